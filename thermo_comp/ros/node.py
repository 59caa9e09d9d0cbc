# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node `thermo_comp`: samples and temperatures in, specific force, flag and diagnostics out.

It publishes what the offline replay of a bag of the same messages writes, bit for bit. Parameters
are checked when they are set and change what runs between two wake-ups.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from functools import partial

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool

from ..errors import CalibrationError, ThermoCompError
from ..online.compensator import Compensator
from ..online.snapshot import take_snapshot
from ..online.stamped_flag import STAMPED_TOPIC
from ..text import hold_standard_streams, one_line
from . import parameters
from .conversions import SampleConverter, Traffic
from .diagnostics import Snapshot, build, look_at
from .parameters import NodeConfig, ParameterError
from .process import SignalWatch, use_profile
from .reader import LoadedCalibration, Reader, check, load, read
from .relay import Relay
from .requests import ParameterRequests
from .waitloop import RawSubscription, WaitLoop, undeclared_overrides

NODE_NAME = 'thermo_comp'

#: As many samples as may wait for one wake-up, in and out: 0.2 s at 10 kHz.
SAMPLE_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
TEMPERATURE_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
FLAG_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
DIAGNOSTICS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)

#: With best effort, samples that come at some 7 kHz or more are taken some at a time, so long
#: after the last ones [s]: it saves a third of the CPU time at 10 kHz. At 5 kHz it would make each
#: wait for longer than it takes to relay it.
REST_S = 0.2e-3

#: After so long without samples [s] readings take effect without them.
IDLE_S = 5.0

USAGE = """\
usage: thermo_comp_node --ros-args -p calibration_file:=PATH [-p NAME:=VALUE ...]

Compensates accel/counts (or imu/uncompensated, with -p input:=imu) into imu/data_raw, using
temperature/board and temperature/case.

example: thermo_comp_node --ros-args -p calibration_file:=unit42.yaml -r accel/counts:=/imu0/counts

parameters:
"""

#: What the launch file calls a parameter whose argument was not given.
NOT_GIVEN = 'not_given.'

#: What files, values, the environment and the middleware do: RuntimeError is its own, too.
_NOT_OURS = (ThermoCompError, OSError, RuntimeError, ParameterException)

_INPUTS = {'counts': (Vector3Stamped, 'accel/counts'), 'imu': (Imu, 'imu/uncompensated')}


@contextmanager
def _opening() -> Iterator[None]:
    """Say what a name or a quality of service of the user's does."""
    try:
        yield
    except (RuntimeError, ValueError, ParameterException, InvalidQosOverridesError) as error:
        raise ParameterError(f'a topic cannot be opened: {error}') from error


class CompensationNode:
    """The node around a `Compensator`; ThermoCompError if it cannot start."""

    def __init__(self, context: Context | None = None) -> None:
        self.node = rclpy.create_node(NODE_NAME, context=context)
        try:
            self._build()
        except BaseException:
            self.node.destroy_node()
            raise
        self._say_calibration()

    def _build(self) -> None:
        """Make all that runs on the ROS node."""
        self._config = parameters.declare(self.node)
        self._loaded = load(self._config)
        self._compensator = Compensator(
            self._loaded.calibration, self._config.compensator_config()
        )
        self._n_publishers = 0
        self._level = b''
        self._last_samples = time.monotonic()
        self._loop = WaitLoop(self.node, REST_S)
        self._relay = self._open_topics()
        self._reported = self._snapshot()
        self._read: LoadedCalibration | None = None
        self._prepared = (self._config, self._loaded, self._relay.samples)
        self.node.add_pre_set_parameters_callback(parameters.coerce)
        self.node.add_on_set_parameters_callback(self._on_set)
        self.node.add_post_set_parameters_callback(self._post_set)
        self._reader = Reader()
        self._requests = ParameterRequests(self.node, self._loop, self._prepare, self._set)
        self._loop.call_every(self._config.diagnostics_period, self._report)
        self._log = self.node.get_logger()
        inputs = tuple(
            f'qos_overrides.{self.node.resolve_topic_name(topic)}.'
            for _, topic in _INPUTS.values()
        )
        for name in undeclared_overrides(self.node):
            # The input that is not open may be opened later, with these.
            if not name.startswith((*inputs, NOT_GIVEN)):
                self._log.warning(f'there is no parameter `{one_line(name)}`, it has no effect')

    def run(self) -> None:
        """Serve until shutdown or a signal."""
        self._loop.run(self._relay.on_data)

    def stop(self) -> None:
        """Make `run` return; callable from any thread."""
        self._loop.stop()

    def close(self) -> None:
        """Destroy the node."""
        self._requests.close()
        self._reader.close()
        self._loop.close()
        self.node.destroy_node()

    def _open_topics(self) -> Relay:
        """Create the subscriptions and publishers, and what connects them."""
        overridable, compensator = QoSOverridingOptions.with_default_policies(), self._compensator
        samples = self._open_samples(self._config)
        self._thermometers = compensator.thermal.inputs
        with _opening():
            temperatures = [
                (
                    self._loop.subscribe(
                        Temperature, f'temperature/{name}', TEMPERATURE_QOS, is_hot=False
                    ),
                    partial(compensator.push, name),
                )
                for name in self._thermometers
            ]
            imu, flag, stamped, self._diagnostics = (
                self.node.create_publisher(
                    message_type, topic, copy(qos), qos_overriding_options=overridable
                )
                for message_type, topic, qos in (
                    (Imu, 'imu/data_raw', OUTPUT_QOS),
                    (Bool, 'regime/dynamic', FLAG_QOS),
                    (DiagnosticArray, STAMPED_TOPIC, FLAG_QOS),
                    (DiagnosticArray, '/diagnostics', DIAGNOSTICS_QOS),
                )
            )
        self._traffic = Traffic()
        converter = self._new_converter(self._config)
        return Relay(self.node, compensator, converter, samples, temperatures, imu, flag, stamped)

    def _open_samples(self, config: NodeConfig) -> RawSubscription:
        with _opening():
            return self._loop.subscribe(*_INPUTS[config.input], SAMPLE_QOS)

    def _new_converter(self, config: NodeConfig) -> SampleConverter:
        return SampleConverter(_INPUTS[config.input][0], config.frame_id, self._traffic)

    def _snapshot(self) -> Snapshot:
        last = self._relay.converter.last_result
        variances = None if last is None else (last[3], last[6], last[8])
        thermal = self._compensator.thermal
        noise = [(1.0 + thermal.noise_excess) * one for one in thermal.correction.noise]
        names = ('sample', *self._thermometers)
        return Snapshot(
            take_snapshot(self._compensator),
            replace(self._traffic, n_failures=self._loop.n_failures),
            variances,
            noise,
            time.monotonic() - self._last_samples,
            tuple(
                look_at(self.node, name, one.subscription)
                for name, one in zip(names, self._relay.inputs, strict=True)
            ),
        )

    def _report(self) -> None:
        """Publish diagnostics; log when the level changes."""
        self._count_lost()
        if self._compensator.counters.n_in != self._reported.status.counters.n_in:
            self._last_samples = time.monotonic()
        silence_s = time.monotonic() - self._last_samples
        if silence_s > IDLE_S:
            self._relay.advance_without_samples(int(silence_s * 1e9))
        now = self._snapshot()
        status = build(self.node.get_fully_qualified_name(), self._loaded, now, self._reported)
        self._reported = now
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(array)
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
        """Count gaps in the driver's numbering, which mean something only while it is one."""
        samples = self._relay.samples
        n_lost, samples.n_lost = samples.n_lost, 0
        before, self._n_publishers = self._n_publishers, samples.subscription.get_publisher_count()
        if before == self._n_publishers == 1:
            self._traffic.n_lost += n_lost

    def _prepare(self, changes: list[Parameter]) -> LoadedCalibration | None:
        """Read the calibration that a change asks for, beside the samples."""
        names = [one.value for one in changes if one.name == 'calibration_file']
        if not names or not isinstance(names[-1], str):
            return None
        return self._reader.read(names[-1], self._config.calibration_directory)

    def _set(
        self, changes: list[Parameter], loaded: LoadedCalibration | None
    ) -> SetParametersResult:
        """Set what was prepared, between two samples."""
        self._read = loaded
        try:
            return self.node.set_parameters_atomically(changes)
        finally:
            self._read = None

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        """Check a change as a whole and keep what was made on the way."""
        samples = self._relay.samples
        # A topic that is opened below declares parameters of its own and comes here again.
        loaded, self._read = self._read or self._loaded, None
        try:
            config = parameters.updated(self._config, changes)
            if config.calibration_file != loaded.path:
                # Set by code of this process, not through a service.
                loaded = read(config.calibration_file, config.calibration_directory)
            check(loaded, config)
            self._check_thermometers(loaded)
            if config.input != self._config.input:
                samples = self._open_samples(config)
        except ThermoCompError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._prepared = (config, loaded, samples)
        return SetParametersResult(successful=True)

    def _check_thermometers(self, loaded: LoadedCalibration) -> None:
        """Refuse a calibration whose thermometers are not those that this node listens to."""
        named, heard = loaded.calibration.sensors, self._compensator.thermal.inputs[1:]
        if named != heard:
            raise CalibrationError(
                f'must be {", ".join(heard)}, which this node listens to, got {", ".join(named)}: '
                'start the node anew with this file',
                loaded.path,
                'sensors',
            )

    def _post_set(self, _changes: list[Parameter]) -> None:
        """Apply what `_on_set` checked."""
        before, relay = self._config, self._relay
        config, loaded, samples = self._prepared
        if loaded is not self._loaded:
            self._loaded = loaded
            self._compensator.swap(loaded.calibration)
            self._say_calibration()
        self._config = config
        if config.compensator_config() != before.compensator_config():
            self._compensator.reconfigure(config.compensator_config())
        if (config.input, config.frame_id) != (before.input, before.frame_id):
            relay.converter = self._new_converter(config)
        if samples is not relay.samples:
            self._loop.unsubscribe(relay.samples)
            relay.samples = samples
        if config.diagnostics_period != before.diagnostics_period:
            self._loop.call_every(config.diagnostics_period, self._report)

    def _say_calibration(self) -> None:
        loaded = self._loaded
        self._log.info(
            f'unit {loaded.calibration.unit.serial}: {loaded.path} ({loaded.sha256[:12]})'
        )


def main(args: list[str] | None = None) -> int:
    """Run the node; 0 after an orderly end, 1 if it could not start, 2 for a wrong usage."""
    args = sys.argv if args is None else args
    hold_standard_streams()
    try:
        extra = remove_ros_args(args)[1:]
    except RuntimeError as error:
        return _fail(error, 2)
    if extra:
        is_help = extra[0] in {'-h', '--help'}
        problem = '' if is_help else f'thermo_comp_node: unknown argument {extra[0]!r}\n'
        text = problem + USAGE + parameters.parameters_help()
        try:
            print(text, file=sys.stdout if is_help else sys.stderr, flush=True)
        except OSError as error:
            # The interpreter would try again at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0 if isinstance(error, BrokenPipeError) else _fail(error, 1)
        return 0 if is_help else 2
    with SignalWatch() as signals:
        try:
            use_profile()
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = CompensationNode()
            try:
                signals.on_signal(node.stop)
                # What start-up left behind is never looked at again by the garbage collector.
                gc.collect()
                gc.freeze()
                node.run()
            finally:
                node.close()
        except ExternalShutdownException:
            pass
        except _NOT_OURS as error:
            return _fail(error, 1)
        finally:
            rclpy.try_shutdown()
    return 0


def _fail(error: Exception, code: int) -> int:
    """Print the one line that a failed start leaves behind; return its exit code."""
    with suppress(OSError):
        print(f'thermo_comp_node: {one_line(str(error))}', file=sys.stderr, flush=True)
    return code


if __name__ == '__main__':
    sys.exit(main())
