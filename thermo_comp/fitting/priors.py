# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the informative prior of a fit, from a calibration of the unit or its type (`population`).

The mean and the covariance of the Gaussian prior of the regression are the parameters of the
calibration and their covariance, increased by the ageing of the unit since the calibration. The
fit uses exactly the columns of the calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
from scipy.linalg import solve_triangular

from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import POPULATION, Calibration, parameter_layout
from ..unit.columns import Column
from .assembly import file_jacobian, parameters_of
from .equations import as_vector
from .hyperparameters import CLEAR_GAIN, log_student
from .initial_triad import ConstantCalibration
from .options import FitOptions
from .regression import Regression
from .thermal_ranges import union
from .unknowns import InformativePrior, State
from .windows import Model, Sets


def prior_columns(calibration: Calibration) -> tuple[Column, ...]:
    """Return the response columns; FitError for a term that applies in one regime only."""
    for term in calibration.response:
        if term.during != 'always':
            raise FitError(
                f'the prior has a thermal response for the {term.during} regime only: fit the '
                'bags of the prior again, with this release'
            )
    names = [field.name for field in fields(Column)]
    return tuple(
        Column(**{name: getattr(term, name) for name in names}) for term in calibration.response
    )


def prior_model(calibration: Calibration) -> Model:
    """
    Return the model of a calibration, with one curve for each regime.

    Windows more than 1 K beyond the temperature range of a calibration of the same unit are not
    used: extrapolated columns would change the calibration's effects of temperature.
    """
    regimes = calibration.regime_sets()
    static, dynamic = (regime.x.bias_function for regime in regimes)
    lower, upper = union(regime.temperature_range_c for regime in regimes)
    is_limited = calibration.needs_temperature and calibration.provenance.model != POPULATION
    return Model(
        name=calibration.provenance.model,
        sets=Sets(static, dynamic, is_shared=False),
        columns=prior_columns(calibration),
        sensors=calibration.sensors,
        detector=calibration.detector,
        reference_temperature=calibration.reference_temperature_c,
        range_c=(lower - 1.0, upper + 1.0) if is_limited else (-np.inf, np.inf),
    )


def constants_of(calibration: Calibration) -> ConstantCalibration:
    """Return the nine constants of a calibration at its reference temperature."""
    return ConstantCalibration(
        np.array([axis.bias for axis in calibration.axes]),
        np.array([axis.scale_factor for axis in calibration.axes]),
        np.array(calibration.misalignment),
    )


def offset_sd_of(calibration: Calibration) -> float:
    """Return the smallest of the axes' sds of the bias offset of a mounting or turn-on [m/s^2]."""
    axes = [axis for part in calibration.regime_sets() for axis in part.axes()]
    return min(axis.residual_sd_m_s2 for axis in axes)


def with_calibration(calibration: Calibration, regression: Regression, state: State) -> State:
    """Return `state` with bias and weights of a calibration that has the nominal scale factors."""
    layout, values = parameter_layout(calibration), parameters_of(calibration)
    if len({(b - a, d - a) for a, b, _, d in (*layout.bias, *layout.scale)}) > 1:
        raise FitError(
            'the curves of the prior have different forms on the axes, or for bias and scale: a '
            'prior needs curves of one form, as a fit writes them'
        )
    # Replace the level of the dynamic set by its difference from the level of the static set.
    both = np.array([[values[block.rows] for block in part] for part in layout[:2]])
    both[..., layout.bias[0].dynamic] -= both[..., 0]
    both[0] /= regression.nominal_scale[:, None]
    return replace(state, bias=both[0, :, 0], weights=both[..., 1:] * regression.rms)


def informative_priors(
    calibration: Calibration,
    regression: Regression,
    state: State,
    model: Model,
    options: FitOptions,
    usual_ageing: float = 1.0,
) -> Iterator[InformativePrior]:
    """
    Yield priors from a calibration for several amounts of ageing, the widest last. A fit compares
    these priors by their log evidence plus the log density of the ageing, a half-Student density
    of scale `usual_ageing` [m/s^2]. A calibration without covariance raises FitError.
    """
    if calibration.posterior is None:
        raise FitError(
            'the prior has no covariance: use a calibration that was fitted to bags; an imported '
            'calibration cannot be a prior'
        )
    # Pairs to try: `ageing`, the sd of the changes of bias [g] and scale factor (0: the sds that
    # the user states); `share`, uncorrelated variance added to each parameter / its variance.
    tried = [(0.0, share) for share in (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)]
    # The fit begins with the last, widest prior: in a first fit with a narrow prior, the
    # estimated noise would absorb changes of the unit.
    if options.ageing_bias or options.ageing_scale:
        tried.append(tried[-1])
    else:
        # The sds of bias [g] and relative scale are equal, as data sheets state similar numbers
        # for both, and few rests do not separate them.
        # An ageing above three times the largest error of |f| is not tried: one attitude does not
        # show the bias of a level axis, and a tilt of 10 mrad with errors of the biases of 10 mg
        # has the drift of a change of the bias by 0.6 ug/K if the scale changes by 60 ppm/K.
        largest = 3.0 * float(np.abs(regression.norm_errors(state)).max()) / options.gravity
        steps = [step for step in (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3) if step <= largest]
        steps = steps or [1e-5]
        tried += [(ageing, 0.0) for ageing in steps]
        # These priors are for a unit in which not only bias and scale have changed, but also the
        # effects of temperature. A `share` of 1, 1e3 or 1e6 multiplies the prior sd of each
        # parameter by up to 1.4, 30 or 1000, because an effect may be a thousand times its prior
        # sd. `_root` limits the added sd to the size of the effect: with a larger sd, effects at
        # temperatures without rests would be unknown.
        fewer = steps[1 - len(steps) % 2 :: 2]  # with the largest step, but every other one
        tried += [(ageing, share) for share in (1.0, 1e3, 1e6) for ageing in fewer]
    K, places = constants_of(calibration).scale, parameter_layout(calibration)
    layout = regression.layout(regression.windows.parts)
    kinds = regression.forces.kinds if regression.forces else ()
    used = range(len(calibration.response))
    to_file = file_jacobian(regression, layout, state, model, used, kinds)
    mean, sizes = as_vector(state, layout)[: layout.n_unit], _sizes(calibration)
    for ageing, share in tried:
        covariance = calibration.posterior.covariance()
        bias_sd = ageing * options.gravity or options.ageing_bias
        scale_sd = ageing or options.ageing_scale
        for axis in range(3):
            blocks = (places.bias[axis], bias_sd * K[axis]), (places.scale[axis], scale_sd)
            for block, sd in blocks:
                levels = [block.static, block.dynamic]
                covariance[np.ix_(levels, levels)] += sd * sd
        density = float(log_student(np.array(ageing * options.gravity / usual_ageing)))
        # The effects of temperature rarely change: log evidence must justify a change.
        density -= CLEAR_GAIN * (share >= 1.0)
        root = _root(covariance, share, sizes, to_file)
        yield InformativePrior(mean, root, density, is_changed=share > 1.0)


def _sizes(calibration: Calibration) -> Floats:
    """Return the RMS over the axes of each coefficient and weight; 0 for other parameters."""
    values, layout = parameters_of(calibration), parameter_layout(calibration)
    result = np.zeros_like(values)
    for blocks in (layout.bias, layout.scale):
        rms = np.sqrt(np.mean([values[block.rows] ** 2 for block in blocks], axis=0))
        for block in blocks:
            result[block.rows] = rms
            result[[block.static, block.dynamic]] = 0.0
    return result


def _root(covariance: Floats, share: float, sizes: Floats, to_file: Floats) -> Floats:
    """
    Return the upper triangular root of the inverse covariance of the unit's unknowns.

    `covariance`: covariance of the file's parameters; ``min(share * v, max(v, size^2))`` is added
    to each variance v; `sizes`: sizes of the parameters; `to_file`: derivatives w.r.t. unknowns
    """
    diagonal = np.diag(covariance)
    floor = np.where(diagonal > 0.0, diagonal, np.min(diagonal[diagonal > 0.0], initial=1.0))
    sd = np.sqrt(floor)
    # A relative jitter of 1e-6 keeps the covariance, stored in single precision, positive
    # definite. QR of the whitened derivatives, without the product of the normal equations, loses
    # no precision for strongly correlated parameters.
    added = np.minimum(share, np.maximum((sizes / sd) ** 2, 1.0))
    widened = covariance / np.outer(sd, sd) + np.diag(1e-6 + added)
    scaled = to_file / sd[:, None]
    whitened = solve_triangular(np.linalg.cholesky(widened), scaled, lower=True)
    root: Floats = np.asarray(np.linalg.qr(whitened, mode='r'))
    return root * np.sign(np.diag(root))[:, None]
