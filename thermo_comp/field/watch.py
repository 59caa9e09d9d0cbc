# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the drift watch: ``|f| - g`` of a rest log against the claimed sd, and a forecast.

A unit is within its claim while its error along gravity is at most `LIMIT` claimed sd. The
forecast is the distribution of the time at which the error first exceeds either bound, for a
random walk from the present estimate with the variance estimated from the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..typing import Floats
from ..unit.calibration import Calibration
from .ageing import Ageing
from .series import Series
from .update import update

#: Largest error that agrees with the claim, in claimed standard deviations.
LIMIT = 2.0
#: Probabilities of the forecast, and its horizon [days].
_QUANTILES, _HORIZON = (0.1, 0.5, 0.9), 3650.0
#: Width of a class of temperature [K], and largest number of periods in the table.
_CLASS_K, _PERIODS = 10.0, 30


@dataclass(frozen=True)
class Row:
    """``|f| - g`` over the rests of a day, a period or a class of temperature [m/s^2]."""

    name: str
    n_rests: int
    temperature: float
    mean: float
    rms: float
    claim: float
    limit: float

    @property
    def is_within(self) -> bool:
        """Whether the RMS is at most the limit: the tolerance, or a multiple of the claimed sd."""
        return self.rms <= self.limit


@dataclass(frozen=True)
class Watch:
    """
    Comparison of the rests of a log with the claimed sd.

    days, periods, temperatures: rows by day, by period (at most 30), by class of temperature
    left: first day of the last period outside the claim; None for a unit within its claim
    forecast: quantiles (10, 50, 90 %) of the time from the last rest until the unit's error
        exceeds its claim [days]; infinite if later than ten years
    interval: the quantiles of `forecast` for a unit that has just been updated
    """

    days: tuple[Row, ...]
    periods: tuple[Row, ...]
    temperatures: tuple[Row, ...]
    last: str
    left: str | None
    forecast: tuple[float, ...]
    interval: tuple[float, ...]
    ageing: Ageing | None

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 1 if the error of the unit exceeds its claim, else 0."""
        return 1 if self.left else 0

    def __str__(self) -> str:
        if self.left:
            text = f'outside its claim since {self.left}: update or recalibrate it'
        elif not self.forecast:
            text = 'within its claim; a forecast needs 3 starts'
        else:
            text = f'within its claim up to {self.last}, outside from about {self._date(1)}'
            text += f' (10 to 90 %: {self._date(0)} .. {self._date(2)})'
        if self.interval:
            low, middle, high = (f'{min(days, _HORIZON):.0f}' for days in self.interval)
            text += f'; recalibration interval {middle} days ({low} .. {high})'
        return text

    def _date(self, k: int) -> str:
        days = self.forecast[k]
        if not np.isfinite(days):
            return 'later than ten years from now'
        return str(np.datetime64(self.last, 'D') + np.timedelta64(int(days), 'D'))


def watch(series: Series, calibration: Calibration, tolerance: float | None = None) -> Watch:
    """
    Compare rests with the claimed sd or a tolerance of ``|f| - g`` [m/s^2]; forecast the excess.
    """
    names = np.array([str(np.datetime64(int(day), 'D')) for day in series.day])
    ordered = np.unique(names)
    days = _rows(series, names, ordered.tolist(), tolerance)
    together = -(-len(ordered) // _PERIODS)
    firsts = ordered[np.searchsorted(ordered, names) // together * together]
    lower = np.floor(series.temperature / _CLASS_K) * _CLASS_K
    classes = [f'{edge:g} .. {edge + _CLASS_K:g} degC' for edge in lower]
    warmer = [f'{edge:g} .. {edge + _CLASS_K:g} degC' for edge in np.unique(lower)]
    is_out = [not row.is_within for row in days]
    # The claim must be exceeded on two days in a row: on one day the unit may have been disturbed.
    n_out = ([*is_out[::-1], False]).index(False)
    left = days[-n_out].name if n_out >= min(2, len(days)) and n_out else None
    last, ageing = days[-1].name, None
    forecast: tuple[float, ...] = ()
    interval: tuple[float, ...] = ()
    if series.start[-1] >= 2:
        updated = update(series, calibration)
        ageing, used, solution = updated.ageing, updated.series, updated.solution
        recent = used.at(used.start == used.start[-1])
        of_parameters, of_levels = (
            column.mean(axis=0) for column in (recent.by_parameter, recent.by_level)
        )
        error = float(of_parameters @ solution.shift)
        variance = max(float(of_parameters @ solution.posterior @ of_parameters), 0.0)
        walk = np.repeat([ageing.bias**2, ageing.scale**2], 3)
        rate = float(of_levels**2 @ walk)
        sd = float(np.sqrt(variance))
        bound = tolerance or LIMIT * float(np.sqrt(np.mean(series.claim**2)))
        interval = passage(0.0, sd, rate, bound)
        forecast = passage(error, sd, rate, bound) if left is None else ()
    periods = _rows(series, firsts, ordered[::together].tolist(), tolerance)
    temperatures = _rows(series, np.array(classes), warmer, tolerance)
    return Watch(days, periods, temperatures, last, left, forecast, interval, ageing)


def _rows(
    series: Series, labels: Floats, ordered: Sequence[str], tolerance: float | None
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


def passage(error: float, sd: float, rate: float, bound: float) -> tuple[float, ...]:
    """
    Return quantiles of the time [days] after which a random walk first exceeds a bound.

    The random walk begins at N(error, sd^2), and its variance grows by `rate` per day. A random
    walk from x stays inside (-c, c) until t with the probability ``sum_k 4 / (k pi) sin(k pi (x +
    c) / 2 c) exp(-(k pi)^2 rate t / 8 c^2)`` over odd k.
    """
    # 60 terms of the sum suffice for times above a thousandth of the median.
    k = np.arange(1, 120, 2) * np.pi
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    inside = np.abs(x := error + sd * nodes) < bound
    waves = 4.0 / k * np.sin(np.outer((x + bound) / (2.0 * bound), k))
    terms = (weights / weights.sum() * inside) @ waves
    times = np.geomspace(1e-3, _HORIZON, 4000)
    stays = np.exp(-np.outer(times, k**2 * rate / (8.0 * bound**2))) @ terms
    return tuple(
        float(times[after[0]]) if len(after := np.flatnonzero(stays <= 1.0 - p)) else np.inf
        for p in _QUANTILES
    )
