# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the statistics of a bag: still intervals, their windows, temperature readings, counters.

The blocks of a bag are read once, in bounded memory. Samples are averaged to cells of about half a
second (see `stillness`), and the cells of a still interval to windows of ten seconds. Windows
of a short interval, or at the end of an interval, may be shorter than ten seconds. In a window the
deviation of every thermal regressor from a straight line is far below the noise, so the mean of a
window is a sufficient statistic. The regression estimates the noise of the windows' means. With a
charge-balancing converter this noise is smaller than sd of the samples / sqrt(number of samples).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..errors import FitError
from ..recording import stillness
from ..recording.blocks import RecordingInfo
from ..recording.overview import CauseCounter
from ..recording.stillness import CellAccumulator, Cells
from ..thermal.plausibility import CONTINUED_SHARE
from ..thermal.thermometer import COLDEST, HOTTEST
from ..typing import Bools, Floats, Ints
from ..unit.provenance import Source
from .coverage import best_rests, n_directions
from .initial_triad import block_means
from .sources import FitSource, angular_velocity

#: Default length of a window of the fit [s].
WINDOW_S = 10.0


class Readings(NamedTuple):
    """Readings of a thermometer in a bag: rising stamps [ns], temperatures [degC], shape (n,)."""

    stamp_ns: Ints = np.empty(0, np.int64)
    value: Floats = np.empty(0)


@dataclass(frozen=True)
class StillInterval:
    """
    A rest: an interval in which the unit does not move.

    start_ns, end_ns: stamps of the middles of the interval's first and last cell
    begin_s: start of the interval's first window, since the bag's first sample [s]
    n_whole: number of windows of full length; the last window may be shorter and is not counted
    time, count, mean: each window's time since the first sample [s], number and mean of samples
    sample_sd: square root of the median of the cells' variances of samples, shape (3,)
    rounding_sd: sd of the error of `mean` by rounding of samples; 0 if samples have noise, (3,)
    angular_rate: mean angular rate of each window [rad/s], or None if a sample of the bag has none
    """

    start_ns: int
    end_ns: int
    begin_s: float
    n_whole: int
    time: Floats
    count: Floats
    mean: Floats
    sample_sd: Floats
    angular_rate: Floats | None = None
    rounding_sd: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class ReducedBag:
    """
    The statistics of one bag that the fit uses.

    start_ns, end_ns: stamps of the first and last sample used
    n_dropped: number of samples that are not finite, or whose stamps are out of order
    n_saturated: number of samples at the full scale
    n_cells, n_still_cells: number of cells (about half a second each) in the bag and in its rests
    window_s: length of a window [s]; longer than requested if the sample rate is low
    cycle_s: typical interval between samples [s]
    is_integer: whether all samples are integers
    middle: sample at zero force of a converter with unsigned codes, else 0
    step: resolution of the coarsest axis [input units], or 0 if the samples do not show it
    max_abs: 99 % quantile, over cells, of the largest magnitude of a sample [input units]
    since_s: time from the bag's first sample to the part of the bag that was read [s]
    restless: reason why the bag cannot be used, such as no rests; '' if the bag can be used
    angular_rate: 'whole' if all samples have a finite angular rate, 'part' if some, else 'none'
    n_spikes: number of dropped readings of each thermometer, over 10 K from their neighbours
    n_glitches: number of dropped single samples that are far from their neighbours
    n_repeated: number of dropped samples with the same stamp as the preceding sample
    parts: the bags that were joined to this recording, see `joining`; () for a single bag
    """

    source: FitSource
    start_ns: int
    end_ns: int
    intervals: tuple[StillInterval, ...]
    temperatures: Mapping[str, Readings]
    n_samples: int
    n_dropped: int
    n_saturated: int
    n_cells: int
    n_still_cells: int
    window_s: float
    cycle_s: float
    is_integer: bool
    middle: float = 0.0
    step: float = 0.0
    max_abs: float = 0.0
    info: RecordingInfo = field(default_factory=lambda: RecordingInfo(Path(), '', {}, 0, 0))
    since_s: float = 0.0
    restless: str = ''
    angular_rate: Literal['none', 'part', 'whole'] = 'none'
    n_spikes: Mapping[str, int] = field(default_factory=dict)
    n_glitches: int = 0
    n_repeated: int = 0
    parts: tuple[Source, ...] = ()

    @property
    def sources(self) -> tuple[Source, ...]:
        """The bags of this recording, for the provenance of a calibration."""
        name, sha256 = self.source.name, self.source.sha256 or ''
        return self.parts or (Source(name, sha256, self.n_samples),)

    def readings(self, name: str) -> Readings:
        """Return the readings of a thermometer; an empty table if the bag lacks it."""
        return self.temperatures.get(name, Readings())

    @property
    def board(self) -> Readings:
        """Readings of the board's thermometer."""
        return self.readings('board')

    @property
    def case(self) -> Readings:
        """Readings of the case's thermometer."""
        return self.readings('case')


class _Pass:
    """One reading of all blocks of a source; `has_rate`: whether all angular rates are finite."""

    def __init__(self, source: FitSource, accumulator: CellAccumulator) -> None:
        readings: dict[str, list[Readings]] = {}
        n_impossible: Counter[str] = Counter()
        self.n_spikes: Counter[str] = Counter()
        self.causes = CauseCounter()
        self.n_samples, self.has_rate = 0, True
        for block in source.blocks():
            rate = angular_velocity(block)
            if len(block.accel_stamp_ns):
                self.has_rate &= rate is not None and bool(np.isfinite(rate).all())
            accumulator.add(block.accel_stamp_ns, block.accel, rate)
            self.causes.add(block)
            for name, (reading_ns, celsius, _) in block.temperatures.items():
                earlier = readings.setdefault(name, [Readings()])
                n_impossible[name] += int(np.count_nonzero(np.abs(celsius) > HOTTEST))
                spikes = is_spike(celsius)
                self.n_spikes[name] += int(np.count_nonzero(spikes))
                new = thinned(reading_ns[~spikes], celsius[~spikes], earlier[-1].stamp_ns[-1:])
                if len(new.stamp_ns):
                    earlier.append(new)
            self.n_samples += len(block.accel_stamp_ns)
        self.cells = accumulator.cells()
        self.temperatures = {
            name: Readings(*map(np.concatenate, zip(*parts, strict=True)))
            for name, parts in readings.items()
        }
        for name, n in n_impossible.items():
            if n > len(self.temperatures[name].value):
                raise FitError(
                    f'{source.name}: {n} readings of {name} are beyond {HOTTEST:g} degC: is the '
                    'topic a temperature in degC?'
                )


def reduce_source(
    source: FitSource,
    *,
    window_s: float = WINDOW_S,
    cell_s: float = 0.5,
    min_rest_s: float | None = None,
    still_sd: float = stillness.STILL_SD,
    full_scale: float | None,
    fewest_windows: int = 1,
) -> ReducedBag:
    """
    Read one source in blocks and keep its sufficient statistics.

    `still_sd` is the largest sd of samples at rest [g]. Without `min_rest_s` a rest lasts at least
    3 s, or at least 1 or 2 s if rests of this length determine bias and scale better. The largest
    variance allowed in a rest is chosen so that rests determine bias and scale best. If the user
    or the bag states |f|, the limit of the variance is fixed, and `min_rest_s` is by default 3 s.
    Cells of the usual 30 samples are over 3 s long at a low sample rate, so that drifts look like
    motions and short rests are lost: cells of 10 or 5 samples are then tried.
    """

    def reduced(least: int) -> tuple[ReducedBag, float]:
        accumulator = CellAccumulator(min(cell_s, window_s), full_scale, window_s, least)
        return _reduced(source, accumulator, window_s, min_rest_s, still_sd, fewest_windows)

    usual, usual_cell_s = reduced(stillness.MIN_SAMPLES)
    if usual_cell_s <= 3.0:
        return usual
    share = usual.n_still_cells / usual.n_cells
    if share < 0.95 and source.force is None:
        # Cells of 10 samples are used if they increase the time at rest by over 5 % of the bag.
        shorter, _ = reduced(10)
        if shorter.n_still_cells / shorter.n_cells > share + 0.05:
            return shorter
    if share < 0.5:
        # Cells of 5 samples are used if they give rests in six attitudes or more.
        shorter, _ = reduced(5)
        means = np.array([interval.mean.mean(axis=0) for interval in shorter.intervals])
        if n_directions(means.reshape(-1, 3)) >= 6:
            return shorter
    return usual


def _reduced(
    source: FitSource,
    accumulator: CellAccumulator,
    window_s: float,
    min_rest_s: float | None,
    still_sd: float,
    fewest_windows: int,
) -> tuple[ReducedBag, float]:
    """Return a source's statistics from the cells of `accumulator`, and a cell's length [s]."""
    reading = _Pass(source, accumulator)
    cells = reading.cells
    if source.force is None:
        ranges = _rests(cells, min_rest_s, still_sd)
    else:
        # The stated |f| is not gravity, so the norms of rests cannot select the thresholds.
        cells = stillness.without_rotation(cells)
        ranges = stillness.still_intervals(cells, min_rest_s or 3.0, still_sd)
    restless = reading.causes.cause(cells, still_sd)
    if not ranges and not restless:
        if 2 * cells.n_saturated > reading.n_samples:
            share = f'{100.0 * cells.n_saturated / reading.n_samples:.0f} % of its samples'
            why = f'{share} are at the full scale: is --full-scale right?'
        else:
            why = stillness.why_restless(cells, still_sd)
        restless = f'no still interval: {why}'
        if min_rest_s is not None:
            restless += f'; --min-rest accepts rests of {min_rest_s:g} s or more only'
    per_window = max(1, round(window_s / cells.cell_s)) if cells.cell_s else 1
    has_rate = reading.has_rate
    bag = ReducedBag(
        source=source,
        start_ns=cells.start_ns,
        end_ns=cells.end_ns,
        intervals=tuple(
            _windows(cells, a, b, min(per_window, max(1, (b - a) // fewest_windows)), has_rate)
            for a, b in ranges
        ),
        temperatures=reading.temperatures,
        n_spikes=reading.n_spikes,
        n_samples=reading.n_samples,
        n_dropped=cells.n_dropped,
        n_saturated=cells.n_saturated,
        n_glitches=cells.n_glitches,
        n_repeated=cells.n_repeated,
        n_cells=len(cells.count),
        n_still_cells=sum(b - a for a, b in ranges),
        # A bag without a usable sample has no cells, and gets the requested window length.
        window_s=round(per_window * cells.cell_s, 6) or window_s,
        cycle_s=_cycle_s(cells),
        is_integer=cells.is_integer,
        middle=cells.middle,
        step=float(cells.quantum.max()),
        max_abs=_max_abs(cells),
        restless=restless,
        angular_rate='whole' if has_rate else 'part' if cells.rate.any() else 'none',
    )
    if (reader := source.reader()) is not None:
        bag = replace(bag, info=reader.info, since_s=reader.since_s)
    return bag, cells.cell_s


def _cycle_s(cells: Cells) -> float:
    """Return the typical interval between samples [s]; NaN without samples."""
    if not len(cells.count):
        return np.nan
    # A cell is complete if its number of samples differs from the median number by at most 1.
    # Samples in bursts make most cells incomplete: use cells with over half the median number.
    median = float(np.median(cells.count))
    use = np.abs(cells.count - median) <= 1.0
    if np.mean(use) < 0.5:
        use = cells.count > 0.5 * median
    return float(f'{cells.cell_s / float(cells.count[use].mean()):.5g}')


def thinned(stamp_ns: Ints, value: Floats, last_ns: Ints) -> Readings:
    """Keep plausible readings with rising stamps; average readings above 10 Hz over 0.2 s."""
    stamp_ns, value = np.asarray(stamp_ns, np.int64), np.asarray(value, np.float64)
    before = np.concatenate((last_ns if len(last_ns) else stamp_ns[:1] - 1, stamp_ns[:-1]))
    use = (value >= COLDEST) & (value <= HOTTEST)
    use &= stamp_ns > np.maximum.accumulate(before[: len(stamp_ns)])
    stamp_ns, value = stamp_ns[use], value[use]
    span_s = np.ptp(stamp_ns) * 1e-9 if len(stamp_ns) else 0.0
    # No thermometer responds within 0.2 s, so means over 0.2 s lose nothing and save time.
    size = int(0.2 * (len(stamp_ns) - 1) / span_s) if span_s else 1
    n = len(stamp_ns) // size * size if size > 1 else 0
    if n:
        first = stamp_ns[0]
        middle = np.mean((stamp_ns[:n] - first).reshape(-1, size), axis=1)
        stamp_ns = first + middle.astype(np.int64)
        value = np.mean(value[:n].reshape(-1, size), axis=1)
    return Readings(stamp_ns, value)


@np.errstate(invalid='ignore')
def is_spike(value: Floats) -> Bools:
    """Return whether each reading is over 10 K from the median of the five around it, (n,)."""
    # A thermometer with a loose contact reads -127 or 85 degC for a moment. If the noise of the
    # thermometer is estimated without these readings, the tracker rejects them as outliers.
    far = np.zeros(len(value), dtype=bool)
    if len(value) > 4:
        middle = np.median(sliding_window_view(value, 5), axis=1)
        far[2:-2] = np.abs(value[2:-2] - middle) > 10.0
        # The first and the last reading have neighbours on one side only. A large step from such a
        # reading to its neighbour belongs to a ramp if the neighbour's next step is similar.
        for place, nearest in ((0, value[:3]), (-1, value[:-4:-1])):
            step, after = np.abs(np.diff(nearest)).tolist()
            far[place] = step > 10.0 and after < CONTINUED_SHARE * step
    return far


def _max_abs(cells: Cells) -> float:
    """Return the 99 % quantile over cells of |mean| + 3 sd, the largest of the three axes."""
    if not len(cells.count):
        return 0.0
    sizes = np.max(np.abs(cells.mean) + 3.0 * np.sqrt(cells.variance), axis=1)
    return float(np.quantile(sizes, 0.99))


def _rests(cells: Cells, min_rest_s: float | None, still_sd: float) -> list[tuple[int, int]]:
    """Find the rests, with the thresholds whose rests determine bias and scale best."""
    candidates: list[list[tuple[int, int]]] = []
    # Candidate limits of the variance in a rest, divided by the variance in the quietest cells.
    ratios = tuple(stillness.VARIANCE_RATIO * 2.0**power for power in range(6))
    of_ratios = stillness.still_runs(cells, still_sd, ratios)
    for shortest_s in (3.0, 2.0, 1.0) if min_rest_s is None else (min_rest_s,):
        for runs in of_ratios:
            ranges = stillness.long_enough(cells, runs, shortest_s)
            if ranges not in candidates:
                candidates.append(ranges)
    weighted = cells.mean * cells.count[:, None]
    means = [
        np.array([weighted[a:b].sum(axis=0) / cells.count[a:b].sum() for a, b in ranges])
        for ranges in candidates
    ]
    best = candidates[best_rests([rests.reshape(-1, 3) for rests in means])]
    return _joined(cells, best, still_sd)


def _joined(cells: Cells, ranges: list[tuple[int, int]], still_sd: float) -> list[tuple[int, int]]:
    """
    Join rests that are separated by a vibration without motion, as from a compressor that cycles.
    There is no motion if on each axis a parabola fits the means of the cells, from four before to
    four after the vibration, with a mean square residual below 4 variances of a cell's mean. Bags
    with fewer than six of these vibrations keep their separate rests.
    """
    is_calm = stillness.is_under(cells, still_sd)
    result = ranges[:1]
    for start, stop in ranges[1:]:
        first, last = result[-1]
        around = slice(max(first, last - 4), min(stop, start + 4))
        time, mean = cells.time[around], cells.mean[around]
        variance = np.maximum(cells.variance[around], cells.quantum**2 / 12.0)
        # Equal samples have no variance: their means differ by rounding, by 1e-12 of a sample.
        variance = np.maximum(variance, (1e-12 * np.abs(mean).max()) ** 2 + 1e-300)
        root = np.sqrt(np.maximum(cells.count[around, None], 1) / variance)
        is_same = is_calm[last:start].all() and np.all(np.diff(cells.index[around]) == 1)
        for axis in range(3) if is_same else ():
            powers = np.vander((time - time[0]) / np.ptp(time), 3) * root[:, [axis]]
            value = mean[:, axis] * root[:, axis]
            residual = value - powers @ np.linalg.lstsq(powers, value, rcond=None)[0]
            is_same = is_same and np.mean(residual**2) < 4.0
        if is_same:
            result[-1] = first, stop
        else:
            result.append((start, stop))
    return result if len(ranges) - len(result) >= 6 else ranges


def _windows(
    cells: Cells, lower: int, upper: int, per_window: int, has_rate: bool
) -> StillInterval:
    """Average the cells of a still interval to windows of `per_window` cells."""
    n_whole, rest = divmod(upper - lower, per_window)
    end = upper - rest if n_whole and 2 * rest < per_window else upper
    rows = slice(lower, end)
    offsets = np.arange(0, end - lower, per_window)
    count = cells.count[rows].astype(np.float64)
    total = np.add.reduceat(count, offsets)
    # The last window is of full length only if it has 90 % of the median number of samples.
    if n_whole and total[n_whole - 1] < 0.9 * np.median(total):
        n_whole -= 1
    mean = block_means(cells.mean[rows], count, offsets)
    variance = np.median(cells.variance[rows], axis=0)
    return StillInterval(
        start_ns=cells.start_ns + round(cells.time[lower] * 1e9),
        end_ns=cells.start_ns + round(cells.time[upper - 1] * 1e9),
        begin_s=float(cells.index[lower]) * cells.cell_s,
        n_whole=n_whole,
        time=np.add.reduceat(cells.time[rows] * count, offsets) / total,
        count=total,
        mean=mean,
        sample_sd=np.sqrt(variance),
        rounding_sd=rounding_sd(variance, np.ptp(mean, axis=0), cells.quantum),
        angular_rate=block_means(cells.rate[rows], count, offsets) if has_rate else None,
    )


def rounding_sd(variance: Floats, drift: Floats, quantum: Floats) -> Floats:
    """
    Return the sd of a mean's error due to the rounding of samples to converter steps, shape (3,).

    `variance`: median variance of the rounded samples in a cell; if it is above 0, the noise of
    the samples averages the rounding error to 0.
    `drift`: range of the windows' means; a range of n converter steps divides the sd by n + 1
    """
    steps = np.divide(drift, quantum, where=quantum > 0.0, out=np.zeros(3))
    return np.asarray(np.where(variance > 0.0, 0.0, quantum / 12.0**0.5 / (1.0 + steps)))
