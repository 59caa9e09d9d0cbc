# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the lack of fit: the excess of the left-out errors over the published covariance.

The lack of fit in a regime, near a temperature, is the mean square of the left-out drift less the
noise and the published variance of this drift. The lack of fit covers effects that no column
describes, such as a kink of the curve, a tilt of the support or a drift of the bias. For models
whose score is at most one standard error worse than that of the chosen model, half of the largest
squared difference between the drift of such a model and that of the chosen model is added.
"""

from __future__ import annotations

import numpy as np

from ..typing import Bools, Floats
from ..unit.calibration import LackOfFit
from .claim import Claim
from .initial_triad import within_positions
from .layout import Layout
from .regression import Regression
from .selection import Fit
from .unknowns import State


def lack_of_fit(fit: Fit, claim: Claim) -> tuple[tuple[LackOfFit, ...], tuple[LackOfFit, ...]]:
    """Return the lack of fit in the static and the dynamic regime, at 0 to 5 temperatures each."""
    windows, regression, selected = fit[:3]
    prior, state, position = fit.posterior.prior, fit.posterior.state, windows.data.position
    noise = prior.sigma**2 * (1.0 / regression.weight[:, None] + prior.noise.variance)
    claimed = drift_variance(regression, state, claim.layout, claim.covariance)
    excess = selected.score.drift**2 - noise - claimed
    near = [trial.posterior.state for trial in selected.trials if trial.is_near]
    drifts = [within_positions(regression.force(other), position) for other in (state, *near)]
    model_error = 0.5 * np.max((np.array(drifts) - drifts[0]) ** 2, axis=0)
    static, dynamic = (
        _points(windows.temperature, excess, model_error, rows & np.isfinite(excess[:, 0]))
        for rows in (~windows.is_dynamic, windows.is_dynamic)
    )
    return static, dynamic


def drift_variance(
    regression: Regression, state: State, layout: Layout, covariance: Floats
) -> Floats:
    """Return the variance of the drift of each window due to `covariance`, shape (n, 3)."""
    position = regression.windows.position
    columns = within_positions(regression.columns, position)
    by_weights = layout.by_weights(columns, regression.effects(state).force[position])
    variances = [
        np.sum((along @ covariance[np.ix_(at, at)]) * along, axis=1) for along, at in by_weights
    ]
    return np.column_stack(variances)


def _points(
    temperature: Floats, excess: Floats, model_error: Floats, rows: Bools
) -> tuple[LackOfFit, ...]:
    """Average the excess of squared drifts in up to 5 temperature bins of 10 windows or more."""
    n_bins = min(5, int(rows.sum()) // 10)
    if not n_bins:
        return ()
    points: list[LackOfFit] = []
    order = np.argsort(temperature, kind='stable')
    for part in np.array_split(order[rows[order]], n_bins):
        mean = excess[part].mean(axis=0)
        # Errors of neighbouring windows are correlated: ten windows count as one observation. An
        # excess below two standard errors is set to 0.
        error = excess[part].std(axis=0) / np.sqrt(max(len(part) / 10.0, 1.0))
        mean = np.where(mean > 2.0 * error, mean, 0.0)
        x, y, z = np.sqrt(mean + model_error[part].mean(axis=0)).tolist()
        celsius = float(temperature[part].mean())
        if not points or celsius > points[-1].temperature_c:
            points.append(LackOfFit(celsius, (x, y, z)))
    return tuple(points) if any(any(point.sd_m_s2) for point in points) else ()
