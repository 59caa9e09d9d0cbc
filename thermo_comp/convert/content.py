# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what another tool's file says of a unit, on its way out or in.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..typing import Floats


@dataclass(frozen=True)
class Content:
    """
    What a file says: ``a = matrix (N - bias)``, the bias a cubic of temperature.

    matrix: shape (3, 3); of an autopilot's file the identity
    bias: coefficients of each axis, in units of N, shape (3, 4)
    reference_c, range_c: the temperature that the cubics count from, and where they hold
    notes: what is lost, or lacks
    source: the tool and the set that was read
    rate_bias: as `bias`, of the angular rate [rad/s], where it is known and can be said
    noise: white [m/s^2/sqrt(Hz)], walk [m/s^2/sqrt(h)], samples per second, on the way out
    """

    matrix: Floats
    bias: Floats
    reference_c: float
    range_c: tuple[float, float]
    notes: list[str]
    source: str = ''
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_bias: Floats | None = None
