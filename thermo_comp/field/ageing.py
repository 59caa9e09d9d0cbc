# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the ageing model of a unit: a Gaussian model of the errors at rest, with variances estimated
by evidence.

``|f| - g`` of rest i at time t_i after start k of the node is ``H_i delta + B_i b(t_i) + S_i
s(t_i) + B_i o_k + lack + e_i``: delta is the error of the calibration (its posterior), b and s are
random walks of bias and scale since the calibration, o_k is a bias offset, e independent noise.
Jumps of the levels, and a change of the curve, are added one at a time while the log Bayes factor
is high enough. The variances maximise the marginal likelihood, with wide priors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G
from .series import Series

#: Centres of the priors, relative to the turn-on offset: random walk per root day of bias, and of
#: scale times g; scatter of a rest. Sd of the logarithm of all priors: a factor of 5 either way.
_WALK_SHARE, _SCATTER_SHARE, _LOG_SD = 0.5, 0.3, 1.6
#: Smallest centre of the prior of the turn-on offset's sd [m/s^2].
_LEAST_TURN_ON = 5.0 * MICRO_G
#: Prior standard deviations tried for a jump of the levels [m/s^2].
_JUMPS = (50.0 * MICRO_G, 500.0 * MICRO_G, 5000.0 * MICRO_G)
#: Relative sizes of a jump in the biases and in the scales times g, which a shock changes less.
_JUMP_SHARES = np.repeat([1.0, 0.1], 3)
#: Prior standard deviations tried for a change of a curve's slope [m/s^2 per K].
_BENDS = (1.0 * MICRO_G, 10.0 * MICRO_G)
#: Largest number of rows (equations) per start of the node in the solution, and in the search for
#: the variances; largest number of all rows in the search, whose time grows with its cube.
_ROWS, _SEARCH_ROWS, _MOST_ROWS = 6, 3, 600


@dataclass(frozen=True)
class Ageing:
    """
    Standard deviations of the ageing model [m/s^2].

    bias, scale: random walk of the bias, and of the scale times g, per root day
    turn_on: bias offset of a start of the node
    rest: scatter from rest to rest
    """

    bias: float
    scale: float
    turn_on: float
    rest: float


@dataclass(frozen=True)
class Change:
    """
    A jump of the levels at `time` [days since 1970] or, if `time` is None, a change of the curve.
    """

    time: float | None
    sd: float
    log_bayes_factor: float

    def columns(self, rows: Rows) -> Floats:
        """Return the derivatives of the ageing model's rows by the change, (n, 6) or (n, 3)."""
        if self.time is None:
            return np.asarray(rows.by_level[:, :3] * rows.warmth[:, np.newaxis])
        is_after = (rows.time >= self.time)[:, np.newaxis]
        return np.asarray(rows.by_level * _JUMP_SHARES * is_after)


@dataclass(frozen=True)
class Rows:
    """
    Equations of the rests, in order of the starts, at most `_ROWS` of a start: orthogonal sums
    with all information of its rests about the six levels.

    noise, scatter: variance of the noise, and factor of the rests' scatter variance in a row
    rank: number of the row within its start
    warmth: board temperature less the reference temperature [K]
    """

    time: Floats
    start: Ints
    y: Floats
    by_parameter: Floats
    by_level: Floats
    lack: Floats
    warmth: Floats
    noise: Floats
    scatter: Floats
    rank: Ints

    def at(self, chosen: Bools) -> Rows:
        """Return the rows that a mask selects."""
        return Rows(**{name: value[chosen] for name, value in vars(self).items()})


def rows_of(series: Series, scatter: float) -> Rows:
    """Sum the rests of each start, weighted by their noise and an initial scatter [m/s^2]."""
    parts: list[tuple[Floats, ...]] = []
    variance = series.noise + scatter**2
    for start in np.unique(series.start):
        at = np.flatnonzero(series.start == start)
        weight = np.sqrt(variance[at].mean() / variance[at])
        Q = np.eye(len(at))
        if len(at) > _ROWS:
            Q = np.linalg.svd(series.by_level[at] * weight[:, np.newaxis], full_matrices=False)[0]
        # The factor Q of the singular value decomposition is orthogonal, so the sum of n equal
        # rests is sqrt(n) times a single rest.
        Q = Q * weight[:, np.newaxis]
        n, warmth = Q.shape[1], series.temperature[at].mean() - series.reference_temperature
        summed = (series.miss, series.by_parameter, series.by_level, series.lack)
        parts.append(
            (
                *(np.full(n, series.time[at].mean()), np.full(n, start)),
                *(Q.T @ column[at] for column in summed),
                np.full(n, warmth),
                *((Q**2).T @ series.noise[at], (Q**2).sum(axis=0)),
                np.arange(n),
            )
        )
    rows = Rows(*[np.concatenate(part) for part in zip(*parts, strict=True)])
    searched = rows.start[rows.rank < _SEARCH_ROWS]
    if len(searched) <= _MOST_ROWS:
        return rows
    # Older starts of the node have little information about the present state.
    return rows.at(rows.start > searched[-_MOST_ROWS])


class Model:
    """The covariance of the model's rows as a function of the variances, with given changes."""

    def __init__(
        self, rows: Rows, calibration: Calibration, since: float, changes: Sequence[Change] = ()
    ) -> None:
        posterior = calibration.posterior
        n = rows.by_parameter.shape[1]
        self.rows, self.changes, self.since = rows, tuple(changes), since
        self.prior = np.zeros((n, n)) if posterior is None else posterior.covariance()
        bias, scale = rows.by_level[:, :3], rows.by_level[:, 3:]
        age = np.maximum(rows.time - since, 0.0)
        elapsed = np.minimum.outer(age, age)
        along = bias @ bias.T
        is_same = rows.start[:, np.newaxis] == rows.start
        self.parts = [
            elapsed * along,
            elapsed * (scale @ scale.T),
            np.where(is_same, along, 0.0),
            np.diag(rows.scatter),
        ]
        # The lack of fit is correlated between temperatures that differ by less than about 10 K.
        near = np.exp(-0.5 * (np.subtract.outer(rows.warmth, rows.warmth) / 10.0) ** 2)
        self.base = rows.by_parameter @ self.prior @ rows.by_parameter.T
        self.base += near * (rows.lack @ rows.lack.T) + np.diag(rows.noise)
        for change in changes:
            columns = change.columns(rows)
            self.base += change.sd**2 * columns @ columns.T

    def covariance(self, ageing: Ageing) -> Floats:
        """Return the covariance of the model's rows."""
        result: Floats = self.base.copy()
        for sd, part in zip(vars(ageing).values(), self.parts, strict=True):
            result += sd**2 * part
        return result

    def fitted(self, centre: Ageing) -> tuple[Ageing, Floats]:
        """Maximise the posterior density of the variances; return also the inverse covariance."""
        middle = np.log(list(vars(centre).values()))

        def loss(logs: Floats) -> tuple[float, Floats]:
            sd = np.exp(logs)
            factor = cho_factor(self.covariance(Ageing(*sd)), lower=True)
            inverse = cho_solve(factor, np.eye(len(self.rows.y)))
            alpha = inverse @ self.rows.y
            away = (logs - middle) / _LOG_SD
            value = np.log(np.diag(factor[0])).sum() + 0.5 * (self.rows.y @ alpha + away @ away)
            slope = [
                v**2 * float((inverse * part).sum() - alpha @ part @ alpha)
                for v, part in zip(sd, self.parts, strict=True)
            ]
            return float(value), np.array(slope) + away / _LOG_SD

        # The evidence has almost no gradient where variances are small, so the search has two
        # initial points: all scatter is due to the starts, or all scatter to the random walks.
        steps = np.abs(np.diff(self.rows.y[self.rows.rank == 0]))
        step = max(float(np.median(steps)), centre.rest)
        bounds = middle - 5.0 * _LOG_SD, middle + 5.0 * _LOG_SD
        best = min(
            (
                minimize(
                    loss,
                    np.clip(np.log(step * np.array(shares)), *bounds),
                    jac=True,
                    method='L-BFGS-B',
                    bounds=list(zip(*bounds, strict=True)),
                    options={'maxiter': 30, 'ftol': 1e-5},
                )
                for shares in ((0.1, 0.1, 1.0, 0.3), (1.0, 1.0, 0.3, 0.1))
            ),
            key=lambda result: result.fun,
        )
        ageing = Ageing(*np.exp(best.x).tolist())
        return ageing, self.inverse(ageing)

    def inverse(self, ageing: Ageing) -> Floats:
        """Return the inverse covariance of the model's rows."""
        factor = cho_factor(self.covariance(ageing), lower=True)
        return np.asarray(cho_solve(factor, np.eye(len(self.rows.y))))


def usual(calibration: Calibration) -> Ageing:
    """Return the centre of the priors; its turn-on sd is the residual sd, or the noise in 1 Hz."""
    residual = max(axis.residual_sd_m_s2 for axis in calibration.static.axes())
    turn_on = max(residual or max(calibration.noise_density_m_s2_sqrt_hz), _LEAST_TURN_ON)
    walk = _WALK_SHARE * turn_on
    return Ageing(walk, walk, turn_on, _SCATTER_SHARE * turn_on)


def learn(series: Series, calibration: Calibration, since: float) -> tuple[Ageing, Model, Series]:
    """
    Estimate variances and changes by evidence, without starts that contradict all other starts.

    At most four changes are added, each with a log Bayes factor of at least 5. A start of the node
    is left out if one of its rows is more than 5 sd from the prediction by all other rows. Returns
    the variances, the model of all rows, and the rests used.
    """
    centre = usual(calibration)
    is_used = np.ones(len(series), dtype=np.bool_)
    for _ in range(2):
        used = series.at(is_used)
        rows = rows_of(used, centre.rest)
        few = rows.at(rows.rank < _SEARCH_ROWS)
        changes: tuple[Change, ...] = ()
        while True:
            model = Model(few, calibration, since, changes)
            ageing, inverse = model.fitted(centre)
            best = max(
                _candidates(model, inverse), key=lambda jump: jump.log_bayes_factor, default=None
            )
            if best is None or best.log_bayes_factor < 5.0 or len(changes) == 4:
                break
            changes += (best,)
        everything = Model(rows, calibration, since, changes)
        inverse = everything.inverse(ageing)
        left_out = (inverse @ rows.y) / np.sqrt(np.diag(inverse))
        bad = rows.start[np.abs(left_out) > 5.0]
        at = np.flatnonzero(is_used)
        is_bad = np.isin(used.start, bad)
        # If more than 10 % of the rests are outliers, the model is wrong, so all rests are kept.
        if not len(bad) or is_bad.sum() > 0.1 * len(used):
            break
        is_used[at[is_bad]] = False
    return ageing, everything, used


def _candidates(model: Model, inverse: Floats) -> Iterator[Change]:
    """
    Yield possible jumps before each start, and a change of the curve, with log Bayes factors.
    """
    rows = model.rows
    alpha, by_level = inverse @ rows.y, rows.by_level * _JUMP_SHARES
    _, first = np.unique(rows.start, return_index=True)
    n = len(first)
    precision = np.empty((n, n, 6, 6))
    for j in range(6):
        half = np.add.reduceat(inverse * by_level[:, j], first, axis=1)
        for i in range(6):
            precision[:, :, i, j] = np.add.reduceat(by_level[:, [i]] * half, first, axis=0)
    gradient = np.add.reduceat(by_level * alpha[:, np.newaxis], first, axis=0)
    # A jump before a start also shifts all later starts.
    after = np.cumsum(np.cumsum(precision[::-1, ::-1], axis=0), axis=1)[::-1, ::-1]
    gradient = np.cumsum(gradient[::-1], axis=0)[::-1]
    known = {change.time for change in model.changes}
    for k in range(n):
        time = float(rows.time[first[k]])
        for sd in _JUMPS if time not in known else ():
            gain = _log_bayes_factor(after[k, k], gradient[k], sd) - np.log(n * len(_JUMPS))
            yield Change(time, sd, gain)
    if None in known:
        return
    columns = Change(None, 1.0, 0.0).columns(rows)
    for sd in _BENDS:
        gain = _log_bayes_factor(columns.T @ inverse @ columns, columns.T @ alpha, sd)
        yield Change(None, sd, gain - float(np.log(len(_BENDS))))


def _log_bayes_factor(precision: Floats, gradient: Floats, sd: float) -> float:
    """
    Return the gain in log evidence by a change of prior sd `sd`, marginal over all other unknowns.
    """
    inner = np.eye(len(gradient)) + sd**2 * precision
    gain = 0.5 * sd**2 * gradient @ np.linalg.solve(inner, gradient)
    return float(gain - 0.5 * np.linalg.slogdet(inner)[1])


@dataclass(frozen=True)
class Solution:
    """
    Change of the file's parameters by the rests, and their covariances at the last rest.

    shift: change of the parameters
    prior, posterior: covariances before and after the rests
    future: covariance that is added during the time of use after the last rest
    gains, innovations: factors of the shift; estimates by fewer rows are partial sums
    """

    shift: Floats
    prior: Floats
    posterior: Floats
    future: Floats
    gains: Floats
    innovations: Floats

    def before(self, row: int) -> Floats:
        """Return the shift that follows from the first rows only."""
        return np.asarray(self.gains[:row].T @ self.innovations[:row])


def solve(model: Model, ageing: Ageing, to_file: Floats, bend: Floats, ahead: float) -> Solution:
    """
    Condition the parameters of the calibration on the rests.

    `to_file`: derivatives of the file's parameters by the six levels, (n_parameters, 6); `bend`:
    by a slope of each axis, (n_parameters, 3); `ahead`: time of use after the last rest [days].
    """
    rows = model.rows
    age = np.maximum(rows.time - model.since, 0.0)[:, np.newaxis]
    walk = np.repeat([ageing.bias**2, ageing.scale**2], 3)
    crossed = rows.by_parameter @ model.prior + (age * rows.by_level * walk) @ to_file.T
    prior = model.prior + (to_file * walk * float(age.max())) @ to_file.T
    for change in model.changes:
        onto = bend if change.time is None else to_file * _JUMP_SHARES
        crossed += change.sd**2 * change.columns(rows) @ onto.T
        prior += change.sd**2 * onto @ onto.T
    lower = np.linalg.cholesky(model.covariance(ageing))
    gains = solve_triangular(lower, crossed, lower=True)
    innovations = solve_triangular(lower, rows.y, lower=True)
    return Solution(
        gains.T @ innovations,
        prior,
        prior - gains.T @ gains,
        (to_file * walk * ahead) @ to_file.T,
        gains,
        innovations,
    )
