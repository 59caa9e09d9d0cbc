# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a split recording together give the results of the whole recording."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders import ArrayBlock
from conftest import ROOT
from position_helpers import GRAVITY, MG, Rest
from position_helpers import START_NS as REST_NS

import thermo_comp
from thermo_comp.errors import FitError, RecordingError
from thermo_comp.fitting import FitOptions, FitSource, fit
from thermo_comp.fitting.joining import joined
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.fitting.sources import KnownForce, digest, fit_sources, parse_sections
from thermo_comp.judging.evaluation import evaluate
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.topics import BagPart, Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.gravity import MICRO_G

START_NS = 1_700_000_000_123_456_789
RATE_HZ = 100
LEVEL = np.array([10.0, -3000.0, 50.0])  # counts
DRIFT = np.array([1.0, 0.0, 0.5]) / 30.0  # counts per second
NOISE = 0.3  # white noise of a sample [counts]


def recorded(rng, seconds):
    """Record a rest in which the bias drifts by `DRIFT`, with two thermometers."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    accel = LEVEL + np.outer(time_s, DRIFT)
    accel += NOISE * rng.standard_normal(accel.shape)
    read_s = np.arange(0.0, seconds, 0.9)
    celsius = 20.0 + read_s / 60.0
    stamps = [START_NS + np.round(1e9 * seconds).astype(np.int64) for seconds in (time_s, read_s)]
    return ArrayBlock(stamps[0], accel, stamps[1], celsius, stamps[1], celsius + 1.0)


def cut(whole, edges_s, pause_s=0.0):
    edges = [START_NS, *(START_NS + round(1e9 * edge) for edge in edges_s), 2 * START_NS]
    parts = []
    for number, (begin, end) in enumerate(pairwise(edges)):
        later, arrays = round(1e9 * number * pause_s), []
        for name in ('accel', 'board', 'case'):
            stamps = getattr(whole, f'{name}_stamp_ns')
            rows = (stamps >= begin) & (stamps < end)
            arrays += [stamps[rows] + later, getattr(whole, name)[rows]]
        parts.append(ArrayBlock(*arrays))
    return parts


def reduced(blocks, **keys):
    return [
        reduce_source(FitSource(f'part{k}', lambda b=block: [b], **keys), full_scale=32767.0)
        for k, block in enumerate(blocks)
    ]


@pytest.mark.parametrize('edges_s', [(200.0,), (123.4, 250.7, 377.0)])
def test_parts_of_a_rest_have_the_windows_of_the_whole_rest(rng, edges_s):
    whole = recorded(rng, 600.0)
    (bag,) = reduced([whole])
    (rest,) = bag.intervals
    (again,) = joined(reduced(cut(whole, edges_s))[::-1])
    (continued,) = again.intervals
    assert (again.start_ns, again.end_ns) == (bag.start_ns, bag.end_ns)
    assert again.n_samples == bag.n_samples
    names = sorted(source.name for source in again.sources)
    assert names == [f'part{k}' for k in range(len(edges_s) + 1)]
    for name in ('board', 'case'):
        np.testing.assert_array_equal(getattr(again, name).stamp_ns, getattr(bag, name).stamp_ns)
        np.testing.assert_array_equal(getattr(again, name).value, getattr(bag, name).value)
    # At each cut less than one window of 10 s is lost.
    assert 0.0 <= rest.count.sum() - continued.count.sum() <= 10.0 * RATE_HZ * len(edges_s)
    assert np.all(np.diff(continued.time) > 0.0)
    # The means of windows differ from the drift by less than five sd of their noise.
    line = LEVEL + np.outer(continued.time, DRIFT)
    sd = NOISE / np.sqrt(continued.count)[:, None]
    assert np.abs((continued.mean - line) / sd).max() < 5.0
    np.testing.assert_allclose(continued.sample_sd, NOISE, rtol=0.05)


def test_recordings_that_are_not_parts_of_one_are_not_joined(rng):
    whole = recorded(rng, 400.0)
    # A pause of up to 60 s joins two parts; in a longer pause the unit may have restarted.
    for pause_s, n in ((1.0, 1), (50.0, 1), (61.0, 2)):
        assert len(joined(reduced(cut(whole, (200.0,), pause_s=pause_s)))) == n
    known = KnownForce('part', parse_sections('0 400 2.0'))
    assert len(joined(reduced(cut(whole, (200.0,)), force=known))) == 2
    short = recorded(rng, 2.0)
    assert len(joined(reduced([short, short]))) == 2
    # The two recordings have equal stamps; each first part is joined with its own second part.
    parts = [*cut(whole, (200.0,)), *cut(replace(whole, accel=-whole.accel), (200.0,))[::-1]]
    first, second = joined(reduced(parts))
    assert len(first.intervals) == len(second.intervals) == 1
    before, after = cut(whole, (200.0,))
    assert len(joined(reduced([before], serial='a') + reduced([after], serial='b'))) == 2


def test_a_move_between_parts_gives_two_rests_and_parts_without_a_rest_are_joined(rng):
    before, after = cut(recorded(rng, 600.0), (300.0,))
    shaken = replace(after, accel=1e3 * rng.standard_normal(after.accel.shape))
    parts = reduced([before, shaken])
    assert not parts[1].intervals
    (bag,) = joined(parts)
    assert (len(bag.intervals), bag.n_samples) == (1, 60_000)
    assert parts[1].restless
    assert not bag.restless
    sources = [part.source for part in parts]
    assert len(fit(sources, FitOptions(gravity=9.80665, groups=('curve',))).positions) == 1
    with pytest.raises(FitError, match='part1: '):
        fit(sources[1:], FitOptions(gravity=9.80665))
    before, after = cut(recorded(rng, 600.0), (300.0,))
    moved = replace(after, accel=after.accel + np.array([0.0, 1.0, 0.0]))
    (bag,) = joined(reduced([before, moved]))
    first, second = bag.intervals
    assert first.time[-1] < 300.0 < second.time[0]
    # WHY: the second rest began at 0 s, so windows of `evaluate` were up to half a window off.
    assert second.begin_s == pytest.approx(second.time[0] - 0.5 * bag.window_s, abs=0.01)


@pytest.mark.slow
def test_a_split_recording_gives_the_calibration_of_the_whole_recording():
    # WHY: each part had its own turn-on and lag states, so the claimed sd was 6 times too large.
    bag = thermo_comp.read(ROOT / 'bags/fit/01.mcap')
    parts = []
    for begin_s in np.arange(0.0, bag.time_s[-1], 1800.0):
        readings = {}
        for name, (time_s, celsius) in bag.temperatures.items():
            use = (time_s >= begin_s) & (time_s < begin_s + 1800.0)
            readings[name] = time_s[use], celsius[use]
        use = (bag.time_s >= begin_s) & (bag.time_s < begin_s + 1800.0)
        part = replace(bag, time_s=bag.time_s[use], counts=bag.counts[use])
        parts.append(replace(part, temperatures=readings, name=f'{begin_s:g} s'))
    options = {'gravity': 9.80665, 'groups': ('curve', 'board')}
    whole, split = (thermo_comp.fit(bags, **options) for bags in (bag, parts))
    assert len(split.provenance.sources) == len(parts)
    difference = np.subtract(*(
        unit.correct(bag.time_s, bag.counts, **bag.temperatures).specific_force
        for unit in (whole, split)
    ))  # fmt: skip
    # Each part loses 30 s at its end; 1.2 ug is the noise of a mean over 60 s.
    assert np.nanstd(difference, axis=0).max() < 1.2 * MICRO_G


@pytest.mark.slow
def test_evaluate_and_report_take_the_parts_as_one_recording(tmp_path, rng, cli):
    paths, topics = [], Topics()
    for number, part in enumerate(cut(recorded(rng, 900.0), (450.0,))):
        paths.append(tmp_path / f'part{number}.mcap')
        with BagWriter(paths[-1], metadata={'serial': 'U1'}) as writer:
            writer.write_temperature(topics.board, part.board_stamp_ns, part.board)
            writer.write_temperature(topics.case, part.case_stamp_ns, part.case)
            writer.write_counts(topics.counts, part.accel_stamp_ns, part.accel)
    calibration = thermo_comp.fit(paths, gravity=9.80665)
    assert [source.sha256 for source in calibration.provenance.sources] == list(map(digest, paths))
    result = evaluate(paths, [('unit', calibration)])
    (bag,) = result.bags
    assert bag.source.name == 'part0.mcap .. part1.mcap'
    # 900 s have 15 windows of 60 s; two windows may be lost at the cut.
    assert len(result.judgements['unit'].windows) >= 13
    thermo_comp.save(calibration, tmp_path / 'unit.yaml')
    errors = cli('evaluate', *paths, '-c', tmp_path / 'unit.yaml').stderr
    assert 'part0.mcap .. part1.mcap: 2 bags of one recording, joined' in errors
    page = tmp_path / 'unit.html'
    cli('report', *paths, '-c', tmp_path / 'unit.yaml', '-o', page)
    text = page.read_text()
    assert all(path.name in text and digest(path) in text for path in paths)


OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2')


def bag_of(path, rest):
    stamp_ns = REST_NS + np.rint(rest.time * 1e9).astype(np.int64)
    board_ns = REST_NS + np.rint((rest.board_time - 3.0) * 1e9).astype(np.int64)
    with BagWriter(path) as writer:
        writer.write_imu('/imu/uncompensated', stamp_ns, rest.accel, np.zeros((len(stamp_ns), 9)))
        writer.write_temperature('/temperature/board', board_ns, rest.temperature(rest.board_time))
    return path


@pytest.fixture
def bag(rng, tmp_path):
    return bag_of(tmp_path / 'bag.mcap', Rest(rng, duration_s=120.0))


def part_of(path, begin=None, end=None, **options):
    with open_recording(path, Topics(part=BagPart(begin, end)), require=('accel',)) as reader:
        return list(reader.blocks(**options)), reader.since_s


@pytest.mark.parametrize('n_messages', [8192, 100])
@pytest.mark.parametrize(('begin', 'end'), [(20.0, 50.0), (20.0, None), (None, 50.0)])
def test_a_part_contains_exactly_the_messages_inside(bag, begin, end, n_messages, monkeypatch):
    monkeypatch.setattr('thermo_comp.recording.blocks.BLOCK_MESSAGES', n_messages)
    blocks, since = part_of(bag, begin, end, raw=True)
    whole = read_recording(bag, require=()).columns
    time = (whole.accel_stamp_ns - REST_NS) * 1e-9
    inside = (time >= (begin or 0.0)) & (time < (end or 1e3))
    np.testing.assert_array_equal(np.concatenate([b.accel for b in blocks]), whole.accel[inside])
    board = whole.temperatures['board']
    at = (board.stamp_ns - REST_NS) * 1e-9
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


def test_a_part_by_stamps_equals_a_part_by_seconds_also_after_a_jump_of_the_clock(bag, tmp_path):
    start = REST_NS * 1e-9
    by_stamp, since = part_of(bag, start + 20.0, start + 50.0)
    by_time, _ = part_of(bag, 20, 50)
    assert since == pytest.approx(20.0)
    for stamped, other in zip(by_stamp, by_time, strict=True):
        np.testing.assert_array_equal(stamped.accel, other.accel)
    with pytest.raises(RecordingError, match=re.escape('no sample is in [500:]')) as refused:
        part_of(bag, 500.0)
    assert str(bag) in str(refused.value)
    assert 'which is 120.0 s' in str(refused.value)
    block = read_recording(bag, require=()).columns
    jump_ns = np.where(block.accel_stamp_ns >= REST_NS + 60 * 10**9, 10**17, 0)
    with BagWriter(tmp_path / 'set.mcap') as writer:
        set_ns = block.accel_stamp_ns + jump_ns
        writer.write_imu('/imu/uncompensated', set_ns, block.accel, np.zeros((len(set_ns), 9)))
    topics = Topics(part=BagPart(30.0))
    with open_recording(tmp_path / 'set.mcap', topics, require=('accel',)) as reader:
        assert sum(map(len, reader.blocks_on_one_clock())) == 90 * 25


@pytest.mark.parametrize(
    ('begin', 'end', 'reason'),
    [
        (5.0, 5.0, 'must end after its begin 5 s, got 5 s'), (5.0, 1.7e9, 'or both as stamps'),
        *((begin, None, '0 s or a positive time') for begin in (-1.0, float('nan'))),
    ],
)  # fmt: skip
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
