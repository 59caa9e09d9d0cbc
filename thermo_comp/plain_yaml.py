# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns YAML as plain values: mappings, lists, texts, numbers, true, false and null, of bounded size.

Scalars are those of YAML 1.2, so 1e-05 is a number and `no` is a text. No aliases, so no alias
bombs; no tags, so no objects; no key twice. One pass over the events of the parser, without
recursion, so no depth and no number of nodes is reached before it is refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from .errors import ThermoCompError
from .files import read_bounded

DEPTH_LIMIT = 12
#: Keys, values, lists and mappings: some ten times those of the largest calibration.
NODE_LIMIT = 20_000
#: What a user writes by hand takes some kB.
_FILE_LIMIT = 1 << 16
#: Digits of the longest integer accepted; a float64 needs no more.
_INTEGER_DIGITS = 20
_INTEGER = re.compile(r'[-+]?[0-9]+')
_FLOAT = re.compile(r'[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?|\.inf)|\.nan')
_WORDS = {'': None, '~': None, 'null': None, 'true': True, 'false': False}
_LOADER: type[yaml.SafeLoader] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class PlainYamlError(ValueError):
    """
    A text that is not YAML of plain values: what is wrong, quoting nothing, in which line, and a
    detail that may quote the text.
    """

    def __init__(self, problem: str, line: int | None = None, detail: str = '') -> None:
        where = '' if line is None else f' (line {line})'
        #: The same without the detail.
        self.rule = f'{problem}{where}'
        super().__init__(f'{problem}: {detail}{where}' if detail else self.rule)


def load_plain_yaml(
    text: str | bytes, depth_limit: int = DEPTH_LIMIT, node_limit: int = NODE_LIMIT
) -> Any:
    """
    Read one YAML document of plain values, null of an empty text; PlainYamlError where it is none.
    """
    try:
        return _load(text, depth_limit, node_limit)
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        problem = getattr(error, 'problem', None) or str(error).splitlines()[0]
        line = None if mark is None else mark.line + 1
        raise PlainYamlError('not valid YAML', line, problem) from error
    except UnicodeEncodeError as error:
        raise PlainYamlError('not valid YAML', detail=error.reason) from error


def read_plain_yaml(path: str | Path) -> Any:
    """Read a small YAML file of a user's; ThermoCompError, which names it, where it is none."""
    try:
        return load_plain_yaml(read_bounded(path, _FILE_LIMIT).decode())
    except OSError as error:
        raise ThermoCompError(f'{path}: cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise ThermoCompError(f'{path}: not UTF-8 text (byte {error.start})') from error
    except ValueError as error:  # of YAML, of the size
        raise ThermoCompError(f'{path}: {error}') from error


def is_plain_text(text: str) -> bool:
    """Say whether an unquoted scalar is a text here."""
    return not (text in _WORDS or _INTEGER.fullmatch(text) or _FLOAT.fullmatch(text))


def _load(text: str | bytes, depth_limit: int, node_limit: int) -> Any:
    document: list[Any] = []
    #: The open collections, innermost last; a mapping with the key that waits for its value.
    open_ones: list[Any] = [document]
    keys: list[Any] = [None]
    has_document = False
    for n, event in enumerate(yaml.parse(text, Loader=_LOADER)):
        mark: Any = event.start_mark
        line = mark.line + 1
        if n > node_limit:
            raise PlainYamlError(f'more than {node_limit} keys and values')
        if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
            if event.tag not in (None, '!'):
                raise PlainYamlError('YAML tags are not accepted', line)
            holder = open_ones[-1]
            value: Any = [] if isinstance(event, yaml.SequenceStartEvent) else {}
            if isinstance(event, yaml.ScalarEvent):
                value = _scalar(event.value, line) if event.implicit[0] else event.value
            if type(holder) is list:
                holder.append(value)
            elif keys[-1] is not None:
                holder[keys[-1]] = value
                keys[-1] = None
            elif type(value) is not str:
                raise _invalid(line, f'a key must be a text, got {value!r:.40}')
            elif value in holder:
                raise _invalid(line, f'the key {value!r:.60} stands twice')
            else:
                keys[-1] = value
            if isinstance(event, yaml.CollectionStartEvent):
                if len(open_ones) > depth_limit:
                    raise PlainYamlError(f'nested deeper than {depth_limit}', line)
                open_ones.append(value)
                keys.append(None)
        elif isinstance(event, yaml.CollectionEndEvent):
            open_ones.pop()
            keys.pop()
        elif isinstance(event, yaml.AliasEvent):
            raise PlainYamlError('YAML aliases are not accepted', line)
        elif isinstance(event, yaml.DocumentStartEvent):
            if has_document:
                raise PlainYamlError('expected one YAML document, found more')
            has_document = True
    return document[0] if document else None


def _scalar(text: str, line: int) -> Any:
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in '-+.0123456789':
        return text
    if _INTEGER.fullmatch(text):
        if len(text) > _INTEGER_DIGITS:
            raise _invalid(line, f'an integer of {len(text)} digits is not accepted')
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text.replace('.inf', 'inf').replace('.nan', 'nan'))
    return text


def _invalid(line: int, detail: str) -> PlainYamlError:
    return PlainYamlError('not valid YAML', line, detail)
