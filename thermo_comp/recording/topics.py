# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the search for the inputs' topics in a bag, and error messages for missing topics."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from ..errors import RecordingError, ThermoCompError
from ..plain_yaml import read_plain_yaml
from ..text import one_line
from ..topics import BOARD, CASE, COUNTS, FLAGS, IMU_IN, IMU_OUT, INPUTS, TEMPERATURE, thermometer
from .blocks import Input, Role

#: Message types of thermometers, each with the field that is read if the user names no field.
PLAIN = {TEMPERATURE: '', 'std_msgs/msg/Float32': 'data', 'std_msgs/msg/Float64': 'data'}

_TYPES = {key: topic.type for key, topic in INPUTS.items()}
#: Topic imu/data_raw: the driver's output in REP 145, and also the node's output. Other topics,
#: or metadata, of the bag show whether the driver or the node published imu/data_raw.
_RAW = IMU_OUT.name
#: Parts of the names of vector topics that hold no specific force; 'imagery' and 'advanced', parts
#: of namespaces, are not such names.
_NO_FORCE = re.compile('(?<!i)mag|gyr|angular|veloc|free|euler|rpy|(?<![a-z])d[qv](?![a-z])')

#: Allowed names of further thermometers; `accel`, `board` and `case` are reserved.
_NAME = re.compile(r'(?!(accel|board|case)$)[a-z][a-z0-9_]{0,63}')
#: Message of the commands and of the node for a topic that is named for two inputs.
TWINS = (
    'one topic for both {} and {}: name a single thermometer as the board, not as another input'
)
_MAX_LISTED = 20  # largest number of topics in a message
_MAX_SHOWN = 80  # largest length of a name in a message [characters]

_FIRST_STAMP_S = 1e8  # a limit of a `BagPart` is a stamp if it is this time [s] (1973) or later

Present = Mapping[str, tuple[str, int]]  # type and number of messages of each topic of a bag


@dataclass(frozen=True, slots=True)
class BagPart:
    """Part of a bag from `begin` to before `end`: times since the first sample, or stamps [s]."""

    begin: float | None = None
    end: float | None = None

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.begin, self.end) if limit is not None]
        if not all(isfinite(limit) and limit >= 0.0 for limit in limits):
            raise ValueError('the part of a bag must begin and end at 0 s or a positive time')
        if len({limit >= _FIRST_STAMP_S for limit in limits}) > 1:
            raise ValueError(
                "give both times in seconds from the bag's first sample, or both as stamps "
                '(seconds since 1970)'
            )
        if len(limits) == 2 and not limits[0] < limits[1]:
            raise ValueError(
                f'the part of a bag must end after its begin {limits[0]:.12g} s, '
                f'got {limits[1]:.12g} s'
            )

    @property
    def is_stamped(self) -> bool:
        """Whether begin and end are stamps instead of times since the first sample."""
        return max(self.begin or 0.0, self.end or 0.0) >= _FIRST_STAMP_S

    def limits_ns(self, first_ns: float) -> tuple[float, float]:
        """Return begin and end as stamps; `first_ns`: the bag's first stamp, inf if unknown."""
        origin = 0 if self.is_stamped else first_ns
        begin = -inf if self.begin is None else origin + round(self.begin * 1e9)
        return begin, inf if self.end is None else origin + round(self.end * 1e9)

    def __str__(self) -> str:
        """Return the limits as a suffix of a bag's name, like ``[10:60]``; '' for a whole bag."""
        begin, end = ('' if limit is None else f'{limit:.12g}' for limit in (self.begin, self.end))
        return '' if self == WHOLE else f'[{begin}:{end}]'


WHOLE = BagPart()  # a whole bag


@dataclass(frozen=True, slots=True)
class Topics:
    """
    Topics of the inputs in a bag, the choice of counts or Imu, and the part to read.
    A name matches with or without its leading slash and, if only one topic fits, with any
    namespace. An input other than `case` without a topic of its default name uses the only topic
    of its type; samples are read from an Imu topic (imu/data_raw first) rather than from counts.
    Topics in `further`, and topics ``temperature/<name>`` in the board topic's namespace, are
    thermometers besides board and case.
    A thermometer's reading may be a field, ``TOPIC:FIELD``, as for ``ros2 topic echo --field``.
    """

    counts: str = COUNTS.name
    imu: str = IMU_IN.name
    board: str = BOARD.name
    case: str = CASE.name
    further: Mapping[str, str] = field(default_factory=dict)
    part: BagPart = WHOLE
    input: Input = 'auto'  # 'auto': a topic named as `counts`, else an Imu, else counts by type

    @classmethod
    def named(cls, names: Mapping[str, str], **others: Any) -> 'Topics':
        """
        Build from the topic of each input: counts, imu, board, case, temperature/NAME.
        If the topic of only one of ``counts`` and ``imu`` is given, this input is read.
        """
        roles: dict[str, Any] = {}
        further = {}
        for name, topic in names.items():
            if name == 'output':  # the node's output is not an input
                continue
            role = name.removeprefix('temperature/')
            if not topic.strip('/'):
                raise ValueError(f'`{name}` needs the name of a topic')
            if ':' in topic and role in ('counts', 'imu'):
                raise ValueError(f'`{name}` takes whole messages, got the field {topic}')
            if role in _TYPES and (role == name or _TYPES[role] == TEMPERATURE):
                roles[role] = topic
            elif role != name and is_thermometer(role):
                further[role] = topic
            else:
                raise ValueError(
                    f'`{name}` is not an input; expected {", ".join(_TYPES)} or temperature/NAME'
                )
        given = [key for key in ('counts', 'imu') if key in roles]
        if len(given) == 1 and others.get('input', 'auto') == 'auto':
            others['input'] = given[0]
        return cls(**roles, further=further, **others)


_USUAL = Topics()


class Selected(NamedTuple):
    """Topic and field of each role; kind of the samples; notes on topics chosen by their type."""

    topics: dict[Role, str]
    fields: dict[Role, str]
    input: Literal['counts', 'imu'] | None
    chosen: str | None


def read_names(path: str | Path) -> dict[str, str]:
    """Read the topic of each input from a YAML file like the files in config/drivers."""
    names = read_plain_yaml(path)
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise ThermoCompError('expected lines INPUT: TOPIC, like board: /imu/temperature', path)
    return names


def parse_name(text: str) -> tuple[str, str]:
    """Read ``INPUT=TOPIC``; ValueError for text of another form."""
    name, equals, topic = text.strip().partition('=')
    if not equals:
        raise ValueError(f'expected INPUT=TOPIC, got {text}')
    return name, topic


def split_field(topic: str) -> tuple[str, str]:
    """Split ``TOPIC:FIELD`` into topic and field; the field is '' if none is given."""
    name, _, field = topic.partition(':')
    return name, field


def is_thermometer(name: str) -> bool:
    """Whether a name is allowed for a further thermometer."""
    return _NAME.fullmatch(name) is not None


def shown(name: str) -> str:
    """Return a name from a bag for a message: shortened, without control characters."""
    return one_line(name if len(name) <= _MAX_SHOWN else name[:_MAX_SHOWN] + '...')


def choice_note(name: str, key: str, wanted: str, among: str) -> str:
    """Return the note that a topic was chosen by its type; '' for a topic of the wanted name."""
    if is_called(name, split_field(wanted)[0]):
        return ''
    kind = _TYPES[key].rpartition('/')[2]
    return f'{shown(name)}, the {among} {kind} of the bag, is taken for {key}'


def select_topics(
    present: Present, topics: Topics, require: Collection[Role], metadata: Mapping[str, str]
) -> Selected:
    """
    Find the topic of each role among the topics with messages. RecordingError for a topic that is
    ambiguous, has a wrong type, is used twice, or is in `require` and missing.
    """
    if require and not any(count for _, count in present.values()):
        raise RecordingError('the bag holds no messages')
    name_of: dict[Role, str] = {}
    keys: dict[Role, str] = {}
    chosen: list[str] = []
    corrected = _corrected(present, metadata)
    inputs = ['counts', 'imu'] if topics.input == 'auto' else [topics.input]
    for role, wanted in {'accel': inputs, 'board': ['board'], 'case': ['case']}.items():
        names = dict(_candidates(present, topics, wanted, corrected))
        key = next((key for key, name in names.items() if present[name][1]), next(iter(names), ''))
        if key:
            name = _of_type(present, names[key], _TYPES[key], getattr(topics, key))
            if present[name][1]:
                name_of[role], keys[role] = name, key
                among = "driver's" if is_called(name, _RAW) else 'only'
                chosen.append(choice_note(name, key, getattr(topics, key), among))
            elif role in require:
                raise RecordingError('the topic has no messages', key=shown(name))
        elif role in require:
            raise _missing(present, {key: getattr(topics, key) for key in wanted}, corrected)
    if corrected and 'accel' not in name_of:
        chosen.append(_text_of_corrected(corrected))
    name_of |= _further(present, topics, name_of, is_read=bool(require))
    if 'accel' in name_of and 'board' not in name_of:
        chosen.append(_text_of_unnamed(present, topics.board, set(name_of.values())))
    named = {**topics.further, 'board': topics.board, 'case': topics.case}
    fields: dict[Role, str] = {}
    roles: dict[tuple[str, str], Role] = {}
    for role, name in name_of.items():
        field = split_field(named.get(role, ''))[1] or PLAIN.get(present[name][0], '')
        if (twin := roles.setdefault((name, field), role)) != role:
            raise RecordingError(TWINS.format(twin, role), key=shown(name))
        if field:
            fields[role] = field
    text = '; '.join(filter(None, chosen)) or None
    return Selected(name_of, fields, cast(Any, keys.get('accel')), text)


def _candidates(
    present: Present, topics: Topics, keys: Sequence[str], corrected: str
) -> Iterator[tuple[str, str]]:
    """Yield input and topic: first by the topic's name, then by REP 145 or the topic's type."""
    for key in keys:
        if (name := _match(present, getattr(topics, key), key)) is not None:
            yield key, name
            if present[name][1]:
                return
    usual = [key for key in keys if getattr(topics, key) == getattr(_USUAL, key)]
    taken = [*(getattr(topics, other) for other in _TYPES), *topics.further.values()]
    for key in ('imu', 'counts', 'board'):
        if key not in usual:
            continue
        of_type = [
            name
            for name in of_kind(present, _TYPES[key])
            if name != corrected and not any(is_called(name, other) for other in taken)
        ]
        only = [name for name in of_type if is_called(name, _RAW)] or of_type
        if key == 'counts':
            only = [name for name in only if not _NO_FORCE.search(name)]
        if len(only) == 1:
            yield key, only[0]
        if of_type and key == 'imu':
            return  # the choice between several Imu topics is left to the user: do not try counts


def of_kind(present: Present, kind: str) -> list[str]:
    """List the topics of a type that have messages."""
    return [name for name, (type_, count) in present.items() if type_ == kind and count]


def _corrected(present: Present, metadata: Mapping[str, str]) -> str:
    """Return the topic of corrected data that the node or `replay` wrote; '' without one."""
    for name in present:
        front = name.removesuffix(_RAW)
        is_beside = any(front + flag.name in present for flag in FLAGS)
        if is_called(name, _RAW) and (is_beside or 'corrected_by' in metadata):
            return name
    return ''


def _text_of_corrected(name: str) -> str:
    return f'{shown(name)} is no input: thermo_comp wrote it, its samples are corrected already'


def _text_of_unnamed(present: Present, board: str, taken: Collection[str]) -> str:
    """Return advice that an unused temperature topic may be the board's; '' if all are used."""
    names = sorted(shown(name) for name in of_kind(present, TEMPERATURE) if name not in taken)
    among = ' or '.join(names)
    text = f'no {board}: if the board thermometer is {among}, give --topic board=TOPIC'
    return text if names else ''


def _further(
    present: Present, topics: Topics, topics_of: Mapping[Role, str], *, is_read: bool
) -> dict[str, str]:
    """Find the thermometers in `topics.further`, and those in the namespace of board or case."""
    further = {}
    for sensor, wanted in topics.further.items():
        name = _match(present, wanted, thermometer(sensor))
        if name is not None:
            further[sensor] = _of_type(present, name, TEMPERATURE, wanted)
        elif is_read:
            raise _missing(present, {thermometer(sensor): wanted})
    beside = topics_of.get('board') or topics_of.get('case') or ''
    namespace, is_usual, _ = beside.rpartition('temperature/')
    front = f'{namespace}temperature/' if is_usual else '/temperature/'
    taken = {*topics_of.values(), *further.values()}
    for name in of_kind(present, TEMPERATURE):
        sensor = name.removeprefix(front)
        if sensor != name and name not in taken and is_thermometer(sensor):
            further.setdefault(sensor, name)
    return dict(sorted(further.items()))


def _of_type(present: Present, name: str, expected: str, wanted: str) -> str:
    kind = present[name][0]
    is_number = expected == TEMPERATURE and (split_field(wanted)[1] or kind in PLAIN)
    if kind != expected and not is_number:
        if expected == TEMPERATURE:
            expected += ', std_msgs/msg/Float32 or Float64; else name a field, TOPIC:FIELD'
        reason = f'the topic has type {shown(kind)}, expected {expected}'
        raise RecordingError(reason, key=shown(name))
    return name


def is_called(name: str, wanted: str) -> bool:
    """Whether a topic of a bag has the wanted name, with or without a namespace."""
    return f'/{name.strip("/")}'.endswith(f'/{wanted.strip("/")}')


def _match(present: Present, wanted: str, key: str) -> str | None:
    """Return the topic with a name, or else the only topic with this name in a namespace."""
    bare = split_field(wanted)[0].strip('/')
    names = [name for name in present if name.strip('/') == bare][:1]
    names = names or sorted(name for name in present if name.endswith('/' + bare))
    if len(names) > 1:
        raise RecordingError(
            f'several topics end in this name: {", ".join(map(shown, names[:_MAX_LISTED]))}; '
            f'choose one with --topic {key}=TOPIC',
            key=wanted,
        )
    return names[0] if names else None


def _missing(present: Present, wanted: Mapping[str, str], corrected: str = '') -> RecordingError:
    names = sorted(present)[:_MAX_LISTED]
    listed = ', '.join(f'{shown(name)} ({shown(present[name][0])})' for name in names)
    if len(present) > len(names):
        listed += f' and {len(present) - len(names)} more'
    if corrected and not {'counts', 'imu'}.isdisjoint(wanted):
        listed += f'; {_text_of_corrected(corrected)}'
    if wanted.keys() == {'imu'} and any(is_called(name, _USUAL.counts) for name in present):
        listed += '; the calibration or --input requires an Imu in m/s^2, not counts'
    option = ' or '.join(f'--topic {key}=TOPIC' for key in wanted)
    reason = f'no such topic; the bag has {listed}; name another with {option}'
    return RecordingError(reason, key=' or '.join(wanted.values()))
