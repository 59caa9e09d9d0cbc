# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the segments: time intervals between temperature readings, with a correction linear in time.

A segment ends at a temperature reading, or after one second. The correction is evaluated at both
ends of a segment and interpolated, so a sample costs a few operations, and the output has no steps
between two readings. The slowly varying variance due to parameters and initial lag states is
evaluated every 10 s, and every second during the first 30 board readings.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from math import sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from ..thermal.lags import BOARD_INPUT
from ..thermal.reading_queue import NEVER_NS, ReadingQueue
from ..thermal.regime import Regime
from ..thermal.settings import ThermalConfig
from ..thermal.state import BOARD
from ..thermal.tracker import ANY_RANGE, ThermalTracker
from ..typing import Bools, Floats
from ..unit.calibration import Calibration, rate_triad
from ..unit.correction import Correction, is_sound
from ..unit.prediction import SlowUncertainty
from .checks import RateCheck
from .status import CompensatorConfig, Counters

#: Longest segment [ns].
SEGMENT_NS: Final = 1_000_000_000
SLOW_NS: Final = 10_000_000_000  # longest time a `SlowState` and its variance are used [ns]
YOUNG_READINGS: Final = 30  # number of board readings that give a precise rate of the board
EVER_NS: Final = -NEVER_NS  # a stamp earlier than any real stamp
#: Sd of the temperature of a unit without thermometer about the reference temperature [K].
UNMEASURED_SD_K: Final = 10.0


class SlowState(NamedTuple):
    """
    Arguments of the variance due to parameters and initial lag states: thermal state; share of
    each unknown initial lag state that remains; rate of the board in a ramp in which the unit may
    have been switched on [K/s].
    """

    state: tuple[float, ...]
    start_shares: list[float]
    start_rate: float


class Segment(NamedTuple):
    """A time interval with a linear correction, and the checks that apply to its samples."""

    start_ns: int
    # False if an earlier call of `ThermalSide.segment` has opened this segment.
    is_new: bool
    is_too_fast: bool  # whether samples arrive faster than the converter makes them
    noise_excess: float  # relative excess of the noise variance because of the samples' rate
    start: tuple[float, ...]  # thermal state at the start of the segment
    end: tuple[float, ...]  # thermal state at the end of the segment
    slow: SlowState  # the same object in successive segments with equal arguments


_NO_STATE: Final = SlowState((), [], 0.0)


class Model:
    """A calibration prepared for evaluation; the object is immutable."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.needs_temperature = calibration.needs_temperature
        self.correction = Correction(calibration)
        self.uncertainty = [SlowUncertainty(calibration, self.correction)]
        #: Correction of the angular rate by the thermal state, or None without a gyroscope.
        self.rate_correction: Correction | None = None
        if calibration.gyroscope is not None:
            triad = rate_triad(calibration)
            self.rate_correction = Correction(triad, self.correction.memory)
            self.uncertainty.append(SlowUncertainty(triad, self.rate_correction))
        self.inputs = (BOARD_INPUT, *calibration.sensors)

    def slow_rows(self, slow: Sequence[SlowState]) -> Floats:
        """Return the slowly varying variances: `n_slow` rows of force, then the angular rate's."""
        states, shares, rates = (np.array(part).T for part in zip(*slow, strict=True))
        return np.concatenate([part.at(states, shares, rates) for part in self.uncertainty])

    def lines(
        self, start: npt.ArrayLike, end: npt.ArrayLike, slow: Floats, noise_excess: npt.ArrayLike
    ) -> tuple[Floats, Floats, Bools]:
        """
        Return `Correction.line` of force and of angular rate (no rows without a gyroscope), and
        whether both pass `is_sound`; `slow`: result of `slow_rows` for these segments.
        """
        n = self.correction.n_slow
        line = self.correction.line(start, end, slow[:n], noise_excess)
        if self.rate_correction is None:
            return line, line[:0], is_sound(line)
        rate_line = self.rate_correction.line(start, end, slow[n:], noise_excess)
        return line, rate_line, is_sound(line) & is_sound(rate_line)


class ThermalSide:
    """The queue of readings, the thermal state and the segments of a compensator."""

    def __init__(self, model: Model, config: CompensatorConfig, counters: Counters) -> None:
        self.counters = counters
        self.queue = ReadingQueue()
        self.flags: list[tuple[int, bool]] = []
        self._n_applied = 0
        self._use(model, config)
        self.tracker = self._new_tracker()

    def _use(self, model: Model, config: CompensatorConfig) -> None:
        self.config = config
        self.model, self.calibration = model, model.calibration
        self.correction, self.rate_correction = model.correction, model.rate_correction
        self.inputs = model.inputs
        self._forget_samples()

    def _forget_samples(self) -> None:
        unit = self.calibration.unit
        self.rate = RateCheck(unit.cycle_time_s, unit.input == 'counts')
        self._segment_key: tuple[int, int] | None = None
        self._slow_key: int | None = None
        self._slow = _NO_STATE
        self._slow_evaluated = _NO_STATE
        self._slow_rows: Floats = np.empty(0)
        #: End and thermal state of the last segment: the start of the next segment if no reading
        #: is applied in between.
        self._last_end: tuple[int, int, tuple[float, ...]] | None = None

    def _new_tracker(self) -> ThermalTracker:
        settings = self.calibration.detector
        return ThermalTracker(settings, self.correction.memory, *self._tracker_config())

    def _tracker_config(self) -> tuple[ThermalConfig, float, tuple[float, float]]:
        gentle_s = self.correction.gentle_transition(self.config.transition_time_s)
        config = replace(self.config, transition_time_s=gentle_s)
        calibration = self.calibration
        return config, calibration.board_lag_s, calibration.rest_gradient_range_k or ANY_RANGE

    def take_over(self, model: Model, config: CompensatorConfig, now_ns: int | None) -> None:
        """Use `model` and `config` from now on; copy objects shared with another compensator."""
        old, self.queue = self.tracker, copy(self.queue)
        unit, rate = self.calibration.unit, copy(self.rate)
        self._use(model, config)
        if self.calibration.unit == unit:
            # A new calibration of the same unit does not resume output stopped by the rate check.
            self.rate = rate
        self.queue.keep(lambda entry: entry[2] in self.inputs)
        if (model.calibration.detector, model.correction.memory) == (old.settings, old.spec):
            self.tracker = copy(old)
            self.tracker.reconfigure(*self._tracker_config(), now_ns)
            return
        self.tracker = self._new_tracker()
        # Start from the last temperatures, so that no sample is dropped for lack of a temperature.
        for name, sensor in old.thermometers.items():
            if name in self.inputs and sensor.stamp_ns is not None:
                self.tracker.read(name, sensor.stamp_ns, sensor.temperature)

    def reset(self) -> None:
        """Forget temperatures, regime and rate; keep waiting readings and counters."""
        self.tracker = self._new_tracker()
        self._forget_samples()

    def push(self, name: str, stamp_ns: int, celsius: float) -> None:
        """Queue a reading, if the calibration has a thermometer of this name."""
        if name in self.inputs:
            for dropped in self.queue.push(name, stamp_ns, celsius):
                self._count_rejected(dropped)

    def _count_rejected(self, name: str) -> None:
        if name == BOARD_INPUT:
            self.counters.n_board_rejected += 1
        else:
            self.counters.n_case_rejected += 1

    def flush(self, stamp_ns: int) -> None:
        """Apply the waiting temperature readings up to a stamp."""
        tracker = self.tracker
        for reading_ns, _, name, _, celsius in self.queue.due(stamp_ns):
            self._n_applied += 1
            if not tracker.read(name, reading_ns, celsius):
                self._count_rejected(name)
                continue
            if name == BOARD_INPUT:
                self.counters.n_board += 1
                is_leading = not tracker.is_live(reading_ns, tracker.case)
            else:
                self.counters.n_case += 1
                is_leading = name == self.inputs[1]
            regime = tracker.detector.regime
            if is_leading and regime is not Regime.UNKNOWN:
                self.flags.append((reading_ns, regime is Regime.DYNAMIC))

    @property
    def is_unmeasured(self) -> bool:
        """Whether the correction is constant and no board temperature has been used."""
        return not self.model.needs_temperature and self.tracker.board.stamp_ns is None

    def sample(self, stamp_ns: int) -> tuple[float, ...]:
        """Return the thermal state at a stamp, or of a soak at T_ref if `is_unmeasured`."""
        if self.is_unmeasured:
            gradients = (0.0, 0.0) * len(self.calibration.sensors)
            reference = self.calibration.reference_temperature_c
            return (reference, UNMEASURED_SD_K**2, 0.0, 0.0, 0.0, *gradients)
        return self.tracker.sample(stamp_ns)

    @property
    def fresh_until_ns(self) -> int:
        """Last stamp with a valid board temperature; NEVER_NS: none needed, EVER_NS: none yet."""
        if not self.model.needs_temperature:
            return NEVER_NS
        board_ns = self.tracker.board.stamp_ns
        timeout_ns = int(self.config.temperature_timeout_s * 1e9)
        return EVER_NS if board_ns is None else board_ns + timeout_ns

    def count_unmeasured(self, n_samples: int) -> None:
        """Count samples dropped because the board temperature is missing or too old."""
        if self.tracker.board.stamp_ns is None:
            self.counters.n_no_temperature += n_samples
        else:
            self.counters.n_stale += n_samples

    def segment(self, stamp_ns: int, n_seen: int) -> Segment:
        """Return the segment of a stamp; if new, check the rate of the `n_seen` samples so far."""
        start_ns = stamp_ns - (stamp_ns - (self.tracker.updated_ns or 0)) % SEGMENT_NS
        key = (self._n_applied, start_ns)
        is_new = key != self._segment_key
        if is_new:
            self._segment_key = key
            self.rate.update(n_seen, stamp_ns)
        end_ns, last = start_ns + SEGMENT_NS, self._last_end
        start = last[2] if last and last[:2] == key else self.sample(start_ns)
        end = self.sample(end_ns)
        self._last_end = (self._n_applied, end_ns, end)
        slow, rate = self._slow_at(start_ns, end), self.rate
        return Segment(start_ns, is_new, rate.is_too_fast, rate.noise_excess, start, end, slow)

    def bias_sd(self, correction: Correction, variances: Sequence[float]) -> tuple[float, ...]:
        """Return each axis' bias sd: the root of the output variance less the noise variance."""
        excess = 1.0 + self.rate.noise_excess
        pairs = zip(variances, correction.noise, strict=False)
        return tuple(sqrt(max(0.0, whole - excess * noise)) for whole, noise in pairs)

    def slow_rows(self, slow: SlowState) -> Floats:
        """Return the slowly varying error covariance, evaluated once per `SlowState`."""
        if slow is not self._slow_evaluated:
            self._slow_evaluated = slow
            self._slow_rows = self.model.slow_rows([slow])[:, 0]
        return self._slow_rows

    def _slow_at(self, start_ns: int, end_state: tuple[float, ...]) -> SlowState:
        """Return the arguments of the slowly varying variance; they are at most `SLOW_NS` old."""
        # The variance due to the unknown initial lag states depends on the rate of the board
        # temperature, which is uncertain at first: evaluate this variance every second.
        is_young = self.tracker.board.n_in_row < YOUNG_READINGS
        key = start_ns // (SEGMENT_NS if is_young else SLOW_NS)
        if key != self._slow_key:
            self._slow_key = key
            if self.is_unmeasured:
                # The temperature is unknown: evaluate the variance at T_ref plus one sd.
                end_state = (end_state[BOARD] + UNMEASURED_SD_K, *end_state[1:])
            memory = self.tracker.memory
            shares = memory.remaining_shares(start_ns + SEGMENT_NS)
            self._slow = SlowState(end_state, shares, memory.start_rate)
        return self._slow
