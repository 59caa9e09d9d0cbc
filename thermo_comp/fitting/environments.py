# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags of another environment: which bag contradicts the others, and what it adds to the claim.

In a chamber with a fan the board follows the case by one law. In still air it follows by another,
and a part without a thermometer answers differently: no coefficients fit both. One such bag among
many would spoil the correction where the many were recorded. So it takes no part in the fit, and
the error of its correction becomes a lack of fit of the calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..text import one_line
from ..typing import Floats
from ..unit.calibration import Calibration, LackOfFit, RegimeSet
from ..unit.gravity import MICRO_G
from .data_checks import Finding
from .lack_of_fit import drift_of_positions
from .left_out import Score
from .reduction import ReducedBag
from .regression import Regression
from .selection import Selected
from .windows import ThermalWindows, thermal_windows

# Fewer bags have no majority that one of them could contradict.
_FEWEST_BAGS = 4
# The left-out drift of a bag contradicts the others from so many times their median RMS, and so
# many times the white noise of a window.
_TIMES = 5.0
# Without such a bag the mean square of the others' left-out drift falls at least by this factor.
_LEAST_FACTOR = 2.0


def bag_at_odds(windows: ThermalWindows, selected: Selected) -> int | None:
    """Find the bag whose left-out drift is far larger than that of all others; None if none is."""
    square = _square_of_bags(windows, selected.score)
    known = np.isfinite(square)
    if known.sum() < _FEWEST_BAGS:
        return None
    worst = int(np.nanargmax(square))
    usual = float(np.median(square[known]))
    noise = float(np.mean(selected.prior.sigma**2))
    return worst if square[worst] > _TIMES**2 * max(usual, noise) else None


def agree_better(
    whole: tuple[ThermalWindows, Selected], rest: tuple[ThermalWindows, Selected], bag: int
) -> bool:
    """Whether the other bags' left-out drift falls once a bag takes no part in the fit."""
    before = np.delete(_square_of_bags(whole[0], whole[1].score), bag)
    after = _square_of_bags(rest[0], rest[1].score)
    known = np.isfinite(before) & np.isfinite(after)
    return bool(known.any() and before[known].mean() > _LEAST_FACTOR * after[known].mean())


def _square_of_bags(windows: ThermalWindows, score: Score) -> Floats:
    """Mean square of the left-out drift of each bag, shape (n_bags,), NaN where it is unknown."""
    bag, square = windows.data.bag_of_position, score.positions.square
    count = np.where(np.isfinite(square), score.positions.windows, 0.0)
    weighted = np.bincount(bag, np.where(count > 0.0, square, 0.0) * count)
    total = np.bincount(bag, count)
    return np.where(total > 0.0, weighted / np.maximum(total, 1.0), np.nan)


def with_doubt(
    calibration: Calibration, windows: ThermalWindows, selected: Selected, bag: ReducedBag
) -> tuple[Calibration, Finding]:
    """
    Add the error of the correction of a bag that took no part to the lack of fit of both sets;
    `windows` and `selected` are of the fit without it.
    """
    state = selected.posterior.state
    scale = np.array([axis.scale_factor for axis in calibration.axes]) / state.kappa
    alone = thermal_windows([bag], windows.model)
    regression = Regression(alone.data, calibration.gravity_m_s2, scale)
    # The weights of columns are in units of the RMS that these had in the fit.
    rms = np.sqrt(np.mean(windows.data.columns**2, axis=0))
    regression.columns = alone.data.columns / np.where(rms > 0.0, rms, 1.0)
    drift = drift_of_positions(regression, regression.force(state))
    is_dynamic = alone.weight > 0.5
    sets = []
    for one, rows in ((calibration.static, ~is_dynamic), (calibration.dynamic, is_dynamic)):
        square = np.mean(drift[rows if rows.any() else slice(None)] ** 2, axis=0)
        sets.append(_doubted(one, square))
    static, dynamic = sets
    rms_of_bag = float(np.sqrt(np.mean(drift**2)))
    name = one_line(bag.source.name)
    finding = Finding(
        'environment',
        'advice',
        f'{name} contradicts the other bags: their correction leaves a drift of '
        f'{rms_of_bag / MICRO_G:.0f} ug in it. It took no part in the fit, and the claim '
        'includes this error. Was it recorded in another environment, with the fan off or '
        'mounted elsewhere? Then give that environment a calibration of its own',
    )
    return replace(calibration, static=static, dynamic=dynamic), finding


def _doubted(one: RegimeSet, square: Floats) -> RegimeSet:
    points: Sequence[LackOfFit] = one.lack_of_fit
    if not points:
        points = (LackOfFit(float(np.mean(one.temperature_range_c)), (0.0, 0.0, 0.0)),)
    wider = []
    for point in points:
        x, y, z = np.sqrt(np.square(point.sd_m_s2) + square).tolist()
        wider.append(replace(point, sd_m_s2=(x, y, z)))
    return replace(one, lack_of_fit=tuple(wider))
