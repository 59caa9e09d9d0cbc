# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the first guess: constant bias, scale, misalignment and attitudes from position means.

The mean of each position lies on an ellipsoid. It is fitted without temperature, first by its
best box, then by least squares on ``|f| - g``; the full regression starts from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ..errors import FitError
from ..typing import Floats, Ints
from .unknowns import Windows

# Even a cheap sensor that drifts over 60 K stays within this of an ellipsoid; motion does not.
_LARGEST_RMS = 0.05


@dataclass(frozen=True)
class ConstantCalibration:
    """The triad at one temperature: bias [input units], scale [the same per m/s^2], M."""

    bias: Floats
    scale: Floats
    misalignment: Floats

    def force(self, measured: Floats) -> Floats:
        """Specific force of measured vectors, shape (n, 3)."""
        return np.asarray(((measured - self.bias) / self.scale) @ self.misalignment.T)


def constant_calibration(
    means: Floats, gravity: float | Floats, with_misalignment: bool
) -> ConstantCalibration:
    """
    Fit the triad to position means, shape (n, 3); FitError if they lie on no ellipsoid. Where |f|
    of the positions differs, `gravity` is that of each, shape (n,).
    """
    if isinstance(gravity, np.ndarray):
        scale = np.full(3, float(np.median(np.linalg.norm(means, axis=1) / gravity)))
        found, rms = _refine(means, gravity, np.zeros(3), scale, with_misalignment)
        if not np.all(found.scale > 0.0) or not rms < _LARGEST_RMS * float(np.median(gravity)):
            raise FitError('the readings do not follow |f| as stated: are its values right?')
        return found
    bias = 0.5 * (means.max(axis=0) + means.min(axis=0))
    half = 0.5 * (means.max(axis=0) - means.min(axis=0))
    if not np.all(half > 0.0):
        raise FitError('an axis reads the same in all positions: it is dead or was never turned')
    tried = []
    for spread in (1.0, 1.3):
        scale = np.full(3, float(np.max(half)) * spread / gravity)
        scale = np.where(half * 4.0 > np.max(half), scale, half / gravity)
        tried.append(_refine(means, gravity, bias, scale, with_misalignment))
    calibration, rms = min(tried, key=lambda found: found[1])
    # Scattered points are met best by a patch of a huge ellipsoid with its centre far away.
    is_around = np.all(np.abs(calibration.bias - bias) < 2.0 * np.max(half))
    if not np.all(calibration.scale > 0.0) or not is_around or not rms < _LARGEST_RMS * gravity:
        raise FitError(
            'the positions lie on no ellipsoid: is every one of them at rest, and is it an '
            'accelerometer, with one unit for three axes at right angles?'
        )
    return calibration


def _refine(
    means: Floats, gravity: float | Floats, bias: Floats, scale: Floats, with_misalignment: bool
) -> tuple[ConstantCalibration, float]:
    unit = scale * float(np.median(gravity))

    def unpack(parameters: Floats) -> ConstantCalibration:
        matrix = np.eye(3)
        if with_misalignment:
            matrix[1, 0], matrix[2, 0], matrix[2, 1] = parameters[6:]
        return ConstantCalibration(
            bias + parameters[:3] * unit, scale * np.exp(parameters[3:6]), matrix
        )

    def residual(parameters: Floats) -> Floats:
        return np.asarray(np.linalg.norm(unpack(parameters).force(means), axis=1) / gravity - 1.0)

    found = least_squares(
        residual,
        np.zeros(9 if with_misalignment else 6),
        loss='soft_l1',
        f_scale=0.01,
        x_scale=0.1,
    )
    rms = float(np.sqrt(np.mean(residual(found.x) ** 2)))
    return unpack(found.x), float(np.median(gravity)) * rms


def position_means(windows: Windows) -> Floats:
    """Mean raw vector of each position, shape (n_positions, 3)."""
    first = np.searchsorted(windows.position, np.arange(windows.n_positions))
    total = np.add.reduceat(windows.weight, first)
    weighted = np.add.reduceat(windows.mean * windows.weight[:, None], first, axis=0)
    return np.asarray(weighted / total[:, None])


def within_positions(measured: Floats, position: Ints) -> Floats:
    """Take from what the windows measure, shape (n, 3), the mean of each position."""
    _, where, count = np.unique(position, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, where, measured)
    return np.asarray(measured - (total / count[:, None])[where])
