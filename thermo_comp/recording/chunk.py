# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns one stretch of an MCAP file with messages: read it, decompress it, find its messages.

A chunk of ordinary size is taken as a whole. Large chunks, torn chunks and messages outside any
chunk are read window by window; a window holds whole records only, and the piece of a record at
its end opens the next one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..typing import Bytes
from . import mcap_records as mcap
from .mcap_records import ChunkSpan, DamagedError
from .random_access import RandomAccess
from .unpack import Region, Stream, growth_limit, open_stream, unpack
from .walk import (
    ENDS_EARLY,
    OTHER_RECORD,
    ZERO_OPCODE,
    Messages,
    OnRecord,
    locate,
    locate_run,
    walk,
)

#: Chunks up to this size are taken as a whole, larger ones as a stream.
MAX_CHUNK_BYTES = 1 << 26
WINDOW_BYTES = 1 << 22
#: Enough of a chunk's record to hold its head.
HEAD_BYTES = 160

_PIECE_BYTES = 1 << 16
_LOOSE = frozenset({mcap.MESSAGE, mcap.SCHEMA, mcap.CHANNEL})


@dataclass(frozen=True, slots=True)
class StreamSpan:
    """
    A stretch of a file whose records are read window by window.

    Attributes
    ----------
    position : int
        Its first byte in the file.
    end : int
        Where it ends at the latest.
    is_chunk : bool
        A chunk, or else records outside any chunk.
    is_torn : bool
        Whether the end is missing: then what is whole is read, and the rest is no error.

    """

    position: int
    end: int
    is_chunk: bool
    is_torn: bool = False


def load_chunk(
    handle: RandomAccess, span: ChunkSpan, on_record: OnRecord
) -> tuple[Bytes, Messages]:
    """
    Read a whole chunk.

    Parameters
    ----------
    handle : RandomAccess
        The open file.
    span : ChunkSpan
        Where the chunk stands.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.

    Returns
    -------
    data : ndarray of uint8
        The decompressed chunk.
    messages : Messages
        Its messages.

    Raises
    ------
    DamagedError
        Damage anywhere in the chunk, with its place in the file.

    """
    record = handle.read_at(span.position, span.length + span.index_length)
    try:
        chunk = _open(record, 0, span)
        return chunk.data, locate(chunk.data, chunk.index, on_record)
    except DamagedError as error:
        raise DamagedError(f'chunk at byte {span.position}: {error}') from error


def load_run(
    handle: RandomAccess, spans: Sequence[ChunkSpan], on_record: OnRecord
) -> tuple[Bytes, Messages] | None:
    """
    Read whole chunks that stand behind each other in the file as if they were one.

    Parameters
    ----------
    handle : RandomAccess
        The open file.
    spans : sequence of ChunkSpan
        Where they stand.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.

    Returns
    -------
    (ndarray of uint8, Messages) or None
        As for `load_chunk`; None where they have to be loaded one by one: because of a gap
        between them, of anything unusual, or of damage, which is then found again and said.

    """
    positions = [span.position - spans[0].position for span in spans]
    ends = [at + s.length + s.index_length for at, s in zip(positions, spans, strict=True)]
    if ends[:-1] != positions[1:]:
        return None
    record = handle.read_at(spans[0].position, ends[-1])
    try:
        chunks = [_open(record, at, span) for at, span in zip(positions, spans, strict=True)]
        if any(chunk.is_packed for chunk in chunks):
            data = np.concatenate([chunk.data for chunk in chunks])
            begins = np.cumsum([0, *(len(chunk.data) for chunk in chunks)]).tolist()
        else:
            data = np.frombuffer(record, np.uint8)
            begins = [chunk.begin for chunk in chunks]
        areas = [(at, at + len(c.data)) for at, c in zip(begins, chunks, strict=False)]
        found = locate_run(data, areas, [chunk.index for chunk in chunks], on_record)
    except DamagedError:
        return None
    if found is None:
        return None
    messages, first = found
    is_early = np.minimum.reduceat(messages.log_ns, first) < [span.start_ns for span in spans]
    is_late = np.maximum.reduceat(messages.log_ns, first) > [span.end_ns for span in spans]
    return None if is_early.any() or is_late.any() else (data, messages)


@dataclass(frozen=True, slots=True)
class _Chunk:
    data: Bytes
    index: memoryview
    is_packed: bool
    #: Where `data` stands among the bytes read, if it is not packed.
    begin: int


def _open(record: bytes, at: int, span: ChunkSpan) -> _Chunk:
    """Decompress the chunk whose record begins at this place of the bytes read."""
    end = at + span.length + span.index_length
    if end > len(record):
        raise DamagedError('the file ends inside it')
    found, data_at, checksum = mcap.parse_chunk_head(record[at : at + HEAD_BYTES], span.position)
    if found.length != span.length or found.size != span.size:
        raise DamagedError('its size is not what the index of the file says')
    begin = at + data_at
    packed = np.frombuffer(record, np.uint8, span.length - data_at, begin)
    data = unpack(found.compression, packed, span.size, checksum)
    index = memoryview(record)[at + span.length : end]
    return _Chunk(data, index, found.compression != '', begin)


class Windows:
    """
    The records of a stretch, in bounded memory.

    Parameters
    ----------
    handle : RandomAccess
        The open file.
    span : StreamSpan
        The stretch.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.

    Attributes
    ----------
    n_walked : int
        Bytes of the records that were gone through so far.
    n_kept : int
        The same without a record at the end that cannot be trusted.

    """

    def __init__(self, handle: RandomAccess, span: StreamSpan, on_record: OnRecord) -> None:
        self._handle = handle
        self._span = span
        self._on_record = on_record
        self.n_walked = self.n_kept = 0

    def __iter__(self) -> Iterator[tuple[Bytes, Messages]]:
        """
        Yield bytes and the messages in them, at least one each time.

        Raises
        ------
        DamagedError
            Damage, unless the stretch is torn.

        """
        try:
            yield from self._windows()
        except DamagedError as error:
            raise DamagedError(f'at byte {self._span.position}: {error}') from error

    def _windows(self) -> Iterator[tuple[Bytes, Messages]]:
        stream, size, checksum = self._open()
        only = None if self._span.is_chunk else _LOOSE
        is_torn = self._span.is_torn
        rest, wanted, n_read, found_sum = b'', WINDOW_BYTES, 0, 0
        is_end = False
        while not is_end:
            piece, is_end = _fill(stream, wanted - len(rest), is_torn)
            n_read += len(piece)
            if size is not None and n_read > size and not is_torn:
                raise DamagedError(f'more than the {size} bytes that it claims')
            if checksum and not is_torn:
                found_sum = zlib.crc32(piece, found_sum)
            data = np.frombuffer(rest + piece, np.uint8)
            messages, end, reason = walk(data, self._on_record, only)
            self.n_kept = self.n_walked + end
            if is_torn and reason == ZERO_OPCODE and len(messages.at):
                self.n_kept = self.n_walked + int(messages.at[-1])
                messages = _without_last(messages)
            self.n_walked += end
            if len(messages.at):
                yield data, messages
            if reason == OTHER_RECORD:
                return
            if reason and (is_end or reason != ENDS_EARLY):
                if is_torn:
                    return
                raise DamagedError(reason)
            rest = data[end:].tobytes()
            wanted = _needed(rest)
        if is_torn:
            return
        if size is not None and n_read != size:
            raise DamagedError(f'{n_read} bytes after decompression, expected {size}')
        if found_sum != checksum:
            raise DamagedError('the checksum does not fit the content')

    def _open(self) -> tuple[Stream, int | None, int]:
        span = self._span
        if not span.is_chunk:
            return Region(self._handle, span.position, span.end), None, 0
        head = self._handle.read_at(span.position, HEAD_BYTES)
        chunk, data_at, checksum = mcap.parse_chunk_head(head, span.position)
        if chunk.size > growth_limit(chunk.compressed_size) and not span.is_torn:
            raise DamagedError(f'{chunk.compressed_size} bytes claim to hold {chunk.size}')
        region = Region(self._handle, span.position + data_at, span.end)
        return open_stream(chunk.compression, region), chunk.size, checksum


def _fill(stream: Stream, n_bytes: int, is_torn: bool) -> tuple[bytes, bool]:
    pieces: list[bytes] = []
    left = n_bytes
    while left > 0:
        try:
            piece = stream.read(min(left, _PIECE_BYTES))
        except DamagedError:
            if not is_torn:
                raise
            piece = b''
        if not piece:
            return b''.join(pieces), True
        pieces.append(piece)
        left -= len(piece)
    return b''.join(pieces), False


def _needed(rest: bytes) -> int:
    """Bytes of a window that holds the record at its front."""
    if len(rest) < mcap.PREFIX_BYTES:
        return WINDOW_BYTES
    length = int.from_bytes(rest[1 : mcap.PREFIX_BYTES], 'little')
    if length > MAX_CHUNK_BYTES:
        raise DamagedError(f'a record of {length} bytes')
    return max(WINDOW_BYTES, mcap.PREFIX_BYTES + length)


def _without_last(messages: Messages) -> Messages:
    """Drop the message before a stretch of zeros: its own end may be zeros too."""
    return Messages(
        messages.at[:-1], messages.size[:-1], messages.channel[:-1], messages.log_ns[:-1]
    )
