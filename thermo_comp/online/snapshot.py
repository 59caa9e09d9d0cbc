# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the look at a compensator that diagnostics take: ages, excesses, faults, checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

from ..thermal.plausibility import Fault
from ..thermal.regime import Regime
from ..thermal.state import ThermalState
from ..unit.correction import Excess
from .compensator import Compensator
from .status import GravityResidual

#: The board temperature is called stale beyond this many of its usual intervals.
STALE_INTERVALS = 5.0
SHORTEST_STALE_S = 0.5  # ... but never sooner than this [s]

_INSIDE = Excess(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CompensatorStatus:
    """How a compensator stands."""

    stamp_ns: int | None
    #: By thermometer what is wrong with its readings, and the size of a step not believed [K].
    faults: Mapping[str, tuple[Fault, float]]
    #: How far the stamps of the readings that wait are ahead of the samples' [s].
    pending_ahead_s: float
    state: ThermalState | None = None  # None until there is a board temperature
    #: Ages of the last used readings at the last sample [s]; infinite when there was none.
    board_age_s: float = inf
    case_age_s: float = inf
    is_board_stale: bool = True
    is_board_lost: bool = True
    is_case_lost: bool = True
    excess: Excess = _INSIDE
    #: Whether the board has led the case in a ramp: the two topics are swapped, most likely.
    is_lead_reversed: bool = False
    #: |f| - g while the platform stands; None before it has stood.
    gravity: GravityResidual | None = None
    #: Whether |f| at rest misses gravity by more than the tolerance: nothing is published.
    is_refuted: bool = False
    #: What is uncertain of the bias of each axis' angular rate [rad/s]; empty where none is known.
    rate_bias_sd: tuple[float, ...] = ()


def take_snapshot(compensator: Compensator) -> CompensatorStatus:
    """Say how a compensator stands at the stamp of its last sample."""
    thermal = compensator.thermal
    tracker, rate = thermal.tracker, thermal.rate_correction
    stamp_ns = compensator.now_ns
    if stamp_ns is None:
        stamp_ns = tracker.updated_ns
    ahead_s = 0.0 if stamp_ns is None else thermal.queue.ahead(stamp_ns)
    faults = {name: (check.fault, check.step) for name, check in tracker.checks.items()}
    board_ns, case_ns = tracker.board.stamp_ns, tracker.case.stamp_ns
    if stamp_ns is None or (board_ns is None and not thermal.is_unmeasured):
        return CompensatorStatus(stamp_ns, faults, ahead_s)
    board_age = inf if board_ns is None else (stamp_ns - board_ns) * 1e-9
    # Half the time-out at the latest, so that a warning always comes before the error.
    latest = compensator.config.temperature_timeout_s / 2.0
    stale_after = min(latest, max(STALE_INTERVALS * tracker.board.interval_s, SHORTEST_STALE_S))
    state = thermal.sample(stamp_ns)
    is_dynamic = tracker.detector.regime == Regime.DYNAMIC
    return CompensatorStatus(
        stamp_ns,
        faults,
        ahead_s,
        thermal.state_at(stamp_ns),
        board_age,
        inf if case_ns is None else (stamp_ns - case_ns) * 1e-9,
        board_age > stale_after,
        board_age > compensator.config.temperature_timeout_s,
        not tracker.is_live(stamp_ns, tracker.case),
        thermal.correction.excess(state, is_dynamic=is_dynamic),
        tracker.lead.is_reversed,
        compensator.gravity.result,
        compensator.gravity.is_refuted,
        thermal.bias_sd(rate, compensator.rate_line[12::3]) if rate else (),
    )
