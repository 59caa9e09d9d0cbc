# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the model: groups of columns are added to the constants one at a time.

The log evidence ranks the groups to be tried; the score on left-out data decides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .comparison import is_better, is_near, is_undecided
from .growth import (
    LAGS,
    PART_CURVE,
    TRIAL_GAIN,
    Candidates,
    Growth,
    Trial,
    likelier,
    pruned_fit,
    settled,
)
from .hyperparameters import downweigh, white_noise
from .left_out import Score, score_of
from .regression import Posterior, Regression
from .unknowns import InformativePrior, Noise, Prior, State
from .windows import BEND, CURVE

# Largest left-out drift, relative to the noise, of a model that lacks nothing.
_AT_NOISE = 2.0
# Largest left-out drift, relative to the chosen model's, of a model of bends that is continued.
_PROMISING = 3.0


@dataclass(frozen=True)
class Selected:
    """The chosen model: its fit, its left-out score, and all models that were tried."""

    posterior: Posterior
    prior: Prior
    score: Score
    trials: tuple[Trial, ...]


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
    grow = Growth(regression, candidates, names)
    # Without a curve the drift is attributed to mountings or to noise: start from both.
    begun = [prior]
    if prior.offset_scale > 0.0:
        begun.append(replace(prior, offset_sd=float(prior.sigma.mean())))
    fits = [grow.fit(forced, state, one, candidates.typical) for one in begun]
    constants = chosen = likelier(fits)
    trials = [constants]
    if CURVE in asked:
        # The curve is added without a test: it may improve the score only with other groups.
        groups = *forced, CURVE
        curve = likelier(
            [grow.fit(groups, fit.posterior.state, fit.prior, fit.typical) for fit in fits]
        )
        downweigh(regression, curve.posterior, curve.prior)
        chosen = grow.fit(groups, curve.posterior.state, curve.prior, curve.typical)
        trials.append(chosen)
    begin = chosen
    if regression.windows.has_part_lags:
        found = grow.bent(begin, asked, PART_CURVE)
        trials += found
        for one in found:
            if is_better(chosen.score, one.score):
                chosen = one
    chosen, found = grow.added(chosen, asked, progress)
    trials += found
    noise = float(chosen.prior.sigma.mean())
    if BEND in asked and BEND not in chosen.groups and chosen.score.rms > _AT_NOISE * noise:
        # The slopes of a part that lags are seen only beside its lag, not beside a stand-in of
        # products and squares.
        _, *bent = grow.bent(begin, asked, LAGS)
        if bent and bent[0].score.rms < _PROMISING * chosen.score.rms:
            trials += bent
            more, found = grow.added(bent[0], asked, progress)
            trials += found
            if is_better(chosen.score, more.score):
                chosen = more
    if chosen is not constants and not is_better(constants.score, chosen.score):
        gain = chosen.posterior.log_evidence - constants.posterior.log_evidence
        if not is_undecided(constants.score, chosen.score) or gain < TRIAL_GAIN:
            chosen = constants
    settled = replace(candidates, typical=chosen.typical)
    posterior, prior, score = finish(regression, chosen.posterior, chosen.prior, settled)
    return Selected(posterior, prior, score, _marked(trials, chosen, score))


def _marked(trials: Sequence[Trial], chosen: Trial, score: Score) -> tuple[Trial, ...]:
    """Mark the chosen model, with its final score, and those within one standard error of it."""
    marked = []
    for trial in trials:
        is_chosen = trial.groups == chosen.groups
        near = not is_chosen and is_near(chosen.score, trial.score)
        kept = replace(trial, score=score) if is_chosen else trial
        marked.append(replace(kept, is_chosen=is_chosen, is_near=near))
    return tuple(marked)


def fit_all(
    regression: Regression,
    state: State,
    prior: Prior,
    candidates: Candidates,
    informative: Sequence[InformativePrior] = (),
) -> Selected:
    """Fit all columns; of several informative priors take that of the largest log evidence."""
    posterior, prior = settled(regression, state, prior, candidates)
    downweigh(regression, posterior, prior)
    posterior, prior = settled(regression, posterior.state, prior, candidates)
    if informative:
        tried = [
            regression.solve(posterior.state, replace(prior, informative=candidate), n_steps=3)
            for candidate in informative
        ]
        best = int(np.argmax([one.log_evidence for one in tried]))
        prior = replace(prior, informative=informative[best])
        posterior, prior = settled(regression, tried[best].state, prior, candidates)
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
    white = pruned_fit(
        regression, *settled(regression, posterior.state, prior, candidates), candidates
    )
    score = score_of(regression, *white)
    slow = _with_slow_noise(regression, *white, candidates)
    if slow[1].noise != white[1].noise:
        slow = pruned_fit(regression, *slow, candidates)
        found = score_of(regression, *slow)
        if not is_better(found, score):
            return *slow, found
    return *white, score


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
    return settled(regression, refined.state, found, candidates)
