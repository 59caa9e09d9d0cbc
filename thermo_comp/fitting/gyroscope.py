# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit of a gyroscope's bias to the angular rate at rest, with the accelerometer's columns.

Each axis of a gyroscope at rest measures a component of the Earth's rate, plus a bias that
changes at each turn-on, so the regression has a constant offset of the rate as an unknown of each
position. Changes of the rate within a position determine the effect of temperature; the mean rate
over the positions determines the constant bias. The equations of the accelerometer are used with
gravity 0, and with rad/s instead of m/s^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..unit.calibration import Calibration, gyroscope_of
from ..unit.gravity import EARTH_RATE
from ..unit.metrics import ResidualStatistics, statistics_by_regime
from .assembly import build_calibration
from .claim import claim_of
from .hyperparameters import Candidates
from .initial_triad import position_means, within_positions
from .options import FitOptions
from .reduction import ReducedBag
from .regression import Regression
from .selection import Fit, select
from .unknowns import Prior, Windows
from .windows import ThermalWindows


@dataclass(frozen=True)
class RateRow:
    """Statistics of the angular rate less its mean in each position, in a regime [rad/s]."""

    section: str
    raw: ResidualStatistics
    fitted: ResidualStatistics
    left_out: ResidualStatistics


def add_gyroscope(
    calibration: Calibration,
    windows: ThermalWindows,
    bags: Sequence[ReducedBag],
    options: FitOptions,
) -> tuple[Calibration, tuple[RateRow, ...]]:
    """
    Add a gyroscope to a calibration: the gyroscope of the prior calibration or, without a prior,
    one fitted to the bags, if the bags have angular rates and temperatures.
    """
    if options.prior is not None:
        known = options.prior.gyroscope
        sensors = calibration.sensors if known is None else windows.model.sensors
        return replace(calibration, gyroscope=known, sensors=sensors), ()
    if not windows.angular_rate.shape[1] or not windows.has_temperature:
        return calibration, ()
    data = replace(
        windows.data,
        mean=windows.angular_rate,
        # At rest neither the scale of an angular rate nor the tilt of a support is observable.
        in_scale=np.zeros(len(windows.data.groups), dtype=bool),
        tilt=windows.data.tilt[:, :0],
    )
    regression = Regression(data, 0.0, np.ones(3))
    up = np.tile((0.0, 0.0, 1.0), (data.n_positions, 1))
    state = regression.initial_state(position_means(data).mean(axis=0), np.zeros(3), up)
    # Sd of the component of the Earth's rate along one axis in an unknown attitude [rad/s].
    earth_sd = EARTH_RATE / math.sqrt(3.0)
    prior = Prior(
        bias_sd=np.ones(3),  # prior sd of the bias [rad/s], wide for any gyroscope
        scale_sd=1.0,
        misalignment_sd=1.0,
        column_sd=np.zeros((2, len(data.groups))),
        offset_sd=earth_sd,
        sigma=np.full(3, 1e-5),
        offset_scale=earth_sd,
    )
    fit = Fit(windows, regression, select(regression, state, prior, _candidates(data, options)))
    # The positions determine the sd of the offsets well, so `claim_of` may take the sd as known.
    chosen = replace(fit.posterior, prior=replace(fit.posterior.prior, offset_scale=0.0))
    claim = claim_of(fit._replace(selected=replace(fit.selected, posterior=chosen)))
    # The offsets contain the Earth's rate, which is no error: subtract its variance.
    claim = replace(claim, offset_sd=math.sqrt(max(claim.offset_sd**2 - earth_sd**2, 0.0)))
    triad = build_calibration(fit, claim, bags, calibration.unit)
    needed = {*calibration.sensors, *triad.sensors}
    sensors = tuple(name for name in windows.model.sensors if name in needed)
    result = replace(calibration, gyroscope=gyroscope_of(triad), sensors=sensors)
    return result, _residual_rows(fit)


def _candidates(data: Windows, options: FitOptions) -> Candidates:
    """Return prior sds of the columns' weights; 0 for columns that the rate cannot have."""
    allowed = data.groups if options.groups is None else options.groups
    is_candidate = np.isin(data.groups, allowed) & (data.kelvins > 0.0)
    kelvins = np.outer((1.0, 0.0), is_candidate * data.kelvins)
    none = np.zeros(kelvins.shape, dtype=bool)
    # Typical and largest (consumer MEMS) prior sd of the bias's slope over temperature [rad/s/K].
    return Candidates(1e-5 * kelvins, 5e-3 * kelvins, none[0], none)


def _residual_rows(fit: Fit) -> tuple[RateRow, ...]:
    (windows, regression, *_), position = fit, fit.windows.data.position
    raw, fitted = (
        within_positions(rate, position).ravel()
        for rate in (windows.angular_rate, regression.force(fit.posterior.state))
    )
    residuals = raw, fitted, fit.selected.score.drift.ravel()
    is_dynamic = np.repeat(windows.is_dynamic, 3)
    tables = [statistics_by_regime(each, is_dynamic) for each in residuals]
    return tuple(RateRow(section, *(table[section] for table in tables)) for section in tables[0])
