# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from columns to MCAP message records: structured arrays, no loop over messages.

Columns wait as they are. Once it is known which messages make a chunk, just their records are
built, so that nothing larger than a chunk is ever laid out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..typing import Bytes, Floats, Ints
from .chunks import MESSAGE, MESSAGE_HEAD_BYTES, PREFIX
from .messages import Messages, gather, scatter

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
_RECORD_HEAD = layout(
    MESSAGE_HEAD_BYTES,
    opcode=('u1', 0),
    size=('<u8', 1),
    channel=('<u2', 9),
    sequence=('<u4', 11),
    log=('<u8', 15),
    publish=('<u8', 23),
)


class Records(Protocol):
    """Messages of one channel that wait to be written, and the bytes of each, shape (n,)."""

    channel: int
    log_ns: Ints
    size: Ints

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """Serialize the chosen: their places among the chosen, and rows of bytes of one size."""
        ...


class StampedRecords:
    """
    Messages that are a header and float64 numbers, as CDR, little-endian.

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
        characters = frame_id.encode() + b'\0'
        body = 4 + (12 + len(characters) + 7) // 8 * 8
        self._layout = layout(
            body + 8 * n_numbers,
            order=('u1', 1),
            sec=('<i4', 4),
            nanosec=('<u4', 8),
            length=('<u4', 12),
            frame=(np.dtype((np.void, len(characters))), 16),
            numbers=(('<f8', (n_numbers,)), body),
        )
        self.size = np.broadcast_to(np.int64(self._layout.itemsize), log_ns.shape)
        # What all have in common is written once, and copied with the rest.
        common: list[Piece] = []
        self._varying: list[Piece] = []
        for column, values in pieces:
            is_common = len(values) and values.strides[0] == 0
            (common if is_common else self._varying).append((column, values))
        pattern: NDArray[Any] = np.zeros(1, self._layout)
        pattern['order'], pattern['length'] = 1, len(characters)
        pattern['frame'] = np.void(characters)
        _fill_numbers(pattern, [(column, values[:1]) for column, values in common])
        self._pattern = _as_void(pattern)[0]

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """Serialize the chosen messages."""
        which = _run(chosen)
        rows: NDArray[Any] = np.empty(len(chosen), self._layout)
        _as_void(rows)[:] = self._pattern
        seconds = self._stamp_ns[which] // _NS
        rows['sec'] = seconds
        rows['nanosec'] = self._stamp_ns[which] - seconds * _NS
        _fill_numbers(rows, [(column, values[which]) for column, values in self._varying])
        yield slice(None), _as_void(rows)


class RawRecords:
    """Messages that are serialized already, behind each other in `data`, each up to its `ends`."""

    def __init__(self, channel: int, log_ns: Ints, data: Bytes, ends: Ints) -> None:
        self.channel = channel
        self.log_ns = log_ns
        self._data = data
        self._ends = ends
        self.size = np.diff(ends, prepend=0)

    def rows(self, chosen: Ints) -> Iterator[tuple[Ints | slice, NDArray[Any]]]:
        """Give the chosen messages."""
        size = self.size[chosen]
        for each in np.unique(size[size > 0]).tolist():
            which = np.flatnonzero(size == each)
            yield which, gather(self._data, self._ends[chosen[which]] - each, each)


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
        size = np.concatenate([batch.size for batch in batches]) + MESSAGE_HEAD_BYTES
        self._order = np.argsort(log_ns, kind='stable')
        self._log_ns = log_ns[self._order]
        self._size = size[self._order]
        self._ends = np.cumsum(self._size)
        self._owner = np.repeat(np.arange(len(batches)), counts)[self._order]
        self._at = 0

    def take(self, n_bytes: int) -> Messages | None:
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
        heads: NDArray[Any] = np.zeros(end - begin, _RECORD_HEAD)
        heads['opcode'] = MESSAGE
        heads['size'] = self._size[begin:end] - PREFIX.size
        heads['log'] = heads['publish'] = self._log_ns[begin:end]
        for number in np.unique(owner).tolist():
            batch = self._batches[number]
            which = np.flatnonzero(owner == number)
            heads['channel'][which] = batch.channel
            chosen = self._order[begin:end][which] - self._first[number]
            for some, rows in batch.rows(chosen):
                scatter(data, at[which[some]] + MESSAGE_HEAD_BYTES, rows)
        scatter(data, at, _as_void(heads))
        size = self._size[begin:end] - MESSAGE_HEAD_BYTES
        channel, log_ns = heads['channel'].copy(), self._log_ns[begin:end]
        return Messages(data, at + MESSAGE_HEAD_BYTES, size, channel, log_ns)


def stamped_payloads(stamp_ns: Ints, frame_id: str, numbers: Floats) -> Bytes:
    """Serialize (CDR, little-endian) a header and `numbers`, shape (n, k), as rows of uint8."""
    pieces = [(0, numbers)]
    records = StampedRecords(0, stamp_ns, stamp_ns, frame_id, numbers.shape[1], pieces)
    if not len(stamp_ns):
        return np.empty((0, 0), np.uint8)
    ((_, rows),) = records.rows(np.arange(len(stamp_ns)))
    return rows.view(np.uint8).reshape(len(rows), rows.itemsize)


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
