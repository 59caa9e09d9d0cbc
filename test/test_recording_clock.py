# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of a recording's clock are shortened; a survey reports missing and wrong data."""

from contextlib import suppress

import numpy as np
import pytest

from thermo_comp.errors import RecordingError
from thermo_comp.recording.blocks import LONGEST_PAUSE_NS
from thermo_comp.recording.overview import survey_recording
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter

START_NS = 1_700_000_000_000_000_000
YEAR_NS = 365 * 86400 * 10**9
STEP_NS = 10_000_000


def blocks_of(path, stamp_ns, reading_ns):
    """Write samples and readings with the given stamps, and read them with jumps shortened."""
    n = len(stamp_ns)
    log_ns = START_NS + STEP_NS * np.arange(n)
    with BagWriter(path) as bag:
        xyz = np.column_stack([np.arange(n)] * 3)
        bag.write_counts('accel/counts', stamp_ns, xyz, log_ns=log_ns)
        every = n // len(reading_ns)
        for topic in ('temperature/board', 'temperature/case'):
            bag.write_temperature(topic, reading_ns, 0.0 * reading_ns, log_ns=log_ns[::every])
    with open_recording(path) as reader:
        return list(reader.blocks_on_one_clock())


def joined(blocks, name):
    if name == 'accel':
        return np.concatenate([block.accel_stamp_ns for block in blocks])
    return np.concatenate([block.temperatures[name].stamp_ns for block in blocks])


@pytest.mark.parametrize('jump_ns', [YEAR_NS, -YEAR_NS, -START_NS + 5, 2 * LONGEST_PAUSE_NS])
def test_a_jump_becomes_an_hour_and_other_intervals_stay(tmp_path, jump_ns):
    true_ns = START_NS + STEP_NS * np.arange(1000)
    after = np.arange(1000) >= 500
    stamp_ns = true_ns + jump_ns * after
    blocks = blocks_of(tmp_path / 'bag.mcap', stamp_ns, stamp_ns[::100])
    # At equal log times readings precede samples: the first message after the jump is a reading.
    hour = LONGEST_PAUSE_NS * after
    offsets = joined(blocks, 'accel') - true_ns
    assert offsets[:500].tolist() == [0] * 500
    steps = np.diff(joined(blocks, 'accel'))
    assert np.delete(steps, 499).tolist() == [STEP_NS] * 998
    assert abs(int(steps[499]) - LONGEST_PAUSE_NS) <= STEP_NS
    for role in ('board', 'case'):
        moved = joined(blocks, role) - true_ns[::100]
        assert np.abs(moved - hour[::100]).max() <= STEP_NS


def test_a_recording_without_a_jump_is_unchanged(tmp_path):
    stamp_ns = START_NS + np.cumsum(np.tile([STEP_NS, 10**9, LONGEST_PAUSE_NS, -(10**9)], 50))
    blocks = blocks_of(tmp_path / 'bag.mcap', stamp_ns, stamp_ns[::10])
    assert joined(blocks, 'accel').tolist() == stamp_ns.tolist()
    assert joined(blocks, 'board').tolist() == stamp_ns[::10].tolist()


@pytest.mark.parametrize(
    ('since_ns', 'text'),
    [
        (YEAR_NS * (np.arange(400) % 2), r'bag\.mcap: .* jumps by more than an hour'),
        (LONGEST_PAUSE_NS * np.arange(400), r'messages stamped over \d+ days'),
    ],
)
def test_a_clock_that_jumps_repeatedly_or_a_message_per_hour_is_refused(tmp_path, since_ns, text):
    stamp_ns = START_NS + since_ns
    with pytest.raises(RecordingError, match=text):
        blocks_of(tmp_path / 'bag.mcap', stamp_ns, stamp_ns[::10])


@pytest.mark.parametrize(('zone_s', 'n'), [(3600, 40000), (-3600, 1000), (1800, 1000), (20, 1000)])
def test_thermometers_with_stamps_of_another_time_zone_are_reported(tmp_path, zone_s, n):
    true_ns = START_NS + STEP_NS * np.arange(n)
    text = f'board readings are stamped {zone_s:+} s from the samples around them: do the stamps'
    with suppress(RecordingError):
        blocks_of(tmp_path / 'bag.mcap', true_ns, true_ns[:: n // 100] + zone_s * 10**9)
    survey = survey_recording(tmp_path / 'bag.mcap')
    assert text in (survey.info.chosen or '')
    assert 'a fit needs one clock for the stamps of all topics' in survey.findings


def test_unstamped_samples_with_stamped_temperatures_are_reported(tmp_path):
    # WHY: for samples stamped 0 s the message blamed the clock of the thermometers.
    true_ns = START_NS + STEP_NS * np.arange(1000)
    with pytest.raises(RecordingError, match='stamped 0 s: the driver does not stamp them'):
        blocks_of(tmp_path / 'bag.mcap', 0 * true_ns, true_ns[::10])


TOPICS = Topics()


def survey(path, temperature, *, gap_s=0.0, backwards=False):
    rng = np.random.default_rng(5)
    n = 18000
    stamps = START_NS + (np.arange(n) + 1) * 200_000_000
    stamps[n // 2 :] += round(gap_s * 1e9)
    if backwards:
        stamps[100] = stamps[98]
    with BagWriter(path) as writer:
        if temperature is not None:
            readings = START_NS + np.arange(len(temperature)) * 10**9
            writer.write_temperature(TOPICS.board, readings, temperature)
            writer.write_temperature(TOPICS.case, readings, temperature)
        log_ns = np.maximum.accumulate(stamps)
        counts = np.array([0.0, 0.0, 3000.0]) + 0.5 * rng.standard_normal((n, 3))
        writer.write_counts(TOPICS.counts, stamps, counts, log_ns=log_ns)
    return survey_recording(path)


def up_and_down(low, high):
    return np.interp(np.arange(3600.0), [0, 600, 1800, 2400, 3600], [low, low, high, high, low])


def test_a_survey_finds_no_fault_in_a_good_bag_and_the_duration_is_the_span_of_stamps(tmp_path):
    result = survey(tmp_path / 'bag', up_and_down(5.0, 35.0))
    assert (result.findings, result.n, result.rate_hz) == ([], 18000, pytest.approx(5.0))
    assert (result.n_still, result.still_s) == (1, pytest.approx(3600.0, abs=15.0))
    board = result.thermometers['board']
    assert (board.lowest, board.highest) == (5.0, 35.0)
    assert board.steepest_heating_k_min == pytest.approx(1.5, rel=0.01)
    assert board.steepest_cooling_k_min == pytest.approx(-1.5, rel=0.01)
    # WHY: the duration was the stamp of the last sample less that of the first: -0.2 s.
    result = survey(tmp_path / 'back', up_and_down(5.0, 35.0), gap_s=-3600.0)
    assert result.duration_s == pytest.approx(3600.0, abs=1.0)
    assert result.still_s <= result.duration_s
    with BagWriter(tmp_path / 'empty') as writer:
        writer.write_temperature(TOPICS.board, [START_NS], [20.0])
    result = survey_recording(tmp_path / 'empty')
    assert result.n == 0
    assert any('no accelerometer samples' in f for f in result.findings)
    board = survey(tmp_path / 'flips', 20.0 + (np.arange(3600) % 2)).thermometers['board']
    assert board.quantum == 1.0
    assert board.steepest_heating_k_min < 0.1


@pytest.mark.parametrize(
    ('temperature', 'options', 'text'),
    [
        (up_and_down(20.0, 24.0), {}, ['spans 4.0 K: 25 K or more are advised']),
        (up_and_down(10.0, 28.0), {}, ['spans 18.0 K: 25 K or more are advised']),
        (np.interp(np.arange(3600.0), [0, 600, 3000], [5.0, 5.0, 35.0]), {},
         ['no cooling ramp: cooling will be corrected by extrapolation; record a ramp']),
        (up_and_down(5e3, 35e3), {},
         [f'{name} reads 5000 .. 3.5e+04: this is not in degC' for name in ('board', 'case')]),
        (up_and_down(278.0, 308.0), {},
         [f'temperature/{name} reads 278 .. 308 degC: that looks like kelvins'
          for name in ('board', 'case')]),
        (None, {}, ['no board temperature', 'no case temperature']),
        (up_and_down(5.0, 35.0), {'gap_s': 30.0, 'backwards': True},
         ['gaps between samples: 1, the longest 30.2 s',
          'samples with a stamp not later than an earlier stamp: 1; these samples are left out']),
        # WHY: after a clock jumped back, a fit left out 3000 samples; the survey stated 1 sample.
        (up_and_down(5.0, 35.0), {'gap_s': -600.0}, ['an earlier stamp: 3000; these']),
        (up_and_down(5.0, 35.0), {'gap_s': -7200.0},
         ['than an hour (1 times): a fit takes each jump']),
    ],
)  # fmt: skip
def test_faults_of_a_recording_are_reported(tmp_path, temperature, options, text):
    findings = survey(tmp_path / 'bag', temperature, **options).findings
    assert [part for part in text if not any(part in found for found in findings)] == []
