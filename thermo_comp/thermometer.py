# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the recursive estimate of T, dT/dt, d2T/dt2 and their variances from stamped readings.

"""

from __future__ import annotations

import math
from dataclasses import dataclass

_OUTLIER_SIGMAS = 6.0
_RESTART_READINGS = 4
_HORIZON_INTERVALS = 5.0


@dataclass(frozen=True, slots=True)
class ThermometerSettings:
    """
    What is known of one temperature sensor, in physical terms; its keys are the file's keys.

    Parameters
    ----------
    noise_sd_c : float
        Standard deviation of the white noise of one reading, K.
    quantum_c : float
        Step of the readings, K; 0 for a continuous sensor.
    typical_ramp_k_min : float
        Typical rate of the ramps it will see, K/min.
    lag_s : float
        Thermal lag between the surroundings and the sensor, s. With the ramp it says how sharply
        the temperature can bend: an onset is an acceleration of ``ramp / lag``.

    Raises
    ------
    ValueError
        If a value is not finite or outside its range.

    """

    noise_sd_c: float = 0.005
    quantum_c: float = 0.0
    typical_ramp_k_min: float = 1.0
    lag_s: float = 600.0

    def __post_init__(self) -> None:
        """
        Refuse values that no sensor has.

        """
        for name in ('noise_sd_c', 'typical_ramp_k_min', 'lag_s'):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f'`{name}` must be positive and finite, got {value}')
        if not 0.0 <= self.quantum_c < math.inf:
            raise ValueError(f'`quantum_c` must be zero or positive, got {self.quantum_c}')


class Thermometer:
    """
    Kalman filter of temperature, rate and acceleration over the readings of one sensor.

    Parameters
    ----------
    settings : ThermometerSettings
        The sensor.

    """

    def __init__(self, settings: ThermometerSettings) -> None:
        self.settings = settings
        self.n_used = 0
        self.n_rejected = 0
        self._lag = settings.lag_s
        self._acceleration_sd = settings.typical_ramp_k_min / 60.0 / settings.lag_s
        self._rate_sd = settings.typical_ramp_k_min / 60.0
        self._noise = settings.noise_sd_c**2 + settings.quantum_c**2 / 12.0
        self.reset()

    def reset(self) -> None:
        """
        Forget the readings (not the counters), as after a jump of time.

        """
        self.stamp_ns: int | None = None
        self.changed_ns: int | None = None
        self.reading = math.nan
        self.temperature = math.nan
        self.rate = math.nan
        self.acceleration = math.nan
        self.var_temperature = math.inf
        self.var_rate = math.inf
        self.var_acceleration = math.inf
        self.interval_s = math.nan
        self.is_ready = False
        self._p01 = self._p02 = self._p12 = 0.0
        self._n_outliers = 0
        self._outlier = math.nan

    def update(self, stamp_ns: int, reading_c: float) -> bool:
        """
        Take one reading.

        Parameters
        ----------
        stamp_ns : int
            When it was measured, ns.
        reading_c : float
            The reading, degC.

        Returns
        -------
        bool
            False when it was not used: not finite, not newer than the last one, or an outlier.

        """
        if not math.isfinite(reading_c):
            self.n_rejected += 1
            return False
        if self.stamp_ns is None:
            self._start(stamp_ns, reading_c)
            return True
        if stamp_ns <= self.stamp_ns:
            self.n_rejected += 1
            return False
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        if dt > self._lag:
            self._start(stamp_ns, reading_c)
            return True
        decay = math.exp(-dt / self._lag)
        process = 2.0 * self._acceleration_sd**2 / self._lag * dt
        half = 0.5 * dt * dt
        p00, p11, p22 = self.var_temperature, self.var_rate, self.var_acceleration
        p01, p02, p12 = self._p01, self._p02, self._p12
        temperature = self.temperature + dt * self.rate + half * self.acceleration
        rate = self.rate + dt * self.acceleration
        acceleration = decay * self.acceleration
        a01 = p01 + dt * p11 + half * p12
        a02 = p02 + dt * p12 + half * p22
        a00 = p00 + dt * p01 + half * p02
        p00 = a00 + dt * a01 + half * a02 + process * half * half / 5.0
        p01 = a01 + dt * a02 + process * half * dt / 4.0
        p02 = decay * a02 + process * half / 3.0
        a12 = p12 + dt * p22
        p11 = p11 + dt * p12 + dt * a12 + process * dt * dt / 3.0
        p12 = decay * a12 + process * dt / 2.0
        p22 = decay * decay * p22 + process
        innovation = reading_c - temperature
        s = p00 + self._noise
        if innovation * innovation > _OUTLIER_SIGMAS**2 * s + self.settings.quantum_c**2:
            return self._suspect(stamp_ns, reading_c, math.sqrt(s))
        self._n_outliers = 0
        k0, k1, k2 = p00 / s, p01 / s, p02 / s
        self.temperature = temperature + k0 * innovation
        self.rate = rate + k1 * innovation
        self.acceleration = acceleration + k2 * innovation
        self.var_temperature = p00 - k0 * p00
        self._p01 = p01 - k0 * p01
        self._p02 = p02 - k0 * p02
        self.var_rate = p11 - k1 * p01
        self._p12 = p12 - k1 * p02
        self.var_acceleration = p22 - k2 * p02
        self.stamp_ns = stamp_ns
        if reading_c != self.reading:
            self.changed_ns = stamp_ns
        self.reading = reading_c
        self.interval_s = (
            dt if self.n_used < 2 else self.interval_s + 0.05 * (dt - self.interval_s)
        )
        self.n_used += 1
        self.is_ready = True
        return True

    def at(self, stamp_ns: int) -> tuple[float, float, float]:
        """
        Extrapolate to a stamp; held after a few reading intervals.

        Parameters
        ----------
        stamp_ns : int
            The stamp, ns.

        Returns
        -------
        tuple of float
            Temperature [degC], rate [K/s] and variance of the temperature [K^2];
            ``(nan, nan, inf)`` before the first reading.

        """
        if self.stamp_ns is None:
            return math.nan, math.nan, math.inf
        if not self.is_ready:
            return self.temperature, 0.0, self.var_temperature
        whole = (stamp_ns - self.stamp_ns) * 1e-9
        horizon = _HORIZON_INTERVALS * self.interval_s
        dt = min(max(whole, -horizon), horizon)
        variance = self.var_temperature + 2.0 * dt * self._p01 + dt * dt * self.var_rate
        beyond = whole - dt
        variance += beyond * beyond * (self.var_rate + self.rate * self.rate)
        return (
            self.temperature + dt * (self.rate + 0.5 * dt * self.acceleration),
            self.rate + dt * self.acceleration,
            variance,
        )

    def _start(self, stamp_ns: int, reading_c: float) -> None:
        self.reset()
        self.stamp_ns = self.changed_ns = stamp_ns
        self.reading = self.temperature = reading_c
        self.rate = self.acceleration = 0.0
        self.var_temperature = self._noise
        self.var_rate = self._rate_sd**2
        self.var_acceleration = self._acceleration_sd**2
        self.n_used += 1

    def _suspect(self, stamp_ns: int, reading_c: float, sd: float) -> bool:
        if abs(reading_c - self._outlier) > _OUTLIER_SIGMAS * sd + self.settings.quantum_c:
            self._n_outliers = 0
        self._n_outliers += 1
        self._outlier = reading_c
        if self._n_outliers >= _RESTART_READINGS:
            self._start(stamp_ns, reading_c)
            return True
        self.n_rejected += 1
        return False
