# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the bag that figures over time show, with rates and regimes by the node's tracker."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from ..fitting.reduction import ReducedBag
from ..fitting.sensors import readings_in_order
from ..thermal.lags import BOARD_INPUT
from ..thermal.regime import Regime
from ..thermal.settings import DetectorSettings
from ..thermal.tracker import ThermalTracker
from ..typing import Floats

# Largest number of points of a line; a figure has fewer pixels in a row.
_MOST_POINTS = 4000


class Stretch(NamedTuple):
    """An interval [s since start] of one regime and direction (-1 cooling, +1 heating, 0 none)."""

    start: float
    stop: float
    regime: Regime
    direction: int


@dataclass(frozen=True)
class ShownBag:
    """Rates, second derivative (NaN until settled) and regimes of a bag over time [K, s]."""

    index: int
    bag: ReducedBag
    start_ns: int
    duration_s: float
    time: Floats
    board_rate: Floats
    case_rate: Floats
    acceleration: Floats
    stretches: tuple[Stretch, ...]

    @property
    def leader(self) -> str:
        """The leading sensor: the case's if the bag has a case thermometer, else the board's."""
        return 'case' if len(self.bag.case.value) else 'board'


def span_of(bag: ReducedBag) -> tuple[int, float]:
    """Return start [ns] and length [s] of a bag's samples or, without samples, of its readings."""
    start_ns, end_ns = bag.start_ns, bag.end_ns
    if not bag.n_samples:
        start_ns, end_ns = bag.board.stamp_ns[[0, -1]].tolist()
    return start_ns, (end_ns - start_ns) * 1e-9


def widest(bags: Sequence[ReducedBag]) -> int:
    """Return the index of the bag with the widest range of T_board; if several, the longest."""
    spans = [float(np.ptp(bag.board.value)) if len(bag.board.value) else 0.0 for bag in bags]
    # Spans within 5 % and lengths within a minute count as equal; of equal bags take the first.
    candidates = [i for i, span in enumerate(spans) if span >= 0.95 * max(spans)]
    return max(candidates, key=lambda i: (round((bags[i].end_ns - bags[i].start_ns) / 60e9), -i))


def shown_bag(bag: ReducedBag, index: int, detector: DetectorSettings) -> ShownBag:
    """Run thermometers and detector over a bag's readings, as the node would."""
    tracker = ThermalTracker(detector)
    start_ns, end = span_of(bag)
    readings = readings_in_order(bag, (BOARD_INPUT, 'case'))
    rows, flags = [], []
    for reading in readings:
        tracker.read(*reading)
        b, c = tracker.board, tracker.case
        lead = b if c.stamp_ns is None else c
        rows.append((b.rate, b.var_rate, c.rate, c.var_rate, *lead.acceleration))
        flags.append((tracker.detector.regime, tracker.detector.direction))
    time: Floats = np.array([stamp_ns - start_ns for _, stamp_ns, _ in readings]) * 1e-9
    # Of several regimes at one time the last applies; equal successive regimes are joined.
    state_at = {
        0.0: (Regime.UNKNOWN, 0),
        **dict(zip(np.clip(time, 0.0, end).tolist(), flags, strict=True)),
    }
    changes = [next(run) for _, run in groupby(state_at.items(), key=itemgetter(1))]
    begins = [begin for begin, _ in changes]
    stretches = (
        Stretch(begin, stop, *state)
        for (begin, state), stop in zip(changes, [*begins[1:], end], strict=True)
        if stop > begin
    )
    every = slice(None, None, len(time) // _MOST_POINTS + 1)
    columns = np.array(rows).reshape(-1, 3, 2)[every]
    board, case, bend = (_settled(*columns[:, k].T) for k in range(3))
    return ShownBag(index, bag, start_ns, end, time[every], board, case, bend, tuple(stretches))


def _settled(value: Floats, variance: Floats) -> Floats:
    """Set an estimate to NaN until its sd has fallen to three times the median sd."""
    known = np.isfinite(value) & np.isfinite(variance)
    if not known.any():
        return np.full(len(value), np.nan)
    usual = float(np.median(variance[known]))
    first = int(np.argmax(known & (variance <= 9.0 * usual)))
    return np.where(known & (np.arange(len(value)) >= first), value, np.nan)
