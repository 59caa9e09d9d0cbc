# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the limits of a calibration's bias and scale over its temperatures, relative to full scale.

A bias is within the converter's range, so level and curve stay within twice the full scale. The
largest value of a column, and the uncertainty, stay within a million times that: far beyond any
instrument, and without overflow.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..quantities import QUANTITIES
from ..typing import Floats
from .columns import Column
from .functions import TANGENT_SPANS, TemperatureFunction
from .posterior import Block, Posterior

#: Limits of a relative scale function, with every term at its largest.
SMALLEST_RELATIVE_SCALE, LARGEST_RELATIVE_SCALE = 0.1, 10.0
#: Largest bias / full scale: samples in an offset code have a bias of half their range.
FULL_SCALES = 2.0
#: Largest effect of a column or of a parameter's uncertainty / largest bias.
WORST = 1e6
#: Number of temperatures at which a function is checked.
_GRID = 513
#: Distance beyond its range in which a function is checked.
_AROUND = f'and along its tangents, {TANGENT_SPANS:g} of the range on each side'
_DIFFERENCE_K = QUANTITIES['temperature span'].at_most or 0.0
_RATE_K_S = (QUANTITIES['temperature rate'].at_most or 0.0) / 60.0


@dataclass(frozen=True)
class Term:
    """A column with its weights on the bias and on the relative scale of the three axes."""

    column: Column
    bias: Sequence[float]
    scale: Sequence[float]

    def largest(self, farthest_k: float) -> float:
        """Return the largest value of the column within `farthest_k` [K] of the reference."""
        column = self.column
        physical = {'gradient_even': 1.0, 'rate': _RATE_K_S}.get(
            column.kind, (_DIFFERENCE_K + abs(column.rest_k)) ** column.order
        )
        return min(max(map(abs, column.range)), physical) * float(farthest_k) ** column.power


class Reach:
    """The temperature range of a set relative to the reference, and the largest bias allowed."""

    def __init__(
        self, range_c: tuple[float, float], edges_c: Sequence[float], reference: float, most: float
    ) -> None:
        self._t = np.linspace(*range_c, _GRID) - reference
        self._beyond_k = TANGENT_SPANS * (range_c[1] - range_c[0])
        self._farthest_k = max(abs(edge - reference) for edge in edges_c)
        self._most = most

    def check_bias(self, key: str, level: float, function: TemperatureFunction) -> None:
        """Raise ValueError if level and curve exceed the largest bias."""
        if abs(level) > self._most:
            raise ValueError(
                f'`{key}.delta` must leave a bias within {self._most:g}, got {level:g}'
            )
        least, largest = self._extremes(function)
        if not math.isfinite(largest - least):
            raise ValueError(f'`{key}.bias_function` must be finite over its range {_AROUND}')
        if max(-least, largest) > self._most:
            reached = largest if largest > -least else least
            raise ValueError(
                f'`{key}.bias_function` must stay within {self._most:g} over its range '
                f'{_AROUND}, reaches {reached:g}'
            )

    def check_scale(self, key: str, function: TemperatureFunction, lost: float) -> None:
        """Raise ValueError if a relative scale, less or plus `lost`, leaves its limits."""
        least, largest = self._extremes(function)
        if not least - lost > SMALLEST_RELATIVE_SCALE:
            raise ValueError(
                f'`{key}.scale_function` must stay above {SMALLEST_RELATIVE_SCALE:g} over its '
                f'ranges {_AROUND}, reaches {least - lost:.4g}'
            )
        if not largest + lost < LARGEST_RELATIVE_SCALE:
            raise ValueError(
                f'`{key}.scale_function` must stay below {LARGEST_RELATIVE_SCALE:g} over its '
                f'ranges {_AROUND}, reaches {largest + lost:.4g}'
            )

    def check_terms(self, key: str, terms: Sequence[Term]) -> None:
        """Raise ValueError if the largest effect of a column exceeds its limit."""
        for k, term in enumerate(terms):
            largest = term.largest(self._farthest_k) * max(map(abs, term.bias))
            if not largest <= WORST * self._most:
                raise ValueError(
                    f'`{key}[{k}].bias` must make a bias within {WORST * self._most:g} of its '
                    f'column, makes {largest:g}'
                )

    def losses(self, terms: Sequence[Term], regime: str) -> list[float]:
        """Return the largest change of each axis' relative scale by the columns of a regime."""
        active = [term for term in terms if term.column.during in ('always', regime)]
        with np.errstate(over='ignore'):
            lost = [np.abs(term.scale) * term.largest(self._farthest_k) for term in active]
            total: list[float] = np.sum([np.zeros(3), *lost], axis=0).tolist()
        return total

    def _extremes(self, function: TemperatureFunction) -> tuple[float, float]:
        try:
            with np.errstate(all='ignore'):
                values = function.value(self._t)
                slopes = function.slope(self._t[[0, -1]])
                # The curve goes on along its tangents.
                ends = values[[0, -1]] + slopes * np.array([-self._beyond_k, self._beyond_k])
                values = np.append(values, ends)
        except OverflowError:
            return -math.inf, math.inf
        if not np.isfinite(values).all():
            return -math.inf, math.inf
        return float(np.min(values)), float(np.max(values))


def check_posterior(
    key: str,
    posterior: Posterior,
    blocks: Sequence[tuple[Block, tuple[TemperatureFunction, TemperatureFunction], float]],
    edges: tuple[Sequence[float], Sequence[float]],
    terms: Sequence[Term],
) -> None:
    """
    Raise ValueError if the effect of a parameter's sd exceeds `WORST` times its bound.

    Each block comes with its functions and bound; `edges` are those of the static and the dynamic
    set, relative to the reference [K].
    """
    variances = (posterior.matrix**2).sum(axis=1) + posterior.variances
    farthest_k = max(abs(edge) for pair in edges for edge in pair)
    largest = [term.largest(farthest_k) for term in terms]
    for block, functions, most in blocks:
        felt = np.array([*_regressors(functions, edges), *largest])
        sd = np.sqrt(variances[block.static : block.end]) * felt
        if not (sd <= WORST * most).all():
            raise ValueError(
                f'`{key}` must keep the effect of every standard deviation below '
                f'{WORST * most:g}, got {sd.max():g}'
            )


def _regressors(
    functions: tuple[TemperatureFunction, TemperatureFunction],
    edges: tuple[Sequence[float], Sequence[float]],
) -> Iterator[float]:
    for function, set_edges in zip(functions, edges, strict=True):
        yield 1.0
        basis: list[Floats] = function.basis(np.array(set_edges))
        yield from (float(np.abs(values).max()) for values in basis)
