# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of other programs are read by their headings; |f| at rest and rates show the units."""

from datetime import datetime, timedelta, timezone
from itertools import takewhile

import numpy as np
import pytest
import yaml
from position_helpers import Rest

from thermo_comp.convert.column_map import (
    column_map_text,
    guess_columns,
    load_column_map,
    table_log,
)
from thermo_comp.convert.headings import map_lines, read_headings
from thermo_comp.convert.log import NO_STAMP, write_log
from thermo_comp.convert.readers import read_log
from thermo_comp.convert.table import exact_ns
from thermo_comp.errors import RecordingError
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.recording.reader import read_recording
from thermo_comp.simulation.campaign import positions

N, STEP_NS = 1200, 10**7
START = datetime(2026, 3, 29, 1, 30, tzinfo=timezone.utc)
START_NS = int(START.timestamp()) * 10**9
UP = np.repeat([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], N // 3, axis=0)


@pytest.mark.parametrize(
    ('text', 'seconds'),
    [
        ('2026-03-29T01:30:00Z', 0),
        ('2026-03-29T01:30:00.123456789Z', 0.123456789),
        ('2026-03-29 01:30:00', 0),  # a time without a zone is UTC
        ('2026-03-29T03:30:00.5+02:00', 0.5),
        ('2026-03-29T03:30:00+0200', 0),  # format of GGIR
        ('2026-03-29 03:30:00.250+0200 [Europe/Paris]', 0.25),  # format of actipy
        ('2026-03-28 20:00:00-05:30', 0),
        ('2026-03-29 01:30', 0),
        *((text, None) for text in ('', '01:30', '2026-13-29 01:30:00', '2026-03-29T01:30:00+2')),
        *((text, None) for text in ('2026-02-30 01:30', '2026-03-29T24:00:01', '01:30:00.5')),
        *((text, None) for text in ('9999-01-01T00:00:00', '0001-01-01T00:00:00Z')),
    ],
)
def test_dates_with_time_zones_are_read(text, seconds):
    expected = NO_STAMP if seconds is None else START_NS + round(seconds * 1e9)
    assert exact_ns(text, 'iso') == expected


QUANTITIES = ('Acceleration', 'm/s^2'), ('Gyroscope', 'rad/s')
PHONE = ','.join(f'{name} {axis} ({unit})' for name, unit in QUANTITIES for axis in 'xyz')


def times(kind):
    ticks = [START + timedelta(microseconds=k * 10**4) for k in range(N)]
    if kind == 'pandas':
        return [str(tick.astimezone(timezone(timedelta(hours=2)))) for tick in ticks]
    if kind == 'actipy':
        return [f'{tick:%Y-%m-%d %H:%M:%S.%f}'[:-3] + '+0000 [Europe/London]' for tick in ticks]
    if kind == 'epoch':
        return [f'{START_NS // 10**9 + k / 100:.2f}' for k in range(N)]
    return [str(START_NS + k * STEP_NS) for k in range(N)]


@pytest.mark.parametrize(
    ('kind', 'headings', 'unit', 'one_g'),
    [
        ('pandas', ',timestamp,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z,temperature', 'iso', 9.80665),
        ('actipy', ',time,x,y,z,wx,wy,wz,temperature', 'iso', 1.0),
        ('epoch', ',timestamp,X,Y,Z,rotX,rotY,rotZ,temperature', 's', 1.0),
        ('phone', f',Time (ns),{PHONE},temp [degC]', 'ns', 9.80665),
    ],
)
def test_a_table_is_read_by_its_headings(tmp_path, rng, kind, headings, unit, one_g):
    path = tmp_path / 'log.csv'
    accel = one_g * (UP + 0.002 * rng.standard_normal(UP.shape))
    rate = 0.01 * rng.standard_normal(UP.shape)
    rows = [
        ','.join([str(k), at, *(f'{v:.6f}' for v in (*a, *w)), f'{20 + k / 100:.2f}'])
        for k, (at, a, w) in enumerate(zip(times(kind), accel, rate, strict=True))
    ]
    path.write_text('\n'.join([headings, *rows]) + '\n')
    columns = guess_columns(path)
    assert (columns.stamp.unit, columns.accel.unit) == (unit, 'g' if one_g == 1.0 else 'm/s^2')
    (tmp_path / 'map.yaml').write_text('\n'.join(map_lines(columns)))
    assert load_column_map(tmp_path / 'map.yaml') == columns
    log = table_log(path, columns)
    assert log.stamp_ns.tolist() == (START_NS + STEP_NS * np.arange(N)).tolist()
    np.testing.assert_allclose(log.accel, accel, atol=1e-6)
    np.testing.assert_allclose(log.gyro, rate, atol=1e-6)
    assert (set(log.temperatures), log.temperatures['board'].celsius[0]) == ({'board'}, 20.0)


@pytest.mark.parametrize('kind', ['dates', 'text', 'numbers'])
def test_a_parquet_table_is_read_by_its_headings(tmp_path, rng, kind):
    pa = pytest.importorskip('pyarrow', reason='pyarrow of the extra `parquet` is not installed')
    import pyarrow.parquet as pq

    stamp_ns = START_NS + STEP_NS * np.arange(N)
    accel = UP + 0.002 * rng.standard_normal(UP.shape)
    dates = stamp_ns.astype('datetime64[ns]')
    time = {'dates': dates, 'text': times('pandas'), 'numbers': stamp_ns}[kind]
    columns = {'label': ['walk'] * N, 'timestamp': time, 'temperature': np.full(N, 20.5)}
    columns |= {f'acc_{axis}': accel[:, k] for k, axis in enumerate('xyz')}
    pq.write_table(pa.table(columns), tmp_path / 'log.parquet')
    guess = guess_columns(tmp_path / 'log.parquet')
    assert guess.accel.unit == 'g'
    log = table_log(tmp_path / 'log.parquet', guess)
    assert log.stamp_ns.tolist() == stamp_ns.tolist()
    np.testing.assert_array_equal(log.accel, accel)
    assert log.temperatures['board'].celsius[0] == 20.5


def test_the_accelerometer_is_chosen_among_several_triads_of_a_table():
    headings = 'now[ms],magx,magy,magz,linear_acc_x,linear_acc_y,linear_acc_z,acc_x [mg],'
    headings += 'acc_y [mg],acc_z [mg],gx[deg/s],gy[deg/s],gz[deg/s],gtemp,AHT_tmp[C],BMP_temp[K]'
    names = read_headings(headings.split(','))
    assert (names.time, names.time_unit, names.accel_unit) == ('now[ms]', 'ms', 'mg')
    assert names.accel == ('acc_x [mg]', 'acc_y [mg]', 'acc_z [mg]')
    assert (names.gyro, names.gyro_unit) == (('gx[deg/s]', 'gy[deg/s]', 'gz[deg/s]'), 'deg/s')
    first_two = {'board': ('gtemp', 'degC'), 'case': ('AHT_tmp[C]', 'degC')}
    assert names.thermometers == {**first_two, 't2': ('BMP_temp[K]', 'K')}
    assert read_headings(['time', 'magx', 'magy', 'magz']) is None


@pytest.mark.parametrize(
    ('headings', 'accel', 'units'),
    [  # units of the time, the accelerometer and the board
        ('time_us,AcX,AcY,AcZ,Tmp,GyX,GyY,GyZ', 'AcX', ('us', '', 'degC')),
        ('millis,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps,TempF', 'ax_g', ('ms', 'g', 'degF')),
        ('stamp,ax_mg,ay_mg,az_mg,temp_f', 'ax_mg', ('', 'mg', 'degF')),
        ('seconds,ax,ay,az,imu_temp_k', 'ax', ('s', '', 'K')),
        ('t [s],ax [g],ay [g],az [g],T [°C]', 'ax [g]', ('s', 'g', 'degC')),
        ('t,imu0_ax,imu0_ay,imu0_az,T_board,T_case', 'imu0_ax', ('', '', 'degC')),
        ('elapsed_h,ax,ay,az,temp (°F)', 'ax', ('h', '', 'degF')),
        # WHY: the `g` of `ax_g` was taken for a gyroscope: "column 'ax_g' is given twice".
        ('time,ax_g,ay_g,az_g,temp', 'ax_g', ('', 'g', 'degC')),
        ('t,acc_x_g,acc_y_g,acc_z_g,gx_dps,gy_dps,gz_dps,temp', 'acc_x_g', ('', 'g', 'degC')),
        # These headings are from PlotJuggler for sensor_msgs/Imu, and from the EuRoC data sets.
        ('__time,/imu/angular_velocity/x,/imu/angular_velocity/y,/imu/angular_velocity/z,'
         '/imu/linear_acceleration/x,/imu/linear_acceleration/y,/imu/linear_acceleration/z,temp',
         '/imu/linear_acceleration/x', ('', '', 'degC')),
        ('timestamp [ns],w_S_x [rad s^-1],w_S_y [rad s^-1],w_S_z [rad s^-1],a_S_x [m s^-2],'
         'a_S_y [m s^-2],a_S_z [m s^-2],temp', 'a_S_x [m s^-2]', ('ns', 'm/s^2', 'degC')),
    ],
)  # fmt: skip
def test_units_and_names_in_headings_of_loggers_are_recognised(headings, accel, units):
    # WHY: the column `temp_f` was read as degC; other common headings were not recognised.
    names = read_headings(headings.split(','))
    assert names.accel[0] == accel
    assert (names.time_unit, names.accel_unit, names.thermometers['board'][1]) == units


def slow_table(path, heading, times, first=20.0, last=45.0):
    """Write a log of one attitude in which the temperature changes from `first` to `last`."""
    up = np.tile([0.0, 5.88, 7.84], (len(times), 1))
    up += 0.01 * np.random.default_rng(0).standard_normal(up.shape)
    temperature = np.linspace(first, last, len(times))
    rows = [
        f'{at},{x:.4f},{y:.4f},{z:.4f},{t:.2f}'
        for at, (x, y, z), t in zip(times, up, temperature, strict=True)
    ]
    path.write_text('\n'.join([f'{heading},ax,ay,az,temp', *rows]) + '\n')
    return path


@pytest.mark.parametrize(
    ('unit', 'times', 'last'),
    [
        # WHY: a test of two hours at 1 Hz was read as 8 s at 1 kHz, even with stamps since 1970.
        *(('s', [since + step * k for k in range(4000)], 45.0)
          for since in (0, 1_774_747_800) for step in (1, 5)),
        # WHY: a table in which every seventh row occurs twice was refused: times did not rise.
        ('s', [k / 10 for k in range(900) for _ in range(2 if k % 7 == 0 else 1)], 45.0),
        # At rest at constant temperature the size and the step of the stamps show their unit.
        *((unit, [START_NS // size + step * k for k in range(900)], 20.0)
          for unit, size, step in (('s', 10**9, 2), ('ms', 10**6, 5000), ('us', 10**9, 10_000))),
    ],
)  # fmt: skip
def test_the_unit_of_the_times_of_a_slow_log_is_recognised(tmp_path, unit, times, last):
    path = slow_table(tmp_path / 'log.csv', 'time', times, last=last)
    assert guess_columns(path).stamp.unit == unit


@pytest.mark.parametrize(
    ('heading', 'times', 'reason'),
    [
        ('time [min]', [k / 600 for k in range(900)], r"'time \[min\]' is in min: the times must"),
        ('time', [k // 10 for k in range(900)], "'time' has the same time as the row before"),
        ('date', [46110 + k / 864000 for k in range(900)], 'no plausible interval of samples'),
        ('time', list(range(900, 0, -1)), "'time' is not a rising time"),
        # WHY: for dates that are not ISO 8601 the message was that no row has a number as stamp.
        *(('date', [cell] * 900, f"column 'date' is a date of ISO 8601.*'{cell}'")
          for cell in ('29/03/2026 01:30:00', '01:30:00.5')),
        # WHY: the message `column 'temp' is given twice` blamed the command line, not the table.
        ('t,temp', [f'{k / 10},20' for k in range(900)], r"log\.csv: 2 columns are called 'temp'"),
    ],
)  # fmt: skip
def test_columns_with_unusable_times_or_temperatures_are_refused(tmp_path, heading, times, reason):
    # WHY: times in minutes were read as seconds; times that do not rise gave a wrong message.
    path = slow_table(tmp_path / 'log.csv', heading, times)
    with pytest.raises(RecordingError, match=reason):
        read_log(path)


def test_a_table_with_blank_temperature_cells_is_read(tmp_path):
    # WHY: if the last cell of most rows was blank, the reader expected a further heading.
    path = slow_table(tmp_path / 'log.csv', 'time', [k / 100 for k in range(N)], last=31.99)
    head, *rows = path.read_text().splitlines()
    rows = [row if k % 100 == 0 else f'{row.rpartition(",")[0]},' for k, row in enumerate(rows)]
    path.write_text('\n'.join([head, *rows]) + '\n')
    log = table_log(path, guess_columns(path))
    assert len(log.accel) == N
    np.testing.assert_allclose(log.temperatures['board'].celsius, 20.0 + np.arange(12.0))


@pytest.mark.parametrize(
    ('comment', 'sign'), [('# t ax ay az temp', ' '), ('#t [s],ax,ay,az,temp', ',')]
)
def test_headings_in_a_comment_are_read(tmp_path, comment, sign):
    # WHY: numpy.savetxt and EuRoC write headings in a comment, and the reader skipped comments.
    path = slow_table(tmp_path / 'log.csv', 't', [k / 10 for k in range(900)])
    rows = path.read_text().replace(',', sign).splitlines()[1:]
    path.write_text('\n'.join(['# logger 3', comment, *rows]) + '\n')
    columns = guess_columns(path)
    assert columns.board.column == 'temp'
    assert len(table_log(path, columns).accel) == 900
    path.write_text('\n'.join(['# one two three four five', *rows]) + '\n')
    with pytest.raises(RecordingError, match='5 columns without headings'):
        guess_columns(path)


def test_a_temperature_in_millikelvins_and_a_force_without_gravity_are_refused(tmp_path):
    times = [k / 10 for k in range(900)]
    path = slow_table(tmp_path / 'log.csv', 'time', times, 20_000.0, 21_000.0)
    with pytest.raises(RecordingError, match='expected -90 to 200: the unit in a column map may'):
        write_log(table_log(path, guess_columns(path)), tmp_path / 'bag')
    # The linear acceleration that a phone logs does not contain gravity.
    names = [f'Linear acceleration {axis} (m/s^2)' for axis in 'xyz']
    rows = [f'{at},0.01,0.02,{0.01 * (k % 3)}' for k, at in enumerate(times)]
    path.write_text('\n'.join([','.join(['time', *names]), *rows]) + '\n')
    with pytest.raises(RecordingError, match=r'is not gravity in any known unit$'):
        write_log(table_log(path, guess_columns(path)), tmp_path / 'bag')


def test_a_table_whose_headings_name_no_time_needs_a_sample_rate(tmp_path, rng):
    # WHY: --rate-hz was ignored for tables with headings.
    path, rows = tmp_path / 'log.csv', UP + 0.002 * rng.standard_normal(UP.shape)
    path.write_text('\n'.join(['ax,ay,az', *(f'{x:.5f},{y:.5f},{z:.5f}' for x, y, z in rows)]))
    with pytest.raises(RecordingError, match="name no time: 'ax', 'ay', 'az'; give --rate-hz, or"):
        guess_columns(path)
    columns = guess_columns(path, 50.0)
    (tmp_path / 'map.yaml').write_text('\n'.join(map_lines(columns)))
    assert load_column_map(tmp_path / 'map.yaml') == columns
    np.testing.assert_array_equal(np.diff(table_log(path, columns).stamp_ns), 2 * 10**7)
    path.write_text('t,ax,ay,az\n' + '0,0,0,9.8\n' * 100)
    with pytest.raises(RecordingError, match=r"column 't' has the times .*leave out --rate-hz"):
        guess_columns(path, 100.0)


@pytest.mark.parametrize(
    ('headings', 'thermometers', 'not_used'),
    [  # WHY: thermometers with headings other than `temp`, `T_board` were left out silently.
        ('board_degC,case_degC,imu', ['board_degC', 'case_degC'], 'imu'),
        ('case,board,label', ['board', 'case'], 'label'),
        ('T_magnet_C,case [°C],die', ['T_magnet_C', 'case [°C]'], 'die'),
        ('imu_temp_raw,board_rev,die', ['die', None], 'imu_temp_raw, board_rev'),
        ('case_id,phase_b,phase_c', [None, None], 'case_id, phase_b, phase_c'),
    ],
)
def test_the_guessed_column_map_is_printed(tmp_path, rng, cli, headings, thermometers, not_used):
    accel, n = UP + 0.002 * rng.standard_normal(UP.shape), headings.count(',') + 1
    rows = [f'{k / 100:.2f},{x:.5f},{y:.5f},{z:.5f}' + f',{20 + k / 100}' * n
            for k, (x, y, z) in enumerate(accel)]  # fmt: skip
    (tmp_path / 'log.csv').write_text('\n'.join([f'time (s),ax,ay,az,{headings}', *rows]))
    printed = cli('convert', tmp_path / 'log.csv', '-o', tmp_path / 'bag').stdout
    assert f'log.csv: columns not used: {not_used}\n' in printed
    head, *lines = printed.splitlines()
    assert 'guessed column map; if the map is wrong, edit it for --columns' in head
    guess = yaml.safe_load('\n'.join(takewhile(lambda line: line.startswith('  '), lines)))
    assert guess['stamp'] == {'column': 'time (s)', 'unit': 's'}
    assert guess['accel'] == {'columns': ['ax', 'ay', 'az'], 'unit': 'g', 'output': 'imu'}
    assert [guess.get(name, {}).get('column') for name in ('board', 'case')] == thermometers
    (tmp_path / 'map.yaml').write_text('\n'.join(map_lines(guess)))
    again = ('--columns', tmp_path / 'map.yaml', '-o', tmp_path / 'again')
    assert f'not used: {not_used}\n' in cli('convert', tmp_path / 'log.csv', *again).stdout


@pytest.mark.parametrize(('last', 'unit'), [(3, None), (1200, None), (40, 'degC')])
def test_a_column_board_of_whole_numbers_is_a_temperature_only_if_plausible(tmp_path, last, unit):
    # The column `board` counts rows, or is 3 (number of a board), or rises from 3 to 40 degC.
    rows = [f'{k / 10},0,6,8,{3 + k * (last - 3) // 1199}' for k in range(1200)]
    (tmp_path / 'log.csv').write_text('\n'.join(['time,ax,ay,az,board', *rows]))
    board = guess_columns(tmp_path / 'log.csv').board
    assert (board and board.unit) == unit


def test_equal_guessed_column_maps_are_printed_once(tmp_path, rng, cli):
    tables = [tmp_path / f'{number}.csv' for number in range(3)]
    headings = ('time (s)', 'time (s)', 'time_s')
    for heading, level, table in zip(headings, np.eye(3), tables, strict=True):
        rows = np.c_[np.arange(4000) / 10.0, level + 0.002 * rng.normal(size=(4000, 3))]
        np.savetxt(table, rows, '%.5f', ',', header=f'{heading},ax,ay,az', comments='')
    printed = cli('fit', *tables, '-o', tmp_path / 'unit.yaml', '--gravity', '9.81').stdout
    assert f'{tables[1]}: same column map as {tables[0]}\n' in printed
    assert f'{tables[2]}: guessed column map' in printed
    assert printed.count('stamp: {column: ') == 2


@pytest.mark.parametrize(('one_g', 'bits'), [(4096.0, 15), (524288.0, 23), (1e8, 31)])
def test_counts_of_24_and_32_bits_are_not_saturated(rng, one_g, bits):
    rest = Rest(rng, level=(0.0, 0.0, one_g), sd=0.002 * one_g)
    rest.accel[:] = np.rint(rest.accel)
    rest.accel[100] = 2.0**bits - 1.0  # largest value of the converter
    bag = reduce_source(rest.source(), full_scale=32767.0)
    assert (bag.n_saturated, len(bag.intervals)) == (1, 1)


def write(path, rng, unit, **columns):
    """Write a table of rests; `unit`: reading at 1 g; times and angular rates are optional."""
    accel = unit * (UP + 0.002 * rng.standard_normal(UP.shape))
    parts = [columns['time'][:, None]] if 'time' in columns else []
    parts += [accel, columns['rate']] if 'rate' in columns else [accel]
    np.savetxt(path, np.hstack(parts), fmt='%.9g')
    return path


@pytest.mark.parametrize(
    ('unit', 'text', 'step', 'time_unit', 'rate_hz'),
    [
        (9.80665, 'm/s^2', 0.01, 's', 100), (1.0, 'g', 5.0, 'ms', 200),
        (1000.0, 'mg', 10000.0, 'us', 100), (4096.0, 'counts', 5e6, 'ns', 200),
    ],
)  # fmt: skip
def test_the_norm_at_rest_and_a_plausible_sample_rate_show_the_units(
    tmp_path, rng, unit, text, step, time_unit, rate_hz
):
    path = write(tmp_path / 'log.txt', rng, unit, time=step * np.arange(1, len(UP) + 1))
    columns = guess_columns(path)
    assert column_map_text(columns) == f'time [{time_unit}], x y z [{text}]'
    log = table_log(path, columns)
    np.testing.assert_array_equal(np.diff(log.stamp_ns), 10**9 // rate_hz)
    assert log.input == ('counts' if text == 'counts' else 'imu')
    write_log(log, tmp_path / 'bag.mcap')
    force = read_recording(tmp_path / 'bag.mcap', require=('accel',)).columns.accel
    expected = unit if text == 'counts' else 9.80665
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), expected, rtol=0.02)


def test_the_speed_of_a_turn_by_hand_shows_the_unit_of_times(tmp_path, rng):
    # WHY: 1 Hz was taken for 1 kHz. A turn by hand takes one interval of 1 s, or 800 of 1 ms each.
    angle = np.repeat([0.0, np.pi, 0.0], [400, 800, 400])
    ramp = np.clip((np.arange(1600) - 400) / 800, 0.0, 1.0) * np.pi
    for turned, unit in ((angle, 's'), (ramp, 'ms')):
        up = np.column_stack((np.cos(turned), np.sin(turned), 0.0 * turned))
        accel = 9.8 * (up + 0.002 * rng.standard_normal(up.shape))
        path = tmp_path / f'{unit}.txt'
        np.savetxt(path, np.column_stack((np.arange(1600.0), accel)), fmt='%.9g')
        assert guess_columns(path).stamp.unit == unit


@pytest.mark.parametrize(('rest_s', 'gap_s'), [(30, 0), (30, 670), (60, 1), (45, 3)])
def test_times_of_short_rests_at_1_hz_are_seconds(tmp_path, rng, rest_s, gap_s):
    # WHY: means over 30 and more samples contained two attitudes, so their |f| was below g.
    ups = positions(18, 1)
    accel = np.repeat(ups, rest_s, axis=0) + 2e-5 * rng.standard_normal((18 * rest_s, 3))
    times = (np.arange(18)[:, None] * (rest_s + gap_s) + np.arange(rest_s)).ravel()
    path = tmp_path / 'log.txt'
    np.savetxt(path, np.column_stack((times, 9.8 * accel)), fmt='%.9g')
    columns = guess_columns(path)
    assert column_map_text(columns) == 'time [s], x y z [m/s^2]'
    write_log(table_log(path, columns), tmp_path / 'bag.mcap')


@pytest.mark.parametrize(('fastest', 'unit'), [(3.0, 'rad/s'), (170.0, 'deg/s')])
def test_the_largest_angular_rate_shows_its_unit(tmp_path, rng, fastest, unit):
    rate = np.linspace(-fastest, fastest, 3 * len(UP)).reshape(-1, 3)
    path = write(tmp_path / 'log.txt', rng, 9.8, rate=rate)
    columns = guess_columns(path, 100.0)
    assert column_map_text(columns) == f'100 Hz, x y z [m/s^2], angular rate x y z [{unit}]'
    expected = rate if unit == 'rad/s' else np.radians(rate)
    gyro = table_log(path, columns).gyro
    assert gyro is not None
    np.testing.assert_allclose(gyro, expected, atol=1e-6)


def test_tables_whose_columns_cannot_be_identified_are_refused(tmp_path, rng):
    path = tmp_path / 'log.txt'
    time = 0.01 * np.arange(len(UP))
    for size, columns, rate_hz, reason in (
        (9.8, {}, None, 'the table has no times; give --rate-hz'),
        (9.8, {'time': time}, 100.0, 'its column 0 has the times'),
        (9.8, {'time': time[::-1]}, None, 'its column 0 is not a rising time'),
        (3.3, {'time': time}, None, 'not gravity in any known unit: give a column map'),
    ):
        with pytest.raises(RecordingError, match=reason):
            guess_columns(write(path, rng, size, **columns), rate_hz)
    for content, reason in (
        ('t,a,b,c\n' + '0,0,0,9.8\n' * 100, 'its headings name no accelerometer'),
        ('a,b,c\n1,2,3\n2,3,4\n', "name no accelerometer: 'a', 'b', 'c'; give a column map"),
        # WHY: decimal commas were taken for separators, so rows had more cells than headings.
        ('t;ax;ay;az\n' + '0,01;0,0;0,1;9,8\n' * 9, 'commas, it begins with 0,01: write decimal'),
        ('0 0 0 9.8 20\n' * 100, '5 columns without headings cannot be identified'),
    ):
        path.write_text(content)
        with pytest.raises(RecordingError, match=reason):
            guess_columns(path)
