# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the ageing model of a unit: a Gaussian model of ``|f| - g`` at rest, fitted by evidence.

``|f| - g`` of rest i at time t_i, recorded after start k of the node, is ``H_i delta + B_i b(t_i)
+ S_i s(t_i) + B_i o_k + L_i l_k + lack + e_i``: delta is the error of the calibration parameters,
with the calibration's covariance; b and s are random walks of bias and scale since the
calibration, o_k is the bias offset of start k, l_k are the unknown lag states at start k, lack is
the lack of fit of the calibration, e_i is independent noise. The matrices H_i, B_i, S_i and L_i
are derivatives of ``|f|`` by parameters, bias, scale and lag states. The slopes of the bias over
temperature are random walks of a fixed sd per root day. Jumps of the levels (bias and scale of
each axis) or of gravity, and a change of the slope of the bias over temperature, are added one at
a time, up to four, while the log Bayes factor of the next change is at least 5. The variances of
random walks, offsets, lag states and scatter maximise the marginal likelihood times wide priors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G
from .series import RestSeries

_LEAST_TURN_ON = 5.0 * MICRO_G  # smallest prior median of the sd of the turn-on offset [m/s^2]
_WALK_SHARE = 0.5  # sd of a random walk per root day / sd of the turn-on offset, prior medians
_SCATTER_SHARE = 0.3  # sd of the scatter of rests / sd of the turn-on offset, prior medians
_LOG_SD = 1.6  # prior sd of the natural logarithm of each sd in `Ageing`: a factor of 5
#: Prior sds tried for a jump of biases and scales (times g), or of gravity [m/s^2].
_JUMPS = (50.0 * MICRO_G, 500.0 * MICRO_G, 5000.0 * MICRO_G)
#: Prior sd of a jump in the three biases, and in the three scales times g, relative to `_JUMPS`: a
#: shock changes a scale times g less than a bias.
_JUMP_SHARES = np.repeat([1.0, 0.1], 3)
_LEAST_GAIN = 5.0  # smallest log Bayes factor of a change that is added (odds 150:1)
_LEAST_LEAD = 3.0  # smallest log Bayes factor of a gravity jump against other changes (odds 20:1)
_BENDS = (1.0 * MICRO_G, 10.0 * MICRO_G)  # prior sds of a change of the bias slopes [m/s^2 per K]
#: Sd of the random walk of the slopes of the bias curves [m/s^2 per K per root day]: after one
#: year, the sd is the smallest of `_BENDS`.
_SLOPE_WALK = _BENDS[0] / np.sqrt(365.25)
_ROWS = 6  # largest number of rows (equations) per start of the node, in `solve`
_SEARCH_ROWS = 3  # largest number of rows per start in the search for the variances
_MOST_ROWS = 600  # largest number of rows in the search; computing time grows with their cube

_Kind: TypeAlias = Literal['levels', 'gravity', 'curve']


@dataclass(frozen=True)
class Ageing:
    """
    Standard deviations of the ageing model [m/s^2], and the ratio `lags`.

    bias, scale: sd of the random walk of the bias, and of the scale times g, per root day
    turn_on: sd of the bias offset of a start of the node
    rest: sd of the scatter from rest to rest
    lags: ratio of the sd of the lag states at a start to the sd that the calibration assumes
    """

    bias: float
    scale: float
    turn_on: float
    rest: float
    lags: float = 0.0


@dataclass(frozen=True)
class Change:
    """
    A jump of levels (bias, and scale times g, of each axis) or of gravity at `time` [days since
    1970], or a change of the slopes of the bias over temperature.

    time: time of a jump; None for a change of the slopes, which holds for all rests
    sd: prior sd of the change of a level or of gravity [m/s^2], or of a slope [m/s^2 per K]
    may_be_gravity: whether a gravity jump is about as probable as this jump of levels
    """

    kind: _Kind
    time: float | None
    sd: float
    log_bayes_factor: float
    may_be_gravity: bool = False

    def columns(self, rows: Rows) -> Floats:
        """Return derivatives of `rows.y` by levels (n, 6), gravity (n, 1) or slopes (n, 3)."""
        if self.time is None:
            return rows.by_slope
        of_jump = rows.by_jump[:, 6:] if self.kind == 'gravity' else rows.by_jump[:, :6]
        return np.asarray(of_jump * (rows.time >= self.time)[:, np.newaxis])


@dataclass(frozen=True)
class Rows:
    """
    Up to `_ROWS` equations per start of the node, in the order of starts: orthogonal combinations
    of the rests of a start, with all information of the rests about bias and scale.

    y, `by_...`, lack: combined ``|f| - g`` [m/s^2], its derivatives, and `RestSeries.lack`
    noise: variance of a row due to noise
    scatter: variance of a row due to the scatter of rests / scatter variance of one rest
    rank: number of the row among the rows of its start, from 0
    above_reference: mean board temperature of a start's rests less the reference temperature [K]
    """

    time: Floats
    start: Ints
    y: Floats
    by_parameter: Floats
    by_level: Floats
    by_gravity: Floats
    by_start: Floats
    lack: Floats
    above_reference: Floats
    noise: Floats
    scatter: Floats
    rank: Ints

    @property
    def by_slope(self) -> Floats:
        """Derivatives of `y` by the slopes of the bias over temperature, (n, 3)."""
        return np.asarray(self.by_level[:, :3] * self.above_reference[:, np.newaxis])

    @property
    def by_jump(self) -> Floats:
        """Derivatives of `y` by levels, times `_JUMP_SHARES`, and by gravity, (n, 7)."""
        return np.column_stack((self.by_level * _JUMP_SHARES, self.by_gravity))

    def at(self, chosen: Bools) -> Rows:
        """Return the rows that a mask selects."""
        return Rows(**{name: value[chosen] for name, value in vars(self).items()})


def rows_of(series: RestSeries, scatter: float) -> Rows:
    """Combine the rests of each start to `Rows`; `scatter`: sd of the scatter of rests [m/s^2]."""
    parts: list[list[Floats]] = []
    variance = series.noise + (series.by_start**2).sum(axis=1) + scatter**2
    for start in np.unique(series.start):
        at = np.flatnonzero(series.start == start)
        weight = np.sqrt(variance[at].mean() / variance[at])
        Q = np.eye(len(at))
        if len(at) > _ROWS:
            Q = np.linalg.svd(series.by_level[at] * weight[:, np.newaxis], full_matrices=False)[0]
        # Orthonormal columns of Q turn n equal rests into the equation of one rest times sqrt(n).
        Q = Q * weight[:, np.newaxis]
        n, t = Q.shape[1], series.temperature[at].mean() - series.reference_temperature
        # A change of gravity changes |f| by the same value in all attitudes.
        derivatives = (series.by_parameter, series.by_level, np.ones(len(series)), series.by_start)
        summed = (series.residual, *derivatives, series.lack)
        part = [np.full(n, series.time[at].mean()), np.full(n, start)]
        part += [*(Q.T @ column[at] for column in summed), np.full(n, t)]
        parts.append([*part, (Q**2).T @ series.noise[at], (Q**2).sum(axis=0), np.arange(n)])
    rows = Rows(*[np.concatenate(part) for part in zip(*parts, strict=True)])
    searched = rows.start[rows.rank < _SEARCH_ROWS]
    if len(searched) <= _MOST_ROWS:
        return rows
    # The oldest starts are left out: they have little information about present bias and scale.
    return rows.at(rows.start > searched[-_MOST_ROWS])


class Model:
    """Covariance of `rows.y` as a function of `Ageing`; random walks begin at day `since`."""

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
            np.where(is_same, rows.by_start @ rows.by_start.T, 0.0),
        ]
        # The correlation of the lack of fit at two temperatures is a Gaussian function of their
        # difference, with an sd of 10 K.
        t = rows.above_reference
        correlation = np.exp(-0.5 * (np.subtract.outer(t, t) / 10.0) ** 2)
        self.base = rows.by_parameter @ self.prior @ rows.by_parameter.T
        self.base += correlation * (rows.lack @ rows.lack.T) + np.diag(rows.noise)
        self.base += _SLOPE_WALK**2 * elapsed * (rows.by_slope @ rows.by_slope.T)
        for change in changes:
            columns = change.columns(rows)
            self.base += change.sd**2 * columns @ columns.T

    def covariance(self, ageing: Ageing) -> Floats:
        """Return the covariance of the rows."""
        result: Floats = self.base.copy()
        for sd, part in zip(vars(ageing).values(), self.parts, strict=True):
            result += sd**2 * part
        return result

    def fitted(self, centre: Ageing) -> tuple[Ageing, Floats]:
        """Return the most probable sds, and the inverse covariance of `rows.y` for these sds."""
        middle = np.log(list(vars(centre).values()))

        def loss(logs: Floats) -> tuple[float, Floats]:
            sd = np.exp(logs)
            factor, inverse = self._factor(Ageing(*sd))
            alpha = inverse @ self.rows.y
            shift = (logs - middle) / _LOG_SD
            value = np.log(np.diag(factor)).sum() + 0.5 * (self.rows.y @ alpha + shift @ shift)
            pairs = zip(sd, self.parts, strict=True)
            slope = [v**2 * float((inverse * P).sum() - alpha @ P @ alpha) for v, P in pairs]
            return float(value), np.array(slope) + shift / _LOG_SD

        # The gradient of the evidence is almost 0 where a variance is small, so two searches
        # begin with variances that assign the steps of |f| - g between starts of the node mainly
        # to turn-on offsets, or mainly to random walks.
        steps = np.abs(np.diff(self.rows.y[self.rows.rank == 0]))
        step = max(float(np.median(steps)), centre.rest)
        bounds = middle - 5.0 * _LOG_SD, middle + 5.0 * _LOG_SD
        search: dict[str, Any] = {'method': 'L-BFGS-B', 'bounds': list(zip(*bounds, strict=True))}
        search['options'] = {'maxiter': 30, 'ftol': 1e-5}
        results = []
        for shares in ((0.1, 0.1, 1.0, 0.3), (1.0, 1.0, 0.3, 0.1)):
            begin = np.clip(np.log([*(step * np.array(shares)), centre.lags]), *bounds)
            results.append(minimize(loss, begin, jac=True, **search))
        ageing = Ageing(*np.exp(min(results, key=lambda result: result.fun).x).tolist())
        return ageing, self.inverse(ageing)

    def inverse(self, ageing: Ageing) -> Floats:
        """Return the inverse of `covariance`."""
        return self._factor(ageing)[1]

    def _factor(self, ageing: Ageing) -> tuple[Floats, Floats]:
        """Return the lower Cholesky factor of `covariance`, and its inverse."""
        factor = cho_factor(self.covariance(ageing), lower=True)
        return factor[0], np.asarray(cho_solve(factor, np.eye(len(self.rows.y))))

    def log_covariance(self, ageing: Ageing) -> Floats:
        """Return the covariance of the log sds of `Ageing`, from Fisher information and prior."""
        inverse = self.inverse(ageing)
        pairs = zip(vars(ageing).values(), self.parts, strict=True)
        parts = [2.0 * sd**2 * inverse @ part for sd, part in pairs]
        information = [[0.5 * float((a * b.T).sum()) for a in parts] for b in parts]
        return np.asarray(np.linalg.inv(information + np.eye(len(parts)) / _LOG_SD**2))


def usual(calibration: Calibration) -> Ageing:
    """Return prior medians of `Ageing` by the fit's residual sd, or by noise if the sd is 0."""
    residual = max(axis.residual_sd_m_s2 for axis in calibration.static.axes())
    turn_on = max(residual or max(calibration.noise_density_m_s2_sqrt_hz), _LEAST_TURN_ON)
    walk = _WALK_SHARE * turn_on
    return Ageing(walk, walk, turn_on, _SCATTER_SHARE * turn_on, lags=1.0)


def learn(
    series: RestSeries, calibration: Calibration, since: float, *, is_gravity_certain: bool = False
) -> tuple[Ageing, Model, RestSeries]:
    """
    Estimate the ageing model by evidence, without starts that contradict all other starts.

    At most four `Change`s are added, each with a log Bayes factor of at least `_LEAST_GAIN`. A
    start of the node is left out if, in the model of all starts, an equation of its rests (a row)
    is more than 5 sd from the prediction by all other rows. Returns the `Ageing`, the `Model` of
    the used rests, and these rests.
    """
    centre = usual(calibration)
    is_used = np.ones(len(series), dtype=np.bool_)
    for _ in range(2):
        used = series.at(is_used)
        rows = rows_of(used, centre.rest)
        searched = rows.at(rows.rank < _SEARCH_ROWS)
        changes: tuple[Change, ...] = ()
        while True:
            model = Model(searched, calibration, since, changes)
            ageing, inverse = model.fitted(centre)
            best = _best(_candidates(model, inverse), is_gravity_certain)
            if best is None or len(changes) == 4:
                break
            changes += (best,)
        model = Model(rows, calibration, since, changes)
        inverse = model.inverse(ageing)
        # Deviation of each row from the prediction by all other rows, in sds.
        deviation = (inverse @ rows.y) / np.sqrt(np.diag(inverse))
        is_outlier = np.isin(used.start, rows.start[np.abs(deviation) > 5.0])
        # If more than 10 % of the rests would be left out, the model is wrong: keep all rests.
        if not 0 < is_outlier.sum() <= 0.1 * len(used):
            break
        is_used[np.flatnonzero(is_used)[is_outlier]] = False
    return ageing, model, used


def _best(candidates: Iterable[Change], is_gravity_certain: bool) -> Change | None:
    """
    Return the most probable `Change`, or None if no log Bayes factor reaches `_LEAST_GAIN`. A
    gravity jump is returned only if its log Bayes factor exceeds 0, and the log Bayes factor of
    any other change, by `_LEAST_LEAD` or more.
    """
    gravity = other = Change('levels', None, 0.0, log_bayes_factor=-np.inf)
    for change in candidates:
        if change.kind != 'gravity':
            other = max(other, change, key=attrgetter('log_bayes_factor'))
        elif not is_gravity_certain:
            gravity = max(gravity, change, key=attrgetter('log_bayes_factor'))
    lead = gravity.log_bayes_factor - max(other.log_bayes_factor, 0.0)
    if lead >= _LEAST_LEAD and gravity.log_bayes_factor >= _LEAST_GAIN:
        return gravity
    if other.log_bayes_factor < _LEAST_GAIN:
        return None
    return replace(other, may_be_gravity=other.kind == 'levels' and lead > -_LEAST_LEAD)


def _candidates(model: Model, inverse: Floats) -> Iterator[Change]:
    """Yield jumps (level, gravity) at node starts, and slope changes, with log Bayes factors."""
    rows = model.rows
    alpha, by_jump = inverse @ rows.y, rows.by_jump
    _, first = np.unique(rows.start, return_index=True)
    n, width = len(first), by_jump.shape[1]
    precision = np.empty((n, n, width, width))
    for j in range(width):
        half = np.add.reduceat(inverse * by_jump[:, j], first, axis=1)
        for i in range(width):
            precision[:, :, i, j] = np.add.reduceat(by_jump[:, [i]] * half, first, axis=0)
    gradient = np.add.reduceat(by_jump * alpha[:, np.newaxis], first, axis=0)
    # A jump before a node start shifts |f| at this start and at all later starts.
    after = np.cumsum(np.cumsum(precision[::-1, ::-1], axis=0), axis=1)[::-1, ::-1]
    gradient = np.cumsum(gradient[::-1], axis=0)[::-1]
    known = {(change.kind, change.time) for change in model.changes}
    parts: list[tuple[_Kind, slice]] = [('levels', slice(6)), ('gravity', slice(6, width))]
    for k, time in enumerate(rows.time[first].tolist()):
        for kind, at in parts:
            for sd in _JUMPS if (kind, time) not in known else ():
                gain = _log_bayes_factor(after[k, k][at, at], gradient[k, at], sd)
                yield Change(kind, time, sd, gain - float(np.log(n * len(_JUMPS))))
    by_slope = rows.by_slope
    for sd in _BENDS if ('curve', None) not in known else ():
        gain = _log_bayes_factor(by_slope.T @ inverse @ by_slope, by_slope.T @ alpha, sd)
        yield Change('curve', None, sd, gain - float(np.log(len(_BENDS))))


def _log_bayes_factor(precision: Floats, gradient: Floats, sd: float) -> float:
    """Return the gain in log evidence by a change whose unknowns have the prior sd `sd`."""
    inner = np.eye(len(gradient)) + sd**2 * precision
    gain = 0.5 * sd**2 * gradient @ np.linalg.solve(inner, gradient)
    return float(gain - 0.5 * np.linalg.slogdet(inner)[1])


@dataclass(frozen=True)
class Solution:
    """
    Change of the calibration file's parameters due to the rests, with the covariances.

    shift: change of the parameters
    prior, posterior: covariances at the time of the last rest, before and after the rests are used
    future: covariance that ageing adds during the time of use after the last rest
    gains, innovations: factors of the shift ``gains.T @ innovations``, with a row for each
        equation; the shift due to the first n equations is the product of the first n rows
    gravity: jumps of gravity, each with its size and the sd of the size [m/s^2]
    """

    shift: Floats
    prior: Floats
    posterior: Floats
    future: Floats
    gains: Floats
    innovations: Floats
    gravity: tuple[tuple[Change, float, float], ...] = ()

    def before(self, row: int) -> Floats:
        """Return the shift of the calibration's parameters due to the first `row` equations."""
        return np.asarray(self.gains[:row].T @ self.innovations[:row])


def solve(model: Model, ageing: Ageing, to_file: Floats, bend: Floats, ahead: float) -> Solution:
    """
    Condition the parameters of the calibration on the rests.

    `to_file`, `bend`: derivatives of the n file parameters by the six levels of `Change`, (n, 6),
    and by the bias slope of each axis, (n, 3); `ahead`: days of use after the last rest.
    """
    rows = model.rows
    age = np.maximum(rows.time - model.since, 0.0)[:, np.newaxis]
    walk = np.repeat([ageing.bias**2, ageing.scale**2], 3)
    crossed = rows.by_parameter @ model.prior + (age * rows.by_level * walk) @ to_file.T
    crossed += _SLOPE_WALK**2 * (age * rows.by_slope) @ bend.T
    per_day = (to_file * walk) @ to_file.T + _SLOPE_WALK**2 * bend @ bend.T
    prior = model.prior + float(age.max()) * per_day
    lower = np.linalg.cholesky(model.covariance(ageing))
    innovations = solve_triangular(lower, rows.y, lower=True)
    gravity = []
    for change in model.changes:
        columns = change.columns(rows)
        if change.kind == 'gravity':  # a jump of local gravity changes no calibration parameter
            gain = change.sd**2 * solve_triangular(lower, columns[:, 0], lower=True)
            variance = max(float(change.sd**2 - gain @ gain), 0.0)
            gravity.append((change, float(gain @ innovations), float(np.sqrt(variance))))
            continue
        onto = bend if change.kind == 'curve' else to_file * _JUMP_SHARES
        crossed += change.sd**2 * columns @ onto.T
        prior += change.sd**2 * onto @ onto.T
    gains = solve_triangular(lower, crossed, lower=True)
    posterior, future = prior - gains.T @ gains, ahead * per_day
    shift = gains.T @ innovations
    return Solution(shift, prior, posterior, future, gains, innovations, tuple(gravity))
