# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the joining of bags that are successive parts of one recording: a recorder split it, or the
parts were recorded one after the other, and the unit was turned between them.

Between the parts of a recording the unit may have stayed switched on, so the parts count as one
turn-on: positions of one turn-on do not show how well the bias repeats from turn-on to turn-on.
Lags continue from each part into the next part, and a rest may continue, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import numpy as np

from ..recording.blocks import Block
from .reduction import Readings, ReducedBag, StillInterval
from .sources import FitSource


def joined(bags: Sequence[ReducedBag]) -> list[ReducedBag]:
    """Join each bag that continues another bag to that bag; keep the order of the given bags."""
    recordings: list[list[ReducedBag]] = []
    for bag in sorted(bags, key=lambda bag: bag.start_ns):
        before = [recording for recording in recordings if _continues(recording[-1], bag)]
        if before:
            # If `bag` continues several (simulated) recordings, the smallest step decides.
            min(before, key=lambda recording: _step(recording[-1], bag)).append(bag)
        else:
            recordings.append([bag])
    number = {id(bag): k for k, bag in enumerate(bags)}
    recordings.sort(key=lambda recording: min(number[id(bag)] for bag in recording))
    return [_one_recording(parts) if len(parts) > 1 else parts[0] for parts in recordings]


def _continues(part: ReducedBag, bag: ReducedBag) -> bool:
    """Whether a bag, by its stamps, sample interval and serial, continues `part`."""
    gap_s = 1e-9 * (bag.start_ns - part.end_ns)
    is_alike = abs(bag.cycle_s - part.cycle_s) < 0.01 * part.cycle_s
    # A bag with known |f| is not joined, because times of |f| count from the start of the bag.
    is_at_1g = bag.source.force is None and part.source.force is None
    is_of_unit = bag.source.serial == part.source.serial
    # Parts overlap by at most 3 s, and by at most a tenth of a part; recordings whose stamps begin
    # at 0 overlap more. The gap between parts, in which the unit is turned and the recorder is
    # restarted, is at most 60 s or, if longer, two sample intervals. If the unit is switched off
    # and on in the gap, the fit takes the offset of each turn-on for an offset of a mounting.
    overlap_s = min(3.0, 1e-10 * (part.end_ns - part.start_ns))
    is_next = -overlap_s < gap_s < max(60.0, 2.0 * bag.cycle_s)
    return bool(is_next and is_alike and is_at_1g and is_of_unit)


def _step(part: ReducedBag, bag: ReducedBag) -> float:
    """Return the norm of the change of the mean sample from `part` to `bag`; 0 without rests."""
    if not (part.intervals and bag.intervals):
        return 0.0
    return float(np.linalg.norm(bag.intervals[0].mean[0] - part.intervals[-1].mean[-1]))


def _one_recording(parts: Sequence[ReducedBag]) -> ReducedBag:
    first, last = parts[0], parts[-1]
    sources = [part.source for part in parts]

    def blocks() -> Iterator[Block]:
        for source in sources:
            yield from source.blocks()

    source = FitSource(
        f'{sources[0].name} .. {sources[-1].name}',
        blocks,
        serial=next((source.serial for source in sources if source.serial), None),
        reader=sources[-1].reader,
    )
    rates = {part.angular_rate for part in parts}
    names = {field.name for field in fields(first) if field.name.startswith('n_')}
    totals = {name: sum(getattr(part, name) for part in parts) for name in names - {'n_spikes'}}
    torn = [f'{part.info.path}: {part.info.truncated}' for part in parts if part.info.truncated]
    return replace(
        first,
        source=source,
        parts=tuple(source for part in parts for source in part.sources),
        end_ns=last.end_ns,
        intervals=_intervals(parts),
        temperatures={
            name: _readings([part.readings(name) for part in parts])
            for name in dict.fromkeys(name for part in parts for name in part.temperatures)
        },
        n_spikes=sum((Counter(part.n_spikes) for part in parts), Counter()),
        is_integer=all(part.is_integer for part in parts),
        middle=max(part.middle for part in parts),
        restless='' if any(part.intervals for part in parts) else first.restless,
        max_abs=max(part.max_abs for part in parts),
        angular_rate=rates.pop() if len(rates) == 1 else 'part',
        info=replace(first.info, end_ns=last.info.end_ns, truncated='; '.join(torn) or None),
        **totals,
    )


def _readings(parts: Sequence[Readings]) -> Readings:
    """Join a thermometer's readings in successive parts; keep readings with rising stamps only."""
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    value = np.concatenate([part.value for part in parts])
    newest = np.maximum.accumulate(stamp_ns)
    use = np.diff(newest, prepend=newest[:1] - 1) > 0
    return Readings(stamp_ns[use], value[use])


def _intervals(parts: Sequence[ReducedBag]) -> tuple[StillInterval, ...]:
    """Return the rests of all parts, with times since the start of the first part."""
    result: list[StillInterval] = []
    for part in parts:
        shift_s = 1e-9 * (part.start_ns - parts[0].start_ns)
        is_alike = abs(part.window_s - parts[0].window_s) < 0.01 * parts[0].window_s
        for number, rest in enumerate(part.intervals):
            # Windows count as whole if they are, within 1 %, as long as the first part's windows.
            n_whole = rest.n_whole if is_alike else 0
            begin_s, time = rest.begin_s + shift_s, rest.time + shift_s
            shifted = replace(rest, begin_s=begin_s, time=time, n_whole=n_whole)
            is_first = bool(result) and number == 0
            if is_first and _is_one_rest(result[-1], shifted, part.window_s):
                result[-1] = _continued(result[-1], shifted)
            else:
                result.append(shifted)
    return tuple(result)


def _is_one_rest(before: StillInterval, after: StillInterval, window_s: float) -> bool:
    """
    Whether a rest continues in the next part: the gap is at most three windows long, and on each
    axis the step over the gap is at most five times the RMS, or twice the largest, of the steps
    between successive windows (rounding may set most of these steps to 0). Up to 20 windows on
    each side of the gap are used; with fewer than 10 steps the result is False.
    """
    gap_s = 1e-9 * (after.start_ns - before.end_ns)
    means = before.mean[: before.n_whole][-20:], after.mean[:20]
    steps = np.concatenate([np.diff(mean, axis=0) for mean in means])
    if gap_s > 3.0 * window_s or not before.n_whole or len(steps) < 10:
        return False
    usual = np.maximum(5.0 * np.sqrt(np.mean(steps**2, axis=0)), 2.0 * np.abs(steps).max(axis=0))
    return bool(np.all(np.abs(means[1][0] - means[0][-1]) <= usual))


def _continued(before: StillInterval, after: StillInterval) -> StillInterval:
    """Join two parts of a rest; drop an incomplete window if complete windows follow it."""
    is_whole = after.n_whole > 0 and len(before.time) <= before.n_whole + 1
    use = slice(before.n_whole if is_whole else None)
    rates = before.angular_rate, after.angular_rate
    n = before.count[use].sum(), after.count.sum()
    return replace(
        before,
        end_ns=after.end_ns,
        n_whole=before.n_whole + after.n_whole * is_whole,
        time=np.concatenate((before.time[use], after.time)),
        count=np.concatenate((before.count[use], after.count)),
        mean=np.concatenate((before.mean[use], after.mean)),
        sample_sd=np.average([before.sample_sd, after.sample_sd], axis=0, weights=n),
        angular_rate=None
        if rates[0] is None or rates[1] is None
        else np.concatenate((rates[0][use], rates[1])),
    )
