# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the detection of departures of a temperature's rate from the baseline, the rate in a soak.

Two Kalman filters of temperature and rate, with a long and a short memory, model d2T/dt2 as white
noise. A rate departs if its excess over the baseline, away from 0, is larger than the swing (the
rate's amplitude in a soak), plus the error of the baseline, plus h times the sd of the rate's
noise. h is computed from the permitted false alarms per hour (Rice's formula [1]_,
docs/regime.md). If noise cannot change the reading of a quantized sensor, no filter is used: the
mean rate is computed from successive crossings of edges between intervals of equal readings.

References
----------
.. [1] S. O. Rice, "Mathematical analysis of random noise", Bell System Technical Journal 24, 1945.

"""

import math
from math import acos, inf, isnan, log, nan, pi, sqrt
from typing import Final

from .settings import ThermometerSettings
from .thermometer import Thermometer

# d2T/dt2 that each filter detects best / d2T/dt2 at the onset of the smallest ramp.
BEND_SHARES = (1.0, 10.0)
TUNING: Final = 1.45  # best memory of a filter [s] / (noise sd / d2T/dt2)^0.4, readings at 1 Hz
# True noise variance of a filter's rate / variance that the filter states, for coarse readings.
CELL_NOISE_SHARE: Final = 0.4
SETTLING_MEMORIES: Final = 5.0  # age / memory above which a filter's noise is stationary
LONGEST_HALF_SWING_S: Final = 600.0  # longest half period of an oscillation of temperature [s]
LARGEST_BASELINE_SHARE: Final = 0.25  # largest baseline rate of a soak / smallest ramp's rate
SWING_MARGIN: Final = 1.25  # assumed swing / observed swing of the rate about its trend
SWING_SIGMAS: Final = 3.0  # number of noise sds subtracted from the rate's observed amplitude
SWING_MEMORY_LAGS: Final = 10.0  # time constant of the decay of the swing / lag of the sensor


class ChangeDetector:
    """
    Baseline, swing and departure of the rate of change of one sensor's temperature.

    `rate` [K/s] is the output of the filter with the longer memory, or `Thermometer.rate` if noise
    never changes a reading. `swing` [K/s]: amplitude of the oscillation of the rate in a soak.
    """

    def __init__(
        self, sensor: ThermometerSettings, smallest_rate: float, ripple: float, false_alarms: float
    ) -> None:
        self._settings = sensor
        self._largest_swing = 0.5 * smallest_rate
        self._largest_baseline = LARGEST_BASELINE_SHARE * smallest_rate
        self._ripple_rate = min(ripple / sensor.lag_s, self._largest_swing)
        self._baseline_s = 0.5 * sensor.lag_s
        self._swing_memory_s = SWING_MEMORY_LAGS * sensor.lag_s
        # The spectral density of a filter's process noise, for any interval of readings, is set so
        # that at 1 Hz the filter has the best memory (1 / tracking frequency) [s] to detect
        # a second derivative of ``share * onset`` [K/s^2].
        self._noise = sensor.noise_sd_c**2 + sensor.quantum_c**2 / 12.0
        noise_sd, onset = sqrt(self._noise), smallest_rate / sensor.lag_s
        memories = [TUNING * math.pow(noise_sd / (share * onset), 0.4) for share in BEND_SHARES]
        self._powers = [self._noise / memory**4 for memory in memories]
        # A filter has ``acos(rho) / (2 pi dt) exp(-h^2 / 2)`` false alarms of each sign per second
        # at a threshold of h sd; rho: correlation of the noise of two rates at times dt apart.
        self._log_crossings = -log(2.0 * pi * false_alarms / (2.0 * len(self._powers)))
        self._by_edges = sensor.has_wide_cells
        self._stamp_ns: int | None = None
        self._dt = 0.0
        self.rate = 0.0
        self.swing = self._ripple_rate
        self._baseline = 0.0
        # Largest error of the baseline [K/s]; the first rate may be at the crest of a ripple.
        self._baseline_error = self.swing
        self._trend = 0.0
        self._is_above = False
        self._turned_s = 0.0  # age at which the rate last crossed its trend [s]
        self._peak = self._peak_before = 0.0  # largest distances of the rate from its trend [K/s]

    def settle(self, sensor: Thermometer, least_error: float = 0.0) -> None:
        """Begin a soak: the rate becomes the baseline, with an error of `least_error` or more."""
        self._baseline = self.rate
        self._baseline_error = max(self.swing, least_error, 2.0 * sqrt(sensor.var_rate))
        self._edge = nan  # last edge of a cell crossed in the soak: none yet

    def is_following(self, stamp_ns: int) -> bool:
        """Whether the filter of `rate` has used the reading with the stamp `stamp_ns`."""
        return self._stamp_ns == stamp_ns and self._age_s > 0.0

    def is_back(self) -> bool:
        """Whether the rate is near the baseline: within the swing plus the baseline's error."""
        return abs(self.rate - self._baseline) < self.swing + self._baseline_error

    def update(self, stamp_ns: int, sensor: Thermometer, pace: float) -> int:
        """
        Use the sensor's last accepted reading; return the sign of the rate's departure from the
        baseline, 0 = none. `pace`: relative speed at which the baseline follows the rate, 1 in a
        soak, 0.25 at the onset of a ramp, 0 in a ramp.
        """
        stamp = self._stamp_ns
        dt = 0.0 if stamp is None else (stamp_ns - stamp) * 1e-9
        is_lost = stamp is None or dt > self._baseline_s or not sensor.is_ready
        if is_lost or sensor.n_restarts != self._n_restarts:
            self._start(stamp_ns, sensor)
            return 0
        if dt <= 0.0:
            return 0
        self._stamp_ns = stamp_ns
        self._age_s += dt
        if not 0.95 * self._dt < dt < 1.05 * self._dt:
            self._tune(dt)
        # A rate between 0 and the baseline (the rate in a soak) is not a departure.
        baseline, swing = self._baseline, self.swing + self._baseline_error
        high = baseline + swing if baseline > 0.0 else swing
        low = baseline - swing if baseline < 0.0 else -swing
        if self._by_edges:
            departure = self._watch_edges(stamp_ns, sensor, low, high)
        else:
            departure = self._watch_filters(dt, sensor, low, high)
        if self._age_s < self._settled_s:
            self.settle(sensor)
            self._trend = self.rate
            return 0
        if not self._by_edges:
            self._learn_swing(dt)
            if not departure or pace < 1.0:
                self._follow(self.rate, pace * dt)
        return departure

    def _start(self, stamp_ns: int, sensor: Thermometer) -> None:
        self._stamp_ns = stamp_ns
        self._n_restarts = sensor.n_restarts
        self._age_s = 0.0
        rate_variance = (self._settings.fastest_ramp_k_min / 60.0) ** 2
        self._filters = [(sensor.temperature, 0.0, self._noise, 0.0, rate_variance)] * 2
        self._edge = nan
        self._edge_ns = stamp_ns
        self._reading = sensor.reading

    def _tune(self, dt: float) -> None:
        """Set thresholds of (excess of a filter's rate)^2 / variance that the filter states."""
        self._dt = dt
        self._thresholds: list[float] = []
        for power in self._powers[::-1]:
            per_memory = dt * math.pow(power / (self._noise * dt), 0.25)  # dt / memory
            correlation = max(1.0 - sqrt(2.0) * per_memory, -1.0)
            squared = max(2.0 * (self._log_crossings + log(acos(correlation) / dt)), 1.0)
            share = 0.25 + 0.08 * min(per_memory, 1.0)
            share = CELL_NOISE_SHARE if self._settings.has_cells else share
            self._thresholds.insert(0, squared * share)
            self._noise_share = share
        self._edge_margin = sqrt(squared) * (self._settings.noise_sd_c * sqrt(2.0))
        self._settled_s = SETTLING_MEMORIES * math.pow(self._noise * dt / self._powers[0], 0.25)

    def _watch_filters(self, dt: float, sensor: Thermometer, low: float, high: float) -> int:
        departure, filters = 0, self._filters
        measured, variance = sensor.measured, sensor.measured_variance
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
        self.rate = v
        return departure

    def _watch_edges(self, stamp_ns: int, sensor: Thermometer, low: float, high: float) -> int:
        self.rate = sensor.rate
        departure = 0
        reading, before = sensor.reading, self._reading
        apart = (stamp_ns - self._edge_ns) * 1e-9
        if reading == before:
            # While no edge is crossed, the rate is at most a quantum / time since the last
            # crossing.
            bound = self._settings.quantum_c / apart
            if bound < self._baseline_error + abs(self._baseline):
                self._baseline_error = max(min(self._baseline_error, bound), self.swing)
                self._baseline = min(max(self._baseline, -bound), bound)
            return 0
        edge = 0.5 * (reading + before)
        moved = edge - self._edge
        sure = abs(moved) - self._edge_margin
        if sure > 0.0 and sure > (high if moved > 0.0 else -low) * apart:
            departure = 1 if moved > 0.0 else -1
        elif not isnan(moved):
            self._follow(moved / apart, apart)
        self._edge = edge
        self._edge_ns = stamp_ns
        self._reading = reading
        return departure

    def _follow(self, rate: float, dt: float) -> None:
        """Move the baseline towards a rate that has lasted for `dt` [s]."""
        baseline, error = self._baseline, self._baseline_error
        limit = self.swing + error
        share = dt / (dt + self._baseline_s)
        moved = baseline + share * min(max(rate - baseline, -limit), limit)
        # The slow onset of a ramp must not raise the baseline to the rate of the ramp.
        farthest = max(self._largest_baseline, abs(baseline))
        self._baseline = min(max(moved, -farthest), farthest)
        self._baseline_error = error - share * error

    def _learn_swing(self, dt: float) -> None:
        """Update the swing: an upper estimate of the rate's amplitude about its trend."""
        self._trend += dt / (dt + self._baseline_s) * (self.rate - self._trend)
        self.swing += dt / (dt + self._swing_memory_s) * (self._ripple_rate - self.swing)
        apart = self.rate - self._trend
        if (apart > 0.0) == self._is_above:
            self._peak = max(self._peak, abs(apart))
            return
        if self._age_s - self._turned_s < LONGEST_HALF_SWING_S:
            # Use the smaller one of the rate's last peaks above and below the trend: at the onset
            # or end of a ramp the rate deviates far on one side only.
            noise = SWING_SIGMAS * sqrt(self._noise_share * self._filters[0][4])
            swing = SWING_MARGIN * min(self._peak, self._peak_before) - noise
            self.swing = max(self.swing, min(swing, self._largest_swing))
            self._peak_before = self._peak
        else:
            self._peak_before = 0.0
        self._is_above = apart > 0.0
        self._turned_s = self._age_s
        self._peak = abs(apart)
