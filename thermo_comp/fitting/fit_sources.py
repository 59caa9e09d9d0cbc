# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way from bags to what the fit reads."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import FitError
from ..files import shown_name
from ..recording import Block, Input, RecordingInfo, Role, Topics, open_recording
from . import FitSource

_SAMPLES: tuple[Role, ...] = ('accel',)


def fit_sources(
    paths: Sequence[str | Path],
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    serial: str | None = None,
    *,
    hashed: bool = True,
) -> tuple[list[FitSource], Input]:
    """
    Prepare recordings for a fit; each is opened once now, and streamed when the fit asks.

    Raises RecordingError if one cannot be read or lacks a topic. Raises FitError if some hold
    counts and some Imu messages, or they are of different units.
    """
    sources: list[FitSource] = []
    kinds: dict[str, str] = {}
    serials: dict[str, str] = {}
    for path in map(Path, paths):
        source, info = recording_source(path, topics, input)
        kinds[info.input or 'counts'] = str(path)
        if info.metadata.get('serial'):
            serials[info.metadata['serial']] = str(path)
        sources.append(replace(source, sha256=digest(path)) if hashed else source)
    if len(kinds) > 1:
        raise FitError(
            f'{kinds["counts"]} holds counts, {kinds["imu"]} Imu messages: leave one kind out, or '
            'choose with --input where a bag has both'
        )
    if serial is None and len(serials) > 1:
        found = ', '.join(f'{path} of {unit}' for unit, path in sorted(serials.items()))
        raise FitError(f'the bags are of different units: {found}')
    return sources, 'imu' if 'imu' in kinds else 'counts'


def recording_source(
    path: str | Path,
    topics: Topics | None = None,
    input: Input = 'auto',  # noqa: A002 - the parameter's public name
    *,
    require: Collection[Role] = _SAMPLES,
) -> tuple[FitSource, RecordingInfo]:
    """
    Make a source of a recording: looked at now, and opened anew for each pass.

    Raises RecordingError if it cannot be read or lacks a topic.
    """
    path = Path(path)
    with open_recording(path, topics, input, require=require) as reader:
        info = reader.info
    latest = reader

    def blocks() -> Iterator[Block]:
        nonlocal latest
        with open_recording(path, topics, input, require=require) as latest:
            yield from latest.blocks_on_one_clock()

    source = FitSource(
        f'{shown_name(path)}{topics.part if topics else ""}',
        blocks,
        serial=info.metadata.get('serial'),
        chosen=info.chosen,
        missing=lambda: latest.info.truncated,
        since_s=lambda: latest.since_s,
        metadata=info.metadata,
    )
    return source, info


def digest(path: Path) -> str:
    """
    Return the SHA-256 of a bag: of the file, or of a directory's files in the order of names.
    """
    total = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob('*') if p.is_file())
    for name in files:
        with name.open('rb') as file:
            for chunk in iter(lambda: file.read(1 << 20), b''):
                total.update(chunk)
    return total.hexdigest()
