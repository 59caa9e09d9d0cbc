# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of files of limited size, and the writing of all output files.

An output never replaces an input of the same command. Without `overwrite` an output replaces no
existing file, even if another process writes at the same time; with `overwrite` an output replaces
only an empty file or a file of the same kind. An output gets its name once it is complete; if the
file system lacks hard links, an empty file reserves the name. Writing to a link writes the file to
which the link points.
"""

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
    """The kind of an output, by which an existing file or folder of this kind is recognised."""

    name: str
    mark: bytes  # regular expression of the first bytes of a file, or of the names in a folder
    is_folder: bool = False
    suffixes: tuple[str, ...] = ()  # accepted file suffixes; an empty tuple accepts any suffix

    def refusal(self, path: Path) -> str:
        """Return why an existing file or folder is not of this kind; an empty text if it is."""
        if path.is_dir() != self.is_folder:
            return f'it is a {"folder" if path.is_dir() else "file"}, not a {self.name}'
        if self.is_folder:
            entries = sorted(path.iterdir())
            for entry in entries:
                if not (entry.is_file() and re.search(self.mark, os.fsencode(entry.name))):
                    return f'it holds {entry.name}, which belongs to no bag'
            is_whole = not entries or (path / _INDEX).is_file()
            return '' if is_whole else f'it is no bag: it has no {_INDEX}'
        if path.is_file():
            with path.open('rb') as file:
                head = file.read(_HEAD_BYTES)
            if not head or re.search(self.mark, head):
                return ''
        return f'it is no {self.name}'


CALIBRATION = Kind('calibration', rb'(?m)^(format_version|unit)\s*:')
PAGE = Kind('HTML page', rb'(?i)\A\s*<!doctype html', suffixes=('.html', '.htm'))
PICTURE = Kind('PNG picture', rb'\A\x89PNG\r\n')
PARAMETERS = Kind('parameter file of thermo_comp', rb'\A# Thermal calibration of unit ')
RECORD = Kind('JSON record', rb'\A\{')
PARQUET = Kind('Parquet file', rb'\APAR1')
CSV = Kind('CSV table of thermo_comp', rb'\A(stamp_ns|name|section|bag),', suffixes=('.csv',))
MCAP = Kind('MCAP file', rb'\A\x89MCAP')
BAG = Kind('rosbag2 directory', rb'\A(metadata\.yaml|.+\.(mcap|db3)(\.zstd)?)\Z', is_folder=True)


def bag_kind(path: str | Path, others: str = '') -> Kind:
    """Return the kind of an output bag by its suffix; an error names *.mcap and `others`."""
    suffix = Path(path).suffix
    if suffix == '.mcap':
        return MCAP
    if suffix[1:2].isalpha():
        endings = f'{suffix} is none of the endings *.mcap{others}'
        text = f'cannot be written: {endings}; a name without an ending makes a folder'
        raise OutputError(text, path)
    return BAG


def shown_name(path: str | Path) -> str:
    """Return the last part of a path; bytes that are not UTF-8 are replaced."""
    return os.fsencode(Path(path).name).decode('utf-8', 'replace')


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file; anything else, e.g. a pipe that may block, raises OSError at once."""
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
    Read a regular file of limited size. ValueError if the file is larger than `limit` bytes,
    PermissionError if it lies outside `within`, OSError if it is missing or not a regular file.
    """
    with open_regular(path) as file:
        # Check the opened file: a link could be exchanged between a check and the opening.
        opened = Path(f'/proc/self/fd/{file.fileno()}')
        if within is not None and not opened.readlink().is_relative_to(within):
            raise PermissionError(errno.EPERM, 'outside of its folder', str(path))
        content = file.read(limit + 1)
        size = os.fstat(file.fileno()).st_size
    if len(content) > limit:
        raise ValueError(f'the file has {size} bytes, at most {limit} are accepted')
    return content


def check_output(
    path: str | Path, kind: Kind, *, overwrite: bool = False, others: Iterable[str | Path] = ()
) -> None:
    """Raise OutputError if an output may not be written, or overlaps with a path of `others`."""
    target = Path(os.path.realpath(path))
    for other in others:
        if _overlaps(target, Path(os.path.realpath(other))):
            text = f'is, contains or lies in {other}, which the command needs'
            raise OutputError(f'{text}: choose another output', path)
    suffix = target.suffix.lower()
    if kind.suffixes and suffix[1:2].isalpha() and suffix not in kind.suffixes:
        names = ' or '.join(f'*{wanted}' for wanted in kind.suffixes)
        text = f'cannot be written: its name must end in {names}, not in {suffix}'
        raise OutputError(text, path)
    if target.exists():
        if not overwrite:
            raise OutputError('exists already; --force overwrites it', path)
        with _output_errors(path):
            refusal = kind.refusal(target)
        if refusal:
            raise OutputError(f'is not replaced: {refusal}; choose another name', path)
        return
    folder = next(above for above in target.parents if above.exists())
    if not folder.is_dir():
        raise OutputError(f'cannot be written: {folder} is not a directory', path)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f'cannot be written: no permission to write in {folder}', path)


class Draft:
    """An output that is being written, under the hidden name `partial` until it is complete."""

    def __init__(self, path: str | Path, kind: Kind, *, overwrite: bool = False) -> None:
        check_output(path, kind, overwrite=overwrite)
        self._path = path
        self._is_replacing = overwrite
        self._target = Path(os.path.realpath(path))
        self.partial = _hidden_sibling(self._target)
        with _output_errors(path):
            self._target.parent.mkdir(parents=True, exist_ok=True)
            if kind.is_folder:
                self.partial.mkdir()

    def publish(self) -> None:
        """Give the output its final name; OutputError if the name exists without `overwrite`."""
        with _output_errors(self._path):
            if self.partial.is_dir():
                sync(self.partial)
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
                    # Without hard links, as on FAT, reserve the name before the file is moved.
                    os.close(os.open(self._target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
                    self.partial.replace(self._target)
            sync(self._target.parent)

    def drop(self) -> None:
        """Remove the incomplete output."""
        with suppress(OSError):
            if self.partial.is_dir():
                shutil.rmtree(self.partial)
            else:
                self.partial.unlink(missing_ok=True)

    def _move_folder(self) -> None:
        old = None
        if self._is_replacing and self._target.exists():
            # Rename the old folder first, because a folder can only replace an empty folder.
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
    """Yield a temporary path; its file or folder becomes the output if no exception occurs."""
    draft = Draft(path, kind, overwrite=overwrite)
    try:
        with _output_errors(path):
            yield draft.partial
            sync(draft.partial)
        draft.publish()
    except BaseException:
        draft.drop()
        raise


def write_atomically(path: str | Path, data: bytes, kind: Kind, *, overwrite: bool = True) -> None:
    """Write a file so that its readers get the complete old or the complete new content."""
    with drafted(path, kind, overwrite=overwrite) as partial:
        partial.write_bytes(data)


def sync(path: Path) -> None:
    """Flush the content of a file, or the entries of a directory, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _output_errors(path: str | Path) -> Iterator[None]:
    """Turn OSError into OutputError, with the name `path` instead of the hidden file's name."""
    try:
        yield
    except OSError as error:
        reason = f'cannot be written: {error.strerror or error}'
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):
            reason = 'exists already; --force overwrites it'
        raise OutputError(reason, path) from error


def _hidden_sibling(path: Path) -> Path:
    stem = path.stem[:40]
    return path.with_name(f'.{stem}.{os.getpid()}-{os.urandom(3).hex()}.partial{path.suffix}')


def _overlaps(target: Path, other: Path) -> bool:
    """Whether two paths are equal, or one path contains the other path, also through links."""
    is_within = other in (target, *target.parents) or target in other.parents
    return is_within or not _identities(target).isdisjoint(_identities(other))


def _identities(path: Path) -> set[tuple[int, int]]:
    """Return device and inode of a file, or of a folder and its entries."""
    identities = set()
    for entry in (path, *(path.iterdir() if path.is_dir() else ())):
        with suppress(OSError):
            status = entry.stat()
            identities.add((status.st_dev, status.st_ino))
    return identities
