# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the families of the curves over temperature: what a fit's option means in functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..unit.functions import CubicSpline, Exponential, Polynomial, TemperatureFunction
from .options import FitOptions
from .reduction import ReducedBag
from .windows import Sets

_ORDERS = {'linear': 1, 'quadratic': 2, 'cubic': 3}
_SPLINE_PIECES = 4
# Knots nearer to the reference than this part of their distance fall on it.
_NEAR = 0.3
# Semiconductors double their leakage in some 10 K: an e-fold of 15 K, and of twice that.
_E_FOLDS_K = (15.0, 30.0)


def sets_of(options: FitOptions, bags: Sequence[ReducedBag]) -> Sets:
    """Choose the curves of the two sets."""
    readings = [bag.board.value for bag in bags if len(bag.board.value)]
    if not readings:
        line = _family('linear', 0.0, 0.0)
        return Sets(line, line)
    span = (min(float(r.min()) for r in readings), max(float(r.max()) for r in readings))
    lower, upper = (edge - options.reference_temperature for edge in span)
    is_paper = options.model == 'golovach'
    static = options.static_curve or ('linear' if is_paper else 'cubic')
    dynamic = options.dynamic_curve or ('quadratic' if is_paper else None)
    if dynamic is None and static in _ORDERS:
        return Sets(_family(static, lower, upper), _family('quadratic', lower, upper))
    return Sets(
        _family(static, lower, upper), _family(dynamic or static, lower, upper), is_shared=False
    )


def _family(name: str, lower: float, upper: float) -> TemperatureFunction:
    if name in _ORDERS:
        return Polynomial((0.0, *[1.0] * _ORDERS[name]))
    if name == 'exponential':
        return Exponential(-float(len(_E_FOLDS_K)), (1.0,) * len(_E_FOLDS_K), _E_FOLDS_K)
    knots = np.linspace(lower, upper, _SPLINE_PIECES + 1)
    step = max((upper - lower) / _SPLINE_PIECES, 1.0)
    kept = sorted([0.0, *(float(k) for k in knots if abs(k) > _NEAR * step)])
    return CubicSpline(tuple(kept), tuple(float(k != 0.0) for k in kept))
