# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what has moved since a calibration: nine constants fitted again to the positions.

In each position ``|f| = g`` whatever the attitude. What bias, scale and misalignment it takes to
make it so for all positions is what the axes have moved by; a calibration that still holds takes
none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..fitting.coverage import distinct_directions, norm_columns
from ..fitting.verdict import POSITIONS_NEEDED
from ..typing import Floats
from ..unit.gravity import MICRO_G
from .windows import Windows, means_by

# A shift must be this sure to be called one.
_SURE_SDS = 3.0
# Nobody knows a misalignment better than this [rad], nor the mean of a position [1].
_SMALLEST_SKEW, _SMALLEST_MISS = 1e-5, 1e-8
# What temperature leaves is alike in windows that follow each other, some so many.
_ALIKE = 6.0


@dataclass(frozen=True)
class AxisShift:
    """What an axis has moved by: bias [m/s^2], relative scale; the sds hold what was claimed."""

    bias: float
    bias_sd: float
    scale: float
    scale_sd: float


def distinct_positions(windows: Windows) -> int:
    """Count the directions that differ by more than five degrees."""
    means = means_by(windows.position, windows.force)
    return len(distinct_directions(means / np.linalg.norm(means, axis=1, keepdims=True)))


def axis_shifts(windows: Windows, misalignment_sd: tuple[float, ...]) -> tuple[AxisShift, ...]:
    """Fit nine constants to the positions' means; none with fewer than six distinct ones."""
    if distinct_positions(windows) < POSITIONS_NEEDED:
        return ()
    gravity = windows.gravity
    # Where a calibration claims little, as while its lags are unknown, it is asked little.
    weight = 1.0 / np.maximum(windows.claimed_sd, _SMALLEST_MISS) ** 2
    known = means_by(windows.position, weight)
    force = means_by(windows.position, windows.force * weight[:, None]) / known[:, None] / gravity
    residual = windows.residual
    scatter = means_by(windows.position, residual**2) - means_by(windows.position, residual) ** 2
    count = np.unique(windows.position, return_counts=True)[1]
    variance = 1.0 / known + scatter / np.maximum(count / _ALIKE, 1.0)
    sd = np.maximum(np.sqrt(np.maximum(variance, 0.0)) / gravity, _SMALLEST_MISS)
    # Linear in shifts, as small as they are: of the norms, and of a misalignment that is known.
    sizes = np.linalg.norm(force, axis=1)
    seen = norm_columns(force / sizes[:, None]) / sd[:, None]
    seen = np.vstack((seen, np.eye(9)[6:] / np.maximum(misalignment_sd, _SMALLEST_SKEW)[:, None]))
    misses = np.concatenate(((sizes - 1.0) / sd, np.zeros(3)))
    found = np.linalg.lstsq(seen, misses, rcond=None)[0]
    # What the constants leave unexplained makes them less sure.
    freedom, left = len(sd) - 6, float(np.sum((misses - seen @ found) ** 2))
    excess = max(1.0, left / freedom) if freedom > 0 else 1.0
    spread = np.sqrt(np.diag(np.linalg.pinv(seen.T @ seen)) * excess)
    return tuple(
        AxisShift(
            float(found[i]) * gravity,
            float(spread[i]) * gravity,
            float(found[3 + i]),
            float(spread[3 + i]),
        )
        for i in range(3)
    )


def what_moved(shifts: tuple[AxisShift, ...]) -> tuple[str, ...]:
    """Name the shifts that are sure, as in ``z bias +12 +- 3 ug``."""
    said = []
    for axis, shift in zip('xyz', shifts, strict=False):
        for name, value, sd, unit in (
            ('bias', shift.bias / MICRO_G, shift.bias_sd / MICRO_G, 'ug'),
            ('scale', 1e6 * shift.scale, 1e6 * shift.scale_sd, 'ppm'),
        ):
            if abs(value) > _SURE_SDS * sd:
                said.append(f'{axis} {name} {value:+.3g} +- {sd:.2g} {unit}')
    return tuple(said)


def rms_by_axis(windows: Windows) -> Floats:
    """Give the RMS of each axis about its mean in a position, static and dynamic, shape (2, 3)."""
    _, place = np.unique(windows.position, return_inverse=True)
    about = windows.force - means_by(windows.position, windows.force)[place]
    return np.array(
        [
            np.sqrt(np.mean(about[rows] ** 2, axis=0)) if rows.any() else np.full(3, np.nan)
            for rows in (~windows.is_dynamic, windows.is_dynamic)
        ]
    )
