# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of an MCAP file chunk by chunk, in bounded memory.

The summary of a complete file lists its chunks of messages. A file that is cut off, or has no
usable summary, is read record by record, and its messages are counted. The `mcap` library
reads schemas, channels, metadata and the summary.
"""

import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader

from ..errors import RecordingError
from ..files import open_regular
from .blocks import BagFile, Topic
from .chunks import HEAD_BYTES, PREFIX, DamagedError, Span, load, parse_chunk_head, translated
from .serialized import Messages, join_messages

MAGIC = b'\x89MCAP0\r\n'
_BEGIN = MAGIC + bytes([Opcode.HEADER])
METADATA_NAME = 'thermo_comp'  # name of the metadata record that this package writes

_FOOTER_BYTES = PREFIX.size + 20 + len(MAGIC)
_MAX_SUMMARY_BYTES = 1 << 28  # a larger summary is not read [bytes]
_MAX_SMALL_RECORD = 1 << 22  # largest schema, channel or metadata record that is read [bytes]
_MAX_LOOSE_BYTES = 1 << 22  # largest span of messages outside chunks [bytes]
_MAX_HELD_BYTES = 1 << 26  # largest memory for messages of overlapping chunks [bytes]
#: Texts for a file that ends inside a record, by the record's opcode; -1: any other opcode.
_CUTS = {
    0: 'it is unreadable from byte {at} on',
    int(Opcode.CHUNK): 'it ends inside a chunk: of this chunk, the first {} messages are read',
    int(Opcode.MESSAGE_INDEX): 'it ends inside the index of its last chunk; the chunk is complete',
    -1: 'it ends inside a record; all records before it are read',
}
#: Types of the records that are read besides messages, by opcode.
_KINDS: Any = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_new_stream: Any = ReadDataStream  # `Any`, because type hints differ between versions of `mcap`


class McapFile(BagFile):
    """An open MCAP file; `spans` are its parts that hold messages, in file order."""

    def __init__(self, path: Path, name: Path) -> None:
        super().__init__(name)
        self.spans: list[Span] = []
        self._counts: Counter[int] = Counter()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        with translated(name), ExitStack() as opened:
            self._file = opened.enter_context(open_regular(path))
            self.close = self._file.close
            self._size = os.fstat(self._file.fileno()).st_size
            self._map()
            opened.pop_all()

    def read(self, channels: Collection[int]) -> Iterator[Messages]:
        """Read the messages of some channels in the order of their log times."""
        order = sorted(range(len(self.spans)), key=lambda row: self.spans[row].start_ns)
        spans = [self.spans[row] for row in order]
        loaded = map(partial(self._load, channels), spans)
        if any(span.end_ns > other.start_ns for span, other in pairwise(self.spans)):
            following = [*(span.start_ns for span in spans[1:]), None]
            return _in_order(zip(order, loaded, following, strict=True))
        return loaded

    def _load(self, channels: Collection[int], span: Span) -> Messages:
        """Read the messages of a span; all other records were read when the file was opened."""
        return load(self._read_at, span, lambda *_: None).of_channels(channels).in_order()

    def _read_at(self, at: int, n_bytes: int) -> bytes:
        return os.pread(self._file.fileno(), n_bytes, at)

    def _map(self) -> None:
        head = self._read_at(0, len(_BEGIN) + 8)
        if not head:
            raise RecordingError('the file is empty')
        if not _BEGIN.startswith(head[: len(_BEGIN)]):
            raise RecordingError('not an MCAP file')
        begin = len(head) + int.from_bytes(head[len(_BEGIN) :], 'little')
        if len(head) < len(_BEGIN) + 8 or begin > self._size:
            raise RecordingError('cut off inside its header: nothing can be read')
        end = self._read_footer(begin)
        if not self.spans:
            self._scan(begin, end)
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            kind = schema.name if schema else 'no type'
            package, _, name = kind.partition('/')
            if name and '/' not in name:  # ROS 1 writes types as package/Type
                kind = f'{package}/msg/{name}'
            topic = Topic(channel.topic, kind, channel.message_encoding, self._counts[number])
            self.topics[number] = topic
        for schema in self._schemas.values():
            if schema.data:
                text = schema.data.decode('utf-8', 'replace')
                self.definitions[schema.name] = (schema.encoding, text)

    def _read_footer(self, begin: int) -> int | None:
        """Read footer and summary; return the end of the data section, None without a footer."""
        at = self._size - _FOOTER_BYTES
        footer = self._read_at(at, _FOOTER_BYTES) if at >= begin else b''
        if not footer.startswith(b'\x02\x14' + bytes(7)) or not footer.endswith(MAGIC):
            return None
        summary = int.from_bytes(footer[9:17], 'little')
        if summary == 0:
            return at
        if not begin <= summary <= at:
            raise DamagedError(f'the summary cannot be at byte {summary}, as the footer states')
        if at - summary <= _MAX_SUMMARY_BYTES:
            self._read_summary(self._read_at(summary, self._size - summary))
        return summary

    def _read_summary(self, content: bytes) -> None:
        """Read the summary of the file; a damaged or incomplete summary is ignored."""
        records_of: dict[type, list[Any]] = {}
        try:
            reader = StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True)
            for record in reader.records:
                records_of.setdefault(type(record), []).append(record)
            (statistics,) = records_of[Statistics]
        except Exception:  # noqa: BLE001 - damaged bytes may raise any type of exception
            return
        counts, n_messages = statistics.channel_message_counts, statistics.message_count
        channels: dict[int, Channel] = {c.id: c for c in records_of.get(Channel, [])}
        chunks = sorted(records_of.get(ChunkIndex, []), key=lambda index: index.chunk_start_offset)
        spans = [
            Span(
                *(chunk.chunk_start_offset, chunk.chunk_length, chunk.message_index_length),
                *(chunk.uncompressed_size, chunk.message_start_time, chunk.message_end_time),
            )
            for chunk in chunks
        ]
        if (
            sum(counts.values()) != n_messages
            or not counts.keys() <= channels.keys()
            or not len(spans) == len({span.position for span in spans}) == statistics.chunk_count
            or any(span.position + span.length + span.index_length > self._size for span in spans)
        ):
            return
        self._channels = channels
        self._schemas = {schema.id: schema for schema in records_of.get(Schema, [])}
        self.spans = [span for span in spans if span.size]
        if self.spans:
            self._counts.update(counts)
            if n_messages:
                self.start_ns = statistics.message_start_time
                self.end_ns = statistics.message_end_time
        for index in records_of.get(MetadataIndex, []):
            is_small = PREFIX.size <= index.length <= _MAX_SMALL_RECORD
            if index.name == METADATA_NAME and is_small and index.offset < self._size:
                pairs = self._read_at(index.offset, index.length)[PREFIX.size :]
                self._on_record(Opcode.METADATA, pairs)

    def _on_record(self, opcode: int, content: bytes) -> None:
        """Store a schema, a channel or the writer's metadata; ignore other records."""
        if opcode not in _KINDS:
            return
        try:
            record = _KINDS[opcode].read(_new_stream(BytesIO(content)))
        except Exception as error:  # damaged bytes may raise any type of exception
            raise DamagedError('a record is shorter than the lengths in it') from error
        if opcode == Opcode.SCHEMA:
            self._schemas[record.id] = record
        elif opcode == Opcode.CHANNEL:
            self._channels[record.id] = record
        elif record.name == METADATA_NAME:
            self.metadata.update(record.metadata)

    def _scan(self, at: int, end: int | None) -> None:
        """Read the file record by record; if `end` is None, up to the last complete message."""
        stop = self._size if end is None else end
        ending = 'it ends between two records, so further records may be missing'
        spans = [Span(0, 0)]
        while at < stop:
            head = self._read_at(at, min(HEAD_BYTES, stop - at))
            opcode, length = head[0], int.from_bytes(head[1 : PREFIX.size], 'little')
            step, last = PREFIX.size + length, spans[-1]
            is_next = at == last.position + last.length + last.index_length
            if len(head) < PREFIX.size or at + step > stop or opcode == 0:
                if end is not None:
                    raise DamagedError(f'the record at byte {at} is not complete')
                ending = _CUTS.get(opcode, _CUTS[-1]).format('{}', at=at)
                if opcode == 0 and at == last.position + last.length:
                    # `scan_records` drops the last message before zeros: add zeros to the span.
                    kind = last.kind if last.kind == 'loose' else 'torn'
                    spans[-1] = replace(last, length=last.length + PREFIX.size, kind=kind)
                elif opcode == Opcode.CHUNK:
                    with suppress(DamagedError):
                        span, length = parse_chunk_head(head, at)[0], self._size - at
                        spans.append(replace(span, length=length, kind='torn'))
                break
            if opcode == Opcode.CHUNK:
                spans.append(parse_chunk_head(head, at)[0])
            elif opcode == Opcode.MESSAGE_INDEX and is_next:
                spans[-1] = replace(last, index_length=last.index_length + step)
            elif opcode == Opcode.MESSAGE:
                if is_next and last.kind == 'loose' and last.length + step < _MAX_LOOSE_BYTES:
                    spans[-1] = replace(last, length=last.length + step)
                else:
                    spans.append(Span(at, step, kind='loose'))
            elif opcode in _KINDS and length <= _MAX_SMALL_RECORD:
                self._on_record(opcode, self._read_at(at + PREFIX.size, length))
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                limit = f'limit {_MAX_SMALL_RECORD} bytes'
                raise DamagedError(f'the record at byte {at} has {length} bytes, {limit}')
            elif opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                ending = 'its summary is missing, but all messages are there'
                break
            at += step
        ending = self._count(spans[1:], ending, end is not None)
        if end is None:
            self.truncated = f'the file is cut off at byte {self._size}: {ending}'

    def _count(self, spans: Sequence[Span], ending: str, is_whole: bool) -> str:
        """Count all messages and find their log times; return the completed text `ending`."""
        n_torn = 0
        for span in spans:
            try:
                messages = load(self._read_at, span, self._on_record)
            except DamagedError:
                if is_whole or span is not spans[-1] or span.kind != 'chunk':
                    raise
                ending += '; its last chunk is damaged and left out'
                break
            n_torn = len(messages) if span.kind == 'torn' else 0
            if len(messages):
                self._counts.update(messages.channel.tolist())
                start, end = int(np.min(messages.log_ns)), int(np.max(messages.log_ns))
                self.spans.append(replace(span, start_ns=start, end_ns=end))
        self.start_ns = min((span.start_ns for span in self.spans), default=None)
        self.end_ns = max((span.end_ns for span in self.spans), default=None)
        return ending.format(n_torn)


def _in_order(pieces: Iterable[tuple[int, Messages, int | None]]) -> Iterator[Messages]:
    """Merge pieces (place in file, messages, first log time of the next piece) by log time."""
    # Messages before the first log time of the next piece are yielded; later messages are held.
    held: dict[int, Messages] = {}
    for row, piece, next_ns in pieces:
        held[row] = piece
        ready = []
        for number, part in sorted(held.items()):
            n = len(part) if next_ns is None else int(np.searchsorted(part.log_ns, next_ns))
            if n:
                ready.append(part.take(slice(0, n)))
            if n == len(part):
                del held[number]
            elif n or number == row:
                held[number] = part.take(slice(n, None)).packed()
        if sum(len(piece.data) for piece in held.values()) > _MAX_HELD_BYTES:
            raise DamagedError(
                'too many of its chunks overlap in time to be read in bounded memory; '
                'sort the messages of the file by time with another tool'
            )
        if ready:
            yield join_messages(ready).in_order()
