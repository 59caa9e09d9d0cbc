# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the causal static/dynamic decision with its memory; it has no clock of its own.

The test (derived in docs/regime.md). A soak has a baseline rate. Two linear filters of different
memory integrate the second derivative of the leading temperature: each gives the present rate,
with a noise variance known in closed form. The dynamic state *opens* when the rate has left the
baseline by more than the chamber's ripple can explain plus a threshold that follows from the
allowed false alarms (Rice's formula for the crossings of a Gaussian process). It is *held* as long
as any sensor's rate, now or half a lag ahead, may exceed the relaxed rate: through the ramp, where
the second derivative is nil, and after it, until the board's lag has died.

References
----------
.. [1] S. O. Rice, "Mathematical analysis of random noise", Bell System Technical Journal 24, 1945.
.. [2] M. Basseville, I. V. Nikiforov, "Detection of Abrupt Changes", Prentice-Hall, 1993.

"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from math import acos, inf, isnan, log, nan, pi, sqrt

from .thermometer import Thermometer, ThermometerSettings

BEND_SHARES = (1.0, 10.0)  # accelerations the two filters are tuned to / the smallest onset
CELL_NOISE_SHARE = 0.4  # noise in a filter's own variance when cells make it come in bunches
SETTLING = 5.0  # memories until a filter's noise is the formula's
HOLD_LAGS = 0.75  # the shortest dynamic state, in lags of the leading sensor
# "The rate is below": the variance in a calm is mostly that of what may begin, so half a sd.
SURE_SIGMAS = 0.5
OBVIOUS_SIGMAS = 5.0  # confidence of "the rate is above"
OBVIOUS_SHARE = 1.5  # the hysteresis: opens above this many relaxed rates, closes below one


class Regime(IntEnum):
    """
    What the surroundings do to the unit; values are those of the paper's S.

    """

    UNKNOWN = -1
    STATIC = 0
    DYNAMIC = 1


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """
    What must be seen and what must not; its keys are the calibration file's `detector` section.

    Parameters
    ----------
    smallest_ramp_k_min : float
        The slowest ramp that must never be missed, K/min.
    false_alarms_per_hour : float
        How often the sensor's noise alone may open the dynamic state, per hour of soak.
    ripple_c : float
        Amplitude of the surroundings' temperature in a soak (a chamber's control ripple), K.
        Through the lag it makes a rate of at most ``ripple_c / lag_s``, which is no onset.
    relaxed_rate_k_min : float
        The lag has died when every sensor's rate is surely below this, K/min.
    dwell_s : float
        How long it must have been below, and the shortest dynamic state, s.
    case, board : ThermometerSettings
        The two sensors.

    Raises
    ------
    ValueError
        If a value is not finite, outside its range, or contradicts another one.

    """

    smallest_ramp_k_min: float = 0.2
    false_alarms_per_hour: float = 0.02
    ripple_c: float = 0.1
    relaxed_rate_k_min: float = 0.05
    dwell_s: float = 60.0
    case: ThermometerSettings = field(default_factory=ThermometerSettings)
    board: ThermometerSettings = field(default_factory=ThermometerSettings)

    def __post_init__(self) -> None:
        """
        Refuse values that contradict each other.

        """
        for name in ('smallest_ramp_k_min', 'false_alarms_per_hour', 'relaxed_rate_k_min'):
            value = getattr(self, name)
            if not 0.0 < value < inf:
                raise ValueError(f'`{name}` must be positive and finite, got {value}')
        for name in ('ripple_c', 'dwell_s'):
            value = getattr(self, name)
            if not 0.0 <= value < inf:
                raise ValueError(f'`{name}` must be zero or positive and finite, got {value}')
        if self.relaxed_rate_k_min * OBVIOUS_SHARE >= self.smallest_ramp_k_min:
            raise ValueError(
                f'`relaxed_rate_k_min` must be below `smallest_ramp_k_min` / {OBVIOUS_SHARE}, '
                f'got {self.relaxed_rate_k_min} and {self.smallest_ramp_k_min}'
            )


class RegimeDetector:
    """
    State machine over the estimates of the case and the board.

    Parameters
    ----------
    settings : DetectorSettings
        Thresholds in physical terms.

    Attributes
    ----------
    regime : Regime
        The state.
    direction : int
        In the dynamic state -1 cooling, +1 heating, 0 not yet sure; otherwise 0.
    switched_ns : int or None
        Stamp of the last switch.

    """

    def __init__(self, settings: DetectorSettings) -> None:
        self.settings = settings
        self._relaxed_rate = settings.relaxed_rate_k_min / 60.0
        self._dwell_ns = round(settings.dwell_s * 1e9)
        self._forget_ns = round(1e9 * max(settings.case.lag_s, settings.board.lag_s))
        self._case_onset = _OnsetTest(settings, settings.case)
        self._board_onset = _OnsetTest(settings, settings.board)
        self._case_calm = _CalmTest(settings, settings.case)
        self._board_calm = _CalmTest(settings, settings.board)
        self.reset()

    def reset(self) -> None:
        """
        Back to unknown, as after time has jumped back.

        """
        self.regime = Regime.UNKNOWN
        self.direction = 0
        self.switched_ns: int | None = None
        self._stamp_ns: int | None = None
        self._calm_ns: int | None = None
        self._held_until_ns: int | None = None
        self._is_grown = False
        self._case_onset.reset()
        self._board_onset.reset()
        self._case_calm.reset()
        self._board_calm.reset()

    def update(self, stamp_ns: int, case: Thermometer | None, board: Thermometer | None) -> Regime:
        """
        Decide after an accepted reading of the leading sensor.

        Parameters
        ----------
        stamp_ns : int
            Stamp of that reading, ns.
        case, board : Thermometer or None
            The two estimates; None for a sensor that is lost. The case leads while it is there.

        Returns
        -------
        Regime
            The regime from this stamp on.

        """
        if case is not None:
            lead, onset = case, self._case_onset
        elif board is not None:
            lead, onset = board, self._board_onset
        else:
            return self.regime
        if self._stamp_ns is not None and stamp_ns - self._stamp_ns > self._forget_ns:
            self.reset()
        self._stamp_ns = stamp_ns
        departure = onset.update(stamp_ns, lead, self.regime, self._is_grown)
        if not lead.is_ready:
            return self.regime

        is_calm = self._case_calm.update(stamp_ns, case)
        is_calm = self._board_calm.update(stamp_ns, board) and is_calm
        if self.regime == Regime.DYNAMIC and not self._is_grown:
            # An onset is seen before the rate is large: until then only its own end ends it.
            self._is_grown = abs(lead.rate) > OBVIOUS_SHARE * self._relaxed_rate
            is_calm = is_calm and onset.is_back()
        if not is_calm:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = stamp_ns

        if self.regime != Regime.DYNAMIC:
            if departure:
                self._open(stamp_ns, departure, lead)
            elif not is_calm:
                speed = OBVIOUS_SHARE * self._relaxed_rate
                direction = _obvious(lead, speed)
                if direction == 0 and board is not None and board.is_ready:
                    direction = _obvious(board, speed)
                if direction:
                    self._open(stamp_ns, direction, lead)
        else:
            direction = _obvious(lead, onset.ripple_rate)
            if direction:
                self.direction = direction
        if (
            self.regime != Regime.STATIC
            and self._calm_ns is not None
            and stamp_ns - self._calm_ns >= self._dwell_ns
            and (self._held_until_ns is None or stamp_ns >= self._held_until_ns)
        ):
            self.regime = Regime.STATIC
            self.direction = 0
            self.switched_ns = stamp_ns
            onset.settle(lead)
        return self.regime

    def _open(self, stamp_ns: int, direction: int, lead: Thermometer) -> None:
        self.regime = Regime.DYNAMIC
        self.direction = direction
        self.switched_ns = stamp_ns
        self._is_grown = False
        # An onset is seen long before the rate has grown: give the ramp time to show.
        hold_ns = max(self._dwell_ns, round(HOLD_LAGS * 1e9 * lead.settings.lag_s))
        self._held_until_ns = stamp_ns + hold_ns


class _OnsetTest:
    """
    Has the rate of one sensor left the baseline of the soak?

    Two linear filters of temperature and rate with different memories watch the readings. Where
    the cells are so wide that noise cannot cross one, the time between two edges crossed in the
    same direction gives the mean rate between them, sharply, and takes the filters' place.

    """

    def __init__(self, settings: DetectorSettings, sensor: ThermometerSettings) -> None:
        smallest_rate = settings.smallest_ramp_k_min / 60.0
        self.ripple_rate = min(settings.ripple_c / sensor.lag_s, 0.5 * smallest_rate)
        self._baseline_s = 0.5 * sensor.lag_s
        self._rate_variance = (sensor.fastest_ramp_k_min / 60.0) ** 2
        # The memory (1 / tracking frequency) that sees an acceleration soonest at 1 Hz, and from
        # it the power of the acceleration that the filter expects, whatever the readings' rate.
        self._noise = sensor.noise_sd_c**2 + sensor.quantum_c**2 / 12.0
        onset = smallest_rate / sensor.lag_s
        memories = [1.45 * (sqrt(self._noise) / (share * onset)) ** 0.4 for share in BEND_SHARES]
        self._powers = [self._noise / memory**4 for memory in memories]
        # crossings per second of h: acos(rho) / (2 pi dt) exp(-h^2 / 2); two filters, two signs
        per_second = settings.false_alarms_per_hour / 3600.0 / (2.0 * len(self._powers))
        self._log_crossings = -log(2.0 * pi * per_second)
        self._edge_noise = sensor.noise_sd_c * sqrt(2.0)
        self._quantum = sensor.quantum_c
        self._has_cells = sensor.has_cells
        self._by_edges = sensor.has_wide_cells
        self.reset()

    def reset(self) -> None:
        self._stamp_ns: int | None = None
        self._n_restarts = -1
        self._filters: list[tuple[float, float, float, float, float]] = []
        self._dt = 0.0
        self._thresholds: list[float] = []
        self._edge_margin = 0.0
        self._settled_s = 0.0
        self._age_s = 0.0
        self._rate = 0.0
        self._baseline = 0.0
        self._doubt = self.ripple_rate  # of the baseline, which may begin at a crest
        self._edge = nan
        self._edge_ns = 0
        self._reading = nan

    def settle(self, sensor: Thermometer) -> None:
        """
        Begin a soak: what the rate is now is its baseline.

        """
        self._baseline = self._rate
        self._doubt = max(self.ripple_rate, 2.0 * sqrt(sensor.var_rate))
        self._edge = nan  # edges that were crossed before the soak tell of the ramp

    def is_back(self) -> bool:
        """
        Whether the rate is within a ripple of the baseline again.

        """
        return abs(self._rate - self._baseline) < self.ripple_rate + self._doubt

    def update(self, stamp_ns: int, sensor: Thermometer, regime: Regime, is_grown: bool) -> int:
        """
        Take the sensor's last reading; return the sign of the departure, 0 = none.

        """
        stamp = self._stamp_ns
        if stamp is None or sensor.n_restarts != self._n_restarts or not sensor.is_ready:
            self._start(stamp_ns, sensor)
            return 0
        dt = (stamp_ns - stamp) * 1e-9
        if dt <= 0.0:
            return 0
        if dt > self._baseline_s:
            self._start(stamp_ns, sensor)
            return 0
        self._stamp_ns = stamp_ns
        self._age_s += dt
        if not 0.95 * self._dt < dt < 1.05 * self._dt:
            self._tune(dt)
        baseline = self._baseline
        ripple = self.ripple_rate + self._doubt
        high = ripple + (baseline if baseline > 0.0 else 0.0)
        low = -ripple + (baseline if baseline < 0.0 else 0.0)
        if self._by_edges:
            departure = self._watch_edges(stamp_ns, sensor, low, high)
        else:
            departure = self._watch_filters(
                dt, sensor.measured, sensor.measured_variance, low, high
            )
        if self._age_s < self._settled_s:
            self.settle(sensor)
            return 0
        if regime == Regime.STATIC:
            if not departure and not self._by_edges:
                self._follow(self._rate, dt)
            return departure
        if regime == Regime.DYNAMIC and not is_grown:
            self._follow(self._rate, 0.25 * dt)
        return 0

    def _follow(self, rate: float, dt: float) -> None:
        """
        Let the baseline follow what the rate has been over a while, at most a ripple per memory.

        """
        limit = self.ripple_rate + self._doubt
        share = dt / (dt + self._baseline_s)
        self._baseline += share * min(max(rate - self._baseline, -limit), limit)
        self._doubt -= share * self._doubt

    def _start(self, stamp_ns: int, sensor: Thermometer) -> None:
        self._stamp_ns = stamp_ns
        self._n_restarts = sensor.n_restarts
        self._age_s = 0.0
        self._filters = [(sensor.temperature, 0.0, self._noise, 0.0, self._rate_variance)] * 2
        self._edge = nan
        self._edge_ns = stamp_ns
        self._reading = sensor.reading

    def _watch_filters(
        self, dt: float, measured: float, variance: float, low: float, high: float
    ) -> int:
        departure = 0
        filters = self._filters
        for k in (1, 0):
            power = self._powers[k]
            t, v, p00, p01, p11 = filters[k]
            t += dt * v
            p00 += dt * (2.0 * p01 + dt * (p11 + power * dt / 3.0))
            p01 += dt * (p11 + 0.5 * power * dt)
            p11 += power * dt
            if variance < inf:
                spread = p00 + variance
                gain = p01 / spread
                innovation = measured - t
                left = variance / spread
                t += p00 / spread * innovation
                v += gain * innovation
                p11 -= gain * p01
                p00 *= left
                p01 *= left
            filters[k] = (t, v, p00, p01, p11)
            beyond = v - high if v > high else (low - v if v < low else 0.0)
            if beyond * beyond > self._thresholds[k] * p11:
                departure = 1 if v > high else -1
        self._rate = v
        return departure

    def _watch_edges(self, stamp_ns: int, sensor: Thermometer, low: float, high: float) -> int:
        self._rate = sensor.rate
        departure = 0
        reading, before = sensor.reading, self._reading
        bound = self._quantum * 1e9 / (stamp_ns - self._edge_ns)
        if reading == before and bound < self._doubt + abs(self._baseline):
            # nothing crossed since: no rate above one quantum in that time
            self._doubt = max(min(self._doubt, bound), self.ripple_rate)
            self._baseline = min(max(self._baseline, -bound), bound)
        if reading != before:
            edge = 0.5 * (reading + before)
            apart = (stamp_ns - self._edge_ns) * 1e-9
            moved = edge - self._edge
            sure = abs(moved) - self._edge_margin
            if sure > 0.0 and sure > (high if moved > 0.0 else -low) * apart:
                departure = 1 if moved > 0.0 else -1
            if departure == 0 and not isnan(moved):
                self._follow(moved / apart, apart)
            self._edge = edge
            self._edge_ns = stamp_ns
            self._reading = reading
        return departure

    def _tune(self, dt: float) -> None:
        """
        Set the thresholds, squared and relative to a filter's own variance of the rate.

        """
        self._dt = dt
        self._thresholds = []
        for power in self._powers:
            pace = dt * (power / (self._noise * dt)) ** 0.25
            correlation = max(1.0 - sqrt(2.0) * pace, -1.0)
            squared = max(2.0 * (self._log_crossings + log(acos(correlation) / dt)), 1.0)
            noise_share = CELL_NOISE_SHARE if self._has_cells else 0.25 + 0.08 * min(pace, 1.0)
            self._thresholds.append(squared * noise_share)
        self._edge_margin = sqrt(squared) * self._edge_noise
        self._settled_s = SETTLING * (self._noise * dt / self._powers[0]) ** 0.25


class _CalmTest:
    """
    Is the rate of one sensor surely below the relaxed rate, now and half a lag ahead?

    Ahead: a rate that moves away from its mean over the last quarter of a lag will go on to do so.

    """

    def __init__(self, settings: DetectorSettings, sensor: ThermometerSettings) -> None:
        self._relaxed = settings.relaxed_rate_k_min / 60.0
        self._ahead = max(self._relaxed, 3.0 * settings.ripple_c / sensor.lag_s)
        self._memory_s = 0.25 * sensor.lag_s
        self._stale_ns = round(0.5e9 * sensor.lag_s)
        # A reading that stands still for longer than a relaxed rate takes through its cell, and
        # than a reversal at the smallest ramp's acceleration stays in it, is calm in itself.
        quantum = sensor.quantum_c
        bend = settings.smallest_ramp_k_min / 60.0 / sensor.lag_s
        self._still_ns = round(
            1e9 * max(quantum / self._relaxed, 2.0 * sqrt(2.0 * quantum / bend))
        )
        self.reset()

    def reset(self) -> None:
        self._stamp_ns: int | None = None
        self._mean = 0.0

    def update(self, stamp_ns: int, sensor: Thermometer | None) -> bool:
        """
        Follow the rate of the sensor; a lost or stale one has no say.

        """
        if sensor is None or sensor.stamp_ns is None:
            return True
        if stamp_ns - sensor.stamp_ns > self._stale_ns:
            return True
        if not sensor.is_ready:
            self._stamp_ns = None
            return False
        rate = sensor.rate
        doubt = sqrt(sensor.var_rate)
        relaxed = self._relaxed
        stamp = self._stamp_ns
        self._stamp_ns = stamp_ns
        if stamp is None or doubt > relaxed:
            self._mean = rate  # not known well enough to have a past
        else:
            dt = (stamp_ns - stamp) * 1e-9
            self._mean += dt / (dt + self._memory_s) * (rate - self._mean)
        changed = sensor.changed_ns
        if self._still_ns and changed is not None and stamp_ns - changed > self._still_ns:
            return True
        room = relaxed - SURE_SIGMAS * doubt
        return -room < rate < room and abs(3.0 * rate - 2.0 * self._mean) < self._ahead


def _obvious(sensor: Thermometer, rate: float) -> int:
    """
    Sign of the rate if it is surely beyond a limit, otherwise 0.

    """
    margin = abs(sensor.rate) - rate
    if margin > 0.0 and margin * margin > OBVIOUS_SIGMAS**2 * sensor.var_rate:
        return 1 if sensor.rate > 0.0 else -1
    return 0
