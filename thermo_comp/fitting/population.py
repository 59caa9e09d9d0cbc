# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the prior of a type of unit (`population`): a calibration with the mean parameters of several
units, relative to the scale factors. The covariance of this calibration is the scatter of the
parameters over the units plus the mean of the units' covariances.

References
----------
.. [1] J. Schaefer, K. Strimmer, "A shrinkage approach to large-scale covariance matrix estimation
   and implications for functional genomics", Stat. Appl. Genet. Mol. Biol. 4(1), 2005.
.. [2] A. Gelman et al., "Bayesian Data Analysis", 3rd ed., CRC Press 2013, section 3.2.

"""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import __version__
from ..errors import FitError
from ..thermal.lags import Lag
from ..typing import Floats
from ..unit.calibration import POPULATION, Calibration, RegimeSet, parameter_layout
from ..unit.columns import FINE_TAUS, Column
from ..unit.posterior import ParameterLayout
from ..unit.provenance import Provenance, Source
from ..unit.terms import LINE
from .assembly import blank_terms, parameters_of, with_parameters
from .nonlinear import without_terms
from .priors import constants_of, prior_columns
from .thermal_ranges import union

#: Smallest number of units for a prior: fewer units do not determine the scatter.
UNITS_NEEDED = 3


def population(calibrations: Sequence[Calibration]) -> Calibration:
    """
    Make the prior of a type of unit from calibrations of at least three units.

    Raises FitError for fewer than three calibrations, two of the same unit, a calibration without
    covariance, or different input units, reference temperatures, sensors or forms of the curves.
    """
    # Leave out nonlinear terms: few units have them, as a fit of them needs |f| above 1 g.
    calibrations = [without_terms(each) for each in calibrations]
    _check_alike(calibrations)
    keys: dict[Column, list[Column]] = {}
    for calibration in calibrations:
        for column in prior_columns(calibration):
            for common, _ in _on_common_lags(column):
                keys.setdefault(_without_range(common), []).append(common)
    columns = []
    for key, same in keys.items():
        rest_k = float(np.mean([column.rest_k for column in same]))
        columns.append(replace(key, range=union(column.range for column in same), rest_k=rest_k))
    template = _template(calibrations, columns)
    K = np.array([constants_of(calibration).scale for calibration in calibrations])
    mean_K = np.exp(np.mean(np.log(np.abs(K)), axis=0)) * np.sign(K[0])
    units = [_relative_to(calibration, template, mean_K) for calibration in calibrations]
    vectors = np.array([vector for vector, _ in units])
    mean = vectors.mean(axis=0)
    deviations = (vectors - mean) / np.sqrt(len(vectors) - 1.0)
    scatter = (1.0 + 1.0 / len(vectors)) * _scatter(deviations, parameter_layout(template), mean_K)
    # Add the mean covariance: a parameter that no unit determines keeps its prior variance.
    scatter += np.mean([covariance for _, covariance in units], axis=0)
    return with_parameters(template, mean_K, mean, scatter)


def _check_alike(calibrations: Sequence[Calibration]) -> None:
    """Raise FitError for too few calibrations, two of one unit, or units of different types."""
    if len(calibrations) < UNITS_NEEDED:
        raise FitError(
            f'the prior of a type needs the calibrations of at least {UNITS_NEEDED} units, got '
            f'{len(calibrations)}'
        )
    first, serials = calibrations[0], [each.unit.serial for each in calibrations]
    if twice := sorted(serial for serial in serials if serials.count(serial) > 1):
        raise FitError(f'two calibrations are of unit {twice[0]}: give one calibration per unit')
    for each in calibrations:
        alike = each.unit.input, each.reference_temperature_c, each.sensors
        if alike != (first.unit.input, first.reference_temperature_c, first.sensors):
            raise FitError(
                f'the calibrations of units {each.unit.serial} and {first.unit.serial} differ in '
                'the key unit.input, reference_temperature_c or sensors: they are not of one type'
            )
        signs = [np.sign([axis.scale_factor for axis in unit.axes]) for unit in (each, first)]
        if (signs[0] != signs[1]).any():
            raise FitError(
                f'an axis of unit {each.unit.serial} has a scale factor of the other sign than in '
                f'unit {first.unit.serial}: mount the sensors, or connect their signals, alike'
            )
        if _shape(each) != _shape(first):
            raise FitError(
                f'the curves over temperature of unit {each.unit.serial} have another form than '
                f'those of unit {first.unit.serial}: fit both units with the same --model, '
                '--static-curve and --dynamic-curve'
            )


def _scatter(deviations: Floats, layout: ParameterLayout, K: Floats) -> Floats:
    """
    Return the covariance of the parameters over n units; `deviations`: the parameters less their
    mean, divided by sqrt(n - 1), shape (n, p); `K`: scale factors of the axes.

    The correlations of the bias, scale and misalignment constants with each other and with the
    curves are set to 0: with chance correlations from few units, one position would determine all
    constants of a new unit. The correlations between curves are reduced by a ratio estimated from
    their scatter [1]_. A dynamic curve is first replaced by its difference from the static curve:
    the two curves are equal in most units, and a reduced correlation between the curves would make
    them differ.
    """
    to_differences = np.eye(deviations.shape[1])
    for block in (*layout.bias, *layout.scale):
        n_common = min(block.dynamic - block.static, block.response - block.dynamic)
        for coefficient in range(1, n_common):
            to_differences[block.dynamic + coefficient, block.static + coefficient] = -1.0
    deviations = _with_common_scatter(deviations @ to_differences.T, layout, K)
    kind = np.zeros(deviations.shape[1], np.int64)  # 0: curves; each other number: one constant
    levels = [[block.static, block.dynamic] for block in (*layout.bias, *layout.scale)]
    for number, places in enumerate((*levels, *range(layout.misalignment, len(kind))), 1):
        kind[places] = number
    scatter: Floats = deviations.T @ deviations * (kind[:, np.newaxis] == kind)
    curves = np.flatnonzero((kind == 0) & (np.diag(scatter) > 0.0))
    sd = np.sqrt(np.diag(scatter))
    relative, n = deviations[:, curves] / sd[curves], len(deviations)
    correlation = relative.T @ relative
    variance = n / (n - 1.0) * ((relative**2).T @ relative**2 - correlation**2 / n)
    others = ~np.eye(len(curves), dtype=bool)
    share = np.sum(variance, where=others) / max(np.sum(correlation**2, where=others), 1e-300)
    is_pair = (kind == 0) & ~np.eye(len(kind), dtype=bool)
    # Correlations are reduced by at least 1 %, so that the covariance is not singular.
    scatter[is_pair] *= 1.0 - np.clip(share, 0.01, 1.0)
    # `to_curves` is the inverse of `to_differences`: it adds the static curve to the differences.
    to_curves = 2.0 * np.eye(len(kind)) - to_differences
    return np.asarray(to_curves @ scatter @ to_curves.T)


def _with_common_scatter(deviations: Floats, layout: ParameterLayout, K: Floats) -> Floats:
    """
    Scale the deviations so that each kind of parameter, such as the slope of the bias, has the
    same scatter on all axes with nonzero deviations. The scatter is the predictive sd for a new
    unit by Student's t distribution [2]_, because three units can be alike by chance.
    """
    size = deviations.shape[1]
    units, kinds = np.ones(size), [[*range(layout.misalignment, size)]]
    for block, scale_factor in zip(layout.bias, np.abs(K), strict=True):
        units[block.rows] = scale_factor
    for blocks in (layout.bias, layout.scale):
        kinds += map(list, zip(*(range(block.static, block.end) for block in blocks), strict=True))
    result: Floats = deviations.copy()
    for kind in kinds:
        used = [place for place in kind if deviations[:, place].any()]
        square = np.sum((deviations[:, used] / units[used]) ** 2, axis=0)
        freedom = (len(deviations) - 1.0) * len(used)
        if used:
            growth = freedom / max(freedom - 2.0, 1.0)
            result[:, used] *= np.sqrt(growth * square.mean() / square)
    return result


def _without_range(column: Column) -> Column:
    """Replace `range` and `rest_k` of a column, which differ between units, by fixed values."""
    return replace(column, range=(0.0, 1.0), rest_k=0.0)


def _in_one_stage(column: Column, tau_s: float) -> Column:
    return replace(column, tau_s=tau_s, second_tau_s=0.0, sensor_share=0.0, lead_s=0.0)


def _on_common_lags(column: Column) -> list[tuple[Column, float]]:
    """
    Return columns with lags of the bank (`FINE_TAUS`), and the factor of each column in a sum that
    approximates `column`.

    Parts of two units of a type have different time constants, so a lag is interpolated between
    the lags of the bank, which is common to all units; a lag of 0 s is always 0 K. A lag of two
    stages, a lag behind a temperature between board and sensor, and a lag with a lead are sums of
    first-order lags. A power of a sum of lags is approximated by the power of one lag of the board
    that has the same delay as the sum in a long ramp.
    """
    tau, second, lag = column.tau_s, column.second_tau_s, column.source
    is_line = isinstance(lag, Lag) and column.term.form is LINE
    if not is_line and any(column.part[1:]):
        # Replace a power of a sum of lags by the power of one lag, whose time constant is >= 1 s.
        return _on_common_lags(_in_one_stage(column, max(tau + second - column.lead_s, 1.0)))
    summands: list[tuple[Column, float]] = []
    if column.sensor_share:
        of_board = replace(column, sensor_share=0.0)
        of_sensor = replace(of_board, group='gradient_lag', kind='gradient_lag')
        summands = [(of_board, 1.0), (of_sensor, -column.sensor_share)]
    elif any(column.part[1:]) and isinstance(lag, Lag):
        weights = lag.first_order_weights
        summands = [(_in_one_stage(column, tau_s), share) for (_, tau_s), share in weights.items()]
    if summands:
        return [
            (common, share * part)
            for summand, share in summands
            for common, part in _on_common_lags(summand)
        ]
    if not isinstance(lag, Lag) or tau in FINE_TAUS:
        return [(column, 1.0)]
    at = bisect(FINE_TAUS, tau)
    if not at:
        share = tau / FINE_TAUS[0]
        shortest = replace(column, tau_s=FINE_TAUS[0])
        if column.term.is_temperature:
            return [(replace(column, tau_s=0.0), 1.0 - share), (shortest, share)]
        return [(shortest, share**column.term.order)]
    if at == len(FINE_TAUS):
        return [(replace(column, tau_s=FINE_TAUS[-1]), 1.0)]
    # Interpolate in log time constant between four lags of the bank: Lagrange polynomials.
    first = min(max(at - 2, 0), len(FINE_TAUS) - 4)
    near = FINE_TAUS[first : first + 4]
    result = []
    for tau_s in near:
        others = [other for other in near if other != tau_s]
        share = math.prod(math.log(tau / other) / math.log(tau_s / other) for other in others)
        result.append((replace(column, tau_s=tau_s), share))
    return result


def _relative_to(
    calibration: Calibration, template: Calibration, mean_K: Floats
) -> tuple[Floats, Floats]:
    """Return parameters and covariance in the layout of `template`, for scale factors `mean_K`."""
    if calibration.posterior is None:
        raise FitError(
            f'the calibration of unit {calibration.unit.serial} has no covariance, so it cannot '
            'be part of a prior: fit it to bags; an imported calibration is not sufficient'
        )
    common_columns = [_without_range(column) for column in prior_columns(template)]
    unit_columns = prior_columns(calibration)
    terms = np.zeros((len(common_columns), len(unit_columns)))
    for k, column in enumerate(unit_columns):
        for common, share in _on_common_lags(column):
            terms[common_columns.index(_without_range(common)), k] += share
    scale = constants_of(calibration).scale
    values, factor = parameters_of(calibration), np.ones(calibration.posterior.n_parameters)
    layout, into = parameter_layout(calibration), parameter_layout(template)
    for axis, (bias, relative) in enumerate(zip(layout.bias, layout.scale, strict=True)):
        factor[bias.rows] = mean_K[axis] / scale[axis]
        values[[relative.static, relative.dynamic]] = np.log(scale[axis] / mean_K[axis])
    placed = np.zeros((into.n_parameters, len(values)))
    others = np.arange(layout.nonlinear, len(values))
    placed[others - len(values) + into.n_parameters, others] = 1.0
    for old, new in zip(layout.bias + layout.scale, into.bias + into.scale, strict=True):
        levels = np.eye(old.response - old.static)
        placed[new.static : new.response, old.static : old.response] = levels
        placed[new.response : new.end, old.response : old.end] = terms
    placed = placed * factor
    return placed @ values, placed @ calibration.posterior.covariance() @ placed.T


def _shape(calibration: Calibration) -> list[tuple[str, int]]:
    return [
        (function.kind, function.n_free)
        for regime in calibration.regime_sets()
        for axis in regime.axes()
        for function in (axis.bias_function, axis.scale_function)
    ]


def _template(calibrations: Sequence[Calibration], columns: Sequence[Column]) -> Calibration:
    """Return a calibration with the union of the units' ranges, and with columns of weight 0."""
    first = calibrations[0]
    sds = [[axis.residual_sd_m_s2 for axis in each.static.axes()] for each in calibrations]
    medians = np.median(sds, axis=0).tolist()
    regimes = []
    for each in zip(*(calibration.regime_sets() for calibration in calibrations), strict=True):
        x, y, z = (
            replace(axis, residual_sd_m_s2=sd)
            for axis, sd in zip(each[0].axes(), medians, strict=True)
        )
        temperatures = union(regime.temperature_range_c for regime in each)
        regimes.append(RegimeSet(temperatures, union(r.rate_range_k_min for r in each), x, y, z))
    return replace(
        first,
        unit=replace(first.unit, serial=POPULATION),
        static=regimes[0],
        dynamic=regimes[1],
        response=blank_terms(columns),
        provenance=Provenance(
            tool_version=__version__,
            model=POPULATION,
            sources=tuple(Source(calibration.unit.serial) for calibration in calibrations),
        ),
        evidence=(),
        posterior=None,
        gyroscope=None,
    )
