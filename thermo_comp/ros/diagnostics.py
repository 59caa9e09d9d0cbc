# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the node says about itself: the compensator's status as a `DiagnosticStatus`.

The level follows one rule. ERROR: nothing good goes out, or samples are saturated. WARN: what goes
out is worse than the calibration promises. OK: the rest. The message names every reason, the worst
first; the key values hold the figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from ..online.status import CompensatorStatus, Counters
from ..text import one_line
from ..thermal.plausibility import Fault
from ..thermal.regime import Regime
from .reader import LoadedCalibration

#: A sample rate further from the calibrated one than this is worth a warning.
RATE_TOLERANCE = 0.1
#: Readings stamped this much ahead of the samples wait too long to be of one clock with them [s].
AHEAD_S = 5.0
#: Samples that are late by so many cycles, and by so long [s], do not come any more.
SILENT_CYCLES, SILENT_S = 5.0, 0.5
#: |f| at rest may miss gravity by this many of its own standard deviations.
GRAVITY_SIGMAS = 5.0

_REGIMES = {Regime.UNKNOWN: 'unknown', Regime.STATIC: 'static', Regime.DYNAMIC: 'dynamic'}
_DIRECTIONS = {-1: 'cooling', 0: 'none', 1: 'heating'}


@dataclass(frozen=True, slots=True)
class Traffic:
    """What the node itself counts, beside the compensator's counters."""

    #: Samples that the driver sent and the node did not get.
    n_lost: int = 0
    #: Output messages that the middleware did not accept.
    n_unpublished: int = 0
    #: Messages that could not be read.
    n_malformed: int = 0
    #: Regime flags published.
    n_flags: int = 0
    #: Samples that took the slow way through rclpy's deserialization.
    n_fallback: int = 0
    #: Messages not used because their input had more than one publisher.
    n_contested: int = 0
    #: Callbacks of the node that ended in an exception.
    n_failures: int = 0


@dataclass(frozen=True, slots=True)
class Input:
    """
    A topic that the node reads: what comes in there, its name remapped, the publishers that the
    node hears, and why it does not hear one that is there.
    """

    name: str
    topic: str
    n_publishers: int
    mismatch: str = ''


@dataclass(frozen=True, slots=True)
class Snapshot:
    """
    The node at one moment: the diagonal of the covariance last published [m^2/s^4], for how long
    there have been no samples, and the inputs, samples first.
    """

    status: CompensatorStatus
    traffic: Traffic
    variances: tuple[float, float, float] | None
    silence_s: float
    inputs: tuple[Input, ...]


def build(
    name: str, loaded: LoadedCalibration, now: Snapshot, before: Snapshot
) -> DiagnosticStatus:
    """
    Say how the compensation of a node (two units are two entries) is doing; differences to the
    last report tell what happened in between.
    """
    findings = sorted(_findings(loaded, now, before), key=lambda finding: -finding[0])
    return DiagnosticStatus(
        level=bytes([findings[0][0] if findings else 0]),
        name=f'{name}: compensation',
        message=one_line('; '.join(text for _, text in findings) or _all_well(now)),
        hardware_id=loaded.calibration.unit.serial,
        values=[
            KeyValue(key=key, value=one_line(value)) for key, value in _values(loaded, now, before)
        ],
    )


def _findings(loaded: LoadedCalibration, now: Snapshot, before: Snapshot) -> list[tuple[int, str]]:
    """List everything that is not as it should be, with its level."""
    error, warn = DiagnosticStatus.ERROR[0], DiagnosticStatus.WARN[0]
    status, new = now.status, _since(now.status.counters, before.status.counters)
    found = _input_findings(now, before)
    silent_s = max(SILENT_S, SILENT_CYCLES * loaded.calibration.unit.cycle_time_s)
    if new.n_in == 0 and now.silence_s > silent_s:
        found.append((error, 'no samples are coming in'))
    if status.state is None:
        found.append((error, 'no board temperature yet, nothing is published'))
    elif status.is_board_lost:
        found.append(
            (error, f'board temperature {status.board_age_s:.1f} s old, nothing is published')
        )
    elif status.is_board_stale:
        found.append((warn, f'board temperature {status.board_age_s:.1f} s old, held'))
    found += _sensor_findings(status)
    if status.is_lead_reversed:
        found.append(
            (
                error,
                'the board leads the case in ramps: are temperature/board and temperature/case '
                'swapped, or is it heated from inside?',
            )
        )
    found += _sample_findings(status, new)
    if new.n_saturated:
        full_scale = loaded.calibration.unit.full_scale
        found.append((error, f'{new.n_saturated} samples saturated (+-{full_scale:g}), dropped'))
    if status.state is not None and status.is_case_lost:
        found.append((warn, 'case temperature lost, the board sensor decides the regime'))
    if status.temperature_excess_k:
        found.append(
            (
                warn,
                f'board temperature {status.temperature_excess_k:+.2f} K outside the '
                'calibrated range, held at its edge',
            )
        )
    if status.rate_excess_k_min:
        found.append(
            (
                warn,
                f'temperature rate {status.rate_excess_k_min:+.2f} K/min outside the '
                'calibrated range, held at its edge',
            )
        )
    for count, text in (
        (new.n_not_finite, 'samples not finite, dropped'),
        (new.n_out_of_order, 'samples out of order, dropped'),
        (new.n_time_jumps, 'jumps of time backwards, estimators reset'),
        (now.traffic.n_lost - before.traffic.n_lost, 'samples lost on the way to the node'),
        (now.traffic.n_malformed - before.traffic.n_malformed, 'messages unreadable, dropped'),
        (now.traffic.n_unpublished - before.traffic.n_unpublished, 'messages not accepted by DDS'),
    ):
        if count:
            found.append((warn, f'{count} {text}'))
    rate, calibrated = _sample_rate(now, before), 1.0 / loaded.calibration.unit.cycle_time_s
    if rate is not None and abs(rate / calibrated - 1.0) > RATE_TOLERANCE:
        found.append((warn, f'{rate:.4g} samples/s, calibrated for {calibrated:.4g}'))
    return found


def _input_findings(now: Snapshot, before: Snapshot) -> list[tuple[int, str]]:
    """Say what is wrong with those who send, and with the node itself."""
    error, warn = DiagnosticStatus.ERROR[0], DiagnosticStatus.WARN[0]
    found: list[tuple[int, str]] = []
    for k, one in enumerate(now.inputs):
        if one.n_publishers > 1:
            text = f'{one.n_publishers} publishers on {one.topic}'
            found.append((error, f'{text}, it is not used until one is left'))
        if one.mismatch:
            level = error if k < 2 else warn
            found.append((level, f'no messages of a publisher on {one.topic}: {one.mismatch}'))
    n_contested = now.traffic.n_contested - before.traffic.n_contested
    if n_contested:
        found.append((error, f'{n_contested} messages of more than one publisher, dropped'))
    n_failures = now.traffic.n_failures - before.traffic.n_failures
    if n_failures:
        found.append((error, f'{n_failures} callbacks failed, see the log of the node'))
    return found


def _sensor_findings(status: CompensatorStatus) -> list[tuple[int, str]]:
    """Say what is wrong with the thermometers themselves."""
    found = []
    for name, fault, step in (
        ('board', status.board_fault, status.board_step_k),
        ('case', status.case_fault, status.case_step_k),
    ):
        if fault == Fault.STILL:
            text = 'stands still to the bit, its uncertainty grows'
        elif fault == Fault.FROZEN:
            text = 'frozen: the other one moves; its readings are not used'
        elif fault == Fault.STEP:
            text = f'jumped by {step:+.2f} K; its readings are not used'
        else:
            continue
        found.append((DiagnosticStatus.WARN[0], f'{name} temperature {text}'))
    if status.pending_ahead_s > AHEAD_S:
        found.append(
            (
                DiagnosticStatus.WARN[0],
                f'temperatures are stamped {status.pending_ahead_s:.0f} s ahead of the samples',
            )
        )
    if status.gradient_excess_k:
        found.append(
            (
                DiagnosticStatus.WARN[0],
                f'case minus board {status.gradient_excess_k:+.2f} K outside the calibrated '
                'range, held at its edge',
            )
        )
    return found


def _sample_findings(status: CompensatorStatus, new: Counters) -> list[tuple[int, str]]:
    """Say what is wrong with the samples themselves, and with the calibration for them."""
    error, warn = DiagnosticStatus.ERROR[0], DiagnosticStatus.WARN[0]
    found = []
    if new.n_stuck:
        found.append((error, f'{new.n_stuck} samples stuck or all zero, dropped'))
    if new.n_too_fast:
        found.append(
            (error, f'{new.n_too_fast} samples too fast for their conversion cycle, dropped')
        )
    gravity = status.gravity
    if gravity is not None:
        figure = f'{gravity.residual:+.2e} +- {gravity.residual_sd:.1e} m/s^2'
        if status.is_refuted:
            found.append(
                (
                    error,
                    f'|f| at rest misses gravity by {figure}: another unit, or an axis '
                    'reversed? Nothing is published',
                )
            )
        elif gravity.sigmas > GRAVITY_SIGMAS:
            found.append((warn, f'|f| at rest misses gravity by {figure}: has the unit aged?'))
    return found


def _all_well(now: Snapshot) -> str:
    state = now.status.state
    if state is None or state.regime == Regime.UNKNOWN:
        return 'regime not known yet, the static set applies'
    return f'{_REGIMES[state.regime]} regime'


def _values(loaded: LoadedCalibration, now: Snapshot, before: Snapshot) -> list[tuple[str, str]]:
    """List the figures, in the order in which a reader wants them."""
    status, counters = now.status, now.status.counters
    state = status.state
    values = [('regime', 'unknown' if state is None else _REGIMES[state.regime])]
    if state is not None:
        values += [
            ('direction', _DIRECTIONS[state.direction]),
            ('dynamic weight', f'{state.weight:.3f}'),
            ('board temperature [degC]', f'{state.board:.4f}'),
            ('board temperature sd [K]', f'{math.sqrt(state.var_board):.4f}'),
            ('board rate [K/min]', f'{60.0 * state.rate:.4f}'),
            ('case minus board [K]', f'{state.gradient:.4f}'),
            ('memory settled', str(state.is_settled)),
        ]
    values += [
        ('board age [s]', f'{status.board_age_s:.3f}'),
        ('case age [s]', f'{status.case_age_s:.3f}'),
        ('board fault', status.board_fault.value),
        ('case fault', status.case_fault.value),
        ('gradient excess [K]', f'{status.gradient_excess_k:.3f}'),
        ('temperature excess [K]', f'{status.temperature_excess_k:.3f}'),
        ('rate excess [K/min]', f'{status.rate_excess_k_min:.3f}'),
    ]
    if status.gravity is not None:
        values += [
            ('gravity residual [m/s^2]', f'{status.gravity.residual:.3e}'),
            ('gravity residual sd [m/s^2]', f'{status.gravity.residual_sd:.3e}'),
            ('gravity windows', str(status.gravity.n_windows)),
            ('standing', str(status.gravity.is_still)),
        ]
    if now.variances is not None:
        values += [
            (f'sd {axis} [m/s^2]', f'{math.sqrt(variance):.3e}')
            for axis, variance in zip('xyz', now.variances, strict=True)
        ]
    rate = _sample_rate(now, before)
    values += [
        ('sample rate [Hz]', 'unknown' if rate is None else f'{rate:.2f}'),
        ('calibrated rate [Hz]', f'{1.0 / loaded.calibration.unit.cycle_time_s:.2f}'),
        ('samples in', str(counters.n_in)),
        ('samples out', str(counters.n_out - now.traffic.n_unpublished)),
    ]
    values += [
        (entry.name.removeprefix('n_').replace('_', ' '), str(getattr(counters, entry.name)))
        for entry in fields(Counters)
        if entry.name != 'n_out'
    ]
    values += [
        (entry.name.removeprefix('n_').replace('_', ' '), str(getattr(now.traffic, entry.name)))
        for entry in fields(Traffic)
    ]
    values += [(f'{one.name} publishers', str(one.n_publishers)) for one in now.inputs]
    return [
        *values,
        ('sample stamp [ns]', 'none' if status.stamp_ns is None else str(status.stamp_ns)),
        ('serial', loaded.calibration.unit.serial),
        ('calibration file', loaded.path),
        ('calibration sha256', loaded.sha256),
        ('calibration date', loaded.calibration.provenance.created),
    ]


def _since(now: Counters, before: Counters) -> Counters:
    return replace(
        now,
        **{one.name: getattr(now, one.name) - getattr(before, one.name) for one in fields(now)},
    )


def _sample_rate(now: Snapshot, before: Snapshot) -> float | None:
    """
    Return samples per second of data time since the last report; None where it can't be told.
    """
    start_ns, end_ns = before.status.stamp_ns, now.status.stamp_ns
    n_new = now.status.counters.n_in - before.status.counters.n_in
    if start_ns is None or end_ns is None or end_ns <= start_ns:
        return None
    if not (n_new and before.status.counters.n_in):
        return None
    return n_new / ((end_ns - start_ns) * 1e-9)
