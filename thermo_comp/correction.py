# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of the correction: a thermal state in, bias, scale and error variances out.

Written once for one float and for arrays of knots, with the same operations in the same order,
so a stream and a batch get the same bits. Notation as in `calibration`; x is the axis' specific
force before the misalignment, its error variance is ``v(x) = a + b x + c x^2``.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import numpy as np

from . import thermal
from .calibration import AxisReference, AxisSet, Calibration, RegimeSet
from .functions import Number, hold

#: While the sets cross over, the output moves no faster than this [m/s^3] (1 ug per second) ...
GENTLE_RATE = 9.80665e-6
#: ... unless that took more than this many transition times.
LONGEST_TRANSITION = 10.0
_GAP_TEMPERATURES = 33
#: (bias, scale) of one axis.
BiasScale = tuple[Number, Number]


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Excess(Generic[Number]):
    """
    How far a thermal state lies outside the calibrated ranges; 0 inside.

    """

    #: [K], [K], [K/s] and, the farthest of the lags, [K]; signed like the excess.
    temperature: Number
    gradient: Number
    rate: Number
    memory: Number


class SetCorrection:
    """
    One regime's set, ready to be evaluated.

    Parameters
    ----------
    regime_set : RegimeSet
        The set.
    other : RegimeSet
        The other regime's: where this one ends and that one goes on, its curve is followed.
    calibration : Calibration
        The unit they belong to.

    """

    def __init__(self, regime_set: RegimeSet, other: RegimeSet, calibration: Calibration) -> None:
        self._reference = calibration.reference_temperature_c
        self.temperature_range_c = regime_set.temperature_range_c
        lower, upper = regime_set.temperature_range_c
        self._t_range = lower - self._reference, upper - self._reference
        lower, upper = other.temperature_range_c
        other_range = lower - self._reference, upper - self._reference
        self._gradient_range = regime_set.gradient_range_k
        self._rate_range = tuple(edge / 60.0 for edge in regime_set.rate_range_k_min)
        self._memory_range = regime_set.memory_range_k
        axes = calibration.axes
        self.axes = tuple(
            AxisCorrection(axis_set, reference, other_set, other_range)
            for axis_set, other_set, reference in zip(
                regime_set.axes(), other.axes(), (axes.x, axes.y, axes.z), strict=True
            )
        )
        # Half of each range: the yardstick by which an excess is judged.
        self._half_widths = tuple(
            (upper - lower) / 2.0
            for lower, upper in (
                self._t_range,
                self._gradient_range,
                self._rate_range,
                self._memory_range,
            )
        )

    def regressors(self, state: tuple[Number, ...]) -> tuple[Regressors[Number], Excess[Number]]:
        """
        Hold a thermal state at the edges of the set's ranges.

        Parameters
        ----------
        state : tuple of float or of ndarray
            As `thermal.ThermalTracker.sample` gives it.

        Returns
        -------
        Regressors
            What the terms multiply.
        Excess
            What was cut off.

        """
        t = state[thermal.BOARD] - self._reference
        held_t = hold(t, *self._t_range)
        gradient = state[thermal.GRADIENT]
        held_gradient = hold(gradient, *self._gradient_range)
        rate = state[thermal.RATE]
        held_rate = hold(rate, *self._rate_range)
        memory = state[thermal.MEMORY :: 2]
        held_memory = tuple(hold(m, *self._memory_range) for m in memory)
        linear = [held_gradient, held_rate]
        linear.extend(held_memory)
        over = t * 0.0
        for m, held in zip(memory, held_memory, strict=True):
            over = over + abs(m - held)
        return (
            Regressors(held_t, t, linear),
            Excess(t - held_t, gradient - held_gradient, rate - held_rate, over),
        )

    def relative_excess(self, excess: Excess[Number]) -> Number:
        """
        Return the excess in units of half the calibrated range, summed over the regressors.

        """
        t, gradient, rate, memory = self._half_widths
        return (
            abs(excess.temperature) / t
            + abs(excess.gradient) / gradient
            + abs(excess.rate) / rate
            + excess.memory / memory
        )


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
        rows = axis_set.covariance
        n_bias = axis_set.n_bias_parameters
        entries = [(i, j, value) for i, row in enumerate(rows) for j, value in enumerate(row)]
        self._bias_form = [(i, j, _twice(i, j, v)) for i, j, v in entries if v and i < n_bias]
        self._cross_form = [(i, j, v) for i, j, v in entries if v and j < n_bias <= i]
        self._scale_form = [(i, j, _twice(i, j, v)) for i, j, v in entries if v and j >= n_bias]

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
        if _differ(regressors.t, regressors.free_t):
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
    ) -> tuple[Number, Number, Number]:
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
        axis_set: AxisSet = self._set
        K: float = self._K
        one = regressors.t * 0.0 + 1.0
        linear = regressors.linear[: 2 + len(axis_set.memory.bias)]
        phi = [one]
        phi.extend(axis_set.bias_function.basis(regressors.t))
        phi.extend(linear)
        phi.append(one)
        phi.extend(axis_set.scale_function.basis(regressors.t))
        phi.extend(linear)
        a = one * axis_set.residual_sd_m_s2**2
        for i, j, value in self._bias_form:
            a = a + value / (K * K) * phi[i] * phi[j]
        b = one * 0.0
        for i, j, value in self._cross_form:
            b = b + 2.0 * value / K * phi[i] * phi[j]
        c = one * 0.0
        for i, j, value in self._scale_form:
            c = c + value * phi[i] * phi[j]
        # Errors of the thermal state itself, through the derivatives of bias / K and of scale.
        bias_slope = axis_set.bias_function.slope(regressors.t)
        scale_slope = axis_set.scale_function.slope(regressors.t)
        gradient = axis_set.gradient
        sources: list[tuple[Number, Number, Number]] = [
            (
                state[thermal.VAR_BOARD] + excess.temperature * excess.temperature,
                (bias_slope - gradient.bias) / K,
                scale_slope - gradient.scale,
            ),
            (
                state[thermal.VAR_GRADIENT] + excess.gradient * excess.gradient,
                one * gradient.bias / K,
                one * gradient.scale,
            ),
            (
                excess.rate * excess.rate,
                one * axis_set.rate.bias / K,
                one * axis_set.rate.scale,
            ),
        ]
        sources += [
            (variance + excess.memory * excess.memory, one * bias / K, one * scale)
            for variance, bias, scale in zip(
                state[thermal.MEMORY + 1 :: 2],
                axis_set.memory.bias,
                axis_set.memory.scale,
                strict=False,
            )
        ]
        for variance, on_bias, on_scale in sources:
            a = a + variance * on_bias * on_bias
            b = b + 2.0 * variance * on_bias * on_scale
            c = c + variance * on_scale * on_scale
        return a, b, c


class Correction:
    """
    Both sets of a calibration, blended by the weight of the thermal state.

    Parameters
    ----------
    calibration : Calibration
        The unit.

    """

    def __init__(self, calibration: Calibration) -> None:
        self.static = SetCorrection(calibration.static, calibration.dynamic, calibration)
        self.dynamic = SetCorrection(calibration.dynamic, calibration.static, calibration)
        self._K = tuple(
            axis.scale_factor
            for axis in (calibration.axes.x, calibration.axes.y, calibration.axes.z)
        )
        self._gravity = calibration.gravity_m_s2
        self._n_lags = len(calibration.memory_time_constants_s)
        #: Variance of the noise of one sample [m^2/s^4].
        self.noise = tuple(
            density * density / calibration.unit.cycle_time_s
            for density in calibration.noise_density_m_s2_sqrt_hz
        )

    def bias_scale(self, state: tuple[Number, ...]) -> list[BiasScale[Number]]:
        """
        Evaluate the blended bias and scale of the three axes.

        Parameters
        ----------
        state : tuple of float or of ndarray
            As `thermal.ThermalTracker.sample` gives it.

        Returns
        -------
        list of (bias, scale)
            Per axis, in input units and input units per m/s^2.

        """
        static, _ = self.static.regressors(state)
        dynamic, _ = self.dynamic.regressors(state)
        weight = state[thermal.WEIGHT]
        rest = 1.0 - weight
        result = []
        for axis_s, axis_d in zip(self.static.axes, self.dynamic.axes, strict=True):
            bias_s, scale_s = axis_s.bias_scale(static)
            bias_d, scale_d = axis_d.bias_scale(dynamic)
            result.append((rest * bias_s + weight * bias_d, rest * scale_s + weight * scale_d))
        return result

    def gentle_transition(self, given_s: float) -> float:
        """
        Stretch a transition time to what an INS would overlook.

        Parameters
        ----------
        given_s : float
            The time over which the sets are to cross over [s]; 0 = a hard switch.

        Returns
        -------
        float
            The time that the difference of the two sets needs, in soaks [s].

        """
        needed = self._largest_gap() / GENTLE_RATE
        return min(max(given_s, needed), LONGEST_TRANSITION * given_s)

    def _largest_gap(self) -> float:
        """
        Bound what the two sets differ by at rest, without thermal terms [m/s^2].

        """
        lower = min(self.static.temperature_range_c[0], self.dynamic.temperature_range_c[0])
        upper = max(self.static.temperature_range_c[1], self.dynamic.temperature_range_c[1])
        board = np.linspace(lower, upper, _GAP_TEMPERATURES)
        nil = np.zeros_like(board)
        state = (board, *[nil] * (thermal.MEMORY - 1 + 2 * self._n_lags))
        static, _ = self.static.regressors(state)
        dynamic, _ = self.dynamic.regressors(state)
        square, relative = nil, nil
        for K, axis_s, axis_d in zip(self._K, self.static.axes, self.dynamic.axes, strict=True):
            bias_s, scale_s = axis_s.bias_scale(static)
            bias_d, scale_d = axis_d.bias_scale(dynamic)
            square = square + ((bias_d - bias_s) / K) ** 2
            relative = np.maximum(relative, np.abs((scale_d - scale_s) / K))
        return float(np.max(np.sqrt(square) + self._gravity * relative))

    def variance(self, state: tuple[Number, ...]) -> list[tuple[Number, Number, Number]]:
        """
        Evaluate the coefficients of each axis' error variance, noise of one sample included.

        The variance of a blend is at most the blend of the variances; to it comes what the two
        sets disagree by, while the regime is unknown, while they cross over, and in proportion
        to how far the state lies outside the calibrated ranges. While the regime is unknown
        either set may be the right one, and the variances of both count.

        Parameters
        ----------
        state : tuple of float or of ndarray
            As `thermal.ThermalTracker.sample` gives it.

        Returns
        -------
        list of (a, b, c)
            Per axis, ``v(x) = a + b x + c x^2`` [m^2/s^4], x in m/s^2.

        """
        static, excess_s = self.static.regressors(state)
        dynamic, excess_d = self.dynamic.regressors(state)
        weight = state[thermal.WEIGHT]
        rest = 1.0 - weight
        relative = rest * self.static.relative_excess(excess_s)
        relative = relative + weight * self.dynamic.relative_excess(excess_d)
        doubt = state[thermal.UNKNOWN] + weight * rest + relative * relative
        rest, weight = (
            rest + state[thermal.UNKNOWN] * weight,
            weight + state[thermal.UNKNOWN] * rest,
        )
        result = []
        for K, noise, axis_s, axis_d in zip(
            self._K, self.noise, self.static.axes, self.dynamic.axes, strict=True
        ):
            a_s, b_s, c_s = axis_s.variance(static, state, excess_s)
            a_d, b_d, c_d = axis_d.variance(dynamic, state, excess_d)
            bias_s, scale_s = axis_s.bias_scale(static)
            bias_d, scale_d = axis_d.bias_scale(dynamic)
            bias_gap = (bias_d - bias_s) / K
            scale_gap = (scale_d - scale_s) / K
            a = rest * a_s + weight * a_d
            # Far outside, the residual of the fit says nothing any more: it grows with the excess.
            a = a + noise + doubt * bias_gap * bias_gap + relative * relative * a
            b = rest * b_s + weight * b_d
            b = b + 2.0 * doubt * bias_gap * scale_gap + relative * relative * b
            c = rest * c_s + weight * c_d
            c = c + doubt * scale_gap * scale_gap + relative * relative * c
            result.append((a, b, c))
        return result


def _differ(one: Number, other: Number) -> bool:
    return bool(np.any(one != other)) if isinstance(one, np.ndarray) else one != other


def _present(gradient: float, rate: float, memory: tuple[float, ...]) -> list[tuple[int, float]]:
    return [(i, c) for i, c in enumerate((gradient, rate, *memory)) if c]


def _twice(i: int, j: int, value: float) -> float:
    return value if i == j else 2.0 * value
