# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the correction of arrays of samples, bit for bit equal to the correction of single samples.

Temperature readings are applied one by one. The intervals of linear correction between readings
are collected and evaluated together; then all samples are corrected by the same operations as
single samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from operator import itemgetter
from typing import Final, TypeAlias

import numpy as np

from ..recording.blocks import Block
from ..thermal.reading_queue import DISORDER_NS, NEVER_NS, PENDING_LIMIT
from ..typing import Bools, Floats, Ints, Stamps
from .checks import roughness
from .compensator import NO_RATE, TIME_JUMP_NS, Compensator, corrected_rate
from .segments import EVER_NS, SEGMENT_NS, Model, Segment
from .status import DROPPED

#: Readings not queued yet, last reading first: number of samples before the reading, latest stamp
#: of the thermometer up to the reading [ns], thermometer, stamp [ns], temperature [degC].
_Arrivals: TypeAlias = list[tuple[int, int, str, int, float]]
#: Segments of the correction, each with its number of samples.
Segments: TypeAlias = list[tuple[Segment, int]]
#: Corrects samples; takes results of `Correction.line`, time since segment start [s], x, y, z.
_Arithmetic: TypeAlias = Callable[..., Sequence[Floats]]
#: Code of the reason for which a sample is dropped; the code 0 marks a published sample.
_REASONS = {name: number for number, name in enumerate(DROPPED, 1)}
_TOO_FAST, _REFUTED = _REASONS['n_too_fast'], _REASONS['n_refuted']
# Number of samples corrected at a time, so that their arrays stay in the cache.
PIECE: Final = 4096
#: Indices in the result of `corrected`: force x, y, z, then the whole covariance matrix.
_COLUMNS: Final = (0, 1, 2, 3, 4, 5, 4, 6, 7, 5, 7, 8)
#: Places in `_COLUMNS` of force x, y, z and covariance xx, xy, xz, yy, yz, zz.
_SAMPLE = [0, 1, 2, 3, 4, 5, 7, 8, 11]


@dataclass(frozen=True)
class CompensatedBlock:
    """The published samples of a block."""

    index: Ints  # indices of the published samples in the block, shape (n,)
    stamp_ns: Stamps
    specific_force: Floats  # corrected specific force [m/s^2], shape (n, 3)
    covariance: Floats  # covariance of the force, row-major 3x3 [m^2/s^4], shape (n, 9)
    #: Corrected angular rate [rad/s] and its variances [rad^2/s^2], shape (n, 3), or None without
    #: an angular rate or a gyroscope in the calibration; variances of a missing rate: `NO_RATE`.
    angular_rate: Floats | None = None
    angular_rate_variance: Floats | None = None


def process_block(
    compensator: Compensator, block: Block, angular_rate: Floats | None = None
) -> CompensatedBlock:
    """Correct a block's samples and angular rates, (n, 3), bit for bit as `process` does."""
    thermal = compensator.thermal
    stamps = np.asarray(block.accel_stamp_ns, dtype=np.int64)
    samples = np.asarray(block.accel, dtype=np.float64)
    arrivals: _Arrivals = []
    for name in thermal.inputs:
        if name in block.temperatures:
            stamp_ns, celsius, place = map(np.asarray, block.temperatures[name])
            order, names = np.maximum.accumulate(stamp_ns), np.full(len(place), name)
            lists = (place, order, names, stamp_ns, celsius)
            arrivals += zip(*(column.tolist() for column in lists), strict=True)
    arrivals.sort(key=itemgetter(0, 1))
    arrivals.reverse()
    runs = _runs(compensator, stamps, arrivals)
    compensator.counters.n_out_of_order += len(stamps) - sum(map(len, runs))
    parts = []
    for number, run in enumerate(runs):
        if number:
            _push(compensator, arrivals, run.item(0))
            compensator.jump_back(stamps.item(run.item(0)))
        segments, index = _gather(compensator, arrivals, run, stamps[run])
        parts.append(_apply(compensator, segments, index, stamps, samples, angular_rate))
    _push(compensator, arrivals, len(stamps))
    compensator.event_ns = EVER_NS
    if len(parts) == 1:
        return parts[0]
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(CompensatedBlock)
        if getattr(parts[0], field.name) is not None
    }
    return CompensatedBlock(**columns)


def _runs(compensator: Compensator, stamps: Stamps, arrivals: _Arrivals) -> list[Ints]:
    """Find the samples whose stamps are in order, split into runs where stamps jump back."""
    before_ns, leap_ns = compensator.last_ns, compensator.leap_ns
    steps = np.diff(stamps, prepend=stamps[:1] if before_ns == EVER_NS else before_ns)
    is_plain = compensator.leapt_ns is None and (steps[before_ns == EVER_NS :] > 0).all()
    if is_plain and int(np.max(steps, initial=0)) <= leap_ns:
        latest_ns = max((arrival[3] for arrival in arrivals), default=EVER_NS)
        compensator.reading_ns = max(compensator.reading_ns, latest_ns)
        return [np.arange(len(stamps))]
    runs: list[list[int]] = [[]]
    last_ns, waiting = before_ns, arrivals[:]
    for number, stamp_ns in enumerate(stamps.tolist()):
        while waiting and waiting[-1][0] <= number:
            compensator.reading_ns = max(compensator.reading_ns, waiting.pop()[3])
        if stamp_ns <= last_ns - TIME_JUMP_NS:
            runs.append([])
            compensator.reading_ns, compensator.leapt_ns = EVER_NS, None
        elif stamp_ns <= last_ns or compensator.is_leap(stamp_ns):
            continue
        runs[-1].append(number)
        compensator.last_ns = last_ns = stamp_ns
    compensator.last_ns = before_ns
    compensator.reading_ns = max(compensator.reading_ns, *(entry[3] for entry in waiting), EVER_NS)
    return [np.array(run, dtype=np.int64) for run in runs]


def _push(
    compensator: Compensator, arrivals: _Arrivals, place: int, due_ns: int = EVER_NS
) -> None:
    """Queue the readings before sample number `place`; `due_ns`: stamp of this sample."""
    thermal = compensator.thermal
    while arrivals and arrivals[-1][0] <= place:
        _, _, name, stamp_ns, celsius = arrivals.pop()
        if len(thermal.queue) >= PENDING_LIMIT:
            # If the queue is full, apply its readings up to `DISORDER_NS` before the new reading,
            # as the node does without samples; after the first sample, none after `due_ns`.
            limit_ns = NEVER_NS if compensator.now_ns is None else due_ns
            thermal.flush(min(limit_ns, stamp_ns - DISORDER_NS))
        thermal.push(name, stamp_ns, celsius)


def _gather(
    compensator: Compensator, arrivals: _Arrivals, index: Ints, stamps: Stamps
) -> tuple[Segments, Ints]:
    """Cut samples into segments between readings; return segments and sample indices."""
    thermal, counters = compensator.thermal, compensator.counters
    n_seen = counters.n_in - counters.n_out_of_order
    segments: Segments = []
    rows = [np.arange(0)]
    at = 0
    while at < len(stamps):
        _push(compensator, arrivals, index.item(at), stamps.item(at))
        thermal.flush(stamps.item(at))
        compensator.last_ns = stamps.item(at)
        stop = int(stamps.searchsorted(thermal.queue.next_ns))
        while arrivals and (place := int(index.searchsorted(arrivals[-1][0]))) < stop:
            _, _, name, stamp_ns, celsius = arrivals.pop()
            thermal.push(name, stamp_ns, celsius)
            stop = min(stop, max(place, int(stamps.searchsorted(stamp_ns))))
        after, fresh_ns = stop, thermal.fresh_until_ns
        if stamps.item(stop - 1) > fresh_ns:
            after = max(at, int(stamps.searchsorted(fresh_ns, 'right')))
            thermal.count_unmeasured(stop - after)
        rows.append(np.arange(at, after))
        while at < after:
            segment = thermal.segment(stamps.item(at), n_seen + at)
            end_ns = segment.start_ns + SEGMENT_NS
            end = after if stamps.item(after - 1) < end_ns else int(stamps.searchsorted(end_ns))
            segments.append((segment, end - at))
            at = end
        at = stop
    if len(stamps):
        compensator.last_ns = stamps.item(-1)
    return segments, index[np.concatenate(rows)]


def _apply(
    compensator: Compensator,
    segments: Segments,
    index: Ints,
    stamps: Stamps,
    samples: Floats,
    angular_rate: Floats | None,
) -> CompensatedBlock:
    """Correct the samples of segments; return the published samples."""
    model = compensator.thermal.model
    if model.rate_correction is None:
        angular_rate = None
    line = rate_line = np.empty((0, 0))
    if segments:
        line, rate_line, is_good = _lines(model, segments)
        if not is_good.all():
            counts = [count for _, count in segments]
            compensator.counters.n_unsound += int(np.sum(counts, where=~is_good))
            index = index[np.repeat(is_good, counts)]
            segments = [segment for segment, good in zip(segments, is_good, strict=True) if good]
            line, rate_line = line[:, is_good], rate_line[:, is_good]
    if len(index) < len(stamps):
        stamps, samples = stamps[index], samples[index]
        angular_rate = None if angular_rate is None else angular_rate[index]
    correction = model.correction

    def force_of(line: list[Floats], dt: Floats, x: Floats, y: Floats, z: Floats) -> list[Floats]:
        row = compensator.evaluate(line, correction.misalignment, dt, x, y, z)
        row = correction.beyond.widened(*row)
        return [row[place] for place in _COLUMNS]

    force = rate = np.empty((12, 0))
    if segments:
        force = _corrected(force_of, line, segments, stamps, samples)
        is_kept = _judge(compensator, segments, stamps, samples, force)
        if angular_rate is not None:
            rate = _corrected(corrected_rate, rate_line, segments, stamps, angular_rate)
            rate[3:, ~np.isfinite(angular_rate.sum(axis=1))] = np.reshape(NO_RATE, (3, 1))
            rate = rate[:, is_kept]
        if not is_kept.all():
            index, stamps, force = index[is_kept], stamps[is_kept], force[:, is_kept]
    rates = () if angular_rate is None else (rate[:3].T, rate[3:6].T)
    return CompensatedBlock(index, stamps, force[:3].T, force[3:].T, *rates)


def _lines(model: Model, segments: Segments) -> tuple[Floats, Floats, Bools]:
    """Evaluate `Model.lines`; evaluate the slowly varying variance once per `SlowState`."""
    _, _, _, excess, start, end, slow = zip(*(segment for segment, _ in segments), strict=True)
    distinct = {id(state): state for state in slow}
    places = {key: place for place, key in enumerate(distinct)}
    rows = model.slow_rows([*distinct.values()])[:, [places[id(state)] for state in slow]]
    return model.lines(np.transpose(start), np.transpose(end), rows, np.array(excess))


def _corrected(
    evaluate: _Arithmetic, table: Floats, segments: Segments, stamps: Stamps, samples: Floats
) -> Floats:
    """Correct the samples of segments; column k of `table`: `Correction.line` of segment k."""
    start_ns = np.array([segment.start_ns for segment, _ in segments], dtype=np.int64)
    ends = np.cumsum([count for _, count in segments])
    n, parts = len(stamps), []
    # Samples that are not finite are corrected like all others; the caller drops them.
    with np.errstate(invalid='ignore', over='ignore'):
        for begin in range(0, n, PIECE):
            stop = min(begin + PIECE, n)
            low = int(np.searchsorted(ends, begin, 'right'))
            high = int(np.searchsorted(ends, stop, 'left')) + 1
            counts = np.diff(np.minimum(ends[low:high], stop), prepend=begin)
            dt = (stamps[begin:stop] - np.repeat(start_ns[low:high], counts)) * 1e-9
            line = list(np.repeat(table[:, low:high], counts, axis=1))
            parts.append(np.array(evaluate(line, dt, *samples[begin:stop].T)))
    return np.concatenate(parts, axis=1)


def _judge(
    compensator: Compensator, segments: Segments, stamps: Stamps, samples: Floats, force: Floats
) -> Bools:
    """Mark the samples to be published; count the reasons for which samples are dropped."""
    reasons = np.zeros(len(stamps), dtype=np.int8)
    last = compensator.stuck.last[:3]
    reasons[compensator.stuck.find(stamps, samples)] = _REASONS['n_stuck']
    is_large = ~(np.abs(samples) < compensator.calibration.unit.full_scale).all(axis=1)
    if is_large.any():
        is_finite = np.isfinite(samples[is_large]).all(axis=1)
        reasons[is_large] = np.where(is_finite, _REASONS['n_saturated'], _REASONS['n_not_finite'])
    gravity, trace = compensator.gravity, compensator.thermal.correction.noise_trace
    counts = np.array([count for _, count in segments])
    first = np.cumsum(counts) - counts
    rows = force[:, first][_SAMPLE].T.tolist()
    pieces = zip(segments, first.tolist(), stamps[first].tolist(), rows, strict=True)
    # Reason for which all samples of a segment are dropped, or 0.
    reason = _REFUTED if compensator.is_refusing else 0
    for (segment, count), begin, stamp_ns, row in pieces:
        # The check of |f| uses the valid first samples of new segments, even if they are dropped.
        is_bad = bool(reasons[begin])
        if segment.is_too_fast:
            reason = _TOO_FAST
        elif segment.is_new:
            reason = _REFUTED if gravity.is_refuted else 0
            if not is_bad and gravity.wants(stamp_ns):
                before = samples[begin - 1].tolist() if begin else last
                rough = roughness(samples[begin].tolist(), before, compensator.scales)
                gravity.add(stamp_ns, row[:3], row[3:], trace, rough)
        if reason:
            keeps_first = is_bad and segment.is_new and reason == _REFUTED
            reasons[begin + keeps_first : begin + count] = reason
    compensator.is_refusing = bool(reason)
    n_out, *n_dropped = np.bincount(reasons, minlength=1 + len(DROPPED)).tolist()
    counters = compensator.counters
    counters.n_out += n_out
    for name, n in zip(DROPPED, n_dropped, strict=True):
        setattr(counters, name, getattr(counters, name) + n)
    is_kept: Bools = reasons == 0
    return is_kept
