# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the base series of the windows (a constant, columns, derivatives of columns, mean samples),
the filter that whitens these series for slow noise, and sums of products of the whitened series.

All terms of the measurement equation (`equations`) are linear combinations of the base series, so
the sums of the products of whitened base series in each position are sufficient statistics.

The mean sample of window k in a position has the error ``c_k + e_k``. e_k is white noise of
variance ``sigma^2 / weight_k``. The slow noise c_k (`unknowns.Noise`) is one of two kinds. The
first is a stationary first-order Gauss-Markov process of variance ``ratio sigma^2`` and
correlation time T (IEEE Std 952, Annex B.4.3); for a long T it is a random walk. The second is
flicker noise, the bias instability of a sensor: a sum of Gauss-Markov processes of equal variance
with the correlation times T, 10 T, 100 T and so on [2]_. The innovations of a Kalman filter for
the error ``c_k + e_k``, divided by their standard deviations, are white and contain all
information of a series, so least squares with the innovations is the optimal estimator [1]_.

References
----------
.. [1] A. C. Harvey, Forecasting, structural time series models and the Kalman filter, Cambridge
   University Press (1989), section 3.4: likelihood by prediction errors.
.. [2] M. S. Keshner, 1/f noise, Proceedings of the IEEE 70 (1982), pp 212 to 218: one relaxation
   process for each decade of frequency gives a 1/f spectrum.

"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ..typing import Bools, Floats, Ints
from .unknowns import Noise, State, Windows


class Whitener:
    """
    A Kalman filter that whitens series of window values, separately in each position.

    position: index of each window's position, shape (n,)
    time: time of each window [s], shape (n,); the windows are sorted by position, then by time
    """

    def __init__(self, position: Ints, time: Floats) -> None:
        starts = np.flatnonzero(np.r_[True, position[1:] != position[:-1]])
        lengths = np.diff(np.r_[starts, len(position)])
        n_steps = int(lengths.max())
        step = np.arange(n_steps)[:, None]
        self._is_there = step < lengths
        #: Row j: index of the j-th window of each position; 0 if the position has fewer windows.
        self._row = np.where(self._is_there, starts + step, 0)
        self._n = len(position)
        since = np.diff(time[self._row], axis=0, prepend=time[self._row[:1]])
        self._interval = interval = np.where(self._is_there, since, 0.0)
        #: Correlation times to try [s]: half decades from 3 windows to a sixth of a position.
        self.times_s: list[float] = []
        span_s = float(np.median(interval.sum(axis=0)))
        typical_s = float(np.median(interval[1:][self._is_there[1:]])) if n_steps > 1 else 1.0
        time_s = 3.0 * typical_s
        while time_s <= span_s / 6.0:
            self.times_s.append(time_s)
            time_s *= 10.0**0.5
        #: Upper bound of the correlation time in a search [s]: half a decade above `times_s[-1]`.
        self._longest_s = time_s
        #: Number of processes that make up flicker noise: their correlation times are 3, 30, 300,
        #: ... windows, up to the first time that is at least as long as a position.
        self.n_flicker = 1 + math.ceil(math.log10(max(span_s / (3.0 * typical_s), 1.0)))

    def shows(self, time_s: float) -> bool:
        """Whether a search may try this correlation time: from `times_s[0]` to `_longest_s`."""
        # The factors 0.999 and 1.001 include both limits in spite of rounding errors.
        shortest_s = 0.999 * self.times_s[0] if self.times_s else math.inf
        return shortest_s < time_s < 1.001 * self._longest_s

    def _innovations(
        self, series: Floats, weight: Floats, noises: Sequence[Noise]
    ) -> Iterator[tuple[Ints, Bools, Floats, Floats]]:
        """
        Run the Kalman filter over series, (n, m), for k noises with equal numbers of processes.

        Step j yields the index of the j-th window of each position, whether the position has this
        window, innovations, (k, n_positions, m), and their variances [sigma^2], (k, n_positions).
        """
        times_s = np.array([[noise.times_s] for noise in noises])
        # Stationary covariance of the processes, which are independent of each other.
        still = np.array([[noise.ratio * np.eye(noise.n_times)] for noise in noises])
        covariance = np.repeat(still, self._row.shape[1], axis=1)
        level = np.zeros((*covariance.shape[:3], series.shape[1]))
        for rows, is_there, step_s in zip(self._row, self._is_there, self._interval, strict=True):
            decay = np.exp(-step_s[:, None] / times_s)
            covariance = still + decay[..., None] * decay[..., None, :] * (covariance - still)
            shared = covariance.sum(axis=-1)
            total = shared.sum(axis=-1) + 1.0 / weight[rows]
            level = level * decay[..., None]
            innovation = series[rows] - level.sum(axis=-2)
            yield rows, is_there, innovation, total
            gain = shared / total[..., None]
            level = level + gain[..., None] * innovation[..., None, :]
            covariance = covariance - gain[..., None] * shared[..., None, :]

    def filter(self, series: Floats, weight: Floats, noise: Noise) -> Floats:
        """Return series whitened for `noise`, which are innovations / their sd, (n, m)."""
        if noise.ratio <= 0.0:
            return np.asarray(series * (1.0 / np.sqrt(1.0 / weight))[:, None])
        result = np.empty_like(series)
        for rows, is_there, innovation, total in self._innovations(series, weight, [noise]):
            result[rows[is_there]] = (innovation[0] / np.sqrt(total[0])[:, None])[is_there]
        return result

    def log_determinant(self, weight: Floats, noise: Noise) -> float:
        """Return the log determinant of the windows' noise covariance / sigma^2."""
        steps = self._innovations(np.empty((self._n, 0)), weight, [noise])
        return float(sum(np.log(total[0, is_there]).sum() for _, is_there, _, total in steps))

    def estimate(self, residual: Floats, weight: Floats) -> Noise:
        """
        Find the Gauss-Markov noise of residuals, shape (n, 3), by their profile likelihood.

        The axes have a common variance ratio and correlation time; the likelihood is maximised
        over the white variance of each axis. White noise is returned unless slow noise raises
        twice the log likelihood by 9.2, the 1 % point of a chi-square with two degrees of freedom.
        """
        # Candidate ratios of the Gauss-Markov variance to the white variance of a window.
        ratios = 10.0 ** np.arange(-2.5, 3.6, 0.5)
        candidates = [Noise(float(ratio), time_s) for time_s in self.times_s for ratio in ratios]
        if not candidates:
            return Noise()
        white = float(self._deviances(residual, weight, [Noise()])[0])
        deviances = self._deviances(residual, weight, candidates)
        best = int(np.argmin(deviances))
        if white - float(deviances[best]) < 9.2:
            return Noise()
        row, column = divmod(best, len(ratios))
        table = deviances.reshape(-1, len(ratios))
        log_ratio = np.log10(ratios[column]) + 0.5 * _vertex(table[row], column)
        log_time = np.log10(self.times_s[row]) + 0.5 * _vertex(table[:, column], row)
        return Noise(float(10.0**log_ratio), float(10.0**log_time))

    def _deviances(self, residual: Floats, weight: Floats, noises: Sequence[Noise]) -> Floats:
        """Return -2 log profile likelihood of each noise, up to a constant, shape (n_noises,)."""
        square, size = np.zeros((len(noises), 3)), np.zeros(len(noises))
        steps = self._innovations(residual, weight, noises)
        for _, is_there, innovation, total in steps:
            square += np.sum((innovation**2 / total[..., None])[:, is_there], axis=1)
            size += np.log(total[:, is_there]).sum(axis=1)
        spread = np.log(np.maximum(square, 1e-300) / self._n).sum(axis=1)
        return np.asarray(3.0 * size + self._n * spread)


def _vertex(values: Floats, at: int) -> float:
    """Return the minimum's index, less `at`, of a parabola through 3 values; 0 if it has none."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2].tolist()
    bend = before - 2.0 * here + after
    return 0.5 * float(before - after) / bend if bend > 0.0 else 0.0


@dataclass(frozen=True)
class Base:
    """
    The order of the base series for given active columns.

    The order is: the constant 1; the columns; for each column with a lag its derivative w.r.t. the
    initial state of the lag; the temperature t of nonlinear terms, if the fit has nonlinear terms;
    the functions `Windows.tilt`; the mean samples of three axes less their mean in the position.

    columns: indices of the active columns among all columns
    lagged: indices, within `columns`, of the columns with a lag; lag: index of each one's lag
    at_start, t, tilts, measured: indices, among the base series, of the derivatives w.r.t. initial
        lag states, of t (shape (1,) or (0,)), of `Windows.tilt`, and of the mean samples
    """

    columns: Ints
    lagged: Ints
    lag: Ints
    at_start: Ints
    t: Ints
    tilts: Ints
    measured: Ints

    @classmethod
    def of(cls, columns: Ints, lags: Ints, n_t: int, n_tilts: int) -> Base:
        """Assign indices to base series; `lags`: index of each column's lag, -1 if it has none."""
        lagged = np.flatnonzero(lags[columns] >= 0)
        counts = 1 + len(columns), len(lagged), n_t, n_tilts, 3
        _, *places = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        return cls(columns, lagged, lags[columns[lagged]], *places)

    @property
    def size(self) -> int:
        """Number of the base series."""
        return int(self.measured[-1]) + 1


@dataclass(frozen=True)
class Products:
    """
    Sums over windows of the products of all pairs of whitened base series. A cell of `Products`
    (not of samples) has the windows of one position in one section of the chamber program.

    base: order of the base series
    means: mean of each base series, not whitened, in each position, shape (n_positions, n_base)
    cells: sums of products over the windows of each cell, shape (n_cells, n_base, n_base)
    first: index of each position's first cell; section: index of each cell's section
    """

    base: Base
    means: Floats
    cells: Floats
    first: Ints
    section: Ints

    @cached_property
    def of_positions(self) -> Floats:
        """Sums of products over each position, shape (n_positions, n_base, n_base)."""
        return np.asarray(np.add.reduceat(self.cells, self.first, axis=0))

    def without(self, sections: Ints) -> Floats:
        """Return the sums of products over each position, less the cells of `sections`."""
        result: Floats = self.of_positions.copy()
        left_out = np.flatnonzero(np.isin(self.section, sections))
        position = np.searchsorted(self.first, left_out, side='right') - 1
        np.subtract.at(result, position, self.cells[left_out])
        return result


class Series:
    """
    The values of the base series (such as columns and mean samples) in the windows of a fit, and
    the sums of products of these series. Nominal scale factors convert mean samples to m/s^2.

    windows: the data of the fit
    nominal_scale: nominal scale factors [input units per m/s^2], shape (3,)
    t: board temperature less the reference for nonlinear terms [K], shape (n, 1) or (n, 0)
    """

    def __init__(self, windows: Windows, nominal_scale: Floats, t: Floats) -> None:
        self.windows = windows
        self.nominal_scale = nominal_scale
        self.measured = windows.mean / nominal_scale
        self.rms = np.sqrt(np.mean(windows.columns**2, axis=0))
        self.rms[self.rms == 0.0] = 1.0
        self.columns = windows.columns / self.rms
        self.bag_of_position = windows.bag_of_position
        self.n_bags = int(windows.bag.max()) + 1
        # Arithmetic with denormal numbers is slow, so derivatives below 1e-9 are set to 0.
        self._starts = np.where(np.abs(windows.start) < 1e-9, 0.0, windows.start) / self.rms
        values, vectors = np.linalg.eigh(windows.start_covariance)
        # The initial lag states are so correlated that few principal components suffice.
        kept = values > 1e-6 * values.max(initial=0.0)
        #: Matrix square root of the prior covariance of the initial lag states, (n_lags, r).
        self.start_root = vectors[:, kept] * np.sqrt(values[kept])
        self._first = windows.edges[:-1]
        self.level = self._averaged(self.measured)
        self._ones, self._n_t = np.ones((len(t), 1)), t.shape[1]
        self._others = np.hstack((t, windows.tilt, self.measured - self.level[windows.position]))
        cell = np.column_stack((windows.position, windows.section))
        self._cells = np.flatnonzero(np.diff(cell, axis=0, prepend=-1).any(axis=1))
        self.whitener = Whitener(windows.position, windows.time)
        shares = 1.0 if windows.undisturbed is None else windows.undisturbed
        self.reweigh(windows.weight * shares)

    def reweigh(self, weight: Floats) -> None:
        """Set the weights of the windows, shape (n,)."""
        self.weight = weight
        self.noise: Noise | None = None
        self._products: Products | None = None

    def whiten(self, noise: Noise) -> None:
        """Set the noise for which the series are whitened."""
        if noise == self.noise:
            return
        self.noise, self._products = noise, None
        self._whitened = partial(self.whitener.filter, weight=self.weight, noise=noise)
        self.noise_determinant = self.whitener.log_determinant(self.weight, noise)

    def products(self, used: Bools) -> Products:
        """Return sums of products for the noise set; `used`: columns of bias and scale, (2, m)."""
        active = np.flatnonzero(used.any(axis=0))
        if self._products is None or not np.array_equal(self._products.base.columns, active):
            base = Base.of(active, self.windows.lag, self._n_t, self.windows.tilt.shape[1])
            series = self.of(base)
            parts = np.split(self._whitened(series), self._cells[1:])
            cells = np.stack([part.T @ part for part in parts])
            first, section = np.searchsorted(self._cells, self._first), self.windows.section
            means = self._averaged(series)
            self._products = Products(base, means, cells, first, section[self._cells])
        return self._products

    def products_of(self, columns: Ints, base: Base, state: State) -> tuple[Floats, Floats]:
        """
        Return sums of products of k columns with each other, (n_positions, k, k), and with base
        series, (n_positions, k, n_base); the columns have the initial lag states of `state`.
        """
        values, lag = self.columns[:, columns], self.windows.lag[columns]
        lagged, start = lag >= 0, (state.start @ self.start_root.T)[self.windows.bag]
        values[:, lagged] += start[:, lag[lagged]] * self._starts[:, columns[lagged]]
        series = np.hstack((values, self.of(base)))
        parts = np.split(self._whitened(series), self._first[1:])
        k = len(columns)
        products = np.stack([part[:, :k].T @ part for part in parts])
        return products[..., :k], products[..., k:]

    def _averaged(self, values: Floats) -> Floats:
        """Return the mean of series in each position, shape (n_positions, k)."""
        count = np.diff(self.windows.edges)[:, None]
        return np.asarray(np.add.reduceat(values, self._first, axis=0) / count)

    def of(self, base: Base) -> Floats:
        """Return the series that `base` lists, in its order, as columns, shape (n, n_base)."""
        at_start = self._starts[:, base.columns[base.lagged]]
        return np.hstack((self._ones, self.columns[:, base.columns], at_start, self._others))

    def starts(self, state: State, base: Base) -> Floats:
        """Return the initial lag state of each column in `base.lagged`, (n_positions, m) [K]."""
        return np.asarray((state.start @ self.start_root.T)[self.bag_of_position][:, base.lag])

    def at_starts(self, rows: Floats, state: State, base: Base) -> Floats:
        """
        Convert linear functions of the base series, (n_positions, k, n_base), whose columns have
        initial lag states 0 (the prior mean), to the initial lag states of `state`.
        """
        if not len(base.lagged):
            return rows  # the memory layout of a copy would change the last bits of products
        result: Floats = rows.copy()
        starts = self.starts(state, base)[:, None]
        result[..., 1 + base.lagged] += starts * rows[..., base.at_start]
        return result

    def products_at(self, products: Floats, state: State, base: Base) -> Floats:
        """Convert `products`, (n_positions, n_base, n_base), to initial lag states of `state`."""
        half = self.at_starts(products, state, base)
        return self.at_starts(np.swapaxes(half, 1, 2), state, base)
