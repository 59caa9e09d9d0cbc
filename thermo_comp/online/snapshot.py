# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the look at a compensator that diagnostics take: ages, excesses, faults, checks."""

from __future__ import annotations

import math
from dataclasses import replace

from ..thermal.regime import Regime
from .compensator import Compensator
from .status import CompensatorStatus

#: The board temperature is called stale beyond this many of its usual intervals.
STALE_INTERVALS = 5.0
#: ... but never sooner than this [s].
SHORTEST_STALE_S = 0.5


def take_snapshot(compensator: Compensator) -> CompensatorStatus:
    """Say how a compensator stands at the stamp of its last sample."""
    thermal = compensator.thermal
    tracker = thermal.tracker
    stamp_ns = compensator.now_ns
    if stamp_ns is None:
        stamp_ns = tracker.updated_ns
    counters = replace(compensator.counters)
    ahead_s = 0.0 if stamp_ns is None else thermal.queue.ahead(stamp_ns)
    faults = {name: (check.fault, check.step) for name, check in tracker.checks.items()}
    board_ns, case_ns = tracker.board.stamp_ns, tracker.case.stamp_ns
    if stamp_ns is None or (board_ns is None and not thermal.is_unmeasured):
        return CompensatorStatus(counters, stamp_ns, faults=faults, pending_ahead_s=ahead_s)
    board_age = math.inf if board_ns is None else (stamp_ns - board_ns) * 1e-9
    # Half the time-out at the latest, so that a warning always comes before the error.
    stale_after = compensator.config.temperature_timeout_s / 2.0
    usual = STALE_INTERVALS * tracker.board.interval_s
    if usual < stale_after:
        stale_after = max(usual, SHORTEST_STALE_S)
    state = thermal.sample(stamp_ns)
    is_dynamic = tracker.detector.regime == Regime.DYNAMIC
    excess = thermal.correction.excess(state, is_dynamic=is_dynamic)
    return CompensatorStatus(
        counters,
        stamp_ns,
        thermal.state_at(stamp_ns),
        board_age,
        math.inf if case_ns is None else (stamp_ns - case_ns) * 1e-9,
        board_age > stale_after,
        board_age > compensator.config.temperature_timeout_s,
        not tracker.is_live(stamp_ns, tracker.case),
        excess.relative,
        excess.temperature,
        excess.rate * 60.0,
        gradient_excess_k=excess.gradient,
        faults=faults,
        is_lead_reversed=tracker.lead.is_reversed,
        gravity=compensator.gravity.result,
        is_refuted=compensator.gravity.is_refuted,
        rate_bias_sd=_rate_bias_sd(compensator),
        pending_ahead_s=ahead_s,
    )


def _rate_bias_sd(compensator: Compensator) -> tuple[float, ...] | None:
    thermal, line = compensator.thermal, compensator.rate_line
    if thermal.rate_correction is None or not line:
        return None
    noises = [(1.0 + thermal.noise_excess) * one for one in thermal.rate_correction.noise]
    pairs = zip(line[12::3], noises, strict=True)
    return tuple(math.sqrt(max(0.0, whole - noise)) for whole, noise in pairs)
