# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from columns to MCAP message records: structured arrays, no loop over messages.

Columns wait as they are. Once it is known which messages make a chunk, just their records are
built, so that nothing larger than a chunk is ever laid out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..typing import Bytes, Floats, Ints
from .wire import gather, scatter

OPCODE_MESSAGE = 5
_NS = 1_000_000_000

#: Values of some of the numbers of a message: first column and the columns' values.
Piece = tuple[int, Floats]


def layout(n_bytes: int, /, **fields: tuple[Any, int]) -> np.dtype[Any]:
    """Describe rows of bytes by the type and offset of each field."""
    content: Any = {
        'names': list(fields),
        'formats': [kind for kind, _ in fields.values()],
        'offsets': [offset for _, offset in fields.values()],
        'itemsize': n_bytes,
    }
    described: np.dtype[Any] = np.dtype(content)
    return described


#: Opcode, length, channel, sequence, log time, publish time.
RECORD_HEAD = layout(
    31,
    opcode=('u1', 0),
    size=('<u8', 1),
    channel=('<u2', 9),
    sequence=('<u4', 11),
    log=('<u8', 15),
    publish=('<u8', 23),
)


class Records(Protocol):
    """
    Messages of one channel that wait to be written, shape (n,); `size` is that of each whole
    record [bytes].
    """

    channel: int
    log_ns: Ints
    size: Ints

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """
        Build the records of the chosen messages: their places among the chosen, and rows of one
        size.
        """
        ...


class StampedRecords:
    """
    Messages that are a header and float64 numbers.

    Each piece is the first column and the values of some of the numbers; those without are 0.
    """

    def __init__(
        self,
        channel: int,
        stamp_ns: Ints,
        log_ns: Ints,
        frame_id: str,
        n_numbers: int,
        pieces: Sequence[Piece],
    ) -> None:
        self.channel = channel
        self.log_ns = log_ns
        self._stamp_ns = stamp_ns
        payload = _stamped_layout(frame_id, n_numbers)
        n_bytes = RECORD_HEAD.itemsize + payload.itemsize
        self.size = np.broadcast_to(np.int64(n_bytes), log_ns.shape)
        self._layout = layout(
            n_bytes, head=(RECORD_HEAD, 0), payload=(payload, RECORD_HEAD.itemsize)
        )
        # What all records have in common is written once, and copied with the rest.
        common: list[Piece] = []
        self._varying: list[Piece] = []
        for column, values in pieces:
            is_common = len(values) and values.strides[0] == 0
            (common if is_common else self._varying).append((column, values))
        pattern: NDArray[Any] = np.zeros(1, self._layout)
        _fill_head(pattern, channel, np.zeros(1, np.int64))
        _fill_frame(pattern['payload'], frame_id)
        _fill_numbers(pattern['payload'], [(column, values[:1]) for column, values in common])
        self._pattern = pattern.view((np.void, n_bytes))[0]

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """Build the records of the chosen messages."""
        which = _run(chosen)
        rows: NDArray[Any] = np.empty(len(chosen), self._layout)
        rows.view((np.void, self._layout.itemsize))[:] = self._pattern
        rows['head']['log'] = self.log_ns[which]
        rows['head']['publish'] = self.log_ns[which]
        payload = rows['payload']
        _fill_stamps(payload, self._stamp_ns[which])
        _fill_numbers(payload, [(column, values[which]) for column, values in self._varying])
        yield slice(None), _as_void(rows)


class RawRecords:
    """Messages that are serialized already, behind each other in `data`, each up to its `ends`."""

    def __init__(self, channel: int, log_ns: Ints, data: Bytes, ends: Ints) -> None:
        self.channel = channel
        self.log_ns = log_ns
        self._data = data
        self._ends = ends
        self._length = np.diff(ends, prepend=0)
        self.size = self._length + RECORD_HEAD.itemsize

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """Build the records of the chosen messages."""
        length = self._length[chosen]
        for each in np.unique(length).tolist():
            which = np.flatnonzero(length == each)
            source = chosen[which]
            rows: NDArray[Any] = np.zeros(
                len(which),
                layout(
                    RECORD_HEAD.itemsize + each,
                    head=(RECORD_HEAD, 0),
                    payload=(np.dtype((np.void, each)), RECORD_HEAD.itemsize),
                ),
            )
            _fill_head(rows, self.channel, self.log_ns[source])
            if each:
                rows['payload'] = gather(self._data, self._ends[source] - each, each)
            yield which, _as_void(rows)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Message records behind each other in `data`; `size` is that of each [bytes], shape (n,)."""

    data: Bytes
    channel: NDArray[np.uint16]
    log_ns: Ints
    size: Ints


class Merged:
    """
    The messages of several channels in log-time order, cut into stretches on demand.

    For equal log times the earlier batch goes first.
    """

    def __init__(self, batches: list[Records]) -> None:
        self._batches = batches
        counts = [len(batch.log_ns) for batch in batches]
        self._first = np.cumsum([0, *counts])
        log_ns = np.concatenate([batch.log_ns for batch in batches])
        size = np.concatenate([batch.size for batch in batches])
        self._order = np.argsort(log_ns, kind='stable')
        self._log_ns = log_ns[self._order]
        self._size = size[self._order]
        self._ends = np.cumsum(self._size)
        self._owner = np.repeat(np.arange(len(batches)), counts)[self._order]
        self._at = 0

    def take(self, n_bytes: int) -> Stretch | None:
        """
        Build the next records, until they have at least so many bytes; None where nothing is left.
        """
        begin = self._at
        if begin == len(self._order):
            return None
        done = int(self._ends[begin] - self._size[begin])
        end = min(int(np.searchsorted(self._ends, done + n_bytes)) + 1, len(self._order))
        self._at = end
        data = np.empty(int(self._ends[end - 1]) - done, np.uint8)
        at = self._ends[begin:end] - self._size[begin:end] - done
        owner = self._owner[begin:end]
        channel = np.empty(end - begin, np.uint16)
        for number in np.unique(owner).tolist():
            batch = self._batches[number]
            which = np.flatnonzero(owner == number)
            channel[which] = batch.channel
            chosen = self._order[begin:end][which] - self._first[number]
            for some, rows in batch.rows(chosen):
                scatter(data, at[which[some]], rows)
        return Stretch(data, channel, self._log_ns[begin:end], self._size[begin:end])


def stamped_payloads(stamp_ns: Ints, frame_id: str, numbers: Floats) -> Bytes:
    """Serialize (CDR, little-endian) a header and `numbers`, shape (n, k), as rows of uint8."""
    payload = _stamped_layout(frame_id, numbers.shape[1])
    rows: NDArray[Any] = np.zeros(len(stamp_ns), payload)
    _fill_frame(rows, frame_id)
    _fill_stamps(rows, stamp_ns)
    _fill_numbers(rows, [(0, numbers)])
    return rows.view(np.uint8).reshape(len(stamp_ns), payload.itemsize)


def _stamped_layout(frame_id: str, n_numbers: int) -> np.dtype[Any]:
    length = len(frame_id.encode()) + 1
    body = 4 + (12 + length + 7) // 8 * 8
    return layout(
        body + 8 * n_numbers,
        order=('u1', 1),
        sec=('<i4', 4),
        nanosec=('<u4', 8),
        length=('<u4', 12),
        frame=(np.dtype((np.void, length)), 16),
        numbers=(('<f8', (n_numbers,)), body),
    )


def _fill_frame(rows: NDArray[Any], frame_id: str) -> None:
    characters = frame_id.encode() + b'\0'
    rows['order'] = 1
    rows['length'] = len(characters)
    rows['frame'] = np.void(characters)


def _fill_stamps(rows: NDArray[Any], stamp_ns: Ints) -> None:
    seconds = stamp_ns // _NS
    rows['sec'] = seconds
    rows['nanosec'] = stamp_ns - seconds * _NS


def _fill_numbers(rows: NDArray[Any], pieces: Sequence[Piece]) -> None:
    numbers = rows['numbers']
    for column, values in pieces:
        for k, value in enumerate(values.T, column):
            numbers[:, k] = value


def _run(chosen: Ints) -> Ints | slice:
    """Say the same as a slice, where rising places stand one behind the other."""
    first, last = int(chosen[0]), int(chosen[-1])
    if last - first + 1 != len(chosen) or (chosen[1:] < chosen[:-1]).any():
        return chosen
    return slice(first, last + 1)


def _fill_head(rows: NDArray[Any], channel: int, log_ns: Ints) -> None:
    head = rows['head']
    head['opcode'] = OPCODE_MESSAGE
    head['size'] = rows.itemsize - 9
    head['channel'] = channel
    head['log'] = log_ns
    head['publish'] = log_ns


def _as_void(rows: NDArray[Any]) -> NDArray[Any]:
    return rows.view(np.dtype((np.void, rows.itemsize)))


def as_times(name: str, values: ArrayLike, n: int | None = None) -> Ints:
    """Check a column of nanoseconds: `n` integers, none negative; ValueError for another."""
    times = np.atleast_1d(np.asarray(values))
    if times.size == 0:
        times = times.astype(np.int64)
    if times.dtype.kind not in 'iu' or times.ndim != 1:
        raise ValueError(f'`{name}` must be one row of integers, got {times.dtype}')
    if n is not None and len(times) != n:
        raise ValueError(f'`{name}` must have {n} values, got {len(times)}')
    checked: Ints = times.astype(np.int64, copy=False)
    if len(checked) and int(np.min(checked)) < 0:
        raise ValueError(f'`{name}` must not be negative, got {int(np.min(checked))}')
    return checked


def as_numbers(name: str, values: ArrayLike, n: int, width: int) -> Floats:
    """Check a column of numbers, shape (n, width) or (width,) for the same in each row."""
    numbers = np.asarray(values, np.float64)
    if numbers.shape not in {(n, width), (width,)}:
        raise ValueError(f'`{name}` must have shape ({n}, {width}), got {numbers.shape}')
    return np.broadcast_to(numbers, (n, width))
