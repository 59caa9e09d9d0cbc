# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the part of the error variance that changes slowly: parameters, and lags that started unseen.

It is evaluated for one state at a time, by stream and batch alike, and held in between, so both
have the same bits whatever library multiplies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..thermal.memory import start_covariance
from ..thermal.state import BOARD, WEIGHT
from ..typing import Floats
from .calibration import Calibration, parameter_layout
from .correction import Correction, Variance
from .response import Sensitivity


class SlowUncertainty:
    """
    What the posterior and the start of the lags leave uncertain.

    calibration: the unit
    correction: its correction
    """

    def __init__(self, calibration: Calibration, correction: Correction) -> None:
        self._correction = correction
        axes = calibration.axes
        self._K = [axis.scale_factor for axis in (axes.x, axes.y, axes.z)]
        memory = correction.memory
        self._felt = [Sensitivity(calibration.response, axis, memory) for axis in range(3)]
        start = start_covariance(memory.lags)
        self._root = np.asarray(np.linalg.cholesky(start), dtype=np.float64)
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

    def at(self, state: Sequence[float], start_shares: Sequence[float]) -> list[Variance[float]]:
        """
        Evaluate (a, b, c) of each axis at one state.

        Returns ``v(x) = a + b x + c x^2`` [m^2/s^4], x in m/s^2.
        """
        table = self._correction.table
        raw = table.raw(state)
        phi = table.weighted(table.held(raw), state[BOARD], state[WEIGHT])
        on_input, _ = table.slopes(state, raw)
        shares = np.array(start_shares)
        result = []
        for axis, K in enumerate(self._K):
            felt: Floats = np.array(self._felt[axis].on_lags(on_input, 0.0)).reshape(-1, 2)
            bias, scale = ((self._root * (felt[:, k] * shares)[:, np.newaxis]) for k in (0, 1))
            a, b, c = _products(bias.sum(axis=0) / K, scale.sum(axis=0))
            if self._blocks:
                of_bias, var_bias, of_scale, var_scale = self._blocks[axis]
                on_bias, on_scale = self._regressors(state, phi, axis)
                on_bias = on_bias / K
                bias = (of_bias * on_bias[:, np.newaxis]).sum(axis=0)
                scale = (of_scale * on_scale[:, np.newaxis]).sum(axis=0)
                more = _products(bias, scale)
                a += more[0] + float((var_bias * on_bias * on_bias).sum())
                b += more[1]
                c += more[2] + float((var_scale * on_scale * on_scale).sum())
            result.append((a, b, c))
        return result

    def of_bias(
        self, states: Floats, mean_of: Callable[[Floats], Floats]
    ) -> tuple[Floats, Floats]:
        """
        Say what the parameters leave uncertain of the bias at each of many states, shape (n, w).

        Returns the variance of the bias, and that of its distance from a mean over states, as
        `mean_of` takes it of rows, shapes (n, 3) [m^2/s^4].
        """
        columns = list(np.ascontiguousarray(states.T))
        table = self._correction.table
        board, weight = columns[BOARD], columns[WEIGHT]
        phi = table.weighted(table.held(table.raw(columns)), board, weight)
        static, dynamic = (
            self._correction.static.bases(board),
            self._correction.dynamic.bases(board),
        )
        rest = 1.0 - weight
        whole, away = np.zeros((2, len(states), 3))
        for axis, (rows, variances, _, _) in enumerate(self._blocks):
            on_bias = [rest, *(rest * value for value in static[axis][0])]
            on_bias += [weight, *(weight * value for value in dynamic[axis][0]), *phi]
            felt = np.column_stack(on_bias) / self._K[axis]
            for result, one in ((whole, felt), (away, felt - mean_of(felt))):
                result[:, axis] = ((one @ rows) ** 2).sum(axis=1) + one**2 @ variances
        return whole, away

    def _regressors(
        self, state: Sequence[float], phi: list[float], axis: int
    ) -> tuple[Floats, Floats]:
        """
        Give what multiplies each parameter of bias and of scale, in the order of the posterior.
        """
        weight = state[WEIGHT]
        bias: list[float] = []
        scale: list[float] = []
        for share, curves in (
            (1.0 - weight, self._correction.static),
            (weight, self._correction.dynamic),
        ):
            of_bias, of_scale = curves.bases(state[BOARD])[axis]
            bias += [share, *(share * value for value in of_bias)]
            scale += [share, *(share * value for value in of_scale)]
        return np.array(bias + phi), np.array(scale + phi)


def _products(bias: Floats, scale: Floats) -> tuple[float, float, float]:
    # Sums along the rows above, and of products here: the same bits wherever the arrays lie.
    return (
        float((bias * bias).sum()),
        2.0 * float((bias * scale).sum()),
        float((scale * scale).sum()),
    )
