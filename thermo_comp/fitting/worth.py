# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what columns are worth: what they explain, what the data tell of them, what they earn.

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


def told_of(posterior: Posterior, part: str) -> Floats:
    """Effective parameters of each column, of all axes; 0 for those without a part, shape (m,)."""
    places = places_of(posterior, part)
    told = np.append(posterior.told, 0.0)
    return np.asarray(np.where(places >= 0, told[places], 0.0).sum(axis=0))


def places_of(posterior: Posterior, part: str) -> Ints:
    """Return the places of the weights of a part, shape (3, m); -1 for columns without one."""
    return posterior.layout.on_bias if part == 'bias' else posterior.layout.on_scale


def widths_of(prior: Prior, part: str) -> Floats:
    """Return the widths of a part, shape (m,)."""
    return prior.on_bias if part == 'bias' else prior.on_scale


def mode_of(posterior: Posterior) -> Floats:
    """Return the weights of all columns at their places among what belongs to the unit."""
    layout, state = posterior.layout, posterior.state
    vector = np.zeros(layout.n + 1)
    vector[layout.on_bias] = state.on_bias
    vector[layout.on_scale] = state.on_scale
    return vector[: layout.n_unit]


def earned(mode: Floats, covariance: Floats, places: Ints, sd: float | Floats) -> float:
    """
    How much the log evidence falls when some weights are held at 0 (Savage-Dickey).

    `mode`, `covariance`: of what belongs to the unit. `places`: their places, shape (k,). `sd`:
    their prior, shape (k,).
    """
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
    mode = mode_of(posterior)
    force = regression.gravity * posterior.state.up[regression.windows.position]
    result = []
    parts: tuple[Literal['bias', 'scale'], ...] = ('bias', 'scale')
    for part in parts:
        weights = posterior.state.on_bias if part == 'bias' else posterior.state.on_scale
        sd, told = widths_of(prior, part), told_of(posterior, part)
        for group in dict.fromkeys(regression.windows.groups):
            used = (names == group) & (sd > 0.0)
            if not used.any():
                continue
            added = columns[:, used] @ weights[:, used].T
            if part == 'scale':
                added = added * force
            places = places_of(posterior, part)[:, used]
            result.append(
                GroupEvidence(
                    group,
                    part,
                    float(np.sqrt(np.mean(added**2))),
                    max(float(told[used].sum()), 0.0),
                    earned(mode, posterior.covariance, places.ravel(), np.tile(sd[used], 3)),
                    tuple(float(value) for value in sd[used]),
                )
            )
    return tuple(result)
