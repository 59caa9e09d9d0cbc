# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the step from found messages to blocks."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..errors import RecordingError
from ..typing import Ints
from .columns import NO_READINGS, Block, ImuColumns, RawMessages, Readings, Role
from .messages import Messages, Topic, pack
from .topics import IMU, shown
from .wire import Stamped, as_cdr, decode_stamped

#: The columns of sensor_msgs/Imu among its numbers, as `ImuColumns` has them.
_IMU_COLUMNS = (slice(0, 4), slice(4, 13), slice(13, 16), slice(16, 25), slice(28, 37))
_IMU_ACCELERATION = slice(25, 28)


class _Found(NamedTuple):
    """Messages of one role, with their places among all of a stretch."""

    rank: Ints
    messages: Messages
    stamped: Stamped


class Decoder:
    """
    Turns messages into blocks.

    `feeds` are the topics of the roles, `channels` has the role of each channel that is read.
    `names` are all thermometers, `keep_raw` keeps the serialized messages too.
    """

    def __init__(
        self,
        feeds: Mapping[Role, Topic],
        channels: Mapping[int, Role],
        names: Collection[str],
        keep_raw: bool,
    ) -> None:
        self._feeds = feeds
        self._channels = {
            role: [number for number, own in channels.items() if own == role] for role in feeds
        }
        self._names = names
        self._keep_raw = keep_raw
        self._is_imu = 'accel' in feeds and feeds['accel'].type == IMU

    def blocks(self, messages: Messages) -> list[Block]:
        """
        Decode messages, in their order; a block ends where the frame changes.

        Raises RecordingError, without a path, for a message whose bytes do not fit its type.
        """
        found = {role: self._found(messages, role) for role in self._feeds}
        if 'accel' in found:
            rank, _, (_, _, frame) = found['accel']
            changes = rank[1:][frame[1:] != frame[:-1]].tolist()
            if changes:
                runs = pairwise([0, *changes, len(messages)])
                return [self.blocks(messages.take(slice(*run)))[0] for run in runs]
        return [self._block(found)]

    def _block(self, found: Mapping[Role, _Found]) -> Block:
        no_ns = NO_READINGS.stamp_ns
        nothing = Stamped(no_ns, np.empty((0, 37 if self._is_imu else 3)), np.empty(0, 'S1'))
        rank, accel = no_ns, nothing
        if 'accel' in found:
            rank, _, accel = found['accel']
        temperatures = dict.fromkeys(self._names, NO_READINGS)
        log_ns = dict.fromkeys(('accel', *self._names), no_ns)
        raw = {}
        for role, (own_rank, messages, (stamp_ns, numbers, _)) in found.items():
            log_ns[role] = messages.log_ns
            if role != 'accel':
                after = np.searchsorted(rank, own_rank).astype(np.int64)
                temperatures[role] = Readings(stamp_ns, numbers[:, 0], after)
            if self._keep_raw and len(messages):
                topic, kind, *_ = self._feeds[role]
                packed = pack(messages.data, messages.start, messages.size)
                raw[role] = RawMessages(topic, kind, messages.log_ns, *packed)
        is_imu, numbers = self._is_imu, accel.numbers
        return Block(
            accel.stamp_ns,
            np.ascontiguousarray(numbers[:, _IMU_ACCELERATION]) if is_imu else numbers,
            accel.frame[0].decode('utf-8', 'replace') if len(accel.frame) else '',
            ImuColumns(*(numbers[:, c] for c in _IMU_COLUMNS)) if is_imu else None,
            temperatures,
            log_ns,
            raw,
        )

    def _found(self, messages: Messages, role: Role) -> _Found:
        feed = self._feeds[role]
        rank = messages.places_of(self._channels[role])
        own = messages.take(rank)
        try:
            if feed.encoding == 'ros1':
                own = as_cdr(own, feed.type)
            return _Found(rank, own, decode_stamped(own, feed.type))
        except RecordingError as error:
            raise RecordingError(error.message, topic=shown(feed.name)) from error
