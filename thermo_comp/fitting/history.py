# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thermal history of a bag: the causal thermal state, on a uniform grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..thermal.tracker import ThermalTracker
from ..typing import Floats, Ints
from .reduction import NO_READINGS, ReducedBag


def readings_in_order(bag: ReducedBag, inputs: Sequence[str]) -> tuple[list[str], Ints, Floats]:
    """Thermometer, stamp and value of each reading; of equal stamps in the order of `inputs`."""
    found = [bag.temperatures.get(name, NO_READINGS) for name in inputs]
    stamps = np.concatenate([one.stamp_ns for one in found])
    order = np.argsort(stamps, kind='stable')
    names = np.repeat(inputs, [len(one.value) for one in found])[order]
    values = np.concatenate([one.value for one in found])[order]
    return names.tolist(), stamps[order], values


def thermal_states(
    bag: ReducedBag, tracker: ThermalTracker, step_s: float
) -> tuple[float, Floats]:
    """
    Drive a tracker with a bag's readings and sample it on a grid.

    `step_s`: grid step [s]. Returns time of the first grid point since the bag's first sample [s].
    Returns `ThermalTracker.sample` at each grid point, shape (n, width).
    """
    names, stamps, values = readings_in_order(bag, ('board', *tracker.spec.sensors))
    step_ns = round(step_s * 1e9)
    begin = max(int(bag.board.stamp_ns[0]), bag.start_ns)
    grid = np.arange(begin, max(bag.end_ns, begin) + step_ns, step_ns)
    # Readings up to and including a grid stamp come first, as they do online.
    due = np.searchsorted(stamps, grid, side='right')
    rows = []
    reading = 0
    stamp_list, value_list = stamps.tolist(), values.tolist()
    for stamp, stop in zip(grid.tolist(), due.tolist(), strict=True):
        while reading < stop:
            tracker.read(names[reading], stamp_list[reading], value_list[reading])
            reading += 1
        rows.append(tracker.sample(stamp))
    return (begin - bag.start_ns) * 1e-9, np.array(rows)
