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
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.subscription import Subscription

from ..online.status import CompensatorStatus, Counters
from ..text import one_line
from ..thermal.plausibility import Fault
from ..thermal.regime import Regime
from .conversions import Traffic
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
_ERROR, _WARN = DiagnosticStatus.ERROR[0], DiagnosticStatus.WARN[0]
_DIRECTIONS = {-1: 'cooling', 0: 'none', 1: 'heating'}


#: Level and text.
Finding = tuple[int, str]


@dataclass(frozen=True, slots=True)
class Input:
    """An input, remapped, with those it hears, and why it does not hear another."""

    name: str
    topic: str
    n_publishers: int
    mismatch: str = ''


@dataclass(frozen=True, slots=True)
class Snapshot:
    """
    The node at one moment: variances as last published and the sample's own noise in them
    [m^2/s^4], silence [s], samples first.
    """

    status: CompensatorStatus
    traffic: Traffic
    variances: tuple[float, float, float] | None
    noise: list[float]
    silence_s: float
    inputs: tuple[Input, ...]


def look_at(node: Node, name: str, subscription: Subscription) -> Input:
    """Count the publishers of an input; where there is none, say why one is not heard."""
    topic, kind = subscription.topic_name, subscription.msg_type
    n_publishers = subscription.get_publisher_count()
    if n_publishers:
        return Input(name, topic, n_publishers)
    expected = f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
    for found in node.get_publishers_info_by_topic(topic):
        if found.topic_type != expected:
            return Input(name, topic, 0, f'its type is {found.topic_type}, not {expected}')
        fit, reason = qos_check_compatible(found.qos_profile, subscription.qos_profile)
        if fit == QoSCompatibility.ERROR:
            said = reason.replace('ERROR: ', '').rstrip('; ')
            return Input(name, topic, 0, f'{said} (qos_overrides.{topic}.subscription)')
    return Input(name, topic, 0)


def build(
    name: str, loaded: LoadedCalibration, now: Snapshot, before: Snapshot
) -> DiagnosticStatus:
    """Say how the compensation of a node is doing now, and what has happened since before."""
    findings = [*_input_findings(now, before), *_findings(loaded, now, before)]
    findings.sort(key=lambda finding: -finding[0])
    return DiagnosticStatus(
        level=bytes([findings[0][0] if findings else 0]),
        name=f'{name}: compensation',
        message=one_line('; '.join(text for _, text in findings) or _all_well(loaded, now)),
        hardware_id=loaded.calibration.unit.serial,
        values=[
            KeyValue(key=key, value=one_line(value)) for key, value in _values(loaded, now, before)
        ],
    )


def _input_findings(now: Snapshot, before: Snapshot) -> Iterator[Finding]:
    """Say what is wrong with those who send, and with the node itself."""
    for k, one in enumerate(now.inputs):
        if one.n_publishers > 1:
            text = f'{one.n_publishers} publishers on {one.topic}'
            yield _ERROR, f'{text}, it is not used until one is left'
        if one.mismatch:
            level = _ERROR if k < 2 else _WARN
            yield level, f'no messages of a publisher on {one.topic}: {one.mismatch}'
    n_contested = now.traffic.n_contested - before.traffic.n_contested
    if n_contested:
        yield _ERROR, f'{n_contested} messages of more than one publisher, dropped'
    n_failures = now.traffic.n_failures - before.traffic.n_failures
    if n_failures:
        yield _ERROR, f'{n_failures} callbacks failed, see the log of the node'


def _findings(loaded: LoadedCalibration, now: Snapshot, before: Snapshot) -> Iterator[Finding]:
    """Say what is wrong with what comes in and what is made of it."""
    status, unit = now.status, loaded.calibration.unit
    new = _since(status.counters, before.status.counters)
    if new.n_in == 0 and now.silence_s > max(SILENT_S, SILENT_CYCLES * unit.cycle_time_s):
        yield _ERROR, 'no samples are coming in'
    needs_board = loaded.calibration.needs_temperature
    is_seen = math.isfinite(status.board_age_s)
    if status.state is None:
        if needs_board:
            yield _ERROR, 'no board temperature yet, nothing is published'
    elif status.is_board_lost and needs_board:
        yield _ERROR, f'board temperature {status.board_age_s:.1f} s old, nothing is published'
    elif status.is_board_stale and is_seen:
        yield _WARN, f'board temperature {status.board_age_s:.1f} s old, held'
    yield from _sensor_findings(status)
    if new.n_stuck:
        yield _ERROR, f'{new.n_stuck} samples stuck or all zero, dropped'
    if new.n_too_fast:
        yield _ERROR, f'{new.n_too_fast} samples too fast for their conversion cycle, dropped'
    gravity = status.gravity
    if gravity is not None:
        missed = f'|f| at rest misses gravity by {gravity.residual:+.2e}'
        missed += f' +- {gravity.residual_sd:.1e} m/s^2'
        if status.is_refuted:
            yield _ERROR, f'{missed}: another unit, or an axis reversed? Nothing is published'
        elif gravity.sigmas > GRAVITY_SIGMAS:
            yield _WARN, f'{missed}: has the unit aged?'
    if new.n_saturated:
        yield _ERROR, f'{new.n_saturated} samples saturated (+-{unit.full_scale:g}), dropped'
    if status.state is not None and status.is_case_lost and needs_board:
        yield _WARN, 'case temperature lost, the board sensor decides the regime'
    for excess, what in (
        (status.temperature_excess_k, 'board temperature {:+.2f} K'),
        (status.rate_excess_k_min, 'temperature rate {:+.2f} K/min'),
    ):
        if excess:
            yield _WARN, f'{what.format(excess)} outside the calibrated range, held at its edge'
    for count, text in (
        (new.n_not_finite, 'samples not finite, dropped'),
        (new.n_out_of_order, 'samples out of order, dropped'),
        (new.n_time_jumps, 'jumps of time backwards, estimators reset'),
        (now.traffic.n_lost - before.traffic.n_lost, 'samples lost on the way to the node'),
        (now.traffic.n_malformed - before.traffic.n_malformed, 'messages unreadable, dropped'),
        (now.traffic.n_unpublished - before.traffic.n_unpublished, 'messages not accepted by DDS'),
    ):
        if count:
            yield _WARN, f'{count} {text}'
    rate, calibrated = _sample_rate(now, before), 1.0 / unit.cycle_time_s
    if rate is not None and abs(rate / calibrated - 1.0) > RATE_TOLERANCE:
        yield _WARN, f'{rate:.4g} samples/s, calibrated for {calibrated:.4g}'


def _sensor_findings(status: CompensatorStatus) -> Iterator[Finding]:
    """Say what is wrong with the thermometers themselves."""
    for name, fault, step in (
        ('board', status.board_fault, status.board_step_k),
        ('case', status.case_fault, status.case_step_k),
    ):
        if fault == Fault.STILL:
            yield _WARN, f'{name} temperature stands still to the bit, its uncertainty grows'
        elif fault == Fault.FROZEN:
            yield (_WARN, f'{name} temperature frozen: the other moves; its readings are not used')
        elif fault == Fault.STEP:
            yield _WARN, f'{name} temperature jumped by {step:+.2f} K; its readings are not used'
    ahead_s, excess_k = status.pending_ahead_s, status.gradient_excess_k
    if ahead_s > AHEAD_S:
        yield _WARN, f'temperatures are stamped {ahead_s:.0f} s ahead of the samples'
    if excess_k:
        text = f'case minus board {excess_k:+.2f} K'
        yield _WARN, f'{text} outside the calibrated range, held at its edge'
    if status.is_lead_reversed:
        text = 'are temperature/board and temperature/case swapped, or is it heated from inside?'
        yield _ERROR, f'the board leads the case in ramps: {text}'


def _all_well(loaded: LoadedCalibration, now: Snapshot) -> str:
    state = now.status.state
    if not loaded.calibration.needs_temperature:
        reference = loaded.calibration.reference_temperature_c
        return f'constants of {reference:g} degC, what temperature does is not known'
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
    densities = loaded.calibration.noise_density_m_s2_sqrt_hz
    for axis, density in zip('xyz', densities, strict=True):
        values.append((f'noise density {axis} [m/s^2/sqrt(Hz)]', f'{density:.3e}'))
    for axis, variance, noise in zip('xyz', now.variances or (), now.noise):  # noqa: B905
        values.append((f'sd {axis} [m/s^2]', f'{math.sqrt(variance):.3e}'))
        bias_sd = math.sqrt(max(0.0, variance - noise))
        values.append((f'bias sd {axis} [m/s^2]', f'{bias_sd:.3e}'))
    gyroscope = loaded.calibration.gyroscope
    for axis, density in zip('xyz', gyroscope.noise_density_rad_s_sqrt_hz if gyroscope else ()):  # noqa: B905
        values.append((f'noise density of rate {axis} [rad/s/sqrt(Hz)]', f'{density:.3e}'))
    for axis, bias_sd in zip('xyz', status.rate_bias_sd or ()):  # noqa: B905
        values.append((f'bias sd of rate {axis} [rad/s]', f'{bias_sd:.3e}'))
    rate = _sample_rate(now, before)
    values += [
        ('sample rate [Hz]', 'unknown' if rate is None else f'{rate:.2f}'),
        ('calibrated rate [Hz]', f'{1.0 / loaded.calibration.unit.cycle_time_s:.2f}'),
        ('samples in', str(counters.n_in)),
        ('samples out', str(counters.n_out - now.traffic.n_unpublished)),
    ]
    values += [
        (entry.name.removeprefix('n_').replace('_', ' '), str(getattr(holder, entry.name)))
        for holder in (counters, now.traffic)
        for entry in fields(holder)
        if entry.name != 'n_out'
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
    """Return samples per second of data time since the last report; None where nothing tells."""
    start_ns, end_ns = before.status.stamp_ns, now.status.stamp_ns
    n_new = now.status.counters.n_in - before.status.counters.n_in
    if start_ns is None or end_ns is None or end_ns <= start_ns:
        return None
    if not (n_new and before.status.counters.n_in):
        return None
    return n_new / ((end_ns - start_ns) * 1e-9)
