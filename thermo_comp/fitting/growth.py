# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fits of models of some groups of columns, each begun from the fit of a smaller model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Bools, Floats
from .comparison import gain, is_better
from .hyperparameters import log_density, pruned, settle
from .left_out import Score, score_of
from .regression import Posterior, Regression
from .unknowns import Prior, State
from .windows import BEND, CURVE, SET

#: Smallest possible gain in log evidence of a group that is tried: odds of e^4 = 55 to one.
TRIAL_GAIN = 4.0
# Largest number of groups tried in a round.
_TRIALS = 3
# Largest number of bend columns: for all axes with a bank of lags; with the lags of their parts a
# score for each axis, as around a bump.
_MOST_BENDS = 16, 60
#: Groups of the curve of parts that lag the board: a polynomial in t - m, m the lag.
PART_CURVE = ('board', 'product', 'square')
#: Groups that are linear in a temperature difference.
LAGS = ('gradient', 'board', 'gradient_lag')
# Groups that are tried together, because one effect has columns in all of them: the curve of a
# part that lags by m is (t - m)^2 = t^2 - 2 t m + m^2, m from the board or from the gradient.
_TOGETHER = (('product', 'square'), (*LAGS, 'product', 'gradient_x_temperature', 'square'))
#: Smallest log Bayes factor of a column that is kept: below 1 the evidence is "not worth more than
#: a bare mention" (Kass and Raftery, Bayes factors, JASA 90 (1995), section 3.2).
LEAST_GAIN = 1.0


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


def pruned_fit(
    regression: Regression,
    posterior: Posterior,
    prior: Prior,
    candidates: Candidates,
    rounds: int = 25,
) -> tuple[Posterior, Prior]:
    """Drop columns with too little gain, as long as the log evidence of the new fit agrees."""
    while True:
        fewer = pruned(regression, posterior, prior, candidates.kept, LEAST_GAIN)
        if np.array_equal(fewer.column_sd, prior.column_sd):
            return posterior, prior
        found = settled(regression, posterior.state, fewer, candidates, rounds)
        if found[0].log_evidence < posterior.log_evidence - LEAST_GAIN:
            return posterior, prior
        posterior, prior = found


def settled(
    regression: Regression, state: State, prior: Prior, candidates: Candidates, rounds: int = 25
) -> tuple[Posterior, Prior]:
    """Fit a model with the priors that its candidate columns have; see `settle`."""
    return settle(
        regression, state, prior, candidates.typical, candidates.largest, candidates.fixed, rounds
    )


class Growth:
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
        posterior, prior = settled(self._regression, state, prior, candidates, 6)
        posterior, prior = pruned_fit(self._regression, posterior, prior, candidates, 8)
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
            chosen = simplest_of_the_best(chosen, better)

    def bent(self, begin: Trial, asked: Sequence[str], groups: Sequence[str]) -> list[Trial]:
        """Fit a model with some groups, and then the bends that it lacks."""
        more = tuple(name for name in groups if name in asked)
        typical = self._typical(begin, more, self._candidates.typical)
        first = self.fit((*begin.groups, *more), begin.posterior.state, begin.prior, typical)
        bent = self.trials(first, [BEND]) if BEND in asked else []
        return [first, *bent]

    def trials(self, chosen: Trial, absent: list[str]) -> list[Trial]:
        """Fit the chosen model plus each group with a large possible gain in log evidence."""
        if not absent:
            return []
        typical = self._candidates.typical
        columns = np.isin(self._names, absent) & typical.any(axis=0)
        inactive = self._regression.inactive(chosen.posterior, chosen.prior, columns)
        if BEND in absent:
            # Some of the many bend columns are tried, chosen by forward selection.
            is_bend = self._names == BEND
            most = _MOST_BENDS[self._regression.windows.has_part_lags]
            knees = inactive.chosen(typical, is_bend, TRIAL_GAIN, most)
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


def likelier(fits: Sequence[Trial]) -> Trial:
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


def simplest_of_the_best(before: Trial, better: Sequence[Trial]) -> Trial:
    """Return the model with the largest gain, or a smaller one that is not significantly worse."""
    best = max(better, key=lambda one: gain(before.score, one.score))
    for one in sorted(better, key=lambda one: len(one.groups)):
        if one is best or not is_better(one.score, best.score):
            return one
    return best
