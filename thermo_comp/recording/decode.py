# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the step from found messages to the rows of each role."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import RecordingError
from ..typing import Bools, Bytes, Ints
from .assemble import Part, Rows
from .columns import Role
from .encode import stamped_payloads
from .topics import TEMPERATURE, shown
from .walk import MESSAGE_HEAD_BYTES, Messages
from .wire import Encoding, Stamped, decode_stamped, frame_runs, gather, scatter


@dataclass(frozen=True, slots=True)
class Feed:
    """
    What feeds a role.

    Attributes
    ----------
    topic : str
    type : str
        Message type.
    encoding : {'cdr', 'ros1'}

    """

    topic: str
    type: str
    encoding: Encoding


class Decoder:
    """
    Turns messages of some channels into rows per role.

    Parameters
    ----------
    feeds : dict of role to Feed
        What feeds each role.
    roles : dict of int to role
        The role of each channel that is read; other channels are passed over.
    keep_raw : bool
        Keep the serialized messages too.

    """

    def __init__(self, feeds: dict[Role, Feed], roles: dict[int, Role], keep_raw: bool) -> None:
        self._feeds = feeds
        self._channels = {
            role: np.array([n for n, own in roles.items() if own == role], np.uint16)
            for role in feeds
        }
        self._keep_raw = keep_raw

    def part(self, data: Bytes, messages: Messages, place: int | None) -> Part:
        """
        Decode the messages of one stretch.

        Parameters
        ----------
        data : ndarray of uint8
            The bytes they are in.
        messages : Messages
            In the order of their places.
        place : int or None
            Ranks are this number plus the message's place in `data`, in that order; or, where it
            is None, the messages are put in order of log time and ranked from 0.

        Raises
        ------
        RecordingError
            A message whose bytes do not fit its type; without a path.

        """
        log_ns = messages.log_ns
        order = None
        if place is None and (log_ns[1:] < log_ns[:-1]).any():
            order = np.argsort(log_ns, kind='stable')
        part: Part = {}
        for role, feed in self._feeds.items():
            is_own = self._is_from(messages.channel, role)
            own = rank = np.flatnonzero(is_own)
            if order is not None:
                rank = np.flatnonzero(is_own[order])
                own = order[rank]
            if len(own):
                at = messages.at[own]
                part[role] = self.rows(
                    feed,
                    role,
                    data,
                    at + MESSAGE_HEAD_BYTES,
                    messages.size[own],
                    log_ns[own],
                    rank if place is None else at + place,
                )
        return part

    def _is_from(self, channel: NDArray[np.uint16], role: Role) -> Bools:
        channels = self._channels[role]
        is_own: Bools = (
            channel == channels[0] if len(channels) == 1 else np.isin(channel, channels)
        )
        return is_own

    def rows(
        self,
        feed: Feed,
        role: Role,
        data: Bytes,
        start: Ints,
        size: Ints,
        log_ns: Ints,
        rank: Ints,
    ) -> Rows:
        """
        Decode messages of one role.

        Parameters
        ----------
        feed : Feed
            What they are.
        role : Role
            Whom they feed.
        data : ndarray of uint8
            The bytes they are in.
        start, size : ndarray of int64, shape (n,)
            Where each serialized message stands.
        log_ns, rank : ndarray of int64, shape (n,)
            Their log times and ranks.

        Raises
        ------
        RecordingError
            A message whose bytes do not fit its type; without a path.

        """
        n_wanted = 1 if feed.type == TEMPERATURE and not self._keep_raw else None
        try:
            stamped = decode_stamped(data, start, size, feed.type, feed.encoding, n_wanted)
        except RecordingError as error:
            raise RecordingError(error.message, topic=shown(feed.topic)) from error
        is_framed = role == 'accel' or (self._keep_raw and feed.encoding == 'ros1')
        frames = frame_runs(data, stamped) if is_framed else [(0, '')]
        raw = None
        if self._keep_raw:
            raw = (
                pack(data, start, size) if feed.encoding == 'cdr' else _reencoded(stamped, frames)
            )
        return Rows(rank, stamped.stamp_ns, log_ns, stamped.numbers, frames, raw)


def pack(data: Bytes, start: Ints, size: Ints) -> tuple[Bytes, Ints]:
    """
    Put pieces of bytes behind each other.

    Parameters
    ----------
    data : ndarray of uint8
        The bytes.
    start, size : ndarray of int64, shape (n,)
        The pieces.

    Returns
    -------
    packed : ndarray of uint8
    ends : ndarray of int64, shape (n,)
        Where each piece ends.

    """
    ends = np.cumsum(size)
    packed = np.empty(int(np.sum(size)), np.uint8)
    for each in np.unique(size).tolist():
        if each:
            own = np.flatnonzero(size == each)
            scatter(packed, ends[own] - each, gather(data, start[own], each))
    return packed, ends


def _reencoded(stamped: Stamped, frames: list[tuple[int, str]]) -> tuple[Bytes, Ints]:
    """CDR of messages that came in another encoding."""
    pieces: list[Bytes] = []
    sizes: list[Ints] = []
    stops = [row for row, _ in frames[1:]] + [len(stamped.stamp_ns)]
    for (begin, text), end in zip(frames, stops, strict=True):
        payloads = stamped_payloads(stamped.stamp_ns[begin:end], text, stamped.numbers[begin:end])
        pieces.append(payloads.ravel())
        sizes.append(np.full(end - begin, payloads.shape[1], np.int64))
    return np.concatenate(pieces), np.cumsum(np.concatenate(sizes))
