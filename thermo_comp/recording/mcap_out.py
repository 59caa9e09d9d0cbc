# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the MCAP file being written: chunks with their message indexes, and the summary at the end.

The bulk (message records, message indexes) is numpy bytes; the few other records go through the
`mcap` library's record classes.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from .. import __version__
from ..typing import Bytes
from .chunks import MESSAGE_HEAD_BYTES
from .encode import Merged
from .mcap_file import MAGIC, METADATA_NAME
from .messages import Messages, join_messages
from .rosbag2_metadata import Definition, FileSummary, dump_yaml, information, offered_qos

#: A sixth faster than 1 on Imu messages, and no larger by more than a few percent.
_ZSTD_LEVEL = -1
_MAX_PACKING = 2
# Versions of mcap differ in which of its methods are typed.
_new_builder: Callable[[], Any] = RecordBuilder
_INDEX_ROW = np.dtype([('log', '<u8'), ('offset', '<u8')])


class McapOutput:
    """
    One new MCAP file from its first byte to its footer.

    `metadata` is written at the front, so that even a torn file has it; `name` is what the
    finished file will be called.
    """

    def __init__(
        self,
        path: Path,
        compression: Literal['none', 'lz4', 'zstd'],
        level: int | None,
        chunk_bytes: int,
        metadata: Mapping[str, str],
        name: str,
    ) -> None:
        self._name = name
        self._compression = '' if compression == 'none' else compression
        self._compress = _compressor(compression, level)
        self._chunk_bytes = chunk_bytes
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._topics: dict[str, tuple[str, str]] = {}
        self._counts: dict[int, int] = {}
        self._chunks: list[ChunkIndex] = []
        self._metadata_index: list[MetadataIndex] = []
        self._tail: list[Messages] = []
        self._packing: deque[tuple[Messages, Future[tuple[bytes | memoryview, int]]]] = deque()
        self._pool = ThreadPoolExecutor(1, 'recording')
        self._start_ns: int | None = None
        self._end_ns = 0
        self._at = 0
        self._stream = path.open('xb', buffering=0)
        self._put(MAGIC)
        self._put_record(Header('ros2', f'thermo_comp {__version__}'))
        if metadata:
            self._put_metadata(METADATA_NAME, metadata)

    def channel(self, topic: str, kind: str, definition: Definition) -> int | None:
        """
        Give the number of a topic's channel, made where it is new; None if its type is another.
        """
        if topic in self._channels:
            same = self._topics[topic][0] == kind
            return self._channels[topic].id if same else None
        if kind not in self._schemas:
            text = definition.text.encode()
            number = len(self._schemas) + 1
            schema = Schema(id=number, data=text, encoding=definition.encoding, name=kind)
            self._schemas[kind] = schema
            self._put_record(schema)
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding='cdr',
            schema_id=self._schemas[kind].id,
            metadata={
                'offered_qos_profiles': dump_yaml([offered_qos(kind)]).strip(),
                'topic_type_hash': definition.type_hash,
            },
        )
        self._channels[topic] = channel
        self._topics[topic] = (kind, definition.type_hash)
        self._counts[channel.id] = 0
        self._put_record(channel)
        return channel.id

    def append(self, merged: Merged) -> None:
        """Add messages; whole chunks are written, the rest waits for more."""
        while True:
            waiting = sum(len(messages.data) for messages in self._tail)
            messages = merged.take(self._chunk_bytes - waiting)
            if messages is None:
                return
            self._tail.append(messages)
            if waiting + len(messages.data) >= self._chunk_bytes:
                self._close_chunk()

    def _close_chunk(self) -> None:
        """Have the waiting messages compressed, and write what was compressed meanwhile."""
        messages, self._tail = join_messages(self._tail), []
        self._packing.append((messages, self._pool.submit(self._pack, messages.data)))
        self._put_packed(_MAX_PACKING)

    def _put_packed(self, n_left: int) -> None:
        while len(self._packing) > n_left:
            messages, future = self._packing.popleft()
            self._put_chunk(messages, *future.result())

    def _pack(self, data: Bytes) -> tuple[bytes | memoryview, int]:
        return self._compress(data), zlib.crc32(data.data)

    def finish(self, custom: Mapping[str, str]) -> FileSummary:
        """
        Write the last chunk, the summary and the footer; flush all to disk and close.

        `custom` goes into rosbag2's own metadata record.
        """
        if self._tail:
            self._close_chunk()
        self._put_packed(0)
        topics = (
            (topic, *self._topics[topic], self._counts[channel.id])
            for topic, channel in self._channels.items()
        )
        summary = FileSummary(self._name, self._start_ns or 0, self._end_ns, tuple(topics))
        text = dump_yaml(information(summary, custom)).strip()
        self._put_metadata('rosbag2', {'serialized_metadata': text})
        self._put_record(DataEnd(data_section_crc=0))
        self._put_summary()
        os.fsync(self._stream.fileno())
        self.close()
        return summary

    def close(self) -> None:
        """Close the file as it is."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._stream.close()

    def _put(self, data: bytes | memoryview) -> None:
        view = memoryview(data)
        while view:
            view = view[self._stream.write(view) :]
        self._at += len(data)

    def _put_record(self, record: McapRecord) -> None:
        builder = _new_builder()
        record.write(builder)
        self._put(builder.end())

    def _put_metadata(self, name: str, content: Mapping[str, str]) -> None:
        begin = self._at
        self._put_record(Metadata(name, dict(content)))
        self._metadata_index.append(MetadataIndex(begin, self._at - begin, name))

    def _put_chunk(self, messages: Messages, packed: bytes | memoryview, checksum: int) -> None:
        log_ns, channel = messages.log_ns, messages.channel
        start, end = int(np.min(log_ns)), int(np.max(log_ns))
        self._start_ns = start if self._start_ns is None else min(self._start_ns, start)
        self._end_ns = max(self._end_ns, end)
        name = self._compression.encode()
        begin = self._at
        n_bytes = len(messages.data)
        head = (Opcode.CHUNK, 40 + len(name) + len(packed), start, end, n_bytes, checksum)
        self._put(struct.pack(f'<BQQQQII{len(name)}sQ', *head, len(name), name, len(packed)))
        self._put(packed)
        chunk_length = self._at - begin
        offsets: dict[int, int] = {}
        rows = np.empty(len(log_ns), _INDEX_ROW)
        rows['log'] = log_ns
        rows['offset'] = messages.start - MESSAGE_HEAD_BYTES
        for number in np.unique(channel).tolist():
            own = rows[channel == number]
            self._counts[number] += len(own)
            offsets[number] = self._at
            self._put(
                struct.pack('<BQHI', Opcode.MESSAGE_INDEX, 6 + own.nbytes, number, own.nbytes)
                + own.tobytes()
            )
        self._chunks.append(
            ChunkIndex(
                chunk_length=chunk_length,
                chunk_start_offset=begin,
                compression=self._compression,
                compressed_size=len(packed),
                message_end_time=end,
                message_index_length=self._at - begin - chunk_length,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(messages.data),
            )
        )

    def _put_summary(self) -> None:
        summary_start = self._at
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._end_ns,
            message_start_time=self._start_ns or 0,
            metadata_count=len(self._metadata_index),
            schema_count=len(self._schemas),
        )
        builder = _new_builder()
        for record in (
            *self._schemas.values(),
            *self._channels.values(),
            statistics,
            *self._chunks,
            *self._metadata_index,
        ):
            record.write(builder)
        body: bytes = builder.end()
        self._put(body)
        footer_head = struct.pack('<BQQQ', Opcode.FOOTER, 20, summary_start, 0)
        checksum = zlib.crc32(footer_head, zlib.crc32(body))
        self._put_record(
            Footer(summary_start=summary_start, summary_offset_start=0, summary_crc=checksum)
        )
        self._put(MAGIC)


def _compressor(
    compression: Literal['none', 'lz4', 'zstd'], level: int | None
) -> Callable[[Bytes], bytes | memoryview]:
    if compression == 'zstd':
        compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL if level is None else level)
        return lambda data: compressor.compress(data.data)
    if compression == 'lz4':
        return lambda data: bytes(
            lz4.frame.compress(data, compression_level=0 if level is None else level)
        )
    return lambda data: data.data
