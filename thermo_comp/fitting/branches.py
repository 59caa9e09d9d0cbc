# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the branches of a rest: where a sensor that lies still jumps, and the runs between the jumps.

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
from typing import Literal

import numpy as np

from ..typing import Floats, Ints
from .reduction import ReducedBag
from .sources import FitSource, angular_velocity

# Still intervals further apart than this are not looked at for a step: too much can have happened.
_LONGEST_GAP_S = 30.0
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
class Event:
    """
    A step in the reading of a sensor at rest.

    kind: the sensor changed by itself; it may have been turned, quietly; it was moved
    time: since the bag's first sample [s]
    stamp_ns: stamp of the first sample after it
    duration_s: interval between the samples before and after it [s]
    step: change of the reading, per axis [input units]
    along, along_sd: change of the norm, that is, along the specific force, and its sd [input
        units]
    temperature_change, temperature_change_sd: step of the board's readings at that time, beside a
        drift, and its sd [K]; NaN where too few readings are near
    turn_needed, turn_seen: angle by which the unit would have to turn for such a step, and what
        the gyroscope saw [rad]; NaN without one
    """

    kind: Literal['jump', 'turn', 'motion']
    time: float
    stamp_ns: int
    duration_s: float
    step: tuple[float, float, float]
    along: float
    along_sd: float
    temperature_change: float
    temperature_change_sd: float
    turn_needed: float
    turn_seen: float


@dataclass(frozen=True)
class Branch:
    """
    A run at rest in one attitude without a step.

    start_s, end_s: from a step (or the first still interval's start) to the next step (or the last
        one's end), since the bag's first sample [s]
    still: its still intervals [s]
    """

    start_s: float
    end_s: float
    still: tuple[tuple[float, float], ...]


def find_branches(
    source: FitSource, bag: ReducedBag
) -> tuple[tuple[Event, ...], tuple[Branch, ...]]:
    """Find the steps between a bag's still intervals, and the branches between the steps."""
    spans = [
        ((i.start_ns - bag.start_ns) * 1e-9, (i.end_ns - bag.start_ns) * 1e-9)
        for i in bag.intervals
    ]
    gaps = [(a[1], b[0]) for a, b in pairwise(spans)]
    short = [gap for gap in gaps if gap[1] - gap[0] <= _LONGEST_GAP_S]
    quiet_sd = np.median([interval.sample_sd for interval in bag.intervals], axis=0)
    found = {
        gap: _examine(near, gap, quiet_sd, bag)
        for gap, near in zip(short, _near(source, bag.start_ns, short), strict=True)
    }
    events: list[Event] = []
    branches: list[Branch] = []
    run, start = spans[:1], spans[0][0] if spans else 0.0
    for gap, span in zip(gaps, spans[1:], strict=True):
        event = found.get(gap)
        if event is not None or gap not in found:
            end, following = gap if event is None else (event.time, event.time)
            branches.append(Branch(start, end, tuple(run)))
            run, start = [], following
        if event is not None:
            events.append(event)
        run.append(span)
    if run:
        branches.append(Branch(start, run[-1][1], tuple(run)))
    return tuple(events), tuple(branches)


@dataclass(frozen=True)
class _Near:
    """Samples beside one gap."""

    time: Floats
    stamp_ns: Ints
    accel: Floats
    gyro: Floats | None


def _near(
    source: FitSource, start_ns: int, gaps: Sequence[tuple[float, float]]
) -> Iterable[_Near]:
    parts: list[list[tuple[Ints, Floats, Floats | None]]] = [[] for _ in gaps]
    if gaps:
        for block in source.blocks():
            time = _seconds(block.accel_stamp_ns, start_ns)
            rate = angular_velocity(block)
            for part, (begin, end) in zip(parts, gaps, strict=True):
                use = (time >= begin - _MARGIN_S) & (time <= end + _MARGIN_S)
                use &= np.isfinite(block.accel).all(axis=1)
                if use.any():
                    part.append(
                        (
                            block.accel_stamp_ns[use],
                            block.accel[use],
                            None if rate is None else rate[use],
                        )
                    )
    for part in parts:
        stamps = np.concatenate([p[0] for p in part]) if part else np.zeros(0, dtype=np.int64)
        accel = np.concatenate([p[1] for p in part]) if part else np.zeros((0, 3))
        rates = [p[2] for p in part if p[2] is not None]
        gyro = np.concatenate(rates) if part and len(rates) == len(part) else None
        yield _Near(_seconds(stamps, start_ns), stamps, accel, gyro)


def _seconds(stamp_ns: Ints, start_ns: int) -> Floats:
    since: Floats = (stamp_ns - start_ns).astype(np.float64) * 1e-9
    return since


def _examine(
    near: _Near, gap: tuple[float, float], quiet_sd: Floats, bag: ReducedBag
) -> Event | None:
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
    is_quiet = bool(np.all(spread <= _QUIET_RATIO * quiet_sd))
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
    warmed, warmed_sd = _temperature_step(bag, near.time[0], near.time[at], near.time[-1])
    x, y, z = step.tolist()
    return Event(
        kind='motion' if not is_quiet else ('jump' if is_no_turn else 'turn'),
        time=float(near.time[at]),
        stamp_ns=int(near.stamp_ns[at]),
        duration_s=float(near.time[at] - near.time[at - 1]),
        step=(x, y, z),
        along=along,
        along_sd=along_sd,
        temperature_change=warmed,
        temperature_change_sd=warmed_sd,
        turn_needed=needed,
        turn_seen=seen,
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
