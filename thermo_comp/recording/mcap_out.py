# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the writing of an MCAP file: chunks with message indexes, the summary at the end, and the
metadata.yaml of rosbag2 (version 9). Messages and their indexes are numpy bytes; the few other
records use the classes of the `mcap` library.
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import numpy as np
import yaml
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from .. import __version__
from ..errors import RecordingError
from ..topics import OUTPUTS
from .chunks import MESSAGE, MESSAGE_HEAD_BYTES, PREFIX
from .fields import typestore
from .mcap_file import MAGIC, METADATA_NAME
from .serialized import Messages, join_messages, scatter

Compression = Literal['none', 'lz4', 'zstd']

#: Functions that compress data; the second argument is the level of zstd.
_COMPRESSORS: Mapping[Compression, Callable[[Any, int], Any]] = {
    'none': lambda data, _: data,
    'lz4': lambda data, _: lz4.frame.compress(data),
    'zstd': zstandard.compress,
}
#: Transient-local topics (a late subscriber gets the last message), without their namespace.
_LATCHED = tuple(topic.name for topic in OUTPUTS if topic.is_latched)
_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # stands for no time limit in a QoS profile
_new_builder: Callable[[], Any] = RecordBuilder  # type hints differ between versions of `mcap`
#: Head of a message record: opcode, length, channel, sequence, log time, publish time.
_RECORD_HEAD = np.dtype('u1, <u8, <u2, <u4, <i8, <i8')
_INDEX_ROW = np.dtype([('log', '<u8'), ('offset', '<u8')])


@lru_cache(maxsize=64)
def known_definition(kind: str) -> tuple[str, str, str]:
    """Return encoding, text and RIHS01 hash of a type; RecordingError for a type not in Jazzy."""
    store = typestore()
    if kind not in store.fielddefs:
        raise RecordingError(f'the definition of message type {kind} is not known')
    text, _ = store.generate_msgdef(kind, ros_version=2)
    return 'ros2msg', text, store.hash_rihs01(kind)


class McapOutput:
    """A new MCAP file, with the metadata first, so that an unfinished file has the metadata."""

    def __init__(
        self,
        path: Path,
        compression: Compression,
        level: int,
        chunk_bytes: int,
        metadata: Mapping[str, str],
        name: str,
    ) -> None:
        self._name, self._metadata, self._chunk_bytes = name, metadata, chunk_bytes
        self._compression, self._level = compression, level
        self._schemas: dict[str, records.Schema] = {}
        self._channels: dict[str, records.Channel] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[records.ChunkIndex] = []
        self._metadata_index: list[records.MetadataIndex] = []
        self._tail: list[Messages] = []
        self._at = 0
        self._stream = path.open('xb', buffering=0)
        self.close = self._stream.close  # closes the file without writing the summary
        self._put(MAGIC)
        self._put_record(records.Header('ros2', f'thermo_comp {__version__}'))
        if metadata:
            self._put_metadata(METADATA_NAME, metadata)

    def channel(self, topic: str, kind: str, definition: tuple[str, str, str]) -> int:
        """Return the channel number of a topic; create the channel if it is new."""
        encoding, text, type_hash = definition
        schema, known = self._schemas.get(kind), self._channels.get(topic)
        if known is not None:
            if schema is None or known.schema_id != schema.id:
                raise RecordingError(f'already written with another type than {kind}')
            return known.id
        if schema is None:
            schema = records.Schema(len(self._schemas) + 1, text.encode(), encoding, kind)
            self._schemas[kind] = schema
            self._put_record(schema)
        qos = dump_yaml([_offered_qos(topic)]).strip()
        facts = {'offered_qos_profiles': qos, 'topic_type_hash': type_hash}
        channel = records.Channel(len(self._channels) + 1, topic, 'cdr', facts, schema.id)
        self._channels[topic] = channel
        self._counts[channel.id] = 0
        self._put_record(channel)
        return channel.id

    def append(self, batches: Sequence[Messages]) -> None:
        """Add messages in log-time order; write full chunks, hold the rest for the next chunk."""
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
        """Write the last chunk, summary and footer; return the content of metadata.yaml."""
        for messages in self._tail:
            if len(messages):
                self._put_chunk(messages)
        information = self._information()
        self._put_metadata('rosbag2', {'serialized_metadata': dump_yaml(information).strip()})
        self._put_record(records.DataEnd(data_section_crc=0))
        self._put_summary()
        os.fsync(self._stream.fileno())
        self.close()
        return information

    def _information(self) -> dict[str, Any]:
        """Build the content of metadata.yaml as rosbag2 of ROS 2 Jazzy does."""
        start_ns, end_ns = self._times()
        kinds = {schema.id: kind for kind, schema in self._schemas.items()}
        counted: list[dict[str, Any]] = [
            {
                'topic_metadata': {
                    'name': channel.topic,
                    'type': kinds[channel.schema_id],
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [_offered_qos(channel.topic)],
                    'type_description_hash': channel.metadata['topic_type_hash'],
                },
                'message_count': self._counts[channel.id],
            }
            for channel in self._channels.values()
        ]
        times = {
            'duration': {'nanoseconds': end_ns - start_ns},
            'starting_time': {'nanoseconds_since_epoch': start_ns},
            'message_count': self._counts.total(),
        }
        return {
            'version': 9,
            'storage_identifier': 'mcap',
            **times,
            'topics_with_message_count': counted,
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self._name],
            'files': [{'path': self._name, **times}],
            'custom_data': dict(self._metadata) or None,
            'ros_distro': 'jazzy',
        }

    def _times(self) -> tuple[int, int]:
        start = min((chunk.message_start_time for chunk in self._chunks), default=0)
        return start, max((chunk.message_end_time for chunk in self._chunks), default=0)

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
        log_ns, channel, size = messages.log_ns, messages.channel, messages.size
        spaced = messages.packed(MESSAGE_HEAD_BYTES)
        data, at = spaced.data, spaced.start - MESSAGE_HEAD_BYTES
        heads: Any = np.zeros(len(at), _RECORD_HEAD)
        heads['f0'], heads['f1'] = MESSAGE, size + (MESSAGE_HEAD_BYTES - PREFIX.size)
        heads['f2'], heads['f4'], heads['f5'] = channel, log_ns, log_ns
        scatter(data, at, heads.view(np.dtype((np.void, MESSAGE_HEAD_BYTES))))
        packed = _COMPRESSORS[self._compression](data.data, self._level)
        name = '' if self._compression == 'none' else self._compression
        begin, start, end = self._at, int(np.min(log_ns)), int(np.max(log_ns))
        self._put_record(records.Chunk(name, packed, end, start, zlib.crc32(data.data), len(data)))
        chunk_length = self._at - begin
        offsets: dict[int, int] = {}
        rows = np.empty(len(log_ns), _INDEX_ROW)
        rows['log'], rows['offset'] = log_ns, at
        for number in np.unique(channel).tolist():
            entries = rows[channel == number]
            self._counts[number] += len(entries)
            offsets[number] = self._at
            index_head = (Opcode.MESSAGE_INDEX, 6 + entries.nbytes, number, entries.nbytes)
            self._put(struct.pack('<BQHI', *index_head) + entries.tobytes())
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=chunk_length,
                chunk_start_offset=begin,
                compression=name,
                compressed_size=len(packed),
                message_end_time=end,
                message_index_length=self._at - begin - chunk_length,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(data),
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
        declared = *self._schemas.values(), *self._channels.values(), statistics
        body = self._put_record(*declared, *self._chunks, *self._metadata_index)
        footer_head = struct.pack('<BQQQ', Opcode.FOOTER, 20, begin, 0)
        self._put_record(records.Footer(begin, 0, zlib.crc32(footer_head, zlib.crc32(body))))
        self._put(MAGIC)


def _offered_qos(topic: str) -> dict[str, Any]:
    """Return a publisher's QoS profile for metadata.yaml: reliable, to match any subscriber."""
    is_flag = topic.endswith(_LATCHED)
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


def dump_yaml(content: Any) -> str:
    """Write YAML in block style with the keys in their order."""
    # The dumper writes repeated values in full, without YAML aliases.
    dumper: Any = type('Dumper', (yaml.SafeDumper,), {'ignore_aliases': lambda *_: True})
    return str(yaml.dump(content, None, dumper, sort_keys=False, allow_unicode=True, width=10_000))
