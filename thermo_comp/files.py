# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how a file is read within bounds and how an output comes to be, for all that write one.

An output never replaces what the command reads; without `overwrite` it never replaces anything,
whoever else writes at the same time; with it, only what is of the same kind. It takes its name
when it is whole. A link is written through: it goes on pointing where it did.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from .errors import OutputError

_HEAD_BYTES = 4096
_INDEX = 'metadata.yaml'


@dataclass(frozen=True)
class Kind:
    """What an output is: a file known by a pattern in its head, a folder by its files' names."""

    name: str
    mark: bytes
    is_folder: bool = False
    suffixes: tuple[str, ...] = ()  # any, if there are none

    def refusal(self, path: Path) -> str:
        """Say why what stands under a name is not of this kind; nothing where it is."""
        if path.is_dir() != self.is_folder:
            return f'it is a {"folder" if path.is_dir() else "file"}'
        if self.is_folder:
            entries = sorted(path.iterdir())
            for entry in entries:
                if not (entry.is_file() and re.search(self.mark, os.fsencode(entry.name))):
                    return f'it holds {entry.name}, which belongs to no bag'
            is_whole = not entries or (path / _INDEX).is_file()
            return '' if is_whole else f'it has no {_INDEX}'
        head = b''
        if path.is_file():
            with path.open('rb') as file:
                head = file.read(_HEAD_BYTES)
            if not head or re.search(self.mark, head):
                return ''
        return f'it is no {self.name}'


CALIBRATION = Kind('calibration', rb'(?m)^(format_version|unit)\s*:')
PAGE = Kind('HTML page', rb'(?i)\A\s*<!doctype html', suffixes=('.html', '.htm'))
PICTURE = Kind('PNG picture', rb'\A\x89PNG\r\n')
PARAMETERS = Kind('parameter file of ours', rb'\A# Thermal calibration of unit ')
RECORD = Kind('JSON record', rb'\A\{')
PARQUET = Kind('Parquet file', rb'\APAR1')
CSV = Kind('CSV table of ours', rb'\A(stamp_ns|name|section|bag),', suffixes=('.csv',))
MCAP = Kind('MCAP file', rb'\A\x89MCAP')
BAG = Kind('rosbag2 directory', rb'\A(metadata\.yaml|.+\.(mcap|db3)(\.zstd)?)\Z', is_folder=True)


def bag_kind(path: str | Path, others: str = '') -> Kind:
    """Tell by the suffix what a bag is to be; `others` is what else may be, for the message."""
    suffix = Path(path).suffix
    if suffix == '.mcap':
        return MCAP
    if suffix[1:2].isalpha():
        raise OutputError(
            f'cannot be written: {suffix} is none of *.mcap{others} and a folder', path
        )
    return BAG


def shown_name(path: str | Path) -> str:
    """Give the last part of a path as text that can be written anywhere, UTF-8 or not."""
    return os.fsencode(Path(path).name).decode('utf-8', 'replace')


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading; OSError, before a reader could block, if it is none."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, 'not a regular file', str(path))
        return os.fdopen(descriptor, 'rb')
    except BaseException:
        os.close(descriptor)
        raise


def read_bounded(path: str | Path, limit: int, within: Path | None = None) -> bytes:
    """
    Read a regular file; ValueError if it is larger than `limit` bytes, PermissionError if what was
    opened lies outside of the folder `within`, OSError as above.
    """
    with open_regular(path) as file:
        # Asked of the file itself: links may be exchanged between a look and the opening.
        if within is not None and not _opened(file).is_relative_to(within):
            raise PermissionError(errno.EPERM, 'outside of its folder', str(path))
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise ValueError(f'{size} bytes, at most {limit} are accepted')
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f'more than {limit} bytes')
    return content


def _opened(file: BinaryIO) -> Path:
    return Path(f'/proc/self/fd/{file.fileno()}').readlink()


def check_output(
    path: str | Path, kind: Kind, *, overwrite: bool = False, others: Iterable[str | Path] = ()
) -> None:
    """Refuse an output before any work is done for it, `others` being never replaced."""
    target = Path(os.path.realpath(path))
    for other in others:
        if _overlaps(target, Path(os.path.realpath(other))):
            raise OutputError(f'is {other} or a part of it, which the command needs', path)
    suffix = target.suffix.lower()
    if kind.suffixes and suffix[1:2].isalpha() and suffix not in kind.suffixes:
        names = ' or '.join(f'*{one}' for one in kind.suffixes)
        raise OutputError(f'cannot be written: {suffix} is not {names}', path)
    if target.exists():
        if not overwrite:
            raise OutputError('exists already; --force overwrites it', path)
        with _told(path):
            refusal = kind.refusal(target)
        if refusal:
            raise OutputError(f'is not replaced: {refusal}', path)
        return
    folder = next(above for above in target.parents if above.exists())
    if not folder.is_dir():
        raise OutputError(f'cannot be written: {folder} is no directory', path)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f'cannot be written: {folder} is closed to you', path)


class Draft:
    """An output in the making: it stands under a hidden name, `partial`, until it is whole."""

    def __init__(self, path: str | Path, kind: Kind, *, overwrite: bool = False) -> None:
        check_output(path, kind, overwrite=overwrite)
        self._path = path
        self._is_replacing = overwrite
        self._target = Path(os.path.realpath(path))
        self.partial = _hidden_sibling(self._target)
        with _told(path):
            self._target.parent.mkdir(parents=True, exist_ok=True)
            if kind.is_folder:
                self.partial.mkdir()

    def publish(self) -> None:
        """Give the finished output its name; OutputError if somebody else was first."""
        with _told(self._path):
            if self.partial.is_dir():
                _sync(self.partial)
                self._move_folder()
            elif self._is_replacing:
                with suppress(FileNotFoundError):
                    self.partial.chmod(stat.S_IMODE(self._target.stat().st_mode))
                self.partial.replace(self._target)
            else:
                try:
                    os.link(self.partial, self._target)
                    self.partial.unlink()
                except FileExistsError:
                    raise
                except OSError:
                    # No hard links here, as on FAT: whoever makes the name has it.
                    os.close(os.open(self._target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
                    self.partial.replace(self._target)
            _sync(self._target.parent)

    def drop(self) -> None:
        """Remove what was written so far."""
        with suppress(OSError):
            if self.partial.is_dir():
                shutil.rmtree(self.partial)
            else:
                self.partial.unlink(missing_ok=True)

    def _move_folder(self) -> None:
        old = None
        if self._is_replacing and self._target.exists():
            # Of folders the system replaces none but an empty one.
            old = self._target.rename(_hidden_sibling(self._target))
        try:
            self.partial.rename(self._target)
        except OSError:
            if old is not None:
                old.rename(self._target)
            raise
        if old is not None:
            shutil.rmtree(old)


@contextmanager
def drafted(path: str | Path, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Give a place to write to; what the block leaves there becomes the output, if it succeeds."""
    draft = Draft(path, kind, overwrite=overwrite)
    try:
        with _told(path):
            yield draft.partial
            _sync(draft.partial)
        draft.publish()
    except BaseException:
        draft.drop()
        raise


def write_atomically(path: str | Path, data: bytes, kind: Kind, *, overwrite: bool = True) -> None:
    """Write a file so that its readers see the old content or the new one, never a part."""
    with drafted(path, kind, overwrite=overwrite) as partial:
        partial.write_bytes(data)


def _sync(path: Path) -> None:
    """Flush a file, or a directory's entries, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _told(path: str | Path) -> Iterator[None]:
    """Say which output failed, and not the hidden name, which nobody knows of."""
    try:
        yield
    except OSError as error:
        said = f'cannot be written: {error.strerror or error}'
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
            said = 'exists already; --force overwrites it'
        raise OutputError(said, path) from error


def _hidden_sibling(path: Path) -> Path:
    stem = path.stem[:40]
    return path.with_name(f'.{stem}.{os.getpid()}-{os.urandom(3).hex()}.partial{path.suffix}')


def _overlaps(target: Path, other: Path) -> bool:
    """Say whether a target is, holds or lies in another file, by whatever names and links."""
    is_within = other in (target, *target.parents) or target in other.parents
    return is_within or not _identities(target).isdisjoint(_identities(other))


def _identities(path: Path) -> set[tuple[int, int]]:
    """Identify a file, or a folder with the files in it."""
    found = set()
    for one in (path, *(path.iterdir() if path.is_dir() else ())):
        with suppress(OSError):
            status = one.stat()
            found.add((status.st_dev, status.st_ino))
    return found
