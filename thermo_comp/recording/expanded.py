# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags whose files rosbag2 has compressed as a whole: expanded beside, then read as any other.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..errors import RecordingError
from .columns import Block, RawMessages, Role
from .mcap_file import translated
from .unpack import expand

if TYPE_CHECKING:
    from .reader import Source


class ExpandedSource:
    """
    A bag of ``.zstd`` files, in the order in which they follow each other.

    `open_files` opens the expanded ones, given what is missing of them. Raises RecordingError for
    a file that holds more than it may, and what `open_files` raises.
    """

    def __init__(
        self, files: Sequence[Path], open_files: Callable[[Sequence[Path], str | None], Source]
    ) -> None:
        self._files = {file.stem: file for file in files}
        self._folder = TemporaryDirectory(prefix='thermo_comp-')
        notes = []
        expanded = []
        try:
            with self._named():
                for name, file in self._files.items():
                    expanded.append(Path(self._folder.name, name))
                    with translated(file):
                        notes.append(expand(file, expanded[-1]))
                self._source = open_files(expanded, '; '.join(filter(None, notes)) or None)
        except BaseException:
            self._folder.cleanup()
            raise
        self.info, self.definitions = self._source.info, self._source.definitions

    def blocks(
        self, selection: Mapping[Role, str], names: Collection[str], *, raw: bool
    ) -> Iterator[Block]:
        """Read the topic of each role, in reading order."""
        with self._named():
            yield from self._source.blocks(selection, names, raw=raw)

    def raw(self, topics: Collection[str]) -> Iterator[RawMessages]:
        """Read topics as they are, about in order of log time."""
        with self._named():
            yield from self._source.raw(topics)

    def close(self) -> None:
        """Close the files and remove what was expanded."""
        self._source.close()
        self._folder.cleanup()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the file that the user has, not the expanded one."""
        try:
            yield
        except RecordingError as error:
            path = None if error.path is None else Path(error.path)
            if path is None or str(path.parent) != self._folder.name:
                raise
            raise RecordingError(error.message, self._files[path.name], error.topic) from error
