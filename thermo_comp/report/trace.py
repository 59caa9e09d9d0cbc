# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal trace of a bag: what the node's own tracker made of the readings, as columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..fitting.reduction import Readings
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
    """
    A run of one regime and direction.

    Parameters
    ----------
    start, stop : float
        Time since the bag's start [s].
    regime : Regime
        The regime.
    direction : int
        -1 cooling, +1 heating, 0 neither.

    """

    start: float
    stop: float
    regime: Regime
    direction: int


@dataclass(frozen=True)
class ThermalTrace:
    """
    Thermal state of one bag on a uniform grid, NaN where it was not known yet.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Time since the bag's start [s].
    board_rate, case_rate : ndarray, shape (n,)
        dT/dt [K/s].
    case_acceleration : ndarray, shape (n,)
        d2T/dt2 of the leading sensor [K/s^2].
    stretches : tuple of Stretch
        The regime flag, without a gap.
    is_case_leading : bool
        False when the bag has no case sensor and the board stands in.

    """

    time: Floats
    board_rate: Floats
    case_rate: Floats
    case_acceleration: Floats
    stretches: tuple[Stretch, ...]
    is_case_leading: bool


def thermal_trace(
    board: Readings, case: Readings, span_ns: tuple[int, int], detector: DetectorSettings
) -> ThermalTrace:
    """
    Run the thermometers and the detector over a bag's readings, as the node would.

    Parameters
    ----------
    board, case : Readings
        The readings.
    span_ns : (int, int)
        First and last stamp of the bag; times count from the first.
    detector : DetectorSettings
        Thermometers and detector.

    Returns
    -------
    ThermalTrace
        For the figures.

    """
    tracker = ThermalTracker(detector)
    start_ns, end_ns = span_ns
    step_ns = max(round(_SHORTEST_STEP_S * 1e9), (end_ns - start_ns) // _N_GRID)
    grid = np.arange(start_ns, end_ns + 1, step_ns, dtype=np.int64)
    feed = _Feed(tracker, board, case)
    rows: list[tuple[float, ...]] = []
    for stamp_ns in grid.tolist():
        feed.until(stamp_ns)
        rows.append(_row(tracker))
    columns = np.array(rows).reshape(-1, 6).T
    return ThermalTrace(
        time=np.asarray((grid - start_ns) * 1e-9, dtype=np.float64),
        board_rate=_settled(columns[0], columns[1]),
        case_rate=_settled(columns[2], columns[3]),
        case_acceleration=_settled(columns[4], columns[5]),
        stretches=_stretches(feed.flags, start_ns, end_ns),
        is_case_leading=bool(len(case.value)),
    )


def _row(tracker: ThermalTracker) -> tuple[float, ...]:
    board, case = tracker.board, tracker.case
    lead = board if case.stamp_ns is None else case
    return (
        board.rate,
        board.var_rate,
        case.rate,
        case.var_rate,
        lead.acceleration,
        lead.var_acceleration,
    )


def _settled(value: Floats, variance: Floats) -> Floats:
    """Leave out an estimate until it has settled: its sd has come down to thrice the usual."""
    known = np.isfinite(value) & np.isfinite(variance)
    if not known.any():
        return np.full(len(value), np.nan)
    usual = float(np.median(variance[known]))
    first = int(np.argmax(known & (variance <= 9.0 * usual)))
    return np.where(known & (np.arange(len(value)) >= first), value, np.nan)


class _Feed:
    """Hands the readings of both sensors to a tracker in the order of their stamps."""

    def __init__(self, tracker: ThermalTracker, board: Readings, case: Readings) -> None:
        stamps = np.concatenate((board.stamp_ns, case.stamp_ns))
        values = np.concatenate((board.value, case.value))
        names = np.repeat((BOARD_INPUT, 'case'), (len(board.value), len(case.value)))
        order = np.argsort(stamps, kind='stable')
        self._stamps: list[int] = stamps[order].tolist()
        self._values: list[float] = values[order].tolist()
        self._names: list[str] = names[order].tolist()
        self._next = 0
        self._tracker = tracker
        #: Stamp, regime and direction at each change.
        self.flags: list[tuple[int, Regime, int]] = []

    def until(self, stamp_ns: int) -> None:
        """Hand over what was read up to and including a stamp."""
        tracker, stamps = self._tracker, self._stamps
        detector = tracker.detector
        k = self._next
        while k < len(stamps) and stamps[k] <= stamp_ns:
            tracker.read(self._names[k], stamps[k], self._values[k])
            now = (detector.regime, detector.direction)
            if not self.flags or self.flags[-1][1:] != now:
                self.flags.append((stamps[k], *now))
            k += 1
        self._next = k


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
