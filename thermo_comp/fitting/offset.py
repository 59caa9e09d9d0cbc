# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns words whose zero is far away: raw words of a converter, as in offset binary.

Angles and norms of raw vectors mean nothing there. So a fit is made of what is left above the word
of no force, and that word is a part of the calibration's bias.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ..typing import Floats
from ..unit.calibration import Axes, AxisReference, Calibration
from .coverage import rough_centre
from .options import COUNTS_FULL_SCALE, FitOptions
from .priors import constants_of
from .reduction import ReducedBag

# A bias beyond this part of 1 g is a word of no force.
_LARGEST_BIAS = 0.5


def find_offset(bags: Sequence[ReducedBag], options: FitOptions) -> Floats:
    """Find the word of no force of each axis, shape (3,): 0 but for words that have one."""
    if options.offset is not None:
        return np.full(3, options.offset)
    if options.input != 'counts':
        return np.zeros(3)
    if options.prior is not None:
        known = constants_of(options.prior)
        is_far = np.abs(known.bias / known.scale).max() > _LARGEST_BIAS * options.gravity
        return np.asarray(np.rint(known.bias) * is_far)
    middle = max(bag.middle for bag in bags)
    if middle:
        return np.full(3, middle)
    means = [np.average(i.mean, axis=0, weights=i.count) for bag in bags for i in bag.intervals]
    return np.rint(rough_centre(np.array(means)))


def centred(bag: ReducedBag, offset: Floats) -> ReducedBag:
    """Take the words of no force out of a bag, and of its source."""
    blocks = bag.source.blocks

    def moved() -> Iterator[Any]:
        for block in blocks():
            yield replace(cast(Any, block), accel=block.accel - offset)

    intervals = tuple(replace(one, mean=one.mean - offset) for one in bag.intervals)
    return replace(bag, source=replace(bag.source, blocks=moved), intervals=intervals)


def about(calibration: Calibration, offset: Floats) -> Calibration:
    """Make a calibration of words above those of no force one of the words themselves."""
    axes, unit = calibration.axes, calibration.unit
    full_scale = unit.full_scale
    if full_scale == COUNTS_FULL_SCALE and offset.max() > 0.0:
        # Words of 16 bits without a sign, of which nobody said how long they are.
        full_scale = 2.0 * COUNTS_FULL_SCALE + 1.0
    moved = (
        AxisReference(axis.scale_factor, axis.bias + by)
        for axis, by in zip((axes.x, axes.y, axes.z), offset.tolist(), strict=True)
    )
    return replace(calibration, unit=replace(unit, full_scale=full_scale), axes=Axes(*moved))


def with_notes(calibration: Calibration, notes: Sequence[str]) -> Calibration:
    """Add notes to a calibration's provenance."""
    provenance = calibration.provenance
    return replace(calibration, provenance=replace(provenance, notes=(*provenance.notes, *notes)))
