# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what is known of a unit before its bags: an earlier calibration of it, or those of siblings.

Both are calibrations: a mean and a covariance of all parameters. What a type of unit has in common
is the mean over units of the parameters relative to the scale factors, and their scatter; an
earlier calibration of the unit itself has grown by its ageing. The fit takes either as the
Gaussian prior of its regression, in the columns of that file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from .. import __version__
from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import (
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    Provenance,
    ResponseTerm,
    Source,
    parameter_layout,
)
from ..unit.columns import Column
from ..unit.posterior import posterior_of
from .assembly import file_parameters
from .options import FitOptions
from .posterior import Regression
from .start import ConstantCalibration
from .unknowns import Known, State
from .windows import Sets

#: A population needs so many units to have a scatter.
UNITS_NEEDED = 3
# What siblings do not have in common may lie in other directions than those few units show: this
# part of the scatter counts for each parameter by itself, and parts of it more may be added.
_ALONE = 0.01
_MORE_ALONE = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
# Correlations are believed to this part of a variance.
_EXACT = 1e-6


def prior_columns(calibration: Calibration) -> tuple[Column, ...]:
    """
    Return the response of a calibration as columns.

    Raises FitError if a column belongs to one regime alone, as in files of version 1.
    """
    for term in calibration.response:
        if term.during != 'always':
            raise FitError(
                f'the prior has a response of the {term.during} regime alone: only columns of '
                'both regimes can serve as a prior'
            )
    return tuple(
        Column(**{field.name: getattr(term, field.name) for field in fields(Column)})
        for term in calibration.response
    )


def prior_sets(calibration: Calibration) -> Sets:
    """Return the curves of a calibration: each regime has its own."""
    return Sets(
        calibration.static.x.bias_function, calibration.dynamic.x.bias_function, is_shared=False
    )


def constants_of(calibration: Calibration) -> ConstantCalibration:
    """Return the nine constants of a calibration at its reference temperature."""
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    return ConstantCalibration(
        np.array([axis.bias for axis in axes]),
        np.array([axis.scale_factor for axis in axes]),
        np.array(calibration.misalignment),
    )


def state_of(calibration: Calibration, regression: Regression, up: Floats) -> State:
    """Return the regression's unknowns as a calibration has them, whose scale is nominal."""
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    K = np.array([axis.scale_factor for axis in axes])
    bias = np.array([axis.bias for axis in axes])
    on_bias, on_scale = [], []
    pairs = zip(calibration.static.axes(), calibration.dynamic.axes(), strict=True)
    for axis, (static, dynamic) in enumerate(pairs):
        on_bias.append(
            [
                *static.bias_function.free_coefficients,
                dynamic.delta - static.delta,
                *dynamic.bias_function.free_coefficients,
                *(term.bias[axis] for term in calibration.response),
            ]
        )
        on_scale.append(
            [
                *static.scale_function.free_coefficients,
                0.0,
                *dynamic.scale_function.free_coefficients,
                *(term.scale[axis] for term in calibration.response),
            ]
        )
        bias[axis] += static.delta
    if len({len(row) for row in (*on_bias, *on_scale)}) > 1:
        raise FitError('the curves of the prior differ from axis to axis, or from bias to scale')
    inverse = np.linalg.inv(np.array(calibration.misalignment))
    n_lags = len(regression.windows.start_covariance)
    return State(
        kappa=np.ones(3),
        bias=bias / K,
        weights=np.stack((np.array(on_bias) / K[:, None], on_scale)) * regression.rms,
        skew=np.array([inverse[1, 0], inverse[2, 0], inverse[2, 1]]),
        up=up,
        offset=np.zeros((len(up), 3)),
        start=np.zeros((regression.n_bags, n_lags)),
    )


def known_of(
    calibration: Calibration, regression: Regression, state: State, sets: Sets, options: FitOptions
) -> list[Known]:
    """
    Turn a calibration into the prior of a regression on its columns: several, for the evidence.

    Each takes more of every parameter's variance for its own. Raises FitError if the calibration
    makes no claim.
    """
    if calibration.posterior is None:
        raise FitError('the prior has no covariance: an import makes no claim to build on')
    K = np.array(
        [a.scale_factor for a in (calibration.axes.x, calibration.axes.y, calibration.axes.z)]
    )
    covariance = calibration.posterior.covariance()
    places = parameter_layout(calibration)
    for axis in range(3):
        for block, sd in (
            (places.bias[axis], options.ageing_bias * K[axis]),
            (places.scale[axis], options.ageing_scale),
        ):
            levels = [block.static, block.dynamic]
            covariance[np.ix_(levels, levels)] += sd * sd
    diagonal = np.diag(covariance)
    floor = np.where(diagonal > 0.0, diagonal, np.min(diagonal[diagonal > 0.0], initial=1.0))
    layout = regression.layout(regression.windows.parts)
    to_file = file_parameters(regression, layout, state, sets, K, range(len(calibration.response)))
    root = np.sqrt(floor)
    scaled, correlation = to_file / root[:, None], covariance / np.outer(root, root)
    mean = regression.vector(state, layout)[: layout.n_unit]
    result = []
    for more in _MORE_ALONE:
        wider = correlation + (_EXACT + more) * np.eye(len(root))
        precision = scaled.T @ np.linalg.solve(wider, scaled)
        result.append(Known(mean, (precision + precision.T) / 2.0))
    return result


def population(calibrations: Sequence[Calibration]) -> Calibration:
    """
    Make the prior of a type of unit from the calibrations of some.

    Raises FitError if the units are too few or their calibrations not alike.
    """
    if len(calibrations) < UNITS_NEEDED:
        raise FitError(f'{len(calibrations)} calibrations, need {UNITS_NEEDED} for a population')
    first = calibrations[0]
    serials = {one.unit.serial for one in calibrations}
    if len(serials) < len(calibrations):
        raise FitError('two of the calibrations are of one unit: a population needs one of each')
    for one in calibrations:
        alike = (one.unit.input, one.reference_temperature_c, one.sensors)
        if alike != (first.unit.input, first.reference_temperature_c, first.sensors):
            raise FitError(
                f'{one.unit.serial} differs from {first.unit.serial} in its input, reference '
                'temperature or sensors: they are not of one type'
            )
        if _shape(one) != _shape(first):
            raise FitError(
                f'{one.unit.serial} has other curves than {first.unit.serial}: fit both with the '
                'same model'
            )
    keys: dict[Column, list[tuple[float, float]]] = {}
    for one in calibrations:
        for column, key in zip(prior_columns(one), _unranged(prior_columns(one)), strict=True):
            keys.setdefault(key, []).append(column.range)
    columns = [
        replace(key, range=(min(r[0] for r in ranges), max(r[1] for r in ranges)))
        for key, ranges in keys.items()
    ]
    K = np.array([[a.scale_factor for a in (c.axes.x, c.axes.y, c.axes.z)] for c in calibrations])
    mean_K = np.exp(np.mean(np.log(np.abs(K)), axis=0)) * np.sign(K[0])
    told = [_told(one, columns, mean_K) for one in calibrations]
    vectors = np.array([vector for vector, _ in told])
    mean = vectors.mean(axis=0)
    away = (vectors - mean) / np.sqrt(len(vectors) - 1.0)
    scatter = (1.0 - _ALONE) * away.T @ away
    scatter[np.diag_indices_from(scatter)] += _ALONE * np.sum(away**2, axis=0)
    # Of the mean itself, too.
    scatter *= 1.0 + 1.0 / len(vectors)
    # What none of the units told is as alike in all as their prior was: it stays as unknown.
    scatter += np.mean([covariance for _, covariance in told], axis=0)
    return _calibration(calibrations, columns, mean_K, mean, scatter)


def _unranged(columns: Sequence[Column]) -> list[Column]:
    """Return columns as they are told apart: units differ in what range each has seen."""
    return [replace(column, range=(0.0, 1.0)) for column in columns]


def _told(
    calibration: Calibration, columns: Sequence[Column], mean_K: Floats
) -> tuple[Floats, Floats]:
    """
    Return a unit's parameters and covariance in the order of a file with these columns.

    At the mean scale factors; 0 for columns that it does not have. Raises FitError if the
    calibration makes no claim.
    """
    if calibration.posterior is None:
        raise FitError(
            f'{calibration.unit.serial} has no covariance: an import says nothing of its type'
        )
    everything = _unranged(columns)
    terms = [everything.index(column) for column in _unranged(prior_columns(calibration))]
    values: list[float] = []
    factor: list[float] = []
    places: list[int] = []
    at = 0
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    pairs = zip(calibration.static.axes(), calibration.dynamic.axes(), strict=True)
    for axis, sets in enumerate(pairs):
        K = axes[axis].scale_factor
        scale = float(np.log(K / mean_K[axis]))
        for part, relative, levels in (
            ('bias', mean_K[axis] / K, [axes[axis].bias + one.delta for one in sets]),
            ('scale', 1.0, [scale, scale]),
        ):
            own: list[float] = []
            for level, one in zip(levels, sets, strict=True):
                own += [level, *getattr(one, f'{part}_function').free_coefficients]
            places += [*range(at, at + len(own)), *(at + len(own) + k for k in terms)]
            at += len(own) + len(columns)
            own += [getattr(term, part)[axis] for term in calibration.response]
            values += own
            factor += [relative] * len(own)
    M = calibration.misalignment
    values += [M[1][0], M[2][0], M[2][1]]
    factor += [1.0] * 3
    places += range(at, at + 3)
    vector, covariance = np.zeros(at + 3), np.zeros((at + 3, at + 3))
    vector[places] = np.multiply(values, factor)
    covariance[np.ix_(places, places)] = calibration.posterior.covariance() * np.outer(
        factor, factor
    )
    return vector, covariance


def _shape(calibration: Calibration) -> list[tuple[str, int]]:
    return [
        (function.kind, function.n_free)
        for regime in calibration.regime_sets()
        for axis in regime.axes()
        for function in (axis.bias_function, axis.scale_function)
    ]


def _calibration(
    calibrations: Sequence[Calibration],
    columns: Sequence[Column],
    mean_K: Floats,
    mean: Floats,
    scatter: Floats,
) -> Calibration:
    """Write a mean and a scatter as a calibration like the first one."""
    first = calibrations[0]
    static: list[AxisSet] = []
    dynamic: list[AxisSet] = []
    weights: list[tuple[Floats, Floats]] = []
    references = []
    at = 0
    pairs = zip(first.static.axes(), first.dynamic.axes(), strict=True)
    for axis, sets in enumerate(pairs):
        parts = []
        for name in ('bias_function', 'scale_function'):
            n, m = (getattr(one, name).n_free for one in sets)
            size = 2 + n + m + len(columns)
            parts.append(np.split(mean[at : at + size], [1, 1 + n, 2 + n, 2 + n + m]))
            at += size
        (level,), of_static, (moved,), of_dynamic, on_bias = parts[0]
        references.append(AxisReference(float(mean_K[axis]), float(level)))
        for made, one, bias, scale, delta in (
            (static, sets[0], of_static, parts[1][1], 0.0),
            (dynamic, sets[1], of_dynamic, parts[1][3], float(moved - level)),
        ):
            made.append(
                replace(
                    one,
                    bias_function=one.bias_function.with_free(tuple(bias.tolist())),
                    scale_function=one.scale_function.with_free(tuple(scale.tolist())),
                    delta=delta,
                    residual_sd_m_s2=_median(calibrations, axis),
                )
            )
        weights.append((on_bias, parts[1][4]))
    a, b, c = mean[-3:].tolist()
    regimes = []
    for name, made in (('static', static), ('dynamic', dynamic)):
        ranges = [getattr(one, name) for one in calibrations]
        regimes.append(
            replace(
                ranges[0],
                temperature_range_c=_union([r.temperature_range_c for r in ranges]),
                rate_range_k_min=_union([r.rate_range_k_min for r in ranges]),
                x=made[0],
                y=made[1],
                z=made[2],
            )
        )
    sd = np.sqrt(np.diag(scatter)[-3:]).tolist()
    return replace(
        first,
        unit=replace(first.unit, serial='population'),
        axes=Axes(*references),
        static=regimes[0],
        dynamic=regimes[1],
        misalignment=((1.0, 0.0, 0.0), (a, 1.0, 0.0), (b, c, 1.0)),
        misalignment_sd=(sd[0], sd[1], sd[2]),
        response=tuple(
            ResponseTerm(
                **{field.name: getattr(column, field.name) for field in fields(Column)},
                bias=(float(weights[0][0][k]), float(weights[1][0][k]), float(weights[2][0][k])),
                scale=(float(weights[0][1][k]), float(weights[1][1][k]), float(weights[2][1][k])),
            )
            for k, column in enumerate(columns)
        ),
        provenance=Provenance(
            tool_version=__version__,
            model='population',
            sources=tuple(Source(one.unit.serial) for one in calibrations),
        ),
        evidence=(),
        posterior=posterior_of(scatter),
        gyroscope=None,
    )


def _median(calibrations: Sequence[Calibration], axis: int) -> float:
    return float(np.median([one.static.axes()[axis].residual_sd_m_s2 for one in calibrations]))


def _union(ranges: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return min(r[0] for r in ranges), max(r[1] for r in ranges)
