# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the belief about units: what a still accelerometer reads says what it reads in.

At rest the specific force is gravity, whatever the attitude: |a| is 1 in g, 9.8 in m/s^2, 1000 in
mg, and the sensitivity in counts. A log whose map says otherwise is refused, because a factor of
9.8 that nobody sees ends in a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY

Unit = Literal['m/s^2', 'g', 'mg', 'counts']

# |a| of a still sensor in each unit. A cheap one is off by a few per cent (bias and scale), a
# thermal chamber adds some more; 20 % is beyond all of them and far below the ratios to be told.
PER_G: dict[Unit, float] = {'g': 1.0, 'm/s^2': STANDARD_GRAVITY, 'mg': 1000.0}
_TOLERANCE = 0.2
# The usual sensitivities, from +-16 g to +-2 g of a 16-bit sensor.
_SENSITIVITIES = (2048, 4096, 8192, 16384)

# Windows for the noise: long enough for a standard deviation, short beside a movement.
_WINDOW_S = 2.0
_WINDOW_SAMPLES = 12
# Noise this many times the quiet level is handling, not noise: the sd of 12 samples stays within
# a factor of 2 of its mean.
_MOVING_RATIO = 4.0
# Two movements with less rest between them than this are one.
_MERGE_S = 10.0


@dataclass(frozen=True)
class Stillness:
    """
    Where a recording rests, and what it reads there.

    Median |a| over the quiet windows, NaN where there are none, and their median sd per axis, in
    the input's unit; how long it rests in all; first and last stamp of each part in which it is
    moved.
    """

    magnitude: float
    noise: float
    still_s: float
    moving_ns: tuple[tuple[int, int], ...]


def find_stillness(stamp_ns: Ints, accel: Floats) -> Stillness:
    """
    Find where a recording rests, from its noise alone, whatever its unit.

    Stamps rise, shape (n,); readings are finite, shape (n, 3).
    """
    step = float(np.median(np.diff(stamp_ns))) if len(stamp_ns) > 1 else 0.0
    length = max(_WINDOW_SAMPLES, round(_WINDOW_S * 1e9 / step)) if step > 0 else _WINDOW_SAMPLES
    n = len(stamp_ns) // length
    if n == 0:
        return Stillness(float('nan'), float('nan'), 0.0, ())
    windows = accel[: n * length].reshape(n, length, 3)
    sd = np.sqrt(windows.var(axis=1, ddof=1).mean(axis=1))
    magnitude = np.linalg.norm(windows.mean(axis=1), axis=1)
    start = stamp_ns[: n * length : length]
    end = stamp_ns[length - 1 : n * length : length]
    # The quiet level is the lower quartile: a log may be handled for most of its time. A sensor
    # whose noise is below its own step shows none: then a step is the level.
    steps = np.abs(np.diff(accel, axis=0))
    quantum = float(np.min(steps[steps > 0.0], initial=np.inf))
    level = max(float(np.quantile(sd, 0.25)), quantum if np.isfinite(quantum) else 0.0)
    is_quiet = sd <= _MOVING_RATIO * level
    return Stillness(
        magnitude=float(np.median(magnitude[is_quiet])),
        noise=float(np.median(sd[is_quiet])),
        still_s=float((end - start)[is_quiet].sum() * 1e-9),
        moving_ns=_merge(start[~is_quiet], end[~is_quiet]),
    )


def _merge(start: Ints, end: Ints) -> tuple[tuple[int, int], ...]:
    parts: list[tuple[int, int]] = []
    for first, last in zip(start.tolist(), end.tolist(), strict=True):
        if parts and first - parts[-1][1] <= _MERGE_S * 1e9:
            parts[-1] = (parts[-1][0], last)
        else:
            parts.append((first, last))
    return tuple(parts)


def believed_unit(magnitude: float) -> tuple[Unit | Literal['unknown'], str]:
    """Say which unit a still |a| speaks for (``counts`` and ``unknown`` among them), and why."""
    for unit, gravity in PER_G.items():
        if abs(magnitude / gravity - 1.0) <= _TOLERANCE:
            return unit, f'|a| at rest is {magnitude:.4g}, gravity is {gravity:.4g} {unit}'
    for sensitivity in _SENSITIVITIES:
        if abs(magnitude / sensitivity - 1.0) <= _TOLERANCE:
            return 'counts', (
                f'|a| at rest is {magnitude:.4g}, as of a sensor with {sensitivity} counts per g'
            )
    if magnitude > 50.0:
        return 'counts', f'|a| at rest is {magnitude:.4g}, which is no gravity in g or m/s^2'
    return 'unknown', f'|a| at rest is {magnitude:.4g}, which is gravity in no unit known here'


def contradiction(stated: str, magnitude: float, counts_per_g: float | None) -> str | None:
    """Say why a stated unit cannot be true, or None where nothing speaks against it."""
    if not np.isfinite(magnitude):
        return None
    believed, reason = believed_unit(magnitude)
    if stated != 'counts':
        return None if believed == stated else f'{reason}: that looks like {believed}'
    if counts_per_g is not None and abs(magnitude / counts_per_g - 1.0) > _TOLERANCE:
        text = f'|a| at rest is {magnitude:.4g} counts, {counts_per_g:g} per g are stated'
        return f'{text}: is there an `offset`?' if magnitude > 2.0 * counts_per_g else text
    if magnitude < 50.0:
        return f'{reason}: that looks like {believed}'
    return None
