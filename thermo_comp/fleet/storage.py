# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns where a fleet's bags lie: any file system that fsspec knows, read by ranges and hashed.

A bag is never copied: the reader asks for stretches of a file, and what passes by is hashed, so
that each byte crosses the network once.
"""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import FleetError
from ..recording import LocalFile, RandomAccess

# Heads of records are read singly; from afar a block of the file comes with the first of them.
_BLOCK_BYTES = 1 << 18
_N_BLOCKS = 8
# Stretches that were read before their turn wait so long to be hashed; the rest is read anew.
_MAX_WAITING = 1 << 26
# What a file system may say of a file that changes with its content, the surest first.
_STAMPS = (
    'ETag',
    'etag',
    'md5Hash',
    'content_md5',
    'generation',
    'version_id',
    'mtime',
    'LastModified',
    'last_modified',
    'updated',
    'created',
)


@dataclass(frozen=True)
class StoredFile:
    """
    One file, as its listing describes it.

    Parameters
    ----------
    name : str
        Its place below the root, with slashes.
    size : int
        Bytes.
    stamp : str
        What changes with its content: an ETag, or the time of the last change.

    """

    name: str
    size: int
    stamp: str


class Storage:
    """
    A folder on some file system.

    Parameters
    ----------
    url : str
        A path of this machine, or a URL such as ``s3://bucket/bags``.

    Raises
    ------
    FleetError
        If no library knows the protocol.

    """

    def __init__(self, url: str) -> None:
        import fsspec

        self.url = url
        try:
            self._fs, self._root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise FleetError(f'{url}: {" ".join(str(error).split())}') from error
        self.is_local = 'file' in self._fs.protocol

    @property
    def name(self) -> str:
        """The folder's own name."""
        return str(self._root).rstrip('/').rpartition('/')[2]

    @property
    def address(self) -> str:
        """Return what another process must be told to find the folder, wherever it was started."""
        return str(self._root) if self.is_local else self.url

    def local_path(self, name: str) -> Path:
        """Return the path of a file of this machine."""
        return Path(self._root) / name

    def files(self) -> list[StoredFile]:
        """
        List all files below the folder, sorted by name.

        Returns
        -------
        list of StoredFile
            Hidden files and folders are left out.

        Raises
        ------
        FleetError
            If the folder cannot be listed.

        """
        try:
            found = list(self._walk() if self.is_local else self._find())
        except Exception as error:  # each file system has exceptions of its own
            raise FleetError(f'{self.url}: cannot be listed: {_words(error)}') from error
        return sorted(
            (one for one in found if not any(p.startswith('.') for p in one.name.split('/'))),
            key=lambda one: one.name,
        )

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
        root = str(self._root).rstrip('/') + '/'
        for path, facts in listing.items():
            if facts.get('type') == 'file' and path.startswith(root):
                stamp = next((str(facts[key]) for key in _STAMPS if facts.get(key)), '')
                yield StoredFile(path[len(root) :], int(facts.get('size') or 0), stamp)

    def open(self, name: str) -> RandomAccess:
        """
        Open a file for reading at places.

        Raises
        ------
        OSError
            If it cannot be opened.

        """
        if self.is_local:
            return LocalFile(self.local_path(name))
        return RangeFile(self._fs, f'{str(self._root).rstrip("/")}/{name}')


class RangeFile:
    """
    A file elsewhere, read stretch by stretch.

    Parameters
    ----------
    fs : fsspec.AbstractFileSystem
        The file system.
    path : str
        The file on it.

    Raises
    ------
    OSError
        If it is not there.

    """

    def __init__(self, fs: Any, path: str) -> None:
        self._fs, self._path = fs, path
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        with _as_os_error():
            self.size = int(fs.size(path) or 0)

    def read_at(self, at: int, n_bytes: int) -> bytes:
        """Read up to so many bytes."""
        end = min(at + n_bytes, self.size)
        if end <= at:
            return b''
        if end - at >= _BLOCK_BYTES:
            return self._fetch(at, end)
        first, last = at // _BLOCK_BYTES, (end - 1) // _BLOCK_BYTES
        blocks = b''.join(self._block(number) for number in range(first, last + 1))
        return blocks[at - first * _BLOCK_BYTES : end - first * _BLOCK_BYTES]

    def _block(self, number: int) -> bytes:
        with self._lock:
            if number in self._blocks:
                self._blocks.move_to_end(number)
            else:
                begin = number * _BLOCK_BYTES
                block = self._fetch(begin, min(begin + _BLOCK_BYTES, self.size))
                self._blocks[number] = block
                if len(self._blocks) > _N_BLOCKS:
                    self._blocks.popitem(last=False)
            return self._blocks[number]

    def _fetch(self, begin: int, end: int) -> bytes:
        with _as_os_error():
            data: bytes = self._fs.cat_file(self._path, start=begin, end=end)
        if len(data) != end - begin:
            raise OSError(errno.EIO, f'{end - begin} bytes were asked for, {len(data)} came')
        return data

    def close(self) -> None:
        """Forget the blocks."""
        self._blocks.clear()


class HashingFile:
    """An open file that hashes what is read of it, in whatever order that is."""

    def __init__(self, inner: RandomAccess) -> None:
        self._inner = inner
        self._hash = hashlib.sha256()
        self._at = 0
        self._waiting: dict[int, bytes] = {}
        self._n_waiting = 0
        self._lock = threading.Lock()
        self.size = inner.size

    def read_at(self, at: int, n_bytes: int) -> bytes:
        """Read up to so many bytes."""
        data = self._inner.read_at(at, n_bytes)
        with self._lock:
            self._take(at, data)
        return data

    def _take(self, at: int, data: bytes) -> None:
        if at > self._at:
            if len(data) > len(self._waiting.get(at, b'')) and (
                self._n_waiting + len(data) <= _MAX_WAITING
            ):
                self._n_waiting += len(data) - len(self._waiting.get(at, b''))
                self._waiting[at] = data
            return
        while data:
            if at + len(data) > self._at:
                self._hash.update(memoryview(data)[self._at - at :])
                self._at = at + len(data)
            due = [begin for begin in self._waiting if begin <= self._at]
            if not due:
                return
            at = due[0]
            data = self._waiting.pop(at)
            self._n_waiting -= len(data)

    def digest(self) -> str:
        """Read what was not read yet, and return the SHA-256 of the whole file."""
        with self._lock:
            while self._at < self.size:
                data = self._inner.read_at(self._at, _BLOCK_BYTES)
                if not data:
                    break
                self._take(self._at, data)
            return self._hash.hexdigest()

    def close(self) -> None:
        """Leave the file open: its owner closes it after asking for the digest."""


def digest_of(storage: Storage, names: list[str]) -> str:
    """
    Return the SHA-256 of several files one after the other, as `fit_sources.digest` does.

    Raises
    ------
    OSError
        If one cannot be read.

    """
    total = hashlib.sha256()
    for name in sorted(names):
        file = storage.open(name)
        try:
            for at in range(0, file.size, 1 << 20):
                total.update(file.read_at(at, 1 << 20))
        finally:
            file.close()
    return total.hexdigest()


@contextmanager
def _as_os_error() -> Iterator[None]:
    """Turn what a file system raises into what a reader of files expects."""
    try:
        yield
    except Exception as error:  # each file system has exceptions of its own
        raise OSError(errno.EIO, _words(error)) from error


def _words(error: Exception) -> str:
    """Say in one line what went wrong."""
    said = getattr(error, 'strerror', None) or ' '.join(str(error).split())
    return said or type(error).__name__


def _leads_up(folder: Path) -> bool:
    """Whether a folder is a link to one that contains the link: it would never end."""
    above = folder.parent.resolve()
    return folder.is_symlink() and folder.resolve() in (above, *above.parents)
