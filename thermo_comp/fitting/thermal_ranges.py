# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ranges of temperatures, rates and gradients in a fit's data, the lag of the board, and the
error of an axis at temperatures at which no position has gravity along this axis.

A scale factor has an effect on the samples only if gravity acts along its axis. A recording in
one attitude at new temperatures extends the temperature range of the calibration, but determines
only the scale factor of the vertical axis at the new temperatures. The scale factors of the
horizontal axes are extrapolated; the error of the extrapolation is added to the lack of fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..thermal.settings import RAMP_K_MIN
from ..thermal.state import USUAL_BOARD_LAG_S
from ..typing import Floats
from ..unit.calibration import Calibration, LackOfFit
from .data_checks import Finding, advice
from .selection import Fit
from .sensors import slope_of_gradient
from .windows import CURVE, PART, ThermalWindows

Range = tuple[float, float]


def union(ranges: Iterable[Range]) -> Range:
    """Return the smallest range that contains all given ranges."""
    lower, upper = zip(*ranges, strict=True)
    return min(lower), max(upper)


def valid_range(values: Floats, smallest_margin: float, order: int = 0) -> Range:
    """
    Return the valid range of a quantity: the range of its values with a margin. A quantity
    proportional to a power `order` of the ramp rate is valid in ramps of twice the rate: its range
    is extended by the factor 2^order.
    """
    ratio = 2.0**order
    lower, upper = float(np.min(values)), float(np.max(values))
    # The margin of 2 % of the range allows for the noise of thermometers in use.
    margin = max(0.02 * (upper - lower), smallest_margin)
    lower, upper = lower - margin, upper + margin
    return min(lower, ratio * lower), max(upper, ratio * upper)


def temperature_range(windows: ThermalWindows) -> Range:
    """Return the valid range of board temperatures [degC]."""
    # A calibration from one temperature is valid within 0.5 K of this temperature. A calibration
    # without a thermometer is valid within 50 K, as its covariance includes an unknown slope.
    return valid_range(windows.temperature, 0.5 if windows.was_measured else 50.0)


def soak_gradient(windows: ThermalWindows, earlier: Calibration | None) -> Range | None:
    """
    Return the gradient of the first sensor in soaks, and the sd of its scatter [K]: the values of
    the prior `earlier` if it has them, else of the windows; None without sensor or soak.
    """
    if earlier is not None and earlier.soak_gradient_k is not None:
        return earlier.soak_gradient_k
    rate = 60.0 * np.abs(windows.rate)
    # For noisy rates, the tenth of the windows with the smallest rates is taken as a soak.
    slowest = max(0.2 * RAMP_K_MIN, float(np.quantile(rate, 0.1)))
    is_soak = rate <= slowest
    if not windows.gradient.any() or slowest > RAMP_K_MIN or is_soak.sum() < 5:
        return None
    # Rates in a soak are not exactly 0: fit a line over the rate to get the gradient at rate 0.
    gradient, by_rate = windows.gradient[is_soak], np.vander(windows.rate[is_soak], 2)
    slope, middle = np.linalg.lstsq(by_rate, gradient, rcond=None)[0].tolist()
    scatter = np.abs(gradient - by_rate @ (slope, middle))
    return middle, 1.4826 * float(np.median(scatter))


def rest_gradient_range(
    windows: ThermalWindows, lag_s: float, earlier: Calibration | None
) -> Range | None:
    """
    Return the valid range of the first sensor's gradient at rate 0, ``gradient - lag_s * rate``.

    The result includes the range of the prior calibration `earlier`. The range of the windows is
    ignored if there is no sensor, if there are no ramps (which determine the lag), or if the range
    exceeds +-100 K, as for bags too short for a rate. The result is None if no range remains.
    """
    lower, upper = valid_range(windows.gradient - lag_s * windows.rate, 0.01)
    is_small = max(-lower, upper) < 100.0
    ranges = [(lower, upper)] if _has_gradients(windows) and is_small else []
    if earlier is not None and earlier.rest_gradient_range_k is not None:
        ranges.append(earlier.rest_gradient_range_k)
    return union(ranges) if ranges else None


def measured_board_lag(windows: ThermalWindows) -> float:
    """Return the lag of the board behind the case [s]; NaN without ramps or case temperature."""
    return slope_of_gradient(windows.gradient, windows.rate) if _has_gradients(windows) else np.nan


def _has_gradients(windows: ThermalWindows) -> bool:
    """Whether the case temperature was recorded in ramps."""
    has_ramps = 60.0 * float(windows.rate.std()) > RAMP_K_MIN
    return bool(windows.gradient.any()) and has_ramps


def usable_board_lag(windows: ThermalWindows) -> float:
    """Return the board's lag behind the case [s]; the usual lag if it is not in 1..1e5 s."""
    lag = slope_of_gradient(windows.gradient, windows.rate)
    return lag if 1.0 <= lag <= 1e5 else USUAL_BOARD_LAG_S


def with_unseen_axes(
    fit: Fit, lacks: Sequence[tuple[LackOfFit, ...]], earlier: Calibration | None
) -> list[tuple[LackOfFit, ...]]:
    """
    Add the error of extrapolated scale factors to the lack of fit of each regime, `lacks`.

    `earlier`: calibration used as prior, or None. The lack of fit of `earlier` is the least value
    for an axis at temperatures at which no position of the bags has gravity along the axis.
    """
    (lower, upper), (new_lower, new_upper) = _determined_ranges(fit, earlier), _seen(fit, None)
    slope = _unknown_slope(fit) * fit.regression.gravity
    ends = _ends(fit, earlier)
    # A calibration interpolates variances of the lack of fit linearly, but the variance of an
    # extrapolated scale factor is quadratic in temperature: state it at five temperatures.
    between = [
        np.linspace(edge, end, 5)
        for edge, end in zip((lower.max(), upper.min()), ends, strict=True)
        if ends[0] < edge < ends[1]
    ]
    result = []
    for k, lack in enumerate(lacks):
        of_prior = earlier.regime_sets()[k].lack_of_fit if earlier else ()
        points = [point.temperature_c for point in (*lack, *of_prior)]
        at = np.unique(np.concatenate((*between, points)))[:, np.newaxis]
        is_new = (new_lower <= at) & (at <= new_upper)
        variance, before = _variance(lack, at[:, 0]), _variance(of_prior, at[:, 0])
        variance = np.where(is_new, variance, np.maximum(variance, before))
        kelvins = np.maximum(np.maximum(lower - at, at - upper), 0.0)
        sd = np.sqrt(variance + (slope * kelvins) ** 2)
        rows = np.hstack((at, sd)).tolist() if sd.any() else []
        result.append(tuple(LackOfFit(celsius, (x, y, z)) for celsius, x, y, z in rows))
    return result


def judge_unseen_axes(fit: Fit, earlier: Calibration | None) -> list[Finding]:
    """Advise a position where a scale factor is extrapolated over more than 2 K."""
    findings = []
    (lower, upper), (first, last) = _determined_ranges(fit, earlier), _ends(fit, earlier)
    below, above = lower > first + 2.0, upper < last - 2.0
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


def _determined_ranges(fit: Fit, earlier: Calibration | None) -> Floats:
    """
    Return the range of board temperature, shape (2, 3) [degC], in which the scale factor of each
    axis has no error of extrapolation. An axis along which no position has gravity has an infinite
    range: the prior sd of its scale factor includes the error of extrapolation.
    """
    lower, upper = _seen(fit, earlier)
    # The temperature ranges of the positions of one test differ by about a tenth of their span.
    margin = 0.1 * (upper - lower)
    is_seen = lower <= upper
    return np.where(is_seen, (lower - margin, upper + margin), [[-np.inf], [np.inf]])


def _seen(fit: Fit, earlier: Calibration | None) -> Floats:
    """
    Return for each axis the lowest and the highest board temperature of the positions with gravity
    along the axis, and of a prior, shape (2, 3) [degC]; (inf, -inf) without prior and position.
    """
    temperature = fit.windows.temperature[:, np.newaxis]
    # With 0.5 g along an axis, |f| has a quarter of the relative error of the axis' scale factor.
    is_along = np.abs(fit.posterior.state.up) >= 0.5
    is_seen = is_along[fit.windows.data.position]
    lower = np.where(is_seen, temperature, np.inf).min(axis=0)
    upper = np.where(is_seen, temperature, -np.inf).max(axis=0)
    for regime in earlier.regime_sets() if earlier else ():
        lower = np.minimum(lower, regime.temperature_range_c[0])
        upper = np.maximum(upper, regime.temperature_range_c[1])
    return np.array((lower, upper))


def _ends(fit: Fit, earlier: Calibration | None) -> Range:
    """Return the lowest and highest board temperatures of the windows and the prior [degC]."""
    temperature = fit.windows.temperature
    ranges = [regime.temperature_range_c for regime in earlier.regime_sets()] if earlier else []
    return union([(float(temperature.min()), float(temperature.max())), *ranges])


def _unknown_slope(fit: Fit) -> float:
    """Return the sd of an extrapolated scale factor's slope [1/K]: half the RMS fitted slope."""
    windows, state = fit.windows.data, fit.posterior.state
    is_curve = np.isin(windows.groups, (CURVE, PART)) & (windows.kelvins > 0.0)
    slopes = state.weights[1][:, is_curve] / windows.kelvins[is_curve]
    return 0.5 * float(np.sqrt(np.mean(np.sum(slopes**2, axis=1))))


def _variance(points: Sequence[LackOfFit], at: Floats) -> Floats:
    """Return variances of a lack of fit at board temperatures `at`, (n, 3) [(m/s^2)^2]."""
    if not points:
        return np.zeros((len(at), 3))
    celsius = [point.temperature_c for point in points]
    variances = np.square([point.sd_m_s2 for point in points])
    return np.column_stack([np.interp(at, celsius, axis) for axis in variances.T])
