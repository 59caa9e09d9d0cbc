# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node's diagnostics: the compensator's status as a `DiagnosticStatus`.

Each finding has the level ERROR or WARN. The message names every finding, the most severe first,
and has the level of the first finding; without findings the level is OK.
"""

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.subscription import Subscription

from ..online.checks import RATE_TOLERANCE
from ..online.compensator import CONTINUED, HELD, SWAPPED, Compensator, CompensatorStatus
from ..text import counted, one_line
from ..thermal.plausibility import Fault
from ..thermal.regime import Regime
from ..thermal.state import BOARD, GRADIENT, RATE, VAR_BOARD, WEIGHT
from ..topics import STATUS
from ..unit.calibration import Calibration
from ..unit.gravity import STANDARD_GRAVITY
from .messages import qos_of
from .reader import LoadedCalibration
from .relay import Relay
from .waitloop import WaitLoop

# Time without samples [s] after which readings are used alone; Fast DDS may deliver 3 s late.
IDLE_S = 5.0
#: Readings with stamps more than this time [s] after the samples' stamps are of another clock.
AHEAD_S = 5.0
#: Samples have stopped if none arrives for this number of conversion cycles and this time [s].
SILENT_CYCLES, SILENT_S = 5.0, 0.5
#: Time for which the level of the diagnostics must stay below the logged level before the lower
#: level is logged [s]; a fault that comes and goes then does not fill the log.
RELIEF_S = 5.0
#: Largest error of |f| at rest without a warning, in standard deviations of the error.
GRAVITY_SIGMAS = 5.0

_ERROR, _WARN = DiagnosticStatus.ERROR[0], DiagnosticStatus.WARN[0]
_DIRECTIONS = {-1: 'cooling', 0: 'none', 1: 'heating'}

#: Level and text of a finding if a counter has risen; the rise follows the text.
_RISEN = {
    'n_contested': (_ERROR, 'messages of more than one publisher, dropped'),
    'n_failures': (_ERROR, 'callbacks failed, see the log of the node'),
    'n_absent': (
        _ERROR,
        'messages of {topic} without an acceleration (linear_acceleration_covariance[0] = -1), '
        'taken as not finite',
    ),
    'n_stuck': (_ERROR, 'samples stuck or all zero, dropped'),
    'n_too_fast': (_ERROR, 'samples too fast for their conversion cycle, dropped'),
    'n_unsound': (_ERROR, 'samples without a finite correction, dropped'),
    'n_saturated': (_ERROR, 'samples saturated (full scale {full_scale:g}), dropped'),
    'n_not_finite': (_WARN, 'samples not finite, dropped'),
    'n_out_of_order': (_WARN, 'samples out of order, dropped'),
    'n_time_jumps': (_WARN, 'jumps of time backwards, estimators reset'),
    'n_lost': (_WARN, 'samples lost on the way to the node'),
    'n_malformed': (_WARN, 'messages unreadable, dropped'),
    'n_unpublished': (_WARN, 'output messages not accepted by DDS'),
}

_FAULTS = {
    Fault.STILL: 'stands still (equal readings), its standard deviation grows',
    Fault.FROZEN: 'frozen (equal readings) while the other temperature changes: not used',
    Fault.STEP: 'jumped by {:+.2f} K; its readings are not used',
    Fault.SHIFTED: 'has jumped by {:+.1f} K, included in its standard deviation: sensor loose?',
    Fault.COPY: "repeats the board thermometer's readings: do both read one topic?",
    Fault.LOOSE: 'is {:.1f} K farther from that of the case than in the fit: thermometer loose?',
}

Finding = tuple[int, str]  # level and text


class Reporter:
    """Publishes the diagnostics of a node; logs each lasting change of their level."""

    def __init__(self, loop: WaitLoop, relay: Relay) -> None:
        self._loop, self._node, self._relay = loop, loop.node, relay
        self._publisher = loop.publisher(DiagnosticArray, STATUS.name, qos_of(STATUS))
        # Level in the last line of the log; time of the last report of this level or a higher one.
        self._level, self._level_s = b'', time.monotonic()
        self._n_publishers = 0
        self._last_samples = time.monotonic()
        # All counters, and the stamp of the newest sample, at the time of the last report.
        self._before = self._count()
        self._before_ns: int | None = None

    @property
    def _compensator(self) -> Compensator:
        return self._relay.running.compensator

    def report(self) -> None:
        """Publish the present state, and the events since the last report."""
        loaded = self._relay.running.loaded
        self._count_lost()
        if self._compensator.counters.n_in != self._before['n_in']:
            self._last_samples = time.monotonic()
        silence_s = time.monotonic() - self._last_samples
        if silence_s > IDLE_S:
            self._relay.advance_without_samples(int(silence_s * 1e9))
        status, counts = self._compensator.status(), self._count()
        new = {name: n - self._before[name] for name, n in counts.items()}
        rate = None
        if status.stamp_ns is not None and self._before_ns is not None:
            passed_s = (status.stamp_ns - self._before_ns) * 1e-9
            if passed_s > 0.0 and new['n_in'] and self._before['n_in']:
                rate = new['n_in'] / passed_s
        self._before, self._before_ns = counts, status.stamp_ns
        topic = self._relay.running.samples.subscription.topic_name
        findings = list(self._findings())
        findings += findings_of(loaded, status, new, rate, silence_s, topic)
        # Without nonlinearity in the calibration, warnings begin at 2.01 g, where the unknown
        # square term has an sd of 0.1 mg, so that accelerations of a vehicle give no warning.
        allowance = 0.0 if loaded.calibration.nonlinearity else STANDARD_GRAVITY
        if (over := self._force_excess()) > allowance:
            text = f'|f| {over:.3g} m/s^2 above the largest |f| of the fit: the covariance grows'
            findings.append((_WARN, text))
        findings.sort(key=lambda finding: -finding[0])
        values = self._values(loaded, status, counts, rate)
        message = DiagnosticStatus(
            level=bytes([findings[0][0] if findings else 0]),
            name=f'{self._node.get_fully_qualified_name()}: compensation',
            message=one_line('; '.join(text for _, text in findings) or _all_well(loaded, status)),
            hardware_id=loaded.calibration.unit.serial,
            values=[KeyValue(key=key, value=one_line(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[message])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        now_s, is_lower = time.monotonic(), message.level < self._level
        if not is_lower:
            self._level_s = now_s
        if message.level > self._level or (is_lower and now_s - self._level_s >= RELIEF_S):
            self._level, self._level_s, log = message.level, now_s, self._node.get_logger()
            # rclpy refuses a second severity from one line of source: each has a separate line.
            if message.level == DiagnosticStatus.OK:
                log.info(message.message)
            elif message.level == DiagnosticStatus.WARN:
                log.warning(message.message)
            else:
                log.error(message.message)

    def _force_excess(self) -> float:
        """Return how far the last |f| exceeds the fit's largest |f|, 1.01 g if unknown [m/s^2]."""
        last = self._relay.running.converter.last_result
        if last is None:
            return 0.0
        return max(0.0, math.hypot(*last[:3]) - self._compensator.thermal.correction.beyond.edge)

    def _count(self) -> dict[str, int]:
        counters, traffic = self._compensator.counters, asdict(self._relay.traffic)
        traffic['n_failures'] = self._loop.n_failures
        return {'n_in': counters.n_in, **asdict(counters), **traffic}

    def _count_lost(self) -> None:
        """Count samples missing in the sequence numbers, if the driver is the only publisher."""
        samples = self._relay.running.samples
        n_lost, samples.n_lost = samples.n_lost, 0
        before, self._n_publishers = self._n_publishers, samples.count_publishers()
        if before == self._n_publishers == 1:
            self._relay.traffic.n_lost += n_lost

    def _findings(self) -> Iterator[Finding]:
        """Yield the problems of the subscriptions and of the rest log."""
        for name, source in self._relay.inputs.items():
            n_publishers, topic = source.count_publishers(), source.subscription.topic_name
            if n_publishers > 1 and source.sources.is_contested:
                text = f'{n_publishers} publishers on {topic}'
                yield _ERROR, f'{text}, the topic is not used until only one of them sends'
            elif n_publishers > 1:
                # The middleware lists a killed publisher until the lease of the publisher ends.
                yield _WARN, f'{n_publishers} publishers on {topic}, of which one sends'
            elif not n_publishers and (mismatch := _mismatch(self._node, source.subscription)):
                level = _ERROR if name in ('sample', 'board') else _WARN
                yield level, f'messages of a publisher on {topic} are not received: {mismatch}'
        output = self._relay.output_topic
        if (n_publishers := self._node.count_publishers(output)) > 1:
            text = f'{n_publishers} publishers on {output}, the output of this node'
            yield _WARN, f'{text}: its subscribers receive the messages of other nodes, too'
        rests = self._relay.rests
        if rests is not None and rests.log.reason:
            lost = counted(rests.log.n_lost, 'rest')
            yield _WARN, f'{lost} not kept in the rest log: {rests.log.reason}'

    def _values(
        self,
        loaded: LoadedCalibration,
        status: CompensatorStatus,
        counts: dict[str, int],
        rate: float | None,
    ) -> dict[str, str]:
        """Return the values of the diagnostics, the most important first."""
        calibration = loaded.calibration
        return {
            **_thermal_values(status),
            **self._force_values(calibration, status),
            'sample rate [Hz]': 'unknown' if rate is None else f'{rate:.2f}',
            'calibrated rate [Hz]': f'{1.0 / calibration.unit.cycle_time_s:.2f}',
            'samples in': str(counts['n_in']),
            'samples out': str(counts['n_out'] - counts['n_unpublished']),
            **{
                name.removeprefix('n_').replace('_', ' '): str(n)
                for name, n in counts.items()
                if name not in ('n_in', 'n_out')
            },
            **{
                f'{name} publishers': str(topic.count_publishers())
                for name, topic in self._relay.inputs.items()
            },
            'sample stamp [ns]': str(status.stamp_ns).lower(),
            'serial': calibration.unit.serial,
            'calibration file': loaded.path,
            'calibration sha256': loaded.sha256,
            'calibration date': calibration.provenance.created,
        }

    def _force_values(self, calibration: Calibration, status: CompensatorStatus) -> dict[str, str]:
        """Return the values for the samples: |f|, rests, noise and uncertainty of each axis."""
        values, gravity = {'force excess [m/s^2]': f'{self._force_excess():.3f}'}, status.gravity
        if gravity is not None:
            values |= {
                'gravity residual [m/s^2]': f'{gravity.residual:.3e}',
                'gravity residual sd [m/s^2]': f'{gravity.residual_sd:.3e}',
                'gravity windows': str(gravity.n_windows),
                'standing': str(gravity.is_still),
            }
        if (rests := self._relay.rests) is not None:
            values |= {
                'rests gathered': str(rests.log.n_rests),
                'days with rests': str(rests.log.n_days),
                'rests not kept': str(rests.log.n_lost),
            }
        densities, gyroscope = calibration.noise_density_m_s2_sqrt_hz, calibration.gyroscope
        values |= _of_axes('noise density {} [m/s^2/sqrt(Hz)]', densities)
        last, thermal = self._relay.running.converter.last_result, self._compensator.thermal
        if last is not None:
            variances = last[3], last[6], last[8]
            bias_sd = thermal.bias_sd(thermal.correction, variances)
            values |= _of_axes('sd {} [m/s^2]', map(math.sqrt, variances))
            values |= _of_axes('bias sd {} [m/s^2]', bias_sd)
            values |= _of_axes('scale sd {}', self._compensator.scale_sd)
            elements = zip(('yx', 'zx', 'zy'), calibration.misalignment_sd, strict=True)
            values |= {f'misalignment sd {name} [rad]': f'{sd:.3e}' for name, sd in elements}
        if gyroscope:
            densities = gyroscope.noise_density_rad_s_sqrt_hz
            values |= _of_axes('noise density of rate {} [rad/s/sqrt(Hz)]', densities)
        return values | _of_axes('bias sd of rate {} [rad/s]', status.rate_bias_sd)


def _thermal_values(status: CompensatorStatus) -> dict[str, str]:
    """Return regime, temperatures, their faults, and distances outside the calibrated ranges."""
    values, state = {'regime': status.regime.name.lower()}, status.state
    if state:
        values |= {
            'direction': _DIRECTIONS[status.direction],
            'dynamic weight': f'{state[WEIGHT]:.3f}',
            'board temperature [degC]': f'{state[BOARD]:.4f}',
            'board temperature sd [K]': f'{math.sqrt(state[VAR_BOARD]):.4f}',
            'board rate [K/min]': f'{60.0 * state[RATE]:.4f}',
            'case minus board [K]': f'{state[GRADIENT]:.4f}',
            'memory settled': str(status.is_settled),
        }
    return values | {
        'board age [s]': f'{status.board_age_s:.3f}',
        'case age [s]': f'{status.case_age_s:.3f}',
        **{f'{name} fault': fault.value for name, (fault, _) in status.faults.items()},
        'gradient excess [K]': f'{status.excess.gradient:.3f}',
        'temperature excess [K]': f'{status.excess.temperature:.3f}',
        'rate excess [K/min]': f'{60.0 * status.excess.rate:.3f}',
    }


def _of_axes(key: str, values: Iterable[float]) -> dict[str, str]:
    return {key.format(axis): f'{value:.3e}' for axis, value in zip('xyz', values, strict=False)}


def _mismatch(node: Node, subscription: Subscription) -> str:
    """Return why a publisher's messages are not received (type or QoS), or an empty text."""
    topic, message_type = subscription.topic_name, subscription.msg_type
    expected = f'{message_type.__module__.partition(".")[0]}/msg/{message_type.__name__}'
    for publisher in node.get_publishers_info_by_topic(topic):
        if publisher.topic_type != expected:
            return f'its type is {publisher.topic_type}, not {expected}'
        fit, reason = qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
        if fit == QoSCompatibility.ERROR:
            text = reason.replace('ERROR: ', '').rstrip('; ')
            return f'{text} (qos_overrides.{topic}.subscription)'
    return ''


def findings_of(
    loaded: LoadedCalibration,
    status: CompensatorStatus,
    new: dict[str, int],
    rate: float | None,
    silence_s: float,
    topic: str = '',
) -> Iterator[Finding]:
    """Yield the problems of inputs and correction; `new`: increases of the counters."""
    unit, needs_board = loaded.calibration.unit, loaded.calibration.needs_temperature
    if new['n_in'] == 0 and silence_s > max(SILENT_S, SILENT_CYCLES * unit.cycle_time_s):
        yield _ERROR, 'no samples are coming in'
    if not status.state:
        if needs_board:
            yield _ERROR, 'no board temperature yet, nothing is published'
    elif status.is_board_lost and needs_board:
        yield _ERROR, f'board temperature {status.board_age_s:.1f} s old, nothing is published'
    elif status.is_board_stale and math.isfinite(status.board_age_s):
        yield _WARN, f'board temperature {status.board_age_s:.1f} s old, but still used'
    for name, (level, text) in _RISEN.items():
        if new[name]:
            yield level, f'{text.format(full_scale=unit.full_scale, topic=topic)}: {new[name]}'
    for name, (fault, step) in status.faults.items():
        if fault in _FAULTS:
            yield _WARN, f'{name} temperature {_FAULTS[fault].format(step)}'
    if (ahead_s := status.pending_ahead_s) > AHEAD_S:
        yield _WARN, f'temperatures are stamped {ahead_s:.0f} s ahead of the samples'
    if status.is_lead_reversed:
        yield _ERROR, SWAPPED
    gravity = status.gravity
    if gravity is None and status.is_refuted:
        before = '|f| at rest differed from gravity before the stamps jumped back'
        yield _ERROR, f'{before}: nothing is published until |f| at rest agrees with gravity'
    if gravity is not None:
        missed = f'|f| at rest differs from gravity by {gravity.residual:+.2e}'
        missed += f' +- {gravity.residual_sd:.1e} m/s^2'
        if status.is_refuted:
            yield _ERROR, f'{missed}: another unit, or an axis reversed? Nothing is published'
        elif abs(gravity.residual) > GRAVITY_SIGMAS * gravity.residual_sd:
            yield _WARN, f'{missed}: has the unit aged, or is it another unit?'
    is_expected = loaded.calibration.needs_case or math.isfinite(status.case_age_s)
    if status.state and status.is_case_lost and needs_board and is_expected:
        yield _WARN, 'case temperature lost, the board sensor decides the regime'
    for excess, what, follows in (
        (status.excess.gradient, 'case minus board {:+.2f} K', HELD),
        (status.excess.temperature, 'board temperature {:+.2f} K', CONTINUED),
        (60.0 * status.excess.rate, 'temperature rate {:+.2f} K/min', HELD),
    ):
        if excess:
            yield _WARN, f'{what.format(excess)} {follows}'
    calibrated = 1.0 / unit.cycle_time_s
    if rate is not None and abs(rate / calibrated - 1.0) > RATE_TOLERANCE:
        yield _WARN, f'{rate:.4g} samples/s, calibrated for {calibrated:.4g}'


def _all_well(loaded: LoadedCalibration, status: CompensatorStatus) -> str:
    if not loaded.calibration.needs_temperature:
        reference = loaded.calibration.reference_temperature_c
        return f'constants of {reference:g} degC, not corrected for temperature'
    if status.regime == Regime.UNKNOWN:
        return 'regime not known yet, the static coefficients apply'
    return f'{status.regime.name.lower()} regime'
