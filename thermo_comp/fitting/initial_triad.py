# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the initial triad: constant bias, scale and misalignment from the mean samples of positions.

Without thermal effects the mean samples of the positions lie on an ellipsoid, which is fitted by
robust least squares on ``|f| - g``. If |f| is the same in all positions, the fit begins with the
bias and scale computed from the extremes of the mean samples on each axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.optimize import least_squares

from ..errors import FitError
from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.metrics import means_by
from .unknowns import BIAS_SD, SCALE_SD, Windows


@dataclass(frozen=True)
class ConstantCalibration:
    """Constant bias [input units], scale [input units per m/s^2] and misalignment matrix M."""

    bias: Floats
    scale: Floats
    misalignment: Floats

    def force(self, measured: Floats) -> Floats:
        """Return the specific force [m/s^2] for samples `measured`, shape (n, 3)."""
        return np.asarray(((measured - self.bias) / self.scale) @ self.misalignment.T)

    def directions(self, windows: Windows) -> Floats:
        """Return the direction of the specific force in each position, shape (n_positions, 3)."""
        up = self.force(position_means(windows))
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def constant_calibration(
    means: Floats, gravity: float | Floats, misalignment_sd: float
) -> ConstantCalibration:
    """
    Fit the triad to position means, (n, 3); FitError if the means do not lie on an ellipsoid.

    `gravity`: |f| of all positions, or of each position, shape (n,) [m/s^2];
    `misalignment_sd`: prior sd of the misalignments [rad]; 0 for axes at right angles
    """
    # Largest RMS distance from the ellipsoid [m/s^2]: 5 % of |f|, which is above the drift of a
    # cheap sensor over 60 K, and below the error for a unit in motion.
    largest_rms = 0.05 * float(np.median(gravity))
    if isinstance(gravity, np.ndarray):
        scale = np.full(3, float(np.median(np.linalg.norm(means, axis=1) / gravity)))
        calibration, rms = _refine(means, gravity, np.zeros(3), scale, misalignment_sd)
        if not rms < largest_rms:
            raise FitError(
                'the readings at rest contradict the stated |f|: are the values in '
                '--specific-force, --radius or the metadata of the bags right?'
            )
        return calibration
    bias = 0.5 * (means.max(axis=0) + means.min(axis=0))
    half = 0.5 * (means.max(axis=0) - means.min(axis=0))
    if not np.all(half > 0.0):
        axes = ', '.join('xyz'[k] for k in np.flatnonzero(half == 0.0))
        raise FitError(
            f'an axis ({axes}) reads the same in all positions: the axis is dead, or the unit was '
            'never turned about another axis'
        )
    # An axis that was not held both up and down has samples that range over less than 2 g. The fit
    # therefore begins from two scale factors: half the range / g, and 1.3 times this value.
    scales = (float(np.max(half)) * spread / gravity for spread in (1.0, 1.3))
    starts = (np.where(half * 4.0 > np.max(half), scale, half / gravity) for scale in scales)
    tried = (_refine(means, gravity, bias, scale, misalignment_sd) for scale in starts)
    calibration, rms = min(tried, key=lambda fitted: fitted[1])
    # Samples that lie on no ellipsoid may fit a large ellipsoid with a far centre: refuse it.
    is_around = np.all(np.abs(calibration.bias - bias) < 2.0 * np.max(half))
    if not (is_around and rms < largest_rms):
        raise FitError(
            'the mean readings of the positions do not lie on an ellipsoid: was the unit at rest '
            'in every position, and are these the readings of an accelerometer, with three axes '
            'at right angles and in one unit of measurement?'
        )
    return calibration


def _refine(
    means: Floats, gravity: float | Floats, bias: Floats, scale: Floats, misalignment_sd: float
) -> tuple[ConstantCalibration, float]:
    """Fit the triad from initial bias and scale; return also the RMS error of |f| [m/s^2]."""
    one_g = float(np.median(gravity))

    def unpack(parameters: Floats) -> ConstantCalibration:
        matrix = np.eye(3)
        matrix[[1, 2, 2], [0, 0, 1]] = misalignment_sd * parameters[6:]
        return ConstantCalibration(
            bias + parameters[:3] * scale * one_g, scale * np.exp(parameters[3:6]), matrix
        )

    def errors(calibration: ConstantCalibration) -> Floats:
        return np.asarray(np.linalg.norm(calibration.force(means), axis=1) / gravity - 1.0)

    def residual(parameters: Floats) -> Floats:
        # |f| of few positions hardly determines some constants, so their built-in prior is added,
        # with the weight for an error of |f| of 0.1 %.
        calibration = unpack(parameters)
        bias_sd = BIAS_SD / STANDARD_GRAVITY * one_g
        log_scale = np.log(np.abs(calibration.scale))
        of_prior = (
            calibration.bias / calibration.scale / bias_sd,
            (log_scale - log_scale.mean()) / SCALE_SD,
            parameters[6:],
        )
        return np.concatenate((errors(calibration), 1e-3 * np.concatenate(of_prior)))

    solution = least_squares(
        residual, np.zeros(9), loss='soft_l1', f_scale=0.01, x_scale=[0.1] * 6 + [1.0] * 3
    )
    calibration = unpack(solution.x)
    return calibration, one_g * float(np.sqrt(np.mean(errors(calibration) ** 2)))


def position_means(windows: Windows) -> Floats:
    """Return the mean of the samples of each position, shape (n_positions, 3)."""
    return block_means(windows.mean, windows.weight, windows.edges[:-1])


def block_means(values: Floats, weight: Floats, first: Ints) -> Floats:
    """Return the weighted mean of each block of rows, (n, k); blocks begin at rows `first`."""
    total = np.add.reduceat(weight, first)
    return np.asarray(np.add.reduceat(values * weight[:, None], first, axis=0) / total[:, None])


def white_noise_of(windows: Windows, scale: Floats) -> Floats:
    """
    Return the sd of the white noise of a window's mean on each axis [m/s^2], shape (3,).

    The sd is computed from second differences of windows, which contain no linear drift; it is 0
    if no position has three windows. In fast ramps second differences contain a part of the drift.
    The smallest noise by second, fourth and sixth differences is used if it is below 70 % of the
    noise by second differences.
    """
    position, noises = windows.position, []
    for order in (2, 4, 6):
        differences = np.diff(windows.mean / scale, n=order, axis=0)
        is_within = position[order:] == position[:-order]
        if is_within.any():
            size = np.median(np.abs(differences[is_within]), axis=0)
            noises.append(size / (0.6745 * np.sqrt(comb(2 * order, order))))
    if not noises:
        return np.zeros(3)
    smallest = np.min(noises, axis=0)
    return np.asarray(np.where(smallest < 0.7 * noises[0], smallest, noises[0]))


def thermometer_error_of(windows: Windows, scale: Floats, *, beyond_noise: bool = False) -> Floats:
    """
    Return the sd of a window's error on each axis due to errors of the board temperature [m/s^2],
    shape (3,): sd of the temperature error times slope of the samples over temperature.

    `beyond_noise`: subtract the noise variance of a reading from the variance of the temperature
    error; the rest is due to coarse steps of the readings, or long intervals between readings
    """
    if windows.board is None:
        return np.zeros(3)
    first = windows.edges[:-1]
    drift = within_positions(windows.mean / scale, windows.position)
    change = within_positions(windows.board[:, :1], windows.position)
    power = np.maximum(np.add.reduceat(change**2, first), 1e-12)
    along = np.add.reduceat(change * drift, first)
    # Subtract the part of the explained sum of squares that is due to white noise.
    square = along**2 / power - white_noise_of(windows, scale) ** 2
    slope = np.sqrt(np.maximum(square.sum(axis=0), 0.0) / power.sum())
    variance = float(windows.board[:, 1].mean()) - beyond_noise * windows.board_noise**2
    return np.asarray(slope * np.sqrt(max(variance, 0.0)))


def within_positions(values: Floats, position: Ints) -> Floats:
    """Return values of windows, shape (n, k), less their mean over the position."""
    _, where = np.unique(position, return_inverse=True)
    return np.asarray(values - means_by(position, values)[where])
