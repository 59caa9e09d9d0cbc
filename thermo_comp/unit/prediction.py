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

from dataclasses import dataclass

import numpy as np

from ..thermal.memory import BOARD_INPUT
from ..thermal.state import BOARD, RATE, WEIGHT, Layout
from ..typing import Floats
from .calibration import Calibration
from .correction import Correction
from .uncertainty import SlowUncertainty


@dataclass(frozen=True)
class PredictedSd:
    """
    How well bias and scale are known in some states.

    Parameters
    ----------
    bias : ndarray, shape (n, 3)
        Standard deviation of each axis' bias, what the sets leave unexplained included [m/s^2].
    scale : ndarray, shape (n, 3)
        Of each axis' relative scale.

    """

    bias: Floats
    scale: Floats


def predicted_sd(calibration: Calibration, temperature: Floats, rate: float) -> PredictedSd:
    """
    Predict the uncertainty in a soak, or in a ramp that has lasted for ever.

    Parameters
    ----------
    calibration : Calibration
        The unit; without a posterior its parameters are taken for known.
    temperature : ndarray, shape (n,)
        Board temperatures.
    rate : float
        Rate of the board [K/s]; 0 in a soak.

    Returns
    -------
    PredictedSd
        At each temperature.

    """
    return sd_of_states(calibration, ramp_states(calibration, temperature, rate, np.inf))


def sd_of_states(calibration: Calibration, states: Floats) -> PredictedSd:
    """Predict the uncertainty of states, shape (n, width), as `ramp_states` gives them."""
    correction = Correction(calibration)
    slow = SlowUncertainty(calibration, correction)
    forgotten = [0.0] * len(correction.memory.lags)
    left = np.array(
        [[axis.residual_sd_m_s2 for axis in part.axes()] for part in calibration.regime_sets()]
    )
    variance = np.array([slow.at(state, forgotten) for state in states.tolist()]).reshape(-1, 3, 3)
    unexplained = left[np.rint(states[:, WEIGHT]).astype(int)]
    return PredictedSd(
        np.sqrt(variance[:, :, 0] + unexplained**2), np.sqrt(np.maximum(variance[:, :, 2], 0.0))
    )


def bias_and_scale(calibration: Calibration, states: Floats) -> tuple[Floats, Floats]:
    """
    Evaluate bias and scale.

    Parameters
    ----------
    calibration : Calibration
        The unit.
    states : ndarray, shape (n, width)
        As `ramp_states` gives them.

    Returns
    -------
    bias : ndarray, shape (n, 3)
        Of each axis [m/s^2].
    scale : ndarray, shape (n, 3)
        Of each axis [input units per m/s^2].

    """
    pairs = Correction(calibration).bias_scale([np.ascontiguousarray(c) for c in states.T])
    one = np.ones(len(states))
    bias, scale = (np.column_stack([pair[k] * one for pair in pairs]) for k in (0, 1))
    axes = calibration.axes
    K = [axis.scale_factor for axis in (axes.x, axes.y, axes.z)]
    return bias / K, scale


def ramp_states(
    calibration: Calibration, temperature: Floats, rate: float, lasted_s: Floats | float
) -> Floats:
    """
    Think up the states of a soak or of a ramp.

    Parameters
    ----------
    calibration : Calibration
        The unit: what it remembers, and how far its board lags.
    temperature : ndarray, shape (n,)
        Board temperatures.
    rate : float
        Rate of the board [K/s]; 0 in a soak.
    lasted_s : ndarray, shape (n,), or float
        For how long the ramp has lasted, inf for ever [s].

    Returns
    -------
    ndarray, shape (n, width)
        A sample of `ThermalTracker` each, for the memory of `Correction`.

    """
    gradient = calibration.board_lag_s * rate
    states, layout = _soaked(calibration, temperature)
    states[:, RATE] = rate
    states[:, WEIGHT] = float(rate != 0.0)
    states[:, list(layout.gradients.values())] = gradient
    for (name, tau), place in layout.lags.items():
        end = tau * rate if name == BOARD_INPUT else gradient
        states[:, place] = end * (1.0 - np.exp(-np.asarray(lasted_s) / tau))
    for (_, width), place in layout.plays.items():
        states[:, place] = -np.sign(rate) * width
    return states


def step_states(calibration: Calibration, temperature: float, since_s: Floats) -> Floats:
    """
    Think up the states after board and case have jumped by 1 K together, out of a soak.

    Parameters
    ----------
    calibration : Calibration
        The unit.
    temperature : float
        Board temperature after the step.
    since_s : ndarray, shape (n,)
        Time since the step [s]; inf gives the soak that follows.

    Returns
    -------
    ndarray, shape (n, width)
        See `ramp_states`; no play moves, and the static set holds.

    """
    states, layout = _soaked(calibration, np.full(len(since_s), temperature))
    for (name, tau), place in layout.lags.items():
        if name == BOARD_INPUT:
            states[:, place] = np.exp(-since_s / tau)
    return states


def _soaked(calibration: Calibration, temperature: Floats) -> tuple[Floats, Layout]:
    layout = Layout(Correction(calibration).memory)
    states = np.zeros((len(temperature), layout.width))
    states[:, BOARD] = temperature
    return states, layout
