# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the data types of the regression: the windows of a fit, the prior and the unknowns."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from .nonlinear import Forces

#: Built-in prior sd of a bias [m/s^2]: 100 mg, more than data sheets of consumer MEMS state.
BIAS_SD = 1.0
#: Built-in prior sd of an axis' scale factor, relative to the mean of the axes.
SCALE_SD = 0.05
#: Typical sd of the attitude of a unit that is returned to a pose by hand [rad].
POSE_SD = 1e-3
#: Smallest built-in prior sd of an element of the misalignment [rad], see `misalignment_scale`.
MISALIGNMENT_SD = 1e-3


def misalignment_scale(noise: float) -> float:
    """
    Return the built-in prior sd of an element of the misalignment [rad]. The sd is 1 mrad for a
    `noise` up to 10 ug in a bandwidth of 1 Hz (navigation grade, machined faces), and rises with
    the noise [m/s^2] up to 10 mrad (cross-axis sensitivity of consumer MEMS).
    """
    return float(np.clip(10.0 * noise, MISALIGNMENT_SD, 1e-2))


@dataclass(frozen=True)
class Windows:
    """
    The data of a fit: the mean samples of n windows, sorted by position and time, and the values
    of all m columns in these windows.

    position, bag: indices, over all bags, of each window's position and of its bag, shape (n,)
    section: index, 0 to 5, of the sixth of its position in which each window lies, shape (n,)
    time: time since the bag's first sample [s], shape (n,)
    weight: number of samples of each window, divided by the median of these numbers, shape (n,)
    mean: mean raw samples, in input units, shape (n, 3)
    columns: values of the columns, for initial lag states at the prior mean, (n, m)
    groups: name of each column's group, m names
    kelvins: RMS / largest slope over temperature of each column [K], 0 if constant, shape (m,)
    lag: index of each column's lag; -1 for a column without lag, shape (m,)
    start: derivative of each column w.r.t. the initial state of its lag, shape (n, m)
    start_covariance: prior covariance of the initial lag states [K^2], shape (n_lags, n_lags)
    in_scale: whether each column may act on the scale as well as on the bias, shape (m,)
    tilt: k functions of temperature, of RMS 1; a support's tilt is a weighted sum of them, (n, k)
    forces: known |f| and nonlinear terms, or None if |f| is gravity in all positions
    undisturbed: factors of `weight`, < 1 for an outlier, (n,); None: the fit estimates the factors
    acts_on: axes on which each column acts, shape (m, 3); None if each acts on all axes
    pose: index of each position's pose, -1 without a pose, shape (n_positions,); None: no poses
    has_prior: whether the fit has a prior calibration
    board: board temperature [degC] and the variance of its estimate [K^2], (n, 2); None: unknown
    board_noise: sd of the noise of a reading of the board's thermometer [K]
    settled: columns at k constant temperatures over the range of the windows, with settled lags,
        shape (k, m), or None if the fit does not use them
    """

    position: Ints
    bag: Ints
    section: Ints
    time: Floats
    weight: Floats
    mean: Floats
    columns: Floats
    groups: tuple[str, ...]
    kelvins: Floats
    lag: Ints
    start: Floats
    start_covariance: Floats
    in_scale: Bools
    tilt: Floats
    forces: Forces | None = None
    undisturbed: Floats | None = None
    acts_on: Bools | None = None
    pose: Ints | None = None
    has_prior: bool = False
    board: Floats | None = None
    board_noise: float = 0.0
    settled: Floats | None = None

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return int(self.position[-1]) + 1

    @cached_property
    def share(self) -> Floats:
        """Factor of each weight's prior sd: 1e-6 on an axis on which its column does not act."""
        acts = np.ones((len(self.groups), 3), bool) if self.acts_on is None else self.acts_on
        return np.where(acts.T, 1.0, 1e-6)

    @cached_property
    def has_drifts(self) -> bool:
        """Whether a column changes within a position."""
        same = self.position[1:] == self.position[:-1]
        return bool(np.diff(self.columns, axis=0)[same].any())

    @property
    def parts(self) -> Bools:
        """Whether each column may act on the bias and on the scale, shape (2, m)."""
        return np.stack((np.ones_like(self.in_scale), self.in_scale))

    @cached_property
    def edges(self) -> Ints:
        """Index of each position's first window, then the number of windows, (n_positions+1,)."""
        return np.searchsorted(self.position, np.arange(self.n_positions + 1))

    @cached_property
    def mounting(self) -> Ints:
        """
        Index of each position's mounting, from 0, shape (n_positions,).

        Successive positions of a bag whose mean samples differ by less than 2 degrees (3.5 % of
        the norm) are rests of one mounting, interrupted by a knock or a gap.
        """
        first, bag = self.edges[:-1], self.bag_of_position
        means = np.add.reduceat(self.mean, first, axis=0) / np.diff(self.edges)[:, None]
        step, size = np.linalg.norm(np.diff(means, axis=0), axis=1), np.linalg.norm(means, axis=1)
        is_new = (bag[1:] != bag[:-1]) | (step >= math.radians(2.0) * size[1:])
        return np.concatenate(([0], np.cumsum(is_new)))

    @property
    def bag_of_position(self) -> Ints:
        """Index of each position's bag, shape (n_positions,)."""
        return self.bag[self.edges[:-1]]

    @property
    def n_poses(self) -> int:
        """Number of the poses to which the unit was returned."""
        return 0 if self.pose is None else int(self.pose.max()) + 1

    @property
    def n_turn_ons(self) -> int:
        """Number of turn-ons: each bag counts as one turn-on."""
        return len(np.unique(self.bag))

    @cached_property
    def has_turn_ons(self) -> bool:
        """
        Whether turn-on offsets are unknowns of the fit. The fit can separate turn-on offsets from
        mounting offsets if the turn-ons have on average two or more mountings. Without a prior
        calibration the offset of a single turn-on is part of the bias.
        """
        fewest = 1 if self.has_prior else 2
        return fewest <= self.n_turn_ons <= (int(self.mounting[-1]) + 1) / 2

    @property
    def age(self) -> Floats:
        """Time since the first window of the bag, shape (n,) [s]."""
        first = np.searchsorted(self.bag, np.arange(int(self.bag[-1]) + 1))
        return np.asarray(self.time - self.time[first][self.bag])


class Noise(NamedTuple):
    """
    Slow noise: one Gauss-Markov process, or flicker noise (bias instability), which is the sum of
    several such processes of equal variance, with correlation times in steps of a factor of ten.

    ratio: stationary variance of each process / white-noise variance of a window of weight 1
    time_s: the shortest correlation time [s]
    n_times: number of Gauss-Markov processes
    """

    ratio: float = 0.0
    time_s: float = 1.0
    n_times: int = 1

    @property
    def times_s(self) -> list[float]:
        """Correlation times of the Gauss-Markov processes [s]."""
        return [self.time_s * 10.0**k for k in range(self.n_times)]

    @property
    def variance(self) -> float:
        """Variance of the sum of the processes / white-noise variance of a window of weight 1."""
        return self.ratio * self.n_times

    @property
    def rate(self) -> float:
        """Sd of slow noise's change in a short time t / (sqrt(t) white-noise sd) [1/sqrt(s)]."""
        return math.sqrt(sum(2.0 * self.ratio / time_s for time_s in self.times_s))


@dataclass(frozen=True)
class InformativePrior:
    """
    Gaussian prior of the unit's unknowns, in the order of `Layout`, from a prior calibration.

    mean: prior mean of the unknowns, shape (n_unit,)
    root: upper triangular R with ``R.T @ R`` the inverse covariance, shape (n_unit, n_unit)
    log_density: log prior density of the amount of ageing that this prior assumes
    is_changed: whether the covariance is far larger than the prior calibration's covariance
    """

    mean: Floats
    root: Floats
    log_density: float = 0.0
    is_changed: bool = False


@dataclass(frozen=True)
class Prior:
    """
    Standard deviations of the prior of the unknowns, and the noises of the windows.

    bias_sd: sd of the bias [m/s^2], about a mean of 0, shape (3,)
    scale_mean, scale_sd: mean, shape (3,), and sd of each axis' scale factor / nominal scale
    misalignment_sd: sd of the elements of the misalignment matrix M [rad]
    column_sd: sd of the weights of columns divided by their RMS, in the bias [m/s^2] and in the
        scale (relative); 0 for an inactive column, shape (2, m)
    offset_sd: sd of the bias offset of a position on each axis [m/s^2], due to its mounting and,
        if turn-on offsets are no unknowns, to its turn-on
    turn_on_sd: sd of the bias offset of a turn-on, common to the positions of a bag [m/s^2]
    sigma: sd of the white noise of a window of weight 1 [m/s^2], shape (3,)
    least_sigma: lower bound of sigma [m/s^2]; the default is below the noise of any sensor
    noise: slow noise of the samples
    offset_scale: scale of the half-Student priors of offset_sd and turn_on_sd [m/s^2]; 0: both sds
        are constant
    misalignment_scale: built-in prior sd of the elements of M, see `misalignment_scale` [rad]
    unseen_misalignment_sd: sd of the elements of M [rad] in the calibration; 0 unless positions
        near the faces of a cube do not determine M and `misalignment_sd` is smaller
    tilt_sd: sd of the coefficients of the tilts of a support [rad], see `Windows.tilt`
    pose_sd: sd of attitudes about their pose [rad]; attitudes without a pose have a flat prior
    start_variance_ratio: variance of the initial lag states / their variance in the node's prior
    nonlinear_sd: sds of the k nonlinear coefficients of an axis, then of their changes per kelvin;
        0 for an inactive coefficient, shape (2 k,)
    informative: prior that replaces all sds of the unit's unknowns, or None; with such a prior
        column_sd only marks the active columns, by values above 0
    """

    column_sd: Floats
    offset_sd: float
    sigma: Floats
    bias_sd: Floats = field(default_factory=lambda: np.full(3, BIAS_SD))
    scale_sd: float = SCALE_SD
    misalignment_sd: float = MISALIGNMENT_SD
    noise: Noise = field(default_factory=Noise)
    scale_mean: Floats = field(default_factory=lambda: np.ones(3))
    offset_scale: float = 0.0
    turn_on_sd: float = 1e-5
    misalignment_scale: float = MISALIGNMENT_SD
    unseen_misalignment_sd: float = 0.0
    tilt_sd: float = 1e-7
    least_sigma: float = 1e-7
    pose_sd: float = POSE_SD
    start_variance_ratio: float = 1.0
    nonlinear_sd: Floats = field(default_factory=lambda: np.zeros(0))
    informative: InformativePrior | None = None


@dataclass(frozen=True)
class State:
    """
    The values of the unknowns of the regression.

    kappa: scale factor of each axis divided by its nominal scale factor, shape (3,)
    bias: bias of each axis [m/s^2], shape (3,)
    weights: weights of the columns divided by their RMS, in the bias [m/s^2] and in the scale
        (relative), shape (2, 3, m)
    misalignment: elements of the inverse of M below the diagonal, shape (3,)
    up: upward unit vector of each position, its attitude, shape (n_positions, 3)
    offset: bias offset of each position [m/s^2], shape (n_positions, 3)
    tilt: coefficients of the support's tilts along `tangents` [rad], shape (n_positions, k, 2)
    start: initial lag states of each bag, in units of their sd, shape (n_bags, r)
    turn_on: bias offset of each bag's turn-on [m/s^2], shape (n_bags, 3) or (n_bags, 0)
    nonlinear: nonlinear coefficients in the order of `Forces`, shape (3, 2 k)
    radius: relative error of a centrifuge's radius, common to all positions, shape (1,) or (0,)
    stretch: relative error of the known |f|, shape (n_positions, 1) or (n_positions, 0)
    pose: upward unit vectors of the poses, shape (n_poses, 3)
    pose_of: index of each position's pose, -1 without a pose, (n_positions,); (0,) without poses
    """

    kappa: Floats
    bias: Floats
    weights: Floats
    misalignment: Floats
    up: Floats
    offset: Floats
    tilt: Floats
    start: Floats
    turn_on: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    nonlinear: Floats = field(default_factory=lambda: np.zeros((3, 0)))
    radius: Floats = field(default_factory=lambda: np.zeros(0))
    stretch: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    pose: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    pose_of: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @cached_property
    def inverse(self) -> Floats:
        """The inverse of the misalignment matrix M, shape (3, 3)."""
        return inverse_misalignment(self.misalignment)

    @cached_property
    def tangents(self) -> Floats:
        """
        Two vectors perpendicular to the `up` of each attitude, shape (n, 3, 2). For an attitude
        with a pose the vectors are the tangents of the pose, projected perpendicular to `up`.
        """
        result = tangent_basis(self.up)
        if self.pose.size:
            is_posed = self.pose_of >= 0
            up, basis = self.up[is_posed], self.pose_tangents[self.pose_of[is_posed]]
            result[is_posed] = basis - up[:, :, None] * np.einsum('pi,pij->pj', up, basis)[:, None]
        return result

    @cached_property
    def pose_tangents(self) -> Floats:
        """Two unit vectors perpendicular to each vector of `pose`, shape (n_poses, 3, 2)."""
        return tangent_basis(self.pose)

    @property
    def from_pose(self) -> Floats:
        """Deviation of k attitudes from their poses along `pose_tangents` [rad], (k, 2)."""
        posed = self.pose_of[self.pose_of >= 0]
        change = self.up[self.pose_of >= 0] - self.pose[posed]
        return np.asarray(np.einsum('pi,pij->pj', change, self.pose_tangents[posed]))


def tangent_basis(up: Floats) -> Floats:
    """Return two unit vectors perpendicular to each vector of `up`, shape (n, 3, 2)."""
    helper = np.zeros_like(up)
    helper[np.arange(len(up)), np.argmin(np.abs(up), axis=1)] = 1.0
    first = _cross(up, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, _cross(up, first)), axis=2)


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of vectors, (n, 3), several times faster than `numpy.cross`."""
    after, before = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[:, after] * b[:, before] - a[:, before] * b[:, after])


def inverse_misalignment(misalignment: Floats) -> Floats:
    """Return the inverse of M, (3, 3), from the inverse's three elements below the diagonal."""
    matrix = np.eye(3)
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = misalignment
    return matrix
