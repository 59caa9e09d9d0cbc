# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of tables with numbers only are recognised by content, or the user is asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermo_comp.convert.column_map import guess_columns, spoken_columns, table_log
from thermo_comp.convert.log import write_log
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording
from thermo_comp.simulation.campaign import positions

UP = np.repeat([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], 400, axis=0)


def write(path: Path, rng: np.random.Generator, unit: float, **columns: np.ndarray) -> Path:
    """Write three rests with other data before and after."""
    accel = unit * (UP + 0.002 * rng.standard_normal(UP.shape))
    parts = [columns['time'][:, None]] if 'time' in columns else []
    parts += [accel, columns['rate']] if 'rate' in columns else [accel]
    np.savetxt(path, np.hstack(parts), fmt='%.9g')
    return path


@pytest.mark.parametrize(
    ('unit', 'said'), [(9.80665, 'm/s^2'), (1.0, 'g'), (1000.0, 'mg'), (4096.0, 'counts')]
)
def test_the_unit_is_that_of_gravity(
    tmp_path: Path, rng: np.random.Generator, unit: float, said: str
) -> None:
    path = write(tmp_path / 'log.txt', rng, unit, time=0.01 * np.arange(len(UP)))
    columns = guess_columns(path)
    assert spoken_columns(columns) == f'time [s], x y z [{said}]'
    log = table_log(path, columns)
    assert log.input == ('counts' if said == 'counts' else 'imu')
    write_log(log, tmp_path / 'bag.mcap')
    force = read_recording(tmp_path / 'bag.mcap', require=('accel',)).columns.accel
    expected = unit if said == 'counts' else 9.80665
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), expected, rtol=0.02)


@pytest.mark.parametrize(
    ('step', 'unit', 'rate_hz'),
    [(0.01, 's', 100), (5.0, 'ms', 200), (10000.0, 'us', 100), (5e6, 'ns', 200)],
)
def test_the_unit_of_times_is_that_of_a_sample_rate(
    tmp_path: Path, rng: np.random.Generator, step: float, unit: str, rate_hz: int
) -> None:
    path = write(tmp_path / 'log.txt', rng, 9.8, time=step * np.arange(1, len(UP) + 1))
    columns = guess_columns(path)
    assert columns.stamp.unit == unit
    np.testing.assert_array_equal(np.diff(table_log(path, columns).stamp_ns), 10**9 // rate_hz)


def test_a_second_is_told_from_a_millisecond_by_how_fast_a_hand_turns(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    # WHY: samples at 1 Hz were taken for 1 kHz. Half a turn takes 1 s or 0.8 s.
    angle = np.repeat([0.0, np.pi, 0.0], [400, 800, 400])
    ramp = np.clip((np.arange(1600) - 400) / 800, 0.0, 1.0) * np.pi
    for turned, unit in ((angle, 's'), (ramp, 'ms')):
        up = np.column_stack((np.cos(turned), np.sin(turned), 0.0 * turned))
        accel = 9.8 * (up + 0.002 * rng.standard_normal(up.shape))
        path = tmp_path / f'{unit}.txt'
        np.savetxt(path, np.column_stack((np.arange(1600.0), accel)), fmt='%.9g')
        assert guess_columns(path).stamp.unit == unit


@pytest.mark.parametrize(('rest_s', 'gap_s'), [(30, 0), (30, 670), (60, 1), (45, 3)])
def test_short_rests_at_1_hz_tell_their_unit(
    tmp_path: Path, rng: np.random.Generator, rest_s: int, gap_s: int
) -> None:
    # WHY: cells of 30 and more samples contained two rests, whose mean is shorter than gravity.
    ups = positions(18, 1)
    accel = np.repeat(ups, rest_s, axis=0) + 2e-5 * rng.standard_normal((18 * rest_s, 3))
    times = (np.arange(18)[:, None] * (rest_s + gap_s) + np.arange(rest_s)).ravel()
    path = tmp_path / 'log.txt'
    np.savetxt(path, np.column_stack((times, 9.8 * accel)), fmt='%.9g')
    columns = guess_columns(path)
    assert spoken_columns(columns) == 'time [s], x y z [m/s^2]'
    write_log(table_log(path, columns), tmp_path / 'bag.mcap')


@pytest.mark.parametrize(('fastest', 'unit'), [(3.0, 'rad/s'), (170.0, 'deg/s')])
def test_a_hand_s_turns_tell_the_unit_of_the_rate(
    tmp_path: Path, rng: np.random.Generator, fastest: float, unit: str
) -> None:
    rate = np.linspace(-fastest, fastest, 3 * len(UP)).reshape(-1, 3)
    path = write(tmp_path / 'log.txt', rng, 9.8, rate=rate)
    columns = guess_columns(path, 100.0)
    assert spoken_columns(columns) == f'100 Hz, x y z [m/s^2], angular rate x y z [{unit}]'
    expected = rate if unit == 'rad/s' else np.radians(rate)
    gyro = table_log(path, columns).gyro
    assert gyro is not None
    np.testing.assert_allclose(gyro, expected, atol=1e-6)


def test_what_does_not_tell_itself_is_asked_for(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / 'log.txt'
    time = 0.01 * np.arange(len(UP))
    with pytest.raises(RecordingError, match='it has no times: give --rate-hz'):
        guess_columns(write(path, rng, 9.8))
    with pytest.raises(RecordingError, match='its first column has the times'):
        guess_columns(write(path, rng, 9.8, time=time), 100.0)
    with pytest.raises(RecordingError, match='is not a rising time'):
        guess_columns(write(path, rng, 9.8, time=time[::-1]))
    with pytest.raises(RecordingError, match=r'not gravity in any known unit: give a column map'):
        guess_columns(write(path, rng, 3.3, time=time))
    path.write_text('t,a,b,c\n' + '0,0,0,9.8\n' * 100)
    with pytest.raises(RecordingError, match='its headings name no accelerometer'):
        guess_columns(path)
    path.write_text('0 0 0 9.8 20\n' * 100)
    with pytest.raises(RecordingError, match='5 columns without headings cannot be identified'):
        guess_columns(path)
