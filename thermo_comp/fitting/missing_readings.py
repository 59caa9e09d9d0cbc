# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the check for samples at rest that are left out because their temperature is unknown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .data_checks import Finding, advice
from .windows import ThermalWindows, Track

if TYPE_CHECKING:
    from .reduction import ReducedBag

# Smallest share of the time at rest without temperature that is reported.
_LEAST_LOST_SHARE = 0.1


class _Missing(NamedTuple):
    """
    Numbers of samples at rest.

    n_still: all samples
    n_unsettled: samples before the estimate of the board temperature is accurate
    n_between: later samples without a temperature, between readings of each thermometer
    """

    n_still: float
    n_unsettled: float
    n_between: float


def judge_missing(windows: ThermalWindows) -> Iterator[Finding]:
    """Report which share of the time at rest is left out without a temperature, and why."""
    used_bags = list({id(bag): bag for bag, _ in windows.rests}.values())
    if not windows.has_temperature or not used_bags:
        return
    counts = [_missing(bag, track) for bag, track in zip(used_bags, windows.tracks, strict=False)]
    n_still, n_unsettled, n_between = np.sum(counts, axis=0).tolist()
    n_used = float(windows.data.weight.sum()) * windows.typical_count
    unsettled = n_unsettled / max(n_still, 1.0)
    missing = 1.0 - n_used / max(n_still, 1.0) - unsettled
    if missing > _LEAST_LOST_SHARE:
        why = 'do the thermometers and the accelerometer use the same clock?'
        if n_between > 0.5 * missing * n_still:
            why = f'does a thermometer stick, or drop out? {_longest_pause(used_bags)}'
        yield advice(
            'unmeasured',
            f'{100.0 * missing:.0f} % of the time at rest has no temperatures and is left out: '
            f'{why}',
        )
    if unsettled > _LEAST_LOST_SHARE:
        quantum = windows.model.detector.board.quantum_c
        steps = f' (steps of {quantum:g} K)' if quantum else ''
        yield advice(
            'steps',
            f'{100.0 * unsettled:.0f} % of the time at rest is left out: the board temperature is '
            f'not accurate before the reading of temperature/board{steps} changes for '
            'the first time in a bag; begin with a ramp, or use a finer thermometer',
        )


def _missing(bag: ReducedBag, track: Track) -> _Missing:
    """Count a bag's samples at rest: all, and those without an accurate temperature."""
    grid = track.start_s + track.step_s * np.arange(len(track.states))
    read = [readings.stamp_ns for readings in bag.temperatures.values() if len(readings.stamp_ns)]
    begin_s, end_s = (
        1e-9 * (stamp_ns - bag.start_ns)
        for stamp_ns in (
            max((stamps[0] for stamps in read), default=bag.start_ns),
            min((stamps[-1] for stamps in read), default=bag.start_ns),
        )
    )
    n_still = n_unsettled = n_between = 0.0
    for interval in bag.intervals:
        time, count = interval.time, interval.count
        is_known = np.interp(time, grid, track.is_known, left=0.0) == 1.0
        is_settled = time >= track.settled_s
        n_still += float(count.sum())
        n_unsettled += float(count[(time >= track.start_s) & ~is_settled].sum())
        is_between = ~is_known & is_settled & (time > begin_s) & (time < end_s)
        n_between += float(count[is_between].sum())
    return _Missing(n_still, n_unsettled, n_between)


def _longest_pause(bags: Sequence[ReducedBag]) -> str:
    """Describe the longest time between two changes of a thermometer's reading."""
    pauses = []
    for bag in bags:
        for name, readings in bag.temperatures.items():
            is_new = np.diff(readings.value, prepend=np.nan) != 0.0
            stamps = np.append(readings.stamp_ns[is_new], readings.stamp_ns[-1:])
            if len(stamps) > 1:
                pauses.append((float(np.diff(stamps).max()) * 1e-9, name, bag.source.name))
    if not pauses:
        return ''
    pause_s, name, where = max(pauses)
    return f'{where}: temperature/{name} has no new value for {pause_s:.0f} s'
