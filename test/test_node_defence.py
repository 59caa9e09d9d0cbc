# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Whatever unknown peers send, the node answers any request and publishes all samples."""

import contextlib
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import ros_helpers as ros
from builders import calibration
from diagnostic_msgs.msg import DiagnosticStatus
from node_process import OVER_UDP, NodeProcess
from rcl_interfaces import srv
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter

from thermo_comp.errors import CalibrationError
from thermo_comp.plain_yaml import NODE_LIMIT
from thermo_comp.ros.parameters import PARAMETERS_LIMIT
from thermo_comp.ros.reader import Reader, read_within
from thermo_comp.text import one_line
from thermo_comp.unit.calibration_file import save_calibration

SLOW = pytest.mark.slow


#: A request may contain these parameters, and must be answered.
STRANGE = [
    *[ParameterMessage(name=name, value=ParameterValue(type=kind))
      for name in ('frame_id', '', 'no such') for kind in (0, 77, 255)],
    *[
        Parameter(name, value=value).to_parameter_msg()
        for name, value in (
            ('calibration_file', '~nosuchuser/u.yaml'), ('calibration_file', '~' * 5000),
            ('calibration_file', ''), ('calibration_file', 'a\0b'), ('input', 'imu'),
            ('calibration_file', [1.0, 2.0]), ('calibration_directory', '/'),
            ('frame_id', 'x' * 10_000_000), ('frame_id', 'a\nb'), ('frame_id', 'a\x1b[2Jb'),
            ('nobody\x1b[2J' * 100_000, 1), ('serial', 's' * 65), ('use_sim_time', 'perhaps'),
            ('transition_time', float('nan')), ('transition_time', 1 << 62),
            ('diagnostics_period', -(1 << 62)),
            ('qos_overrides./accel/counts.subscription.depth', 7),
        )
    ],
]  # fmt: skip


@pytest.mark.parametrize('together', [False, True], ids=['each', 'together'])
def test_any_request_is_answered_and_samples_go_on(peer, unit, together):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        kind = srv.SetParametersAtomically if together else srv.SetParameters
        name = f'thermo_comp/{"set_parameters_atomically" if together else "set_parameters"}'
        for message in STRANGE:
            answer = peer.call(kind, name, kind.Request(parameters=[message]))
            result = answer.result if together else answer.results[0]
            assert not result.successful, message.name
            assert result.reason, message.name
            assert result.reason == one_line(result.reason)
            assert len(result.reason) < 10_000, message.name[:60]
        samples.go_on()
        good = Parameter('frame_id', value='body').to_parameter_msg()
        answer = peer.call(kind, name, kind.Request(parameters=[STRANGE[1], good]))
        assert node._relay.running.config.frame_id == ('' if together else 'body')
        answer = peer.call(kind, name, kind.Request(parameters=[good] * (PARAMETERS_LIMIT + 1)))
        result = answer.result if together else answer.results[0]
        assert f'at most {PARAMETERS_LIMIT}' in result.reason
        samples.go_on()
        assert node._loop.n_failures == 0


@pytest.mark.parametrize(
    ('kind', 'field'),
    [
        (srv.GetParameters, 'names'),
        (srv.GetParameterTypes, 'names'),
        (srv.DescribeParameters, 'names'),
        (srv.ListParameters, 'prefixes'),
    ],
)
def test_parameter_requests_of_any_length_are_answered(peer, unit, kind, field):
    # WHY: a request with 100 000 names delayed the samples by more than a second.
    name = 'thermo_comp/' + re.sub('(?<!^)(?=[A-Z])', '_', kind.__name__).lower()
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)

        def ask(*names):
            answer = str(peer.call(kind, name, kind.Request(**{field: list(names)})))
            samples.go_on()
            return answer

        nothing = str(kind.Response())
        assert ask(*['qos_overrides' if field == 'prefixes' else 'frame_id'] * 3) != nothing
        for names in (['frame_id'] * (PARAMETERS_LIMIT + 1), ['frame_id'] * 100_000):
            assert ask(*names) == nothing
        for odd_name in ('', 'no such', 'a..b', '\x1b', 'x' * 1_000_000):
            assert ask(odd_name) == nothing
        assert node._loop.n_failures == 0


def test_a_callback_that_fails_is_logged_counted_and_survived(peer, unit):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)

        def fail(*_):
            raise ZeroDivisionError('nobody foresaw this')

        node._loop.call_soon(fail)
        status = ros.status_with(peer, samples.reports, 'callbacks failed')
        assert status.level == DiagnosticStatus.ERROR
        samples.go_on()
        keep, node._requests._apply = node._requests._apply, fail
        (result,) = peer.set_parameters(frame_id='body')
        assert result.reason == "internal error (ZeroDivisionError), see the node's log"
        node._requests._apply = keep
        keep, node._relay._take_readings = node._relay._take_readings, fail
        n_failures = node._loop.n_failures
        samples.driver.temperatures(ros.START_NS + samples.n_sent * ros.CYCLE_NS, 20.0, 20.0)
        peer.poll(lambda: node._loop.n_failures > n_failures, 'the failure')
        node._relay._take_readings = keep
        samples.go_on()


NOT_CALIBRATIONS = {
    'root:x:0:0:secret:/root:/bin/sh\n': '',
    'secret_key: 1\n': 'not a calibration: the key `format_version` is missing',
    '"secret": *secret\n': 'YAML aliases are not accepted (line 1)',
    'a: 1\nb: "secret\n': 'not valid YAML (line 3)',
    'secret: 1\nsecret: 2\n': 'not valid YAML (line 2)',
    '[secret]: 1\n': 'not valid YAML',
    '- secret\n': 'expected a mapping',
    'format_version: 987654321\nsecret: 1\n': 'not a calibration: the key `unit` is missing',
    f'a: [{"[], " * NODE_LIMIT}]\n': f'more than {NODE_LIMIT} keys and values',
}


def test_no_content_of_a_file_that_is_no_calibration_is_quoted(peer, unit, tmp_path):
    other = tmp_path / 'other'
    with ros.node_in_thread(*ros.node_arguments(unit)):
        for content, rule in NOT_CALIBRATIONS.items():
            other.write_text(content)
            (result,) = peer.set_parameters(calibration_file=str(other))
            assert not result.successful
            assert result.reason.startswith(f'{other}: {rule}')
            for word in ('secret', 'root', '987654321'):
                assert word not in result.reason.removeprefix(str(other))


def test_a_calibration_outside_the_calibration_directory_is_refused(peer, unit, tmp_path):
    folder, outside = tmp_path / 'units', tmp_path / 'outside.yaml'
    folder.mkdir()
    save_calibration(calibration(), outside)
    inside = folder / 'unit.yaml'
    save_calibration(calibration(), inside)
    (folder / 'link.yaml').symlink_to(outside)
    (folder / 'up').symlink_to(tmp_path)
    (folder / 'good.yaml').symlink_to('unit.yaml')
    with ros.node_in_thread(*ros.node_arguments(inside, f'calibration_directory:={folder}')):
        for name in (outside, folder / '../outside.yaml', folder / 'link.yaml', '/etc/shadow'):
            (result,) = peer.set_parameters(calibration_file=str(name))
            expected = 'must be in the folder that the parameter `calibration_directory` names'
            assert result.reason == f'{name}: {expected}'
        (result,) = peer.set_parameters(calibration_file=str(folder / 'up' / 'outside.yaml'))
        assert 'calibration_directory' in result.reason
        (result,) = peer.set_parameters(calibration_file=str(folder / 'good.yaml'))
        assert result.successful, result.reason
        (result,) = peer.set_parameters(calibration_directory='/')
        assert not result.successful
        assert peer.describe('calibration_directory')[0].read_only


def test_a_calibration_reader_that_ends_is_restarted(unit):
    # A separate process reads the file, so a file that crashes the reader does not end the node.
    reader = Reader()
    assert reader.read(str(unit), '').calibration == calibration()
    process = reader._process
    process.kill()
    process.wait()
    with pytest.raises(CalibrationError, match='the process that reads it ended'):
        reader.read(str(unit), '')
    assert reader.read(str(unit), '').calibration == calibration()
    with pytest.raises(CalibrationError, match=r'^none\.yaml: cannot be read: No such file'):
        reader.read('none.yaml', '')
    reader.close()
    with pytest.raises(CalibrationError, match='the process that reads it ended'):
        reader.read(str(unit), '')


def test_a_calibration_file_that_hangs_at_the_start_is_refused(monkeypatch):
    forever = threading.Event()
    monkeypatch.setattr('thermo_comp.ros.reader.read', lambda *_: forever.wait())
    with pytest.raises(CalibrationError, match=r'^a\.yaml: cannot be read: no answer within 0\.2'):
        read_within('a.yaml', '', 0.2)
    forever.set()


def test_while_a_calibration_file_hangs_other_parameters_can_be_set(peer, unit):
    # WHY: a file on a lost network drive blocked all parameter requests and the end of the node.
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        assert peer.set_parameters(calibration_file=str(unit))[0].successful
        node._reader._limit_s = 3.0
        node._reader._process.send_signal(signal.SIGSTOP)
        process, name = node._reader._process, 'thermo_comp/set_parameters'
        message = Parameter('calibration_file', value=str(unit)).to_parameter_msg()
        hanging = peer._clients[name].call_async(srv.SetParameters.Request(parameters=[message]))
        (result,) = peer.set_parameters(frame_id='body')
        assert result.successful
        samples.go_on()
        assert not hanging.done()
        peer.poll(hanging.done, 'the answer')
        (refused,) = hanging.result().results
        assert refused.reason == f'{unit}: cannot be read: no answer within 3 s'
        assert process.returncode == -signal.SIGKILL
        node._reader._limit_s = ros.TIMEOUT
        assert peer.set_parameters(calibration_file=str(unit))[0].successful
        samples.go_on()


@pytest.mark.parametrize('number', [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=SLOW)])
def test_while_a_calibration_file_hangs_the_node_can_be_ended(peer, unit, number):
    with NodeProcess('-p', f'calibration_file:={unit}', **OVER_UDP) as node:
        assert peer.set_parameters(calibration_file=str(unit))[0].successful
        children = Path(f'/proc/{node.process.pid}/task').glob('*/children')
        (reader,) = ' '.join(child.read_text() for child in children).split()
        os.kill(int(reader), signal.SIGSTOP)
        message = Parameter('calibration_file', value=str(unit)).to_parameter_msg()
        client = peer._clients['thermo_comp/set_parameters']
        client.call_async(srv.SetParameters.Request(parameters=[message]))
        assert peer.set_parameters(frame_id='body')[0].successful
        began = time.monotonic()
        code = node.stop(number)
        assert time.monotonic() - began < 2.0
        assert code == (0 if number == signal.SIGTERM else -number)
        peer.poll(lambda: not alive(int(reader)), 'the end of the reader')
        assert 'Traceback' not in node.said


def test_a_fault_that_comes_and_goes_does_not_fill_the_log(peer, unit, capfd):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        samples = ros.Samples(peer, node)
        for _ in range(8):
            samples.driver.counts(ros.START_NS + samples.n_sent * ros.CYCLE_NS, math.nan, 0.0, 0.0)
            samples.n_sent += 1
            ros.status_with(peer, samples.reports, 'samples not finite, dropped: 1')
            ros.status_with(peer, samples.reports, 'constants of', lambda: samples.send(1))
    assert capfd.readouterr().err.count('samples not finite') <= 1


def alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False


HANGING = """
from thermo_comp.text import keep_standard_output
keep_standard_output()
import threading
from thermo_comp.ros import node, reader
reader.read = lambda *_: (print('reads', flush=True), threading.Event().wait())
raise SystemExit(node.main(['node', '--ros-args', '-p', 'calibration_file:=gone.yaml']))
"""


def test_a_node_that_hangs_at_the_start_ends_with_one_or_with_repeated_signals():
    # WHY: the first SIGTERM had no effect; in a later version each SIGTERM delayed the end.
    words = [sys.executable, '-c', HANGING]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == 'reads\n'
        began = time.monotonic()
        while process.poll() is None and time.monotonic() - began < ros.TIMEOUT:
            process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
        assert process.wait(ros.TIMEOUT) == 0
        assert time.monotonic() - began < 2.2


def test_parameters_written_by_param_dump_are_set_by_param_load(peer, unit):
    with ros.node_in_thread(*ros.node_arguments(unit)) as node:
        names = [parameter for parameter in node.node._parameters]  # noqa: C416
        request = srv.GetParameters.Request(names=names)
        values = peer.call(srv.GetParameters, 'thermo_comp/get_parameters', request).values
        assert len(values) == len(names) > 20
        dumped = [ParameterMessage(name=n, value=v) for n, v in zip(names, values, strict=True)]
        loaded = srv.SetParameters.Request(parameters=dumped)
        results = peer.call(srv.SetParameters, 'thermo_comp/set_parameters', loaded).results
        assert [result.reason for result in results if not result.successful] == []
