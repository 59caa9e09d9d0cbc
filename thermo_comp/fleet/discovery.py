# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns which files make a bag, and which bags a unit: a folder per unit, or the serials in the bags.

``DIR/[LOT/]UNIT/BAG``: the bags of one folder are one thermal test of one unit, so a unit that was
tested twice has two folders and comes out twice. Bags that lie in DIR itself are sorted by the
serial in their metadata.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import PurePosixPath

from ..errors import FleetError, RecordingError
from ..recording import open_recording
from ..text import one_line
from .storage import Storage, StoredFile


@dataclass(frozen=True)
class FoundBag:
    """One bag: its place below the fleet's folder, and its files, several for a directory."""

    name: str
    files: tuple[StoredFile, ...]

    @property
    def n_bytes(self) -> int:
        """Size of its files."""
        return sum(file.size for file in self.files)


@dataclass(frozen=True)
class FoundUnit:
    """The bags of one thermal test; the name is a folder or serial, the lot the folder above."""

    name: str
    lot: str
    bags: tuple[FoundBag, ...]


def find_units(storage: Storage) -> list[FoundUnit]:
    """Find the units by name; raises FleetError where nothing can be listed or there is no bag."""
    bags = group_files(storage.files())
    if not bags:
        raise FleetError(
            f'{storage.url}: no bag in it; expected DIR/UNIT/BAG or DIR/LOT/UNIT/BAG, where BAG '
            'is .mcap, .db3, .bag or a rosbag2 directory'
        )
    by_folder: dict[str, list[FoundBag]] = defaultdict(list)
    for bag in bags:
        by_folder[str(PurePosixPath(bag.name).parent)].append(bag)
    loose = by_folder.pop('.', [])
    by_serial: dict[str, list[FoundBag]] = defaultdict(list)
    for bag in loose:
        serial = _serial(storage, bag)
        by_serial[f'{serial} (in {storage.name})' if serial in by_folder else serial].append(bag)
    units = [FoundUnit(one_line(n), _lot(n), tuple(found)) for n, found in by_folder.items()]
    units += [FoundUnit(one_line(n), '', tuple(found)) for n, found in by_serial.items()]
    return sorted(units, key=lambda unit: unit.name)


def group_files(files: list[StoredFile]) -> list[FoundBag]:
    """Put the files of a fleet together to bags, in the order of their names."""
    by_folder: dict[str, list[StoredFile]] = defaultdict(list)
    for file in files:
        by_folder[str(PurePosixPath(file.name).parent)].append(file)
    bags = []
    for folder, inside in by_folder.items():
        stored = [one for one in inside if one.name.endswith(('.mcap', '.db3', '.bag'))]
        if stored and folder != '.' and _is_bag_folder(PurePosixPath(folder).name, inside, stored):
            bags.append(FoundBag(folder, tuple(inside)))
        else:
            bags += [FoundBag(one.name, (one,)) for one in stored]
    return sorted(bags, key=lambda bag: bag.name)


def _is_bag_folder(folder: str, inside: list[StoredFile], stored: list[StoredFile]) -> bool:
    """Whether a folder is a rosbag2 directory; one whose recorder was killed has no metadata."""
    if any(PurePosixPath(file.name).name == 'metadata.yaml' for file in inside):
        return True
    stems = [PurePosixPath(file.name).stem for file in stored]
    return all(
        stem.startswith(f'{folder}_') and stem.rpartition('_')[2].isdigit() for stem in stems
    )


def _lot(name: str) -> str:
    first, _, rest = name.partition('/')
    return one_line(first) if rest else ''


def _serial(storage: Storage, bag: FoundBag) -> str:
    """Ask a bag that lies in the fleet's folder itself whose it is."""
    try:
        with storage.here(bag.name, bag.files) as path, open_recording(path, require=()) as reader:
            return reader.info.metadata.get('serial') or storage.name
    except (RecordingError, OSError):
        # Nobody knows whose it is: it becomes a unit of its own, which says what is wrong.
        return bag.name
