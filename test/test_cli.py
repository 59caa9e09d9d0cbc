# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line: help, plain tables, valid JSON, and topics by name."""

import json
import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from builders import rich_calibration
from conftest import ROOT, parsed, ran

import thermo_comp
from thermo_comp.cli import bags, output
from thermo_comp.cli.app import split_arguments
from thermo_comp.online.status import DROPPED
from thermo_comp.recording.reader import inspect_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.calibration_file import save_calibration
from thermo_comp.unit.nonlinearity import Nonlinearity, NonlinearTerm


@pytest.fixture(scope='session')
def bag(tmp_path_factory, cli):
    # 15 min at 10 Hz are 9000 samples, of which 4 precede the first board reading.
    path = tmp_path_factory.mktemp('cli') / 'bag'
    cli('simulate', '--profile', '20 4min, 30@2 6min', '--rate-hz', '10', '-o', path)
    return path


@pytest.fixture(scope='session')
def unit(bag):
    save_calibration(rich_calibration(), bag.parent / 'unit.yaml')
    return bag.parent / 'unit.yaml'


def test_the_option_version_prints_the_version(cli):
    assert cli('--version').stdout == f'thermo_comp {thermo_comp.__version__}\n'


class TestOutput:
    def test_tables_in_a_pipe_are_plain_columns(self, bag, cli):
        printed = cli('info', bag).stdout
        assert '\x1b' not in printed
        assert printed.isascii()
        assert max(map(len, printed.splitlines())) <= 80
        row = next(line for line in printed.splitlines() if line.startswith('/accel/counts'))
        assert row.split() == ['/accel/counts', 'geometry_msgs/msg/Vector3Stamped', '8996']

    def test_a_closed_pipe_gives_no_error(self, bag):
        command = f'{sys.executable} -m thermo_comp info {bag} | head -n 1'
        finished = ran('bash', '-c', f'set -o pipefail; {command}')
        assert (finished.stderr, len(finished.stdout.splitlines())) == ('', 1)

    def test_progress_is_shown_only_on_a_terminal_and_colour_only_without_no_color(self, bag, cli):
        for no_color in (False, True):
            leader, follower = pty.openpty()
            terminal = {'COLUMNS': '80', 'TERM': 'xterm-256color', 'NO_COLOR': '1'}
            environment = {**os.environ, **terminal}
            if not no_color:
                del environment['NO_COLOR']
            process = subprocess.Popen(
                [sys.executable, '-m', 'thermo_comp', 'info', str(bag)], cwd=ROOT,
                env=environment, stdin=follower, stdout=follower, stderr=follower,
            )  # fmt: skip
            os.close(follower)
            shown = b''
            with suppress(OSError):  # the command has ended and closed its terminal
                while part := os.read(leader, 65536):
                    shown += part
            os.close(leader)
            assert process.wait(timeout=60) == 0
            assert b'reading bag' in shown
            assert bool(re.search(rb'\x1b\[(3\d|9\d|38)', shown)) != no_color
        finished = cli('info', bag)
        assert 'reading bag' not in finished.stdout + finished.stderr


def test_what_a_library_prints_on_descriptor_1_goes_to_standard_error():
    # WHY: an error that Fast DDS printed stood before the JSON of `record` and `play`.
    code = (
        'import os; from thermo_comp.cli import app; '
        "app.run = lambda _: (os.write(1, b'library'), print('result'), 0)[-1]; app.main([])"
    )
    finished = ran(sys.executable, '-c', code, check=True)
    assert (finished.stdout, finished.stderr) == ('result\n', 'library')


def test_a_command_computes_in_one_thread():
    # WHY: BLAS threads waited for each other; on two busy cores a fit took 16 times as long.
    code = (
        'import os, sys; from thermo_comp.cli import app; '
        "app.run = lambda _: print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS']); "
        'app.main([])'
    )
    for wanted, text in (({}, '1'), ({'OPENBLAS_NUM_THREADS': '3'}, '3')):
        environment = {k: v for k, v in os.environ.items() if k != 'OPENBLAS_NUM_THREADS'}
        finished = ran(sys.executable, '-c', code, env={**environment, **wanted}, check=True)
        assert finished.stdout.split() == ['False', text]


class TestPlay:
    @pytest.fixture(autouse=True)
    def needs_ros(self):
        pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

    def test_play_sends_every_message_under_the_requested_names(self, bag, cli):
        arguments = ('play', bag, '--rate', '0', '--wait', '0', '--json')
        finished = cli(*arguments, '--ros-args', '-r', '__ns:=/here')
        data = parsed(finished.stdout)
        info = inspect_recording(bag)
        counts = {f'/here{name}': count for name, (_, count) in info.topics.items()}
        assert (data['messages'], data['unheard']) == (counts, sorted(data['unheard']))
        assert '/here/accel/counts had no subscriber' in finished.stderr

    def test_ros_arguments_end_at_two_dashes(self):
        words = ['play', 'a', '--ros-args', '-r', 'x:=y', '--', '-q']
        assert split_arguments(words) == (['play', 'a', '-q'], ['-r', 'x:=y'])
        assert split_arguments(['info', '--', 'a']) == (['info', '--', 'a'], [])


def test_a_plan_simulates_a_whole_test(tmp_path, cli):
    plan = ('--plan', 'tumble-1', '--unit', 'demo')
    cli('simulate', *plan, '--rate-hz', '1', '-o', tmp_path / 'sim')
    infos = [inspect_recording(path) for path in sorted((tmp_path / 'sim').iterdir())]
    assert [round((info.end_ns - info.start_ns) / 6e10) for info in infos] == [*[20] * 18, 180]
    assert {info.metadata['serial'] for info in infos} == {'demo-0001'}
    assert json.loads(infos[0].metadata['truth'])['profile'] == 'tumble-1'


def test_info_lists_nonlinear_terms(unit, cli, tmp_path):
    square = NonlinearTerm('square', (1e-5, -2e-5, 0.0), (1e-7, 0.0, 0.0), 1e-4)
    bent = Nonlinearity((9.8, 98.0), 1e-4, (square,))
    known = replace(rich_calibration(), nonlinearity=bent, posterior=None)
    save_calibration(known, tmp_path / 'unit.yaml')
    printed = cli('info', tmp_path / 'unit.yaml').stdout
    assert re.search(r'^K2 +µg/g² +10 +-20 +0$', printed, re.MULTILINE)
    assert re.search(r'^K2 per kelvin +µg/g²/K +0\.1 +0 +0$', printed, re.MULTILINE)
    assert 'nonlinearity' not in cli('info', unit).stdout


class TestTopics:
    @pytest.fixture
    def named(self, tmp_path):
        with BagWriter(tmp_path / 'bag') as writer:
            counts = np.arange(3000.0).reshape(-1, 3)
            writer.write_counts('/imu/raw', np.arange(1, 1001) * 10_000_000, counts)
            for row, topic in enumerate(('/t1', '/t2', '/t3')):
                writer.write_temperature(topic, [10_000_000], [20.0 + row])
        return tmp_path / 'bag'

    def test_options_override_topics_of_a_file(self, named, cli):
        profile = named.with_name('lab.yaml')
        profile.write_text('counts: /imu/raw\nboard: /t2\ntemperature/magnet: /t3\n')
        arguments = ('--topics', profile, '--topic', 'board=/t1', '--topic=case=/t2')
        seen = parsed(cli('info', named, *arguments, '--json').stdout)
        degrees = {name: probe['lowest'] for name, probe in seen['thermometers'].items()}
        assert degrees == {'board': 20.0, 'case': 21.0, 'magnet': 22.0}
        assert seen['chosen'] is None

    def test_the_only_topic_of_its_type_is_taken_and_named(self, named, unit, cli):
        text = '/imu/raw, the only Vector3Stamped of the bag, is taken for counts'
        assert text in cli('info', named).stdout
        topics = ('--topic', 'board=/t1', '--topic', 'case=/t2')
        arguments = ('-o', named.with_name('out.mcap'), '--serial', '', *topics)
        assert f'{named}: {text}' in cli('replay', named, '-c', unit, *arguments).stderr

    def test_a_topics_file_of_another_form_is_refused(self, named, cli):
        profile = named.with_name('lab.yaml')
        profile.write_text('board: [1]\n')
        refused = cli('info', named, '--topics', profile, code=1).stderr
        assert f'{profile}: expected lines INPUT: TOPIC' in refused
        assert 'cannot be read' in cli('info', named, '--topics', named, code=1).stderr


class TestCells:
    @pytest.mark.parametrize(
        ('cell', 'text'),
        [
            (None, '-'), (float('nan'), '-'), (float('inf'), '-'), (0.0, '0'), (3, '3'),
            ('a', 'a'), (12.3456, '12.35'), (-0.00012345, '-0.000123'), (999.96, '1000'),
            (123456.7, '123457'),
        ],
    )  # fmt: skip
    def test_cells_of_tables_have_the_expected_text(self, cell, text):
        assert output.text(cell) == text

    def test_columns_of_tables_are_aligned_and_plain_values_are_json_without_nan(self):
        lines = list(output.aligned(('n', 'name'), [(1, 'a'), (10, 'bc')]))
        assert lines == [' n  name', ' 1  a', '10  bc']
        assert list(output.aligned(('n',), [], 'title')) == ['title', 'n']
        data = {'a': np.array([1.0, np.nan]), 'b': (np.int64(3), Path('x')), 3: np.True_}
        assert output.plain(data) == {'a': [1.0, None], 'b': [3, 'x'], '3': True}


def test_findings_that_set_the_exit_code_are_printed_despite_quiet(capsys):
    out = output.Output(quiet=True)
    out.sources([('01.mcap', 'the only topic', 'cut off after 3 s')])
    with pytest.raises(typer.Exit):
        out.end()
    assert capsys.readouterr() == ('', 'thermo_comp: 01.mcap: cut off after 3 s\n')


def test_the_command_replay_has_a_text_for_every_reason_to_drop_a_sample():
    assert tuple(bags._LEFT_OUT) == DROPPED
