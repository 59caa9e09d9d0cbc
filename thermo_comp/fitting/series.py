# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the base series of the windows, and their products whitened for a noise model.

All terms of the measurement equation (`equations`) are linear combinations of a few base series.
The products of the whitened base series of each position and section are therefore sufficient for
the regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..typing import Bools, Floats, Ints
from .noise import Whitener
from .unknowns import Noise, State, Windows


@dataclass(frozen=True)
class Base:
    """
    The base series of some columns, in their order: 1, the columns, the derivatives of those with
    a lag by its initial state, t, the temperatures of the support, the measured values of the
    three axes less their mean in the position.

    columns: the active columns; moved: those of them with a lag, as places in `columns`
    lag: number of that lag
    has_t: whether t, for the nonlinear terms, is a base series
    n_tilts: number of temperatures of the support
    """

    columns: Ints
    moved: Ints
    lag: Ints
    has_t: bool
    n_tilts: int

    @cached_property
    def at_start(self) -> Ints:
        """Places of the derivatives by the initial lag states."""
        return 1 + len(self.columns) + np.arange(len(self.moved))

    @cached_property
    def t(self) -> Ints:
        """Place of t, shape (1,) or (0,)."""
        return 1 + len(self.columns) + len(self.moved) + np.arange(int(self.has_t))

    @cached_property
    def tilts(self) -> Ints:
        """Places of the temperatures of the support."""
        return 1 + len(self.columns) + len(self.moved) + len(self.t) + np.arange(self.n_tilts)

    @cached_property
    def measured(self) -> Ints:
        """Places of the measured values of the axes, shape (3,)."""
        return self.size - 3 + np.arange(3)

    @cached_property
    def size(self) -> int:
        """Number of base series."""
        return 1 + len(self.columns) + len(self.moved) + len(self.t) + self.n_tilts + 3


@dataclass(frozen=True)
class Products:
    """
    Products of the base series over the windows.

    base: the base series
    means: mean of each series in each position, shape (n_positions, n_base)
    cells: products in each position and section, shape (n_cells, n_base, n_base)
    first: first cell of each position; section: section of each cell
    """

    base: Base
    means: Floats
    cells: Floats
    first: Ints
    section: Ints

    @cached_property
    def whole(self) -> Floats:
        """Products of each position, shape (n_positions, n_base, n_base)."""
        return np.asarray(np.add.reduceat(self.cells, self.first, axis=0))

    def without(self, sections: Ints) -> Floats:
        """Products of each position without some sections, of the same shape as `whole`."""
        result: Floats = self.whole.copy()
        position = np.cumsum(np.isin(np.arange(len(self.cells)), self.first)) - 1
        gone = np.isin(self.section, sections)
        np.subtract.at(result, position[gone], self.cells[gone])
        return result


class Series:
    """
    The series of the windows, in m/s^2 of the nominal scale factor.

    windows: the data
    nominal_scale: [input units per m/s^2], shape (3,)
    t: temperature of the nonlinear terms, shape (n, 1) or (n, 0)
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
        # Derivatives below 1e-9 are set to 0, because arithmetic with denormal numbers is slow.
        self._starts = np.where(np.abs(windows.start) < 1e-9, 0.0, windows.start) / self.rms
        values, vectors = np.linalg.eigh(windows.start_covariance)
        # The initial lag states are strongly correlated: few components have nearly all variance.
        kept = values > 1e-6 * values.max(initial=0.0)
        #: Initial lag states are this times standardised components, shape (n_lags, r).
        self.start_root = vectors[:, kept] * np.sqrt(values[kept])
        self._first = np.searchsorted(windows.position, np.arange(windows.n_positions))
        self.level = self._averaged(self.measured)
        others = (t, windows.tilt, self.measured - self.level[windows.position])
        self._others = np.hstack((np.ones((len(t), 1)), *others))
        self._has_t = bool(t.shape[1])
        new_cell = np.diff(windows.position, prepend=-1) != 0
        new_cell |= np.diff(windows.section, prepend=-1) != 0
        self._cells = np.flatnonzero(new_cell)
        self.whitener = Whitener(windows.position, windows.time)
        shares = 1.0 if windows.undisturbed is None else windows.undisturbed
        self.reweigh(windows.weight * shares)

    def reweigh(self, weight: Floats) -> None:
        """Set the weights of the windows, shape (n,)."""
        self.weight = weight
        self.noise: Noise | None = None
        self._products: tuple[Bools, Products] | None = None

    def whiten(self, noise: Noise) -> None:
        """Use a noise model, to which the series are whitened."""
        if noise == self.noise:
            return
        self._gains = self.whitener.gains(self.weight, noise)
        self.noise, self._products = noise, None
        self.noise_determinant = self.whitener.log_determinant(self._gains)

    def products(self, used: Bools) -> Products:
        """Return the products of the active columns, shape (2, m), for the current noise."""
        taken: Bools = np.any(used, axis=0)
        if self._products and np.array_equal(self._products[0], taken):
            return self._products[1]
        columns = np.flatnonzero(taken)
        moved = np.flatnonzero(self.windows.lag[columns] >= 0)
        lag, n_tilts = self.windows.lag[columns[moved]], self.windows.tilt.shape[1]
        base = Base(columns, moved, lag, self._has_t, n_tilts)
        series = self.of(base)
        filtered = self.whitener.filter(series, self._gains)
        result = Products(
            base,
            self._averaged(series),
            np.stack([part.T @ part for part in np.split(filtered, self._cells[1:])]),
            np.searchsorted(self._cells, self._first),
            self.windows.section[self._cells],
        )
        self._products = taken, result
        return result

    def products_of(self, columns: Ints, base: Base) -> tuple[Floats, Floats]:
        """
        Return the products of some columns with each other and with a base, in each position,
        shapes (n_positions, k, k) and (n_positions, k, n_base).
        """
        series = np.hstack((self.columns[:, columns], self.of(base)))
        parts = np.split(self.whitener.filter(series, self._gains), self._first[1:])
        k = len(columns)
        products = np.stack([part[:, :k].T @ part for part in parts])
        return products[..., :k], products[..., k:]

    def _averaged(self, values: Floats) -> Floats:
        """Return the mean of each position, shape (n_positions, k)."""
        count = np.diff(np.append(self._first, len(values)))[:, None]
        return np.asarray(np.add.reduceat(values, self._first, axis=0) / count)

    def of(self, base: Base) -> Floats:
        """Return the series of a base, shape (n, n_base)."""
        one, others = self._others[:, :1], self._others[:, 1:]
        at_start = self._starts[:, base.columns[base.moved]]
        return np.hstack((one, self.columns[:, base.columns], at_start, others))

    def starts(self, state: State, base: Base) -> Floats:
        """Return the initial state of the lag of each moved column, (n_positions, n_moved) [K]."""
        return np.asarray((state.start @ self.start_root.T)[self.bag_of_position][:, base.lag])

    def at_starts(self, rows: Floats, state: State, base: Base) -> Floats:
        """
        Replace the columns at the prior mean of the initial lag states by those at a state, in
        linear functions of the base series, shape (n_positions, k, n_base).
        """
        if not len(base.moved):
            return rows
        result: Floats = rows.copy()
        result[..., 1 + base.moved] += self.starts(state, base)[:, None] * rows[..., base.at_start]
        return result

    def products_at(self, products: Floats, state: State, base: Base) -> Floats:
        """Replace the columns alike in products of the base, (n_positions, n_base, n_base)."""
        half = self.at_starts(products, state, base)
        return self.at_starts(np.swapaxes(half, 1, 2), state, base)
