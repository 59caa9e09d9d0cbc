# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns (counts, temperatures) -> (specific force, covariance, regime, status), streaming and batch.

Between two thermal events the bias and the scale of each axis move linearly in time. An event is
a temperature reading or, while none comes, the end of a one-second segment; there the correction
is evaluated in full (at the segment's start and end), so a sample costs a few operations, follows
the temperature without a staircase, and a batch needs the full evaluation once per segment.

A reading takes effect at the first sample whose stamp is not before its own and that comes after
it; so the result depends on stamps and order of arrival, not on when the code happened to run,
and a node that got everything in order publishes the bits that the offline replay writes.

Each segment begins with a look at what the samples say of themselves: their rate, and, from the
segment's first sample, |f| against gravity while the platform stands. So the checks cost nothing
per sample, and a batch comes to the same verdicts.

"""

from __future__ import annotations

import math
from typing import Final

from ..thermal.reading_queue import ReadingQueue
from ..thermal.regime import Regime
from ..thermal.settings import ThermalConfig
from ..thermal.tracker import ThermalTracker
from ..unit.calibration import Calibration
from ..unit.correction import Correction
from .health import GravityMonitor
from .sample_guard import RateWatch, StuckWatch
from .status import CompensatorConfig, Counters

#: Samples this much faster than calibrated, relative, still have the calibrated noise.
RATE_TOLERANCE: Final = 0.1
#: Longest time over which bias and scale are taken as linear in time.
SEGMENT_NS: Final = 1_000_000_000
#: A stamp that goes back by more than this is a jump of time (a bag that loops), not disorder.
TIME_JUMP_NS: Final = 1_000_000_000
#: Earlier than any stamp.
_EVER_NS: Final = -(1 << 62)

_Nine = tuple[float, float, float, float, float, float, float, float, float]
_Twelve = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip
#: Specific force x, y, z [m/s^2] and the covariance xx, xy, xz, yy, yz, zz [m^2/s^4].
Corrected = _Nine


class Compensator:
    """
    Corrects one unit's samples, one by one.

    Parameters
    ----------
    calibration : Calibration
        The unit.
    config : CompensatorConfig, optional
        The user's settings.

    """

    def __init__(self, calibration: Calibration, config: CompensatorConfig | None = None) -> None:
        self.config = config or CompensatorConfig()
        self.counters = Counters()
        self._queue = ReadingQueue()
        #: Age of the board temperature beyond which nothing is published.
        self.timeout_ns = _timeout_ns(self.config)
        self._flags: list[tuple[int, bool]] = []
        self._n_applied = 0
        self._segment_key: tuple[int, int] | None = None
        self.stuck = StuckWatch(self.config.stuck_timeout_s)
        self._use(calibration)
        self.tracker = ThermalTracker(
            calibration.detector, calibration.memory_time_constants_s, self._thermal_config()
        )
        self.last_ns = self._event_ns = _EVER_NS

    def _use(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.correction = Correction(calibration)
        self._full_scale = self._limit = calibration.unit.full_scale
        self._counts_cycles = calibration.unit.input == 'counts'
        self.rate = RateWatch(calibration.unit.cycle_time_s)
        self.gravity = self._gravity_monitor()

    def _thermal_config(self) -> ThermalConfig:
        return ThermalConfig(
            self.correction.gentle_transition(self.config.transition_time_s),
            self.config.case_timeout_s,
            self.calibration.board_lag_s,
            self.config.temperature_timeout_s,
        )

    def _gravity_monitor(self) -> GravityMonitor:
        return GravityMonitor(
            self.config.local_gravity_m_s2 or self.calibration.gravity_m_s2,
            self.config.gravity_tolerance_m_s2,
        )

    def push_board(self, stamp_ns: int, celsius: float) -> None:
        """
        Queue a board temperature [degC]; it takes effect at the first sample not before it.

        """
        self._push(stamp_ns, 0, celsius)

    def push_case(self, stamp_ns: int, celsius: float) -> None:
        """
        Queue a case temperature [degC]; it takes effect at the first sample not before it.

        """
        self._push(stamp_ns, 1, celsius)

    def _push(self, stamp_ns: int, kind: int, celsius: float) -> None:
        n_refused = self._queue.push(stamp_ns, kind, celsius)
        if n_refused:
            self.count_rejected(kind, n_refused)
        self._event_ns = min(self._event_ns, stamp_ns)

    def process(self, stamp_ns: int, x: float, y: float, z: float) -> Corrected | None:
        """
        Correct one sample.

        Parameters
        ----------
        stamp_ns : int
            Its stamp.
        x, y, z : float
            The raw sample, in the calibration's input unit.

        Returns
        -------
        tuple of 9 floats or None
            Specific force x, y, z [m/s^2] and the covariance xx, xy, xz, yy, yz, zz [m^2/s^4];
            None where nothing must be published, with the reason counted in `counters`.

        """
        if not self.last_ns < stamp_ns < self._event_ns:
            return self._process_first(stamp_ns, x, y, z)
        self.last_ns = stamp_ns
        stuck = self.stuck
        run = stuck.run
        is_stuck = False
        if x == run[0] and y == run[1] and z == run[2]:
            is_stuck = stuck.again(stamp_ns)
        else:
            stuck.run = (x, y, z, stamp_ns)
            stuck.n_same = 0
        limit = self._limit
        if is_stuck or not (-limit < x < limit and -limit < y < limit and -limit < z < limit):
            self._count_bad(x, y, z)
            return None
        if not (x or y or z) and stuck.is_on:
            self.counters.n_stuck += 1
            return None
        (
            start_ns,
            (bx, bx1, sx, sx1, by, by1, sy, sy1, bz, bz1, sz, sz1),
            (ax, lx, qx, ay, ly, qy, az, lz, qz),
            (yx, zx, zy, var_yx, var_zx, var_zy),
        ) = self._segment
        dt = (stamp_ns - start_ns) * 1e-9
        x = (x - (bx + bx1 * dt)) / (sx + sx1 * dt)
        y = (y - (by + by1 * dt)) / (sy + sy1 * dt)
        z = (z - (bz + bz1 * dt)) / (sz + sz1 * dt)
        vx = ax + x * (lx + x * qx)
        vy = ay + y * (ly + y * qy)
        vz = az + z * (lz + z * qz)
        xx = x * x
        cxy = yx * vx
        cxz = zx * vx
        self.counters.n_out += 1
        return (
            x,
            yx * x + y,
            zx * x + zy * y + z,
            vx,
            cxy,
            cxz,
            yx * cxy + vy + xx * var_yx,
            yx * cxz + zy * vy,
            zx * cxz + zy * zy * vy + vz + xx * var_zx + y * y * var_zy,
        )

    def _count_bad(self, x: float, y: float, z: float) -> None:
        full_scale = self._full_scale
        if self.is_refusing:
            if self.rate_refuses:
                self.counters.n_too_fast += 1
            else:
                self.counters.n_refuted += 1
        elif not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            self.counters.n_not_finite += 1
        elif max(abs(x), abs(y), abs(z)) < full_scale:
            self.counters.n_stuck += 1
        else:
            self.counters.n_saturated += 1

    def _process_first(self, stamp_ns: int, x: float, y: float, z: float) -> Corrected | None:
        """
        Correct the first sample after an event, which serves the checks, too.

        """
        key = self._segment_key
        if not self._advance(stamp_ns):
            return None
        if self._segment_key == key:
            return self.process(stamp_ns, x, y, z)
        self.is_refusing = self.rate_refuses
        row = self.process(stamp_ns, x, y, z)
        if self.gravity.is_refuted and not self.rate_refuses:
            # It still tells when the trust is restored.
            self.is_refusing = True
            if row is not None:
                self.counters.n_out -= 1
                self.counters.n_refuted += 1
        if row is not None and self.gravity.wants(stamp_ns):
            self.gravity.add(stamp_ns, row[:3], row[3:], self.correction.noise_trace)
        return None if self.is_refusing else row

    @property
    def rate_refuses(self) -> bool:
        """
        Whether samples are held back because they cannot be conversions of the calibrated cycle.

        """
        return self.rate.is_too_fast and self._counts_cycles

    def _advance(self, stamp_ns: int) -> bool:
        """
        Bring the thermal state and the segment to a stamp; False where no sample may go out.

        """
        if not self._admit(stamp_ns):
            return False
        for reading_ns, kind, _, celsius in self._queue.due(stamp_ns):
            self.apply_reading(reading_ns, kind, celsius)
        return self._enter_segment(stamp_ns)

    def _admit(self, stamp_ns: int) -> bool:
        if stamp_ns > self.last_ns:
            return True
        if stamp_ns > self.last_ns - TIME_JUMP_NS:
            self.counters.n_out_of_order += 1
            return False
        # Readings of the old time that no sample reached belong to the time that is gone.
        self._queue.drop_after(stamp_ns)
        self.tracker.reset()
        self._forget_samples()
        self.counters.n_time_jumps += 1
        self.last_ns = stamp_ns - 1
        return True

    def _forget_samples(self) -> None:
        # What comes is another recording.
        self.stuck.reset()
        self.rate.reset()
        self.gravity = self._gravity_monitor()

    def apply_reading(self, stamp_ns: int, kind: int, celsius: float) -> None:
        """
        Let a reading take effect now: kind 0 is the board, 1 the case.

        """
        self._n_applied += 1
        tracker = self.tracker
        if kind == 0:
            if tracker.board_reading(stamp_ns, celsius):
                self.counters.n_board += 1
            else:
                self.count_rejected(kind)
        elif tracker.case_reading(stamp_ns, celsius):
            self.counters.n_case += 1
            regime = tracker.detector.regime
            if regime is not Regime.UNKNOWN:
                self._flags.append((stamp_ns, regime is Regime.DYNAMIC))
        else:
            self.count_rejected(kind)

    def count_rejected(self, kind: int, n: int = 1) -> None:
        """
        Count readings that are not used: kind 0 is the board, 1 the case.

        """
        if kind == 0:
            self.counters.n_board_rejected += n
        else:
            self.counters.n_case_rejected += n

    def _enter_segment(self, stamp_ns: int) -> bool:
        tracker = self.tracker
        board_ns = tracker.board.stamp_ns
        updated_ns = tracker.updated_ns
        next_ns = self._queue.next_ns
        if board_ns is None or updated_ns is None:
            self.counters.n_no_temperature += 1
            # Every sample comes back here until there is a temperature, and is counted here.
            self._event_ns = _EVER_NS
            self.last_ns = stamp_ns
            return False
        if stamp_ns - board_ns > self.timeout_ns:
            self.counters.n_stale += 1
            self._event_ns = _EVER_NS
            self.last_ns = stamp_ns
            return False
        # Segments count from the last reading, wherever the first sample in one may lie.
        start_ns = updated_ns + (stamp_ns - updated_ns) // SEGMENT_NS * SEGMENT_NS
        counters = self.counters
        self.open_segment(start_ns, counters.n_in - counters.n_out_of_order, stamp_ns)
        line, variance = self._evaluate(start_ns)
        self._segment = (start_ns, line, variance, self.correction.misalignment)
        deadline_ns = board_ns + self.timeout_ns + 1
        self._event_ns = min(next_ns, start_ns + SEGMENT_NS, deadline_ns)
        return True

    def open_segment(self, start_ns: int, n_seen: int, stamp_ns: int) -> bool:
        """
        Check the rate at a segment's first sample; False if the segment only goes on.

        Parameters
        ----------
        start_ns : int
            Where the segment begins.
        n_seen : int
            Samples in order that came before.
        stamp_ns : int
            Stamp of its first sample.

        Returns
        -------
        bool
            Whether it is a new segment, not one that a block's end has cut.

        """
        key = (self._n_applied, start_ns)
        if key == self._segment_key:
            return False
        self._segment_key = key
        self.rate.update(n_seen, stamp_ns)
        return True

    @property
    def noise_excess(self) -> float:
        """
        What the rate adds to the noise of a sample, relative; density^2 / cycle is for the cycle.

        """
        excess = self.rate.ratio - 1.0
        return excess if excess > RATE_TOLERANCE else 0.0

    def _evaluate(self, start_ns: int) -> tuple[_Twelve, _Nine]:
        """
        Lay a line from a segment's beginning to its end: bias and scale, their change; a, b, c.

        """
        correction = self.correction
        (bx, sx), (by, sy), (bz, sz) = correction.bias_scale(self.tracker.sample(start_ns))
        at_end, variance = correction.evaluate(self.tracker.sample(start_ns + SEGMENT_NS))
        (bx1, sx1), (by1, sy1), (bz1, sz1) = at_end
        (ax, lx, qx), (ay, ly, qy), (az, lz, qz) = variance
        nx, ny, nz = correction.noise
        excess = self.noise_excess
        return (
            (bx, bx1 - bx, sx, sx1 - sx, by, by1 - by, sy, sy1 - sy, bz, bz1 - bz, sz, sz1 - sz),
            (ax + excess * nx, lx, qx, ay + excess * ny, ly, qy, az + excess * nz, lz, qz),
        )

    def take_flags(self) -> list[tuple[int, bool]]:
        """
        Take the regime flags that became due: (stamp of the case reading, S).

        """
        flags, self._flags = self._flags, []
        return flags

    @property
    def is_refusing(self) -> bool:
        """
        Whether the samples of the present segment are held back.

        """
        return self._limit < 0.0

    @is_refusing.setter
    def is_refusing(self, value: bool) -> None:
        self._limit = -1.0 if value else self._full_scale

    def take_pending(self) -> list[tuple[int, int, int, float]]:
        """
        Take the readings that no sample has reached: (stamp, kind, order, degC).

        """
        self._event_ns = _EVER_NS
        return self._queue.take()

    def flush(self, stamp_ns: int) -> None:
        """
        Let queued readings up to a stamp take effect without a sample (no samples are coming).

        """
        for reading_ns, kind, _, celsius in self._queue.due(stamp_ns):
            self.apply_reading(reading_ns, kind, celsius)
        self._event_ns = _EVER_NS

    def swap(self, calibration: Calibration) -> None:
        """
        Take over another calibration between two samples.

        The thermometers, the regime and the memory go on where the new calibration reads them in
        the same way; a calibration with another detector or other time constants starts them anew.

        """
        same = (
            calibration.detector == self.calibration.detector
            and calibration.memory_time_constants_s == self.calibration.memory_time_constants_s
        )
        self._use(calibration)
        self._segment_key = None
        if same:
            self.tracker.reconfigure(self._thermal_config(), self.now_ns)
        else:
            self.tracker = self._restarted(calibration)
        self._event_ns = _EVER_NS

    def _restarted(self, calibration: Calibration) -> ThermalTracker:
        """
        Make a tracker that starts from the temperatures just seen, so that no sample is lost.

        """
        tracker = ThermalTracker(
            calibration.detector, calibration.memory_time_constants_s, self._thermal_config()
        )
        old = self.tracker
        if old.board.stamp_ns is not None:
            tracker.board_reading(old.board.stamp_ns, old.board.temperature)
        if old.case.stamp_ns is not None:
            tracker.case_reading(old.case.stamp_ns, old.case.temperature)
        return tracker

    def reconfigure(self, config: CompensatorConfig) -> None:
        """
        Take over other settings between two samples.

        """
        if config.stuck_timeout_s != self.config.stuck_timeout_s:
            self.stuck = StuckWatch(config.stuck_timeout_s)
        self.config = config
        self.timeout_ns = _timeout_ns(config)
        self.gravity = self._gravity_monitor()
        self._segment_key = None
        self.tracker.reconfigure(self._thermal_config(), self.now_ns)
        self._event_ns = _EVER_NS

    @property
    def now_ns(self) -> int | None:
        """
        Stamp of the last sample; None before the first.

        """
        return self.last_ns if self.last_ns != _EVER_NS else None

    def pending_ahead(self, stamp_ns: int) -> float:
        """
        How far the farthest reading that waits for a sample lies ahead of a stamp [s]; 0 if none.

        """
        return self._queue.ahead(stamp_ns)

    def reset(self) -> None:
        """
        Forget temperatures, regime and queue; counters stay.

        """
        self.tracker.reset()
        self._queue.take()
        self._flags.clear()
        self._forget_samples()
        self._segment_key = None
        self.last_ns = self._event_ns = _EVER_NS


def _timeout_ns(config: CompensatorConfig) -> int:
    return int(config.temperature_timeout_s * 1e9)
