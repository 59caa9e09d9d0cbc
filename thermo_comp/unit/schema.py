# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the step from plain values to dataclasses and back: type hints are the schema of a file.

Hints are float, int, bool, str, Literal, tuple, dataclass, any of them or None, and
``Annotated[hint, Bounds(...), 'what it means']``. Nothing is converted but an integer to a float
and a list to a tuple. What several keys have to do with each other is the dataclass' own matter:
it raises a ValueError that starts with the key in backticks.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import (
    Annotated,
    Any,
    Literal,
    NoReturn,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

#: Longer than any key that there is.
_LONGEST_NAME = 60
_NAMED_FIRST = re.compile(r'`(?P<key>[\w.\[\]]+)` (?P<rest>.*)', re.DOTALL)
_WORDS: dict[Any, str] = {str: 'text', int: 'integer', float: 'number', bool: 'true or false'}
_JSON_TYPES: dict[Any, str] = {str: 'string', int: 'integer', float: 'number', bool: 'boolean'}

Value = TypeVar('Value')


class SchemaError(ValueError):
    """A value that does not fit: the key's path, and what was expected there."""

    def __init__(self, key: str, message: str) -> None:
        self.key = key
        self.message = message
        super().__init__(f'{key}: {message}' if key else message)


@dataclass(frozen=True)
class Bounds:
    """Where a number must lie, or how long a text must be."""

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    shortest: int = 0
    longest: int | None = None

    def fault(self, value: Any) -> str | None:
        """Say what is expected of a value that does not comply."""
        if isinstance(value, str):
            if len(value) < self.shortest:
                s = '' if self.shortest == 1 else 's'
                return f'must have at least {self.shortest} character{s}'
            if self.longest is not None and len(value) > self.longest:
                return f'must have at most {self.longest} characters'
            return None
        if self.above is not None and not value > self.above:
            return f'must be greater than {self.above:g}'
        if self.at_least is not None and not value >= self.at_least:
            return f'must be at least {self.at_least:g}'
        if self.below is not None and not value < self.below:
            return f'must be less than {self.below:g}'
        return None

    def keywords(self) -> dict[str, float]:
        """Return the same in the words of JSON Schema."""
        words = {
            'exclusiveMinimum': self.above,
            'minimum': self.at_least,
            'exclusiveMaximum': self.below,
            'minLength': self.shortest or None,
            'maxLength': self.longest,
        }
        return {word: value for word, value in words.items() if value is not None}


Positive = Annotated[float, Bounds(above=0.0)]
NotNegative = Annotated[float, Bounds(at_least=0.0)]


def build(hint: type[Value], data: Any, key: str = '') -> Value:
    """
    Build what a type hint says from plain values.

    Raises SchemaError if a key is unknown or missing, or a value is not what the hint says.
    """
    result: Value = _build(hint, data, key)
    return result


@contextmanager
def naming(key: str) -> Iterator[None]:
    """
    Turn a ValueError whose text starts with a key in backticks into a SchemaError of that key.
    """
    try:
        yield
    except SchemaError:
        raise
    except ValueError as error:
        named = _NAMED_FIRST.fullmatch(str(error))
        if named is None:
            raise SchemaError(key, str(error)) from error
        raise SchemaError(_joined(key, named['key']), named['rest']) from error


def plain(value: Any) -> Any:
    """Turn dataclasses and tuples into mappings and lists: the reverse of `build`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        # `kind` decides how the rest is read, so it stands first.
        return {'kind': items.pop('kind'), **items} if 'kind' in items else items
    return [plain(item) for item in value] if isinstance(value, tuple) else value


def required_keys(cls: type) -> tuple[str, ...]:
    """Return the keys of a dataclass that must be given."""
    return _fields(cls)[1]


def json_schema(cls: type) -> dict[str, Any]:
    """Return the JSON Schema of a dataclass and of all that it holds."""
    definitions: dict[str, Any] = {}
    top = _schema(cls, definitions)['$ref'].rpartition('/')[2]
    result = definitions.pop(top)
    return {'$defs': dict(sorted(definitions.items())), **result}


def _build(hint: Any, data: Any, key: str) -> Any:
    if hint is float or hint is int or hint is str or hint is bool:
        return _scalar(hint, data, key)
    if _is_dataclass(hint):
        return _object(hint, data, key)
    origin, arguments = _parts(hint)
    if origin is Annotated:
        value = _build(arguments[0], data, key)
        for bounds in arguments[1:]:
            fault = bounds.fault(value) if isinstance(bounds, Bounds) else None
            if fault:
                _refuse(key, fault, data)
        return value
    if origin is Literal:
        if not isinstance(data, str) or data not in arguments:
            _refuse(key, f'must be {_choice([repr(one) for one in arguments])}', data)
        return data
    if origin is tuple:
        return _sequence(arguments, data, key)
    return _either(arguments, data, key)


def _is_dataclass(hint: Any) -> TypeGuard[type]:
    return dataclasses.is_dataclass(hint)


@lru_cache(maxsize=256)
def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    if get_origin(hint) is Annotated:
        return Annotated, (hint.__origin__, *hint.__metadata__)
    origin = get_origin(hint)
    if origin not in (Literal, tuple, Union, types.UnionType):
        raise TypeError(f'{hint} is no hint that a schema knows')
    return Union if origin is types.UnionType else origin, get_args(hint)


@lru_cache(maxsize=256)
def _fields(cls: type) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the hints of a dataclass by key, and which keys must be given."""
    hints = get_type_hints(cls, include_extras=True)
    fields = dataclasses.fields(cls)
    required = tuple(
        f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING
    )
    return {f.name: hints[f.name] for f in fields}, required


def _scalar(hint: type, data: Any, key: str) -> Any:
    kind = type(data)
    if hint is float and kind is int and math.isfinite(_as_float(data)):
        return float(data)
    if kind is not hint:
        _refuse(key, f'must be a valid {_WORDS[hint]}', data)
    if hint is float and not math.isfinite(data):
        _refuse(key, 'must be a finite number', data)
    return data


def _as_float(value: int) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _object(cls: type, data: Any, key: str) -> Any:
    if not isinstance(data, dict):
        _refuse(key, 'must be a mapping of keys', data)
    hints, required = _fields(cls)
    # A misspelt key is unknown and missing at once, and the spelling is the one to be told about.
    for name in data:
        if name not in hints:
            raise SchemaError(_joined(key, _shown_name(name)), 'unknown key')
    for name in required:
        if name not in data:
            raise SchemaError(_joined(key, name), 'this key is missing')
    values = {
        name: _build(hint, data[name], _joined(key, name))
        for name, hint in hints.items()
        if name in data
    }
    with naming(key):
        return cls(**values)


def _sequence(arguments: tuple[Any, ...], data: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        _refuse(key, 'must be a list', data)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        hints = arguments[:1] * len(data)
    elif len(data) != len(arguments):
        raise SchemaError(key, f'must have {len(arguments)} entries, got {len(data)}')
    else:
        hints = arguments
    return tuple(
        _build(hint, item, f'{key}[{i}]')
        for i, (hint, item) in enumerate(zip(hints, data, strict=True))
    )


def _either(arguments: tuple[Any, ...], data: Any, key: str) -> Any:
    if data is None and type(None) in arguments:
        return None
    hints = [hint for hint in arguments if hint is not type(None)]
    if len(hints) == 1:
        return _build(hints[0], data, key)
    if not all(_is_dataclass(hint) for hint in hints):
        for hint in hints:
            if type(data) is hint:
                return data
        _refuse(key, f'must be a valid {_choice(sorted(_WORDS[hint] for hint in hints))}', data)
    if not isinstance(data, dict):
        _refuse(key, 'must be a mapping of keys', data)
    kinds = {_kind(hint): hint for hint in hints}
    if 'kind' not in data:
        raise SchemaError(_joined(key, 'kind'), 'this key is missing')
    kind = data['kind']
    if not isinstance(kind, str) or kind not in kinds:
        _refuse(_joined(key, 'kind'), f'must be {_choice([repr(one) for one in kinds])}', kind)
    return _object(kinds[kind], data, key)


def _kind(cls: Any) -> str:
    return str(get_args(_fields(cls)[0]['kind'])[0])


def _refuse(key: str, expected: str, data: Any) -> NoReturn:
    simple = isinstance(data, str | int | float | bool) or data is None
    shown = repr(data)[:_LONGEST_NAME] if simple else f'a {type(data).__name__}'
    raise SchemaError(key, f'{expected}, got {shown}')


def _joined(key: str, name: str) -> str:
    return f'{key}.{name}' if key else name


def _shown_name(name: str) -> str:
    # What is no name can be anything: lines, or pages of text.
    shown = name if name.isprintable() and len(name) < _LONGEST_NAME else repr(name)
    return shown[:_LONGEST_NAME]


def _choice(words: list[str]) -> str:
    return ' or '.join(part for part in (', '.join(words[:-1]), words[-1]) if part)


def _schema(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if hint in _JSON_TYPES:
        return {'type': _JSON_TYPES[hint]}
    if _is_dataclass(hint):
        _define(hint, definitions)
        return {'$ref': f'#/$defs/{hint.__name__}'}
    if hint is type(None):
        return {'type': 'null'}
    origin, arguments = _parts(hint)
    if origin is Annotated:
        result = _schema(arguments[0], definitions)
        for note in arguments[1:]:
            result |= note.keywords() if isinstance(note, Bounds) else {'description': note}
        return result
    if origin is Literal:
        one = len(arguments) == 1
        return {'const': arguments[0]} if one else {'enum': list(arguments), 'type': 'string'}
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return {'type': 'array', 'items': _schema(arguments[0], definitions)}
        items = [_schema(one, definitions) for one in arguments]
        n = len(items)
        return {'type': 'array', 'prefixItems': items, 'minItems': n, 'maxItems': n}
    return {'anyOf': [_schema(one, definitions) for one in arguments]}


def _define(cls: Any, definitions: dict[str, Any]) -> None:
    if cls.__name__ in definitions:
        return
    result: dict[str, Any] = {
        'type': 'object',
        'description': inspect.cleandoc(cls.__doc__),
        'additionalProperties': False,
    }
    definitions[cls.__name__] = result
    hints, required = _fields(cls)
    result['properties'] = {name: _schema(hint, definitions) for name, hint in hints.items()}
    for field in dataclasses.fields(cls):
        if field.name not in required:
            factory = field.default_factory
            value = field.default if factory is dataclasses.MISSING else factory()
            result['properties'][field.name]['default'] = plain(value)
    result['required'] = list(required)
