# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the fit reads: blocks of accelerometer samples and temperature readings, by source.

Bags, tables and simulated runs provide the same blocks as to the compensator.
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
from .known_force import USUAL_FORCE, AskedForce, KnownForce, known_force

_SAMPLES: tuple[Role, ...] = ('accel',)


def angular_velocity(block: object) -> Floats | None:
    """Angular rate of a block that has one: a recording's, when its input is an Imu."""
    imu = getattr(block, 'imu', None)
    if imu is None or (imu.angular_velocity_covariance[:, 0] == -1.0).any():
        return None
    rate: Floats = imu.angular_velocity
    return rate if rate.any() else None


@dataclass(frozen=True)
class FitSource:
    """
    One bag (or what stands for one): `blocks` gives a fresh iterable in file order for each pass.

    `reader` gives what read it last, which knows what was missing; None for arrays.
    """

    name: str
    blocks: Callable[[], Iterable[Block]]
    sha256: str | None = None
    serial: str | None = None
    force: KnownForce | None = None  # None: at rest |f| is gravity
    reader: Callable[[], RecordingReader | None] = lambda: None


def fit_sources(
    paths: Sequence[str | Path], topics: Topics | None = None, force: AskedForce = USUAL_FORCE
) -> tuple[list[FitSource], Input]:
    """
    Prepare recordings for a fit; each is opened once now, and streamed when the fit asks.

    Raises RecordingError if one cannot be read or lacks a topic; FitError if one is given
    twice, or some hold counts and some Imu messages.
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
            raise FitError(f'{path}: is {twin} once more, and nothing may count twice')
    if len(kinds) > 1:
        raise FitError(
            f'{kinds["counts"]} holds counts, {kinds["imu"]} Imu messages: leave one kind out, or '
            'choose with --input where a bag has both'
        )
    return sources, 'imu' if 'imu' in kinds else 'counts'


def recording_source(
    path: str | Path,
    topics: Topics | None = None,
    *,
    require: Collection[Role] = _SAMPLES,
    progress: Callable[[float], None] | None = None,
    force: AskedForce = USUAL_FORCE,
) -> tuple[FitSource, RecordingInfo]:
    """
    Make a source of a recording: looked at now, and opened anew for each pass. `force`: what the
    user says of |f|, in place of the bag's metadata.
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
    if topic and not any(is_called(topic, one) for one in (wanted.counts, wanted.imu)):
        name += f' ({shown(topic)})'  # every message then says which topic was taken
    serial = info.metadata.get('serial')
    known = known_force(path, info, force)
    return FitSource(name, blocks, serial=serial, force=known, reader=lambda: latest), info


def digest(path: Path) -> str:
    """Return the SHA-256 of a bag: of a file, or of a directory's in the order of names."""
    total = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob('*') if p.is_file())
    for name in files:
        with name.open('rb') as file:
            for chunk in iter(lambda: file.read(1 << 20), b''):
                total.update(chunk)
    return total.hexdigest()
