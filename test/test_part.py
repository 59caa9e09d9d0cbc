# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A command for a part of a bag gives the same results as for a bag of that part alone."""

import re
from dataclasses import replace

import numpy as np
import pytest
from position_helpers import GRAVITY, MG, START_NS, Rest

from thermo_comp.errors import FitError, RecordingError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.sources import fit_sources
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.topics import BagPart, Topics
from thermo_comp.recording.writer import BagWriter

OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2')


def bag_of(path, rest):
    stamp_ns = START_NS + np.rint(rest.time * 1e9).astype(np.int64)
    board_ns = START_NS + np.rint((rest.board_time - 3.0) * 1e9).astype(np.int64)
    with BagWriter(path) as writer:
        writer.write_imu('/imu/uncompensated', stamp_ns, rest.accel, np.zeros((len(stamp_ns), 9)))
        writer.write_temperature('/temperature/board', board_ns, rest.temperature(rest.board_time))
    return path


@pytest.fixture
def bag(rng, tmp_path):
    return bag_of(tmp_path / 'bag.mcap', Rest(rng, duration_s=120.0))


def part_of(path, begin=None, end=None, **options):
    topics = Topics(part=BagPart(begin, end))
    with open_recording(path, topics, require=('accel',)) as reader:
        return list(reader.blocks(**options)), reader.since_s


@pytest.mark.parametrize('n_messages', [8192, 100])
@pytest.mark.parametrize(('begin', 'end'), [(20.0, 50.0), (20.0, None), (None, 50.0)])
def test_a_part_contains_exactly_the_messages_inside(bag, begin, end, n_messages, monkeypatch):
    monkeypatch.setattr('thermo_comp.recording.blocks.BLOCK_MESSAGES', n_messages)
    blocks, since = part_of(bag, begin, end, raw=True)
    whole = read_recording(bag, require=()).columns
    time = (whole.accel_stamp_ns - START_NS) * 1e-9
    inside = (time >= (begin or 0.0)) & (time < (end or 1e3))
    np.testing.assert_array_equal(np.concatenate([b.accel for b in blocks]), whole.accel[inside])
    board = whole.temperatures['board']
    at = (board.stamp_ns - START_NS) * 1e-9
    own = (at >= (-9.0 if begin is None else begin)) & (at < (end or 1e3))
    got = np.concatenate([b.temperatures['board'].celsius for b in blocks])
    np.testing.assert_array_equal(got, board.celsius[own])
    assert since == (begin or 0.0)
    after = [np.sum(inside[:n]) for n in board.after[own]]
    begins = np.cumsum([0, *map(len, blocks)])
    places = [b.temperatures['board'].after + n for b, n in zip(blocks, begins, strict=False)]
    np.testing.assert_array_equal(np.concatenate(places), after)
    for block in blocks:
        assert sum(map(len, block.raw.values())) == block.n_messages
        assert all(len(raw.data) == raw.size.sum() for raw in block.raw.values())


def test_a_part_by_stamps_equals_a_part_by_seconds_and_needs_samples(bag):
    start = START_NS * 1e-9
    by_stamp, since = part_of(bag, start + 20.0, start + 50.0)
    by_time, _ = part_of(bag, 20, 50)
    assert since == pytest.approx(20.0)
    for stamped, other in zip(by_stamp, by_time, strict=True):
        np.testing.assert_array_equal(stamped.accel, other.accel)
    with pytest.raises(RecordingError, match=re.escape('no sample is in [500:]')) as refused:
        part_of(bag, 500.0)
    assert str(bag) in str(refused.value)
    assert 'which is 120.0 s' in str(refused.value)


@pytest.mark.parametrize(
    ('begin', 'end', 'reason'),
    [
        (5.0, 5.0, 'must end after its begin 5 s, got 5 s'),
        (-1.0, None, '0 s or a positive time'),
        (float('nan'), None, '0 s or a positive time'),
        (5.0, 1.7e9, 'or both as stamps'),
    ],
)
def test_impossible_bounds_of_a_part_are_refused(begin, end, reason):
    with pytest.raises(ValueError, match=reason):
        BagPart(begin, end)


def test_the_part_before_a_jump_is_fitted(rng, tmp_path):
    rest = Rest(rng)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=300.0)
    bag = bag_of(tmp_path / 'bag.mcap', rest)
    for begin in (None, 100.0):
        sources, kind = fit_sources([bag], Topics(part=BagPart(begin)))
        with pytest.raises(FitError, match=r'at 300\.0 s the sensor jumped'):
            fit(sources, OPTIONS)
    sources, kind = fit_sources([bag], Topics(part=BagPart(100.0, 299.0)))
    assert kind == 'imu'
    result = fit(sources, replace(OPTIONS))
    assert result.bags[0].n_samples == 199 * 25
    assert result.calibration.provenance.sources[0].name == 'bag.mcap[100:299]'


def test_a_jump_of_the_clock_does_not_change_a_part(rng, tmp_path):
    rest = Rest(rng, duration_s=120.0)
    path = bag_of(tmp_path / 'bag.mcap', rest)
    block = read_recording(path, require=()).columns
    with BagWriter(tmp_path / 'set.mcap') as writer:
        set_ns = block.accel_stamp_ns + np.where(rest.time >= 60.0, 10**17, 0)
        writer.write_imu('/imu/uncompensated', set_ns, block.accel, np.zeros((len(set_ns), 9)))
    topics = Topics(part=BagPart(30.0))
    with open_recording(tmp_path / 'set.mcap', topics, require=('accel',)) as reader:
        blocks = list(reader.blocks_on_one_clock())
    assert sum(map(len, blocks)) == 90 * 25
