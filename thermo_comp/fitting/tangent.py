# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the linearised measurement equation, and the normal equations of each position and axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Floats, Ints


@dataclass(frozen=True)
class Tangent:
    """
    The equations linearised about a state, as coefficients of the base series at this state.

    Most derivatives are one base series times a factor; the others are one of a few combinations
    of them. The derivative of axis i in position p by unknown u is ``factor[p, i, u]`` times the
    series ``place[u]``, in the order base series, combinations. The unknowns of an axis are those
    of the position: up (2), stretch, offset, tilts; of the bag: initial lag states; of the unit:
    kappa, bias, weights, nonlinear coefficients, radius, misalignment (3). The last "unknown" is
    the residual, measured minus predicted.

    combined: the combinations, shape (n_positions, 3, n_base, n_combined)
    place: series of each unknown, shape (k + 1,)
    factor: shape (n_positions, 3, k + 1)
    """

    combined: Floats
    place: Ints
    factor: Floats

    def normal(self, products: Floats) -> Floats:
        """
        Return the normal equations of each position and axis, without any prior.

        `products`: of the base series at the state, shape (n_positions, n_base, n_base). In the
        result, shape (n_positions, 3, k + 1, k + 1), the last column is the gradient, and its last
        element the sum of squares of the residuals.
        """
        n = products.shape[-1]
        turned = products[:, None] @ self.combined
        size = n + turned.shape[-1]
        every = np.empty((*turned.shape[:2], size, size))
        every[..., :n, :n] = products[:, None]
        every[..., :n, n:] = turned
        every[..., n:, :n] = np.swapaxes(turned, 2, 3)
        every[..., n:, n:] = np.swapaxes(self.combined, 2, 3) @ turned
        # A flat index is several times faster than one of rows and columns.
        flat = (self.place[:, None] * size + self.place).ravel()
        taken = every.reshape(-1, size * size).take(flat, axis=1)
        result = taken.reshape(*self.factor.shape, len(self.place))
        result *= self.factor[..., :, None]
        result *= self.factor[..., None, :]
        return np.asarray(result)

    def of(self, rows: Floats) -> Floats:
        """
        Apply the derivatives to linear functions of the base series, such as their means, shape
        (n_positions, m, n_base); return their derivatives, shape (n_positions, 3, m, k + 1).
        """
        combined = rows[:, None] @ self.combined
        own = np.broadcast_to(rows[:, None], (*combined.shape[:3], rows.shape[2]))
        every = np.concatenate((own, combined), axis=3)
        return np.asarray(every[..., self.place] * self.factor[:, :, None])
