# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns every storage that is not plain MCAP: sqlite3, ROS 1 and packed messages, through rosbags.

`rosbags` finds the messages, file by file; their bytes are laid side by side and decoded many at a
time. What it raises on a damaged bag is translated here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from .assemble import Part
from .columns import RawMessages, Role
from .decode import Decoder, Feed
from .unpack import unpack_message
from .wire import Encoding

_BATCH_MESSAGES = 1 << 14
_BATCH_BYTES = 1 << 23


class ForeignSource:
    """
    Files that `rosbags` reads, one after the other.

    Parameters
    ----------
    files : sequence of Path
        ``.db3``, ``.mcap`` or one ROS 1 ``.bag``.
    metadata : mapping of str to str, optional
        Key-value pairs that stand beside the files.
    note : str or None, optional
        What is missing beside them.
    is_packed : bool, optional
        Whether rosbag2 has compressed message by message.

    Raises
    ------
    RecordingError
        Whatever `rosbags` cannot open.

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
        self.storage: str = {'.bag': 'ros1', '.mcap': 'mcap'}.get(suffix, 'sqlite3')
        self.metadata: Mapping[str, str] = dict(metadata or {})
        self.truncated = note
        self._path = files[0]
        self._is_packed = is_packed
        self._readers: list[tuple[Path, Any]] = []
        types: dict[str, list[str]] = {}
        counts: Counter[str] = Counter()
        definitions: dict[str, tuple[str, str]] = {}
        spans: list[tuple[int, int]] = []
        try:
            for file in files:
                with _translated(file):
                    reader: Any = Reader1(file) if suffix == '.bag' else Reader2(file)
                    reader.open()
                    self._readers.append((file, reader))
                    if reader.message_count:
                        spans.append((int(reader.start_time), int(reader.end_time) - 1))
                for connection in reader.connections:
                    # A database holds whatever it was given, in any column.
                    if not all(isinstance(c, str) for c in (connection.topic, connection.msgtype)):
                        raise RecordingError('a topic has no name or no type', file)
                    counts[connection.topic] += connection.msgcount
                    known = types.setdefault(connection.topic, [])
                    if connection.msgtype not in known:
                        known.append(connection.msgtype)
                    if connection.msgdef.data and suffix != '.bag':
                        definitions[connection.msgtype] = (
                            f'ros2{connection.msgdef.format.name.lower()}',
                            connection.msgdef.data,
                        )
        except BaseException:
            self.close()
            raise
        self.topics: Mapping[str, tuple[str, int]] = {
            topic: (' | '.join(known), counts[topic]) for topic, known in types.items()
        }
        self.definitions: Mapping[str, tuple[str, str]] = definitions
        self.start_ns = min((start for start, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)

    def parts(self, selection: dict[Role, str], *, raw: bool) -> Iterator[Part]:
        """
        Read the chosen topics.

        Parameters
        ----------
        selection : dict of role to str
            Topic per role.
        raw : bool
            Keep the serialized messages too.

        Raises
        ------
        RecordingError
            Damaged storage or messages.

        """
        if not self._readers:
            raise RecordingError('the recording is closed', self._path)
        roles = {topic: role for role, topic in selection.items()}
        feeds: dict[Role, Feed] = {}
        for _, reader in self._readers:
            for found in reader.connections:
                if found.topic in roles:
                    feed = Feed(found.topic, found.msgtype, self._encoding)
                    feeds.setdefault(roles[found.topic], feed)
        batch = _Batch(Decoder(feeds, {}, raw), feeds)
        for file, reader in self._readers:
            chosen = [c for c in reader.connections if c.topic in roles]
            if not chosen:
                continue
            with _translated(file):
                for connection, log_ns, data in reader.messages(connections=chosen):
                    message = unpack_message(data) if self._is_packed else data
                    batch.add(roles[connection.topic], log_ns, message)
                    if batch.is_full:
                        yield batch.take()
                if batch.n_messages:
                    yield batch.take()

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """
        Read topics as they are, in the order of log time.

        Raises
        ------
        RecordingError
            Damaged storage, or a ROS 1 bag, whose messages are no CDR.

        """
        if self._encoding != 'cdr':
            raise RecordingError('its messages are those of ROS 1: convert the bag', self._path)
        for file, reader in self._readers:
            chosen = [c for c in reader.connections if c.topic in topics]
            with _translated(file):
                for one, log_ns, data in reader.messages(connections=chosen) if chosen else ():
                    message = unpack_message(data) if self._is_packed else data
                    times, ends = (np.array([n], np.int64) for n in (log_ns, len(message)))
                    yield RawMessages(
                        one.topic, one.msgtype, times, np.frombuffer(message, np.uint8), ends
                    )

    def close(self) -> None:
        """Close the files."""
        while self._readers:
            self._readers.pop()[1].close()


class _Batch:
    """Messages collected one by one, to be decoded together."""

    def __init__(self, decoder: Decoder, feeds: dict[Role, Feed]) -> None:
        self._decoder = decoder
        self._feeds = feeds
        self._next_rank = 0
        self._clear()

    def _clear(self) -> None:
        self.n_messages = 0
        self._n_bytes = 0
        self._data: dict[Role, list[bytes]] = {role: [] for role in self._feeds}
        self._times: dict[Role, list[tuple[int, int]]] = {role: [] for role in self._feeds}

    @property
    def is_full(self) -> bool:
        """Whether it is time to decode."""
        return self.n_messages >= _BATCH_MESSAGES or self._n_bytes >= _BATCH_BYTES

    def add(self, role: Role, log_ns: int, data: bytes) -> None:
        """Add one message."""
        self._data[role].append(data)
        self._times[role].append((log_ns, self._next_rank))
        self._next_rank += 1
        self.n_messages += 1
        self._n_bytes += len(data)

    def take(self) -> Part:
        """Decode what is there and begin anew."""
        part: Part = {}
        for role, feed in self._feeds.items():
            if self._data[role]:
                data = np.frombuffer(b''.join(self._data[role]), np.uint8)
                size = np.fromiter(map(len, self._data[role]), np.int64, len(self._data[role]))
                log_ns, rank = np.array(self._times[role], np.int64).T
                start = np.cumsum(size) - size
                part[role] = self._decoder.rows(feed, role, data, start, size, log_ns, rank)
        self._clear()
        return part


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
