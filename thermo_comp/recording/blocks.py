# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns blocks, the columns of consecutive messages of a bag, and the description of a bag.

A column is a numpy array with one row per message. All times are integer nanoseconds: ``stamp`` is
the stamp in a message's header, ``log`` the time when the recorder received the message.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ..errors import RecordingError
from ..typing import Bools, Floats, Ints
from .serialized import Messages, join_messages, scatter

Input = Literal['auto', 'counts', 'imu']
Role = str  # ``accel``, or the name of a thermometer

ROLES: tuple[Role, ...] = ('accel', 'board', 'case')

BLOCK_MESSAGES = 1 << 15  # messages per block: many, so that the overhead per block is negligible

NO_STAMP_NS = -(2**31) * 10**9  # marks a missing stamp: the earliest stamp of a header [ns]
_JUMP_NS = 10**9  # a backward step of the stamps by more than this is a jump of the clock [ns]
LONGEST_PAUSE_NS = 3600 * 10**9  # longer jumps of the stamps are shortened to this length [ns]
_MOST_JUMPS = 100  # largest number of jumps by over an hour in the stamps of a valid bag
_FEWEST_STAMPS = 10  # smallest number of stamps for a warning about their clock
_APART_S = 10.0  # largest median time between readings and adjacent samples of one clock [s]
_REPEAT_NS = 10 * 10**9  # `Readings.thinned` keeps a repeated reading after this time [ns]
_LONG_NS = 10 * 86400 * 10**9  # shortest duration of a long recording [ns]
_SPARSEST_NS = 10 * 10**9  # largest mean interval of messages in a long recording [ns]


class Topic(NamedTuple):
    """Topic of a channel in a bag: name, message type, encoding and number of messages."""

    name: str
    type: str
    encoding: str
    n_messages: int = 0


class BagFile:
    """An open file of a bag."""

    storage = 'mcap'

    def __init__(self, path: Path) -> None:
        self.path = path  # the path stated in error messages
        self.topics: dict[int, Topic] = {}  # topic of each channel number
        self.definitions: dict[str, tuple[str, str]] = {}  # encoding and text of each type
        self.metadata: dict[str, str] = {}
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.truncated: str | None = None  # description of missing data


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """The content of a bag, known before its messages are read."""

    path: Path
    storage: str
    topics: Mapping[str, tuple[str, int]]  # type ('A | B' for two types) and number of messages
    start_ns: int  # first log time, 0 without messages
    end_ns: int  # last log time, 0 without messages
    truncated: str | None = None  # description of missing parts
    metadata: Mapping[str, str] = field(default_factory=dict)  # keys and values stored in the bag
    input: Literal['counts', 'imu'] | None = None  # kind of the samples
    chosen: str | None = None  # notes on topics selected by their type, and on stamps

    @property
    def n_messages(self) -> int:
        """Number of messages of all topics."""
        return sum(count for _, count in self.topics.values())


class ImuColumns(NamedTuple):
    """Fields of sensor_msgs/Imu; a writer repeats an array of one row for all messages."""

    orientation: Floats  # quaternion x, y, z, w, shape (n, 4)
    orientation_covariance: Floats  # each covariance has the shape (n, 9)
    angular_velocity: Floats  # [rad/s], shape (n, 3)
    angular_velocity_covariance: Floats
    linear_acceleration_covariance: Floats

    @classmethod
    def of_rate(cls, rate: Floats | None) -> ImuColumns:
        """Build fields from angular rates (None: no rates), without an orientation (REP 145)."""
        none, unknown = np.array([-1.0] + 8 * [0.0]), np.zeros(9)
        level = np.array([0.0, 0.0, 0.0, 1.0])
        if rate is None:
            return cls(level, none, np.zeros(3), none, unknown)
        return cls(level, none, rate, unknown, unknown)

    def take(self, rows: Ints | Bools) -> ImuColumns:
        """Select messages."""
        return ImuColumns(*(column[rows] for column in self))


class Readings(NamedTuple):
    """Readings of a thermometer, shape (m,); `after`: number of samples before each reading."""

    stamp_ns: Ints
    celsius: Floats
    after: Ints = np.empty(0, np.int64)

    def take(self, which: Ints | Bools | slice) -> Readings:
        """Select readings; the result has no `after`."""
        return Readings(self.stamp_ns[which], self.celsius[which])

    def thinned(self) -> Readings:
        """Drop readings that are not finite, or that repeat the last kept reading within 10 s."""
        # Tables repeat a slow sensor's reading in each row until its next reading.
        kept: list[int] = []
        last_ns, last = 0, math.nan
        rows = zip(self.stamp_ns.tolist(), self.celsius.tolist(), strict=True)
        for row, (now_ns, value) in enumerate(rows):
            # A backward stamp is a restart of the clock: keep the reading.
            is_new = value != last or now_ns - last_ns >= _REPEAT_NS or now_ns < last_ns
            if is_new and math.isfinite(value):
                kept.append(row)
                last_ns, last = now_ns, value
        return self.take(np.array(kept, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive messages in reading order, as columns; a block ends where `frame_id` changes."""

    accel_stamp_ns: Ints
    accel: Floats  # counts per conversion cycle, or m/s^2 of sensor_msgs/Imu, shape (n, 3)
    frame_id: str
    imu: ImuColumns | None  # fields of sensor_msgs/Imu besides the acceleration
    temperatures: Mapping[str, Readings]  # readings of each thermometer
    log_ns: Mapping[Role, Ints]
    raw: Mapping[Role, Messages] = field(default_factory=dict)  # serialized messages, if requested

    def __len__(self) -> int:
        """Return the number of accelerometer messages."""
        return len(self.accel_stamp_ns)

    @property
    def n_messages(self) -> int:
        """Number of messages of the accelerometer and of all thermometers."""
        return sum(map(len, self.log_ns.values()))

    @property
    def stamp_ns(self) -> dict[Role, Ints]:
        """The stamps of the samples (key ``accel``) and of each thermometer's readings."""
        stamps = {name: readings.stamp_ns for name, readings in self.temperatures.items()}
        return {'accel': self.accel_stamp_ns, **stamps}

    def take(self, rows: Mapping[Role, Bools]) -> Block:
        """Select messages; `rows` has a mask for ``accel`` and for each thermometer."""
        is_taken = rows['accel']
        n_before = np.concatenate(([0], np.cumsum(is_taken)))
        temperatures = {
            name: readings.take(rows[name])._replace(after=n_before[readings.after[rows[name]]])
            for name, readings in self.temperatures.items()
        }
        return Block(
            self.accel_stamp_ns[is_taken],
            self.accel[is_taken],
            self.frame_id,
            self.imu and self.imu.take(is_taken),
            temperatures,
            {role: log_ns[rows[role]] for role, log_ns in self.log_ns.items()},
            {role: messages.take(rows[role]).packed() for role, messages in self.raw.items()},
        )


class Recording(NamedTuple):
    """A whole bag in memory, as one block with the `frame_id` of the first sample."""

    info: RecordingInfo
    columns: Block


def gathered(blocks: Iterable[Block]) -> Iterator[Block]:
    """Join blocks until they have `BLOCK_MESSAGES` messages, or until `frame_id` changes."""
    waiting: list[Block] = []
    for block in blocks:
        if len({each.frame_id for each in (*waiting, block) if len(each)}) > 1:
            yield joined(waiting)
            waiting = []
        waiting.append(block)
        if sum(each.n_messages for each in waiting) >= BLOCK_MESSAGES:
            yield joined(waiting)
            waiting = []
    if waiting:
        yield joined(waiting)


def joined(blocks: Sequence[Block]) -> Block:
    """Join a nonempty list of blocks into a block with the `frame_id` of the first sample."""
    if len(blocks) == 1:
        return blocks[0]
    begins = np.cumsum([0, *map(len, blocks)])
    temperatures = {}
    for name in blocks[0].temperatures:
        parts = zip((block.temperatures[name] for block in blocks), begins, strict=False)
        moved = [part._replace(after=part.after + begin) for part, begin in parts]
        temperatures[name] = Readings(*map(np.concatenate, zip(*moved, strict=True)))
    imus = [block.imu for block in blocks if block.imu is not None]
    raws = {role: [b.raw[role] for b in blocks if role in b.raw] for b in blocks for role in b.raw}
    return Block(
        np.concatenate([block.accel_stamp_ns for block in blocks]),
        np.concatenate([block.accel for block in blocks]),
        next((block.frame_id for block in blocks if len(block)), ''),
        ImuColumns(*map(np.concatenate, zip(*imus, strict=True))) if imus else None,
        temperatures,
        {role: np.concatenate([b.log_ns[role] for b in blocks]) for role in blocks[0].log_ns},
        {role: join_messages(parts) for role, parts in raws.items()},
    )


def with_stamps(block: Block, last_ns: int) -> tuple[Block, int]:
    """
    Give each reading without a stamp the newest stamp of the samples before it, because its log
    time depends on the speed of a playback; drop readings without a stamp before the first sample.
    `last_ns`: newest sample stamp before the block. Return the block and the newest sample stamp.
    """
    samples = np.concatenate(([last_ns], block.accel_stamp_ns))
    jumps = np.flatnonzero(np.diff(samples) < -_JUMP_NS) + 1
    newest = np.concatenate([np.maximum.accumulate(run) for run in np.split(samples, jumps)])
    temperatures, kept = dict(block.temperatures), {}
    for name, readings in block.temperatures.items():
        is_bare = readings.stamp_ns == NO_STAMP_NS
        if is_bare.any():
            stamp_ns = np.where(is_bare, newest[readings.after], readings.stamp_ns)
            temperatures[name] = readings._replace(stamp_ns=stamp_ns)
            kept[name] = stamp_ns != NO_STAMP_NS
            if name in block.raw:  # write the stamps into the serialized little-endian headers
                stamps = np.stack((stamp_ns // 10**9, stamp_ns % 10**9), axis=1).astype('<i4')
                raw = block.raw[name]
                scatter(raw.data, raw.start + 4, stamps.view((np.void, 8))[:, 0])
    if kept:
        everything = {role: np.ones(len(times), bool) for role, times in block.log_ns.items()}
        block = replace(block, temperatures=temperatures).take({**everything, **kept})
    return block, int(newest[-1])


def unstamped(stamp_ns: int) -> str:
    """Return the warning that all samples have the same stamp."""
    return f'all samples are stamped {stamp_ns * 1e-9:g} s: the driver does not stamp them'


def clocks_apart(block: Block) -> str:
    """Return a warning for equal stamps or for readings on another clock than samples; else ''."""
    stamps = block.accel_stamp_ns
    if len(stamps) >= _FEWEST_STAMPS and (stamps == stamps[0]).all():
        return unstamped(int(stamps[0]))
    for name, readings in block.temperatures.items():
        inside = (readings.after > 0) & (readings.after < len(block))
        stamp_ns, after = readings.stamp_ns[inside], readings.after[inside]
        edges = block.accel_stamp_ns[after - 1], block.accel_stamp_ns[after]
        apart_s = (stamp_ns - np.clip(stamp_ns, *edges)) * 1e-9
        if len(apart_s) >= _FEWEST_STAMPS and abs(middle := np.median(apart_s)) > _APART_S:
            return (
                f'{name} readings are stamped {middle:+.0f} s from the samples around them: do '
                'the stamps of thermometer and accelerometer come from two clocks?'
            )
    return ''


def without_jumps(blocks: Iterable[Block], path: Path) -> Iterator[Block]:
    """
    Turn a jump of the stamps by over an hour, forwards or backwards, into a gap of an hour.
    A clock that is set during a recording can leave a gap of years, too long for a time grid. A
    gap of an hour suffices to make the thermal state unknown. Raises RecordingError for more than
    100 such jumps, and for over ten days with less than one message per 10 s on average.
    """
    last_ns: int | None = None
    offset = 0
    n_jumps = n_messages = span_ns = 0
    for block in blocks:
        thermometers = block.temperatures.values()
        # Sort readings and samples in the bag's order: a reading follows `after` samples.
        places = [*(thermometer.after for thermometer in thermometers), np.arange(len(block))]
        stamps = np.concatenate([*(part.stamp_ns for part in thermometers), block.accel_stamp_ns])
        order = np.argsort(np.concatenate(places), kind='stable')
        read: Ints = stamps[order]
        steps = np.diff(read, prepend=read[0] if last_ns is None else last_ns)
        is_jump = np.abs(steps) > LONGEST_PAUSE_NS
        moved = offset + np.cumsum(np.where(is_jump, LONGEST_PAUSE_NS - steps, 0))
        last_ns, offset = int(read[-1]), int(moved[-1])
        n_jumps += int(np.count_nonzero(is_jump))
        n_messages += len(read)
        span_ns += int(np.sum(np.where(is_jump, LONGEST_PAUSE_NS, np.maximum(steps, 0))))
        if n_jumps > _MOST_JUMPS or span_ns > max(_LONG_NS, n_messages * _SPARSEST_NS):
            reason = f'{n_messages} messages stamped over {span_ns / 86400e9:.0f} days with '
            reason += f'{n_jumps} jumps by more than an hour: no recording of a thermal test'
            raise RecordingError(clocks_apart(block) or reason, path)
        stamps[order] += moved
        parts = np.split(stamps, np.cumsum([len(readings.after) for readings in thermometers]))
        temperatures = {
            name: readings._replace(stamp_ns=stamp_ns)
            for (name, readings), stamp_ns in zip(block.temperatures.items(), parts, strict=False)
        }
        yield replace(block, accel_stamp_ns=parts[-1], temperatures=temperatures)
