# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the stretches of an MCAP file that hold messages: read one, and find the messages in it.

The message index behind a chunk is never trusted. What it points at must be message records that,
together with the few other records between them, tile the chunk without gap or overlap; where
they do not, or there is no index, the records are walked one by one. Layout: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..typing import Bytes, Ints
from .messages import Messages, field, gather
from .unpack import MAX_CHUNK_BYTES, DamagedError, unpack, unpack_beginning

#: Opcode and length in front of each record.
PREFIX = struct.Struct('<BQ')
#: Enough of a chunk's record to hold its head.
HEAD_BYTES = 160
_CHUNK_HEAD = struct.Struct('<BQQQQII')
_INDEX_HEAD = struct.Struct('<BQHI')
#: Log time and offset of one message, 8 bytes each.
_INDEX_ROW_BYTES = 16
#: Bytes of a message record before its serialized message; of these, after the prefix.
MESSAGE_HEAD_BYTES = 31
_MESSAGE_FIELDS_BYTES = MESSAGE_HEAD_BYTES - PREFIX.size
MESSAGE = int(Opcode.MESSAGE)

#: Why a walk stopped, besides damage that is said in other words.
_ENDS_EARLY = 'a record ends too early'
_ZERO_OPCODE = 'a record has the opcode 0'

#: Reads so many bytes at a place of the file, fewer only where it ends.
ReadAt = Callable[[int, int], bytes]
#: Is given opcode and content of every record that is no message.
OnRecord = Callable[[int, bytes], None]


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


def parse_chunk_head(head: bytes, position: int) -> tuple[Span, str, int, int]:
    """Read the head of the chunk at this place: its span, compression, begin of data, checksum."""
    try:
        found = _CHUNK_HEAD.unpack_from(head)
        opcode, content, start_ns, end_ns, size, checksum, n_name = found
        if opcode != Opcode.CHUNK:
            raise DamagedError(f'no chunk at byte {position}')
        name_end = _CHUNK_HEAD.size + n_name
        data_at = name_end + 8
        if n_name <= 64 and len(head) < data_at:
            raise DamagedError('a record is shorter than its content')
    except struct.error as error:
        raise DamagedError('a record is shorter than its content') from error
    n_packed = int.from_bytes(head[name_end:data_at], 'little')
    length = PREFIX.size + content
    if n_name > 64 or data_at + n_packed != length:
        raise DamagedError(f'the chunk at byte {position} has a damaged head')
    compression = head[_CHUNK_HEAD.size : name_end].decode('utf-8', 'replace')
    return Span(position, length, 0, size, start_ns, end_ns), compression, data_at, checksum


def load(read_at: ReadAt, span: Span, on_record: OnRecord) -> Messages:
    """Read a stretch of the file and find its messages, in the order of their places."""
    try:
        if span.kind == 'chunk':
            return _load_chunk(read_at, span, on_record)
        record = read_at(span.position, min(span.length, MAX_CHUNK_BYTES))
        data = np.frombuffer(record, np.uint8)
        if span.kind == 'torn':
            _, compression, data_at, _ = parse_chunk_head(record[:HEAD_BYTES], span.position)
            data = unpack_beginning(compression, data[data_at:])
        messages, _, reason = walk(data, on_record)
        if span.kind == 'loose' and reason not in {'', _ZERO_OPCODE}:
            raise DamagedError(reason)
        # The message before a stretch of zeros may itself end in zeros that are none of its own.
        return messages.take(slice(-1)) if reason == _ZERO_OPCODE else messages
    except DamagedError as error:
        place = 'at' if span.kind == 'loose' else 'chunk at'
        raise DamagedError(f'{place} byte {span.position}: {error}') from error


def _load_chunk(read_at: ReadAt, span: Span, on_record: OnRecord) -> Messages:
    n_bytes = span.length + span.index_length
    if max(span.size, n_bytes) > MAX_CHUNK_BYTES:
        raise DamagedError(
            f'{span.length} bytes claim to hold {span.size}, a chunk may have {MAX_CHUNK_BYTES}'
        )
    record = read_at(span.position, n_bytes)
    if len(record) < n_bytes:
        raise DamagedError('the file ends inside it')
    head, compression, data_at, checksum = parse_chunk_head(record[:HEAD_BYTES], span.position)
    if head.length != span.length or head.size != span.size:
        raise DamagedError('its size is not what the index of the file says')
    packed = np.frombuffer(record, np.uint8, span.length - data_at, data_at)
    data = unpack(compression, packed, span.size, checksum)
    messages = locate(data, memoryview(record)[span.length :], on_record)
    log_ns = messages.log_ns
    if len(log_ns) and (np.min(log_ns) < span.start_ns or np.max(log_ns) > span.end_ns):
        raise DamagedError('its messages are outside the time it claims')
    return messages


def locate(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages:
    """Find all messages of a whole chunk, with the message index records behind it as a hint."""
    messages = _indexed(data, index, on_record)
    if messages is None:
        messages, end, reason = walk(data, on_record)
        if end != len(data):
            raise DamagedError(reason)
    return messages


def _indexed(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages | None:
    """Find the messages by the index; None where it is not the whole truth."""
    columns: list[Ints] = []
    begin = 0
    while begin + _INDEX_HEAD.size <= len(index):
        opcode, content, _, length = _INDEX_HEAD.unpack_from(index, begin)
        begin += _INDEX_HEAD.size
        if opcode != Opcode.MESSAGE_INDEX:
            raise DamagedError('what follows it is not its message index')
        if content != length + 6 or length % _INDEX_ROW_BYTES or begin + length > len(index):
            return None
        if length:
            # An offset that no chunk can have comes out negative.
            rows = (length // _INDEX_ROW_BYTES,)
            columns.append(np.ndarray(rows, '<i8', index, begin + 8, (_INDEX_ROW_BYTES,)))
        begin += length
    if begin != len(index) or not columns:
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


def walk(data: Bytes, on_record: OnRecord) -> tuple[Messages, int, str]:
    """
    Go from record to record as far as they are whole.

    Returns the messages, where the first record begins that is not whole (the length of `data`
    where all are), and what is wrong with that one. Raises DamagedError for impossible times.
    """
    view = data.data
    places: list[int] = []
    at, reason = 0, ''
    while at < len(data):
        if at + PREFIX.size > len(data):
            reason = _ENDS_EARLY
            break
        opcode, length = PREFIX.unpack_from(view, at)
        end = at + PREFIX.size + length
        if opcode == 0:
            reason = _ZERO_OPCODE
        elif opcode == MESSAGE and length < _MESSAGE_FIELDS_BYTES:
            reason = f'a message record has {length} bytes'
        elif end > len(data):
            reason = _ENDS_EARLY
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
