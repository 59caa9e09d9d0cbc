# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the data say of columns that take no part in a fit: their gain, and a choice of some.

References
----------
.. [1] M. E. Tipping, A. C. Faul, Fast marginal likelihood maximisation for sparse Bayesian models,
   AISTATS 2003.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats, Ints

# Parts of their standard deviations in which columns that take no part are tried.
_PARTS = 10.0 ** np.arange(-4.0, 1.01, 0.25)


@dataclass(frozen=True)
class Inactive:
    """
    What the data say of columns that take no part, beside all that do: the sparsity and quality
    factors S and Q of sparse Bayesian learning (Tipping and Faul, 2003), as matrix and vector.

    columns: the columns asked for, shape (k,); S: shape (2 k 3, 2 k 3); Q: shape (2 k 3,), in the
    order part, column, axis
    """

    columns: Ints
    S: Floats
    Q: Floats

    def gain(self, column_sd: Floats, wanted: Bools) -> float:
        """
        Return what columns, shape (m,), would add to the log evidence in one part of their prior
        standard deviations, (2, m): ``(q (1 + S)^-1 q - log det(1 + S)) / 2`` in units of these.
        """
        sd = column_sd[:, self.columns] * wanted[self.columns]
        sd = np.repeat(sd[..., None], 3, axis=2).ravel()
        at = np.flatnonzero(sd > 0.0)
        S, along = np.linalg.eigh(self.S[np.ix_(at, at)] * np.outer(sd[at], sd[at]))
        square = _PARTS[:, None] ** 2
        S, q2 = square * np.maximum(S, 0.0), square * (along.T @ (sd[at] * self.Q[at])) ** 2
        return 0.5 * float((q2 / (1.0 + S) - np.log1p(S)).sum(axis=1).max(initial=0.0))

    def chosen(self, column_sd: Floats, wanted: Bools, least: float, most: int) -> Bools:
        """
        Choose some of the columns wanted, one after another: the one that adds most to the log
        evidence beside those before it in its prior standard deviation, as long as it adds more
        than `least`; shape (m,).
        """
        k = len(self.columns)
        sd = column_sd[:, self.columns] * wanted[self.columns]
        sd = np.repeat(sd[..., None], 3, axis=2).ravel()
        S, Q = self.S * np.outer(sd, sd), self.Q * sd
        result = np.zeros_like(wanted)
        for _ in range(most):
            square = _PARTS[:, None] ** 2
            s, q2 = square * np.maximum(np.diag(S), 0.0), square * Q**2
            each = 0.5 * (q2 / (1.0 + s) - np.log1p(s)).reshape(-1, 2, k, 3).sum(axis=(1, 3))
            part, best = np.unravel_index(int(np.argmax(each)), each.shape)
            if each[part, best] < least:
                break
            result[self.columns[best]] = True
            at = np.arange(2 * k * 3).reshape(2, k, 3)[:, best].ravel()
            at = at[sd[at] > 0.0]
            own = S[np.ix_(at, at)] + np.eye(len(at)) / _PARTS[part] ** 2
            solved = np.linalg.solve(own, np.column_stack((S[at], Q[at])))
            S, Q = S - S[:, at] @ solved[:, :-1], Q - S[:, at] @ solved[:, -1]
            S[at], S[:, at], Q[at] = 0.0, 0.0, 0.0
        return result
