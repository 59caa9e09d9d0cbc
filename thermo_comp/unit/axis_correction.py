# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns one axis of one regime's set: its bias, its scale and what its error variance is made of.

Written once for one float and for arrays, as `correction` says.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic

from ..thermal import tracker as thermal
from .calibration import AxisReference, AxisSet
from .functions import Number, hold

#: (bias, scale) of one axis.
BiasScale = tuple[Number, Number]
#: (a, b, c) of one axis.
Variance = tuple[Number, Number, Number]
#: What is not 0 of a quadratic form: per row its index and (column, coefficient).
_Form = list[tuple[int, list[tuple[int, float]]]]


# Not frozen: these two are made anew for each thermal event, and a frozen one takes twice as long.
@dataclass(slots=True)
class Regressors(Generic[Number]):
    """
    What the terms of one set multiply, held at the edges of that set's ranges.

    """

    #: T_board - T_ref [K].
    t: Number
    #: The same, not held.
    free_t: Number
    #: Gradient [K], rate [K/s], then the memory of each lag [K].
    linear: list[Number]
    #: Whether `t` is not `free_t` somewhere.
    is_held: bool


@dataclass(slots=True)
class Excess(Generic[Number]):
    """
    How far a thermal state lies outside the calibrated ranges; 0 inside.

    """

    #: [K], [K], [K/s] and, the farthest of the lags, [K]; signed like the excess.
    temperature: Number
    gradient: Number
    rate: Number
    memory: Number


class AxisCorrection:
    """
    One axis of one set, ready to be evaluated.

    Parameters
    ----------
    axis_set : AxisSet
        Its coefficients.
    reference : AxisReference
        The axis at the reference temperature.
    other : AxisSet
        The axis in the other regime.
    other_range : (float, float)
        Where its functions hold, from the reference [K].

    """

    def __init__(
        self,
        axis_set: AxisSet,
        reference: AxisReference,
        other: AxisSet,
        other_range: tuple[float, float],
    ) -> None:
        self._set = axis_set
        self._other = other
        self._other_range = other_range
        self._K = reference.scale_factor
        self._level = reference.bias + axis_set.delta
        self._bias_terms = _present(
            axis_set.gradient.bias, axis_set.rate.bias, axis_set.memory.bias
        )
        self._scale_terms = _present(
            axis_set.gradient.scale, axis_set.rate.scale, axis_set.memory.scale
        )
        K, n_bias = self._K, axis_set.n_bias_parameters
        bias_rows, scale_rows = axis_set.covariance[:n_bias], axis_set.covariance[n_bias:]
        self._bias_form = _form(bias_rows, 0, 0, 1.0 / (K * K))
        self._cross_form = _form([row[:n_bias] for row in scale_rows], n_bias, 0, 2.0 / K)
        self._scale_form = _form([row[n_bias:] for row in scale_rows], n_bias, n_bias, 1.0)
        self._n_linear = 2 + len(axis_set.memory.bias)
        self._residual = axis_set.residual_sd_m_s2**2
        self._gradient = axis_set.gradient
        # What a variance of 1 of gradient, rate and each lag makes of a, b and c.
        terms = zip(
            (axis_set.gradient.bias, axis_set.rate.bias, *axis_set.memory.bias),
            (axis_set.gradient.scale, axis_set.rate.scale, *axis_set.memory.scale),
            strict=True,
        )
        self._term_variances = [
            (k, bias * bias / (K * K), 2.0 * bias * scale / K, scale * scale)
            for k, (bias, scale) in enumerate(terms)
            if bias or scale
        ]

    def bias_scale(self, regressors: Regressors[Number]) -> BiasScale[Number]:
        """
        Evaluate the bias [input units] and the scale [input units per m/s^2].

        """
        values = regressors.linear
        bias = self._set.bias_function.value(regressors.t) + self._level
        for index, coefficient in self._bias_terms:
            bias = bias + coefficient * values[index]
        relative = self._set.scale_function.value(regressors.t)
        for index, coefficient in self._scale_terms:
            relative = relative + coefficient * values[index]
        if regressors.is_held:
            # Beyond its own range a set goes on as the other does, as far as that one was
            # calibrated: what the two differ by is held, not what they have in common.
            here = hold(regressors.free_t, *self._other_range)
            edge = hold(regressors.t, *self._other_range)
            other = self._other
            bias = bias + (other.bias_function.value(here) - other.bias_function.value(edge))
            relative = relative + (
                other.scale_function.value(here) - other.scale_function.value(edge)
            )
        return bias, relative * self._K

    def variance(
        self,
        regressors: Regressors[Number],
        state: tuple[Number, ...],
        excess: Excess[Number],
    ) -> Variance[Number]:
        """
        Evaluate (a, b, c) of the error variance: parameters, thermometers, memory, residual.

        Parameters
        ----------
        regressors : Regressors
            The held state.
        state : tuple of float or of ndarray
            The state itself, with its variances.
        excess : Excess
            How far outside the ranges it is.

        Returns
        -------
        a, b, c : float or ndarray
            ``v(x) = a + b x + c x^2`` [m^2/s^4], x in m/s^2.

        """
        axis_set, K = self._set, self._K
        t = regressors.t
        # Errors of the thermal state itself, through the derivatives of bias / K and of scale.
        variance = state[thermal.VAR_BOARD] + excess.temperature * excess.temperature
        on_bias = (axis_set.bias_function.slope(t) - self._gradient.bias) / K
        on_scale = axis_set.scale_function.slope(t) - self._gradient.scale
        a = variance * on_bias * on_bias + self._residual
        b = 2.0 * variance * on_bias * on_scale
        c = variance * on_scale * on_scale
        for k, to_a, to_b, to_c in self._term_variances:
            if k == 0:
                variance = state[thermal.VAR_GRADIENT] + excess.gradient * excess.gradient
            elif k == 1:
                variance = excess.rate * excess.rate
            else:
                index = thermal.MEMORY + 1 + 2 * (k - 2)
                variance = state[index] + excess.memory * excess.memory
            a = a + variance * to_a
            b = b + variance * to_b
            c = c + variance * to_c
        if not self._bias_form and not self._scale_form:
            return a, b, c
        # What the parameters leave uncertain.
        one = t * 0.0 + 1.0
        linear = regressors.linear[: self._n_linear]
        phi: list[Number] = [one]
        for function in (axis_set.bias_function, axis_set.scale_function):
            phi.extend(function.basis(t))
            phi.extend(linear)
            phi.append(one)
        return (
            _with_form(a, self._bias_form, phi),
            _with_form(b, self._cross_form, phi),
            _with_form(c, self._scale_form, phi),
        )


def _present(gradient: float, rate: float, memory: tuple[float, ...]) -> list[tuple[int, float]]:
    return [(i, c) for i, c in enumerate((gradient, rate, *memory)) if c]


def _form(
    rows: Sequence[tuple[float, ...]], first_row: int, first_column: int, factor: float
) -> _Form:
    """
    Take what is not 0 of a quadratic form: per row its index and (column, coefficient).

    """
    result: _Form = []
    for i, row in enumerate(rows, first_row):
        # An entry off the diagonal stands for two, but for those between bias and scale.
        terms = [
            (j, value * factor * (2.0 if j < i and first_row == first_column else 1.0))
            for j, value in enumerate(row, first_column)
            if value
        ]
        if terms:
            result.append((i, terms))
    return result


def _with_form(total: Number, form: _Form, phi: list[Number]) -> Number:
    for i, terms in form:
        inner = phi[0] * 0.0
        for j, coefficient in terms:
            inner = inner + coefficient * phi[j]
        total = total + inner * phi[i]
    return total
