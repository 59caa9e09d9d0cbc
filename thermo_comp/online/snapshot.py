# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the look at a compensator that diagnostics take: ages, excesses, faults, checks.

"""

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
    """
    Say how a compensator stands at the stamp of its last sample.

    """
    tracker = compensator.tracker
    stamp_ns = compensator.now_ns
    if stamp_ns is None:
        stamp_ns = tracker.updated_ns
    counters = replace(compensator.counters)
    ahead_s = 0.0 if stamp_ns is None else compensator.pending_ahead(stamp_ns)
    board_ns, case_ns = tracker.board.stamp_ns, tracker.case.stamp_ns
    if stamp_ns is None or board_ns is None:
        return CompensatorStatus(
            counters,
            stamp_ns,
            None,
            math.inf,
            math.inf,
            True,
            True,
            True,
            0.0,
            0.0,
            0.0,
            pending_ahead_s=ahead_s,
        )
    board_age = (stamp_ns - board_ns) * 1e-9
    # Half the time-out at the latest, so that a warning always comes before the error.
    stale_after = compensator.config.temperature_timeout_s / 2.0
    usual = STALE_INTERVALS * tracker.board.interval_s
    if usual < stale_after:
        stale_after = max(usual, SHORTEST_STALE_S)
    state = tracker.sample(stamp_ns)
    regime_set = (
        compensator.correction.dynamic
        if tracker.detector.regime == Regime.DYNAMIC
        else compensator.correction.static
    )
    _, excess = regime_set.regressors(state)
    return CompensatorStatus(
        counters,
        stamp_ns,
        tracker.state_at(stamp_ns),
        board_age,
        math.inf if case_ns is None else (stamp_ns - case_ns) * 1e-9,
        board_age > stale_after,
        board_age > compensator.config.temperature_timeout_s,
        not tracker.is_case_live(stamp_ns),
        regime_set.relative_excess(excess),
        excess.temperature,
        excess.rate * 60.0,
        gradient_excess_k=excess.gradient,
        board_fault=tracker.board_guard.fault,
        case_fault=tracker.case_guard.fault,
        board_step_k=tracker.board_guard.step,
        case_step_k=tracker.case_guard.step,
        is_lead_reversed=tracker.lead.is_reversed,
        rate_ratio=compensator.rate.ratio,
        is_too_fast=compensator.rate_refuses,
        gravity=compensator.gravity.result,
        is_refuted=compensator.gravity.is_refuted,
        pending_ahead_s=ahead_s,
    )
