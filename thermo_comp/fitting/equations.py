# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the linearised measurement equation of the windows, and its products over the windows.

Window w of position p, axis i, in m/s^2 of the nominal scale factor K0::

    N / K0 = kappa a (1 + S s) + b + B beta + o_p + kappa (A l_p)_i g + noise,
    a = (A u_p)_i g,  A = M^-1,  l_p across u_p: tilt of the support

B and S are columns of one table (`unit.columns`), each divided by its RMS. With g = 0 this is the
equation of an angular rate: b, B beta and o_p remain. If |f| differs between positions it replaces
g, and the nonlinear terms ``kappa sum_j (k_j + k'_j t) n_j(a)`` are added (`forces`).
All terms are linear combinations of a few base series (1, columns, their derivatives by the
initial lag states, t, temperatures of the support, the measured values). The products of the
whitened base series of each position and section are therefore sufficient for the regression.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..typing import Bools, Floats, Ints
from .forces import Forces
from .noise import Whitener
from .unknowns import Layout, Noise, Prior, State, Windows, lay_out

#: Row and column of the unknown elements of M^-1.
MISALIGNMENT_ROWS = ((1, 0), (2, 0), (2, 1))


@dataclass(frozen=True)
class Products:
    """
    Products of the base series of the columns in use.

    columns: the columns in use; moved: those of them with a lag; lag: number of that lag
    means: mean of the base series in each position, shape (n_positions, n_base)
    cells: products in each position and section, shape (n_cells, n_base, n_base)
    first: first cell of each position; section: section of each cell
    """

    columns: Ints
    moved: Ints
    lag: Ints
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


@dataclass(frozen=True)
class Tangent:
    """
    The equations linearised about a state, as coefficients of the base series.

    derivatives: derivatives by the unknowns, shape (n_positions, 3, n_base, n_unknowns); the
        unknowns of an axis are kappa, bias, weights, nonlinear coefficients, radius, misalignment
        (3), up (2), stretch, offset, tilts, initial lag states
    residual: measured minus predicted, shape (n_positions, 3, n_base)
    """

    derivatives: Floats
    residual: Floats


class Equations:
    """
    The measurement equations of a fit.

    windows: the data
    gravity: local gravity; 0 for an angular rate
    nominal_scale: K0 [input units per m/s^2], shape (3,)
    """

    def __init__(self, windows: Windows, gravity: float, nominal_scale: Floats) -> None:
        self.windows = windows
        self.gravity = gravity
        self.forces = windows.forces if gravity else None
        self._t = np.zeros((len(windows.time), 0))
        if self.forces is not None:
            self._t = self.forces.t[:, None]
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
        first = np.searchsorted(windows.position, np.arange(windows.n_positions))
        level = np.add.reduceat(self.measured, first, axis=0)
        level /= np.diff(np.append(first, len(windows.position)))[:, None]
        self.level = level
        self._centred = self.measured - level[windows.position]
        new_cell = np.diff(windows.position, prepend=-1) != 0
        new_cell |= np.diff(windows.section, prepend=-1) != 0
        self._cells = np.flatnonzero(new_cell)
        self.whitener = Whitener(windows.position, windows.time)
        self.reweigh(windows.weight)

    def initial_state(self, bias: Floats, misalignment: Floats, up: Floats) -> State:
        """Return a state with nominal scale factors and no effect of temperature."""
        return State(
            kappa=np.ones(3),
            bias=bias,
            weights=np.zeros((2, 3, len(self.windows.groups))),
            misalignment=misalignment,
            up=up,
            offset=np.zeros((len(up), 3)),
            tilt=np.zeros((len(up), self.windows.tilt.shape[1], 2)),
            start=np.zeros((self.n_bags, self.start_root.shape[1])),
            nonlinear=np.zeros((3, 2 * len(self.forces.kinds) if self.forces else 0)),
            radius=np.zeros(1),
            stretch=np.zeros((len(up), 1)),
        )

    def norms(self, state: State) -> Floats:
        """Return |f| of each position with the estimated radius, shape (n_positions,)."""
        if self.forces is None:
            return np.full(self.windows.n_positions, self.gravity)
        return self.forces.norms(state.radius, np.zeros_like(state.stretch))

    def along_axes(self, state: State) -> Floats:
        """Return the specific force along each axis in each position, shape (n_positions, 3)."""
        return np.asarray(self._norm(state) * state.up @ state.inverse.T)

    def _norm(self, state: State) -> float | Floats:
        if self.forces is None:
            return self.gravity
        return np.asarray(self.forces.norms(state.radius, state.stretch)[:, None])

    def reweigh(self, weight: Floats) -> None:
        """Set the weights of the windows, shape (n,)."""
        self.weight = weight
        self.noise: Noise | None = None
        self._products: tuple[Bools, Products] | None = None

    def layout(self, used: Bools, bends: Bools | None = None) -> Layout:
        """
        Assign a place to every unknown.

        `used`: active columns of bias and scale, shape (2, m); `bends`: active nonlinear
        coefficients, shape (2 k,); None for all
        """
        if bends is None or self.forces is None:
            bends = np.ones(2 * len(self.forces.kinds) if self.forces else 0, dtype=bool)
        moved = bool((self.windows.lag[used.any(axis=0)] >= 0).any())
        return lay_out(
            used,
            self.bag_of_position,
            self.windows.tilt.shape[1],
            self.start_root.shape[1] if moved else 0,
            bends,
            self.forces,
        )

    def whiten(self, noise: Noise) -> None:
        """Whiten all base series for a noise model, if the current one is another."""
        if noise == self.noise:
            return
        gains = self.whitener.gains(self.weight, noise)
        self.noise, self._products = noise, None
        self.noise_determinant = self.whitener.log_determinant(gains)
        one = np.ones((len(self.weight), 1))
        others = np.hstack((one, self._t, self.windows.tilt, self._centred))
        self._filtered_columns = self.whitener.filter(self.columns, gains)
        self._filtered_starts = self.whitener.filter(self._starts, gains)
        self._filtered_others = self.whitener.filter(others, gains)

    def products(self, used: Bools) -> Products:
        """Return the products of the active columns, shape (2, m), for the current noise."""
        taken: Bools = np.any(used, axis=0)
        if self._products is not None and np.array_equal(self._products[0], taken):
            return self._products[1]
        columns = np.flatnonzero(taken)
        moved = np.flatnonzero(self.windows.lag[columns] >= 0)
        at_start = columns[moved]
        filtered = self._filtered_others
        base = np.hstack(
            (
                filtered[:, :1],
                self._filtered_columns[:, columns],
                self._filtered_starts[:, at_start],
                filtered[:, 1:],
            )
        )
        ends = np.append(self._cells[1:], len(base))
        cells = np.stack([base[a:b].T @ base[a:b] for a, b in zip(self._cells, ends, strict=True)])
        position = self.windows.position[self._cells]
        plain = np.hstack(
            (
                np.ones((len(base), 1)),
                self.columns[:, columns],
                self._starts[:, at_start],
                self._t,
                self.windows.tilt,
                self._centred,
            )
        )
        first = np.searchsorted(self.windows.position, np.arange(self.windows.n_positions))
        count = np.diff(np.append(first, len(base)))[:, None]
        result = Products(
            columns,
            moved,
            self.windows.lag[at_start],
            np.add.reduceat(plain, first, axis=0) / count,
            cells,
            np.flatnonzero(np.diff(position, prepend=-1) != 0),
            self.windows.section[self._cells],
        )
        self._products = taken, result
        return result

    def absent_products(self, absent: Ints, used: Bools, p: int) -> tuple[Floats, Floats]:
        """Return products of inactive columns in a position: mutual, and with the active base."""
        a, b = np.searchsorted(self.windows.position, (p, p + 1))
        present = self.products(used)
        own, filtered = self._filtered_columns[a:b, absent], self._filtered_others[a:b]
        base = np.hstack(
            (
                filtered[:, :1],
                self._filtered_columns[a:b, present.columns],
                self._filtered_starts[a:b, present.columns[present.moved]],
                filtered[:, 1:],
            )
        )
        return own.T @ own, own.T @ base

    def tangent(self, state: State, layout: Layout, products: Products) -> Tangent:
        """Linearise the equations about a state."""
        used, columns = layout.used, products.columns
        n_positions, n_columns = self.windows.n_positions, len(columns)
        n_tilts, n_starts = self.windows.tilt.shape[1], layout.start.shape[1]
        n_base = products.cells.shape[1]
        force = self.along_axes(state)
        effect = self._effect(state, products)
        behind = 1 + n_columns + np.arange(len(products.moved))
        on_bias, on_scale = state.weights[:, :, columns]
        # Per axis: factor of kappa a as a combination of the base; the first base series is 1.
        scaled = np.swapaxes(effect @ on_scale.T, 1, 2)
        scaled[:, :, 0] = 1.0
        first_tilt = n_base - 3 - n_tilts
        across = self._across(state)
        in_bias, in_scale = (np.flatnonzero(mask[columns]) for mask in used)
        n_linear = 2 + len(in_bias) + len(in_scale)
        n_own = layout.axis.shape[1]
        at, n_stretches = n_own + layout.radius.size, layout.stretch.shape[1]
        behind_up = at + 5 + n_stretches
        n_all = behind_up + 1 + 2 * n_tilts + n_starts
        T = np.zeros((n_positions, 3, n_base, n_all))
        T[..., 0] = force[:, :, None] * scaled
        T[:, :, 0, 1] = 1.0
        T[..., 2 : 2 + len(in_bias)] = effect[:, None, :, in_bias]
        times = (state.kappa * (force + self._bends(state, 0)))[:, :, None, None]
        T[..., 2 + len(in_bias) : n_linear] = times * effect[:, None, :, in_scale]
        # Derivative of the reading by the force along its axis.
        answers = scaled
        if self.forces is not None:
            answers = self._bend(self.forces, state, layout, scaled, T)
            along = (state.kappa * force)[:, :, None] * answers
            T[..., at + 5 : behind_up] = along[..., None]
            if layout.radius.size:
                T[..., n_own] = self.forces.by_radius(state.radius)[:, None, None] * along
        for k, (row, source) in enumerate(MISALIGNMENT_ROWS):
            turned = (self._norm(state) * state.kappa[row] * state.up)[:, source]
            T[:, row, :, at + k] = turned[:, None] * answers[:, row]
        T[..., at + 3 : at + 5] = across[:, :, None, :] * answers[..., None]
        T[:, :, 0, behind_up] = 1.0
        for k in range(n_tilts):
            first = behind_up + 1 + 2 * k
            T[:, :, first_tilt + k, first : first + 2] = across
        if n_starts:
            weight = on_bias + times[..., 0] * on_scale
            moved = weight[:, :, products.moved, None] * self.start_root[products.lag]
            T[:, :, behind, n_all - n_starts :] = moved
        return Tangent(T, self.misfit(state, products))

    def _bend(
        self, forces: Forces, state: State, layout: Layout, scaled: Floats, T: Floats
    ) -> Floats:
        """
        Write the derivatives by the nonlinear coefficients into T; return the derivative of the
        readings by force, which is `scaled` plus the slope of the nonlinear terms.
        """
        value, slope = forces.terms(self.along_axes(state))
        # The scale's change multiplies the terms at the reference; its product with their change
        # per kelvin is negligible.
        over_t = np.zeros_like(scaled)
        over_t[:, :, -4 - self.windows.tilt.shape[1]] = 1.0
        each = np.concatenate((value, value), axis=2)
        result: Floats = scaled.copy()
        k = len(forces.kinds)
        for term, places in enumerate(layout.nonlinear.T):
            base = scaled if term < k else over_t
            of_axis = state.nonlinear[:, term]
            result += (slope[..., term % k] * of_axis)[:, :, None] * base
            T[..., 0] += (each[..., term] * of_axis)[:, :, None] * base
            if places[0] >= 0:
                column = np.flatnonzero(layout.axis[0] == places[0])[0]
                T[..., column] = (state.kappa * each[..., term])[:, :, None] * base
        return result

    def _bends(self, state: State, part: int) -> Floats | float:
        """Evaluate the nonlinear terms: at the reference (part 0), or their change per kelvin."""
        if self.forces is None:
            return 0.0
        k = len(self.forces.kinds)
        value, _ = self.forces.terms(self.along_axes(state))
        own = state.nonlinear[:, part * k : (part + 1) * k]
        return np.asarray(np.einsum('pik,ik->pi', value, own))

    def misfit(self, state: State, products: Products) -> Floats:
        """Measured minus predicted as combinations of the base, (n_positions, 3, n_base)."""
        n_base, n_tilts = products.cells.shape[1], self.windows.tilt.shape[1]
        force = self.along_axes(state)
        on_bias, on_scale = state.weights[:, :, products.columns]
        read = state.kappa * (force + self._bends(state, 0))
        weight = on_bias + read[:, :, None] * on_scale
        result = -weight @ np.swapaxes(self._effect(state, products), 1, 2)
        result[:, :, 0] = self.level - (read + state.bias + state.offset)
        if self.forces is not None:
            result[:, :, n_base - 4 - n_tilts] = -state.kappa * self._bends(state, 1)
        tilted = np.einsum('pkt,pit->pik', state.tilt, self._across(state))
        result[:, :, n_base - 3 - n_tilts : n_base - 3] = -tilted
        result[:, [0, 1, 2], n_base - 3 + np.arange(3)] = 1.0
        return np.asarray(result)

    def _across(self, state: State) -> Floats:
        """Return the derivative of each axis by a rotation of each attitude, (n, 3, 2)."""
        turned = np.einsum('ij,pjt->pit', state.inverse, state.tangents)
        if self.forces is None:
            return np.asarray(self.gravity * state.kappa[:, None] * turned)
        sizes = self.forces.norms(state.radius, state.stretch)
        return np.asarray(sizes[:, None, None] * (state.kappa[:, None] * turned))

    def _effect(self, state: State, products: Products) -> Floats:
        """
        Return each column as a combination of the base, (n_positions, n_base, n_columns): the
        column itself plus the contribution of the bag's initial lag states.
        """
        n_columns = len(products.columns)
        start = state.start[self.bag_of_position] @ self.start_root.T
        effect = np.zeros((self.windows.n_positions, products.cells.shape[1], n_columns))
        effect[:, 1 + np.arange(n_columns), np.arange(n_columns)] = 1.0
        behind = 1 + n_columns + np.arange(len(products.moved))
        effect[:, behind, products.moved] = start[:, products.lag]
        return effect

    def residual(self, state: State, layout: Layout) -> Floats:
        """Measured minus predicted, shape (n, 3) [m/s^2]."""
        products = self.products(layout.used)
        misfit = self.misfit(state, products)
        at_start = products.columns[products.moved]
        base = np.hstack(
            (
                np.ones((len(self.weight), 1)),
                self.columns[:, products.columns],
                self._starts[:, at_start],
                self._t,
                self.windows.tilt,
                self._centred,
            )
        )
        of_window = misfit[self.windows.position]
        return np.asarray(np.einsum('nb,nib->ni', base, of_window))

    def force(self, state: State, rows: slice = slice(None)) -> Floats:
        """Correct windows as the compensator does, without mounting offsets, shape (n, 3)."""
        columns = self.columns[rows]
        along = self.measured[rows] - state.bias - columns @ state.weights[0].T
        along /= state.kappa * (1.0 + columns @ state.weights[1].T)
        if self.forces is not None:
            along = self.forces.linearise(along, state.nonlinear, rows)
        return np.asarray(along @ np.linalg.inv(state.inverse).T)

    def precision(self, prior: Prior, layout: Layout) -> Floats:
        """Return inverse prior variances, shape (n,); 0 for those of an informative prior."""
        result = np.zeros(layout.n)
        result[layout.kappa] = prior.scale_sd**-2
        result[layout.bias] = prior.bias_sd**-2.0
        columns = prior.column_sd[prior.column_sd > 0.0]
        result[layout.axis[:, 2 : 2 + len(columns)]] = columns**-2.0
        if self.forces is not None:
            bends = prior.nonlinear_sd[prior.nonlinear_sd > 0.0]
            result[layout.axis[:, 2 + len(columns) :]] = bends**-2.0
            result[layout.stretch] = self.forces.stretch_sd[:, None] ** -2.0
            if layout.radius.size:
                result[layout.radius] = self.forces.radius_sd**-2.0
        result[layout.misalignment] = prior.misalignment_sd**-2
        if prior.informative is not None:
            result[: layout.n_unit] = 0.0
        result[layout.offset] = prior.offset_sd**-2
        result[layout.tilt] = prior.tilt_sd**-2
        result[layout.start] = 1.0 / prior.start_share
        # The prior of attitudes is flat. An angular rate does not depend on the attitude: the
        # precision 1 keeps the equations regular.
        result[layout.up] = 0.0 if self.gravity else 1.0
        return result

    def prior_mean(self, prior: Prior, layout: Layout) -> Floats:
        """Mean of the prior; 0 for all but kappa and bias, shape (n,)."""
        mean = np.zeros(layout.n)
        if prior.informative is not None:
            mean[: layout.n_unit] = prior.informative.mean
            return mean
        mean[layout.kappa] = 1.0
        mean[layout.bias] = prior.bias_mean
        return mean


# Unknowns to which a step is added; attitudes move in their tangent planes.
_ADDED = (
    *('kappa', 'bias', 'weights', 'misalignment', 'offset', 'tilt'),
    *('start', 'nonlinear', 'radius', 'stretch'),
)


def _added(layout: Layout) -> list[str]:
    return [name for name in _ADDED if getattr(layout, name).size]


def as_vector(state: State, layout: Layout) -> Floats:
    """Return the unknowns as a vector; its elements for attitudes, tangent steps, are 0."""
    result = np.zeros(layout.n + 1)
    for name in _added(layout):
        result[getattr(layout, name)] = getattr(state, name)
    return result[:-1]


def moved_by(state: State, step: Floats, layout: Layout) -> State:
    """Add a step to a state; inactive weights and coefficients are set to 0."""
    padded = np.append(step, 0.0)
    up = state.up + np.einsum('pij,pj->pi', state.tangents, padded[layout.up])
    moved = {name: getattr(state, name) + padded[getattr(layout, name)] for name in _added(layout)}
    for name in moved.keys() & {'weights', 'nonlinear'}:
        moved[name] = np.where(getattr(layout, name) >= 0, moved[name], 0.0)
    return replace(state, up=up / np.linalg.norm(up, axis=1, keepdims=True), **moved)
