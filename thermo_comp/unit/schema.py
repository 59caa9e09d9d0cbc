# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the conversion of plain values to dataclasses and back: type hints are the schema of a file.

Hints are float, int, bool, str, Literal, tuple, dataclass, None, unions of these types, and
``Annotated[hint, Bounds(...), 'description']``. A mapping is converted to a dataclass, a list to
a tuple, an integer to a float; other conversions are errors. Each dataclass checks rules between
its keys, and raises a ValueError that starts with a key in backticks.
"""

import dataclasses
import math
import re
import typing
from contextlib import suppress
from functools import lru_cache
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from ..quantities import Bounds

#: Longest name or value in an error message [characters]; valid keys are shorter.
_LONGEST_NAME = 60
_NAMED_FIRST = re.compile(r'`(?P<key>[\w.\[\]]+)` (?P<rest>.*)', re.DOTALL)
_WORDS: dict[Any, str] = {str: 'text', int: 'integer', float: 'number', bool: 'true or false'}

Value = TypeVar('Value')


class SchemaError(ValueError):
    """A value that breaks the schema; `key`: path of its key; `message`: the expected value."""

    def __init__(self, key: str, message: str) -> None:
        self.key = key
        self.message = message
        super().__init__(f'{key}: {message}' if key else message)


#: Three numbers, for the axes x, y, z.
Vector = tuple[float, float, float]


def build(hint: type[Value], data: Any, key: str = '') -> Value:
    """Build a value of a type hint; SchemaError with the key if `data` do not fit the hint."""
    result: Value = _build(hint, data, key)
    return result


def broken(key: str, rule: str, got: object) -> ValueError:
    """Return the error for a key whose value breaks a rule; `rule`: words after 'must'."""
    shown = f'{got:g}' if isinstance(got, float) else got
    return ValueError(f'`{key}` must {rule}, got {shown}')


def check_ranges(value: object, **spans: Bounds) -> None:
    """Raise ValueError for a reversed range, or one narrower than `at_least` of its bounds."""
    for key, span in spans.items():
        lower, upper = getattr(value, key)
        shown = f'[{lower}, {upper}]'
        if not lower < upper:
            raise broken(key, 'be [lower, upper] with lower < upper', shown)
        if span.at_least is not None and not upper - lower >= span.at_least:
            raise broken(key, f'span at least {span.at_least:g} {span.unit}', shown)


def plain(value: Any) -> Any:
    """Turn dataclasses and tuples into mappings and lists: the reverse of `build`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        # The key `kind` selects the schema of the other keys, so it is written first.
        return {'kind': items.pop('kind'), **items} if 'kind' in items else items
    return [plain(item) for item in value] if isinstance(value, tuple) else value


def _build(hint: Any, data: Any, key: str) -> Any:
    if hint in _WORDS:
        return _scalar(hint, data, key)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _object(hint, data, key)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        value = _build(arguments[0], data, key)
        for bounds in arguments[1:]:
            fault = bounds.fault(value) if isinstance(bounds, Bounds) else None
            if fault:
                _refuse(key, fault, data)
        return value
    if origin is Literal:
        if not isinstance(data, str) or data not in arguments:
            _refuse(key, f'must be {_choice([*map(repr, arguments)])}', data)
        return data
    if origin is tuple:
        return _sequence(arguments, data, key)
    return _either(arguments, data, key)


@lru_cache(maxsize=256)
def fields_of(cls: type) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the type hints of a dataclass by key, and the keys that must be given."""
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = dataclasses.fields(cls)
    required = (f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING)
    return {f.name: hints[f.name] for f in fields}, tuple(required)


def _scalar(hint: type, data: Any, key: str) -> Any:
    if hint is float and type(data) is int:
        with suppress(OverflowError):
            return float(data)
    if type(data) is not hint:
        _refuse(key, f'must be a valid {_WORDS[hint]}', data)
    if isinstance(data, float) and not math.isfinite(data):
        _refuse(key, 'must be a finite number', data)
    return data


def _object(cls: type, data: Any, key: str) -> Any:
    if not isinstance(data, dict):
        _refuse(key, 'must be a mapping of keys', data)
    hints, required = fields_of(cls)
    # A misspelt required key is an unknown key, and a missing key: report the unknown key first.
    for name in data:
        if name not in hints:
            others = ', '.join(other for other in hints if other not in data)
            expected = f', expected one of {others}' if others else ''
            raise SchemaError(_joined(key, _shown_name(name)), f'unknown key{expected}')
    for name in required:
        if name not in data:
            raise SchemaError(_joined(key, name), 'this key is missing')
    given = {name: hint for name, hint in hints.items() if name in data}
    values = {name: _build(hint, data[name], _joined(key, name)) for name, hint in given.items()}
    try:
        return cls(**values)
    except ValueError as error:
        named = _NAMED_FIRST.fullmatch(str(error))
        if named is None:
            raise SchemaError(key, str(error)) from error
        raise SchemaError(_joined(key, named['key']), named['rest']) from error


def _sequence(arguments: tuple[Any, ...], data: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        _refuse(key, 'must be a list', data)
    hints = arguments[:1] * len(data) if arguments[-1] is Ellipsis else arguments
    if len(data) != len(hints):
        raise SchemaError(key, f'must have {len(hints)} entries, got {len(data)}')
    pairs = enumerate(zip(hints, data, strict=True))
    return tuple(_build(hint, item, f'{key}[{i}]') for i, (hint, item) in pairs)


def _either(arguments: tuple[Any, ...], data: Any, key: str) -> Any:
    if data is None and type(None) in arguments:
        return None
    hints = [hint for hint in arguments if hint is not type(None)]
    if len(hints) == 1:
        return _build(hints[0], data, key)
    if hints[0] in _WORDS:
        if type(data) not in hints:
            words = sorted(_WORDS[hint] for hint in hints)
            _refuse(key, f'must be a valid {_choice(words)}', data)
        return data
    if not isinstance(data, dict):
        _refuse(key, 'must be a mapping of keys', data)
    kinds = {typing.get_args(fields_of(hint)[0]['kind'])[0]: hint for hint in hints}
    if 'kind' not in data:
        raise SchemaError(_joined(key, 'kind'), 'this key is missing')
    kind = data['kind']
    if not isinstance(kind, str) or kind not in kinds:
        _refuse(_joined(key, 'kind'), f'must be {_choice([*map(repr, kinds)])}', kind)
    return _object(kinds[kind], data, key)


def _refuse(key: str, expected: str, data: Any) -> NoReturn:
    simple = isinstance(data, str | int | float | bool) or data is None
    shown = repr(data)[:_LONGEST_NAME] if simple else f'a {type(data).__name__}'
    raise SchemaError(key, f'{expected}, got {shown}')


def _joined(key: str, name: str) -> str:
    return f'{key}.{name}' if key else name


def _shown_name(name: str) -> str:
    # An invalid name may be any text: show unprintable text by `repr`, and cut long text.
    shown = name if name.isprintable() and len(name) < _LONGEST_NAME else repr(name)
    return shown[:_LONGEST_NAME]


def _choice(words: list[str]) -> str:
    return ' or '.join(part for part in (', '.join(words[:-1]), words[-1]) if part)
