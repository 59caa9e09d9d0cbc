# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the model: groups of columns are added to the constants one at a time.

The log evidence ranks the groups to be tried; the left-out score decides. A group is added if it
reduces the error on left-out data by more than the standard error over the folds, both for
positions and for sections of the program. A group that describes only one recording, or one
program, fails one of the two tests.

References
----------
.. [1] A. Vehtari, A. Gelman, J. Gabry, Practical Bayesian model evaluation using leave-one-out
   cross-validation, Statistics and Computing 27 (2017).

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Bools, Floats
from .hyperparameters import downweigh, log_density, pruned, settle, white_noise
from .left_out import Score, score_of
from .regression import Posterior, Regression
from .unknowns import InformativePrior, Noise, Prior, State
from .windows import BEND, CURVE, SET

#: Smallest possible gain in log evidence of a group that is tried: odds of e^4 = 55 to one.
TRIAL_GAIN = 4.0
# Largest number of groups tried in a round.
_TRIALS = 3
#: Groups that are linear in a temperature difference.
LAGS = ('gradient', 'board', 'gradient_lag')
# Groups that are tried together, because one effect has columns in all of them: the curve of a
# part that lags by m is (t - m)^2 = t^2 - 2 t m + m^2, m from the board or from the gradient.
_TOGETHER = (('product', 'square'), (*LAGS, 'product', 'gradient_x_temperature', 'square'))
#: Smallest log Bayes factor of a column that is kept: below 1 the evidence is "not worth more than
#: a bare mention" (Kass and Raftery, Bayes factors, JASA 90 (1995), section 3.2).
LEAST_GAIN = 1.0
# Logarithms of mean squares that differ by less than this count as equal: 5 % of an RMS.
_EQUAL = 0.1
# Largest left-out drift, relative to the noise, of a model that lacks nothing.
_AT_NOISE = 2.0
# Largest left-out drift, relative to the chosen model's, of a model of bends that is continued.
_PROMISING = 3.0
# Largest factor by which the RMS error of the two halves may rise: two folds scatter by a quarter.
_MOST_BY_HALVES = 1.25


@dataclass(frozen=True)
class Trial:
    """
    A model that was tried.

    groups: its groups of columns; () for constants
    score: its left-out errors
    posterior, prior: its fit
    typical: typical prior sd of its columns, shape (2, m)
    is_chosen: whether it is the chosen model
    is_near: whether its score is within one standard error of that of the chosen model
    """

    groups: tuple[str, ...]
    score: Score
    posterior: Posterior
    prior: Prior
    typical: Floats
    is_chosen: bool = False
    is_near: bool = False

    @property
    def log_density(self) -> float:
        """Log evidence plus log prior density of the mounting's standard deviation."""
        return log_density(self.posterior, self.prior)


@dataclass(frozen=True)
class Selected:
    """The chosen model: its fit, its left-out score, and all models that were tried."""

    posterior: Posterior
    prior: Prior
    score: Score
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Candidates:
    """
    The columns that may take part in a model.

    typical, largest: centre of the hyperprior and upper bound of each column's prior sd, in units
        of its RMS, shape (2, m); 0 for a column that may not take part
    forced: columns that are always kept, shape (m,)
    fixed: columns that are always kept, with their prior sd, shape (2, m)
    """

    typical: Floats
    largest: Floats
    forced: Bools
    fixed: Bools

    @property
    def kept(self) -> Bools:
        """Columns that are never dropped, shape (2, m)."""
        return self.fixed | self.forced


def select(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    progress: Callable[[float], None] = lambda _part: None,
) -> Selected:
    """Choose the groups of columns by left-out data, and fit them."""
    names = np.array(regression.windows.groups)
    may = candidates.typical.any(axis=0)
    forced = tuple(dict.fromkeys(names[candidates.forced & may].tolist()))
    asked = [name for name in dict.fromkeys(names[may].tolist()) if name not in forced]
    grow = _Growth(regression, candidates, names)
    # Without a curve the drift is attributed to mountings or to noise: start from both.
    begun = [prior]
    if prior.offset_scale > 0.0:
        begun.append(replace(prior, offset_sd=float(prior.sigma.mean())))
    fits = [grow.fit(forced, state, one, candidates.typical) for one in begun]
    constants = chosen = _likelier(fits)
    trials = [constants]
    if CURVE in asked:
        # The curve is added without a test: it may improve the score only with other groups.
        groups = *forced, CURVE
        curve = _likelier(
            [grow.fit(groups, fit.posterior.state, fit.prior, fit.typical) for fit in fits]
        )
        downweigh(regression, curve.posterior, curve.prior)
        chosen = grow.fit(groups, curve.posterior.state, curve.prior, curve.typical)
        trials.append(chosen)
    begin = chosen
    chosen, found = grow.added(chosen, asked, progress)
    trials += found
    noise = float(chosen.prior.sigma.mean())
    if BEND in asked and BEND not in chosen.groups and chosen.score.rms > _AT_NOISE * noise:
        # The slopes of a part that lags are seen only beside its lag, not beside a stand-in of
        # products and squares.
        bent = grow.bent(begin, asked)
        if bent is not None and bent.score.rms < _PROMISING * chosen.score.rms:
            trials.append(bent)
            bent, found = grow.added(bent, asked, progress)
            trials += found
            if is_better(chosen.score, bent.score):
                chosen = bent
    if chosen is not constants and not is_better(constants.score, chosen.score):
        gain = chosen.posterior.log_evidence - constants.posterior.log_evidence
        if not _is_undecided(constants.score, chosen.score) or gain < TRIAL_GAIN:
            chosen = constants
    settled = replace(candidates, typical=chosen.typical)
    posterior, prior, score = finish(regression, chosen.posterior, chosen.prior, settled)
    marked = []
    for one in trials:
        is_chosen = one.groups == chosen.groups
        is_near = not is_chosen and _is_near(chosen.score, one.score)
        kept = replace(one, score=score) if is_chosen else one
        marked.append(replace(kept, is_chosen=is_chosen, is_near=is_near))
    return Selected(posterior, prior, score, tuple(marked))


def fit_all(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    informative: Sequence[InformativePrior] = (),
) -> Selected:
    """Fit all columns; of several informative priors take that of the largest log evidence."""
    posterior, prior = _settle(regression, state, prior, candidates)
    downweigh(regression, posterior, prior)
    posterior, prior = _settle(regression, posterior.state, prior, candidates)
    if informative:
        tried = [
            regression.solve(posterior.state, replace(prior, informative=candidate), n_steps=3)
            for candidate in informative
        ]
        best = int(np.argmax([one.log_evidence for one in tried]))
        prior = replace(prior, informative=informative[best])
        posterior, prior = _settle(regression, tried[best].state, prior, candidates)
    posterior, prior = _with_slow_noise(regression, posterior, prior, candidates)
    score = score_of(regression, posterior, prior)
    groups = tuple(dict.fromkeys(regression.windows.groups))
    trial = Trial(groups, score, posterior, prior, candidates.typical, is_chosen=True)
    return Selected(posterior, prior, score, (trial,))


def finish(
    regression: Regression, posterior: Posterior, prior: Prior, candidates: Candidates
) -> tuple[Posterior, Prior, Score]:
    """
    Complete the chosen model: weights of outliers, columns with too little gain, slow noise.

    Slow noise also absorbs thermal effects that the model lacks, so it is kept only if it does not
    worsen the correction of left-out data.
    """
    downweigh(regression, posterior, prior)
    white = _pruned(
        regression, *_settle(regression, posterior.state, prior, candidates), candidates
    )
    score = score_of(regression, *white)
    slow = _with_slow_noise(regression, *white, candidates)
    if slow[1].noise != white[1].noise:
        slow = _pruned(regression, *slow, candidates)
        found = score_of(regression, *slow)
        if not is_better(found, score):
            return *slow, found
    return *white, score


def _pruned(
    regression: Regression,
    posterior: Posterior,
    prior: Prior,
    candidates: Candidates,
    rounds: int = 25,
) -> tuple[Posterior, Prior]:
    """Drop columns with too little gain, as long as the log evidence of the new fit agrees."""
    while True:
        fewer = pruned(posterior, prior, candidates.kept, LEAST_GAIN)
        if np.array_equal(fewer.column_sd, prior.column_sd):
            return posterior, prior
        found = _settle(regression, posterior.state, fewer, candidates, rounds)
        if found[0].log_evidence < posterior.log_evidence - LEAST_GAIN:
            return posterior, prior
        posterior, prior = found


def _settle(
    regression: Regression, state: State, prior: Prior, candidates: Candidates, rounds: int = 25
) -> tuple[Posterior, Prior]:
    return settle(
        regression, state, prior, candidates.typical, candidates.largest, candidates.fixed, rounds
    )


def _with_slow_noise(
    regression: Regression, posterior: Posterior, prior: Prior, candidates: Candidates
) -> tuple[Posterior, Prior]:
    """Estimate the slow noise from the residuals, then by log evidence, and settle with it."""
    residual = regression.residual(posterior.state, posterior.layout) / prior.sigma
    best = regression.whitener.estimate(residual, regression.weight)
    if best == prior.noise:
        return posterior, prior

    def with_noise(noise: Noise) -> tuple[Posterior, Prior]:
        trial = replace(prior, noise=noise)
        for _ in range(2):
            fitted = regression.solve(posterior.state, trial, n_steps=1)
            trial = replace(trial, sigma=white_noise(regression, fitted))
        return fitted, trial

    # The parameters absorb a part of the noise, so residuals underestimate it; the log evidence
    # does not. Search ratio and time in steps of a factor of 3, then of 3^(1/2) and 3^(1/4).
    refined, found = with_noise(best)
    step = 3.0
    while step > 3.0**0.2:
        around = [
            with_noise(Noise(best.ratio * ratio, best.time_s * time))
            for ratio, time in ((step, 1.0), (1.0 / step, 1.0), (1.0, step), (1.0, 1.0 / step))
            if regression.whitener.shows(best.time_s * time)
        ]
        nearby = max(around, key=lambda one: one[0].log_evidence)
        if nearby[0].log_evidence > refined.log_evidence:
            refined, found = nearby
            best = found.noise
        else:
            step = step**0.5
    return _settle(regression, refined.state, found, candidates)


class _Growth:
    """Fits models of some groups, each initialised by the fit of a smaller model."""

    def __init__(self, regression: Regression, candidates: Candidates, names: Floats) -> None:
        self._regression = regression
        self._candidates = candidates
        self._names = names

    def fit(self, groups: tuple[str, ...], state: State, prior: Prior, typical: Floats) -> Trial:
        """Fit a model; columns that a smaller model dropped are tried again."""
        candidates = replace(self._candidates, typical=typical)
        wanted = np.isin(self._names, groups)
        begin = np.where(prior.column_sd > 0.0, prior.column_sd, typical)
        prior = replace(prior, column_sd=np.where(wanted, begin, 0.0))
        posterior, prior = _settle(self._regression, state, prior, candidates, 6)
        posterior, prior = _pruned(self._regression, posterior, prior, candidates, 8)
        score = score_of(self._regression, posterior, prior)
        return Trial(groups, score, posterior, prior, typical)

    def added(
        self, chosen: Trial, asked: Sequence[str], progress: Callable[[float], None]
    ) -> tuple[Trial, list[Trial]]:
        """Add groups as long as left-out data confirm it; return the last model and all tried."""
        trials: list[Trial] = []
        part = 1.0
        while True:
            found = self.trials(chosen, [name for name in asked if name not in chosen.groups])
            trials += found
            better = [one for one in found if is_better(chosen.score, one.score)]
            part *= 0.6
            progress(1.0 - part)
            if not better:
                return chosen, trials
            chosen = _simplest_of_the_best(chosen, better)

    def bent(self, begin: Trial, asked: Sequence[str]) -> Trial | None:
        """Fit a model with all lags and the bends that it lacks; None if it lacks none."""
        lags = tuple(name for name in LAGS if name in asked)
        groups = (*begin.groups, *lags)
        typical = self._typical(begin, lags, self._candidates.typical)
        lagged = self.fit(groups, begin.posterior.state, begin.prior, typical)
        return next(iter(self.trials(lagged, [BEND])), None)

    def trials(self, chosen: Trial, absent: list[str]) -> list[Trial]:
        """Fit the chosen model plus each group with a large possible gain in log evidence."""
        if not absent:
            return []
        typical = self._candidates.typical
        columns = np.isin(self._names, absent) & typical.any(axis=0)
        inactive = self._regression.inactive(chosen.posterior, chosen.prior, columns)
        if BEND in absent:
            # At most 16 of the many bend columns are tried, chosen by forward selection.
            is_bend = self._names == BEND
            knees = inactive.chosen(typical, is_bend, TRIAL_GAIN, 16)
            typical = np.where(is_bend & ~knees, 0.0, typical)
        asked: list[tuple[str, ...]] = [(name,) for name in absent]
        together = (tuple(name for name in names if name in absent) for names in _TOGETHER)
        asked += [names for names in together if len(names) > 1]
        gains = {names: inactive.gain(typical, np.isin(self._names, names)) for names in asked}
        likely = [names for names in asked if gains[names] > TRIAL_GAIN]
        likely.sort(key=gains.__getitem__, reverse=True)
        tried = likely[:_TRIALS]
        if chosen.groups == (CURVE,) and (SET,) in likely[_TRIALS:]:
            # The paper's two sets are always tried.
            tried.append((SET,))
        state, prior = chosen.posterior.state, chosen.prior
        return [
            self.fit((*chosen.groups, *names), state, prior, self._typical(chosen, names, typical))
            for names in tried
        ]

    def _typical(self, chosen: Trial, names: tuple[str, ...], most: Floats) -> Floats:
        """
        Return the typical prior sd of a model with further groups.

        The sd of a new column corresponds to the RMS residual of the chosen model, up to `most`.
        """
        kelvins = self._regression.windows.kelvins
        moved = float(kelvins[0]) or 1.0
        left = float(
            np.sqrt(
                np.mean(
                    self._regression.residual(chosen.posterior.state, chosen.posterior.layout) ** 2
                )
            )
        )
        slope = left / moved
        units = np.array([[1.0], [1.0 / (self._regression.gravity or 1.0)]])
        own = np.minimum(slope * units * kelvins, most)
        return np.where(np.isin(self._names, names), own, chosen.typical)


def _likelier(fits: Sequence[Trial]) -> Trial:
    """
    Choose between fits begun with small and with large mountings: the one better on left-out data.

    If neither is, the large mountings must be likelier by `TRIAL_GAIN`. Both explain the norms of
    few positions, one by mountings, the other by misalignments; only the second predicts the norm
    of another position.
    """
    small, *others = fits
    for large in others:
        gain = large.log_density - small.log_density
        is_likelier = gain > TRIAL_GAIN and not is_better(large.score, small.score)
        if is_likelier or is_better(small.score, large.score):
            return large
    return small


def _simplest_of_the_best(before: Trial, better: Sequence[Trial]) -> Trial:
    """Return the model with the largest gain, or a smaller one that is not significantly worse."""
    best = max(better, key=lambda one: _gain(before.score, one.score))
    for one in sorted(better, key=lambda one: len(one.groups)):
        if one is best or not is_better(one.score, best.score):
            return one
    return best


def is_better(before: Score, after: Score, *, by_halves: bool = True) -> bool:
    """
    Whether the second model is better on left-out data by more than the standard error. Halves of
    the program limit the number of columns; they do not compare models of the same columns.
    """
    return _gain(before, after, by_halves=by_halves) > 0.0


def _gain(before: Score, after: Score, *, by_halves: bool = True) -> float:
    """
    Return the gain of a model if it exceeds its standard errors, else 0.

    It is the sum of the log gains of the drift. If the drifts are equal, the norms of left-out
    positions decide with a gain of two standard errors.
    """
    positions, sections, norms = _gains(before, after)
    drift = [one for one in (positions, sections) if one]
    is_worse_by_halves = by_halves and after.halves.rms > _MOST_BY_HALVES * before.halves.rms
    if (norms and norms[0] < -norms[1]) or is_worse_by_halves:
        return 0.0
    total = sum(gain for gain, _ in drift)
    if total > _EQUAL * len(drift) and all(gain > error for gain, error in drift):
        return total
    is_sure = norms is not None and norms[0] > max(2.0 * norms[1], _EQUAL)
    if is_sure and norms and all(abs(gain) < _EQUAL for gain, _ in drift):
        return norms[0]
    return 0.0


def _is_undecided(before: Score, after: Score) -> bool:
    """Whether left-out data do not decide: equal drifts, and no norms scored in both models."""
    *drift, norms = _gains(before, after)
    return norms is None and all(abs(one[0]) < _EQUAL for one in drift if one)


def _is_near(chosen: Score, other: Score) -> bool:
    """Whether a model is at most one standard error worse than the chosen one."""
    found = [one for one in _gains(chosen, other) if one]
    return bool(found) and all(gain > -error for gain, error in found)


def _gains(before: Score, after: Score) -> list[tuple[float, float] | None]:
    return [b.gain_of(a) for b, a in zip(before.kinds, after.kinds, strict=True)]
