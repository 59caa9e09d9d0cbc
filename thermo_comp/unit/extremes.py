# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the extreme values that a function of temperature takes over a range."""

from __future__ import annotations

import math

import numpy as np

from ..typing import Floats
from .functions import Polynomial, TemperatureFunction

_GRID = 513


def extreme_values(
    function: TemperatureFunction, lower: float, upper: float
) -> tuple[float, float]:
    """
    Find the smallest and the largest value of a function over a range.

    `lower, upper`: the range of t [K].
    """
    t = np.linspace(lower, upper, _GRID)
    if isinstance(function, Polynomial):
        t = np.append(t, _extremes(function, lower, upper))
    try:
        with np.errstate(all='ignore'):
            values = function.value(t)
    except OverflowError:
        return -math.inf, math.inf
    if not np.all(np.isfinite(values)):
        return -math.inf, math.inf
    return float(np.min(values)), float(np.max(values))


def _extremes(function: Polynomial, lower: float, upper: float) -> Floats:
    """Find where a polynomial can have its extremes inside a range."""
    reach = max(abs(lower), abs(upper), 1.0)
    slope = [power * c for power, c in enumerate(function.coefficients)][1:]
    # A term that cannot move the function by 1e-12 anywhere in the range moves no extreme either,
    # and as a leading coefficient it would overflow the companion matrix.
    while slope and not abs(slope[-1]) * reach ** len(slope) > 1e-12:
        slope.pop()
    if len(slope) < 2 or not np.all(np.isfinite(slope)):
        return np.empty(0)
    return np.clip(np.roots(slope[::-1]).real, lower, upper)
