# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns residual statistics: the few numbers that tests, the fit and the report all quote.

A residual is ``corrected - true``. Of a position of unknown attitude only the norm is known to
be true, so the residual that every bag gives is ``|f| - g``; where the truth is simulated the
vector residual is judged too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats
from .gravity import MICRO_G


@dataclass(frozen=True)
class ResidualStatistics:
    """
    What is said of a set of residuals.

    n: how many residuals were finite and counted
    mean, rms, peak: mean, root of the mean square and largest magnitude, in the residual's unit;
        NaN when there are none
    """

    n: int
    mean: float
    rms: float
    peak: float

    def scaled(self, factor: float) -> ResidualStatistics:
        """Return the statistics in another unit."""
        return ResidualStatistics(
            self.n, self.mean * factor, self.rms * factor, self.peak * abs(factor)
        )

    @property
    def micro_g(self) -> ResidualStatistics:
        """The statistics of residuals in m/s^2, expressed in micro-g."""
        return self.scaled(1.0 / MICRO_G)


def residual_statistics(residual: Floats) -> ResidualStatistics:
    """
    Summarise residuals; those that are not finite are left out.

    `residual`: scalar residuals, or vectors, of which the norm is summarised (the mean is then the
    length of the mean vector), shape (n,).
    """
    values = np.asarray(residual, dtype=np.float64)
    if values.ndim == 2:
        values = values[np.isfinite(values).all(axis=1)]
        size = np.linalg.norm(values, axis=1)
        mean = float(np.linalg.norm(values.mean(axis=0))) if len(values) else np.nan
    else:
        values = values[np.isfinite(values)]
        size = np.abs(values)
        mean = float(values.mean()) if len(values) else np.nan
    if not len(values):
        return ResidualStatistics(0, np.nan, np.nan, np.nan)
    return ResidualStatistics(
        len(values), mean, float(np.sqrt(np.mean(size**2))), float(np.max(size))
    )


def norm_residual(specific_force: Floats, gravity: float) -> Floats:
    """
    Form ``|f| - g``, the residual that needs no attitude.

    `specific_force`: corrected specific force, shape (..., 3).
    """
    force = np.asarray(specific_force, dtype=np.float64)
    return np.asarray(np.sqrt(np.einsum('...i,...i->...', force, force)) - gravity)


def statistics_by_regime(residual: Floats, is_dynamic: Bools) -> dict[str, ResidualStatistics]:
    """
    Summarise residuals over the static sections, the dynamic ones and all together.

    `residual`: residuals, shape (n,). `is_dynamic`: which of them fall on a dynamic section, shape
    (n,).
    """
    values = np.asarray(residual, dtype=np.float64)
    dynamic = np.asarray(is_dynamic, dtype=bool)
    return {
        'static': residual_statistics(values[~dynamic]),
        'dynamic': residual_statistics(values[dynamic]),
        'all': residual_statistics(values),
    }
