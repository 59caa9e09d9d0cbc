# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the model: groups of columns are added in steps to a model of constants.

The log evidence ranks the groups of columns to try; the score on left-out data decides which to
add. The fit of each model begins from the fit of a smaller model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from ..typing import Floats
from .hyperparameters import (
    CLEAR_GAIN,
    Candidates,
    downweigh,
    log_density,
    pruned_fit,
    settle,
    with_slow_noise,
)
from .left_out import Score, gain, is_better, is_near, is_undecided, is_worse_by_norms, score_of
from .regression import PosteriorMode, Regression
from .unknowns import POSE_SD, InformativePrior, Prior, State
from .windows import BEND, CURVE, LAGS, PART, PRODUCTS, SET, ThermalWindows

#: Ratio of a large initial sd of mounting offsets to the scale of their prior. In data sheets the
#: bias of tactical triads repeats to 0.3 .. 1 mg over turn-ons, 10 to 20 times the prior's scale.
LARGE_OFFSETS = 10.0


@dataclass(frozen=True)
class Trial:
    """
    A model that the selection has fitted.

    groups: groups of the model's columns, () for a model of constants alone
    score: left-out errors of the model
    posterior: fit of the model
    typical: typical prior sd of the model's columns, shape (2, m)
    is_near: whether the chosen model has a score better by at most one standard error
    """

    groups: tuple[str, ...]
    score: Score
    posterior: PosteriorMode
    typical: Floats
    is_chosen: bool = False
    is_near: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether noise, or the error of a coarse thermometer, explains the left-out drift."""
        is_noise = self.score.rms <= 2.0 * float(self.posterior.prior.sigma.mean())
        return is_noise or self.score.is_by_thermometer


@dataclass(frozen=True)
class Selected:
    """
    The chosen model: its completed fit, its left-out score, and all models that were tried.

    informative: the priors made from one calibration for several amounts of ageing
    """

    posterior: PosteriorMode
    score: Score
    trials: tuple[Trial, ...]
    informative: tuple[InformativePrior, ...] = ()


class Fit(NamedTuple):
    """
    The windows of a fit, their regression, and the chosen model.

    typical: typical prior sd of all columns that the selection could have chosen, shape (2, m), or
        None if there was no selection of columns
    of_means: state of the fit of a curve to the means of the positions, if that fit is worse on
        left-out data than the chosen model and no bag contains a ramp; else None
    """

    windows: ThermalWindows
    regression: Regression
    selected: Selected
    typical: Floats | None = None
    of_means: State | None = None

    @property
    def posterior(self) -> PosteriorMode:
        """The fit of the chosen model."""
        return self.selected.posterior

    @property
    def offset_sd(self) -> float:
        """
        Sd, fitted to the bags, of the bias offset of a mounting after a new turn-on [m/s^2]. A
        calibration has a larger sd, to allow for larger offsets that the bags do not exclude.
        """
        prior = self.posterior.prior
        return float(np.hypot(prior.offset_sd, self.regression.has_turn_ons * prior.turn_on_sd))


_Model = TypeVar('_Model', Trial, Selected)


def _best(chosen: Trial, trials: Sequence[Trial]) -> Trial:
    for trial in trials:
        if is_better(chosen.score, trial.score):
            chosen = trial
    return chosen


class Growth:
    """Fits models of given groups of columns; each fit begins from the fit of a smaller model."""

    def __init__(self, regression: Regression, candidates: Candidates) -> None:
        self.regression = regression
        self._candidates = candidates
        self._names = np.array(regression.windows.groups)
        may = candidates.typical.any(axis=0)
        self.forced = tuple(dict.fromkeys(self._names[candidates.forced & may].tolist()))
        names = dict.fromkeys(self._names[may].tolist())
        #: Groups of columns that may be added to a model.
        self.free = [group for group in names if group not in self.forced]
        #: The fitted models, for the report of the fit.
        self.tried: list[Trial] = []

    def fit(self, groups: tuple[str, ...], state: State, prior: Prior, typical: Floats) -> Trial:
        """Fit all columns of `groups`, also columns that the fit of a smaller model dropped."""
        candidates = replace(self._candidates, typical=typical)
        initial_sd = np.where(prior.column_sd > 0.0, prior.column_sd, typical)
        is_wanted = np.isin(self._names, groups)
        prior = replace(prior, column_sd=np.where(is_wanted, initial_sd, 0.0))
        if self.regression.windows.n_poses:
            # With a large prior sd, attitudes and mounting offsets would absorb the effect of new
            # columns. Begin with small sds; keep the sd of the mounting offsets if it is constant.
            prior = replace(prior, pose_sd=0.1 * POSE_SD)
            if prior.offset_scale > 0.0:
                small_sd = float(min(prior.offset_sd, prior.sigma.mean()))
                prior = replace(prior, offset_sd=small_sd)
        posterior = settle(self.regression, state, prior, candidates, 6)
        posterior = pruned_fit(self.regression, posterior, candidates, 8)
        return Trial(groups, score_of(self.regression, posterior), posterior, typical)

    def extended(
        self, before: Trial, groups: tuple[str, ...] = (), largest_sd: Floats | None = None
    ) -> Trial:
        """
        Fit the model `before` plus groups of columns, beginning from the fit of `before`.
        `largest_sd`: upper bound of the new columns' typical prior sd, shape (2, m); None: keep
        the typical prior sds of `before`
        """
        regression, posterior, typical = self.regression, before.posterior, before.typical
        if largest_sd is not None:
            kelvins, state = regression.windows.kelvins, posterior.state
            square = float(np.mean(regression.residual(state, posterior.layout) ** 2))
            if state.pose.size:
                # Mounting offsets and tilts from poses absorb model errors: add their squares.
                by_attitude = regression.gravity * state.from_pose
                square += float(np.mean(state.offset**2) + np.mean(by_attitude**2))
            # Typical sd of a new column: the weight for which the column explains the residual.
            slope = np.sqrt(square) / (float(kelvins[0]) or 1.0)
            units = np.array([[1.0], [1.0 / (regression.gravity or 1.0)]])
            new = np.minimum(slope * units * kelvins, largest_sd)
            typical = np.where(np.isin(self._names, groups), new, typical)
        return self.fit((*before.groups, *groups), posterior.state, posterior.prior, typical)

    def added(self, chosen: Trial, progress: Callable[[float], None]) -> Trial:
        """Add groups of columns while left-out errors decrease; return the final model."""
        part = 1.0
        while True:
            larger = self.trials(chosen, self.free)
            self.tried += larger
            better = [trial for trial in larger if is_better(chosen.score, trial.score)]
            part *= 0.6
            progress(1.0 - part)
            if not better:
                return chosen
            # Choose the smallest model that is not significantly worse than the best model.
            best = max(better, key=lambda trial: gain(chosen.score, trial.score))
            better.sort(key=lambda trial: len(trial.groups))
            chosen = next(t for t in better if t is best or not is_better(t.score, best.score))

    def with_bends(self, before: Trial, groups: Sequence[str]) -> list[Trial]:
        """Fit the model `before` plus `groups` without bends, and with bends; return the fits."""
        added = tuple(group for group in groups if group in self.free)
        smooth = self.extended(before, added, self._candidates.typical)
        return [smooth, *self.trials(smooth, [BEND])]

    def lowest_degree(self, constants: Trial) -> Trial:
        """Fit curves of each degree; choose a higher degree if the log density clearly rises."""
        prior, state = constants.posterior.prior, constants.posterior.state
        prior = replace(prior, offset_sd=prior.offset_scale or prior.offset_sd)
        number = np.cumsum(self._names == CURVE)
        groups = *constants.groups, CURVE
        chosen, *larger = (
            self.fit(groups, state, prior, self._candidates.typical * (number <= degree))
            for degree in range(1, int(number[-1]) + 1)
        )
        # A curve of high degree fits |f| in few positions exactly, so the evidence decides.
        for curve in larger:
            if log_density(curve.posterior) - log_density(chosen.posterior) > CLEAR_GAIN:
                chosen = curve
        return chosen

    def trials(self, chosen: Trial, groups: Sequence[str]) -> list[Trial]:
        """Fit the chosen model plus each of up to 4 sets of groups that have large gains."""
        absent = [group for group in groups if group in self.free and group not in chosen.groups]
        if not absent:
            return []
        typical = self._candidates.typical
        columns = np.isin(self._names, absent) & typical.any(axis=0)
        inactive = self.regression.inactive(chosen.posterior, columns)
        if BEND in absent:
            # Select up to 60 bends: a bump in the bias of one axis over temperature needs 20.
            is_bend = self._names == BEND
            knees = inactive.chosen(typical, is_bend, CLEAR_GAIN, 60)
            typical = np.where(is_bend & ~knees, 0.0, typical)
        # Try those groups together that describe one effect: the squared temperature of a part of
        # lag m behind t, (t - m)^2 = t^2 - 2 t m + m^2, needs the product t m and the square m^2.
        together = PRODUCTS, (*LAGS, 'product', 'gradient_x_temperature', 'square')
        sets = [tuple(group for group in groups if group in absent) for groups in together]
        sets = [*((group,) for group in absent), *(groups for groups in sets if len(groups) > 1)]
        if {*LAGS} & {*absent} and not {*LAGS} & {*chosen.groups}:
            # Products and powers of lags are tried only in a model with lags (marginality).
            sets = [each for each in sets if {*LAGS} & {*each} or not {*PRODUCTS} & {*each}]
        gains = {groups: inactive.gain(typical, np.isin(self._names, groups)) for groups in sets}
        likely = [groups for groups in sets if gains[groups] > CLEAR_GAIN]
        likely.sort(key=gains.__getitem__, reverse=True)
        tried = likely[:3]
        if chosen.groups == (CURVE,) and (SET,) in likely[3:]:
            tried.append((SET,))
        return [self.extended(chosen, groups, typical) for groups in tried]


def better_start(fits: Sequence[_Model]) -> _Model:
    """
    Choose by left-out data between the first fit, begun with a small prior sd of mounting offsets
    or of the misalignment, and the last fit, begun with a large sd. If left-out data do not
    decide, the last fit is chosen only for a log density larger by `CLEAR_GAIN`. Mounting offsets
    and misalignments explain |f| in few positions equally well, but only misalignments predict |f|
    in a new position.
    """
    small, large = fits[0], fits[-1]
    evidence_gain = log_density(large.posterior) - log_density(small.posterior)
    is_worse = is_better(large.score, small.score) or is_worse_by_norms(small.score, large.score)
    is_likelier = evidence_gain > CLEAR_GAIN and not is_worse
    return large if is_likelier or is_better(small.score, large.score) else small


def select(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    progress: Callable[[float], None] = lambda _part: None,
) -> Selected:
    """Choose the groups of columns by left-out data, and fit them."""
    growth = Growth(regression, candidates)
    # A model of constants attributes the drift to mounting offsets or to noise: begin from a small
    # and from a large prior sd of mounting offsets.
    priors = [prior]
    if prior.offset_scale > 0.0:
        large = float(prior.sigma.mean())
        priors.append(replace(prior, offset_sd=large, turn_on_sd=large))
    fits = [growth.fit(growth.forced, state, initial, candidates.typical) for initial in priors]
    constants = first = better_start(fits)
    growth.tried.append(constants)
    if CURVE in growth.free:
        # Add the curve without a test: it may improve the score only together with more columns.
        if regression.windows.has_drifts:
            curve = better_start([growth.extended(fit, (CURVE,)) for fit in fits])
            downweigh(regression, curve.posterior)
            first = growth.extended(curve)
        else:
            first = growth.lowest_degree(constants)
        growth.tried.append(first)
    parts = None
    if PART in growth.free:
        # Curves over the temperatures of parts replace the curve over the board temperature.
        parts = better_start([growth.extended(fit, (PART,)) for fit in fits])
    chosen = _grown(growth, first, parts, progress)
    if chosen is not constants and not is_better(constants.score, chosen.score):
        more_evidence = log_density(chosen.posterior) - log_density(constants.posterior)
        if not is_undecided(constants.score, chosen.score) or more_evidence < CLEAR_GAIN:
            chosen = constants
    candidates = replace(candidates, typical=chosen.typical)
    posterior, score = finish(regression, chosen, candidates)
    trials = tuple(
        replace(trial, score=score, is_chosen=True)
        if trial.groups == chosen.groups
        else replace(trial, is_near=is_near(chosen.score, trial.score))
        for trial in growth.tried
    )
    return Selected(posterior, score, trials)


def _grown(
    growth: Growth, first: Trial, parts: Trial | None, progress: Callable[[float], None]
) -> Trial:
    """Add groups of columns to the better of `first` and `parts`; return the best model."""
    chosen = first
    if parts is not None:
        trials = [parts, *growth.trials(parts, [BEND])]
        if 'gradient' in growth.free and not _best(chosen, trials).is_complete:
            trials.append(growth.extended(parts, ('gradient',)))
        growth.tried += trials
        chosen = _best(chosen, trials)
    if growth.regression.windows.acts_on is not None and not chosen.is_complete:
        trials = growth.with_bends(first, ('board', *PRODUCTS))
        growth.tried += trials
        chosen = _best(chosen, trials)
    return growth.added(chosen, progress)


def fit_all(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    informative: Sequence[InformativePrior] = (),
) -> Selected:
    """Fit all columns, with the prior of `informative` whose fit has the largest log density."""
    # Mounting offsets and ageing of the unit explain |f| in few positions equally well, so the sd
    # of the mounting offsets is not fitted until an informative prior is chosen.
    scale = prior.offset_scale
    prior = replace(prior, offset_scale=0.0 if informative else scale)
    posterior = settle(regression, state, prior, candidates)
    downweigh(regression, posterior)
    posterior = settle(regression, posterior.state, posterior.prior, candidates)
    if informative:
        priors = [replace(posterior.prior, informative=candidate) for candidate in informative]
        fits = [regression.solve(posterior.state, each, n_steps=3) for each in priors]
        best = max(fits, key=log_density)
        prior = replace(best.prior, offset_scale=scale)
        posterior = settle(regression, best.state, prior, candidates)
    posterior = with_slow_noise(regression, posterior, candidates)
    score = score_of(regression, posterior)
    groups = tuple(dict.fromkeys(regression.windows.groups))
    trial = Trial(groups, score, posterior, candidates.typical, is_chosen=True)
    return Selected(posterior, score, (trial,), tuple(informative))


def finish(
    regression: Regression, chosen: Trial, candidates: Candidates
) -> tuple[PosteriorMode, Score]:
    """
    Complete the chosen model: reduce the weights of outliers, drop columns of small gain, try a
    large sd of mounting offsets, and try slow noise. Slow noise can describe thermal effects in
    place of columns, so it is kept only if the correction of left-out data does not become worse.
    """
    downweigh(regression, chosen.posterior)
    posterior = settle(regression, chosen.posterior.state, chosen.posterior.prior, candidates)
    posterior = pruned_fit(regression, posterior, candidates)
    score, prior = score_of(regression, posterior), posterior.prior
    white = replace(chosen, posterior=posterior, score=score)
    large = LARGE_OFFSETS * prior.offset_scale
    is_noise = score.rms <= 4.0 * float(np.hypot(score.noise, score.by_thermometer))
    if prior.offset_sd < prior.offset_scale and is_noise:
        # Nine constants explain |f| in nine positions with any mounting offsets. The drift of an
        # axis due to its scale factor is proportional to the specific force along the axis, so a
        # model that explains the drifts determines the forces and thus the mounting offsets.
        prior = replace(prior, offset_sd=large, turn_on_sd=large)
        posterior = settle(regression, posterior.state, prior, candidates)
        score = score_of(regression, posterior)
        white = better_start([white, replace(chosen, posterior=posterior, score=score)])
    slow = with_slow_noise(regression, white.posterior, candidates)
    if slow.prior.noise != white.posterior.prior.noise:
        slow = pruned_fit(regression, slow, candidates)
        score = score_of(regression, slow)
        if not (is_worse_by_norms(white.score, score) or is_better(score, white.score)):
            return slow, score
    return white.posterior, white.score
