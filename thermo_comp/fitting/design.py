# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the equations of the windows: base columns, whitened once for each noise, and the prediction.

Noise is white plus a random walk of the bias. Within a position the error of window k is
``c_k + e_k``, where e_k is white with variance ``sigma^2 / weight_k`` and c_k a random walk that
starts at 0 with the position and gains the variance ``rho sigma^2`` per second. The innovations of
its Kalman filter, divided by their standard deviations, are white and carry the same information,
so whatever is filtered alike - samples and columns - can be treated by ordinary least squares.

References
----------
.. [1] A. C. Harvey, Forecasting, structural time series models and the Kalman filter, Cambridge
   University Press (1989), section 3.4: likelihood by prediction errors.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..typing import Bools, Floats, Ints
from .unknowns import Layout, Prior, State, Windows

# Unknowns that a step is added to; the last ones may take no part.
_ADDED = ('kappa', 'bias', 'weights', 'skew', 'offset', 'lean', 'start')


class Whitener:
    """Filters series of windows, in order of position and time, position by position."""

    def __init__(self, position: Ints, time: Floats) -> None:
        starts = np.flatnonzero(np.r_[True, position[1:] != position[:-1]])
        lengths = np.diff(np.r_[starts, len(position)])
        n_steps = int(lengths.max())
        step = np.arange(n_steps)[:, None]
        #: Row of the table at each step of each position; those beyond its end point to row 0.
        self._is_there = step < lengths
        self._row = np.where(self._is_there, starts + step, 0)
        self._n = len(position)
        interval = np.zeros((n_steps, len(starts)))
        interval[1:] = np.where(
            self._is_there[1:], time[self._row[1:]] - time[self._row[:-1]], 0.0
        )
        self._interval = interval

    def gains(self, weight: Floats, rho: float) -> tuple[Floats, Floats]:
        """Give Kalman gain and sd of the innovation [sigma], shape (n_steps, n_positions)."""
        noise = 1.0 / weight[self._row]
        gain, root = np.zeros_like(noise), np.sqrt(noise)
        if rho <= 0.0:
            return gain, root
        variance = np.zeros(noise.shape[1])
        for k in range(len(noise)):
            variance = variance + rho * self._interval[k]
            total = variance + noise[k]
            gain[k] = variance / total
            root[k] = np.sqrt(total)
            variance = variance * (1.0 - gain[k])
        return gain, root

    def filter(self, series: Floats, gains: tuple[Floats, Floats]) -> Floats:
        """Whiten series, shape (n, k)."""
        gain, root = gains
        result = np.empty_like(series)
        if not gain.any():
            scale = np.empty(self._n)
            scale[self._row[self._is_there]] = 1.0 / root[self._is_there]
            return np.asarray(series * scale[:, None])
        level = np.zeros((self._row.shape[1], series.shape[1]))
        for k, rows in enumerate(self._row):
            innovation = series[rows] - level
            level += gain[k][:, None] * innovation
            there = self._is_there[k]
            result[rows[there]] = (innovation / root[k][:, None])[there]
        return result

    def log_determinant(self, gains: tuple[Floats, Floats]) -> float:
        """Logarithm of the determinant of the noise's covariance, in units of sigma^2."""
        return 2.0 * float(np.log(gains[1][self._is_there]).sum())


@dataclass(frozen=True)
class _Whitened:
    """Base columns of one axis, filtered; their Gram matrix in each position."""

    rho: float
    gains: tuple[Floats, Floats]
    base: Floats
    grams: Floats
    determinant: float


class Design:
    """
    The data of a fit as combinations of base columns: one, the columns, their start states, and
    what a support leans with.

    windows: the data
    gravity: local gravity; 0 for an angular rate
    nominal_scale: K0 [input units per m/s^2], shape (3,)
    """

    def __init__(self, windows: Windows, gravity: float, nominal_scale: Floats) -> None:
        self.windows = windows
        self.gravity = gravity
        self.nominal_scale = nominal_scale
        self.measured = windows.mean / nominal_scale
        self.rms = np.sqrt(np.mean(windows.columns**2, axis=0))
        self.rms[self.rms == 0.0] = 1.0
        self.weight = np.repeat(windows.weight[:, None], 3, axis=1)
        self._whitener = Whitener(windows.position, windows.time)
        self._columns = windows.columns / self.rms
        # Start states move few distinct series: one per lag and power of t.
        # What has died away is 0: numbers near the smallest that there are cost a hundred-fold.
        self._start = np.where(np.abs(windows.start) < 1e-9, 0.0, windows.start) / self.rms
        self.moved = np.flatnonzero(windows.lag >= 0)
        self._base = np.hstack(
            (
                np.ones((len(windows.time), 1)),
                self._columns,
                self._start[:, self.moved],
                windows.lean,
            )
        )
        edges = np.searchsorted(windows.position, np.arange(windows.n_positions + 1))
        self._rows = [slice(a, b) for a, b in pairwise(edges.tolist())]
        self._bags = windows.bag_of_position
        self.n_bags = int(windows.bag.max()) + 1
        self.start_information = np.asarray(np.linalg.inv(windows.start_covariance))
        self._cache: list[_Whitened | None] = [None] * 3

    def reweight(self, weight: Floats) -> None:
        """Take other weights of the windows, shape (n, 3)."""
        self.weight = weight
        self._cache = [None] * 3

    def _whitened(self, axis: int, rho: float) -> _Whitened:
        found = self._cache[axis]
        if found is None or found.rho != rho:
            gains = self._whitener.gains(self.weight[:, axis], rho)
            base = self._whitener.filter(self._base, gains)
            grams = np.stack([base[rows].T @ base[rows] for rows in self._rows])
            determinant = self._whitener.log_determinant(gains)
            found = self._cache[axis] = _Whitened(rho, gains, base, grams, determinant)
        return found

    def layout(self, used: Bools) -> Layout:
        """Give every unknown its place; `used`: columns of bias and scale, shape (2, m)."""
        n = 0

        def take(*shape: int) -> Ints:
            nonlocal n
            size = int(np.prod(shape))
            n += size
            return np.arange(n - size, n).reshape(shape)

        axis = take(3, 2 + int(used.sum()))
        weights = np.full((2, 3, used.shape[1]), -1)
        weights.transpose(1, 0, 2)[:, used] = axis[:, 2:]
        skew = take(3)
        n_unit = n
        n_positions = self.windows.n_positions
        taken: Bools = np.any(used, axis=0)
        moved = taken[self.moved]
        n_lags = len(self.windows.start_covariance) if moved.any() else 0
        up = np.empty((n_positions, 2), dtype=np.int64)
        offset = np.empty((n_positions, 3), dtype=np.int64)
        lean = np.empty((n_positions, self.windows.lean.shape[1], 2), dtype=np.int64)
        start = np.empty((self.n_bags, n_lags), dtype=np.int64)
        blocks = []
        for bag in range(self.n_bags):
            first = n
            for p in np.flatnonzero(self._bags == bag):
                up[p], offset[p], lean[p] = take(2), take(3), take(*lean.shape[1:])
            start[bag] = take(n_lags)
            blocks.append(slice(first, n))
        leans = np.ones(lean.shape[1], dtype=bool)
        base = np.flatnonzero(np.concatenate(([True], taken, moved, leans)))
        return Layout(axis, weights, skew, up, offset, lean, start, n_unit, tuple(blocks), n, base)

    def precision(self, prior: Prior, layout: Layout) -> Floats:
        """Inverse variances of the prior, shape (n,); where there is a matrix instead, 0."""
        result = np.zeros(layout.n + 1)
        result[layout.kappa] = prior.scale_sd**-2
        result[layout.bias] = prior.bias_sd**-2.0
        result[layout.axis[:, 2:]] = prior.widths[prior.widths > 0.0] ** -2.0
        result[layout.skew] = prior.skew_sd**-2
        if prior.known is not None:
            result[: layout.n_unit] = 0.0
        result[layout.offset] = prior.offset_sd**-2
        result[layout.lean] = prior.lean_sd**-2
        if not self.gravity:
            # Attitudes are nothing to an angular rate: they stay as they are.
            result[layout.up] = 1.0
        return result[:-1]

    def _inform(self, prior: Prior, layout: Layout) -> list[tuple[slice, Floats]]:
        """Give what the prior has as matrices: where, and the inverse covariance."""
        result: list[tuple[slice, Floats]] = []
        if prior.known is not None:
            result.append((slice(0, layout.n_unit), prior.known.precision))
        result += [
            (slice(places[0], places[-1] + 1), self.start_information / prior.start_share)
            for places in layout.start
            if len(places)
        ]
        return result

    def prior_mean(self, prior: Prior, layout: Layout) -> Floats:
        """Mean of the prior; 0 for all but kappa and bias, shape (n,)."""
        mean = np.zeros(layout.n)
        if prior.known is not None:
            mean[: layout.n_unit] = prior.known.mean
            return mean
        mean[layout.kappa] = 1.0
        mean[layout.bias] = prior.bias_mean
        return mean

    def vector(self, state: State, layout: Layout) -> Floats:
        """Give the unknowns as a vector; attitudes as 0, they move in the tangent plane."""
        result = np.zeros(layout.n + 1)
        for name in _ADDED if layout.start.size else _ADDED[:-1]:
            result[getattr(layout, name)] = getattr(state, name)
        return result[:-1]

    def _moved(self, state: State, step: Floats, layout: Layout) -> State:
        padded = np.append(step, 0.0)
        up = state.up + np.einsum('pij,pj->pi', state.tangents, padded[layout.up])
        moved = {
            name: getattr(state, name) + padded[getattr(layout, name)]
            for name in (_ADDED if layout.start.size else _ADDED[:-1])
        }
        moved['weights'] = np.where(layout.weights >= 0, moved['weights'], 0.0)
        return replace(state, up=up / np.linalg.norm(up, axis=1, keepdims=True), **moved)

    def _combination(self, state: State, p: int, axis: int, force: float) -> Floats:
        """Predict one position and axis, as a combination of the base columns."""
        n_columns = len(self.windows.groups)
        # Eq. (7) with (8) and (9): bias, and scale times input.
        weight = state.weights[0, axis] + state.kappa[axis] * force * state.weights[1, axis]
        result = np.zeros(self._base.shape[1])
        result[0] = state.kappa[axis] * force + state.bias[axis] + state.offset[p, axis]
        result[1 : n_columns + 1] = weight
        moved = self.moved
        end = n_columns + 1 + len(moved)
        result[n_columns + 1 : end] = (
            weight[moved] * state.start[self._bags[p]][self.windows.lag[moved]]
        )
        turned = state.kappa[axis] * self.gravity * (state.inverse[axis] @ state.tangents[p])
        result[end:] = state.lean[p] @ turned
        return result

    def residual(self, state: State) -> Floats:
        """Measured minus predicted, shape (n, 3) [m/s^2]."""
        force = self.gravity * state.up @ state.inverse.T
        result = np.empty_like(self.measured)
        for p, rows in enumerate(self._rows):
            for axis in range(3):
                combination = self._combination(state, p, axis, float(force[p, axis]))
                result[rows, axis] = self.measured[rows, axis] - self._base[rows] @ combination
        return result

    def force(self, state: State) -> Floats:
        """Correct the windows as the compensator would, that knows no offset, shape (n, 3)."""
        along = self.measured - state.bias - self._columns @ state.weights[0].T
        along /= state.kappa * (1.0 + self._columns @ state.weights[1].T)
        return np.asarray(along @ np.linalg.inv(state.inverse).T)
