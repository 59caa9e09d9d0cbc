# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the lack of fit: the excess of the left-out errors over the published uncertainty.

Per regime and temperature it is the mean square of the left-out drift less its published variance.
So a kink of the curve, a tilt of the support or a drift of the bias widens the covariance although
no column describes it. Models within one standard error of the chosen model contribute half of
their squared difference from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats
from ..unit.calibration import LackOfFit
from .claim import Claim
from .equations import Equations
from .regression import Regression
from .selection import Selected
from .unknowns import Layout, State
from .windows import ThermalWindows


@dataclass(frozen=True)
class Excess:
    """
    Excess of the squared left-out drift over its published variance, (n, 3) [(m/s^2)^2].

    square: excess with the chosen model
    others: half of the squared difference to models that are as good within one standard error
    """

    square: Floats
    others: Floats


def lack_of_fit(
    windows: ThermalWindows, regression: Regression, selected: Selected, claim: Claim
) -> tuple[tuple[LackOfFit, ...], tuple[LackOfFit, ...]]:
    """Return the lack of fit of the static and of the dynamic regime; () for none."""
    excess = _excess(regression, selected, claim)
    is_dynamic = windows.weight > 0.5
    return _points(windows, excess, ~is_dynamic), _points(windows, excess, is_dynamic)


def _excess(regression: Regression, selected: Selected, claim: Claim) -> Excess:
    prior = selected.prior
    noise = prior.sigma**2 * (1.0 / regression.weight[:, None] + prior.noise.ratio)
    claimed = drift_variance(regression, selected.posterior.state, claim.layout, claim.covariance)
    square = selected.score.drift**2 - noise - claimed
    mine = drift_of_positions(regression, regression.force(selected.posterior.state))
    others = np.zeros_like(mine)
    near = [trial for trial in selected.trials if trial.is_near]
    for one in near:
        away = drift_of_positions(regression, regression.force(one.posterior.state)) - mine
        others = np.maximum(others, 0.5 * away**2)
    return Excess(square, others)


def drift_of_positions(regression: Equations, values: Floats) -> Floats:
    """Subtract from each window the mean of its position, shape (n, k)."""
    position = regression.windows.position
    first = np.searchsorted(position, np.arange(regression.windows.n_positions))
    count = np.diff(np.append(first, len(position)))[:, None]
    return np.asarray(values - (np.add.reduceat(values, first, axis=0) / count)[position])


def drift_variance(
    regression: Regression, state: State, layout: Layout, covariance: Floats
) -> Floats:
    """Return the variance of the drift of each window by a covariance of the unit, (n, 3)."""
    in_bias, in_scale = (np.flatnonzero(mask) for mask in layout.used)
    on_bias, on_scale = (
        drift_of_positions(regression, regression.columns[:, one]) for one in (in_bias, in_scale)
    )
    force = regression.along_axes(state)
    result = np.zeros((len(on_bias), 3))
    for axis in range(3):
        a = force[regression.windows.position, axis][:, None]
        along = np.hstack((on_bias, a * on_scale))
        at = layout.axis[axis, 2 : 2 + along.shape[1]]
        result[:, axis] = np.sum((along @ covariance[np.ix_(at, at)]) * along, axis=1)
    return result


def _points(windows: ThermalWindows, excess: Excess, rows: Bools) -> tuple[LackOfFit, ...]:
    """Average the excess of some windows in at most 5 bins of temperature, 10 windows or more."""
    rows = rows & np.isfinite(excess.square[:, 0])
    n = int(rows.sum())
    n_bins = min(5, n // 10)
    if not n_bins:
        return ()
    temperature = windows.temperature[rows]
    order = np.argsort(temperature, kind='stable')
    points = []
    for part in np.array_split(order, n_bins):
        square = excess.square[rows][part]
        mean = square.mean(axis=0)
        # Errors of neighbouring windows are correlated: ten windows count as one observation. An
        # excess below two standard errors is set to 0.
        error = square.std(axis=0) / np.sqrt(max(len(part) / 10.0, 1.0))
        mean = np.where(mean > 2.0 * error, mean, 0.0)
        x, y, z = np.sqrt(mean + excess.others[rows][part].mean(axis=0)).tolist()
        points.append(LackOfFit(float(temperature[part].mean()), (x, y, z)))
    rising = [
        one
        for k, one in enumerate(points)
        if not k or one.temperature_c > points[k - 1].temperature_c
    ]
    return tuple(rising) if any(any(one.sd_m_s2) for one in rising) else ()
