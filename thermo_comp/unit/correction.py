# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of the correction: a thermal state in, bias, scale and error variances out.

Written once for one float and for arrays of knots, with the same operations in the same order,
so a stream and a batch get the same bits. Notation as in `calibration`; x is the axis' specific
force before the misalignment, its error variance is ``v(x) = a + b x + c x^2``.

"""

from __future__ import annotations

import numpy as np

from ..thermal import tracker as thermal
from .axis_correction import AxisCorrection, BiasScale, Excess, Regressors, Variance
from .calibration import Calibration, RegimeSet
from .functions import Number, hold

#: While the sets cross over, the output moves no faster than this [m/s^3] (1 ug per second) ...
GENTLE_RATE = 9.80665e-6
#: ... unless that took more than this many transition times.
LONGEST_TRANSITION = 10.0
_GAP_TEMPERATURES = 33


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
            Regressors(held_t, t, linear, not _is_all(held_t, t)),
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

    def bias_scale(self, regressors: Regressors[Number]) -> list[BiasScale[Number]]:
        """
        Evaluate bias and scale of the three axes.

        """
        return [axis.bias_scale(regressors) for axis in self.axes]

    def variance(
        self,
        regressors: Regressors[Number],
        state: tuple[Number, ...],
        excess: Excess[Number],
    ) -> list[Variance[Number]]:
        """
        Evaluate the error variance of the three axes; see `AxisCorrection.variance`.

        """
        return [axis.variance(regressors, state, excess) for axis in self.axes]


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
        # To the noise of one sample comes that of rounding to whole counts, twice 1/12 count^2
        # where the converter carries the remainder on.
        quantum = 1.0 / 6.0 if calibration.unit.input == 'counts' else 0.0
        #: The sum over the axes, rounding included [m^2/s^4].
        self.noise_trace = sum(self.noise, 0.0) + sum((quantum / K**2 for K in self._K), 0.0)
        M, sd = calibration.misalignment, calibration.misalignment_sd
        #: yx, zx, zy of the misalignment and their variances.
        self.misalignment = (
            *(M[1][0], M[2][0], M[2][1]),
            *(sd[0] * sd[0], sd[1] * sd[1], sd[2] * sd[2]),
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
        weight = state[thermal.WEIGHT]
        alone = self._alone(weight)
        if alone is not None:
            return alone.bias_scale(alone.regressors(state)[0])
        static = self.static.bias_scale(self.static.regressors(state)[0])
        dynamic = self.dynamic.bias_scale(self.dynamic.regressors(state)[0])
        return _blend(weight, static, dynamic)

    def _alone(self, weight: Number) -> SetCorrection | None:
        """
        Find the set that counts alone, which is the usual case; None while both do.

        """
        if _is_all(weight, 0.0):
            return self.static
        return self.dynamic if _is_all(weight, 1.0) else None

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
        static = self.static.bias_scale(self.static.regressors(state)[0])
        dynamic = self.dynamic.bias_scale(self.dynamic.regressors(state)[0])
        square, relative = nil, nil
        for K, (bias_s, scale_s), (bias_d, scale_d) in zip(self._K, static, dynamic, strict=True):
            square = square + ((bias_d - bias_s) / K) ** 2
            relative = np.maximum(relative, np.abs((scale_d - scale_s) / K))
        return float(np.max(np.sqrt(square) + self._gravity * relative))

    def variance(self, state: tuple[Number, ...]) -> list[Variance[Number]]:
        """
        Evaluate the coefficients of each axis' error variance; see `evaluate`.

        """
        return self.evaluate(state)[1]

    def evaluate(
        self, state: tuple[Number, ...]
    ) -> tuple[list[BiasScale[Number]], list[Variance[Number]]]:
        """
        Evaluate bias, scale and error variance of each axis, noise of one sample included.

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
        list of (bias, scale)
            Per axis, in input units and input units per m/s^2.
        list of (a, b, c)
            Per axis, ``v(x) = a + b x + c x^2`` [m^2/s^4], x in m/s^2.

        """
        weight, unknown = state[thermal.WEIGHT], state[thermal.UNKNOWN]
        alone = self._alone(weight)
        if alone is not None and _is_all(unknown, 0.0):
            regressors, excess = alone.regressors(state)
            if _is_all(alone.relative_excess(excess), 0.0):
                variances = alone.variance(regressors, state, excess)
                return alone.bias_scale(regressors), [
                    (a + noise, b, c)
                    for (a, b, c), noise in zip(variances, self.noise, strict=True)
                ]
        static, excess_s = self.static.regressors(state)
        dynamic, excess_d = self.dynamic.regressors(state)
        rest = 1.0 - weight
        relative = rest * self.static.relative_excess(excess_s)
        relative = relative + weight * self.dynamic.relative_excess(excess_d)
        doubt = unknown + weight * rest + relative * relative
        values_s, values_d = self.static.bias_scale(static), self.dynamic.bias_scale(dynamic)
        share_s, share_d = rest + unknown * weight, weight + unknown * rest
        variances_s = self.static.variance(static, state, excess_s)
        variances_d = self.dynamic.variance(dynamic, state, excess_d)
        variances = [
            (
                share_s * a_s + share_d * a_d,
                share_s * b_s + share_d * b_d,
                share_s * c_s + share_d * c_d,
            )
            for (a_s, b_s, c_s), (a_d, b_d, c_d) in zip(variances_s, variances_d, strict=True)
        ]
        result = []
        for K, noise, (a, b, c), (bias_s, scale_s), (bias_d, scale_d) in zip(
            self._K, self.noise, variances, values_s, values_d, strict=True
        ):
            bias_gap = (bias_d - bias_s) / K
            scale_gap = (scale_d - scale_s) / K
            # Far outside, the residual of the fit says nothing any more: it grows with the excess.
            result.append(
                (
                    a + noise + doubt * bias_gap * bias_gap + relative * relative * a,
                    b + 2.0 * doubt * bias_gap * scale_gap + relative * relative * b,
                    c + doubt * scale_gap * scale_gap + relative * relative * c,
                )
            )
        return _blend(weight, values_s, values_d), result


def _blend(
    weight: Number, static: list[BiasScale[Number]], dynamic: list[BiasScale[Number]]
) -> list[BiasScale[Number]]:
    rest = 1.0 - weight
    return [
        (rest * bias_s + weight * bias_d, rest * scale_s + weight * scale_d)
        for (bias_s, scale_s), (bias_d, scale_d) in zip(static, dynamic, strict=True)
    ]


def _is_all(value: Number, wanted: Number | float) -> bool:
    return bool((value == wanted).all()) if isinstance(value, np.ndarray) else value == wanted
