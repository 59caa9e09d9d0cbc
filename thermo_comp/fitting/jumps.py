# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the detection of jumps: steps in the samples of an accelerometer at rest.

The output of a sensor can step within one sample, if stress in its die relaxes or a joint slips.
The temperature does not step, so no function of temperature describes a jump, and a fit to data
across a jump gives a wrong curve. A jump differs from a rotation of the unit in two ways: samples
before and after a jump scatter no more than at rest; and the norm of the sample changes (a
rotation hardly changes the norm), or a gyroscope measures no rotation during the jump. A steep
curve over temperature changes the samples more slowly than a jump.

Neighbouring samples of a sensor with a low-pass filter have a correlation r, and the slow noise of
the samples hides a step. The noise of the differences ``a_i - r a_(i-1)`` is white (generalised
least squares for first-order noise), so they show a step within one sample. The differences also
show a decaying shock, so the mean levels before and after a jump must differ as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats
from .reduction import ReducedBag
from .sources import angular_velocity

# Shortest time over which samples before or after a gap between rests are averaged [s].
_MARGIN_S = 10.0
# Smallest number of samples before a step, and after it, for a test of the step.
_FEWEST_SAMPLES = 8
# Smallest significant ratio of a step to its sd; noise causes ratios of up to about 5.
_STEP_SDS = 8.0


@dataclass(frozen=True)
class Jump:
    """
    A step in the samples of a sensor at rest that is not a rotation of the unit.

    time: time of the step since the bag's first sample [s]
    duration_s: interval between the last sample before and the first sample after the step [s]
    step: step of each axis [input units]
    along: step of the norm of the samples, which is the step along gravity [input units]
    temperature_change, temperature_change_sd: step of the board temperature at the time of the
        jump, fitted with a linear drift, and sd of this step [K]; NaN with too few readings
    """

    time: float
    duration_s: float
    step: tuple[float, float, float]
    along: float
    temperature_change: float
    temperature_change_sd: float


def find_jumps(bag: ReducedBag) -> tuple[Jump, ...]:
    """
    Find the jumps between successive rests of a bag. Two rests are compared if the gap between
    them is at most 30 s or 250 samples, whichever is longer, and their attitudes differ by less
    than 10 degrees.
    """
    # A rest has whole cells of usually 30 samples, so gaps are long at a low sample rate.
    longest_ns = 1e9 * max(30.0, 250.0 * bag.cycle_s)
    margin_s = max(_MARGIN_S, 120.0 * bag.cycle_s)  # at least 120 samples
    means = [np.average(rest.mean, axis=0, weights=rest.count) for rest in bag.intervals]
    ups = [mean / np.linalg.norm(mean) for mean in means]
    gaps = [
        ((before.end_ns - bag.start_ns) * 1e-9, (after.start_ns - bag.start_ns) * 1e-9)
        for (before, up), (after, other) in pairwise(zip(bag.intervals, ups, strict=True))
        if after.start_ns - before.end_ns <= longest_ns and up @ other > np.cos(np.radians(10.0))
    ]
    quiet_sd = np.median([interval.sample_sd for interval in bag.intervals], axis=0)
    # Samples without visible noise have at least the error of rounding.
    rounding_sd = np.median([interval.rounding_sd for interval in bag.intervals], axis=0)
    sds = np.maximum(quiet_sd, np.maximum(rounding_sd, 1e-9)), rounding_sd
    beside = _beside_gaps(bag, gaps, [margin_s] * len(gaps))
    # A mean level beside a gap needs more samples if their noise is correlated.
    margins = [max(_margin(part, sds[0]), margin_s) for part in beside]
    if max(margins, default=0.0) > margin_s:
        beside = _beside_gaps(bag, gaps, margins)
    jumps = (_examine(part, gap, sds, bag) for part, gap in zip(beside, gaps, strict=True))
    return tuple(jump for jump in jumps if jump is not None)


def _beside_gaps(
    bag: ReducedBag, gaps: Sequence[tuple[float, float]], margins: Sequence[float]
) -> list[Floats]:
    """Collect the samples in and around each gap: time, sample, angular rate or NaN, (n, 7)."""
    parts = [[np.zeros((0, 7))] for _ in gaps]
    for block in bag.source.blocks() if gaps else ():
        time, rate = (block.accel_stamp_ns - bag.start_ns) * 1e-9, angular_velocity(block)
        rate = np.full(block.accel.shape, np.nan) if rate is None else rate
        for part, (begin, end), margin in zip(parts, gaps, margins, strict=True):
            use = (time >= begin - margin) & (time <= end + margin)
            use &= np.isfinite(block.accel).all(axis=1)
            part.append(np.column_stack((time[use], block.accel[use], rate[use])))
    return [np.concatenate(part) for part in parts]


def _margin(samples: Floats, quiet_sd: Floats) -> float:
    """Return the time to average beside a gap [s]: 60 correlation times, within 10 to 100 s."""
    time, accel = samples[:, 0], samples[:, 1:4]
    if len(time) < 2 * _FEWEST_SAMPLES:
        return _MARGIN_S
    _, r = _place_and_correlation(time, accel, quiet_sd)
    tau = -float(np.median(np.diff(time))) / np.log(r) if r else 0.0
    return float(np.clip(60.0 * tau, _MARGIN_S, 100.0))


def _examine(
    samples: Floats, gap: tuple[float, float], sds: tuple[Floats, Floats], bag: ReducedBag
) -> Jump | None:
    """Return the jump in a gap between two rests, or None; `sds`: sd of noise, sd of rounding."""
    quiet_sd, rounding_sd = sds
    time, accel, gyro = samples[:, 0], samples[:, 1:4], samples[:, 4:]
    before, after = time <= gap[0], time >= gap[1]
    if min(before.sum(), after.sum()) < _FEWEST_SAMPLES:
        return None
    beside = before | after
    at, r = _place_and_correlation(time, accel, quiet_sd)
    # Fit the change of the mean level to the samples before and after the gap, not to those in it.
    lasting, relative_sd, residual = _step(time[beside], accel[beside], time[at])
    # The step is the difference of two mean levels, each with an error of rounding.
    by_rounding = 2.0**0.5 * rounding_sd
    lasting_sd = np.hypot(quiet_sd * relative_sd * _sd_growth(residual, quiet_sd), by_rounding)
    step, relative_sd, residual = _step(time, accel, time[at], r)
    # For correlated noise, `quiet_sd` (scatter within half a second) is too small: fit the noise.
    sd = np.sqrt(np.mean(residual**2, axis=0)) if r else quiet_sd
    step_sd = np.hypot(sd * relative_sd * _sd_growth(residual, sd), by_rounding)
    if r:
        is_step = np.abs(step) > _STEP_SDS * step_sd
        # The change of the mean level must exceed half of the step, and 4 sd of the change.
        is_step &= lasting * np.sign(step) > 0.5 * np.abs(step)
        is_step &= np.abs(lasting) > 4.0 * lasting_sd
    else:
        is_step = np.abs(lasting) > _STEP_SDS * lasting_sd
    if not is_step.any() or _is_gradual(time, accel, (at, r), sd, bag):
        return None
    sides = accel[:at], accel[at:]
    # Differences of neighbouring samples contain noise, but no drift.
    spread = np.sqrt(0.25 * sum(np.mean(np.diff(side, axis=0) ** 2, axis=0) for side in sides))
    middle = 0.5 * (sides[0].mean(axis=0) + sides[1].mean(axis=0))
    norm = float(np.linalg.norm(middle))
    along = float(np.linalg.norm(middle + 0.5 * step) - np.linalg.norm(middle - 0.5 * step))
    size = float(np.linalg.norm(step))
    along_sd = float(np.sqrt((middle / norm) ** 2 @ step_sd**2))
    needed_rad = float(np.sqrt(max(size**2 - along**2, 0.0))) / norm
    # A step is no rotation if the gyroscope measured less than a third of the step's angle, or if
    # the norm |a| changed by over 20 % of the step: a rotation by d rad changes |a| by up to
    # 2 d |a| times the relative error of the uncalibrated sensor, at most 10 %.
    is_no_turn = _turn(time, gyro, at) < 0.33 * needed_rad or (
        abs(along) > 0.2 * size and abs(along) > _STEP_SDS * along_sd
    )
    # Samples of a unit that is handled scatter by far more than twice the quiet noise.
    if not is_no_turn or np.any(spread > 2.0 * quiet_sd):
        return None
    (x, y, z), of_board = step.tolist(), _temperature_step(bag, time[0], time[at], time[-1])
    return Jump(float(time[at]), float(time[at] - time[at - 1]), (x, y, z), along, *of_board)


def _is_gradual(
    time: Floats, accel: Floats, step: tuple[int, float], sd: Floats, bag: ReducedBag
) -> bool:
    """
    Whether a gradual change, due to a steep curve over temperature, explains the samples e^2 times
    better (likelihood) than a step. The change is linear in time while the board temperature
    changes by 0.1 K or more. `step`: first sample after the step, and lag-1 correlation
    """
    (at, r), sd = step, np.maximum(sd, 1e-9)
    board_s, board = _readings(bag, time[0], time[-1])
    if len(board) < _FEWEST_SAMPLES:
        return False
    rate = abs(float(np.polyfit(board_s - time[at], board, 1)[0]))
    chi2 = []
    duration_s = 0.1 / max(rate, 1e-9)
    while 2.0 * duration_s < time[-1] - time[0]:
        for middle in time[at] + duration_s * np.array([-0.25, 0.0, 0.25]):
            residual = _step(time, accel, float(middle), r, duration_s)[2]
            chi2.append(np.sum((residual / sd) ** 2))
        duration_s *= 2.0
    of_step = np.sum((_step(time, accel, time[at], r)[2] / sd) ** 2)
    return bool(min(chi2, default=np.inf) < of_step - 4.0)


def _sd_growth(residual: Floats, sd: Floats) -> Floats:
    """Return sd of the mean of `residual` / sd for white noise of sd `sd`, at least 1, (3,)."""
    # If the means of 40 pieces have the lag-1 correlation r, the variance of the mean of all
    # pieces is (1 + r) / (1 - r) times the variance for uncorrelated pieces.
    size = max(len(residual) // 40, 1)
    n = len(residual) // size
    means = residual[: n * size].reshape(n, size, 3).mean(axis=1)
    square = np.mean(means**2, axis=0)
    correlation = np.sum(means[1:] * means[:-1], axis=0) / np.maximum(n * square, 1e-300)
    r = np.clip(correlation, 0.0, 1.0 - 1.0 / n)
    variance = size * square * (1.0 + r) / (1.0 - r)
    return np.asarray(np.sqrt(np.maximum(variance / np.maximum(sd**2, 1e-300), 1.0)))


def _temperature_step(bag: ReducedBag, begin: float, at: float, end: float) -> tuple[float, float]:
    """Return the fitted step of the board temperature at the time `at`, and its sd [K]."""
    time, value = _readings(bag, begin, end)
    if min(np.sum(time < at), np.sum(time >= at)) < _FEWEST_SAMPLES:
        return np.nan, np.nan
    (step,), relative_sd, residual = _step(time, value[:, None], at)
    return float(step), relative_sd * float(np.sqrt(np.sum(residual**2) / (len(value) - 3)))


def _readings(bag: ReducedBag, begin: float, end: float) -> tuple[Floats, Floats]:
    """Return times since the bag's start [s] and board readings [degC] from `begin` to `end`."""
    time = np.asarray(bag.board.stamp_ns - bag.start_ns, dtype=np.float64) * 1e-9
    use = (time >= begin) & (time <= end)
    return time[use], np.asarray(bag.board.value[use], dtype=np.float64)


def _place_and_correlation(time: Floats, accel: Floats, quiet_sd: Floats) -> tuple[int, float]:
    """
    Find the first sample after a step, and the lag-1 correlation of the noise.

    The time of the step and the correlation are estimated alternately, up to three times. Noise
    with a lag-1 correlation of up to 0.4 is taken as white, with the correlation 0. The largest
    correlation is 0.999, for noise that is practically a random walk.
    """
    at, r = _place_of_step(time, accel, quiet_sd, 0.0), 0.0
    for _ in range(3):
        residual = _step(time, accel, time[at])[2] / quiet_sd
        square = max(np.sum(residual**2), 1e-300)
        correlation = float(np.sum(residual[1:] * residual[:-1]) / square)
        r = min(correlation, 0.999) if correlation > 0.4 else 0.0
        if not r:
            break
        at = _place_of_step(time, accel, quiet_sd, r)
    return at, r


def _place_of_step(time: Floats, accel: Floats, quiet_sd: Floats, r: float) -> int:
    """Find the first sample after the most likely step in samples with a linear drift."""
    n = len(time)
    trend = _trend(time, r)
    residual = whitened(accel, r)
    residual = residual - trend @ (trend.T @ residual)
    candidates = np.arange(_FEWEST_SAMPLES, n - _FEWEST_SAMPLES + 1)
    # A unit step at sample k, whitened for the lag-1 correlation r, is 1 at k and 1 - r after k:
    # its product with a residual is a sum over the residuals from sample k on. Removal of the
    # trend reduces the sum of squares of the whitened step by its squared products with `trend`.
    tail = _sums_behind(residual, r)[candidates]
    trend_tail = _sums_behind(trend, r)[candidates]
    square = 1.0 + (1.0 - r) ** 2 * (n - candidates - 1) - (trend_tail**2).sum(axis=1)
    gain = ((tail / quiet_sd) ** 2).sum(axis=1) / square
    return int(candidates[int(np.argmax(gain))])


def _sums_behind(rows: Floats, r: float) -> Floats:
    """Return for each row its value plus ``1 - r`` times the sum of all later rows."""
    return np.asarray((1.0 - r) * np.cumsum(rows[::-1], axis=0)[::-1] + r * rows)


def whitened(values: Floats, r: float) -> Floats:
    """Whiten k series, (n, k), whose noise is of first order with lag-1 correlation r."""
    first = np.sqrt(1.0 - r * r) * values[:1]
    return np.concatenate((first, values[1:] - r * values[:-1]))


def _step(
    time: Floats, values: Floats, at: float, r: float = 0.0, duration_s: float = 0.0
) -> tuple[Floats, float, Floats]:
    """
    Fit a step at the time `at`, or a linear change over `duration_s` about `at`, and a linear
    drift. Return the step, its sd / sd of the noise, and the residuals (n, k).
    """
    trend = _trend(time, r)
    part = np.clip((time - at) / duration_s + 0.5, 0.0, 1.0) if duration_s else time >= at
    jump = whitened(np.asarray(part, dtype=np.float64)[:, None], r)[:, 0]
    jump -= trend @ (trend.T @ jump)
    values = whitened(values, r)
    square = float(jump @ jump)
    step = np.asarray(jump @ values / square)
    return step, square**-0.5, values - trend @ (trend.T @ values) - np.outer(jump, step)


def _trend(time: Floats, r: float) -> Floats:
    """Return a constant and a linear drift, whitened and made orthonormal, shape (n, 2)."""
    columns = np.column_stack((np.ones(len(time)), time - time.mean()))
    return np.asarray(np.linalg.qr(whitened(columns, r))[0])


def _turn(time: Floats, gyro: Floats, at: int) -> float:
    """Return the angle of rotation [rad] within 1 s of a step, by the rate less its median."""
    rates = [side - np.median(side, axis=0) for side in (gyro[:at], gyro[at:])]
    angles = np.concatenate(rates)[1:] * np.diff(time)[:, None]
    return float(np.linalg.norm(angles[np.abs(time[1:] - time[at]) <= 1.0].sum(axis=0)))
