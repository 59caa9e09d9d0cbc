# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ranges of temperatures, rates and gradients in a fit's data, and the lag of the board."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..thermal.settings import RAMP_K_MIN
from ..thermal.state import USUAL_BOARD_LAG_S
from ..typing import Floats
from ..unit.calibration import Calibration
from .windows import ThermalWindows

Range = tuple[float, float]


def union(ranges: Iterable[Range]) -> Range:
    """Return the smallest range that contains all given ranges."""
    lower, upper = zip(*ranges, strict=True)
    return min(lower), max(upper)


def valid_range(values: Floats, smallest_margin: float, order: int = 0) -> Range:
    """
    Return the valid range of a quantity that is proportional to a power (`order`) of a heat flow:
    the range of its values with a margin, extended by a factor 2^order to ramps of twice the rate,
    as heat flow is proportional to the rate. The range of a temperature (order 0) is not extended.
    """
    ratio = 2.0**order
    lower, upper = float(np.min(values)), float(np.max(values))
    # The margin of 2 % of the span allows for the noise of thermometers in use.
    margin = max(0.02 * (upper - lower), smallest_margin)
    lower, upper = lower - margin, upper + margin
    return min(lower, ratio * lower), max(upper, ratio * upper)


def temperature_range(windows: ThermalWindows) -> Range:
    """Return the valid range of board temperatures [degC]."""
    # A calibration from one temperature is valid within 0.5 K of this temperature or, without a
    # thermometer, within 50 K, as the covariance then includes an unknown slope over temperature.
    return valid_range(windows.temperature, 0.5 if windows.was_measured else 50.0)


def soak_gradient(windows: ThermalWindows, known: Calibration | None) -> Range | None:
    """
    Return the gradient of the first sensor in soaks and its robust scatter [K], from the prior
    calibration `known` if it has both; None without the sensor or without a soak.
    """
    if known is not None and known.soak_gradient_k is not None:
        return known.soak_gradient_k
    rate = 60.0 * np.abs(windows.rate)
    # If the rate is noisy, the tenth of the windows with the smallest rates counts as soak.
    slowest = max(0.2 * RAMP_K_MIN, float(np.quantile(rate, 0.1)))
    is_soak = rate <= slowest
    if not windows.gradient.any() or slowest > RAMP_K_MIN or is_soak.sum() < 5:
        return None
    # The gradient at rate 0 follows from a line over the rate, which is not yet 0 in a soak.
    gradient, by_rate = windows.gradient[is_soak], np.vander(windows.rate[is_soak], 2)
    slope, middle = np.linalg.lstsq(by_rate, gradient, rcond=None)[0].tolist()
    scatter = np.abs(gradient - by_rate @ (slope, middle))
    return middle, 1.4826 * float(np.median(scatter))


def rest_gradient_range(
    windows: ThermalWindows, lag_s: float, known: Calibration | None
) -> Range | None:
    """
    Return the range of the first sensor's gradient less ``lag_s * rate``, the change in ramps.

    The range of a prior calibration, `known`, is included. If the prior has no range, the result
    is None without the sensor, without ramps, which determine the lag, or for values above 100 K,
    as in bags that are too short for a rate.
    """
    lower, upper = valid_range(windows.gradient - lag_s * windows.rate, 0.01)
    is_small = max(-lower, upper) < 100.0
    ranges = [(lower, upper)] if _has_gradients(windows) and is_small else []
    if known is not None and known.rest_gradient_range_k is not None:
        ranges.append(known.rest_gradient_range_k)
    return union(ranges) if ranges else None


def measured_board_lag(windows: ThermalWindows) -> float:
    """
    Return the lag of the board temperature behind that of the case [s], negative if the board
    leads; NaN without ramps or without a case temperature.
    """
    return _slope_of_gradient(windows) if _has_gradients(windows) else np.nan


def _has_gradients(windows: ThermalWindows) -> bool:
    """Whether the case temperature was recorded in ramps."""
    has_ramps = 60.0 * float(windows.rate.std()) > RAMP_K_MIN
    return bool(windows.gradient.any()) and has_ramps


def usable_board_lag(windows: ThermalWindows) -> float:
    """Return the lag of the board behind the case [s]; `USUAL_BOARD_LAG_S` if not 1..1e5 s."""
    lag = _slope_of_gradient(windows)
    return lag if 1.0 <= lag <= 1e5 else USUAL_BOARD_LAG_S


def _slope_of_gradient(windows: ThermalWindows) -> float:
    """Return the slope of the gradient over the rate [s], NaN at a constant rate."""
    rate = windows.rate - np.mean(windows.rate)
    power = float(rate @ rate)
    return float(rate @ windows.gradient) / power if power > 0.0 else np.nan
