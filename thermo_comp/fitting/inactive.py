# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the score of inactive columns: the gain in log evidence if they joined the fit.

References
----------
.. [1] M. E. Tipping, A. C. Faul, Fast marginal likelihood maximisation for sparse Bayesian models,
   AISTATS 2003.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats, Ints

# Grid of the common factor of the columns' prior sd: the gain is that at the best factor.
_FACTORS = 10.0 ** np.arange(-4.0, 1.01, 0.25)


@dataclass(frozen=True)
class Inactive:
    """
    Sparsity and quality factors of inactive columns, given the active ones [1]_.

    part, column: part (0: bias, 1: scale) and column of each of k cases, shape (k,)
    S: sparsity factor, information about their weights, shape (3 k, 3 k), in the order case, axis
    Q: quality factor, gradient by their weights, shape (3 k,)
    """

    part: Ints
    column: Ints
    S: Floats
    Q: Floats

    def gain(self, column_sd: Floats, wanted: Bools) -> float:
        """
        Return the gain in log evidence by the `wanted` columns, shape (m,).

        It is ``(q (1 + S)^-1 q - log det(1 + S)) / 2``, S and q in units of the columns' prior sd,
        shape (2, m), at the best common factor of this sd.
        """
        sd = np.repeat(column_sd[self.part, self.column] * wanted[self.column], 3)
        at = np.flatnonzero(sd > 0.0)
        S, along = np.linalg.eigh(self.S[np.ix_(at, at)] * np.outer(sd[at], sd[at]))
        square = _FACTORS[:, None] ** 2
        S, q2 = square * np.maximum(S, 0.0), square * (along.T @ (sd[at] * self.Q[at])) ** 2
        return 0.5 * float((q2 / (1.0 + S) - np.log1p(S)).sum(axis=1).max(initial=0.0))

    def chosen(self, column_sd: Floats, wanted: Bools, least: float, most: int) -> Bools:
        """
        Choose `most` of the wanted columns at most, by forward selection, shape (m,).

        The next column is that with the largest gain in log evidence given those chosen before;
        the selection ends when this gain is below `least`.
        """
        sd = np.repeat(column_sd[self.part, self.column] * wanted[self.column], 3)
        at = np.flatnonzero(sd > 0.0)
        column = np.repeat(self.column, 3)[at]
        S, Q = self.S[np.ix_(at, at)] * np.outer(sd[at], sd[at]), self.Q[at] * sd[at]
        result = np.zeros_like(wanted)
        square = _FACTORS[:, None] ** 2
        for _ in range(most if len(at) else 0):
            s, q2 = square * np.maximum(np.diag(S), 0.0), square * Q**2
            each = np.zeros((len(square), len(wanted)))
            np.add.at(each.T, column, 0.5 * (q2 / (1.0 + s) - np.log1p(s)).T)
            factor, best = np.unravel_index(int(np.argmax(each)), each.shape)
            if each[factor, best] < least:
                break
            result[best] = True
            own = np.flatnonzero(column == best)
            block = S[np.ix_(own, own)] + np.eye(len(own)) / square[factor]
            solved = np.linalg.solve(block, np.column_stack((S[own], Q[own])))
            S, Q = S - S[:, own] @ solved[:, :-1], Q - S[:, own] @ solved[:, -1]
            S[own], S[:, own], Q[own] = 0.0, 0.0, 0.0
        return result
