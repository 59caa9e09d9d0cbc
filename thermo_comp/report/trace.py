# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal trace of a bag: what the node's own tracker made of the readings, as columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..fitting.history import readings_in_order
from ..fitting.reduction import ReducedBag
from ..thermal.memory import BOARD_INPUT
from ..thermal.regime import Regime
from ..thermal.settings import DetectorSettings
from ..thermal.tracker import ThermalTracker
from ..typing import Floats

#: Grid points of a trace, whatever the bag's length; a line in a figure has fewer pixels.
_N_GRID = 4000
_SHORTEST_STEP_S = 1.0


@dataclass(frozen=True)
class Stretch:
    """A run of one regime and direction (-1 cooling, +1 heating, 0 neither) [s since start]."""

    start: float
    stop: float
    regime: Regime
    direction: int


@dataclass(frozen=True)
class ThermalTrace:
    """
    Thermal state on a uniform grid of times since the start, NaN where not known yet.

    Rates in K/s; the acceleration is that of the leading sensor [K/s^2].
    """

    time: Floats
    board_rate: Floats
    case_rate: Floats
    case_acceleration: Floats
    stretches: tuple[Stretch, ...]
    is_case_leading: bool


def thermal_trace(
    bag: ReducedBag, span_ns: tuple[int, int], detector: DetectorSettings
) -> ThermalTrace:
    """Run thermometers and detector over a bag's readings from `span_ns` on, as the node would."""
    tracker = ThermalTracker(detector)
    start_ns, end_ns = span_ns
    step_ns = max(round(_SHORTEST_STEP_S * 1e9), (end_ns - start_ns) // _N_GRID)
    grid = np.arange(start_ns, end_ns + 1, step_ns, dtype=np.int64)
    names, stamps, values = readings_in_order(bag, (BOARD_INPUT, 'case'))
    readings = zip(names, stamps.tolist(), values.tolist(), strict=True)
    reading = next(readings, None)
    flags: list[tuple[int, Regime, int]] = []
    rows: list[tuple[float, ...]] = []
    for grid_ns in grid.tolist():
        while reading is not None and reading[1] <= grid_ns:
            tracker.read(*reading)
            now = (tracker.detector.regime, tracker.detector.direction)
            if not flags or flags[-1][1:] != now:
                flags.append((reading[1], *now))
            reading = next(readings, None)
        b, c = tracker.board, tracker.case
        lead = b if c.stamp_ns is None else c
        bend = (lead.acceleration, lead.var_acceleration)
        rows.append((b.rate, b.var_rate, c.rate, c.var_rate, *bend))
    columns = np.array(rows).reshape(-1, 6).T
    return ThermalTrace(
        time=np.asarray((grid - start_ns) * 1e-9, dtype=np.float64),
        board_rate=_settled(columns[0], columns[1]),
        case_rate=_settled(columns[2], columns[3]),
        case_acceleration=_settled(columns[4], columns[5]),
        stretches=_stretches(flags, start_ns, end_ns),
        is_case_leading=bool(len(bag.case.value)),
    )


def _settled(value: Floats, variance: Floats) -> Floats:
    """Leave out an estimate until it has settled: its sd has come down to thrice the usual."""
    known = np.isfinite(value) & np.isfinite(variance)
    if not known.any():
        return np.full(len(value), np.nan)
    usual = float(np.median(variance[known]))
    first = int(np.argmax(known & (variance <= 9.0 * usual)))
    return np.where(known & (np.arange(len(value)) >= first), value, np.nan)


def _stretches(
    flags: list[tuple[int, Regime, int]], start_ns: int, end_ns: int
) -> tuple[Stretch, ...]:
    changes = [(start_ns, Regime.UNKNOWN, 0), *flags]
    ends = [stamp_ns for stamp_ns, _, _ in flags] + [end_ns]
    found: list[Stretch] = []
    for (begin_ns, regime, direction), until_ns in zip(changes, ends, strict=True):
        start, stop = (min(max(t, start_ns), end_ns) - start_ns for t in (begin_ns, until_ns))
        if stop <= start:
            continue
        if found and (found[-1].regime, found[-1].direction) == (regime, direction):
            start = round(found.pop().start * 1e9)
        found.append(Stretch(start * 1e-9, stop * 1e-9, regime, direction))
    return tuple(found)
