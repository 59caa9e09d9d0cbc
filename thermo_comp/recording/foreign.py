# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns every storage that is not plain MCAP: sqlite3, ROS 1 and packed messages, through rosbags.

`rosbags` finds the messages; they are laid side by side, to be decoded many at a time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from ..errors import RecordingError
from .chunks import inflate_message, inflate_ros1_chunk, translated
from .columns import BagFile, Done, Messages, Topic, Work

_BATCH_MESSAGES = 1 << 14
_BATCH_BYTES, _BATCH_NS = 1 << 23, 10 * 10**9


class ForeignFile(BagFile):
    """One file that `rosbags` reads; `is_packed` where each message is compressed by itself."""

    def __init__(self, path: Path, name: Path, *, is_packed: bool = False) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        super().__init__(name)
        self._is_packed = is_packed
        is_ros1 = path.suffix == '.bag'
        encoding = 'ros1' if is_ros1 else 'cdr'
        self.storage = {'.bag': 'ros1', '.mcap': 'mcap'}.get(path.suffix, 'sqlite3')
        with translated(name, is_foreign=True):
            reader: Any = Reader1(path) if is_ros1 else Reader2(path)
            self._reader = reader
            reader.open()
            for at, chunk in reader.chunks.items() if is_ros1 else ():
                reader.chunks[at] = chunk._replace(decompressor=inflate_ros1_chunk)
            if reader.message_count:
                self.start_ns = int(reader.start_time)
                self.end_ns = int(reader.end_time) - 1
            for number, one in enumerate(reader.connections):
                # A database holds whatever it was given, in any column.
                if not (isinstance(one.topic, str) and isinstance(one.msgtype, str)):
                    raise RecordingError('a topic has no name or no type')
                self.topics[number] = Topic(one.topic, one.msgtype, encoding, one.msgcount)
                if one.msgdef.data and not is_ros1:
                    kind = f'ros2{one.msgdef.format.name.lower()}'
                    self.definitions[one.msgtype] = kind, one.msgdef.data

    def read(self, channels: Collection[int], work: Work[Done]) -> Iterator[Done]:
        """Read the messages of channels in reading order, and do some work on them."""
        yield from map(work, self._messages(channels))

    def _messages(self, channels: Collection[int]) -> Iterator[Messages]:
        """Read messages of channels, the numbers of the reader's connections."""
        chosen = [self._reader.connections[number] for number in channels]
        known = {(one.topic, one.msgtype): n for n, one in zip(channels, chosen, strict=True)}
        batch: list[tuple[bytes, int, int]] = []
        n_bytes = 0
        for one, log_ns, packed in self._reader.messages(connections=chosen):
            data = inflate_message(packed) if self._is_packed else packed
            batch.append((data, known[one.topic, one.msgtype], log_ns))
            n_bytes += len(data)
            is_long = n_bytes >= _BATCH_BYTES or log_ns - batch[0][2] > _BATCH_NS
            if is_long or len(batch) >= _BATCH_MESSAGES:
                yield Messages.of(*zip(*batch, strict=True))
                batch, n_bytes = [], 0
        if batch:
            yield Messages.of(*zip(*batch, strict=True))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()
