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

    columns: the inactive columns, shape (k,)
    S: sparsity factor, information about their weights, shape (2 k 3, 2 k 3), in the order part
        (bias, scale), column, axis
    Q: quality factor, gradient by their weights, shape (2 k 3,)
    """

    columns: Ints
    S: Floats
    Q: Floats

    def gain(self, column_sd: Floats, wanted: Bools) -> float:
        """
        Return the gain in log evidence by the `wanted` columns, shape (m,).

        It is ``(q (1 + S)^-1 q - log det(1 + S)) / 2``, S and q in units of the columns' prior sd,
        shape (2, m), at the best common factor of this sd.
        """
        sd = column_sd[:, self.columns] * wanted[self.columns]
        sd = np.repeat(sd[..., None], 3, axis=2).ravel()
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
        k = len(self.columns)
        sd = column_sd[:, self.columns] * wanted[self.columns]
        sd = np.repeat(sd[..., None], 3, axis=2).ravel()
        S, Q = self.S * np.outer(sd, sd), self.Q * sd
        result = np.zeros_like(wanted)
        for _ in range(most):
            square = _FACTORS[:, None] ** 2
            s, q2 = square * np.maximum(np.diag(S), 0.0), square * Q**2
            each = 0.5 * (q2 / (1.0 + s) - np.log1p(s)).reshape(-1, 2, k, 3).sum(axis=(1, 3))
            part, best = np.unravel_index(int(np.argmax(each)), each.shape)
            if each[part, best] < least:
                break
            result[self.columns[best]] = True
            at = np.arange(2 * k * 3).reshape(2, k, 3)[:, best].ravel()
            at = at[sd[at] > 0.0]
            block = S[np.ix_(at, at)] + np.eye(len(at)) / _FACTORS[part] ** 2
            solved = np.linalg.solve(block, np.column_stack((S[at], Q[at])))
            S, Q = S - S[:, at] @ solved[:, :-1], Q - S[:, at] @ solved[:, -1]
            S[at], S[:, at], Q[at] = 0.0, 0.0, 0.0
        return result
