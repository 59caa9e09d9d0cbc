# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the bags say of the thermometers: noise, lag, ramps, detector; the causal thermal state.

Rates are taken here from both sides, over a minute each, which only a recording allows; what is
learnt makes the causal thermometers and the detector expect what this chamber did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from operator import itemgetter

import numpy as np

from ..thermal.settings import OBVIOUS_SHARE, RAMP_K_MIN, DetectorSettings, ThermometerSettings
from ..thermal.tracker import ThermalTracker
from ..typing import Bools, Floats
from .reduction import NO_READINGS, Readings, ReducedBag

# Below this no thermometer is worth believing, and the recursion would follow rounding errors.
_SMALLEST_NOISE = 1e-4
_BIN_S = 10.0
_BINS_PER_SIDE = 6
# Shares of readings that are no more than stray ones.
_STRAY = (0.005, 0.995)
_MINUTE_S = 60.0
# A ramp is clear when its rate is this far above the noise of rates.
_CLEAR = 5.0
_LAG_RANGE_S = (30.0, 3600.0)
_RIPPLE_RANGE_C = (0.02, 1.0)
# The unit may meet ramps faster than the chamber's.
_RAMP_MARGIN = 1.5


@dataclass(frozen=True)
class Course:
    """One thermometer's rate over one bag, on a grid of ten seconds, and its noise [K/s]."""

    rate: Floats
    rate_sd: float

    @property
    def is_resting(self) -> Bools:
        """Where the chamber rests: no ramp for five minutes before and after."""
        moving = np.abs(self.rate) > max(0.2 * self.fastest, _CLEAR * self.rate_sd)
        near = np.convolve(moving, np.ones(61))[30:-30] > 0.5
        return np.asarray(~near)

    @property
    def fastest(self) -> float:
        """Rate that all but a hundredth of the course stays below [K/s]."""
        return float(np.quantile(np.abs(self.rate), 0.99))


def learn_detector(bags: Sequence[ReducedBag]) -> DetectorSettings:
    """Set the detector to the sensors and ramps that the bags show."""
    base = DetectorSettings()
    board = learn_thermometer([bag.board for bag in bags], base.board)
    case = learn_thermometer([bag.case for bag in bags], base.case)
    courses = _courses([bag.case for bag in bags], case.noise_sd_c, case.quantum_c)
    smallest = min(base.smallest_ramp_k_min, _slowest_ramp(courses, base.smallest_ramp_k_min))
    return replace(
        base,
        smallest_ramp_k_min=smallest,
        relaxed_rate_k_min=min(base.relaxed_rate_k_min, 0.4 * smallest / OBVIOUS_SHARE),
        ripple_c=_ripple(courses, case.lag_s, base.ripple_c),
        board=board,
        case=case,
    )


def learn_thermometer(
    recorded: Sequence[Readings], base: ThermometerSettings
) -> ThermometerSettings:
    """Estimate one sensor's quantum, noise, lag and fastest ramp."""
    long = [readings.value for readings in recorded if len(readings.value) >= 30]
    if not long:
        return base
    quantum = quantum_of(np.concatenate(long))
    noise = max(_noise_of(long, quantum), _SMALLEST_NOISE)
    courses = _courses(recorded, noise, quantum)
    clear = [one for one in courses if one.fastest > _CLEAR * one.rate_sd]
    if not clear:
        return replace(base, noise_sd_c=noise, quantum_c=quantum)
    fastest = max(one.fastest for one in clear)
    # A ramp begins through a lag with the acceleration ramp / lag; the means of a minute on
    # either side see it when it is half a minute old, and spread it over the minute.
    lags = []
    for one in clear:
        bend = np.abs(one.rate[_BINS_PER_SIDE:] - one.rate[:-_BINS_PER_SIDE])
        steepest = float(np.quantile(bend, 0.995)) / (_BIN_S * _BINS_PER_SIDE)
        if steepest > 0.0:
            lags.append(one.fastest / steepest)
    lag = float(np.clip(np.median(lags), *_LAG_RANGE_S)) if lags else base.lag_s
    return replace(
        base,
        noise_sd_c=noise,
        quantum_c=quantum,
        fastest_ramp_k_min=max(base.fastest_ramp_k_min, _RAMP_MARGIN * 60.0 * fastest),
        lag_s=round(lag, 1),
    )


def quantum_of(values: Floats) -> float:
    """Find the step of a rounded sensor in its readings, shape (n,)."""
    levels = np.unique(np.round(values, 9))
    if len(levels) < 2 or len(levels) > 0.5 * len(values):
        return 0.0
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.min(gaps)]))
    steps = gaps / step
    is_grid = np.abs(steps - np.rint(steps)) < 0.1
    return round(step, 9) if is_grid.mean() > 0.9 else 0.0


def _noise_of(values: Sequence[Floats], quantum: float) -> float:
    # A straight ramp has no second difference; white noise of sd s gives s sqrt(6).
    second = np.concatenate([np.diff(value, 2) for value in values])
    if not quantum:
        return 1.4826 * float(np.median(np.abs(second))) / float(np.sqrt(6.0))
    # Rounded readings stand still most of the time, so a median would say 0: the mean square
    # without the largest hundredth serves, less what rounding alone gives.
    square = np.sort(second**2)[: max(1, int(0.99 * len(second)))]
    variance = max(float(square.mean()) / 6.0 - quantum**2 / 12.0, (0.1 * quantum) ** 2)
    return float(np.sqrt(variance))


def _courses(recorded: Sequence[Readings], noise: float, quantum: float) -> list[Course]:
    """Rates of each bag that is long enough to have any."""
    side = _BIN_S * _BINS_PER_SIDE
    result = []
    for readings in recorded:
        if len(readings.value) < 30:
            continue
        time = (readings.stamp_ns - readings.stamp_ns[0]) * 1e-9
        n_bins = int(time[-1] / _BIN_S)
        if n_bins < 6 * _BINS_PER_SIDE:
            continue
        # The mean over a bin is a difference of the integral at its edges.
        integral = np.concatenate(
            ([0.0], np.cumsum(0.5 * (readings.value[1:] + readings.value[:-1]) * np.diff(time)))
        )
        edges = np.interp(np.arange(n_bins + 1) * _BIN_S, time, integral)
        means = (edges[_BINS_PER_SIDE:] - edges[:-_BINS_PER_SIDE]) / side
        rate = (means[_BINS_PER_SIDE:] - means[:-_BINS_PER_SIDE]) / side
        per_side = max(1.0, side * (len(time) - 1) / time[-1])
        # Rounding errors of neighbours are alike as long as the temperature stays in one step.
        spread = np.sqrt(2.0 * (noise**2 / per_side + quantum**2 / 12.0))
        result.append(Course(rate, float(spread) / side))
    return result


def _slowest_ramp(courses: Sequence[Course], usual: float) -> float:
    """Seven tenths of the slowest long ramp [K/min], within reason."""
    slowest = usual / 0.7
    for one in courses:
        clear = np.abs(one.rate) > max(_CLEAR * one.rate_sd, 0.1 / 60.0)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], clear.astype(np.int8), [0]))))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if (stop - start) * _BIN_S > 600.0:
                middle = float(np.quantile(np.abs(one.rate[start:stop]), 0.9)) * 60.0
                slowest = min(slowest, middle)
    return max(0.7 * slowest, RAMP_K_MIN)


def _ripple(courses: Sequence[Course], lag_s: float, usual: float) -> float:
    """Amplitude of the surroundings' ripple in soaks: through the lag it made the rates seen."""
    rates = [one.rate[one.is_resting] for one in courses]
    resting = np.concatenate(rates) if rates else np.zeros(0)
    if len(resting) < 60 or not courses:
        return usual
    noise = float(np.median([one.rate_sd for one in courses]))
    swing = float(np.quantile(np.abs(resting - np.median(resting)), 0.95))
    clean = float(np.sqrt(max(swing**2 - (2.0 * noise) ** 2, 0.0)))
    # A ripple within the noise of the rates is not seen: then the usual one may be there.
    hidden = min(usual, 3.0 * noise * lag_s)
    return float(np.clip(max(clean * lag_s, hidden), *_RIPPLE_RANGE_C))


def gradients_at_rest(bags: Sequence[ReducedBag], sensors: Sequence[str]) -> dict[str, float]:
    """Find T_s - T_board of each sensor while the board's rate is 0: what its own heat makes."""
    result = {}
    for name in sensors:
        rate, gradient = [np.zeros(0)], [np.zeros(0)]
        for bag in bags:
            board, other = bag.board, bag.temperatures.get(name, NO_READINGS)
            if min(len(board.value), len(other.value)) < 30:
                continue
            first = max(board.stamp_ns[0], other.stamp_ns[0])
            last = min(board.stamp_ns[-1], other.stamp_ns[-1])
            grid = np.arange(0.0, (last - first) * 1e-9, _MINUTE_S)
            at, beside = (
                np.interp(grid, (one.stamp_ns - first) * 1e-9, one.value) for one in (board, other)
            )
            if len(grid) > 2:
                rate.append(np.gradient(at, _MINUTE_S))
                gradient.append(beside - at)
        g, v = np.concatenate(gradient), np.concatenate(rate)
        moved = v - v.mean() if len(v) else v
        power = float(moved @ moved)
        lag = float(moved @ g) / power if power > 0.0 else 0.0
        result[name] = round(float(np.median(g - lag * v)), 3) if len(g) else 0.0
    return result


def without_copies(bags: Sequence[ReducedBag]) -> tuple[list[ReducedBag], list[str]]:
    """Leave out thermometers that repeat the board's readings in every bag; name them."""
    names = sorted(set.intersection(*({*bag.temperatures} for bag in bags)) - {'board'})
    copies = [
        name
        for name in names
        if all(np.array_equal(bag.temperatures[name].value, bag.board.value) for bag in bags)
        and any(len(bag.board.value) for bag in bags)
    ]
    kept = [
        replace(bag, temperatures={k: v for k, v in bag.temperatures.items() if k not in copies})
        for bag in bags
    ]
    return kept, copies


def board_span(bags: Sequence[ReducedBag], reference: float) -> tuple[float, float]:
    """Return the board temperatures seen, from the reference [K], but for stray readings."""
    values = np.concatenate([bag.board.value for bag in bags])
    if not len(values):
        return 0.0, 0.0
    lower, upper = (np.quantile(values, _STRAY) - reference).tolist()
    return lower, upper


def readings_in_order(bag: ReducedBag, inputs: Sequence[str]) -> list[tuple[str, int, float]]:
    """Thermometer, stamp and value of each reading; of equal stamps in the order of `inputs`."""
    found: list[tuple[str, int, float]] = []
    for name in inputs:
        one = bag.temperatures.get(name, NO_READINGS)
        found += zip(repeat(name), one.stamp_ns.tolist(), one.value.tolist(), strict=False)
    return sorted(found, key=itemgetter(1))


def thermal_states(
    bag: ReducedBag, tracker: ThermalTracker, step_s: float
) -> tuple[float, Floats, Bools]:
    """Sample a tracker: where the grid begins [s], states, which of them rest on readings."""
    readings = iter(readings_in_order(bag, ('board', *tracker.spec.sensors)))
    reading = next(readings, None)
    step_ns = round(step_s * 1e9)
    begin = max(int(bag.board.stamp_ns[0]), bag.start_ns)
    rows, is_heard = [], []
    board, *others = tracker.thermometers.values()
    limit_s, other_limit_s = tracker.config.temperature_timeout_s, tracker.config.case_timeout_s
    for stamp_ns in range(begin, max(bag.end_ns, begin) + step_ns, step_ns):
        # Readings up to and including a grid stamp come first, as they do online.
        while reading is not None and reading[1] <= stamp_ns:
            tracker.read(*reading)
            reading = next(readings, None)
        rows.append(tracker.sample(stamp_ns))
        is_heard.append(
            board.beyond(stamp_ns) <= limit_s
            and all(one.beyond(stamp_ns) <= other_limit_s for one in others)
        )
    return (begin - bag.start_ns) * 1e-9, np.array(rows), np.array(is_heard)
