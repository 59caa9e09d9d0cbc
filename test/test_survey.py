# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A survey of a recording reports data that a fit needs and that are missing or faulty."""

import numpy as np
import pytest

from thermo_comp.recording.overview import survey_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter

TOPICS = Topics()
START_NS = 1_767_225_600_000_000_000


def survey(path, temperature, *, gap_s=0.0, noise=0.5, case=True, backwards=False):
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
            if case:
                writer.write_temperature(TOPICS.case, readings, temperature)
        log_ns = np.maximum.accumulate(stamps)
        counts = np.array([0.0, 0.0, 3000.0]) + noise * rng.standard_normal((n, 3))
        writer.write_counts(TOPICS.counts, stamps, counts, log_ns=log_ns)
    return survey_recording(path)


def up_and_down(low, high):
    seconds = np.arange(3600.0)
    return np.interp(seconds, [0, 600, 1800, 2400, 3600], [low, low, high, high, low])


def test_a_good_recording_has_no_findings(tmp_path):
    result = survey(tmp_path / 'bag', up_and_down(5.0, 35.0))
    assert result.findings == []
    assert result.n == 18000
    assert result.rate_hz == pytest.approx(5.0)
    assert result.n_still == 1
    assert result.still_s == pytest.approx(3600.0, abs=15.0)
    board = result.thermometers['board']
    assert (board.lowest, board.highest) == (5.0, 35.0)
    # The temperature rises and falls by 30 K in 20 minutes.
    assert board.steepest_heating_k_min == pytest.approx(1.5, rel=0.01)
    assert board.steepest_cooling_k_min == pytest.approx(-1.5, rel=0.01)


@pytest.mark.parametrize(
    ('temperature', 'options', 'text'),
    [
        (up_and_down(20.0, 24.0), {}, ['spans 4.0 K: 25 K or more are advised']),
        (up_and_down(10.0, 28.0), {}, ['spans 18.0 K: 25 K or more are advised']),
        (up_and_down(5e3, 35e3), {},
         [f'{name} reads 5000 .. 3.5e+04: this is not in degC' for name in ('board', 'case')]),
        (up_and_down(278.0, 308.0), {},
         [f'temperature/{name} reads 278 .. 308 degC: that looks like kelvins'
          for name in ('board', 'case')]),
        (None, {}, ['no board temperature', 'no case temperature']),
        (up_and_down(5.0, 35.0), {'gap_s': 30.0, 'backwards': True},
         ['gaps between samples: 1, the longest 30.2 s',
          'samples with a stamp not later than an earlier stamp: 1; these samples are left out']),
    ],
)  # fmt: skip
def test_faults_of_a_recording_are_reported(tmp_path, temperature, options, text):
    findings = survey(tmp_path / 'bag', temperature, **options).findings
    assert [part for part in text if not any(part in found for found in findings)] == []


@pytest.mark.parametrize(
    ('back_s', 'text'),
    [
        (600.0, 'an earlier stamp: 3000; these'),
        (7200.0, 'than an hour (1 times): a fit takes each jump'),
    ],
)
def test_samples_after_a_backward_jump_of_the_clock_are_counted(tmp_path, back_s, text):
    # WHY: if the clock jumps back by 10 min, a fit leaves out 10 min; the survey counted 1 sample.
    result = survey(tmp_path / 'bag', up_and_down(5.0, 35.0), gap_s=-back_s)
    assert any(text in finding for finding in result.findings)


def test_a_missing_cooling_ramp_is_reported(tmp_path):
    heating = np.interp(np.arange(3600.0), [0, 600, 3000, 3600], [5.0, 5.0, 35.0, 35.0])
    findings = survey(tmp_path / 'bag', heating).findings
    assert findings == [
        'no cooling ramp: cooling will be corrected by extrapolation; record a ramp'
    ]


def test_steps_of_a_coarse_thermometer_are_not_taken_for_ramps(tmp_path):
    # Readings in steps of 1 K alternate between two values, which is no ramp of 60 K/min.
    flips = 20.0 + (np.arange(3600) % 2)
    result = survey(tmp_path / 'bag', flips)
    board = result.thermometers['board']
    assert board.quantum == 1.0
    assert board.steepest_heating_k_min < 0.1


def test_a_recording_without_samples_is_surveyed(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_temperature(TOPICS.board, [START_NS], [20.0])
    result = survey_recording(tmp_path / 'bag')
    assert result.n == 0
    assert any('no accelerometer samples' in f for f in result.findings)
