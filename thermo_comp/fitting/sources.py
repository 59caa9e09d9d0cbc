# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the input of a fit: sources of blocks of accelerometer samples and temperature readings.

Bags, tables and simulated runs all give blocks of the type `Block` to fit and compensator.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import FitError
from ..files import shown_name
from ..recording.blocks import Block, Input, RecordingInfo, Role
from ..recording.reader import RecordingReader, open_recording
from ..recording.topics import Topics, is_called, shown
from ..typing import Floats
from .known_force import USUAL_FORCE, ForceOptions, KnownForce, known_force


def angular_velocity(block: object) -> Floats | None:
    """Return the angular rate [rad/s] of a block of Imu messages; None if absent or all 0."""
    imu = getattr(block, 'imu', None)
    if imu is None or (imu.angular_velocity_covariance[:, 0] == -1.0).any():
        return None
    rate: Floats = imu.angular_velocity
    return rate if rate.any() else None


@dataclass(frozen=True)
class FitSource:
    """
    A bag, table, array or simulated run.

    blocks: function that returns a new iterable of the blocks in file order
    force: known |f|, or None if |f| is gravity
    reader: function that returns the last reader of the recording, or None for arrays
    """

    name: str
    blocks: Callable[[], Iterable[Block]]
    sha256: str | None = None
    serial: str | None = None
    force: KnownForce | None = None
    reader: Callable[[], RecordingReader | None] = lambda: None


def fit_sources(
    paths: Sequence[str | Path], topics: Topics | None = None, force: ForceOptions = USUAL_FORCE
) -> tuple[list[FitSource], Input]:
    """
    Make sources of recordings; a fit opens each recording again.

    Raises RecordingError if a recording cannot be read or lacks a topic, and FitError if a
    recording is given twice, or if some recordings have counts and some have Imu messages.
    """
    sources: list[FitSource] = []
    kinds: dict[str, str] = {}
    names: dict[str, str] = {}
    for path in map(Path, paths):
        source, info = recording_source(path, topics, force=force)
        kinds[info.input or 'counts'] = str(path)
        sources.append(replace(source, sha256=digest(path)))
        twin = names.setdefault(str(sources[-1].sha256), str(path))
        if len(names) < len(sources):
            raise FitError(f'{path}: has the same content as {twin}: give only one')
    if len(kinds) > 1:
        raise FitError(
            f'{kinds["counts"]} has counts, {kinds["imu"]} has Imu messages: give recordings of '
            'one kind, or choose with --input if a bag has both'
        )
    return sources, 'imu' if 'imu' in kinds else 'counts'


def recording_source(
    path: str | Path,
    topics: Topics | None = None,
    *,
    require: Collection[Role] = ('accel',),
    progress: Callable[[float], None] | None = None,
    force: ForceOptions = USUAL_FORCE,
) -> tuple[FitSource, RecordingInfo]:
    """
    Make a source of a recording; each iteration over its blocks opens the recording again.

    `require`: topics that the recording must have; `force`: the user's options about |f|, which
    replace the bag's metadata
    """
    path = Path(path)
    with open_recording(path, topics, require=require) as reader:
        info, topic = reader.info, reader.topics.get('accel')
    latest, total = reader, info.topics[topic][1] if topic else 0

    def blocks() -> Iterator[Block]:
        nonlocal latest
        n_read = 0
        with open_recording(path, topics, require=require) as latest:
            for block in latest.blocks_on_one_clock():
                yield block
                n_read += len(block)
                if progress is not None and total:
                    progress(min(n_read / total, 1.0))

    wanted = topics or Topics()
    name = f'{shown_name(path)}{wanted.part}'
    if topic and not any(is_called(topic, usual) for usual in (wanted.counts, wanted.imu)):
        name += f' ({shown(topic)})'  # the topic is part of the name in messages about the source
    serial = info.metadata.get('serial')
    known = known_force(path, info, force)
    return FitSource(name, blocks, serial=serial, force=known, reader=lambda: latest), info


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files of a directory in the order of names."""
    total = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob('*') if p.is_file())
    for name in files:
        with name.open('rb') as file:
            for chunk in iter(lambda: file.read(1 << 20), b''):
                total.update(chunk)
    return total.hexdigest()
