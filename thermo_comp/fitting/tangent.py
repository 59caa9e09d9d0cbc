# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the linearised measurement equation, and the normal equations that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..typing import Floats, Ints


class Normal(NamedTuple):
    """
    Normal equations of each axis without the prior; the order of unknowns is that of `Tangent`.

    local: products of the derivatives w.r.t. the unknowns of positions and bags with all
        derivatives and the residual, shape (n_positions, 3, n_local, k + 1)
    unit: products of the derivatives w.r.t. the unknowns of the unit, and of the residual, with
        each other, summed over the positions, shape (3, n, n)
    """

    local: Floats
    unit: Floats

    def scaled(self, factor: Floats) -> Normal:
        """Multiply the normal equations of each axis by a factor, shape (3,)."""
        return Normal(self.local * factor[:, None, None], self.unit * factor[:, None, None])

    @property
    def square(self) -> Floats:
        """Sum of squares of the whitened residuals of each axis, shape (3,)."""
        return np.asarray(np.maximum(self.unit[:, -1, -1], 0.0))


@dataclass(frozen=True)
class Tangent:
    """
    The equations linearised about a state, as coefficients of the base series at this state.

    The derivative of the readings w.r.t. an unknown is a factor times a base series, or times one
    of the combinations `combined` of base series. For axis i, position p and unknown u the
    derivative is ``factor[p, i, u]`` times the series of index ``place[u]``; combinations are
    counted after the base series. The unknowns of an axis are those of the position (2 of the
    attitude, stretch, offset, tilts), then those of the bag (initial lag states, turn-on offset),
    then those of the unit (kappa, bias, weights, nonlinear coefficients, radius, 3 of the
    misalignment, 2 of each pose). The last place is for the residual, measured minus predicted.

    combined: the combinations of base series, shape (n_positions, 3, n_base, n_combined)
    place: index of the series of each unknown, shape (k + 1,)
    factor: factor of the series of each unknown, shape (n_positions, 3, k + 1)
    n_local: number of unknowns of position and bag
    n_bias: number of unknowns after kappa that have the factor 1: the bias and its weights
    n_scale: number of weights of the scale, which follow the weights of the bias
    scale: factor of the weights of the scale, shape (n_positions, 3)
    """

    combined: Floats
    place: Ints
    factor: Floats
    n_local: int
    n_bias: int
    n_scale: int
    scale: Floats

    def normal(self, products: Floats) -> Normal:
        """Return the normal equations; products of base series: (n_positions, n_base, n_base)."""
        first, with_combined = self.n_local, products[:, None] @ self.combined
        place = self.place[first:]
        n, bias = len(place), slice(1, 1 + self.n_bias)
        scale = slice(bias.stop, bias.stop + self.n_scale)
        # Sums over the positions of the products of the base series, times the powers 0, 1 and 2
        # of the factor of the scale's weights.
        powers = np.stack([self.scale**k for k in range(3)])
        sums = np.tensordot(powers.transpose(2, 0, 1), products, 1)
        unit = np.empty((3, n, n))
        for rows, columns, k in ((bias, bias, 0), (bias, scale, 1), (scale, scale, 2)):
            block = sums[:, k, place[rows, None], place[columns]]
            unit[:, rows, columns] = block
            unit[:, columns, rows] = np.swapaxes(block, 1, 2)
        others = np.array([0, *range(scale.stop, n)])
        rows_of = self._rows(np.append(np.arange(first), first + others), products, with_combined)
        of_others = rows_of[:, :, first:, first:].sum(axis=0)
        unit[:, others] = of_others
        unit[:, :, others] = np.swapaxes(of_others, 1, 2)
        return Normal(rows_of[:, :, :first], unit)

    def _rows(self, unknowns: Ints, products: Floats, with_combined: Floats) -> Floats:
        """Return the rows of the normal equations of m unknowns, (n_positions, 3, m, k + 1)."""
        n, series = products.shape[-1], self.place[unknowns]
        base, combined = np.flatnonzero(series < n), np.flatnonzero(series >= n)
        by_series = np.empty((*with_combined.shape[:2], len(series), n + with_combined.shape[-1]))
        of_combined = self.combined[..., series[combined] - n]
        by_series[:, :, base, :n] = products[:, None, series[base]]
        by_series[:, :, base, n:] = with_combined[:, :, series[base]]
        by_series[:, :, combined, :n] = np.swapaxes(with_combined[..., series[combined] - n], 2, 3)
        by_series[:, :, combined, n:] = np.swapaxes(of_combined, 2, 3) @ with_combined
        result = by_series.take(self.place, axis=3)
        result *= self.factor[:, :, unknowns, None]
        result *= self.factor[:, :, None]
        return np.asarray(result)

    def at(self, places: Ints) -> Tangent:
        """Return the equations of the positions `places`."""
        kept = {name: getattr(self, name)[places] for name in ('combined', 'factor', 'scale')}
        return replace(self, **kept)

    def of(self, rows: Floats) -> Floats:
        """
        Return the derivatives of m linear functions of the readings, such as the mean, shape
        (n_positions, 3, m, k + 1). `rows`: these functions of the base series, shape
        (n_positions, m, n_base)
        """
        combined = rows[:, None] @ self.combined
        of_base = np.broadcast_to(rows[:, None], (*combined.shape[:3], rows.shape[2]))
        by_series = np.concatenate((of_base, combined), axis=3)
        return np.asarray(by_series[..., self.place] * self.factor[:, :, None])
