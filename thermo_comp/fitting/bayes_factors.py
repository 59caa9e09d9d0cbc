# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a fit says of its groups of columns: what each explains, spends and gains in evidence.

References
----------
.. [1] J. M. Dickey, The weighted likelihood ratio, linear hypotheses on normal location
   parameters, Annals of Mathematical Statistics 42 (1971).

"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..typing import Floats, Ints
from ..unit.calibration import GroupEvidence
from .equations import as_vector
from .regression import Posterior, Regression
from .unknowns import Prior


def log_bayes_factor(
    mode: Floats, covariance: Floats, places: Ints, prior_sd: float | Floats
) -> float:
    """Fall of the log evidence when some weights are held at 0 (Savage-Dickey ratio, [1]_)."""
    mode, covariance = mode[places], covariance[np.ix_(places, places)]
    root = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(root, root))
    values = np.maximum(values, 1e-12)
    along = vectors.T @ (mode / root)
    determinant = float(np.log(values).sum() + 2.0 * np.log(root).sum())
    known = float(np.sum(np.log(np.broadcast_to(prior_sd, mode.shape))))
    return 0.5 * float(np.sum(along**2 / values)) + 0.5 * determinant - known


def group_evidence(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[GroupEvidence, ...]:
    """Say what each group of columns in use explains, spends and gains."""
    names = np.array(regression.windows.groups)
    state, layout = posterior.state, posterior.layout
    mode = as_vector(state, layout)[: layout.n_unit]
    force = regression.gravity * state.up[regression.windows.position]
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
            places, sd = layout.weights[k][:, used], prior.column_sd[k][used]
            result.append(
                GroupEvidence(
                    group,
                    part,
                    float(np.sqrt(np.mean(added**2))),
                    max(float(effective[k][used].sum()), 0.0),
                    log_bayes_factor(mode, posterior.covariance, places.ravel(), np.tile(sd, 3)),
                    tuple(sd.tolist()),
                )
            )
    return tuple(result)
