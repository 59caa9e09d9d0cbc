# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the batch form of the compensator: whole columns at once, with the stream's bits.

The thermal side runs reading by reading through the same tracker; only what it gives at the
segments' ends is gathered, evaluated for all segments together and applied to all samples with
the operations of `Compensator.process` in their order.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .blocks import AccelBlock, CompensatedBlock, Floats, Stamps
from .sample_guard import Mask

if TYPE_CHECKING:
    from .compensator import Compensator

#: Longest time over which bias and scale are taken as linear in time.
SEGMENT_NS = 1_000_000_000
#: A stamp that goes back by more than this is a jump of time (a bag that loops), not disorder.
TIME_JUMP_NS = 1_000_000_000
#: Samples corrected at a time, so that the columns in work stay in the cache.
_CHUNK = 16384


@dataclass(slots=True)
class _Segments:
    """
    The segments of a block: where each begins and ends, and the thermal states at both ends.

    """

    start_ns: list[int]
    first: list[int]
    after: list[int]
    states: list[tuple[float, ...]]
    end_states: list[tuple[float, ...]]
    #: Not the rest of one that the end of the block before has cut.
    is_new: list[bool]
    #: Held back because the samples come too fast; and what the rate adds to their noise.
    is_too_fast: list[bool]
    noise_excess: list[float]


def process_block(compensator: Compensator, block: AccelBlock) -> CompensatedBlock:
    """
    Correct a block of samples; see `Compensator.process_block`.

    """
    counters = compensator.counters
    n_seen = counters.n_in - counters.n_out_of_order
    stamps = np.asarray(block.accel_stamp_ns, dtype=np.int64)
    before = np.maximum.accumulate(np.concatenate(([compensator.last_ns], stamps)))[:-1]
    in_order = stamps > before
    if np.any(stamps <= before - TIME_JUMP_NS):
        return _one_by_one(compensator, block)
    compensator.counters.n_out_of_order += int(len(stamps) - np.count_nonzero(in_order))
    if in_order.all():
        index = np.arange(len(stamps), dtype=np.int64)
        samples = np.asarray(block.accel, dtype=np.float64)
    else:
        index = np.flatnonzero(in_order)
        stamps = stamps[index]
        samples = np.asarray(block.accel, dtype=np.float64)[index]
    segments = _run_thermal_side(compensator, block, stamps, in_order, n_seen)
    if len(stamps):
        compensator.last_ns = int(stamps[-1])
    return _apply(compensator, segments, index, stamps, samples)


def _one_by_one(compensator: Compensator, block: AccelBlock) -> CompensatedBlock:
    """
    Process a block in which time jumps: rare, so the stream's own code serves.

    """
    events = [
        (int(after), 0, int(s), float(v))
        for after, s, v in zip(block.board_after, block.board_stamp_ns, block.board, strict=True)
    ]
    events += [
        (int(after), 1, int(s), float(v))
        for after, s, v in zip(block.case_after, block.case_stamp_ns, block.case, strict=True)
    ]
    events.sort(key=lambda event: event[0])
    push = (compensator.push_board, compensator.push_case)
    index, rows = [], []
    k = 0
    stamps = block.accel_stamp_ns.tolist()
    for i, (stamp_ns, sample) in enumerate(zip(stamps, block.accel.tolist(), strict=True)):
        while k < len(events) and events[k][0] <= i:
            push[events[k][1]](events[k][2], events[k][3])
            k += 1
        row = compensator.process(stamp_ns, *sample)
        if row is not None:
            index.append(i)
            rows.append(row)
    for _, kind, stamp_ns, celsius in events[k:]:
        push[kind](stamp_ns, celsius)
    where = np.array(index, dtype=np.int64)
    table = np.array(rows).reshape(-1, 9)
    return CompensatedBlock(
        where,
        np.asarray(block.accel_stamp_ns)[where],
        table[:, :3],
        table[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]],
    )


def _run_thermal_side(
    compensator: Compensator,
    block: AccelBlock,
    stamps: Stamps,
    in_order: npt.NDArray[np.bool_],
    n_seen: int,
) -> _Segments:
    segments = _Segments([], [], [], [], [], [], [], [])
    n_samples = len(stamps)
    # A reading takes effect at the first sample that is not before it and that comes after it.
    kept_before = np.concatenate(([0], np.cumsum(in_order)))
    pending = compensator.take_pending()
    reading_ns = [np.array([entry[0] for entry in pending], dtype=np.int64)]
    kinds = [np.array([entry[1] for entry in pending], dtype=np.int64)]
    orders = [np.array([entry[2] for entry in pending], dtype=np.int64)]
    values = [np.array([entry[3] for entry in pending])]
    after = [np.zeros(len(pending), dtype=np.int64)]
    for kind, (s, v, a) in enumerate(
        (
            (block.board_stamp_ns, block.board, block.board_after),
            (block.case_stamp_ns, block.case, block.case_after),
        )
    ):
        reading_ns.append(np.asarray(s, dtype=np.int64))
        kinds.append(np.full(len(s), kind))
        # Behind whatever was pushed before: only the order within one sensor and stamp counts.
        orders.append(np.arange(len(s)) + (1 << 60))
        values.append(np.asarray(v, dtype=np.float64))
        after.append(kept_before[np.asarray(a, dtype=np.int64)])
    reading_stamps = np.concatenate(reading_ns)
    kind_column = np.concatenate(kinds)
    value_column = np.concatenate(values)
    effect = np.maximum(
        np.searchsorted(stamps, reading_stamps, side='left'), np.concatenate(after)
    )
    order = np.lexsort((np.concatenate(orders), kind_column, reading_stamps, effect))
    events = zip(
        effect[order].tolist(),
        reading_stamps[order].tolist(),
        kind_column[order].tolist(),
        value_column[order].tolist(),
        strict=True,
    )
    position = 0
    for at, stamp_ns, kind, celsius in events:
        if at > position:
            stop = min(at, n_samples)
            _add_segments(compensator, segments, stamps, position, stop, n_seen)
            position = at
        if at >= n_samples:
            (compensator.push_board, compensator.push_case)[kind](stamp_ns, celsius)
        else:
            compensator.apply_reading(stamp_ns, kind, celsius)
    if position < n_samples:
        _add_segments(compensator, segments, stamps, position, n_samples, n_seen)
    return segments


def _add_segments(
    compensator: Compensator,
    segments: _Segments,
    stamps: Stamps,
    first: int,
    after: int,
    n_seen: int,
) -> None:
    """
    Add the segments of samples first..after, over which no reading takes effect.

    """
    tracker = compensator.tracker
    board_ns, updated_ns = tracker.board.stamp_ns, tracker.updated_ns
    if board_ns is None or updated_ns is None:
        compensator.counters.n_no_temperature += after - first
        return
    if int(stamps[after - 1]) - board_ns > compensator.timeout_ns:
        fresh = int(
            np.searchsorted(stamps[first:after], board_ns + compensator.timeout_ns, 'right')
        )
        compensator.counters.n_stale += after - first - fresh
        after = first + fresh
    while first < after:
        start_ns = updated_ns + (int(stamps[first]) - updated_ns) // SEGMENT_NS * SEGMENT_NS
        end_ns = start_ns + SEGMENT_NS
        if int(stamps[after - 1]) < end_ns:
            stop = after
        else:
            stop = first + int(np.searchsorted(stamps[first:after], end_ns, 'left'))
        is_new = compensator.open_segment(start_ns, n_seen + first, int(stamps[first]))
        segments.is_new.append(is_new)
        is_too_fast = compensator.rate_refuses and (is_new or compensator.is_refusing)
        segments.is_too_fast.append(is_too_fast)
        segments.noise_excess.append(compensator.noise_excess)
        segments.start_ns.append(start_ns)
        segments.first.append(first)
        segments.after.append(stop)
        segments.states.append(tracker.sample(start_ns))
        segments.end_states.append(tracker.sample(end_ns))
        first = stop


def _apply(
    compensator: Compensator,
    segments: _Segments,
    index: npt.NDArray[np.int64],
    stamps: Stamps,
    samples: Floats,
) -> CompensatedBlock:
    if not segments.start_ns:
        return CompensatedBlock(index[:0], stamps[:0], np.empty((0, 3)), np.empty((0, 9)))
    starts = tuple(np.array(segments.states).T.copy())
    ends = tuple(np.array(segments.end_states).T.copy())
    at_start = compensator.correction.bias_scale(starts)
    at_end = compensator.correction.bias_scale(ends)
    columns: list[npt.NDArray[Any]] = [np.array(segments.start_ns, dtype=np.int64)]
    for (bias, scale), (bias_end, scale_end) in zip(at_start, at_end, strict=True):
        columns += [bias, bias_end - bias, scale, scale_end - scale]
    excess = np.array(segments.noise_excess)
    correction = compensator.correction
    for (a, b, c), noise in zip(correction.variance(ends), correction.noise, strict=True):
        columns += (a + excess * noise, b, c)
    first = np.array(segments.first)
    counts = np.array(segments.after) - first
    n = int(counts.sum())
    # The columns stand one after the other in memory: each is written in one run.
    force = np.empty((3, n)).T
    covariance = np.empty((9, n)).T
    keep = np.ones(n, dtype=bool)
    source = _covered(first, counts, len(stamps))
    ends_at = np.cumsum(counts)
    low = 0
    begin = 0
    while begin < n:
        # Whole segments, about a cache's worth of them.
        high = max(int(np.searchsorted(ends_at, begin + _CHUNK, 'right')), low + 1)
        end = int(ends_at[high - 1])
        rows = source[begin:end] if source is not None else slice(begin, end)
        with np.errstate(invalid='ignore', over='ignore'):
            # What is not finite is corrected like the rest and then left out.
            _correct(
                compensator,
                [column[low:high] for column in columns],
                counts[low:high],
                stamps[rows],
                samples[rows],
                force[begin:end],
                covariance[begin:end],
                keep[begin:end],
            )
        low, begin = high, end
    if source is not None:
        index, stamps, samples = index[source], stamps[source], samples[source]
    _judge(compensator, segments, counts, stamps, samples, force, covariance, keep)
    if not keep.all():
        index, stamps = index[keep], stamps[keep]
        force, covariance = force[keep], covariance[keep]
    compensator.counters.n_out += len(index)
    return CompensatedBlock(index, stamps, force, covariance)


def _covered(
    first: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], n_samples: int
) -> npt.NDArray[np.int64] | None:
    """
    Find the samples that lie in a segment; None when all do.

    """
    if int(counts.sum()) == n_samples:
        return None
    return np.concatenate([np.arange(f, f + c) for f, c in zip(first, counts, strict=True)])


def _correct(
    compensator: Compensator,
    columns: list[npt.NDArray[Any]],
    counts: npt.NDArray[np.int64],
    stamps: Stamps,
    samples: Floats,
    force: Floats,
    covariance: Floats,
    keep: npt.NDArray[np.bool_],
) -> None:
    if counts[0] * len(counts) == len(stamps) and (counts == counts[0]).all():
        # Segments of one length stand as the rows of a table: their columns spread for nothing.
        shape: tuple[int, ...] = (len(counts), int(counts[0]))
        spread = [column[:, None] for column in columns]
    else:
        shape = (len(stamps),)
        spread = [np.repeat(column, counts) for column in columns]
    dt = (stamps.reshape(shape) - spread[0]) * 1e-9
    _mark_bad(compensator.calibration.unit.full_scale, samples, keep)
    x, y, z = (
        _divide(samples[:, i].reshape(shape), spread[1 + 4 * i : 5 + 4 * i], dt) for i in range(3)
    )
    vx, vy, vz = (
        _variance(value, *spread[at : at + 3])
        for value, at in zip((x, y, z), (13, 16, 19), strict=True)
    )
    yx, zx, zy, var_yx, var_zx, var_zy = compensator.misalignment
    xx = x * x
    cxy = yx * vx
    cxz = zx * vx
    out = [column.reshape(shape) for column in (*force.T, *covariance.T)]
    out[0][...] = x
    np.add(yx * x, y, out=out[1])
    np.add(zx * x + zy * y, z, out=out[2])
    out[3][...] = vx
    out[4][...] = cxy
    out[6][...] = cxy
    out[5][...] = cxz
    out[9][...] = cxz
    np.add(yx * cxy + vy, xx * var_yx, out=out[7])
    np.add(yx * cxz, zy * vy, out=out[8])
    out[10][...] = out[8]
    np.add(zx * cxz + zy * zy * vy + vz + xx * var_zx, y * y * var_zy, out=out[11])


def _mark_bad(full_scale: float, samples: Floats, keep: npt.NDArray[np.bool_]) -> None:
    # One look at the extremes settles the usual case; a NaN fails both comparisons.
    if -full_scale < np.min(samples) and np.max(samples) < full_scale:
        return
    keep &= ((-full_scale < samples) & (samples < full_scale)).all(axis=1)


def _judge(
    compensator: Compensator,
    segments: _Segments,
    counts: npt.NDArray[np.int64],
    stamps: Stamps,
    samples: Floats,
    force: Floats,
    covariance: Floats,
    keep: npt.NDArray[np.bool_],
) -> None:
    """
    Leave out what the stream would not publish, and count why.

    """
    counters, gravity = compensator.counters, compensator.gravity
    is_good = keep.copy()
    is_stuck = _stuck(compensator, stamps, samples)
    if is_stuck is not None:
        keep &= ~is_stuck
    begins = np.concatenate(([0], np.cumsum(counts)[:-1]))
    is_refuted: list[bool] = []
    trace = compensator.noise_trace
    firsts = zip(
        begins.tolist(),
        stamps[begins].tolist(),
        keep[begins].tolist(),
        segments.is_new,
        segments.is_too_fast,
        strict=True,
    )
    for row, stamp_ns, is_kept, is_new, is_fast in firsts:
        if not is_new:
            is_refuted.append(compensator.is_refusing and not is_fast)
            continue
        is_refuted.append(gravity.is_refuted and not is_fast)
        if is_kept and not is_fast and gravity.wants(stamp_ns):
            xx, xy, xz, _, yy, yz, _, _, zz = covariance[row].tolist()
            x, y, z = force[row].tolist()
            gravity.add(stamp_ns, (x, y, z), (xx, xy, xz, yy, yz, zz), trace)
    compensator.is_refusing = segments.is_too_fast[-1] or is_refuted[-1]
    # Every sample of a segment that is held back counts for that; the first one of a refuted
    # segment has been looked at like any other.
    is_fast_row = np.repeat(segments.is_too_fast, counts)
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


def _stuck(compensator: Compensator, stamps: Stamps, samples: Floats) -> Mask | None:
    """
    Find the samples that are not believed: too long the same, or three exact zeros.

    """
    if not compensator.stuck.is_on:
        return None
    found = compensator.stuck.find(stamps, samples)
    is_zero = samples[:, 0] == 0.0
    if is_zero.any():
        is_zero &= (samples[:, 1] == 0.0) & (samples[:, 2] == 0.0)
        found = is_zero if found is None else found | is_zero
    return found


def _divide(raw: Floats, line: list[npt.NDArray[Any]], dt: Floats) -> Floats:
    bias, bias_slope, scale, scale_slope = line
    value: Floats = bias_slope * dt
    value += bias
    np.subtract(raw, value, out=value)
    divisor = scale_slope * dt
    divisor += scale
    value /= divisor
    return value


def _variance(x: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    value = x * c
    value += b
    value *= x
    value += a
    return value
