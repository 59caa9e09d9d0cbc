# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the plausibility checks of samples: a stuck converter, more samples than the converter can
make, and |f| at rest, which must be gravity.

A converter with noise does not repeat its numbers for seconds; three exact zeros indicate a dead
wire. A converter counts charge per cycle, so the scale factor changes with the sample rate. If a
calibration is aged or of another unit, |f| at rest may differ from gravity by more than the stated
uncertainty. |f| is averaged over windows of a second or longer. A window is still if its scatter
is within the sensor's noise and its mean agrees with the mean of the previous window. A step of
|f| from a rest to another rest is judged within 3 s.
"""

import math
from collections.abc import Sequence
from typing import Final, TypeAlias

import numpy as np

from ..thermal.reading_queue import NEVER_NS
from ..typing import Bools, Floats, Ints
from .status import GravityResidual

#: An axis counts as stuck after the time-out only if it repeated its reading this number of times.
STUCK_SAMPLES: Final = 50
#: Change of both other axes [m/s^2] at which an axis that repeats its reading counts as stuck: the
#: change in a turn by 1.2 degrees, above the noise and the steps of a converter at rest.
MOTION: Final = 0.2
#: An axis that repeats its reading at rest is stuck if the other axes change `NOISY_CHANGES` times
#: by `NOISY_SDS` sd of their noise from sample to sample. The noise of the stuck axis must have
#: an sd of `VISIBLE_SDS` converter steps or more: smaller noise might not change the reading.
NOISY_CHANGES: Final = 20
NOISY_SDS: Final = 1.5
VISIBLE_SDS: Final = 2.0
#: Largest accepted ratio of the long-term rate of samples to the calibrated rate.
LARGEST_RATE: Final = 1.5
#: Burst of samples accepted beyond `LARGEST_RATE`, as from a driver's buffer: number of samples,
#: or duration [s].
BURST_SAMPLES: Final = 50
BURST_S: Final = 0.25
#: Largest relative deviation of the sample rate from the calibrated rate at which the calibrated
#: noise applies and no warning is given.
RATE_TOLERANCE: Final = 0.1
_WINDOW_S: Final = 1.0  # time over which the sample rate is measured [s]
#: Duration of a window of the gravity check [ns]: shortest, and longest if samples are few.
WINDOW_NS: Final = 1_000_000_000
LONGEST_WINDOW_NS: Final = 30_000_000_000
# Shortest time between two samples of a window of the gravity check [ns].
PROBE_NS: Final = 90_000_000
SMALLEST_WINDOW: Final = 5  # smallest number of samples in a window of the gravity check
#: Largest ratio of a still window's scatter to the noise of its samples, both as sd: the scatter
#: about the mean and the scatter from sample to sample must not exceed this ratio.
SCATTER_FACTOR: Final = 3.0
#: Largest change of the mean between two still windows in addition to noise [m/s^2]: 0.5 mg.
LARGEST_CHANGE: Final = 5e-3
#: Number of still windows averaged into one residual, with exponentially falling weight.
MEMORY_WINDOWS: Final = 30.0
#: Number of consecutive still windows that refute a calibration, and that restore it.
REFUTING_WINDOWS: Final = 3
RESTORING_WINDOWS: Final = 2
#: Time at rest between a step of |f| and the judgement of the step [ns].
STEP_NS: Final = 300_000_000
#: An error of |f| after motion counts as an acceleration of the platform, as in a coordinated
#: turn, if the force has turned by less than this angle [rad], at most this time [ns] after |f|
#: agreed with gravity: an error of the calibration depends on the direction of the force.
SAME_DIRECTION: Final = 0.05
LONGEST_MANOEUVRE_NS: Final = 60_000_000_000
#: A residual of |f| above the tolerance plus this number of its sd refutes the calibration.
REFUTING_SIGMAS: Final = 5.0


#: Run of equal readings of an axis: first sample with its stamp [ns]; number of repeats; largest
#: change of both other axes since the first sample [input unit]. Counted after the
#: `STUCK_SAMPLES`th repeat: number of changes of the other axes by `NOISY_SDS` sd or more from
#: sample to sample; smallest change, which is the converter's step [input unit].
Run: TypeAlias = tuple[tuple[float, float, float, int], int, float, int, float]


class StuckCheck:
    """
    Counts consecutive equal readings of each axis; with a `timeout_s` of 0 s, no sample is stuck.

    Samples are stuck if all three axes repeat their readings for over `timeout_s`. One axis alone
    is stuck if it repeats its reading for over `timeout_s` while both other axes change by over
    `motion` [input unit], or while they show noise and its own noise has an sd of two converter
    steps or more. `noise_sds`: sd of the noise of each axis [input unit].
    """

    def __init__(self, timeout_s: float, motion: float, noise_sds: Sequence[float]) -> None:
        self.is_on = timeout_s > 0.0
        self.limit_ns = round(timeout_s * 1e9) if self.is_on else NEVER_NS
        self.motion = motion
        self._noisy = [NOISY_SDS * sd or math.inf for sd in noise_sds]
        self._visible = [sd / VISIBLE_SDS for sd in noise_sds]
        self.last = (math.nan, math.nan, math.nan, 0)  # the last sample and its stamp
        #: For each axis, the run of equal readings that ends with the last sample; empty if the
        #: last sample changed the reading of every axis.
        self.runs: tuple[Run, ...] = ()

    def again(self, stamp_ns: int, x: float, y: float, z: float) -> bool:
        """Return whether a sample that repeats the reading of one axis or more is stuck."""
        last = self.last
        self.last = sample = (x, y, z, stamp_ns)
        of_x, of_y, of_z = self.runs or (_begun(last),) * 3
        new = sample, 0, 0.0, 0, math.inf
        self.runs = runs = (
            self._continued(of_x, sample, last, 1, 2) if x == last[0] else new,
            self._continued(of_y, sample, last, 2, 0) if y == last[1] else new,
            self._continued(of_z, sample, last, 0, 1) if z == last[2] else new,
        )
        if max(runs[0][1], runs[1][1], runs[2][1]) < STUCK_SAMPLES:
            return False
        latest_ns = stamp_ns - self.limit_ns
        is_long = [n >= STUCK_SAMPLES and first[3] < latest_ns for first, n, *_ in runs]
        return all(is_long) or any(
            long and (moved > self.motion or (n_noisy >= NOISY_CHANGES and step <= visible))
            for long, (*_, moved, n_noisy, step), visible in zip(
                is_long, runs, self._visible, strict=True
            )
        )

    def _continued(
        self,
        run: Run,
        sample: tuple[float, float, float, int],
        last: tuple[float, float, float, int],
        j: int,
        k: int,
    ) -> Run:
        """Extend an axis' run of equal readings by `sample`; `j`, `k`: the other axes."""
        first, n, moved, n_noisy, step = run
        change, other = abs(sample[j] - first[j]), abs(sample[k] - first[k])
        if change > moved and other > moved:
            moved = min(change, other)
        if n >= STUCK_SAMPLES:
            for i in (j, k):
                change = abs(sample[i] - last[i])
                n_noisy += change >= self._noisy[i]
                if 0.0 < change < step:
                    step = change
        return first, n + 1, moved, n_noisy, step

    def find(self, stamps: Ints, samples: Floats) -> Bools:
        """Return which samples, (n > 0, 3), `Compensator` drops as stuck or as three zeros."""
        n = len(stamps)
        columns = samples.T
        changes = np.empty((3, n), dtype=np.bool_)
        changes[:, 0] = columns[:, 0] != self.last[:3]
        changes[:, 1:] = columns[:, 1:] != columns[:, :-1]
        runs = list(self.runs or (_begun(self.last),) * 3)
        are_long = np.zeros((3, n), dtype=np.bool_)
        is_stuck = np.zeros(n, dtype=np.bool_)
        for axis, run in enumerate(runs):
            begins = np.concatenate([[-1 - run[1]], np.flatnonzero(changes[axis])])
            ends = np.append(begins[1:], n)
            is_judged = (ends - begins > STUCK_SAMPLES) & (ends > 0)
            is_judged[-1] = True
            spans = zip(begins[is_judged].tolist(), ends[is_judged].tolist(), strict=True)
            for begin, end in spans:
                begun = run
                if begin >= 0:
                    begun = _begun((*samples[begin].tolist(), int(stamps[begin])))
                here = slice(max(begin, 0), end)
                equal = np.arange(here.start - begin, end - begin)
                is_long = (equal >= STUCK_SAMPLES) & (stamps[here] - begun[0][3] > self.limit_ns)
                moved, n_noisy, step = self._changes(begun, columns, here, equal, axis)
                is_noisy = (n_noisy >= NOISY_CHANGES) & (step <= self._visible[axis])
                are_long[axis, here] = is_long
                is_stuck[here] |= is_long & ((moved > self.motion) | is_noisy)
                latest = moved.item(-1), n_noisy.item(-1), step.item(-1)
                runs[axis] = (begun[0], end - 1 - begin, *latest)
        self.last, self.runs = (*samples[-1].tolist(), int(stamps[-1])), tuple(runs)
        is_stuck |= are_long.all(axis=0)
        if self.is_on:
            zeros = np.flatnonzero(columns[0] == 0.0)
            is_stuck[zeros[~samples[zeros].any(axis=1)]] = True
        return is_stuck

    def _changes(
        self, run: Run, columns: Floats, here: slice, equal: Ints, axis: int
    ) -> tuple[Floats, Ints, Floats]:
        """
        Return `moved`, `n_noisy`, `step` of a `Run` after each sample of `columns[:, here]`;
        `equal`: number of repeats of the first reading of the run up to each sample.
        """
        first, _, moved, n_noisy, step = run
        # The first difference needs the sample before the slice `here`.
        before = self.last[:3] if here.start == 0 else columns[:, here.start - 1]
        values = np.column_stack([before, columns[:, here]])[[axis - 2, axis - 1]]
        with np.errstate(invalid='ignore'):
            moved_by = np.abs(values[:, 1:].T - np.take(first[:3], [axis - 2, axis - 1]))
            changes = np.abs(np.diff(values))
        most_moved = np.fmax.accumulate(np.append(moved, moved_by.min(axis=1)))[1:]
        # Like `_continued`, ignore changes of the other axes up to repeat number `STUCK_SAMPLES`.
        changes[:, equal <= STUCK_SAMPLES] = 0.0
        noisy = np.take(self._noisy, [axis - 2, axis - 1])[:, np.newaxis]
        counts = n_noisy + np.cumsum(np.sum(changes >= noisy, axis=0))
        steps = np.where(changes > 0.0, changes, math.inf).min(axis=0)
        return most_moved, counts, np.minimum.accumulate(np.append(step, steps))[1:]


def _begun(sample: tuple[float, float, float, int]) -> Run:
    """Return a new run of equal readings of an axis, begun by `sample`."""
    return sample, 0, 0.0, 0, math.inf


class RateCheck:
    """Compares the sample rate with the calibrated rate, at the start of each segment."""

    def __init__(self, cycle_s: float, counts_cycles: bool = True) -> None:
        self._cycle_s, self._counts_cycles = cycle_s, counts_cycles
        self._allowance = max(BURST_SAMPLES, BURST_S / cycle_s)
        self.is_too_fast = False  # whether samples arrive faster than the converter makes them
        self.ratio = 1.0  # samples per calibrated conversion cycle over the last `_WINDOW_S`
        self._level = 0.0
        self._last: tuple[int, int] | None = None
        self._window = (0, 0)

    @property
    def noise_excess(self) -> float:
        """Relative excess of a sample's noise variance due to a rate above the calibrated rate."""
        excess = self.ratio - 1.0
        return excess if excess > RATE_TOLERANCE else 0.0

    def update(self, n_seen: int, stamp_ns: int) -> None:
        """Update the sample rate from the number of samples so far and the latest stamp [ns]."""
        last = self._last
        self._last = (n_seen, stamp_ns)
        if last is None:
            self._window = self._last
            return
        n, dt = n_seen - last[0], (stamp_ns - last[1]) * 1e-9
        level = self._level + n - LARGEST_RATE * dt / self._cycle_s
        # The number of excess samples is limited to twice the allowed number, so that the alarm
        # ends soon after a long excess.
        self._level = min(max(level, 0.0), 2.0 * self._allowance)
        self.is_too_fast = self._counts_cycles and self._level > self._allowance
        n, dt = n_seen - self._window[0], (stamp_ns - self._window[1]) * 1e-9
        if dt >= _WINDOW_S:
            self.ratio = n * self._cycle_s / dt
            self._window = (n_seen, stamp_ns)


def variance_along(force: Sequence[float], covariance: Sequence[float]) -> float:
    """Return the variance of |f| of a force with the covariance xx, xy, xz, yy, yz, zz."""
    x, y, z = force
    xx, xy, xz, yy, yz, zz = covariance
    square = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return square / (x * x + y * y + z * z)


def roughness(sample: Sequence[float], last: Sequence[float], scales: Sequence[float]) -> float:
    """Return half the squared change of the force between two samples [m^2/s^4]; 0 for NaN."""
    changes = [(a - b) / scale for a, b, scale in zip(sample, last, scales, strict=True)]
    half = 0.5 * sum(change * change for change in changes)
    return half if half >= 0.0 else 0.0


class GravityCheck:
    """Compares |f| with gravity in still windows; a tolerance of 0 means no limit of |f|."""

    def __init__(self, gravity: float, tolerance: float = 0.0) -> None:
        self.gravity = gravity
        self._tolerance = tolerance or math.inf
        # Whether |f| in the last still windows refutes the calibration.
        self.is_refuted = False
        self._is_against = False  # whether |f| of the last still window was beyond the limit
        self._n_agreeing = 0  # number of successive still windows with equal `_is_against`
        self._forces: list[Sequence[float]] = []
        #: Forces of the samples after a step of |f|, and the stamp of the first such sample [ns].
        self._off: list[Sequence[float]] = []
        self._off_ns = 0
        self._is_resting = False  # whether the last sample agreed with the last still window
        self._begin_ns = self._last_ns = 0
        self._last_mean: list[float] | None = None
        #: Mean force and stamp [ns] of the last still window in which |f| agreed with gravity or
        #: in which the platform accelerated; whether any later window was not still.
        self._agreed: tuple[list[float], int] | None = None
        self._has_moved = False
        self._weight = 0.0  # sum of the weights of the windows averaged in `result`
        # Residual of |f|, or None before the first still window.
        self.result: GravityResidual | None = None

    def wants(self, stamp_ns: int) -> bool:
        """Whether enough time has passed since the last sample that was added to a window."""
        return not 0 <= stamp_ns - self._last_ns < PROBE_NS

    def add(
        self,
        stamp_ns: int,
        force: Sequence[float],
        covariance: Sequence[float],
        noise: float,
        rough: float = 0.0,
    ) -> None:
        """
        Add a sample: force [m/s^2], covariance (xx to zz), trace of the noise covariance, and
        `roughness`, which shows a vibration whose phase is the same in all added samples.
        """
        self._watch_step(stamp_ns, force, covariance, noise, rough)
        since_ns, step_ns = stamp_ns - self._begin_ns, stamp_ns - self._last_ns
        if not (0 <= since_ns < LONGEST_WINDOW_NS and 0 <= step_ns < 3 * WINDOW_NS):
            self._forces = []
        if not self._forces:
            self._begin_ns = stamp_ns
        self._last_ns = stamp_ns
        self._forces.append((*force, rough))
        is_long = stamp_ns - self._begin_ns >= 0.98 * WINDOW_NS
        if is_long and len(self._forces) >= SMALLEST_WINDOW:
            self._close(covariance, noise)
            self._forces = []

    def _watch_step(
        self,
        stamp_ns: int,
        force: Sequence[float],
        covariance: Sequence[float],
        noise: float,
        rough: float,
    ) -> None:
        """Refute the calibration if, after a step, |f| at rest differs from g for `STEP_NS`."""
        is_still = self.result and self.result.is_still and self._last_mean
        if self.is_refuted or not (self._off or is_still):
            self._off, self._is_resting = [], False
            return
        # Largest difference of two samples at rest: `LARGEST_CHANGE` + 4 sd of the difference.
        near = LARGEST_CHANGE + 4.0 * math.sqrt(2.0 * noise / 3.0)
        was_resting, reference = self._is_resting, (self._off or [self._last_mean or ()])[0]
        is_near = max(abs(a - b) for a, b in zip(force, reference, strict=True)) <= near
        is_near = is_near and rough <= SCATTER_FACTOR**2 * noise
        variance = max(variance_along(force, covariance), noise / 3.0)
        residual = math.hypot(*force) - self.gravity
        is_off = abs(residual) > self._tolerance + REFUTING_SIGMAS * math.sqrt(variance)
        self._is_resting = is_near and not self._off
        if not is_off or not (is_near if self._off else was_resting):
            self._off = []
            return
        if not self._off:
            self._off_ns = stamp_ns
        self._off.append(force)
        if stamp_ns - self._off_ns >= STEP_NS:
            self._is_against, self._n_agreeing, self.is_refuted = True, REFUTING_WINDOWS, True
            mean = [math.fsum(values) / len(self._off) for values in zip(*self._off, strict=True)]
            residual = math.hypot(*mean) - self.gravity
            n = self.result.n_windows if self.result else 0
            self._weight, self._last_mean, self._forces = 0.0, mean, []
            self.result = GravityResidual(residual, math.sqrt(variance), n, True)
            self._off = []

    def _close(self, covariance: Sequence[float], noise_variance: float) -> None:
        n = len(self._forces)
        *axes, rough = zip(*self._forces, strict=True)
        mean = [math.fsum(values) / n for values in axes]
        squares = [(v - m) ** 2 for values, m in zip(axes, mean, strict=True) for v in values]
        scatter = max(math.fsum(squares) / (n - 1), sum(rough) / n)
        last, self._last_mean = self._last_mean or [math.inf] * 3, mean
        # Largest difference of two means at rest: `LARGEST_CHANGE` plus 4 sd of the difference.
        change = LARGEST_CHANGE + 4.0 * math.sqrt(2.0 * noise_variance / (3.0 * n))
        largest = max(abs(a - b) for a, b in zip(mean, last, strict=True))
        if not (scatter <= SCATTER_FACTOR**2 * noise_variance and largest <= change):
            self._has_moved = True
            self.result = self.result and self.result._replace(is_still=False)
            return
        size = math.hypot(*mean)
        # The mean of a window reduces the noise of the samples, but not the calibration's error.
        noise = noise_variance / 3.0
        variance = max(variance_along(mean, covariance) - noise, 0.0) + noise / n
        limit = self._tolerance + REFUTING_SIGMAS * math.sqrt(variance)
        is_against = abs(size - self.gravity) > limit
        if not is_against:
            self._agreed, self._has_moved = (mean, self._last_ns), False
        elif self._is_accelerated(mean, size):
            self._agreed = (mean, self._last_ns)
            self.result = self.result and self.result._replace(is_still=False)
            return
        if is_against == self._is_against:
            self._n_agreeing += 1
        else:
            # The windows before |f| crossed the limit do not describe the present error of |f|.
            self._is_against, self._n_agreeing, self._weight = is_against, 1, 0.0
        if self._n_agreeing >= (REFUTING_WINDOWS if is_against else RESTORING_WINDOWS):
            self.is_refuted = is_against
        decay = 1.0 - 1.0 / MEMORY_WINDOWS
        self._weight = self._weight * decay + 1.0
        gain = 1.0 / self._weight
        residual, sd, n, _ = self.result or (0.0, 0.0, 0, False)
        residual += gain * (size - self.gravity - residual)
        sd = math.sqrt(sd**2 + gain * (variance - sd**2))
        self.result = GravityResidual(residual, sd, n + 1, is_still=True)

    def _is_accelerated(self, mean: Sequence[float], size: float) -> bool:
        """Whether motion of the platform may explain `size`, the |f| of a window [m/s^2]."""
        if self.is_refuted or self._agreed is None or not self._has_moved:
            return False
        agreed, agreed_ns = self._agreed
        along = sum(a * b for a, b in zip(agreed, mean, strict=True)) / math.hypot(*agreed)
        is_parallel = along > math.cos(SAME_DIRECTION) * size
        return is_parallel and self._last_ns - agreed_ns <= LONGEST_MANOEUVRE_NS
