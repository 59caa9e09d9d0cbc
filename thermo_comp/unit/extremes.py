# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the smallest value that a function of temperature takes over a range.

"""

from __future__ import annotations

import numpy as np

from ..typing import Floats
from .functions import Polynomial, TemperatureFunction

_GRID = 513


def smallest_value(function: TemperatureFunction, lower: float, upper: float) -> float:
    """
    Find the smallest value of a function over a range.

    Parameters
    ----------
    function : Polynomial or CubicSpline or Exponential
        The function.
    lower, upper : float
        The range of t [K].

    Returns
    -------
    float
        Its smallest value; not finite where the function overflows.

    """
    t = np.linspace(lower, upper, _GRID)
    if isinstance(function, Polynomial):
        t = np.append(t, _extremes(function, lower, upper))
    with np.errstate(all='ignore'):
        return float(np.min(function.value(t)))


def _extremes(function: Polynomial, lower: float, upper: float) -> Floats:
    """
    Find where a polynomial can have its extremes inside a range.

    """
    reach = max(abs(lower), abs(upper), 1.0)
    slope = [power * c for power, c in enumerate(function.coefficients)][1:]
    # A term that cannot move the function by 1e-12 anywhere in the range moves no extreme either,
    # and as a leading coefficient it would overflow the companion matrix.
    while slope and not abs(slope[-1]) * reach ** len(slope) > 1e-12:
        slope.pop()
    if len(slope) < 2 or not np.all(np.isfinite(slope)):
        return np.empty(0)
    return np.clip(np.roots(slope[::-1]).real, lower, upper)
