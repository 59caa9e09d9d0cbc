# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
``thermo_comp partial``: a recording says what it can, in words and in JSON, and makes no file.

"""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from pose_helpers import GRAVITY, MG, START_NS, Rest
from thermo_comp.fitting.one_pose import PoseOptions
from thermo_comp.fitting.partial import recording_source, tell

from thermo_comp.cli.app import run
from thermo_comp.errors import FitError, RecordingError
from thermo_comp.recording import BagWriter
from thermo_comp.simulation import positions


@pytest.fixture
def cli(capsys):
    """Run the command line in this process: the starts of many would be the slowest part."""

    def command(*arguments, code=0):
        assert run([*map(str, arguments)]) == code
        return SimpleNamespace(**dict(zip(('stdout', 'stderr'), capsys.readouterr(), strict=True)))

    return command


def write(path, time, accel, board=None):
    stamp_ns = START_NS + np.rint(np.asarray(time) * 1e9).astype(np.int64)
    with BagWriter(path) as bag:
        bag.write_imu('imu/uncompensated', stamp_ns, accel, np.zeros((len(accel), 9)), 'imu')
        if board is not None:
            at, celsius = board
            board_ns = START_NS + np.rint(at * 1e9).astype(np.int64)
            bag.write_temperature('temperature/board', board_ns, celsius)
    return path


def write_rest(path, rest):
    return write(path, rest.time, rest.accel, (rest.board_time, rest.temperature(rest.board_time)))


def write_positions(path, rng, n=12):
    """Hold a triad with bias (0.1, -0.2, 0.3) m/s^2 in n attitudes, moved in between."""
    parts = []
    for up in positions(n, 3):
        still = GRAVITY * up + (0.1, -0.2, 0.3) + 0.02 * rng.standard_normal((500, 3))
        parts += [still, GRAVITY * rng.standard_normal((100, 3))]
    accel = np.concatenate(parts)
    return write(path, np.arange(len(accel)) / 100.0, accel)


def test_whole_rest_in_words_and_json(tmp_path, rng, cli):
    rest = Rest(rng)
    rest.accel[:, 2] += 1.5 * MG * (rest.temperature(rest.time) - 20.0)
    bag = write_rest(tmp_path / 'rest.mcap', rest)
    said = cli('partial', bag, '--gravity', str(GRAVITY)).stdout
    assert 'for this attitude only' in said
    assert 'mg from gravity' in said
    found = json.loads(cli('partial', bag, '--json').stdout)
    assert found['events'] == []
    (branch,) = found['branches']
    assert branch['level_from_gravity_mg'] is None
    assert branch['coefficients_mg'][0] == pytest.approx(1.5, abs=0.3)


def test_jump_refuses_the_whole(tmp_path, rng, cli):
    rest = Rest(rng, fall=30.0)
    rest.add((0.0, 0.0, 25.0 * MG), from_s=250.0)
    bag = write_rest(tmp_path / 'rest.mcap', rest)
    refused = cli('partial', bag, code=1)
    assert refused.stdout == ''
    assert 'the sensor jumped by +2' in refused.stderr
    assert 'not a function of temperature' in refused.stderr
    found = json.loads(cli('partial', bag, '--branches', '--json').stdout)
    assert len(found['branches']) == 2
    assert found['events'][0]['kind'] == 'jump'
    (part,) = json.loads(cli('partial', bag, '--to', '240', '--json').stdout)['branches']
    assert part['end_s'] <= 240.0


def test_small_span_says_so_and_changes_nothing(tmp_path, rng, cli):
    bag = write_rest(tmp_path / 'rest.mcap', Rest(rng, fall=1.0))
    refused = cli('partial', bag, code=1)
    assert 'is too small, need 3' in refused.stderr
    assert 'is too small, need 3' in cli('partial', bag, '--branches', code=1).stdout
    assert [path.name for path in tmp_path.iterdir()] == ['rest.mcap']


def test_many_attitudes_without_temperature(tmp_path, rng, cli):
    bag = write_positions(tmp_path / 'hand.mcap', rng)
    refused = cli('partial', bag, code=1)
    assert 'need local gravity' in refused.stderr
    said = cli('partial', bag, '--gravity', str(GRAVITY)).stdout
    assert '12 positions' in said
    assert 'is no calibration' in said
    found = json.loads(cli('partial', bag, '--gravity', str(GRAVITY), '--json').stdout)
    # 12 windows of 5 s: the noise of 2 mg averages to micro-g, the bias to a mm/s^2 or so.
    np.testing.assert_allclose(found['bias'], (0.1, -0.2, 0.3), atol=0.005)
    np.testing.assert_allclose(found['scale'], 1.0, atol=0.001)


def test_wrong_part_of_a_recording(tmp_path, rng, cli):
    bag = write_rest(tmp_path / 'rest.mcap', Rest(rng, duration_s=60.0))
    assert (
        '`begin_s` must be before'
        in cli('partial', bag, '--from', '9', '--to', '3', code=2).stderr
    )


def test_library_says_the_same(tmp_path, rng):
    bag = write_rest(tmp_path / 'rest.mcap', Rest(rng))
    assert tell(bag, PoseOptions()).fits[0].model.order == 2
    still = write_rest(tmp_path / 'still.mcap', Rest(rng, fall=1.0))
    with pytest.raises(FitError, match='too small'):
        tell(still, PoseOptions())
    with pytest.raises(RecordingError):
        recording_source(tmp_path / 'nothing.mcap')
