# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns functions that write bags by `mcap` and `rosbags`, and the columns expected of a reader."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from thermo_comp.recording.blocks import ImuColumns

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
STRING, BOOL = 'std_msgs/msg/String', 'std_msgs/msg/Bool'

ACCEL, IMU_IN, BOARD, CASE, OTHER = (
    '/accel/counts', '/imu/uncompensated', '/temperature/board', '/temperature/case', '/chatter',
)  # fmt: skip
#: Message type of each topic; topics such as /mpu/data have the names of a driver.
TYPES = {
    ACCEL: VECTOR, IMU_IN: IMU, BOARD: TEMPERATURE, CASE: TEMPERATURE, OTHER: STRING,
    '/mpu/data': IMU, '/mpu/die': TEMPERATURE, '/baro/air': TEMPERATURE,
}  # fmt: skip
START_NS = 1_600_000_000_000_000_000


@dataclass
class Message:
    topic: str
    log_ns: int
    stamp_ns: int = 0
    frame_id: str = ''
    numbers: tuple[float, ...] = field(default=())
    is_little: bool = True


@lru_cache(maxsize=2)
def typestore(ros=2):
    return get_typestore(Stores.ROS2_JAZZY if ros == 2 else Stores.ROS1_NOETIC)


def to_ros(message, ros=2):
    types = typestore(ros).types
    if message.topic == OTHER:
        return types[STRING]('x' * (message.stamp_ns % 50))
    stamp = types['builtin_interfaces/msg/Time'](*divmod(message.stamp_ns, 10**9))
    sequence = () if ros == 2 else (7,)
    header = types['std_msgs/msg/Header'](*sequence, stamp, message.frame_id)
    vector = types['geometry_msgs/msg/Vector3']
    values = message.numbers
    kind = TYPES[message.topic]
    if kind == VECTOR:
        return types[VECTOR](header, vector(*values))
    if kind == IMU:
        return types[IMU](
            header, types['geometry_msgs/msg/Quaternion'](*values[0:4]), np.array(values[4:13]),
            vector(*values[13:16]), np.array(values[16:25]), vector(*values[25:28]),
            np.array(values[28:37]),
        )  # fmt: skip
    return types[TEMPERATURE](header, *values)


def serialize(message):
    kind = TYPES[message.topic]
    return bytes(typestore().serialize_cdr(to_ros(message), kind, little_endian=message.is_little))


def write_mcap(path, messages, *, compression='none', repeat=True, **options):
    """Write an MCAP file; `options`: arguments of `mcap.writer.Writer`, such as `chunk_size`."""
    options |= {'repeat_channels': repeat, 'repeat_schemas': repeat}
    with path.open('wb') as file:
        writer = McapWriter(file, compression=CompressionType[compression.upper()], **options)
        writer.start('ros2')
        channels, schemas = {}, {}
        for message in messages:
            topic, log_ns, kind = message.topic, message.log_ns, TYPES[message.topic]
            if kind not in schemas:
                text = typestore().generate_msgdef(kind, ros_version=2)[0]
                schemas[kind] = writer.register_schema(kind, 'ros2msg', text.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, 'cdr', schemas[kind])
            writer.add_message(channels[topic], log_ns, serialize(message), log_ns)
        writer.finish()


def write_rosbag2(path, messages, *, storage='mcap', compression=''):
    plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(getattr(CompressionMode, compression), CompressionFormat.ZSTD)
    with writer:
        links = {}
        for message in messages:
            topic = message.topic
            if topic not in links:
                links[topic] = writer.add_connection(topic, TYPES[topic], typestore=typestore())
            writer.write(links[topic], message.log_ns, serialize(message))


def write_rosbag1(path, messages):
    store = typestore(1)
    with Writer1(path) as writer:
        links = {}
        for message in messages:
            topic, kind = message.topic, TYPES[message.topic]
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(to_ros(message, 1), kind)
            writer.write(links[topic], message.log_ns, data)


def imu_columns(rng, n):
    """Draw all columns of n Imu messages, except for the linear acceleration."""
    return ImuColumns(*(rng.standard_normal((n, width)) for width in (4, 9, 3, 9, 9)))


def columns_of(messages):
    columns = {
        f'{role}_{name}': []
        for role in ('accel', 'board', 'case')
        for name in ('stamp_ns', 'log_ns', 'values', 'after')
    }
    roles = {ACCEL: 'accel', IMU_IN: 'accel', BOARD: 'board', CASE: 'case'}
    for message in messages:
        role = roles.get(message.topic)
        if role is None:
            continue
        columns[f'{role}_after'].append(len(columns['accel_stamp_ns']))
        columns[f'{role}_stamp_ns'].append(message.stamp_ns)
        columns[f'{role}_log_ns'].append(message.log_ns)
        value = message.numbers[25:28] if message.topic == IMU_IN else message.numbers
        columns[f'{role}_values'].append(list(value) if role == 'accel' else value[0])
    return columns


def assert_columns(block, messages):
    expected = columns_of(messages)
    accel = (block.accel_stamp_ns, block.accel, np.arange(len(block)))
    for role, (stamp_ns, values, after) in {'accel': accel, **block.temperatures}.items():
        for name, found in (('stamp_ns', stamp_ns), ('log_ns', block.log_ns[role])):
            assert found.dtype == np.int64
            assert found.tolist() == expected[f'{role}_{name}'], (role, name)
        assert after.tolist() == expected[f'{role}_after']
        assert values.dtype == np.float64
        # Compare bits: a reader must keep the bits of a NaN, and a NaN does not equal itself.
        shape = (-1, 3) if role == 'accel' else (-1,)
        wanted = np.array(expected[f'{role}_values'], np.float64).reshape(shape)
        assert np.ascontiguousarray(values).tobytes() == wanted.tobytes(), role


def regular_messages(n=40, accel=ACCEL, every=8):
    """Make messages of samples at a fixed rate; both thermometers have one per `every` samples."""
    messages = []
    width = 3 if accel == ACCEL else 37
    for row in range(n):
        time_ns = START_NS + 2_500_000 * row
        if row % every == 0:
            for topic, celsius in ((BOARD, 20.0), (CASE, 25.0)):
                reading = (celsius + row, 0.0)
                messages.append(Message(topic, time_ns, time_ns - 900, 'board', reading))
        numbers = tuple(float(row * width + k) for k in range(width))
        messages.append(Message(accel, time_ns, time_ns - 1000, 'accel', numbers))
    return messages
