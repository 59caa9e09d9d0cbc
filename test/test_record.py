# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The command `record` writes a bag per position, from a growing bag or a driver on DDS."""

import json
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT, ran
from triads import triad

from thermo_comp.errors import RecordingError
from thermo_comp.recording.growing import growing_blocks, leftovers, numbered_bags
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.run import simulate_blocks
from thermo_comp.unit.calibration_file import load_calibration
from thermo_comp.unit.prediction import in_a_soak

N_POSITIONS, SOAK_S, TURN_S, RATE = 9, 100.0, 20.0, 10.0
UNIT = triad('plain', 1)
UPS = positions(N_POSITIONS, 2)
START_NS = 1_767_225_600_000_000_000


def write_session(path, ups=UPS, chunk_bytes=1 << 14):
    """Write a bag of a unit that rests in each attitude in turn, and is handled between rests."""
    rng = np.random.default_rng(5)
    program = parse_cyclogram(f'20 {SOAK_S:g}s')
    start_ns = START_NS
    with BagWriter(path, metadata={'serial': 'lab-7'}, chunk_bytes=chunk_bytes) as writer:
        for seed, up in enumerate(ups):
            (run,) = simulate_blocks(
                UNIT, program, up, block_size=1 << 20, rate_hz=RATE, temperature_rate_hz=1.0,
                seed=seed,
            )  # fmt: skip
            by = start_ns - int(run.accel_stamp_ns[0])
            writer.write_counts('accel/counts', run.accel_stamp_ns + by, run.counts, 'imu_link')
            for name, stamp_ns, celsius in (
                ('board', run.board_stamp_ns, run.board),
                ('case', run.case_stamp_ns, run.case),
                ('lid', run.case_stamp_ns, run.case - 1.0),
            ):
                writer.write_temperature(f'temperature/{name}', stamp_ns + by, celsius)
            end_ns = int(run.accel_stamp_ns[-1]) + by
            stamps = end_ns + (np.arange(1, TURN_S * RATE) * 1e9 / RATE).astype(np.int64)
            shaken = np.rint(run.counts[-1] + rng.normal(0.0, 900.0, (len(stamps), 3)))
            writer.write_counts('accel/counts', stamps, shaken, 'imu_link')
            start_ns = int(stamps[-1]) + round(1e9 / RATE)
            writer.flush()
    return path


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    return write_session(tmp_path_factory.mktemp('session') / 'session.mcap')


def contents(paths):
    collected = {}
    for path in paths:
        with open_recording(path, require=()) as reader:
            for topic, messages in reader.raw(reader.info.topics):
                collected.setdefault(topic.name, []).extend(messages)
    return collected


def check_positions(result):
    assert result['is_complete']
    for position, up in zip(result['positions'], UPS, strict=True):
        # The unit's bias turns the measured direction by less than 1 degree.
        assert np.array(position['up']) @ up > np.cos(np.radians(1.0))
        assert position['reason'] == ''
        assert set(position['thermometers']) == {'board', 'case', 'lid'}
        # Means over 3 s, next to a motion, do not count as rest.
        assert position['still_s'] == pytest.approx(SOAK_S, abs=20.0)


def check_fit(result, cli, folder):
    given = '--gravity 9.80665 --model golovach'
    words = shlex.split(result['command'].replace('--gravity G', given))
    assert words.pop(0) == 'thermo_comp'
    bags = [str(path) for path in sorted(folder.glob('*.mcap'))]
    cli(*(part for word in words for part in (bags if '*' in word else [word])), cwd=folder)
    calibration = load_calibration(folder / 'unit.yaml')
    assert calibration.unit.serial == 'lab-7'
    # The board is at 20.39 degC in all positions, so compare the constants at 20.39 degC.
    bias, _, scale, _ = in_a_soak(calibration, 20.39)
    # `record` computes `scale_sd` from the noise in the positions.
    assert scale / UNIT.scale_factor == pytest.approx(1.0, abs=5.0 * max(result['scale_sd']))
    true_bias = np.array(UNIT.bias_at_reference) / UNIT.scale_factor
    assert bias == pytest.approx(true_bias, abs=5.0 * 9.80665 * max(result['bias_sd_g']))
    limit = 5.0 * max(result['misalignment_sd_rad'])
    assert np.array(calibration.misalignment) == pytest.approx(UNIT.M, abs=limit)


CRASH = """
import os, signal, sys
from pathlib import Path
from thermo_comp.recording.growing import PositionBags
from thermo_comp.recording.reader import open_recording
bags = PositionBags(Path(sys.argv[2]), 'lab-7')
with open_recording(Path(sys.argv[1])) as reader:
    for block in reader.blocks(raw=True):
        bags.add(block, reader.info)
bags.release(int(sys.argv[3]))
os.kill(os.getpid(), signal.SIGKILL)
"""


class TestGrowing:
    def test_each_message_of_a_growing_file_is_read_once(self, session, tmp_path):
        whole = session.read_bytes()
        growing = tmp_path / 'growing.mcap'
        growing.write_bytes(b'')
        sizes = iter([0, 40, *(len(whole) * k // 7 for k in range(1, 7)), len(whole)])

        def wait(_):
            growing.write_bytes(whole[: next(sizes)])
            return False

        collected = {}
        n_looks = 0
        for news in growing_blocks(growing, Topics(), wait):
            n_looks += news is None
            if news is not None:
                block, info = news
                assert info.metadata['serial'] == 'lab-7'
                for role, messages in block.raw.items():
                    collected.setdefault(role, []).extend(messages)
        assert n_looks == 10
        sent = contents([session])
        assert collected.pop('accel') == sent.pop('/accel/counts')
        assert {f'/temperature/{name}': own for name, own in collected.items()} == sent

    def test_wrong_files_and_options_of_record_are_refused(self, tmp_path, session, cli):
        with pytest.raises(RecordingError, match='no such file'):
            next(growing_blocks(tmp_path / 'no.mcap', Topics(), lambda _: True))
        (tmp_path / 'text.mcap').write_text('hello, this is no bag')
        with pytest.raises(RecordingError, match=r'text\.mcap'):
            list(growing_blocks(tmp_path / 'text.mcap', Topics(), lambda _: False))
        out = ('-o', tmp_path / 'bags')
        printed = cli('record', session, '--soak', '45', *out, code=2).stderr
        assert "--soak: expected a duration like 45min, 1.5h or 30s, got '45'" in printed
        (tmp_path / 'file').write_text('')
        printed = cli('record', session, '-o', tmp_path / 'file', code=1).stderr
        assert 'cannot be written' in printed

    def test_a_bag_of_several_positions_is_split_into_a_bag_for_each(self, session, cli, tmp_path):
        options = ('--positions', f'{N_POSITIONS}', '--soak', '80s', '-o', tmp_path / 'bags')
        finished = cli('record', session, *options, '--json')
        result = json.loads(finished.stdout)
        check_positions(result)
        bags = numbered_bags(tmp_path / 'bags')
        assert [str(bag) for bag in bags] == result['bags']
        assert [bag.name for bag in bags] == [f'{k:02d}.mcap' for k in range(1, N_POSITIONS + 1)]
        assert contents(bags) == contents([session])
        assert f'position {N_POSITIONS}: good' in finished.stderr

    def test_a_second_run_of_record_continues_a_folder(self, cli, tmp_path):
        bags = tmp_path / 'bags'
        for number, part in enumerate((UPS[:2], UPS[2:3]), 1):
            bag = write_session(tmp_path / f'part{number}.mcap', part)
            words = ('--positions', '3', '--soak', '80s', '-o', bags, '--json')
            finished = cli('record', bag, *words, code=None)
            result = json.loads(finished.stdout)
            assert finished.returncode == (0 if result['is_complete'] else 1)
            assert result['n_good'] == (2, 3)[number - 1]
        assert len(numbered_bags(bags)) == 3
        other = ('record', bag, '-o', bags, '--serial', 'lab-8')
        assert '01.mcap is of unit lab-7, not lab-8' in cli(*other, code=1).stderr


def test_a_bag_left_by_a_crash_is_reported_and_completed(session, cli, tmp_path):
    bags = tmp_path / 'bags'
    words = ('-c', CRASH, session, bags, START_NS + 200 * 10**9)
    assert ran(sys.executable, *words).returncode == -signal.SIGKILL
    (left,) = leftovers(bags)
    assert leftovers(bags) == {left: 1}
    arguments = ('record', session, '--positions', '1', '--soak', '80s', '-o', bags)
    assert f'{left} is bag 1 of a crashed run; --finish' in cli(*arguments, code=None).stderr
    assert left.exists()
    for bag in numbered_bags(bags):
        bag.unlink()
    before = contents([left])
    cli(*arguments, '--finish', code=None)
    assert leftovers(bags) == {}
    first = bags / '01.mcap'
    assert contents([first]) == before
    with open_recording(first, require=()) as reader:
        assert reader.info.truncated is None
        assert reader.info.metadata['serial'] == 'lab-7'
    broken = bags / '.07.999999999-abcdef.partial.mcap'
    broken.write_bytes(b'no bag')
    assert 'the bag cannot be completed' in cli(*arguments, '--finish', code=None).stderr
    assert broken.exists()


class Recording:
    def __init__(self, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'thermo_comp', 'record', *map(str, arguments)], cwd=ROOT,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def wait_for(self, words):
        for line in self.process.stderr:
            if words in line:
                return
        raise AssertionError(f'it ended without: {words}')

    def end(self, number=None):
        if number is not None:
            self.process.send_signal(number)
        out, errors = self.process.communicate(timeout=120)
        assert 'Traceback' not in errors
        return self.process.returncode, json.loads(out), errors


@pytest.fixture
def play():
    pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
    from thermo_comp.ros.player import play

    return play


class TestLive:
    def test_a_driver_is_recorded_and_fitted(self, play, session, cli, tmp_path):
        bags = tmp_path / 'bags'
        options = ('--positions', f'{N_POSITIONS}', '--soak', '80s', '--serial', 'lab-7')
        recording = Recording(*options, '-o', bags, '--json')
        recording.wait_for('no publisher on /accel/counts or /imu/uncompensated')
        play(session, rate=0.0, wait_s=30.0)
        code, result, _ = recording.end()
        assert code == 0
        check_positions(result)
        assert len(numbered_bags(bags)) == N_POSITIONS
        # The recording ends when the last position is complete; no earlier message is missing.
        sent, got = contents([session]), contents(numbered_bags(bags))
        assert got.keys() == sent.keys()
        for topic, messages in got.items():
            assert messages == sent[topic][: len(messages)]
            assert len(messages) > 0.95 * len(sent[topic])
        check_fit({**result, 'command': result['command'].replace(str(bags), '.')}, cli, bags)

    @pytest.mark.slow
    def test_imu_messages_under_other_names_are_recorded_until_a_signal(self, play, tmp_path):
        n, force = 2000, 9.81 * UPS[0]
        stamps = START_NS + np.arange(n) * 20_000_000
        bag, bags = tmp_path / 'imu.mcap', tmp_path / 'bags'
        with BagWriter(bag) as writer:
            noise = np.random.default_rng(3).normal(0.0, 0.01, (n, 3))
            writer.write_imu('imu/uncompensated', stamps, force + noise, np.zeros(9))
            writer.write_temperature('temperature/board', stamps[::50], np.full(n // 50, 20.0))
        remap = ['-r', '__ns:=/left', '-r', 'imu/uncompensated:=imu/driver']
        topics = ('--topic', 'imu=/left/imu/driver', '--topic', 'board=/left/temperature/board')
        recording = Recording('--soak', '30s', *topics, '-o', bags, '--json')
        recording.wait_for('no publisher on /left/imu/driver')
        play(bag, rate=0.0, wait_s=30.0, ros_args=remap)
        recording.wait_for('position 1: good')
        code, result, printed = recording.end(signal.SIGTERM)
        assert (code, result['n_good'], result['is_complete']) == (0, 1, False), printed
        assert result['findings'][0] == 'positions missing: 17 of 18'
        assert contents(numbered_bags(bags)) == contents([bag])
        assert sorted(bags.iterdir()) == numbered_bags(bags)

    @pytest.mark.slow
    def test_a_topic_of_a_wrong_type_is_named(self, peer, tmp_path):
        from geometry_msgs.msg import PointStamped

        peer.node.create_publisher(PointStamped, 'accel/counts', 10)
        recording = Recording('-o', tmp_path / 'bags', '--json')
        recording.wait_for(
            '/accel/counts has the type geometry_msgs/msg/PointStamped, '
            'expected geometry_msgs/msg/Vector3Stamped'
        )
        code, result, _ = recording.end(signal.SIGINT)
        assert (code, result['bags'], result['command']) == (0, [], None)
