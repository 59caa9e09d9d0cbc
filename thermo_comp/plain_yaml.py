# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of YAML as plain values: mappings, lists, texts, numbers, true, false and null.

Scalars are those of YAML 1.2, so 1e-05 is a number and `no` is a text. Repeated keys are refused,
as are aliases, which could expand a small file to large data, and tags, which could build Python
objects. The parser's events are read in one pass, so that a file with too many levels or values
is refused before its values take memory.
"""

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import yaml

from .errors import ThermoCompError
from .files import read_bounded

DEPTH_LIMIT = 12  # largest number of nested lists and mappings
#: Largest number of keys, values, lists and mappings of a file: three times the number in a file
#: with all columns of `unit.columns.bank` for two thermometers, except the kind `bend`.
NODE_LIMIT = 20_000
_FILE_LIMIT = 1 << 16  # size limit of hand-written YAML files [bytes], which usually have a few kB
_INVALID = 'not valid YAML'
_INTEGER_DIGITS = 20  # digits of the longest integer accepted; a float64 needs no more
_INTEGER = re.compile(r'[-+]?[0-9]+')
_FLOAT = re.compile(r'[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?|\.inf)|\.nan')
_WORDS = {'': None, '~': None, 'null': None, 'true': True, 'false': False}
_LOADER: type[yaml.SafeLoader] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class PlainYamlError(ValueError):
    """A text that is not plain YAML; `detail` may quote the text, `problem` does not."""

    def __init__(self, problem: str, line: int | None = None, detail: str = '') -> None:
        where = '' if line is None else f' (line {line})'
        self.rule = f'{problem}{where}'  # the message for users who may not read the file
        super().__init__(f'{problem}: {detail}{where}' if detail else self.rule)


def load_plain_yaml(text: str | bytes, node_limit: int = NODE_LIMIT) -> Any:
    """Read a YAML document, None if empty; PlainYamlError if the text is not plain YAML."""
    try:
        return _load(text, node_limit)
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        problem = getattr(error, 'problem', None) or str(error).splitlines()[0]
        line = None if mark is None else mark.line + 1
        raise PlainYamlError(_INVALID, line, problem) from error
    except UnicodeEncodeError as error:
        raise PlainYamlError(_INVALID, detail=error.reason) from error


def read_plain_yaml(path: str | Path) -> Any:
    """Read a YAML file; a file that is not plain YAML raises a ThermoCompError with its name."""
    try:
        return load_plain_yaml(read_bounded(path, _FILE_LIMIT).decode())
    except OSError as error:
        raise ThermoCompError(f'{path}: cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise ThermoCompError(f'{path}: not UTF-8 text (byte {error.start})') from error
    except ValueError as error:  # the YAML, or the size of the file, was refused
        raise ThermoCompError(f'{path}: {error}') from error


def is_plain_text(text: str) -> bool:
    """Whether `load_plain_yaml` reads an unquoted scalar as a text."""
    return not (text in _WORDS or _INTEGER.fullmatch(text) or _FLOAT.fullmatch(text))


def _load(text: str | bytes, node_limit: int) -> Any:
    def bounded() -> Iterator[Any]:
        for n, event in enumerate(yaml.parse(text, Loader=_LOADER)):
            if n > node_limit:
                raise PlainYamlError(f'more than {node_limit} keys and values')
            yield event

    def value(event: Any, depth: int) -> Any:
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise PlainYamlError('YAML aliases are not accepted', line)
        if event.tag not in (None, '!'):
            raise PlainYamlError('YAML tags are not accepted', line)
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event.value, line) if event.implicit[0] else event.value
        if depth == DEPTH_LIMIT:
            raise PlainYamlError(f'nested deeper than {DEPTH_LIMIT} levels', line)
        inner = takewhile(lambda inside: not isinstance(inside, yaml.CollectionEndEvent), events)
        if isinstance(event, yaml.SequenceStartEvent):
            return [value(part, depth + 1) for part in inner]
        collected: dict[str, Any] = {}
        for key_event in inner:
            key, line = value(key_event, depth + 1), key_event.start_mark.line + 1
            if type(key) is not str:
                raise PlainYamlError(_INVALID, line, f'a key must be a text, got {key!r:.40}')
            if key in collected:
                raise PlainYamlError(_INVALID, line, f'the key {key!r:.60} occurs twice')
            collected[key] = value(next(events), depth + 1)
        return collected

    events = bounded()
    documents: list[Any] = []
    for event in events:
        if isinstance(event, yaml.DocumentStartEvent) and documents:
            raise PlainYamlError('expected one YAML document, found more')
        if isinstance(event, yaml.NodeEvent):
            documents.append(value(event, 0))
    return documents[0] if documents else None


def _scalar(text: str, line: int) -> Any:
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in '-+.0123456789':
        return text
    if _INTEGER.fullmatch(text):
        if len(text) > _INTEGER_DIGITS:
            detail = f'an integer of {len(text)} digits is not accepted'
            raise PlainYamlError(_INVALID, line, detail)
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text.replace('.inf', 'inf').replace('.nan', 'nan'))
    return text
