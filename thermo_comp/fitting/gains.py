# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the change of the log evidence of a fit if columns are removed or added.

References
----------
.. [1] J. M. Dickey, The weighted likelihood ratio, linear hypotheses on normal location
   parameters, Annals of Mathematical Statistics 42 (1971).
.. [2] M. E. Tipping, A. C. Faul, Fast marginal likelihood maximisation for sparse Bayesian models,
   AISTATS 2003.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats, Ints

# Squares of factors to try on the prior sd of new columns; the factor of largest gain is used.
_SQUARED_FACTORS = (10.0 ** np.arange(-4.0, 1.01, 0.25))[:, None] ** 2


def log_bayes_factors(mode: Floats, covariance: Floats, places: Ints, prior_sd: Floats) -> Floats:
    """
    Return the loss of log evidence if k weights are set to 0 (Savage-Dickey ratio, [1]_), for n
    choices of these weights, shape (n,).

    `places`, `prior_sd`: indices and prior sd of the weights in each choice, shape (n, k)
    """
    means = mode[places]
    blocks = covariance[places[:, :, None], places[:, None, :]]
    root = np.sqrt(np.einsum('nii->ni', blocks))
    values, vectors = np.linalg.eigh(blocks / (root[:, :, None] * root[:, None, :]))
    values = np.maximum(values, 1e-12)
    along = np.einsum('nij,ni->nj', vectors, means / root)
    determinant = np.log(values).sum(axis=1) + 2.0 * np.log(root).sum(axis=1)
    square = np.sum(along**2 / values, axis=1)
    return np.asarray(0.5 * (square + determinant) - np.log(prior_sd).sum(axis=1))


@dataclass(frozen=True)
class Inactive:
    """
    Sparsity and quality factors of inactive columns, given the active columns [2]_.

    part, column: part (0: bias, 1: scale) and column of each of k inactive columns, shape (k,)
    S: sparsity factor: information about the weights, ordered by column, then axis, (3 k, 3 k)
    Q: quality factor: gradient of the log likelihood w.r.t. the weights, shape (3 k,)
    """

    part: Ints
    column: Ints
    S: Floats
    Q: Floats

    def _in_prior_sd(self, column_sd: Floats, wanted: Bools) -> tuple[Floats, Floats, Ints]:
        """Return S, Q and column of each weight of `wanted` columns, for weights in prior sds."""
        sd = np.repeat(column_sd[self.part, self.column] * wanted[self.column], 3)
        at = np.flatnonzero(sd > 0.0)
        S = self.S[np.ix_(at, at)] * np.outer(sd[at], sd[at])
        return S, self.Q[at] * sd[at], np.repeat(self.column, 3)[at]

    def gain(self, column_sd: Floats, wanted: Bools) -> float:
        """
        Return the gain in log evidence, at least 0, if the columns in the mask `wanted`, (m,), are
        added: ``(Q (1 + S)^-1 Q - log det(1 + S)) / 2``, S and Q for weights in prior sds. A
        prior sd is `column_sd`, (2, m), times the factor of largest gain (`_SQUARED_FACTORS`).
        """
        S, Q, _ = self._in_prior_sd(column_sd, wanted)
        S, along = np.linalg.eigh(S)
        s, q2 = _SQUARED_FACTORS * np.maximum(S, 0.0), _SQUARED_FACTORS * (along.T @ Q) ** 2
        return 0.5 * float((q2 / (1.0 + s) - np.log1p(s)).sum(axis=1).max(initial=0.0))

    def chosen(self, column_sd: Floats, wanted: Bools, least: float, most: int) -> Bools:
        """
        Choose up to `most` columns from the mask `wanted`, (m,), by forward selection.

        Each step chooses the column with the largest gain in log evidence, given the columns
        already chosen; the selection ends when the largest gain is below `least`.
        """
        S, Q, column = self._in_prior_sd(column_sd, wanted)
        result = np.zeros_like(wanted)
        for _ in range(most if len(Q) else 0):
            s, q2 = _SQUARED_FACTORS * np.maximum(np.diag(S), 0.0), _SQUARED_FACTORS * Q**2
            gains = np.zeros((len(_SQUARED_FACTORS), len(wanted)))
            np.add.at(gains.T, column, 0.5 * (q2 / (1.0 + s) - np.log1p(s)).T)
            factor, best = np.unravel_index(int(np.argmax(gains)), gains.shape)
            if gains[factor, best] < least:
                break
            result[best] = True
            at = np.flatnonzero(column == best)
            block = S[np.ix_(at, at)] + np.eye(len(at)) / _SQUARED_FACTORS[factor]
            solved = np.linalg.solve(block, np.column_stack((S[at], Q[at])))
            S, Q = S - S[:, at] @ solved[:, :-1], Q - S[:, at] @ solved[:, -1]
            S[at], S[:, at], Q[at] = 0.0, 0.0, 0.0
        return result
