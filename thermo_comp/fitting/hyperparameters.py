# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the estimation of prior sds and noises, and the removal of columns of small log Bayes factor.

Each column has one prior standard deviation of its weights in the bias of all axes and one in the
scale. All bends (changes of slope at knees) share one prior sd of the change of slope of the bias,
and one for the scale; these sds set the smoothness of the curves. Newton's steps move each sd that
is not fixed to the mode of the log evidence [1]_ plus the log density of a hyperprior. The
hyperprior is log-normal with centre sd0 and variance tau^2 of log sd. At the mode of a prior sd
``effective parameters + log(sd / sd0) / tau^2 = sum w^2 / sd^2``, w being the weights of the
column on the three axes. The prior sd of a column without information stays at sd0.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992), eqs 4.8 to 4.10.
.. [2] A. Gelman, Prior distributions for variance parameters in hierarchical models, Bayesian
   Analysis 1 (2006): half-t priors for standard deviations.
.. [3] J. A. Nelder, A reformulation of linear models, Journal of the Royal Statistical Society A
   140 (1977): a model with a product also has the factors of the product.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from ..typing import Bools, Floats, Ints
from .equations import as_vector
from .gains import log_bayes_factors
from .initial_triad import white_noise_of
from .regression import PosteriorMode, Regression
from .unknowns import POSE_SD, Noise, Prior, State
from .windows import BEND, LAGS, PRODUCTS

#: Degrees of freedom of the half-Student prior of the sd of mounting offsets, as in [2]_.
STUDENT_NU = 4.0
#: Smallest log Bayes factor of a column that is kept: a log Bayes factor below 1 is "not worth
#: more than a bare mention" (Kass and Raftery, Bayes factors, JASA 90 (1995), section 3.2).
LEAST_GAIN = 1.0
#: Gain in log evidence that makes a model clearly more likely than another: odds of 55 : 1.
CLEAR_GAIN = 4.0
#: Variance of the natural log of a prior sd in its hyperprior: one sd is a factor of ten.
LOG_VARIANCE = float(np.log(10.0)) ** 2
_Value = Floats | float


@dataclass(frozen=True)
class Candidates:
    """
    The columns that a model may have.

    typical, largest: centre of the hyperprior and upper bound of `Prior.column_sd`, in the bias
        [m/s^2] and in the scale (relative), (2, m); 0 for a column that the model may not have
    forced: columns that are always kept, shape (m,)
    fixed: columns that are always kept, with a constant prior sd, shape (2, m)
    """

    typical: Floats
    largest: Floats
    forced: Bools
    fixed: Bools


def settle(
    regression: Regression, state: State, prior: Prior, candidates: Candidates, rounds: int = 25
) -> PosteriorMode:
    """Update prior sds and noises, at most `rounds` times, until changes are below about 5 %."""
    posterior = regression.solve(state, prior, n_steps=3)
    for _ in range(rounds):
        prior, change = _updated(regression, posterior, candidates)
        if change < 0.05:
            break
        posterior = regression.step(posterior.state, prior)
    return regression.solve(posterior.state, prior, n_steps=1)


def _updated(
    regression: Regression, posterior: PosteriorMode, candidates: Candidates
) -> tuple[Prior, float]:
    """Move prior sds and noises towards their modes; also return the largest |log(new / old)|."""
    prior, layout, determined = posterior.prior, posterior.layout, posterior.determined
    sd, power = prior.column_sd, np.sum(posterior.state.weights**2, axis=1)
    moves = (sd > 0.0) & ~candidates.fixed
    centre = np.where(moves, candidates.typical, 1.0)
    # Sds and weights relative to the typical sd of each column.
    relative, power = np.where(moves, sd, 1.0) / centre, power / centre**2
    effective = posterior.effective_parameters.copy()
    for part, of_part in enumerate(moves & (np.array(regression.windows.groups) == BEND)):
        bends = np.flatnonzero(of_part)
        if bends.size:
            relative[part, bends] = np.exp(np.mean(np.log(relative[part, bends])))
            effective[part, bends] = effective[part, bends].sum()
            power[part, bends] = power[part, bends].sum()
    step = _toward(effective, power, relative, np.log(relative) / LOG_VARIANCE, 1.0 / LOG_VARIANCE)
    new_sd = np.minimum(centre * relative * np.exp(step), candidates.largest)
    column_sd = np.where(moves, new_sd, sd)
    turn_on_sd = prior.turn_on_sd
    if prior.informative is None:
        # With a prior calibration the sd of turn-on offsets keeps its value, because the few
        # turn-ons of an update do not separate turn-on offsets from the ageing of the bias.
        turn_on_sd = _offset_sd(posterior, turn_on_sd, layout.turn_on)
    moved = replace(
        prior,
        column_sd=column_sd,
        offset_sd=_offset_sd(posterior, prior.offset_sd, layout.offset),
        turn_on_sd=turn_on_sd,
        tilt_sd=_tilt_sd(posterior, float(regression.windows.kelvins[0])),
        pose_sd=_pose_sd(posterior),
        misalignment_sd=_misalignment_sd(posterior),
        start_variance_ratio=_start_variance_ratio(posterior),
        sigma=white_noise(regression, posterior),
    )

    def change(name: str, at: Bools | tuple[()] = ()) -> float:
        new, old = (np.asarray(getattr(each, name))[at] for each in (moved, prior))
        return float(np.max(np.abs(np.log(new / old)), initial=0.0))

    return moved, max(
        change('column_sd', moves & (effective > 0.3)),
        # The sd of offsets counts for convergence if the data determine more than one offset.
        change('offset_sd') * bool(determined[layout.offset].sum() > 1.0),
        change('turn_on_sd') * bool(determined[layout.turn_on].sum() > 1.0),
        # A change of the sd of the supports' tilts by 15 % hardly changes the fit.
        change('tilt_sd') / 3.0,
        change('pose_sd'),
        change('start_variance_ratio') / 4.0,
        change('sigma'),
    )


def _misalignment_sd(posterior: PosteriorMode) -> float:
    """Move the prior sd of M to its mode if the data determine more than one element of M."""
    prior, misalignment = posterior.prior, posterior.state.misalignment
    if prior.informative is not None or prior.unseen_misalignment_sd:
        return prior.misalignment_sd
    # Three elements of M determine their sd poorly: the built-in sd counts as a fourth element.
    gamma = float(posterior.determined[posterior.layout.misalignment].sum())
    share = 1.5 * max(1.0 - 1.0 / max(gamma, 1.0), 0.0)
    square = share * np.sum(misalignment**2) + prior.misalignment_scale**2
    # Upper bound of the sd of M: 0.03 rad, for separate sensors on a printed bracket. A larger M
    # would, by its second-order effect, explain any error of |f| on six faces.
    return min(float(np.sqrt(square / (share * gamma + 1.0))), 0.03)


def _start_variance_ratio(posterior: PosteriorMode) -> float:
    """Return the mode of the variance of the initial lag states / variance in the node's prior."""
    start, places = posterior.state.start, posterior.layout.start
    if not places.size:
        return posterior.prior.start_variance_ratio
    # The node's prior (a variance ratio of 1) counts as one more lag state, so that the lag states
    # of a single bag cannot make the ratio very small.
    gamma = float(posterior.determined[places].sum())
    if gamma <= -1.0:
        raise np.linalg.LinAlgError('rounding errors exceed the information about lag states')
    return float(min((np.sum(start**2) + 1.0) / (gamma + 1.0), 1.0))


def _tilt_sd(posterior: PosteriorMode, kelvins: float) -> float:
    """Move the sd of supports' tilts to its mode; `kelvins`: RMS of T_board - T_reference [K]."""
    sd, tilt = posterior.prior.tilt_sd, posterior.state.tilt
    if not tilt.size:
        return sd
    # The scale of the half-normal prior of the tilts' sd is 15 urad/K, for unevenly heated
    # aluminium of 23 ppm/K, times the larger of `kelvins` and 1 K.
    square = (sd / (1.5e-5 * max(kelvins, 1.0))) ** 2
    effective = posterior.determined[posterior.layout.tilt].sum()
    step = _toward(effective, np.sum(tilt**2), sd, square - 1.0, 2.0 * square)
    return float(sd * np.exp(step))


def _pose_sd(posterior: PosteriorMode) -> float:
    """Move the prior sd of attitudes about their poses towards its mode."""
    sd, layout = posterior.prior.pose_sd, posterior.layout
    if not layout.pose.size:
        return sd
    effective = posterior.determined[layout.posed].sum()
    power = np.sum(posterior.state.from_pose**2)
    slope = np.log(sd / POSE_SD) / LOG_VARIANCE
    return float(sd * np.exp(_toward(effective, power, sd, slope, 1.0 / LOG_VARIANCE)))


def _toward(effective: _Value, power: _Value, sd: _Value, slope: _Value, rise: _Value) -> Floats:
    """
    Return Newton's step of log sd, within +-2, to solve ``power / sd^2 = effective + slope``.

    `slope`, `rise`: minus the first and second derivative of the log hyperprior w.r.t. log sd
    """
    ratio = power / (sd * sd)
    gradient = ratio - effective - slope
    curvature = 2.0 * np.minimum(ratio, 2.0 * effective + 1.0) + 0.5 * effective + rise
    return np.asarray(np.clip(gradient / curvature, -2.0, 2.0))


def _offset_sd(posterior: PosteriorMode, sd: float, places: Ints) -> float:
    """Move the sd of offsets (unknowns `places`) towards the mode under a half-Student prior."""
    scale = posterior.prior.offset_scale
    if scale <= 0.0 or not places.size:
        return sd
    effective = float(posterior.determined[places].sum())
    power = float(np.sum(as_vector(posterior.state, posterior.layout)[places] ** 2))
    square = (sd / scale) ** 2
    slope = (STUDENT_NU + 1.0) * square / (STUDENT_NU + square)
    rise = 2.0 * (STUDENT_NU + 1.0) * STUDENT_NU * square / (STUDENT_NU + square) ** 2
    step = _toward(effective, power, sd, slope, rise + 0.1)
    # Bounds of the offset sd: 1e-4 times the prior's scale; 5 mg (0.05 m/s^2), as in cheap MEMS.
    return float(np.clip(sd * np.exp(step), 1e-4 * scale, 0.05))


def log_density(posterior: PosteriorMode) -> float:
    """Return the log evidence plus the log prior densities of offset sds, pose sd and ageing."""
    prior, result = posterior.prior, posterior.log_evidence
    if prior.offset_scale:
        sd = [prior.offset_sd, *[prior.turn_on_sd] * bool(posterior.layout.turn_on.size)]
        result += float(log_student(np.array(sd) / prior.offset_scale).sum())
    if posterior.layout.pose.size:
        result -= 0.5 * float(np.log(prior.pose_sd / POSE_SD)) ** 2 / LOG_VARIANCE
    if prior.informative is not None:
        result += prior.informative.log_density
    return result


def log_student(x: Floats) -> Floats:
    """Return the log density of Student's distribution at x, without its constant."""
    return np.asarray(-0.5 * (STUDENT_NU + 1.0) * np.log1p(x**2 / STUDENT_NU))


def white_noise(regression: Regression, posterior: PosteriorMode) -> Floats:
    """Return the sd of white noise of each axis from residuals and effective parameters, (3,)."""
    n = len(regression.weight)
    determined, layout = posterior.determined, posterior.layout
    of_axis = determined[layout.axis].sum(axis=1) + determined[layout.offset].sum(axis=0)
    if layout.turn_on.size:
        of_axis += determined[layout.turn_on].sum(axis=0)
    # Effective parameters of unknowns that all axes share are divided equally among the axes.
    common = (layout.shared, layout.up, layout.stretch, layout.tilt, layout.start)
    spent = of_axis + sum(determined[places].sum() for places in common) / 3.0
    sigma = np.sqrt(posterior.square / np.maximum(n - spent, 0.05 * n))
    # The samples of an axis may be constant: its noise is at least 1 % of the noisiest axis' sd.
    least_sigma = np.full(3, max(posterior.prior.least_sigma, 0.01 * float(sigma.max())))
    if not regression.windows.has_drifts:
        # If no column changes within a position, slow noise may absorb the whole residual. The
        # white noise is then at least the noise of differences of windows, because these
        # differences contain no drift.
        least_sigma = np.maximum(
            least_sigma, white_noise_of(regression.windows, regression.nominal_scale)
        )
    return np.asarray(np.maximum(sigma, least_sigma))


def with_slow_noise(
    regression: Regression, posterior: PosteriorMode, candidates: Candidates
) -> PosteriorMode:
    """Estimate slow noise from the residuals, then by log evidence; refit with the slow noise."""
    prior, whitener = posterior.prior, regression.whitener
    residual = regression.residual(posterior.state, posterior.layout) / prior.sigma
    estimated = whitener.estimate(residual, regression.weight)
    if estimated == prior.noise:
        return posterior

    def with_noise(noise: Noise) -> PosteriorMode:
        trial = replace(prior, noise=noise)
        for _ in range(2):
            fitted = regression.solve(posterior.state, trial, n_steps=1)
            trial = replace(trial, sigma=white_noise(regression, fitted))
        return replace(fitted, prior=trial)

    def likeliest(n_times: int) -> PosteriorMode:
        # Find the variance ratio and correlation time of largest log evidence, in steps by a
        # factor of 3, then of 3^(1/2) and 3^(1/4).
        best, step = with_noise(estimated._replace(n_times=n_times)), 3.0
        while step > 3.0**0.2:
            ratio, time_s, _ = best.prior.noise
            factors = (step, 1.0), (1.0 / step, 1.0), (1.0, step), (1.0, 1.0 / step)
            around = (
                with_noise(Noise(ratio * by_ratio, time_s * by_time, n_times))
                for by_ratio, by_time in factors
                if whitener.shows(time_s * by_time)
            )
            better = next((fit for fit in around if fit.log_evidence > best.log_evidence), None)
            step, best = (step**0.5, best) if better is None else (step, better)
        return best

    # Residuals lack the noise that the parameters absorb; the log evidence accounts for the
    # absorbed noise. All accelerometers have flicker noise, so a process with one correlation time
    # is chosen only if it has more log evidence than flicker noise, by `CLEAR_GAIN`.
    single, best = likeliest(1), likeliest(whitener.n_flicker)
    if single.log_evidence > best.log_evidence + CLEAR_GAIN:
        best = single
    return settle(regression, best.state, best.prior, candidates)


def pruned_fit(
    regression: Regression, posterior: PosteriorMode, candidates: Candidates, rounds: int = 25
) -> PosteriorMode:
    """Drop columns in rounds while a round lowers the log evidence by less than `LEAST_GAIN`."""
    while True:
        prior = _pruned(regression, posterior, candidates)
        if np.array_equal(prior.column_sd, posterior.prior.column_sd):
            return posterior
        smaller = settle(regression, posterior.state, prior, candidates, rounds)
        if smaller.log_evidence < posterior.log_evidence - LEAST_GAIN:
            return posterior
        posterior = smaller


def _pruned(regression: Regression, posterior: PosteriorMode, candidates: Candidates) -> Prior:
    """Drop columns with a log Bayes factor below `LEAST_GAIN`, one by one, smallest first."""
    layout, prior, covariance = posterior.layout, posterior.prior, posterior.covariance.copy()
    mode = as_vector(posterior.state, layout)[: layout.n_unit]
    # A column's weight in the scale can explain drifts that its weight in the bias causes: keep a
    # column with a fixed sd in the scale also in the bias.
    is_kept = candidates.fixed | candidates.forced | candidates.fixed[1]
    droppable = np.argwhere((prior.column_sd > 0.0) & ~is_kept).tolist()
    column_sd, weight_sd = prior.column_sd.copy(), regression.weight_sd(prior)
    windows = regression.windows
    is_lag = np.isin(windows.groups, LAGS) & (windows.lag >= 0)
    is_product = np.isin(windows.groups, PRODUCTS)
    while droppable:
        part, column = np.array(droppable).T
        places = layout.weights[part, :, column]
        gains = log_bayes_factors(mode, covariance, places, weight_sd[part, :, column])
        # A product t m of temperature and lag can replace the lag m at the rates of one chamber
        # program, but not at other rates: a model with products keeps a lag (marginality, [3]_).
        used = column_sd > 0.0
        is_last = (used & is_product).any(axis=1) & ((used & is_lag).sum(axis=1) == 1)
        gains[(used & is_lag & is_last[:, np.newaxis])[part, column]] = np.inf
        weakest = int(np.argmin(gains))
        if gains[weakest] >= LEAST_GAIN:
            break
        column_sd[tuple(droppable.pop(weakest))] = 0.0
        at = places[weakest]
        gain = np.linalg.solve(covariance[np.ix_(at, at)], covariance[at])
        mode = mode - gain.T @ mode[at]
        covariance -= covariance[:, at] @ gain
    return replace(prior, column_sd=column_sd)


def downweigh(regression: Regression, posterior: PosteriorMode) -> None:
    """
    If the residual of a window differs by more than 3 sd from the median of 7 windows around it
    (from 0 in a position of up to 6 windows), reduce the window's weight so that the weighted
    difference is 3 sd. Keep all weights if `windows.undisturbed` is given.
    """
    windows = regression.windows
    if windows.undisturbed is None:
        size = regression.residual(posterior.state, posterior.layout) / posterior.prior.sigma
        regression.reweigh(windows.weight * undisturbed(size, windows.weight, windows.position))


def undisturbed(residual: Floats, weight: Floats, position: Ints) -> Floats:
    """Return factors <= 1 for the weights of windows, (n,), from their `residual`, (n, 3)."""
    size = residual * np.sqrt(weight)[:, None]
    for part in np.split(size, np.flatnonzero(np.diff(position)) + 1):
        if len(part) > 6:
            np.subtract(part, median_filter(part, (7, 1), mode='mirror'), out=part)
    size = np.abs(size)
    # The 80 % quantile of |x| is 1.2816 sd of a normal x. The median of |x| is not used: it can be
    # 0, because window means of a charge-balancing converter often have few distinct values.
    usual = np.quantile(size, 0.8, axis=0) / 1.2816
    size = np.minimum(size / np.maximum(usual, 1e-300), 1e3).max(axis=1)
    return np.asarray((3.0 / np.maximum(size, 3.0)) ** 2)
