# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns functions of temperature (polynomial, cubic spline, exponential) that are 0 or 1 at t = 0.

A single ``t = T_board - T_ref`` [K] gives the same bits as an array: the code uses only ``+ - *
/`` in a fixed order, and `math.exp` number by number. Each function is linear in its free
coefficients, so `basis` gives the regressors of the fit and of the parameter covariance. The
curves of Golovach's paper are polynomials (equations 9 and 10).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from ..quantities import QUANTITIES
from ..typing import Floats
from .schema import broken

#: A temperature difference [K], or an array of temperature differences.
Kelvins: TypeAlias = float | Floats

#: Length of the tangent that continues a curve beyond its range / width of the range. Over this
#: length a parabola departs from the tangent by 1/16 of its departure over a whole range.
TANGENT_SPANS = 0.25
#: Largest accepted error of a function's value (0 or 1) at the reference temperature.
NORMALISATION_TOLERANCE = 1e-9
#: Smallest distance between a spline's knots, and largest distance of a knot from the reference
#: temperature [K]; numbers far beyond these limits would make the spline overflow.
_KNOT_STEP = 1e-3
_FARTHEST_KNOT = 2000.0


def hold(value: Floats, lower: npt.ArrayLike, upper: npt.ArrayLike) -> Floats:
    """Limit values to the range from `lower` to `upper`."""
    return np.asarray(np.minimum(np.maximum(value, lower), upper))


def by_element(function: Callable[[float], float], x: Kelvins) -> Floats:
    """Apply a function to each number, as numpy's rounding may depend on the array's length."""
    return np.array([function(v) for v in np.ravel(x).tolist()]).reshape(np.shape(x))


class _Family(ABC):
    """The interface of all families of functions of temperature."""

    @property
    @abstractmethod
    def free_coefficients(self) -> tuple[float, ...]:
        """The free coefficients of the function, in the order of `basis`."""

    @property
    def n_free(self) -> int:
        """Number of free coefficients of the function."""
        return len(self.free_coefficients)

    def value(self, t: Kelvins) -> Floats:
        """Evaluate the function at `t` [K]."""
        return self._evaluate(np.asarray(t))

    def slope(self, t: Kelvins) -> Floats:
        """Evaluate the derivative of the function at `t`, per K."""
        return self._evaluate(np.asarray(t), is_slope=True)

    @abstractmethod
    def _evaluate(self, t: Floats, *, is_slope: bool = False) -> Floats: ...


@dataclass(frozen=True)
class Polynomial(_Family):
    """
    A polynomial ``c[0] + c[1] t + c[2] t^2 + ...`` of t, the board less the reference temperature
    [K]; c[0] is 0 for a bias, 1 for a scale (equation 10 of Golovach's paper).
    """

    coefficients: Annotated[tuple[float, ...], QUANTITIES['coefficients']]
    kind: Literal['polynomial'] = 'polynomial'

    def __post_init__(self) -> None:
        if not self.coefficients:
            raise ValueError('`coefficients` must hold at least the value at t = 0')

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """All coefficients of the polynomial except the value at the reference temperature."""
        return self.coefficients[1:]

    def with_free(self, values: tuple[float, ...], at_reference: float) -> Polynomial:
        """Return a polynomial with the coefficients `at_reference` and `values`."""
        return replace(self, coefficients=(at_reference, *values))

    def _evaluate(self, t: Floats, *, is_slope: bool = False) -> Floats:
        coefficients = self._slopes if is_slope else self.coefficients
        result = t * 0.0 + coefficients[-1]
        for coefficient in coefficients[-2::-1]:
            result = result * t + coefficient
        return np.asarray(result)

    @cached_property
    def _slopes(self) -> tuple[float, ...]:
        return tuple(k * c for k, c in enumerate(self.coefficients))[1:] or (0.0,)

    def basis(self, t: Kelvins) -> list[Floats]:
        """Evaluate the derivatives of the polynomial w.r.t. its free coefficients: t, t^2, ..."""
        return list(np.multiply.accumulate([np.asarray(t)] * self.n_free)) if self.n_free else []


@dataclass(frozen=True)
class CubicSpline(_Family):
    """
    Natural cubic spline through values at rising knots of t = T_board - T_ref [K]. The knot t = 0
    has the value 0 (bias) or 1 (scale). Beyond the outer knots the spline is constant.
    """

    knots_k: Annotated[tuple[float, ...], QUANTITIES['knots']]
    values: tuple[float, ...]
    kind: Literal['spline'] = 'spline'

    def __post_init__(self) -> None:
        if len(self.knots_k) < 3:
            raise broken('knots_k', 'hold at least 3 knots', len(self.knots_k))
        if len(self.values) != len(self.knots_k):
            rule = f'have one number per knot ({len(self.knots_k)})'
            raise broken('values', rule, len(self.values))
        if any(b - a < _KNOT_STEP for a, b in zip(self.knots_k, self.knots_k[1:], strict=False)):
            raise ValueError(f'`knots_k` must rise strictly, by {_KNOT_STEP} K or more')
        if max(map(abs, self.knots_k)) > _FARTHEST_KNOT:
            raise ValueError(f'`knots_k` must lie within {_FARTHEST_KNOT:g} K of t = 0')
        if 0.0 not in self.knots_k:
            raise ValueError('`knots_k` must contain 0, the reference temperature')

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """Values of the spline at all knots except t = 0, less the value at t = 0."""
        at = self.knots_k.index(0.0)
        return tuple(v - self.values[at] for v in self.values[:at] + self.values[at + 1 :])

    def with_free(self, values: tuple[float, ...], at_reference: float) -> CubicSpline:
        """Return a spline: `at_reference` at t = 0, plus `values` at the other knots."""
        at = self.knots_k.index(0.0)
        moved = (*values[:at], 0.0, *values[at:])
        return replace(self, values=tuple(at_reference + v for v in moved))

    @cached_property
    def _pieces(self) -> Floats:
        return _natural_pieces(self.knots_k, self.values)

    @cached_property
    def _cardinal_pieces(self) -> list[Floats]:
        units = zip(self.knots_k, np.eye(len(self.knots_k)), strict=True)
        return [_natural_pieces(self.knots_k, unit) for knot, unit in units if knot]

    def _evaluate(self, t: Floats, *, is_slope: bool = False) -> Floats:
        return self._along(self._pieces, t, is_slope=is_slope)

    def basis(self, t: Kelvins) -> list[Floats]:
        """Evaluate the derivatives w.r.t. the free coefficients, which are cardinal splines."""
        return [self._along(pieces, np.asarray(t)) for pieces in self._cardinal_pieces]

    def _along(self, pieces: Floats, t: Floats, *, is_slope: bool = False) -> Floats:
        knots = np.array(self.knots_k)
        held = hold(t, knots[0], knots[-1])
        where = np.clip(np.searchsorted(knots, held, side='right') - 1, 0, len(knots) - 2)
        h, (a, b, c, d) = held - knots[where], pieces[:, where]
        if is_slope:
            return np.asarray((3.0 * d * h + 2.0 * c) * h + b)
        return np.asarray(((d * h + c) * h + b) * h + a)


@dataclass(frozen=True)
class Exponential(_Family):
    """
    A sum ``constant + sum_j amplitudes[j] exp(t / e_fold_k[j])``, with t the board less the
    reference temperature. The value at t = 0 is 0 (bias) or 1 (scale). An e-fold [K], of any sign,
    is the change of temperature that multiplies a term by e.
    """

    constant: float
    amplitudes: Annotated[tuple[float, ...], QUANTITIES['coefficients']]
    e_fold_k: tuple[float, ...]
    kind: Literal['exponential'] = 'exponential'

    def __post_init__(self) -> None:
        if not self.amplitudes:
            raise ValueError('`amplitudes` must hold at least one number')
        if len(self.amplitudes) != len(self.e_fold_k):
            rule = f'have one number per amplitude ({len(self.amplitudes)})'
            raise broken('e_fold_k', rule, len(self.e_fold_k))
        if any(abs(e_fold) < 1.0 for e_fold in self.e_fold_k):
            # With a shorter e-fold exp(t / e_fold) may overflow within a useful range of t.
            raise ValueError('`e_fold_k` must be at least 1 K in magnitude')

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """The amplitudes of the exponentials, whose e-folds are fixed."""
        return self.amplitudes

    def with_free(self, values: tuple[float, ...], at_reference: float) -> Exponential:
        """Return a sum of exponentials with the amplitudes `values` and the same e-folds."""
        return replace(self, constant=at_reference - math.fsum(values), amplitudes=values)

    def _evaluate(self, t: Floats, *, is_slope: bool = False) -> Floats:
        result = t * 0.0 + (0.0 if is_slope else self.constant)
        for amplitude, e_fold in zip(self.amplitudes, self.e_fold_k, strict=True):
            factor = amplitude / e_fold if is_slope else amplitude
            result = result + factor * by_element(math.exp, t / e_fold)
        return np.asarray(result)

    def basis(self, t: Kelvins) -> list[Floats]:
        """Evaluate the derivatives w.r.t. the amplitudes, with the value at t = 0 held fixed."""
        return [by_element(math.exp, t / e_fold) - 1.0 for e_fold in self.e_fold_k]


#: A function of temperature of any of the three families.
TemperatureFunction = Polynomial | CubicSpline | Exponential


def check_reference(name: str, function: TemperatureFunction, expected: float) -> None:
    """Raise ValueError if a function is not `expected` at t = 0; `name`: key of the function."""
    with np.errstate(all='ignore'):
        value = function.value(0.0)
    if not abs(value - expected) <= NORMALISATION_TOLERANCE:
        raise broken(name, f'be {expected:g} at t = 0 (T_ref)', float(value))


def basis_slopes(function: TemperatureFunction, t: float) -> list[float]:
    """Return the derivatives over temperature [per K] of the basis of a function at `t` [K]."""
    units = np.eye(function.n_free).tolist()
    return [float(function.with_free(tuple(unit), 0.0).slope(t)) for unit in units]


def _natural_pieces(knots: npt.ArrayLike, values: npt.ArrayLike) -> Floats:
    """Return a spline's a, b, c, d in ``a + b h + c h^2 + d h^3``, h: t less the left knot."""
    # The tridiagonal system of the spline is solved with numpy: the node must not import scipy.
    y, h = np.asarray(values), np.diff(np.asarray(knots))
    slopes = np.diff(y) / h
    n = len(y)
    matrix = np.eye(n)
    right = np.zeros(n)
    for i in range(1, n - 1):
        matrix[i, i - 1 : i + 2] = h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]
        right[i] = 6.0 * (slopes[i] - slopes[i - 1])
    curvature = np.linalg.solve(matrix, right)
    b = slopes - h * (2.0 * curvature[:-1] + curvature[1:]) / 6.0
    return np.array([y[:-1], b, curvature[:-1] / 2.0, np.diff(curvature) / (6.0 * h)])


def in_order(values: Floats, axis: int) -> Floats:
    """Sum along an axis from first to last, whatever the size of the other axes."""
    values = np.ascontiguousarray(values)
    if not values.shape[axis] or math.prod(values.shape[axis + 1 :]) > 1:
        return np.asarray(values.sum(axis=axis))
    # Along the innermost axis the order of additions in numpy's `sum` depends on the length.
    total: Floats = np.add.accumulate(values, axis=axis).take(-1, axis)
    return total
