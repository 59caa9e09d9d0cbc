# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the part of the error variance that changes slowly: parameters, and lags that started unseen.
Stream and batch evaluate it one state at a time, for the same bits, and hold it in between.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..thermal.memory import start_covariance
from ..thermal.state import BOARD, WEIGHT
from ..typing import Floats
from .calibration import Calibration, parameter_layout
from .correction import Correction


class SlowUncertainty:
    """What the posterior and the start of the lags leave uncertain."""

    def __init__(self, calibration: Calibration, correction: Correction) -> None:
        self._correction = correction
        self._K = correction.K[:, 0].tolist()
        self._n_sensors = len(correction.memory.sensors)
        self._root = np.asarray(np.linalg.cholesky(start_covariance(correction.memory.lags)))
        self._blocks: list[tuple[Floats, Floats, Floats, Floats]] = []
        posterior = calibration.posterior
        if posterior is None:
            return
        layout = parameter_layout(calibration)
        matrix, rest = posterior.matrix, posterior.variances
        for bias, scale in zip(layout.bias, layout.scale, strict=True):
            of_bias, of_scale = slice(bias.static, bias.end), slice(scale.static, scale.end)
            rows = np.concatenate((matrix[of_bias], matrix[of_scale]))
            if matrix.shape[1] > len(rows):
                # The same covariance of one axis from fewer columns.
                rows = np.ascontiguousarray(np.linalg.qr(rows.T)[1].T)
            n_bias = bias.end - bias.static
            self._blocks.append((rows[:n_bias], rest[of_bias], rows[n_bias:], rest[of_scale]))

    def at(self, state: Sequence[float], start_shares: Sequence[float]) -> list[float]:
        """Evaluate a, b, c of each axis at one state: ``v(x) = a + b x + c x^2`` [m^2/s^4]."""
        states = np.array(state)[:, np.newaxis]
        table = self._correction.table
        factors, _ = table.factors(states[BOARD], states[WEIGHT])
        phi = table.held(table.raw(states)) * factors
        felt = self._correction.felt(states, factors)[self._n_sensors :, :, 0]
        moved = felt * np.array(start_shares)[:, np.newaxis]
        regressors = self._correction.curves.regressors(states, phi) if self._blocks else []
        result: list[float] = []
        for axis, K in enumerate(self._K):
            bias, scale = ((self._root * moved[:, [row]]).sum(axis=0) for row in (axis, axis + 3))
            v = _products(bias / K, scale)
            if self._blocks:
                of_bias, var_bias, of_scale, var_scale = self._blocks[axis]
                on_bias, on_scale = regressors[axis] / K, regressors[axis + 3]
                v += _products((of_bias * on_bias).sum(axis=0), (of_scale * on_scale).sum(axis=0))
                v[0] += (var_bias * on_bias[:, 0] ** 2).sum()
                v[2] += (var_scale * on_scale[:, 0] ** 2).sum()
            result += v.tolist()
        return result

    def of_bias(
        self, states: Floats, mean_of: Callable[[Floats], Floats]
    ) -> tuple[Floats, Floats]:
        """
        Say what the parameters leave uncertain of the bias at each of many states, shape (n, w).

        Returns the variance of the bias, and that of its distance from a mean over states, as
        `mean_of` takes it of rows, shapes (n, 3) [m^2/s^4].
        """
        columns = states.T
        phi = self._correction.table.values(columns)
        regressors = self._correction.curves.regressors(columns, phi)
        whole, away = np.zeros((2, len(states), 3))
        for axis, (rows, variances, _, _) in enumerate(self._blocks):
            felt = regressors[axis].T / self._K[axis]
            for result, one in ((whole, felt), (away, felt - mean_of(felt))):
                result[:, axis] = ((one @ rows) ** 2).sum(axis=1) + one**2 @ variances
        return whole, away


def _products(bias: Floats, scale: Floats) -> Floats:
    # Sums along the rows above, and of products here: the same bits wherever the arrays lie.
    return np.array([(bias * bias).sum(), 2.0 * (bias * scale).sum(), (scale * scale).sum()])
