# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns every storage that is not plain MCAP: sqlite3, ROS 1 and packed messages, through rosbags.

`rosbags` finds the messages, file by file; their bytes are laid side by side and decoded many at a
time. What it raises on a damaged bag is translated here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from .chunks import Messages
from .columns import Block, RawMessages, RecordingInfo, Role, count_topics
from .decode import Decoder, Feed
from .unpack import unpack_message, unpack_ros1_chunk
from .wire import Encoding

_BATCH_MESSAGES = 1 << 14
_BATCH_BYTES = 1 << 23


class ForeignSource:
    """
    Files that `rosbags` reads, one after the other: ``.db3``, ``.mcap`` or one ROS 1 ``.bag``.

    `metadata` are key-value pairs that stand beside them, `note` what is missing beside them;
    `is_packed` where rosbag2 has compressed message by message. Raises RecordingError for
    whatever `rosbags` cannot open.
    """

    def __init__(
        self,
        files: Sequence[Path],
        metadata: Mapping[str, str] | None = None,
        note: str | None = None,
        *,
        is_packed: bool = False,
    ) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        suffix = files[0].suffix
        self._encoding: Encoding = 'ros1' if suffix == '.bag' else 'cdr'
        self._path = files[0]
        self._is_packed = is_packed
        self._readers: list[tuple[Path, Any]] = []
        channels: list[tuple[str, str, int]] = []
        definitions: dict[str, tuple[str, str]] = {}
        spans: list[tuple[int, int]] = []
        try:
            for file in files:
                with _translated(file):
                    reader: Any = Reader1(file) if suffix == '.bag' else Reader2(file)
                    reader.open()
                    self._readers.append((file, reader))
                    for at, chunk in reader.chunks.items() if suffix == '.bag' else ():
                        reader.chunks[at] = chunk._replace(decompressor=unpack_ros1_chunk)
                    if reader.message_count:
                        spans.append((int(reader.start_time), int(reader.end_time) - 1))
                for connection in reader.connections:
                    # A database holds whatever it was given, in any column.
                    if not all(isinstance(c, str) for c in (connection.topic, connection.msgtype)):
                        raise RecordingError('a topic has no name or no type', file)
                    channels.append((connection.topic, connection.msgtype, connection.msgcount))
                    if connection.msgdef.data and suffix != '.bag':
                        definitions[connection.msgtype] = (
                            f'ros2{connection.msgdef.format.name.lower()}',
                            connection.msgdef.data,
                        )
        except BaseException:
            self.close()
            raise
        self.definitions: Mapping[str, tuple[str, str]] = definitions
        self.info = RecordingInfo(
            files[0],
            {'.bag': 'ros1', '.mcap': 'mcap'}.get(suffix, 'sqlite3'),
            count_topics(channels),
            min((start for start, _ in spans), default=0),
            max((end for _, end in spans), default=0),
            note,
            dict(metadata or {}),
        )

    def blocks(
        self, selection: Mapping[Role, str], names: Collection[str], *, raw: bool
    ) -> Iterator[Block]:
        """Read the topic of each role, in reading order."""
        if not self._readers:
            raise RecordingError('the recording is closed', self._path)
        roles = {topic: role for role, topic in selection.items()}
        feeds: dict[Role, Feed] = {}
        for _, reader in self._readers:
            for found in reader.connections:
                if found.topic in roles:
                    feed = Feed(found.topic, found.msgtype, self._encoding)
                    feeds.setdefault(roles[found.topic], feed)
        numbers = {feed.topic: number for number, feed in enumerate(feeds.values())}
        decoder = Decoder(feeds, dict(enumerate(feeds)), names, raw)
        for file, _ in self._readers:
            with _translated(file):
                for batch in self._batches(file, numbers):
                    yield from decoder.blocks(batch)

    def _batches(self, file: Path, numbers: Mapping[str, int]) -> Iterator[Messages]:
        """Collect messages to be decoded together; their channel is the number of the topic."""
        found: list[tuple[int, int]] = []
        pieces: list[bytes] = []
        n_bytes = 0
        for topic, _, log_ns, data in self._messages(file, numbers):
            found.append((numbers[topic], log_ns))
            pieces.append(data)
            n_bytes += len(data)
            if len(pieces) >= _BATCH_MESSAGES or n_bytes >= _BATCH_BYTES:
                yield _messages_of(found, pieces)
                found, pieces, n_bytes = [], [], 0
        if pieces:
            yield _messages_of(found, pieces)

    def _messages(
        self, file: Path, topics: Collection[str]
    ) -> Iterator[tuple[str, str, int, bytes]]:
        """Topic, type, log time and bytes of the messages of topics, one by one."""
        reader = dict(self._readers)[file]
        chosen = [one for one in reader.connections if one.topic in topics]
        for one, log_ns, data in reader.messages(connections=chosen) if chosen else ():
            yield one.topic, one.msgtype, log_ns, unpack_message(data) if self._is_packed else data

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """Read topics as they are; not those of a ROS 1 bag, whose messages are no CDR."""
        if self._encoding != 'cdr':
            raise RecordingError('its messages are those of ROS 1: convert the bag', self._path)
        for file, _ in self._readers:
            with _translated(file):
                for topic, kind, log_ns, data in self._messages(file, topics):
                    times, ends = (np.array([n], np.int64) for n in (log_ns, len(data)))
                    yield RawMessages(topic, kind, times, np.frombuffer(data, np.uint8), ends)

    def close(self) -> None:
        """Close the files."""
        while self._readers:
            self._readers.pop()[1].close()


def _messages_of(found: list[tuple[int, int]], pieces: list[bytes]) -> Messages:
    size = np.fromiter(map(len, pieces), np.int64, len(pieces))
    channel, log_ns = np.array(found, np.int64).T
    data = np.frombuffer(b''.join(pieces), np.uint8)
    return Messages(data, np.cumsum(size) - size, size, channel.astype(np.uint16), log_ns)


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn whatever a damaged bag makes `rosbags` raise into one line."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(error.message, path, error.topic) from error
    except Exception as error:  # a damaged bag surfaces there as nearly any exception type
        text = ' '.join(str(error).split()) or type(error).__name__
        raise RecordingError(f'the bag cannot be read: {text}', path) from error
