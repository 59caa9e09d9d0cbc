# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the initial state and the prior of the regression, with or without a prior calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import FitError
from ..typing import Bools, Floats
from ..unit.calibration import Calibration
from . import rests
from .coverage import distinct_directions, norm_columns
from .data_checks import POSITIONS_FOR_MISALIGNMENT, POSITIONS_NEEDED
from .hyperparameters import Candidates
from .initial_triad import (
    ConstantCalibration,
    constant_calibration,
    position_means,
    white_noise_of,
    within_positions,
)
from .left_out import is_better
from .nonlinear import starting_sd, with_terms
from .options import FitOptions
from .priors import informative_priors, offset_sd_of, with_calibration
from .reduction import ReducedBag
from .regression import Regression
from .selection import LARGE_OFFSETS, Fit, Selected, better_start, fit_all, select
from .unknowns import BIAS_SD, SCALE_SD, InformativePrior, Prior, State, misalignment_scale
from .windows import CURVE, PART, SET, ThermalWindows

#: Largest prior sd of the slope over temperature of the bias [m/s^2 per K] (500 ug/K) and of the
#: relative scale factor [1/K] (200 ppm/K): the limits in data sheets of consumer MEMS triads.
STEEPEST = np.array([5e-3, 2e-4])


@dataclass(frozen=True)
class Problem:
    """
    The input of a fit besides the windows.

    start: initial bias, scale and misalignment, without effects of temperature
    up: attitudes of the positions, upward unit vectors, shape (n_positions, 3)
    is_by_settled: whether the model selection refuses to increase `left_out.settled_error`
    has_pieces: whether long rests are cut into positions of about an hour (`refit_checks`)
    """

    bags: Sequence[ReducedBag]
    options: FitOptions
    start: ConstantCalibration
    up: Floats
    progress: Callable[[float], None]
    is_by_settled: bool = False
    has_pieces: bool = False

    @cached_property
    def n_directions(self) -> int:
        """Number of different attitudes."""
        return len(distinct_directions(self.up))


def regress(windows: ThermalWindows, problem: Problem) -> Fit:
    """
    Fit the windows, with or without a prior calibration.

    If no prior is given and the temperature changes more between positions than within them, two
    fits are made: to the means of the positions, and to all windows. The fit to all windows is
    returned if its error on left-out data is smaller.
    """
    if problem.options.prior is not None:
        return _regress(windows, problem)
    if problem.options.model != 'golovach':
        data, is_steady = windows.data, rests.is_steady(windows)
        is_settled = is_steady & rests.is_without_drift(data, problem.start.scale)
        is_settled &= rests.is_bench(windows, problem.up)
        windows = replace(windows, data=rests.constant_in(data, is_steady, is_settled))
    if problem.has_pieces or not rests.is_constant(windows, windows.data.position):
        return _regress(windows, problem)
    # In a soak the effect of an unknown lag is about as large as the effect of the remaining
    # temperature drift, so only differences of |f| between positions determine the curve.
    everywhere = np.ones(windows.data.n_positions, dtype=bool)
    at_rest = replace(windows, data=rests.constant_in(windows.data, everywhere, everywhere))
    # Each regression reports progress from 0.7 to 0.95: map it to half of this range.
    first = replace(problem, progress=lambda part: problem.progress(0.35 + 0.5 * part))
    second = replace(problem, progress=lambda part: problem.progress(0.475 + 0.5 * part))
    of_means, fit = _regress(at_rest, first, is_at_rest=True), _regress(windows, second)
    if not is_better(of_means.selected.score, fit.selected.score):
        return of_means
    trials = of_means.selected.trials
    has_curve = any(trial.is_chosen and CURVE in trial.groups for trial in trials)
    if has_curve and rests.only_warms_up(windows):
        return fit._replace(of_means=of_means.posterior.state)
    return fit


def _regress(windows: ThermalWindows, problem: Problem, *, is_at_rest: bool = False) -> Fit:
    """Fit the windows; `is_at_rest`: whether the columns are set constant in each position."""
    data, options, start = windows.data, problem.options, problem.start
    earlier, n_directions = options.prior, problem.n_directions
    # If a prior calibration is given, the drifts in one heated attitude separate bias and scale.
    is_bench = earlier is None and rests.is_bench(windows, problem.up)
    has_poses = n_directions < POSITIONS_NEEDED and rests.is_constant(windows, data.position)
    if (has_poses or n_directions == 1) and earlier is None and data.forces is None:
        data = replace(data, pose=rests.poses_of(windows, problem.up))
    if options.model == 'golovach' or is_bench or n_directions == 1 or data.n_poses:
        # Omit support tilts, as a tilt is not separable from a drift of the unit in one attitude,
        # nor from a change of the attitude in a pose. In Golovach's model tilts would absorb the
        # errors of the static and the dynamic set.
        data = replace(data, tilt=data.tilt[:, :0])
    settled = data.settled if problem.is_by_settled else None
    data = replace(data, has_prior=earlier is not None, settled=settled)
    regression = Regression(data, options.gravity, start.scale)
    state = initial_state(regression, start, problem.up)
    prior = _initial_prior(windows, problem)
    if n_directions >= POSITIONS_NEEDED and not data.has_turn_ons:
        # The misalignment would absorb turn-on offsets, which are no unknowns of this regression.
        prior = _with_faces(prior, problem.up)
    steepness = _steepness(windows, problem, is_at_rest=is_at_rest)
    candidates = _candidates(windows, problem, steepness, is_bench=is_bench)
    if earlier is not None:
        state = with_terms(with_calibration(earlier, regression, state), earlier)
        prior, others = _updating_priors(earlier, windows, options, regression, state, prior)
        fixed = replace(candidates, fixed=np.ones_like(candidates.fixed))
        return Fit(windows, regression, fit_all(regression, state, prior, fixed, others))
    if options.model == 'golovach':
        prior = replace(prior, column_sd=candidates.typical)
        return Fit(windows, regression, fit_all(regression, state, prior, candidates))
    is_few = n_directions < POSITIONS_NEEDED
    narrow = _narrowed(prior, regression, state) if is_few else prior
    without_slow = replace(candidates, typical=candidates.typical * ~_is_slow(windows))
    selected = _selected(
        *(regression, state, narrow, without_slow),
        lambda part: problem.progress(0.7 + 0.25 * part),
    )
    chosen = selected.posterior
    full_prior = replace(chosen.prior, bias_sd=prior.bias_sd, scale_sd=prior.scale_sd)
    selected = replace(selected, posterior=replace(chosen, prior=full_prior))
    # In the covariance, the prior sd of the scale factor's slope is not halved as in `_steepest`.
    limits = STEEPEST, _steepest(n_directions)
    full, used = (_typical_slopes(steepness, limit, options.gravity) for limit in limits)
    claimed = candidates.typical * (full / used)[:, np.newaxis]
    return Fit(windows, regression, selected, claimed)


def _selected(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    progress: Callable[[float], None],
) -> Selected:
    """
    Select the model. After a reduction of the prior sd of the misalignment by `_with_faces`, a
    second model is selected with the full sd, and `better_start` chooses one of the two models.
    """
    selected = select(regression, state, prior, candidates, progress)
    if not prior.unseen_misalignment_sd:
        return selected
    full = replace(prior, misalignment_sd=prior.unseen_misalignment_sd, unseen_misalignment_sd=0.0)
    return better_start([selected, select(regression, state, full, candidates, progress)])


def _updating_priors(
    earlier: Calibration,
    windows: ThermalWindows,
    options: FitOptions,
    regression: Regression,
    state: State,
    prior: Prior,
) -> tuple[Prior, list[InformativePrior]]:
    """
    Return `prior` plus an informative prior that allows for the largest ageing since the
    calibration `earlier`, and a list of informative priors for smaller ageing.
    """
    data, noise = regression.windows, _noise_in_1_hz(windows, regression.nominal_scale)
    *others, widest = informative_priors(
        earlier, regression, state, windows.model, options, LARGE_OFFSETS * _mounting_scale(noise)
    )
    # A fit of few windows may have no residual: assume at least half the noise of `earlier`.
    window_s = windows.typical_count * earlier.unit.cycle_time_s
    least_sigma = 0.5 * float(np.min(earlier.noise_density_m_s2_sqrt_hz)) / window_s**0.5
    prior = replace(
        prior,
        column_sd=data.parts.astype(np.float64),
        informative=widest,
        least_sigma=max(least_sigma, prior.least_sigma),
    )
    if prior.offset_scale and (repeated_sd := offset_sd_of(earlier)):
        # The prior scale of the offset sd is at most twice the offset sd of `earlier`, so that the
        # fit explains larger changes of |f| by ageing of the unit.
        scale = min(prior.offset_scale, 2.0 * repeated_sd)
        offset_sd = prior.offset_sd if data.has_turn_ons else repeated_sd
        prior = replace(prior, offset_sd=offset_sd, turn_on_sd=repeated_sd, offset_scale=scale)
    return prior, others


def initial_state(regression: Regression, start: ConstantCalibration, up: Floats) -> State:
    """Return the state of a calibration without effects of temperature."""
    inverse = np.asarray(np.linalg.inv(start.misalignment), dtype=np.float64)
    misalignment = inverse[[1, 2, 2], [0, 0, 1]]
    return regression.initial_state(start.bias / start.scale, misalignment, up)


def _initial_prior(windows: ThermalWindows, problem: Problem) -> Prior:
    """Return the prior of constants, noise and offsets; the prior sd of each column is 0."""
    data, start, options = windows.data, problem.start, problem.options
    drift = within_positions(data.mean / start.scale, data.position)
    # Smallest initial sd of mounting offsets and of white noise [m/s^2] (1 ug).
    small_sd = 1e-5
    sigma = max(float(np.sqrt(np.mean(drift**2))), small_sd)
    noise = _noise_in_1_hz(windows, start.scale)
    # Rounding of samples without noise shifts the mean of a position as a mounting offset does.
    roundings = [interval.rounding_sd / start.scale for _, interval in windows.rests]
    rounding_sd = float(np.sqrt(np.mean(np.square(roundings))))
    misalignment_sd = misalignment_scale(noise)
    prior = Prior(
        misalignment_sd=misalignment_sd,
        column_sd=np.zeros((2, len(data.groups))),
        offset_sd=max(small_sd, rounding_sd),
        sigma=np.full(3, sigma),
        # The axes of a sensor have similar scale factors: the prior mean is their geometric mean.
        scale_mean=np.exp(np.mean(np.log(start.scale))) / start.scale,
        offset_scale=max(_mounting_scale(noise), 3.0 * rounding_sd),
        misalignment_scale=misalignment_sd,
    )
    if data.forces is not None:
        prior = replace(prior, nonlinear_sd=starting_sd(data.forces, options))
    if options.mounting_sd is not None:
        sd = float(np.hypot(options.mounting_sd, rounding_sd))
        prior = replace(prior, offset_sd=sd, turn_on_sd=sd, offset_scale=0.0)
    return prior


def _with_faces(prior: Prior, up: Floats) -> Prior:
    """
    Return `prior` with a smaller sd of the misalignment for a noisy sensor that rests only on its
    faces: there misalignments of some degrees, to second order, would explain any errors of |f|.
    The published covariance keeps the sd of `prior`.
    """
    by_element = up[:, [1, 2, 2]] * up[:, [0, 0, 1]]
    # Reduced sd of a misalignment [rad]: the cross-axis sensitivity of good consumer MEMS.
    reduced_sd, sd = 2.5e-3, prior.misalignment_scale
    # The RMS product of two components of `up` is below 0.1 if one axis is near the vertical in
    # each position, and 0.3 if each vertical is in the middle between two axes.
    if float(np.sqrt(np.mean(by_element**2))) >= 0.1 or sd <= reduced_sd:
        return prior
    return replace(prior, misalignment_sd=reduced_sd, unseen_misalignment_sd=sd)


def _narrowed(prior: Prior, regression: Regression, state: State) -> Prior:
    """
    Return `prior` with smaller sds of bias and scale, for the selection of columns: five times the
    largest error of |f|, within 5 to 100 % of the sds of `prior`. Few attitudes do not separate
    bias and scale, which would be large, with larger sds, in a model that lacks columns.
    """
    norms = np.linalg.norm(position_means(regression.windows) / regression.nominal_scale, axis=1)
    limit = 5.0 * float(np.abs(norms - regression.norms(state)).max())
    ratios = limit / BIAS_SD, limit / regression.gravity / SCALE_SD
    by_bias, by_scale = np.clip(ratios, 0.05, 1.0).tolist()
    return replace(prior, bias_sd=by_bias * prior.bias_sd, scale_sd=by_scale * prior.scale_sd)


def _is_slow(windows: ThermalWindows) -> Bools:
    """
    Return whether the lag of each column settles by less than 90 % in the longest bag, (m,). Slow
    columns are nearly collinear with the curve: `select` does not use them, but `claim` does.
    """
    model, longest_s = windows.model, float(windows.data.age.max())
    taus = np.array([0.0] * len(model.sets.groups) + [column.tau_s for column in model.columns])
    of_part = ((model.part_sums != 0.0) * taus).max(axis=1, initial=0.0)
    return np.asarray(np.append(taus, of_part) > longest_s / np.log(10.0))


def _noise_in_1_hz(windows: ThermalWindows, scale: Floats) -> float:
    """Return the sd of the noise in a 1 Hz bandwidth [m/s^2], median of axes; 0 if unknown."""
    data = windows.data
    inner = np.flatnonzero(data.position[2:] == data.position[:-2])
    if not len(inner):
        return 0.0
    step_s = np.median(np.diff(data.time)[inner])
    return float(np.median(white_noise_of(data, scale)) * np.sqrt(step_s))


def _mounting_scale(noise: float) -> float:
    """Return the prior scale of mounting offsets [m/s^2], from the noise in a 1 Hz bandwidth."""
    # The prior scale of offsets is at least 30 ug, typical of navigation grade, and at most 0.5
    # mg, typical of consumer MEMS; the tail of the Student prior allows for larger offsets. For
    # noise below 0.3 ug the smallest prior scale is 100 times the noise: double precision does not
    # suffice to estimate an offset 1e6 times as large as the noise.
    least, most = max(min(3e-4, 100.0 * noise), 1e-7), 5e-3
    return float(np.clip(3.0 * noise, least, most))


def _candidates(
    windows: ThermalWindows, problem: Problem, steepness: float, *, is_bench: bool
) -> Candidates:
    """Return typical and largest prior sds of the columns' weights; 0 for excluded columns."""
    data, options = windows.data, problem.options
    groups = np.array(data.groups)
    allowed = {*data.groups} if options.groups is None else {*options.groups, *options.forced}
    is_candidate = np.isin(groups, list(allowed)) & (data.kelvins > 0.0)
    is_candidate &= windows.has_temperature
    # Bags without soaks at several temperatures do not determine the static set: the difference of
    # the sets would describe any effect in the dynamic windows, and be wrong in a soak.
    is_forced = SET in options.forced or options.model == 'golovach'
    is_candidate &= (groups != SET) | windows.has_soaks | is_forced
    parts = np.stack((is_candidate, is_candidate & data.in_scale))
    steepest = _steepest(problem.n_directions)
    slopes = _typical_slopes(steepness, steepest, options.gravity)
    fixed = np.zeros(parts.shape, dtype=bool)
    if is_bench:
        # One attitude cannot separate scale and bias: fix the prior sd of the scale's curve.
        fixed[1] = parts[1] & np.isin(groups, (CURVE, PART))
    forced = np.isin(groups, options.forced)
    if options.model == 'golovach':
        # Keep all columns of Golovach's model, with a nearly flat prior: 10 times the largest sd.
        slopes, forced, fixed = 10.0 * STEEPEST, np.ones_like(forced), np.ones_like(fixed)
    typical, largest = (np.outer(sd, data.kelvins) * parts for sd in (slopes, steepest))
    if not windows.was_measured:
        # Without a thermometer the slopes over temperature keep their largest prior sd.
        typical[:, 0] = largest[:, 0] = STEEPEST
        forced[0] = fixed[:, 0] = True
    return Candidates(typical, largest, forced, fixed)


def _steepest(n_directions: int) -> Floats:
    """Return largest prior sds of the slopes of bias and scale for a number of attitudes, (2,)."""
    # For two to eight attitudes the prior sd of the scale factor's slope is halved. The drift of a
    # nearly level axis is more often a tilt of the support than a slope of several hundred ppm/K.
    is_few = 1 < n_directions < POSITIONS_FOR_MISALIGNMENT
    return STEEPEST * (1.0, 0.5 if is_few else 1.0)


def _typical_slopes(steepness: float, steepest: Floats, gravity: float) -> Floats:
    """Return the typical prior sd of a slope of bias and scale, shape (2,)."""
    # The smallest typical slope of the bias is 0.1 ug/K, better than navigation grade.
    slope = float(np.clip(steepness, 1e-6, steepest[0] / 3.0))
    return np.array([slope, min(slope / gravity, steepest[1] / 3.0)])


def _steepness(windows: ThermalWindows, problem: Problem, *, is_at_rest: bool) -> float:
    """Return the RMS change of a sample per kelvin, taken as a change of the bias [m/s^2 / K]."""
    data, start = windows.data, problem.start
    within = within_positions(data.mean / start.scale, data.position)
    drift = float(np.sqrt(np.mean(within**2, axis=0)).max())
    if data.n_positions < POSITIONS_NEEDED:
        change = within_positions(windows.temperature[:, None], data.position)
        return drift / (float(np.sqrt(np.mean(change**2))) or 1.0)
    kelvins = float(np.std(windows.temperature)) or 1.0
    # If the temperature differs only between rests, the drift appears in differences of |f|.
    force = (position_means(data) - start.bias) / start.scale
    sizes, norms = sizes_of(windows, problem.options), np.linalg.norm(force, axis=1)
    errors = norms - sizes
    if np.ptp(sizes) > 0.0:
        # A cubic of |f| describes errors due to nonlinearity, which are no thermal drift.
        powers = np.vander(sizes / sizes.max(), 4)
        errors -= powers @ np.linalg.lstsq(powers, errors, rcond=None)[0]
    if is_at_rest:
        # Divide the sd of the errors of |f| by the RMS effect on |f| of unit slopes of bias and
        # scale, less the part of this effect that a constant bias and scale explain.
        constants = norm_columns(force / norms[:, None])[:, :6]
        celsius = windows.temperature[data.edges[:-1]]
        of_slopes = (celsius - celsius.mean())[:, None] * constants
        of_slopes -= constants @ np.linalg.lstsq(constants, of_slopes, rcond=None)[0]
        kelvins = float(np.sqrt(np.mean(np.sum(of_slopes**2, axis=1))))
        return float(np.std(errors)) / max(kelvins, 1e-9)
    return max(drift, float(np.std(errors))) / kelvins


def sizes_of(windows: ThermalWindows, options: FitOptions) -> Floats:
    """Return the known |f| of each position, shape (n_positions,) [m/s^2]."""
    data = windows.data
    return data.forces.sizes if data.forces else np.full(data.n_positions, options.gravity)


def initial_triad(windows: ThermalWindows, options: FitOptions) -> ConstantCalibration:
    """Fit constant bias, scale, misalignment; with few attitudes one scale only (1 for m/s^2)."""
    means, gravity = position_means(windows.data), sizes_of(windows, options)
    norms = np.linalg.norm(means, axis=1)
    if not norms.all() or (len(means) > 1 and not means.any(axis=0).all()):
        axes = ', '.join('xyz'[k] for k in np.flatnonzero(~np.any(means, axis=0)))
        raise FitError(
            f'an axis is exactly zero at rest ({axes or "all axes in a position"}): is the axis '
            'dead, or the topic wrong?'
        )
    scale = float(np.median(norms / gravity))
    if len(distinct_directions(means / norms[:, None])) >= POSITIONS_NEEDED:
        sizes = options.gravity if windows.data.forces is None else gravity
        noise = _noise_in_1_hz(windows, np.full(3, scale))
        return constant_calibration(means, sizes, misalignment_scale(noise))
    if options.input == 'm/s^2':
        if abs(scale - 1.0) > 0.2:
            raise FitError(
                f'the samples at rest have norm {scale * options.gravity:.3g}, expected '
                f'{options.gravity:.3g}: are the samples in m/s^2?'
            )
        scale = 1.0
    return ConstantCalibration(np.zeros(3), np.full(3, scale), np.eye(3))
