# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns statistics of residuals, which are corrected less true force, or ``|f| - g``."""

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats, Ints


@dataclass(frozen=True)
class ResidualStatistics:
    """Number, mean, RMS and largest magnitude of finite residuals; NaN if there are none."""

    n: int
    mean: float
    rms: float
    peak: float


def residual_statistics(residual: Floats) -> ResidualStatistics:
    """Summarise residuals, shape (n,); residuals that are not finite are left out."""
    values = residual[np.isfinite(residual)]
    if not len(values):
        return ResidualStatistics(0, np.nan, np.nan, np.nan)
    rms, peak = float(np.sqrt(np.mean(values**2))), float(np.max(np.abs(values)))
    return ResidualStatistics(len(values), float(values.mean()), rms, peak)


def norm_residual(specific_force: Floats, gravity: float | Floats) -> Floats:
    """Return ``|f| - g`` of forces, shape (..., 3); `gravity`: the true |f| [m/s^2]."""
    square = np.einsum('...i,...i->...', specific_force, specific_force)
    return np.asarray(np.sqrt(square) - gravity)


def means_by(labels: Ints, values: Floats, weight: Floats | None = None) -> Floats:
    """Return the weighted mean of the `values`, (n, ...), with each label, in order of labels."""
    weight = np.ones(len(labels)) if weight is None else weight
    _, place = np.unique(labels, return_inverse=True)
    count = np.bincount(place, weight)
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, place, (values.T * weight).T)
    return np.asarray((total.T / count).T)


def statistics_by_regime(residual: Floats, is_dynamic: Bools) -> dict[str, ResidualStatistics]:
    """Summarise the residuals in the static regime, in the dynamic regime, and in both."""
    return {
        'static': residual_statistics(residual[~is_dynamic]),
        'dynamic': residual_statistics(residual[is_dynamic]),
        'all': residual_statistics(residual),
    }
