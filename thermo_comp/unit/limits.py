# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the limits of a calibration's bias and scale over its temperatures.

The bias at the reference temperature, and its change over temperature, are each at most twice the
full scale. The effect of a column on the bias, and of a parameter's sd on bias or scale, is at
most a million times the limit of bias or scale: no instrument needs more, and no float overflows.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..quantities import QUANTITIES
from .functions import TANGENT_SPANS, TemperatureFunction
from .posterior import ParameterLayout
from .schema import broken

if TYPE_CHECKING:
    from .calibration import Calibration

#: Limits of the relative scale: its curve over temperature, minus and plus the effects of columns.
SMALLEST_RELATIVE_SCALE, LARGEST_RELATIVE_SCALE = 0.1, 10.0
#: Largest bias / full scale. (Samples in an offset code have a bias of half of their range.)
FULL_SCALES = 2.0
#: Largest effect of a column, or of a parameter's sd, divided by the limit of bias or scale.
WORST = 1e6
#: Number of temperatures at which a function of temperature is checked.
_GRID = 513
#: Words of error messages for the temperatures at which a function is checked.
_AROUND = f'range and, on each side, along the tangent for {TANGENT_SPANS:g} of the range'


def check_limits(calibration: Calibration, layout: ParameterLayout) -> None:
    """Raise ValueError, with the name of the key, if a value of a calibration is too large."""
    reference, sets = calibration.reference_temperature_c, calibration.regime_sets()
    limit = FULL_SCALES * calibration.unit.full_scale
    _check_axes(calibration, limit)
    edges = [[edge - reference for edge in part.temperature_range_c] for part in sets]
    outermost = min(map(min, edges)), max(map(max, edges))
    if calibration.nonlinearity is not None:
        force = calibration.unit.full_scale / min(abs(a.scale_factor) for a in calibration.axes)
        calibration.nonlinearity.check_slope(force, outermost)
    response = calibration.response
    farthest_k = max(map(abs, outermost))
    largest = (min(max(map(abs, term.range)), term.term.largest(term)) for term in response)
    sizes = [u * farthest_k**term.power for u, term in zip(largest, response, strict=True)]
    for k, (term, size) in enumerate(zip(response, sizes, strict=True)):
        effect = size * max(map(abs, term.bias))
        if not effect <= WORST * limit:
            rule = f'keep the largest effect of the column within {WORST * limit:g} input units'
            raise broken(f'response[{k}].bias', rule, effect)
    for regime, part, ends in zip(('static', 'dynamic'), sets, edges, strict=True):
        is_active = [term.during in ('always', regime) for term in response]
        for k, (name, axis) in enumerate(zip('xyz', part.axes(), strict=True)):
            terms = zip(response, sizes, is_active, strict=True)
            effect = sum(abs(term.scale[k]) * size for term, size, is_used in terms if is_used)
            _check_scale(f'{regime}.{name}', _extremes(axis.scale_function, ends), effect)
        for name, at, axis in zip('xyz', calibration.axes, part.axes(), strict=True):
            extremes = _extremes(axis.bias_function, ends)
            _check_bias(f'{regime}.{name}', at.bias + axis.delta, extremes, limit)
    if calibration.posterior is None:
        return
    calibration.posterior.check_size(layout.n_parameters)
    variances = (calibration.posterior.matrix**2).sum(axis=1) + calibration.posterior.variances
    for k, axes in enumerate(zip(*(part.axes() for part in sets), strict=True)):
        for block, functions, bound in (
            (layout.bias[k], [axis.bias_function for axis in axes], limit),
            (layout.scale[k], [axis.scale_function for axis in axes], LARGEST_RELATIVE_SCALE),
        ):
            sd = np.sqrt(variances[block.rows])
            worst = np.max(sd * [*_regressors(functions, edges), *sizes])
            if not worst <= WORST * bound:
                rule = f"keep the effect of each parameter's sd at most {WORST * bound:g} "
                rule += '(bias: input units; scale: relative)'
                raise broken('posterior.factor', rule, worst)


def _check_axes(calibration: Calibration, limit: float) -> None:
    for name, axis in zip('xyz', calibration.axes, strict=True):
        if abs(axis.bias) > limit:
            rule = f'be within twice unit.full_scale, {limit:g}'
            raise broken(f'axes.{name}.bias', rule, float(axis.bias))
        force = calibration.unit.full_scale / abs(axis.scale_factor)
        if fault := QUANTITIES['full-scale force'].fault(force):
            raise ValueError(
                f'`axes.{name}.scale_factor` makes unit.full_scale a force that {fault} m/s^2, '
                f'got {force:g}'
            )


def _check_bias(key: str, level: float, extremes: tuple[float, float], limit: float) -> None:
    if abs(level) > limit:
        rule = f'keep bias plus delta within {limit:g} input units'
        raise broken(f'{key}.delta', rule, float(level))
    smallest, largest = extremes
    if not math.isfinite(largest - smallest):
        raise ValueError(f'`{key}.bias_function` must be finite over its {_AROUND}')
    if max(-smallest, largest) > limit:
        raise ValueError(
            f'`{key}.bias_function` must stay within {limit:g} input units over its {_AROUND}, '
            f'reaches {max(extremes, key=abs):g}'
        )


def _check_scale(key: str, extremes: tuple[float, float], effect: float) -> None:
    """Refuse a scale beyond its limits; `effect`: largest effect of all columns on the scale."""
    for word, value, is_kept, limit in (
        ('above', extremes[0] - effect, operator.gt, SMALLEST_RELATIVE_SCALE),
        ('below', extremes[1] + effect, operator.lt, LARGEST_RELATIVE_SCALE),
    ):
        if not is_kept(value, limit):
            raise ValueError(
                f'`{key}.scale_function` must stay {word} {limit:g} with all columns, over its '
                f'{_AROUND}, reaches {value:.4g}'
            )


def _extremes(function: TemperatureFunction, edges: Sequence[float]) -> tuple[float, float]:
    """Return the smallest and largest values of a function and its tangents beyond `edges`."""
    lower, upper = edges
    t = np.linspace(lower, upper, _GRID)
    beyond_k = TANGENT_SPANS * (upper - lower)
    try:
        with np.errstate(all='ignore'):
            values = function.value(t)
            ends = values[[0, -1]] + function.slope(t[[0, -1]]) * np.array([-beyond_k, beyond_k])
            values = np.append(values, ends)
    except OverflowError:
        return -math.inf, math.inf
    if not np.isfinite(values).all():
        return -math.inf, math.inf
    return float(np.min(values)), float(np.max(values))


def _regressors(
    functions: Sequence[TemperatureFunction], edges: Sequence[Sequence[float]]
) -> list[float]:
    """Return largest |derivatives| of functions w.r.t. their value at T_ref and coefficients."""
    pairs = zip(functions, edges, strict=True)
    both = [function.basis(np.array(ends)) for function, ends in pairs]
    return [size for basis in both for size in (1.0, *(float(np.abs(v).max()) for v in basis))]
