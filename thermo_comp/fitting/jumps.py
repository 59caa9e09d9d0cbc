# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the jumps: where a sensor that lies still changes by itself.

A sensor can change by itself within one sample: a die that relaxes, a part that loses its grip.
The temperature does not jump, so no function of temperature can follow, and a fit over the jump
smears it over the whole curve. A jump is told from a turn of the unit by three witnesses: the
readings beside it are as quiet as ever; the norm of the reading changes, which a turn leaves
nearly alone; the gyroscope, where there is one, saw no rotation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats, Ints
from .reduction import ReducedBag
from .sources import FitSource, angular_velocity

# Still intervals further apart than this are not looked at for a step: too much can have happened;
# nor those whose readings point so far from each other.
_LONGEST_GAP_S, _NEAR = 30.0, np.cos(np.radians(10.0))
# Readings on either side of the gap that say what the level was.
_MARGIN_S = 10.0
_FEWEST_SAMPLES = 8
# A step this many sd is one; the search over its place makes about 5 by chance.
_STEP_SDS = 8.0
# A hand on the unit leaves far more than this many times the quiet noise.
_QUIET_RATIO = 2.0
# A turn by d changes |a| by at most twice the sensor's error (10 % of g, generously) times d.
_NORM_SHARE = 0.2
# A gyro that saw less than this part of the turn needed saw none.
_TURN_SHARE = 0.33


@dataclass(frozen=True)
class Jump:
    """
    A step in the reading of a sensor at rest, which no turn of the unit explains.

    time: since the bag's first sample [s]
    duration_s: interval between the samples before and after it [s]
    step: change of the reading, per axis [input units]
    along: change of the norm, that is, along the specific force [input units]
    temperature_change, temperature_change_sd: step of the board's readings at that time, beside a
        drift, and its sd [K]; NaN where too few readings are near
    """

    time: float
    duration_s: float
    step: tuple[float, float, float]
    along: float
    temperature_change: float
    temperature_change_sd: float


def find_jumps(bag: ReducedBag) -> tuple[Jump, ...]:
    """Find the jumps between a bag's rests; streams it again only where there may be one."""
    means = [np.average(one.mean, axis=0, weights=one.count) for one in bag.intervals]
    ups = [mean / np.linalg.norm(mean) for mean in means]
    gaps = [
        ((before.end_ns - bag.start_ns) * 1e-9, (after.start_ns - bag.start_ns) * 1e-9)
        for (before, up), (after, other) in pairwise(zip(bag.intervals, ups, strict=True))
        if after.start_ns - before.end_ns <= _LONGEST_GAP_S * 1e9 and up @ other > _NEAR
    ]
    quiet_sd = np.median([interval.sample_sd for interval in bag.intervals], axis=0)
    near = _near(bag.source, bag.start_ns, gaps)
    found = (_examine(part, gap, quiet_sd, bag) for part, gap in zip(near, gaps, strict=True))
    return tuple(jump for jump in found if jump is not None)


@dataclass(frozen=True)
class _Near:
    """Samples beside one gap."""

    time: Floats
    accel: Floats
    gyro: Floats | None


def _near(
    source: FitSource, start_ns: int, gaps: Sequence[tuple[float, float]]
) -> Iterable[_Near]:
    parts: list[list[tuple[Floats, Floats, Floats | None]]] = [[] for _ in gaps]
    if gaps:
        for block in source.blocks():
            time = _seconds(block.accel_stamp_ns, start_ns)
            rate = angular_velocity(block)
            for part, (begin, end) in zip(parts, gaps, strict=True):
                use = (time >= begin - _MARGIN_S) & (time <= end + _MARGIN_S)
                use &= np.isfinite(block.accel).all(axis=1)
                if use.any():
                    part.append((time[use], block.accel[use], None if rate is None else rate[use]))
    for part in parts:
        time = np.concatenate([np.zeros(0), *(p[0] for p in part)])
        accel = np.concatenate([np.zeros((0, 3)), *(p[1] for p in part)])
        rates = [p[2] for p in part if p[2] is not None]
        yield _Near(
            time, accel, np.concatenate(rates) if part and len(rates) == len(part) else None
        )


def _seconds(stamp_ns: Ints, start_ns: int) -> Floats:
    since: Floats = (stamp_ns - start_ns).astype(np.float64) * 1e-9
    return since


def _examine(
    near: _Near, gap: tuple[float, float], quiet_sd: Floats, bag: ReducedBag
) -> Jump | None:
    beside = (near.time <= gap[0]) | (near.time >= gap[1])
    if min(np.sum(near.time <= gap[0]), np.sum(near.time >= gap[1])) < _FEWEST_SAMPLES:
        return None
    # A bump passes: only what the quiet samples on both sides show is a step.
    at = _place_of_step(near.time, near.accel, quiet_sd)
    lasting, lasting_sd = _step(near.time[beside], near.accel[beside], near.time[at], quiet_sd)
    if not np.any(np.abs(lasting) > _STEP_SDS * lasting_sd):
        return None
    step, step_sd = _step(near.time, near.accel, near.time[at], quiet_sd)
    before, after = near.accel[:at], near.accel[at:]
    spread = np.sqrt(0.5 * (_local_variance(before) + _local_variance(after)))
    middle = 0.5 * (before.mean(axis=0) + after.mean(axis=0))
    norm = float(np.linalg.norm(middle))
    along = float(np.linalg.norm(middle + 0.5 * step) - np.linalg.norm(middle - 0.5 * step))
    size = float(np.linalg.norm(step))
    along_sd = float(np.sqrt((middle / norm) ** 2 @ step_sd**2))
    needed = float(np.sqrt(max(size**2 - along**2, 0.0))) / norm
    seen = np.nan if near.gyro is None else _turn(near.time, near.gyro, at)
    is_no_turn = seen < _TURN_SHARE * needed or (
        abs(along) > _NORM_SHARE * size and abs(along) > _STEP_SDS * along_sd
    )
    if not is_no_turn or np.any(spread > _QUIET_RATIO * quiet_sd):
        return None
    warmed, warmed_sd = _temperature_step(bag, near.time[0], near.time[at], near.time[-1])
    x, y, z = step.tolist()
    return Jump(
        time=float(near.time[at]),
        duration_s=float(near.time[at] - near.time[at - 1]),
        step=(x, y, z),
        along=along,
        temperature_change=warmed,
        temperature_change_sd=warmed_sd,
    )


def _temperature_step(bag: ReducedBag, begin: float, at: float, end: float) -> tuple[float, float]:
    """Estimate what the board's readings did at a step, and the sd of that."""
    time = _seconds(bag.board.stamp_ns, bag.start_ns)
    use = (time >= begin) & (time <= end)
    time, value = time[use], bag.board.value[use]
    if min(np.sum(time < at), np.sum(time >= at)) < _FEWEST_SAMPLES:
        return np.nan, np.nan
    jump = (time >= at).astype(np.float64)
    columns = np.column_stack((_trend(time), jump))
    parameters, *_ = np.linalg.lstsq(columns, value, rcond=None)
    left = value - columns @ parameters
    spread = float(left @ left) / max(len(value) - 3, 1)
    covariance = np.linalg.inv(columns.T @ columns)
    return float(parameters[2]), float(np.sqrt(spread * covariance[2, 2]))


def _place_of_step(time: Floats, accel: Floats, quiet_sd: Floats) -> int:
    """Find the first sample after the step that explains most, beside a straight drift."""
    n = len(time)
    trend = _trend(time)
    left = accel - trend @ (trend.T @ accel)
    candidates = np.arange(_FEWEST_SAMPLES, n - _FEWEST_SAMPLES + 1)
    # Of H_k = (i >= k): its product with a residual is a sum from k on, its own square after the
    # trend is taken out follows from the trend's sums.
    tail = np.cumsum(left[::-1], axis=0)[::-1]
    trend_tail = np.cumsum(trend[::-1], axis=0)[::-1]
    square = (n - candidates) - (trend_tail[candidates] ** 2).sum(axis=1)
    gain = ((tail[candidates] / quiet_sd) ** 2).sum(axis=1) / square
    return int(candidates[int(np.argmax(gain))])


def _step(time: Floats, accel: Floats, at: float, quiet_sd: Floats) -> tuple[Floats, Floats]:
    """
    Estimate a step at a known time, beside a straight drift, and its sd from the quiet noise.
    """
    trend = _trend(time)
    jump = (time >= at).astype(np.float64)
    jump -= trend @ (trend.T @ jump)
    square = float(jump @ jump)
    return np.asarray(jump @ accel / square), np.asarray(quiet_sd / np.sqrt(square))


def _trend(time: Floats) -> Floats:
    """Columns of a level and a drift, orthonormal, shape (n, 2)."""
    t = time - time.mean()
    return np.column_stack([np.full(len(t), len(t) ** -0.5), t / np.sqrt(t @ t)])


def _local_variance(samples: Floats) -> Floats:
    """Noise from neighbouring differences, which a drift does not widen."""
    return np.asarray(0.5 * np.mean(np.diff(samples, axis=0) ** 2, axis=0))


def _turn(time: Floats, gyro: Floats, at: int) -> float:
    """
    Angle turned through within a second of the step, against the gyro's own level on each side.
    """
    levels = (np.median(gyro[:at], axis=0), np.median(gyro[at:], axis=0))
    dt = np.diff(time)
    angle = np.zeros(3)
    for i in np.flatnonzero(np.abs(time[1:] - time[at]) <= 1.0):
        angle += (gyro[i + 1] - levels[int(i + 1 >= at)]) * dt[i]
    return float(np.linalg.norm(angle))
