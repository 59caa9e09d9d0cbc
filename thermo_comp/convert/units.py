# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the belief about units: what a still accelerometer reads says what it reads in.

At rest the specific force is gravity, whatever the attitude. A log whose map says otherwise is
refused, because a factor of 9.8 that nobody sees ends in a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..recording.stillness import CellAccumulator
from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY

Unit = Literal['m/s^2', 'g', 'mg', 'counts']

# |a| of a still sensor in each unit. A cheap one is off by a few per cent (bias and scale), a
# thermal chamber adds some more; 20 % is beyond all of them and far below the ratios to be told.
PER_G: dict[Unit, float] = {'g': 1.0, 'm/s^2': STANDARD_GRAVITY, 'mg': 1000.0}
_TOLERANCE = 0.2
# The usual sensitivities, from +-16 g to +-2 g of a 16-bit sensor.
_SENSITIVITIES = (2048, 4096, 8192, 16384)

_CELL_S, _MIN_SAMPLES = 0.5, 12
_RUN_ROWS = 1 << 16  # reduced at once: bounded memory
# Noise this many times the quiet level is handling, not noise: the sd of 12 samples stays within
# a factor of 2 of its mean.
_MOVING_RATIO = 4.0
# Two movements with less rest between them than this are one.
_MERGE_NS = 10 * 10**9


@dataclass(frozen=True)
class Stillness:
    """
    Where a recording rests, and what it reads there.

    Median |a| over the quiet cells, NaN where there are none, and their median sd per axis, in
    the input's unit; how long it rests in all; begin and end of each part in which it is moved.
    """

    magnitude: float
    noise: float
    still_s: float
    moving_ns: tuple[tuple[int, int], ...]


def find_stillness(stamp_ns: Ints, accel: Floats) -> Stillness:
    """
    Find where a recording rests, from its noise alone, whatever its unit, and however shortly;
    readings (n, 3).
    """
    reduced = CellAccumulator(_CELL_S, None)
    for first in range(0, len(accel), _RUN_ROWS):
        run = slice(first, first + _RUN_ROWS)
        reduced.add(stamp_ns[run], accel[run])
    cells = reduced.finish()
    full = cells.count >= _MIN_SAMPLES
    if full.any():
        full &= cells.count >= 0.5 * np.median(cells.count)
    if not full.any():
        return Stillness(float('nan'), float('nan'), 0.0, ())
    sd = np.sqrt(cells.variance[full].mean(axis=1))
    # The quiet level is the lower quartile: a log may be handled for most of its time. A sensor
    # whose noise is below its own step shows none: then a step is the level.
    is_quiet = sd <= _MOVING_RATIO * max(np.quantile(sd, 0.25), cells.quantum.max())
    cell_ns = round(cells.cell_s * 1e9)
    moving: list[tuple[int, int]] = []
    for begin in (cells.start_ns + cells.index[full][~is_quiet] * cell_ns).tolist():
        is_next = moving and begin - moving[-1][1] <= _MERGE_NS
        moving.append((moving.pop()[0] if is_next else begin, begin + cell_ns))
    return Stillness(
        magnitude=float(np.median(np.linalg.norm(cells.mean[full][is_quiet], axis=1))),
        noise=float(np.median(sd[is_quiet])),
        still_s=float(is_quiet.sum() * cells.cell_s),
        moving_ns=tuple(moving),
    )


def believed_unit(magnitude: float) -> tuple[Unit | Literal['unknown'], str]:
    """Say which unit a still |a| speaks for (``counts`` and ``unknown`` among them), and why."""
    said = f'|a| at rest is {magnitude:.4g}'
    for unit, gravity in PER_G.items():
        if abs(magnitude / gravity - 1.0) <= _TOLERANCE:
            return unit, f'{said}, gravity is {gravity:.4g} {unit}'
    for sensitivity in _SENSITIVITIES:
        if abs(magnitude / sensitivity - 1.0) <= _TOLERANCE:
            return 'counts', f'{said}, as of a sensor with {sensitivity} counts per g'
    if magnitude > 50.0:
        return 'counts', f'{said}, which is no gravity in g or m/s^2'
    return 'unknown', f'{said}, which is gravity in no unit known here'


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
    return f'{reason}: that looks like {believed}' if magnitude < 50.0 else None
