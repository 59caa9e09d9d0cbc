# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the exclusion of bags from another environment, and the error that they add to the claim.

In a chamber with a fan the board temperature follows the case temperature by one law, in still air
by another. The bias of a part without a thermometer then depends on the environment, and no set of
coefficients describes both. One bag of still air would increase the error of the correction in the
chamber. Therefore the fit excludes this bag, and its error becomes a lack of fit.
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
from .lack_of_fit import drift_of_positions, drift_variance
from .left_out import Score
from .options import FitOptions
from .priors import constants_of, informative_priors, prior_columns, prior_sets, with_calibration
from .reduction import ReducedBag
from .regression import Regression
from .selection import Selected
from .start import position_means
from .unknowns import BIAS_SD, MISALIGNMENT_SD, SCALE_SD, Prior, State
from .windows import Model, ThermalWindows, thermal_windows

# Smallest number of bags with a majority that one bag can contradict.
_FEWEST_BAGS = 4
# A bag contradicts the others if the RMS of its left-out drift exceeds their median, and the white
# noise of a window, by this factor.
_LEAST_RATIO = 5.0
# The exclusion of the bag must decrease the mean square of the others' left-out drift by this.
_LEAST_FACTOR = 2.0
# Standard deviation of the level of a bag [m/s^2]: 1 mg, more than the turn-on of a navigation
# sensor.
_LEVEL_SD = 1e-2
# Factor of the root of a precision that keeps the parameters at the mean of the prior.
_PRECISION_FACTOR = 1e4


def contradicting_bag(windows: ThermalWindows, selected: Selected) -> int | None:
    """
    Find the bag that may be of another environment; None if none is suspect.

    It is the one whose left-out drift is far larger than that of all others. A bag whose drift the
    others do not determine is it if theirs is far above the noise.
    """
    square = _square_of_bags(windows, selected.score)
    known = np.isfinite(square)
    if known.sum() < _FEWEST_BAGS:
        return None
    usual = float(np.median(square[known]))
    limit = _LEAST_RATIO**2 * float(np.mean(selected.prior.sigma**2))
    if (~known).sum() == 1 and usual > limit:
        return int(np.argmin(known))
    worst = int(np.nanargmax(square))
    return worst if square[worst] > max(_LEAST_RATIO**2 * usual, limit) else None


def is_better_without(
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


def bags_contradicting_prior(
    windows: ThermalWindows, known: Calibration, options: FitOptions
) -> list[int]:
    """
    Find the bags whose drift contradicts a calibration of the same unit: with the unit's
    parameters fixed, no start states and tilts of the bag explain it.
    """
    data = replace(windows.data, tilt=windows.data.tilt[:, :0])
    constants = constants_of(known)
    regression = Regression(data, options.gravity, constants.scale)
    up = constants.force(position_means(data))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    state = _state_of(known, regression, up)
    first = informative_priors(known, regression, state, windows.model.sets, options)[0]
    # The noise of a window, as long as the calibration's typical ones.
    window_s = windows.typical_count * known.unit.cycle_time_s
    sigma = np.array(known.noise_density_m_s2_sqrt_hz) / np.sqrt(window_s)
    prior = Prior(
        bias_mean=state.bias,
        bias_sd=np.full(3, BIAS_SD),
        scale_sd=SCALE_SD,
        misalignment_sd=MISALIGNMENT_SD,
        column_sd=data.parts.astype(np.float64),
        # The level may have moved by a turn-on or by ageing: only the drift is judged.
        offset_sd=_LEVEL_SD,
        sigma=np.maximum(sigma, 1e-9),
        informative=replace(first, root=first.root * _PRECISION_FACTOR),
    )
    found = regression.solve(state, prior, n_steps=4)

    left = drift_of_positions(regression, regression.residual(found.state, found.layout))
    inverse = np.linalg.inv(first.root)
    claimed = drift_variance(regression, state, found.layout, inverse @ inverse.T)
    lacks = [point.sd_m_s2 for one in known.regime_sets() for point in one.lack_of_fit]
    lack = np.square(lacks).max(axis=0) if lacks else np.zeros(3)
    share = np.sum(left**2, axis=1) / np.sum(claimed + prior.sigma**2 + lack, axis=1)
    bag = data.bag
    mean = np.bincount(bag, share) / np.maximum(np.bincount(bag), 1)
    found_bags: list[int] = np.flatnonzero(mean > _LEAST_RATIO**2).tolist()
    return found_bags


def _state_of(known: Calibration, regression: Regression, up: Floats) -> State:
    constants = constants_of(known)
    inverse = np.asarray(np.linalg.inv(constants.misalignment), dtype=np.float64)
    begin = regression.initial_state(
        constants.bias / constants.scale, inverse[[1, 2, 2], [0, 0, 1]], up
    )
    return with_calibration(known, regression, begin)


def with_excluded_error(
    calibration: Calibration, bags: Sequence[ReducedBag], others: str
) -> tuple[Calibration, Finding]:
    """
    Add the error of the correction of bags that took no part to the lack of fit of both sets;
    `others` says what the bags contradict.
    """
    model = Model(
        calibration.provenance.model,
        prior_sets(calibration),
        prior_columns(calibration),
        calibration.sensors,
        calibration.detector,
        calibration.reference_temperature_c,
    )
    alone = thermal_windows(bags, model)
    constants = constants_of(calibration)
    regression = Regression(alone.data, calibration.gravity_m_s2, constants.scale)
    up = constants.force(position_means(alone.data))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    state = _state_of(calibration, regression, up)
    drift = drift_of_positions(regression, regression.force(state))
    is_dynamic = alone.weight > 0.5
    sets = []
    for one, rows in ((calibration.static, ~is_dynamic), (calibration.dynamic, is_dynamic)):
        square = np.mean(drift[rows if rows.any() else slice(None)] ** 2, axis=0)
        sets.append(_widened(one, square))
    static, dynamic = sets
    rms = float(np.sqrt(np.mean(drift**2))) / MICRO_G
    names = ', '.join(one_line(bag.source.name) for bag in bags)
    finding = Finding(
        'environment',
        'advice',
        f'{names}: the correction by {others} leaves a drift of {rms:.0f} ug. The recording took '
        'no part in the fit, and the claim includes this error. Another environment, with the '
        'fan off or mounted elsewhere, needs a calibration of its own',
    )
    return replace(calibration, static=static, dynamic=dynamic), finding


def _widened(one: RegimeSet, square: Floats) -> RegimeSet:
    points: Sequence[LackOfFit] = one.lack_of_fit
    if not points:
        points = (LackOfFit(float(np.mean(one.temperature_range_c)), (0.0, 0.0, 0.0)),)
    wider = []
    for point in points:
        x, y, z = np.sqrt(np.square(point.sd_m_s2) + square).tolist()
        wider.append(replace(point, sd_m_s2=(x, y, z)))
    return replace(one, lack_of_fit=tuple(wider))
