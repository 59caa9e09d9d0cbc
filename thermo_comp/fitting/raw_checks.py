# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the checks of the raw data of a fit: serial numbers, samples, thermometer readings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..errors import FitError
from ..recording.overview import KELVINS
from ..recording.stillness import widened
from ..text import counted
from ..typing import Bools
from ..unit.calibration import POPULATION, Calibration
from ..unit.gravity import STANDARD_GRAVITY
from .data_checks import Finding, advice
from .jumps import Jump, find_jumps
from .options import COUNTS_FULL_SCALE, FitOptions
from .reduction import ReducedBag, StillInterval
from .windows import ThermalWindows, Track


def judge_prior(serial: str, prior: Calibration | None) -> Iterator[Finding]:
    """Refuse a prior of another unit, whose small uncertainties do not apply to this unit."""
    if prior is None or prior.provenance.model == POPULATION:
        return
    if 'unknown' not in (serial, prior.unit.serial) and serial != prior.unit.serial:
        yield Finding(
            'prior',
            'refusal',
            f'the prior is the calibration of unit {prior.unit.serial}, the bags are of unit '
            f'{serial}: make a prior of the type of units with thermo_comp prior, from the '
            'calibrations of three units or more',
        )


def full_scale_of(bags: Sequence[ReducedBag], options: FitOptions) -> float:
    """Return the full scale [input units]: as stated, else a usual value above all samples."""
    full_scale, largest = options.saturated_at, max(bag.max_abs for bag in bags)
    if full_scale == COUNTS_FULL_SCALE:
        return widened(full_scale, np.array([[largest]]))
    if full_scale is None:
        # Take the smallest usual full scale 10 % above all samples, else twice the largest sample.
        # The result is at least the full scale of the prior, which the user may have stated.
        ranges = (STANDARD_GRAVITY * g for g in (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0))
        full_scale = next((top for top in ranges if top > 1.1 * largest), 2.0 * largest)
        full_scale = max(full_scale, options.prior.unit.full_scale if options.prior else 0.0)
    return full_scale


def judge_bags(bags: Sequence[ReducedBag], options: FitOptions) -> Iterator[Finding]:
    """Check the raw data: samples, motion, dead axes, thermometers, units, jumps, angular rate."""

    def total(name: str) -> int:
        return sum(getattr(bag, name) for bag in bags)

    n_samples = total('n_samples')
    part = total('n_saturated') / n_samples
    if part > 0.001:
        yield Finding(
            'saturation',
            'refusal' if part > 0.05 else 'advice',
            f'{100.0 * part:.2f} % of the samples are at the full scale: a force exceeds the '
            'range of the sensor, or --full-scale is wrong',
        )
    if n_dropped := total('n_dropped'):
        why = 'was a clock set back?'
        if 2 * total('n_repeated') > n_dropped:
            why = 'does the driver send several samples with one stamp?'
        share = f'{n_dropped}, {100.0 * n_dropped / n_samples:.2g} % of all'
        text = 'samples that are not finite, or have a stamp that does not rise, are left out'
        yield advice('dropped', f'{text} ({share}): {why}')
    if n := total('n_glitches'):
        yield advice(
            'glitches',
            f'{counted(n, "sample")} far from both neighbours, left out: does the bus lose bits?',
        )
    still = total('n_still_cells') / total('n_cells')
    if still < 0.5:
        yield advice(
            'motion',
            f'the unit was still for only {100.0 * still:.0f} % of the time; the times of '
            'vibration or handling were left out',
        )
    rests = _rests(bags)
    if n_equal := sum(not rest.sample_sd.any() for rest in rests):
        share = '' if n_equal == len(rests) else f' in {n_equal} of {len(rests)} rests'
        text = (
            f'at rest all samples are equal for half a second or longer{share}, without any '
            'noise: does the driver repeat one sample, or is the resolution of the sensor too '
            'coarse? If the resolution is coarse, set stuck_timeout of the node to 0: by default '
            'the node drops samples that stay equal for 2 s'
        )
        yield advice('stuck', text)
    if dead := list(_dead_axes(bags)):
        text = '; '.join(f'{axis.bag}: {axis.text}' for axis in dead)
        yield Finding('stuck', 'refusal', f'{text}: {_why_dead(bags, dead)}')
    size = float(np.median(np.linalg.norm(np.concatenate([rest.mean for rest in rests]), axis=1)))
    yield from _judge_full_scale(bags, size, options)
    yield from _judge_thermometers(bags)
    yield from _judge_units(bags, size, options)
    per_mg = 1e-3 * (STANDARD_GRAVITY if options.input == 'm/s^2' else size)
    yield from _judge_jumps(bags, per_mg)
    if not all(bag.angular_rate == bags[0].angular_rate != 'part' for bag in bags):
        names = ', '.join(bag.source.name for bag in bags if bag.angular_rate != 'whole')
        text = f'{names}: not every sample has an angular rate, so no gyroscope was fitted'
        yield advice('rate', text)


def _judge_full_scale(
    bags: Sequence[ReducedBag], size: float, options: FitOptions
) -> Iterator[Finding]:
    """Report a full scale that is estimated from the samples; `size`: median norm at rest."""
    full_scale = full_scale_of(bags, options)
    if full_scale not in (options.full_scale, COUNTS_FULL_SCALE):
        text = (
            f'samples of {full_scale:.5g} {options.input} ({full_scale / size:.2g} times gravity) '
            'or more on an axis will count as saturated, and will not be published: if the sensor '
            'measures more, state its range with --full-scale'
        )
        yield advice('full-scale', text)


def _rests(bags: Sequence[ReducedBag]) -> list[StillInterval]:
    return [rest for bag in bags for rest in bag.intervals]


def in_kelvins(bag: ReducedBag) -> str:
    """Return a message about a thermometer whose readings look like kelvins; '' if none does."""
    for name in sorted(bag.temperatures):
        celsius = bag.readings(name).value
        # 233 K is -40 degC, the lower limit of industrial electronics, which fail at 233 degC.
        if len(celsius) and 233.0 < (median := float(np.median(celsius))) < KELVINS[1]:
            reads = f'temperature/{name} reads {median:.4g} degC in the median'
            return f'{reads}: that looks like kelvins; record degC'
    return ''


def _judge_thermometers(bags: Sequence[ReducedBag]) -> Iterator[Finding]:
    """Check the readings of thermometers; FitError if the readings of a bag are in kelvins."""
    names = sorted({name for bag in bags for name in bag.temperatures})
    for name in names:
        if n := sum(bag.n_spikes.get(name, 0) for bag in bags):
            yield advice(
                'spikes',
                f'temperature/{name}: {counted(n, "reading")} more than 10 K from the readings '
                'before and after, left out: does the thermometer lose contact?',
            )
    for bag in bags:
        if text := in_kelvins(bag):
            raise FitError(f'{bag.source.name}: {text}')
    for name in names:
        celsius = np.concatenate([bag.readings(name).value for bag in bags])
        if len(celsius) and KELVINS[0] < np.median(celsius) < KELVINS[1]:
            reads = f'temperature/{name} reads {np.min(celsius):.4g} .. {np.max(celsius):.4g} degC'
            yield advice('kelvins', f'{reads}: that looks like kelvins; record degC')


def _judge_units(
    bags: Sequence[ReducedBag], size: float, options: FitOptions
) -> Iterator[Finding]:
    """Check whether samples with a norm of `size` [input units] at rest are counts."""
    if options.input != 'counts' or all(bag.is_integer for bag in bags):
        return
    for unit, one_g in (('m/s^2', STANDARD_GRAVITY), ('g', 1.0)):
        if abs(size / one_g - 1.0) < 0.1:
            yield Finding(
                'units',
                'refusal',
                f'the samples have norm {size:.3g} and are not whole numbers: they look like '
                f'{unit}, not counts; record them as sensor_msgs/Imu in m/s^2',
            )
            return
    yield advice(
        'compensated',
        'the samples are not whole numbers: were they averaged, scaled or compensated before the '
        'recording? A calibration made from scaled samples is valid for that scaling only',
    )


class _DeadAxis(NamedTuple):
    """An axis whose samples all equal `value` in a rest of a bag; `text`: its description."""

    bag: str
    axis: int
    value: float
    text: str


def _why_dead(bags: Sequence[ReducedBag], dead: Sequence[_DeadAxis]) -> str:
    """Return why the samples of axes are constant: clipped at the full scale, or a dead axis."""
    largest = max(float(np.abs(rest.mean).max()) for rest in _rests(bags))
    # The magnitudes of the limits of a two's complement code (-32768, 32767) differ by one count.
    is_at_top = np.isclose([abs(axis.value) for axis in dead], largest, rtol=1e-4, atol=0.0)
    ends = {(axis.axis, axis.value > 0.0) for axis in dead}
    if not largest or not is_at_top.all() or len(ends) == 1:
        return 'the axis is dead; leave out each bag with a dead axis'
    # The advised full scale is just below the clipped samples, which are then saturated.
    limit = f'--full-scale {largest * (1.0 - 1e-4):.5g}'
    return (
        'the same largest magnitude, with both signs or on several axes, is the full scale: leave '
        f'out a clipped bag, or leave out the clipped rests of a bag with {limit}'
    )


def _dead_axes(bags: Sequence[ReducedBag]) -> Iterator[_DeadAxis]:
    """
    Find axes that are constant throughout a rest but have noise in half or more of the rests. An
    axis that is constant in all rests, but not 0 in all, is dead if another axis has noise.
    """
    rests = _rests(bags)
    alive = np.array([rest.sample_sd > 0.0 for rest in rests])
    usual = 2 * alive.sum(axis=0) >= len(rests)
    if len(rests) > 1 and usual.any():
        has_reading = np.any([rest.mean[0] != 0.0 for rest in rests], axis=0)
        usual |= has_reading & ~alive.any(axis=0)
    return constant_axes(bags, usual)


def constant_axes(bags: Sequence[ReducedBag], usual: Bools) -> Iterator[_DeadAxis]:
    """Find axes with constant samples throughout a rest; `usual`: axes to be checked, (3,)."""
    for bag in bags:
        for rest in bag.intervals:
            is_dead = ~(rest.sample_sd > 0.0) & usual & (np.ptp(rest.mean, axis=0) == 0.0)
            # The samples of a working axis show noise or drift within a thousand samples.
            for axis in np.flatnonzero(is_dead & (rest.count.sum() >= 1000)):
                hours = (rest.end_ns - rest.start_ns) / 3600e9
                value = float(rest.mean[0, axis])
                text = f'{"xyz"[axis]} reads exactly {value:g} for {hours:.2g} h'
                yield _DeadAxis(bag.source.name, int(axis), value, text)


def _judge_jumps(bags: Sequence[ReducedBag], per_mg: float) -> Iterator[Finding]:
    """Refuse bags with jumps of the bias; `per_mg`: input units per mg."""
    jumped = '; '.join(
        f'{bag.source.name}: {describe(jump, per_mg, bag.since_s)}'
        for bag in bags
        for jump in find_jumps(bag)
    )
    if jumped:
        text = f'{jumped}: leave out a bag with a jump, or end before the jump with --to'
        yield Finding('jump', 'refusal', text)


def describe(jump: Jump, per_mg: float, since_s: float = 0.0) -> str:
    """Return the message for a jump; `since_s`: start of the part of the bag that was read [s]."""
    vector = ', '.join(f'{v / per_mg:+.3g}' for v in jump.step)
    warmed = ''
    if np.isfinite(jump.temperature_change):
        warmed = (
            f', while the board temperature changed by {jump.temperature_change:+.2f} ± '
            f'{jump.temperature_change_sd:.2f} K'
        )
    return (
        f'at {jump.time + since_s:.1f} s the sensor jumped by {jump.along / per_mg:+.3g} mg along '
        f'gravity ({vector}) within {jump.duration_s:.2g} s, without motion{warmed}: not a '
        'function of temperature'
    )


def judge_missing(bags: Sequence[ReducedBag], windows: ThermalWindows) -> Iterator[Finding]:
    """Report a large share of the time at rest that is left out for lack of a temperature."""
    if not windows.has_temperature:
        return
    counts = [_missing(bag, track) for bag, track in zip(bags, windows.tracks, strict=True)]
    n_still, n_unsettled, n_missing, n_between = np.sum(counts, axis=0).tolist()
    unsettled, missing = n_unsettled / n_still, n_missing / n_still
    reported = 0.1  # a larger share of the time at rest without a temperature is reported
    if missing > reported:
        why = 'do the thermometers and the accelerometer use the same clock?'
        if n_between > 0.5 * n_missing:
            why = f'does a thermometer stick, or drop out? {_longest_pause(bags)}'
        share = f'{100.0 * missing:.0f} % of the time at rest'
        yield advice('unmeasured', f'{share} has no temperatures and is left out: {why}')
    if unsettled > reported:
        quantum = windows.model.detector.board.quantum_c
        steps = f' (steps of {quantum:g} K)' if quantum else ''
        yield advice(
            'steps',
            f'{100.0 * unsettled:.0f} % of the time at rest is left out: the board temperature is '
            f'not accurate before the reading of temperature/board{steps} changes for '
            'the first time in a bag; begin with a ramp, or use a finer thermometer',
        )


def _missing(bag: ReducedBag, track: Track) -> tuple[float, float, float, float]:
    """
    Return four numbers of samples at rest: all samples; samples before the board temperature is
    accurate; other samples without a temperature; samples without a temperature that were recorded
    after the board temperature was accurate, while all thermometers gave readings.
    """
    read = [readings.stamp_ns for readings in bag.temperatures.values() if len(readings.stamp_ns)]
    begin_s = 1e-9 * (max(stamp_ns[0] for stamp_ns in read) - bag.start_ns)
    end_s = 1e-9 * (min(stamp_ns[-1] for stamp_ns in read) - bag.start_ns)
    n_still = n_unsettled = n_missing = n_between = 0.0
    for rest in bag.intervals:
        is_known = np.interp(rest.time, track.grid_s, track.is_known, left=0.0) == 1.0
        is_settled = rest.time >= track.settled_s
        n_still += float(rest.count.sum())
        is_unsettled = (rest.time >= track.start_s) & ~is_settled
        n_unsettled += float(rest.count[is_unsettled].sum())
        n_missing += float(rest.count[~is_known & ~is_unsettled].sum())
        is_between = ~is_known & is_settled & (rest.time > begin_s) & (rest.time < end_s)
        n_between += float(rest.count[is_between].sum())
    return n_still, n_unsettled, n_missing, n_between


def _longest_pause(bags: Sequence[ReducedBag]) -> str:
    """Describe the longest time between two changes of a thermometer's reading."""
    pauses = []
    for bag in bags:
        for name, readings in bag.temperatures.items():
            is_new = np.diff(readings.value, prepend=np.nan) != 0.0
            stamps = np.append(readings.stamp_ns[is_new], readings.stamp_ns[-1:])
            pause_s = float(np.diff(stamps).max(initial=0)) * 1e-9
            pauses.append((pause_s, name, bag.source.name))
    pause_s, name, where = max(pauses)
    return f'{where}: temperature/{name} has no new value for {pause_s:.0f} s'
