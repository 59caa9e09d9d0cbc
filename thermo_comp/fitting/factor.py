# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the linear algebra of a step: a Hessian whose parts belong to the unit or to one bag."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..typing import Floats
from .unknowns import Layout

# Of a matrix of unit diagonal: what keeps it positive definite to the last digit.
JITTER = 1e-13
# Start states of neighbouring lags are told apart to fewer digits.
_START_JITTER = 1e-10


class Factor:
    """The Hessian, factored: what belongs to one bag alone is eliminated first."""

    def __init__(self, hessian: Floats, layout: Layout) -> None:
        n = layout.n_unit
        self._n, self._blocks = n, layout.blocks
        root = np.sqrt(np.diag(hessian))
        self._root = root
        scaled = hessian / np.outer(root, root)
        unit = scaled[:n, :n].copy()
        self.log_determinant = 2.0 * float(np.log(root).sum())
        self._locals = []
        jitter = np.full(len(hessian), JITTER)
        jitter[layout.start] = _START_JITTER
        for block in layout.blocks:
            factor = cho_factor(scaled[block, block] + np.diag(jitter[block]))
            cross = cho_solve(factor, scaled[block, :n])
            unit -= scaled[:n, block] @ cross
            self._locals.append((factor, cross))
            self.log_determinant += 2.0 * float(np.log(np.diag(factor[0])).sum())
        self._unit = cho_factor(unit + JITTER * np.eye(n))
        self.log_determinant += 2.0 * float(np.log(np.diag(self._unit[0])).sum())

    def solve(self, right: Floats) -> Floats:
        """Solve for one right side."""
        n = self._n
        right = right / self._root
        first = right[:n].copy()
        for block, (_, cross) in zip(self._blocks, self._locals, strict=True):
            first -= cross.T @ right[block]
        result = np.empty_like(right)
        result[:n] = cho_solve(self._unit, first)
        for block, (factor, cross) in zip(self._blocks, self._locals, strict=True):
            result[block] = cho_solve(factor, right[block]) - cross @ result[:n]
        return np.asarray(result / self._root)

    def covariances(self) -> tuple[Floats, list[Floats]]:
        """Covariance of what belongs to the unit, and of what belongs to each bag."""
        n, root = self._n, self._root
        unit = cho_solve(self._unit, np.eye(n))
        blocks = []
        for block, (factor, cross) in zip(self._blocks, self._locals, strict=True):
            alone = cho_solve(factor, np.eye(block.stop - block.start))
            both = alone + cross @ unit @ cross.T
            blocks.append(both / np.outer(root[block], root[block]))
        return unit / np.outer(root[:n], root[:n]), blocks
