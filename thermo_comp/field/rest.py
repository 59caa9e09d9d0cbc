# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the record of a rest, one line of text with a checksum, and the thinning of rest logs.

A rest log is a folder with one file per day (UTC). Each line of a file is a CRC-32 in hexadecimal,
a blank, and JSON: an object describes a start of the node, a list describes a window at rest after
the start above it. Lines with a wrong checksum are skipped; if a process is killed, the power
fails, or the disk is full, only the line being written is damaged.
"""

import json
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass
from typing import Any

from ..thermal.lags import Lag, MemorySpec, Play
from ..thermal.state import StateLayout

#: Suffix of the files of a rest log; the name of a file is the day, as in 2026-11-25.rests.
SUFFIX = '.rests'
#: First two bytes after the checksum, in the line of a node start and in the line of a rest.
_OF_START, _OF_REST = b' {', b' ['


@dataclass(frozen=True)
class Start:
    """
    A start of the node; `sha256`: hash of the calibration, `memory`: contents of thermal states.
    After a change of calibration or gravity the log has another `Start` with the same `start_ns`,
    which identifies the start and is no date, because the clock may be set later.
    """

    start_ns: int
    serial: str
    input: str
    gravity: float
    sha256: str
    memory: MemorySpec


@dataclass(frozen=True)
class Rest:
    """
    A window at rest. `stamp_ns`: stamp of its middle; `n`, `mean`, `sd`: number, mean and sd of
    its samples [input units]; `state`: mean thermal state, in the order of the `StateLayout` of
    `Start.memory`; `shares`: fraction of the unknown initial state of each lag that has not yet
    decayed; `rate`: mean angular rate [rad/s], empty if unknown.
    """

    stamp_ns: int
    n: int
    mean: tuple[float, ...]
    sd: tuple[float, ...]
    state: tuple[float, ...]
    shares: tuple[float, ...] = ()
    rate: tuple[float, ...] = ()


def encode(record: Start | Rest) -> bytes:
    """Return a start or a rest as a line of a rest log."""
    if isinstance(record, Start):
        # Earlier releases cannot read rates and newer fields of lags and play operators: write
        # such fields only if their values differ from the defaults.
        sensors, lags, plays, *newer = vars(record.memory).values()
        while newer and not newer[-1]:
            newer.pop()
        memory = [sensors, list(map(_shortened, lags)), list(map(_shortened, plays)), *newer]
        data: Any = {**vars(record), 'memory': memory}
    else:
        # Nine digits resolve 0.01 counts of a 24-bit converter.
        data = [
            [float(f'{value:.9g}') for value in part] if isinstance(part, tuple) else part
            for part in astuple(record)
        ]
    text = json.dumps(data, separators=(',', ':'), ensure_ascii=True).encode()
    return b'%08x %s\n' % (zlib.crc32(text), text)


def _shortened(quantity: Lag | Play) -> tuple[Any, ...]:
    """Return the fields of a lag or play operator, without default values at the end."""
    values, defaults = tuple(quantity), [*type(quantity)._field_defaults.values()]
    while defaults and values[-1] == defaults.pop():
        values = values[:-1]
    return values


def decode(content: bytes) -> tuple[list[tuple[Start, Rest]], int]:
    """Return a file's rests, each with the start of the node, and the number of damaged lines."""
    rests: list[tuple[Start, Rest]] = []
    start: Start | None = None
    n_damaged = 0
    for line in content.splitlines():
        text = line[9:]
        if line[:9] != b'%08x ' % zlib.crc32(text):
            n_damaged += bool(line)
            continue
        try:
            data = json.loads(text)
            if isinstance(data, dict):
                start = _start(data)
            elif start is not None:
                rests.append((start, _rest(data, start.memory)))
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
            # The content is invalid in spite of a valid checksum.
            n_damaged += 1
    return rests, n_damaged


def _start(data: dict[str, Any]) -> Start:
    sensors, lags, plays, *newer = data['memory']
    memory = MemorySpec(
        tuple(map(str, sensors)),
        tuple(_quantity(Lag, lag) for lag in lags),
        tuple(_quantity(Play, play) for play in plays),
        *(tuple(map(str, names)) for names in newer),
    )
    start = Start(**{**data, 'memory': memory})
    _whole(start.start_ns)
    if not 1.0 <= start.gravity <= 100.0:
        raise ValueError(start.gravity)
    return start


def _rest(data: list[Any], memory: MemorySpec) -> Rest:
    stamp_ns, n, *parts = data
    mean, sd, state, shares, rate = (tuple(map(_number, part)) for part in parts)
    lengths = (len(mean), len(sd), len(state), len(shares), len(rate) % 3)
    if lengths != (3, 3, StateLayout(memory).width, len(memory.lags), 0) or min(sd) < 0.0:
        raise ValueError(lengths)
    return Rest(_whole(stamp_ns), _whole(n), mean, sd, state, shares, rate)


def _quantity(cls: type[Any], values: Sequence[Any]) -> Any:
    """Make a lag or a play operator from the values of its first fields."""
    names = cls._fields[: len(values)]
    pairs = zip(names, values, strict=True)
    return cls(*(str(v) if name in ('input', 'sensor') else _number(v) for name, v in pairs))


def _number(value: float) -> float:
    if not abs(value) < 1e12:  # refuses NaN, and numbers far above any quantity of a rest
        raise ValueError(value)
    return float(value)


def _whole(value: int) -> int:
    if type(value) is not int or not 0 < value < 1 << 63:
        raise ValueError(value)
    return value


def counted_rests(content: bytes) -> int:
    """Count the undamaged lines of rests in a file."""
    lines = (line for line in content.splitlines() if line[8:10] == _OF_REST)
    return sum(line[:9] == b'%08x ' % zlib.crc32(line[9:]) for line in lines)


def thinned(content: bytes) -> bytes:
    """
    Keep the lines of node starts and, after each start, of the first, third, fifth ... rest; drop
    all other lines. Checksums are not verified.
    """
    kept: list[bytes] = []
    n = 0
    for line in content.splitlines(keepends=True):
        is_start = line[8:10] == _OF_START
        if is_start or (line[8:10] == _OF_REST and line.endswith(b'\n')):
            n = 0 if is_start else n + 1
            if is_start or n % 2:
                kept.append(line)
    return b''.join(kept)


def rests_of(
    contents: Iterable[bytes], is_wanted: Callable[[Start], bool]
) -> tuple[list[tuple[Start, Rest]], int]:
    """
    Decode files into rests without duplicates, and the number of damaged lines. The rests are
    sorted by start, then by stamp; starts are sorted by the stamp of their last rest, because
    `start_ns` and the first stamps may be from the time before the computer set its clock.
    """
    everything: dict[tuple[int, int], tuple[Start, Rest]] = {}
    n_damaged = 0
    for content in contents:
        rests, n = decode(content)
        n_damaged += n
        everything |= {(s.start_ns, r.stamp_ns): (s, r) for s, r in rests if is_wanted(s)}
    last: dict[int, int] = {}
    for start_ns, stamp_ns in everything:
        last[start_ns] = max(stamp_ns, last.get(start_ns, 0))
    ordered = sorted(everything, key=lambda key: (last[key[0]], *key))
    return [everything[key] for key in ordered], n_damaged
