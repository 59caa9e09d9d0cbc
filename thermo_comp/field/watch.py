# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the drift watch: comparison of ``|f| - g`` in a rest log with the claimed sd, and a forecast.

A unit is within its claim while the RMS of its errors along gravity, over attitudes and node
starts, is at most `LIMIT` times the sd that its calibration claims for them. The verdict follows
from the rests of the last week and the error at the last rest by the ageing model. The forecast is
the distribution of the time at which the RMS error exceeds the limit, for random walks of bias
and scale that begin at the present estimate and have the variances estimated from the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..text import counted
from ..typing import Floats, Ints
from ..unit.calibration import Calibration
from .ageing import Ageing
from .series import RestSeries
from .update import Update, update

LIMIT = 2.0  # largest RMS error / claimed sd of a unit that is within its claim
#: Number of days whose RMS of |f| - g decides the verdict: enough to average the turn-on bias
#: offsets, and far less than the time in which a unit drifts to the limit.
_WINDOW_DAYS = 7
_LEAST_STARTS = 10  # smallest number of starts of the node whose attitudes the forecast uses
_QUANTILES = 0.1, 0.5, 0.9  # probabilities of the forecast
_HORIZON = 3650.0  # longest time that is forecast [days]
_WALKS = 2000  # number of simulated random walks
_CLASS_K = 10.0  # width of a temperature class in the table of `Watch` [K]
_PERIODS = 30  # largest number of periods in the table of `Watch`


@dataclass(frozen=True)
class Row:
    """``|f| - g`` [m/s^2] and temperature [degC] over a day, a period or a temperature class."""

    name: str
    n_rests: int
    temperature: float
    mean: float
    rms: float
    claim: float
    limit: float

    @property
    def is_within(self) -> bool:
        """Whether the RMS of |f| - g is at most the tolerance, or `LIMIT` times the claimed sd."""
        return self.rms <= self.limit


@dataclass(frozen=True)
class Watch:
    """
    Comparison of the rests of a log with the claimed sd.

    days, periods, temperatures: rows by day, by period (at most 30), by class of temperature
    last: the last day with rests
    week: rows of the days with rests in the last week
    recent: RMS of |f| - g over the last week / limit; one disturbed day hardly changes it
    outside_since: day since which the unit is outside its claim; None if it is within its claim
    inside_since: day on which the unit was again within its claim; None if it was never outside,
        or is outside
    forecast: quantiles (10, 50, 90 %) of the time from the last rest until the unit's error
        exceeds its claim [days]; infinite if later than ten years; () if unknown or exceeded
    interval: the quantiles of `forecast` for a calibration that is updated at the last rest
    """

    days: tuple[Row, ...]
    periods: tuple[Row, ...]
    temperatures: tuple[Row, ...]
    last: str
    week: tuple[Row, ...]
    recent: float
    outside_since: str | None
    inside_since: str | None
    forecast: tuple[float, ...]
    interval: tuple[float, ...]
    ageing: Ageing | None

    @property
    def exit_code(self) -> int:
        """Exit code: 1 if the verdict is *outside* (|f| - g is beyond its limit), else 0."""
        return 1 if self.outside_since else 0

    def __str__(self) -> str:
        n_out = sum(not row.is_within for row in self.week)
        week = f'RMS of |f| - g {self.recent:.2g} times the limit over the last {_WINDOW_DAYS} '
        week += f'days, {n_out} of {counted(len(self.week), "day")} above the limit'
        if self.outside_since and self.recent <= 1.0:
            week += ', but the error at the last rest by the ageing model is above the limit'
        if self.outside_since:
            text = (
                f'the unit is outside its claim since {self.outside_since} ({week}): update its '
                'calibration by rests, or recalibrate the unit'
            )
        else:
            since = self.inside_since
            how = f'again within its claim since {since}' if since else 'within its claim'
            text = f'the unit is {how} up to {self.last} ({week}); '
            if self.forecast:
                when = 'on any day' if self.forecast[1] < 1.0 else self._date(1, 'on about ')
                text += f'forecast: its error will exceed its claim {when}'
                text += f' (10 to 90 %: {self._date(0)} .. {self._date(2)})'
            else:
                text += 'a forecast needs rests of 3 starts of the node'
        if self.interval:
            low, middle, high = (f'{min(days, _HORIZON):.0f}' for days in self.interval)
            text += f'; recalibration interval {middle} days (10 to 90 %: {low} .. {high})'
        return text

    def _date(self, k: int, front: str = '') -> str:
        days = self.forecast[k]
        if not np.isfinite(days):
            return 'in more than ten years'
        return f'{front}{np.datetime64(self.last, "D") + np.timedelta64(int(days), "D")}'


def watch(series: RestSeries, calibration: Calibration, tolerance: float | None = None) -> Watch:
    """
    Compare rests with the claimed sd, or with a tolerance of ``|f| - g`` [m/s^2], and forecast the
    time until the error of the unit exceeds the limit.
    """
    names = np.array([str(np.datetime64(int(day), 'D')) for day in series.day])
    ordered = np.unique(names)
    days = _rows(series, names, ordered.tolist(), tolerance)
    together = -(-len(ordered) // _PERIODS)
    firsts = ordered[np.searchsorted(ordered, names) // together * together]
    lower, of_class = np.unique(np.floor(series.temperature / _CLASS_K), return_inverse=True)
    classes = [f'{edge:g} .. {edge + _CLASS_K:g} degC' for edge in lower * _CLASS_K]
    numbers = np.unique(series.day)
    first, recent = _smoothed(numbers, np.array([row.rms / row.limit for row in days]))
    ageing: Ageing | None = None
    forecast: tuple[float, ...] = ()
    interval: tuple[float, ...] = ()
    if series.start[-1] >= 2:
        updated = update(series, calibration)
        ageing = updated.ageing
        forecast, interval = _forecasts(updated, tolerance)
    is_out, is_row_out = recent > 1.0, np.array([not row.is_within for row in days])
    # The RMS of |f| - g over a week responds late to a change. While the error by the ageing model
    # is above the limit, one last day above the limit puts the unit outside its claim. While that
    # error is within the limit, two last days within the limit put the unit within its claim.
    is_error_out = bool(forecast) and forecast[1] == 0.0
    is_out[-1] &= is_error_out or is_row_out[-2:].any()
    is_out[-1] |= is_error_out and is_row_out[-1]
    outside_since = inside_since = None
    if is_out[-1]:
        is_early = ~is_out if recent[-1] > 1.0 else ~is_row_out
        begin = min(int(np.append(-1, np.flatnonzero(is_early))[-1]) + 1, len(days) - 1)
        window = days[first[begin] if recent[-1] > 1.0 else begin : begin + 1]
        outside_since = next((row.name for row in window if not row.is_within), window[-1].name)
        forecast = ()
    elif (recent > 1.0).any():
        # `days` has a row after `until`: a later week, or each of the last two days, is within
        # the limit.
        until = int(np.flatnonzero(recent > 1.0)[-1])
        inside_since = days[int(np.flatnonzero(is_row_out[: until + 1])[-1]) + 1].name
    periods = _rows(series, firsts, ordered[::together].tolist(), tolerance)
    temperatures = _rows(series, np.array(classes)[of_class], classes, tolerance)
    return Watch(
        *(days, periods, temperatures, days[-1].name, days[first[-1] :], float(recent[-1])),
        *(outside_since, inside_since, forecast, interval, ageing),
    )


def _smoothed(day: Ints, ratio: Floats) -> tuple[Ints, Floats]:
    """
    Return, for the week that ends on each day, the index of its first day and its RMS of `ratio`.

    If a week has only one day with rests, the preceding day with rests is added. The largest
    `ratio` of a week, perhaps of a disturbed day, is replaced by the second largest.
    """
    n = np.arange(len(day))
    first = np.searchsorted(day, day - _WINDOW_DAYS, side='right')
    first = np.minimum(first, np.maximum(n - 1, 0))
    squares = [np.sort(ratio[i : k + 1] ** 2) for i, k in zip(first, n, strict=True)]
    means = [(values.sum() - np.diff(values[-2:]).sum()) / len(values) for values in squares]
    return first, np.sqrt(means)


def _forecasts(
    updated: Update, tolerance: float | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """
    Return the quantiles of the time until the error of the unit exceeds the limit, with the
    present calibration and with an update at the last rest.

    Error: RMS of |f| - g in the attitudes of rests of the last week or the last ten node starts.
    """
    used, ageing, solution = updated.series, updated.ageing, updated.solution
    is_recent = used.time > used.time[-1] - _WINDOW_DAYS
    recent = used.at(is_recent | (used.start > used.start[-1] - _LEAST_STARTS))
    share = recent.n_windows / recent.n_windows.sum()
    # |root @ e| is the RMS of |f| - g due to the errors e of parameters, biases and scales.
    joined = np.hstack((recent.by_parameter, recent.by_level)) * np.sqrt(share)[:, np.newaxis]
    root = np.linalg.qr(joined, mode='r')
    of_parameters, of_levels = np.split(root, [recent.by_parameter.shape[1]], axis=1)
    walk = of_levels * np.repeat([ageing.bias, ageing.scale], 3)
    bias, scale = (float((part**2).sum()) for part in np.split(walk, 2, axis=1))
    # Each start of the node gives the biases new offsets, which add to the error, so the variance
    # of these offsets is subtracted from the square of the limit. After a disturbance the ageing
    # model may overestimate the offsets' variance: use the variance of |f| - g at the recent rests
    # instead, if this variance is smaller.
    scatter = ageing.turn_on**2 * float((of_levels[:, :3] ** 2).sum()) + ageing.rest**2
    left = recent.residual - recent.by_parameter @ solution.shift
    scatter = min(scatter, float(share @ left**2))
    limit = tolerance or LIMIT * float(np.sqrt(share @ recent.claim**2))
    bound = float(np.sqrt(max(limit**2 - scatter, 0.0)))
    # Sd of the logarithm of the daily growth of the error's variance, by the delta method.
    slope = 2.0 * np.array([bias, scale]) / (bias + scale)
    of_walks = updated.model.log_covariance(ageing)[:2, :2]
    rate_sd = float(np.sqrt(slope @ of_walks @ slope))
    error = of_parameters @ solution.shift
    covariance = of_parameters @ solution.posterior @ of_parameters.T
    now = passage(error, covariance, walk, bound, rate_sd)
    return now, passage(np.zeros_like(error), covariance, walk, bound, rate_sd)


def _rows(
    series: RestSeries, labels: Floats, ordered: Sequence[str], tolerance: float | None
) -> tuple[Row, ...]:
    rows = []
    for name in ordered:
        at = labels == name
        weight = series.n_windows[at] / series.n_windows[at].sum()
        temperature, mean = (float(weight @ x[at]) for x in (series.temperature, series.residual))
        rms, claim = (float(np.sqrt(weight @ x[at] ** 2)) for x in (series.residual, series.claim))
        limit = tolerance or LIMIT * claim
        rows.append(Row(name, int(at.sum()), temperature, mean, rms, claim, limit))
    return tuple(rows)


def passage(
    mean: Floats, covariance: Floats, walk: Floats, bound: float, rate_sd: float = 0.0
) -> tuple[float, ...]:
    """
    Return quantiles of the time [days] at which the norm of a random walk first exceeds a bound.

    The walk begins at a random vector of mean `mean`, (k,), and covariance `covariance`, (k, k).
    In d days the walk changes by sqrt(d) `walk`, (k, m), times m independent normal variables;
    `rate_sd` is the sd of the logarithm of the variance of the walk. The time is 0 for a walk that
    begins above the bound, 0.01 days or more for other walks.
    """
    rng = np.random.default_rng(1)
    # Principal directions with less than a thousandth of the largest error are left out.
    size, vectors = np.linalg.eigh(covariance + np.outer(mean, mean) + walk @ walk.T)
    onto = vectors[:, size > 1e-6 * size[-1]].T
    mean, covariance = onto @ mean, onto @ covariance @ onto.T
    # A square factor of the walk's covariance needs one normal variable per direction.
    walk = np.transpose(np.linalg.qr((onto @ walk).T, mode='r'))
    values, vectors = np.linalg.eigh(covariance)
    initial = vectors * np.sqrt(np.maximum(values, 0.0))
    error = mean + rng.standard_normal((_WALKS, len(mean))) @ initial.T
    speed = np.exp(0.5 * rate_sd * rng.standard_normal(_WALKS))
    times = np.concatenate(([0.0], np.geomspace(0.01, _HORIZON, 400)))
    left = np.maximum(bound - np.sqrt((error**2).sum(axis=1)), 0.0)
    inside = np.where(left > 0.0, 1.0, 0.0)
    stays = [inside.sum() / _WALKS]
    for step in np.diff(times):
        if stays[-1] <= 1.0 - _QUANTILES[-1]:
            break
        # Once more than a fifth of the simulated walks are beyond the bound, remove these walks.
        is_in = inside > 0.0
        if is_in.mean() < 0.8:
            error, speed, left, inside = error[is_in], speed[is_in], left[is_in], inside[is_in]
        moved = rng.standard_normal((len(error), walk.shape[1])) @ walk.T
        error = error + (speed * np.sqrt(step))[:, np.newaxis] * moved
        size = np.sqrt(np.einsum('ij,ij->i', error, error))
        # A Brownian bridge with the distances a and b from the bound at two times crosses the
        # bound between the times with the probability exp(-2 a b / variance), `variance` being
        # the variance of the walk's change between the times along the error vector.
        onto_walk = error @ walk
        along = np.einsum('ij,ij->i', onto_walk, onto_walk) * speed**2 * step
        product = left * np.maximum(bound - size, 0.0) * size**2
        inside = inside * -np.expm1(-2.0 * product / np.maximum(along, 1e-300))
        left = np.maximum(bound - size, 0.0)
        stays.append(inside.sum() / _WALKS)
    survival = np.array(stays)
    return tuple(
        float(times[np.argmax(survival <= 1.0 - p)]) if survival[-1] <= 1.0 - p else np.inf
        for p in _QUANTILES
    )
