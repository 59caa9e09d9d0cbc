# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a calibration claims beyond the covariance of one fit: what the data do not determine.

How well mounting and turn-on repeat is integrated over: the covariance is that of the mixture of
fits over this standard deviation, each weighted by its evidence and by a prior that is flat in the
logarithm below a scale and falls like Student's t above it. Gravity adds its stated error to the
three scale factors at once.

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
from .hyperparameters import STUDENT_NU
from .regression import Posterior, Regression
from .selection import LAGS, Selected
from .unknowns import Layout, Prior

# Standard deviations of the mounting over the scale of their prior: what evidence can tell apart.
_MOUNTINGS = 10.0 ** np.arange(-2.0, 1.51, 0.25)
# Noises of a window that an unseen column may add before it counts.
_OPEN = 4.0
# A column stands still if it moves by less than this share of the temperature's own change.
_STANDS = 0.01


@dataclass(frozen=True)
class Claim:
    """
    What is claimed of the unit.

    layout: places of the unknowns: of the fit, and of what nobody saw
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
    Integrate over the mounting's standard deviation, keep open what nobody saw (`candidates`:
    typical widths, shape (2, m)), and add the error of gravity [m/s^2].
    """
    prior = selected.prior
    posterior = regression.solve(selected.posterior.state, prior, n_steps=0)
    layout, covariance, offset_sd = posterior.layout, posterior.covariance, prior.offset_sd
    if prior.offset_scale > 0.0:
        covariance, offset_sd = _over_mountings(regression, posterior, prior)
    if candidates is not None:
        wider = _with_unseen(regression, posterior, prior, candidates)
        wide = regression.solve(posterior.state, wider, n_steps=0)
        # What unseen columns add is that beside the mounting of the mode.
        at = _places(posterior.layout, wide.layout)
        where = np.ix_(at, at)
        more = covariance - posterior.covariance
        layout, covariance = wide.layout, wide.covariance.copy()
        covariance[where] += more
    if gravity_sd and regression.gravity:
        # Samples in units of a wrong gravity make all scale factors wrong by the same ratio.
        along = np.zeros(len(covariance))
        along[layout.kappa] = posterior.state.kappa * gravity_sd / regression.gravity
        covariance = covariance + np.outer(along, along)
    return Claim(layout, covariance, offset_sd)


def _places(layout: Layout, wider: Layout) -> Ints:
    """Find the unit's unknowns of a layout in one of more columns, shape (n_unit,)."""
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
    Give columns back that the data could not have seen, lest they be claimed to be 0.

    A column that is absent was not needed; whether it is 0 the data determine to ``1 / sqrt(S)``,
    S what they say of it beside the columns that stayed. Where that is more than some standard
    deviations of a window's noise, the covariance has it with that width; its weight stays 0. A
    column that stood still, as in soaks, is judged as if it moved as far as the temperature did.
    """
    groups = np.array(regression.windows.groups)
    inactive = regression.inactive(posterior, prior, np.isin(groups, LAGS) & typical.any(axis=0))
    k = len(inactive.columns)
    seen = np.diag(inactive.S).reshape(2, k, 3).mean(axis=2)
    sd = np.zeros_like(typical)
    sd[:, inactive.columns] = 1.0 / np.sqrt(np.maximum(seen, 1e-300))
    for group in LAGS:
        # All lags of a group together are as large as one of them may be.
        own = np.isin(groups, group) & (sd > 0.0)
        share = np.sqrt(np.maximum(own.sum(axis=1, keepdims=True), 1))
        sd = np.where(own, np.minimum(sd, typical / share), sd)
    units = np.array([[1.0], [1.0 / (regression.gravity or 1.0)]])
    kelvins = regression.windows.kelvins
    stood = kelvins < _STANDS * float(kelvins[0])
    farther = np.where(stood, float(kelvins[0]) / np.maximum(kelvins, 1e-9), 1.0)
    matters = (sd > 0.0) & (sd * farther > _OPEN * float(np.mean(prior.sigma)) * units)
    return replace(prior, column_sd=np.where(matters, sd, prior.column_sd))


def _over_mountings(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[Floats, float]:
    tried = prior.offset_scale * _MOUNTINGS
    fits = [
        regression.solve(posterior.state, replace(prior, offset_sd=float(sd)), n_steps=1)
        for sd in tried
    ]
    # On a logarithmic grid: any order of magnitude is as likely, with a Student's tail above.
    density = -0.5 * (STUDENT_NU + 1.0) * np.log1p(_MOUNTINGS**2 / STUDENT_NU)
    weight = np.array([one.log_evidence for one in fits]) + density
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    n = posterior.layout.n_unit
    here = as_vector(posterior.state, posterior.layout)[:n]
    covariance = np.zeros((n, n))
    for share, one in zip(weight, fits, strict=True):
        away = as_vector(one.state, one.layout)[:n] - here
        covariance += share * (one.covariance + np.outer(away, away))
    return covariance, float(np.sqrt(weight @ tried**2))
