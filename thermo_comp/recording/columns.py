# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the columns: what a bag becomes once it is read, and the words that describe the bag.

A column is a numpy array with one row per message. All times are integer nanoseconds: the
``stamp`` is the message's own header stamp, the ``log`` is when the recorder got it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..typing import Bytes, Floats, Ints

Input = Literal['auto', 'counts', 'imu']
Role = Literal['accel', 'board', 'case']

ROLES: tuple[Role, ...] = ('accel', 'board', 'case')


@dataclass(frozen=True, slots=True)
class Topics:
    """
    Where the three inputs stand in a bag.

    A name matches with or without its leading slash and, where only one topic of the bag fits,
    with any namespace in front: ``accel/counts`` finds ``/imu0/accel/counts``.
    """

    counts: str = 'accel/counts'
    imu: str = 'imu/uncompensated'
    board: str = 'temperature/board'
    case: str = 'temperature/case'


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """
    What a bag holds, known before its messages are read.

    Attributes
    ----------
    path : Path
        The bag as it was named by the caller.
    storage : str
        ``mcap``, ``sqlite3`` or ``ros1``.
    topics : mapping of str to (str, int)
        Message type and number of messages per topic; a topic of which two types were recorded
        has them joined by `` | ``.
    start_ns, end_ns : int
        Log time of the first and of the last message; 0 and 0 where there is none.
    truncated : str or None
        What is missing, in words, where the bag was cut off; None where it is whole.
    metadata : mapping of str to str
        The key-value pairs that the bag's writer left in it.
    input : {'counts', 'imu'} or None
        Which accelerometer topic is read; None where the bag has neither.

    """

    path: Path
    storage: str
    topics: Mapping[str, tuple[str, int]]
    start_ns: int
    end_ns: int
    truncated: str | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    input: Literal['counts', 'imu'] | None = None

    @property
    def n_messages(self) -> int:
        """Count the messages of all topics."""
        return sum(count for _, count in self.topics.values())


@dataclass(frozen=True, slots=True)
class ImuColumns:
    """
    What a sensor_msgs/Imu carries beside its stamp and its linear acceleration.

    Attributes
    ----------
    orientation : ndarray, shape (n, 4)
        Quaternion x, y, z, w.
    orientation_covariance : ndarray, shape (n, 9)
    angular_velocity : ndarray, shape (n, 3)
        rad/s.
    angular_velocity_covariance : ndarray, shape (n, 9)
    linear_acceleration_covariance : ndarray, shape (n, 9)

    """

    orientation: Floats
    orientation_covariance: Floats
    angular_velocity: Floats
    angular_velocity_covariance: Floats
    linear_acceleration_covariance: Floats


@dataclass(frozen=True, slots=True)
class RawMessages:
    """
    Serialized messages of one topic, as they stand in the bag.

    Attributes
    ----------
    topic, type : str
    log_ns : ndarray of int64, shape (n,)
    data : ndarray of uint8
        The messages' bytes, one after the other.
    ends : ndarray of int64, shape (n,)
        Where each message ends in `data`.

    """

    topic: str
    type: str
    log_ns: Ints
    data: Bytes
    ends: Ints


@dataclass(frozen=True, slots=True)
class Block:
    """
    A run of messages in reading order, as columns.

    Attributes
    ----------
    accel_stamp_ns, accel_log_ns : ndarray of int64, shape (n,)
    accel : ndarray, shape (n, 3)
        Counts per cycle, or m/s^2 where the input is sensor_msgs/Imu.
    frame_id : str
        Of the accelerometer messages; a block ends where it changes.
    imu : ImuColumns or None
        The rest of the message where the input is sensor_msgs/Imu.
    board_stamp_ns, board_log_ns : ndarray of int64, shape (m,)
    board : ndarray, shape (m,)
        degC.
    board_after : ndarray of int64, shape (m,)
        How many of THIS block's accelerometer messages stand before each reading, 0..n.
    case_stamp_ns, case_log_ns, case, case_after
        The same for the case sensor.
    raw : tuple of RawMessages
        The very messages, where the caller asked for them.

    """

    accel_stamp_ns: Ints
    accel_log_ns: Ints
    accel: Floats
    frame_id: str
    imu: ImuColumns | None
    board_stamp_ns: Ints
    board_log_ns: Ints
    board: Floats
    board_after: Ints
    case_stamp_ns: Ints
    case_log_ns: Ints
    case: Floats
    case_after: Ints
    raw: tuple[RawMessages, ...] = ()

    def __len__(self) -> int:
        """Count the accelerometer messages."""
        return len(self.accel_stamp_ns)

    @property
    def temperatures(self) -> dict[str, tuple[Ints, Floats, Ints]]:
        """Readings by the name of their thermometer: stamps, degC, samples before."""
        return {
            'board': (self.board_stamp_ns, self.board, self.board_after),
            'case': (self.case_stamp_ns, self.case, self.case_after),
        }


@dataclass(frozen=True, slots=True)
class Recording:
    """
    A whole bag in memory.

    Attributes
    ----------
    info : RecordingInfo
    columns : Block
        All messages as one block; its `frame_id` is that of the first accelerometer message.

    """

    info: RecordingInfo
    columns: Block
