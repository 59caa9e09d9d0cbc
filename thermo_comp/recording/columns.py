# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the block: what a stretch of a bag becomes once it is read, and the words that describe a bag.

A column is a numpy array with one row per message. All times are integer nanoseconds: the
``stamp`` is the message's own header stamp, the ``log`` is when the recorder got it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ..typing import Bools, Floats, Ints
from .messages import Messages, Topic, join_messages

Input = Literal['auto', 'counts', 'imu']
#: ``accel``, or the name of a thermometer.
Role = str

ROLES: tuple[Role, ...] = ('accel', 'board', 'case')

#: A block is given out once it has so many messages, where nobody wants another number; a chunk
#: of usual size has more.
BLOCK_MESSAGES = 1 << 13


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """
    What a bag holds, known before its messages are read.

    `topics` have message type and number of messages; two types are joined by `` | ``. `start_ns`
    and `end_ns` are the log times of the first and the last message, or 0. `truncated` says what
    is missing; `metadata` are the pairs that the bag's writer left in it; `input` says which
    accelerometer topic is read, if there is one; `chosen` which topics were taken by their type.
    """

    path: Path
    storage: str
    topics: Mapping[str, tuple[str, int]]
    start_ns: int
    end_ns: int
    truncated: str | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    input: Literal['counts', 'imu'] | None = None
    chosen: str | None = None

    @property
    def n_messages(self) -> int:
        """Count the messages of all topics."""
        return sum(count for _, count in self.topics.values())


def count_topics(channels: Iterable[Topic]) -> dict[str, tuple[str, int]]:
    """Make `RecordingInfo.topics` of what each channel carries."""
    found: dict[str, list[Topic]] = {}
    for one in channels:
        found.setdefault(one.name, []).append(one)
    return {
        name: (' | '.join(dict.fromkeys(o.type for o in own)), sum(o.n_messages for o in own))
        for name, own in found.items()
    }


class ImuColumns(NamedTuple):
    """
    What a sensor_msgs/Imu carries beside its stamp and its linear acceleration.

    The orientation is a quaternion x, y, z, w, shape (n, 4); the rates [rad/s] have shape (n, 3),
    each covariance (n, 9).
    """

    orientation: Floats
    orientation_covariance: Floats
    angular_velocity: Floats
    angular_velocity_covariance: Floats
    linear_acceleration_covariance: Floats

    @classmethod
    def of_rate(cls, rate: Floats) -> ImuColumns:
        """Give what is no orientation (REP 145), and rates; their covariances are not known."""
        no_orientation = [0.0, 0.0, 0.0, 1.0], [-1.0] + 8 * [0.0]
        level, none, unknown = (
            np.broadcast_to(row, (len(rate), len(row))) for row in (*no_orientation, np.zeros(9))
        )
        return cls(level, none, rate, unknown, unknown)

    def take(self, rows: Ints | Bools) -> ImuColumns:
        """Choose some messages."""
        return ImuColumns(*(one[rows] for one in self))


class Readings(NamedTuple):
    """What one thermometer said, shape (m,), `after` so many of the samples of its block."""

    stamp_ns: Ints
    celsius: Floats
    after: Ints


@dataclass(frozen=True, slots=True)
class Block:
    """
    A run of messages in reading order, as columns, n samples.

    `accel`, shape (n, 3), is in counts per cycle, or m/s^2 where the input is sensor_msgs/Imu;
    `imu` is the rest of that message. A block ends where the samples' `frame_id` changes. The
    temperatures are by the name of the thermometer, empty for those that the bag lacks; `log_ns`
    by role, as `raw`, where asked for.
    """

    accel_stamp_ns: Ints
    accel: Floats
    frame_id: str
    imu: ImuColumns | None
    temperatures: Mapping[str, Readings]
    log_ns: Mapping[Role, Ints]
    raw: Mapping[Role, Messages] = field(default_factory=dict)

    def __len__(self) -> int:
        """Count the accelerometer messages."""
        return len(self.accel_stamp_ns)

    @property
    def n_messages(self) -> int:
        """Count the messages of all roles."""
        return sum(map(len, self.log_ns.values()))

    def take(self, rows: Mapping[Role, Bools]) -> Block:
        """Choose some messages of each role."""
        own = rows['accel']
        n_before = np.concatenate(([0], np.cumsum(own)))
        return Block(
            self.accel_stamp_ns[own],
            self.accel[own],
            self.frame_id,
            self.imu and self.imu.take(own),
            {
                name: Readings(
                    one.stamp_ns[rows[name]],
                    one.celsius[rows[name]],
                    n_before[one.after[rows[name]]],
                )
                for name, one in self.temperatures.items()
            },
            {role: log_ns[rows[role]] for role, log_ns in self.log_ns.items()},
            {role: one.take(rows[role]).packed() for role, one in self.raw.items()},
        )


class Recording(NamedTuple):
    """A whole bag in memory, as one block with the `frame_id` of the first sample."""

    info: RecordingInfo
    columns: Block


def gathered(blocks: Iterable[Block], n_messages: int = 0) -> Iterator[Block]:
    """Put blocks together until each has so many messages, or the `frame_id` changes."""
    waiting: list[Block] = []
    frame_id: str | None = None
    n_wanted = n_messages or BLOCK_MESSAGES
    for block in blocks:
        if len(block):
            if frame_id not in {None, block.frame_id}:
                yield joined(waiting)
                waiting = []
            frame_id = block.frame_id
        waiting.append(block)
        if sum(one.n_messages for one in waiting) >= n_wanted:
            yield joined(waiting)
            waiting, frame_id = [], None
    if waiting:
        yield joined(waiting)


def joined(blocks: Sequence[Block]) -> Block:
    """Put blocks, at least one, behind each other as one, with the first sample's `frame_id`."""
    if len(blocks) == 1:
        return blocks[0]
    begins = np.cumsum([0, *map(len, blocks)])
    temperatures = {}
    for name in blocks[0].temperatures:
        stamps, celsius, afters = zip(*(block.temperatures[name] for block in blocks), strict=True)
        moved = [after + begin for after, begin in zip(afters, begins, strict=False)]
        temperatures[name] = Readings(*map(np.concatenate, (stamps, celsius, moved)))
    imus = [block.imu for block in blocks if block.imu is not None]
    raws: dict[Role, list[Messages]] = {}
    for block in blocks:
        for role, own in block.raw.items():
            raws.setdefault(role, []).append(own)
    return Block(
        np.concatenate([block.accel_stamp_ns for block in blocks]),
        np.concatenate([block.accel for block in blocks]),
        next((block.frame_id for block in blocks if len(block)), ''),
        ImuColumns(*map(np.concatenate, zip(*imus, strict=True))) if imus else None,
        temperatures,
        {role: np.concatenate([b.log_ns[role] for b in blocks]) for role in blocks[0].log_ns},
        {role: join_messages(own) for role, own in raws.items()},
    )
