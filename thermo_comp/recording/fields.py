# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of a number inside messages of any type, by the definition of the message type.

A field is named ``TOPIC:FIELD``, as for ``ros2 topic echo --field``. In plain CDR a number begins
at a multiple of its size, counted from the end of the encapsulation. A string or sequence is its
length, a uint32, followed by its content. A field is read in all messages of a batch at once.
"""

import re
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..typing import Floats, Ints
from .blocks import NO_STAMP_NS
from .serialized import Messages, gather, number_at

_STEP = re.compile(r'([A-Za-z]\w*)(?:\[([0-9]{1,6})\])?')  # name of a field, index of an element
#: Numpy types of the basic types of numbers in messages.
_KINDS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1', 'int8': 'i1', 'uint8': 'u1',
    'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
_EXTREME = re.compile('(^|_)(min|max)(_|$)')
_HEADER = 'std_msgs/msg/Header'
_IDL = '=' * 80 + '\nIDL: '  # text before the name of each type in a definition in IDL

#: Constants and fields of message types; a field is its name and a description as in `rosbags`.
Definitions = Mapping[str, tuple[Any, list[tuple[str, Any]]]]


@lru_cache(maxsize=1)
def typestore() -> Any:
    """Return the message types of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def definitions_of(kind: str, known: Mapping[str, tuple[str, str]]) -> Definitions:
    """Return the types of ROS 2 Jazzy, and the bag's definition of `kind` if the bag has one."""
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    defined: dict[str, Any] = {}
    encoding, text = known.get(kind, ('', ''))
    try:
        if encoding == 'ros2msg':
            defined = get_types_from_msg(text, kind)
        elif encoding == 'ros2idl':
            for part in filter(None, text.split(_IDL)):
                defined |= get_types_from_idl(part.partition('\n')[2] if _IDL in text else part)
    except TypesysError as error:
        raise RecordingError(f'the definition of {kind} cannot be read') from error
    known_types = ChainMap(defined, typestore().fielddefs)
    if kind not in known_types:
        raise RecordingError(f'the bag does not define its type {kind}')
    return known_types


def temperature_fields(kind: str, known: Mapping[str, tuple[str, str]]) -> list[str]:
    """List the number fields with `temp` in the name, without those named as minima or maxima."""
    try:
        fields = definitions_of(kind, known)[kind][1]
    except RecordingError:
        return []
    return [
        name
        for name, (node, content) in fields
        if 'temp' in name.lower()
        and not _EXTREME.search(name.lower())
        and node == _BASE
        and content[0] in _KINDS
    ]


@dataclass(frozen=True, slots=True)
class Field:
    """A number in messages of type `kind`; `path` has the field names that lead to the number."""

    kind: str
    path: str
    definitions: Definitions

    def __post_init__(self) -> None:
        """Raise RecordingError for a path that does not end at a number."""
        self._find(Messages.of([], [], []), self.path)

    @property
    def header(self) -> str:
        """The path to a std_msgs/Header in the message or in its field `header`, or ''."""
        kind, path = self.kind, ''
        for _ in range(2):
            inner = dict(self.definitions[kind][1]).get('header')
            if inner is None or inner[0] != _NAME:
                return ''
            kind, path = inner[1], f'{path}header.'
            if kind == _HEADER:
                return path
        return ''

    def read(self, messages: Messages) -> tuple[Ints, Floats]:
        """Return stamps [ns] (`NO_STAMP_NS` without a header) and numbers, shape (n,)."""
        values = self._find(messages, self.path).astype(np.float64)
        if not self.header:
            return np.full(len(messages), NO_STAMP_NS), values
        stamp = f'{self.header}stamp.'
        seconds, rest = (self._find(messages, stamp + part) for part in ('sec', 'nanosec'))
        return seconds.astype(np.int64) * 10**9 + rest, values

    def _find(self, messages: Messages, path: str) -> Any:
        cursor, kind = _Cursor(messages, self.definitions), self.kind
        description: Any = None
        try:
            for step in path.split('.'):
                match = _STEP.fullmatch(step)
                fields = self.definitions[kind][1] if kind else []
                if match is None or match[1] not in dict(fields):
                    among = ', '.join(name for name, _ in fields[:20]) or 'none'
                    kind = kind or 'a number'
                    raise RecordingError(f'{kind} has the fields {among}, no `{step}`')
                for name, description in fields:
                    if name == match[1]:
                        break
                    cursor.skip(description)
                if match[2] is not None:
                    description = cursor.enter(description, int(match[2]))
                kind = description[1] if description[0] == _NAME else ''
        except RecursionError as error:
            raise RecordingError(f'the message type {self.kind} contains itself') from error
        if description[0] != _BASE or description[1][0] not in _KINDS:
            raise RecordingError(f'`{path}` of {self.kind} is not a number')
        return cursor.number(_KINDS[description[1][0]])


_BASE, _NAME, _ARRAY = 1, 2, 3  # kinds of fields in `rosbags`: number or string, message, array


class _Cursor:
    """The next byte to read in each message of a batch, counted after the encapsulation."""

    def __init__(self, messages: Messages, definitions: Definitions) -> None:
        self._messages, self._definitions = messages, definitions
        self._at = np.zeros(len(messages), np.int64)
        is_whole = messages.size >= 4  # a shorter message lacks a part of the encapsulation
        heads = number_at(gather(messages.data, messages.start * is_whole, 2), 0, '>u2')
        if not is_whole.all() or (heads > 1).any():
            raise RecordingError('expected plain CDR messages (representation 0x0000 or 0x0001)')
        self._is_big = heads == 0

    def number(self, kind: str) -> Any:
        """Read a number of each message, and advance past it."""
        size = int(kind[1:])
        self._leap(1, size)
        rows = gather(self._messages.data, self._messages.start + 4 + self._at - size, size)
        little, big = number_at(rows, 0, f'<{kind}'), number_at(rows, 0, f'>{kind}')
        return np.where(self._is_big, big, little)

    def skip(self, description: Any) -> None:
        """Advance past a field."""
        node, content = description
        if node == _NAME:
            for _, definition in self._definitions[content][1]:
                self.skip(definition)
        elif node != _BASE:
            counts = self._count(description)
            kind = _KINDS.get(content[0][1][0]) if content[0][0] == _BASE else None
            if kind:
                self._leap(counts, int(kind[1:]))
                return
            # Elements of variable size are skipped one by one.
            while (rows := np.flatnonzero(counts > 0)).size:
                some = _Cursor(self._messages.take(rows), self._definitions)
                some._at = self._at[rows]
                some.skip(content[0])
                self._at[rows] = some._at
                counts = counts - 1
        elif content[0] == 'string':
            self._leap(self.number('u4').astype(np.int64), 1)
        elif content[0] in _KINDS:
            self._leap(1, int(_KINDS[content[0]][1:]))
        else:
            raise RecordingError(f'a {content[0]} field before the wanted number is not supported')

    def enter(self, description: Any, place: int) -> Any:
        """Advance to an element of an array or a sequence; return the element's description."""
        if description[0] in (_BASE, _NAME):
            raise RecordingError(f'element [{place}] of a field that is not an array')
        counts, element = self._count(description), description[1][0]
        if (counts <= place).any():
            raise RecordingError(f'element [{place}] of an array of {int(counts.min())} elements')
        for _ in range(place):
            self.skip(element)
        return element

    def _count(self, description: Any) -> Ints:
        if description[0] == _ARRAY:
            return np.full_like(self._at, description[1][1])
        return np.asarray(self.number('u4').astype(np.int64))

    def _leap(self, counts: Ints | int, size: int) -> None:
        """Advance past `counts` numbers of `size` bytes in each message."""
        aligned = (self._at + size - 1) // size * size
        self._at = np.where(counts > 0, aligned + counts * size, self._at)
        if (self._at + 4 > self._messages.size).any():
            raise RecordingError('damaged message: it ends inside a field')
