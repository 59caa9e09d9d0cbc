# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and 2 with topics of any name are converted; the unit follows from |f| at rest."""

import re

import numpy as np
import pytest
from recording_helpers import typestore
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from thermo_comp.convert.bag import bag_log, find_topics
from thermo_comp.convert.log import contradiction, find_stillness, infer_unit, write_log
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording

G = 9.80665
N = 400
START_NS = 1_600_000_000_000_000_000
IMU, TEMPERATURE, PRESSURE = (
    f'sensor_msgs/msg/{name}' for name in ('Imu', 'Temperature', 'FluidPressure')
)
NAMES = {'/mpu/data': IMU, '/mpu/die': TEMPERATURE, '/baro/air': TEMPERATURE}


def messages(ros, rng, scale, names):
    """Yield (topic, type, log_ns, message) of a sensor at rest whose samples have norm `scale`."""
    types = typestore(ros).types
    vector = types['geometry_msgs/msg/Vector3']

    def header(stamp_ns):
        stamp = types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
        return types['std_msgs/msg/Header'](*(() if ros == 2 else (7,)), stamp, 'mpu')

    force = scale * (np.array([0.0, 0.1, 1.0]) + 0.003 * rng.standard_normal((N, 3)))
    zeros = np.zeros(9)
    for k in range(N):
        now = START_NS + 10_000_000 * k
        for topic, kind in names.items():
            if kind == IMU:
                attitude = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
                body = (attitude, zeros, vector(0.01, 0.0, 0.5), zeros, vector(*force[k]), zeros)
                yield topic, kind, now, types[kind](header(now), *body)
            elif k % 50 == 0:
                value = 100.0 * len(topic) + k / 50 if kind == PRESSURE else len(topic) + k / 50
                yield topic, kind, now, types[kind](header(now), value, 0.0)


def write_bag(path, rng, ros=2, scale=G):
    store = typestore(ros)
    new = {'version': 9, 'storage_plugin': StoragePlugin.SQLITE3}
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with Writer1(path) if ros == 1 else Writer2(path, **new) as writer:
        links = {t: writer.add_connection(t, kind, typestore=store) for t, kind in NAMES.items()}
        for topic, kind, log_ns, message in messages(ros, rng, scale, NAMES):
            writer.write(links[topic], log_ns, serialize(message, kind))
    return path


@pytest.mark.parametrize('ros', [1, 2])
def test_topics_of_any_name_are_converted_to_the_default_topics(tmp_path, rng, ros):
    path = write_bag(tmp_path / ('old.bag' if ros == 1 else 'new'), rng, ros)
    report = write_log(bag_log(path), tmp_path / 'bag.mcap')
    recording = read_recording(tmp_path / 'bag.mcap')
    assert report.messages['accel'] == N
    np.testing.assert_array_equal(
        recording.columns.accel_stamp_ns, START_NS + 10_000_000 * np.arange(N)
    )
    np.testing.assert_allclose(recording.columns.accel.mean(axis=0), (0.0, 0.1 * G, G), atol=0.02)
    np.testing.assert_array_equal(recording.columns.imu.angular_velocity[0], (0.01, 0.0, 0.5))
    # The thermometer in the namespace of the Imu is the board thermometer.
    np.testing.assert_array_equal(
        recording.columns.temperatures['board'].celsius, len('/mpu/die') + np.arange(8)
    )
    np.testing.assert_array_equal(
        recording.columns.temperatures['case'].celsius, len('/baro/air') + np.arange(8)
    )
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
        # A thermometer in the namespace of a barometer is the case's, also as the only
        # thermometer.
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
    both = present(['/imu/data'], ['/imu/t1', '/imu/t2'])
    chosen = find_topics(both, None, '/imu/t2', None)
    assert chosen['board'] == '/imu/t2'
    assert chosen['case'] == '/imu/t1'


def test_the_command_convert_reads_a_bag(tmp_path, rng, cli):
    bag = write_bag(tmp_path / 'bag', rng, scale=1.0)
    refused = cli('convert', bag, '-o', tmp_path / 'out.mcap', code=1)
    assert re.search(r'is m/s\^2, but .* looks like g', refused.stderr)
    finished = cli('convert', bag, '--unit', 'g', '-o', tmp_path / 'out.mcap')
    assert f'{N:8} imu/uncompensated' in finished.stdout
    force = read_recording(tmp_path / 'out.mcap').columns.accel
    np.testing.assert_allclose(force.mean(axis=0), (0.0, 0.1 * G, G), atol=0.02)
    assert finished.stderr == (
        f'thermo_comp: {bag}: /mpu/data, its only Imu, is taken for imu; /mpu/die, its nearest '
        'Temperature, is taken for board; /baro/air, its nearest Temperature, is taken for case\n'
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
    [
        (1.019, 'g'),  # an MPU6050 with 2 % of bias
        (0.85, 'g'),
        (9.78, 'm/s^2'),
        (10.4, 'm/s^2'),
        (1003.0, 'mg'),
        (2051.0, 'counts'),
        (16100.0, 'counts'),
        (3003.0, 'counts'),
        (0.1, 'unknown'),
        (32.2, 'unknown'),  # gravity in ft/s^2
    ],
)
def test_the_unit_follows_from_the_norm_at_rest(magnitude, unit):
    inferred, reason = infer_unit(magnitude)
    assert inferred == unit
    assert f'{magnitude:.4g}' in reason


def test_a_stated_unit_that_may_be_true_is_not_contradicted():
    assert contradiction('g', 1.15, None) is None
    assert contradiction('m/s^2', 9.6, None) is None
    # Any |a| at rest above 50 may be in counts, because converters differ in their bits.
    assert contradiction('counts', 2941.7, None) is None
    assert contradiction('counts', 2060.0, 2048.0) is None
    # Without a rest |a| is unknown, and no unit is refused.
    assert contradiction('g', float('nan'), None) is None


def shaken(rng, n, scale, noise):
    accel = scale * np.array([0.6, 0.0, 0.8]) + noise * rng.standard_normal((n, 3))
    middle = slice(2 * n // 5, 3 * n // 5)
    accel[middle] += 20.0 * noise * rng.standard_normal((len(accel[middle]), 3))
    return accel


@pytest.mark.parametrize('scale', [1.0, 9.81, 2048.0])
def test_movement_is_found_in_any_unit(rng, scale):
    n = 5000
    stamp_ns = np.arange(1, n + 1) * 10_000_000
    stillness = find_stillness(stamp_ns, shaken(rng, n, scale, 1e-3 * scale))
    # The sensor is shaken from 20 to 30 s.
    assert [(t0 * 1e-9, t1 * 1e-9) for t0, t1 in stillness.moving_ns] == [
        (pytest.approx(20.01), pytest.approx(30.01))
    ]
    # A mean over 2 s at 100 Hz of samples with a noise of 0.1 % has a noise of 0.1 % / sqrt(200).
    assert stillness.magnitude == pytest.approx(scale, rel=3e-4)
    assert stillness.noise == pytest.approx(1e-3 * scale, rel=0.1)
    assert stillness.still_s == pytest.approx(40.0, abs=0.5)


def test_rare_steps_of_a_coarse_sensor_are_not_taken_for_motion(rng):
    # If rounding steps are larger than the noise, samples at rest change by a step now and then.
    accel = np.tile([0.0, 0.0, 1.0], (1000, 1))
    accel[::97, 0] = 0.1
    stillness = find_stillness(np.arange(1000) * 10_000_000, accel)
    assert stillness.moving_ns == ()
    assert stillness.magnitude == pytest.approx(1.0, rel=1e-3)


def test_the_stillness_of_five_samples_is_unknown():
    stillness = find_stillness(np.arange(5), np.ones((5, 3)))
    assert np.isnan(stillness.magnitude)
    assert stillness.moving_ns == ()
    assert np.isnan(find_stillness(np.arange(1), np.ones((1, 3))).magnitude)
