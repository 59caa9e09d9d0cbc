# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the stretches of an MCAP file that hold messages: read one, and find the messages in it.

The message index behind a chunk is never trusted. What it points at must be message records that,
together with the few other records between them, tile the chunk without gap or overlap; where
they do not, or there is no index, the records are walked one by one. Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..files import open_regular
from ..typing import Bytes, Ints
from .unpack import MAX_CHUNK_BYTES, DamagedError, unpack, unpack_beginning
from .wire import field, gather, scatter

#: Opcode and length in front of each record.
PREFIX = struct.Struct('<BQ')
#: Enough of a chunk's record to hold its head.
HEAD_BYTES = 160
_CHUNK_HEAD = struct.Struct('<BQQQQII')
_LENGTH = struct.Struct('<Q')
_INDEX_HEAD = struct.Struct('<BQHI')
#: Log time and offset of one message, 8 bytes each.
_INDEX_ROW_BYTES = 16
#: Bytes of a message record before its serialized message; of these, after the prefix.
MESSAGE_HEAD_BYTES = 31
_MESSAGE_FIELDS_BYTES = MESSAGE_HEAD_BYTES - PREFIX.size
MESSAGE = int(Opcode.MESSAGE)
_LOOSE = (int(Opcode.MESSAGE), int(Opcode.SCHEMA), int(Opcode.CHANNEL))

#: Why a walk stopped, besides damage that is said in other words.
ENDS_EARLY = 'a record ends too early'
OTHER_RECORD = 'a record of another kind'
ZERO_OPCODE = 'a record has the opcode 0'

#: Is given opcode and content of every record that is no message.
OnRecord = Callable[[int, bytes], None]


class LocalFile:
    """
    A file that is read at places, from any thread.

    OSError if it is a FIFO or a device: these would never end.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_regular(path)
        self.size = os.fstat(self._file.fileno()).st_size

    def read_at(self, at: int, n_bytes: int) -> bytes:
        """Read up to so many bytes, fewer only where the file ends."""
        return os.pread(self._file.fileno(), n_bytes, at)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


@dataclass(frozen=True, slots=True)
class Span:
    """
    A stretch of a file: a chunk, one whose end is missing, or messages outside any chunk.

    `position` and `length` [bytes] are those of its records, with `index_length` bytes of message
    indexes behind it; `size` is its content's, `start_ns` and `end_ns` the log times of its
    messages.
    """

    position: int
    length: int
    index_length: int = 0
    size: int = 0
    start_ns: int = 0
    end_ns: int = 0
    kind: Literal['chunk', 'torn', 'loose'] = 'chunk'


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

    def __len__(self) -> int:
        """Count them."""
        return len(self.start)

    def take(self, which: Ints | slice) -> Messages:
        """Choose some of them; the bytes stay."""
        return Messages(
            self.data, self.start[which], self.size[which], self.channel[which], self.log_ns[which]
        )

    def packed(self) -> Messages:
        """Put their bytes behind each other, so that the others' can go."""
        data, ends = pack(self.data, self.start, self.size)
        return Messages(data, ends - self.size, self.size, self.channel, self.log_ns)


def join_messages(pieces: Sequence[Messages]) -> Messages:
    """Put messages, at least one piece, behind each other."""
    if len(pieces) == 1:
        return pieces[0]
    begins = np.cumsum([0, *(len(one.data) for one in pieces)])
    return Messages(
        np.concatenate([one.data for one in pieces]),
        np.concatenate([one.start + at for one, at in zip(pieces, begins, strict=False)]),
        np.concatenate([one.size for one in pieces]),
        np.concatenate([one.channel for one in pieces]),
        np.concatenate([one.log_ns for one in pieces]),
    )


def pack(data: Bytes, start: Ints, size: Ints) -> tuple[Bytes, Ints]:
    """Put pieces of bytes behind each other; gives these and the end of each piece."""
    ends = np.cumsum(size)
    packed = np.empty(int(np.sum(size)), np.uint8)
    for each in np.unique(size).tolist():
        if each:
            own = np.flatnonzero(size == each)
            scatter(packed, ends[own] - each, gather(data, start[own], each))
    return packed, ends


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a chunk says of itself; its `data_at` is where the packed bytes begin in the record."""

    span: Span
    compression: str
    data_at: int
    checksum: int


def parse_chunk_head(head: bytes, position: int) -> ChunkHead:
    """Read the first bytes of the chunk at this place of the file."""
    try:
        found = _CHUNK_HEAD.unpack_from(head)
        opcode, content, start_ns, end_ns, size, checksum, n_name = found
        if opcode != Opcode.CHUNK:
            raise DamagedError(f'no chunk at byte {position}')
        if content < 40 or n_name > 64:
            raise DamagedError(f'the chunk at byte {position} has a damaged head')
        name_end = _CHUNK_HEAD.size + n_name
        (n_packed,) = _LENGTH.unpack_from(head, name_end)
    except struct.error as error:
        raise DamagedError('a record is shorter than its content') from error
    data_at = name_end + _LENGTH.size
    length = PREFIX.size + content
    if data_at + n_packed != length:
        raise DamagedError(f'the chunk at byte {position} has a damaged head')
    compression = head[_CHUNK_HEAD.size : name_end].decode('utf-8', 'replace')
    span = Span(position, length, 0, size, start_ns, end_ns)
    return ChunkHead(span, compression, data_at, checksum)


def load(handle: LocalFile, span: Span, on_record: OnRecord) -> Messages:
    """Read a stretch of the file and find its messages, in the order of their places."""
    try:
        if span.kind == 'loose':
            data = np.frombuffer(handle.read_at(span.position, span.length), np.uint8)
            return walk(data, on_record)[0]
        if span.kind == 'torn':
            return _load_torn(handle, span, on_record)
        return _load_chunk(handle, span, on_record)
    except DamagedError as error:
        place = 'at' if span.kind == 'loose' else 'chunk at'
        raise DamagedError(f'{place} byte {span.position}: {error}') from error


def _load_chunk(handle: LocalFile, span: Span, on_record: OnRecord) -> Messages:
    n_bytes = span.length + span.index_length
    if max(span.size, n_bytes) > MAX_CHUNK_BYTES:
        raise DamagedError(
            f'{span.length} bytes claim to hold {span.size}, a chunk may have {MAX_CHUNK_BYTES}'
        )
    record = handle.read_at(span.position, n_bytes)
    if len(record) < n_bytes:
        raise DamagedError('the file ends inside it')
    head = parse_chunk_head(record[:HEAD_BYTES], span.position)
    if head.span.length != span.length or head.span.size != span.size:
        raise DamagedError('its size is not what the index of the file says')
    packed = np.frombuffer(record, np.uint8, span.length - head.data_at, head.data_at)
    data = unpack(head.compression, packed, span.size, head.checksum)
    messages = locate(data, memoryview(record)[span.length :], on_record)
    log_ns = messages.log_ns
    if len(log_ns) and (np.min(log_ns) < span.start_ns or np.max(log_ns) > span.end_ns):
        raise DamagedError('its messages are outside the time it claims')
    return messages


def _load_torn(handle: LocalFile, span: Span, on_record: OnRecord) -> Messages:
    record = handle.read_at(span.position, min(span.length, MAX_CHUNK_BYTES))
    head = parse_chunk_head(record[:HEAD_BYTES], span.position)
    packed = np.frombuffer(record, np.uint8)[head.data_at :]
    messages, _, reason = walk(unpack_beginning(head.compression, packed), on_record)
    # The message before a stretch of zeros may itself end in zeros that are none of its own.
    return messages.take(slice(-1)) if reason == ZERO_OPCODE else messages


def locate(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages:
    """
    Find all messages of a whole chunk, with the message index records behind it as a hint.

    Raises DamagedError where the bytes are no sequence of records.
    """
    messages = _indexed(data, index, on_record)
    if messages is None:
        messages, end, reason = walk(data, on_record)
        if end != len(data):
            raise DamagedError(reason)
    return messages


def _indexed(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages | None:
    """Find the messages by the index; None where it is not the whole truth."""
    columns = _index_columns(index)
    if not columns:
        return None
    at = np.sort(np.concatenate(columns), kind='stable')
    if at[0] < 0 or at[-1] > len(data) - MESSAGE_HEAD_BYTES:
        return None
    head = gather(data, at, MESSAGE_HEAD_BYTES)
    # Unsigned on purpose: a length that is too small wraps around to one that is too large.
    length = field(head, 1, '<u8') - np.uint64(_MESSAGE_FIELDS_BYTES)
    if int(np.max(length)) > len(data) or (field(head, 0, 'u1') != MESSAGE).any():
        return None
    size = length.view(np.int64)
    begins = np.concatenate(([0], at + size + MESSAGE_HEAD_BYTES))
    ends = np.concatenate((at, [len(data)]))
    if (begins > ends).any():
        return None
    found: list[tuple[int, bytes]] = []
    for gap in np.flatnonzero(begins < ends).tolist():
        between = data[begins[gap] : ends[gap]]
        extra, stop, _ = walk(between, lambda *record: found.append(record))
        if len(extra) or stop != len(between):
            return None
    for record in found:
        on_record(*record)
    return _messages(data, at, size, head)


def _index_columns(index: memoryview) -> list[Ints] | None:
    """Offsets of the messages by each index record; None where these are not usable."""
    columns: list[Ints] = []
    at = 0
    while at + _INDEX_HEAD.size <= len(index):
        opcode, content, _, length = _INDEX_HEAD.unpack_from(index, at)
        at += _INDEX_HEAD.size
        if opcode != Opcode.MESSAGE_INDEX:
            raise DamagedError('what follows it is not its message index')
        if content != length + 6 or length % _INDEX_ROW_BYTES or at + length > len(index):
            return None
        if length:
            # An offset that no chunk can have comes out negative.
            rows = (length // _INDEX_ROW_BYTES,)
            columns.append(np.ndarray(rows, '<i8', index, at + 8, (_INDEX_ROW_BYTES,)))
        at += length
    return columns if at == len(index) else None


def walk(data: Bytes, on_record: OnRecord, *, is_loose: bool = False) -> tuple[Messages, int, str]:
    """
    Go from record to record as far as they are whole; outside a chunk, up to one of another kind.

    Returns the messages, where the first record begins that is not whole (the length of `data`
    where all are), and what is wrong with that one. Raises DamagedError for impossible times.
    """
    view = data.data
    places: list[int] = []
    at, reason = 0, ''
    while at < len(data):
        if at + PREFIX.size > len(data):
            reason = ENDS_EARLY
            break
        opcode, length = PREFIX.unpack_from(view, at)
        end = at + PREFIX.size + length
        if opcode == 0:
            reason = ZERO_OPCODE
        elif is_loose and opcode not in _LOOSE:
            reason = OTHER_RECORD
        elif opcode == MESSAGE and length < _MESSAGE_FIELDS_BYTES:
            reason = f'a message record has {length} bytes'
        elif end > len(data):
            reason = ENDS_EARLY
        if reason:
            break
        if opcode == MESSAGE:
            places.append(at)
        else:
            on_record(opcode, bytes(view[at + PREFIX.size : end]))
        at = end
    found = np.array(places, np.int64)
    head = gather(data, found, MESSAGE_HEAD_BYTES)
    size = field(head, 1, '<i8') - _MESSAGE_FIELDS_BYTES
    return _messages(data, found, size, head), at, reason


def _messages(data: Bytes, at: Ints, size: Ints, head: NDArray[np.void]) -> Messages:
    log_ns = field(head, 15, '<i8').astype(np.int64)
    if len(log_ns) and int(np.min(log_ns)) < 0:
        raise DamagedError('a message has a log time beyond the year 2262')
    # Copied: each role looks at all of them.
    channel = field(head, 9, '<u2').astype(np.uint16)
    return Messages(data, at + MESSAGE_HEAD_BYTES, size, channel, log_ns)
