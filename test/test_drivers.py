# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A command with a driver's file of config/drivers reads bags with the topics of this driver."""

import csv
import re

import numpy as np
import pytest
from builders import START_NS, axis_set, calibration, equal_axes, regime_set
from conftest import ROOT, parsed
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from thermo_comp.errors import ThermoCompError
from thermo_comp.recording.topics import read_names
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration

FILES = sorted((ROOT / 'config' / 'drivers').glob('*.yaml'))
IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
MAGNETIC, VECTOR = 'sensor_msgs/msg/MagneticField', 'geometry_msgs/msg/Vector3Stamped'
FLOAT, PRESSURE = 'std_msgs/msg/Float64', 'sensor_msgs/msg/FluidPressure'
PX4 = 'px4_msgs/msg/SensorAccel'
MIP = 'microstrain_inertial_msgs/msg/MipSensorTemperatureStatistics'
OWN = {
    PX4: 'uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 x\nfloat32 y\n'
    'float32 z\nfloat32 temperature\nuint32 error_count\nuint8[3] clip_counter\nuint8 samples\n',
    MIP: 'microstrain_inertial_msgs/MipHeader header\nfloat32 min_temp\nfloat32 max_temp\n'
    'float32 mean_temp\n',
    'microstrain_inertial_msgs/msg/MipHeader': 'std_msgs/Header header\nuint8 event_source\n',
}
#: For each driver: its topics with their types (docs/drivers.md), and other topics of its bag.
LAYOUTS = {
    'microstrain': {'/imu/data': IMU, '/mip/sensor/temperature_statistics': MIP},
    'xsens': {'/imu/data': IMU, '/temperature': TEMPERATURE, '/filter/free_acceleration': VECTOR,
              '/imu/angular_velocity': VECTOR},
    'vectornav': {'/vectornav/imu': IMU, '/vectornav/imu_uncompensated': IMU,
                  '/vectornav/temperature': TEMPERATURE, '/vectornav/magnetic': MAGNETIC},
    'sbg': {'/imu/data': IMU, '/imu/temp': TEMPERATURE, '/imu/mag': MAGNETIC},
    'bno055': {'/bno055/imu_raw': IMU, '/bno055/imu': IMU, '/bno055/temp': TEMPERATURE},
    'witmotion': {'/imu': IMU, '/temperature': TEMPERATURE, '/magnetometer': MAGNETIC},
    'phidgets': {'/imu/data_raw': IMU, '/temperature': FLOAT, '/imu/mag': MAGNETIC},
    # PX4 publishes no Imu messages, so a node of the user must publish /imu/uncompensated.
    'px4': {'/imu/uncompensated': IMU, '/fmu/out/sensor_accel': PX4},
    'mavros': {'/mavros/imu/data': IMU, '/mavros/imu/data_raw': IMU,
               '/mavros/imu/temperature_imu': TEMPERATURE,
               '/mavros/imu/temperature_baro': TEMPERATURE,
               '/mavros/imu/static_pressure': PRESSURE},
    'ardupilot': {'/ap/imu/experimental/data': IMU, '/ap/airspeed': VECTOR},
    'realsense': {'/camera/camera/accel/sample': IMU, '/camera/camera/gyro/sample': IMU},
    'mpu6050': {'/imu': IMU},
}  # fmt: skip
#: Drivers whose bags are fitted: one per type of temperature message, and one without readings.
FITTED = {'mavros', 'px4', 'phidgets', 'ardupilot'}
# The bags of these drivers take the longest time, so their tests run in `make slow`.
SLOW = {'px4', 'phidgets'}
#: Seven rests of REST_S [s]: six faces, the first again; the board warms by WARMING [K/s].
UPS = np.concatenate((np.eye(3), -np.eye(3), [[1.0, 0.0, 0.0]]))
RATE, REST_S, WARMING = 5, 75, 0.05
SECONDS = len(UPS) * REST_S
GRAVITY, MICRO_G = 9.80665, 9.80665e-6
#: Bias [m/s^2], its slope [m/s^2/K], and noise of a sample [m/s^2], 6 ug in means over 60 s.
BIAS, SLOPE, NOISE = np.array([0.05, -0.03, 0.08]), np.array([1e-3, -2e-3, 3e-3]), 1e-3


@pytest.fixture(scope='module')
def store():
    types = get_typestore(Stores.ROS2_JAZZY)
    for kind in reversed(OWN):
        types.register(get_types_from_msg(OWN[kind], kind))
    return types


def message(store, kind, stamp_ns, celsius, force):
    types, zeros = store.types, np.zeros(9)
    stamp = types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    header = types['std_msgs/msg/Header'](stamp, 'imu_link')
    vector = types['geometry_msgs/msg/Vector3']
    if kind == IMU:
        level = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
        still = vector(0.0, 0.0, 0.0)
        return types[kind](header, level, zeros, still, zeros, vector(*force), zeros)
    if kind == MIP:
        head = types['microstrain_inertial_msgs/msg/MipHeader'](header, 0)
        return types[kind](head, celsius - 1.0, celsius + 1.0, celsius)
    if kind == PX4:
        return types[kind](1, 1, 7, *force, celsius, 0, np.zeros(3, np.uint8), 1)
    if kind == MAGNETIC:
        return types[kind](header, vector(1e-5, 2e-5, 4e-5), zeros)
    if kind == VECTOR:
        return types[kind](header, vector(0.0, 0.0, 0.0))
    return types[kind](celsius) if kind == FLOAT else types[kind](header, celsius, 0.0)


@pytest.fixture
def bag(request, tmp_path, store):
    """Write rests with the topics of a driver: samples at 5 Hz, other messages at 1 Hz."""
    path, noise = tmp_path / 'bag', np.random.default_rng(40)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {
            topic: (writer.add_connection(topic, kind, typestore=store), kind)
            for topic, kind in LAYOUTS[request.param].items()
        }
        for row in range(SECONDS * RATE):
            stamp_ns, warmer = START_NS + row * 10**9 // RATE, WARMING * row / RATE
            force = GRAVITY * UPS[row // (REST_S * RATE)] + BIAS + SLOPE * warmer
            force += NOISE * noise.standard_normal(3)
            for link, kind in links.values():
                if kind == IMU or row % RATE == 0:
                    celsius = 20.0 + warmer - (2.0 if 'baro' in link.topic else 0.0)
                    sent = message(store, kind, stamp_ns, celsius, force)
                    writer.write(link, stamp_ns + 1, store.serialize_cdr(sent, kind))
    return path


def test_every_driver_has_a_layout_and_a_line_in_the_page():
    assert {path.stem for path in FILES} == LAYOUTS.keys()
    page = (ROOT / 'docs' / 'drivers.md').read_text()
    for path in FILES:
        (line,) = [row for row in page.splitlines() if row.endswith(f'| `{path.stem}` |')]
        for name, topic in read_names(path).items():
            assert name == 'output' or topic.partition(':')[0] in line, (path.stem, topic)


@pytest.mark.parametrize(
    ('path', 'bag'),
    [
        pytest.param(file, file.stem, marks=[pytest.mark.slow] * (file.stem in SLOW))
        for file in FILES
    ],
    indirect=['bag'],
)
def test_every_command_reads_a_bag_with_the_topics_of_the_driver(path, bag, tmp_path, cli):
    names, topics = read_names(path), ('--topics', path)
    has_board = path.stem not in {'ardupilot', 'realsense', 'mpu6050'}
    printed = cli('info', bag, *topics).stdout
    assert f'{SECONDS * RATE} samples of imu, {RATE} Hz' in printed
    assert f'{len(UPS)} still intervals' in printed
    # `info` lists the thermometers that the topics file names, and no other numbers of messages.
    assert re.findall(r'^(board|case) +1\.000 +(\S+) +(\S+)', printed, re.MULTILINE) == [
        (name, f'{20.0 - lag:.2f}', f'{46.2 - lag:.2f}')
        for name, lag in (('board', 0.0), ('case', 2.0))
        if name in names
    ]
    assert 'is taken for board' not in printed
    assert ('no case temperature' in printed) == ('case' not in names)
    assert ('--topic case=TOPIC\n' in printed) == ('case' not in names)
    fitted = tmp_path / 'unit.yaml'
    save_calibration(warming_unit(), tmp_path / 'warm.yaml')
    if path.stem in FITTED:
        finished = cli('fit', bag, *topics, '-o', fitted, '--gravity', str(GRAVITY))
        assert ('the bags have no thermometer' in finished.stdout) == (not has_board)
        # Means over 60 s have 6 ug of noise; raw samples drift by 26 K times 1 to 3 mm/s^2/K.
        judged = parsed(cli('evaluate', bag, '-c', fitted, *topics, '--json', code=None).stdout)
        left = judged['sections_m_s2']['all']['rms'] / MICRO_G
        assert left < 10.0 if has_board else 500.0 < left < 2500.0
    else:
        fitted = tmp_path / 'warm.yaml'
    if has_board or path.stem in FITTED:
        cli('replay', bag, '-c', fitted, '-o', tmp_path / 'out.csv', *topics)
        with (tmp_path / 'out.csv').open() as file:
            rows = list(csv.DictReader(file))
        # The first sample precedes the first temperature reading, so it is not corrected.
        assert len(rows) >= SECONDS * RATE - 1
    if not has_board:
        command = 'replay', bag, '-c', tmp_path / 'warm.yaml', '-o', tmp_path / 'o.csv'
        assert 'temperature/board: no such topic' in cli(*command, *topics, code=1).stderr


def warming_unit():
    """Make a unit whose z bias grows by 1 mm/s^2/K, so the output shows the reading in use."""
    unit, parts = Unit('T-1', 'm/s^2', 160.0, 1.0 / RATE), regime_set(z=axis_set((0.0, 1e-3)))
    return calibration(unit=unit, axes=equal_axes(1.0), static=parts, dynamic=parts)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)
def test_the_node_uses_the_topics_of_the_driver_s_file(path, tmp_path, peer):
    from ros_helpers import node_arguments, node_in_thread, stamped
    from sensor_msgs.msg import Imu, Temperature
    from std_msgs.msg import Float64

    from thermo_comp.ros.messages import LiveField

    names = {'imu': '/imu/uncompensated', 'board': '/temperature/board', **read_names(path)}
    layout = LAYOUTS[path.stem]
    save_calibration(warming_unit(), tmp_path / 'unit.yaml')
    words = node_arguments(tmp_path / 'unit.yaml', f'topics:={path}', 'input:=imu')
    with node_in_thread(*words) as node:
        heard_topics = {subscription.topic_name for subscription in node.node.subscriptions}
        topics = {topic.partition(':')[0] for name, topic in names.items() if name != 'output'}
        board, _, field = names['board'].partition(':')
        if field:
            # The driver's message package is not installed: `LiveField` must refuse the topic.
            assert topics - {board} <= heard_topics
            with pytest.raises(ThermoCompError, match=f'{board}: its type .* is not installed'):
                LiveField(board, layout[board], field)
            return
        assert topics <= heard_topics | {board}
        heard = peer.listen(Imu, names.get('output', 'imu/data_raw'))
        is_bare = layout.get(board) == FLOAT
        reading = Float64(data=30.0) if is_bare else Temperature(temperature=30.0)
        thermometer = peer.publisher(type(reading), board)
        samples = peer.publisher(Imu, names['imu'])
        peer.join(node)
        for k in range(40):
            message = stamped(Imu(), START_NS + k * 10**9 // RATE, 'imu_link')
            message.linear_acceleration.x = 0.01 * (k % 3)
            message.linear_acceleration.z = GRAVITY
            if not is_bare:
                stamped(reading, START_NS + k * 10**9 // RATE)
            thermometer.publish(reading)
            samples.publish(message)
        peer.wait_for(lambda: heard and abs(heard[-1].linear_acceleration.z - GRAVITY) > 5e-3)
        assert heard[-1].linear_acceleration.z == pytest.approx(GRAVITY - 0.01, abs=1e-6)
