# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The conversion of a table writes or counts each row, and does not change values."""

import json

import numpy as np
import pytest
import yaml
from conftest import ROOT

from thermo_comp.convert.column_map import ColumnMap, load_column_map, table_log
from thermo_comp.convert.log import Readings, write_log
from thermo_comp.errors import RecordingError, ThermoCompError
from thermo_comp.recording.reader import read_recording
from thermo_comp.unit.gravity import STANDARD_GRAVITY
from thermo_comp.unit.schema import build


def table(path, n=400, scale=1.0):
    """Write a log of a unit at rest; temperature cells repeat the last reading."""
    rng = np.random.default_rng(1)
    columns = {'ms': 1000 + 10 * np.arange(n)}
    for axis, up in (('ax', 0.6), ('ay', 0.0), ('az', 0.8)):
        columns[axis] = np.round(scale * up + 1e-3 * scale * rng.standard_normal(n), 6)
    columns |= {axis: np.round(rng.standard_normal(n), 3) for axis in ('wx', 'wy', 'wz')}
    columns['case'] = 20.0 + 0.5 * (np.arange(n) // 100)
    columns['board'] = 25.0 + 0.125 * (np.arange(n) // 40)
    lines = [','.join(columns)]
    lines += [','.join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)]
    path.write_text('\n'.join(lines) + '\n')
    return path, columns


def column_map(**changes):
    data = {
        'stamp': {'column': 'ms', 'unit': 'ms'},
        'accel': {'columns': ['ax', 'ay', 'az'], 'unit': 'g', 'output': 'imu'},
        'board': {'column': 'board'},
        'case': {'column': 'case'},
        'serial': 'unit7',
        'frame_id': 'here',
    }
    return build(ColumnMap, {**data, **changes})


def test_a_bag_converted_from_a_table_has_the_values_of_the_table(tmp_path):
    path, columns = table(tmp_path / 'log.csv')
    gyro = {'columns': ['wx', 'wy', 'wz'], 'unit': 'deg/s'}
    report = write_log(table_log(path, column_map(gyro=gyro)), tmp_path / 'bag')
    recording = read_recording(tmp_path / 'bag')
    block = recording.columns
    assert (recording.info.input, recording.info.metadata['serial']) == ('imu', 'unit7')
    assert (recording.info.metadata['converted_from'], block.frame_id) == ('log.csv', 'here')
    assert block.accel_stamp_ns.tolist() == (columns['ms'] * 10**6).tolist()
    expected = np.column_stack([columns[k] for k in ['ax', 'ay', 'az']]) * STANDARD_GRAVITY
    np.testing.assert_array_equal(block.accel, expected)
    np.testing.assert_allclose(
        np.degrees(block.imu.angular_velocity),
        np.column_stack([columns[k] for k in ['wx', 'wy', 'wz']]),
        rtol=1e-14,  # rounding of the conversions to rad/s and back to deg/s
    )
    # In a sensor_msgs/Imu -1 means no orientation, 0 an unknown covariance of the angular rate.
    assert block.imu.orientation_covariance[:, 0].tolist() == [-1.0] * 400
    assert not block.imu.angular_velocity_covariance.any()
    case, board = block.temperatures['case'], block.temperatures['board']
    assert case.celsius.tolist() == [20.0, 20.5, 21.0, 21.5]
    assert case.stamp_ns.tolist() == [(1000 + 1000 * k) * 10**6 for k in range(4)]
    assert len(board.celsius) == report.messages['board'] == 10
    assert case.after.tolist() == [0, 100, 200, 300]
    assert (report.rows, report.messages['accel']) == (400, 400)
    assert (report.rate_hz, report.duration_s) == (pytest.approx(100.0), pytest.approx(3.99))
    assert 'gravity is 1 g' in report.inferred_unit


def test_counts_are_converted_with_a_stated_sensitivity_and_less_an_offset(tmp_path):
    path, columns = table(tmp_path / 'log.csv', scale=2048.0)
    accel = {'columns': ['ax', 'ay', 'az'], 'unit': 'counts', 'output': 'imu'}
    accel |= {'counts_per_g': 2048.0}
    write_log(table_log(path, column_map(accel=accel)), tmp_path / 'bag')
    block = read_recording(tmp_path / 'bag').columns
    np.testing.assert_allclose(block.accel[:, 0], columns['ax'] * STANDARD_GRAVITY / 2048.0)
    wrong = table_log(path, column_map(accel={**accel, 'counts_per_g': 16384.0}))
    with pytest.raises(RecordingError, match=r'16384 counts/g are stated$'):
        write_log(wrong, tmp_path / 'other')
    assert not (tmp_path / 'other').exists()
    rows = np.loadtxt(path, delimiter=',', skiprows=1)
    rows[:, 1:4] += 32768.0
    np.savetxt(path, rows, '%.17g', ',', header=','.join(columns), comments='')
    accel |= {'output': 'counts', 'clip': [0, 65535]}
    with pytest.raises(RecordingError, match='is there an `offset`'):
        write_log(table_log(path, column_map(accel=accel)), tmp_path / 'bag.mcap')
    log = table_log(path, column_map(accel={**accel, 'offset': 32768.0}))
    assert log.clip == (-32768.0, 32767.0)
    write_log(log, tmp_path / 'bag.mcap')
    read = read_recording(tmp_path / 'bag.mcap').columns.accel
    np.testing.assert_allclose(read[:, 0], columns['ax'], atol=1e-9)


@pytest.mark.parametrize('unit', ['ms', 'us'])
def test_times_of_a_counter_of_32_bits_continue_after_its_overflow(tmp_path, unit):
    # WHY: Arduino's micros() overflows to 0 after 71.6 min; the fit used only samples before it.
    path, _ = table(tmp_path / 'log.csv')
    lines = path.read_text().splitlines()
    ticks = [(2**32 - 2000 + 10 * k) % 2**32 for k in range(400)]
    rows = [f'{at},{row.partition(",")[2]}' for at, row in zip(ticks, lines[1:], strict=True)]
    path.write_text('\n'.join([lines[0], *rows]))
    log = table_log(path, column_map(stamp={'column': 'ms', 'unit': unit}))
    assert np.diff(log.stamp_ns).tolist() == [10 * {'ms': 10**6, 'us': 10**3}[unit]] * 399
    report = write_log(log, tmp_path / 'bag')
    assert (report.findings['continued'].count, report.findings['continued'].lines) == (1, (202,))
    assert report.findings['backwards'].count == 0
    lines[200] = lines[200].replace(lines[200].partition(',')[0], '1000.0')
    path.write_text('\n'.join(lines))
    report = write_log(table_log(path, column_map()), tmp_path / 'other')
    assert (report.findings['continued'].count, report.findings['backwards'].count) == (0, 1)


def test_readings_stay_among_samples_after_a_restart_of_the_clock(tmp_path):
    path, _ = table(tmp_path / 'log.csv')
    lines = path.read_text().splitlines()
    for k in range(201, 401):
        at, _, rest = lines[k].partition(',')
        lines[k] = f'{float(at) - 2500.0},{rest}'  # the clock is set back by 2.5 s
    path.write_text('\n'.join(lines))
    write_log(table_log(path, column_map()), tmp_path / 'bag')
    board = read_recording(tmp_path / 'bag').columns.temperatures['board']
    # The board temperature changes every 40 rows; a reading precedes the sample of its row.
    assert board.after.tolist() == list(range(0, 400, 40))


def test_rows_with_faults_are_counted_and_readings_of_minus_127_degc_left_out(tmp_path):
    path, _ = table(tmp_path / 'log.csv')
    lines = path.read_text().splitlines()
    lines[11] = lines[11].replace(lines[11].split(',')[1], 'nan')
    lines[21] = 'garbage,' + lines[21].partition(',')[2]
    lines[31] = '1300.0,2.0,0.0,0.8,0,0,0,20.0,25.0'
    lines[41], lines[42] = lines[42], lines[41]
    lines[51] = lines[50]
    lines[400] = '4990.0,0.6'
    path.write_text('\n'.join(lines))
    accel = {'columns': ['ax', 'ay', 'az'], 'unit': 'g', 'output': 'imu', 'clip': [-1.99, 1.99]}
    report = write_log(table_log(path, column_map(accel=accel)), tmp_path / 'bag')
    block = read_recording(tmp_path / 'bag').columns
    assert report.rows == 400
    assert (report.findings['short_rows'].count, report.findings['non_numeric'].count) == (1, 2)
    assert report.findings['short_rows'].lines == (401,)
    assert report.findings['non_numeric'].lines == (12, 22)
    assert (report.findings['clipped'].count, report.findings['clipped'].lines) == (1, (32,))
    assert (report.findings['backwards'].count, report.findings['backwards'].lines) == (1, (43,))
    assert (report.findings['repeated'].count, report.findings['repeated'].lines) == (1, (52,))
    assert len(block) == report.messages['accel'] == 397
    # The bag keeps clipped samples and samples in wrong order, because the node rejects them.
    assert block.accel[:, 0].max() == 2.0 * STANDARD_GRAVITY
    assert (np.diff(block.accel_stamp_ns) < 0).sum() == 1
    assert (np.diff(block.log_ns['accel']) >= 0).all()
    # WHY: 46 readings of -127 degC (DS18B20 without contact) increased a fit's error to 0.68 mg.
    path, _ = table(tmp_path / 'log.csv')
    lines = path.read_text().splitlines()
    for k in (50, 51, 300):
        lines[k] = lines[k].rpartition(',')[0] + ',-127'
    path.write_text('\n'.join(lines))
    report = write_log(table_log(path, column_map()), tmp_path / 'cold')
    assert report.findings['impossible'].count == 2  # a reading repeated in two rows counts once
    assert read_recording(tmp_path / 'cold').columns.temperatures['board'].celsius.min() == 25.0


def test_stamps_of_a_fixed_rate_do_not_accumulate_rounding(tmp_path):
    path, _ = table(tmp_path / 'log.csv', n=300)
    write_log(table_log(path, column_map(stamp={'rate_hz': 3.0})), tmp_path / 'bag')
    stamps = read_recording(tmp_path / 'bag').columns.accel_stamp_ns
    assert stamps[0] == 10**9
    # Each stamp is a multiple of 1/3 s, not of 0.333333333 s, rounded to a nanosecond.
    assert stamps[-1] == 10**9 + round(299 * 1e9 / 3.0)


def test_the_bag_does_not_depend_on_the_number_of_rows_in_a_block(tmp_path, monkeypatch):
    path, _ = table(tmp_path / 'log.csv')
    write_log(table_log(path, column_map()), tmp_path / 'whole')
    monkeypatch.setattr('thermo_comp.convert.log._RUN_ROWS', 64)
    write_log(table_log(path, column_map()), tmp_path / 'parts')
    whole, parts = (read_recording(tmp_path / name).columns for name in ('whole', 'parts'))
    for name in ('accel_stamp_ns', 'accel'):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    for name, readings in whole.temperatures.items():
        np.testing.assert_array_equal(readings, parts.temperatures[name])


@pytest.mark.parametrize(
    ('unit', 'reading', 'celsius'),
    # The unit `raw` has counts of 1/16 K above 20 degC.
    [('K', 300, 26.85), ('degF', 212, 100.0), ('raw', 160, 30.0), ('degC', 30, 30.0)],
)
def test_temperatures_of_any_unit_become_degc(tmp_path, unit, reading, celsius):
    path, _ = table(tmp_path / 'log.csv')
    raw = {'degc_per_count': 0.0625, 'degc_at_zero': 20.0} if unit == 'raw' else {}
    path.write_text(path.read_text().replace(',25.', f',{reading}.'))
    board = {'column': 'board', 'unit': unit, **raw}
    write_log(table_log(path, column_map(board=board)), tmp_path / 'bag')
    first = float(read_recording(tmp_path / 'bag').columns.temperatures['board'].celsius[0])
    assert first == pytest.approx(celsius)


def test_kelvins_and_tables_without_numbers_are_refused(tmp_path):
    path, _ = table(tmp_path / 'log.csv')
    path.write_text(path.read_text().replace(',25.', ',298.'))
    with pytest.raises(RecordingError, match=r'board temperature is 29.* looks like kelvins'):
        write_log(table_log(path, column_map()), tmp_path / 'bag')
    path = tmp_path / 'log.csv'
    path.write_text('ms,ax,ay,az,board,case\n' + 'a,b,c,d,e,f\n' * 5)
    with pytest.raises(RecordingError, match='none of its 5 rows holds numbers'):
        write_log(table_log(path, column_map()), tmp_path / 'bag')


def test_readings_are_kept_if_they_change_or_after_ten_seconds():
    def kept(values, step_s=1):
        stamps = np.arange(len(values), dtype=np.int64) * step_s * 10**9
        return (Readings(stamps, np.array(values)).thinned().stamp_ns // 10**9).tolist()

    assert kept([1, 1, 2, 2, 2, 1]) == [0, 2, 5]
    assert kept([1] * 10, step_s=4) == [0, 12, 24, 36]
    assert kept([float('nan'), 1, float('nan'), 1, 2]) == [1, 4]
    assert kept([float('nan')] * 3) == []
    readings = Readings(np.array([5, 6, 1, 2]) * 10**9, np.full(4, 20.0))
    assert (readings.thinned().stamp_ns // 10**9).tolist() == [5, 1]


class TestColumnMap:
    def test_shipped_column_maps_are_valid(self):
        paths = sorted((ROOT / 'config' / 'columns').glob('*.yaml'))
        assert paths
        for path in paths:
            load_column_map(path)

    @pytest.mark.parametrize(
        ('changes', 'key', 'message'),
        [
            ({'further': [{'name': 'case', 'column': 'c'}]}, 'further[0].name',
             'fit into a topic'),
            ({'further': [{'name': 'a', 'column': column} for column in 'bc']}, None,
             'two thermometers with the same'),
            ({'stamp': {'column': 't'}}, 'stamp.unit', 'iso if `column` is given'),
            ({'stamp': {}}, 'stamp', 'give either `column` and `unit`, or `rate_hz`'),
            ({'stamp': {'column': 't', 'unit': 's', 'rate_hz': 1.0}}, 'stamp', 'give either'),
            ({'accel': {'columns': ['x', 'y', 'z'], 'unit': 'g', 'output': 'counts'}}, 'accel',
             'must be imu if `unit` is g, got counts'),
            ({'accel': {'columns': ['x', 'y', 'z'], 'unit': 'counts', 'output': 'imu'}}, 'accel',
             'must be given if `unit` is counts'),
            ({'accel': {'columns': ['x', 'y', 'z'], 'unit': 'g', 'output': 'imu', 'clip': [2, 1]}},
             'accel', r'must be \[lowest, highest\] .*, got \[2.0, 1.0\]'),
            ({'board': {'column': 'b', 'unit': 'raw'}}, 'board.degc_per_count',
             'if `unit` is raw, and only then; `unit`: raw'),
            ({'board': {'column': 'b', 'unit': 'raw', 'degc_per_count': 1.0}},
             'board.degc_at_zero', 'must be given if `unit` is raw'),
            ({'board': {'column': 'b', 'publish': 'all'}}, 'board.publish', 'unknown key'),
            ({'accel': {'columns': [0, 1, 2], 'unit': 'counts', 'output': 'counts'},
             'gyro': {'columns': [3, 4, 5], 'unit': 'rad/s'}}, 'accel.output',
             'must be imu if `gyro` is given'),
            ({'accel': {'columns': ['x', 'x', 'z'], 'unit': 'g', 'output': 'imu'}}, None,
             "column 'x' is given twice"),
            ({'board': {'column': 'b'}, 'case': {'column': 'b'}}, None,
             "column 'b' is given twice"),
        ],
    )  # fmt: skip
    def test_mistakes_in_a_column_map_name_their_key(self, tmp_path, changes, key, message):
        path, accel = tmp_path / 'map.yaml', {'columns': [*'xyz'], 'unit': 'g', 'output': 'imu'}
        data = {'stamp': {'column': 't', 'unit': 's'}, 'accel': accel, **changes}
        path.write_text(yaml.safe_dump(data))
        with pytest.raises(RecordingError, match=message) as caught:
            load_column_map(path)
        assert str(path) in str(caught.value)
        assert key is None or (caught.value.key or '').startswith(key)

    def test_files_that_are_not_column_maps_are_refused(self, tmp_path):
        path = tmp_path / 'map.yaml'
        with pytest.raises(ThermoCompError, match=r'map\.yaml: .*No such file'):
            load_column_map(path)
        for content, reason in (
            *((b'- a\n- b\n', 'a column map is a mapping'), (b'\xff\xfe\x00a', 'UTF-8')),
            (b'a: [1\n', r'map\.yaml: not valid YAML'),
        ):
            path.write_bytes(content)
            with pytest.raises(ThermoCompError, match=reason):
                load_column_map(path)


def test_convert_reports_rows_rate_and_topics(tmp_path, cli):
    path, _ = table(tmp_path / 'log.csv')
    map_path = tmp_path / 'map.yaml'
    map_path.write_text(
        'stamp: {column: ms, unit: ms}\n'
        'accel: {columns: [ax, ay, az], unit: g, output: imu}\n'
        'board: {column: board}\n'
    )
    arguments = ('convert', path, '--columns', map_path, '-o', tmp_path / 'bag')
    printed = cli(*arguments).stdout
    assert '400 rows, 4.0 s at 100 Hz' in printed
    assert '400 imu/uncompensated' in printed
    text = f'thermo_comp: error: {tmp_path}/bag: exists already; --force overwrites it\n'
    assert cli(*arguments, code=1).stderr == text
    data = json.loads(cli(*arguments, '--force', '--json').stdout)
    assert (data['accel_messages'], data['stillness']['moving_ns']) == (400, [])
    assert cli(*arguments, '--force', '-q').stdout == ''


class TestFreezer:
    """The recording of an MPU-6050 in a freezer, whose log has several faults."""

    @pytest.fixture
    def path(self, real_data):
        path = real_data / 'freezer-mpu6050' / 'temp-calibration.csv'
        if not path.is_file():
            pytest.skip(f'{path} does not exist')
        return path

    def test_every_row_is_in_the_bag_and_the_faults_are_reported(self, path, tmp_path):
        columns = load_column_map(ROOT / 'config' / 'columns' / 'freezer.yaml')
        report = write_log(table_log(path, columns), tmp_path / 'bag')
        assert report.rows == report.messages['accel'] == 24514
        assert report.findings['clipped'].count == 7
        first, last = report.stillness.moving_ns[0], report.stillness.moving_ns[-1]
        assert first[0] == report.log.stamp_ns[0]
        assert first[1] * 1e-9 == pytest.approx(49.0, abs=3.0)
        assert last[0] * 1e-9 == pytest.approx(1944.0, abs=3.0)
        assert report.stillness.magnitude == pytest.approx(1.02, abs=0.03)
        block = read_recording(tmp_path / 'bag').columns
        assert len(block) == 24514
        assert block.temperatures['case'].celsius.min() == pytest.approx(-17.8, abs=0.1)
        assert block.temperatures['board'].celsius.min() == pytest.approx(3.6, abs=0.5)
        assert block.temperatures['barometer'].celsius.min() == pytest.approx(-17.0, abs=0.1)
        assert report.messages['barometer'] == len(block.temperatures['barometer'].celsius)
        assert report.messages.keys() == {'accel', 'board', 'case', 'barometer'}
        assert report.messages['case'] < 0.75 * report.rows
