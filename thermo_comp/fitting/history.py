# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thermal history of a bag: the causal thermal state, on a uniform grid."""

from __future__ import annotations

import numpy as np

from ..thermal.tracker import ThermalTracker
from ..typing import Floats
from .reduction import ReducedBag


def thermal_states(
    bag: ReducedBag, tracker: ThermalTracker, step_s: float
) -> tuple[float, Floats]:
    """
    Drive a tracker with a bag's readings and sample it on a grid.

    Parameters
    ----------
    bag : ReducedBag
        The bag, with board readings.
    tracker : ThermalTracker
        A fresh one.
    step_s : float
        Grid step [s].

    Returns
    -------
    start_s : float
        Time of the first grid point since the bag's first sample [s].
    states : ndarray, shape (n, width)
        `ThermalTracker.sample` at each grid point.

    """
    stamps = np.concatenate((bag.board.stamp_ns, bag.case.stamp_ns))
    values = np.concatenate((bag.board.value, bag.case.value))
    is_case = np.concatenate(
        (np.zeros(len(bag.board.value), bool), np.ones(len(bag.case.value), bool))
    )
    order = np.argsort(stamps, kind='stable')
    stamps, values, is_case = stamps[order], values[order], is_case[order]
    step_ns = round(step_s * 1e9)
    begin = max(int(bag.board.stamp_ns[0]), bag.start_ns)
    grid = np.arange(begin, max(bag.end_ns, begin) + step_ns, step_ns)
    # Readings up to and including a grid stamp come first, as they do online.
    due = np.searchsorted(stamps, grid, side='right')
    rows = []
    reading = 0
    stamp_list, value_list, case_list = stamps.tolist(), values.tolist(), is_case.tolist()
    for stamp, stop in zip(grid.tolist(), due.tolist(), strict=True):
        while reading < stop:
            name = 'case' if case_list[reading] else 'board'
            tracker.read(name, stamp_list[reading], value_list[reading])
            reading += 1
        rows.append(tracker.sample(stamp))
    return (begin - bag.start_ns) * 1e-9, np.array(rows)
