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
from scipy.linalg import solve_triangular

from .. import __version__
from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import POPULATION, Calibration, RegimeSet, parameter_layout
from ..unit.columns import Column
from ..unit.provenance import Provenance, Source
from .assembly import blank_terms, file_parameters, parameters_of, union, with_parameters
from .equations import as_vector
from .nonlinear import without_terms
from .options import FitOptions
from .regression import Regression
from .start import ConstantCalibration
from .unknowns import InformativePrior, State
from .windows import Sets

#: A population needs so many units to have a scatter.
UNITS_NEEDED = 3
# What siblings do not have in common may lie in other directions than those few units show: this
# part of the scatter counts for each parameter by itself, and parts of it more may be added.
_ALONE = 0.01
_MORE_ALONE = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
# Ageing that nobody has stated, of biases [parts of g] and of scales, is what the bags show.
_AGEINGS = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3)
# Ageing of scales is as large as that of biases, in these units, or a small part of it.
_SCALE_SHARES = (0.0, 0.01, 1.0)
# Correlations are believed to this part of a variance.
_EXACT = 1e-6


def prior_columns(calibration: Calibration) -> tuple[Column, ...]:
    """Return the response as columns; FitError if one is of one regime, as in version 1."""
    for term in calibration.response:
        if term.during != 'always':
            raise FitError(
                f'the prior has a response of the {term.during} regime alone: only columns of '
                'both regimes can serve as a prior'
            )
    names = [field.name for field in fields(Column)]
    return tuple(
        Column(**{name: getattr(term, name) for name in names}) for term in calibration.response
    )


def prior_sets(calibration: Calibration) -> Sets:
    """Return the curves of a calibration: each regime has its own."""
    return Sets(
        calibration.static.x.bias_function, calibration.dynamic.x.bias_function, is_shared=False
    )


def constants_of(calibration: Calibration) -> ConstantCalibration:
    """Return the nine constants of a calibration at its reference temperature."""
    return ConstantCalibration(
        np.array([axis.bias for axis in calibration.axes]),
        np.array([axis.scale_factor for axis in calibration.axes]),
        np.array(calibration.misalignment),
    )


def with_calibration(calibration: Calibration, regression: Regression, state: State) -> State:
    """Give a state the bias and weights of a calibration, whose scale is nominal."""
    layout, values = parameter_layout(calibration), parameters_of(calibration)
    if len({(b - a, d - a) for a, b, _, d in (*layout.bias, *layout.scale)}) > 1:
        raise FitError('the curves of the prior differ from axis to axis, or from bias to scale')
    # Of each axis the level of the static set, and behind it what else there is beside that.
    both = np.array([[values[one.static : one.end] for one in part] for part in layout[:2]])
    both[..., layout.bias[0].dynamic] -= both[..., 0]
    both[0] /= regression.nominal_scale[:, None]
    return replace(state, bias=both[0, :, 0], weights=both[..., 1:] * regression.rms)


def informative_priors(
    calibration: Calibration, regression: Regression, state: State, sets: Sets, options: FitOptions
) -> list[InformativePrior]:
    """
    Turn a calibration into priors on its columns, for the evidence, the last to begin with;
    FitError without claim.
    """
    if calibration.posterior is None:
        raise FitError('the prior has no covariance: an import makes no claim to build on')
    K = constants_of(calibration).scale
    covariance = calibration.posterior.covariance()
    places = parameter_layout(calibration)

    def grown(bias_sd: float, scale_sd: float) -> Floats:
        result: Floats = covariance.copy()
        for axis in range(3):
            for block, sd in (
                (places.bias[axis], bias_sd * K[axis]),
                (places.scale[axis], scale_sd),
            ):
                levels = [block.static, block.dynamic]
                result[np.ix_(levels, levels)] += sd * sd
        return result

    stated = options.ageing_bias, options.ageing_scale
    tried = [(grown(*stated), more) for more in _MORE_ALONE]
    if not any(stated):
        tried += [
            (grown(ageing * options.gravity, share * ageing), 0.0)
            for share in _SCALE_SHARES
            for ageing in _AGEINGS
        ]
    # The fit only begins with the last: noise must not take what a narrow one leaves.
    tried.append((tried[-1][0], _MORE_ALONE[-1]))
    layout = regression.layout(regression.windows.parts)
    kinds = regression.forces.kinds if regression.forces else ()
    used = range(len(calibration.response))
    to_file = file_parameters(regression, layout, state, sets, used, kinds)
    mean = as_vector(state, layout)[: layout.n_unit]
    result = []
    for known, more in tried:
        diagonal = np.diag(known)
        floor = np.where(diagonal > 0.0, diagonal, np.min(diagonal[diagonal > 0.0], initial=1.0))
        sd = np.sqrt(floor)
        scaled, correlation = to_file / sd[:, None], known / np.outer(sd, sd)
        wider = correlation + (_EXACT + more) * np.eye(len(sd))
        # Parameters that are almost one, as the levels of both sets, would drown in a product.
        whitened = solve_triangular(np.linalg.cholesky(wider), scaled, lower=True)
        root: Floats = np.asarray(np.linalg.qr(whitened, mode='r'))
        root = root * np.sign(np.diag(root))[:, None]
        result.append(InformativePrior(mean, root))
    return result


def population(calibrations: Sequence[Calibration]) -> Calibration:
    """Make the prior of a type of unit from some; FitError if they are too few or not alike."""
    if len(calibrations) < UNITS_NEEDED:
        raise FitError(f'{len(calibrations)} calibrations, need {UNITS_NEEDED} for a population')
    # Units of a type need not share a nonlinearity, which takes a centrifuge to see.
    calibrations = [without_terms(one) if one.nonlinearity else one for one in calibrations]
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
    keys: dict[Column, list[Column]] = {}
    for one in calibrations:
        for column, key in zip(prior_columns(one), _alike(prior_columns(one)), strict=True):
            keys.setdefault(key, []).append(column)
    columns = [
        replace(
            key,
            range=union(one.range for one in own),
            rest_k=float(np.mean([one.rest_k for one in own])),
        )
        for key, own in keys.items()
    ]
    like = _like(calibrations, columns)
    K = np.array([constants_of(one).scale for one in calibrations])
    mean_K = np.exp(np.mean(np.log(np.abs(K)), axis=0)) * np.sign(K[0])
    told = [_told(one, like, mean_K) for one in calibrations]
    vectors = np.array([vector for vector, _ in told])
    mean = vectors.mean(axis=0)
    away = (vectors - mean) / np.sqrt(len(vectors) - 1.0)
    scatter = (1.0 - _ALONE) * away.T @ away
    scatter[np.diag_indices_from(scatter)] += _ALONE * np.sum(away**2, axis=0)
    # Of the mean itself, too.
    scatter *= 1.0 + 1.0 / len(vectors)
    # What none of the units told is as alike in all as their prior was: it stays as unknown.
    scatter += np.mean([covariance for _, covariance in told], axis=0)
    return with_parameters(like, mean_K, mean, scatter)


def _alike(columns: Sequence[Column]) -> list[Column]:
    """Return columns as they are told apart: units differ in what they have seen, and in heat."""
    return [replace(column, range=(0.0, 1.0), rest_k=0.0) for column in columns]


def _told(calibration: Calibration, like: Calibration, mean_K: Floats) -> tuple[Floats, Floats]:
    """Return a unit's parameters and covariance at the places of others, at the mean scale."""
    if calibration.posterior is None:
        raise FitError(
            f'{calibration.unit.serial} has no covariance: an import says nothing of its type'
        )
    everything = _alike(prior_columns(like))
    terms = [everything.index(column) for column in _alike(prior_columns(calibration))]
    scale = constants_of(calibration).scale
    values, factor = parameters_of(calibration), np.ones(calibration.posterior.n_parameters)
    layout, into = parameter_layout(calibration), parameter_layout(like)
    for axis, (bias, relative) in enumerate(zip(layout.bias, layout.scale, strict=True)):
        factor[bias.static : bias.end] = mean_K[axis] / scale[axis]
        values[[relative.static, relative.dynamic]] = np.log(scale[axis] / mean_K[axis])
    places = np.arange(into.n_parameters - len(values), into.n_parameters)
    blocks = zip((*layout.bias, *layout.scale), (*into.bias, *into.scale), strict=True)
    for own, block in blocks:
        response = [block.response + k for k in terms]
        places[own.static : own.end] = [*range(block.static, block.response), *response]
    placed = np.zeros((into.n_parameters, len(values)))
    placed[places, np.arange(len(values))] = factor
    return placed @ values, placed @ calibration.posterior.covariance() @ placed.T


def _shape(calibration: Calibration) -> list[tuple[str, int]]:
    return [
        (function.kind, function.n_free)
        for regime in calibration.regime_sets()
        for axis in regime.axes()
        for function in (axis.bias_function, axis.scale_function)
    ]


def _like(calibrations: Sequence[Calibration], columns: Sequence[Column]) -> Calibration:
    """Make a calibration like some, of these columns, which its parameters wait for."""
    first = calibrations[0]
    slow = [[axis.residual_sd_m_s2 for axis in one.static.axes()] for one in calibrations]
    regimes = []
    for k, regime in enumerate(first.regime_sets()):
        each = [one.regime_sets()[k] for one in calibrations]
        x, y, z = (
            replace(own, residual_sd_m_s2=float(sd))
            for own, sd in zip(regime.axes(), np.median(slow, axis=0), strict=True)
        )
        temperatures = union([one.temperature_range_c for one in each])
        rates = union([one.rate_range_k_min for one in each])
        regimes.append(RegimeSet(temperatures, rates, x, y, z))
    return replace(
        first,
        unit=replace(first.unit, serial=POPULATION),
        static=regimes[0],
        dynamic=regimes[1],
        response=blank_terms(columns),
        provenance=Provenance(
            tool_version=__version__,
            model=POPULATION,
            sources=tuple(Source(one.unit.serial) for one in calibrations),
        ),
        evidence=(),
        posterior=None,
        gyroscope=None,
    )
