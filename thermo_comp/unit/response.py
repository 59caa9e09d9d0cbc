# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal response of one axis: the weighted sum of the columns, and what it is felt by.

Weights of 0 are left out, so that a column that is another axis' leaves no bit of this one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from ..thermal.memory import MemorySpec
from .calibration import ResponseTerm
from .functions import Number

#: Which column, and its weight on the bias and on the relative scale.
_Terms = list[tuple[int, float]]


class Weights:
    """
    The weights of the columns on one axis.

    response: the columns
    axis: 0, 1, 2 for x, y, z
    factor: by what the weights of a term are multiplied; by default by 1
    """

    def __init__(
        self,
        response: Sequence[ResponseTerm],
        axis: int,
        factor: Callable[[ResponseTerm], float] = lambda _: 1.0,
    ) -> None:
        self._bias: _Terms = []
        self._scale: _Terms = []
        for k, term in enumerate(response):
            for terms, weight in ((self._bias, term.bias[axis]), (self._scale, term.scale[axis])):
                if weight and factor(term):
                    terms.append((k, factor(term) * weight))

        #: Which columns have one.
        self.present = sorted({k for k, _ in (*self._bias, *self._scale)})

    def add(self, bias: Number, scale: Number, columns: Sequence[Number]) -> tuple[Number, Number]:
        """Add the weighted columns to a bias [input units] and to a relative scale."""
        for k, weight in self._bias:
            bias = bias + weight * columns[k]
        for k, weight in self._scale:
            scale = scale + weight * columns[k]
        return bias, scale


class Sensitivity:
    """
    What an error of a thermal state makes of one axis' response.

    Plays are taken to follow their input, so they feel nothing.

    response: the columns
    axis: 0, 1, 2 for x, y, z
    memory: that of the tracker
    """

    def __init__(self, response: Sequence[ResponseTerm], axis: int, memory: MemorySpec) -> None:
        # ``T - L`` rises with T, ``g = T_s - T`` falls.
        self._on_board = Weights(response, axis, _sign)
        self._on_power = Weights(response, axis, lambda term: float(term.power > 0))
        self._on_gradients = [
            Weights(response, axis, partial(_is_now, sensor)) for sensor in memory.sensors
        ]
        self._on_lags = [Weights(response, axis, partial(_is_lag, lag)) for lag in memory.lags]

    def on_board(
        self, on_input: Sequence[Number], on_power: Sequence[Number], nil: Number
    ) -> tuple[Number, Number]:
        """Differentiate (bias, relative scale) by the board temperature [per K]."""
        bias, scale = self._on_board.add(nil, nil, on_input)
        return self._on_power.add(bias, scale, on_power)

    def on_gradients(self, on_input: Sequence[Number], nil: Number) -> list[tuple[Number, Number]]:
        """Differentiate by the gradient of each sensor [per K]."""
        return [weights.add(nil, nil, on_input) for weights in self._on_gradients]

    def on_lags(self, on_input: Sequence[Number], nil: Number) -> list[tuple[Number, Number]]:
        """Differentiate by each lag [per K]."""
        return [weights.add(nil, nil, on_input) for weights in self._on_lags]


def _sign(term: ResponseTerm) -> float:
    if term.kind == 'board' or (term.kind == 'square' and term.tau_s):
        return 1.0
    return -1.0 if term.is_of_gradient else 0.0


def _is_now(sensor: str, term: ResponseTerm) -> float:
    return float(term.is_of_gradient and term.sensor == sensor)


def _is_lag(lag: tuple[str, float], term: ResponseTerm) -> float:
    return float(term.kind != 'play' and term.lag == lag)
