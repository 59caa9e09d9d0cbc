# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns which bags belong to which unit: a folder per unit, or the serials that the bags carry.

``DIR/[LOT/]UNIT/BAG``: the bags of one folder are one thermal test of one unit, so a unit that was
tested twice has two folders and comes out twice. Bags that lie in DIR itself are sorted by the
serial in their metadata.
"""

from __future__ import annotations

from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import PurePosixPath

from ..errors import FleetError, RecordingError
from .bag import FoundBag, group_files, open_bag
from .storage import Storage

# A listing of many bags on a far file system waits, it does not compute.
_N_READERS = 16


@dataclass(frozen=True)
class FoundUnit:
    """
    The bags of one thermal test of one unit.

    Parameters
    ----------
    name : str
        Its folder below the fleet's, or its serial.
    lot : str
        The folder above it; empty where there is none.
    bags : tuple of FoundBag
        In the order of their names.

    """

    name: str
    lot: str
    bags: tuple[FoundBag, ...]


def find_units(storage: Storage) -> list[FoundUnit]:
    """
    Find the units of a fleet.

    Parameters
    ----------
    storage : Storage
        The fleet's folder.

    Returns
    -------
    list of FoundUnit
        In the order of their names.

    Raises
    ------
    FleetError
        If the folder cannot be listed, or holds no bag.

    """
    bags = group_files(storage.files())
    if not bags:
        raise FleetError(
            f'{storage.url}: no bag in it; expected DIR/UNIT/BAG or DIR/LOT/UNIT/BAG, where BAG '
            'is .mcap, .db3, .bag or a rosbag2 directory'
        )
    by_folder: dict[str, list[FoundBag]] = defaultdict(list)
    loose: list[FoundBag] = []
    for bag in bags:
        folder = str(PurePosixPath(bag.name).parent)
        if folder == '.':
            loose.append(bag)
        else:
            by_folder[folder].append(bag)
    units = [FoundUnit(name, _lot(name), tuple(found)) for name, found in by_folder.items()]
    units += _by_serial(storage, loose, {unit.name for unit in units})
    return sorted(units, key=lambda unit: unit.name)


def _lot(name: str) -> str:
    first, _, rest = name.partition('/')
    return first if rest else ''


def _by_serial(storage: Storage, bags: list[FoundBag], taken: set[str]) -> list[FoundUnit]:
    """Sort the bags that lie in the fleet's folder itself."""

    def serial_of(bag: FoundBag) -> str:
        try:
            with open_bag(storage, bag, require=()) as reader:
                return reader.info.metadata.get('serial') or storage.name
        except RecordingError:
            # Nobody knows whose it is: it becomes a unit of its own, which says what is wrong.
            return bag.name

    groups: dict[str, list[FoundBag]] = defaultdict(list)
    with ThreadPoolExecutor(_N_READERS) as pool:
        for bag, serial in zip(bags, pool.map(serial_of, bags), strict=True):
            groups[serial].append(bag)
    return [
        FoundUnit(name if name not in taken else f'{name} (in {storage.name})', '', tuple(found))
        for name, found in groups.items()
    ]
