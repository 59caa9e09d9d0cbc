# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a fit says of its columns: what each group explains, spends and earns.

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
from .posterior import Posterior, Regression
from .unknowns import Prior


def told_of(posterior: Posterior) -> Floats:
    """Effective parameters of each column in bias and scale, of all axes, shape (2, m)."""
    return np.asarray(np.append(posterior.told, 0.0)[posterior.layout.weights].sum(axis=1))


def earned(mode: Floats, covariance: Floats, places: Ints, sd: float | Floats) -> float:
    """How much the log evidence falls when some weights are held at 0 (Savage-Dickey, [1]_)."""
    mode, covariance = mode[places], covariance[np.ix_(places, places)]
    root = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(root, root))
    values = np.maximum(values, 1e-12)
    along = vectors.T @ (mode / root)
    determinant = float(np.log(values).sum() + 2.0 * np.log(root).sum())
    known = float(np.sum(np.log(np.broadcast_to(sd, mode.shape))))
    return 0.5 * float(np.sum(along**2 / values)) + 0.5 * determinant - known


def group_worth(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[GroupEvidence, ...]:
    """Say what each group explains, spends and earns."""
    names = np.array(regression.windows.groups)
    columns = regression.windows.columns / regression.rms
    mode = regression.vector(posterior.state, posterior.layout)[: len(posterior.covariance)]
    force = regression.gravity * posterior.state.up[regression.windows.position]
    told = told_of(posterior)
    parts: tuple[Literal['bias', 'scale'], ...] = ('bias', 'scale')
    result = []
    for k, part in enumerate(parts):
        for group in dict.fromkeys(regression.windows.groups):
            used = (names == group) & (prior.widths[k] > 0.0)
            if not used.any():
                continue
            added = columns[:, used] @ posterior.state.weights[k][:, used].T
            if part == 'scale':
                added = added * force
            places, sd = posterior.layout.weights[k][:, used], prior.widths[k][used]
            result.append(
                GroupEvidence(
                    group,
                    part,
                    float(np.sqrt(np.mean(added**2))),
                    max(float(told[k][used].sum()), 0.0),
                    earned(mode, posterior.covariance, places.ravel(), np.tile(sd, 3)),
                    tuple(sd.tolist()),
                )
            )
    return tuple(result)
