# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns batches of serialized messages, and copies of bytes between them and numpy arrays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..typing import Bools, Bytes, Ints


def gather(buffer: Bytes, at: Ints, n_bytes: int) -> Any:
    """Copy `n_bytes` from each position in a buffer into a row of type void."""
    return _everywhere(buffer, n_bytes)[at] if len(at) else np.empty(0, (np.void, n_bytes))


def scatter(buffer: Bytes, at: Ints, rows: NDArray[Any]) -> None:
    """Copy rows to positions of a buffer, the inverse of `gather`."""
    if len(at):
        _everywhere(buffer, rows.itemsize)[at] = rows


def _everywhere(buffer: Bytes, n_bytes: int) -> Any:
    shape = (buffer.size - n_bytes + 1,)
    return np.ndarray(shape, np.dtype((np.void, n_bytes)), buffer.data, strides=(1,))


def number_at(rows: NDArray[Any], offset: int, kind: str) -> Any:
    """Return the number of numpy type `kind` at an offset [bytes] of each row, without a copy."""
    if len(rows) == 0:
        return np.empty(0, kind)
    return np.ndarray((len(rows),), kind, rows.data, offset=offset, strides=(rows.itemsize,))


@dataclass(frozen=True, slots=True)
class Messages:
    """Serialized messages, shape (n,), by their positions and lengths [bytes] in `data`."""

    data: Bytes
    start: Ints
    size: Ints
    channel: NDArray[np.uint16]
    log_ns: Ints

    @classmethod
    def of(cls, pieces: Sequence[bytes], channel: Any, log_ns: Any) -> Messages:
        """Concatenate messages."""
        size = np.fromiter(map(len, pieces), np.int64, len(pieces))
        data = np.frombuffer(b''.join(pieces), np.uint8)
        numbers, times = np.asarray(channel, np.uint16), np.asarray(log_ns, np.int64)
        return cls(data, np.cumsum(size) - size, size, numbers, times)

    @classmethod
    def of_rows(cls, rows: Bytes, channel: NDArray[np.uint16], log_ns: Ints) -> Messages:
        """Make a message of each row of bytes, shape (n, size)."""
        size = np.full(len(rows), rows.shape[1])
        return cls(rows.ravel(), np.cumsum(size) - size, size, channel, log_ns)

    def __len__(self) -> int:
        return len(self.start)

    def __iter__(self) -> Iterator[bytes]:
        """Yield the bytes of each message."""
        data = self.data.tobytes()
        for at, size in zip(self.start.tolist(), self.size.tolist(), strict=True):
            yield data[at : at + size]

    def take(self, which: Ints | Bools | slice) -> Messages:
        """Select messages; the result shares the bytes in `data`."""
        return Messages(
            self.data, self.start[which], self.size[which], self.channel[which], self.log_ns[which]
        )

    def places_of(self, numbers: Collection[int]) -> Ints:
        """Return the indices of the messages of some channels."""
        is_chosen = np.zeros(len(self), np.bool_)
        for number in numbers:  # several times as fast as `np.isin`
            is_chosen |= self.channel == number
        return np.flatnonzero(is_chosen)

    def of_channels(self, numbers: Collection[int]) -> Messages:
        """Select the messages of some channels."""
        places = self.places_of(numbers)
        return self if len(places) == len(self) else self.take(places)

    def in_order(self) -> Messages:
        """Sort the messages by log time; messages with equal log times keep their order."""
        if (self.log_ns[1:] >= self.log_ns[:-1]).all():
            return self
        return self.take(np.argsort(self.log_ns, kind='stable'))

    def packed(self, room: int = 0) -> Messages:
        """Copy the messages so that `data` can be freed; leave `room` bytes before each copy."""
        ends = np.cumsum(self.size + room)
        data = np.empty(int(ends[-1]) if len(ends) else 0, np.uint8)
        for each in np.unique(self.size[self.size > 0]).tolist():
            rows = np.flatnonzero(self.size == each)
            scatter(data, ends[rows] - each, gather(self.data, self.start[rows], each))
        return Messages(data, ends - self.size, self.size, self.channel, self.log_ns)


def join_messages(pieces: Sequence[Messages]) -> Messages:
    """Concatenate a nonempty list of batches of messages."""
    if len(pieces) == 1:
        return pieces[0]
    begins = np.cumsum([0, *(len(piece.data) for piece in pieces)])
    return Messages(
        np.concatenate([piece.data for piece in pieces]),
        np.concatenate([piece.start + at for piece, at in zip(pieces, begins, strict=False)]),
        *(np.concatenate([getattr(piece, n) for piece in pieces]) for n in Messages.__slots__[2:]),
    )
