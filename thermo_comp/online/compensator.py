# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the correction of a stream of samples: counts and temperatures to specific force, covariance,
regime and status.

A temperature reading applies from the next arriving sample with an equal or later stamp on. Stamps
and order of arrival thus determine the output: a node that received all messages in order
publishes the same bits as the offline replay. To save time, the sample rate and |f| at rest are
checked at the first sample of each segment only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Final

from ..thermal.lags import BOARD_INPUT
from ..thermal.plausibility import Fault
from ..thermal.regime import Regime
from ..thermal.state import GRADIENT
from ..unit.calibration import Calibration
from ..unit.correction import SCALE_VARIANCES, VARIANCES, Excess
from ..unit.covariance import Real, covariance_at
from ..unit.functions import TANGENT_SPANS
from ..unit.nonlinearity import corrected_nonlinear
from .checks import MOTION, GravityCheck, StuckCheck, roughness
from .segments import EVER_NS, SEGMENT_NS, Model, ThermalSide
from .status import CompensatorConfig, Counters, GravityResidual

#: Smallest backward step of the stamps that counts as a jump of time, as in a looped bag [ns].
TIME_JUMP_NS: Final = 1_000_000_000
#: A forward step of the stamps above both limits ([ns], [cycles]) is accepted only if a reading or
#: a second sample confirms the step; otherwise a damaged stamp would erase the thermal memory.
LEAP_NS: Final = 15_000_000_000
LEAP_CYCLES: Final = 10.0
#: Age above which a board temperature is stale: number of reading intervals, and lower bound [s].
STALE_INTERVALS: Final = 5.0
SHORTEST_STALE_S: Final = 0.5
#: Texts about the status of a compensator, for diagnostics and offline reports.
SWAPPED: Final = (
    'the board leads the case in ramps: are temperature/board and temperature/case swapped, is '
    'the case thermometer loose, or is the unit heated from inside?'
)
HELD: Final = 'outside the calibrated range: corrected as at the edge of the range'
CONTINUED: Final = (
    'outside the calibrated range: curves continued along their tangent for '
    f'{TANGENT_SPANS:g} of the range, then constant'
)

#: Variances of an angular rate that is not finite; the first, -1, means no rate in an Imu.
NO_RATE: Final = (-1.0, 0.0, 0.0)

#: Specific force x, y, z [m/s^2] and the covariance xx, xy, xz, yy, yz, zz [m^2/s^4].
Corrected = tuple[float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class CompensatorStatus:
    """State of a compensator at the stamp of its last sample."""

    stamp_ns: int | None
    #: Fault of each thermometer, and its size [K]: the rejected step, the shift, or the
    #: unexplained gradient of a loose thermometer.
    faults: Mapping[str, tuple[Fault, float]]
    #: Time from the last sample to the latest queued temperature reading [s].
    pending_ahead_s: float
    #: Thermal state in the order of `StateLayout`; empty until there is a board temperature.
    state: tuple[float, ...] = ()
    regime: Regime = Regime.UNKNOWN
    direction: int = 0  # temperature change: -1 cooling, +1 heating, 0 neither
    is_settled: bool = False  # whether the unknown initial lag states have decayed
    #: Time from the last used reading of board or case to the last sample [s]; inf: none used.
    board_age_s: float = math.inf
    case_age_s: float = math.inf
    is_board_stale: bool = True
    is_board_lost: bool = True
    is_case_lost: bool = True
    excess: Excess = Excess(0.0, 0.0, 0.0, 0.0)  # noqa: RUF009 - it is immutable
    #: Whether the board temperature leads the case temperature in a ramp, as with swapped topics.
    is_lead_reversed: bool = False
    gravity: GravityResidual | None = None  # residual at rest, or None before the first rest
    #: Whether nothing is published, as the error of |f| at rest exceeds the tolerance plus 5 sd.
    is_refuted: bool = False
    #: Sd of the corrected angular rate's bias on each axis [rad/s]; empty without a gyroscope.
    rate_bias_sd: tuple[float, ...] = ()


class Compensator:
    """Corrects the samples of one unit, each when it arrives."""

    def __init__(
        self, calibration: Calibration | Model, config: CompensatorConfig | None = None
    ) -> None:
        self.config = config or CompensatorConfig()
        self.counters = Counters()
        model = calibration if isinstance(calibration, Model) else Model(calibration)
        self.thermal = ThermalSide(model, self.config, self.counters)
        self._use(model.calibration)
        self.stuck = self._stuck_check()
        self.last_ns = self.event_ns = EVER_NS
        #: Stamp of a sample long after all earlier stamps, not yet confirmed by a second sample.
        self.leapt_ns: int | None = None
        self.reading_ns = EVER_NS  # the latest stamp of a reading
        #: The present segment: start [ns], result of `Correction.line`, and misalignment.
        self._segment: tuple[int, list[float], tuple[float, ...]] = (0, [], ())
        #: `Correction.line` of the angular rate in the present segment; empty without a gyroscope.
        self.rate_line: list[float] = []

    def _use(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._full_scale = self._limit = calibration.unit.full_scale
        self._edge = self.thermal.correction.beyond.edge
        self.scales = [axis.scale_factor for axis in calibration.axes]
        self.gravity = GravityCheck(*self._gravity_settings)
        self.evaluate = corrected_nonlinear if calibration.nonlinearity else corrected
        self.leap_ns = max(LEAP_NS, round(LEAP_CYCLES * 1e9 * calibration.unit.cycle_time_s))

    def _stuck_check(self) -> StuckCheck:
        scales, root_s = list(map(abs, self.scales)), math.sqrt(self.calibration.unit.cycle_time_s)
        pairs = zip(scales, self.calibration.noise_density_m_s2_sqrt_hz, strict=True)
        noise_sds = [scale * density / root_s for scale, density in pairs]
        return StuckCheck(self.config.stuck_timeout_s, MOTION * max(scales), noise_sds)

    @property
    def _gravity_settings(self) -> tuple[float, float]:
        """Gravity, and the tolerance of |f| about gravity [m/s^2]."""
        gravity = self.config.local_gravity_m_s2 or self.calibration.gravity_m_s2
        return gravity, self.config.gravity_tolerance_m_s2

    def push(self, name: str, stamp_ns: int, celsius: float) -> None:
        """
        Queue a reading [degC]; readings of thermometers that the calibration lacks are ignored.

        At most 4096 readings wait for a sample with an equal or later stamp. If more wait, the
        older half is dropped and counted as rejected.
        """
        self.thermal.push(name, stamp_ns, celsius)
        self.event_ns = min(self.event_ns, stamp_ns)
        self.reading_ns = max(self.reading_ns, stamp_ns)

    def process(self, stamp_ns: int, x: float, y: float, z: float) -> Corrected | None:
        """
        Correct one sample in the calibration's input unit.

        Returns specific force x, y, z [m/s^2] and the covariance xx, xy, xz, yy, yz, zz [m^2/s^4];
        None if the sample must not be published, with the reason counted in `counters`.
        """
        if not self.last_ns < stamp_ns < self.event_ns:
            return self._process_first(stamp_ns, x, y, z)
        self.last_ns = stamp_ns
        stuck = self.stuck
        last = stuck.last
        is_stuck = False
        if x == last[0] or y == last[1] or z == last[2]:
            is_stuck = stuck.again(stamp_ns, x, y, z)
        else:
            stuck.last = (x, y, z, stamp_ns)
            stuck.runs = ()
        limit = self._limit
        is_stuck = is_stuck or (stuck.is_on and not (x or y or z))
        if is_stuck or not (-limit < x < limit and -limit < y < limit and -limit < z < limit):
            self._count_bad(x, y, z)
            return None
        self.counters.n_out += 1
        start_ns, line, misalignment = self._segment
        row = self.evaluate(line, misalignment, (stamp_ns - start_ns) * 1e-9, x, y, z)
        edge = self._edge
        if -edge < row[0] < edge and -edge < row[1] < edge and -edge < row[2] < edge:
            return row
        return self.thermal.correction.beyond.widened(*row)

    @property
    def corrects_rate(self) -> bool:
        """Whether the calibration has a gyroscope."""
        return self.thermal.rate_correction is not None

    def correct_rate(
        self, stamp_ns: int, x: float, y: float, z: float
    ) -> tuple[float, float, float, float, float, float]:
        """
        Return the corrected angular rate [rad/s] of the last sample, then its variances.

        A rate that is not finite has the variances -1, 0, 0, as a missing rate in sensor_msgs/Imu.
        """
        dt = (stamp_ns - self._segment[0]) * 1e-9
        row = corrected_rate(self.rate_line, dt, x, y, z)
        return row if math.isfinite(x + y + z) else (*row[:3], *NO_RATE)

    def _count_bad(self, x: float, y: float, z: float) -> None:
        if self.is_refusing and self.thermal.rate.is_too_fast:
            self.counters.n_too_fast += 1
        elif self.is_refusing:
            self.counters.n_refuted += 1
        elif not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            self.counters.n_not_finite += 1
        elif max(abs(x), abs(y), abs(z)) < self._full_scale:
            self.counters.n_stuck += 1
        else:
            self.counters.n_saturated += 1

    def _process_first(self, stamp_ns: int, x: float, y: float, z: float) -> Corrected | None:
        """Correct and check the first sample after a reading or the end of a segment."""
        if stamp_ns <= self.last_ns - TIME_JUMP_NS:
            self.jump_back(stamp_ns)
            self.reading_ns, self.leapt_ns = EVER_NS, None
        elif stamp_ns <= self.last_ns or self.is_leap(stamp_ns):
            self.counters.n_out_of_order += 1
            return None
        thermal = self.thermal
        thermal.flush(stamp_ns)
        fresh_ns = thermal.fresh_until_ns
        if stamp_ns > fresh_ns:
            thermal.count_unmeasured(1)
            # This branch drops and counts every sample until a fresh board temperature is used.
            self.event_ns = EVER_NS
            self.last_ns = stamp_ns
            return None
        counters = self.counters
        segment = thermal.segment(stamp_ns, counters.n_in - counters.n_out_of_order)
        start_ns, is_new, is_too_fast, excess, start, end, state = segment
        self.event_ns = min(thermal.queue.next_ns, start_ns + SEGMENT_NS, fresh_ns + 1)
        correction, slow = thermal.correction, thermal.slow_rows(state)
        line, rate_line, is_good = thermal.model.lines(start, end, slow, excess)
        self.rate_line = rate_line.tolist()
        if not is_good:
            # This branch drops and counts every sample while the correction is not finite.
            counters.n_unsound += 1
            self.event_ns, self.last_ns = EVER_NS, stamp_ns
            return None
        self._segment = (start_ns, line.tolist(), correction.misalignment)
        if is_new:
            self.is_refusing = is_too_fast
        last = self.stuck.last[:3]
        row = self.process(stamp_ns, x, y, z)
        if not is_new:
            return row
        if self.gravity.is_refuted and not is_too_fast:
            # The |f| of dropped samples is checked: output resumes once |f| agrees with gravity.
            self.is_refusing = True
            if row is not None:
                counters.n_out -= 1
                counters.n_refuted += 1
        if row is not None and self.gravity.wants(stamp_ns):
            rough = roughness((x, y, z), last, self.scales)
            self.gravity.add(stamp_ns, row[:3], row[3:], correction.noise_trace, rough)
        return None if self.is_refusing else row

    def is_leap(self, stamp_ns: int) -> bool:
        """Whether a stamp is too long after all earlier stamps to be accepted from one sample."""
        leapt_ns, self.leapt_ns = self.leapt_ns, None
        near_ns = stamp_ns - self.leap_ns
        is_far = self.last_ns != EVER_NS and max(self.last_ns, self.reading_ns) < near_ns
        if is_far and (leapt_ns is None or stamp_ns <= leapt_ns):
            self.leapt_ns = stamp_ns
            self.event_ns = EVER_NS  # makes `is_leap` test the next sample, too
            return True
        return False

    def jump_back(self, stamp_ns: int) -> None:
        """Restart at a sample before which the stamps have jumped back, as in a looped bag."""
        # Waiting readings with later stamps belong to the time before the backward jump.
        self.thermal.queue.keep(lambda entry: entry[0] <= stamp_ns)
        self.thermal.reset()
        self.stuck = self._stuck_check()
        is_refuted = self.gravity.is_refuted
        self.gravity = GravityCheck(*self._gravity_settings)
        # A refuted calibration stays refuted until |f| in still windows agrees with gravity.
        self.gravity.is_refuted = is_refuted
        self.counters.n_time_jumps += 1
        self.last_ns = stamp_ns - 1

    def take_flags(self) -> list[tuple[int, bool]]:
        """Return regime flags since the last call: stamp of a reading [ns], True if dynamic."""
        flags, self.thermal.flags = self.thermal.flags, []
        return flags

    @property
    def is_refusing(self) -> bool:
        """Whether the samples of the present segment are dropped."""
        return self._limit < 0.0

    @is_refusing.setter
    def is_refusing(self, value: bool) -> None:
        self._limit = -1.0 if value else self._full_scale

    def flush(self, stamp_ns: int) -> None:
        """Apply the queued readings up to a stamp; for use while no samples come."""
        self.thermal.flush(stamp_ns)
        self.event_ns = EVER_NS

    def swap(self, calibration: Calibration) -> None:
        """Use `calibration` instead of the present calibration from the next sample on."""
        self.take_over(Model(calibration), self.config)

    def successor(self, model: Model, config: CompensatorConfig) -> Compensator:
        """
        Build a compensator that continues from the last sample with `model` and `config`.

        The states of thermometers, regime and memory are kept if `model` has the detector
        settings, lags and play operators of the present model; otherwise only the last
        temperatures are kept. Both compensators share objects: use only one of them afterwards.
        """
        new = copy(self)
        new.take_over(model, config)
        return new

    def take_over(self, model: Model, config: CompensatorConfig) -> None:
        """Use `model` and `config` from now on; copy objects shared with another compensator."""
        gravity, before, stuck = copy(self.gravity), self._gravity_settings, self.stuck
        self.config, self.thermal = config, copy(self.thermal)
        self.thermal.take_over(model, config, self.now_ns)
        is_same = self.calibration == model.calibration
        self._use(model.calibration)
        if is_same and self._gravity_settings == before:
            # Calibration and tolerance of |f| are unchanged: keep the result of the check of |f|.
            self.gravity = gravity
        self.stuck = self._stuck_check()
        if self.stuck.limit_ns == stuck.limit_ns:
            self.stuck.last, self.stuck.runs = stuck.last, stuck.runs
        self.event_ns = EVER_NS

    @property
    def now_ns(self) -> int | None:
        """Stamp of the last sample; None before the first sample."""
        return self.last_ns if self.last_ns != EVER_NS else None

    def status(self) -> CompensatorStatus:
        """Return the state of the compensator, for diagnostics."""
        thermal = self.thermal
        tracker = thermal.tracker
        detector, gravity = tracker.detector, self.gravity
        stamp_ns = tracker.updated_ns if self.now_ns is None else self.now_ns
        ahead_s = 0.0 if stamp_ns is None else thermal.queue.ahead(stamp_ns)
        faults = {name: check.finding for name, check in tracker.checks.items()}
        board_ns, case_ns = tracker.board.stamp_ns, tracker.case.stamp_ns
        if stamp_ns is None or (board_ns is None and not thermal.is_unmeasured):
            return CompensatorStatus(stamp_ns, faults, ahead_s)
        board_age_s, case_age_s = (
            math.inf if used_ns is None else (stamp_ns - used_ns) * 1e-9
            for used_ns in (board_ns, case_ns)
        )
        # The warning of a stale board temperature comes at half the time-out or earlier.
        timeout_s = self.config.temperature_timeout_s
        usual_s = max(STALE_INTERVALS * tracker.board.interval_s, SHORTEST_STALE_S)
        state = thermal.sample(stamp_ns)
        loose_k = tracker.loose_k(state[GRADIENT])
        for name, twin in tracker.copies.items():
            if twin.is_copy and faults[name][0] is Fault.NONE:
                faults[name] = Fault.COPY, 0.0
        if loose_k and faults[BOARD_INPUT][0] in (Fault.NONE, Fault.SHIFTED):
            faults[BOARD_INPUT] = Fault.LOOSE, loose_k
        rate_bias_sd: tuple[float, ...] = ()
        if thermal.rate_correction is not None and self.rate_line:
            variances = [self.rate_line[place] for place in VARIANCES]
            rate_bias_sd = thermal.bias_sd(thermal.rate_correction, variances)
        return CompensatorStatus(
            stamp_ns,
            faults,
            ahead_s,
            state,
            detector.regime,
            detector.direction,
            thermal.is_unmeasured or tracker.is_settled(stamp_ns),
            board_age_s,
            case_age_s,
            board_age_s > min(timeout_s / 2.0, usual_s),
            board_age_s > timeout_s,
            not tracker.is_live(stamp_ns, tracker.case),
            thermal.correction.excess(state, is_dynamic=detector.regime == Regime.DYNAMIC),
            tracker.lead.is_reversed,
            gravity.result,
            gravity.is_refuted,
            rate_bias_sd,
        )

    @property
    def scale_sd(self) -> tuple[float, ...]:
        """Relative sd of each scale factor in the present segment; () before the first segment."""
        line = self._segment[1]
        return tuple(math.sqrt(max(0.0, line[place])) for place in SCALE_VARIANCES if line)


def corrected(
    line: Sequence[Real], misalignment: tuple[float, ...], dt: Real, x: Real, y: Real, z: Real
) -> tuple[Real, Real, Real, Real, Real, Real, Real, Real, Real]:
    """Return force x, y, z and covariance xx, xy, xz, yy, yz, zz, `dt` s after a segment began."""
    bx, bx1, sx, sx1, by, by1, sy, sy1, bz, bz1, sz, sz1 = line[:12]
    yx, zx, zy = misalignment
    # Equation 7 of the paper (docs/theory.md), solved for the input of each axis.
    x = (x - (bx + bx1 * dt)) / (sx + sx1 * dt)
    y = (y - (by + by1 * dt)) / (sy + sy1 * dt)
    z = (z - (bz + bz1 * dt)) / (sz + sz1 * dt)
    xx, xy, xz, yy, yz, zz = covariance_at(line[12:], x, y, z)
    return x, yx * x + y, zx * x + zy * y + z, xx, xy, xz, yy, yz, zz


def corrected_rate(
    line: Sequence[Real], dt: Real, x: Real, y: Real, z: Real
) -> tuple[Real, Real, Real, Real, Real, Real]:
    """Return the angular rate x, y, z and each axis' variance, `dt` s after a segment's start."""
    bx, bx1, _, _, by, by1, _, _, bz, bz1 = line[:10]
    xx, yy, zz = (line[place] for place in VARIANCES)
    return x - (bx + bx1 * dt), y - (by + by1 * dt), z - (bz + bz1 * dt), xx, yy, zz
