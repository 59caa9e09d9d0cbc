# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a bag of the fleet: which files make it, how it is opened where it lies, what is kept of it.

What is kept are its sufficient statistics (`fitting.ReducedBag`): windows, temperature readings,
counters. The thermal estimators run causally through a bag from its first reading on, so the bag
is the smallest piece that can be reduced by itself.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

from ..errors import FitError, RecordingError
from ..fitting import FitOptions, FitSource, ReducedBag, SourceBlock, reduce_bag
from ..recording import (
    ROLES,
    Input,
    RandomAccess,
    RecordingReader,
    Role,
    Topics,
    in_split_order,
    open_mcap,
    open_recording,
)
from .storage import HashingFile, Storage, StoredFile, digest_of

_METADATA = 'metadata.yaml'
_NEEDED: tuple[Role, ...] = ('accel', 'board')


@dataclass(frozen=True)
class FoundBag:
    """
    One bag.

    Parameters
    ----------
    name : str
        Its place below the fleet's folder.
    files : tuple of StoredFile
        What it is made of; several for a directory.

    """

    name: str
    files: tuple[StoredFile, ...]

    @property
    def is_folder(self) -> bool:
        """Whether it is a directory with files of its own."""
        return self.files[0].name != self.name

    @property
    def n_bytes(self) -> int:
        """Size of its files."""
        return sum(file.size for file in self.files)


def group_files(files: list[StoredFile]) -> list[FoundBag]:
    """
    Put the files of a fleet together to bags.

    Parameters
    ----------
    files : list of StoredFile
        All files.

    Returns
    -------
    list of FoundBag
        In the order of their names.

    """
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
    if any(PurePosixPath(file.name).name == _METADATA for file in inside):
        return True
    stems = [PurePosixPath(file.name).stem for file in stored]
    return all(
        stem.startswith(f'{folder}_') and stem.rpartition('_')[2].isdigit() for stem in stems
    )


def mcap_names(bag: FoundBag) -> list[str]:
    """List the MCAP files of a bag as they follow each other; empty where it has none."""
    paths = (Path(file.name) for file in bag.files if file.name.endswith('.mcap'))
    return [path.as_posix() for path in in_split_order(paths)]


def open_bag(
    storage: Storage,
    bag: FoundBag,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    require: Collection[Role] = ROLES,
    hashing: HashingFile | None = None,
) -> RecordingReader:
    """
    Open a bag where it lies.

    Parameters
    ----------
    storage : Storage
        The fleet's folder.
    bag : FoundBag
        The bag.
    topics, input, require
        As for `recording.open_recording`.
    hashing : HashingFile or None, optional
        The bag's only file, already open; it stays so.

    Returns
    -------
    RecordingReader
        An MCAP bag is read by ranges, nothing else needs to be.

    Raises
    ------
    RecordingError
        If it cannot be read, or only a copy on this machine could be.

    """
    names = mcap_names(bag)
    if hashing is None and storage.is_local and (bag.is_folder or not names):
        return open_recording(storage.local_path(bag.name), topics, input, require=require)
    if not names:
        raise RecordingError(
            'only MCAP is read from a distance: copy the bag to this machine', bag.name
        )

    def opened(path: Path) -> RandomAccess:
        return storage.open(path.as_posix()) if hashing is None else hashing

    return open_mcap([Path(name) for name in names], opened, topics, input, require=require)


@dataclass(frozen=True)
class BagStatistics:
    """
    What a unit's fit needs of one bag; some kilobytes that travel instead of the bag.

    Parameters
    ----------
    name : str
        The bag's place below the fleet's folder.
    sha256 : str
        Of its content; empty where it could not be read to its end.
    n_bytes : int
        Its size.
    reduced : ReducedBag or None
        Its sufficient statistics; None where there is a problem.
    input : {'counts', 'm/s^2'}
        What its samples are.
    lot : str
        The lot that its metadata name.
    problem : str
        Why it is left out; empty where it is not.
    is_passing : bool
        Whether the problem may pass: the file system failed, not the bag.
    note : str
        What a reader should know of it: cut off.
    cpu_s : float
        Processor time that it took.

    """

    name: str
    sha256: str
    n_bytes: int
    reduced: ReducedBag | None = None
    input: Literal['counts', 'm/s^2'] = 'counts'
    lot: str = ''
    problem: str = ''
    is_passing: bool = False
    note: str = ''
    cpu_s: float = 0.0


def reduce_found(
    url: str, bag: FoundBag, options: FitOptions, topics: Topics | None, kind: Input
) -> BagStatistics:
    """
    Read a bag once: hash it, and keep its sufficient statistics.

    Parameters
    ----------
    url : str
        The fleet's folder.
    bag : FoundBag
        The bag.
    options : FitOptions
        The fit's; its `input` is replaced by what the bag holds.
    topics : Topics or None
        Names of the inputs.
    kind : {'auto', 'counts', 'imu'}
        What is read.

    Returns
    -------
    BagStatistics
        Or the reason why there are none: no bag stops a fleet.

    """
    began = time.process_time()
    storage = Storage(url)
    empty = BagStatistics(bag.name, '', bag.n_bytes)
    try:
        with _hashing(storage, bag) as hashing:
            result = _reduced(storage, bag, hashing, options, topics, kind, empty)
            sha256 = (
                digest_of(storage, [file.name for file in bag.files])
                if hashing is None
                else hashing.digest()
            )
    except OSError as error:
        return replace(empty, problem=f'{bag.name}: {error.strerror or error}', is_passing=True)
    reduced = result.reduced
    if reduced is not None:
        source = replace(reduced.source, sha256=sha256)
        result = replace(result, reduced=replace(reduced, source=source))
    return replace(result, sha256=sha256, cpu_s=time.process_time() - began)


@contextmanager
def _hashing(storage: Storage, bag: FoundBag) -> Iterator[HashingFile | None]:
    """Open a bag that is one MCAP file so that reading it hashes it."""
    if bag.is_folder or not mcap_names(bag):
        yield None
        return
    file = storage.open(bag.name)
    try:
        yield HashingFile(file)
    finally:
        file.close()


def _reduced(
    storage: Storage,
    bag: FoundBag,
    hashing: HashingFile | None,
    options: FitOptions,
    topics: Topics | None,
    kind: Input,
    empty: BagStatistics,
) -> BagStatistics:
    try:
        with open_bag(storage, bag, topics, kind, require=_NEEDED, hashing=hashing) as reader:
            info = reader.info
            unit: Literal['counts', 'm/s^2'] = 'm/s^2' if info.input == 'imu' else 'counts'
            source = FitSource(
                name=PurePosixPath(bag.name).name,
                blocks=reader.blocks_on_one_clock,
                serial=info.metadata.get('serial'),
            )
            reduced = reduce_bag(source, 0, replace(options, input=unit))
            info = reader.info
    except RecordingError as error:
        is_passing = isinstance(error.__cause__, OSError)
        return replace(empty, problem=_short(error, bag.name), is_passing=is_passing)
    except FitError as error:
        return replace(empty, problem=str(error))
    return replace(
        empty,
        reduced=replace(reduced, source=replace(source, blocks=_elsewhere)),
        input=unit,
        lot=info.metadata.get('lot', ''),
        note=f'{source.name}: {info.truncated}' if info.truncated else '',
    )


def _short(error: RecordingError, name: str) -> str:
    """Name the bag as the fleet does, wherever it lies."""
    parts = (name, error.topic, error.message)
    return ': '.join(part for part in parts if part)


def _elsewhere() -> Iterable[SourceBlock]:
    """Stand in for the samples of a bag that was reduced where it lies."""
    raise FitError('the samples stayed where the bag lies')
