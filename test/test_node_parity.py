# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node, into which a bag is played over DDS, and the offline replay give the same bits."""

import csv
import gc
from dataclasses import replace

import numpy as np
import pytest
from recording_helpers import imu_columns

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from builders import START_NS, rich_calibration
from live_node import through_the_node
from rosbags.highlevel import AnyReader

from thermo_comp.recording.blocks import ImuColumns
from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import replay
from thermo_comp.topics import IMU_OUT, REGIME, STAMPED
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration

TOPICS = Topics()
RATE_HZ = 1
MINUTES = 18
UNIT = Unit('T-1', 'counts', 32767.0, 1.0 / RATE_HZ)


@pytest.fixture(autouse=True)
def _collected():
    """Free objects in circular references, as the next test would see their ROS nodes."""
    yield
    gc.collect()


def thermal_test(path, imu=False, has_case=True):
    """Write a bag of soak, ramp and soak, with some late readings; return the sample count."""
    rng = np.random.default_rng(11)
    n = MINUTES * 60 * RATE_HZ
    stamps = START_NS + np.arange(1, n + 1) * (1_000_000_000 // RATE_HZ)
    seconds = np.arange(0.0, MINUTES * 60.0, 2.0)
    case = np.interp(seconds, [0.0, 400.0, 800.0], [15.0, 15.0, 25.0])
    board = np.interp(seconds - 100.0, [0.0, 400.0, 800.0], [16.0, 16.0, 26.0])
    reading_ns = START_NS + (seconds * 1e9).astype(np.int64)
    accel = np.array([5.0, -3.0, 310.0 * 9.80665]) + rng.integers(-4, 5, (n, 3))
    with BagWriter(path) as writer:
        for topic, values, late_ns in (
            (TOPICS.board, board, 350_000_000),
            (TOPICS.case, case, 1_250_000_000),
            ('temperature/frame', 0.5 * (board + case) + 1.0, 700_000_000),
        ):
            if topic == TOPICS.case and not has_case:
                continue
            noisy = values + 0.004 * rng.standard_normal(len(values))
            late = late_ns * (rng.random(len(values)) < 0.3)
            writer.write_temperature(topic, reading_ns, noisy, reading_ns + late)
        if imu:
            rest = imu_columns(rng, n)
            rest.angular_velocity_covariance[::10, 0] = -1.0
            rest.angular_velocity[3::50, 1] = np.nan
            covariance = rest.linear_acceleration_covariance
            covariance[5::50, 0] = -1.0
            force = accel / [300.0, -295.0, 310.0]
            writer.write_imu(TOPICS.imu, stamps, force, covariance, 'imu_link', imu=rest)
        else:
            writer.write_counts(TOPICS.counts, stamps, accel, 'imu_link')
    return n


def output_of(path):
    with AnyReader([path]) as reader:

        def messages(topic):
            wanted = [link for link in reader.connections if link.topic.endswith(topic.name)]
            return [(link.msgtype, bytes(data)) for link, _, data in reader.messages(wanted)]

        flags = [bool(reader.deserialize(data, kind).data) for kind, data in messages(REGIME)]
        stamped = [data for _, data in messages(STAMPED)]
    topics = Topics(imu=IMU_OUT.name, input='imu')
    return read_recording(path, topics, require=('accel',)).columns, flags, stamped


def run(calibration, bag, folder, *node_args, **keys):
    save_calibration(calibration, folder / 'unit.yaml')
    live, offline = folder / 'live.mcap', folder / 'offline.mcap'
    played, recorded = through_the_node(bag, folder / 'unit.yaml', live, *node_args)
    result = replay(bag, calibration, offline, **keys)
    assert not played.unheard
    assert not played.lossy
    out, flags, stamped = output_of(live)
    expected, *expected_flags = output_of(offline)
    assert out.frame_id == expected.frame_id
    assert out.accel_stamp_ns.tolist() == expected.accel_stamp_ns.tolist()
    assert np.flatnonzero((out.accel != expected.accel).any(axis=1)).tolist() == []
    for name in ImuColumns._fields:
        assert getattr(out.imu, name).tobytes() == getattr(expected.imu, name).tobytes(), name
    # Each case reading has a regime flag, so equal flags mean equal switching times.
    assert [flags, stamped] == expected_flags
    assert ({*flags}, len(stamped)) == ({False, True}, len(flags))
    assert recorded['imu/data_raw'] == result.counters.n_out
    assert recorded['regime/dynamic'] == result.n_flags
    return result.counters.n_out


def test_node_and_replay_give_equal_output_for_counts(tmp_path):
    n = thermal_test(tmp_path / 'bag')
    unit = replace(rich_calibration(), unit=UNIT)
    # The first board temperature arrives in time, so every sample is corrected.
    assert run(unit, tmp_path / 'bag', tmp_path) == n


@pytest.mark.slow
def test_without_a_case_sensor_the_board_rate_selects_the_regime(tmp_path):
    n = thermal_test(tmp_path / 'bag', has_case=False)
    unit = replace(rich_calibration(), unit=UNIT)
    assert run(unit, tmp_path / 'bag', tmp_path) == n
    replay(tmp_path / 'bag', unit, tmp_path / 'out.csv')
    with (tmp_path / 'out.csv').open() as file:
        regimes = {row['regime'] for row in csv.DictReader(file)}
    assert regimes == {'unknown', 'static', 'dynamic'}


def test_node_and_replay_give_equal_output_for_imu_messages(tmp_path):
    thermal_test(tmp_path / 'bag.mcap', imu=True)
    unit = replace(rich_calibration(), unit=replace(UNIT, input='m/s^2', full_scale=160.0))
    axes = {axis: replace(getattr(unit.axes, axis), scale_factor=1.0, bias=0.0) for axis in 'xyz'}
    unit = replace(unit, axes=replace(unit.axes, **axes))
    args = ['-p', 'input:=imu', '-p', 'frame_id:=tilted']
    assert run(unit, tmp_path / 'bag.mcap', tmp_path, *args, frame_id='tilted') > 0
    given = read_recording(tmp_path / 'bag.mcap', Topics(input='imu'), require=('accel',)).columns
    published, _, _ = output_of(tmp_path / 'live.mcap')
    given = given.imu.take(np.flatnonzero(np.isin(given.accel_stamp_ns, published.accel_stamp_ns)))
    is_rate = given.angular_velocity_covariance[:, 0] != -1.0
    # The node corrects measured angular rates, and keeps rates that are marked as missing.
    moved = np.abs(published.imu.angular_velocity - given.angular_velocity)
    assert moved[~is_rate].max() == 0.0
    # WHY: a rate of NaN was published with the variances of a corrected rate.
    assert (given.linear_acceleration_covariance[:, 0] != -1.0).all()
    is_nan = np.isnan(published.imu.angular_velocity).any(axis=1)
    assert 0 < np.count_nonzero(is_nan) < len(is_nan) / 10
    assert {*published.imu.angular_velocity_covariance[is_nan, 0]} == {-1.0}
    is_rate &= ~is_nan
    # The biases of `rich_gyroscope` at the reference temperature are 10 mrad/s and more.
    assert moved[is_rate].min() > 1e-3
    claimed = published.imu.angular_velocity_covariance[is_rate].reshape(-1, 3, 3)
    assert (np.linalg.eigvalsh(claimed) > 0.0).all()
