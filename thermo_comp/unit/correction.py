# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of the correction: a thermal state in, bias, scale and error variances out.

Written once for one float and for arrays of knots, with the same operations in the same order,
so a stream and a batch get the same bits. Notation as in `calibration`; x is the axis' specific
force before the misalignment, its error variance is ``v(x) = a + b x + c x^2``. Its part that
changes slowly is `uncertainty`'s, and comes in ready.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from ..thermal.memory import MemorySpec
from ..thermal.state import BOARD, GRADIENT, UNKNOWN, VAR_BOARD, VAR_GRADIENT, WEIGHT, Layout
from .calibration import Calibration
from .columns import ColumnTable, memory_of
from .curves import SetCurves
from .functions import Number
from .gravity import MICRO_G
from .response import Sensitivity, Weights

#: (bias, scale) of one axis.
BiasScale: TypeAlias = tuple[Number, Number]
#: (a, b, c) of one axis.
Variance: TypeAlias = tuple[Number, Number, Number]

#: While the sets cross over, the output moves no faster than this [m/s^3] (1 ug per second) ...
GENTLE_RATE = MICRO_G
#: ... unless that took more than this many transition times.
LONGEST_TRANSITION = 10.0
_GAP_TEMPERATURES = 33
#: Rounding to whole counts, twice 1/12 where the converter carries the remainder on [counts^2].
ROUNDING_VARIANCE = 1.0 / 6.0


class Correction:
    """
    Both sets of a calibration, blended by the weight of the thermal state, and its response.

    calibration: the unit
    memory: what the tracker must remember, for the angular rate, too; or what it does remember
    noise: variance of the noise of one message per axis, rounding included [m^2/s^4]
    noise_trace: their sum
    misalignment: yx, zx, zy of the misalignment and their variances
    """

    def __init__(self, calibration: Calibration, memory: MemorySpec | None = None) -> None:
        self.static = SetCurves(calibration.static, calibration.dynamic, calibration)
        self.dynamic = SetCurves(calibration.dynamic, calibration.static, calibration)
        self._edges = [one.temperature_range_c for one in calibration.regime_sets()]
        axes = calibration.axes
        self._K = tuple(axis.scale_factor for axis in (axes.x, axes.y, axes.z))
        self._gravity = calibration.gravity_m_s2
        response = calibration.response
        gyroscope = calibration.gyroscope
        columns = (*response, *(gyroscope.response if gyroscope else ()))
        self.memory = memory or memory_of(columns, calibration.sensors)
        lower, upper = zip(*self._edges, strict=True)
        self.table = ColumnTable(
            response, self.memory, calibration.reference_temperature_c, (min(lower), max(upper))
        )
        self._weights = [Weights(response, axis) for axis in range(3)]
        self._sensitivities = [Sensitivity(response, axis, self.memory) for axis in range(3)]
        layout = Layout(self.memory)
        self._gradients = list(layout.gradients.values())
        self._lags = list(layout.lags.values())
        rounding = ROUNDING_VARIANCE if calibration.unit.input == 'counts' else 0.0
        self.noise = tuple(
            density * density / calibration.unit.cycle_time_s + rounding / (K * K)
            for density, K in zip(calibration.noise_density_m_s2_sqrt_hz, self._K, strict=True)
        )
        self.noise_trace = sum(self.noise, 0.0)
        M, sd = calibration.misalignment, calibration.misalignment_sd
        variances = [value * value for value in sd]
        posterior = calibration.posterior
        if posterior is not None:
            own = (posterior.matrix[-3:] ** 2).sum(axis=1) + posterior.variances[-3:]
            variances = own.tolist()
        self.misalignment = (M[1][0], M[2][0], M[2][1], *variances)

    def bias_scale(self, state: Sequence[Number]) -> list[BiasScale[Number]]:
        """Evaluate the bias and the scale of the three axes."""
        return self._bias_scale(state, self.table.values(state))

    def _bias_scale(
        self, state: Sequence[Number], phi: Sequence[Number]
    ) -> list[BiasScale[Number]]:
        weight = state[WEIGHT]
        rest = 1.0 - weight
        static, dynamic = self.static.values(state[BOARD]), self.dynamic.values(state[BOARD])
        result = []
        for axis, (bias_s, scale_s), (bias_d, scale_d) in zip(
            range(3), static, dynamic, strict=True
        ):
            bias, relative = self._weights[axis].add(
                rest * bias_s + weight * bias_d, rest * scale_s + weight * scale_d, phi
            )
            # Eq. (8): K at this temperature.
            result.append((bias, relative * self._K[axis]))
        return result

    def gentle_transition(self, given_s: float) -> float:
        """
        Stretch a transition time to what an INS would overlook.

        `given_s`: the time over which the sets are to cross over [s]; 0 = a hard switch. Returns
        the time that the difference of the two sets needs, in soaks [s].
        """
        needed = self._largest_gap() / GENTLE_RATE
        return min(max(given_s, needed), LONGEST_TRANSITION * given_s)

    def _largest_gap(self) -> float:
        """Bound what the two sets differ by at rest [m/s^2]."""
        lower, upper = zip(*self._edges, strict=True)
        board = np.linspace(min(lower), max(upper), _GAP_TEMPERATURES)
        square, relative = np.zeros_like(board), np.zeros_like(board)
        for bias, scale in self._gaps(board):
            square = square + bias**2
            relative = np.maximum(relative, np.abs(scale))
        return float(np.max(np.sqrt(square) + self._gravity * relative))

    def _gaps(self, board: Number) -> list[tuple[Number, Number]]:
        """Give what the sets differ by at a board temperature: bias / K and relative scale."""
        static, dynamic = self.static.values(board), self.dynamic.values(board)
        return [
            ((bias_d - bias_s) / K, scale_d - scale_s)
            for K, (bias_s, scale_s), (bias_d, scale_d) in zip(
                self._K, static, dynamic, strict=True
            )
        ]

    def relative_excess(self, state: Sequence[Number]) -> Number:
        """
        Say how far a thermal state lies outside the calibrated ranges, in half ranges; 0 inside.
        """
        weight = state[WEIGHT]
        raw = self.table.raw(state)
        static, dynamic = self.static.excess(state), self.dynamic.excess(state)
        curves = (1.0 - weight) * static.relative + weight * dynamic.relative
        every = range(len(self.table.columns))
        return curves + self.table.excess(raw, self.table.held(raw), weight * 0.0, every)

    def gradient_excess(self, state: Sequence[float]) -> float:
        """
        Say how far the gradients lie outside the calibrated ranges, the farthest, signed [K].
        """
        raw = self.table.raw(state)
        over = [0.0]
        for column, u, held in zip(self.table.columns, raw, self.table.held(raw), strict=True):
            if column.kind == 'now':
                over.append(u - held)
        return max(over, key=abs)

    def evaluate(
        self, state: Sequence[Number], slow: Sequence[Variance[Number]]
    ) -> tuple[list[BiasScale[Number]], list[Variance[Number]]]:
        """
        Evaluate bias, scale and error variance of each axis, noise of one message included.

        To the variance comes what the two sets disagree by, while the regime is unknown, while
        they cross over, and in proportion to how far the state lies outside the calibrated
        ranges. While the regime is unknown either set may be the right one, and the variances of
        both count.

        Returns per axis, ``v(x) = a + b x + c x^2`` [m^2/s^4], x in m/s^2.
        """
        weight, unknown = state[WEIGHT], state[UNKNOWN]
        rest = 1.0 - weight
        raw = self.table.raw(state)
        held = self.table.held(raw)
        phi = self.table.weighted(held, state[BOARD], weight)
        static, dynamic = self.static.excess(state), self.dynamic.excess(state)
        outside = rest * static.relative + weight * dynamic.relative
        doubt = unknown + weight * rest + outside * outside
        shares = rest + unknown * weight, weight + unknown * rest
        excesses = static.temperature, dynamic.temperature
        slopes = self.static.slopes(state[BOARD]), self.dynamic.slopes(state[BOARD])
        on_input, on_power = self.table.slopes(state, raw)
        beyond = [u - edge for u, edge in zip(raw, held, strict=True)]
        cut_off = self.table.weighted(beyond, state[BOARD], weight)
        nil = weight * 0.0
        variances = []
        gaps = self._gaps(state[BOARD])
        if self.table.differs:
            gaps = self._with_response(gaps, state, held)
        for axis, K in enumerate(self._K):
            felt = self._sensitivities[axis]
            a, b, c = nil, nil, nil
            of_board = felt.on_board(on_input, on_power, nil)
            for share, curves, excess, slope in zip(
                shares, (self.static, self.dynamic), excesses, slopes, strict=True
            ):
                variance = share * (state[VAR_BOARD] + excess * excess)
                bias = (slope[axis][0] + of_board[0]) / K
                scale = slope[axis][1] + of_board[1]
                a, b, c = _with(a, b, c, variance, bias, scale)
                a = a + share * curves.residuals[axis]
            for place, (bias, scale) in zip(
                self._gradients, felt.on_gradients(on_input, nil), strict=True
            ):
                a, b, c = _with(a, b, c, state[place + VAR_GRADIENT - GRADIENT], bias / K, scale)
            for place, (bias, scale) in zip(self._lags, felt.on_lags(on_input, nil), strict=True):
                a, b, c = _with(a, b, c, state[place + 1], bias / K, scale)
            a, b, c = a + slow[axis][0], b + slow[axis][1], c + slow[axis][2]
            # Far outside, the residual of the fit says nothing any more: it grows with the excess.
            present = self._weights[axis].present
            relative = outside + self.table.excess(raw, held, nil, present)
            grown = 1.0 + relative * relative
            a, b, c = _with(grown * a, grown * b, grown * c, doubt, *gaps[axis])
            bias, scale = self._weights[axis].add(nil, nil, cut_off)
            a, b, c = _with(a, b, c, nil + 1.0, bias / K, scale)
            variances.append((a + self.noise[axis], b, c))
        return self._bias_scale(state, phi), variances

    def _with_response(
        self, gaps: list[tuple[Number, Number]], state: Sequence[Number], held: Sequence[Number]
    ) -> list[tuple[Number, Number]]:
        """Add what the columns that belong to one regime make of the difference of the sets."""
        nil = state[WEIGHT] * 0.0
        of_static = self.table.weighted(held, state[BOARD], nil)
        of_dynamic = self.table.weighted(held, state[BOARD], nil + 1.0)
        change = [d - s for d, s in zip(of_dynamic, of_static, strict=True)]
        result = []
        for axis, (bias, scale) in enumerate(gaps):
            more, relative = self._weights[axis].add(nil, nil, change)
            result.append((bias + more / self._K[axis], scale + relative))
        return result


def _with(
    a: Number, b: Number, c: Number, variance: Number, bias: Number, scale: Number
) -> tuple[Number, Number, Number]:
    """Add what an error makes of v(x) that moves the axis by ``bias + scale x`` per unit."""
    return (
        a + variance * bias * bias,
        b + 2.0 * variance * bias * scale,
        c + variance * scale * scale,
    )
