# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the published uncertainty: the covariance of the fit, increased for columns that the data do
not determine, and for effects that the model lacks.

Unless the user states the sd of mounting and turn-on offsets, this sd is marginalised: a mixture
of fits, one for each sd of a grid, has the published covariance. The weight of a fit in the
mixture is its evidence, limited by the evidence of |f| in the positions, times the prior density
of the offset sd (half-Student [1]_ without a prior calibration). The covariance includes the error
of local gravity, which changes all scale factors by the same ratio.

If the model lacks an effect, the best weights of columns differ between sections of the chamber
program. A jackknife [2]_ estimates these differences: errors in another program are as large.

References
----------
.. [1] A. Gelman, Prior distributions for variance parameters in hierarchical models, Bayesian
   Analysis 1 (2006).
.. [2] B. Efron, The jackknife, the bootstrap and other resampling plans, SIAM (1982), chapter 3.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from ..typing import Floats, Ints
from .elimination import inverse_root
from .equations import as_vector
from .hyperparameters import CLEAR_GAIN, log_density, log_student
from .initial_triad import block_means, within_positions
from .layout import Layout
from .regression import PosteriorMode, Regression
from .selection import LARGE_OFFSETS, Fit
from .unknowns import Prior, State
from .windows import CURVE, LAGS, PART


@dataclass(frozen=True)
class Claim:
    """
    The published uncertainty of a unit.

    layout: row in `covariance` of each unknown of the fit, and of further weights of value 0
    covariance: covariance of the unknowns of the unit (not of positions), (n_unit, n_unit)
    offset_sd: sd of the bias offset of a new mounting or turn-on [m/s^2]
    """

    layout: Layout
    covariance: Floats
    offset_sd: float


def claim_of(fit: Fit, gravity_sd: float = 0.0, known_offset_sd: float = 0.0) -> Claim:
    """
    Return the published covariance of a fit.

    `gravity_sd`: sd of local gravity [m/s^2]; `known_offset_sd`: sd of mounting and turn-on
    offsets by a prior calibration, or 0 [m/s^2]
    """
    regression, chosen = fit.regression, fit.posterior
    # The rests of a mounting share an offset, but the regression has an offset for each rest. Give
    # each offset `n_rests` times the variance: the mean offset of a mounting keeps its variance.
    mounting = regression.windows.mounting
    n_rests = len(mounting) / (mounting[-1] + 1)
    prior = replace(chosen.prior, offset_sd=chosen.prior.offset_sd * n_rests**0.5)
    if prior.unseen_misalignment_sd:
        prior = replace(prior, misalignment_sd=prior.unseen_misalignment_sd)
    posterior = regression.solve(chosen.state, prior, n_steps=0)
    layout, offset_sd = posterior.layout, chosen.prior.offset_sd
    offsets = _over_offsets(regression, posterior, offset_sd, known_offset_sd)
    covariance, offset_sd, turn_on_variance = offsets
    if informative := fit.selected.informative:
        # Few rests do not show which constants have aged since the prior calibration: mix fits
        # that assume different amounts of ageing.
        priors = [replace(prior, informative=each) for each in informative]
        fits = [regression.solve(posterior.state, each, n_steps=3) for each in priors]
        log_weight = np.array([log_density(each) for each in fits])
        mixture, _ = _mixture(regression, posterior, priors, log_weight)
        covariance = covariance + _excess(mixture, posterior.covariance)
    covariance = covariance + _excess(_jackknifed(regression, posterior), covariance)
    if turn_on_variance:
        point = regression.at(posterior.state, prior)
        by_offset = np.array([point.by_offset(axis) for axis in range(3)])
        covariance = covariance + turn_on_variance * (by_offset.T @ by_offset)
    if fit.typical is not None:
        # `_widened` computes the covariance at the most likely sd of mounting offsets: add to it
        # the increases of the covariance by mixtures, jackknife and turn-ons.
        excess = covariance - posterior.covariance
        layout, covariance = _widened(regression, posterior, fit.typical, fit.of_means)
        at = _places(posterior.layout, layout)
        covariance[np.ix_(at, at)] += excess
    if gravity_sd and regression.gravity:
        along = np.zeros(len(covariance))
        along[layout.kappa] = posterior.state.kappa * gravity_sd / regression.gravity
        covariance = covariance + np.outer(along, along)
    return Claim(layout, covariance, offset_sd)


def _over_offsets(
    regression: Regression, posterior: PosteriorMode, offset_sd: float, known_sd: float
) -> tuple[Floats, float, float]:
    """
    Return three results: the covariance of the unit's unknowns, by mixtures over the sds of
    offsets; the sd of the bias offset of a new mounting after a new turn-on [m/s^2]; and the
    variance of the bias offset that all bags of a single turn-on share, for which the regression
    has no unknown (0 for several turn-ons).

    `offset_sd`: sd of mounting offsets in the fit; `known_sd`: sd of offsets by a prior
    calibration, or 0 [m/s^2]
    """
    windows, scale = regression.windows, posterior.prior.offset_scale
    n_mountings = int(windows.mounting[-1]) + 1
    is_single = windows.n_turn_ons == 1 < n_mountings
    if scale <= 0.0:
        # An sd stated by the user is for the sum of mounting and turn-on offset. In the regression
        # the mean offset of m mountings has the variance sd^2 / m. If the mountings share one
        # offset, the mean has the variance sd^2.
        covariance = posterior.covariance
        if offset_sd and n_mountings > 1:
            tried = offset_sd * np.exp2(np.arange(11.0))
            priors, evidence = _with_offsets(regression, posterior, tried)
            if evidence.max() > evidence[0] + CLEAR_GAIN:
                # The bags show larger offsets than stated, see `data_checks.judge_mountings`.
                covariance, weight = _mixture(regression, posterior, priors, evidence)
                offset_sd = float(np.sqrt(weight @ tried**2))
        variance = offset_sd**2 * (1.0 - 1.0 / n_mountings) if is_single else 0.0
        return covariance, offset_sd, variance
    kind = 'mounting' if is_single or windows.has_turn_ons else 'both'
    grid = _offsets_tried(scale, known_sd, kind)
    priors, evidence = _with_offsets(regression, posterior, grid[0])
    covariance, weight = _mixture(regression, posterior, priors, evidence + grid[1])
    offset_sd = float(np.sqrt(weight @ grid[0] ** 2))
    if regression.has_turn_ons:
        values, log_prior = _offsets_tried(scale, known_sd, 'both')
        priors = [replace(posterior.prior, turn_on_sd=sd) for sd in values.tolist()]
        fits = [regression.solve(posterior.state, each, n_steps=1) for each in priors]
        evidence = np.array([fit.log_evidence for fit in fits])
        mixture, weight = _mixture(regression, posterior, priors, evidence + log_prior)
        variance = float(weight @ values**2)
        covariance = covariance + _excess(mixture, posterior.covariance)
        return covariance, float(np.hypot(offset_sd, variance**0.5)), 0.0
    if not (is_single and regression.gravity):
        return covariance, offset_sd, 0.0
    # Bags of one turn-on do not show the sd of the bias over turn-ons: use the prior of this sd.
    values, log_prior = _offsets_tried(scale, known_sd, 'turn-on')
    variance = float(np.average(values**2, weights=np.exp(log_prior)))
    return covariance, float(np.hypot(offset_sd, variance**0.5)), variance


def _offsets_tried(scale: float, known_sd: float, kind: str) -> tuple[Floats, Floats]:
    """
    Return the values to try for the sd of the offsets of mountings or turn-ons [m/s^2], and the
    log prior density of the logarithm of this sd at these values.

    `scale`: scale of the sd's prior in the fit [m/s^2]; `known_sd`: sd of the offsets by a prior
    calibration [m/s^2], else 0; `kind`: 'mounting', 'turn-on' or 'both', see `prior_ratio`
    """
    if known_sd:
        # A test of 12 positions determines the sd of mounting offsets within a factor of 1.5.
        ratio = 10.0 ** np.arange(-1.5, 1.51, 0.125)
        return known_sd * ratio, log_student(np.log(ratio) / np.log(1.5))
    # Scale of the half-Student prior of the sd, divided by `scale`, for offsets of these kinds.
    # 'mounting': of mountings within a turn-on; 'turn-on': of a single turn-on, which does not
    # show how well the bias repeats; 'both': of turn-ons, or of mountings each with a turn-on.
    prior_ratio = {'mounting': 1.0 / 3.0, 'turn-on': 1.0, 'both': LARGE_OFFSETS}[kind]
    # The log evidence changes smoothly over the grid's step, a third of a decade. The smallest sd
    # is far below the error of a long test (0.05 ug). The density of the logarithm of the sd is
    # the density of the sd times the sd.
    ratio = 10.0 ** np.linspace(-3.45, 2.25, 19)
    return scale * ratio, log_student(ratio / prior_ratio) + np.log(ratio)


def _places(layout: Layout, widened: Layout) -> Ints:
    """Return the indices of the unit's unknowns of `layout` in `widened`, shape (n_unit,)."""
    places = np.empty(layout.n_unit, dtype=np.int64)
    for name in ('kappa', 'bias', 'weights', 'nonlinear', 'shared'):
        at = getattr(layout, name)
        places[at[at >= 0]] = getattr(widened, name)[at >= 0]
    return places


def _widened(
    regression: Regression, posterior: PosteriorMode, typical: Floats, of_means: State | None
) -> tuple[Layout, Floats]:
    """Return layout and covariance, extended by the columns that the data do not determine."""
    prior, state = _with_unseen(regression, posterior, typical), posterior.state
    other = state
    if of_means is not None:
        # The drifts of warm-ups within the positions determine the chosen curve. A warm-up heats
        # the board in another way than a chamber does, so the curve fitted to the positions' means
        # is an alternative: half of the squared difference of the curves is added to the
        # covariance. Columns that change more within the positions than between them keep the
        # weights of the chosen fit.
        within = within_positions(regression.columns, regression.windows.position)
        between = np.mean((regression.columns - within) ** 2, axis=0)
        is_of_means = np.mean(within**2, axis=0) < between
        weights = np.where(is_of_means, of_means.weights, state.weights)
        other = replace(of_means, weights=weights)
        # Columns that only the fit of the means has get a tiny prior sd, so that `with_unseen` has
        # their weights.
        is_used = other.weights.any(axis=1) & (prior.column_sd == 0.0)
        prior = replace(prior, column_sd=np.where(is_used, 1e-9, prior.column_sd))
    with_unseen = regression.solve(state, prior, n_steps=0)
    layout = with_unseen.layout
    # The weights of the added columns are 0 in the fit: add to the covariance the square of the
    # step of all unknowns to the mode of the model with the added columns.
    step = regression.at(state, prior).solution[0][: layout.n_unit]
    difference = (as_vector(other, layout) - as_vector(state, layout))[: layout.n_unit]
    excess = np.outer(step, step) + 0.5 * np.outer(difference, difference)
    return layout, with_unseen.covariance + excess


def _with_unseen(regression: Regression, posterior: PosteriorMode, typical: Floats) -> Prior:
    """
    Add to the prior the columns that the data do not determine, so that their variance is not 0.

    The weight of an inactive column is consistent with 0, but the data bound it only to ``1 /
    sqrt(S)``, S being the information about the weight given the active columns. A column is
    added, with the weight 0 and the sd ``min(1 / sqrt(S), prior sd)``, if this sd exceeds two sd
    of a window's noise. For the comparison with the noise, the sd of a nearly constant column is
    scaled to the RMS of the board temperature t [K].
    """
    groups, prior = np.array(regression.windows.groups), posterior.prior
    kelvins = regression.windows.kelvins
    active = groups[prior.column_sd.any(axis=0)]
    # Add columns of lags and curves (few temperatures do not determine all powers), and columns
    # active only in the bias or only in the scale: one attitude does not separate their drifts.
    curves = [PART if PART in active else CURVE]
    may = np.isin(groups, [*LAGS, *curves]) | prior.column_sd.any(axis=0)
    inactive = regression.inactive(posterior, may & typical.any(axis=0))
    information = np.diag(inactive.S).reshape(-1, 3)
    information = information.sum(axis=1) / np.maximum((information > 0.0).sum(axis=1), 1)
    sd = np.zeros_like(typical)
    sd[inactive.part, inactive.column] = 1.0 / np.sqrt(np.maximum(information, 1e-300))
    is_of_lags = np.isin(groups, LAGS)
    if not regression.windows.has_drifts:
        # At constant temperatures lags change by thermometer errors alone, so the data do not
        # bound the weights of lags.
        sd = np.where((sd > 0.0) & (regression.windows.lag >= 0), np.inf, sd)
    sd = np.where(is_of_lags, sd, np.minimum(sd, typical))
    if CURVE in active:
        # A lag only delays the curve: the prior sd of a lag's weight is at most the curve's slope
        # (RMS over axes), including the slopes that inactive curve columns may add.
        is_curve = (groups == CURVE) & (kelvins > 0.0)
        square = np.mean(posterior.state.weights**2, axis=1) + sd**2
        slopes = np.sqrt(np.sum(square[:, is_curve] / kelvins[is_curve] ** 2, axis=1))
        of_curve = np.outer(slopes, kelvins)
        typical = np.minimum(typical, of_curve)
        # A curve column that the data do not determine may change the curve's slope by 50 %.
        sd = np.where(groups == CURVE, np.minimum(sd, 0.5 * of_curve), sd)
    # n lags together have at most the prior variance of one lag: divide each sd limit by sqrt(n).
    is_lag = is_of_lags & (sd > 0.0)
    share = np.sqrt(np.maximum(is_lag.sum(axis=1, keepdims=True), 1))
    sd = np.where(is_lag, np.minimum(sd, typical / share), sd)
    units = np.array([[1.0], [1.0 / (regression.gravity or 1.0)]])
    # A column is nearly constant if its RMS / slope [K] is below 1 % of the RMS of column t.
    is_constant = kelvins < 0.01 * float(kelvins[0])
    ratio = np.where(is_constant, float(kelvins[0]) / np.maximum(kelvins, 1e-9), 1.0)
    matters = (sd > 0.0) & (sd * ratio > 2.0 * float(np.mean(prior.sigma)) * units)
    return replace(prior, column_sd=np.where(matters, sd, prior.column_sd))


def _with_offsets(
    regression: Regression, posterior: PosteriorMode, tried: Floats
) -> tuple[list[Prior], Floats]:
    """Return a prior for each sd of mounting offsets in `tried`, and its log evidence, (k,)."""
    prior, mounting = posterior.prior, regression.windows.mounting
    n_rests = len(mounting) / (mounting[-1] + 1)
    priors = [replace(prior, offset_sd=sd) for sd in tried.tolist()]
    fits = [regression.solve(posterior.state, each, n_steps=1) for each in priors]
    # If tilts of the supports were fitted to drifts that mounting offsets cause, the fitted sd of
    # the tilts is too large: try a tenth of this sd, too.
    rigid = [
        regression.solve(posterior.state, replace(each, tilt_sd=0.1 * each.tilt_sd), n_steps=3)
        for each in priors
    ]
    # With a large sd of mounting offsets attitudes absorb model errors, so the log evidence rises:
    # limit its rise to the rise of the log evidence of |f|, plus `CLEAR_GAIN`.
    of_data = np.logaddexp([fit.log_evidence for fit in fits], [fit.log_evidence for fit in rigid])
    of_norms = _norm_evidence(regression, posterior, tried, fits[-1].root)
    nearest = int(np.argmin(np.abs(np.log(tried * n_rests**0.5 / prior.offset_sd))))
    of_data, of_norms = of_data - of_data[nearest], of_norms - of_norms[nearest]
    if n_rests > 1.0:
        # The rests of a mounting share its offset: only mountings' means determine the offset sd.
        return [replace(prior, offset_sd=n_rests**0.5 * sd) for sd in tried.tolist()], of_norms
    return priors, np.minimum(of_data, of_norms + CLEAR_GAIN)


def _mixture(
    regression: Regression, posterior: PosteriorMode, priors: Sequence[Prior], log_weight: Floats
) -> tuple[Floats, Floats]:
    """
    Return the covariance about the mode by a mixture over `priors`, and the weight of each prior.

    The equations of all priors are linearised at the mode `posterior`. The priors' own modes
    differ by percents in bias and scale if the attitudes do not separate bias and scale. Equations
    linearised at these modes would increase the sd of well determined sums of bias and scale.
    """
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    n = posterior.layout.n_unit
    covariance = np.zeros((n, n))
    for share, prior in zip(weight, priors, strict=True):
        step, factor = regression.at(posterior.state, prior).solution
        root = inverse_root(factor)
        covariance += share * (root @ root.T + np.outer(step[:n], step[:n]))
    return covariance, weight


def _excess(covariance: Floats, other: Floats) -> Floats:
    """Return ``covariance - other``, with eigenvalues < 0 (scaled by sds of `other`) set to 0."""
    sd = np.sqrt(np.diag(other))
    values, vectors = np.linalg.eigh((covariance - other) / np.outer(sd, sd))
    root = sd[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root @ root.T)


def _norm_evidence(
    regression: Regression, posterior: PosteriorMode, offset_sd: Floats, by_drifts: Floats
) -> Floats:
    """
    Return the log evidence, up to a constant, of the mountings' mean |f| for k offset sds, (k,).

    `by_drifts`: root of the unit's covariance at the largest offset sd, at which drifts alone
    determine the thermal weights; only the rows of these weights are used
    """
    prior, state, layout = posterior.prior, posterior.state, posterior.layout
    point, first = regression.at(state, prior), regression.windows.edges[:-1]
    along = point.norms_by_unit
    weight = np.add.reduceat(regression.weight, first)
    residual = block_means(regression.residual(state, layout), regression.weight, first)
    # Average derivatives and errors (with offset) of |f| over the rests of each mounting.
    errors = np.sum(point.norm_by_axes * (residual + state.offset), axis=1)
    first = np.flatnonzero(np.diff(regression.windows.mounting, prepend=-1))
    means = block_means(np.column_stack((along, errors)), weight, first)
    along, errors, weight = means[:, :-1], means[:, -1], np.add.reduceat(weight, first)
    if prior.informative is None:
        # The prior of the constants is so wide that its mean can be set to the fitted constants.
        weights = layout.axis[:, 2:].ravel()
        constants = np.setdiff1d(np.arange(layout.n_unit), weights)
        of_prior = np.hstack((
            along[:, constants] / np.sqrt(point.precision[constants]),
            along[:, weights] @ by_drifts[weights],
        ))  # fmt: skip
    else:
        errors += along @ point.deviation[: layout.n_unit]
        of_prior = solve_triangular(prior.informative.root, along.T, trans='T').T
    noise = float(np.mean(prior.sigma**2)) * (1.0 / weight + prior.noise.variance)
    variances, vectors = np.linalg.eigh(of_prior @ of_prior.T + np.diag(noise))
    variances = np.maximum(variances, noise.min()) + offset_sd[:, None] ** 2
    square = np.sum((vectors.T @ errors) ** 2 / variances, axis=1)
    return np.asarray(-0.5 * (square + np.sum(np.log(variances), axis=1)))


def _jackknifed(regression: Regression, posterior: PosteriorMode) -> Floats:
    """
    Return the covariance of the unit's unknowns by the jackknife over the sections of the test,
    less the part due to noise, shape (n_unit, n_unit). The result is 0 if there is one section, or
    if noise explains the changes of the unknowns.
    """
    n = posterior.layout.n_unit
    last = int(regression.windows.section.max())
    if not last:
        return np.zeros((n, n))
    products = regression.products(posterior.layout.used)
    step, factor = regression.at(posterior.state, posterior.prior).solution
    changes, ratios = [], []
    for number in range(last + 1):
        grams = products.without(np.array([number]))
        other, remaining = regression.at(posterior.state, posterior.prior, grams).solution
        changes.append(other[:n] - step[:n])
        ratios.append(_ratios_to_noise(factor.T @ changes[-1], remaining.T @ posterior.root))
    ratio, without = np.concatenate(ratios), np.array(changes)
    # Under noise alone each ratio (of squared change to variance) has mean 1 and variance 2.
    if ratio.sum() - len(ratio) < 2.0 * np.sqrt(2.0 * len(ratio)):
        return np.zeros((n, n))
    # Noise contributes about len(ratio) to the sum of the ratios; model errors cause the rest.
    share = 1.0 - len(ratio) / ratio.sum()
    return np.asarray(share * last / (last + 1) * without.T @ without)


def _ratios_to_noise(change: Floats, remaining: Floats) -> Floats:
    """
    Return the squared changes of k combinations of the unknowns if some windows are left out,
    divided by the variances of these changes due to noise, shape (k,).

    `change`: change of the unknowns, shape (n,), and `remaining`: root of the information of the
    remaining windows, ``remaining.T @ remaining``, shape (n, n), both scaled so that the
    covariance of the fit of all windows is the unit matrix
    """
    shares, directions = np.linalg.eigh(remaining.T @ remaining)
    # Ignore combinations of unknowns that lose less than 1e-6 of their information.
    is_measured = shares < 1.0 - 1e-6
    shares = np.maximum(shares[is_measured], 1e-12)
    return np.asarray((change @ directions[:, is_measured]) ** 2 * shares / (1.0 - shares))
