# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the records of an MCAP file other than its messages: bytes to values, nothing trusted.

Each length is checked against the bytes that are there, so no damaged file makes a reader run
out of bounds or allocate what the file does not hold. Layouts: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import cache

MAGIC = b'\x89MCAP0\r\n'
#: Opcode and length in front of each record.
PREFIX_BYTES = 9
FOOTER_BYTES = PREFIX_BYTES + 20 + len(MAGIC)

HEADER = 0x01
FOOTER = 0x02
SCHEMA = 0x03
CHANNEL = 0x04
MESSAGE = 0x05
CHUNK = 0x06
MESSAGE_INDEX = 0x07
CHUNK_INDEX = 0x08
STATISTICS = 0x0B
METADATA = 0x0C
DATA_END = 0x0F

#: A chunk's head up to its compressed bytes, without the compression's name.
CHUNK_HEAD_BYTES = PREFIX_BYTES + 40


class DamagedError(Exception):
    """Bytes that are not what they should be; the text says what."""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type and its definition."""

    name: str
    encoding: str
    text: str


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with its type and how its messages are serialized."""

    topic: str
    type: str
    encoding: str


@dataclass(frozen=True, slots=True)
class ChunkSpan:
    """
    Where a chunk stands in its file, as its head or the file's chunk index says.

    Attributes
    ----------
    position : int
        Of its opcode in the file.
    length : int
        Of the whole record [bytes].
    index_length : int
        Of the message index records behind it [bytes].
    start_ns, end_ns : int
        Log times of its messages.
    compression : str
    compressed_size, size : int
        Before and after decompression [bytes].

    """

    position: int
    length: int
    index_length: int
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    size: int


@dataclass(slots=True)
class Statistics:
    """The counts in a file's summary."""

    n_messages: int
    start_ns: int
    end_ns: int
    counts: dict[int, int] = field(default_factory=dict)


@cache
def _little_endian(layout: str) -> struct.Struct:
    return struct.Struct('<' + layout)


class Cursor:
    """
    Reads values one after the other out of bytes.

    Parameters
    ----------
    data : bytes
        The content.
    at : int, optional
        Where to begin.

    Raises
    ------
    DamagedError
        From every method, where the bytes end before the value does.

    """

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data = data
        self.at = at

    def take(self, n_bytes: int) -> bytes:
        """Take the next bytes."""
        end = self.at + n_bytes
        if end > len(self.data):
            raise DamagedError('a record is shorter than its content')
        taken = self.data[self.at : end]
        self.at = end
        return taken

    def numbers(self, layout: str) -> tuple[int, ...]:
        """Take little-endian integers, described as for `struct`."""
        packed = _little_endian(layout)
        at = self.at
        self.at = end = at + packed.size
        if end > len(self.data):
            raise DamagedError('a record is shorter than its content')
        return packed.unpack_from(self.data, at)

    def text(self) -> str:
        """Take a string with its length in front."""
        (length,) = self.numbers('I')
        return self.take(length).decode('utf-8', 'replace')

    def pairs(self) -> dict[str, str]:
        """Take a map of strings."""
        (length,) = self.numbers('I')
        inner = Cursor(self.take(length))
        found: dict[str, str] = {}
        while inner.at < len(inner.data):
            key = inner.text()
            found[key] = inner.text()
        return found


def parse_schema(content: bytes) -> tuple[int, Schema]:
    """Read a schema record's content."""
    cursor = Cursor(content)
    (number,) = cursor.numbers('H')
    return number, Schema(cursor.text(), cursor.text(), cursor.text())


def parse_channel(content: bytes, schemas: dict[int, Schema]) -> tuple[int, Channel]:
    """Read a channel record's content."""
    cursor = Cursor(content)
    number, schema = cursor.numbers('HH')
    topic, encoding = cursor.text(), cursor.text()
    name = schemas[schema].name if schema in schemas else 'no type'
    package, _, kind = name.partition('/')
    if kind and '/' not in kind:  # as ROS 1 names its types
        name = f'{package}/msg/{kind}'
    return number, Channel(topic, name, encoding)


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Read a metadata record's content: its name and its pairs."""
    cursor = Cursor(content)
    return cursor.text(), cursor.pairs()


def parse_statistics(content: bytes) -> Statistics:
    """Read a statistics record's content."""
    cursor = Cursor(content)
    n_messages, _, _, _, _, _, start_ns, end_ns, length = cursor.numbers('QHIIIIQQI')
    inner = Cursor(cursor.take(length))
    statistics = Statistics(n_messages, start_ns, end_ns)
    while inner.at < length:
        number, count = inner.numbers('HQ')
        statistics.counts[number] = count
    return statistics


def parse_chunk_index(content: bytes) -> ChunkSpan:
    """Read a chunk index record's content."""
    cursor = Cursor(content)
    start_ns, end_ns, position, length, offsets = cursor.numbers('QQQQI')
    cursor.take(offsets)
    (index_length,) = cursor.numbers('Q')
    compression = cursor.text()
    compressed_size, size = cursor.numbers('QQ')
    return ChunkSpan(
        position, length, index_length, start_ns, end_ns, compression, compressed_size, size
    )


def parse_chunk_head(head: bytes, position: int) -> tuple[ChunkSpan, int, int]:
    """
    Read a chunk's head.

    Parameters
    ----------
    head : bytes
        The record's first bytes, opcode included.
    position : int
        Of the opcode in the file.

    Returns
    -------
    span : ChunkSpan
        Without a message index.
    data_at : int
        Where the compressed bytes begin in the record.
    checksum : int
        CRC-32 of the decompressed bytes; 0 where there is none.

    Raises
    ------
    DamagedError
        A head that is cut off or disagrees with the record's length.

    """
    cursor = Cursor(head)
    opcode, content, start_ns, end_ns, size, checksum, name_length = cursor.numbers('BQQQQII')
    if opcode != CHUNK:
        raise DamagedError(f'no chunk at byte {position}')
    if content < 40 or name_length > 64:
        raise DamagedError(f'the chunk at byte {position} has a damaged head')
    compression = cursor.take(name_length).decode('utf-8', 'replace')
    (compressed_size,) = cursor.numbers('Q')
    if cursor.at + compressed_size != PREFIX_BYTES + content:
        raise DamagedError(f'the chunk at byte {position} has a damaged head')
    span = ChunkSpan(
        position, PREFIX_BYTES + content, 0, start_ns, end_ns, compression, compressed_size, size
    )
    return span, cursor.at, checksum
