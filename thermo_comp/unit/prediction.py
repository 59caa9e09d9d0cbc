# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a calibration says of thermal states that are thought up: a soak, a ramp, a step.

In a ramp of rate q that has lasted for s seconds the gradients are the board's lag times q, a lag
of time constant tau stands ``tau q (1 - exp(-s / tau))`` behind the board, and a play has been
pushed to its end; in a soak (q = 0) all of them are 0. The static set holds in a soak, the
dynamic one in a ramp. Noise, and what the thermometers do not know, are left out.
"""

from __future__ import annotations

import numpy as np

from ..thermal.memory import BOARD_INPUT
from ..thermal.state import BOARD, RATE, WEIGHT, Layout
from ..typing import Floats
from .calibration import Calibration
from .correction import Correction
from .uncertainty import SlowUncertainty


def in_a_soak(
    calibration: Calibration, temperature: float | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Evaluate a soak, at the reference temperature by default, shapes (3,).

    Returns bias [m/s^2] and its sd, scale [input units per m/s^2] and its relative sd.
    """
    at = np.array([calibration.reference_temperature_c if temperature is None else temperature])
    states = ramp_states(calibration, at)
    bias, scale = bias_and_scale(calibration, states)
    sd_bias, sd_scale = sd_of_states(calibration, states)
    return bias[0], sd_bias[0], scale[0], sd_scale[0]


def bias_and_scale(calibration: Calibration, states: Floats) -> tuple[Floats, Floats]:
    """Evaluate bias [m/s^2] and scale [input units per m/s^2] at states, shapes (n, 3)."""
    correction = Correction(calibration)
    bias, scale = correction.bias_scale(states.T)
    return (bias / correction.K).T, scale.T


def sd_of_states(calibration: Calibration, states: Floats) -> tuple[Floats, Floats]:
    """Predict the sd of the bias [m/s^2] and of the relative scale at states, shapes (n, 3)."""
    correction = Correction(calibration)
    slow = SlowUncertainty(calibration, correction)
    forgotten = [0.0] * len(correction.memory.lags)
    variance = np.array([slow.at(state, forgotten) for state in states.tolist()]).reshape(-1, 3, 3)
    unexplained = correction.curves.residuals[np.rint(states[:, WEIGHT]).astype(int), :, 0]
    a, c = variance[:, :, 0] + unexplained, np.maximum(variance[:, :, 2], 0.0)
    return np.sqrt(a), np.sqrt(c)


def ramp_states(
    calibration: Calibration,
    temperature: Floats,
    rate: float = 0.0,
    lasted_s: Floats | float = 0.0,
) -> Floats:
    """
    Think up the states of a ramp, or of a soak, at board temperatures, shape (n,).

    `rate` is the board's [K/s]; `lasted_s` for how long it has lasted, inf for ever, shape (n,).
    """
    layout = Layout(Correction(calibration).memory)
    states = np.zeros((len(temperature), layout.width))
    gradient = calibration.board_lag_s * rate
    states[:, BOARD], states[:, RATE], states[:, WEIGHT] = temperature, rate, float(rate != 0.0)
    states[:, list(layout.gradients.values())] = gradient
    for (name, tau), place in layout.lags.items():
        end = tau * rate if name == BOARD_INPUT else gradient
        states[:, place] = end * (1.0 - np.exp(-np.asarray(lasted_s) / tau))
    for (_, width), place in layout.plays.items():
        states[:, place] = -np.sign(rate) * width
    return states


def step_states(calibration: Calibration, temperature: float, since_s: Floats) -> Floats:
    """Think up the states at times [s] after board and case jumped by 1 K, out of a soak."""
    states = ramp_states(calibration, np.full(len(since_s), temperature))
    for (name, tau), place in Layout(Correction(calibration).memory).lags.items():
        if name == BOARD_INPUT:
            states[:, place] = np.exp(-since_s / tau)
    return states
