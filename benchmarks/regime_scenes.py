# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulates ramps and sensors for benchmarks/regime.py, and delays of a CUSUM test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermo_comp.typing import Floats

RIPPLE_C = 0.1
DRIFT_K_MIN = 0.01
DRIFT_S = 5400.0
BOARD_LAG_S = 600.0
SENSORS = ((0.001, 0.0), (0.01, 0.0), (0.001, 0.0625), (0.01, 0.0625), (0.01, 1.0))


@dataclass(frozen=True)
class Scene:
    """A scene: ramp rate [K/min], case lag [s], sensor noise [K], quantum [K] and rate [Hz]."""

    ramp_k_min: float
    lag_s: float
    noise_sd: float
    quantum: float
    rate_hz: float

    @property
    def sensor(self) -> str:
        """Noise and quantum of the sensor as text."""
        quantum = f', {1e3 * self.quantum:g} mK steps' if self.quantum else ''
        return f'{1e3 * self.noise_sd:g} mK{quantum}'


def first_order(t: Floats, lag: float) -> Floats:
    """Return the output of a first-order lag for a ramp of slope 1 that starts at time 0."""
    x = np.maximum(t, 0.0)
    return x - lag * (1.0 - np.exp(-x / lag))


def second_order(t: Floats, lag: float, other: float) -> Floats:
    """Return the output of two lags in series for a ramp of slope 1 that starts at time 0."""
    x = np.maximum(t, 0.0)
    decay = lag**2 * np.exp(-x / lag) - other**2 * np.exp(-x / other)
    return x - lag - other + decay / (lag - other)


def temperatures(
    scene: Scene, t: Floats, duration: float, rng: np.random.Generator, ripple: float = RIPPLE_C
) -> tuple[Floats, Floats]:
    """Return case and board temperatures [degC]: a ramp that lasts `duration`; if 0, a soak."""
    rate = scene.ramp_k_min / 60.0 * rng.choice((-1.0, 1.0))
    start = 20.0 + rng.uniform(-0.5, 0.5) * max(scene.quantum, 0.1)
    board_lag = BOARD_LAG_S if abs(BOARD_LAG_S - scene.lag_s) > 1.0 else 1.01 * scene.lag_s
    case = start + rate * (first_order(t, scene.lag_s) - first_order(t - duration, scene.lag_s))
    board = start + rate * (
        second_order(t, scene.lag_s, board_lag)
        - second_order(t - duration, scene.lag_s, board_lag)
    )
    if ripple:
        omega = 2.0 * np.pi / rng.uniform(180.0, 900.0)
        swing = np.sin(omega * t + rng.uniform(0.0, 2.0 * np.pi))
        case += ripple / np.hypot(1.0, omega * scene.lag_s) * swing
        drift = DRIFT_K_MIN / 60.0 * DRIFT_S * (1.0 - np.exp(-(t - t[0]) / DRIFT_S))
        case += drift
        board += drift
    return case, board


def read(truth: Floats, scene: Scene, rng: np.random.Generator) -> Floats:
    """Return readings [degC] with the noise and rounding of the scene's sensor."""
    reading = truth + rng.normal(0.0, scene.noise_sd, truth.shape)
    return np.round(reading / scene.quantum) * scene.quantum if scene.quantum else reading


def known_signature_delays(
    scene: Scene, per_hour: float, hours: float, n: int, seed: int
) -> tuple[float, float]:
    """
    Return median and 95 % quantile of the delays [s] of a CUSUM test that is given the true ramp,
    baseline and noise.

    The test statistic (Page's) is the largest log likelihood ratio over the onset times, with the
    true ramp as signature. The threshold for `per_hour` false alarms is extrapolated from noise
    without a ramp, where the logarithm of the number of exceedances is a line over the threshold.
    """
    rng = np.random.default_rng([seed, 9])
    dt = 1.0 / scene.rate_hz
    bend = scene.ramp_k_min / 60.0 / scene.lag_s
    # After half of `longest` readings the ramp has a signal-to-noise ratio of 4.5, so that
    # `longest` readings detect the ramp reliably.
    longest = round(2.0 * (20.0 * dt * (4.5 * scene.noise_sd / bend) ** 2) ** 0.2 / dt)
    signature = scene.ramp_k_min / 60.0 * first_order(np.arange(1, longest + 1) * dt, scene.lag_s)

    def cusum(x: Floats) -> Floats:
        best = np.zeros(len(x))
        energy = np.cumsum(signature**2)
        sums = np.zeros(len(x))
        for length in range(1, longest + 1):
            # `signature[length - 1]` multiplies the newest reading, `signature[0]` the oldest.
            sums = np.convolve(x, signature[:length][::-1])[: len(x)]
            np.maximum(best, (sums - 0.5 * energy[length - 1]) / scene.noise_sd**2, out=best)
        return best

    levels = np.arange(3.0, 8.0, 0.25)
    counts = np.zeros(len(levels))
    for _ in range(max(1, round(hours / 5.0))):
        best = cusum(rng.normal(0.0, scene.noise_sd, round(18000.0 / dt)))
        for i, level in enumerate(levels):
            above = np.flatnonzero(best > level)
            counts[i] += 0 if len(above) == 0 else 1 + np.count_nonzero(np.diff(above) > longest)
    seen = counts > 2
    slope, offset = np.polyfit(levels[seen], np.log(counts[seen] / hours), 1)
    threshold = (np.log(per_hour) - offset) / slope
    delays = []
    for _ in range(n):
        x = rng.normal(0.0, scene.noise_sd, 2 * longest)
        x[longest:] += signature
        above = cusum(x)[longest:] > threshold
        delays.append((int(np.argmax(above)) + 1) * dt if above.any() else np.inf)
    return float(np.median(delays)), float(np.percentile(delays, 95))
