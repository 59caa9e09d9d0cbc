# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of the node's ROS topics: name, type, QoS, serialization of the regime flags.

Node, replay, recorders, player, bag writer and docs/ros_interface.md use the table of topics. A
message is serialized in little-endian CDR: 4 bytes of encapsulation, then the fields.
"""

from collections.abc import Callable
from dataclasses import dataclass
from struct import pack

VECTOR3_STAMPED = 'geometry_msgs/msg/Vector3Stamped'
IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
BOOL = 'std_msgs/msg/Bool'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'

#: Number of float64 values of the message types that consist of a std_msgs/Header and float64s.
N_NUMBERS = {VECTOR3_STAMPED: 3, IMU: 37, TEMPERATURE: 2}

_ENCAPSULATION = b'\0\1\0\0'

#: Serializes a regime, given the stamp [ns] of the reading that decided on the regime, whether the
#: regime is dynamic, and the serial of the unit.
PackFlag = Callable[[int, bool, str], bytes]


@dataclass(frozen=True, slots=True)
class NodeTopic:
    """A topic of the node, with the QoS that the node requests or offers."""

    name: str
    type: str
    meaning: str  # description of the topic in the reference page
    depth: int
    is_reliable: bool = True
    is_latched: bool = False  # a late subscriber gets the last message (transient local)


def _bool_flag(_stamp_ns: int, is_dynamic: bool, _serial: str) -> bytes:
    return _ENCAPSULATION + bytes([is_dynamic])


def _stamped_flag(stamp_ns: int, is_dynamic: bool, serial: str) -> bytes:
    """Serialize the regime as a DiagnosticArray with the stamp of the reading that decided it."""
    status = b''
    for text in ('regime', 'dynamic' if is_dynamic else 'static', serial):
        # In CDR the level of a status is one byte; the length of a text is aligned to 4 bytes.
        status += bytes(-(1 + len(status)) % 4) + pack('<I', len(text.encode()) + 1)
        status += text.encode() + b'\0'
    status += bytes(-(1 + len(status)) % 4) + pack('<I', 0)  # the status has no key-value pairs
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    # Stamp, length of the empty frame_id with its NUL, padding, number of status, level.
    head = pack('<iII4xIb', sec, nanosec, 1, 1, 0)
    return _ENCAPSULATION + head + status


def thermometer(name: str) -> str:
    """Return the default topic of a thermometer."""
    return f'temperature/{name}'


# The topics of the samples, input and output, have a queue of 2000 samples: 0.2 s at 10 kHz.
COUNTS = NodeTopic('accel/counts', VECTOR3_STAMPED, 'counts per cycle', 2000, is_reliable=False)
IMU_IN = NodeTopic(
    'imu/uncompensated',
    IMU,
    'm/s^2, with `input:=imu`; orientation and its covariance pass through, '
    'and so do angular rate and its covariance unless the calibration has a `gyroscope`; '
    'a message with `linear_acceleration_covariance[0]` = -1 (no acceleration) is not published',
    2000,
    is_reliable=False,
)
BOARD, CASE = (
    NodeTopic(thermometer(name), TEMPERATURE, meaning, 50, is_reliable=False)
    for name, meaning in (
        ('board', 'degC; or std_msgs/Float32, Float64, or a number in any message'),
        ('case', 'degC, as `temperature/board`; further thermometers: `temperature/NAME`'),
    )
)
IMU_OUT = NodeTopic('imu/data_raw', IMU, 'specific force in m/s^2', 2000)
REGIME = NodeTopic(
    'regime/dynamic',
    BOOL,
    'whether the regime is dynamic (S = 1); sent at each case reading or, without case, at each '
    'board reading; not sent while S is unknown',
    1,
    is_latched=True,
)
STAMPED = NodeTopic(
    'regime/stamped',
    DIAGNOSTICS,
    'the regime with the stamp of the reading that decides it; `status[0].message` is `dynamic` '
    'or `static`',
    1,
    is_latched=True,
)
STATUS = NodeTopic('/diagnostics', DIAGNOSTICS, '1 Hz; hardware_id = serial of the unit', 10)

SAMPLES = {'counts': COUNTS, 'imu': IMU_IN}  # sample topics by the value of the parameter `input`
INPUTS = {**SAMPLES, 'board': BOARD, 'case': CASE}  # all input topics by their keys in `Topics`
FLAGS: dict[NodeTopic, PackFlag] = {REGIME: _bool_flag, STAMPED: _stamped_flag}
OUTPUTS = (IMU_OUT, *FLAGS)  # the topics that `replay` writes
