# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the map of one MCAP file: which stretches hold its messages, its topics, what is missing.

The data section is gone through record by record from the front, over the heads only; where the
chunk index of the summary knows a chunk, it is stepped over together with its message indexes.
So a file without a summary, or cut off anywhere, is mapped by the same walk as a whole one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..typing import Bytes
from . import mcap_records as mcap
from .chunk import HEAD_BYTES, MAX_CHUNK_BYTES, StreamSpan, Windows, load_chunk
from .mcap_records import Channel, ChunkSpan, DamagedError, Schema, Statistics
from .random_access import LocalFile, OpenFile, RandomAccess
from .walk import Messages, walk

#: Name of the metadata record with the key-value pairs of this package's writer.
METADATA_NAME = 'thermo_comp'

_MAX_SUMMARY_BYTES = 1 << 28
_MAX_SMALL_RECORD = 1 << 22


class Survey:
    """
    One open MCAP file, mapped.

    Parameters
    ----------
    path : Path
        The file.
    open_file : callable, optional
        Opens it where it lies.

    Attributes
    ----------
    handle : RandomAccess
        The open file.
    spans : list of ChunkSpan or StreamSpan
        What holds messages, in the order of the file.
    channels : dict of int to Channel
    schemas : dict of int to Schema
    counts : Counter of int
        Messages per channel.
    start_ns, end_ns : int or None
        Log time of the first and the last message.
    metadata : dict of str to str
    truncated : str or None

    Raises
    ------
    RecordingError
        No MCAP file, a file that cannot be opened, damage other than a missing end.

    """

    def __init__(self, path: Path, open_file: OpenFile = LocalFile) -> None:
        self.path = path
        self.spans: list[ChunkSpan | StreamSpan] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.counts: Counter[int] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.metadata: dict[str, str] = {}
        self.truncated: str | None = None
        self._chunk_index: dict[int, ChunkSpan] = {}
        self._statistics: Statistics | None = None
        self._channel_records: dict[int, bytes] = {}
        self._unscanned: list[tuple[ChunkSpan | StreamSpan, bool]] = []
        self._last_index: Counter[int] = Counter()
        try:
            self.handle: RandomAccess = open_file(path)
        except OSError as error:
            raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
        try:
            self._map()
        except DamagedError as error:
            self.close()
            raise RecordingError(f'damaged: {error}', path) from error
        except OSError as error:
            self.close()
            raise RecordingError(f'cannot be read: {error.strerror}', path) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self.handle.close()

    def _map(self) -> None:
        self._size = self.handle.size
        begin = self._read_header()
        end = self._read_footer(begin)
        self._has_footer = end is not None
        if not self._is_indexed():
            self._chunk_index.clear()
        self._walk(begin, self._size if end is None else end)
        if not self._has_footer:
            self._check_last()
        n_torn = self._scan()
        if self.truncated is not None:
            self.truncated = (
                f'the file is cut off at byte {self._size}: {self.truncated.format(n_torn)}'
            )
        for number, content in self._channel_records.items():
            self.channels[number] = mcap.parse_channel(content, self.schemas)[1]
        if self._statistics is not None:
            self.counts = Counter(self._statistics.counts)
            if self._statistics.n_messages:
                self.start_ns = self._statistics.start_ns
                self.end_ns = self._statistics.end_ns

    def _read(self, at: int, n_bytes: int) -> bytes:
        return self.handle.read_at(at, n_bytes)

    def _read_header(self) -> int:
        head = self._read(0, len(mcap.MAGIC) + mcap.PREFIX_BYTES)
        if not head:
            raise RecordingError('the file is empty', self.path)
        magic = head[: len(mcap.MAGIC)]
        if magic != mcap.MAGIC[: len(magic)]:
            raise RecordingError('not an MCAP file', self.path)
        if len(head) == len(mcap.MAGIC) + mcap.PREFIX_BYTES:
            opcode, length = head[len(mcap.MAGIC)], int.from_bytes(head[-8:], 'little')
            if opcode != mcap.HEADER:
                raise RecordingError(
                    'not an MCAP file: it does not begin with a header', self.path
                )
            if len(head) + length <= self._size:
                return len(head) + length
        raise RecordingError('cut off inside its header, there is nothing to read', self.path)

    def _read_footer(self, begin: int) -> int | None:
        """Where the data section ends; None where the file has no footer."""
        at = self._size - mcap.FOOTER_BYTES
        footer = self._read(at, mcap.FOOTER_BYTES) if at >= begin else b''
        if not footer.startswith(b'\x02\x14' + bytes(7)) or not footer.endswith(mcap.MAGIC):
            return None
        summary = int.from_bytes(footer[9:17], 'little')
        if summary == 0:
            return at
        if not begin <= summary <= at:
            raise DamagedError(f'the footer puts the summary at byte {summary}')
        if at - summary <= _MAX_SUMMARY_BYTES:
            content = np.frombuffer(self._read(summary, at - summary), np.uint8)
            self._read_summary(content)
        return summary

    def _read_summary(self, content: Bytes) -> None:
        """Take what the summary says; a damaged one is as good as none."""
        try:
            _, end, _ = walk(content, self._on_summary)
        except DamagedError:
            end = -1
        if end != len(content):
            self._chunk_index.clear()
            self._statistics = None

    def _on_summary(self, opcode: int, content: bytes) -> None:
        if opcode == mcap.CHUNK_INDEX:
            span = mcap.parse_chunk_index(content)
            self._chunk_index[span.position] = span
        elif opcode == mcap.STATISTICS:
            self._statistics = mcap.parse_statistics(content)
        else:
            self._on_record(opcode, content)

    def _on_record(self, opcode: int, content: bytes) -> None:
        if opcode == mcap.SCHEMA:
            number, schema = mcap.parse_schema(content)
            self.schemas[number] = schema
        elif opcode == mcap.CHANNEL:
            self._channel_records[int.from_bytes(content[:2], 'little')] = content
        elif opcode == mcap.METADATA:
            name, pairs = mcap.parse_metadata(content)
            if name == METADATA_NAME:
                self.metadata.update(pairs)

    def _is_indexed(self) -> bool:
        """Whether the summary tells enough to step over the chunks it knows."""
        said = self._statistics
        if said is None or sum(said.counts.values()) != said.n_messages:
            self._statistics = None
            return False
        return all(number in self._channel_records for number, n in said.counts.items() if n)

    def _walk(self, at: int, end: int) -> None:
        """Go over the heads of the data section's records."""
        pending: ChunkSpan | None = None
        index: Counter[int] = Counter()
        while at < end:
            known = self._chunk_index.get(at)
            if known is not None and at + known.length + known.index_length <= end:
                self._add(known)
                at += known.length + known.index_length
                continue
            head = self._read(at, min(HEAD_BYTES, end - at))
            opcode, length = head[0], int.from_bytes(head[1 : mcap.PREFIX_BYTES], 'little')
            step = mcap.PREFIX_BYTES + length
            is_torn = len(head) < mcap.PREFIX_BYTES or at + step > end or opcode == 0
            if pending is not None and (opcode != mcap.MESSAGE_INDEX or is_torn):
                self._close_chunk(pending, index)
                pending, index = None, Counter()
            if is_torn:
                self._torn(at, head)
                return
            if opcode == mcap.CHUNK:
                pending, _, _ = mcap.parse_chunk_head(head, at)
            elif opcode == mcap.MESSAGE_INDEX and pending is not None:
                number, n_messages = _index_head(head, length)
                index[number] += n_messages
                pending = replace(pending, index_length=pending.index_length + step)
            elif opcode == mcap.MESSAGE:
                at = self._loose(at, end)
                continue
            elif opcode in {mcap.SCHEMA, mcap.CHANNEL, mcap.METADATA}:
                self._small_record(opcode, at, length)
            elif opcode in {mcap.DATA_END, mcap.FOOTER}:
                self._end('its summary is missing, but no message is')
                return
            at += step
        if pending is not None:
            self._close_chunk(pending, index)
        self._end('it ends between two records, so more may have followed')

    def _end(self, words: str) -> None:
        if not self._has_footer:
            self.truncated = words

    def _torn(self, at: int, head: bytes) -> None:
        """Take what is left of a record that is not whole."""
        if self._has_footer:
            raise DamagedError(f'the record at byte {at} is not whole')
        opcode = head[0]
        if opcode == 0:
            self.truncated = f'it is unreadable from byte {at} on'
            self._distrust_last(at)
        elif opcode == mcap.CHUNK:
            self.truncated = 'it ends inside a chunk, of which the first {} messages are read'
            try:
                mcap.parse_chunk_head(head, at)
            except DamagedError:
                return
            torn = StreamSpan(at, self._size, is_chunk=True, is_torn=True)
            self.spans.append(torn)
            self._unscanned.append((torn, True))
        elif opcode == mcap.MESSAGE_INDEX:
            self.truncated = 'it ends inside the index of its last chunk, which is read whole'
        else:
            self.truncated = 'it ends inside a record, everything before that is read'

    def _small_record(self, opcode: int, at: int, length: int) -> None:
        if length <= _MAX_SMALL_RECORD:
            self._on_record(opcode, self._read(at + mcap.PREFIX_BYTES, length))
        elif opcode != mcap.METADATA:
            raise DamagedError(f'the record at byte {at} has {length} bytes')

    def _close_chunk(self, span: ChunkSpan, index: Counter[int]) -> None:
        """Take a chunk that the walk found, with what its message indexes say."""
        if not self._add(span):
            return
        self._last_index = index
        is_counted = index.total() > 0
        self.counts.update(index)
        if not is_counted or any(number not in self._channel_records for number in index):
            self._unscanned.append((self.spans[-1], not is_counted))
        self._spread(span.start_ns, span.end_ns)

    def _add(self, span: ChunkSpan) -> bool:
        if span.size == 0:
            return False
        length = span.length + span.index_length
        is_large = max(span.size, length) > MAX_CHUNK_BYTES
        self.spans.append(
            StreamSpan(span.position, span.position + span.length, is_chunk=True)
            if is_large
            else span
        )
        return True

    def _loose(self, at: int, end: int) -> int:
        """Take a stretch of messages outside any chunk; gives where it ends."""
        stretch = StreamSpan(at, end, is_chunk=False, is_torn=not self._has_footer)
        windows = Windows(self.handle, stretch, self._on_record)
        for _, messages in windows:
            self._count(messages)
        if windows.n_walked == 0:
            raise DamagedError(f'the record at byte {at} is not whole')
        self.spans.append(replace(stretch, end=at + windows.n_kept))
        return at + windows.n_walked

    def _distrust_last(self, at: int) -> None:
        """Read a last chunk that zeros follow up to them, as its own end may be zeros too."""
        last = self.spans[-1] if self.spans else None
        if (
            isinstance(last, ChunkSpan)
            and not last.compression
            and at == last.position + last.length
        ):
            self.counts.subtract(self._last_index)
            end = at + mcap.PREFIX_BYTES
            torn = StreamSpan(last.position, end, is_chunk=True, is_torn=True)
            self.spans[-1] = torn
            self._unscanned = [entry for entry in self._unscanned if entry[0] is not last]
            self._unscanned.append((torn, True))

    def _check_last(self) -> None:
        """
        Count the last whole chunk of a file without a footer, whose index may be cut off.

        One that is not sound is left out.
        """
        last = self.spans[-1] if self.spans else None
        if last is None or (isinstance(last, StreamSpan) and (last.is_torn or not last.is_chunk)):
            return
        self._unscanned = [entry for entry in self._unscanned if entry[0] is not last]
        self.counts.subtract(self._last_index)
        if isinstance(last, StreamSpan):
            self.spans[-1] = replace(last, is_torn=True)
            self._unscanned.append((self.spans[-1], True))
            return
        try:
            _, messages = load_chunk(self.handle, last, self._on_record)
            self._count(messages)
        except DamagedError:
            self.spans.pop()
            self.truncated = f'{self.truncated}; its last chunk is damaged and left out'

    def _scan(self) -> int:
        """Read the chunks that no index describes; gives the number of messages of a torn one."""
        n_torn = 0
        for span, is_counted in self._unscanned:
            if isinstance(span, ChunkSpan):
                found = iter([load_chunk(self.handle, span, self._on_record)])
            else:
                found = iter(Windows(self.handle, span, self._on_record))
            for _, messages in found:
                if is_counted:
                    self._count(messages)
                if isinstance(span, StreamSpan) and span.is_torn:
                    n_torn += len(messages.at)
        return n_torn

    def _count(self, messages: Messages) -> None:
        if not len(messages.at):
            return
        numbers, counts = np.unique(messages.channel, return_counts=True)
        self.counts.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        self._spread(int(np.min(messages.log_ns)), int(np.max(messages.log_ns)))

    def _spread(self, start_ns: int, end_ns: int) -> None:
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = end_ns if self.end_ns is None else max(self.end_ns, end_ns)


def _index_head(head: bytes, length: int) -> tuple[int, int]:
    """Channel and number of messages of a message index record."""
    number, n_bytes = mcap.Cursor(head, mcap.PREFIX_BYTES).numbers('HI')
    return number, n_bytes // 16 if n_bytes + 6 == length else 0
