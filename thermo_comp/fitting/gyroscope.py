# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit of the gyroscope: the angular rate of the still windows, over the same columns.

A gyroscope at rest reads the Earth's rate, another one in each attitude, and a bias that a turn-on
changes: so each position has an offset of its own, and what temperature does is told by the
changes within the positions; the constant is told by the mean over them. The regression is the
accelerometer's without gravity: every m/s^2 of it reads rad/s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..unit.calibration import Calibration
from ..unit.gravity import EARTH_RATE
from ..unit.metrics import ResidualStatistics, statistics_by_regime
from ..unit.rate_triad import gyroscope_of
from .assembly import build_calibration
from .claim import claim_of
from .options import FitOptions
from .reduction import ReducedBag
from .regression import Regression
from .selection import Candidates, Selected, select
from .start import position_means, within_positions
from .unknowns import Prior
from .windows import ThermalWindows

# What it is on one axis, of an attitude that nobody knows.
_EARTH_SD = EARTH_RATE / math.sqrt(3.0)
# Built-in prior, wide for any gyroscope: bias [rad/s].
_BIAS_SD = 1.0
# Typical and steepest slope of the bias [rad/s per K]: consumer MEMS, 0.03 and 0.3 deg/s/K.
_SLOPE, _STEEPEST = 1e-5, 5e-3
# The noise begins with this [rad/s].
_SIGMA = 1e-5


@dataclass(frozen=True)
class RateRow:
    """The rate at rest of one section less the mean of each position, as of `ResidualRow`."""

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
    """Give a calibration the gyroscope of its prior, else of bags with rates and temperature."""
    if options.prior is not None:
        known = options.prior.gyroscope
        sensors = calibration.sensors if known is None else windows.model.sensors
        return replace(calibration, gyroscope=known, sensors=sensors), ()
    if not windows.angular_rate.shape[1] or not windows.has_temperature:
        return calibration, ()
    data = replace(
        windows.data,
        mean=windows.angular_rate,
        # An angular rate has no scale to tell here, nor does it feel the tilt of a support.
        in_scale=np.zeros(len(windows.data.groups), dtype=bool),
        tilt=windows.data.tilt[:, :0],
    )
    regression = Regression(data, 0.0, np.ones(3))
    level = position_means(data)
    up = np.tile((0.0, 0.0, 1.0), (data.n_positions, 1))
    state = regression.initial_state(level.mean(axis=0), np.zeros(3), up)
    asked = {*data.groups} if options.groups is None else {*options.groups}
    may = np.isin(data.groups, list(asked)) & (data.kelvins > 0.0)
    widths = np.outer((1.0, 0.0), may * data.kelvins)
    never = np.zeros(len(data.groups), dtype=bool)
    candidates = Candidates(
        _SLOPE * widths, _STEEPEST * widths, never, np.zeros(widths.shape, dtype=bool)
    )
    prior = Prior(
        bias_mean=np.zeros(3),
        bias_sd=np.full(3, _BIAS_SD),
        scale_sd=1.0,
        misalignment_sd=1.0,
        column_sd=np.zeros_like(widths),
        offset_sd=_EARTH_SD,
        sigma=np.full(3, _SIGMA),
        offset_scale=_EARTH_SD,
    )
    selected = select(regression, state, prior, candidates)
    # Of the offsets, which every position shows, the Earth's rate is no error of the gyroscope.
    shown = replace(selected, prior=replace(selected.prior, offset_scale=0.0))
    claim = claim_of(regression, shown)
    turn_on = math.sqrt(max(claim.offset_sd**2 - _EARTH_SD**2, 0.0))
    triad = build_calibration(
        windows, regression, selected, replace(claim, offset_sd=turn_on), bags, calibration.unit
    )
    needed = {*calibration.sensors, *triad.sensors}
    sensors = tuple(name for name in windows.model.sensors if name in needed)
    told = replace(calibration, gyroscope=gyroscope_of(triad), sensors=sensors)
    return told, _rows(windows, regression, selected)


def _rows(
    windows: ThermalWindows, regression: Regression, selected: Selected
) -> tuple[RateRow, ...]:
    position, fitted = windows.data.position, regression.force(selected.posterior.state)
    is_dynamic = np.repeat(windows.weight > 0.5, 3)
    raw, by_fit = (
        within_positions(rate, position).ravel() for rate in (windows.angular_rate, fitted)
    )
    left_out = selected.score.drift.ravel()
    known = np.isfinite(left_out)
    tables = [statistics_by_regime(one, is_dynamic) for one in (raw, by_fit)]
    tables.append(statistics_by_regime(left_out[known], is_dynamic[known]))
    return tuple(RateRow(section, *(table[section] for table in tables)) for section in tables[0])
