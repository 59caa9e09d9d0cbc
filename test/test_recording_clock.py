# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A jump of a recording's clock is shortened to an hour; a clock that jumps often is refused."""

from contextlib import suppress

import numpy as np
import pytest

from thermo_comp.errors import RecordingError
from thermo_comp.recording.blocks import LONGEST_PAUSE_NS
from thermo_comp.recording.overview import survey_recording
from thermo_comp.recording.reader import open_recording
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
    blocks = blocks_of(
        tmp_path / 'bag.mcap', true_ns + jump_ns * after, (true_ns + jump_ns * after)[::100]
    )
    # At equal log times readings precede samples: the sixth reading is the first after the jump.
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


def test_a_clock_that_jumps_repeatedly_is_refused(tmp_path):
    stamp_ns = START_NS + YEAR_NS * (np.arange(400) % 2)
    with pytest.raises(RecordingError, match=r'bag\.mcap: .* jumps by more than an hour'):
        blocks_of(tmp_path / 'bag.mcap', stamp_ns, stamp_ns[::10])


def test_a_recording_with_one_message_per_hour_is_refused(tmp_path):
    stamp_ns = START_NS + LONGEST_PAUSE_NS * np.arange(400)
    with pytest.raises(RecordingError, match=r'messages stamped over \d+ days'):
        blocks_of(tmp_path / 'bag.mcap', stamp_ns, stamp_ns[::10])


@pytest.mark.parametrize(('zone_s', 'n'), [(3600, 40000), (-3600, 1000), (1800, 1000), (20, 1000)])
def test_thermometers_with_stamps_of_another_time_zone_are_reported(tmp_path, zone_s, n):
    # WHY: `replay` corrected samples with the temperatures of another hour, without a warning.
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
