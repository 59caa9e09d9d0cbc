# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the error of an axis at temperatures at which no position had gravity along this axis.

A scale factor has an effect on the readings only if gravity acts along its axis. A recording in
one attitude at new temperatures extends the temperature range of the calibration, but determines
only the scale factor of the vertical axis at these temperatures. The scale factors of the other
axes are extrapolated, and the error of this extrapolation is added to the lack of fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..typing import Floats
from ..unit.calibration import Calibration, LackOfFit
from .data_checks import Finding, advice
from .selection import Fit
from .thermal_ranges import Range, union
from .windows import CURVE, PART

#: Smallest component of gravity along an axis, in g, for a position to determine the scale factor
#: of the axis. At 0.5, the relative error of |f| is a quarter of that of the scale factor.
LEAST_GRAVITY_SHARE = 0.5
#: Largest extrapolation of a scale factor without added error, divided by the temperature range of
#: the positions along its axis: ranges of positions in one test differ by about this ratio.
FREE_RANGE_SHARE = 0.1
#: Extrapolation of a scale factor above which a position is advised [K].
LEAST_KELVINS = 2.0


def with_unseen_axes(
    fit: Fit, lacks: Sequence[tuple[LackOfFit, ...]], known: Calibration | None
) -> list[tuple[LackOfFit, ...]]:
    """
    Add the error of extrapolated scale factors to the lack of fit of each regime, `lacks`.

    `known`: calibration that was the prior, or None. At temperatures at which no position of the
    bags determines the scale of an axis, the lack of fit of the axis is at least the prior's.
    """
    (lower, upper), (new_lower, new_upper) = _known_ranges(fit, known), _seen(fit, None)
    slope = _unknown_slope(fit) * fit.regression.gravity
    ends = _ends(fit, known)
    # The variance grows with the square of the distance in K, but is interpolated linearly
    # between temperatures, so five temperatures are used.
    between = [
        np.linspace(edge, end, 5)
        for edge, end in zip((lower.max(), upper.min()), ends, strict=True)
        if ends[0] < edge < ends[1]
    ]
    result = []
    for k, lack in enumerate(lacks):
        of_prior = known.regime_sets()[k].lack_of_fit if known else ()
        points = [point.temperature_c for point in (*lack, *of_prior)]
        at = np.unique(np.concatenate((*between, points)))[:, np.newaxis]
        is_new = (new_lower <= at) & (at <= new_upper)
        variance = _variance(lack, at[:, 0])
        before = _variance(of_prior, at[:, 0])
        variance = np.where(is_new, variance, np.maximum(variance, before))
        kelvins = np.maximum(np.maximum(lower - at, at - upper), 0.0)
        sd = np.sqrt(variance + (slope * kelvins) ** 2)
        rows = np.hstack((at, sd)).tolist() if sd.any() else []
        result.append(tuple(LackOfFit(celsius, (x, y, z)) for celsius, x, y, z in rows))
    return result


def judge_unseen_axes(fit: Fit, known: Calibration | None) -> list[Finding]:
    """Advise a position at temperatures at which no position determines an axis' scale factor."""
    if not fit.regression.gravity:
        return []
    findings = []
    lower, upper = _known_ranges(fit, known)
    first, last = _ends(fit, known)
    below, above = lower > first + LEAST_KELVINS, upper < last - LEAST_KELVINS
    for where, end, edge, is_unseen in (
        ('below', first, lower[below].max(initial=first), below),
        ('above', last, upper[above].min(initial=last), above),
    ):
        if is_unseen.any():
            names = ' and '.join('xyz'[axis] for axis in np.flatnonzero(is_unseen))
            text = (
                f'{where} {edge:.0f} degC no position has gravity along {names}: the scale factor '
                f'of {names} is extrapolated to {end:.0f} degC, and the published uncertainty '
                f'includes this error. Record a position with {names} up in this range'
            )
            findings.append(advice('axes', text))
    return findings


def _known_ranges(fit: Fit, known: Calibration | None) -> Floats:
    """
    Return the range of board temperature of each axis without an added error of its scale factor,
    shape (2, 3) [degC]. The range is infinite for an axis along which no position has gravity:
    its scale factor keeps the sd of the prior, which includes the error.
    """
    lower, upper = _seen(fit, known)
    reach = FREE_RANGE_SHARE * (upper - lower)
    is_seen = lower <= upper
    return np.where(is_seen, (lower - reach, upper + reach), [[-np.inf], [np.inf]])


def _seen(fit: Fit, known: Calibration | None) -> Floats:
    """
    Return the lowest and the highest board temperature of the positions with gravity along each
    axis, and of a prior calibration, shape (2, 3) [degC]; (inf, -inf) if there are none.
    """
    temperature = fit.windows.temperature[:, np.newaxis]
    is_along = np.abs(fit.posterior.state.up) >= LEAST_GRAVITY_SHARE
    is_seen = is_along[fit.windows.data.position]
    lower = np.where(is_seen, temperature, np.inf).min(axis=0)
    upper = np.where(is_seen, temperature, -np.inf).max(axis=0)
    for regime in known.regime_sets() if known else ():
        lower = np.minimum(lower, regime.temperature_range_c[0])
        upper = np.maximum(upper, regime.temperature_range_c[1])
    return np.array((lower, upper))


def _ends(fit: Fit, known: Calibration | None) -> Range:
    """Return the lowest and the highest board temperature of all windows and of a prior [degC]."""
    temperature = fit.windows.temperature
    ranges = [regime.temperature_range_c for regime in known.regime_sets()] if known else []
    return union([(float(temperature.min()), float(temperature.max())), *ranges])


def _unknown_slope(fit: Fit) -> float:
    """
    Return the sd of the slope of an extrapolated scale factor [1/K]: half of the RMS, over the
    axes, of the slopes of the fitted scale curves.
    """
    windows, state = fit.windows.data, fit.posterior.state
    is_curve = np.isin(windows.groups, (CURVE, PART)) & (windows.kelvins > 0.0)
    slopes = state.weights[1][:, is_curve] / windows.kelvins[is_curve]
    return 0.5 * float(np.sqrt(np.mean(np.sum(slopes**2, axis=1))))


def _variance(points: Sequence[LackOfFit], at: Floats) -> Floats:
    """Return the variance of a lack of fit at board temperatures `at`, shape (n, 3)."""
    if not points:
        return np.zeros((len(at), 3))
    celsius = [point.temperature_c for point in points]
    variances = np.square([point.sd_m_s2 for point in points])
    return np.column_stack([np.interp(at, celsius, axis) for axis in variances.T])
