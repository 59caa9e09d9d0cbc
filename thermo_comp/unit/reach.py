# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how far the parts of a calibration reach over its own temperatures and its own full scale.

A bias is a part of what the converter can tell, so level and curve stay within twice the full
scale; a column at its very worst, and what is uncertain of it, within a million times that, which
no instrument comes near and floating point still carries.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..quantities import QUANTITIES
from ..typing import Floats
from .columns import Column
from .functions import TANGENT_SPANS, TemperatureFunction
from .posterior import Block, Posterior

#: A scale function, with every term at its worst, stays within these parts of the reference.
SMALLEST_RELATIVE_SCALE, LARGEST_RELATIVE_SCALE = 0.1, 10.0
#: A bias stays within so many full scales: words with an offset have it at half their range.
FULL_SCALES = 2.0
#: What a column makes of a bias, or a parameter leaves open, stays within so many of those.
WORST = 1e6
#: At so many temperatures of its range a function is looked at.
_GRID = 513
#: How far beyond its range a function is looked at.
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
        """Give the largest value that the column can have, so far from the reference [K]."""
        column = self.column
        physical = {'even': 1.0, 'rate': _RATE_K_S}.get(
            column.kind, (_DIFFERENCE_K + abs(column.rest_k)) ** column.order
        )
        return min(max(map(abs, column.range)), physical) * float(farthest_k) ** column.power


class Reach:
    """The temperatures of a set, seen from the reference, and the largest bias there is."""

    def __init__(
        self, range_c: tuple[float, float], edges_c: Sequence[float], reference: float, most: float
    ) -> None:
        self._t = np.linspace(*range_c, _GRID) - reference
        self._beyond_k = TANGENT_SPANS * (range_c[1] - range_c[0])
        self._farthest_k = max(abs(edge - reference) for edge in edges_c)
        self._most = most

    def check_bias(self, key: str, level: float, function: TemperatureFunction) -> None:
        """Raise ValueError where level and curve leave what a bias can be."""
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
        """Raise ValueError where a relative scale, with so much more at its worst, is none."""
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
        """Raise ValueError where a column at its worst is more than any bias."""
        for k, term in enumerate(terms):
            largest = term.largest(self._farthest_k) * max(map(abs, term.bias))
            if not largest <= WORST * self._most:
                raise ValueError(
                    f'`{key}[{k}].bias` must make a bias within {WORST * self._most:g} of its '
                    f'column, makes {largest:g}'
                )

    def losses(self, terms: Sequence[Term], regime: str) -> list[float]:
        """Give what the columns of a regime may take off each axis' relative scale."""
        own = [one for one in terms if one.column.during in ('always', regime)]
        with np.errstate(over='ignore'):
            lost = [np.abs(one.scale) * one.largest(self._farthest_k) for one in own]
            found: list[float] = np.sum([np.zeros(3), *lost], axis=0).tolist()
        return found

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
    Raise ValueError where a parameter alone leaves more open than anybody can mean.

    Each block comes with its functions and with what bounds it; `edges` are the static and the
    dynamic set's, less the reference [K].
    """
    variances = (posterior.matrix**2).sum(axis=1) + posterior.variances
    farthest_k = max(abs(edge) for one in edges for edge in one)
    largest = [term.largest(farthest_k) for term in terms]
    for block, functions, most in blocks:
        felt = np.array([*_regressors(functions, edges), *largest])
        sd = np.sqrt(variances[block.static : block.end]) * felt
        if not (sd <= WORST * most).all():
            raise ValueError(
                f'`{key}` must leave no parameter more open than {WORST * most:g} at its worst, '
                f'leaves {sd.max():g}'
            )


def _regressors(
    functions: tuple[TemperatureFunction, TemperatureFunction],
    edges: tuple[Sequence[float], Sequence[float]],
) -> Iterator[float]:
    for function, own in zip(functions, edges, strict=True):
        yield 1.0
        basis: list[Floats] = function.basis(np.array(own))
        yield from (float(np.abs(values).max()) for values in basis)
