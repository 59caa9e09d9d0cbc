# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the estimation of the settings of thermometers and of the regime detector from bags.

Temperature rates are central differences over two minutes of a recording. The rates show the lags
of the thermometers and the ramps of the test. The settings of the thermal tracker and of the
regime detector are computed from lags, ramps and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy.integrate import cumulative_trapezoid

from ..thermal.plausibility import LARGEST_STEP
from ..thermal.settings import OBVIOUS_SHARE, RAMP_K_MIN, DetectorSettings, ThermometerSettings
from ..typing import Floats, Ints
from .reduction import Readings, ReducedBag

# Interval between temperature rates [s]; number of intervals on each side of a central difference.
_BIN_S, _BINS_PER_SIDE = 10.0, 6


@dataclass(frozen=True)
class RateHistory:
    """Temperature rates of a thermometer at intervals of 10 s, and sd of their noise [K/s]."""

    rate: Floats
    rate_sd: float

    @property
    def least_ramp(self) -> float:
        """Smallest rate of a ramp that noise does not hide [K/s]: 5 sd of the noise of a rate."""
        return 5.0 * self.rate_sd

    @property
    def fastest(self) -> float:
        """The 99 % quantile of the absolute rate of the temperature [K/s]."""
        return float(np.quantile(np.abs(self.rate), 0.99))


def learn_detector(bags: Sequence[ReducedBag]) -> DetectorSettings:
    """Return detector settings that suit the noise, lags and ramps in the bags."""
    base = DetectorSettings()
    board = learn_thermometer([bag.board for bag in bags], base.board)
    case = learn_thermometer([bag.case for bag in bags], base.case)
    histories = _histories([bag.case for bag in bags], case.noise_sd_c, case.quantum_c)
    smallest = min(base.smallest_ramp_k_min, _slowest_ramp(histories, base.smallest_ramp_k_min))
    return replace(
        base,
        smallest_ramp_k_min=smallest,
        relaxed_rate_k_min=min(base.relaxed_rate_k_min, 0.4 * smallest / OBVIOUS_SHARE),
        ripple_c=_ripple(histories, case.lag_s, base.ripple_c),
        board=board,
        case=case,
    )


def learn_thermometer(
    recorded: Sequence[Readings], base: ThermometerSettings
) -> ThermometerSettings:
    """Estimate the quantum, noise, lag and fastest ramp of a thermometer from its readings."""
    long = [readings for readings in recorded if len(readings.value) >= 30]
    if not long:
        return base
    quantum = quantum_of(np.concatenate([readings.value for readings in long]))
    # A noise setting below 0.1 mK would let the estimated temperature follow rounding errors.
    noise = max(_noise_of(long, quantum), 1e-4)
    histories = _histories(recorded, noise, quantum)
    with_ramps = [history for history in histories if history.fastest > history.least_ramp]
    if not with_ramps:
        return replace(base, noise_sd_c=noise, quantum_c=quantum)
    fastest = max(history.fastest for history in with_ramps)
    # At the start of a ramp a temperature with a first-order lag has the second derivative
    # ``rate / lag``, which is estimated from the difference of two rates one minute apart.
    lags = []
    for history in with_ramps:
        change = np.abs(history.rate[_BINS_PER_SIDE:] - history.rate[:-_BINS_PER_SIDE])
        if (steepest := float(np.quantile(change, 0.995)) / (_BIN_S * _BINS_PER_SIDE)) > 0.0:
            lags.append(history.fastest / steepest)
    # The estimate of the temperature restarts after a pause longer than the lag, so the setting of
    # the lag is at least three times the interval between readings.
    interval_ns = max(float(np.median(np.diff(readings.stamp_ns))) for readings in long)
    least_s = min(max(30.0, 3e-9 * interval_ns), 3600.0)
    lag = float(np.clip(np.median(lags), least_s, 3600.0)) if lags else base.lag_s
    return replace(
        base,
        noise_sd_c=noise,
        quantum_c=quantum,
        # The temperature of a unit in use may change up to 1.5 times faster than in the test.
        fastest_ramp_k_min=max(base.fastest_ramp_k_min, 1.5 * 60.0 * fastest),
        lag_s=round(lag, 1),
    )


def quantum_of(values: Floats) -> float:
    """Return the quantum of readings [K], the step to which they are rounded; 0 if not rounded."""
    levels = np.unique(np.round(values, 9))
    if len(levels) < 2 or len(levels) > 0.5 * len(values):
        return 0.0
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.min(gaps)]))
    steps = gaps / step
    is_grid = np.abs(steps - np.rint(steps)) < 0.1
    return round(step, 9) if is_grid.mean() > 0.9 else 0.0


def _noise_of(recorded: Sequence[Readings], quantum: float) -> float:
    # Second differences contain no linear ramp; for white noise of sd s their sd is s sqrt(6).
    second = np.concatenate([np.diff(readings.value, 2) for readings in recorded])
    if not quantum:
        return 1.4826 * float(np.median(np.abs(second))) / float(np.sqrt(6.0))
    # Most rounded readings equal their neighbours, so the median of the differences is 0. The mean
    # square of the differences, without the largest 1 %, less the rounding variance is used.
    square = np.sort(second**2)[: int(0.99 * len(second))]
    noise = float(np.sqrt(max(float(square.mean()) / 6.0 - quantum**2 / 12.0, 0.0)))
    limit = 0.1 * quantum
    return noise if noise > limit else float(np.clip(_flicker(recorded), 0.1 * limit, limit))


def _flicker(recorded: Sequence[Readings]) -> float:
    """
    Return the sd of the noise of readings whose quantum is much larger than the noise [K]. While
    the temperature passes the edge between two rounded values at the rate r, readings at intervals
    h with noise of sd s change ``2 s / (r h sqrt(pi))`` times, but at least once.
    """
    moves = inverse_rates = 0.0
    for readings in recorded:
        time, value = (readings.stamp_ns - readings.stamp_ns[0]) * 1e-9, readings.value
        changed = np.flatnonzero(np.diff(value))
        edges = 0.5 * (value[changed] + value[changed + 1])
        first = np.flatnonzero(np.diff(edges, prepend=np.nan))
        count = np.diff(np.append(first, len(edges)))
        edge, at_s = edges[first], time[changed[first]]
        # Leave out edges at which the temperature reverses.
        step, apart_s = edge[2:] - edge[:-2], at_s[2:] - at_s[:-2]
        passes = np.abs(step) > 1e-9
        moves += float(np.sum(count[1:-1][passes] ** 2 - 1)) * float(np.median(np.diff(time))) ** 2
        inverse_rates += float(np.sum((apart_s[passes] / step[passes]) ** 2))
    return 0.5 * float(np.sqrt(np.pi * moves / (inverse_rates or np.inf)))


def _histories(recorded: Sequence[Readings], noise: float, quantum: float) -> list[RateHistory]:
    """Return the temperature rates of each bag with at least 30 readings and 6 minutes."""
    side = _BIN_S * _BINS_PER_SIDE
    result = []
    for readings in recorded:
        time = (readings.stamp_ns - readings.stamp_ns[:1]) * 1e-9
        n_bins = int(time[-1] / _BIN_S) if len(time) >= 30 else 0
        if n_bins < 6 * _BINS_PER_SIDE:
            continue
        # The mean temperature over a minute is the change of its integral, divided by 60 s.
        integral = cumulative_trapezoid(readings.value, time, initial=0)
        edges = np.interp(np.arange(n_bins + 1) * _BIN_S, time, integral)
        means = (edges[_BINS_PER_SIDE:] - edges[:-_BINS_PER_SIDE]) / side
        rate = (means[_BINS_PER_SIDE:] - means[:-_BINS_PER_SIDE]) / side
        per_side = max(1.0, side * (len(time) - 1) / time[-1])
        # Rounding errors of a temperature that changes by less than a quantum do not average out.
        spread = np.sqrt(2.0 * (noise**2 / per_side + quantum**2 / 12.0))
        result.append(RateHistory(rate, float(spread) / side))
    return result


def _slowest_ramp(histories: Sequence[RateHistory], usual: float) -> float:
    """Return 0.7 times the rate of the slowest ramp over 10 min, in RAMP_K_MIN..usual [K/min]."""
    slowest = usual / 0.7
    for history in histories:
        is_ramp = np.abs(history.rate) > max(history.least_ramp, 0.1 / 60.0)
        edges = np.flatnonzero(np.diff(is_ramp, prepend=False, append=False))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if (stop - start) * _BIN_S > 600.0:
                middle = float(np.quantile(np.abs(history.rate[start:stop]), 0.9)) * 60.0
                slowest = min(slowest, middle)
    return max(0.7 * slowest, RAMP_K_MIN)


def _ripple(histories: Sequence[RateHistory], lag_s: float, usual: float) -> float:
    """Return the amplitude of the periodic changes of the case temperature in soaks [K]."""
    rates = [np.zeros(0)]
    for history in histories:
        moving = np.abs(history.rate) > max(0.2 * history.fastest, history.least_ramp)
        # A grid point is in a soak if no ramp is within five minutes before or after it.
        rates.append(history.rate[np.convolve(moving, np.ones(61))[30:-30] < 0.5])
    resting = np.concatenate(rates)
    if len(resting) < 60:
        return usual
    noise = float(np.median([history.rate_sd for history in histories]))
    swing = float(np.quantile(np.abs(resting - np.median(resting)), 0.95))
    clean = float(np.sqrt(max(swing**2 - (2.0 * noise) ** 2, 0.0)))
    # Noise may hide a ripple whose rates are up to 3 sd of the noise of the rates: assume a ripple
    # of this amplitude, but at most the `usual` amplitude.
    hidden = min(usual, 3.0 * noise * lag_s)
    return float(np.clip(max(clean * lag_s, hidden), 0.02, 1.0))


def gradients_at_rest(bags: Sequence[ReducedBag], sensors: Sequence[str]) -> dict[str, float]:
    """Return T_sensor - T_board of each sensor at constant temperature (by self-heating) [K]."""
    result = {}
    for name in sensors:
        rate, gradient = [np.zeros(0)], [np.zeros(0)]
        for bag in bags:
            board, sensor = bag.board, bag.readings(name)
            if min(len(board.value), len(sensor.value)) < 30:
                continue
            first = max(board.stamp_ns[0], sensor.stamp_ns[0])
            last = min(board.stamp_ns[-1], sensor.stamp_ns[-1])
            grid = np.arange(0.0, (last - first) * 1e-9, 60.0)
            at, beside = (
                np.interp(grid, (readings.stamp_ns - first) * 1e-9, readings.value)
                for readings in (board, sensor)
            )
            if len(grid) > 2:
                rate.append(np.gradient(at, 60.0))
                gradient.append(beside - at)
        g, v = np.concatenate(gradient), np.concatenate(rate)
        lag = np.nan_to_num(slope_of_gradient(g, v)) if len(g) else 0.0
        result[name] = round(float(np.median(g - lag * v)), 3) if len(g) else 0.0
    return result


def slope_of_gradient(gradient: Floats, rate: Floats) -> float:
    """Return the slope of gradients over rates [s]; NaN if all rates are equal."""
    moved = rate - np.mean(rate)
    power = float(moved @ moved)
    return float(moved @ gradient) / power if power > 0.0 else np.nan


def without_copies(bags: Sequence[ReducedBag]) -> tuple[list[ReducedBag], list[str]]:
    """Return the bags less copies of the board's thermometer, and the names of the copies."""
    names = sorted(set.intersection(*({*bag.temperatures} for bag in bags)) - {'board'})
    copies = [
        name
        for name in names
        if any(len(bag.board.value) for bag in bags)
        and all(np.array_equal(bag.temperatures[name].value, bag.board.value) for bag in bags)
    ]
    kept = [
        replace(bag, temperatures={k: v for k, v in bag.temperatures.items() if k not in copies})
        for bag in bags
    ]
    return kept, copies


def board_span(bags: Sequence[ReducedBag], reference: float) -> tuple[float, float]:
    """Return the 0.5 % and 99.5 % quantiles of the board temperature less the reference [K]."""
    values = np.concatenate([bag.board.value for bag in bags])
    if not len(values):
        return 0.0, 0.0
    lower, upper = (np.quantile(values, (0.005, 0.995)) - reference).tolist()
    return lower, upper


def averaged(
    bag: ReducedBag, detector: DetectorSettings, inputs: Sequence[str], step_s: float
) -> tuple[ReducedBag, DetectorSettings]:
    """
    Average readings over steps of `step_s` if each step has two or more, as from IMU drivers.

    Return the bag with mean readings, and the settings with the noise of a mean reading.
    `inputs`: names of thermometers, the board's first; the others have the settings of the case.
    """
    temperatures = {**bag.temperatures}
    settings = [detector.board, detector.case]
    for k, names in enumerate((inputs[:1], inputs[1:])):
        steps = [bag.readings(name).stamp_ns // round(1e9 * step_s) for name in names]
        n = min((len(step) / len(np.unique(step)) for step in steps if len(step)), default=1.0)
        if n < 2.0:
            continue
        for name, step in zip(names, steps, strict=True):
            if len(step):
                temperatures[name] = _means(bag.readings(name), step, settings[k].has_cells)
        if not settings[k].has_cells:
            noise = np.hypot(settings[k].noise_sd_c, settings[k].quantum_c / np.sqrt(12.0))
            settings[k] = replace(settings[k], noise_sd_c=float(noise / np.sqrt(n)), quantum_c=0.0)
    board, case = settings
    return replace(bag, temperatures=temperatures), replace(detector, board=board, case=case)


def _means(readings: Readings, step: Ints, has_cells: bool) -> Readings:
    """Average the readings of each step; if `has_cells`, keep its first and changed readings."""
    stamp_ns, value = readings
    is_first = np.diff(step, prepend=-1) != 0
    if has_cells:
        is_first[1:] |= np.diff(value) != 0.0
        return Readings(stamp_ns[is_first], value[is_first])
    first = np.flatnonzero(is_first)
    least, most = np.minimum.reduceat(value, first), np.maximum.reduceat(value, first)
    # The tracker tests readings with impossible changes, so these readings are not averaged.
    is_first |= np.repeat(most - least > LARGEST_STEP, np.diff(first, append=len(step)))
    first = np.flatnonzero(is_first)
    n = np.diff(first, append=len(step))
    # Means of equal readings must be exactly equal, so that a stuck thermometer is recognised.
    after_ns, after = (values - np.repeat(values[first], n) for values in readings)
    mean_ns = stamp_ns[first] + np.add.reduceat(after_ns, first) // n
    return Readings(mean_ns, value[first] + np.add.reduceat(after, first) / n)


def readings_in_order(bag: ReducedBag, inputs: Sequence[str]) -> list[tuple[str, int, float]]:
    """Return (thermometer, stamp, value) sorted by stamp, equal stamps in `inputs` order."""
    rows = [
        (name, stamp_ns, value)
        for name in inputs
        for stamp_ns, value in zip(*map(np.ndarray.tolist, bag.readings(name)), strict=True)
    ]
    return sorted(rows, key=itemgetter(1))
