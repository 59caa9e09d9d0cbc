# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the published covariance: that of the fit, widened by what the data do not determine.

The standard deviation of mounting and turn-on offsets is marginalised: the covariance is that of a
mixture of fits on a grid of this standard deviation. The weight of each fit is its evidence times
a half-Student prior. The standard deviation of gravity is a common error of the scale factors.

References
----------
.. [1] A. Gelman, Prior distributions for variance parameters in hierarchical models, Bayesian
   Analysis 1 (2006).

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats, Ints
from .equations import as_vector
from .growth import LAGS
from .hyperparameters import STUDENT_NU
from .regression import Posterior, Regression
from .selection import Selected
from .unknowns import Layout, Prior

# Grid of the mounting's standard deviation, relative to the scale of its prior: steps of a quarter
# decade, over which the log evidence is smooth.
_MOUNTING_GRID = 10.0 ** np.arange(-3.0, 1.51, 0.25)
# Smallest standard deviation that is as likely as larger ones, on a logarithmic scale.
_LEAST_LIKELY = 0.01


@dataclass(frozen=True)
class Claim:
    """
    The published uncertainty of a unit.

    layout: places of the unknowns of the fit and of the columns that only the covariance has
    covariance: of the unit's own unknowns, shape (n_unit, n_unit)
    offset_sd: standard deviation of a new mounting or turn-on [m/s^2]
    """

    layout: Layout
    covariance: Floats
    offset_sd: float


def claim_of(
    regression: Regression,
    selected: Selected,
    candidates: Floats | None = None,
    gravity_sd: float = 0.0,
) -> Claim:
    """
    Return the published covariance.

    `candidates`: prior sd of the columns that could take part, shape (2, m); those that the data
    do not determine are added to the covariance; `gravity_sd`: [m/s^2]
    """
    prior = selected.prior
    posterior = regression.solve(selected.posterior.state, prior, n_steps=0)
    layout, covariance, offset_sd = posterior.layout, posterior.covariance, prior.offset_sd
    if prior.offset_scale > 0.0:
        covariance, offset_sd = _over_mountings(regression, posterior, prior)
    if candidates is not None:
        wider = _with_unseen(regression, posterior, prior, candidates)
        wide = regression.solve(posterior.state, wider, n_steps=0)
        # The unseen columns are added at the mounting sd of the mode, the mixture's excess to it.
        at = _places(posterior.layout, wide.layout)
        where = np.ix_(at, at)
        more = covariance - posterior.covariance
        layout, covariance = wide.layout, wide.covariance.copy()
        covariance[where] += more
    if gravity_sd and regression.gravity:
        # An error of gravity is the same relative error of all three scale factors.
        along = np.zeros(len(covariance))
        along[layout.kappa] = posterior.state.kappa * gravity_sd / regression.gravity
        covariance = covariance + np.outer(along, along)
    return Claim(layout, covariance, offset_sd)


def _places(layout: Layout, wider: Layout) -> Ints:
    """Return the places of the unit's unknowns in a layout with more columns, (n_unit,)."""
    places = np.empty(layout.n_unit, dtype=np.int64)
    is_used = layout.weights >= 0
    places[layout.axis[:, :2]] = wider.axis[:, :2]
    places[layout.weights[is_used]] = wider.weights[is_used]
    places[layout.shared] = wider.shared
    is_used = layout.nonlinear >= 0
    places[layout.nonlinear[is_used]] = wider.nonlinear[is_used]
    return places


def _with_unseen(
    regression: Regression, posterior: Posterior, prior: Prior, typical: Floats
) -> Prior:
    """
    Add unseen columns to the prior, so that the covariance does not state that they are 0.

    An inactive column is consistent with 0, but the data bound it only to ``1 / sqrt(S)``, S being
    its information given the active columns. If this bound exceeds two standard deviations of a
    window's noise, the column enters the covariance with this sd and zero weight. A column that
    hardly moved is judged as if it had moved as far as the temperature did.
    """
    groups = np.array(regression.windows.groups)
    inactive = regression.inactive(posterior, prior, np.isin(groups, LAGS) & typical.any(axis=0))
    seen = np.diag(inactive.S).reshape(-1, 3)
    seen = seen.sum(axis=1) / np.maximum((seen > 0.0).sum(axis=1), 1)
    sd = np.zeros_like(typical)
    sd[inactive.part, inactive.column] = 1.0 / np.sqrt(np.maximum(seen, 1e-300))
    for group in LAGS:
        # The lags of a group share one prior variance: their sum is bounded by that of one lag.
        own = np.isin(groups, group) & (sd > 0.0)
        share = np.sqrt(np.maximum(own.sum(axis=1, keepdims=True), 1))
        sd = np.where(own, np.minimum(sd, typical / share), sd)
    units = np.array([[1.0], [1.0 / (regression.gravity or 1.0)]])
    kelvins = regression.windows.kelvins
    # A column is called still if it moved by less than 1 % of the change of temperature.
    stood = kelvins < 0.01 * float(kelvins[0])
    farther = np.where(stood, float(kelvins[0]) / np.maximum(kelvins, 1e-9), 1.0)
    matters = (sd > 0.0) & (sd * farther > 2.0 * float(np.mean(prior.sigma)) * units)
    return replace(prior, column_sd=np.where(matters, sd, prior.column_sd))


def _over_mountings(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[Floats, float]:
    """Return covariance and offset sd of the mixture of fits over the mounting's sd."""
    tried = prior.offset_scale * _MOUNTING_GRID
    fits = [
        regression.solve(posterior.state, replace(prior, offset_sd=float(sd)), n_steps=1)
        for sd in tried
    ]
    # Density per step of the logarithm: flat below the scale, with a Student's tail above it, and
    # falling to 0 below a hundredth of the scale, which few mountings reach.
    density = -0.5 * (STUDENT_NU + 1.0) * np.log1p(_MOUNTING_GRID**2 / STUDENT_NU)
    density += np.log(np.minimum(_MOUNTING_GRID / _LEAST_LIKELY, 1.0))
    weight = np.array([fit.log_evidence for fit in fits]) + density
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    n = posterior.layout.n_unit
    here = as_vector(posterior.state, posterior.layout)[:n]
    covariance = np.zeros((n, n))
    for share, one in zip(weight, fits, strict=True):
        away = as_vector(one.state, one.layout)[:n] - here
        covariance += share * (one.covariance + np.outer(away, away))
    return covariance, float(np.sqrt(weight @ tried**2))
