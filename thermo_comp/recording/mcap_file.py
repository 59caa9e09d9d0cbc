# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the map of one MCAP file: which stretches hold its messages, its topics, what is missing.

An ordinary file says all of it in its summary. One without a usable summary, or cut off anywhere,
is gone through record by record from the front, and its messages are counted. Whatever is not a
message is read by the `mcap` library, from bytes that are there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader

from ..errors import RecordingError
from .chunks import (
    ENDS_EARLY,
    HEAD_BYTES,
    PREFIX,
    ZERO_OPCODE,
    LocalFile,
    Messages,
    Span,
    load,
    parse_chunk_head,
    walk,
)
from .unpack import MAX_CHUNK_BYTES, DamagedError

MAGIC = b'\x89MCAP0\r\n'
#: Name of the metadata record with the key-value pairs of this package's writer.
METADATA_NAME = 'thermo_comp'

_FOOTER_BYTES = PREFIX.size + 20 + len(MAGIC)
_MAX_SUMMARY_BYTES = 1 << 28
_MAX_SMALL_RECORD = 1 << 22
_WINDOW_BYTES = 1 << 22
# Versions of mcap differ in what of it is typed.
_new_stream: Any = ReadDataStream


@dataclass(frozen=True, slots=True)
class Topic:
    """What a channel carries: its topic, message type and encoding."""

    name: str
    type: str
    encoding: str


class McapFile:
    """
    One open MCAP file, mapped.

    Its `spans` hold messages, in the order of the file; `counts` are messages per channel,
    `start_ns` and `end_ns` the log times of the first and the last; `truncated` says what is
    missing. Raises RecordingError for what is no MCAP file, or damaged other than at its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.spans: list[Span] = []
        self.topics: dict[int, Topic] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self.counts: Counter[int] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.metadata: dict[str, str] = {}
        self.truncated: str | None = None
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        try:
            self.handle = LocalFile(path)
        except OSError as error:
            raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
        try:
            with translated(path):
                self._map()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self.handle.close()

    def _map(self) -> None:
        begin = self._read_header()
        end = self._read_footer(begin)
        if not self.spans:
            self.counts.clear()
            self._scan(begin, end)
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            kind = schema.name if schema else 'no type'
            package, _, name = kind.partition('/')
            if name and '/' not in name:  # as ROS 1 names its types
                kind = f'{package}/msg/{name}'
            self.topics[number] = Topic(channel.topic, kind, channel.message_encoding)
        for schema in self._schemas.values():
            if schema.data:
                text = schema.data.decode('utf-8', 'replace')
                self.definitions[schema.name] = (schema.encoding, text)

    def _read_header(self) -> int:
        """Check how the file begins; gives where its records begin."""
        head = self.handle.read_at(0, len(MAGIC) + PREFIX.size)
        if not head:
            raise RecordingError('the file is empty', self.path)
        if not MAGIC.startswith(head[: len(MAGIC)]):
            raise RecordingError('not an MCAP file', self.path)
        if len(head) == len(MAGIC) + PREFIX.size:
            opcode, length = PREFIX.unpack_from(head, len(MAGIC))
            if opcode != Opcode.HEADER:
                raise RecordingError(
                    'not an MCAP file: it does not begin with a header', self.path
                )
            if len(head) + length <= self.handle.size:
                return len(head) + int(length)
        raise RecordingError('cut off inside its header, there is nothing to read', self.path)

    def _read_footer(self, begin: int) -> int | None:
        """Where the data section ends, and what the summary says; None where there is no end."""
        at = self.handle.size - _FOOTER_BYTES
        footer = self.handle.read_at(at, _FOOTER_BYTES) if at >= begin else b''
        if not footer.startswith(b'\x02\x14' + bytes(7)) or not footer.endswith(MAGIC):
            return None
        summary = int.from_bytes(footer[9:17], 'little')
        if summary == 0:
            return at
        if not begin <= summary <= at:
            raise DamagedError(f'the footer puts the summary at byte {summary}')
        if at - summary <= _MAX_SUMMARY_BYTES:
            self._read_summary(self.handle.read_at(summary, self.handle.size - summary))
        return summary

    def _read_summary(self, content: bytes) -> None:
        """Take what the summary says; a damaged or incomplete one is as good as none."""
        found: dict[type, list[Any]] = {}
        try:
            reader = StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True)
            for record in reader.records:
                found.setdefault(type(record), []).append(record)
        except Exception:  # noqa: BLE001 - damaged bytes surface as nearly any exception type
            return
        said = found.get(Statistics, [])
        chunks: list[ChunkIndex] = found.get(ChunkIndex, [])
        channels: dict[int, Channel] = {one.id: one for one in found.get(Channel, [])}
        if len(said) != 1:
            return
        counts: dict[int, int] = said[0].channel_message_counts
        if sum(counts.values()) != said[0].message_count or not counts.keys() <= channels.keys():
            return
        if not len(chunks) == len({c.chunk_start_offset for c in chunks}) == said[0].chunk_count:
            return
        if any(
            one.chunk_start_offset + one.chunk_length + one.message_index_length > self.handle.size
            for one in chunks
        ):
            return
        self._channels = channels
        self._schemas = {one.id: one for one in found.get(Schema, [])}
        self.counts.update(counts)
        if said[0].message_count:
            self.start_ns, self.end_ns = said[0].message_start_time, said[0].message_end_time
        chunks.sort(key=lambda one: one.chunk_start_offset)
        self.spans = [
            Span(
                one.chunk_start_offset,
                one.chunk_length,
                one.message_index_length,
                one.uncompressed_size,
                one.message_start_time,
                one.message_end_time,
            )
            for one in chunks
            if one.uncompressed_size
        ]
        for index in found.get(MetadataIndex, []):
            is_small = PREFIX.size <= index.length <= _MAX_SMALL_RECORD
            if index.name == METADATA_NAME and is_small and index.offset < self.handle.size:
                pairs = self.handle.read_at(index.offset, index.length)[PREFIX.size :]
                self._on_record(Opcode.METADATA, pairs)

    def _on_record(self, opcode: int, content: bytes) -> None:
        """Take a record of the data section that is no message."""
        if opcode == Opcode.SCHEMA:
            schema = _parsed(Schema, content)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = _parsed(Channel, content)
            self._channels[channel.id] = channel
        elif opcode == Opcode.METADATA:
            pairs = _parsed(Metadata, content)
            if pairs.name == METADATA_NAME:
                self.metadata.update(pairs.metadata)

    def _scan(self, at: int, end: int | None) -> None:
        """Go through the file's records; where it has no end, up to the last whole message."""
        is_whole = end is not None
        stop = self.handle.size if end is None else end
        words = 'it ends between two records, so more may have followed'
        while at < stop:
            head = self.handle.read_at(at, min(HEAD_BYTES, stop - at))
            opcode, length = head[0], int.from_bytes(head[1 : PREFIX.size], 'little')
            step = PREFIX.size + length
            if len(head) < PREFIX.size or at + step > stop or opcode == 0:
                if is_whole:
                    raise DamagedError(f'the record at byte {at} is not whole')
                words = self._torn(at, head)
                break
            if opcode == Opcode.CHUNK:
                span = parse_chunk_head(head, at).span
                self.spans += [span] if span.size else []
            elif opcode == Opcode.MESSAGE_INDEX:
                self._extend_index(at, step)
            elif opcode == Opcode.MESSAGE:
                at = self._loose(at, stop, is_whole)
                continue
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}:
                self._small_record(opcode, at, length)
            elif opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                words = 'its summary is missing, but no message is'
                break
            at += step
        words = self._count(words, is_whole)
        if not is_whole:
            self.truncated = f'the file is cut off at byte {self.handle.size}: {words}'

    def _extend_index(self, at: int, step: int) -> None:
        last = self.spans[-1] if self.spans else None
        if last is not None and at == last.position + last.length + last.index_length:
            self.spans[-1] = replace(last, index_length=last.index_length + step)

    def _small_record(self, opcode: int, at: int, length: int) -> None:
        if length <= _MAX_SMALL_RECORD:
            self._on_record(opcode, self.handle.read_at(at + PREFIX.size, length))
        elif opcode != Opcode.METADATA:
            raise DamagedError(f'the record at byte {at} has {length} bytes')

    def _loose(self, at: int, stop: int, is_whole: bool) -> int:
        """Take a window of messages outside any chunk; gives where it ends."""
        (_, length) = PREFIX.unpack(self.handle.read_at(at, PREFIX.size))
        if length > MAX_CHUNK_BYTES:
            raise DamagedError(f'at byte {at}: a record of {length} bytes')
        n_bytes = min(max(_WINDOW_BYTES, PREFIX.size + length), stop - at)
        data = np.frombuffer(self.handle.read_at(at, n_bytes), np.uint8)
        _, end, reason = walk(data, self._on_record, is_loose=True)
        if not end or (reason == ZERO_OPCODE and is_whole):
            raise DamagedError(f'at byte {at}: {reason or ENDS_EARLY}')
        self.spans.append(Span(at, end, kind='loose'))
        return at + end

    def _torn(self, at: int, head: bytes) -> str:
        """Take what is left of a record that is not whole; says what that is."""
        if head[0] == 0:
            self._distrust_last(at)
            return f'it is unreadable from byte {at} on'
        if head[0] == Opcode.CHUNK:
            try:
                span = parse_chunk_head(head, at).span
            except DamagedError:
                pass
            else:
                self.spans.append(replace(span, length=self.handle.size - at, kind='torn'))
            return 'it ends inside a chunk, of which the first {} messages are read'
        if head[0] == Opcode.MESSAGE_INDEX:
            return 'it ends inside the index of its last chunk, which is read whole'
        return 'it ends inside a record, everything before that is read'

    def _distrust_last(self, at: int) -> None:
        """Leave out the last message before zeros, as its own end may be zeros too."""
        last = self.spans[-1] if self.spans else None
        if last is None or at != last.position + last.length:
            return
        if last.kind == 'loose':
            messages = load(self.handle, last, self._on_record)
            end = int(messages.start[-1] - messages.start[0]) if len(messages) else 0
            self.spans[-1:] = [replace(last, length=end)] if end else []
        elif not parse_chunk_head(
            self.handle.read_at(last.position, HEAD_BYTES), last.position
        ).compression:
            # With the zeros that follow, which end the walk.
            self.spans[-1] = replace(last, length=last.length + PREFIX.size, kind='torn')

    def _count(self, words: str, is_whole: bool) -> str:
        """Read all messages once: how many there are, and from when to when."""
        for row, span in enumerate(list(self.spans)):
            try:
                messages = load(self.handle, span, self._on_record)
            except DamagedError:
                if is_whole or row + 1 < len(self.spans) or span.kind != 'chunk':
                    raise
                self.spans.pop()
                words = f'{words}; its last chunk is damaged and left out'
                continue
            if span.kind == 'torn':
                words = words.format(len(messages))
            if len(messages):
                self._add(row, messages)
        return words.format(0)

    def _add(self, row: int, messages: Messages) -> None:
        numbers, counts = np.unique(messages.channel, return_counts=True)
        self.counts.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        start, end = int(np.min(messages.log_ns)), int(np.max(messages.log_ns))
        self.spans[row] = replace(self.spans[row], start_ns=start, end_ns=end)
        self.start_ns = start if self.start_ns is None else min(self.start_ns, start)
        self.end_ns = end if self.end_ns is None else max(self.end_ns, end)


def _parsed(kind: Any, content: bytes) -> Any:
    try:
        return kind.read(_new_stream(BytesIO(content)))
    except Exception as error:  # see above
        raise DamagedError('a record is shorter than its content') from error


@contextmanager
def translated(path: Path) -> Iterator[None]:
    """Say which file it is that is damaged or cannot be read."""
    try:
        yield
    except DamagedError as error:
        raise RecordingError(f'damaged: {error}', path) from error
    except RecordingError as error:
        raise RecordingError(error.message, path, error.topic) from error
    except OSError as error:
        raise RecordingError(f'cannot be read: {error.strerror}', path) from error
