# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the exclusion of bags that were recorded in another thermal environment (such as still air)
than most bags or a prior calibration, and the error that the calibration states for these bags.

In still air the board temperature responds to the case temperature in another way than in a
chamber with a fan. No thermometer is at the axes, so in another environment the bias is another
function of the measured temperatures. A bag from still air in the fit would increase the error of
the calibration in a chamber with a fan. The error of the correction in an excluded bag is
published as a lack of fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..text import one_line
from ..typing import Bools, Floats
from ..unit.calibration import Calibration, LackOfFit, RegimeSet
from ..unit.gravity import MICRO_G
from .coverage import distinct_directions
from .data_checks import POSITIONS_NEEDED, Finding, advice
from .evidence import drift_variance
from .initial_triad import within_positions
from .initialisation import initial_state
from .left_out import Folds
from .options import FitOptions
from .priors import constants_of, informative_priors, offset_sd_of, prior_model, with_calibration
from .reduction import ReducedBag
from .regression import Regression
from .selection import Fit
from .unknowns import Prior, State, Windows
from .windows import ThermalWindows, thermal_windows


def _is_far_above(square: Floats | float, usual: float) -> Bools:
    return np.asarray(square > 5.0**2 * usual)


def contradicting_bag(fit: Fit) -> list[int]:
    """
    Return, in a list, the index of a bag that may be of another environment; [] if no bag is.

    A bag is suspect if its left-out drift exceeds five times both the median over the bags and the
    white noise of a window. If the left-out drift of exactly one bag is unknown, that bag is
    suspect as soon as the other bags' median left-out drift exceeds five times the white noise.
    """
    square = _square_of_bags(fit)
    is_scored = np.isfinite(square)
    if is_scored.sum() < 4:
        # At least four bags are needed to decide that one bag contradicts the majority.
        return []
    usual = float(np.median(square[is_scored]))
    noise = float(np.mean(fit.posterior.prior.sigma**2))
    if (~is_scored).sum() == 1 and _is_far_above(usual, noise):
        return [int(np.argmin(is_scored))]
    worst = int(np.nanargmax(square))
    return [worst] if _is_far_above(square[worst], max(usual, noise)) else []


def is_better_without(whole: Fit, rest: Fit, bag: int) -> bool:
    """Whether excluding `bag` more than halves the other bags' mean square left-out drift."""
    before, after = np.delete(_square_of_bags(whole), bag), _square_of_bags(rest)
    is_scored = np.isfinite(before) & np.isfinite(after)
    return bool(is_scored.any() and before[is_scored].mean() > 2.0 * after[is_scored].mean())


def _square_of_bags(fit: Fit) -> Floats:
    """Return the mean square left-out drift of each bag [(m/s^2)^2], NaN if unknown, (n_bags,)."""
    data, folds = fit.windows.data, fit.selected.score.positions
    bag = data.bag_of_position[np.flatnonzero(np.diff(data.mounting, prepend=-1))]
    return Folds.of(folds.square, folds.windows, bag).square


def contradiction(
    windows: ThermalWindows, earlier: Calibration, options: FitOptions
) -> tuple[list[int], bool]:
    """
    Return the indices of the bags whose drift the calibration `earlier` of their unit does not
    explain with any initial lag states; if these bags are the majority, return all indices.

    Also return whether the bags can update `earlier`: either ``|f| - g`` far exceeds the drift and
    the published sd of |f|, which shows a change of bias or scale; or the bags have the six
    attitudes that determine bias and scale.
    """
    data = replace(windows.data, tilt=windows.data.tilt[:, :0])
    regression, state = _at_calibration(earlier, data, options.gravity)
    first = next(informative_priors(earlier, regression, state, windows.model, options))
    # Length of a typical window [s], and the white noise of its mean [m/s^2].
    window_s = windows.typical_count * earlier.unit.cycle_time_s
    sigma = np.array(earlier.noise_density_m_s2_sqrt_hz) / np.sqrt(window_s)
    prior = Prior(
        column_sd=data.parts.astype(np.float64),
        # Only drifts are compared: bias offsets of 1 mg, by turn-ons or ageing, are allowed.
        offset_sd=1e-2,
        sigma=np.maximum(sigma, 1e-9),
        # Prior sds divided by 1e4 keep the parameters practically at the calibration's values.
        informative=replace(first, root=1e4 * first.root),
    )
    fitted = regression.solve(state, prior, n_steps=4)
    drift = within_positions(regression.residual(fitted.state, fitted.layout), data.position)
    inverse = np.linalg.inv(first.root)
    claimed = drift_variance(regression, state, fitted.layout, inverse @ inverse.T)
    lacks = [point.sd_m_s2 for regime in earlier.regime_sets() for point in regime.lack_of_fit]
    lack = np.square(lacks).max(axis=0) if lacks else np.zeros(3)
    ratio = np.sum(drift**2, axis=1) / np.sum(claimed + prior.sigma**2 + lack, axis=1)
    mean = np.bincount(data.bag, ratio) / np.maximum(np.bincount(data.bag), 1)
    norm = regression.norm_errors(state)
    along = regression.at(state, prior).norms_by_unit @ inverse
    usual = np.mean(drift**2) + np.mean(np.sum(along**2, axis=1)) + offset_sd_of(earlier) ** 2
    may_update = bool(_is_far_above(float(np.mean(norm**2)), usual))
    is_far = _is_far_above(mean, 1.0)
    if np.mean(is_far) > 0.5:
        # A change of environment hardly shows in some attitudes: if most bags deviate, return all.
        is_far[:] = True
    may_update |= len(distinct_directions(state.up)) >= POSITIONS_NEEDED
    return np.flatnonzero(is_far).tolist(), may_update


def _at_calibration(
    calibration: Calibration, data: Windows, gravity: float
) -> tuple[Regression, State]:
    """Return the regression of windows, and the state of its unknowns that a calibration gives."""
    constants = constants_of(calibration)
    regression = Regression(data, gravity, constants.scale)
    state = initial_state(regression, constants, constants.directions(data))
    return regression, with_calibration(calibration, regression, state)


def with_excluded_error(
    calibration: Calibration, bags: Sequence[ReducedBag], others: str, *, is_updated: bool
) -> tuple[Calibration, Finding]:
    """
    Add to the lack of fit of both regimes the drift, and the error of |f|, that remain in `bags`
    after the correction.

    `others`: text that names what `bags` contradict, other bags or the prior; `is_updated`:
    whether `bags` were used in the fit
    """
    windows = thermal_windows(bags, prior_model(calibration))
    regression, state = _at_calibration(calibration, windows.data, calibration.gravity_m_s2)
    drift = within_positions(regression.force(state), windows.data.position)
    of_norms = np.mean(regression.norm_errors(state) ** 2)
    regimes = ~windows.is_dynamic, windows.is_dynamic
    # A regime without windows gets the drift of all windows.
    static, dynamic = (
        _widened(regime, of_norms + np.mean(drift[rows | ~rows.any()] ** 2, axis=0))
        for regime, rows in zip(calibration.regime_sets(), regimes, strict=True)
    )
    names = ', '.join(one_line(bag.source.name) for bag in bags)
    rms = float(np.sqrt(np.mean(drift**2))) / MICRO_G
    text = (
        f'{names}: the correction by {others} leaves a drift of {rms:.0f} ug. The fit did not use '
        'these data; the published uncertainty includes their errors. Another environment, such '
        'as still air or another mounting, needs a separate calibration'
    )
    if is_updated:
        text = (
            f'{names}: the unit, or its environment, has changed since {others}: the effects of '
            f'temperature differ. The fit leaves a drift of {rms:.0f} ug, which the published '
            f'uncertainty includes. Bags over the whole temperature range allow a fit without '
            f'{others}'
        )
    return replace(calibration, static=static, dynamic=dynamic), advice('environment', text)


def _widened(regime: RegimeSet, square: Floats) -> RegimeSet:
    """Add a variance of each axis, shape (3,), to the lack of fit of a regime."""
    middle = LackOfFit(float(np.mean(regime.temperature_range_c)), (0.0, 0.0, 0.0))
    points = []
    for point in regime.lack_of_fit or (middle,):
        x, y, z = np.sqrt(np.square(point.sd_m_s2) + square).tolist()
        points.append(replace(point, sd_m_s2=(x, y, z)))
    return replace(regime, lack_of_fit=tuple(points))
