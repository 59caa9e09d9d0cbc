# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what the regression works on: the windows, the prior, the unknowns and their places."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..typing import Bools, Floats, Ints

#: Built-in prior, wide for any triad: bias [m/s^2], relative scale, elements of M [rad].
BIAS_SD, SCALE_SD, SKEW_SD = 1.0, 0.05, 1e-3


@dataclass(frozen=True)
class Windows:
    """
    The data: windows sorted by position and time, with every column of the table.

    position, bag: numbers from 0; a position lies in one bag, shape (n,)
    time: time since the bag's first sample [s], shape (n,)
    weight: samples of the window over those of a typical one, shape (n,)
    mean: mean raw samples, in input units, shape (n, 3)
    columns: values of the columns, in their physical units, with start states at their prior mean,
        shape (n, m)
    groups: group of each column
    lag: the lag whose start state moves a column; -1 for none, shape (m,)
    reach: how long a memory asks for each column [s]; 0 for none, shape (m,)
    start: derivative of each column by that state, shape (n, m)
    start_covariance: prior of the start states [K^2], shape (n_lags, n_lags)
    in_scale: which columns the scale may have as well as the bias, shape (m,)
    lean: what a support may lean with, in units of their RMS, shape (n, k)
    """

    position: Ints
    bag: Ints
    time: Floats
    weight: Floats
    mean: Floats
    columns: Floats
    groups: tuple[str, ...]
    lag: Ints
    reach: Floats
    start: Floats
    start_covariance: Floats
    in_scale: Bools
    lean: Floats

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return int(self.position[-1]) + 1

    @property
    def parts(self) -> Bools:
        """Which columns bias and scale may have, shape (2, m)."""
        return np.stack((np.ones_like(self.in_scale), self.in_scale))

    @property
    def bag_of_position(self) -> Ints:
        """Bag of each position."""
        return self.bag[np.searchsorted(self.position, np.arange(self.n_positions))]


@dataclass(frozen=True)
class Known:
    """What is known of the unit's own parameters, as `Layout` has them: mean, 1 / covariance."""

    mean: Floats
    precision: Floats


@dataclass(frozen=True)
class Prior:
    """
    What is known beforehand; standard deviations, inf for nothing.

    bias_mean, bias_sd: [m/s^2], shape (3,)
    scale_sd: of kappa, about 1
    skew_sd: of the elements of M [rad]
    widths: of the weights of each column, in units of its RMS, in the bias [m/s^2] and in the
        scale (relative); 0 for a column that takes no part, shape (2, m)
    offset_sd: of the offset of each position and axis [m/s^2]
    sigma: white noise of a typical window [m/s^2], shape (3,)
    rho: variance per second of the walk over that of the white noise, shape (3,)
    least_offset_sd: what offset_sd is at least, whatever the data say [m/s^2]
    lean_sd: what the supports lean by [rad per RMS of what they lean with]
    start_share: of the run-time prior's variance of the start states, what these bags have
    known: takes the place of all widths of the unit's own parameters; these say only which columns
        take part
    """

    bias_mean: Floats
    bias_sd: Floats
    scale_sd: float
    skew_sd: float
    widths: Floats
    offset_sd: float
    sigma: Floats
    rho: Floats
    least_offset_sd: float = 0.0
    lean_sd: float = 1e-7
    start_share: float = 1.0
    known: Known | None = None


@dataclass(frozen=True)
class State:
    """
    The unknowns; weights are of columns in units of their RMS, in bias and scale, shape (2, 3, m);
    lean is of each position, along its tangents, shape (n_positions, k, 2).
    """

    kappa: Floats
    bias: Floats
    weights: Floats
    skew: Floats
    up: Floats
    offset: Floats
    lean: Floats
    start: Floats

    @cached_property
    def inverse(self) -> Floats:
        """Return the inverse of M."""
        return inverse_misalignment(self.skew)

    @cached_property
    def tangents(self) -> Floats:
        """Return two unit vectors across each attitude, shape (n, 3, 2)."""
        return tangent_basis(self.up)


@dataclass(frozen=True)
class Layout:
    """
    Places of the unknowns in the vector of parameters, those of the unit first.

    axis: all unknowns of each axis: kappa, bias, weights, shape (3, k)
    weights: shape (2, 3, m); -1 for columns that take no part
    blocks: those of each bag
    base: what takes part of the base columns
    """

    axis: Ints
    weights: Ints
    skew: Ints
    up: Ints
    offset: Ints
    lean: Ints
    start: Ints
    n_unit: int
    blocks: tuple[slice, ...]
    n: int
    base: Ints

    @property
    def kappa(self) -> Ints:
        """Places of kappa, shape (3,)."""
        return self.axis[:, 0]

    @property
    def bias(self) -> Ints:
        """Places of the bias, shape (3,)."""
        return self.axis[:, 1]


def tangent_basis(up: Floats) -> Floats:
    """Two unit vectors across each given one, shape (n, 3, 2)."""
    helper = np.zeros_like(up)
    helper[np.arange(len(up)), np.argmin(np.abs(up), axis=1)] = 1.0
    first = np.cross(up, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(up, first)), axis=2)


def inverse_misalignment(skew: Floats) -> Floats:
    """Return A = M^-1: from the frame to the sensitivity axes, lower triangular, unit diagonal."""
    matrix = np.eye(3)
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = skew
    return matrix


def initial_state(
    windows: Windows, n_bags: int, bias: Floats, kappa: Floats, skew: Floats, up: Floats
) -> State:
    """Make a state without any thermal term."""
    return State(
        kappa=kappa,
        bias=bias,
        weights=np.zeros((2, 3, len(windows.groups))),
        skew=skew,
        up=up,
        offset=np.zeros((len(up), 3)),
        lean=np.zeros((len(up), windows.lean.shape[1], 2)),
        start=np.zeros((n_bags, len(windows.start_covariance))),
    )
