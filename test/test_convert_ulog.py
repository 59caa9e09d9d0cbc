# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""PX4 logs, written here as the public format description of ULog states, become bags."""

import struct

import numpy as np
import pytest

from thermo_comp.convert.autopilot import read_autopilot
from thermo_comp.convert.log import write_log
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording

pytest.importorskip('pyulog', reason='pyulog of the extra `px4` is not installed')

ACCEL = 'sensor_accel:uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;'
ACCEL += 'float x;float y;float z;float temperature;uint32_t error_count;uint8_t[3] clip_counter;'
OLD_ACCEL = 'sensor_accel:uint64_t timestamp;float x;float y;float z;float temperature;'
GYRO = 'sensor_gyro:uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;'
BARO = 'sensor_baro:uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;'
BARO += 'float pressure;float temperature;uint32_t error_count;'
N = 600
STEP_US = 10_000


class UlogWriter:
    def __init__(self, *formats):
        self.body = b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 0)
        self.message('B', bytes(40))
        for text in formats:
            self.message('F', text.encode())
        self.message('I', b'\x0echar[5] ver_hwTESTB')
        self.n_subscribed = 0

    def message(self, kind, payload):
        self.body += struct.pack('<HB', len(payload), ord(kind)) + payload

    def subscribe(self, topic, instance):
        self.message('A', struct.pack('<BH', instance, self.n_subscribed) + topic.encode())
        self.n_subscribed += 1
        return self.n_subscribed - 1

    def data(self, subscription, payload):
        self.message('D', struct.pack('<H', subscription) + payload)


def still(rng, n=N, sd=0.03):
    """Make forces at rest [m/s^2], with z down as in PX4, as numbers of single precision."""
    return np.float32(np.array([0.2, -0.1, -9.8]) + sd * rng.standard_normal((n, 3)))


def write_two_imus(path, rng, gyro_every=1):
    log = UlogWriter(ACCEL, GYRO, BARO)
    ids = [log.subscribe('sensor_accel', i) for i in (0, 1)]
    gyro_id, baro_id = log.subscribe('sensor_gyro', 0), log.subscribe('sensor_baro', 0)
    force = [still(rng), still(rng)]
    celsius = [np.float32(30 + 0.01 * np.arange(N)), np.float32(25 - 0.01 * np.arange(N))]
    for k in range(N):
        now = 5_000_000 + k * STEP_US
        for i, number in enumerate(ids):
            row = (now + 400, now + i, 77 + i, *force[i][k], celsius[i][k], 0, 0, 0, 0)
            log.data(number, struct.pack('<QQIffffI3B', *row))
        if k % gyro_every == 0:
            log.data(gyro_id, struct.pack('<QQfff', now + 400, now, 0.001 * k, 0.0, -0.5))
        if k % 50 == 0:
            row = (now + 90, now, 9, 1e5, 20 + 0.5 * (k // 50), 0)
            log.data(baro_id, struct.pack('<QQIffI', *row))
    path.write_bytes(log.body)
    return {'force': np.array(force), 'celsius': np.array(celsius)}


def write_old(path, force, step_us, celsius=31.5, warming=0.0):
    """Write samples in the old format: a stamp per message, no separate times of samples."""
    log = UlogWriter(OLD_ACCEL)
    number = log.subscribe('sensor_accel', 0)
    for k, row in enumerate(force):
        now = 1_000_000 + k * step_us
        log.data(number, struct.pack('<Qffff', now, *row, celsius + warming * k))
    path.write_bytes(log.body)
    return path


@pytest.fixture
def flight(tmp_path, rng):
    path = tmp_path / 'flight.ulg'
    return path, write_two_imus(path, rng)


@pytest.mark.parametrize('imu', [0, 1])
def test_each_imu_of_a_log_can_become_a_bag(flight, tmp_path, imu):
    path, truth = flight
    report = write_log(read_autopilot(path, imu=imu), tmp_path / 'bag.mcap')
    recording = read_recording(tmp_path / 'bag.mcap')
    bag = recording.columns
    assert report.messages['accel'] == N
    # A stamp is the time at which the IMU took the sample, not the time of publication.
    expected_ns = (5_000_000 + np.arange(N) * STEP_US + imu) * 1000
    np.testing.assert_array_equal(bag.accel_stamp_ns, expected_ns)
    np.testing.assert_array_equal(bag.accel, truth['force'][imu])
    np.testing.assert_array_equal(bag.temperatures['board'].celsius, truth['celsius'][imu])
    np.testing.assert_array_equal(bag.temperatures['case'].celsius, 20 + 0.5 * np.arange(12))
    assert recording.info.metadata['serial'] == f'px4-accel-{77 + imu}'


def test_the_gyroscope_of_an_instance_is_in_its_bag_unless_it_is_sparsely_logged(
    flight, tmp_path, rng
):
    path, _ = flight
    write_log(read_autopilot(path, imu=0), tmp_path / 'bag.mcap')
    rate = read_recording(tmp_path / 'bag.mcap').columns.imu.angular_velocity
    # Gyroscope and accelerometer have equal stamps; values are rounded to single precision.
    np.testing.assert_allclose(rate[:, 0], 0.001 * np.arange(N), atol=1e-6)
    assert read_autopilot(path, imu=1).gyro is None
    write_two_imus(path, rng, gyro_every=5)
    assert read_autopilot(path).gyro is None


def test_logs_without_sample_times_or_a_thermometer_are_read(tmp_path, rng):
    force = still(rng)
    read = read_autopilot(write_old(tmp_path / 'old.ulg', force, STEP_US))
    np.testing.assert_array_equal(read.accel, force)
    assert 'case' not in read.temperatures
    # A constant temperature is written every 10 s, so once in this log of 6 s.
    np.testing.assert_array_equal(read.temperatures['board'].celsius, [31.5])
    log = UlogWriter(ACCEL)
    number = log.subscribe('sensor_accel', 0)
    for k, force in enumerate(still(rng)):
        now = 1_000_000 + k * STEP_US
        row = (now, now, 1, *force, float('nan'), 0, 0, 0, 0)
        log.data(number, struct.pack('<QQIffffI3B', *row))
    path = tmp_path / 'cold.ulg'
    path.write_bytes(log.body)
    assert not read_autopilot(path).temperatures


def test_a_torn_ulog_is_read_up_to_the_cut_and_other_files_are_refused(flight, tmp_path):
    path, truth = flight
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    read = read_autopilot(path)
    n = len(read.stamp_ns)
    assert 250 < n < 350
    np.testing.assert_array_equal(read.accel, truth['force'][0][:n])
    path = write_old(tmp_path / 'quiet.ulg', [(0.0, 0.0, -9.80665)] * N, STEP_US, 35.0)
    with pytest.raises(RecordingError, match=r'no noise at all.*simulator'):
        read_autopilot(path)
    path, baro = tmp_path / 'refused.ulg', UlogWriter(BARO)
    baro.data(baro.subscribe('sensor_baro', 0), struct.pack('<QQIffI', 1, 1, 9, 1e5, 20.0, 0))
    unstamped = UlogWriter('sensor_accel:float x;float y;float z;')
    number = unstamped.subscribe('sensor_accel', 0)
    unstamped.data(number, struct.pack('<fff', 0.0, 0.0, 1.0))
    for content, message in (
        (baro.body, 'the log holds no IMU'),
        (unstamped.body, r'not a ULog file|holds no IMU'),
        *((text, 'not a ULog file') for text in (b'', b'ULog', b'time,x,y,z\n1,2,3,4\n' * 10)),
    ):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            read_autopilot(path)


COMBINED = 'sensor_combined:uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;'
COMBINED += 'int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;'
COMBINED += 'uint32_t accelerometer_integral_dt;'
AIR = 'vehicle_air_data:uint64_t timestamp;uint64_t timestamp_sample;float baro_temp_celcius;'


def write_combined(path, rng, later=None, **parameters):
    """Write a log with sensor_combined only, as earlier versions of PX4 do by default."""
    log = UlogWriter(COMBINED, AIR)
    for name, value in parameters.items():
        log.message('P', parameter(name, value))
    number, air = log.subscribe('sensor_combined', 0), log.subscribe('vehicle_air_data', 0)
    force = still(rng)
    for k, vector in enumerate(force):
        now = 7_000_000 + k * STEP_US
        rows = [(-200, vector)]
        if k == 3:
            # Add a message without accelerometer sample, and a message that repeats a sample.
            rows += [(2**31 - 1, vector), (-200 - 50, vector)]
        for j, (relative, own) in enumerate(rows):
            row = (now + (50 if j == 2 else 0), 0.1, 0.2, 0.3, 5000, relative, *own, 5000)
            log.data(number, struct.pack('<QfffIifffI', *row))
        if k % 100 == 0:
            log.data(air, struct.pack('<QQf', now, now, 40.0 + 0.01 * k))
        for name, value in (later or {}).items():
            if k == N // 2 - 1:
                log.message('P', parameter(name, value))
    path.write_bytes(log.body)
    return force


def parameter(name, value):
    key = f'int32_t {name}'.encode()
    return bytes([len(key)]) + key + struct.pack('<i', value)


def test_sensor_combined_replaces_sensor_accel_unless_px4_compensated_it(tmp_path, rng, cli):
    path = tmp_path / 'default.ulg'
    force = write_combined(path, rng)
    read = read_autopilot(path)
    np.testing.assert_array_equal(read.accel, force)
    np.testing.assert_array_equal(read.stamp_ns, (7_000_000 - 200 + np.arange(N) * STEP_US) * 1000)
    np.testing.assert_allclose(read.gyro, np.tile([0.1, 0.2, 0.3], (N, 1)), rtol=1e-6)
    np.testing.assert_array_equal(read.temperatures['board'].celsius, 40.0 + np.arange(6))
    assert 'case' not in read.temperatures
    printed = cli('convert', path, '-o', tmp_path / 'bag.mcap').stdout
    assert 'the log has no sensor_accel' in printed
    assert 'add 4 to SDLOG_PROFILE' in printed
    path = tmp_path / 'corrected.ulg'
    write_combined(path, rng, TC_A_ENABLE=1)
    with pytest.raises(RecordingError, match=r'TC_A_ENABLE was 1.*SDLOG_PROFILE'):
        read_autopilot(path)
    assert len(read_autopilot(path, allow_compensated=True).stamp_ns) == N


@pytest.mark.parametrize('begin', [0, 1])
def test_samples_compensated_by_px4_are_left_out(tmp_path, rng, begin):
    path = tmp_path / 'half.ulg'
    force = write_combined(path, rng, {'TC_A_ENABLE': 1 - begin}, TC_A_ENABLE=begin)
    read = read_autopilot(path)
    assert 'TC_A_ENABLE was 1 for 50 % of the samples' in read.chosen
    # A parameter change has the stamp of the message before it, so skip the sample at the change.
    n = min(len(read.accel), N // 2) - 1
    part = slice(-n, None) if begin else slice(n)
    np.testing.assert_array_equal(read.accel[part], force[part])


def test_the_report_on_a_log_at_1_hz_names_fits_for_which_1_hz_is_sufficient(tmp_path, rng, cli):
    path = write_old(tmp_path / 'slow.ulg', still(rng), 1_000_000, warming=0.01)
    printed = cli('convert', path, '-o', tmp_path / 'bag.mcap').stdout
    assert '1 Hz is sufficient for soaks of minutes' in printed
    assert 'sensor_accel at 10 Hz' in printed
