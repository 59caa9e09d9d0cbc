# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the door to recordings: open a bag of any storage, say what it holds, read it as columns.

Reading order
    The order of a ROS player: log time, and for equal log times the place in the file. The split
    files of one bag follow each other as its metadata.yaml lists them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

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
from .part import Cut
from .storage import Bag, loss, open_bag
from .topics import Topics, select_topics


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
        bag: Bag,
        topics: Topics,
        input: Input,  # noqa: A002 - the parameter's public name
        require: Collection[Role],
    ) -> None:
        selection = select_topics(path, bag.info.topics, topics, input, require)
        self._bag = bag
        self._names = selection.thermometers
        self.topics: Mapping[Role, str] = dict(selection.topics)
        self.definitions = bag.definitions
        self._cut = Cut(path, topics.part, self.topics)
        self._part = topics.part
        self.info = replace(bag.info, input=selection.input, chosen=selection.chosen)

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
        source = self._bag.blocks(self.topics, self._names, raw=raw)
        for block in gathered(source, n_messages):
            for role in n_read:
                n_read[role] += len(block.log_ns[role])
            if block.n_messages:
                yield block
        for role, topic in self.topics.items():
            missing = loss(topic, n_read[role], self.info.topics[topic][1])
            if missing and missing not in (self.info.truncated or ''):
                told = '; '.join(filter(None, (self.info.truncated, missing)))
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
        yield from self._bag.raw(topics)

    def close(self) -> None:
        """Close the files."""
        self._bag.close()

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
        bag = open_bag(path)
    except OSError as error:
        raise RecordingError(f'cannot be opened: {error.strerror}', path) from error
    try:
        return RecordingReader(path, bag, topics or Topics(), input, require)
    except BaseException:
        bag.close()
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
