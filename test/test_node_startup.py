# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A node that cannot start ends with one line on stderr; a node that has started ends cleanly."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ran

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from builders import calibration
from node_process import NodeProcess, without_middleware
from ros_helpers import TIMEOUT, Driver, node_in_thread, standing
from sensor_msgs.msg import Imu

from thermo_comp.ros.node import main
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import dump_calibration, save_calibration


def arguments(*overrides):
    kinds = ('-r' if rule.startswith('temperature') else '-p' for rule in overrides)
    words = [word for pair in zip(kinds, overrides, strict=True) for word in pair]
    return ['thermo_comp_node', '--ros-args', *words]


@pytest.mark.parametrize(
    ('overrides', 'text'),
    [
        ([], 'parameter `calibration_file` is not set; start with --ros-args -p calibration_f'),
        (['calibration_file:={tmp}/none.yaml'],
         '/none.yaml: cannot be read: No such file or dir'),
        (['calibration_file:={tmp}'], 'cannot be read: '),
        (['calibration_file:={tmp}/nan.yaml'], '/nan.yaml: axes.x.bias: '),
        (['calibration_file:={tmp}/text.yaml'], '/text.yaml: expected a mapping'),
        (['calibration_file:={unit}', 'serial:=T-2'], "unit.serial: must be 'T-2' (parameter"),
        (['calibration_file:={unit}', 'input:=imu'], "unit.input: must be 'm/s^2'"),
        (['calibration_file:={tmp}/imu.yaml'],
         "/imu.yaml: unit.input: must be 'counts' (parameter `input` is counts), got 'm/s^2'"),
        (['calibration_file:={unit}', 'input:=gyro'], '`input` must be one of counts, imu'),
        (['calibration_file:={unit}',
         'qos_overrides./accel/counts.subscription.reliability:=good'],
         'the topic accel/counts cannot be opened: '),
        (['calibration_file:={unit}', 'qos_overrides./accel/counts.subscription.depth:=deep'],
         "accel/counts cannot be opened: Trying to set parameter 'qos_overrides./accel/counts"),
        (['calibration_file:={unit}', 'use_sim_time:=7'], "set parameter 'use_sim_time' to '7'"),
        (['calibration_file:={unit}', 'topics:=board=/t', 'temperature/case:=/t'],
         '/t: one topic for both board and case: name a single thermometer as the board, not as'),
    ],
)  # fmt: skip
def test_a_node_that_cannot_start_prints_one_line(overrides, text, unit, tmp_path, capfd):
    (tmp_path / 'text.yaml').write_text('just words')
    nan = dump_calibration(calibration()).replace('bias: 0.0', 'bias: .nan', 1)
    (tmp_path / 'nan.yaml').write_text(nan)
    save_calibration(calibration(unit=Unit('T-1', 'm/s^2', 160.0, 0.01)), tmp_path / 'imu.yaml')
    code = main(arguments(*(override.format(tmp=tmp_path, unit=unit) for override in overrides)))
    printed = capfd.readouterr()
    assert (code, without_middleware(printed.out)) == (1, '')
    (line,) = printed.err.splitlines()
    assert line.startswith('thermo_comp_node: ')
    assert text in line


@pytest.mark.parametrize(
    ('name', 'value', 'text'),
    [
        ('ROS_DOMAIN_ID', 'abc', 'ROS_DOMAIN_ID is not an integral number'),
        ('ROS_LOG_DIR', '/proc/none', "Failed to create log directory '/proc/none'"),
    ],
)
def test_an_unusable_ros_environment_is_one_line(name, value, text, unit, monkeypatch, capfd):
    monkeypatch.setenv(name, value)
    assert main(arguments(f'calibration_file:={unit}')) == 1
    printed = capfd.readouterr().err.splitlines()[-1]
    assert printed.startswith('thermo_comp_node: failed to initialize')
    assert text in printed


def test_a_node_with_closed_streams_runs(unit, peer):
    # WHY: with stderr closed the pipe for signals got descriptor 2: log text became a signal.
    shell = ['sh', '-c', 'exec "$0" "$@" <&- >&- 2>&-', sys.executable]
    words = [*shell, '-m', 'thermo_comp.ros.node', *arguments(f'calibration_file:={unit}')[1:]]
    with subprocess.Popen(words, cwd=Path(__file__).parents[1]) as node:
        assert peer.describe('serial')[0].description
        node.terminate()
        assert node.wait(TIMEOUT) == 0


@pytest.mark.parametrize(('sink', 'code'), [('> /dev/full', 1), ('| true', 0)])
def test_help_that_cannot_be_written_prints_no_traceback(sink, code):
    words = f'set -o pipefail; "{sys.executable}" -m thermo_comp.ros.node --help {sink}'
    finished = ran('bash', '-c', words)
    assert finished.returncode == code
    assert 'Traceback' not in finished.stderr


#: Libraries of the offline tools, which are not installed on a robot.
ABSENT = ('typer', 'rich', 'rosbags', 'mcap', 'zstandard', 'scipy', 'matplotlib')


def test_node_and_commands_without_ros_end_with_advice(tmp_path, monkeypatch):
    # This ROS 2 belongs to another version of Python, such as that of conda.
    absent = 'rclpy._rclpy_pybind11'
    (tmp_path / 'rclpy').mkdir()
    text = f'raise ImportError("No module named {absent}\\nSee another page")\n'
    (tmp_path / 'rclpy' / '__init__.py').write_text(text)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    finished = ran(sys.executable, '-c', 'from thermo_comp.__main__ import node; node()')
    text = f'thermo_comp_node: error: No module named {absent}: source the setup file of ROS 2'
    assert (finished.returncode, finished.stdout) == (1, '')
    assert finished.stderr.startswith(text)
    assert finished.stderr.count('\n') == 1
    finished = ran(sys.executable, '-m', 'thermo_comp', 'play', 'bag')
    assert (finished.returncode, finished.stdout) == (1, '')
    assert f'cannot import (No module named {absent}): source the setup' in finished.stderr


def test_the_node_needs_only_ros_numpy_and_yaml(unit, peer, tmp_path, monkeypatch):
    # Python imports sitecustomize when it starts, in the node and in its child processes.
    (tmp_path / 'sitecustomize.py').write_text(
        'import sys\n'
        'class Absent:\n'
        '    def find_spec(self, name, *_):\n'
        f'        if name.partition(".")[0] in {ABSENT!r}:\n'
        '            raise ModuleNotFoundError(name, name=name)\n'
        'sys.meta_path.insert(0, Absent())\n'
    )
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    check = f'from importlib.util import find_spec\nfor name in {ABSENT!r}:\n'
    check += '    try: find_spec(name)\n    except ModuleNotFoundError: print(name)'
    assert tuple(ran(sys.executable, '-c', check).stdout.split()) == ABSENT
    heard = peer.listen(Imu, 'imu/data_raw')
    with NodeProcess('-p', f'calibration_file:={unit}') as node:
        driver = Driver(peer)
        peer.poll(lambda: peer.node.count_publishers('imu/data_raw'), 'the output')

        def is_heard():
            stamp_ns = time.monotonic_ns()
            driver.temperatures(stamp_ns, 20.0, 20.0)
            driver.counts(stamp_ns, *standing(stamp_ns))
            return bool(heard)

        peer.poll(is_heard, 'a sample')
        # The node reads a calibration in a child process.
        (result,) = peer.set_parameters(calibration_file=str(unit))
        assert result.successful, result.reason
        del heard[:]
        peer.poll(is_heard, 'a sample after the reload')
        assert node.stop() == 0
        assert 'rror' not in node.said.replace('[ERROR]', '')
    finished = ran(sys.executable, '-m', 'thermo_comp', 'info', unit)
    assert finished.returncode == 1
    text = 'thermo_comp: error: the commands need typer: pip install thermo_comp\n'
    assert (finished.stdout, finished.stderr) == ('', text)


def test_the_node_prints_its_help_and_names_wrong_arguments_and_parameters(capfd, unit):
    assert main(['thermo_comp_node', '--help']) == 0
    assert 'example: thermo_comp_node --ros-args -p calibration_file' in capfd.readouterr().out
    assert main(['thermo_comp_node', 'unit.yaml']) == 2
    assert "unknown argument 'unit.yaml'" in capfd.readouterr().err
    assert main(['thermo_comp_node', '--ros-args', '--params-file', '/none.yaml']) == 2
    printed = capfd.readouterr().err
    assert 'thermo_comp_node: ' in printed
    assert 'Traceback' not in printed
    overrides = ['-p', f'calibration_file:={unit}', '-p', 'transition_tme:=3.0']
    overrides += ['-p', 'qos_overrides./imu/uncompensated.subscription.depth:=3']
    with node_in_thread(*overrides):
        printed = capfd.readouterr().err
        assert 'there is no parameter `transition_tme`: value not used' in printed
        assert printed.count('there is no parameter') == 1


@pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_signal_during_the_start_ends_the_node_cleanly(unit, number):
    # Send the signal as soon as the middleware has started its first thread.
    with NodeProcess('-p', f'calibration_file:={unit}') as node:
        tasks = Path(f'/proc/{node.process.pid}/task')
        deadline = time.monotonic() + TIMEOUT
        while not any('dds.' in name(task) for task in tasks.iterdir()):
            assert time.monotonic() < deadline
        assert node.stop(number) == 0
        assert 'Traceback' not in node.said


def name(task):
    try:
        return (task / 'comm').read_text()
    except OSError:
        return ''
