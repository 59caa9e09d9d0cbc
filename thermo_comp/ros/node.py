# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node `thermo_comp`: samples and temperatures in, specific force, flag and diagnostics out.

A wake-up takes what has arrived of all three inputs, samples first, and works through it in the
order of arrival. So it does not matter how the wake-ups fell: the node publishes what the offline
replay of a bag of the same messages writes, bit for bit. Parameters are checked when they are set
and change what runs between two wake-ups.

"""

from __future__ import annotations

import gc
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable
from copy import copy

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool

from ..compensator import Compensator
from ..errors import ThermoCompError
from . import parameters
from .conversions import SampleConverter, read_temperature
from .diagnostics import Snapshot, Traffic, build
from .loading import check, load
from .middleware import use_profile
from .parameters import NodeConfig, ParameterError
from .signals import SignalWatch
from .waitloop import RawPublisher, RawSubscription, RCLError, WaitLoop, undeclared_overrides

NODE_NAME = 'thermo_comp'

#: As many samples as may wait for one wake-up, in and out: 0.2 s at 10 kHz.
SAMPLE_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
TEMPERATURE_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
FLAG_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
DIAGNOSTICS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)

#: Samples that come more often than this, above some 3 kHz, are taken some at a time, so long
#: after the last ones [s]: it saves a third of the CPU time at 10 kHz, and none waits as long as
#: an INS at 2 kHz for its next one.
REST_S = 0.3e-3

#: After so long without samples [s] readings take effect without them, but for those not older
#: than the newest by this: a sample that Fast DDS has to repeat can be 3 s late.
IDLE_S = 5.0
IDLE_NS = 1_000_000_000

USAGE = """\
usage: thermo_comp_node --ros-args -p calibration_file:=PATH [-p NAME:=VALUE ...]

Compensates accel/counts (or imu/uncompensated, with -p input:=imu) into imu/data_raw, using
temperature/board and temperature/case.

example: thermo_comp_node --ros-args -p calibration_file:=unit42.yaml -r accel/counts:=/imu0/counts

parameters:
"""

#: The two messages of the flag, serialized.
_FLAGS = tuple(serialize_message(Bool(data=is_dynamic)) for is_dynamic in (False, True))

_INPUTS = {'counts': (Vector3Stamped, 'accel/counts'), 'imu': (Imu, 'imu/uncompensated')}

# A temperature that has arrived: received [ns], stamp [ns], degC, and where it goes.
_Reading = tuple[int, int, float, Callable[[int, float], None]]


class CompensationNode:
    """
    The node around one `Compensator`.

    Parameters
    ----------
    context : rclpy.context.Context, optional
        Initialised; the default context if not given.

    Raises
    ------
    ThermoCompError
        If a parameter or the calibration can't be used.

    """

    def __init__(self, context: Context | None = None) -> None:
        self.node = rclpy.create_node(NODE_NAME, context=context)
        try:
            self._build()
        except BaseException:
            self.node.destroy_node()
            raise
        self._say_calibration()

    def _build(self) -> None:
        """
        Make all that runs on the ROS node.

        """
        self._config = parameters.declare(self.node)
        self._loaded = load(self._config)
        self._compensator = Compensator(
            self._loaded.calibration, self._config.compensator_config()
        )
        self._readings: list[_Reading] = []
        self._newest_reading_ns: int | None = None
        self._n_publishers = 0
        self._n_lost = 0
        self._n_malformed = 0
        self._n_fallback = 0
        self._n_unpublished = 0
        self._n_flags = 0
        self._converter = SampleConverter(_INPUTS[self._config.input][0], self._config.frame_id)
        self._level = b''
        self._last_samples = time.monotonic()
        self._loop = WaitLoop(self.node, REST_S)
        self._open_topics()
        self._reported = self._snapshot()
        self._prepared = (self._config, self._loaded)
        self.node.add_pre_set_parameters_callback(parameters.coerce)
        self.node.add_on_set_parameters_callback(self._on_set)
        self.node.add_post_set_parameters_callback(self._post_set)
        self._loop.call_every(self._config.diagnostics_period, self._report)
        self._log = self.node.get_logger()
        inputs = tuple(
            f'qos_overrides.{self.node.resolve_topic_name(topic)}.'
            for _, topic in _INPUTS.values()
        )
        for name in undeclared_overrides(self.node):
            # The input that is not open may be opened later, with these.
            if not name.startswith(inputs):
                self._log.warning(f'there is no parameter `{name}`, it has no effect')

    def run(self) -> None:
        """
        Serve until shutdown or a signal.

        """
        self._loop.run(self._on_data)

    def stop(self) -> None:
        """
        Make `run` return; callable from any thread.

        """
        self._loop.stop()

    def close(self) -> None:
        """
        Destroy the node.

        """
        self._loop.close()
        self.node.destroy_node()

    def _open_topics(self) -> None:
        """
        Create the subscriptions and publishers.

        """
        subscribe, overridable = self._loop.subscribe, QoSOverridingOptions.with_default_policies()
        try:
            self._samples = self._open_samples(self._config)
            self._temperatures: list[tuple[RawSubscription, Callable[[int, float], None]]] = [
                (subscribe(Temperature, topic, TEMPERATURE_QOS, is_hot=False), push)
                for topic, push in (
                    ('temperature/board', self._push_board),
                    ('temperature/case', self._push_case),
                )
            ]
            self._imu, self._flag, self._diagnostics = (
                self.node.create_publisher(
                    message_type, topic, copy(qos), qos_overriding_options=overridable
                )
                for message_type, topic, qos in (
                    (Imu, 'imu/data_raw', OUTPUT_QOS),
                    (Bool, 'regime/dynamic', FLAG_QOS),
                    (DiagnosticArray, '/diagnostics', DIAGNOSTICS_QOS),
                )
            )
        except (RuntimeError, InvalidQosOverridesError) as error:
            raise ParameterError(f'a topic cannot be opened: {error}') from error
        self._publish = RawPublisher(self._imu).publish
        self._publish_flag = RawPublisher(self._flag).publish

    def _open_samples(self, config: NodeConfig) -> RawSubscription:
        return self._loop.subscribe(*_INPUTS[config.input], SAMPLE_QOS)

    def _push_board(self, stamp_ns: int, celsius: float) -> None:
        self._compensator.push_board(stamp_ns, celsius)

    def _push_case(self, stamp_ns: int, celsius: float) -> None:
        self._compensator.push_case(stamp_ns, celsius)

    def _on_data(self) -> None:
        """
        Work through everything that has arrived.

        """
        messages, received_ns = self._samples.drain(is_paced=True)
        for subscription, push in self._temperatures:
            readings = subscription.drain()
            if readings[0]:
                self._take_readings(*readings, push)
        if not messages:
            return
        if self._readings:
            messages = self._relay_with_readings(messages, received_ns)
        self._relay(messages)

    def _take_readings(
        self, messages: list[bytes], received_ns: list[int], push: Callable[[int, float], None]
    ) -> None:
        for data, received in zip(messages, received_ns, strict=True):
            reading = read_temperature(data)
            if reading is None:
                self._n_malformed += 1
            else:
                self._newest_reading_ns = reading[0]
                self._readings.append((received, *reading, push))

    def _relay_with_readings(self, messages: list[bytes], received_ns: list[int]) -> list[bytes]:
        """
        Relay up to the last reading that came before the last sample; return the rest.

        """
        start = 0
        later = []
        for reading in sorted(self._readings, key=lambda one: one[0]):
            received, stamp_ns, celsius, push = reading
            if received > received_ns[-1]:
                later.append(reading)
                continue
            end = bisect_left(received_ns, received, start)
            self._relay(messages[start:end])
            push(stamp_ns, celsius)
            start = end
        self._readings = later
        return messages[start:]

    def _relay(self, messages: Iterable[bytes]) -> None:
        convert, process = self._converter.convert, self._compensator.process
        for data in messages:
            frame = convert(data, process)
            if frame is not None:
                try:
                    self._publish(frame)
                except RCLError:
                    self._count_unpublished()
        self._publish_flags()

    def _publish_flags(self) -> None:
        for _, is_dynamic in self._compensator.take_flags():
            try:
                self._publish_flag(_FLAGS[is_dynamic])
            except RCLError:
                self._count_unpublished()
            self._n_flags += 1

    def _count_unpublished(self) -> None:
        """
        Go on after a message that the middleware did not take, but not after the shutdown.

        """
        if not self.node.context.ok():
            raise ExternalShutdownException
        self._n_unpublished += 1

    def _snapshot(self) -> Snapshot:
        last, converter = self._converter.last_result, self._converter
        inputs = (self._samples, *(subscription for subscription, _ in self._temperatures))
        found = [one.subscription.get_publisher_count() for one in inputs]
        traffic = Traffic(
            n_lost=self._n_lost,
            n_unpublished=self._n_unpublished,
            n_malformed=self._n_malformed + converter.n_malformed,
            n_flags=self._n_flags,
            n_fallback=self._n_fallback + converter.n_fallback,
            n_sample_publishers=found[0],
            n_board_publishers=found[1],
            n_case_publishers=found[2],
        )
        variances = None if last is None else (last[3], last[6], last[8])
        return Snapshot(self._compensator.status, traffic, variances)

    def _report(self) -> None:
        """
        Publish diagnostics; log when the level changes.

        """
        self._count_lost()
        now = self._snapshot()
        if now.status.counters.n_in != self._reported.status.counters.n_in:
            self._last_samples = time.monotonic()
        elif time.monotonic() - self._last_samples > IDLE_S:
            self._advance_without_samples()
            now = self._snapshot()
        array = build(self.node.get_name(), self._loaded, now, self._reported)
        self._reported = now
        self._diagnostics.publish(array)
        status = array.status[0]
        if status.level != self._level:
            self._level = status.level
            # rclpy wants one call per severity and place.
            if status.level == DiagnosticStatus.OK:
                self._log.info(status.message)
            elif status.level == DiagnosticStatus.WARN:
                self._log.warning(status.message)
            else:
                self._log.error(status.message)

    def _count_lost(self) -> None:
        """
        Count gaps in the driver's numbering, which mean something only while there is one driver.

        """
        samples = self._samples
        n_lost, samples.n_lost = samples.n_lost, 0
        before, self._n_publishers = self._n_publishers, samples.subscription.get_publisher_count()
        if before == self._n_publishers == 1:
            self._n_lost += n_lost

    def _advance_without_samples(self) -> None:
        """
        Let readings take effect that no sample will come to, so that the flag stays alive.

        """
        if self._newest_reading_ns is None:
            return
        horizon_ns = self._newest_reading_ns - IDLE_NS
        for _, stamp_ns, celsius, push in self._readings:
            if stamp_ns <= horizon_ns:
                push(stamp_ns, celsius)
        self._readings = [one for one in self._readings if one[1] > horizon_ns]
        self._compensator.flush(horizon_ns)
        self._publish_flags()

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        """
        Check a change as a whole and keep what was parsed on the way.

        """
        try:
            config = parameters.updated(self._config, changes)
            if any(change.name == 'calibration_file' for change in changes):
                loaded = load(config)
            else:
                loaded = self._loaded
                check(loaded, config)
        except ThermoCompError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._prepared = (config, loaded)
        return SetParametersResult(successful=True)

    def _post_set(self, _changes: list[Parameter]) -> None:
        """
        Apply what `_on_set` checked.

        """
        before = self._config
        config, loaded = self._prepared
        if loaded is not self._loaded:
            self._loaded = loaded
            self._compensator.swap(loaded.calibration)
            self._say_calibration()
        # Before anything below declares parameters of its own and comes here again.
        self._config = config
        if config.compensator_config() != before.compensator_config():
            self._compensator.reconfigure(config.compensator_config())
        if (config.input, config.frame_id) != (before.input, before.frame_id):
            self._n_malformed += self._converter.n_malformed
            self._n_fallback += self._converter.n_fallback
            message_type, _ = _INPUTS[config.input]
            self._converter = SampleConverter(message_type, config.frame_id)
        if config.input != before.input:
            self._loop.unsubscribe(self._samples)
            self._samples = self._open_samples(config)
        if config.diagnostics_period != before.diagnostics_period:
            self._loop.call_every(config.diagnostics_period, self._report)

    def _say_calibration(self) -> None:
        loaded = self._loaded
        self._log.info(
            f'unit {loaded.calibration.unit.serial}: {loaded.path} ({loaded.sha256[:12]})'
        )


def main(args: list[str] | None = None) -> int:
    """
    Run the node; the console script `thermo_comp_node`.

    Parameters
    ----------
    args : list of str, optional
        Command line with the program's name first; `sys.argv` if not given.

    Returns
    -------
    int
        Exit code: 0 after an orderly end, 1 if the node could not start, 2 for a wrong usage.

    """
    args = sys.argv if args is None else args
    try:
        extra = remove_ros_args(args)[1:]
    except RuntimeError as error:
        print(f'thermo_comp_node: {error}', file=sys.stderr)
        return 2
    if extra:
        is_help = extra[0] in {'-h', '--help'}
        problem = '' if is_help else f'thermo_comp_node: unknown argument {extra[0]!r}\n'
        text = problem + USAGE + parameters.parameters_help()
        print(text, file=sys.stdout if is_help else sys.stderr)
        return 0 if is_help else 2
    with SignalWatch() as signals:
        try:
            use_profile()
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            _serve(signals)
        except ExternalShutdownException:
            pass
        except ThermoCompError as error:
            print(f'thermo_comp_node: {error}', file=sys.stderr)
            return 1
        finally:
            rclpy.try_shutdown()
    return 0


def _serve(signals: SignalWatch) -> None:
    node = CompensationNode()
    try:
        signals.on_signal(node.stop)
        # What start-up left behind is never looked at again by the garbage collector.
        gc.collect()
        gc.freeze()
        node.run()
    finally:
        node.close()


if __name__ == '__main__':
    sys.exit(main())
