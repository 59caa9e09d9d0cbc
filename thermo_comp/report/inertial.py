# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what an accelerometer's error means to an inertial navigator, in metres.

A constant error b of a horizontal axis moves the position by ``b t^2 / 2`` at first; over longer
times the Schuler oscillation bounds it, with a peak of ``2 b R / g``.
"""

from __future__ import annotations

from ..unit.gravity import MICRO_G, STANDARD_GRAVITY

#: Times at which a navigator's user asks [s].
TIMES_S = (60.0, 300.0, 600.0)
_EARTH_RADIUS = 6.371e6
#: Peak of the Schuler oscillation for one micro-g [m]: 12.7.
SCHULER_PEAK_PER_MICRO_G = 2.0 * MICRO_G * _EARTH_RADIUS / STANDARD_GRAVITY


def position_error(bias: float, time: float) -> float:
    """
    Give the position error of a constant accelerometer error, while it still grows freely.

    Parameters
    ----------
    bias : float
        Error [m/s^2].
    time : float
        Time of free inertial navigation [s]; well below a quarter Schuler period, 1266 s.

    Returns
    -------
    float
        Metres.

    """
    return 0.5 * bias * time * time


def schuler_peak(bias: float) -> float:
    """
    Give the largest position error of a constant accelerometer error, reached after 42 minutes.

    Parameters
    ----------
    bias : float
        Error [m/s^2].

    Returns
    -------
    float
        Metres.

    """
    return bias / MICRO_G * SCHULER_PEAK_PER_MICRO_G
