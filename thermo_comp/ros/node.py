# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the node `thermo_comp`: samples and temperatures in; force, regime flag, diagnostics out.

The output equals, bit for bit, the offline replay of the same messages in the same order.
Parameters are checked when they are set, and applied between two wake-ups of the node's loop.
"""

import gc
import os
import sys
from contextlib import suppress
from functools import partial

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter

from ..errors import CalibrationError, ThermoCompError
from ..online.compensator import Compensator
from ..online.segments import Model
from ..text import hold_standard_streams, one_line
from ..topics import BOARD, CASE, COUNTS, IMU_IN, IMU_OUT, SAMPLES
from . import parameters
from .diagnostics import Reporter
from .process import SignalWatch, use_profile
from .reader import LoadedCalibration, Reader, read_within
from .relay import Relay, Running
from .waitloop import WaitLoop, overrides

NODE_NAME = 'thermo_comp'

#: Pause after a wake-up [s], for best-effort samples at 7 kHz or more. This pause saves a third of
#: the CPU time at 10 kHz. At 5 kHz it would delay a sample by more time than the correction of the
#: sample takes.
PAUSE_S = 0.2e-3

#: Time from a signal to the end of the process if a call hangs [s].
ENDING_S = 1.8

USAGE = f"""\
usage: thermo_comp_node --ros-args -p calibration_file:=PATH [-p NAME:=VALUE ...]

Compensates {COUNTS.name} (or {IMU_IN.name}, with -p input:=imu) into {IMU_OUT.name}, using
{BOARD.name} and {CASE.name}.

example: thermo_comp_node --ros-args -p calibration_file:=unit42.yaml -r accel/counts:=/imu0/counts

parameters:
"""

#: Prefix that the launch file puts before the name of a parameter whose argument is missing.
NOT_GIVEN = 'not_given.'

#: Errors due to the user's files, values or environment, or to the middleware (RuntimeError).
_USER_ERRORS = (ThermoCompError, OSError, RuntimeError, rclpy.exceptions.ParameterException)


class CompensationNode:
    """The ROS node with a `Compensator`; ThermoCompError if the node cannot start."""

    def __init__(self, context: rclpy.context.Context | None = None) -> None:
        self.node = rclpy.create_node(NODE_NAME, context=context)
        try:
            self._build()
        except BaseException:
            self.node.destroy_node()
            raise
        self._print_calibration()

    def _build(self) -> None:
        self._log, config = self.node.get_logger(), parameters.declare(self.node)
        loaded = read_within(config.calibration_file, config.calibration_directory)
        compensator = Compensator(loaded.calibration, config.compensator_config())
        self._check(loaded, config, compensator.thermal.inputs)
        self._loop = WaitLoop(self.node, PAUSE_S)
        self._relay = Relay(self._loop, loaded, compensator, config)
        self._reporter = Reporter(self._loop, self._relay)
        self._reader = Reader()
        self._requests = parameters.ParameterRequests(self._loop, self._prepare, self._set)
        self._loop.call_every(config.diagnostics_period, self._report)
        topics = [self.node.resolve_topic_name(sample.name) for sample in SAMPLES.values()]
        # Accept QoS overrides of counts and Imu: the input that is not in use may be opened later.
        known = *(f'qos_overrides.{topic}.' for topic in topics), NOT_GIVEN
        for name in overrides(self.node):
            if not (self.node.has_parameter(name) or name.startswith(known)):
                self._log.warning(f'there is no parameter `{one_line(name)}`: value not used')

    def run(self) -> None:
        """Serve until shutdown or a signal."""
        self._loop.run(self._relay.on_data)

    def counts(self) -> tuple[int, int, int]:
        """Return the numbers of samples received and published, and of flags published."""
        counters, traffic = self._relay.running.compensator.counters, self._relay.traffic
        return counters.n_in, counters.n_out - traffic.n_unpublished, traffic.n_flags

    def stop(self) -> None:
        """Make `run` return; callable from any thread."""
        self._loop.stop()

    def close(self) -> None:
        """Destroy the node."""
        self._reader.close()
        self._requests.close()
        if self._relay.rests is not None:
            self._relay.rests.log.close()
        self.node.destroy_node()

    def _report(self) -> None:
        self._relay.follow_types()
        self._relay.gather()
        self._reporter.report()

    def _prepare(self, changes: list[Parameter]) -> tuple[LoadedCalibration, Model] | None:
        """Read, test and prepare a changed calibration, in parallel to the samples."""
        names = [change.value for change in changes if change.name == 'calibration_file']
        if not names or not isinstance(names[-1], str):
            return None
        directory = self._relay.running.config.calibration_directory
        loaded = self._reader.read(names[-1], directory)
        return loaded, Model(loaded.calibration)

    def _set(
        self, changes: list[Parameter], new: tuple[LoadedCalibration, Model] | None
    ) -> SetParametersResult:
        """Apply a parameter change as a whole between two samples, or change nothing."""
        before = after = self._relay.running
        loaded, model = new or (before.loaded, before.compensator.thermal.model)
        config = parameters.updated(before.config, changes)
        self._check(loaded, config, before.compensator.thermal.inputs)
        for change in changes:
            if not self.node.has_parameter(change.name):
                raise parameters.ParameterError(f'there is no parameter `{change.name}`')
        values = self.node.get_parameters([change.name for change in changes])
        try:
            after = self._relay.successor(loaded, model, config)
            self._run_with(after)
            # rclpy refuses changes of fixed parameters.
            result = self.node.set_parameters_atomically(changes)
            if not result.successful:
                raise parameters.ParameterError(result.reason)
            if new:
                self._print_calibration(before.loaded.calibration.unit.serial)
            self._loop.call_soon(partial(self._relay.release, before.samples))
            # Any failure up to this `return` restores the previous calibration and parameters.
            return result  # noqa: TRY300
        except BaseException:
            self._run_with(before)
            self._relay.release(after.samples)
            changed = [
                new for new in values if self.node.get_parameter(new.name).value != new.value
            ]
            self.node.set_parameters_atomically(changed)
            raise

    def _run_with(self, running: Running) -> None:
        before, self._relay.running = self._relay.running, running
        if (period_s := running.config.diagnostics_period) != before.config.diagnostics_period:
            self._loop.call_every(period_s, self._report)

    def _check(
        self, loaded: LoadedCalibration, config: parameters.NodeConfig, inputs: tuple[str, ...]
    ) -> None:
        """Refuse a calibration whose serial, input or thermometers are not those of the node."""
        unit, sensors = loaded.calibration.unit, loaded.calibration.sensors
        taken = {'counts': 'counts', 'imu': 'm/s^2'}[config.input]
        if config.serial and unit.serial != config.serial:
            rule, got = f'{config.serial!r} (parameter `serial`)', repr(unit.serial)
            key = 'unit.serial'
        elif unit.input != taken:
            rule, got = f'{taken!r} (parameter `input` is {config.input})', repr(unit.input)
            key = 'unit.input'
        elif sensors != inputs[1:]:
            rule, key = f'{", ".join(inputs[1:])}, which this node listens to', 'sensors'
            got = f'{", ".join(sensors)}: restart the node with this file'
        else:
            return
        raise CalibrationError(f'must be {rule}, got {got}', loaded.path, key)

    def _print_calibration(self, serial_before: str = '') -> None:
        loaded = self._relay.running.loaded
        serial = loaded.calibration.unit.serial
        self._log.info(f'unit {serial}: {loaded.path} ({loaded.sha256[:12]})')
        if serial_before not in ('', serial):
            advice = 'set the parameter `serial` to refuse calibrations of other units'
            self._log.warning(f'unit {serial} replaces unit {serial_before}: {advice}')


def main(args: list[str] | None = None) -> int:
    """Run the node; return 0 after an orderly end, 1 after an error, 2 for a wrong usage."""
    args = sys.argv if args is None else args
    hold_standard_streams()
    try:
        extra = rclpy.utilities.remove_ros_args(args)[1:]
    except RuntimeError as error:
        return _fail(error, 2)
    if extra:
        is_help = extra[0] in {'-h', '--help'}
        problem = '' if is_help else f'thermo_comp_node: unknown argument {extra[0]!r}\n'
        text = problem + USAGE + parameters.parameters_help()
        try:
            print(text, file=sys.stdout if is_help else sys.stderr, flush=True)
        except OSError as error:
            # Replace stdout, which the interpreter would try to flush again at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0 if isinstance(error, BrokenPipeError) else _fail(error, 1)
        return 0 if is_help else 2
    with SignalWatch(ENDING_S) as signals:
        try:
            use_profile()
            rclpy.init(args=args, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
            node = CompensationNode()
            try:
                signals.on_signal(node.stop)
                # Exclude the objects of the start-up from later garbage collections.
                gc.collect()
                gc.freeze()
                node.run()
            finally:
                node.close()
        except ExternalShutdownException:
            pass
        except _USER_ERRORS as error:
            return _fail(error, 1)
        finally:
            rclpy.try_shutdown()
    return 0


def _fail(error: Exception, code: int) -> int:
    """Print the reason of a failure on one line; return the exit code."""
    with suppress(OSError):
        print(f'thermo_comp_node: {one_line(str(error))}', file=sys.stderr, flush=True)
    return code


if __name__ == '__main__':
    sys.exit(main())
