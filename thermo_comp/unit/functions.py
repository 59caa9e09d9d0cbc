# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a function of temperature: polynomial, cubic spline or exponential, normalised at t = 0.

Every function takes ``t = T_board - T_ref`` [K], as one float or as an array, and gives the
same bits for both: only ``+ - * /`` in a fixed order are used, and `math.exp` element by
element. Each is linear in its free coefficients, so `basis` gives both the regressors of the
fit and the derivatives that carry the parameter covariance (Eq. (9) and (10) of the paper, which
asks for polynomials, splines and exponentials).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np

from ..typing import Floats

#: One float, or an array of them: what every evaluation here maps onto itself.
Number = TypeVar('Number', float, Floats)

#: How exactly a function must meet its value at the reference.
NORMALISATION_TOLERANCE = 1e-9
#: Knots of any use [K]; what is closer or farther away overflows.
_KNOT_STEP = 1e-3
_FARTHEST_KNOT = 2000.0


def hold(value: Number, lower: float, upper: float) -> Number:
    """Hold a value at the edges of a range, given in its unit."""
    if isinstance(value, np.ndarray):
        return np.minimum(np.maximum(value, lower), upper)
    return lower if value < lower else upper if value > upper else value


@dataclass(frozen=True)
class Polynomial:
    """
    ``c[0] + c[1] t + c[2] t^2 + ...`` (Eq. (10), with the leading constant where it belongs).

    coefficients: by rising power; the first is the value at the reference: 0 for a bias function,
        1 for a scale function. Unit of the function per K^power

    Raises ValueError if there are no coefficients or one is not finite.
    """

    coefficients: tuple[float, ...]
    kind: Literal['polynomial'] = 'polynomial'

    def __post_init__(self) -> None:
        if not self.coefficients:
            raise ValueError('`coefficients` must hold at least the value at the reference')
        _check_finite('coefficients', self.coefficients)

    @property
    def n_free(self) -> int:
        """Number of free coefficients: all but the value at the reference."""
        return len(self.coefficients) - 1

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """The free coefficients, in the order of `basis`."""
        return self.coefficients[1:]

    def with_free(self, values: tuple[float, ...]) -> Polynomial:
        """Return the same function with other free coefficients."""
        return replace(self, coefficients=(self.coefficients[0], *values))

    def value(self, t: Number) -> Number:
        """Evaluate at `t` [K]."""
        result = t * 0.0 + self.coefficients[-1]
        for coefficient in reversed(self.coefficients[:-1]):
            result = result * t + coefficient
        return result

    def slope(self, t: Number) -> Number:
        """Evaluate the derivative at `t`, per K."""
        result = t * 0.0
        for power in range(len(self.coefficients) - 1, 0, -1):
            result = result * t + power * self.coefficients[power]
        return result

    def basis(self, t: Number) -> list[Number]:
        """Evaluate the derivatives with respect to the free coefficients: t, t^2, ..."""
        result: list[Number] = []
        power = t
        for _ in range(self.n_free):
            result.append(power)
            power = power * t
        return result


@dataclass(frozen=True)
class CubicSpline:
    """
    Natural cubic spline through values at knots, one of which is the reference (0 K).

    Outside the outermost knots the end value is held.

    knots_k: rising deviations from the reference temperature [K]; 0 is one of them
    values: the function at the knots; at knot 0 it is 0 (bias) or 1 (scale)

    Raises ValueError if there are fewer than three knots, they do not rise, 0 is missing, the
    lengths differ, or a number is not finite.
    """

    knots_k: tuple[float, ...]
    values: tuple[float, ...]
    kind: Literal['spline'] = 'spline'

    def __post_init__(self) -> None:
        if len(self.knots_k) < 3:
            raise ValueError(f'`knots_k` must hold at least 3 knots, got {len(self.knots_k)}')
        if len(self.values) != len(self.knots_k):
            raise ValueError(
                f'`values` must have one number per knot ({len(self.knots_k)}), '
                f'got {len(self.values)}'
            )
        _check_finite('knots_k', self.knots_k)
        _check_finite('values', self.values)
        if any(b - a < _KNOT_STEP for a, b in zip(self.knots_k, self.knots_k[1:], strict=False)):
            raise ValueError(f'`knots_k` must rise strictly, by {_KNOT_STEP} K or more')
        if max(map(abs, self.knots_k)) > _FARTHEST_KNOT:
            raise ValueError(f'`knots_k` must lie within {_FARTHEST_KNOT:g} K of the reference')
        if 0.0 not in self.knots_k:
            raise ValueError('`knots_k` must contain 0, the reference temperature')

    @property
    def n_free(self) -> int:
        """Number of free coefficients: the values at all knots but the reference."""
        return len(self.values) - 1

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """The free coefficients, in the order of `basis`."""
        at = self.knots_k.index(0.0)
        return self.values[:at] + self.values[at + 1 :]

    def with_free(self, values: tuple[float, ...]) -> CubicSpline:
        """Return the same knots with other free values."""
        at = self.knots_k.index(0.0)
        return replace(self, values=(*values[:at], self.values[at], *values[at:]))

    @cached_property
    def _pieces(self) -> list[tuple[float, ...]]:
        return _natural_pieces(self.knots_k, self.values)

    @cached_property
    def _cardinal_pieces(self) -> list[list[tuple[float, ...]]]:
        result = []
        for j, knot in enumerate(self.knots_k):
            if knot != 0.0:
                unit = tuple(1.0 if i == j else 0.0 for i in range(len(self.knots_k)))
                result.append(_natural_pieces(self.knots_k, unit))
        return result

    def value(self, t: Number) -> Number:
        """Evaluate at `t` [K]."""
        return self._evaluate(self._pieces, t, _cubic)

    def slope(self, t: Number) -> Number:
        """Evaluate the derivative at `t`, per K."""
        return self._evaluate(self._pieces, t, _cubic_slope)

    def basis(self, t: Number) -> list[Number]:
        """Evaluate the derivatives with respect to the free values: the cardinal splines."""
        return [self._evaluate(pieces, t, _cubic) for pieces in self._cardinal_pieces]

    def _evaluate(
        self,
        pieces: list[tuple[float, ...]],
        t: Number,
        form: Callable[[Number, Number, Number, Number, Number], Number],
    ) -> Number:
        knots = self.knots_k
        held = hold(t, knots[0], knots[-1])
        if isinstance(held, np.ndarray):
            where = np.clip(np.searchsorted(knots, held, side='right') - 1, 0, len(knots) - 2)
            table = np.array(pieces)[where]
            return form(
                held - np.array(knots)[where],
                table[..., 0],
                table[..., 1],
                table[..., 2],
                table[..., 3],
            )
        index = min(max(bisect_right(knots, held) - 1, 0), len(knots) - 2)
        return form(held - knots[index], *pieces[index])


@dataclass(frozen=True)
class Exponential:
    """
    ``constant + sum_j amplitudes[j] exp(t / e_fold_k[j])``.

    constant: together with the amplitudes it makes the value at the reference 0 (bias) or 1
        (scale)
    amplitudes: in the unit of the function
    e_fold_k: the temperature change that multiplies a term by e [K]; any sign, not 0

    Raises ValueError if there is no term, the lengths differ, an e-fold is 0, or a number is not
    finite.
    """

    constant: float
    amplitudes: tuple[float, ...]
    e_fold_k: tuple[float, ...]
    kind: Literal['exponential'] = 'exponential'

    def __post_init__(self) -> None:
        if not self.amplitudes:
            raise ValueError('`amplitudes` must hold at least one number')
        if len(self.amplitudes) != len(self.e_fold_k):
            raise ValueError(
                f'`e_fold_k` must have one number per amplitude ({len(self.amplitudes)}), '
                f'got {len(self.e_fold_k)}'
            )
        _check_finite('constant', (self.constant,))
        _check_finite('amplitudes', self.amplitudes)
        _check_finite('e_fold_k', self.e_fold_k)
        if any(abs(e_fold) < 1.0 for e_fold in self.e_fold_k):
            # Below 1 K the exponential overflows within any useful temperature range.
            raise ValueError('`e_fold_k` must be at least 1 K in magnitude')

    @property
    def n_free(self) -> int:
        """Number of free coefficients: the amplitudes (the e-folds give the shape)."""
        return len(self.amplitudes)

    @property
    def free_coefficients(self) -> tuple[float, ...]:
        """The free coefficients, in the order of `basis`."""
        return self.amplitudes

    def with_free(self, values: tuple[float, ...]) -> Exponential:
        """Return the same shape with other amplitudes and the same value at the reference."""
        at_reference = self.constant + math.fsum(self.amplitudes)
        return replace(self, constant=at_reference - math.fsum(values), amplitudes=values)

    def value(self, t: Number) -> Number:
        """Evaluate at `t` [K]."""
        result = t * 0.0 + self.constant
        for amplitude, e_fold in zip(self.amplitudes, self.e_fold_k, strict=True):
            result = result + amplitude * _exp(t / e_fold)
        return result

    def slope(self, t: Number) -> Number:
        """Evaluate the derivative at `t`, per K."""
        result = t * 0.0
        for amplitude, e_fold in zip(self.amplitudes, self.e_fold_k, strict=True):
            result = result + amplitude / e_fold * _exp(t / e_fold)
        return result

    def basis(self, t: Number) -> list[Number]:
        """Evaluate the derivatives with respect to the amplitudes at a fixed reference value."""
        return [_exp(t / e_fold) - 1.0 for e_fold in self.e_fold_k]


#: Any of the three families.
TemperatureFunction = Polynomial | CubicSpline | Exponential


def check_reference(name: str, function: TemperatureFunction, expected: float) -> None:
    """Raise ValueError, with the name of the key, if a function misses its value at 0 K."""
    with np.errstate(all='ignore'):
        value = function.value(0.0)
    if not abs(value - expected) <= NORMALISATION_TOLERANCE:
        raise ValueError(f'`{name}` must be {expected:g} at the reference, got {value:g}')


def _check_finite(name: str, values: tuple[float, ...]) -> None:
    for value in values:
        if not math.isfinite(value):
            raise ValueError(f'`{name}` must be finite, got {value}')


def _exp(x: Number) -> Number:
    """
    Exponentiate with the same bits for a float and for an array of them.

    numpy's vector exponential rounds differently from libm's in the last place.
    """
    if isinstance(x, np.ndarray):
        return np.array([math.exp(v) for v in x.ravel().tolist()]).reshape(x.shape)
    return math.exp(x)


def _cubic(h: Number, a: Number, b: Number, c: Number, d: Number) -> Number:
    return ((d * h + c) * h + b) * h + a


def _cubic_slope(h: Number, _a: Number, b: Number, c: Number, d: Number) -> Number:
    return (3.0 * d * h + 2.0 * c) * h + b


def _natural_pieces(
    knots: tuple[float, ...], values: tuple[float, ...]
) -> list[tuple[float, ...]]:
    """
    Coefficients of ``a + b h + c h^2 + d h^3`` on each interval, h from its left knot.

    The second derivatives at the knots solve the usual tridiagonal system with zeros at both
    ends. numpy serves: the node must not load an optimiser, which scipy's interpolation does.
    """
    x = np.array(knots)
    y = np.array(values)
    n = len(x)
    h = np.diff(x)
    slopes = np.diff(y) / h
    matrix = np.eye(n)
    right = np.zeros(n)
    for i in range(1, n - 1):
        matrix[i, i - 1 : i + 2] = h[i - 1], 2.0 * (h[i - 1] + h[i]), h[i]
        right[i] = 6.0 * (slopes[i] - slopes[i - 1])
    curvature = np.linalg.solve(matrix, right)
    b = slopes - h * (2.0 * curvature[:-1] + curvature[1:]) / 6.0
    pieces = np.column_stack((y[:-1], b, curvature[:-1] / 2.0, np.diff(curvature) / (6.0 * h)))
    return [tuple(row) for row in pieces.tolist()]
