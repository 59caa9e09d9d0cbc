# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the search for the inputs' topics in a bag, and the sentences said when one is not there.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, Literal, cast

from ..errors import RecordingError
from ..text import one_line
from .columns import Input, Role

VECTOR3_STAMPED = 'geometry_msgs/msg/Vector3Stamped'
IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
BOOL = 'std_msgs/msg/Bool'

_TYPES = {'counts': VECTOR3_STAMPED, 'imu': IMU, 'board': TEMPERATURE, 'case': TEMPERATURE}
_OUTPUT = '/imu/data_raw'  # what the node gives out is no input of it

#: Names of further thermometers: those that a role has not.
_NAME = re.compile(r'(?!(accel|board|case)$)[a-z][a-z0-9_]{0,63}')
_MAX_LISTED = 20
_MAX_SHOWN = 80

_FIRST_STAMP_S = 1e8  # no bag lasts three years, and no clock that was set stands before 1973 [s]

#: The topics of a bag with their type and number of messages.
Present = Mapping[str, tuple[str, int]]


@dataclass(frozen=True, slots=True)
class Part:
    """From `begin` to before `end`: seconds since the bag's first sample; from 1e8 on stamps."""

    begin: float | None = None
    end: float | None = None

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.begin, self.end) if limit is not None]
        if not all(isfinite(limit) and limit >= 0.0 for limit in limits):
            raise ValueError('the part of a bag begins and ends at 0 or a positive time')
        if len({limit >= _FIRST_STAMP_S for limit in limits}) > 1:
            raise ValueError("give both times from the bag's first sample, or both as stamps")
        if len(limits) == 2 and not limits[0] < limits[1]:
            raise ValueError(f'the part of a bag must end after {limits[0]:g}, got {limits[1]:g}')

    @property
    def is_stamped(self) -> bool:
        """Whether the times are stamps."""
        return max(self.begin or 0.0, self.end or 0.0) >= _FIRST_STAMP_S

    def limits_ns(self, first_ns: float) -> tuple[float, float]:
        """Give begin and end as stamps; `first_ns` is the first sample's, inf until it comes."""
        origin = 0 if self.is_stamped else first_ns
        begin = -inf if self.begin is None else origin + round(self.begin * 1e9)
        return begin, inf if self.end is None else origin + round(self.end * 1e9)

    def __str__(self) -> str:
        """Write it behind a bag's name."""
        begin, end = ('' if limit is None else f'{limit:.12g}' for limit in (self.begin, self.end))
        return '' if self == WHOLE else f'[{begin}:{end}]'


WHOLE = Part()  # all of a bag


@dataclass(frozen=True, slots=True)
class Topics:
    """
    Where the inputs stand in a bag, which of counts and Imu is read, and which part of it.
    A name matches with or without its leading slash and, where only one topic fits, with any
    namespace in front. Where a usual name is not there, the bag's only topic of the type is taken.
    Further thermometers are found beside the board's, ``temperature/<name>``, or named.
    """

    counts: str = 'accel/counts'
    imu: str = 'imu/uncompensated'
    board: str = 'temperature/board'
    case: str = 'temperature/case'
    further: Mapping[str, str] = field(default_factory=dict)
    part: Part = WHOLE
    input: Input = 'auto'  # which prefers the counts

    @classmethod
    def named(cls, names: Mapping[str, str], **others: Any) -> Topics:
        """Take topics by ``counts``, ``imu``, ``board``, ``case`` or ``temperature/<name>``."""
        roles: dict[str, Any] = {}
        further = {}
        for name, topic in names.items():
            own = name.removeprefix('temperature/')
            if not topic.strip('/'):
                raise ValueError(f'`{name}` needs the name of a topic')
            if own in _TYPES and (own == name or _TYPES[own] == TEMPERATURE):
                roles[own] = topic
            elif own != name and is_thermometer(own):
                further[own] = topic
            else:
                raise ValueError(
                    f'`{name}` is no input; expected {", ".join(_TYPES)} or temperature/NAME'
                )
        return cls(**roles, further=further, **others)


_USUAL = Topics()


def is_thermometer(name: str) -> bool:
    """Tell whether a further thermometer may be called so."""
    return _NAME.fullmatch(name) is not None


def shown(name: str) -> str:
    """Make a name that comes from a bag fit for one line: no control characters, not too long."""
    return one_line(name if len(name) <= _MAX_SHOWN else name[:_MAX_SHOWN] + '...')


def said_choice(name: str, key: str, wanted: str, among: str = 'only') -> str:
    """Say that a topic was taken for an input by its type; nothing where it is the one wanted."""
    kind = _TYPES[key].rpartition('/')[2]
    return '' if _fits(name, wanted) else f'{shown(name)}, its {among} {kind}, is taken for {key}'


def select_topics(
    present: Present, topics: Topics, require: Collection[Role]
) -> tuple[dict[Role, str], Literal['counts', 'imu'] | None, str | None]:
    """
    Find the topics that feed the roles, as far as they have messages, what the accelerometer's is,
    and what was taken for want of the usual name. RecordingError for a topic that is ambiguous, of
    another type, or required and not there.
    """
    if require and not any(count for _, count in present.values()):
        raise RecordingError('the bag holds no messages')
    found: dict[Role, str] = {}
    keys: dict[Role, str] = {}
    inputs = ['counts', 'imu'] if topics.input == 'auto' else [topics.input]
    for role, own in {'accel': inputs, 'board': ['board'], 'case': ['case']}.items():
        names = {key: name for key in own if (name := _find(present, topics, key)) is not None}
        key = next((key for key, name in names.items() if present[name][1]), next(iter(names), ''))
        if key:
            name = _of_type(present, names[key], _TYPES[key])
            if present[name][1]:
                found[role], keys[role] = name, key
            elif role in require:
                raise RecordingError('the topic has no messages', key=shown(name))
        elif role in require:
            raise _missing(present, {key: getattr(topics, key) for key in own})
    chosen = [said_choice(found[role], key, getattr(topics, key)) for role, key in keys.items()]
    found |= _further(present, topics, found, is_read=bool(require))
    return found, cast(Any, keys.get('accel')), '; '.join(filter(None, chosen)) or None


def _further(
    present: Present, topics: Topics, found: Mapping[Role, str], *, is_read: bool
) -> dict[str, str]:
    """Find the other thermometers: those named, and any beside the board's or the case's."""
    both = {}
    for own, wanted in topics.further.items():
        name = _match(present, wanted, f'temperature/{own}')
        if name is not None:
            both[own] = _of_type(present, name, TEMPERATURE)
        elif is_read:
            raise _missing(present, {f'temperature/{own}': wanted})
    beside = found.get('board') or found.get('case') or ''
    namespace, is_usual, _ = beside.rpartition('temperature/')
    front = f'{namespace}temperature/' if is_usual else '/temperature/'
    taken = {*found.values(), *both.values()}
    for name, (kind, count) in present.items():
        own = name.removeprefix(front)
        is_beside = kind == TEMPERATURE and count and own != name and name not in taken
        if is_beside and is_thermometer(own):
            both.setdefault(own, name)
    return dict(sorted(both.items()))


def _of_type(present: Present, name: str, expected: str) -> str:
    kind = present[name][0]
    if kind != expected:
        reason = f'the topic has type {shown(kind)}, expected {expected}'
        raise RecordingError(reason, key=shown(name))
    return name


def _fits(name: str, wanted: str) -> bool:
    return f'/{name.strip("/")}'.endswith(f'/{wanted.strip("/")}')


def _match(present: Present, wanted: str, key: str) -> str | None:
    """Find a topic by its name, or the only one that has the name behind a namespace."""
    bare = wanted.strip('/')
    spaced = [name for name in present if name.strip('/') == bare][:1]
    spaced = spaced or sorted(name for name in present if name.endswith('/' + bare))
    if len(spaced) > 1:
        raise RecordingError(
            f'several topics end in it: {", ".join(map(shown, spaced[:_MAX_LISTED]))}; '
            f'choose one with --topic {key}=TOPIC',
            key=wanted,
        )
    return spaced[0] if spaced else None


def _find(present: Present, topics: Topics, key: str) -> str | None:
    wanted: str = getattr(topics, key)
    name = _match(present, wanted, key)
    # A case is no board, and a bag without a case's thermometer is an ordinary one.
    if name is not None or key == 'case' or wanted != getattr(_USUAL, key):
        return name
    taken = [getattr(topics, other) for other in _TYPES if other != key]
    taken += topics.further.values()
    only = [
        name
        for name, (kind, count) in present.items()
        if count
        and kind == _TYPES[key]
        and not name.endswith(_OUTPUT)
        and not any(_fits(name, other) for other in taken)
    ]
    return only[0] if len(only) == 1 else None


def _missing(present: Present, wanted: Mapping[str, str]) -> RecordingError:
    names = sorted(present)[:_MAX_LISTED]
    listed = ', '.join(f'{shown(name)} ({shown(present[name][0])})' for name in names)
    if len(present) > len(names):
        listed += f' and {len(present) - len(names)} more'
    option = ' or '.join(f'--topic {key}=TOPIC' for key in wanted)
    return RecordingError(
        f'no such topic; the bag has {listed}; name another with {option}',
        key=' or '.join(wanted.values()),
    )
