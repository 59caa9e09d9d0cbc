# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns every storage that is not plain MCAP: sqlite3, ROS 1 and compressed files, through rosbags.

`rosbags` finds the messages; their bytes are laid side by side and decoded many at a time.
What it raises on a damaged bag is translated here.

"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import RecordingError
from .assemble import Part
from .columns import RawMessages, Role
from .decode import Decoder, Feed
from .wire import Encoding

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_BATCH_MESSAGES = 1 << 14
_BATCH_BYTES = 1 << 23


class ForeignSource:
    """
    A bag that `rosbags` reads.

    Parameters
    ----------
    path : Path
        A rosbag2 directory, a bare storage file, or a ROS 1 ``.bag``.
    note : str or None, optional
        What is missing beside it.

    Raises
    ------
    RecordingError
        Whatever `rosbags` cannot open.

    """

    def __init__(self, path: Path, note: str | None = None) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        self.path = path
        self.truncated = note
        self._encoding: Encoding = 'ros1' if path.suffix == '.bag' else 'cdr'
        with _translated(path):
            self._reader: Any = Reader1(path) if self._encoding == 'ros1' else Reader2(path)
            self._reader.open()
        self._connections: list[Connection] = list(self._reader.connections)
        self.storage: str = 'ros1' if self._encoding == 'ros1' else _storage(self._reader)
        topics: dict[str, tuple[str, int]] = {}
        definitions: dict[str, tuple[str, str]] = {}
        for connection in self._connections:
            kind, count = topics.get(connection.topic, (connection.msgtype, 0))
            if connection.msgtype not in kind.split(' | '):
                kind = f'{kind} | {connection.msgtype}'
            topics[connection.topic] = (kind, count + connection.msgcount)
            if connection.msgdef.data and self._encoding == 'cdr':
                definitions[connection.msgtype] = (
                    f'ros2{connection.msgdef.format.name.lower()}',
                    connection.msgdef.data,
                )
        self.topics: Mapping[str, tuple[str, int]] = topics
        self.definitions: Mapping[str, tuple[str, str]] = definitions
        has_messages = self._reader.message_count > 0
        self.start_ns = int(self._reader.start_time) if has_messages else 0
        self.end_ns = int(self._reader.end_time) - 1 if has_messages else 0
        custom = getattr(getattr(self._reader, 'storage', None), 'metadata', None)
        self.metadata: Mapping[str, str] = {
            str(k): str(v) for k, v in (getattr(custom, 'custom', None) or {}).items()
        }

    def parts(self, selection: dict[Role, str], *, raw: bool) -> Iterator[Part]:
        """
        Read the chosen topics.

        Parameters
        ----------
        selection : dict of role to str
            Topic per role.
        raw : bool
            Keep the serialized messages too.

        Yields
        ------
        Part

        Raises
        ------
        RecordingError
            Damaged storage or messages.

        """
        if self._reader is None:
            raise RecordingError('the recording is closed', self.path)
        roles = {topic: role for role, topic in selection.items()}
        chosen = [c for c in self._connections if c.topic in roles]
        if not chosen:
            return
        feeds = {roles[c.topic]: Feed(c.topic, c.msgtype, self._encoding) for c in chosen}
        batch = _Batch(Decoder(feeds, {}, raw), feeds)
        with _translated(self.path):
            for connection, log_ns, data in self._reader.messages(connections=chosen):
                batch.add(roles[connection.topic], log_ns, data)
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
            raise RecordingError('its messages are those of ROS 1: convert the bag', self.path)
        chosen = [c for c in self._connections if c.topic in topics]
        with _translated(self.path):
            for one, log_ns, data in self._reader.messages(connections=chosen) if chosen else ():
                times, ends = (np.array([number], np.int64) for number in (log_ns, len(data)))
                yield RawMessages(
                    one.topic, one.msgtype, times, np.frombuffer(data, np.uint8), ends
                )

    def close(self) -> None:
        """
        Close the files.

        """
        if self._reader is not None:
            self._reader.close()
            self._reader = None


class _Batch:
    """
    Messages collected one by one, to be decoded together.

    """

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
        """
        Whether it is time to decode.

        """
        return self.n_messages >= _BATCH_MESSAGES or self._n_bytes >= _BATCH_BYTES

    def add(self, role: Role, log_ns: int, data: bytes) -> None:
        """
        Add one message.

        """
        self._data[role].append(data)
        self._times[role].append((log_ns, self._next_rank))
        self._next_rank += 1
        self.n_messages += 1
        self._n_bytes += len(data)

    def take(self) -> Part:
        """
        Decode what is there and begin anew.

        """
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


def _storage(reader: Any) -> str:
    name = type(
        reader.storage.storages[0]
        if hasattr(reader.storage, 'storages') and reader.storage.storages
        else reader.storage
    ).__name__
    return 'mcap' if name.startswith('Mcap') else 'sqlite3'


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """
    Turn whatever a damaged bag makes `rosbags` raise into one line.

    """
    try:
        yield
    except RecordingError as error:
        raise RecordingError(error.message, path, error.topic) from error
    except Exception as error:  # a damaged bag surfaces there as nearly any exception type
        text = ' '.join(str(error).split()) or type(error).__name__
        raise RecordingError(f'the bag cannot be read: {text}', path) from error
