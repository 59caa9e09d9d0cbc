# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the step from found messages to blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import RecordingError
from ..typing import Ints
from .chunks import Messages, pack
from .columns import NO_READINGS, Block, ImuColumns, RawMessages, Readings, Role
from .encode import stamped_payloads
from .topics import IMU, TEMPERATURE, shown
from .wire import Encoding, Stamped, decode_stamped, frame_runs

#: The columns of sensor_msgs/Imu among its numbers, as `ImuColumns` has them.
_IMU_COLUMNS = (slice(0, 4), slice(4, 13), slice(13, 16), slice(16, 25), slice(28, 37))
_IMU_ACCELERATION = slice(25, 28)


@dataclass(frozen=True, slots=True)
class Feed:
    """What feeds a role: a topic, its message type and its encoding."""

    topic: str
    type: str
    encoding: Encoding


@dataclass(frozen=True, slots=True)
class _Rows:
    """Decoded messages of one role, with their places among all of a stretch."""

    rank: Ints
    log_ns: Ints
    messages: Messages
    stamped: Stamped
    frames: list[tuple[int, str]]


class Decoder:
    """
    Turns messages into blocks.

    `channels` has the role of each channel that is read; the others are passed over. `names` are
    all thermometers, `keep_raw` keeps the serialized messages too.
    """

    def __init__(
        self,
        feeds: Mapping[Role, Feed],
        channels: Mapping[int, Role],
        names: Collection[str],
        keep_raw: bool,
    ) -> None:
        self._feeds = feeds
        self._channels = {
            role: np.array([n for n, own in channels.items() if own == role], np.uint16)
            for role in feeds
        }
        self._names = names
        self._keep_raw = keep_raw
        self._is_imu = 'accel' in feeds and feeds['accel'].type == IMU

    def chosen(self, messages: Messages) -> Messages:
        """Keep the messages that are read."""
        channels = np.concatenate(list(self._channels.values()))
        return messages.take(np.flatnonzero(np.isin(messages.channel, channels)))

    def blocks(self, messages: Messages) -> Iterator[Block]:
        """
        Decode messages, in their order; a block ends where the frame changes.

        Raises RecordingError, without a path, for a message whose bytes do not fit its type.
        """
        rows = {role: self._rows(messages, role) for role in self._feeds}
        accel = rows.pop('accel', None)
        frames = [row for row, _ in accel.frames] if accel is not None else []
        n_accel = len(accel.rank) if accel is not None else 0
        after = {
            name: np.zeros(len(one.rank), np.int64)
            if accel is None
            else np.searchsorted(accel.rank, one.rank).astype(np.int64)
            for name, one in rows.items()
        }
        begins = dict.fromkeys(rows, 0)
        for begin, end in zip(frames or [0], [*frames[1:], n_accel], strict=True):
            ends = {
                name: int(np.searchsorted(after[name], end, 'right')) if end < n_accel else None
                for name in rows
            }
            own = {name: slice(begins[name], ends[name]) for name in rows}
            yield self._block(accel, slice(begin, end), rows, own, after)
            begins = {name: stop or 0 for name, stop in ends.items()}

    def _block(
        self,
        accel: _Rows | None,
        samples: slice,
        rows: Mapping[str, _Rows],
        own: Mapping[str, slice],
        after: Mapping[str, Ints],
    ) -> Block:
        numbers = np.empty((0, 37 if self._is_imu else 3))
        stamp_ns = np.empty(0, np.int64)
        temperatures = dict.fromkeys(self._names, NO_READINGS)
        parts: dict[Role, tuple[_Rows, slice]] = {}
        if accel is not None:
            parts['accel'] = accel, samples
            numbers, stamp_ns = accel.stamped.numbers[samples], accel.stamped.stamp_ns[samples]
        for name, one in rows.items():
            part = own[name]
            parts[name] = one, part
            temperatures[name] = Readings(
                one.stamped.stamp_ns[part],
                one.stamped.numbers[part, 0],
                after[name][part] - samples.start,
            )
        log_ns = dict.fromkeys(('accel', *self._names), NO_READINGS.stamp_ns)
        log_ns.update({role: one.log_ns[part] for role, (one, part) in parts.items()})
        raw: tuple[RawMessages, ...] = ()
        if self._keep_raw:
            raw = tuple(self._raw(role, *found) for role, found in parts.items())
        return Block(
            stamp_ns,
            np.ascontiguousarray(numbers[:, _IMU_ACCELERATION]) if self._is_imu else numbers,
            next((text for row, text in accel.frames if row == samples.start), '')
            if accel is not None
            else '',
            ImuColumns(*(numbers[:, c] for c in _IMU_COLUMNS)) if self._is_imu else None,
            temperatures,
            log_ns,
            tuple(one for one in raw if len(one.ends)),
        )

    def _rows(self, messages: Messages, role: Role) -> _Rows:
        feed, channels = self._feeds[role], self._channels[role]
        is_own = (
            messages.channel == channels[0]
            if len(channels) == 1
            else np.isin(messages.channel, channels)
        )
        rank = np.flatnonzero(is_own)
        own = messages if len(rank) == len(messages) else messages.take(rank)
        n_wanted = 1 if feed.type == TEMPERATURE and not self._keep_raw else None
        try:
            stamped = decode_stamped(
                own.data, own.start, own.size, feed.type, feed.encoding, n_wanted
            )
        except RecordingError as error:
            raise RecordingError(error.message, topic=shown(feed.topic)) from error
        is_framed = role == 'accel' or (self._keep_raw and feed.encoding == 'ros1')
        frames = frame_runs(stamped.frame) if is_framed else [(0, '')]
        return _Rows(rank, own.log_ns, own, stamped, frames)

    def _raw(self, role: Role, rows: _Rows, part: slice) -> RawMessages:
        feed, own = self._feeds[role], rows.messages.take(part)
        if feed.encoding == 'cdr':
            data, ends = pack(own.data, own.start, own.size)
            return RawMessages(feed.topic, feed.type, own.log_ns, data, ends)
        # CDR of messages that came in another encoding; their frames differ one from the next.
        firsts = np.array([row for row, _ in rows.frames])
        pieces = [
            stamped_payloads(
                rows.stamped.stamp_ns[row : row + 1],
                rows.frames[int(np.searchsorted(firsts, row, 'right')) - 1][1],
                rows.stamped.numbers[row : row + 1],
            ).ravel()
            for row in range(len(rows.rank))[part]
        ]
        ends = np.cumsum([len(piece) for piece in pieces], dtype=np.int64)
        data = np.concatenate(pieces) if pieces else np.empty(0, np.uint8)
        return RawMessages(feed.topic, feed.type, own.log_ns, data, ends)
