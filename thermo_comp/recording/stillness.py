# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns still intervals: sums samples in short cells (count, mean, variance) and finds still cells.

Two tests are relative to the noise of the bag's quiet cells: the variance inside a cell
(vibration, handling) and the step of the mean between adjacent cells (a turn, a knock). A step
starts a new interval, because a tilt by a microradian changes a sample by a micro-g. A unit at
rest may tilt as its temperature changes: if the mean changes steadily by at most 50 micro-g/s over
several cells, this is a drift and not a step. Two tests have absolute limits, because even a
flight has quiet cells: at rest the sd of samples is at most `still_sd`, and the angular rate is
within 1 deg/s of its median.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..typing import Bools, Floats, Ints
from .noise import is_glitch, roughest_at_rest, spread_of_variances

#: Largest variance of a cell at rest (30 samples or more) / the bag's noise variance: white noise
#: exceeds 4 with a probability below 1e-11, and vibration that must be cut out is far above 4.
VARIANCE_RATIO = 4.0
#: Largest sd of samples at rest [g]: above any sensor's noise, below the sd of most flights.
STILL_SD = 0.05
_STILL_RATE_SD = np.radians(2.0)  # largest sd of the angular rate in a cell at rest [rad/s]
_STILL_RATE = np.radians(1.0)  # largest mean angular rate of a cell less the rate's bias [rad/s]
_LEVEL_S = 120.0  # the bias of the angular rate is interpolated between medians over this time [s]
_ROTATION_S = 10.0  # `without_rotation` subtracts the median angular rate over this time [s]
_STEP_SDS = 8.0  # smallest step between adjacent cells that ends a rest, in robust sd of steps
_DRIFT_STEPS, _DRIFT = 9, 5e-5  # number of steps whose median is the drift; largest drift [g/s]
_QUANTUM_SAMPLES = 20000  # number of samples that are searched for a quantum
_STEPS_NEEDED = 10  # smallest number of changes that prove a quantum, if all are its multiples
STRETCHES = (1, 2, 3, 6, 12, 30, 60)  # numbers of windows that a whole number of cells may fill
_LONGEST_CELL_NS = 86400e9  # largest length of a cell, reached only with wrong stamps [ns]
MIN_SAMPLES = 30  # usual smallest number of samples in a cell
_LARGEST = 1e100  # largest valid sample: squares of larger samples may overflow
_WORD = 32768.0  # middle of the range of unsigned 16-bit numbers
_LONGER = (23, 31)  # numbers of bits of 24- and 32-bit words without the sign bit
_STUCK = 0.3  # ratio of the noise's sd to the quantum below which most samples are equal


@dataclass(frozen=True)
class Cells:
    """Statistics of the n cells (short runs of samples) of a bag, of shape (n,) or (n, 3)."""

    start_ns: int  # stamp of the first sample of the bag
    end_ns: int  # stamp of the last sample of the bag
    cell_s: float
    n_dropped: int  # number of samples dropped: not finite, or with a stamp that does not rise
    n_saturated: int
    n_glitches: int  # number of samples dropped as glitches, see `is_glitch`
    n_repeated: int  # number of samples with the same stamp as the sample before
    is_integer: bool  # whether all samples are whole numbers
    quantum: Floats  # step between the possible values of an axis; 0: unknown; shape (3,)
    middle: float  # 32768 for unsigned 16-bit words, else 0
    time: Floats  # mean time of a cell's samples since `start_ns` [s]
    count: Ints  # number of samples in a cell
    index: Ints  # number of a cell on the time grid
    mean: Floats
    variance: Floats
    roughness: Floats  # half the mean square change from sample to sample
    seam: Floats  # first sample of a cell less the last sample of the cell before; 0 after a gap
    rate: Floats  # mean angular rate [rad/s]
    rate_variance: Floats  # [rad^2/s^2]

    def part(self, which: slice) -> 'Cells':
        """Select consecutive cells."""
        names = 'time count index mean variance roughness seam rate rate_variance'
        return replace(self, **{name: getattr(self, name)[which] for name in names.split()})


class CellAccumulator:
    """
    Reduces streamed samples to cells that last `cell_s`, or longer to have `least` samples.
    Whole cells fill `window_s`, or 2 to 60 times `window_s` if a cell is longer than `window_s`.
    Samples of `full_scale` or more are saturated and dropped.
    """

    def __init__(
        self,
        cell_s: float,
        full_scale: float | None,
        window_s: float | None = None,
        least: int = MIN_SAMPLES,
    ) -> None:
        self._asked_cell_s, self._window_s, self._least = cell_s, window_s, least
        self._full_scale = full_scale
        self._cell_ns = self._start_ns = 0
        self._last_ns: int | None = None
        self._last = np.zeros((0, 3))  # last sample of the previous block
        self._shift = np.zeros(3)
        # Columns of a cell's row: number of the cell; number of samples; sums of times, of samples
        # (and rates) and of their squares; change of the samples from the cell before; sums of
        # squared changes from sample to sample. The last row changes while samples are added.
        self._sums: list[Floats] = [np.empty((0, 15))]
        self._n_dropped = self._n_saturated = self._n_glitches = self._n_repeated = 0
        self._n_looked_at = 0
        self._is_integer, self._is_negative = True, False
        self._middle, self._quantum = 0.0, np.zeros(3)
        self._few_changes = [np.zeros(0)] * 3

    def add(self, stamp_ns: Ints, samples: Floats, rate: Floats | None = None) -> None:
        """Add the next samples and angular rates, shape (n, 3), in file order, to the cells."""
        if not len(stamp_ns):
            return
        # Tests of three slices need a fifth of the time of a reduction over an axis of length 3.
        x, y, z = (np.abs(samples) < _LARGEST).T
        use = x & y & z
        before = int(stamp_ns[0]) - 1 if self._last_ns is None else self._last_ns
        use &= stamp_ns > np.maximum.accumulate(np.concatenate(([before], stamp_ns[:-1])))
        self._n_dropped += int((~use).sum())
        self._n_repeated += int((np.diff(stamp_ns, prepend=before) == 0).sum())
        if not use.all():
            stamp_ns, samples = stamp_ns[use], samples[use]
            rate = None if rate is None else rate[use]
        if self._full_scale is not None and len(samples):
            if self._full_scale == _WORD - 1.0 and not self._middle:
                self._look_for_sign(samples)
                self._full_scale = widened(self._full_scale, samples)
            x, y, z = (np.abs(samples - self._middle) < self._full_scale).T
            use = x & y & z
            if not use.all():
                self._n_saturated += int((~use).sum())
                stamp_ns, samples = stamp_ns[use], samples[use]
                rate = None if rate is None else rate[use]
        if not len(stamp_ns):
            return
        if self._last_ns is None:
            self._begin(stamp_ns, samples)
            self._sums = [np.empty((0, 15 if rate is None else 21))]
        self._last_ns = int(stamp_ns[-1])
        for first in range(0, len(samples), _QUANTUM_SAMPLES):
            # Repeated samples do not show the quantum, so `_n_looked_at` does not count them.
            if self._n_looked_at >= _QUANTUM_SAMPLES:
                break
            part = samples[first : first + _QUANTUM_SAMPLES - self._n_looked_at]
            quantum = _quantum_of(part, self._few_changes)
            self._quantum = np.where(self._quantum > 0.0, self._quantum, quantum)
            self._n_looked_at += int((part[1:] != part[:-1]).any(axis=1).sum()) + 1
        self._is_integer = self._is_integer and bool((samples == np.rint(samples)).all())
        glitches = is_glitch(samples, self._quantum)
        if glitches.any():
            self._n_glitches += int(glitches.sum())
            stamp_ns, samples = stamp_ns[~glitches], samples[~glitches]
            rate = None if rate is None else rate[~glitches]
        self._accumulate(stamp_ns, samples, rate)

    def forget(self, stamp_ns: int) -> None:
        """Drop the cells before a stamp [ns]."""
        first = (stamp_ns - self._start_ns) // max(self._cell_ns, 1)
        n = int(np.searchsorted(self.cells().index, first))
        self._sums = [self._sums[0][n:]]

    def cells(self) -> Cells:
        """Return all cells so far, including the unfinished last cell."""
        sums = np.concatenate(self._sums)
        self._sums = [sums]  # the next call of `cells` appends rows of new cells only
        index, count = sums[:, 0].astype(np.int64), sums[:, 1]
        total, square = np.split(sums[:, 3:-6], 2, axis=1)
        n_free = np.maximum(count[:, None] - 1.0, 1.0)
        mean = total / count[:, None]
        # Set variances below their rounding error to 0, as for equal samples.
        spread = square - count[:, None] * mean**2
        spread[spread < np.finfo(np.float64).eps * count[:, None] * square] = 0.0
        variance = spread / n_free
        rate, rate_variance = (
            x[:, 3:] if x.shape[1] > 3 else np.zeros((len(x), 3)) for x in (mean, variance)
        )
        cell_s = self._cell_ns * 1e-9
        # Whole numbers have a quantum of 1 at least, also on an axis that does not change.
        quantum = np.maximum(self._quantum, float(self._is_integer))
        return Cells(
            *(self._start_ns, self._last_ns or self._start_ns, cell_s),
            *(self._n_dropped, self._n_saturated, self._n_glitches, self._n_repeated),
            *(self._is_integer, quantum, self._middle),
            *(sums[:, 2] / count + index * cell_s, count.astype(np.int64), index),
            *(mean[:, :3] + self._shift, variance[:, :3], sums[:, -3:] / (2.0 * n_free)),
            *(sums[:, -6:-3], rate, rate_variance),
        )

    def _look_for_sign(self, samples: Floats) -> None:
        """Detect unsigned 16-bit words: samples are whole numbers, none negative, some > 32768."""
        self._is_negative |= bool((samples < 0.0).any())
        if not self._is_negative and np.max(samples, initial=0.0) > _WORD:
            is_word = (samples == np.rint(samples)) & (samples < 2.0 * _WORD)
            self._middle = _WORD if is_word.all() else 0.0

    def _begin(self, stamp_ns: Ints, samples: Floats) -> None:
        steps = np.diff(stamp_ns) if len(stamp_ns) > 1 else np.zeros(1)
        step, between = float(np.median(steps)), 0.0
        gaps = steps[steps > 10.0 * step]
        if gaps.sum() > 0.5 * steps.sum():
            # A driver that polls a buffer sends bursts at a constant interval below 5 s: a cell is
            # two intervals or longer. Pauses while a hand turns a unit are irregular or over 5 s.
            usual = float(np.median(gaps))
            is_regular = np.mean(np.abs(gaps - usual) < 0.2 * usual) > 0.9
            if is_regular and usual < 5e9:
                step, between = float(steps.mean()), 2.0 * usual
        cell_ns = max(self._asked_cell_s * 1e9, self._least * step, between, 1.0)
        cell_ns = min(cell_ns, _LONGEST_CELL_NS)
        self._cell_ns = round(
            cell_ns if self._window_s is None else _part_of(self._window_s, cell_ns)
        )
        self._start_ns = int(stamp_ns[0])
        self._shift = samples[0].copy()

    def _accumulate(self, stamp_ns: Ints, samples: Floats, rate: Floats | None) -> None:
        since = stamp_ns - self._start_ns
        ids = since // self._cell_ns
        first = np.flatnonzero(np.concatenate(([True], ids[1:] != ids[:-1])))
        # Each row of `terms` is a column of `_sums`: sums along contiguous rows are fast.
        terms = np.zeros((self._sums[0].shape[1], len(since)))
        n = (len(terms) - 9) // 2
        terms[1] = 1.0
        terms[2] = (since - ids * self._cell_ns) * 1e-9
        terms[3:6] = samples.T - self._shift[:, None]
        if n > 3 and rate is not None:
            terms[6:9] = np.where(np.abs(rate.T) < _LARGEST, rate.T, 0.0)
        np.square(terms[3 : 3 + n], out=terms[3 + n : -6])
        last = self._sums[-1]
        before = np.concatenate((last[-1:, 0] if len(last) else ids[:1], ids[:-1]))
        previous = self._last - self._shift if len(last) else terms[3:6, :1].T
        change = np.diff(terms[3:6], prepend=previous.T)
        terms[-3:] = np.where(ids == before, change**2, 0.0)
        terms[-6:-3] = np.where(ids == before + 1, change, 0.0)
        self._last = samples[-1:]
        sums = np.add.reduceat(terms, first, axis=1).T
        sums[:, 0] = ids[first]
        if len(last) and sums[0, 0] == last[-1, 0]:
            sums[0, 1:] += last[-1, 1:]
            self._sums[-1] = last[:-1]
        self._sums.append(sums)


def widened(full_scale: float, samples: Floats) -> float:
    """Return `full_scale`, or 2^23 - 1 or 2^31 - 1 counts if most samples exceed 65536."""
    size = np.abs(samples)
    if np.max(size, initial=0.0) < 2.0 * _WORD:
        return full_scale
    size = size.max(axis=1)
    if np.median(size) < 2.0 * _WORD:
        return full_scale
    return next(2.0**bits - 1.0 for bits in _LONGER if np.median(size) < 2.0**bits or bits == 31)


def _part_of(window_s: float, least_ns: float) -> float:
    """Raise a cell length [ns] so that whole cells fill 1 to 60 windows; keep a longer length."""
    for stretch in STRETCHES:
        n_cells = int(stretch * window_s * 1e9 / least_ns * (1.0 + 1e-6))
        if n_cells:
            return stretch * window_s * 1e9 / n_cells
    return least_ns


def _quantum_of(samples: Floats, few: list[Floats]) -> Floats:
    """Return each axis's quantum, 0 if unknown; `few`: up to two earlier changes of each axis."""
    result = np.zeros(3)
    for axis in range(3):
        changes = np.abs(np.diff(samples[:, axis]))
        changes = np.sort(np.concatenate((few[axis], changes[changes > 0.0])))
        # One or two changes from sample to sample may be turns of the unit: wait for more changes.
        few[axis] = changes[: 3 * (len(changes) < 3)]
        if len(changes) < 3:
            continue
        # Changes by an equal number of quanta differ by rounding only. The smallest change is the
        # quantum if all changes are its whole multiples, or if there are few distinct changes.
        n_levels = 1 + int(np.sum(np.diff(changes) > 0.1 * changes[0]))
        steps = changes / changes[0]
        is_whole = len(changes) >= _STEPS_NEEDED and (np.abs(steps - np.rint(steps)) < 0.1).all()
        if n_levels < 0.2 * len(changes) or n_levels == 1 or is_whole:
            result[axis] = changes[0]
    return result


def still_intervals(
    cells: Cells, min_rest_s: float, still_sd: float = STILL_SD
) -> list[tuple[int, int]]:
    """Return runs of still cells of at least `min_rest_s`, as half-open ranges of indices."""
    return long_enough(cells, still_runs(cells, still_sd, (VARIANCE_RATIO,))[0], min_rest_s)


def long_enough(
    cells: Cells, runs: Sequence[tuple[int, int]], min_rest_s: float
) -> list[tuple[int, int]]:
    """Select the runs of cells that last at least `min_rest_s`."""
    min_cells = max(1, int(np.ceil(min_rest_s / cells.cell_s - 1e-9))) if runs else 1
    return [(start, stop) for start, stop in runs if stop - start >= min_cells]


def still_runs(
    cells: Cells, still_sd: float, ratios: Sequence[float]
) -> list[list[tuple[int, int]]]:
    """
    Return the runs of still cells of any length for each value of `ratios`, the largest ratio of a
    still cell's variance to the noise variance; `still_sd` is the largest sd at rest [g].
    """
    full = is_full(cells)
    plausible = full & is_under(cells, still_sd) & ~_is_turning(cells)
    if not plausible.any():
        return [[] for _ in ratios]
    drift = _drift(cells, plausible)
    level = np.quantile(cells.variance[plausible], 0.1, axis=0)
    colour = spread_of_variances(cells, plausible, level)
    # A sensor that repeats one number does not show its noise, so the noise variance is at least a
    # quarter quantum squared, as for samples that toggle between two adjacent numbers. For white
    # noise, 1.3 times the tenth percentile of the variances is 1.0 (cells of 60 samples) or 0.9
    # (cells of 32 samples) times the mean variance.
    noise = np.maximum(1.3 * level * colour, 0.25 * cells.quantum**2)
    # A drift of d within a cell has a variance of d^2 / 12; twice this variance allows for noise.
    within = np.concatenate((drift[:1], (drift[1:] + drift[:-1]) / 2.0, drift[-1:]))
    by_drift = within**2 / 6.0 if len(within) else 0.0
    result = []
    for ratio in ratios:
        quiet = plausible & (cells.variance <= ratio * noise + by_drift).all(axis=1)
        roughest = roughest_at_rest(cells, quiet, colour > 1.0, ratio)
        quiet &= (cells.roughness <= roughest).all(axis=1)
        # Limit of the change from the last sample of a cell to the first sample of the next cell.
        is_seamless = np.abs(cells.seam[1:]) <= _STEP_SDS * np.sqrt(2.0 * roughest / ratio)
        broken = ~(_is_joined(cells, quiet, drift) & is_seamless.all(axis=1))
        # Exclude cells adjacent to a moving cell or to a step: the motion may extend into them.
        near = ~quiet
        near[1:] |= ~quiet[:-1] | broken
        near[:-1] |= ~quiet[1:] | broken
        edges = np.flatnonzero(np.diff(np.concatenate(([0], (~near).astype(np.int8), [0]))))
        result.append(list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)))
    return result


def without_rotation(cells: Cells) -> Cells:
    """
    Subtract from each cell's angular rate the median rate of the 10 s that end with the cell: a
    unit at a constant angular rate counts as at rest, and a unit whose rate changes does not.
    """
    n = max(1, round(_ROTATION_S / cells.cell_s)) if cells.cell_s else 1
    if len(cells.rate) <= n or not cells.rate.any():
        return cells
    around = np.concatenate((np.repeat(cells.rate[:1], n - 1, axis=0), cells.rate))
    level = np.median(sliding_window_view(around, n, axis=0), axis=-1)
    return replace(cells, rate=cells.rate - level)


def why_restless(cells: Cells, still_sd: float = STILL_SD) -> str:
    """Describe why a bag has no rests."""
    full, under = is_full(cells), is_under(cells, still_sd)
    if full.any() and not (full & under).any():
        quietest = np.sqrt(np.min(cells.variance[full].max(axis=1))) / _one_g(cells)
        return (
            f'the samples scatter by at least {1e3 * quietest:.3g} mg (sd), the limit at rest is '
            f'{1e3 * still_sd:.3g} mg (--still-sd): was the unit worn, driven or shaken?'
        )
    if (full & under & _is_turning(cells)).sum() > 0.5 * full.sum():
        return 'the angular rate mostly varies more than at rest (is the rate in rad/s?)'
    edges = np.diff(np.r_[0, (full & under).astype(np.int8), 0])
    runs = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    longest_s = float(np.max(runs, initial=0)) * cells.cell_s
    longest = f'{longest_s:.3g}' if longest_s < 999.5 else f'{longest_s:.0f}'
    text = f'the unit is quiet for {longest} s at most, as if worn or driven, '
    return text + 'but must rest in each position'


def is_full(cells: Cells, least: float = 2.0) -> Bools:
    """Whether a cell has `least` samples or more, and at least half of the median number."""
    usual = float(np.median(cells.count)) if len(cells.count) else 0.0
    return np.asarray(cells.count >= max(least, 0.5 * usual))


def _one_g(cells: Cells) -> float:
    """Return the median norm of the cells' means, which is gravity in units of the input."""
    norms = np.linalg.norm(cells.mean - cells.middle, axis=1)
    return float(np.median(norms)) if len(norms) else 0.0


def is_under(cells: Cells, still_sd: float) -> Bools:
    """Whether the sd of a cell's samples is at most `still_sd` [g], or at most a quantum."""
    ceiling = np.maximum((still_sd * _one_g(cells)) ** 2, cells.quantum**2)
    return np.asarray((cells.variance <= ceiling).all(axis=1))


def _is_turning(cells: Cells) -> Bools:
    """Whether the unit turns in a cell: angular rates scatter, or differ from the rate's bias."""
    shakes = (cells.rate_variance > _STILL_RATE_SD**2).any(axis=1)
    calm = np.flatnonzero(~shakes)
    if not len(calm) or not cells.rate.any():
        return np.asarray(shakes)
    stretch = (cells.time[calm] // _LEVEL_S).astype(np.int64)
    first = np.flatnonzero(np.r_[True, np.diff(stretch) != 0])
    runs = np.split(calm, first[1:])
    middle = [float(np.median(cells.time[run])) for run in runs]
    levels = np.array([np.median(cells.rate[run], axis=0) for run in runs])
    level = np.column_stack([np.interp(cells.time, middle, axis) for axis in levels.T])
    return np.asarray(shakes | (np.abs(cells.rate - level) > _STILL_RATE).any(axis=1))


def _drift(cells: Cells, plausible: Bools) -> Floats:
    """Return the drift from cell to cell: the median of nine steps, at most 50 ug per second."""
    both = plausible[1:] & plausible[:-1] & (np.diff(cells.index) == 1)
    step = np.where(both[:, None], np.diff(cells.mean, axis=0), 0.0)
    half = _DRIFT_STEPS // 2
    if len(step) <= half:
        return np.zeros_like(step)
    around = np.pad(step, ((half, half), (0, 0)), mode='reflect')
    drift = np.median(sliding_window_view(around, _DRIFT_STEPS, axis=0), axis=-1)
    largest = _DRIFT * cells.cell_s * _one_g(cells)
    return np.asarray(np.clip(drift, -largest, largest))


def _is_joined(cells: Cells, quiet: Bools, drift: Floats) -> Bools:
    """Whether cell i + 1 continues the rest of cell i: no gap, and no step beyond the drift."""
    step = np.diff(cells.mean, axis=0) - drift
    both = quiet[1:] & quiet[:-1] & (np.diff(cells.index) == 1)
    if not both.any():
        return np.zeros(len(step), dtype=bool)
    # With many short rests most steps between cells are turns: limit the spread of the steps.
    spread = 1.4826 * np.median(np.abs(step[both]), axis=0)
    spread = np.minimum(spread, STILL_SD / _STEP_SDS * _one_g(cells))
    square = cells.variance / cells.count[:, None]
    noise = np.sqrt(np.maximum(2.0 * np.median(square[quiet], axis=0), square[1:] + square[:-1]))
    # If most samples are equal, a change by one quantum is no sign of a knock.
    is_stuck = np.median(cells.variance[quiet], axis=0) < (_STUCK * cells.quantum) ** 2
    change = np.where(is_stuck, 1.1 * cells.quantum, 0.0)
    limit = np.maximum(_STEP_SDS * np.maximum(spread, noise), change)
    return np.asarray(both & (np.abs(step) <= limit).all(axis=1))
