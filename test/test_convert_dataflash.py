# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""ArduPilot logs, written here as the public description of DataFlash states, become bags."""

import struct

import numpy as np
import pytest

from thermo_comp.convert.autopilot import read_autopilot
from thermo_comp.convert.log import write_log
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording

pytest.importorskip('pymavlink', reason='pymavlink of the extra `ardupilot` is not installed')

SIZES = {'Q': 8, 'B': 1, 'f': 4, 'I': 4, 'H': 2, 'h': 2, 'c': 2, 'N': 16}
NEW_IMU = ('QBffffffIIfBBHH', 'TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz')
OLD_IMU = ('QffffffIIfBB', 'TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp,GyHlt,AcHlt')
NEW_BARO = ('QBffcfIffB', 'TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,H')
OLD_BARO = ('Qffcf', 'TimeUS,Alt,Press,Temp,CRt')
PARM = ('QNff', 'TimeUS,Name,Value,Default')
N = 500
STEP_US = 20_000


class DataflashWriter:
    def __init__(self):
        self.body = b''
        self.types = {}
        self._format(0x80, 'FMT', 89, 'BBnNZ', 'Type,Length,Name,Format,Columns')

    def _format(self, number, name, length, layout, columns):
        texts = (text.encode() for text in (name, layout, columns))
        self.body += b'\xa3\x95\x80' + struct.pack('<BB4s16s64s', number, length, *texts)

    def define(self, name, layout, columns):
        number = 0x81 + len(self.types)
        self.types[name] = (number, layout)
        self._format(number, name, 3 + sum(SIZES[c] for c in layout), layout, columns)

    def write(self, name, *values):
        number, layout = self.types[name]
        code = '<' + ''.join({'c': 'h', 'N': '16s'}.get(c, c) for c in layout)
        self.body += b'\xa3\x95' + bytes([number]) + struct.pack(code, *values)


def still(rng):
    return np.float32(np.array([0.2, -0.1, -9.8]) + 0.03 * rng.standard_normal((N, 3)))


def write_new(path, rng, parameters=(('INS_TCAL1_ENABLE', 0.0),)):
    log = DataflashWriter()
    log.define('IMU', *NEW_IMU)
    log.define('BARO', *NEW_BARO)
    log.define('PARM', *PARM)
    for name, value, *at in parameters:
        log.write('PARM', at[0] if at else 1000, name.encode(), value, 0.0)
    force = np.array([still(rng), still(rng)])
    for k in range(N):
        now = 2_000_000 + k * STEP_US
        for i, hundredths in ((0, 2000 + k), (1, 1500 - k)):
            numbers = (*force[i][k], 0, 0, 30.0 + i + 0.25 * (k // 10), 1, 1, 1000, 1000)
            log.write('IMU', now + i, i, 0.1, 0.2, 0.3 + i, *numbers)
            if k % 10 == 0:
                log.write('BARO', now, i, 1.0, 1e5, hundredths, 0.0, 0, 0.0, 20.0, 1)
    path.write_bytes(log.body)
    return force


@pytest.mark.parametrize(('imu', 'baro'), [(0, 0), (1, 0), (0, 1)])
def test_each_imu_of_a_log_in_the_new_format_can_be_converted(tmp_path, rng, imu, baro):
    path = tmp_path / 'new.BIN'
    force = write_new(path, rng)
    write_log(read_autopilot(path, imu=imu, baro=baro), tmp_path / 'bag.mcap')
    bag = read_recording(tmp_path / 'bag.mcap').columns
    stamp_ns = (2_000_000 + np.arange(N) * STEP_US + imu) * 1000
    np.testing.assert_array_equal(bag.accel_stamp_ns, stamp_ns)
    np.testing.assert_array_equal(bag.accel, force[imu])
    # The log has numbers of single precision, so the rate 0.3 has a rounding error of 1e-7.
    np.testing.assert_allclose(bag.imu.angular_velocity[:, 2], 0.3 + imu, atol=1e-7)
    celsius = 30.0 + imu + 0.25 * np.arange(N // 10)
    np.testing.assert_array_equal(bag.temperatures['board'].celsius, celsius)
    hundredths = (2000 + np.arange(0, N, 10)) if baro == 0 else (1500 - np.arange(0, N, 10))
    np.testing.assert_allclose(bag.temperatures['case'].celsius, hundredths / 100, rtol=1e-15)


def test_each_imu_of_a_log_in_the_old_format_can_be_converted(tmp_path, rng):
    log = DataflashWriter()
    for name in ('IMU', 'IMU2'):
        log.define(name, *OLD_IMU)
    for name in ('BARO', 'BAR2'):
        log.define(name, *OLD_BARO)
    force = {'IMU': still(rng), 'IMU2': still(rng)}
    for k in range(N):
        now = 2_000_000 + k * STEP_US
        for i, name in enumerate(force):
            log.write(name, now, 0.0, 0.0, 0.0, *force[name][k], 0, 0, 30.0 + i, 1, 1)
        log.write('BARO', now, 0.0, 1e5, 2150, 0.0)
        log.write('BAR2', now, 0.0, 1e5, 2250, 0.0)
    path = tmp_path / 'old.BIN'
    path.write_bytes(log.body)
    for i, name in enumerate(force):
        read = read_autopilot(path, imu=i, baro=i)
        np.testing.assert_array_equal(read.accel, force[name])
        np.testing.assert_array_equal(read.temperatures['board'].celsius, [30.0 + i])
        np.testing.assert_array_equal(read.temperatures['case'].celsius, [21.5 + i])


def test_a_temperature_of_0_means_no_thermometer(tmp_path, rng):
    log = DataflashWriter()
    log.define('IMU', *NEW_IMU)
    for k, force in enumerate(still(rng)):
        log.write('IMU', 1000 + k * STEP_US, 0, 0.0, 0.0, 0.0, *force, 0, 0, 0.0, 1, 1, 1000, 1000)
    path = tmp_path / 'none.BIN'
    path.write_bytes(log.body)
    assert not read_autopilot(path).temperatures


def test_a_log_corrected_by_ardupilot_is_refused_and_a_simulated_log_reported(tmp_path, rng):
    path = tmp_path / 'corrected.BIN'
    write_new(path, rng, parameters=(('INS_TCAL1_ENABLE', 1.0),))
    with pytest.raises(RecordingError, match=r'INS_TCAL1_ENABLE was 1.*already'):
        read_autopilot(path)
    assert len(read_autopilot(path, allow_compensated=True).stamp_ns) == N
    assert len(read_autopilot(path, imu=1).stamp_ns) == N
    write_new(path, rng, parameters=(('SIM_ACC1_RND', 0.1),))
    assert 'SIM_' in read_autopilot(path).metadata['ardupilot_simulated']


HALF_US = 2_000_000 + N // 2 * STEP_US


@pytest.mark.parametrize(
    ('course', 'kept', 'share'),
    [
        ([(0.0, 1000), (1.0, HALF_US)], slice(0, N // 2), 50),
        ([(1.0, 1000), (0.0, HALF_US)], slice(N // 2, N), 50),
        # WHY: a log was refused if INS_TCAL1_ENABLE changed from 2 (learn) to 1 (correct).
        ([(2.0, 1000), (1.0, HALF_US + N // 4 * STEP_US)], slice(0, 3 * N // 4), 25),
    ],
)
def test_samples_corrected_by_ardupilot_are_left_out(tmp_path, rng, course, kept, share):
    path = tmp_path / 'log.BIN'
    force = write_new(path, rng, [('INS_TCAL1_ENABLE', *step) for step in course])
    read = read_autopilot(path)
    np.testing.assert_array_equal(read.accel, force[0][kept])
    assert f'INS_TCAL1_ENABLE was 1 for {share} % of the samples' in read.chosen
    assert len(read_autopilot(path, allow_compensated=True).stamp_ns) == N
    # The fit needs the thermal history, so temperatures stay where samples are left out.
    assert len(read.temperatures['board'].celsius) > 1


def test_a_torn_log_and_a_log_with_impossible_stamps_lose_only_their_damaged_messages(
    tmp_path, rng
):
    path = tmp_path / 'torn.BIN'
    force = write_new(path, rng)
    whole = path.read_bytes()
    cut = whole.rindex(b'\xa3\x95\x81') + 40
    path.write_bytes(whole[:cut])
    log = read_autopilot(path, imu=1)
    assert log.short == [2 * N]
    np.testing.assert_array_equal(log.accel, force[1][: N - 1])
    path = tmp_path / 'jump.BIN'
    write_new(path, rng)
    body = bytearray(path.read_bytes())
    # Set all bits of the time of the first IMU message, a time of half a million years.
    at = body.index(b'\xa3\x95\x81') + 3
    body[at : at + 8] = b'\xff' * 8
    path.write_bytes(body)
    report = write_log(read_autopilot(path), tmp_path / 'bag.mcap')
    assert (report.messages['accel'], report.findings['non_numeric'].count) == (N - 1, 1)


def test_absent_instances_and_files_of_other_kinds_are_refused(tmp_path, rng):
    path = tmp_path / 'new.BIN'
    write_new(path, rng)
    with pytest.raises(RecordingError, match='no IMU 2; there are: 0, 1'):
        read_autopilot(path, imu=2)
    with pytest.raises(RecordingError, match='no barometer 5; there are: 0, 1'):
        read_autopilot(path, baro=5)
    for content in (b'', b'time,x,y,z\n', b'\xa3\x95' + bytes(600)):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r'not a DataFlash log|holds no IMU'):
            read_autopilot(path)


@pytest.mark.parametrize(
    ('columns', 'message'),
    [
        (NEW_IMU[1].replace('GH', 'EG'), 'format of IMU has a column twice'),
        (NEW_IMU[1], 'format of IMU is longer than its stated length'),
    ],
)
def test_damaged_formats_are_refused(tmp_path, rng, columns, message):
    log = DataflashWriter()
    log.define('IMU', NEW_IMU[0], columns)
    log.write('IMU', 1000, 0, *np.zeros(6), 0, 0, 30.0, 1, 1, 1000, 1000)
    body = bytearray(log.body)
    if 'longer' in message:
        # Reduce the length (byte 4) in the second FMT message; the first FMT message has 89 bytes.
        body[89 + 4] -= 10
    path = tmp_path / 'damaged.BIN'
    path.write_bytes(body)
    with pytest.raises(RecordingError, match=message):
        read_autopilot(path)
