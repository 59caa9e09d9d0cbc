# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the indices of the unknowns in the vector of parameters of the regression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from .nonlinear import Forces


@dataclass(frozen=True)
class Layout:
    """
    Indices of the unknowns (named as in `State`) in the vector of parameters, the unit's first.

    axis: scale ratio kappa, bias, active weights and nonlinear coefficients of each axis, (3, k)
    weights, nonlinear: indices of the weights, shape (2, 3, m), and of the nonlinear coefficients,
        shape (3, 2 k); -1 for an inactive unknown
    start, turn_on: unknowns of each bag: initial lag states, and the bias offset of its turn-on,
        shapes (n_bags, r) and (n_bags, 3) or (n_bags, 0)
    own: attitude, error of |f|, bias offset and tilts of each position, shape (n_positions, k)
    pose_of: index of each position's pose, -1 without a pose
    bag: index of each position's bag
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
        Indices of the columns of a position's equations (for unknowns of the position, its bag and
        the unit, and for the residual) in the order of `Tangent`, for each axis, shape (3, k).
        """
        n_own, r = self.own.shape[1], self.start.shape[1]
        starts = np.tile(n_own + np.arange(r), (3, 1))
        turn_ons = n_own + r + np.arange(self.turn_on.shape[1]).reshape(3, -1)
        unit = n_own + self.of_bag.shape[1] + self.unit
        return np.hstack((self.of_axis, starts, turn_ons, unit))

    @cached_property
    def unit(self) -> Ints:
        """Indices of the unit's unknowns by axis, n_unit for the residual, (3, k)."""
        common = np.append(self.shared, self.n_unit)
        return np.hstack((self.axis, np.tile(common, (3, 1))))

    @property
    def n_local(self) -> int:
        """Number of unknowns of a position and its bag in the equations of one axis."""
        return len(self.of_axis[0]) + len(self.start[0]) + len(self.turn_on[0]) // 3

    @cached_property
    def of_bag(self) -> Ints:
        """Indices of the unknowns of each bag, shape (n_bags, r + 3) or (n_bags, r)."""
        return np.hstack((self.start, self.turn_on))

    @cached_property
    def of_axis(self) -> Ints:
        """Column indices, in `own`, of a position's unknowns in each axis' equations, (3, k)."""
        first = self.up.shape[1] + self.stretch.shape[1]
        before, after = range(first), range(first + 3, self.own.shape[1])
        return np.array([[*before, first + axis, *after] for axis in range(3)])

    @cached_property
    def used(self) -> Bools:
        """Whether bias and scale have a weight of each of the m columns, shape (2, m)."""
        return np.asarray(self.weights[:, 0] >= 0)

    def by_weights(self, columns: Floats, force: Floats) -> Iterator[tuple[Floats, Ints]]:
        """
        Yield, for each axis, the derivatives of readings w.r.t. the active weights, and indices of
        these weights; `columns`: shape (n, m); `force` along the axes: shape (n, 3) or (3,).
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
    Assign an index to every unknown, given the active columns of bias and scale, shape (2, m), and
    the active nonlinear coefficients, shape (2 k,).
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
