# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the input of a fit: sources of blocks of accelerometer samples and temperature readings.

Bags, tables and simulated runs all give blocks of the type `Block` to fit and compensator. The
user or a bag's metadata state a |f| that is not g: as a single value, as a table of time sections,
or by a rotation rate and a radius.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import FitError, ThermoCompError
from ..files import read_bounded, shown_name
from ..recording.blocks import NO_STAMP_NS, Block, Input, RecordingInfo, Role
from ..recording.fields import Field, definitions_of
from ..recording.reader import RecordingReader, open_recording
from ..recording.topics import Topics, is_called, shown, split_field
from ..typing import Floats, Ints
from ..unit.gravity import parse_acceleration

#: Keys of a bag's metadata about |f|.
MAGNITUDE, ROTATION = 'specific_force_magnitude_m_s2', 'rotation_topic'
RADIUS, RADIUS_SD = 'rotation_radius_m', 'rotation_radius_sd_m'


class Section(NamedTuple):
    """Times since a bag's first sample [s], with |f| between them (`size`) and its sd [m/s^2]."""

    begin_s: float
    end_s: float
    size: float
    sd: float


class Magnitude(NamedTuple):
    """
    The known |f| of a rest, ``hypot(still, spin)`` [m/s^2].

    still: |f| without the rotation
    spin: centripetal acceleration w^2 r at the stated radius r and the rotation rate w
    sd: sd of |f| without the effect of the radius's error
    """

    still: float
    spin: float = 0.0
    sd: float = 0.0

    @property
    def norm(self) -> float:
        """|f| with the centripetal acceleration at the stated radius [m/s^2]."""
        return math.hypot(self.still, self.spin)


@dataclass(frozen=True)
class KnownForce:
    """
    The known |f| of a bag over time: in `sections` (else |f| is gravity), or due to a rotation.

    stamp_ns, rate: measurements of the rotation rate [rad/s], about a vertical axis
    radius, radius_sd: distance of the unit from the axis and its sd [m]; the fit does not estimate
        a radius with the sd 0
    """

    name: str
    sections: tuple[Section, ...] = ()
    stamp_ns: Ints | None = None
    rate: Floats | None = None
    radius: float = 0.0
    radius_sd: float = 0.0

    def radius_part(self, size: Magnitude) -> float:
        """Return the sd of |f| due to the error of the radius [m/s^2]."""
        return size.spin**2 / size.norm * self.radius_sd / self.radius if self.radius else 0.0

    def of(self, start_ns: int, end_ns: int, first_ns: int, gravity: float) -> Magnitude:
        """Return |f| of a rest between two stamps; `first_ns`: stamp of the bag's first sample."""
        if self.stamp_ns is None or self.rate is None:
            middle_s = (0.5 * (start_ns + end_ns) - first_ns) * 1e-9
            for section in self.sections:
                if section.begin_s <= middle_s < section.end_s:
                    return Magnitude(section.size, sd=section.sd)
            return Magnitude(gravity)
        inside = (self.stamp_ns >= start_ns) & (self.stamp_ns <= end_ns)
        n, needed = int(inside.sum()), 3  # the sd of the mean of two readings is not reliable
        if n < needed:
            since_s = (start_ns - first_ns) * 1e-9
            raise FitError(
                f'{self.name}: {n} readings of the rotation rate in the rest that begins at '
                f'{since_s:.1f} s; a rest needs {needed} to give |f|'
            )
        spin = self.rate[inside] ** 2 * self.radius
        mean, sd = float(spin.mean()), float(spin.std(ddof=1)) / math.sqrt(len(spin))
        # |f|^2 = g^2 + spin^2, so d|f| = spin / |f| d(spin).
        return Magnitude(gravity, mean, sd * mean / math.hypot(mean, 9.8))


@dataclass(frozen=True)
class ForceOptions:
    """
    The user's options that state |f|.

    magnitude: |f| as a value with unit, or the path of a table of |f|
    rotation: topic of the rotation rate, as TOPIC or TOPIC:FIELD
    radius, radius_sd: distance of the unit from the rotation axis and its sd [m]
    """

    magnitude: str | None = None
    rotation: str | None = None
    radius: float | None = None
    radius_sd: float | None = None

    def __post_init__(self) -> None:
        if self.rotation is not None and (self.radius is None or self.magnitude is not None):
            raise ValueError('`rotation` needs `radius`, and excludes `specific_force`')
        if self.rotation is None and (self.radius, self.radius_sd) != (None, None):
            raise ValueError('`radius` and `radius_sd` are given without `rotation`')


def angular_velocity(block: object) -> Floats | None:
    """Return the angular rate [rad/s] in a block of Imu messages; None if it is absent or 0."""
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
    reader: function that returns the last opened reader of the recording, or None for arrays
    """

    name: str
    blocks: Callable[[], Iterable[Block]]
    sha256: str | None = None
    serial: str | None = None
    force: KnownForce | None = None
    reader: Callable[[], RecordingReader | None] = lambda: None


def fit_sources(
    paths: Sequence[str | Path], topics: Topics | None = None, force: ForceOptions | None = None
) -> tuple[list[FitSource], Input]:
    """
    Make sources of recordings; a fit opens each recording again.

    Raises RecordingError if a recording cannot be read or lacks a topic. Raises FitError if a
    recording is given twice, or if some recordings have counts and the others Imu messages.
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
    force: ForceOptions | None = None,
) -> tuple[FitSource, RecordingInfo]:
    """
    Make a source of a recording; each iteration over its blocks opens the recording again.

    `require`: roles whose topics must exist; `force`: options for |f|, instead of the metadata
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
    known = known_force(path, info, force or ForceOptions())
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


def known_force(path: Path, info: RecordingInfo, asked: ForceOptions) -> KnownForce | None:
    """
    Return |f| of a bag from the options `asked`, else from its metadata; None if |f| is g.

    Raises FitError for a stated |f| that cannot be parsed, and for a rotation topic without data.
    """
    metadata = info.metadata
    try:
        if asked.magnitude is not None:
            sections = _asked_sections(asked.magnitude, path)
            return KnownForce(str(path), sections) if sections else None
        if asked.rotation is not None:
            return _rotating(path, info, asked)
        if ROTATION in metadata:
            radius, sd = float(metadata.get(RADIUS, 'nan')), float(metadata.get(RADIUS_SD, '0'))
            if not (0.0 < radius < math.inf and 0.0 <= sd < math.inf):
                raise ValueError(
                    f'metadata with {ROTATION} need a positive {RADIUS} [m]; {RADIUS_SD} [m] may '
                    'be absent, or must be 0 or positive'
                )
            return _rotating(path, info, ForceOptions(None, metadata[ROTATION], radius, sd))
        if MAGNITUDE in metadata:
            return KnownForce(str(path), parse_sections(metadata[MAGNITUDE]))
    except ValueError as mistake:
        raise FitError(f'{path}: {mistake}') from mistake
    return None


def parse_sections(text: str) -> tuple[Section, ...]:
    """
    Read |f| [m/s^2] from a text: one line ``MAGNITUDE [SD]``, or lines of ``BEGIN END MAGNITUDE
    [SD]`` with times since the bag's first sample [s]. A ; ends a line, a # begins a comment.
    """
    lines = text.replace(',', ' ').replace(';', '\n').split('\n')
    rows = [_numbers(words) for line in lines if (words := line.split('#')[0].split())]
    if len(rows) == 1 and len(rows[0]) < 3:
        return (_section(0.0, math.inf, *rows[0]),)
    if not rows or not all(len(row) in (3, 4) for row in rows):
        raise ValueError(
            'the specific force must be one number in m/s^2, or lines of BEGIN END MAGNITUDE [SD] '
            'in s and m/s^2'
        )
    return tuple(_section(*row) for row in rows)


def _section(begin_s: float, end_s: float, size: float, sd: float = 0.0) -> Section:
    if not begin_s < end_s:
        raise ValueError(
            f'a line of |f| must end after its begin {begin_s:g} s, got the end {end_s:g} s'
        )
    # The limit 1e7 m/s^2, above the acceleration in a gun, detects typing errors.
    if not (0.0 < size < 1e7 and 0.0 <= sd < size):
        raise ValueError(
            f'a specific force must be above its sd and below 1e7 m/s^2, got {size:g} +- {sd:g}'
        )
    return Section(begin_s, end_s, size, sd)


def _numbers(words: list[str]) -> list[float]:
    text = repr(' '.join(words)[:60])
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f'|f|: expected numbers, got {text}') from error
    if not all(map(math.isfinite, values)):
        raise ValueError(f'|f|: expected finite numbers, got {text}')
    return values


def _asked_sections(text: str, path: Path) -> tuple[Section, ...]:
    """Read |f| from a value with unit, or from a table whose lines may begin with a bag's name."""
    table = Path(text)
    if not table.is_file():
        try:
            return (_section(0.0, math.inf, parse_acceleration(text)),)
        except ValueError as mistake:
            reason = f'--specific-force: {mistake}; nor is there a file of this name'
            raise FitError(reason) from mistake
    try:
        content = read_bounded(table, 1 << 20).decode('utf-8')
    except (OSError, ValueError) as error:
        raise ThermoCompError(f'cannot be read: {error}', table) from error
    mine: list[str] = []
    for line in content.splitlines():
        first, _, rest = line.strip().replace(',', ' ').partition(' ')
        # A first word such as 01.mcap or run_* is a bag's name; 10s is a number with its unit.
        if not first or first[0] == '#' or not re.search(r'[A-Za-z_*?]{2}|[*]', first):
            mine.append(line)
        elif fnmatch(path.name, first):
            mine.append(rest)
    if not any(line.split('#')[0].strip() for line in mine):
        return ()
    try:
        return parse_sections('\n'.join(mine))
    except ValueError as mistake:
        raise ThermoCompError(str(mistake), table) from mistake


def _rotating(path: Path, info: RecordingInfo, asked: ForceOptions) -> KnownForce:
    """Read the rotation rate of a bag, and combine it with the radius to the known |f|."""
    wanted, field = split_field(asked.rotation or '')
    names = [name for name in info.topics if is_called(name, wanted)]
    if len(names) != 1:
        raise ValueError(
            f'{len(names)} topics are called {wanted}, expected one with the rotation rate'
        )
    stamps, rates = [np.empty(0, np.int64)], [np.empty(0)]
    with open_recording(path, require=()) as reader:
        kind = info.topics[names[0]][0]
        path_in = field or {'geometry_msgs/msg/Vector3Stamped': 'vector.z'}.get(kind, 'data')
        number = Field(kind, path_in, definitions_of(kind, reader.definitions))
        for _, messages in reader.raw([names[0]]):
            stamp_ns, rate = number.read(messages)
            stamps.append(np.where(stamp_ns == NO_STAMP_NS, messages.log_ns, stamp_ns))
            rates.append(rate)
    stamp_ns, rate = np.concatenate(stamps), np.concatenate(rates)
    if not len(rate) or not np.isfinite(rate).all():
        raise ValueError(
            f'{names[0]}, the topic of the rotation rate, has no messages, or a rate that is not '
            'finite'
        )
    radius, radius_sd = asked.radius or 0.0, asked.radius_sd or 0.0
    return KnownForce(str(path), (), stamp_ns, rate, radius, radius_sd)
