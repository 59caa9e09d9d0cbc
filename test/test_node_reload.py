# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration and parameters of a node process are changed through ROS services while it runs."""

import sys
import threading
from dataclasses import replace
from itertools import pairwise

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import rclpy
from builders import SECOND_NS, START_NS, calibration
from live_node import lossless
from node_process import NodeProcess
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from ros_helpers import CYCLE_NS, TIMEOUT, Driver, node_in_thread, stamp_of, standing
from sensor_msgs.msg import Imu

from thermo_comp.online.compensator import Compensator
from thermo_comp.ros.node import CompensationNode
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.unit.calibration import Axes, AxisReference, Unit
from thermo_comp.unit.calibration_file import dump_calibration, save_calibration

K = 300.0


def of_bias(counts, **keys):
    """Make a calibration that a test recognises by the bias of the x axis [counts]."""
    axes = Axes(AxisReference(K, counts), AxisReference(K, 0.0), AxisReference(K, 0.0))
    return calibration(axes=axes, **keys)


class Flow:
    def __init__(self, peer):
        self._peer = peer
        self.heard = peer.listen(Imu, 'imu/data_raw')
        self._driver = Driver(peer)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.n_sent = 0
        self._thread.start()

    def _run(self):
        while not self._stop.wait(0.001):
            stamp_ns = START_NS + self.n_sent * CYCLE_NS
            if self.n_sent % 10 == 0:
                self._driver.temperatures(stamp_ns, 20.0, 20.0)
            self._driver.counts(stamp_ns, *standing(self.n_sent))
            self.n_sent += 1

    def more(self, n=100):
        wanted = len(self.heard) + n
        self._peer.wait_for(lambda: len(self.heard) >= wanted, f'{n} more samples')
        return len(self.heard)

    def bias(self, index):
        message = self.heard[index]
        raw = standing((stamp_of(message) - START_NS) // CYCLE_NS)[0]
        return round(raw - K * message.linear_acceleration.x, 6)

    def stop(self):
        self._stop.set()
        self._thread.join(TIMEOUT)
        last = START_NS + (self.n_sent - 1) * CYCLE_NS
        self._peer.wait_for(lambda: stamp_of(self.heard[-1]) == last, 'the last sample')


def test_a_reload_while_samples_flow_loses_no_sample(peer, tmp_path):
    first, second, third = (tmp_path / f'{name}.yaml' for name in ('first', 'second', 'third'))
    save_calibration(of_bias(1.0), first)
    save_calibration(of_bias(2.0), second)
    broken = tmp_path / 'broken.yaml'
    text = dump_calibration(of_bias(77.0))
    with NodeProcess(*lossless(), '-p', f'calibration_file:={first}') as node:
        flow = Flow(peer)
        assert flow.bias(flow.more() - 1) == 1.0
        assert [r.successful for r in peer.set_parameters(calibration_file=str(second))] == [True]
        flow.more()
        # WHY: a file with a lag of 1e-300 s was refused after its bias was already in use.
        for key, old, new in (
            ('lag_s', 'lag_s: 600.0', 'lag_s: 1e-300'), ('axes.x.bias', 'bias: 77.0', 'bias: .nan')
        ):  # fmt: skip
            broken.write_text(text.replace(old, new, 1))
            (result,) = peer.set_parameters(calibration_file=str(broken))
            assert not result.successful
            assert result.reason.startswith(f'{broken}: ')
            assert key in result.reason
            assert new.rpartition(' ')[2].lstrip('.') in result.reason.lower()
            flow.more()
            request = GetParameters.Request(names=['calibration_file'])
            (parameter,) = peer.call(GetParameters, 'thermo_comp/get_parameters', request).values
            assert parameter.string_value == str(second)
        assert not peer.set_atomically(transition_time=5, calibration_file=str(broken)).successful
        assert peer.set_atomically(no_such=5).reason == 'there is no parameter `no_such`'
        result = peer.set_atomically(transition_time=5, calibration_file=str(tmp_path / 'none'))
        assert 'none: cannot be read: No such file' in result.reason
        request = GetParameters.Request(names=['transition_time', 'frame_id'])
        values = peer.call(GetParameters, 'thermo_comp/get_parameters', request).values
        assert values[0].double_value == 30.0
        assert flow.bias(flow.more() - 1) == 2.0
        # If the path is set again, its file is read again; a float parameter accepts an integer.
        save_calibration(of_bias(3.0), second)
        result = peer.set_atomically(transition_time=5, calibration_file=str(second))
        assert result.successful, result.reason
        values = peer.call(GetParameters, 'thermo_comp/get_parameters', request).values
        assert values[0].double_value == 5.0
        save_calibration(of_bias(4.0, unit=Unit('T-2', 'counts', 32767.0, 0.01)), third)
        (result,) = peer.set_parameters(serial='T-9')
        assert "unit.serial: must be 'T-9'" in result.reason
        assert peer.set_parameters(serial='T-1')[0].successful
        (result,) = peer.set_parameters(calibration_file=str(third))
        assert "unit.serial: must be 'T-1' (parameter `serial`), got 'T-2'" in result.reason
        (result,) = peer.set_parameters(input='imu')
        assert "unit.input: must be 'm/s^2'" in result.reason
        save_calibration(of_bias(4.0, unit=Unit('T-1', 'm/s^2', 160.0, 0.01)), third)
        (result,) = peer.set_parameters(calibration_file=str(third))
        assert "must be 'counts' (parameter `input` is counts), got 'm/s^2'" in result.reason
        save_calibration(of_bias(5.0, sensors=('case', 'lid')), third)
        (result,) = peer.set_parameters(calibration_file=str(third))
        assert 'sensors: must be case, which this node listens to, got case, lid' in result.reason
        flow.more()
        flow.stop()
        assert node.is_alive, node.said
        assert node.stop() == 0
        assert 'Traceback' not in node.said
    stamps = [stamp_of(message) for message in flow.heard]
    assert stamps == list(range(stamps[0], stamps[-1] + 1, CYCLE_NS))
    biases = [flow.bias(index) for index in range(len(stamps))]
    assert (biases[0], [b for a, b in pairwise(biases) if a != b]) == (1.0, [2.0, 3.0])


class _Stop(BaseException):
    """The exception that `raising_at` raises."""


def raising_at(number, call):
    """Call a function and raise at the n-th executed line; return whether this line exists."""
    n_lines = 0

    def trace(frame, event, _):
        nonlocal n_lines
        if event == 'line':
            n_lines += 1
            if n_lines == number:
                raise _Stop
        return trace if '/thermo_comp/' in frame.f_code.co_filename else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    except _Stop:
        return True
    finally:
        sys.settrace(before)
    return False


def test_a_change_that_fails_at_any_line_is_not_applied(tmp_path):
    first, second = tmp_path / 'first.yaml', tmp_path / 'second.yaml'
    save_calibration(of_bias(1.0), first)
    # The detector settings of the files differ, so every part of the correction is built anew.
    save_calibration(of_bias(2.0, detector=DetectorSettings(dwell_s=61.0)), second)
    context = Context()
    rclpy.init(args=['--ros-args', '-p', f'calibration_file:={first}'], context=context)
    node = CompensationNode(context)
    undisturbed = Compensator(of_bias(1.0))
    new_values = {'calibration_file': str(second), 'frame_id': 'body', 'transition_time': 5.0,
                  'stuck_timeout': 3.0, 'diagnostics_period': 2.0}  # fmt: skip
    changes = [Parameter(name, value=value) for name, value in new_values.items()]
    try:
        new = node._prepare(changes)
        values = {change.name: node.node.get_parameter(change.name).value for change in changes}
        running = node._relay.running
        number, k = 1, 0
        while raising_at(number, lambda: node._set(changes, new)):
            number += 1
            assert node._relay.running is running
            assert {name: node.node.get_parameter(name).value for name in values} == values
            assert node._loop._period_ns == SECOND_NS
            for _ in range(3):
                for compensator in (undisturbed, running.compensator):
                    if k % 10 == 0:
                        compensator.push('board', START_NS + k * CYCLE_NS, 20.0 + 1e-3 * k)
                        compensator.push('case', START_NS + k * CYCLE_NS, 20.0 + 2e-3 * k)
                sample = START_NS + k * CYCLE_NS, *standing(k)
                assert running.compensator.process(*sample) == undisturbed.process(*sample)
                k += 1
        assert number > 150
        for change in changes:
            assert node.node.get_parameter(change.name).value == change.value
        sample = START_NS + k * CYCLE_NS, *standing(k)
        force = node._relay.running.compensator.process(*sample)
        assert force[0] == pytest.approx((standing(k)[0] - 2.0) / K, abs=1e-12)
        assert node._relay.running.config.frame_id == 'body'
        assert node._loop._period_ns == 2 * SECOND_NS
    finally:
        node.close()
        context.try_shutdown()


def test_a_calibration_of_another_unit_is_named(peer, tmp_path, capfd):
    first, second = tmp_path / 'first.yaml', tmp_path / 'second.yaml'
    save_calibration(of_bias(1.0), first)
    unit = of_bias(1.0).unit
    save_calibration(of_bias(77.0, unit=replace(unit, serial='Z-9')), second)
    with node_in_thread(*lossless(), '-p', f'calibration_file:={first}'):
        for path in (first, second):
            (result,) = peer.set_parameters(calibration_file=str(path))
            assert result.successful, result.reason
    said = capfd.readouterr().err
    assert said.count('replaces unit') == 1
    assert f'unit Z-9 replaces unit {unit.serial}: set the parameter `serial`' in said
