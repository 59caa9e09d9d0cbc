# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the log Bayes factors of columns, and the contribution of each group of columns to a fit.

References
----------
.. [1] J. M. Dickey, The weighted likelihood ratio, linear hypotheses on normal location
   parameters, Annals of Mathematical Statistics 42 (1971).

"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..typing import Floats, Ints
from ..unit.provenance import GroupEvidence
from .equations import as_vector
from .regression import Posterior, Regression
from .unknowns import Prior


def log_bayes_factors(mode: Floats, covariance: Floats, places: Ints, prior_sd: Floats) -> Floats:
    """
    Return the loss of log evidence if some weights are set to 0 (Savage-Dickey ratio, [1]_).

    `places`: places of the weights of each of n cases, shape (n, k); `prior_sd`: (n,) or (n, k)
    """
    means = mode[places]
    blocks = covariance[places[:, :, None], places[:, None, :]]
    root = np.sqrt(np.einsum('nii->ni', blocks))
    values, vectors = np.linalg.eigh(blocks / (root[:, :, None] * root[:, None, :]))
    values = np.maximum(values, 1e-12)
    along = np.einsum('nij,ni->nj', vectors, means / root)
    determinant = np.log(values).sum(axis=1) + 2.0 * np.log(root).sum(axis=1)
    sd = np.broadcast_to(prior_sd if prior_sd.ndim > 1 else prior_sd[:, None], means.shape)
    square = np.sum(along**2 / values, axis=1)
    return np.asarray(0.5 * (square + determinant) - np.log(sd).sum(axis=1))


def group_evidence(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[GroupEvidence, ...]:
    """Return RMS contribution, effective parameters and log Bayes factor of each group in use."""
    names = np.array(regression.windows.groups)
    state, layout = posterior.state, posterior.layout
    mode = as_vector(state, layout)[: layout.n_unit]
    force = (regression.norms(state)[:, None] * state.up)[regression.windows.position]
    effective = posterior.effective_parameters
    parts: tuple[Literal['bias', 'scale'], ...] = ('bias', 'scale')
    result = []
    for k, part in enumerate(parts):
        for group in dict.fromkeys(regression.windows.groups):
            used = (names == group) & (prior.column_sd[k] > 0.0)
            if not used.any():
                continue
            added = regression.columns[:, used] @ state.weights[k][:, used].T
            if part == 'scale':
                added = added * force
            places, sd = layout.weights[k][:, used].ravel(), prior.column_sd[k][used]
            each = regression.weight_sd(prior)[k][:, used].ravel()
            (gain,) = log_bayes_factors(mode, posterior.covariance, places[None], each[None])
            result.append(
                GroupEvidence(
                    group,
                    part,
                    float(np.sqrt(np.mean(added**2))),
                    max(float(effective[k][used].sum()), 0.0),
                    float(gain),
                    tuple(sd.tolist()),
                )
            )
    return tuple(result)
