# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fast path: one MCAP file, mapped, and its messages chunk by chunk in bounded memory.

An ordinary file says in its summary which stretches hold its messages. One without a usable
summary, or cut off anywhere, is gone through record by record from the front, and its messages are
counted. Whatever is not a message is read by the `mcap` library, from bytes that are there.

Reading order is log time and, for equal log times, the place in the file: what a ROS player gives.
It needs the time spans in the heads of the chunks to be true, which is checked.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import ExitStack
from dataclasses import replace
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
from .chunks import HEAD_BYTES, PREFIX, Span, load, parse_chunk_head
from .messages import BagFile, Done, Messages, Topic, Work, join_messages
from .unpack import MAX_CHUNK_BYTES, DamagedError, translated

MAGIC = b'\x89MCAP0\r\n'
#: Name of the metadata record with the key-value pairs of this package's writer.
METADATA_NAME = 'thermo_comp'

_FOOTER_BYTES = PREFIX.size + 20 + len(MAGIC)
_MAX_SUMMARY_BYTES = 1 << 28
_MAX_SMALL_RECORD = 1 << 22
_WINDOW_BYTES = 1 << 22
#: Chunks under way: what two threads read while the caller works on one block.
_N_AHEAD = 8
_AHEAD_BYTES = 1 << 26
#: Messages of overlapping chunks that are held back at most [bytes].
_MAX_HELD_BYTES = 1 << 26
# Versions of mcap differ in what of it is typed.
_new_stream: Any = ReadDataStream


class McapFile(BagFile):
    """One open MCAP file; its `spans` hold messages, in their order; `pool` reads ahead."""

    def __init__(self, path: Path, name: Path, pool: Executor) -> None:
        super().__init__(name)
        self.spans: list[Span] = []
        self._pool = pool
        self._counts: Counter[int] = Counter()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        with translated(name), ExitStack() as opened:
            self._file = opened.enter_context(open_regular(path))
            self._size = os.fstat(self._file.fileno()).st_size
            self._map()
            opened.pop_all()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, channels: Collection[int], work: Work[Done]) -> Iterator[Done]:
        """Read the messages of channels in reading order, and do some work on them."""
        # What a thread has decompressed it works on, too: it has the bytes in its cache.
        if all(one.end_ns <= other.start_ns for one, other in pairwise(self.spans)):
            yield from self._ahead(self.spans, lambda span: work(self._load(span, channels)))
            return
        order = sorted(range(len(self.spans)), key=lambda row: (self.spans[row].start_ns, row))
        spans = [self.spans[row] for row in order]
        following = [*(span.start_ns for span in spans[1:]), None]
        loaded = self._ahead(spans, lambda span: self._load(span, channels))
        yield from map(work, _in_order(zip(order, loaded, following, strict=True)))

    def _ahead(self, spans: Iterable[Span], work: Callable[[Span], Done]) -> Iterator[Done]:
        """Read, decompress and work ahead in threads; most of it needs no interpreter lock."""
        # The pool is not this generator's own: one that is given up is closed by the garbage
        # collector, anywhere, where waiting for a thread may be a deadlock.
        waiting: deque[tuple[int, Future[Done]]] = deque()
        try:
            for span in spans:
                while waiting and (
                    len(waiting) == _N_AHEAD
                    or sum(n_bytes for n_bytes, _ in waiting) + span.size > _AHEAD_BYTES
                ):
                    yield waiting.popleft()[1].result()
                waiting.append((span.size, self._pool.submit(work, span)))
            while waiting:
                yield waiting.popleft()[1].result()
        finally:
            for _, future in waiting:
                future.cancel()

    def _load(self, span: Span, channels: Collection[int]) -> Messages:
        """Read a stretch; records that matter were read when the file was opened."""
        return load(self._read_at, span, lambda *_: None).of_channels(channels).in_order()

    def _read_at(self, at: int, n_bytes: int) -> bytes:
        return os.pread(self._file.fileno(), n_bytes, at)

    def _map(self) -> None:
        begin = self._read_header()
        end = self._read_footer(begin)
        if not self.spans:
            self._counts.clear()
            self._scan(begin, end)
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            kind = schema.name if schema else 'no type'
            package, _, name = kind.partition('/')
            if name and '/' not in name:  # as ROS 1 names its types
                kind = f'{package}/msg/{name}'
            topic = Topic(channel.topic, kind, channel.message_encoding, self._counts[number])
            self.topics[number] = topic
        for schema in self._schemas.values():
            if schema.data:
                text = schema.data.decode('utf-8', 'replace')
                self.definitions[schema.name] = (schema.encoding, text)

    def _read_header(self) -> int:
        """Check how the file begins; gives where its records begin."""
        head = self._read_at(0, len(MAGIC) + PREFIX.size)
        if not head:
            raise RecordingError('the file is empty')
        if not MAGIC.startswith(head[: len(MAGIC)]):
            raise RecordingError('not an MCAP file')
        if len(head) == len(MAGIC) + PREFIX.size:
            opcode, length = PREFIX.unpack_from(head, len(MAGIC))
            if opcode != Opcode.HEADER:
                raise RecordingError('not an MCAP file: it does not begin with a header')
            if len(head) + length <= self._size:
                return len(head) + int(length)
        raise RecordingError('cut off inside its header, there is nothing to read')

    def _read_footer(self, begin: int) -> int | None:
        """Where the data section ends, and what the summary says; None where there is no end."""
        at = self._size - _FOOTER_BYTES
        footer = self._read_at(at, _FOOTER_BYTES) if at >= begin else b''
        if not footer.startswith(b'\x02\x14' + bytes(7)) or not footer.endswith(MAGIC):
            return None
        summary = int.from_bytes(footer[9:17], 'little')
        if summary == 0:
            return at
        if not begin <= summary <= at:
            raise DamagedError(f'the footer puts the summary at byte {summary}')
        if at - summary <= _MAX_SUMMARY_BYTES:
            self._read_summary(self._read_at(summary, self._size - summary))
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
        said: list[Statistics] = found.get(Statistics, [])
        chunks: list[ChunkIndex] = found.get(ChunkIndex, [])
        channels: dict[int, Channel] = {one.id: one for one in found.get(Channel, [])}
        if len(said) != 1:
            return
        counts = said[0].channel_message_counts
        if sum(counts.values()) != said[0].message_count or not counts.keys() <= channels.keys():
            return
        if not len(chunks) == len({c.chunk_start_offset for c in chunks}) == said[0].chunk_count:
            return
        spans = [
            Span(
                one.chunk_start_offset,
                one.chunk_length,
                one.message_index_length,
                one.uncompressed_size,
                one.message_start_time,
                one.message_end_time,
            )
            for one in sorted(chunks, key=lambda one: one.chunk_start_offset)
        ]
        if any(one.position + one.length + one.index_length > self._size for one in spans):
            return
        self._channels = channels
        self._schemas = {one.id: one for one in found.get(Schema, [])}
        self._counts.update(counts)
        if said[0].message_count:
            self.start_ns, self.end_ns = said[0].message_start_time, said[0].message_end_time
        self.spans = [one for one in spans if one.size]
        for index in found.get(MetadataIndex, []):
            is_small = PREFIX.size <= index.length <= _MAX_SMALL_RECORD
            if index.name == METADATA_NAME and is_small and index.offset < self._size:
                pairs = self._read_at(index.offset, index.length)[PREFIX.size :]
                self._on_record(Opcode.METADATA, pairs)

    def _on_record(self, opcode: int, content: bytes) -> None:
        """Take a record of the data section that is no message."""
        kinds: Mapping[int, Any] = {
            Opcode.SCHEMA: Schema,
            Opcode.CHANNEL: Channel,
            Opcode.METADATA: Metadata,
        }
        if opcode not in kinds:
            return
        try:
            record = kinds[opcode].read(_new_stream(BytesIO(content)))
        except Exception as error:  # see above
            raise DamagedError('a record is shorter than its content') from error
        if opcode == Opcode.SCHEMA:
            self._schemas[record.id] = record
        elif opcode == Opcode.CHANNEL:
            self._channels[record.id] = record
        elif record.name == METADATA_NAME:
            self.metadata.update(record.metadata)

    def _scan(self, at: int, end: int | None) -> None:
        """Go through the file's records; where it has no end, up to the last whole message."""
        stop = self._size if end is None else end
        words = 'it ends between two records, so more may have followed'
        while at < stop:
            head = self._read_at(at, min(HEAD_BYTES, stop - at))
            opcode, length = head[0], int.from_bytes(head[1 : PREFIX.size], 'little')
            step = PREFIX.size + length
            if len(head) < PREFIX.size or at + step > stop or opcode == 0:
                if end is not None:
                    raise DamagedError(f'the record at byte {at} is not whole')
                words = self._torn(at, head)
                break
            last = self.spans[-1] if self.spans else Span(0, 0)
            is_next = at == last.position + last.length + last.index_length
            if opcode == Opcode.CHUNK:
                span = parse_chunk_head(head, at)[0]
                self.spans += [span] if span.size else []
            elif opcode == Opcode.MESSAGE_INDEX and is_next:
                self.spans[-1] = replace(last, index_length=last.index_length + step)
            elif opcode == Opcode.MESSAGE:
                if length > MAX_CHUNK_BYTES:
                    raise DamagedError(f'at byte {at}: a record of {length} bytes')
                if is_next and last.kind == 'loose' and last.length + step < _WINDOW_BYTES:
                    self.spans[-1] = replace(last, length=last.length + step)
                else:
                    self.spans.append(Span(at, step, kind='loose'))
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}:
                if length <= _MAX_SMALL_RECORD:
                    self._on_record(opcode, self._read_at(at + PREFIX.size, length))
                elif opcode != Opcode.METADATA:
                    raise DamagedError(f'the record at byte {at} has {length} bytes')
            elif opcode in {Opcode.DATA_END, Opcode.FOOTER}:
                words = 'its summary is missing, but no message is'
                break
            at += step
        words = self._count(words, end is not None)
        if end is None:
            self.truncated = f'the file is cut off at byte {self._size}: {words}'

    def _torn(self, at: int, head: bytes) -> str:
        """Take what is left of a record that is not whole; says what that is."""
        if head[0] == 0:
            last = self.spans[-1] if self.spans else None
            if last is not None and at == last.position + last.length:
                # With the zeros that follow, which end the walk: its own end may be zeros too.
                kind = last.kind if last.kind == 'loose' else 'torn'
                self.spans[-1] = replace(last, length=last.length + PREFIX.size, kind=kind)
            return f'it is unreadable from byte {at} on'
        if head[0] == Opcode.CHUNK:
            try:
                span = parse_chunk_head(head, at)[0]
            except DamagedError:
                pass
            else:
                self.spans.append(replace(span, length=self._size - at, kind='torn'))
            return 'it ends inside a chunk, of which the first {} messages are read'
        if head[0] == Opcode.MESSAGE_INDEX:
            return 'it ends inside the index of its last chunk, which is read whole'
        return 'it ends inside a record, everything before that is read'

    def _count(self, words: str, is_whole: bool) -> str:
        """Read all messages once: how many there are, and from when to when."""
        for row, span in enumerate(list(self.spans)):
            try:
                messages = load(self._read_at, span, self._on_record)
            except DamagedError:
                if is_whole or row + 1 < len(self.spans) or span.kind != 'chunk':
                    raise
                self.spans.pop()
                words = f'{words}; its last chunk is damaged and left out'
                continue
            if span.kind == 'torn':
                words = words.format(len(messages))
            if len(messages):
                self._counts.update(messages.channel.tolist())
                start, end = int(np.min(messages.log_ns)), int(np.max(messages.log_ns))
                self.spans[row] = replace(span, start_ns=start, end_ns=end)
                self.start_ns = start if self.start_ns is None else min(self.start_ns, start)
                self.end_ns = end if self.end_ns is None else max(self.end_ns, end)
        return words.format(0)


def _in_order(pieces: Iterable[tuple[int, Messages, int | None]]) -> Iterator[Messages]:
    """Merge stretches, given with their numbers and the first log time of what follows."""
    # Once the next one begins at time t, whatever was read before t is final. So only the messages
    # of chunks that overlap at one instant are ever held back.
    held: dict[int, Messages] = {}
    for row, piece, next_ns in pieces:
        held[row] = piece
        ready = []
        for number, one in sorted(held.items()):
            n = len(one) if next_ns is None else int(np.searchsorted(one.log_ns, next_ns))
            if n:
                ready.append(one.take(slice(0, n)))
            if n == len(one):
                del held[number]
            elif n or number == row:
                held[number] = one.take(slice(n, None)).packed()
        if sum(len(one.data) for one in held.values()) > _MAX_HELD_BYTES:
            raise DamagedError(
                'too many of its chunks overlap in time to be read in bounded memory; '
                'sort it by time with another tool'
            )
        if ready:
            yield join_messages(ready).in_order()
