# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the jumps: where a sensor that lies still changes by itself.

A sensor can change by itself within one sample: a die that relaxes, a part that loses its grip.
The temperature does not jump, so no function of temperature can follow, and a fit over the jump
smears it over the whole curve. A jump is told from a turn of the unit by three witnesses: the
readings beside it are as quiet as ever; the norm of the reading changes, which a turn leaves
nearly alone; the gyroscope, where there is one, saw no rotation.

Behind a low pass neighbouring samples have a correlation r, and the scatter of means hides a step.
The changes ``a_i - r a_(i-1)`` have none (whitening, or generalised least squares for noise of
the first order): beside them a step that comes within one sample stands out. So does a shock that
the low pass lets die away; hence the level must differ, too, in quiet samples on either side, over
as long as it takes to see that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats, Ints
from .reduction import ReducedBag
from .sources import angular_velocity

# Still intervals further apart than this are not looked at for a step: too much can have happened;
# nor those whose readings point so far from each other.
_LONGEST_GAP_S, _NEAR = 30.0, np.cos(np.radians(10.0))
# Readings on either side of the gap that say what the level was: so long, or so many times the
# time constant of the noise, but no longer than that.
_MARGIN_S, _MARGIN_TAUS, _LONGEST_MARGIN_S = 10.0, 60.0, 100.0
# Noise of less correlation from sample to sample is white; more cannot be told from a walk.
_COLOURED, _MOST_COLOURED = 0.4, 0.999
_FEWEST_SAMPLES = 8
_ROUNDS = 3  # place and correlation of a step, each from the other
_PIECES = 40  # into which the readings around a gap are cut for their correlation
# A step this many sd is one; the search over its place makes about 5 by chance.
_STEP_SDS = 8.0
# What whitened samples show must last: by so many sd, and by so much of it.
_LASTING_SDS, _LASTING_SHARE = 4.0, 0.5
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
    near = _near(bag, gaps, [_MARGIN_S] * len(gaps))
    # Slow noise takes longer to know its level.
    margins = [_margin(part, quiet_sd) for part in near]
    slow = [place for place, margin in enumerate(margins) if margin > _MARGIN_S]
    wider = _near(bag, [gaps[place] for place in slow], [margins[place] for place in slow])
    for place, part in zip(slow, wider, strict=True):
        near[place] = part
    found = (_examine(part, gap, quiet_sd, bag) for part, gap in zip(near, gaps, strict=True))
    return tuple(jump for jump in found if jump is not None)


def _near(
    bag: ReducedBag, gaps: Sequence[tuple[float, float]], margins: Sequence[float]
) -> list[Floats]:
    """Collect the samples beside each gap: time, reading, rate (NaN: none), shape (n, 7)."""
    parts = [[np.zeros((0, 7))] for _ in gaps]
    for block in bag.source.blocks() if gaps else ():
        time, rate = _seconds(block.accel_stamp_ns, bag.start_ns), angular_velocity(block)
        rate = np.full(block.accel.shape, np.nan) if rate is None else rate
        for part, (begin, end), margin in zip(parts, gaps, margins, strict=True):
            use = (time >= begin - margin) & (time <= end + margin)
            use &= np.isfinite(block.accel).all(axis=1)
            part.append(np.column_stack((time[use], block.accel[use], rate[use])))
    return [np.concatenate(part) for part in parts]


def _margin(near: Floats, quiet_sd: Floats) -> float:
    """Choose how far beside a gap to look, by the time constant of the noise."""
    time, accel = near[:, 0], near[:, 1:4]
    if len(time) < 2 * _FEWEST_SAMPLES:
        return _MARGIN_S
    _, r = _place_and_colour(time, accel, quiet_sd)
    tau = -float(np.median(np.diff(time))) / np.log(r) if r else 0.0
    return float(np.clip(_MARGIN_TAUS * tau, _MARGIN_S, _LONGEST_MARGIN_S))


def _seconds(stamp_ns: Ints, start_ns: int) -> Floats:
    since: Floats = (stamp_ns - start_ns).astype(np.float64) * 1e-9
    return since


def _examine(
    near: Floats, gap: tuple[float, float], quiet_sd: Floats, bag: ReducedBag
) -> Jump | None:
    time, accel, gyro = near[:, 0], near[:, 1:4], near[:, 4:]
    before, after = time <= gap[0], time >= gap[1]
    if min(before.sum(), after.sum()) < _FEWEST_SAMPLES:
        return None
    beside = before | after
    at, r = _place_and_colour(time, accel, quiet_sd)
    # A bump passes: only what the quiet samples on both sides show is a step.
    lasting, known, left = _step(time[beside], accel[beside], time[at])
    lasting_sd = quiet_sd * known * _correlation(left, quiet_sd)
    step, known, left = _step(time, accel, time[at], r)
    # Of coloured noise the scatter within a cell says little.
    sd = np.sqrt(np.mean(left**2, axis=0)) if r else quiet_sd
    step_sd = sd * known * _correlation(left, sd)
    if r:
        is_step = (np.abs(step) > _STEP_SDS * step_sd) & (lasting / step > _LASTING_SHARE)
        is_step &= np.abs(lasting) > _LASTING_SDS * lasting_sd
    else:
        is_step = np.abs(lasting) > _STEP_SDS * lasting_sd
    if not is_step.any():
        return None
    sides = accel[:at], accel[at:]
    # Noise from neighbouring differences, which a drift does not widen.
    spread = np.sqrt(0.25 * sum(np.mean(np.diff(one, axis=0) ** 2, axis=0) for one in sides))
    middle = 0.5 * (sides[0].mean(axis=0) + sides[1].mean(axis=0))
    norm = float(np.linalg.norm(middle))
    along = float(np.linalg.norm(middle + 0.5 * step) - np.linalg.norm(middle - 0.5 * step))
    size = float(np.linalg.norm(step))
    along_sd = float(np.sqrt((middle / norm) ** 2 @ step_sd**2))
    needed = float(np.sqrt(max(size**2 - along**2, 0.0))) / norm
    seen = _turn(time, gyro, at)
    is_no_turn = seen < _TURN_SHARE * needed or (
        abs(along) > _NORM_SHARE * size and abs(along) > _STEP_SDS * along_sd
    )
    if not is_no_turn or np.any(spread > _QUIET_RATIO * quiet_sd):
        return None
    warmed, warmed_sd = _temperature_step(bag, time[0], time[at], time[-1])
    x, y, z = step.tolist()
    return Jump(
        time=float(time[at]),
        duration_s=float(time[at] - time[at - 1]),
        step=(x, y, z),
        along=along,
        temperature_change=warmed,
        temperature_change_sd=warmed_sd,
    )


def _correlation(left: Floats, sd: Floats) -> Floats:
    """
    How much less well a mean is known than by white noise of `sd`, per axis, 1 or more.

    What is left beside a step, (n, 3), in twentieths of each side: their variance, and their
    correlation r from one to the next, which makes means worse by (1 + r) / (1 - r).
    """
    size = max(len(left) // _PIECES, 1)
    n = len(left) // size
    means = left[: n * size].reshape(n, size, 3).mean(axis=1)
    square = np.mean(means**2, axis=0)
    follows = np.sum(means[1:] * means[:-1], axis=0) / np.maximum(n * square, 1e-300)
    r = np.clip(follows, 0.0, 1.0 - 1.0 / n)
    worse = size * square * (1.0 + r) / (1.0 - r)
    return np.asarray(np.sqrt(np.maximum(worse / np.maximum(sd**2, 1e-300), 1.0)))


def _temperature_step(bag: ReducedBag, begin: float, at: float, end: float) -> tuple[float, float]:
    """Estimate what the board's readings did at a step, and the sd of that."""
    time = _seconds(bag.board.stamp_ns, bag.start_ns)
    use = (time >= begin) & (time <= end)
    time, value = time[use], bag.board.value[use]
    if min(np.sum(time < at), np.sum(time >= at)) < _FEWEST_SAMPLES:
        return np.nan, np.nan
    (step,), known, left = _step(time, value[:, None], at)
    spread = float(np.sum(left**2)) / max(len(value) - 3, 1)
    return float(step), known * float(np.sqrt(spread))


def _place_and_colour(time: Floats, accel: Floats, quiet_sd: Floats) -> tuple[int, float]:
    """Find the first sample after the step, and the noise's correlation, 0 where it is white."""
    at, r = _place_of_step(time, accel, quiet_sd, 0.0), 0.0
    for _ in range(_ROUNDS):
        left = _step(time, accel, time[at])[2] / quiet_sd
        follows = float(np.sum(left[1:] * left[:-1]) / max(np.sum(left**2), 1e-300))
        r = min(follows, _MOST_COLOURED) if follows > _COLOURED else 0.0
        if not r:
            break
        at = _place_of_step(time, accel, quiet_sd, r)
    return at, r


def _place_of_step(time: Floats, accel: Floats, quiet_sd: Floats, r: float) -> int:
    """Find the first sample after the step that explains most, beside a straight drift."""
    n = len(time)
    trend = _trend(time, r)
    left = whitened(accel, r)
    left = left - trend @ (trend.T @ left)
    candidates = np.arange(_FEWEST_SAMPLES, n - _FEWEST_SAMPLES + 1)
    # Of H_k = (i >= k), whitened: 1 at k, 1 - r behind. Its product with a residual is a sum from
    # k on, its own square after the trend is taken out follows from the trend's sums.
    tail = _sums_behind(left, r)[candidates]
    trend_tail = _sums_behind(trend, r)[candidates]
    square = 1.0 + (1.0 - r) ** 2 * (n - candidates - 1) - (trend_tail**2).sum(axis=1)
    gain = ((tail / quiet_sd) ** 2).sum(axis=1) / square
    return int(candidates[int(np.argmax(gain))])


def _sums_behind(rows: Floats, r: float) -> Floats:
    """Sum rows from each on, all but the first of them ``1 - r`` times."""
    return np.asarray((1.0 - r) * np.cumsum(rows[::-1], axis=0)[::-1] + r * rows)


def whitened(values: Floats, r: float) -> Floats:
    """Take out of rows a correlation r from one to the next, shape (n, k)."""
    first = np.sqrt(1.0 - r * r) * values[:1]
    return np.concatenate((first, values[1:] - r * values[:-1]))


def _step(time: Floats, values: Floats, at: float, r: float = 0.0) -> tuple[Floats, float, Floats]:
    """Estimate a step beside a drift, its sd in units of the noise, and what is left, (n, k)."""
    trend = _trend(time, r)
    jump = whitened((time >= at).astype(np.float64)[:, None], r)[:, 0]
    jump -= trend @ (trend.T @ jump)
    values = whitened(values, r)
    square = float(jump @ jump)
    step = np.asarray(jump @ values / square)
    return step, square**-0.5, values - trend @ (trend.T @ values) - np.outer(jump, step)


def _trend(time: Floats, r: float = 0.0) -> Floats:
    """Columns of a level and a drift, whitened and orthonormal, shape (n, 2)."""
    columns = np.column_stack((np.ones(len(time)), time - time.mean()))
    return np.asarray(np.linalg.qr(whitened(columns, r))[0])


def _turn(time: Floats, gyro: Floats, at: int) -> float:
    """Angle turned through within a second of the step, against the level on each side."""
    levels = (np.median(gyro[:at], axis=0), np.median(gyro[at:], axis=0))
    dt = np.diff(time)
    angle = np.zeros(3)
    for i in np.flatnonzero(np.abs(time[1:] - time[at]) <= 1.0):
        angle += (gyro[i + 1] - levels[int(i + 1 >= at)]) * dt[i]
    return float(np.linalg.norm(angle))
