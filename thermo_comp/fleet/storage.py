# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns where a fleet's bags lie: a folder on any file system that fsspec knows."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import FleetError

# What a file system may say of a file that changes with its content, the surest first.
_STAMPS = (
    *('ETag', 'etag', 'md5Hash', 'content_md5', 'generation', 'version_id'),
    *('mtime', 'LastModified', 'last_modified', 'updated', 'created'),
)


@dataclass(frozen=True)
class StoredFile:
    """One file as its listing has it; `stamp` (ETag or time) changes with its content."""

    name: str
    size: int
    stamp: str


class Storage:
    """A folder here or at a URL like ``s3://bucket/bags``; FleetError for a strange protocol."""

    def __init__(self, url: str) -> None:
        import fsspec

        self.url = url
        try:
            self._fs, root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise FleetError(f'{url}: {" ".join(str(error).split())}') from error
        self.is_local = 'file' in self._fs.protocol
        self._root = str(root).rstrip('/') or '/'

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self._root.rpartition('/')[2]

    @property
    def address(self) -> str:
        """Return what another process must be told to find the folder, wherever it was started."""
        return self._root if self.is_local else self.url

    def files(self) -> list[StoredFile]:
        """List all files below the folder but hidden ones, sorted by name."""
        try:
            found = list(self._walk() if self.is_local else self._find())
        except Exception as error:  # each file system has exceptions of its own
            raise FleetError(f'{self.url}: cannot be listed: {_words(error)}') from error
        shown = (f for f in found if not any(p.startswith('.') for p in f.name.split('/')))
        return sorted(shown, key=lambda one: one.name)

    def _walk(self) -> Iterator[StoredFile]:
        # A local tree may be put together of links, which fsspec lists but does not follow.
        root = Path(self._root)
        if not root.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, 'no such directory')
        for folder, folders, names in os.walk(root, followlinks=True):
            if _leads_up(Path(folder)):
                folders.clear()
                continue
            for name in names:
                path = Path(folder) / name
                try:
                    status = path.stat()
                except OSError:  # a link that leads nowhere
                    continue
                stamp = str(status.st_mtime_ns)
                yield StoredFile(path.relative_to(root).as_posix(), status.st_size, stamp)

    def _find(self) -> Iterator[StoredFile]:
        listing: Mapping[str, Mapping[str, Any]] = self._fs.find(self._root, detail=True)
        if not listing and not self._fs.exists(self._root):
            raise FileNotFoundError(errno.ENOENT, 'no such directory')
        root = self._root.rstrip('/') + '/'
        for path, facts in listing.items():
            if facts.get('type') == 'file' and path.startswith(root):
                stamp = next((str(facts[key]) for key in _STAMPS if facts.get(key)), '')
                yield StoredFile(path[len(root) :], int(facts.get('size') or 0), stamp)

    @contextmanager
    def here(self, name: str, files: Sequence[StoredFile]) -> Iterator[Path]:
        """Give the path of a bag on this machine, a copy if it lies elsewhere; raises OSError."""
        if self.is_local:
            yield Path(self._root) / name
            return
        with tempfile.TemporaryDirectory(prefix='thermo_comp-') as scratch:
            for file in files:
                target = Path(scratch, file.name)
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    self._fs.get_file(f'{self._root}/{file.name}', str(target))
                except Exception as error:  # each file system has exceptions of its own
                    raise OSError(errno.EIO, _words(error)) from error
            yield Path(scratch, name)


def _words(error: Exception) -> str:
    """Say in one line what went wrong."""
    said = getattr(error, 'strerror', None) or ' '.join(str(error).split())
    return said or type(error).__name__


def _leads_up(folder: Path) -> bool:
    """Whether a folder is a link to one that contains the link: it would never end."""
    above = folder.parent.resolve()
    return folder.is_symlink() and folder.resolve() in (above, *above.parents)
