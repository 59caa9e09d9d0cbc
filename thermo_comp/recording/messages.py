# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns serialized messages by the thousand: their bytes in one array, and where each begins."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..typing import Bools, Bytes, Ints


def gather(buffer: Bytes, at: Ints, n_bytes: int) -> NDArray[Any]:
    """Copy `n_bytes` from each position, so far before the buffer's end, as rows of void."""
    kind = np.dtype((np.void, n_bytes))
    if len(at) == 0:
        return np.empty(0, kind)
    everywhere: NDArray[Any] = np.ndarray(
        (buffer.size - n_bytes + 1,), kind, buffer.data, strides=(1,)
    )
    return everywhere[at]


def scatter(buffer: Bytes, at: Ints, rows: NDArray[Any]) -> None:
    """Copy rows to positions of a buffer, the inverse of `gather`."""
    if len(at):
        everywhere: NDArray[Any] = np.ndarray(
            (buffer.size - rows.itemsize + 1,), rows.dtype, buffer.data, strides=(1,)
        )
        everywhere[at] = rows


def field(rows: NDArray[Any], offset: int, kind: str) -> NDArray[Any]:
    """Look at one number of each gathered row, by its offset [bytes] and numpy type: a view."""
    if len(rows) == 0:
        return np.empty(0, kind)
    view: NDArray[Any] = np.ndarray(
        (len(rows),), kind, rows.data, offset=offset, strides=(rows.itemsize,)
    )
    return view


Done = TypeVar('Done')


class Topic(NamedTuple):
    """What a channel carries: its topic, message type, encoding and number of messages."""

    name: str
    type: str
    encoding: str
    n_messages: int = 0


@dataclass(frozen=True, slots=True)
class Messages:
    """
    Serialized messages by their place in some bytes, shape (n,) each.

    `start` and `size` are where they stand in `data` and how long they are [bytes].
    """

    data: Bytes
    start: Ints
    size: Ints
    channel: NDArray[np.uint16]
    log_ns: Ints

    @classmethod
    def of(cls, pieces: Sequence[bytes], channel: Any, log_ns: Any) -> Messages:
        """Put messages behind each other."""
        size = np.fromiter(map(len, pieces), np.int64, len(pieces))
        data = np.frombuffer(b''.join(pieces), np.uint8)
        numbers, times = np.asarray(channel, np.uint16), np.asarray(log_ns, np.int64)
        return cls(data, np.cumsum(size) - size, size, numbers, times)

    def __len__(self) -> int:
        """Count them."""
        return len(self.start)

    def __iter__(self) -> Iterator[bytes]:
        """Give the bytes of each."""
        data = self.data.tobytes()
        for at, size in zip(self.start.tolist(), self.size.tolist(), strict=True):
            yield data[at : at + size]

    def take(self, which: Ints | Bools | slice) -> Messages:
        """Choose some of them; the bytes stay."""
        return Messages(
            self.data, self.start[which], self.size[which], self.channel[which], self.log_ns[which]
        )

    def places_of(self, numbers: Collection[int]) -> Ints:
        """Find those of some channels."""
        is_own = np.zeros(len(self), np.bool_)
        for number in numbers:  # a few; as fast as one
            is_own |= self.channel == number
        return np.flatnonzero(is_own)

    def of_channels(self, numbers: Collection[int]) -> Messages:
        """Choose those of some channels."""
        places = self.places_of(numbers)
        return self if len(places) == len(self) else self.take(places)

    def in_order(self) -> Messages:
        """Sort them by log time and, for equal ones, by their places."""
        if (self.log_ns[1:] >= self.log_ns[:-1]).all():
            return self
        return self.take(np.argsort(self.log_ns, kind='stable'))

    def packed(self, room: int = 0) -> Messages:
        """Put their bytes behind each other, with room before each, so that the others' can go."""
        ends = np.cumsum(self.size + room)
        data = np.empty(int(ends[-1]) if len(ends) else 0, np.uint8)
        for each in np.unique(self.size[self.size > 0]).tolist():
            own = np.flatnonzero(self.size == each)
            scatter(data, ends[own] - each, gather(self.data, self.start[own], each))
        return Messages(data, ends - self.size, self.size, self.channel, self.log_ns)


def join_messages(pieces: Sequence[Messages]) -> Messages:
    """Put messages, at least one piece, behind each other."""
    if len(pieces) == 1:
        return pieces[0]
    begins = np.cumsum([0, *(len(one.data) for one in pieces)])
    return Messages(
        np.concatenate([one.data for one in pieces]),
        np.concatenate([one.start + at for one, at in zip(pieces, begins, strict=False)]),
        *(np.concatenate([getattr(one, n) for one in pieces]) for n in Messages.__slots__[2:]),
    )


#: What is done with messages while their bytes are at hand.
Work: TypeAlias = Callable[[Messages], Done]


class BagFile(ABC):
    """
    One open file of a bag; `path` is what errors call it.

    `topics` are by the number of their channel, `definitions` encoding and text by message type,
    `start_ns` and `end_ns` the log times of the first and the last message; `truncated` says what
    is missing.
    """

    storage = 'mcap'

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, Topic] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self.metadata: dict[str, str] = {}
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.truncated: str | None = None

    @abstractmethod
    def read(self, channels: Collection[int], work: Work[Done]) -> Iterator[Done]:
        """Read the messages of channels in reading order, and do some work on them."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""
