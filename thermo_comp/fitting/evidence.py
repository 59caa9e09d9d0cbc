# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the residuals that a fit reports: of each step of the model, and of each position.

Each position has two residuals: in sample, and with the unit's parameters fitted without this
position, which estimates the error in a new attitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from .left_out import Score
from .regression import Regression
from .selection import Selected
from .unknowns import Noise, State
from .windows import CURVE, SET, ThermalWindows


@dataclass(frozen=True)
class PositionReport:
    """
    The result of a fit for one still interval.

    source: the bag's name
    start_ns: stamp of its start
    duration_s: length [s]
    up: estimated direction of the specific force, in the output frame
    residual_rms: RMS of ``|f| - g`` over its windows [m/s^2]
    left_out_rms: RMS of its left-out error, see `left_out_error` [m/s^2]
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
    ``|f| - g`` of one section, by step of the model.

    section: ``static``, ``dynamic`` or ``all``
    raw: with the constants at the reference temperature
    one_set: with one curve for both regimes; no values if each regime has its own curve
    two_sets: with a curve for each regime
    fitted: with the calibration, on the data of the fit
    left_out: on data that were not used in the fit, see `left_out_error`
    """

    section: str
    raw: ResidualStatistics
    one_set: ResidualStatistics
    two_sets: ResidualStatistics
    fitted: ResidualStatistics
    left_out: ResidualStatistics


def residual_rows(
    windows: ThermalWindows, regression: Regression, selected: Selected, *, is_shared: bool
) -> tuple[tuple[ResidualRow, ...], Floats]:
    """
    Return the residuals of the steps of the model, and the left-out error of each window [m/s^2].

    `is_shared`: whether the curve columns act in both regimes, see `windows.Sets`.
    """
    state = selected.posterior.state
    steps = [regression.force(replace(state, weights=np.zeros_like(state.weights)))]
    rungs = (_with_only(regression, selected, groups) for groups in ((CURVE,), (CURVE, SET)))
    steps += [regression.force(step) for step in (*rungs, state)]
    sizes = regression.norms(state)[regression.windows.position]
    residuals = [norm_residual(force, sizes) for force in steps]
    left_out = left_out_error(selected.score, sizes)
    is_dynamic = windows.weight > 0.5
    known = np.isfinite(left_out)
    tables = [statistics_by_regime(r, is_dynamic) for r in residuals]
    if not is_shared:
        tables[1] = statistics_by_regime(np.empty(0), np.empty(0, bool))
    tables.append(statistics_by_regime(left_out[known], is_dynamic[known]))
    rows = tuple(
        ResidualRow(section, *(table[section] for table in tables))
        for section in ('static', 'dynamic', 'all')
    )
    return rows, left_out


def left_out_error(score: Score, gravity: float | Floats) -> Floats:
    """
    Return the error of each left-out window [m/s^2], shape (n,): ``|f| - g`` if the other
    positions determine the norm, else the RMS over the axes of the drift.
    """
    norm = norm_residual(score.force, gravity)
    drift = np.sqrt(np.mean(score.drift**2, axis=1))
    return np.asarray(np.where(np.isfinite(norm), norm, drift))


def _with_only(regression: Regression, selected: Selected, groups: tuple[str, ...]) -> State:
    """Fit again with some groups only, under a flat prior of their weights."""
    only = np.isin(regression.windows.groups, groups)
    # The residuals of such a model are mostly model error: all windows get equal weight.
    prior = replace(
        selected.prior,
        column_sd=only * regression.windows.parts * [[0.05], [0.005]],
        offset_sd=1e-7,
        offset_scale=0.0,
        noise=Noise(),
        informative=None,
    )
    return regression.solve(selected.posterior.state, prior).state


def position_reports(
    windows: ThermalWindows, regression: Regression, selected: Selected, left_out: Floats
) -> tuple[PositionReport, ...]:
    """List the positions with their RMS residuals in sample and left out."""
    state = selected.posterior.state
    sizes = regression.norms(state)[regression.windows.position]
    residual = norm_residual(regression.force(state), sizes)
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
