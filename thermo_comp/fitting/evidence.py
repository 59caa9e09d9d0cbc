# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the statistics that a fit reports: residuals of each position; residuals after correction with
constants, with curves and with the response; the contribution of each group of columns; and the
lack of fit, the excess of the left-out errors over the published covariance.

Each position has two residuals: in sample, by the fit of all positions; and left out, by a fit
without this position, which estimates the error in a new attitude.

The lack of fit in a regime, near a temperature, is the mean square of the left-out drift less the
noise and the published variance of this drift. The lack of fit covers effects that no column
describes, such as a kink of the curve, a tilt of the support or a drift of the bias. The lack of
fit includes half of the largest squared difference in drift between the chosen model and any other
model whose score is at most one standard error worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from ..typing import Bools, Floats
from ..unit.calibration import LackOfFit
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from ..unit.provenance import GroupEvidence
from .claim import Claim
from .equations import as_vector
from .gains import log_bayes_factors
from .initial_triad import within_positions
from .layout import Layout
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
    Statistics of ``|f| - g`` over the windows of a regime, after each step of the correction.

    section: regime of the windows, ``static``, ``dynamic`` or ``all``
    raw: residuals after correction with the constants at the reference temperature
    one_set: residuals with one curve for both regimes; empty if each regime has a separate curve
    two_sets: residuals with a curve for each regime
    fitted: residuals with the calibration, in sample
    left_out: residuals by fits without the position; the drift if these fits do not give |f|
    left_out_drift: drift of an axis by fits without the position or section (`Score.drift`)
    """

    section: str
    raw: ResidualStatistics
    one_set: ResidualStatistics
    two_sets: ResidualStatistics
    fitted: ResidualStatistics
    left_out: ResidualStatistics
    left_out_drift: ResidualStatistics


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
    # If other positions do not determine |f|, the left-out error is the drift, RMS over the axes.
    norm = norm_residual(selected.score.force, sizes)
    drift = np.sqrt(np.mean(selected.score.drift**2, axis=1))
    left_out = np.where(np.isfinite(norm), norm, drift)
    if not windows.model.sets.is_shared:
        residuals[1] = np.full_like(left_out, np.nan)
    shown = *residuals, left_out, drift
    tables = [statistics_by_regime(each, windows.is_dynamic) for each in shown]
    rows = (ResidualRow(section, *(table[section] for table in tables)) for section in tables[0])
    return tuple(rows), residuals[-1], left_out


def _with_only(regression: Regression, chosen: PosteriorMode, groups: tuple[str, ...]) -> State:
    """Fit only the columns of the given groups, under an almost flat prior of their weights."""
    only = np.isin(regression.windows.groups, groups)
    # Residuals of a model of few columns are mostly model error, which slow noise or mounting
    # offsets would absorb: this fit has white noise only and no offsets.
    prior = replace(
        chosen.prior,
        column_sd=only * regression.windows.parts * [[0.05], [0.005]],  # bias [m/s^2], scale
        offset_sd=1e-7,
        offset_scale=0.0,
        noise=Noise(),
        informative=None,
    )
    return regression.solve(chosen.state, prior).state


def position_reports(fit: Fit, residual: Floats, left_out: Floats) -> tuple[PositionReport, ...]:
    """Return a report for each position, from the residuals of `residual_rows`, shape (n,)."""
    result = []
    for number, (bag, interval) in enumerate(fit.windows.rests):
        rows = fit.windows.data.position == number
        x, y, z = fit.posterior.state.up[number].tolist()
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
    Return RMS effect, number of effective parameters and log Bayes factor of each column group.

    The Bayes factor compares the fit with a fit without a group or, if the prior is a
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
                # All weights get one sd, the geometric mean of the principal sds of their prior.
                root = of_prior[places]
                mean_sd = np.exp(np.linalg.slogdet(root @ root.T)[1] / (2.0 * len(root)))
                weight_sd = np.full(len(places), mean_sd)
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


def lack_of_fit(fit: Fit, claim: Claim) -> tuple[tuple[LackOfFit, ...], tuple[LackOfFit, ...]]:
    """Return the lack of fit in the static and the dynamic regime, at 0 to 5 temperatures each."""
    windows, regression, selected = fit[:3]
    prior, state, position = fit.posterior.prior, fit.posterior.state, windows.data.position
    # Use weights from numbers of samples: weights reduced for outliers would overstate the noise.
    noise = prior.sigma**2 * (1.0 / windows.data.weight[:, None] + prior.noise.variance)
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
    by_weights = layout.by_weights(columns, regression.along(state)[position])
    variances = [
        np.sum((along @ covariance[np.ix_(at, at)]) * along, axis=1) for along, at in by_weights
    ]
    return np.column_stack(variances)


def _points(
    temperature: Floats, excess: Floats, model_error: Floats, rows: Bools
) -> tuple[LackOfFit, ...]:
    """Return the lack of fit in up to 5 temperature bins, each with 10 windows or more."""
    n_bins = min(5, int(rows.sum()) // 10)
    if not n_bins:
        return ()
    points: list[LackOfFit] = []
    order = np.argsort(temperature, kind='stable')
    for part in np.array_split(order[rows[order]], n_bins):
        mean = excess[part].mean(axis=0)
        # Errors of neighbouring windows are correlated: ten windows count as one observation. A
        # mean excess of the squared drift below two standard errors is set to 0.
        error = excess[part].std(axis=0) / np.sqrt(max(len(part) / 10.0, 1.0))
        mean = np.where(mean > 2.0 * error, mean, 0.0)
        x, y, z = np.sqrt(mean + model_error[part].mean(axis=0)).tolist()
        celsius = float(temperature[part].mean())
        if not points or celsius > points[-1].temperature_c:
            points.append(LackOfFit(celsius, (x, y, z)))
    return tuple(points) if any(any(point.sd_m_s2) for point in points) else ()
