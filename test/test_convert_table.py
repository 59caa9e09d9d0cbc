# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of any layout and bags with topics of any name give equal columns."""

import re

import numpy as np
import pytest
from recording_helpers import IMU, START_NS, TEMPERATURE, Message, write_rosbag1, write_rosbag2

from thermo_comp.convert import log as logs
from thermo_comp.convert.bag import bag_log, find_topics
from thermo_comp.convert.column_map import ColumnMap, table_log
from thermo_comp.convert.log import NO_STAMP, contradiction, find_stillness, infer_unit, write_log
from thermo_comp.convert.readers import read_log
from thermo_comp.convert.table import Format, Stamp, exact_ns, read_parquet, read_text
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.unit.schema import build

ROWS_ALONE = Stamp(rate_hz=1.0)
ROWS = [(1000, 0.5, -1.25), (1001, 0.25, 2e-3), (1003, -7.0, 1.5)]


def write(path, text):
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ('delimiter', 'newline', 'prefix'),
    [
        *((',', '\n', ''), (';', '\r\n', ''), ('\t', '\n', '\ufeff')),
        *(('|', '\n', '# a logger wrote this\n'), ('  ', '\n', '\n')),
    ],
    ids=['comma', 'semicolon-crlf', 'tab-bom', 'bar-comment', 'blanks'],
)
def test_every_layout_of_a_table_gives_equal_values(tmp_path, delimiter, newline, prefix):
    lines = [delimiter.join(('t', 'a', 'b'))]
    lines += [delimiter.join(map(str, row)) for row in ROWS]
    path = write(tmp_path / 'log.txt', prefix + newline.join(lines) + newline)
    table = read_text(path, ['b', 'a'], Stamp('t', 'ms'))
    assert table.stamp_ns.tolist() == [1000 * 10**6, 1001 * 10**6, 1003 * 10**6]
    assert table.values['a'].tolist() == [row[1] for row in ROWS]
    assert table.values['b'].tolist() == [row[2] for row in ROWS]
    assert len(table.short) == 0


def test_headings_are_optional_and_a_column_may_begin_late(tmp_path):
    path = write(tmp_path / 'log.txt', '1 2 3\n4 5 6\n')
    assert read_text(path, [2], ROWS_ALONE).values[2].tolist() == [3.0, 6.0]
    # 'nan' and 'inf' are numbers, unless the user states that the first line is a heading.
    path = write(tmp_path / 'words.txt', 'nan inf\n1 2\n')
    assert read_text(path, [0], ROWS_ALONE, Format(header=True)).values[0].tolist() == [1.0]
    path = write(tmp_path / 'log.csv', '# made by hand\na,b\n\n1,2\nx,3\n4\n5,6\n')
    table = read_text(path, ['a', 'b'], ROWS_ALONE)
    assert table.line.tolist() == [4, 5, 7]
    np.testing.assert_array_equal(table.values['a'], [1.0, np.nan, 5.0])
    assert [*table.short] == [6]
    # WHY: a table was refused if the last column, a thermometer, is blank in the first rows.
    rows = [f'{k},0.1,{"" if k < 20 else 20 + k}' for k in range(60)]
    path = write(tmp_path / 'log.csv', '\n'.join(['t,ax,celsius', *rows]))
    table = read_text(path, ['t', 'celsius'], ROWS_ALONE)
    np.testing.assert_array_equal(table.values['t'], np.arange(60.0))
    assert np.isnan(table.values['celsius'][:20]).all()
    assert table.values['celsius'][20] == 40.0


@pytest.mark.parametrize('separator', [',', ';', '\t', ' '])
def test_lines_before_the_table_of_a_logger_are_left_out(tmp_path, separator):
    # The reader turns the row of units into NaN, and counts and omits the incomplete last row.
    head = ['Inertial logger', '# serial 7', '% matlab', '// c', f'Rate:{separator}100', '']
    rows = ['t|ax|ay|az', 's|g|g|g', *(f'{k}|0.1|0.2|{k}' for k in range(60)), '# end', '60|0.1']
    text = '\n'.join([*head, *(row.replace('|', separator) for row in rows)])
    table = read_text(write(tmp_path / 'log.csv', text), ['t', 'az'], ROWS_ALONE)
    assert np.isnan(table.values['t'][0])
    np.testing.assert_array_equal(table.values['az'][1:], np.arange(60.0))
    assert (table.line[1], [*table.short]) == (9, [70])


def test_stamps_of_a_table_are_exact():
    # Numbers of double precision would round nanoseconds since 1970 to steps of 256 ns.
    cells = ['1767225600.123456789', '1767225600123456789e-9', ' +2 ', '1.5e-9']
    exact = [1767225600123456789, 1767225600123456789, 2 * 10**9, 2]
    assert [exact_ns(cell, 's') for cell in cells] == exact
    assert exact_ns('1767225600123456789', 'ns') == 1767225600123456789
    bad = ['', 'soon', 'nan', 'inf', '1e40', '99999999999999999999']
    assert {exact_ns(cell, 'ns') for cell in bad} == {NO_STAMP}


@pytest.mark.parametrize(
    ('text', 'column', 'message'),
    [
        ('', 'a', 'the table is empty'),
        (' \n\n', 'a', 'the table is empty'),
        ('# only a comment\n', 'a', 'the table is empty'),
        ('a,b\n', 'a', 'headings but no rows'),
        ('a,b\n1,2\n', 'c', "no column 'c'; there are: 'a', 'b'"),
        ('a,a\n1,2\n', 'a', "2 columns are called 'a'"),
        ('1,2\n3,4\n', 'a', "no column 'a': the table has no headings"),
        ('1,2\n3,4\n', 2, 'no column 2: the table has 2 columns, 0 to 1'),
        ('1,2\n3,4\n', -1, 'no column -1: the table has 2 columns, 0 to 1'),
        # WHY: rows whose numbers have decimal commas were left out.
        ('a;b\n1,5;2\n3;4\n5;6\n', 'a', "column 'a' has decimal commas, it begins with 1,5"),
        ('a,b\n\0\0\n', 'a', 'it holds zero bytes'),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, column, message):
    path = write(tmp_path / 'log.csv', text)
    with pytest.raises(RecordingError, match=message) as caught, logs.naming(path):
        read_text(path, [column], ROWS_ALONE)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    for name in ('absent.csv', 'absent.ulg', 'absent.BIN'):
        with pytest.raises(RecordingError, match=f'{name}: No such file or directory$'):
            read_log(tmp_path / name)


def parquet(folder, **columns):
    pa = pytest.importorskip('pyarrow', reason='pyarrow of the extra `parquet` is not installed')
    import pyarrow.parquet as pq

    pq.write_table(pa.table(columns), folder / 'log.parquet')
    return folder / 'log.parquet'


class TestParquet:
    def test_a_parquet_table_gives_the_values_of_the_text_table(self, tmp_path):
        t, a, _ = zip(*ROWS, strict=True)
        path = parquet(tmp_path, t=t, a=a, b=[1, None, 3])
        table = read_parquet(path, ['a', 'b'], Stamp('t', 'ms'))
        assert table.stamp_ns.tolist() == [1000 * 10**6, 1001 * 10**6, 1003 * 10**6]
        assert table.values['a'].tolist() == [*a]
        np.testing.assert_array_equal(table.values['b'], [1.0, np.nan, 3.0])

    @pytest.mark.parametrize(
        ('stamps', 'expected'),
        [
            (np.array([1767225600123, 0], dtype='datetime64[ms]'), [1767225600123 * 10**6, 0]),
            ([0.5, float('nan')], [500_000_000, NO_STAMP]),
        ],
    )
    def test_parquet_stamps_are_dates_or_fractional_seconds(self, tmp_path, stamps, expected):
        path = parquet(tmp_path, t=stamps, a=[1.0, 2.0])
        assert read_parquet(path, ['a'], Stamp('t', 's')).stamp_ns.tolist() == expected

    def test_unreadable_parquet_is_refused(self, tmp_path):
        path = parquet(tmp_path, a=['one', 'two'])
        with pytest.raises(RecordingError, match="column 'a' holds string"):
            read_parquet(path, ['a'], ROWS_ALONE)
        with pytest.raises(RecordingError, match="no column 'b'"):
            read_parquet(path, ['b'], ROWS_ALONE)
        with pytest.raises(RecordingError, match='the table is empty'):
            read_parquet(parquet(tmp_path, a=np.array([], dtype=float)), ['a'], ROWS_ALONE)
        path.write_text('a,b\n')
        with pytest.raises(RecordingError, match='not a readable Parquet file'):
            read_parquet(path, ['a'], ROWS_ALONE)


@pytest.mark.parametrize('suffix', ['csv', 'parquet'])
@pytest.mark.parametrize('unit', ['s', 'ns'])
def test_stamps_that_ros_cannot_hold_are_left_out(tmp_path, suffix, unit):
    scale = 10**9 if unit == 's' else 1
    good = [10**9 + k for k in range(40)] if unit == 's' else [10**18 + k for k in range(40)]
    bad = [-1, 2**31, 2 * 10**10, 2**62, 2**63] if unit == 's' else [-1, 2**31 * 10**9, 2**63]
    rows = good + bad

    def written(stamps):
        path = tmp_path / f'log.{suffix}'
        if suffix == 'parquet':
            is_signed = min(stamps) < 0
            stamps = [min(stamp, 2**62) for stamp in stamps] if is_signed else stamps
            stored = np.array(stamps, np.int64 if is_signed else np.uint64)
            return parquet(tmp_path, t=stored, **dict.fromkeys('xyz', [5.66] * len(stamps)))
        path.write_text('\n'.join(['t,x,y,z', *(f'{at},5.66,5.66,5.66' for at in stamps)]))
        return path

    accel = {'columns': ['x', 'y', 'z'], 'unit': 'm/s^2', 'output': 'imu'}
    chart = build(ColumnMap, {'stamp': {'column': 't', 'unit': unit}, 'accel': accel})
    for stamps in (rows, good + bad[1:]):
        report = write_log(table_log(written(stamps), chart), tmp_path / 'bag.mcap', force=True)
        left_out = report.findings['out_of_range'].count + report.findings['non_numeric'].count
        assert (report.messages['accel'], left_out) == (40, len(stamps) - 40)
        bag = read_recording(tmp_path / 'bag.mcap', Topics(input='imu'), require=('accel',))
        assert bag.columns.accel_stamp_ns.tolist() == [stamp * scale for stamp in good]
    with pytest.raises(RecordingError, match=r'before 1970 or after January 2038|holds numbers'):
        write_log(table_log(written(bad[1:]), chart), tmp_path / 'none.mcap')


G = 9.80665
N = 400
PRESSURE = 'sensor_msgs/msg/FluidPressure'


def write_bag(path, rng, ros=2, scale=G):
    force = scale * (np.array([0.0, 0.1, 1.0]) + 0.003 * rng.standard_normal((N, 3)))
    zeros, messages = [0.0] * 9, []
    for k in range(N):
        now_ns = START_NS + 10_000_000 * k
        imu = (0.0, 0.0, 0.0, 1.0, *zeros, 0.01, 0.0, 0.5, *zeros, *force[k], *zeros)
        messages.append(Message('/mpu/data', now_ns, now_ns, 'mpu', imu))
        if k % 50 == 0:
            for topic in ('/mpu/die', '/baro/air'):
                reading = (len(topic) + k / 50, 0.0)
                messages.append(Message(topic, now_ns, now_ns, 'mpu', reading))
    if ros == 1:
        write_rosbag1(path, messages)
    else:
        write_rosbag2(path, messages, storage='sqlite3')
    return path


@pytest.mark.parametrize('ros', [1, 2])
def test_topics_of_any_name_are_converted_to_the_default_topics(tmp_path, rng, ros):
    path = write_bag(tmp_path / ('old.bag' if ros == 1 else 'new'), rng, ros)
    report = write_log(bag_log(path), tmp_path / 'bag.mcap')
    recording = read_recording(tmp_path / 'bag.mcap')
    columns = recording.columns
    assert report.messages['accel'] == N
    np.testing.assert_array_equal(columns.accel_stamp_ns, START_NS + 10_000_000 * np.arange(N))
    np.testing.assert_allclose(columns.accel.mean(axis=0), (0.0, 0.1 * G, G), atol=0.02)
    np.testing.assert_array_equal(columns.imu.angular_velocity[0], (0.01, 0.0, 0.5))
    for name, topic in (('board', '/mpu/die'), ('case', '/baro/air')):
        celsius = columns.temperatures[name].celsius
        np.testing.assert_array_equal(celsius, len(topic) + np.arange(8))
    assert recording.info.metadata['topic_board'] == '/mpu/die'


def present(imu, temperature=(), pressure=()):
    return {
        **dict.fromkeys(imu, (IMU, 10)),
        **dict.fromkeys(temperature, (TEMPERATURE, 10)),
        **dict.fromkeys(pressure, (PRESSURE, 10)),
    }


@pytest.mark.parametrize(
    ('temperature', 'pressure', 'board', 'case'),
    [
        ((), (), None, None),
        (('/t',), (), '/t', None),
        (('/imu/t', '/air'), (), '/imu/t', '/air'),
        # A thermometer beside a barometer is taken for the case's, even if it is the only one.
        (('/baro/t',), ('/baro/p',), None, '/baro/t'),
        (('/imu/t', '/baro/t', ), ('/baro/p',), '/imu/t', '/baro/t'),
        (('/robot/imu/t', '/robot/baro/t'), ('/robot/baro/p',), '/robot/imu/t', '/robot/baro/t'),
        (('/robot/baro/t',), ('/robot/baro/p',), None, '/robot/baro/t'),
    ],
)  # fmt: skip
def test_thermometers_are_identified_by_their_namespace(temperature, pressure, board, case):
    imu = '/robot/imu/data' if temperature and temperature[0].startswith('/robot') else '/imu/data'
    topics = find_topics(present([imu], temperature, pressure), None, None, None)
    assert topics == {'imu': imu, 'board': board, 'case': case}


def test_ambiguous_topics_must_be_named():
    with pytest.raises(RecordingError, match=r'several topics may be the Imu.*--topic imu='):
        find_topics(present(['/a/data', '/b/data']), None, None, None)
    with pytest.raises(RecordingError, match=r'several topics may be the board.*--topic board='):
        find_topics(present(['/imu/data'], ['/imu/t1', '/imu/t2']), None, None, None)
    with pytest.raises(RecordingError, match='holds no sensor_msgs/msg/Imu'):
        find_topics(present([], ['/t']), None, None, None)
    chosen = find_topics(present(['/imu/data'], ['/imu/t1', '/imu/t2']), None, '/imu/t2', None)
    assert (chosen['board'], chosen['case']) == ('/imu/t2', '/imu/t1')


def test_the_command_convert_reads_a_bag(tmp_path, rng, cli):
    bag = write_bag(tmp_path / 'bag', rng, scale=1.0)
    refused = cli('convert', bag, '-o', tmp_path / 'out.mcap', code=1)
    assert re.search(r'is m/s\^2, but .* looks like g', refused.stderr)
    finished = cli('convert', bag, '--unit', 'g', '-o', tmp_path / 'out.mcap')
    assert f'{N:8} imu/uncompensated' in finished.stdout
    force = read_recording(tmp_path / 'out.mcap').columns.accel
    np.testing.assert_allclose(force.mean(axis=0), (0.0, 0.1 * G, G), atol=0.02)
    assert finished.stderr == (
        f'thermo_comp: {bag}: /mpu/data, the only Imu of the bag, is taken for imu; '
        '/mpu/die, the nearest Temperature of the bag, is taken for board; '
        '/baro/air, the nearest Temperature of the bag, is taken for case\n'
    )
    named = (f'--topic={x}' for x in ('imu=/mpu/data', 'board=/mpu/die', 'case=/baro/air'))
    finished = cli('convert', bag, '--unit', 'g', '-o', tmp_path / 'named.mcap', *named)
    assert 'is taken for' not in finished.stderr
    wrong = cli('convert', bag, '--imu', '1', '-o', tmp_path / 'two.mcap', code=2)
    assert '--topic' in wrong.stderr
    table = tmp_path / 'table.csv'
    table.write_text('1,2,3\n')
    wrong = cli('convert', table, '--unit', 'g', '-o', tmp_path / 'two.mcap', code=2)
    assert '--unit does not apply to a table, which takes --columns, --rate-hz' in wrong.stderr


@pytest.mark.parametrize(
    ('magnitude', 'unit'),
    [  # 1.019 g is |f| of an MPU6050 with a bias of 19 mg; 32.2 is gravity in ft/s^2.
        *((1.019, 'g'), (0.85, 'g'), (9.78, 'm/s^2'), (10.4, 'm/s^2'), (1003.0, 'mg')),
        *((2051.0, 'counts'), (16100.0, 'counts'), (3003.0, 'counts')),
        *((0.1, 'unknown'), (32.2, 'unknown')),
    ],
)
def test_the_unit_follows_from_the_norm_at_rest(magnitude, unit):
    inferred, reason = infer_unit(magnitude)
    assert inferred == unit
    assert f'{magnitude:.4g}' in reason


def test_a_stated_unit_that_may_be_true_is_not_contradicted():
    assert contradiction('g', 1.15, None) is None
    assert contradiction('m/s^2', 9.6, None) is None
    # Any |a| at rest above 50 may be in counts, because converters differ in resolution.
    assert contradiction('counts', 2941.7, None) is None
    assert contradiction('counts', 2060.0, 2048.0) is None
    assert contradiction('g', float('nan'), None) is None


@pytest.mark.parametrize('scale', [1.0, 9.81, 2048.0])
def test_movement_is_found_in_any_unit(rng, scale):
    accel = scale * (np.array([0.6, 0.0, 0.8]) + 1e-3 * rng.standard_normal((5000, 3)))
    accel[2000:3000] += 20e-3 * scale * rng.standard_normal((1000, 3))
    stillness = find_stillness(np.arange(1, 5001) * 10_000_000, accel)
    assert np.array(stillness.moving_ns) * 1e-9 == pytest.approx(np.array([[20.01, 30.01]]))
    # Samples at 100 Hz have a noise of 0.1 %, so a mean over 2 s has a noise of 0.1 % / sqrt(200).
    assert stillness.magnitude == pytest.approx(scale, rel=3e-4)
    assert stillness.noise == pytest.approx(1e-3 * scale, rel=0.1)
    assert stillness.still_s == pytest.approx(40.0, abs=0.5)


def test_steps_of_a_coarse_sensor_are_no_motion_and_five_samples_no_rest(rng):
    # If rounding steps are larger than the noise, samples at rest change by a step now and then.
    accel = np.tile([0.0, 0.0, 1.0], (1000, 1))
    accel[::97, 0] = 0.1
    stillness = find_stillness(np.arange(1000) * 10_000_000, accel)
    assert (stillness.moving_ns, stillness.magnitude) == ((), pytest.approx(1.0, rel=1e-3))
    stillness = find_stillness(np.arange(5), np.ones((5, 3)))
    assert np.isnan(stillness.magnitude)
    assert stillness.moving_ns == ()
    assert np.isnan(find_stillness(np.arange(1), np.ones((1, 3))).magnitude)
