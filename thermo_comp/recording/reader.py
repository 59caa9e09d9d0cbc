# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the door to recordings: open a bag of any storage, say what it holds, read it as columns.

Reading order
    The order of a ROS player: log time, and for equal log times the place in the file. The split
    files of one bag follow each other as its metadata.yaml lists them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import RecordingError
from .clock import Cut, without_jumps
from .columns import (
    ROLES,
    Block,
    Input,
    Recording,
    RecordingInfo,
    Role,
    count_topics,
    gathered,
    joined,
)
from .foreign import ForeignFile
from .mcap_file import McapFile
from .messages import BagFile, Messages, Topic
from .rosbag2_metadata import Description, read_metadata
from .topics import Topics, select_topics, shown
from .unpack import expand, translated
from .wire import decode_blocks

_N_LOADERS = 2


class RecordingReader:
    """
    An open bag; use it as a context manager.

    `info` is what the bag says of itself; once all blocks are read, its `truncated` names what did
    not come. `topics` are the bag's own names of each role's, `definitions` encoding and text of
    each message type's, where the bag carries it.
    """

    def __init__(
        self,
        path: Path,
        topics: Topics,
        input: Input,  # noqa: A002 - the parameter's public name
        require: Collection[Role],
    ) -> None:
        self._stack = ExitStack()
        self._files: list[BagFile] = []
        try:
            self.info = self._open(path)
            self.definitions = {k: d for one in self._files for k, d in one.definitions.items()}
            with translated(path):
                selection = select_topics(self.info.topics, topics, input, require)
        except OSError as error:
            self.close()
            raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
        except BaseException:
            self.close()
            raise
        self._names = selection.thermometers
        self.topics: Mapping[Role, str] = dict(selection.topics)
        self._part = topics.part
        self._cut = Cut(path, topics.part)
        self.info = replace(self.info, input=selection.input, chosen=selection.chosen)

    def _open(self, path: Path) -> RecordingInfo:
        """Open the files; those that rosbag2 has compressed as a whole are expanded beside."""
        found, note = _described(path)
        folder = ''
        if found.compression == 'file':
            folder = self._stack.enter_context(TemporaryDirectory(prefix='thermo_comp-'))
        self._stack.callback(self._close_files)
        # Ends before the files that its threads read.
        pool = ThreadPoolExecutor(_N_LOADERS, 'recording')
        self._stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        notes = [note]
        for name in found.files:
            file = name
            if folder:
                file = Path(folder, name.stem)
                with translated(name):
                    notes.append(expand(name, file))
            is_packed = found.compression == 'message'
            if found.storage == 'mcap' and not is_packed:
                self._files.append(McapFile(file, name, pool))
            else:
                self._files.append(ForeignFile(file, name, is_packed=is_packed))
        for one in self._files:
            if one.truncated is not None:
                front = f'{one.path.name}: ' if len(self._files) > 1 else ''
                notes.append(front + one.truncated)
        topics = count_topics(topic for one in self._files for topic in one.topics.values())
        for topic, n_promised in found.counts.items():
            notes.append(_loss(topic, topics.get(topic, ('', 0))[1], n_promised))
        metadata = dict(found.custom)
        for one in self._files:
            metadata |= one.metadata
        return RecordingInfo(
            path,
            self._files[0].storage,
            topics,
            min((f.start_ns for f in self._files if f.start_ns is not None), default=0),
            max((f.end_ns for f in self._files if f.end_ns is not None), default=0),
            '; '.join(filter(None, notes)) or None,
            metadata,
        )

    def blocks(self, *, raw: bool = False, n_messages: int = 0) -> Iterator[Block]:
        """
        Read the bag from its beginning in bounded memory, RecordingError for damaged data.

        `raw` keeps the serialized messages in `Block.raw`; `n_messages` is about how many make a
        block, 0 for as few as are read at good speed.
        """
        blocks = self._blocks(raw, n_messages)
        yield from blocks if self._part.is_whole else self._cut.blocks(blocks)

    def _blocks(self, raw: bool = False, n_messages: int = 0) -> Iterator[Block]:
        n_read = dict.fromkeys(self.topics, 0)
        for block in gathered(self._decoded(raw), n_messages):
            for role in n_read:
                n_read[role] += len(block.log_ns[role])
            if block.n_messages:
                yield block
        for role, topic in self.topics.items():
            loss = _loss(topic, n_read[role], self.info.topics[topic][1])
            if loss and loss not in (self.info.truncated or ''):
                told = '; '.join(filter(None, (self.info.truncated, loss)))
                self.info = replace(self.info, truncated=told)

    def _decoded(self, raw: bool) -> Iterator[Block]:
        """Decode the topic of each role, in reading order."""
        roles = {topic: role for role, topic in self.topics.items()}
        for file in self._opened():
            feeds: dict[int, tuple[Role, Topic]] = {}
            for number, topic in file.topics.items():
                if topic.name in roles:
                    if topic.encoding not in {'cdr', 'ros1'}:
                        raise _no_cdr(topic, file)
                    feeds[number] = roles[topic.name], topic
            for role, topic in feeds.values():
                if topic[:3] != dict(feeds.values())[role][:3]:
                    reason = 'its messages have several encodings'
                    raise RecordingError(reason, file.path, shown(topic.name))
            if feeds:
                work = partial(decode_blocks, feeds=feeds, names=self._names, keep_raw=raw)
                with translated(file.path, is_foreign=isinstance(file, ForeignFile)):
                    for blocks in file.read(feeds, work):
                        yield from blocks

    def blocks_on_one_clock(self) -> Iterator[Block]:
        """Read the bag for whoever walks its time: without the jumps of its clock."""
        try:
            if self._part.is_whole or self._part.is_stamped:
                yield from without_jumps(self.blocks())
            else:
                yield from self._cut.blocks(without_jumps(self._blocks()))
        except RecordingError as error:
            raise RecordingError(error.message, error.path or self.info.path, error.key) from error

    @property
    def since_s(self) -> float:
        """Where the part that is read begins, since the bag's first sample [s]; known then."""
        return self._cut.since_s

    def raw(self, topics: Collection[str]) -> Iterator[tuple[Topic, Messages]]:
        """Read topics, by the bag's own names, as they are, about in order of log time."""
        for file in self._opened():
            own = {n: one for n, one in file.topics.items() if one.name in topics}
            for topic in own.values():
                if topic.encoding != 'cdr':
                    raise _no_cdr(topic, file)
            with translated(file.path, is_foreign=isinstance(file, ForeignFile)):
                for found in file.read(own, partial(_raw, topics=own)) if own else ():
                    yield from found

    def close(self) -> None:
        """Close the files and remove what was expanded."""
        self._stack.close()

    def _close_files(self) -> None:
        while self._files:
            self._files.pop().close()

    def _opened(self) -> Sequence[BagFile]:
        if not self._files:
            raise RecordingError('the recording is closed', self.info.path)
        return self._files

    def __enter__(self) -> RecordingReader:
        """Give the open reader."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the files."""
        self.close()


def open_recording(
    path: str | Path,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    require: Collection[Role] = ROLES,
) -> RecordingReader:
    """
    Open a bag: a rosbag2 directory, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.

    Of the accelerometer's topics ``auto`` prefers the counts. Roles that are required are an error
    where they are absent; the others' columns are just empty. Raises RecordingError for what is no
    bag, an empty or damaged one, a missing or ambiguous topic, a wrong message type.
    """
    return RecordingReader(Path(path), topics or Topics(), input, require)


def read_recording(
    path: str | Path,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    require: Collection[Role] = ROLES,
) -> Recording:
    """Read a whole bag into memory; as `open_recording`, and RecordingError for damaged data."""
    with open_recording(path, topics, input, require=require) as reader:
        blocks = list(reader.blocks())
        nothing = Messages.of([], [], [])
        return Recording(reader.info, joined(blocks or decode_blocks(nothing, {}, ROLES[1:])))


def inspect_recording(path: str | Path, topics: Topics | None = None) -> RecordingInfo:
    """Say what a bag holds without reading its messages; raises as `open_recording` does."""
    with open_recording(path, topics, require=()) as reader:
        return reader.info


def _described(path: Path) -> tuple[Description, str | None]:
    """Find the files of a bag, and what is missing beside them; RecordingError for no bag."""
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    if path.is_dir():
        described = read_metadata(path)
        if described is not None:
            return described, None
        for suffix in ('.mcap', '.db3'):
            files = [one for one in path.iterdir() if one.suffix == suffix and one.is_file()]
            if files:
                note = 'metadata.yaml is missing, the recording was not finished'
                return Description(suffix[1:], tuple(_in_split_order(files))), note
        raise RecordingError('not a bag: the directory has no metadata.yaml', path)
    if not path.is_file():
        raise RecordingError('not a bag: neither a file nor a directory', path)
    if path.suffix not in {'.mcap', '.db3', '.bag'}:
        raise RecordingError('not a bag: expected a directory, .mcap, .db3 or .bag', path)
    return Description(path.suffix[1:], (path,)), None


def _in_split_order(files: Iterable[Path]) -> list[Path]:
    """Sort the files of a split bag by the number at the end of their names."""

    def number(file: Path) -> tuple[int, str]:
        digits = file.stem.rpartition('_')[2]
        return (int(digits) if digits.isascii() and digits.isdigit() else 0, file.name)

    return sorted(files, key=number)


def _raw(messages: Messages, topics: Mapping[int, Topic]) -> list[tuple[Topic, Messages]]:
    found = ((topic, messages.of_channels([number])) for number, topic in topics.items())
    return [(topic, one.packed()) for topic, one in found if len(one)]


def _loss(topic: str, n_read: int, n_promised: int) -> str | None:
    if n_read >= n_promised:
        return None
    return f'{shown(topic)}: {n_read} of the {n_promised} messages promised are there'


def _no_cdr(topic: Topic, file: BagFile) -> RecordingError:
    reason = f'its messages are encoded as {shown(topic.encoding)!r}, expected cdr'
    return RecordingError(reason, file.path, shown(topic.name))
