# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the parts of an MCAP file that hold messages: decompresses the parts, finds the messages.

A complete chunk must expand to the size that it declares, at most 64 MiB. The message index of a
chunk is only used if the messages in the index fill the chunk without gap or overlap; otherwise
the records of the chunk are read one by one. https://mcap.dev/spec
"""

import bz2
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Bytes, Ints
from .serialized import Messages, gather, number_at

PREFIX = struct.Struct('<BQ')  # opcode and length in front of each record
HEAD_BYTES = 160  # bytes read at the begin of a record, enough for the head of a chunk
_CHUNK_HEAD = struct.Struct('<BQQQQII')
_INDEX_HEAD = struct.Struct('<BQHI')
_INDEX_ROW_BYTES = 16  # log time and offset of one message, 8 bytes each
MESSAGE_HEAD_BYTES = 31  # number of bytes before the serialized message in a record
_MESSAGE_FIELDS_BYTES = MESSAGE_HEAD_BYTES - PREFIX.size  # bytes between `PREFIX` and message
MESSAGE = int(Opcode.MESSAGE)

#: Reasons why `scan_records` stopped before the end of the data.
_ENDS_EARLY = 'a record ends too early'
_ZERO_OPCODE = 'a record has the opcode 0'
MAX_CHUNK_BYTES = 1 << 26  # largest declared content of a chunk [bytes]
#: A compressed file may expand to `_MAX_GROWTH` times its size plus `_FREE_GROWTH_BYTES` [bytes].
_MAX_GROWTH = 1024
_FREE_GROWTH_BYTES = 1 << 26
_MAX_WINDOW = 1 << 27  # largest window of zstd [bytes]
_STEP_BYTES = 1 << 16  # bytes decompressed at a time; whole pieces before a damaged byte are kept
_ENGINES: Mapping[str, Callable[[], Any]] = {
    'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor,
}

#: Callback for every record that is not a message, with the record's opcode and content.
OnRecord = Callable[[int, bytes], None]


class DamagedError(Exception):
    """Damaged bytes in a bag; the text of the error describes the damage."""


@contextmanager
def translated(path: Path, *, is_foreign: bool = False) -> Iterator[None]:
    """Turn errors of reading (if `is_foreign`, any error) into RecordingErrors with the path."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(error.message, path, error.key) from error
    except DamagedError as error:
        raise RecordingError(f'damaged: {error}', path) from error
    except OSError as error:
        raise RecordingError(f'cannot be read: {error.strerror or error}', path) from error
    except Exception as error:
        if not is_foreign:
            raise
        text = ' '.join(str(error).split()) or type(error).__name__
        raise RecordingError(f'the bag cannot be read: {text}', path) from error


@dataclass(frozen=True, slots=True)
class Span:
    """Part of a file: 'chunk', 'torn' (a chunk without its end), 'loose' (messages, no chunk)."""

    position: int
    length: int  # number of bytes, without the message indexes after the part
    index_length: int = 0
    size: int = 0  # number of bytes after decompression
    start_ns: int = 0
    end_ns: int = 0
    kind: Literal['chunk', 'torn', 'loose'] = 'chunk'


def parse_chunk_head(head: bytes, position: int) -> tuple[Span, str, int, int]:
    """Return the span of a chunk, its compression, the offset of its data and its checksum."""
    try:
        fields = _CHUNK_HEAD.unpack_from(head)
        opcode, content, start_ns, end_ns, size, checksum, n_name = fields
        name, n_packed = struct.unpack_from(f'<{n_name}sQ', head, _CHUNK_HEAD.size)
    except struct.error as error:
        raise DamagedError(f'the chunk at byte {position} has a damaged head') from error
    length, data_at = PREFIX.size + content, _CHUNK_HEAD.size + n_name + 8
    if opcode != Opcode.CHUNK or data_at + n_packed != length:
        raise DamagedError(f'the chunk at byte {position} has a damaged head')
    span = Span(position, length, 0, size, start_ns, end_ns)
    return span, name.decode('utf-8', 'replace'), data_at, checksum


def load(read_at: Callable[[int, int], bytes], span: Span, on_record: OnRecord) -> Messages:
    """Read a span of the file; find its messages, in the order of their positions in the file."""
    n_bytes = span.length + span.index_length
    try:
        if span.kind == 'chunk' and max(span.size, n_bytes) > MAX_CHUNK_BYTES:
            raise DamagedError(
                f'{n_bytes} bytes declare a content of {span.size} bytes, limit {MAX_CHUNK_BYTES}'
            )
        record = read_at(span.position, min(n_bytes, MAX_CHUNK_BYTES))
        data = np.frombuffer(record, np.uint8)
        if span.kind == 'loose':
            messages, reason = scan_records(data, on_record)
            if reason not in {'', _ZERO_OPCODE}:
                raise DamagedError(reason)
            return messages
        head, compression, data_at, checksum = parse_chunk_head(record[:HEAD_BYTES], span.position)
        if span.kind == 'torn':
            data = inflate(compression, data[data_at:], MAX_CHUNK_BYTES, is_torn=True)
            return scan_records(data, on_record)[0]
        if head.length != span.length or head.size != span.size:
            raise DamagedError('its size differs from the size in the index of the file')
        data = inflate(compression, data[data_at : span.length], span.size, span.size + 1)
        if len(data) != span.size:
            raise DamagedError(f'{len(data)} bytes after decompression, expected {span.size}')
        if checksum and zlib.crc32(data.data) != checksum:
            raise DamagedError('the checksum does not match the content')
        messages = locate(data, memoryview(record)[span.length :], on_record)
        log_ns = messages.log_ns
        if len(log_ns) and (np.min(log_ns) < span.start_ns or np.max(log_ns) > span.end_ns):
            raise DamagedError('the chunk has messages outside its declared times')
    except DamagedError as error:
        place = 'at' if span.kind == 'loose' else 'chunk at'
        raise DamagedError(f'{place} byte {span.position}: {error}') from error
    return messages


def locate(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages:
    """Find all messages of a complete chunk, if possible by the message index after the chunk."""
    messages = _indexed(data, index)
    if messages is None:
        messages, reason = scan_records(data, on_record)
        if reason:
            raise DamagedError(reason)
    return messages


def _indexed(data: Bytes, index: memoryview) -> Messages | None:
    """Find messages by a chunk's index; None if the messages do not fill the chunk exactly."""
    columns: list[Ints] = []
    begin = 0
    while begin + _INDEX_HEAD.size <= len(index):
        opcode, content, _, length = _INDEX_HEAD.unpack_from(index, begin)
        begin += _INDEX_HEAD.size
        is_sound = opcode == Opcode.MESSAGE_INDEX and content == length + 6
        if not is_sound or length % _INDEX_ROW_BYTES or begin + length > len(index):
            return None
        # An unsigned offset of 2^63 or more becomes negative, which `is_inside` refuses.
        columns.append(np.frombuffer(index, '<i8', length // 8, begin)[1::2])
        begin += length
    at = np.sort(np.concatenate(columns), kind='stable') if columns else np.empty(0, np.int64)
    is_inside = len(at) > 0 and at[0] >= 0 and at[-1] <= len(data) - MESSAGE_HEAD_BYTES
    if begin != len(index) or not is_inside:
        return None
    head = gather(data, at, MESSAGE_HEAD_BYTES)
    # A length below the size of the fields becomes a huge unsigned number, refused as > len(data).
    length = number_at(head, 1, '<u8') - np.uint64(_MESSAGE_FIELDS_BYTES)
    if int(np.max(length)) > len(data) or (number_at(head, 0, 'u1') != MESSAGE).any():
        return None
    size = length.view(np.int64)
    begins = np.concatenate(([0], at + size + MESSAGE_HEAD_BYTES))
    if at[0] or begins[-1] != len(data) or (begins[1:-1] != at[1:]).any():
        return None
    return _messages(data, at, size, head)


def scan_records(data: Bytes, on_record: OnRecord) -> tuple[Messages, str]:
    """
    Read complete records one by one; return the messages, and why reading stopped early, else ''.
    The last message before zeros is dropped: the zeros may have replaced bytes of this message.
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
    starts = np.array(places[:-1] if reason == _ZERO_OPCODE else places, np.int64)
    head = gather(data, starts, MESSAGE_HEAD_BYTES)
    size = number_at(head, 1, '<i8') - _MESSAGE_FIELDS_BYTES
    return _messages(data, starts, size, head), reason


def _messages(data: Bytes, at: Ints, size: Ints, head: NDArray[np.void]) -> Messages:
    log_ns = number_at(head, 15, '<i8').astype(np.int64)
    if len(log_ns) and int(np.min(log_ns)) < 0:
        raise DamagedError('a message has a log time beyond the year 2262')
    channel = number_at(head, 9, '<u2').astype(np.uint16)  # a contiguous array, for fast searches
    return Messages(data, at + MESSAGE_HEAD_BYTES, size, channel, log_ns)


def expand(packed: Path, target: Path) -> str | None:
    """Decompress a ``.zstd`` file of rosbag2; return a description of damage, or None."""
    with open_regular(packed) as source, target.open('wb') as file:
        limit = packed.stat().st_size * _MAX_GROWTH + _FREE_GROWTH_BYTES
        loss = None
        try:
            for data in _pieces('zstd', source, limit, _STEP_BYTES):
                file.write(data)
        except zstandard.ZstdError as error:
            n_bytes = file.tell()
            loss = f'{packed.name} is unreadable after {n_bytes} bytes of its content ({error})'
        if not file.tell():
            raise DamagedError(loss or 'it has no content')
        return loss


def inflate(
    compression: str, packed: Any, limit: int, step: int = _STEP_BYTES, *, is_torn: bool = False
) -> Bytes:
    """Decompress bytes, or the readable part of a torn chunk; DamagedError above `limit` bytes."""
    if not compression:
        return np.asarray(packed)
    pieces: list[bytes] = []
    try:
        pieces.extend(_pieces(compression, memoryview(packed), limit, step))
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError) as error:
        if not is_torn:
            raise DamagedError(f'{compression}: {error}') from error
    return np.frombuffer(b''.join(pieces), np.uint8)


def inflate_ros1_chunk(packed: bytes) -> bytes:
    """Decompress a chunk of a ROS 1 bag, whose first bytes identify the compression."""
    compression = {b'BZh': 'bz2', b'\x04\x22\x4d': 'lz4'}.get(packed[:3], '')
    return inflate(compression, packed, MAX_CHUNK_BYTES).tobytes() if compression else packed


def _pieces(compression: str, source: Any, limit: int, step: int) -> Iterator[bytes]:
    """Decompress a source in pieces of `step` bytes; DamagedError above `limit` bytes in all."""
    n_left = limit
    for piece in iter(partial(_reader(compression, source), step), b''):
        n_left -= len(piece)
        if n_left < 0:
            raise DamagedError(f'its content exceeds the limit of {limit} bytes')
        yield piece


def _reader(compression: str, source: Any) -> Callable[[int], bytes]:
    """Return a function that decompresses and returns up to n further bytes, b'' at the end."""
    if compression == 'zstd':
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
        return decompressor.stream_reader(source, read_across_frames=True).read
    if compression not in _ENGINES:
        raise DamagedError(f'unknown compression {compression!r}, expected zstd, lz4 or none')
    engine, left = _ENGINES[compression](), [source]

    def read(n_bytes: int) -> bytes:
        if not left and (engine.eof or engine.needs_input):
            return b''
        data: bytes = engine.decompress(left.pop() if left else b'', max_length=n_bytes)
        return data

    return read
