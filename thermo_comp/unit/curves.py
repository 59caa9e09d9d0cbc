# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the curves of one regime: what its set makes of the board temperature alone.

Written once for one float and for arrays, as `correction` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, NamedTuple

from ..thermal.state import BOARD, RATE
from .calibration import Calibration, RegimeSet
from .functions import Number, hold


class Excess(NamedTuple, Generic[Number]):
    """How far a thermal state lies outside the ranges of a set; 0 inside."""

    #: [K] and [K/s], signed.
    temperature: Number
    rate: Number
    #: Their sizes in half ranges, added.
    relative: Number


class SetCurves:
    """
    One regime's curves, ready to be evaluated.

    regime_set: the set
    other: the other regime's: where this one ends and that one goes on, its curve is followed
    calibration: the unit they belong to
    """

    def __init__(self, regime_set: RegimeSet, other: RegimeSet, calibration: Calibration) -> None:
        axes = calibration.axes
        self._reference = calibration.reference_temperature_c
        self._t_range = self._from_reference(regime_set)
        self._other_range = self._from_reference(other)
        lower, upper = regime_set.rate_range_k_min
        self._rate_range = lower / 60.0, upper / 60.0
        self._sets, self._others = regime_set.axes(), other.axes()
        self._levels = [
            axis.bias + axis_set.delta
            for axis, axis_set in zip((axes.x, axes.y, axes.z), self._sets, strict=True)
        ]
        #: What each axis' set leaves unexplained, as a variance [m^2/s^4].
        self.residuals = [axis_set.residual_sd_m_s2**2 for axis_set in self._sets]

    def _from_reference(self, regime_set: RegimeSet) -> tuple[float, float]:
        lower, upper = regime_set.temperature_range_c
        return lower - self._reference, upper - self._reference

    def excess(self, state: Sequence[Number]) -> Excess[Number]:
        """Say how far outside the set's ranges a thermal state lies."""
        t, rate = state[BOARD] - self._reference, state[RATE]
        over, too_fast = t - hold(t, *self._t_range), rate - hold(rate, *self._rate_range)
        return Excess(
            over,
            too_fast,
            abs(over) / _half(self._t_range) + abs(too_fast) / _half(self._rate_range),
        )

    def values(self, board: Number) -> list[tuple[Number, Number]]:
        """
        Evaluate (bias [input units], relative scale) of each axis at a board temperature [degC].
        """
        t = board - self._reference
        held = hold(t, *self._t_range)
        # Beyond its own range a set goes on as the other does, as far as that one was
        # calibrated: what the two differ by is held, not what they have in common.
        here, edge = hold(t, *self._other_range), hold(held, *self._other_range)
        goes_on = not _is_all(held, t)
        result = []
        for level, one, other in zip(self._levels, self._sets, self._others, strict=True):
            bias = one.bias_function.value(held) + level
            # Eq. (9)
            relative = one.scale_function.value(held)
            if goes_on:
                of_bias, of_scale = other.bias_function, other.scale_function
                bias = bias + (of_bias.value(here) - of_bias.value(edge))
                relative = relative + (of_scale.value(here) - of_scale.value(edge))
            result.append((bias, relative))
        return result

    def slopes(self, board: Number) -> list[tuple[Number, Number]]:
        """Differentiate what `values` gives, by the board temperature [per K]."""
        t = hold(board - self._reference, *self._t_range)
        return [(one.bias_function.slope(t), one.scale_function.slope(t)) for one in self._sets]

    def bases(self, board: Number) -> list[tuple[list[Number], list[Number]]]:
        """Give the regressors of each axis' free coefficients, of bias and of relative scale."""
        t = hold(board - self._reference, *self._t_range)
        return [(one.bias_function.basis(t), one.scale_function.basis(t)) for one in self._sets]


def _half(edges: tuple[float, float]) -> float:
    return (edges[1] - edges[0]) / 2.0


def _is_all(value: Number, wanted: Number) -> bool:
    is_equal = value == wanted
    return is_equal if isinstance(is_equal, bool) else bool(is_equal.all())
