# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the choice of the model: candidates, held-out sections, the winner.

Held out are whole stretches of every bag between switches of the regime, never random samples:
neighbouring windows share their thermal history, so a random split would ask a model what it has
already seen. A candidate is trained on the rest and predicts the stretch, with the attitudes of
the training windows (or, for a position wholly held out, its own), inside the temperatures that
it was trained on. Ties go to the model with fewer parameters.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Bools, Floats, Ints
from ..unit.functions import Exponential
from .ladder import E_FOLDS_K, FUNCTION_NAMES, TERM_NAMES, golovach_spec, model_spec
from .model import ModelSpec
from .regression import Freedom, Outcome, regress
from .solution import Solution, predict, regressors
from .start import ConstantCalibration, starting_solution
from .table import WindowTable
from .two_sets import is_worth_a_bend, may_bend

N_FOLDS = 5
#: First guesses of the lags, relative to the bounds they must stay in.
_START_LAGS_S = {1: (600.0,), 2: (250.0, 1500.0)}
# A model must beat a smaller one by this much to be worth its parameters.
_TIE = 0.02
_PULL_SDS = 6.0
# A candidate that has not settled by then has lags that wander because nothing needs them.
_MAX_STEPS = 15


@dataclass(frozen=True)
class Candidate:
    """
    One model and how it did.

    Parameters
    ----------
    name : str
        The model.
    n_parameters : int
        Its size.
    fitted_rms : float
        RMS prediction error per axis on the windows it was fitted on [m/s^2].
    held_out_rms : float
        The same on held-out sections; NaN when it was not tried.
    bic : float
        Bayesian information criterion relative to the best candidate.
    is_chosen : bool
        Whether it was taken.

    """

    name: str
    n_parameters: int
    fitted_rms: float
    held_out_rms: float
    bic: float
    is_chosen: bool


@dataclass(frozen=True)
class Trial:
    """
    A candidate that has been fitted and tested.

    Parameters
    ----------
    spec : ModelSpec
        The model.
    outcome : Outcome
        Its fit on everything.
    fitted_rms : float
        RMS residual per axis of that fit [m/s^2].
    fold_squares, fold_counts : ndarray, shape (N_FOLDS,)
        Sum of squares and number of the held-out residuals.

    """

    spec: ModelSpec
    outcome: Outcome
    fitted_rms: float
    fold_squares: Floats
    fold_counts: Floats

    @property
    def held_out_rms(self) -> float:
        """
        RMS prediction error on the held-out sections [m/s^2]; NaN without any.

        """
        total = float(self.fold_counts.sum())
        return float(np.sqrt(self.fold_squares.sum() / total)) if total else np.nan


class Selector:
    """
    Tries candidates on one table and keeps what it has tried.

    Parameters
    ----------
    table : WindowTable
        Windows, coarse ones to be quick.
    gravity : float
        Local gravity.
    constant : ConstantCalibration
        First guess.
    freedom : Freedom
        What the regression may move.
    progress : callable
        Told the name of each candidate.
    transient_s : float or None, optional
        Time constant of warming-up [s], where it is modelled.

    """

    def __init__(
        self,
        table: WindowTable,
        gravity: float,
        constant: ConstantCalibration,
        freedom: Freedom,
        progress: Callable[[str], None],
        transient_s: float | None = None,
    ) -> None:
        self._table = table
        self._gravity = gravity
        self._constant = constant
        self._freedom = freedom
        self._progress = progress
        self._transient_s = transient_s
        self._folds = fold_numbers(table)
        self._trials: dict[str, Trial] = {}

    def try_model(self, spec: ModelSpec) -> Trial:
        """
        Fit a candidate on everything and on each set of training sections.

        """
        if spec.name not in self._trials:
            self._progress(spec.name)
            self._trials[spec.name] = self._tried(spec)
        return self._trials[spec.name]

    def choose(self) -> str:
        """
        Search the ladder: terms for a quadratic, then the function, then the terms once more.

        Returns
        -------
        str
            Name of the winner.

        """
        self.try_model(golovach_spec())
        function, terms = 'quadratic', ''
        for _ in range(3):
            before = function, terms
            terms = self._best([(function, t) for t in TERM_NAMES])[1]
            function = self._best([(f, terms) for f in FUNCTION_NAMES])[0]
            if (function, terms) == before:
                break
        if terms:
            name = _name(function, terms)
            self.try_model(model_spec(f'{name}@dynamic', self._table))
        return self._winner(list(self._trials.values())).spec.name

    def table_of(self, chosen: str) -> tuple[Candidate, ...]:
        """
        List what was tried, smallest first.

        Parameters
        ----------
        chosen : str
            Name of the model that was taken.

        Returns
        -------
        tuple of Candidate
            One per model.

        """
        trials = sorted(self._trials.values(), key=lambda t: (t.spec.n_parameters, t.spec.name))
        n = self._table.mean.size
        # The noise is what the best of them leaves.
        variance = min(trial.fitted_rms for trial in trials) ** 2
        bic = [n * t.fitted_rms**2 / variance + t.outcome.layout.n * np.log(n) for t in trials]
        return tuple(
            Candidate(
                trial.spec.name,
                trial.spec.n_parameters,
                trial.fitted_rms,
                trial.held_out_rms,
                float(value - min(bic)),
                trial.spec.name == chosen,
            )
            for trial, value in zip(trials, bic, strict=True)
        )

    def _bic(self, trial: Trial) -> float:
        n = self._table.mean.size
        return 2.0 * n * float(np.log(trial.fitted_rms)) + trial.outcome.layout.n * float(
            np.log(n)
        )

    def _best(self, pairs: Sequence[tuple[str, str]]) -> tuple[str, str]:
        by_name = {_name(*pair): pair for pair in pairs}
        trials = [self.try_model(model_spec(name, self._table)) for name in by_name]
        return by_name[self._winner(trials).spec.name]

    def _winner(self, trials: Sequence[Trial]) -> Trial:
        if not any(trial.fold_counts.sum() for trial in trials):
            return min(trials, key=self._bic)
        best = min(trials, key=lambda trial: trial.held_out_rms)
        tied = [trial for trial in trials if trial is best or _is_tie(trial, best)]
        return min(
            tied,
            key=lambda t: (t.spec.n_parameters, t.spec.live == 'dynamic', t.held_out_rms),
        )

    def _tried(self, spec: ModelSpec) -> Trial:
        near = self._trials.get(_name('quadratic', spec.name.partition('+')[2]))
        like = near.outcome.solution if near else None
        if isinstance(spec.static, Exponential):
            spec = self._best_e_fold(spec, like)
        outcome = self._fit(spec, like)
        if spec.dynamic is not None and may_bend(self._table):
            bent = self._fit(replace(spec, static=spec.dynamic), outcome.solution)
            outcome = bent if is_worth_a_bend(outcome, bent) else outcome
            spec = outcome.solution.spec
        scale = np.abs(outcome.solution.scale[:, 0])
        fitted = float(np.sqrt(np.mean((outcome.residual / scale) ** 2)))
        squares, counts = np.zeros(N_FOLDS), np.zeros(N_FOLDS)
        for fold in np.unique(self._folds[self._folds >= 0]):
            squares[fold], counts[fold] = self._held_out(outcome, self._folds == fold)
        return Trial(spec, outcome, fitted, squares, counts)

    def _fit(self, spec: ModelSpec, like: Solution | None) -> Outcome:
        return fit_model(
            self._table,
            spec,
            self._gravity,
            self._constant,
            self._freedom,
            like=like,
            transient_s=self._transient_s,
            max_steps=_MAX_STEPS,
        )

    def _best_e_fold(self, spec: ModelSpec, like: Solution | None) -> ModelSpec:
        tried = []
        for e_fold in E_FOLDS_K:
            one = replace(spec, static=Exponential(0.0, (0.0,), (e_fold,)))
            start = begin(self._table, one, self._gravity, self._constant, like, self._transient_s)
            held = replace(self._freedom, lags=False, start_memory=False)
            tried.append(regress(self._table, start, held, max_rounds=2, max_steps=5))
        best = min(tried, key=lambda outcome: float(np.mean(outcome.residual**2)))
        return best.solution.spec

    def _held_out(self, whole: Outcome, out: Bools) -> tuple[float, float]:
        """
        Sum of squares and number of the residuals of one fold, per axis, in m/s^2.

        """
        table = self._table
        training, judged = table.select(~out), table.select(out)
        trained = regress(
            training, whole.solution, self._freedom, max_rounds=1, max_steps=_MAX_STEPS
        ).solution
        lower, upper = float(np.min(training.t)), float(np.max(training.t))
        inside = (judged.t >= lower) & (judged.t <= upper)
        judged = judged.select(inside)
        if not len(judged.t):
            return 0.0, 0.0
        unseen = ~np.isin(judged.position, training.position)
        if unseen.any():
            only_attitudes = Freedom(
                misalignment=False, lags=False, start_memory=False, axes=False, transient=False
            )
            trained = regress(
                judged.select(unseen), trained, only_attitudes, max_rounds=1
            ).solution
        columns = regressors(judged, trained.spec, trained.time_constants_s, trained.start_memory)
        residual = (judged.mean - predict(judged, trained, columns)) / np.abs(trained.scale[:, 0])
        # A knock or a torn window must not decide between models.
        limit = _PULL_SDS * max(1.4826 * float(np.median(np.abs(residual))), 1e-12)
        return float(np.sum(np.clip(residual, -limit, limit) ** 2)), float(residual.size)


def fit_model(
    table: WindowTable,
    spec: ModelSpec,
    gravity: float,
    constant: ConstantCalibration,
    freedom: Freedom,
    *,
    like: Solution | None = None,
    transient_s: float | None = None,
    max_steps: int = 60,
) -> Outcome:
    """
    Fit one model.

    Parameters
    ----------
    table : WindowTable
        The windows.
    spec : ModelSpec
        The model.
    gravity : float
        Local gravity.
    constant : ConstantCalibration
        First guess.
    freedom : Freedom
        What may move.
    like : Solution or None, optional
        A similar model's fit, for a better first guess.
    transient_s : float or None, optional
        Time constant of warming-up [s], where it is modelled.
    max_steps : int, optional
        Bound of the Gauss-Newton steps of one round.

    Returns
    -------
    Outcome
        The fit.

    """
    start = begin(table, spec, gravity, constant, like, transient_s)
    if spec.n_lags:
        # With zero coefficients the lags feel nothing; these come first, at held lags.
        held = replace(freedom, lags=False, start_memory=False)
        start = regress(table, start, held, max_rounds=2, max_steps=10).solution
    return regress(table, start, freedom, max_steps=max_steps)


def begin(
    table: WindowTable,
    spec: ModelSpec,
    gravity: float,
    constant: ConstantCalibration,
    like: Solution | None,
    transient_s: float | None = None,
) -> Solution:
    """
    Make the start of a model's regression, from another model's fit where there is one.

    """
    lags = np.array(_START_LAGS_S.get(spec.n_lags, ()))
    if like is not None and len(like.time_constants_s) == spec.n_lags:
        lags = like.time_constants_s
    start = starting_solution(table, spec, gravity, constant, lags, transient_s)
    if like is None:
        return start
    start.bias[:, 0] = like.bias[:, 0]
    start.scale[:, 0] = like.scale[:, 0]
    if len(like.transient):
        start = replace(start, transient=like.transient, transient_s=like.transient_s)
    return replace(start, skew=like.skew, up=like.up, noise_sd=like.noise_sd)


def fold_numbers(table: WindowTable) -> Ints:
    """
    Assign each window to a fold: stretches of its bag between regime switches.

    Parameters
    ----------
    table : WindowTable
        The windows.

    Returns
    -------
    ndarray of int64, shape (n,)
        Fold of each window, below `N_FOLDS`. Sections are dealt out in turn, so that neighbours
        in time and temperature fall to different folds. The first section of a bag is -1, never
        held out: without it nothing would be known of the memory that the bag began with.


    """
    result = np.zeros(len(table.section), dtype=np.int64)
    for bag in np.unique(table.bag):
        rows = table.bag == bag
        _, number = np.unique(table.section[rows], return_inverse=True)
        result[rows] = np.where(number > 0, (number - 1) % N_FOLDS, -1)
    return result


def _is_tie(trial: Trial, best: Trial) -> bool:
    """
    Whether the best is better by no more than chance between folds, or than matters.

    """
    if trial.held_out_rms <= (1.0 + _TIE) * best.held_out_rms:
        return True
    used = (trial.fold_counts > 0) & (best.fold_counts > 0)
    gain = (trial.fold_squares - best.fold_squares)[used] / best.fold_counts[used]
    if len(gain) < 3:
        return False
    return bool(gain.mean() < gain.std(ddof=1) / np.sqrt(len(gain)))


def _name(function: str, terms: str) -> str:
    return f'{function}+{terms}' if terms else function
