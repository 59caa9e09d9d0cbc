# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the batch form of the compensator: whole columns at once, with the stream's bits.

The thermal side runs reading by reading through the same tracker; only what it gives at the
segments' ends is gathered, evaluated for all segments together and applied to all samples with
the operations of `Compensator.process` in their order.
"""

from __future__ import annotations

from array import array
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..thermal.reading_queue import refused_readings
from ..typing import Bools, Floats, Ints, Stamps
from ..unit.correction import Correction
from .blocks import AccelBlock, CompensatedBlock
from .compensator import TIME_JUMP_NS, Compensator
from .kernel import Lines, correct, correct_rates
from .segments import SEGMENT_NS, lay_lines

#: Where xx, xy, xz, yy, yz, zz stand in a row of the covariance.
_UNIQUE = [0, 1, 2, 4, 5, 8]


class _Segments:
    """
    Runs of samples over which the correction is linear in time, as columns.

    Columns of numbers, not a list of runs: objects that stay keep the garbage collector busy.
    """

    __slots__ = (
        'after',
        'end_states',
        'first',
        'is_new',
        'is_too_fast',
        'noise_excess',
        'slow',
        'start_ns',
        'states',
    )

    def __init__(self) -> None:
        self.start_ns: list[int] = []
        #: Their samples are first..after - 1.
        self.first: list[int] = []
        self.after: list[int] = []
        #: Not the rest of one that the end of the block before has cut.
        self.is_new: list[bool] = []
        #: Held back because the samples come too fast; and what the rate adds to their noise.
        self.is_too_fast: list[bool] = []
        self.noise_excess: list[float] = []
        #: What parameters and starts leave uncertain, nine numbers each.
        self.slow = array('d')
        #: The thermal states at both ends, one behind the other.
        self.states = array('d')
        self.end_states = array('d')

    def columns(self, numbers: array[float]) -> list[Floats]:
        """Give what stands one behind the other, as columns."""
        table = np.frombuffer(numbers).reshape(len(self.start_ns), -1)
        return list(table.T.copy())


def process_block(
    compensator: Compensator, block: AccelBlock, angular_rate: Floats | None = None
) -> CompensatedBlock:
    """
    Correct a block, e.g. a `recording.Block`, with the bits that `Compensator.process` gives, and
    the angular rate of its samples, shape (n, 3), with those of `correct_rate`.

    Flags wait in `Compensator.take_flags`, counts in its `counters`.
    """
    if not compensator.corrects_rate:
        angular_rate = None
    counters = compensator.counters
    n_seen = counters.n_in - counters.n_out_of_order
    stamps = np.asarray(block.accel_stamp_ns, dtype=np.int64)
    samples = np.asarray(block.accel, dtype=np.float64)
    if not len(stamps) or (
        int(stamps[0]) > compensator.last_ns and (stamps[1:] > stamps[:-1]).all()
    ):
        index = np.arange(len(stamps), dtype=np.int64)
        kept_before = None
    else:
        before = np.maximum.accumulate(np.concatenate(([compensator.last_ns], stamps)))[:-1]
        if np.any(stamps <= before - TIME_JUMP_NS):
            return _one_by_one(compensator, block, angular_rate)
        in_order = stamps > before
        index = np.flatnonzero(in_order)
        counters.n_out_of_order += len(stamps) - len(index)
        kept_before = np.concatenate(([0], np.cumsum(in_order)))
        stamps, samples = stamps[index], samples[index]
    segments = _run_thermal_side(compensator, block, stamps, kept_before, n_seen)
    if len(stamps):
        compensator.last_ns = int(stamps[-1])
    return _apply(compensator, segments, index, stamps, samples, angular_rate)


def _one_by_one(
    compensator: Compensator, block: AccelBlock, angular_rate: Floats | None
) -> CompensatedBlock:
    """Process a block in which time jumps: rare, so the stream's own code serves."""
    events = [
        (int(after), name, int(stamp_ns), float(celsius))
        for name in compensator.thermal.inputs
        if name in block.temperatures
        for stamp_ns, celsius, after in zip(*block.temperatures[name], strict=True)
    ]
    events.sort(key=lambda event: event[0])
    index, rows, rates = [], [], []
    k = 0
    stamps = block.accel_stamp_ns.tolist()
    for i, (stamp_ns, sample) in enumerate(zip(stamps, block.accel.tolist(), strict=True)):
        while k < len(events) and events[k][0] <= i:
            compensator.push(*events[k][1:])
            k += 1
        row = compensator.process(stamp_ns, *sample)
        if row is not None:
            index.append(i)
            rows.append(row)
            if angular_rate is not None:
                rates.append(compensator.correct_rate(stamp_ns, *angular_rate[i].tolist()))
    for _, name, stamp_ns, celsius in events[k:]:
        compensator.push(name, stamp_ns, celsius)
    where = np.array(index, dtype=np.int64)
    table = np.array(rows).reshape(-1, 9)
    result = CompensatedBlock(
        where,
        np.asarray(block.accel_stamp_ns)[where],
        table[:, :3],
        table[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]],
    )
    if angular_rate is None:
        return result
    table = np.array(rates).reshape(-1, 6)
    return replace(result, angular_rate=table[:, :3], angular_rate_variance=table[:, 3:])


def _run_thermal_side(
    compensator: Compensator,
    block: AccelBlock,
    stamps: Stamps,
    kept_before: Stamps | None,
    n_seen: int,
) -> _Segments:
    segments = _Segments()
    n_samples = len(stamps)
    # A reading takes effect at the first sample that is not before it and that comes after it.
    pending = compensator.take_pending()
    columns = [list(column) for column in zip(*pending, strict=True)] or [[], [], [], []]
    parts: list[tuple[npt.ArrayLike, ...]] = [(*columns, [0] * len(pending))]
    for kind, name in enumerate(compensator.thermal.inputs):
        if name in block.temperatures:
            own_ns, celsius, place = block.temperatures[name]
            # Behind whatever was pushed before: only the order within one sensor and stamp counts.
            later = np.arange(len(own_ns)) + (1 << 60)
            place = np.asarray(place) if kept_before is None else kept_before[np.asarray(place)]
            parts.append((own_ns, np.full(len(own_ns), kind), later, celsius, place))
    reading_ns, kinds, orders, arrival = (
        np.concatenate([np.asarray(part[k], np.int64) for part in parts]) for k in (0, 1, 2, 4)
    )
    values = np.concatenate([np.asarray(part[3], dtype=np.float64) for part in parts])
    effect = np.maximum(np.searchsorted(stamps, reading_ns, side='left'), arrival)
    order = np.lexsort((orders, kinds, reading_ns, effect))
    queue = compensator.thermal.queue
    refused = refused_readings(reading_ns, kinds, arrival, effect, len(pending), queue.last_ns)
    if refused is not None:
        for kind, n_refused in enumerate(np.bincount(kinds[refused]).tolist()):
            compensator.thermal.count_rejected(kind, n_refused)
        order = order[~refused[order]]
    n_due = int(np.searchsorted(effect[order], n_samples))
    due, waiting = order[:n_due], np.sort(order[n_due:])
    events = zip(
        *(column[due].tolist() for column in (effect, reading_ns, kinds, values)), strict=True
    )
    thermal = compensator.thermal
    position = 0
    for at, stamp_ns, kind, celsius in events:
        if at > position:
            _add_segments(compensator, segments, stamps, position, at, n_seen)
            position = at
        thermal.apply(stamp_ns, kind, celsius)
    if position < n_samples:
        _add_segments(compensator, segments, stamps, position, n_samples, n_seen)
    for i in waiting.tolist():
        kind = int(kinds[i])
        if not queue.put(int(reading_ns[i]), kind, float(values[i])):
            thermal.count_rejected(kind, 1)
    for kind in range(len(thermal.inputs)):
        own_ns = reading_ns[len(pending) :][kinds[len(pending) :] == kind]
        if len(own_ns):
            queue.last_ns[kind] = int(own_ns[-1])
    return segments


def _add_segments(
    compensator: Compensator,
    segments: _Segments,
    stamps: Stamps,
    first: int,
    after: int,
    n_seen: int,
) -> None:
    """Add the segments of samples first..after, over which no reading takes effect."""
    thermal = compensator.thermal
    last_ns = stamps.item(after - 1)
    fresh_ns = thermal.fresh_until_ns
    if last_ns > fresh_ns:
        fresh = int(np.searchsorted(stamps[first:after], fresh_ns, 'right'))
        thermal.count_unmeasured(after - first - fresh)
        after = first + fresh
    while first < after:
        stamp_ns = stamps.item(first)
        start_ns = thermal.start_of(stamp_ns)
        end_ns = start_ns + SEGMENT_NS
        if last_ns < end_ns:
            stop = after
        else:
            stop = first + int(np.searchsorted(stamps[first:after], end_ns, 'left'))
        is_new = thermal.open(start_ns, n_seen + first, stamp_ns)
        is_too_fast = thermal.rate_refuses and (is_new or compensator.is_refusing)
        segments.start_ns.append(start_ns)
        segments.first.append(first)
        segments.after.append(stop)
        segments.is_new.append(is_new)
        segments.is_too_fast.append(is_too_fast)
        segments.noise_excess.append(thermal.noise_excess)
        end = thermal.sample(end_ns)
        for of_axis in thermal.slow_at(start_ns, end):
            segments.slow.extend(of_axis)
        segments.states.extend(thermal.sample(start_ns))
        segments.end_states.extend(end)
        first = stop


def _apply(
    compensator: Compensator,
    segments: _Segments,
    index: Ints,
    stamps: Stamps,
    samples: Floats,
    angular_rate: Floats | None,
) -> CompensatedBlock:
    rates: tuple[Floats, ...] = ()
    if not segments.first:
        none = np.empty((0, 3))
        found = CompensatedBlock(index[:0], stamps[:0], none, np.empty((0, 9)))
        if angular_rate is None:
            return found
        return replace(found, angular_rate=none, angular_rate_variance=none)
    slow = segments.columns(segments.slow)
    ends = segments.columns(segments.states), segments.columns(segments.end_states)
    excess = np.array(segments.noise_excess)

    def lines_of(correction: Correction, first: int) -> list[Floats]:
        of_axes = [(slow[k], slow[k + 1], slow[k + 2]) for k in (first, first + 3, first + 6)]
        return lay_lines(correction, *ends, of_axes, excess)

    correction = compensator.thermal.correction
    columns = lines_of(correction, 0)
    counts = np.array(segments.after) - np.array(segments.first)
    if int(counts.sum()) < len(stamps):
        covered = zip(segments.first, segments.after, strict=True)
        source = np.concatenate([np.arange(first, after) for first, after in covered])
        index, stamps, samples = index[source], stamps[source], samples[source]
    start_ns = np.array(segments.start_ns, dtype=np.int64)
    lines = Lines(start_ns, columns, counts)
    force, covariance = correct(lines, correction.misalignment, stamps, samples)
    full_scale = compensator.calibration.unit.full_scale
    keep: Bools = np.asarray((np.abs(samples) < full_scale).all(axis=1))
    is_stuck = _stuck(compensator, stamps, samples)
    _judge(compensator, segments, counts, stamps, samples, force, covariance, keep, is_stuck)
    if angular_rate is not None and compensator.thermal.rate_correction is not None:
        columns = lines_of(compensator.thermal.rate_correction, 9)
        rates = correct_rates(Lines(start_ns, columns, counts), stamps, angular_rate[index])
    if not keep.all():
        index, stamps = index[keep], stamps[keep]
        force, covariance = force[keep], covariance[keep]
        rates = tuple(one[keep] for one in rates)
    compensator.counters.n_out += len(index)
    return CompensatedBlock(index, stamps, force, covariance, *rates)


def _judge(
    compensator: Compensator,
    segments: _Segments,
    counts: Ints,
    stamps: Stamps,
    samples: Floats,
    force: Floats,
    covariance: Floats,
    keep: Bools,
    is_stuck: Bools | None,
) -> None:
    """Leave out what the stream would not publish, and count why."""
    counters = compensator.counters
    is_good = keep
    if is_stuck is not None:
        is_good = keep.copy()
        keep &= ~is_stuck
    begins = np.cumsum(counts) - counts
    is_refuted = _refuted(compensator, segments, begins, stamps, force, covariance, keep)
    is_too_fast = segments.is_too_fast
    compensator.is_refusing = is_too_fast[-1] or is_refuted[-1]
    n_kept = int(np.count_nonzero(keep))
    if n_kept == len(keep) and not any(is_too_fast) and not any(is_refuted):
        return
    is_good = is_good.copy()
    # Every sample of a segment that is held back counts for that; the first one of a refuted
    # segment has been looked at like any other.
    is_fast_row = np.repeat(is_too_fast, counts)
    is_held_row = np.repeat(is_refuted, counts)
    first = begins[np.array(is_refuted) & np.array(segments.is_new)]
    is_held_row[first] = False
    counters.n_too_fast += int(np.count_nonzero(is_fast_row))
    counters.n_refuted += int(np.count_nonzero(is_held_row))
    is_seen = ~(is_fast_row | is_held_row)
    if not is_good.all():
        is_bad = is_seen & ~is_good
        n_not_finite = int(np.count_nonzero(~np.isfinite(samples[is_bad]).all(axis=1)))
        counters.n_not_finite += n_not_finite
        counters.n_saturated += int(np.count_nonzero(is_bad)) - n_not_finite
    if is_stuck is not None:
        counters.n_stuck += int(np.count_nonzero(is_seen & is_good & is_stuck))
    keep &= is_seen
    counters.n_refuted += int(np.count_nonzero(keep[first]))
    keep[first] = False


def _refuted(
    compensator: Compensator,
    segments: _Segments,
    begins: Ints,
    stamps: Stamps,
    force: Floats,
    covariance: Floats,
    keep: Bools,
) -> list[bool]:
    """Let each segment's first sample tell of gravity; say which segments that holds back."""
    gravity, trace = compensator.gravity, compensator.thermal.correction.noise_trace
    is_refuted: list[bool] = []
    firsts = zip(
        stamps[begins].tolist(),
        force[begins].tolist(),
        covariance[begins][:, _UNIQUE].tolist(),
        keep[begins].tolist(),
        segments.is_new,
        segments.is_too_fast,
        strict=True,
    )
    for stamp_ns, mean, spread, is_kept, is_new_one, is_fast in firsts:
        if not is_new_one:
            is_refuted.append(compensator.is_refusing and not is_fast)
            continue
        is_refuted.append(gravity.is_refuted and not is_fast)
        if is_kept and not is_fast and gravity.wants(stamp_ns):
            gravity.add(stamp_ns, mean, spread, trace)
    return is_refuted


def _stuck(compensator: Compensator, stamps: Stamps, samples: Floats) -> Bools | None:
    """Find the samples that are not believed: too long the same, or three exact zeros."""
    if not compensator.stuck.is_on:
        return None
    found = compensator.stuck.find(stamps, samples)
    zeros = np.flatnonzero(samples[:, 0] == 0.0)
    zeros = zeros[(samples[zeros, 1:] == 0.0).all(axis=1)]
    if len(zeros):
        found = np.zeros(len(stamps), dtype=bool) if found is None else found
        found[zeros] = True
    return found
