# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Closed forms of temperatures with thermal lags, and thermometers that read them."""

import numpy as np

from thermo_comp.thermal.regime import Regime, RegimeDetector
from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings
from thermo_comp.thermal.thermometer import Thermometer

SECOND_NS = 1_000_000_000
LAG_S = 900.0
BOARD_LAG_S = 600.0


def lagged(t, corners, lag, other=0.0):
    """
    Return a temperature that lags a chamber by two time constants [s] in series, or by one.
    `corners`: pairs of a time [s] and the rate of the chamber [K/min] from this time on.
    """
    out, before = np.zeros(len(t)), 0.0
    for at, rate in corners:
        x = np.maximum(t - at, 0.0)
        decay = lag**2 * np.exp(-x / lag) - (other**2 * np.exp(-x / other) if other else 0.0)
        out += (rate - before) / 60.0 * (x - lag - other + decay / (lag - other))
        before = rate
    return out


def ripple(t, lag, period, phase=0.0, amplitude=0.1):
    omega = 2.0 * np.pi / period
    return amplitude / np.hypot(1.0, omega * lag) * np.sin(omega * t + phase)


def read(truth, noise, quantum, rng):
    reading = truth + rng.normal(0.0, noise, len(truth))
    return np.round(reading / quantum) * quantum if quantum else reading


def detector_settings(noise, quantum=0.0, lag=LAG_S, **changes):
    return DetectorSettings(
        case=ThermometerSettings(noise, quantum, lag_s=lag),
        board=ThermometerSettings(noise, quantum, lag_s=lag + BOARD_LAG_S),
        **changes,
    )


def regimes(settings, t, case, board):
    """Yield time [s], regime and direction after each reading; None: a missing thermometer."""
    case_thermometer, board_thermometer = Thermometer(settings.case), Thermometer(settings.board)
    detector = RegimeDetector(settings)
    nothing = [None] * len(t)
    stamps = np.round(t * 1e9).astype(np.int64).tolist()
    readings = (nothing if values is None else values.tolist() for values in (case, board))
    for stamp_ns, c, b in zip(stamps, *readings, strict=True):
        if b is not None:
            board_thermometer.update(stamp_ns, b)
        if c is not None and not case_thermometer.update(stamp_ns, c):
            continue
        regime = detector.update(
            stamp_ns,
            None if case is None else case_thermometer,
            None if board is None else board_thermometer,
        )
        yield stamp_ns / 1e9, regime, detector.direction


def switches(settings, t, case, board):
    """Return time, regime and direction at each change of the regime."""
    collected, before = [], Regime.UNKNOWN
    for state in regimes(settings, t, case, board):
        if state[1] != before:
            collected.append(state)
            before = state[1]
    return collected
