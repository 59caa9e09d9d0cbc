# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the search for the bags of a fleet, by unit, on any file system that fsspec can read."""

import errno
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..errors import RecordingError, ThermoCompError
from ..recording.reader import open_recording
from ..text import one_line

# Keys of a file in a listing whose values change with the file's content, most reliable first.
_STAMPS = (
    *('ETag', 'etag', 'md5Hash', 'content_md5', 'generation', 'version_id'),
    *('mtime', 'LastModified', 'last_modified', 'updated', 'created'),
)

# Ends of the names of tables and logs; .txt is omitted, because notes beside bags end in .txt.
_TABLES = ('.csv', '.tsv', '.mat', '.parquet', '.ulg', '.bin')


class StoredFile(NamedTuple):
    """A file in a listing; `stamp` (ETag or time) changes with the file's content."""

    name: str
    size: int
    stamp: str


#: Files of each bag (a rosbag2 folder has several), by the bag's path in the fleet's folder.
Bags = dict[str, list[StoredFile]]


@dataclass(frozen=True)
class FoundUnit:
    """Bags of a thermal test; `name`: folder of the bags or serial; `lot`: top folder or ''."""

    name: str
    lot: str
    bags: Bags


class Storage:
    """The folder of a fleet: a local folder, or a URL like ``s3://bucket/bags`` for fsspec."""

    def __init__(self, url: str) -> None:
        import fsspec

        self.url = url
        try:
            self._fs, root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise ThermoCompError(f'{url}: {words(error)}') from error
        self._root = str(root).rstrip('/')
        self._is_local = 'file' in self._fs.protocol
        # The absolute path or the URL, which does not depend on the working directory.
        self.address = self._root if self._is_local else url
        self.name = self._root.rpartition('/')[2]

    def files(self) -> list[StoredFile]:
        """List all files below the folder except hidden ones, sorted by name."""
        try:
            if self._is_local:
                listing = {path: self._fs.info(path) for path in _scan(self._root)}
            else:
                listing = self._fs.find(self._root, detail=True)
            if not listing and not self._fs.isdir(self._root):
                raise NotADirectoryError(errno.ENOTDIR, 'no such directory')
        except Exception as error:  # each file system raises its own exceptions
            raise ThermoCompError(f'{self.url}: cannot be listed: {words(error)}') from error
        files = []
        for path, facts in listing.items():
            name = path.removeprefix(f'{self._root}/')
            if facts['type'] == 'file' and not any(p.startswith('.') for p in name.split('/')):
                stamp = next((str(facts[key]) for key in _STAMPS if facts.get(key)), '')
                files.append(StoredFile(name, int(facts.get('size') or 0), stamp))
        return sorted(files)

    @contextmanager
    def here(self, name: str, files: Sequence[StoredFile]) -> Iterator[Path]:
        """Yield a bag's path, or the path of a copy of a remote bag; OSError if the copy fails."""
        if self._is_local:
            yield Path(self._root, name)
            return
        with tempfile.TemporaryDirectory(prefix='thermo_comp-') as scratch:
            sources, copies = (
                [f'{root}/{file.name}' for file in files] for root in (self._root, scratch)
            )
            try:
                self._fs.get(sources, copies)
            except Exception as error:  # each file system raises its own exceptions
                raise OSError(errno.EIO, words(error)) from error
            yield Path(scratch, name)


def _scan(root: str) -> Iterator[str]:
    """Yield the files of a local tree, following links (fsspec does not follow links)."""

    def refuse(error: OSError) -> None:
        if error.errno not in (errno.ENOENT, errno.ENOTDIR):
            raise OSError(error.errno, f'{error.strerror} in {one_line(error.filename)}')

    # A folder that cannot be read raises OSError, because it may be the folder of a unit.
    for folder, folders, names in os.walk(root, onerror=refuse, followlinks=True):
        here = Path(folder).resolve()
        # Skip hidden folders and the file system's `lost+found`; and links to a folder that
        # contains the link, because the scan would never end.
        folders[:] = [
            name
            for name in folders
            if not name.startswith('.')
            and name != 'lost+found'
            and Path(folder, name).resolve() not in (here, *here.parents)
        ]
        yield from (str(path) for name in names if (path := Path(folder, name)).is_file())


def words(error: Exception) -> str:
    """Return the text of an error on a single line."""
    text = getattr(error, 'strerror', None) or ' '.join(str(error).split())
    return text or type(error).__name__


def find_units(storage: Storage) -> list[FoundUnit]:
    """Find the units of a fleet; ThermoCompError if its folder cannot be listed or has no bag."""
    bags = group_files(storage.files())
    if not bags:
        raise ThermoCompError(
            f'{storage.url}: no bag in it; expected DIR/UNIT/BAG or DIR/LOT/UNIT/BAG, where BAG '
            'is .mcap, .db3, .bag or a rosbag2 directory'
        )
    folders = {_folder(name) for name in bags}
    by_unit: dict[tuple[str, str], Bags] = defaultdict(dict)
    for name, files in bags.items():
        unit = _folder(name)
        lot = unit.partition('/')[0] if '/' in unit else ''
        if not unit:
            serial = _serial(storage, name, files)
            unit = f'{serial} (in {storage.name})' if serial in folders else serial
        by_unit[one_line(unit), one_line(lot)][name] = files
    return [FoundUnit(unit, lot, by_unit[unit, lot]) for unit, lot in sorted(by_unit)]


def folders_of_tables(storage: Storage) -> tuple[str, ...]:
    """Return the folders with tables or logs that `convert` can convert, but without a bag."""
    stored = storage.files()
    with_bags = tuple(f'{_folder(name)}/' for name in group_files(stored))
    # fleet.csv and fleet.parquet are results of an earlier run, not tables of samples.
    tables = {
        _folder(file.name)
        for file in stored
        if file.name.endswith(_TABLES) and not file.name.endswith(('/fleet.csv', '/fleet.parquet'))
    }
    return tuple(sorted(name for name in tables - {''} if not f'{name}/'.startswith(with_bags)))


def group_files(files: Sequence[StoredFile]) -> Bags:
    """Group the files of a fleet into bags, sorted by name."""
    by_folder: dict[str, list[StoredFile]] = defaultdict(list)
    for file in files:
        by_folder[_folder(file.name)].append(file)
    bags: Bags = {}
    for folder, inside in by_folder.items():
        stored = [file for file in inside if file.name.endswith(('.mcap', '.db3', '.bag'))]
        if stored and folder and _is_bag(folder, inside, stored):
            bags[folder] = inside
        else:
            bags |= {file.name: [file] for file in stored}
    return dict(sorted(bags.items()))


def _is_bag(folder: str, inside: list[StoredFile], stored: list[StoredFile]) -> bool:
    """Whether a folder is a rosbag2 bag: has metadata.yaml, or all bag files are FOLDER_<n>."""
    stems = [file.name.rpartition('.')[0].rpartition('_') for file in stored]
    usual = f'{folder}/{folder.rpartition("/")[2]}'
    return any(file.name == f'{folder}/metadata.yaml' for file in inside) or all(
        stem == usual and number.isdigit() for stem, _, number in stems
    )


def _folder(name: str) -> str:
    return name.rpartition('/')[0]


def _serial(storage: Storage, name: str, files: Sequence[StoredFile]) -> str:
    """Return the serial in the metadata of a bag, or else the name of the fleet's folder."""
    try:
        with storage.here(name, files) as path, open_recording(path, require=()) as reader:
            return reader.info.metadata.get('serial') or storage.name
    except (RecordingError, OSError):
        # A bag that cannot be read is a separate unit in the table, whose row states the problem.
        return name
