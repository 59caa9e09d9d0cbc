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
from .evidence import left_out_force
from .learning import Learnt, learn
from .options import FitOptions
from .posterior import Regression
from .reduction import ReducedBag
from .start import position_means, within_positions
from .unknowns import Prior, initial_state
from .windows import CURVE, ThermalWindows

# What it is on one axis, of an attitude that nobody knows.
_EARTH_SD = EARTH_RATE / math.sqrt(3.0)
# Built-in prior, wide for any gyroscope: bias [rad/s] and what temperature does to it.
_BIAS_SD, _COLUMN_SD = 1.0, 1e-4
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
        # An angular rate has no scale to tell here, nor does it feel how a support leans.
        in_scale=np.zeros(len(windows.data.groups), dtype=bool),
        lean=windows.data.lean[:, :0],
    )
    one = np.ones(3)
    regression = Regression(data, 0.0, one)
    level = position_means(data)
    up = np.tile((0.0, 0.0, 1.0), (data.n_positions, 1))
    state = initial_state(data, regression.n_bags, level.mean(axis=0), one, np.zeros(3), up)
    is_curve = np.array([group == CURVE for group in data.groups])
    drift = float(np.sqrt(np.mean((data.mean - level[data.position]) ** 2, axis=0)).max())
    allowed = options.groups
    takes_part = np.array([allowed is None or group in allowed for group in data.groups])
    prior = Prior(
        bias_mean=np.zeros(3),
        bias_sd=np.full(3, _BIAS_SD),
        scale_sd=1.0,
        skew_sd=1.0,
        widths=np.outer((1.0, 0.0), np.where(is_curve, max(_COLUMN_SD, drift), _COLUMN_SD))
        * takes_part,
        offset_sd=_EARTH_SD,
        sigma=np.full(3, _SIGMA),
        rho=np.zeros(3),
        least_offset_sd=_EARTH_SD,
    )
    learnt = learn(regression, state, prior, is_curve, walks=bool(windows.model.columns))
    residuals = _rows(windows, regression, learnt)
    # Of the offsets the Earth's rate is no error of the gyroscope.
    turn_on = math.sqrt(max(learnt.prior.offset_sd**2 - _EARTH_SD**2, 0.0))
    told = replace(learnt, prior=replace(learnt.prior, offset_sd=turn_on))
    triad = build_calibration(windows, regression, told, bags, calibration.unit)
    needed = {*calibration.sensors, *triad.sensors}
    sensors = tuple(name for name in windows.model.sensors if name in needed)
    return replace(calibration, gyroscope=gyroscope_of(triad), sensors=sensors), residuals


def _rows(windows: ThermalWindows, regression: Regression, learnt: Learnt) -> tuple[RateRow, ...]:
    position, fitted = windows.data.position, regression.force(learnt.posterior.state)
    left_out = left_out_force(regression, learnt)
    is_dynamic = np.repeat(windows.weight > 0.5, 3)
    raw, by_fit, by_others = (
        statistics_by_regime(within_positions(rate, position).ravel(), is_dynamic)
        for rate in (windows.angular_rate, fitted, left_out)
    )
    return tuple(
        RateRow(section, raw[section], by_fit[section], by_others[section]) for section in raw
    )
