# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Each file of config/drivers against a bag with the topics and types of that driver."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set
from conftest import ROOT
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from thermo_comp.errors import RecordingError
from thermo_comp.recording.overview import survey_recording
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.topics import Topics, read_names
from thermo_comp.replay import replay
from thermo_comp.unit.calibration import Axes, AxisReference, Unit

FILES = sorted((ROOT / 'config' / 'drivers').glob('*.yaml'))
START_NS = 1_767_225_600 * 10**9
IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
MAGNETIC, VECTOR = 'sensor_msgs/msg/MagneticField', 'geometry_msgs/msg/Vector3Stamped'
FLOAT, PRESSURE = 'std_msgs/msg/Float64', 'sensor_msgs/msg/FluidPressure'
PX4, MIP = (
    'px4_msgs/msg/SensorAccel',
    'microstrain_inertial_msgs/msg/MipSensorTemperatureStatistics',
)
OWN = {
    PX4: 'uint64 timestamp\nuint64 timestamp_sample\nuint32 device_id\nfloat32 x\nfloat32 y\n'
    'float32 z\nfloat32 temperature\nuint32 error_count\nuint8[3] clip_counter\nuint8 samples\n',
    MIP: 'microstrain_inertial_msgs/MipHeader header\nfloat32 min_temp\nfloat32 max_temp\n'
    'float32 mean_temp\n',
    'microstrain_inertial_msgs/msg/MipHeader': 'std_msgs/Header header\nuint8 event_source\n',
}
#: What each driver publishes, as docs/drivers.md has it, and what is beside it.
LAYOUTS = {
    'microstrain': {'/imu/data': IMU, '/mip/sensor/temperature_statistics': MIP},
    'xsens': {
        '/imu/data': IMU,
        '/temperature': TEMPERATURE,
        '/filter/free_acceleration': VECTOR,
        '/imu/angular_velocity': VECTOR,
    },
    'vectornav': {
        '/vectornav/imu': IMU,
        '/vectornav/imu_uncompensated': IMU,
        '/vectornav/temperature': TEMPERATURE,
        '/vectornav/magnetic': MAGNETIC,
    },
    'sbg': {'/imu/data': IMU, '/imu/temp': TEMPERATURE, '/imu/mag': MAGNETIC},
    'bno055': {'/bno055/imu_raw': IMU, '/bno055/imu': IMU, '/bno055/temp': TEMPERATURE},
    'witmotion': {'/imu': IMU, '/temperature': TEMPERATURE, '/magnetometer': MAGNETIC},
    'phidgets': {'/imu/data_raw': IMU, '/temperature': FLOAT, '/imu/mag': MAGNETIC},
    # The Imu is of a node of the user's.
    'px4': {'/imu/uncompensated': IMU, '/fmu/out/sensor_accel': PX4},
    'mavros': {
        '/mavros/imu/data': IMU,
        '/mavros/imu/data_raw': IMU,
        '/mavros/imu/temperature_imu': TEMPERATURE,
        '/mavros/imu/temperature_baro': TEMPERATURE,
        '/mavros/imu/static_pressure': PRESSURE,
    },
    'ardupilot': {'/ap/imu/experimental/data': IMU, '/ap/airspeed': VECTOR},
    'realsense': {'/camera/camera/accel/sample': IMU, '/camera/camera/gyro/sample': IMU},
    'mpu6050': {'/imu': IMU},
}
#: Those without a temperature.
LACKS = {'ardupilot', 'realsense', 'mpu6050'}
SECONDS, RATE = 60, 20


@pytest.fixture(scope='module')
def store() -> Any:
    found = get_typestore(Stores.ROS2_JAZZY)
    for kind in reversed(OWN):
        found.register(get_types_from_msg(OWN[kind], kind))
    return found


def message(store: Any, kind: str, stamp_ns: int, second: float) -> Any:
    """Make a message at rest that warms by 0.1 K/s."""
    types, celsius, zeros = store.types, 20.0 + 0.1 * second, np.zeros(9)
    header = types['std_msgs/msg/Header'](
        types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9)), 'imu_link'
    )
    vector = types['geometry_msgs/msg/Vector3']
    force = vector(0.01 * np.sin(1e3 * second), 0.0, 9.80665)
    if kind == IMU:
        level = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
        return types[kind](header, level, zeros, vector(0.0, 0.0, 0.0), zeros, force, zeros)
    if kind == MIP:
        own = types['microstrain_inertial_msgs/msg/MipHeader'](header, 0)
        return types[kind](own, celsius - 1.0, celsius + 1.0, celsius)
    if kind == PX4:
        return types[kind](1, 1, 7, 0.0, 0.0, -9.8, celsius, 0, np.zeros(3, np.uint8), 1)
    if kind == MAGNETIC:
        return types[kind](header, vector(1e-5, 2e-5, 4e-5), zeros)
    if kind == VECTOR:
        return types[kind](header, vector(0.0, 0.0, 0.0))
    return types[kind](celsius) if kind == FLOAT else types[kind](header, celsius, 0.0)


@pytest.fixture
def bag(request: Any, tmp_path: Path, store: Any) -> Path:
    """Write a minute of a driver: samples at 20 Hz, all else at 1 Hz."""
    path = tmp_path / 'bag'
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {
            topic: (writer.add_connection(topic, kind, typestore=store), kind)
            for topic, kind in LAYOUTS[request.param].items()
        }
        for row in range(SECONDS * RATE):
            stamp_ns = START_NS + row * 10**9 // RATE
            for link, kind in links.values():
                if kind == IMU or row % RATE == 0:
                    data = store.serialize_cdr(message(store, kind, stamp_ns, row / RATE), kind)
                    writer.write(link, stamp_ns + 1, data)
    return path


def test_every_driver_has_a_layout_and_a_line_in_the_page() -> None:
    assert {path.stem for path in FILES} == LAYOUTS.keys()
    page = (ROOT / 'docs' / 'drivers.md').read_text()
    for path in FILES:
        (line,) = [one for one in page.splitlines() if one.endswith(f'| `{path.stem}` |')]
        for name, topic in read_names(path).items():
            assert name == 'output' or topic.partition(':')[0] in line, (path.stem, topic)


@pytest.mark.parametrize(
    ('path', 'bag'), [(path, path.stem) for path in FILES], indirect=['bag'], ids=str
)
def test_the_file_reads_the_drivers_bag(path: Path, bag: Path, tmp_path: Path) -> None:
    names = {'imu': '/imu/uncompensated', **read_names(path)}
    lacks = {'board'} if path.stem in LACKS else set()
    topics = Topics.named(names)
    with open_recording(bag, topics, require={'accel', 'board'} - lacks) as reader:
        assert set(reader.topics) == ({'accel', 'board', *topics_of(names)} - lacks)
        for role, topic in reader.topics.items():
            assert topic == names['imu' if role == 'accel' else role].partition(':')[0]
    survey = survey_recording(bag, topics)
    if 'board' not in lacks:
        board = survey.thermometers['board']
        assert (board.n, board.rate_hz) == (pytest.approx(SECONDS, abs=1), pytest.approx(1.0))
        assert board.lowest == pytest.approx(20.0, abs=0.2)
        assert board.highest == pytest.approx(25.9, abs=1e-3)
    for one in lacks:
        with pytest.raises(RecordingError, match='no such topic'):
            open_recording(bag, topics, require={one})
    assert (survey.info.input, survey.n) == ('imu', SECONDS * RATE)
    # 1 mm/s^2 per K along z: what is taken off says which temperature was read.
    scale = calibration(
        unit=Unit('T-1', 'm/s^2', 160.0, 1.0 / RATE),
        axes=Axes(*[AxisReference(1.0, 0.0)] * 3),
        static=regime_set(z=axis_set((0.0, 1e-3))),
        dynamic=regime_set(z=axis_set((0.0, 1e-3))),
    )
    if 'board' in lacks:
        with pytest.raises(RecordingError, match='temperature/board: no such topic'):
            replay(bag, scale, tmp_path / 'out.csv', topics=topics)
        return
    replay(bag, scale, tmp_path / 'out.csv', topics=topics)
    with (tmp_path / 'out.csv').open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last['specific_force_z_m_s2']) == pytest.approx(9.80665 - 5.9e-3, abs=3e-4)


def topics_of(names: dict[str, str]) -> set[str]:
    return {one for one in names if one not in ('imu', 'counts', 'output')}


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)
def test_the_node_listens_where_the_file_says(path: Path, tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
    from ros_helpers import node_in_thread

    from thermo_comp.unit.calibration_file import save_calibration

    names = read_names(path)
    kind = 'm/s^2' if 'imu' in names else 'counts'
    save_calibration(calibration(unit=Unit('T-1', kind, 1e3, 0.05)), tmp_path / 'unit.yaml')
    words = [f'calibration_file:={tmp_path / "unit.yaml"}', f'topics:={path}']
    with node_in_thread(*(word for one in words for word in ('-p', one))) as node:
        heard = {one.topic_name for one in node.node.subscriptions}
        assert {
            topic.partition(':')[0] for name, topic in names.items() if name != 'output'
        } <= heard
        assert node.node.count_publishers(names.get('output', '/imu/data_raw')) == 1
