# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the recursive estimate of T, dT/dt, d2T/dt2 and their variances from stamped readings.

Two Kalman filters of temperature, rate and acceleration (d2T/dt2) interact [1]_: *quiet*, in which
the acceleration is almost constant (a soak, the middle of a ramp), and *bending*, in which the
acceleration changes as at the onset and end of a ramp behind a thermal lag [2]_. The estimate is
the mean of both filters weighted by their probabilities, and its variance includes the filters'
difference. If a sensor's quantum exceeds the noise, all temperatures in a cell (an interval of one
quantum) give the same reading. A changed reading then measures the edge between two cells
precisely; an unchanged reading only shows that the temperature is in the cell [3]_.

References
----------
.. [1] H. A. P. Blom, Y. Bar-Shalom, "The interacting multiple model algorithm for systems with
   Markovian switching coefficients", IEEE Trans. Automatic Control 33(8), 1988.
.. [2] R. A. Singer, "Estimating optimal tracking filter performance for manned maneuvering
   targets", IEEE Trans. Aerospace and Electronic Systems AES-6(4), 1970.
.. [3] R. E. Curry, "Estimation and Control with Quantized Measurements", MIT Press, 1970.

"""

from math import erf, exp, inf, nan, sqrt
from typing import Final

from .settings import ThermometerSettings

OUTLIER_SIGMAS: Final = 6.0  # innovation / its sd above which a reading is down-weighted
OUTLIER_LIMITS: Final = 5.0  # innovation / limit of outliers, above which a reading is rejected
RESTART_READINGS: Final = 4  # consecutive outliers of equal sign after which the filter restarts
# Mean time in the quiet mode [s]; the mean time in the bending mode is the lag of the sensor.
SOAK_S: Final = 900.0
# Sd of the noise that drives d2T/dt2 in the quiet filter / sd of this noise in the bending filter.
QUIET_SHARE: Final = 5e-3
CELL_SHARE: Final = 0.2  # replaces `QUIET_SHARE` if noise never changes a reading
_ROOT_HALF: Final = 0.7071067811865476  # 1 / sqrt(2)
_DENSITY_AT_0: Final = 0.3989422804014327  # 1 / sqrt(2 pi)
#: Smallest (absolute zero) and largest reading that is accepted as a temperature [degC].
COLDEST: Final = -273.15
HOTTEST: Final = 1000.0
HORIZON_INTERVALS: Final = 5.0  # longest linear extrapolation [reading intervals]
LONGEST_STEP_SHARE: Final = 0.125  # longest time step of `predict` / lag of the sensor
NOISE_MEMORY: Final = 200.0  # number of innovations over which the noise factor is averaged

#: Temperature, rate, acceleration; then elements 00, 01, 02, 11, 12, 22 of their covariance. The
#: filters are written out in floats, because matrix operations would be slower.
State = tuple[float, float, float, float, float, float, float, float, float]

_NOWHERE: State = (nan, nan, nan, inf, 0.0, 0.0, inf, 0.0, inf)  # state before the first reading


class Thermometer:
    """
    Causal estimate of one sensor's temperature [degC], its rate [K/s] and acceleration [K/s^2].

    The estimates hold at `stamp_ns`, the stamp of the last used reading; before the first reading
    they are NaN with infinite variances. `changed_ns`: stamp of the last change of the reading;
    `interval_s`: typical interval between readings; `n_in_row`: number of readings since the
    filter last started; `n_restarts`: number of starts after a gap or a step; `is_ready`: whether
    `n_in_row` is 2 or more, so that there is a rate. `measured`, `measured_variance`: the last
    reading or, if the quantum far exceeds the noise, a Gaussian measurement in its place (infinite
    variance: no information). `bending`: probability that the acceleration changes.
    """

    def __init__(self, settings: ThermometerSettings) -> None:
        self.settings = settings
        self.n_restarts = 0
        noise, quantum = settings.noise_sd_c, settings.quantum_c
        self._noise = noise * noise
        self._flat = noise * noise + quantum * quantum / 12.0
        self._noise_scale = 1.0  # noise factor: actual / declared noise variance
        self._n_turns = 8.0  # number of innovations in `_noise_scale`, plus 8 for its prior
        self._has_cells = settings.has_cells
        self._quantum = quantum
        self._lag = settings.lag_s
        self._rate_sd = settings.fastest_ramp_k_min / 60.0
        self._bend = self._rate_sd / settings.lag_s
        self._bending_power = 2.0 * self._bend * self._bend / settings.lag_s
        share = CELL_SHARE if settings.has_wide_cells else QUIET_SHARE
        self._quiet_power = self._bending_power * share * share
        self.reset()

    def reset(self) -> None:
        """Forget the readings; keep the restart counter and the noise factor."""
        self.stamp_ns: int | None = None
        self.changed_ns: int | None = None
        self.reading = nan
        self.temperature = self.rate = nan
        self.var_temperature = self.var_rate = inf
        self.interval_s = self._horizon_s = nan
        self.n_in_row = 0
        self.is_ready = False
        self.measured = nan
        self.measured_variance = inf
        self.bending = 0.5
        self._covariance = 0.0  # covariance of temperature and rate
        self._quiet: State = _NOWHERE
        self._bent: State = _NOWHERE
        self._innovation = 0.0
        self._n_outliers = 0

    def update(self, stamp_ns: int, reading_c: float) -> bool:
        """
        Use a reading [degC]; return False for an impossible temperature, for a stamp that is not
        after the last used stamp, and for an outlier too far from the prediction to be used.
        """
        if not COLDEST <= reading_c <= HOTTEST:
            return False
        if self.stamp_ns is None:
            self._start(stamp_ns, reading_c)
            return True
        if stamp_ns <= self.stamp_ns:
            return False
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        lag = self._lag
        if dt > lag:
            self.n_restarts += 1
            self._start(stamp_ns, reading_c)
            return True

        # Interaction step of the multiple-model filter [1]: each filter starts from a mixture of
        # the states of both.
        to_bending = dt / (dt + SOAK_S)
        to_quiet = dt / (dt + lag)
        bending = self.bending
        prior_bending = bending * (1.0 - to_quiet) + (1.0 - bending) * to_bending
        prior_quiet = 1.0 - prior_bending
        quiet = mix(self._quiet, self._bent, bending * to_quiet / prior_quiet)
        bent = mix(self._bent, self._quiet, (1.0 - bending) * to_bending / prior_bending)
        # `predict` is accurate for times much shorter than the lag: divide a long interval.
        n_steps = 1 + int(dt / (LONGEST_STEP_SHARE * lag))
        for _ in range(n_steps):
            quiet = predict(quiet, dt / n_steps, lag, self._quiet_power)
            bent = predict(bent, dt / n_steps, lag, self._bending_power)

        apart = bent[0] - quiet[0]
        expected = quiet[0] + prior_bending * apart
        variance = prior_quiet * quiet[3] + prior_bending * (bent[3] + prior_quiet * apart * apart)
        scale = self._noise_scale
        noise = self._flat * scale
        spread = variance + noise
        innovation = reading_c - expected
        is_turning = innovation * self._innovation < 0.0
        self._innovation = innovation
        if is_turning and not self._has_cells:
            # Estimate the noise from innovations whose sign differs from the sign of the preceding
            # innovation: a change of the rate gives innovations of equal sign.
            excess = min(innovation * innovation / spread - 1.0, 8.0)
            if self._n_turns < NOISE_MEMORY:
                self._n_turns += 1.0
            self._noise_scale = max(1.0, scale * (1.0 + excess / self._n_turns))
        limit = OUTLIER_SIGMAS * sqrt(spread) + 5.0 * self._bend * dt * dt + 1.5 * self._quantum
        if abs(innovation) > limit:
            self._n_outliers = 1 if is_turning else self._n_outliers + 1
            if self._n_outliers >= RESTART_READINGS:
                self.n_restarts += 1
                self._start(stamp_ns, reading_c)
                return True
            if abs(innovation) > OUTLIER_LIMITS * limit:
                return False
            noise = max(noise, innovation * innovation / OUTLIER_SIGMAS**2 - variance)
        else:
            self._n_outliers = 0
        measured = reading_c
        if self._has_cells:
            move = (quiet[1] + prior_bending * (bent[1] - quiet[1])) * dt
            measured, noise = self._cell(reading_c, expected, variance, move, bent[6] * dt * dt)

        # Update both filters, and the probability of the bending filter by the likelihoods of
        # the filters' innovations.
        if noise < inf:
            quiet, of_quiet, s = correct(quiet, measured, noise)
            bent, of_bent, bent_s = correct(bent, measured, noise)
            evidence = 0.5 * (of_quiet * of_quiet / s - of_bent * of_bent / bent_s)
            if not -30.0 < evidence < 30.0:
                evidence = 30.0 if evidence > 0.0 else -30.0
            odds = prior_bending * sqrt(s / bent_s) * exp(evidence)
            bending = odds / (prior_quiet + odds)
        else:
            bending = prior_bending

        self._quiet = quiet
        self._bent = bent
        self.bending = bending
        t, v, _, p00, p01, _, p11, _, _ = quiet
        apart, dv = bent[0] - t, bent[1] - v
        both = bending * (1.0 - bending)
        self.temperature = t + bending * apart
        self.rate = v + bending * dv
        self.var_temperature = p00 + bending * (bent[3] - p00) + both * apart * apart
        self._covariance = p01 + bending * (bent[4] - p01) + both * apart * dv
        self.var_rate = p11 + bending * (bent[6] - p11) + both * dv * dv
        self.measured = measured
        self.measured_variance = noise
        if reading_c != self.reading:
            self.changed_ns = stamp_ns
            self.reading = reading_c
        self.stamp_ns = stamp_ns
        self.n_in_row += 1
        interval = self.interval_s + 0.05 * (dt - self.interval_s) if self.is_ready else dt
        self.interval_s = interval
        self._horizon_s = HORIZON_INTERVALS * interval
        self.is_ready = True
        return True

    def at(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return temperature, rate, and variance of the temperature extrapolated to a stamp."""
        if self.stamp_ns is None:
            return nan, nan, inf
        if not self.is_ready:
            return self.temperature, self.rate, self.var_temperature
        dt = ahead = (stamp_ns - self.stamp_ns) * 1e-9
        horizon = self._horizon_s
        rate = self.rate
        unknown = 0.0
        if not -horizon <= ahead <= horizon:
            # Beyond the extrapolation horizon the temperature is held constant, and its variance
            # grows by the square of the change that its rate or an unseen ramp would cause.
            dt = horizon if ahead > 0.0 else -horizon
            beyond = ahead - dt
            unseen = min(0.5 * self._bend * abs(beyond), self._rate_sd)
            unknown = beyond * beyond * (self.var_rate + rate * rate + unseen * unseen)
        variance = self.var_temperature + dt * (2.0 * self._covariance + dt * self.var_rate)
        return self.temperature + dt * rate, rate, variance + unknown

    def beyond(self, stamp_ns: int) -> float:
        """Return the time from the extrapolation horizon to a stamp [s]; 0 within the horizon."""
        if self.stamp_ns is None or not self.is_ready:
            return 0.0
        ahead = (stamp_ns - self.stamp_ns) * 1e-9
        return max(ahead - self._horizon_s, 0.0)

    @property
    def acceleration(self) -> tuple[float, float]:
        """Estimate of the temperature's second derivative [K/s^2] and its variance [K^2/s^4]."""
        if self.stamp_ns is None:
            return nan, inf
        state = mix(self._quiet, self._bent, self.bending)
        return state[2], state[8]

    def _start(self, stamp_ns: int, reading_c: float) -> None:
        self.reset()
        self.stamp_ns = self.changed_ns = stamp_ns
        self.reading = self.measured = self.temperature = reading_c
        self.rate = 0.0
        noise = self._flat * self._noise_scale
        self.var_temperature = self.measured_variance = noise
        self.var_rate = self._rate_sd**2
        self._quiet = self._bent = (
            reading_c, 0.0, 0.0, noise, 0.0, 0.0, self.var_rate, 0.0, self._bend**2
        )  # fmt: skip
        self.n_in_row = 1

    def _cell(
        self, reading: float, expected: float, variance: float, move: float, var_move: float
    ) -> tuple[float, float]:
        """Turn a quantized reading into an equivalent Gaussian measurement and its variance."""
        half = 0.5 * self._quantum
        noise = self._noise
        if variance < 4.0 * noise:
            # For a prediction whose sd is below twice the noise: match the moments of the
            # prediction truncated to the reading's cell.
            spread = variance + noise
            sd = sqrt(spread)
            low = (reading - half - expected) / sd
            high = (reading + half - expected) / sd
            inside = 0.5 * (erf(high * _ROOT_HALF) - erf(low * _ROOT_HALF))
            if inside < 1e-9:
                return reading, self._flat
            at_low = _DENSITY_AT_0 * exp(-0.5 * low * low) / inside
            at_high = _DENSITY_AT_0 * exp(-0.5 * high * high) / inside
            shift = at_low - at_high
            loss = shift * shift + high * at_high - low * at_low
            if loss < 1e-6:
                return reading, inf
            return expected + sd * shift / loss, spread / loss - variance
        jump = abs(reading - self.reading)
        if jump > 1.5 * self._quantum:
            return reading, self._flat
        if jump > half:
            edge = 0.5 * (reading + self.reading) + 0.5 * move
            return edge, min(noise + (move * move + 4.0 * var_move) / 12.0, self._flat)
        # A repeated reading only shows that the temperature is in the cell of this reading.
        box = half * half / 3.0
        if variance > box:
            return reading, variance * box / (variance - box)
        # A prediction outside the reading's cell is corrected to the edge. All readings within the
        # time in which the prediction changes by its sd have the weight of one measurement.
        if abs(expected - reading) > half:
            edge = reading + (half if expected > reading else -half)
            return edge, variance * max(1.0, sqrt(variance) / (abs(move) + 1e-30))
        return reading, inf


def mix(state: State, other: State, share: float) -> State:
    """Return mean and covariance of a mixture of two states; `share`: weight of `other`."""
    t, v, a, p00, p01, p02, p11, p12, p22 = state
    u, w, b, r00, r01, r02, r11, r12, r22 = other
    dt, dv, da = u - t, w - v, b - a
    apart = share * (1.0 - share)
    at, av = apart * dt, apart * dv
    return (
        t + share * dt, v + share * dv, a + share * da,
        p00 + share * (r00 - p00) + at * dt, p01 + share * (r01 - p01) + at * dv,
        p02 + share * (r02 - p02) + at * da, p11 + share * (r11 - p11) + av * dv,
        p12 + share * (r12 - p12) + av * da, p22 + share * (r22 - p22) + apart * da * da,
    )  # fmt: skip


def predict(state: State, dt: float, lag: float, power: float) -> State:
    """
    Predict a filter's state `dt` [s] later. The acceleration d2T/dt2 decays with the time constant
    `lag` [s] and is driven by white noise of the density `power` [K^2/s^5].
    """
    t, v, a, p00, p01, p02, p11, p12, p22 = state
    half = 0.5 * dt * dt
    decay = 1.0 / (1.0 + dt / lag)
    grown = power * dt
    driven = grown * half
    # the transition matrix times the covariance, above the diagonal
    c01 = p01 + dt * p11 + half * p12
    c02 = p02 + dt * p12 + half * p22
    c12 = p12 + dt * p22
    return (
        t + dt * v + half * a,
        v + dt * a,
        decay * a,
        p00 + dt * (p01 + c01) + half * (p02 + c02 + 0.2 * driven),
        c01 + dt * (c02 + 0.25 * driven),
        decay * c02 + driven / 3.0,
        p11 + dt * (p12 + c12) + driven / 1.5,
        decay * c12 + 0.5 * dt * grown,
        decay * decay * p22 + grown,
    )


def correct(state: State, measured: float, variance: float) -> tuple[State, float, float]:
    """Update with a measured temperature; return state, innovation [K], innovation variance."""
    t, v, a, p00, p01, p02, p11, p12, p22 = state
    spread = p00 + variance
    innovation = measured - t
    k0 = p00 / spread
    k1 = p01 / spread
    k2 = p02 / spread
    left = variance / spread
    corrected = (
        t + k0 * innovation, v + k1 * innovation, a + k2 * innovation,
        left * p00, left * p01, left * p02, p11 - k1 * p01, p12 - k1 * p02, p22 - k2 * p02,
    )  # fmt: skip
    return corrected, innovation, spread
