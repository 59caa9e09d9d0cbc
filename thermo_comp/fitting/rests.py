# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the judgement of the rests: a sensor that jumped, which no temperature explains."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..typing import Floats
from ..unit.gravity import STANDARD_GRAVITY
from .branches import Event, find_branches
from .options import FitOptions
from .reduction import ReducedBag, StillInterval
from .verdict import Finding

# Neighbours this close in time and direction may be one rest with a step in it.
_NEAR_S, _NEAR_DEG = 30.0, 10.0


def find_jumps(bag: ReducedBag) -> tuple[Event, ...]:
    """Find where a sensor jumped at rest; streams the bag again only where that may be."""
    if len(bag.intervals) < 2:
        return ()
    up = _directions(bag.intervals)
    close = np.einsum('ij,ij->i', up[1:], up[:-1]) > np.cos(np.radians(_NEAR_DEG))
    short = [
        after.start_ns - before.end_ns <= _NEAR_S * 1e9
        for before, after in pairwise(bag.intervals)
    ]
    if not np.any(close & np.array(short)):
        return ()
    return tuple(event for event in find_branches(bag.source, bag)[0] if event.kind == 'jump')


def judge_rests(bags: Sequence[ReducedBag], options: FitOptions) -> list[Finding]:
    """Judge whether the sensor kept still where the unit did."""
    jumps = [(bag, event) for bag in bags for event in find_jumps(bag)]
    if not jumps:
        return []
    per_mg = milli_g(bags, options.input)
    said = '; '.join(
        f'{bag.source.name}: {describe(event, per_mg, bag.since_s)}' for bag, event in jumps
    )
    return [
        Finding('jump', 'refusal', f'{said}: leave out such a bag, or end before it with --to')
    ]


def milli_g(bags: Sequence[ReducedBag], kind: str) -> float:
    """Input units of a thousandth of g: of the typical reading at rest, for counts."""
    if kind == 'm/s^2':
        return STANDARD_GRAVITY * 1e-3
    means = np.concatenate([interval.mean for bag in bags for interval in bag.intervals])
    return float(np.median(np.linalg.norm(means, axis=1))) * 1e-3


def describe(event: Event, per_mg: float, since_s: float = 0.0) -> str:
    """Say one step in words; `since_s` is where the part of its bag begins."""
    at = f'at {event.time + since_s:.1f} s'
    vector = ', '.join(f'{v / per_mg:+.3g}' for v in event.step)
    along = f'{event.along / per_mg:+.3g} mg along gravity'
    size = f'{along} ({vector}) within {event.duration_s:.2g} s'
    if event.kind == 'jump':
        warmed = ''
        if np.isfinite(event.temperature_change):
            warmed = (
                f', while its temperature changed by {event.temperature_change:+.2f} ± '
                f'{event.temperature_change_sd:.2f} K'
            )
        return (
            f'{at} the sensor jumped by {size}, without motion{warmed}: not a '
            'function of temperature'
        )
    what = 'may have been turned or jumped' if event.kind == 'turn' else 'was moved'
    return f'{at} the unit {what}: the reading changed by {size}'


def _directions(intervals: Sequence[StillInterval]) -> Floats:
    means = np.array([np.average(i.mean, axis=0, weights=i.count) for i in intervals])
    return np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True))
