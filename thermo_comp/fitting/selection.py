# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the model: it grows from constants, one group of columns at a time.

The log evidence says which groups are worth a trial; the left-out score says whether a group
stays. It stays if the correction of data that took no part improves by more than its standard
error over the folds, for positions and for sections of the program alike: a group that only
explains one recording, or one program, fails one of the two.

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
from .hyperparameters import downweigh, pruned, settle, white_noise
from .left_out import Score, score_of
from .regression import Posterior, Regression
from .unknowns import InformativePrior, Noise, Prior, State
from .windows import BEND, CURVE, SET

# A group is worth a trial if it could add this to the log evidence: e^4 = 55 to one.
_WORTH_A_TRIAL = 4.0
# So many groups are tried in a round, the most promising first.
_TRIALS = 3
# Groups that one law of physics needs together: parts that lag by m have the curve of their own
# temperature, (t - m)^2 = t^2 - 2 t m + m^2; where m is of the flow between two thermometers, the
# product is mixed.
#: Groups that are linear in a temperature difference.
LAGS = ('gradient', 'board', 'gradient_lag')
_TOGETHER = (('product', 'square'), (*LAGS, 'product', 'gradient_x_temperature', 'square'))
# So many columns of knees are asked for in a round.
_MOST_BENDS = 16
# The noise is sought in steps of this factor, then of its roots; its white part follows in so many
# rounds.
_NOISE_STEP, _NOISE_ROUNDS = 3.0, 2
# A column of the chosen model stays if the log evidence falls by this without it: less is worth no
# more than a bare mention (Kass and Raftery, Bayes factors, JASA 90 (1995), section 3.2).
_LEAST_GAIN = 1.0
# Logarithms of mean squares that differ by less than this are equal: 5 % of an RMS.
_EQUAL = 0.1
# The RMS error of the two halves may rise by this factor: two folds scatter by a quarter.
_MOST_BY_HALVES = 1.25
# Norms of left-out positions alone decide for a group if they gain so many standard errors.
_SURE_ERRORS = 2.0


@dataclass(frozen=True)
class Trial:
    """
    A model that was looked at.

    groups: its groups of columns; () for constants
    score: its left-out errors
    posterior, prior: its fit
    typical: widths that the priors of its columns centre on, shape (2, m)
    is_chosen: whether it is the one
    is_near: whether it is as good as the chosen one within the standard error of their difference
    """

    groups: tuple[str, ...]
    score: Score
    posterior: Posterior
    prior: Prior
    typical: Floats
    is_chosen: bool = False
    is_near: bool = False


@dataclass(frozen=True)
class Selected:
    """The chosen model: its fit, its left-out score, and all models that were looked at."""

    posterior: Posterior
    prior: Prior
    score: Score
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Candidates:
    """
    What may take part.

    typical, largest: widths that the prior of each column centres on and never exceeds, in units
        of its RMS, shape (2, m); 0 for a column that may not take part
    forced: columns that stay whatever they gain, shape (m,)
    fixed: columns that keep their width and their place, shape (2, m)
    """

    typical: Floats
    largest: Floats
    forced: Bools
    fixed: Bools

    @property
    def kept(self) -> Bools:
        """Which columns are never dropped, shape (2, m)."""
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
    # Drift looks like mountings, or like noise, as long as there is no curve: two beginnings.
    begun = [prior]
    if prior.offset_scale > 0.0:
        begun.append(replace(prior, offset_sd=float(prior.sigma.mean())))
    fits = [grow.fit(forced, state, one, candidates.typical) for one in begun]
    constants = chosen = _likeliest(fits)
    trials, round_number = [constants], 0
    if CURVE in asked:
        # All else is relative to a curve, which may help only together with it.
        groups = *forced, CURVE
        curve = _likeliest(
            [grow.fit(groups, fit.posterior.state, fit.prior, fit.typical) for fit in fits]
        )
        downweigh(regression, curve.posterior, curve.prior)
        chosen = grow.fit(groups, curve.posterior.state, curve.prior, curve.typical)
        trials.append(chosen)
    while True:
        found = grow.trials(chosen, [name for name in asked if name not in chosen.groups])
        trials += found
        better = [one for one in found if is_better(chosen.score, one.score)]
        round_number += 1
        progress(1.0 - 0.6**round_number)
        if not better:
            break
        chosen = _simplest_of_the_best(chosen, better)
    if chosen is not constants and not is_better(constants.score, chosen.score):
        gain = chosen.posterior.log_evidence - constants.posterior.log_evidence
        if not _is_open(constants.score, chosen.score) or gain < _WORTH_A_TRIAL:
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
    """Fit all columns that may take part; of priors of the unit the likeliest is taken."""
    posterior, prior = _settle(regression, state, prior, candidates)
    downweigh(regression, posterior, prior)
    posterior, prior = _settle(regression, posterior.state, prior, candidates)
    if informative:
        tried = [
            regression.solve(posterior.state, replace(prior, informative=one), n_steps=3)
            for one in informative
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
    Settle the chosen model: knocks, columns that gain too little, and slow noise.

    Exponentially correlated noise explains as well what the model misses of the temperature: it is
    kept only if the correction of left-out data is no worse with it.
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
    """Drop columns that gain too little, as long as the log evidence agrees once they are gone."""
    while True:
        fewer = pruned(posterior, prior, candidates.kept, _LEAST_GAIN)
        if np.array_equal(fewer.column_sd, prior.column_sd):
            return posterior, prior
        found = _settle(regression, posterior.state, fewer, candidates, rounds)
        if found[0].log_evidence < posterior.log_evidence - _LEAST_GAIN:
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
    """Estimate the exponentially correlated noise from the residuals, and settle with it."""
    residual = regression.residual(posterior.state, posterior.layout) / prior.sigma
    best = regression.whitener.estimate(residual, regression.weight)
    if best == prior.noise:
        return posterior, prior

    def with_noise(noise: Noise) -> tuple[Posterior, Prior]:
        trial = replace(prior, noise=noise)
        for _ in range(_NOISE_ROUNDS):
            looked = regression.solve(posterior.state, trial, n_steps=1)
            trial = replace(trial, sigma=white_noise(regression, looked))
        return looked, trial

    # Residuals lack what the parameters took of the noise; the log evidence counts it.
    looked, found = with_noise(best)
    step = _NOISE_STEP
    while step > _NOISE_STEP**0.2:
        around = [
            with_noise(Noise(best.ratio * ratio, best.time_s * time))
            for ratio, time in ((step, 1.0), (1.0 / step, 1.0), (1.0, step), (1.0, 1.0 / step))
            if regression.whitener.shows(best.time_s * time)
        ]
        nearby = max(around, key=lambda one: one[0].log_evidence)
        if nearby[0].log_evidence > looked.log_evidence:
            looked, found = nearby
            best = found.noise
        else:
            step = step**0.5
    return _settle(regression, looked.state, found, candidates)


class _Growth:
    """Fits models of some groups, each beginning from the fit of a smaller one."""

    def __init__(self, regression: Regression, candidates: Candidates, names: Floats) -> None:
        self._regression = regression
        self._candidates = candidates
        self._names = names

    def fit(self, groups: tuple[str, ...], state: State, prior: Prior, typical: Floats) -> Trial:
        """Fit a model; columns that a smaller model dropped are asked again."""
        candidates = replace(self._candidates, typical=typical)
        wanted = np.isin(self._names, groups)
        begin = np.where(prior.column_sd > 0.0, prior.column_sd, typical)
        prior = replace(prior, column_sd=np.where(wanted, begin, 0.0))
        posterior, prior = _settle(self._regression, state, prior, candidates, 6)
        posterior, prior = _pruned(self._regression, posterior, prior, candidates, 8)
        score = score_of(self._regression, posterior, prior)
        return Trial(groups, score, posterior, prior, typical)

    def trials(self, chosen: Trial, absent: list[str]) -> list[Trial]:
        """Fit the groups that could add most to the log evidence, each beside the chosen ones."""
        if not absent:
            return []
        typical = self._candidates.typical
        columns = np.isin(self._names, absent) & typical.any(axis=0)
        inactive = self._regression.inactive(chosen.posterior, chosen.prior, columns)
        if BEND in absent:
            # Of many knees few are asked for: those that the data show one after another.
            is_bend = self._names == BEND
            knees = inactive.chosen(typical, is_bend, _WORTH_A_TRIAL, _MOST_BENDS)
            typical = np.where(is_bend & ~knees, 0.0, typical)
        asked: list[tuple[str, ...]] = [(name,) for name in absent]
        together = (tuple(name for name in names if name in absent) for names in _TOGETHER)
        asked += [names for names in together if len(names) > 1]
        gains = {names: inactive.gain(typical, np.isin(self._names, names)) for names in asked}
        likely = [names for names in asked if gains[names] > _WORTH_A_TRIAL]
        likely.sort(key=gains.__getitem__, reverse=True)
        tried = likely[:_TRIALS]
        if chosen.groups == (CURVE,) and (SET,) in likely[_TRIALS:]:
            # The paper's two sets are always looked at.
            tried.append((SET,))
        state, prior = chosen.posterior.state, chosen.prior
        return [
            self.fit((*chosen.groups, *names), state, prior, self._typical(chosen, names, typical))
            for names in tried
        ]

    def _typical(self, chosen: Trial, names: tuple[str, ...], most: Floats) -> Floats:
        """
        Typical widths once a group is added: those of its columns explain what is left, and are
        `most` at most.
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


def _likeliest(fits: Sequence[Trial]) -> Trial:
    return max(fits, key=lambda fit: fit.posterior.log_evidence)


def _simplest_of_the_best(before: Trial, better: Sequence[Trial]) -> Trial:
    """Take the largest gain, or of smaller models the first that is as good within the error."""
    best = max(better, key=lambda one: _gain(before.score, one.score))
    for one in sorted(better, key=lambda one: len(one.groups)):
        if one is best or not is_better(one.score, best.score):
            return one
    return best


def is_better(before: Score, after: Score) -> bool:
    """Whether left-out data show a model to be better, by more than their standard error."""
    return _gain(before, after) > 0.0


def _gain(before: Score, after: Score) -> float:
    """
    Return the sum of log gains of the drift if a model is better by more than the errors, else 0.
    """
    positions, sections, norms = _gains(before, after)
    drift = [one for one in (positions, sections) if one]
    is_worse_by_halves = after.halves.rms > _MOST_BY_HALVES * before.halves.rms
    if (norms and norms[0] < -norms[1]) or is_worse_by_halves:
        return 0.0
    total = sum(gain for gain, _ in drift)
    if total > _EQUAL * len(drift) and all(gain > error for gain, error in drift):
        return total
    is_sure = norms is not None and norms[0] > max(_SURE_ERRORS * norms[1], _EQUAL)
    if is_sure and norms and all(abs(gain) < _EQUAL for gain, _ in drift):
        return norms[0]
    return 0.0


def _is_open(before: Score, after: Score) -> bool:
    """Whether left-out data cannot tell: the drifts are equal, no norms are left out in common."""
    *drift, norms = _gains(before, after)
    return norms is None and all(abs(one[0]) < _EQUAL for one in drift if one)


def _is_near(chosen: Score, other: Score) -> bool:
    """Whether another model differs from the chosen one by no more than one standard error."""
    found = [one for one in _gains(chosen, other) if one]
    return bool(found) and all(gain > -error for gain, error in found)


def _gains(before: Score, after: Score) -> list[tuple[float, float] | None]:
    return [b.gain_of(a) for b, a in zip(before.kinds, after.kinds, strict=True)]
