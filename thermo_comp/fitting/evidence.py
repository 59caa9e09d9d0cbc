# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the statistics that a fit reports: residuals of each position; residuals after correction with
constants, with curves and with the response; and the contribution of each group of columns.

Each position has two residuals: in sample, by the fit of all positions; and left out, by a fit
without this position, which estimates the error in a new attitude.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from ..typing import Bools, Floats
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from ..unit.provenance import GroupEvidence
from .equations import as_vector
from .gains import log_bayes_factors
from .left_out import Score
from .regression import PosteriorMode, Regression
from .selection import Fit
from .unknowns import Noise, State
from .windows import CURVE, SET


@dataclass(frozen=True)
class PositionReport:
    """
    The result of a fit for one still interval.

    source: name of the bag
    start_ns: stamp of the start of the interval
    duration_s: duration of the interval [s]
    up: estimated direction of the specific force, in the output frame
    residual_rms: RMS of ``|f| - g`` over the windows of the interval [m/s^2]
    left_out_rms: RMS of ``|f| - g``, or of the drift, by a fit without the interval [m/s^2]
    """

    source: str
    start_ns: int
    duration_s: float
    up: tuple[float, float, float]
    residual_rms: float
    left_out_rms: float


@dataclass(frozen=True)
class ResidualRow:
    """
    Statistics of ``|f| - g`` over the windows of one section, after each step of the correction.

    section: regime of the windows, ``static``, ``dynamic`` or ``all``
    raw: corrected with the constants at the reference temperature
    one_set: corrected with one curve for both regimes; empty if each regime has its own curve
    two_sets: corrected with a curve for each regime
    fitted: corrected with the calibration, in sample
    left_out: corrected by fits without the position; RMS drifts where these do not determine |f|
    """

    section: str
    raw: ResidualStatistics
    one_set: ResidualStatistics
    two_sets: ResidualStatistics
    fitted: ResidualStatistics
    left_out: ResidualStatistics


def residual_rows(fit: Fit) -> tuple[tuple[ResidualRow, ...], Floats, Floats]:
    """
    Return statistics of the residuals after each step of the correction; and, for each window,
    ``|f| - g`` in sample and the left-out error [m/s^2], shape (n,).
    """
    windows, regression, selected, state = *fit[:3], fit.posterior.state
    steps = [
        replace(state, weights=np.zeros_like(state.weights)),
        *(_with_only(regression, fit.posterior, groups) for groups in ((CURVE,), (CURVE, SET))),
        state,
    ]
    sizes = regression.norms(state)[regression.windows.position]
    residuals = [norm_residual(regression.force(step), sizes) for step in steps]
    left_out = left_out_error(selected.score, sizes)
    if not windows.model.sets.is_shared:
        residuals[1] = np.full_like(left_out, np.nan)
    tables = tables_of((*residuals, left_out), windows.is_dynamic)
    rows = tuple(
        ResidualRow(section, *(table[section] for table in tables))
        for section in ('static', 'dynamic', 'all')
    )
    return rows, residuals[-1], left_out


def tables_of(
    residuals: Iterable[Floats], is_dynamic: Bools
) -> list[dict[str, ResidualStatistics]]:
    """Return, for each array of residuals, (n,), statistics of finite values by regime."""
    return [
        statistics_by_regime(values[np.isfinite(values)], is_dynamic[np.isfinite(values)])
        for values in residuals
    ]


def left_out_error(score: Score, gravity: float | Floats) -> Floats:
    """
    Return the error of each left-out window [m/s^2], shape (n,): ``|f| - g`` if the other
    positions determine |f|, else the RMS of the drifts of the three axes.
    """
    norm = norm_residual(score.force, gravity)
    drift = np.sqrt(np.mean(score.drift**2, axis=1))
    return np.asarray(np.where(np.isfinite(norm), norm, drift))


def _with_only(regression: Regression, chosen: PosteriorMode, groups: tuple[str, ...]) -> State:
    """Repeat the fit with the given groups only, under an almost flat prior of their weights."""
    only = np.isin(regression.windows.groups, groups)
    # The residuals of a model with few groups are mostly model error, which slow noise or mounting
    # offsets would absorb: the fit has white noise only and no offsets.
    prior = replace(
        chosen.prior,
        column_sd=only * regression.windows.parts * [[0.05], [0.005]],
        offset_sd=1e-7,
        offset_scale=0.0,
        noise=Noise(),
        informative=None,
    )
    return regression.solve(chosen.state, prior).state


def position_reports(fit: Fit, residual: Floats, left_out: Floats) -> tuple[PositionReport, ...]:
    """Return a report for each position, from the residuals of `residual_rows`, shape (n,)."""
    windows, state = fit.windows, fit.posterior.state
    result = []
    for number, (bag, interval) in enumerate(windows.rests):
        rows = windows.data.position == number
        x, y, z = state.up[number].tolist()
        result.append(
            PositionReport(
                source=bag.source.name,
                start_ns=interval.start_ns,
                duration_s=(interval.end_ns - interval.start_ns) * 1e-9,
                up=(x, y, z),
                residual_rms=float(np.sqrt(np.mean(residual[rows] ** 2))),
                left_out_rms=float(np.sqrt(np.mean(left_out[rows] ** 2))),
            )
        )
    return tuple(result)


def group_evidence(regression: Regression, posterior: PosteriorMode) -> tuple[GroupEvidence, ...]:
    """
    Return RMS contribution, effective parameters and log Bayes factor of each active group.

    The Bayes factor compares the fit with a fit without the group or, if the prior is a
    calibration, with a fit in which the group keeps the weights of this calibration.
    """
    names = np.array(regression.windows.groups)
    prior, state, layout = posterior.prior, posterior.state, posterior.layout
    change = as_vector(state, layout)[: layout.n_unit]
    of_prior = None
    if prior.informative is not None:
        change = change - prior.informative.mean
        of_prior = solve_triangular(prior.informative.root, np.eye(layout.n_unit))
    force = (regression.norms(state)[:, None] * state.up)[regression.windows.position]
    effective = posterior.effective_parameters
    parts: tuple[Literal['bias', 'scale'], ...] = ('bias', 'scale')
    result = []
    for k, part in enumerate(parts):
        for group in dict.fromkeys(regression.windows.groups):
            used = (names == group) & (prior.column_sd[k] > 0.0)
            if not used.any():
                continue
            correction = regression.columns[:, used] @ state.weights[k][:, used].T
            if part == 'scale':
                correction = correction * force
            places, sd = layout.weights[k][:, used].ravel(), prior.column_sd[k][used]
            if of_prior is None:
                weight_sd = regression.weight_sd(prior)[k][:, used].ravel()
            else:
                weight_sd = np.full(len(places), _mean_sd(of_prior[places]))
            cases = places[None], weight_sd[None]
            (gain,) = log_bayes_factors(change, posterior.covariance, *cases)
            result.append(
                GroupEvidence(
                    group,
                    part,
                    float(np.sqrt(np.mean(correction**2))),
                    max(float(effective[k][used].sum()), 0.0),
                    float(gain),
                    tuple(sd.tolist()),
                )
            )
    return tuple(result)


def _mean_sd(root: Floats) -> float:
    """Return the geometric mean of the principal sds of the covariance ``root @ root.T``."""
    return float(np.exp(np.linalg.slogdet(root @ root.T)[1] / (2.0 * len(root))))
