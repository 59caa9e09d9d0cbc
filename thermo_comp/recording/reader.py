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
from types import TracebackType
from typing import Protocol

from ..errors import RecordingError
from .assemble import Part, assemble, join_blocks
from .clock import without_jumps
from .columns import ROLES, Block, Input, RawMessages, Recording, RecordingInfo, Role, Topics
from .expanded import ExpandedSource
from .foreign import ForeignSource
from .mcap_source import McapSource
from .random_access import OpenFile
from .rosbag2_metadata import Description, read_metadata
from .topics import select_topics, shown


class Source(Protocol):
    """One opened storage."""

    storage: str
    topics: Mapping[str, tuple[str, int]]
    definitions: Mapping[str, tuple[str, str]]
    start_ns: int
    end_ns: int
    truncated: str | None
    metadata: Mapping[str, str]

    def parts(self, selection: dict[Role, str], *, raw: bool) -> Iterator[Part]:
        """Decode the messages of the chosen topics, in reading order."""
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

    Attributes
    ----------
    info : RecordingInfo
        What the bag says of itself; once all blocks are read, `truncated` names what did not come.
    definitions : mapping of str to (str, str)
        Encoding and text of each message type's definition, where the bag carries it.

    """

    def __init__(
        self,
        path: Path,
        source: Source,
        topics: Topics,
        input: Input,  # noqa: A002 - the parameter's public name
        require: Collection[Role],
    ) -> None:
        selection = select_topics(path, source.topics, topics, input, require)
        self._source = source
        self._selection = dict(selection.topics)
        self.definitions = source.definitions
        self.info = RecordingInfo(
            path=path,
            storage=source.storage,
            topics=dict(source.topics),
            start_ns=source.start_ns,
            end_ns=source.end_ns,
            truncated=source.truncated,
            metadata=dict(source.metadata),
            input=selection.input,
        )

    @property
    def topics(self) -> Mapping[Role, str]:
        """The bag's own name of each topic that is read."""
        return dict(self._selection)

    def blocks(self, *, raw: bool = False, n_messages: int = 0) -> Iterator[Block]:
        """
        Read the bag from its beginning in bounded memory.

        Parameters
        ----------
        raw : bool, optional
            Keep the serialized messages in `Block.raw`.
        n_messages : int, optional
            About how many messages make a block; 0 = as few as are read at good speed.

        Yields
        ------
        Block
            In reading order; of limited size.

        Raises
        ------
        RecordingError
            Damaged data.

        """
        names = {role: (name, self.info.topics[name][0]) for role, name in self._selection.items()}
        parts = self._source.parts(self._selection, raw=raw)
        is_imu = self.info.input == 'imu'
        n_read = dict.fromkeys(names, 0)
        for block in assemble(parts, is_imu=is_imu, names=names, n_messages=n_messages):
            for role in names:
                n_read[role] += len(getattr(block, f'{role}_stamp_ns'))
            yield block
        for role, (name, _) in names.items():
            self._miss(name, n_read[role], self.info.topics[name][1])

    def blocks_on_one_clock(self) -> Iterator[Block]:
        """
        Read the bag for whoever walks its time: jumps of its clock are taken out.

        Yields
        ------
        Block
            As `blocks` gives them; see `clock` for the stamps behind a jump.

        Raises
        ------
        RecordingError
            As for `blocks`, and stamps that are no clock.

        """
        try:
            yield from without_jumps(self.blocks())
        except RecordingError as error:
            raise RecordingError(
                error.message, error.path or self.info.path, error.topic
            ) from error

    def _miss(self, topic: str, n_read: int, n_promised: int) -> None:
        """Say so where fewer messages came than the bag had promised."""
        loss = _loss(topic, n_read, n_promised)
        if loss and loss not in (self.info.truncated or ''):
            told = '; '.join(filter(None, (self.info.truncated, loss)))
            self.info = replace(self.info, truncated=told)

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """
        Read topics as they are, a stretch of one topic at a time, about in order of log time.

        Parameters
        ----------
        topics : collection of str
            The bag's own names.

        Yields
        ------
        RawMessages
            Of limited size.

        Raises
        ------
        RecordingError
            Damaged data, or messages that are no CDR.

        """
        yield from self._source.raw(topics)

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def __enter__(self) -> RecordingReader:
        """Give the open reader."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
    Open a bag for reading block by block.

    Parameters
    ----------
    path : str or Path
        A rosbag2 directory, a bare ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.
    topics : Topics, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        Which accelerometer topic is read; ``auto`` prefers the counts.
    require : collection of {'accel', 'board', 'case'}, optional
        Roles whose absence is an error; the others' columns are just empty.

    Raises
    ------
    RecordingError
        Missing file, not a bag, empty bag, missing or ambiguous topic, wrong message type,
        damaged file.

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


def open_mcap(
    files: Sequence[Path],
    open_file: OpenFile,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    require: Collection[Role] = ROLES,
) -> RecordingReader:
    """
    Open the MCAP files of one bag that lie where only the caller can read.

    Parameters
    ----------
    files : sequence of Path
        Their names, in the order in which they follow each other.
    open_file : callable
        Opens one of them for reading at places; `OSError` where it cannot.
    topics, input, require
        As for `open_recording`.

    Returns
    -------
    RecordingReader
        Whose path is that of the first file.

    Raises
    ------
    RecordingError
        As for `open_recording`.

    """
    source = McapSource(files, open_file=open_file)
    try:
        return RecordingReader(files[0], source, topics or Topics(), input, require)
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
    """
    Read a whole bag into memory.

    Parameters
    ----------
    path, topics, input, require
        As for `open_recording`.

    Raises
    ------
    RecordingError
        As for `open_recording`, and damaged data.

    """
    with open_recording(path, topics, input, require=require) as reader:
        columns = join_blocks(reader.blocks(), reader.info.input == 'imu')
        return Recording(reader.info, columns)


def inspect_recording(path: str | Path, topics: Topics | None = None) -> RecordingInfo:
    """
    Say what a bag holds without reading its messages.

    Parameters
    ----------
    path : str or Path
        The bag.
    topics : Topics, optional
        Names of the inputs, to tell `RecordingInfo.input`.

    Raises
    ------
    RecordingError
        Missing file, not a bag, damaged file.

    """
    path = Path(path)
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
        return _open_described(description)
    for suffix in ('.mcap', '.db3'):
        files = in_split_order(
            file for file in path.iterdir() if file.suffix == suffix and file.is_file()
        )
        if files:
            note = 'metadata.yaml is missing, the recording was not finished'
            return (McapSource if suffix == '.mcap' else ForeignSource)(files, note=note)
    raise RecordingError('not a bag: the directory has no metadata.yaml', path)


def _open_described(description: Description) -> Source:
    """Open the files that a metadata.yaml lists, and hold them against what it promises."""
    if description.compression == 'file':
        return ExpandedSource(description.files, partial(_open_files, description))
    return _open_files(description, description.files, None)


def _open_files(description: Description, files: Sequence[Path], note: str | None) -> Source:
    is_packed = description.compression == 'message'
    source: Source
    if description.storage == 'mcap' and not is_packed:
        source = McapSource(files, description.custom, note)
    else:
        source = ForeignSource(files, description.custom, note, is_packed=is_packed)
    losses = (
        _loss(topic, source.topics.get(topic, ('', 0))[1], n_promised)
        for topic, n_promised in description.counts.items()
    )
    source.truncated = '; '.join(filter(None, (source.truncated, *losses))) or None
    return source


def _loss(topic: str, n_read: int, n_promised: int) -> str | None:
    if n_read >= n_promised:
        return None
    return f'{shown(topic)}: {n_read} of the {n_promised} messages promised are there'


def in_split_order(files: Iterable[Path]) -> list[Path]:
    """Sort the files of a split bag by the number at the end of their names."""
    return sorted(files, key=_number)


def _number(file: Path) -> tuple[int, str]:
    """Sort key of the files of a split bag: the number at the end of the name."""
    digits = file.stem.rpartition('_')[2]
    return (int(digits) if digits.isascii() and digits.isdigit() else 0, file.name)
