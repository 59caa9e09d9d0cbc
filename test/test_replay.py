# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""`replay` has the bits of a compensator that processes the messages one by one."""

import csv
import dataclasses
import tracemalloc

import numpy as np
import pytest
from builders import SECOND_NS, START_NS, calibration, equal_axes, rich_calibration
from recording_helpers import BOOL, OTHER, Message, imu_columns, regular_messages, write_rosbag1
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from thermo_comp.errors import CalibrationError, OutputError, RecordingError
from thermo_comp.recording.reader import open_recording, read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import ReplayResult, replay
from thermo_comp.topics import IMU_OUT, REGIME
from thermo_comp.unit.calibration import Unit

TOPICS = Topics()


def thermal_test(path, minutes=30.0, rate_hz=5.0, serial='', is_imu=False):
    """Write a bag of a ramp between two soaks, in seven parts; the board lags the case."""
    rng = np.random.default_rng(7)
    n = round(minutes * 60.0 * rate_hz)
    stamps = START_NS + np.rint((np.arange(n) + 1.0) * (1e9 / rate_hz)).astype(np.int64)
    seconds = np.arange(0.0, minutes * 60.0, 1.0)
    case = np.interp(seconds, [0.0, 600.0, 1500.0], [12.0, 12.0, 27.0])
    board = np.interp(seconds - 200.0, [0.0, 600.0, 1500.0], [14.0, 14.0, 28.0])
    reading_ns = START_NS + (seconds * 1e9).astype(np.int64)
    accel = np.array([1800.0, -300.0, 2300.0]) + rng.integers(-3, 4, (n, 3))
    metadata = {'serial': serial} if serial else {}
    parts = (np.array_split(np.arange(size), 7) for size in (n, len(seconds)))
    with BagWriter(path, metadata=metadata) as writer:
        for rows, readings in zip(*parts, strict=True):
            for topic, values in ((TOPICS.board, board), (TOPICS.case, case)):
                noisy = values[readings] + 0.004 * rng.standard_normal(len(readings))
                writer.write_temperature(topic, reading_ns[readings], noisy)
            if is_imu:
                imu = imu_columns(rng, len(rows))
                given = accel[rows] / 300.0, imu.linear_acceleration_covariance, 'imu_link'
                writer.write_imu(TOPICS.imu, stamps[rows], *given, imu=imu)
            else:
                writer.write_counts(TOPICS.counts, stamps[rows], accel[rows], 'imu_link')
            writer.flush()
    return path


def output_of(path):
    flags, stamped = [], []
    with AnyReader([path]) as reader:
        regime = '/' + REGIME.name
        wanted = [c for c in reader.connections if c.topic in (regime, '/regime/stamped')]
        for connection, log_ns, data in reader.messages(wanted) if wanted else ():
            array = reader.deserialize(data, connection.msgtype)
            if connection.topic == regime:
                flags.append((log_ns, bool(array.data)))
                continue
            (status,) = array.status
            assert (array.header.frame_id, status.name, status.level) == ('', 'regime', 0)
            assert (status.hardware_id, status.values) == ('T-1', [])
            assert status.message in ('dynamic', 'static')
            stamp = array.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == log_ns
            stamped.append((log_ns, status.message == 'dynamic'))
    assert stamped == flags
    topics = Topics(imu=IMU_OUT.name, input='imu')
    return read_recording(path, topics, require=('accel',)).columns, flags


def test_replay_of_constants_needs_no_thermometer(tmp_path):
    bag = tmp_path / 'bag'
    rng = np.random.default_rng(3)
    n = 3000
    stamps = START_NS + np.arange(n) * 10_000_000
    with BagWriter(bag) as writer:
        writer.write_counts(TOPICS.counts, stamps, 2940.0 + rng.standard_normal((n, 3)), 'imu')
    replay(bag, calibration(axes=equal_axes(510.0, 5.0)), tmp_path / 'out')
    source = read_recording(bag, require=('accel',)).columns
    block, flags = output_of(tmp_path / 'out')
    np.testing.assert_allclose(block.accel, (source.accel - 5.0) / 510.0, rtol=1e-14)
    assert flags == []
    with pytest.raises(RecordingError, match='temperature/board'):
        replay(bag, rich_calibration(), tmp_path / 'other')


def test_infinite_board_readings_hide_no_warning_of_the_range(tmp_path):
    bag, stamps = tmp_path / 'bag', START_NS + np.arange(300) * SECOND_NS
    celsius = np.full(300, 90.0)
    celsius[100:150], celsius[200:205] = np.inf, -np.inf
    with BagWriter(bag) as writer:
        writer.write_counts(TOPICS.counts, stamps, 2000.0 + np.arange(900).reshape(300, 3), 'imu')
        writer.write_temperature(TOPICS.board, stamps, celsius)
    result = replay(bag, rich_calibration(), tmp_path / 'out')
    assert any('board temperature +' in note for note in result.notes)


def test_inputs_are_copied_unchanged(tmp_path):
    bag = thermal_test(tmp_path / 'bag', minutes=3.0)
    replay(bag, rich_calibration(), tmp_path / 'out', keep_inputs=True)
    with AnyReader([bag]) as before, AnyReader([tmp_path / 'out']) as after:
        messages = {}
        for connection, _, data in before.messages():
            messages.setdefault(connection.topic, []).append(bytes(data))
        copies = {}
        for connection, log_ns, data in after.messages():
            if connection.topic in messages:
                copies.setdefault(connection.topic, []).append(bytes(data))
                stamp = after.deserialize(data, connection.msgtype).header.stamp
                assert log_ns == stamp.sec * SECOND_NS + stamp.nanosec
    assert copies == messages


def test_another_unit_is_refused_unless_serial_names_it_or_is_empty_and_another_input_too(
    tmp_path,
):
    bag = thermal_test(tmp_path / 'bag', minutes=1.0, serial='T-2')
    calibration = rich_calibration()
    for serial in (None, 'T-2'):
        with pytest.raises(CalibrationError, match=r'is of unit T-1.* is (of unit )?T-2 '):
            replay(bag, calibration, tmp_path / 'out', serial=serial)
    assert not (tmp_path / 'out').exists()
    assert isinstance(replay(bag, calibration, tmp_path / 'a', serial=''), ReplayResult)
    assert isinstance(replay(bag, calibration, tmp_path / 'b', serial='T-1'), ReplayResult)
    bag = thermal_test(tmp_path / 'imu', minutes=1.0, is_imu=True)
    with pytest.raises(CalibrationError, match=r'takes samples in counts.*are sensor_msgs/Imu'):
        replay(bag, calibration, tmp_path / 'out', topics=Topics(input='imu'))
    with pytest.raises(RecordingError, match='accel/counts'):
        replay(bag, calibration, tmp_path / 'out')


def test_memory_does_not_grow_with_the_bag(tmp_path, monkeypatch):
    # Blocks have 2048 messages, so each bag has many blocks; a unit cycle of 2 ms allows 500 Hz.
    monkeypatch.setattr('thermo_comp.recording.blocks.BLOCK_MESSAGES', 1 << 11)
    calibration = rich_calibration()
    unit = dataclasses.replace(calibration.unit, cycle_time_s=0.002)
    calibration = dataclasses.replace(calibration, unit=unit)
    peaks, held = [], []
    for name, minutes in (('short', 1.0), ('long', 3.0)):
        bag = thermal_test(tmp_path / name, minutes=minutes, rate_hz=500.0)
        held.clear()
        tracemalloc.start()
        result = replay(
            *(bag, calibration, tmp_path / f'{name}.mcap'),
            progress=lambda part: held.append((part, tracemalloc.get_traced_memory()[0])),
        )
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert result.counters.n_out == minutes * 60.0 * 500.0
        parts, held_bytes = zip(*held, strict=True)
        assert list(parts) == sorted(parts)
        assert parts[-1] == 1.0
    # Three times the messages need more memory only for the list of regime flags.
    assert peaks[1] < 1.1 * peaks[0]
    third = len(parts) // 3
    assert max(held_bytes[-third:]) < 1.15 * max(held_bytes[:third])


@pytest.mark.parametrize('imu', [False, True])
def test_an_output_table_has_the_values_of_the_output_bag(tmp_path, imu):
    pq = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')
    bag = thermal_test(tmp_path / 'bag', rate_hz=2.0, is_imu=imu)
    unit = {'unit': Unit('T-1', 'm/s^2', 100.0, 0.1)} if imu else {}
    calibration = dataclasses.replace(rich_calibration(), **unit)
    for name in ('out', 'out.csv', 'out.parquet'):
        replay(bag, calibration, tmp_path / name)
    block, flags = output_of(tmp_path / 'out')
    with (tmp_path / 'out.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    parquet = pq.read_table(tmp_path / 'out.parquet')
    assert parquet.schema.metadata[b'serial'] == b'T-1'
    covariance = block.imu.linear_acceleration_covariance
    expected = {
        'stamp_ns': block.accel_stamp_ns,
        **{f'specific_force_{a}_m_s2': block.accel[:, i] for i, a in enumerate('xyz')},
    }
    for i, j in zip(*np.triu_indices(3), strict=True):
        expected[f'covariance_{"xyz"[i]}{"xyz"[j]}_m2_s4'] = covariance[:, 3 * i + j]
    if imu:
        for i, a in enumerate('xyz'):
            expected[f'angular_velocity_{a}_rad_s'] = block.imu.angular_velocity[:, i]
    assert set(rows[0]) == set(parquet.column_names) == {*expected, 'regime'}
    for name, column in expected.items():
        assert np.array_equal(parquet[name].to_numpy(), column), name
        number = int if name == 'stamp_ns' else float
        assert [number(row[name]) for row in rows] == column.tolist(), name
    regimes = parquet['regime'].to_pylist()
    assert [row['regime'] for row in rows] == regimes
    names = {False: 'static', True: 'dynamic'}
    for k in (0, len(rows) // 3, len(rows) // 2, len(rows) - 1):
        before = [value for stamp, value in flags if stamp <= block.accel_stamp_ns[k]]
        assert regimes[k] == (names[before[-1]] if before else 'unknown')
    assert len(rows) == len(block) > 0
    assert imu or set(regimes) == {'unknown', 'static', 'dynamic'}


def test_copies_that_are_impossible_are_refused_and_leave_no_output(tmp_path):
    bag = thermal_test(tmp_path / 'bag', minutes=1.0)
    with pytest.raises(OutputError, match='can only contain the corrected'):
        replay(bag, rich_calibration(), tmp_path / 'out.csv', all_topics=True)
    (tmp_path / 'ros1').mkdir()
    bag = tmp_path / 'ros1' / 'bag.bag'
    write_rosbag1(bag, [*regular_messages(40), Message(OTHER, START_NS)])
    with pytest.raises(RecordingError, match=f"{OTHER}: .* encoded as 'ros1', expected cdr"):
        replay(bag, rich_calibration(), bag.with_name('out.mcap'), all_topics=True)
    assert list(bag.parent.iterdir()) == [bag]


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_option_all_topics_copies_every_topic(tmp_path, storage):
    inputs = thermal_test(tmp_path / 'inputs', minutes=2.0)
    mcap = tmp_path / 'bag'
    stamps = START_NS + np.arange(-3, 150) * 10**9
    messages = [f'message {k}'.encode() * (1 + k % 3) for k in range(len(stamps))]
    with open_recording(inputs) as reader, BagWriter(mcap) as writer:
        for block in reader.blocks(raw=True):
            for role, raw in block.raw.items():
                name = reader.topics[role]
                writer.write_raw(name, reader.info.topics[name][0], raw.log_ns, raw)
        writer.write_raw('odd', 'odd_msgs/msg/Odd', stamps, messages, ('ros2msg', 'string data'))
        flags = [bytes((0, 1, 0, 0, k % 2)) for k in range(len(stamps))]
        writer.write_raw('gps/ok', BOOL, stamps, flags)
        writer.write_raw(IMU_OUT.name, BOOL, stamps, [bytes((0, 1, 0, 0, 0))] * len(stamps))
    bag = mcap
    if storage == 'sqlite3':
        bag = tmp_path / 'sqlite'
        with (
            AnyReader([mcap]) as reader_of_all,
            Writer(bag, version=9, storage_plugin=StoragePlugin.SQLITE3) as sqlite,
        ):
            for source in reader_of_all.connections:
                content = {'msgdef': source.msgdef.data, 'rihs01': source.digest or 'RIHS01_0'}
                copied = sqlite.add_connection(source.topic, source.msgtype, **content)
                for _, stamp, data in reader_of_all.messages(connections=[source]):
                    sqlite.write(copied, stamp, data)
    replay(bag, rich_calibration(), tmp_path / 'out', all_topics=True)
    replay(bag, rich_calibration(), tmp_path / 'plain')
    with AnyReader([tmp_path / 'out']) as copy, AnyReader([mcap]) as given:
        for topic in ('/odd', '/gps/ok', '/accel/counts', '/temperature/board'):
            copied, original = (
                [(stamp, bytes(data)) for to, stamp, data in bag.messages() if to.topic == topic]
                for bag in (copy, given)
            )
            assert copied == original, topic
        (output,) = (link for link in copy.connections if link.topic == f'/{IMU_OUT.name}')
        assert output.msgtype == 'sensor_msgs/msg/Imu'
        times = [stamp for _, stamp, _ in copy.messages()]
        assert times == sorted(times)
    first, second = (output_of(tmp_path / name)[0] for name in ('out', 'plain'))
    assert np.array_equal(first.accel, second.accel)
