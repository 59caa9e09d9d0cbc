# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from bags to what the fit reads.

"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from ..errors import FitError
from ..recording import Block, Input, Topics, open_recording
from . import FitSource


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

    Parameters
    ----------
    paths : sequence of str or Path
        Recordings of one unit.
    topics : Topics or None, optional
        Names of the inputs.
    input : {'auto', 'counts', 'imu'}, optional
        What is read.
    serial : str or None, optional
        The unit as the user knows it; it wins over what the bags say.
    hashed : bool, optional
        Whether the bags' hashes are wanted, which takes reading each of them once.

    Returns
    -------
    sources : list of FitSource
        In the order given.
    input : {'counts', 'imu'}
        What all of them hold.

    Raises
    ------
    RecordingError
        If one cannot be read or lacks a topic.
    FitError
        If some hold counts and some Imu messages, or they are of different units.

    """
    sources: list[FitSource] = []
    kinds: dict[str, str] = {}
    serials: dict[str, str] = {}
    for path in map(Path, paths):
        with open_recording(path, topics, input, require=('accel', 'board')) as reader:
            info = reader.info
        kinds[info.input or 'counts'] = str(path)
        if info.metadata.get('serial'):
            serials[info.metadata['serial']] = str(path)
        sources.append(
            FitSource(
                name=path.name,
                blocks=_Blocks(path, topics, input),
                sha256=digest(path) if hashed else None,
                serial=info.metadata.get('serial'),
                truncated=info.truncated,
            )
        )
    if len(kinds) > 1:
        raise FitError(
            f'{kinds["counts"]} holds counts, {kinds["imu"]} Imu messages: choose one with --input'
        )
    if serial is None and len(serials) > 1:
        found = ', '.join(f'{path} of {unit}' for unit, path in sorted(serials.items()))
        raise FitError(f'the bags are of different units: {found}')
    return sources, 'imu' if 'imu' in kinds else 'counts'


class _Blocks:
    """
    Opens a recording anew for each pass.

    """

    def __init__(self, path: Path, topics: Topics | None, kind: Input) -> None:
        self._path, self._topics, self._input = path, topics, kind

    def __call__(self) -> Iterable[Block]:
        return self._read()

    def _read(self) -> Iterator[Block]:
        with open_recording(
            self._path, self._topics, self._input, require=('accel', 'board')
        ) as reader:
            yield from reader.blocks()


def digest(path: Path) -> str:
    """
    Return the SHA-256 of a bag: of the file, or of a directory's files in the order of names.

    Parameters
    ----------
    path : Path
        The bag.

    Returns
    -------
    str
        Hexadecimal.

    """
    total = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob('*') if p.is_file())
    for name in files:
        with name.open('rb') as file:
            for chunk in iter(lambda: file.read(1 << 20), b''):
                total.update(chunk)
    return total.hexdigest()
