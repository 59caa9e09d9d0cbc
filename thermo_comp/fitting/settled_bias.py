# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the expected error of the bias at constant temperatures, after all lags have settled.

In bags that all begin at one temperature the lags change together with the board temperature, so
such bags do not determine the bias after the lags have settled: this bias is extrapolated.
"""

from __future__ import annotations

import numpy as np

from ..typing import Floats
from .regression import PosteriorMode, Regression


def settled_error(
    regression: Regression, posterior: PosteriorMode, excess: float, settled: Floats
) -> float:
    """
    Return the expected error of the bias after all lags settled [m/s^2]; inf without bias columns.

    The error is the root sum of squares of two terms: the posterior sd of this bias; and
    `excess`, the left-out drift beyond the noise [m/s^2], times the ratio (if above 1) of this sd
    to that of the bias in the windows. `settled`: columns at settled temperatures, shape (k, m).
    """
    if not posterior.layout.used[0].any():
        return np.inf
    # 500 windows are sufficient to compute the RMS, over the windows, of the bias sd.
    seen = regression.columns[:: max(len(regression.columns) // 500, 1)]
    sd, seen_sd = (
        _sd_of_changes(posterior, columns - columns.mean(axis=0))
        for columns in (settled / regression.rms, seen)
    )
    # `seen_sd`, the sd in the windows, is 0 if all columns are constant in the windows.
    growth = max(sd / seen_sd, 1.0) if seen_sd else 1.0
    return float(np.hypot(sd, excess * growth))


def _sd_of_changes(posterior: PosteriorMode, columns: Floats) -> float:
    """Return the RMS, over axes and rows of columns (k, m), of the sd of the bias [m/s^2]."""
    parts = posterior.layout.by_weights(columns, np.zeros(3))
    square = sum(float(np.sum((part @ posterior.root[at]) ** 2)) for part, at in parts)
    return float(np.sqrt(square / (3 * len(columns))))
