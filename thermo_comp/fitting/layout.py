# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the index of each unknown of a fit in the vector of unknowns, and the measurement equations
linearised with respect to the unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from .nonlinear import Forces


@dataclass(frozen=True)
class Layout:
    """
    Indices of the unknowns of a fit, named as in `State`, in the vector of all unknowns: first the
    unknowns of the unit, then for each bag the unknowns of its positions and of the bag itself.

    axis: kappa, bias, active weights and active nonlinear coefficients of each axis, shape (3, k)
    weights: weights of each column in the bias and in the scale, -1 if inactive, shape (2, 3, m)
    nonlinear: nonlinear coefficients, -1 if inactive, shape (3, 2 k)
    start, turn_on: initial lag states of each bag, shape (n_bags, r), and the bias offset of its
        turn-on, shape (n_bags, 3) or (n_bags, 0)
    own: all unknowns of each position, in the order `up` (attitude, 2), `stretch` (error of the
        known |f|, 1 or 0), `offset` (bias offset, 3), `tilt`; shape (n_positions, k)
    pose_of: number of each position's pose (not an index of unknowns), -1 without a pose
    bag: number of each position's bag
    n_unit, n: number of unknowns of the unit, and number of all unknowns
    """

    axis: Ints
    weights: Ints
    misalignment: Ints
    up: Ints
    offset: Ints
    tilt: Ints
    start: Ints
    turn_on: Ints
    nonlinear: Ints
    radius: Ints
    stretch: Ints
    pose: Ints
    pose_of: Ints
    own: Ints
    bag: Ints
    n_unit: int
    n: int

    @property
    def kappa(self) -> Ints:
        """Indices of kappa, shape (3,)."""
        return self.axis[:, 0]

    @property
    def bias(self) -> Ints:
        """Indices of the bias, shape (3,)."""
        return self.axis[:, 1]

    @cached_property
    def shared(self) -> Ints:
        """Indices of the unit's unknowns common to all axes: radius, misalignment and poses."""
        return np.concatenate((self.radius, self.misalignment, self.pose.ravel()))

    @property
    def posed(self) -> Ints:
        """Indices of the attitudes of the k positions that are in a pose, shape (k, 2)."""
        return self.up[self.pose_of >= 0]

    @cached_property
    def columns(self) -> Ints:
        """
        Indices of the columns of a position's equations that belong to each axis, in the order of
        `Tangent`: unknowns of the position, of its bag and of the unit, residual; shape (3, k).
        """
        n_own, r = self.own.shape[1], self.start.shape[1]
        starts = np.tile(n_own + np.arange(r), (3, 1))
        turn_ons = n_own + r + np.arange(self.turn_on.shape[1]).reshape(3, -1)
        unit = n_own + self.of_bag.shape[1] + self.unit
        return np.hstack((self.of_axis, starts, turn_ons, unit))

    @cached_property
    def unit(self) -> Ints:
        """Indices of the unit's unknowns, then the residual, in each axis' equations, (3, k)."""
        common = np.append(self.shared, self.n_unit)
        return np.hstack((self.axis, np.tile(common, (3, 1))))

    @property
    def n_local(self) -> int:
        """Number of unknowns of a position and its bag in the equations of one axis."""
        return len(self.of_axis[0]) + len(self.start[0]) + len(self.turn_on[0]) // 3

    @cached_property
    def of_bag(self) -> Ints:
        """Indices of r lag states and 3 or 0 turn-on offsets of each bag, (n_bags, r + 3 or r)."""
        return np.hstack((self.start, self.turn_on))

    @cached_property
    def of_axis(self) -> Ints:
        """Columns of `own` with the unknowns that occur in the equations of each axis, (3, k)."""
        first = self.up.shape[1] + self.stretch.shape[1]
        before, after = range(first), range(first + 3, self.own.shape[1])
        return np.array([[*before, first + axis, *after] for axis in range(3)])

    @cached_property
    def used(self) -> Bools:
        """Whether bias and scale have a weight of each of the m columns, shape (2, m)."""
        return np.asarray(self.weights[:, 0] >= 0)

    def by_weights(self, columns: Floats, force: Floats) -> Iterator[tuple[Floats, Ints]]:
        """
        Yield, for each axis, the derivatives of the readings w.r.t. the active weights, and the
        indices of these weights; `columns`: (n, m); `force` along the axes: (n, 3) or (3,).
        """
        in_bias, in_scale = self.used
        for axis in range(3):
            along = np.hstack((columns[:, in_bias], force[..., [axis]] * columns[:, in_scale]))
            yield along, self.axis[axis, 2 : 2 + along.shape[1]]


def lay_out(
    used: Bools,
    active: Bools,
    bag_of_position: Ints,
    pose_of: Ints | None,
    n_tilts: int,
    n_starts: int,
    has_turn_ons: bool,
    forces: Forces | None,
) -> Layout:
    """
    Assign an index to every unknown; `used`: active columns of bias and scale, shape (2, m);
    `active`: active nonlinear coefficients, shape (2 k,).
    """
    n = 0

    def take(*shape: int) -> Ints:
        nonlocal n
        size = int(np.prod(shape))
        n += size
        return np.arange(n - size, n).reshape(shape)

    n_linear = 2 + int(used.sum())
    axis = take(3, n_linear + int(active.sum()))
    weights = np.full((2, 3, used.shape[1]), -1)
    weights.transpose(1, 0, 2)[:, used] = axis[:, 2:n_linear]
    nonlinear = np.full((3, len(active)), -1)
    nonlinear[:, active] = axis[:, n_linear:]
    radius = take(int(forces is not None and forces.radius_sd > 0.0))
    misalignment = take(3)
    pose_of = np.full(len(bag_of_position), -1) if pose_of is None else pose_of
    pose = take(int(pose_of.max()) + 1, 2)
    n_unit = n
    n_positions, n_bags = len(bag_of_position), int(bag_of_position.max()) + 1
    n_stretches = int(forces is not None and bool(forces.sd.any()))
    own = np.empty((n_positions, 2 + n_stretches + 3 + 2 * n_tilts), dtype=np.int64)
    start = np.empty((n_bags, n_starts), dtype=np.int64)
    turn_on = np.empty((n_bags, 3 * has_turn_ons), dtype=np.int64)
    for bag in range(n_bags):
        for p in np.flatnonzero(bag_of_position == bag):
            own[p] = take(own.shape[1])
        start[bag] = take(n_starts)
        turn_on[bag] = take(3 * has_turn_ons)
    up, stretch, offset, tilt = np.split(own, np.cumsum([2, n_stretches, 3]), axis=1)
    return Layout(
        *(axis, weights, misalignment, up, offset, tilt.reshape(n_positions, n_tilts, 2), start),
        *(turn_on, nonlinear, radius, stretch, pose, pose_of),
        *(own, bag_of_position, n_unit, n),
    )


class Normal(NamedTuple):
    """
    The data's part of the normal equations of each axis (without the prior): sums over whitened
    windows of products of the readings' derivatives and residual, in the order of `Tangent`.

    local: for each position, the products of the derivatives w.r.t. the unknowns of the position
        and its bag with all derivatives and the residual, shape (n_positions, 3, n_local, k + 1)
    unit: the products of all pairs of the derivatives w.r.t. the unit's unknowns and the residual,
        summed over all positions, shape (3, n, n)
    """

    local: Floats
    unit: Floats

    def scaled(self, factor: Floats) -> Normal:
        """Multiply the normal equations of each axis by its element of `factor`, shape (3,)."""
        return Normal(self.local * factor[:, None, None], self.unit * factor[:, None, None])

    @property
    def square(self) -> Floats:
        """Sum of squares of the whitened residuals of each axis, shape (3,)."""
        return np.asarray(np.maximum(self.unit[:, -1, -1], 0.0))


@dataclass(frozen=True)
class Tangent:
    """
    The measurement equations linearised about a state, as sums of base series (`series.Base`).

    The derivative of the readings w.r.t. an unknown is a factor times a base series, or times a
    linear combination of base series (one of `combined`). For axis i, position p and unknown u the
    derivative is ``factor[p, i, u]`` times series ``place[u]``: a base series or, from index
    n_base on, one of `combined`. Unknowns of an axis, in this order: of the position (2 of the
    attitude, stretch, offset, tilts), of the bag (initial lag states, turn-on offset), and of the
    unit (kappa, bias, weights, nonlinear coefficients, radius, 3 of the misalignment, 2 of each
    pose). The last element is for the residual, measured minus predicted.

    combined: weights of the base series in each combination, (n_positions, 3, n_base, n_combined)
    place: index of each unknown's series, a base series or one of `combined`, shape (k + 1,)
    factor: factor of each unknown's series in its derivative, shape (n_positions, 3, k + 1)
    n_local: number of the unknowns of position and bag, the first unknowns of an axis
    n_bias: number of unknowns after kappa that have the factor 1: the bias and its weights
    n_scale: number of weights in the scale, which follow the weights in the bias
    scale: the factor of the weights in the scale, shape (n_positions, 3)
    """

    combined: Floats
    place: Ints
    factor: Floats
    n_local: int
    n_bias: int
    n_scale: int
    scale: Floats

    def normal(self, products: Floats) -> Normal:
        """
        Build normal equations from `products`, sums of the products of all pairs of base series in
        each position, shape (n_positions, n_base, n_base).
        """
        first, with_combined = self.n_local, products[:, None] @ self.combined
        place = self.place[first:]
        n, bias = len(place), slice(1, 1 + self.n_bias)
        scale = slice(bias.stop, bias.stop + self.n_scale)
        # Sums, over the positions, of `products` times the power 0, 1 or 2 of `scale`.
        powers = np.stack([self.scale**k for k in range(3)])
        sums = np.tensordot(powers.transpose(2, 0, 1), products, 1)
        unit = np.empty((3, n, n))
        for rows, columns, k in ((bias, bias, 0), (bias, scale, 1), (scale, scale, 2)):
            block = sums[:, k, place[rows, None], place[columns]]
            unit[:, rows, columns] = block
            unit[:, columns, rows] = np.swapaxes(block, 1, 2)
        others = np.array([0, *range(scale.stop, n)])
        rows_of = self._rows(np.append(np.arange(first), first + others), products, with_combined)
        of_others = rows_of[:, :, first:, first:].sum(axis=0)
        unit[:, others] = of_others
        unit[:, :, others] = np.swapaxes(of_others, 1, 2)
        return Normal(rows_of[:, :, :first], unit)

    def _rows(self, unknowns: Ints, products: Floats, with_combined: Floats) -> Floats:
        """Return the rows of the normal equations of m unknowns, (n_positions, 3, m, k + 1)."""
        n, series = products.shape[-1], self.place[unknowns]
        base, combined = np.flatnonzero(series < n), np.flatnonzero(series >= n)
        by_series = np.empty((*with_combined.shape[:2], len(series), n + with_combined.shape[-1]))
        of_combined = self.combined[..., series[combined] - n]
        by_series[:, :, base, :n] = products[:, None, series[base]]
        by_series[:, :, base, n:] = with_combined[:, :, series[base]]
        by_series[:, :, combined, :n] = np.swapaxes(with_combined[..., series[combined] - n], 2, 3)
        by_series[:, :, combined, n:] = np.swapaxes(of_combined, 2, 3) @ with_combined
        result = by_series.take(self.place, axis=3)
        result *= self.factor[:, :, unknowns, None]
        result *= self.factor[:, :, None]
        return np.asarray(result)

    def at(self, places: Ints) -> Tangent:
        """Return the linearised equations of the positions with the indices `places`."""
        kept = {name: getattr(self, name)[places] for name in ('combined', 'factor', 'scale')}
        return replace(self, **kept)

    def of(self, rows: Floats) -> Floats:
        """
        Return the derivatives of m linear functions of the readings, such as the mean, shape
        (n_positions, 3, m, k + 1); `rows`: these functions of the base series, (n_positions, m,
        n_base).
        """
        combined = rows[:, None] @ self.combined
        of_base = np.broadcast_to(rows[:, None], (*combined.shape[:3], rows.shape[2]))
        by_series = np.concatenate((of_base, combined), axis=3)
        return np.asarray(by_series[..., self.place] * self.factor[:, :, None])
