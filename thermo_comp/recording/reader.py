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
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol

from ..errors import RecordingError
from .clock import without_jumps
from .columns import (
    ROLES,
    Block,
    Input,
    RawMessages,
    Recording,
    RecordingInfo,
    Role,
    empty_block,
    gathered,
    joined,
)
from .expanded import ExpandedSource
from .foreign import ForeignSource
from .mcap_source import McapSource
from .part import Cut
from .rosbag2_metadata import Description, read_metadata
from .topics import Topics, select_topics, shown


class Source(Protocol):
    """One opened storage; which topics of `info` are read is chosen above it."""

    info: RecordingInfo
    definitions: Mapping[str, tuple[str, str]]

    def blocks(
        self, selection: Mapping[Role, str], names: Collection[str], *, raw: bool
    ) -> Iterator[Block]:
        """Decode the topic of each role, in reading order, with these thermometers in all."""
        ...

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """Give the messages of topics as they are."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


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
        source: Source,
        topics: Topics,
        input: Input,  # noqa: A002 - the parameter's public name
        require: Collection[Role],
    ) -> None:
        selection = select_topics(path, source.info.topics, topics, input, require)
        self._source = source
        self._names = selection.thermometers
        self.topics: Mapping[Role, str] = dict(selection.topics)
        self.definitions = source.definitions
        self._cut = Cut(path, topics.part, self.topics)
        self._part = topics.part
        self.info = replace(source.info, path=path, input=selection.input, chosen=selection.chosen)

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
        source = self._source.blocks(self.topics, self._names, raw=raw)
        for block in gathered(source, n_messages):
            for role in n_read:
                n_read[role] += len(block.log_ns[role])
            if block.n_messages:
                yield block
        for role, topic in self.topics.items():
            loss = _loss(topic, n_read[role], self.info.topics[topic][1])
            if loss and loss not in (self.info.truncated or ''):
                told = '; '.join(filter(None, (self.info.truncated, loss)))
                self.info = replace(self.info, truncated=told)

    def blocks_on_one_clock(self) -> Iterator[Block]:
        """
        Read the bag for whoever walks its time: jumps of its clock are taken out, see `clock`.

        Raises RecordingError as `blocks` does, and for stamps that are no clock.
        """
        try:
            if self._part.is_whole or self._part.is_stamped:
                yield from without_jumps(self.blocks())
            else:
                yield from self._cut.blocks(without_jumps(self._blocks()))
        except RecordingError as error:
            raise RecordingError(
                error.message, error.path or self.info.path, error.topic
            ) from error

    @property
    def since_s(self) -> float:
        """Where the part that is read begins, since the bag's first sample [s]; known then."""
        return self._cut.since_s

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """
        Read topics, by the bag's own names, as they are, about in order of log time.

        Raises RecordingError for damaged data, or messages that are no CDR.
        """
        yield from self._source.raw(topics)

    def close(self) -> None:
        """Close the files."""
        self._source.close()

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
    path = Path(path)
    try:
        source = _open_source(path)
    except OSError as error:
        raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
    try:
        return RecordingReader(path, source, topics or Topics(), input, require)
    except BaseException:
        source.close()
        raise


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
        return Recording(reader.info, joined(blocks or [empty_block(ROLES[1:])]))


def inspect_recording(path: str | Path, topics: Topics | None = None) -> RecordingInfo:
    """Say what a bag holds without reading its messages; raises as `open_recording` does."""
    with open_recording(path, topics, require=()) as reader:
        return reader.info


def _open_source(path: Path) -> Source:
    if not path.exists():
        raise RecordingError('no such file or directory', path)
    if path.is_dir():
        return _open_directory(path)
    if not path.is_file():
        raise RecordingError('not a bag: neither a file nor a directory', path)
    if path.suffix == '.mcap':
        return McapSource([path])
    if path.suffix in {'.db3', '.bag'}:
        return ForeignSource([path])
    raise RecordingError('not a bag: expected a directory, .mcap, .db3 or .bag', path)


def _open_directory(path: Path) -> Source:
    description = read_metadata(path)
    if description is not None:
        if description.compression == 'file':
            return ExpandedSource(description.files, partial(_open_files, description))
        return _open_files(description, description.files, None)
    for suffix in ('.mcap', '.db3'):
        files = in_split_order(
            file for file in path.iterdir() if file.suffix == suffix and file.is_file()
        )
        if files:
            note = 'metadata.yaml is missing, the recording was not finished'
            return (McapSource if suffix == '.mcap' else ForeignSource)(files, note=note)
    raise RecordingError('not a bag: the directory has no metadata.yaml', path)


def _open_files(description: Description, files: Sequence[Path], note: str | None) -> Source:
    """Open the files that a metadata.yaml lists, and hold them against what it promises."""
    is_packed = description.compression == 'message'
    source: Source
    if description.storage == 'mcap' and not is_packed:
        source = McapSource(files, description.custom, note)
    else:
        source = ForeignSource(files, description.custom, note, is_packed=is_packed)
    losses = (
        _loss(topic, source.info.topics.get(topic, ('', 0))[1], n_promised)
        for topic, n_promised in description.counts.items()
    )
    told = '; '.join(filter(None, (source.info.truncated, *losses))) or None
    source.info = replace(source.info, truncated=told)
    return source


def _loss(topic: str, n_read: int, n_promised: int) -> str | None:
    if n_read >= n_promised:
        return None
    return f'{shown(topic)}: {n_read} of the {n_promised} messages promised are there'


def in_split_order(files: Iterable[Path]) -> list[Path]:
    """Sort the files of a split bag by the number at the end of their names."""

    def number(file: Path) -> tuple[int, str]:
        digits = file.stem.rpartition('_')[2]
        return (int(digits) if digits.isascii() and digits.isdigit() else 0, file.name)

    return sorted(files, key=number)
