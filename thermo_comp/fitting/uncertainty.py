# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the prediction of how well bias and scale are known over temperature and its rate.

In a long ramp of rate q every regressor has a steady value: the gradient is the board's lag times
q, each memory its time constant times q. The parameter covariance, and what the sets leave
unexplained, give the standard deviations there; it is what the compensator publishes, without the
noise of the sample and of the thermometers.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Floats
from ..unit.calibration import AxisSet, Calibration


@dataclass(frozen=True)
class PredictedSd:
    """
    Standard deviations over a grid of temperatures and rates.

    Parameters
    ----------
    temperature : ndarray, shape (n,)
        Board temperature.
    rate : ndarray, shape (m,)
        Rate of the board.
    bias : ndarray, shape (n, m, 3)
        Standard deviation of each axis' bias [m/s^2], the unexplained part included.
    scale : ndarray, shape (n, m, 3)
        Of each axis' relative scale.

    """

    temperature: Floats
    rate: Floats
    bias: Floats
    scale: Floats


def predicted_sd(calibration: Calibration, temperature: Floats, rate: Floats) -> PredictedSd:
    """
    Predict the uncertainty of bias and scale in steady ramps.

    Parameters
    ----------
    calibration : Calibration
        The unit, with parameter covariances.
    temperature : array_like, shape (n,)
        Board temperatures.
    rate : array_like, shape (m,)
        Rates of the board [K/s]; 0 takes the static set, others the dynamic one.

    Returns
    -------
    PredictedSd
        Zero variance where the calibration holds no covariance.

    """
    temperature = np.asarray(temperature, dtype=np.float64)
    rate = np.asarray(rate, dtype=np.float64)
    t = temperature - calibration.reference_temperature_c
    bias = np.empty((len(t), len(rate), 3))
    scale = np.empty_like(bias)
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    for column, q in enumerate(rate.tolist()):
        regime = calibration.dynamic if q else calibration.static
        for number, (axis, reference) in enumerate(zip(regime.axes(), axes, strict=True)):
            on_bias, on_scale = _regressors(axis, calibration, t, q)
            covariance = full_covariance(axis)
            n = axis.n_bias_parameters
            of_bias = _form(on_bias, covariance[:n, :n]) / reference.scale_factor**2
            bias[:, column, number] = np.sqrt(of_bias + axis.residual_sd_m_s2**2)
            scale[:, column, number] = np.sqrt(_form(on_scale, covariance[n:, n:]))
    return PredictedSd(temperature, rate, bias, scale)


def full_covariance(axis: AxisSet) -> Floats:
    """
    Unpack the lower triangle that a calibration stores.

    Parameters
    ----------
    axis : AxisSet
        One axis of one set.

    Returns
    -------
    ndarray, shape (n, n)
        Symmetric; zeros when none is stored.

    """
    n = axis.n_bias_parameters + axis.n_scale_parameters
    result = np.zeros((n, n))
    for i, row in enumerate(axis.covariance):
        result[i, : i + 1] = row
        result[: i + 1, i] = row
    return result


def _regressors(
    axis: AxisSet, calibration: Calibration, t: Floats, rate: float
) -> tuple[Floats, Floats]:
    lags = calibration.memory_time_constants_s[: len(axis.memory.bias)]
    steady = [calibration.board_lag_s * rate, rate, *(tau * rate for tau in lags)]
    one = np.ones_like(t)
    parts = []
    for function in (axis.bias_function, axis.scale_function):
        columns = [one, *function.basis(t), *(value * one for value in steady)]
        parts.append(np.column_stack(columns))
    return parts[0], parts[1]


def _form(columns: Floats, covariance: Floats) -> Floats:
    return np.asarray(np.maximum(np.einsum('ni,ij,nj->n', columns, covariance, columns), 0.0))
