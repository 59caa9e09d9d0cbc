# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns an open bag of any storage: its files, what they say, and their messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol, TypeVar

from ..errors import RecordingError
from .columns import Block, RawMessages, RecordingInfo, Role, count_topics
from .decode import Decoder, Feed
from .foreign import ForeignFile
from .mcap_file import McapFile
from .messages import Messages, Topic, pack
from .rosbag2_metadata import Description, read_metadata
from .topics import shown
from .unpack import expand, translated

_Done = TypeVar('_Done')
_N_LOADERS = 2
_BARE = Description('', (), '', {}, {})


class BagFile(Protocol):
    """
    One open file of a bag; `path` is what errors call it.

    `topics` are by the number of their channel, `definitions` encoding and text by message type,
    `start_ns` and `end_ns` the log times of the first and the last message; `truncated` says what
    is missing.
    """

    path: Path
    storage: str
    topics: dict[int, Topic]
    definitions: dict[str, tuple[str, str]]
    metadata: dict[str, str]
    start_ns: int | None
    end_ns: int | None
    truncated: str | None

    def read(
        self, channels: Collection[int], work: Callable[[Messages], _Done]
    ) -> Iterator[_Done]:
        """Read the messages of channels in reading order, and do some work on them."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class Bag:
    """
    The files of one bag, in the order in which they follow each other, and what they say.

    Those that rosbag2 has compressed as a whole are expanded beside. `note` is what is missing
    beside the files. Raises RecordingError for what cannot be read.
    """

    def __init__(
        self,
        path: Path,
        files: Sequence[Path],
        description: Description = _BARE,
        note: str | None = None,
    ) -> None:
        self._path = path
        self._stack = ExitStack()
        self._files: list[BagFile] = []
        folder = ''
        if description.compression == 'file':
            folder = self._stack.enter_context(TemporaryDirectory(prefix='thermo_comp-'))
        self._stack.callback(self._close_files)
        # Ends before the files that its threads read.
        pool = ThreadPoolExecutor(_N_LOADERS, 'recording')
        self._stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        notes = [note]
        try:
            for name in files:
                file = name
                if folder:
                    file = Path(folder, name.stem)
                    with translated(name):
                        notes.append(expand(name, file))
                is_packed = description.compression == 'message'
                if (description.storage or file.suffix[1:]) == 'mcap' and not is_packed:
                    self._files.append(McapFile(file, name, pool))
                else:
                    self._files.append(ForeignFile(file, name, is_packed=is_packed))
        except BaseException:
            self.close()
            raise
        for one in self._files:
            if one.truncated is not None:
                front = f'{one.path.name}: ' if len(files) > 1 else ''
                notes.append(front + one.truncated)
        self.definitions = {k: text for one in self._files for k, text in one.definitions.items()}
        topics = count_topics(topic for one in self._files for topic in one.topics.values())
        for topic, n_promised in description.counts.items():
            notes.append(loss(topic, topics.get(topic, ('', 0))[1], n_promised))
        metadata = dict(description.custom)
        for one in self._files:
            metadata |= one.metadata
        self.info = RecordingInfo(
            path,
            self._files[0].storage,
            topics,
            min((f.start_ns for f in self._files if f.start_ns is not None), default=0),
            max((f.end_ns for f in self._files if f.end_ns is not None), default=0),
            '; '.join(filter(None, notes)) or None,
            metadata,
        )

    def blocks(
        self, selection: Mapping[Role, str], names: Collection[str], *, raw: bool
    ) -> Iterator[Block]:
        """Decode the topic of each role, in reading order, with these thermometers in all."""
        roles = {topic: role for role, topic in selection.items()}
        for file in self._opened():
            with translated(file.path, is_foreign=isinstance(file, ForeignFile)):
                feeds: dict[Role, Feed] = {}
                found = file.topics.items()
                channels = {n: roles[one.name] for n, one in found if one.name in roles}
                for number, role in channels.items():
                    topic = file.topics[number]
                    if topic.encoding not in {'cdr', 'ros1'}:
                        raise _no_cdr(topic)
                    feed = Feed(topic.name, topic.type, topic.encoding)
                    if feeds.setdefault(role, feed) != feed:
                        raise RecordingError(
                            'its messages have several encodings', topic=shown(topic.name)
                        )
                if channels:
                    decoder = Decoder(feeds, channels, names, raw)
                    for blocks in file.read(channels, decoder.blocks):
                        yield from blocks

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """Give the messages of topics as they are."""
        for file in self._opened():
            own = {n: one for n, one in file.topics.items() if one.name in topics}
            with translated(file.path, is_foreign=isinstance(file, ForeignFile)):
                for topic in own.values():
                    if topic.encoding != 'cdr':
                        raise _no_cdr(topic)
                for found in file.read(own, partial(_raw, own)) if own else ():
                    yield from found

    def close(self) -> None:
        """Close the files and remove what was expanded."""
        self._stack.close()

    def _close_files(self) -> None:
        while self._files:
            self._files.pop().close()

    def _opened(self) -> Sequence[BagFile]:
        if not self._files:
            raise RecordingError('the recording is closed', self._path)
        return self._files


def open_bag(path: Path) -> Bag:
    """Open a rosbag2 directory or one file; RecordingError for what is no bag."""
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    if path.is_dir():
        return _open_directory(path)
    if not path.is_file():
        raise RecordingError('not a bag: neither a file nor a directory', path)
    if path.suffix in {'.mcap', '.db3', '.bag'}:
        return Bag(path, [path])
    raise RecordingError('not a bag: expected a directory, .mcap, .db3 or .bag', path)


def _open_directory(path: Path) -> Bag:
    description = read_metadata(path)
    if description is not None:
        return Bag(path, description.files, description)
    for suffix in ('.mcap', '.db3'):
        files = in_split_order(
            file for file in path.iterdir() if file.suffix == suffix and file.is_file()
        )
        if files:
            note = 'metadata.yaml is missing, the recording was not finished'
            return Bag(path, files, note=note)
    raise RecordingError('not a bag: the directory has no metadata.yaml', path)


def in_split_order(files: Iterable[Path]) -> list[Path]:
    """Sort the files of a split bag by the number at the end of their names."""

    def number(file: Path) -> tuple[int, str]:
        digits = file.stem.rpartition('_')[2]
        return (int(digits) if digits.isascii() and digits.isdigit() else 0, file.name)

    return sorted(files, key=number)


def _raw(topics: Mapping[int, Topic], messages: Messages) -> list[RawMessages]:
    found = []
    for number, topic in topics.items():
        one = messages.of_channels([number])
        if len(one):
            packed = pack(one.data, one.start, one.size)
            found.append(RawMessages(topic.name, topic.type, one.log_ns, *packed))
    return found


def loss(topic: str, n_read: int, n_promised: int) -> str | None:
    """Say how many messages of a topic are missing, if any are."""
    if n_read >= n_promised:
        return None
    return f'{shown(topic)}: {n_read} of the {n_promised} messages promised are there'


def _no_cdr(topic: Topic) -> RecordingError:
    return RecordingError(
        f'its messages are encoded as {shown(topic.encoding)!r}, expected cdr',
        topic=shown(topic.name),
    )
