# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node and `record` read temperatures from number fields of stamped and unstamped messages."""

import threading
import time
from dataclasses import replace

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

import ros_helpers as ros
from builders import thermal_calibration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, Temperature
from std_msgs.msg import Float64

from thermo_comp.errors import ThermoCompError
from thermo_comp.recording.topics import Topics
from thermo_comp.ros.listener import LiveTopics
from thermo_comp.ros.messages import LiveField
from thermo_comp.ros.node import main
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration

NAMES = {'board': '/pack:temperature', 'case': '/case_t'}


@pytest.fixture
def unit(tmp_path):
    path = tmp_path / 'unit.yaml'
    save_calibration(thermal_calibration(), path)
    return path


def sample(stamp_ns):
    message = ros.stamped(Vector3Stamped(), stamp_ns, 'imu')
    message.vector.x, message.vector.y, message.vector.z = ros.standing(0)
    return message


@pytest.mark.parametrize('is_file', [False, True])
def test_the_node_finds_the_message_type_of_a_topic_while_it_runs(peer, unit, is_file):
    topics = ','.join(f'{name}={topic}' for name, topic in NAMES.items())
    if is_file:
        lines = ''.join(f'{name}: {topic}\n' for name, topic in NAMES.items())
        (unit.parent / 'lab.yaml').write_text(lines)
        topics = str(unit.parent / 'lab.yaml')
    heard = peer.listen(DiagnosticArray, '/diagnostics')

    def values(**expected):
        def look():
            shown = {value.key: value.value for array in heard for value in array.status[0].values}
            return all(
                shown.get(name, 'x').replace('.', '').lstrip('-').isdecimal()
                and abs(float(shown[name]) - value) < 1e-6
                for name, value in expected.items()
            )

        return look

    with ros.node_in_thread(*ros.node_arguments(unit, f'topics:={topics}')):
        board = peer.publisher(BatteryState, '/pack')
        case = peer.publisher(Float64, '/case_t')
        samples = peer.publisher(Vector3Stamped, 'accel/counts')
        board.publish(ros.stamped(BatteryState(temperature=25.0), ros.START_NS))
        peer.wait_for(values(unpublished=0), 'a report')
        samples.publish(sample(ros.START_NS))
        peer.wait_for(values(**{'board temperature [degC]': 25.0}), 'the board')
        # A reading without a stamp applies from the previous sample on.
        case.publish(Float64(data=23.0))
        samples.publish(sample(ros.START_NS + ros.SECOND_NS))
        samples.publish(sample(ros.START_NS + 2 * ros.SECOND_NS))
        of_case = {'case minus board [K]': -2.0, 'case age [s]': 2.0}
        peer.wait_for(values(**of_case), 'the case, 2 s old')


@pytest.mark.parametrize(
    ('topics', 'text'),
    [
        ('bord=/t', 'parameter `topics`: `bord` is not an input'),
        ('board=/t,case', 'parameter `topics`: expected INPUT=TOPIC, got case'),
        ('/none/drivers.yaml', '/none/drivers.yaml: cannot be read'),
        ('counts=/imu/data_raw', '/imu/data_raw: is both input and output: remap imu/data_raw'),
        ('imu=/imu/data_raw', "must be 'm/s^2' (parameter `input` is imu), got 'counts'"),
    ],
)
def test_impossible_topics_are_refused(unit, topics, text, capfd):
    command = ['thermo_comp_node', '--ros-args', *ros.node_arguments(unit, f'topics:={topics}')]
    assert main(command) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert text in line


def test_a_driver_on_imu_data_raw_requires_another_output_topic(unit, capfd):
    calibration = replace(thermal_calibration(), unit=Unit('T-1', 'm/s^2', 160.0, 0.01))
    save_calibration(calibration, unit, overwrite=True)
    words = ros.node_arguments(unit, 'topics:=imu=/imu/data_raw')
    assert main(['thermo_comp_node', '--ros-args', *words]) == 1
    text = '/imu/data_raw: is both input and output: remap imu/data_raw to another name'
    assert text in capfd.readouterr().err
    names = 'imu=/imu/data_raw,output=/imu/compensated'
    with ros.node_in_thread(*ros.node_arguments(unit, f'topics:={names}')) as node:
        assert node.node.count_publishers('/imu/compensated') == 1


def test_record_writes_number_fields_of_messages_as_temperatures(peer):
    outputs = {}
    pause, deadline = threading.Event(), time.monotonic() + ros.TIMEOUT
    messages = [
        ('accel', sample(ros.START_NS)),
        ('case', Float64(data=23.0)),
        ('board', ros.stamped(BatteryState(temperature=25.0), ros.START_NS + 5)),
    ]
    with LiveTopics(Topics.named({**NAMES, 'counts': 'accel/counts'})) as live:
        publishers = {
            'accel': peer.publisher(Vector3Stamped, 'accel/counts'),
            'case': peer.publisher(Float64, '/case_t'),
            'board': peer.publisher(BatteryState, '/pack'),
        }
        sent = []

        def wait(_seconds):
            """Send the next message if the previous one has arrived; end after the last one."""
            if len(outputs) == len(sent) < len(messages):
                role, message = messages[len(sent)]
                sent.append(role)
                publishers[role].publish(message)
            pause.wait(0.02)
            return len(outputs) == len(messages) or time.monotonic() > deadline

        for news in live.blocks(wait):
            for role, own in news[0].raw.items() if news else ():
                outputs.setdefault(role, []).extend(own)
    case = deserialize_message(outputs['case'][0], Temperature)
    board = deserialize_message(outputs['board'][0], Temperature)
    # A reading without a stamp gets the stamp of the previous sample.
    assert (case.temperature, case.header.stamp.sec) == (23.0, ros.START_NS // ros.SECOND_NS)
    assert (board.temperature, board.header.stamp.nanosec) == (25.0, 5)


def test_a_number_field_is_read_from_messages_that_rclpy_wrote():
    message = BatteryState(temperature=25.0, cell_temperature=[1.0, 2.5])
    data = serialize_message(ros.stamped(message, ros.START_NS + 7))
    for path, value in (('temperature', 25.0), ('cell_temperature[1]', 2.5)):
        field = LiveField('/pack', 'sensor_msgs/msg/BatteryState', path)
        assert field.read(data) == (ros.START_NS + 7, value)
    assert LiveField('/pack', 'sensor_msgs/msg/BatteryState', 'cell_voltage[3]').read(data) is None
    for kind, path, text in (
        ('px4_msgs/msg/SensorAccel', 'temperature', '/t: its type px4_msgs.* is not installed'),
        ('sensor_msgs/msg/Imu', 'temperature', 'Imu has no number `temperature`'),
        ('sensor_msgs/msg/Imu', 'header', 'Imu has no number `header`'),
    ):
        with pytest.raises(ThermoCompError, match=text):
            LiveField('/t', kind, path)
