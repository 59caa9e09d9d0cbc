# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the MCAP file being written: chunks with their message indexes, the summary at the end, and
what rosbag2 says of it (metadata.yaml of version 9).

The bulk (message records, message indexes) is numpy bytes; the few other records go through the
`mcap` library's record classes.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import lz4.frame
import numpy as np
import yaml
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from .. import __version__
from ..errors import RecordingError
from .chunks import MESSAGE, MESSAGE_HEAD_BYTES, PREFIX
from .columns import Messages, join_messages, scatter
from .mcap_file import MAGIC, METADATA_NAME
from .topics import BOOL
from .wire import typestore

Compression = Literal['none', 'lz4', 'zstd']

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}
#: A sixth faster than 1 on Imu messages, and no larger by more than a few percent.
_ZSTD_LEVEL = -1
# Versions of mcap differ in which of its methods are typed.
_new_builder: Callable[[], Any] = RecordBuilder
#: Opcode, length, channel, sequence, log time, publish time.
_RECORD_HEAD = np.dtype('u1, <u8, <u2, <u4, <i8, <i8')
_INDEX_ROW = np.dtype([('log', '<u8'), ('offset', '<u8')])


class Definition(NamedTuple):
    """A message type's definition with all it depends on; its hash (RIHS01), if it is known."""

    encoding: str
    text: str
    type_hash: str


@lru_cache(maxsize=64)
def known_definition(kind: str) -> Definition:
    """Look up a message type of ROS 2 Jazzy; RecordingError for one that it does not have."""
    store = typestore()
    if kind not in store.fielddefs:
        raise RecordingError(f'the definition of message type {kind} is not known')
    text, _ = store.generate_msgdef(kind, ros_version=2)
    return Definition('ros2msg', text, store.hash_rihs01(kind))


class McapOutput:
    """One new MCAP file, its metadata at the front, so that even a torn one has them."""

    def __init__(
        self,
        path: Path,
        compression: Compression,
        level: int | None,
        chunk_bytes: int,
        metadata: Mapping[str, str],
        name: str,
    ) -> None:
        self._name, self._metadata, self._chunk_bytes = name, metadata, chunk_bytes
        self._compression = '' if compression == 'none' else compression
        self._compress = _compressor(compression, level)
        self._schemas: dict[str, records.Schema] = {}
        #: By topic, with the type and its hash.
        self._channels: dict[str, tuple[records.Channel, str, str]] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[records.ChunkIndex] = []
        self._metadata_index: list[records.MetadataIndex] = []
        self._tail: list[Messages] = []
        self._at = 0
        self._stream = path.open('xb', buffering=0)
        self._put(MAGIC)
        self._put_record(records.Header('ros2', f'thermo_comp {__version__}'))
        if metadata:
            self._put_metadata(METADATA_NAME, metadata)

    def channel(self, topic: str, kind: str, definition: Definition) -> int:
        """Give the number of a topic's channel, made where it is new."""
        if topic in self._channels:
            known, known_kind, _ = self._channels[topic]
            if known_kind != kind:
                raise RecordingError(f'already written with another type than {kind}')
            return known.id
        if kind not in self._schemas:
            number, text = len(self._schemas) + 1, definition.text.encode()
            self._schemas[kind] = records.Schema(number, text, definition.encoding, kind)
            self._put_record(self._schemas[kind])
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding='cdr',
            schema_id=self._schemas[kind].id,
            metadata={
                'offered_qos_profiles': dump_yaml([_offered_qos(kind)]).strip(),
                'topic_type_hash': definition.type_hash,
            },
        )
        self._channels[topic] = channel, kind, definition.type_hash
        self._counts[channel.id] = 0
        self._put_record(channel)
        return channel.id

    def append(self, batches: Sequence[Messages]) -> None:
        """Add messages in log-time order; whole chunks are written, the rest waits for more."""
        messages = join_messages([*self._tail, *batches])
        n_old = sum(map(len, self._tail))
        order = np.argsort(messages.log_ns[n_old:], kind='stable')
        messages = messages.take(np.concatenate([np.arange(n_old), n_old + order]))
        ends = np.cumsum(messages.size + MESSAGE_HEAD_BYTES)
        begin = n_done = 0
        while len(ends) and ends[-1] - n_done >= self._chunk_bytes:
            end = int(np.searchsorted(ends, n_done + self._chunk_bytes)) + 1
            self._put_chunk(messages.take(slice(begin, end)))
            begin, n_done = end, int(ends[end - 1])
        self._tail = [messages.take(slice(begin, None)).packed()]

    def finish(self) -> dict[str, Any]:
        """Write the last chunk, the summary and the footer; gives what metadata.yaml says."""
        for messages in self._tail:
            if len(messages):
                self._put_chunk(messages)
        topics = (
            (topic, kind, type_hash, self._counts[channel.id])
            for topic, (channel, kind, type_hash) in self._channels.items()
        )
        found = _information(self._name, *self._times(), topics, self._metadata)
        self._put_metadata('rosbag2', {'serialized_metadata': dump_yaml(found).strip()})
        self._put_record(records.DataEnd(data_section_crc=0))
        self._put_summary()
        os.fsync(self._stream.fileno())
        self.close()
        return found

    def close(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _times(self) -> tuple[int, int]:
        """Give the log times of the first and the last message."""
        start = min((one.message_start_time for one in self._chunks), default=0)
        return start, max((one.message_end_time for one in self._chunks), default=0)

    def _put(self, data: Any) -> None:
        view = memoryview(data)
        while view:
            view = view[self._stream.write(view) :]
        self._at += len(data)

    def _put_record(self, *new: records.McapRecord) -> bytes:
        builder = _new_builder()
        for record in new:
            record.write(builder)
        data: bytes = builder.end()
        self._put(data)
        return data

    def _put_metadata(self, name: str, content: Mapping[str, str]) -> None:
        begin = self._at
        self._put_record(records.Metadata(name, dict(content)))
        self._metadata_index.append(records.MetadataIndex(begin, self._at - begin, name))

    def _put_chunk(self, messages: Messages) -> None:
        """Lay messages out as the records of a chunk, and write it with its message indexes."""
        log_ns, channel, size = messages.log_ns, messages.channel, messages.size
        laid = messages.packed(MESSAGE_HEAD_BYTES)
        data, at = laid.data, laid.start - MESSAGE_HEAD_BYTES
        heads: Any = np.zeros(len(at), _RECORD_HEAD)
        heads['f0'], heads['f1'] = MESSAGE, size + (MESSAGE_HEAD_BYTES - PREFIX.size)
        heads['f2'], heads['f4'], heads['f5'] = channel, log_ns, log_ns
        scatter(data, at, heads.view(np.dtype((np.void, MESSAGE_HEAD_BYTES))))
        packed, checksum = self._compress(data.data), zlib.crc32(data.data)
        start, end = int(np.min(log_ns)), int(np.max(log_ns))
        name = self._compression.encode()
        begin, n_bytes = self._at, len(data)
        head = (Opcode.CHUNK, 40 + len(name) + len(packed), start, end, n_bytes, checksum)
        self._put(struct.pack(f'<BQQQQII{len(name)}sQ', *head, len(name), name, len(packed)))
        self._put(packed)
        chunk_length = self._at - begin
        offsets: dict[int, int] = {}
        rows = np.empty(len(log_ns), _INDEX_ROW)
        rows['log'], rows['offset'] = log_ns, at
        for number in np.unique(channel).tolist():
            own = rows[channel == number]
            self._counts[number] += len(own)
            offsets[number] = self._at
            index_head = (Opcode.MESSAGE_INDEX, 6 + own.nbytes, number, own.nbytes)
            self._put(struct.pack('<BQHI', *index_head) + own.tobytes())
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=chunk_length,
                chunk_start_offset=begin,
                compression=self._compression,
                compressed_size=len(packed),
                message_end_time=end,
                message_index_length=self._at - begin - chunk_length,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=n_bytes,
            )
        )

    def _put_summary(self) -> None:
        begin, (start, end) = self._at, self._times()
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=end,
            message_start_time=start,
            metadata_count=len(self._metadata_index),
            schema_count=len(self._schemas),
        )
        declared = *self._schemas.values(), *(one for one, *_ in self._channels.values())
        body = self._put_record(*declared, statistics, *self._chunks, *self._metadata_index)
        footer_head = struct.pack('<BQQQ', Opcode.FOOTER, 20, begin, 0)
        self._put_record(records.Footer(begin, 0, zlib.crc32(footer_head, zlib.crc32(body))))
        self._put(MAGIC)


def _compressor(compression: Compression, level: int | None) -> Callable[[Any], Any]:
    if compression == 'zstd':
        return zstandard.ZstdCompressor(level=_ZSTD_LEVEL if level is None else level).compress
    if compression == 'lz4':
        return lambda data: lz4.frame.compress(data, compression_level=level or 0)
    return lambda data: data


def _offered_qos(kind: str) -> dict[str, Any]:
    """Give the QoS profile that is recorded as offered: reliable, so that any reader matches."""
    is_flag = kind == BOOL  # of which a late reader gets the last one
    return {
        'history': 'keep_last',
        'depth': 1 if is_flag else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if is_flag else 'volatile',
        'deadline': _INFINITE,
        'lifespan': _INFINITE,
        'liveliness': 'automatic',
        'liveliness_lease_duration': _INFINITE,
        'avoid_ros_namespace_conventions': False,
    }


def _information(
    name: str,
    start_ns: int,
    end_ns: int,
    topics: Iterable[tuple[str, str, str, int]],
    custom: Mapping[str, str],
) -> dict[str, Any]:
    """Build metadata.yaml as Jazzy has it; topics are name, type, hash of the type and count."""
    counted: list[dict[str, Any]] = [
        {
            'topic_metadata': {
                'name': topic,
                'type': kind,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [_offered_qos(kind)],
                'type_description_hash': type_hash,
            },
            'message_count': count,
        }
        for topic, kind, type_hash, count in topics
    ]
    times = {
        'duration': {'nanoseconds': end_ns - start_ns},
        'starting_time': {'nanoseconds_since_epoch': start_ns},
        'message_count': sum(one['message_count'] for one in counted),
    }
    return {
        'version': 9,
        'storage_identifier': 'mcap',
        **times,
        'topics_with_message_count': counted,
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [name],
        'files': [{'path': name, **times}],
        'custom_data': dict(custom) or None,
        'ros_distro': 'jazzy',
    }


def dump_yaml(content: Any) -> str:
    """Write YAML in block style with the keys in their order."""
    # Values that stand twice are written twice.
    dumper: Any = type('Dumper', (yaml.SafeDumper,), {'ignore_aliases': lambda *_: True})
    return str(yaml.dump(content, None, dumper, sort_keys=False, allow_unicode=True, width=10_000))
