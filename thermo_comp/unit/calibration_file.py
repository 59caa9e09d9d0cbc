# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the calibration file: YAML to a validated Calibration and back, and its JSON Schema.

The reader takes any bytes at all and answers with a Calibration or a CalibrationError that names
the file and the key: size, nesting and the YAML features it accepts are bounded before anything
is built (no aliases, so no alias bombs; no tags, so no objects; no duplicate keys).

"""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from ..errors import CalibrationError
from ..files import CALIBRATION, read_bounded, write_atomically
from .calibration import FORMAT_VERSION, Calibration

#: A calibration of the largest model takes some 60 kB.
SIZE_LIMIT = 1 << 20
DEPTH_LIMIT = 12
#: Keys, values, lists and mappings: some ten times those of the largest model.
NODE_LIMIT = 20_000
#: Digits of the longest integer accepted; a float64 needs no more.
_INTEGER_DIGITS = 20
#: Longer than any key that there is.
_LONGEST_NAME = 60
_NAMED_FIRST = re.compile(r'`(?P<key>[\w.\[\]]+)` (?P<rest>.*)')

_ADAPTER: TypeAdapter[Calibration] = TypeAdapter(Calibration)
#: A file without all of these is something else.
_REQUIRED = [
    one.name
    for one in dataclasses.fields(Calibration)
    if one.default is one.default_factory is dataclasses.MISSING
]
_BASE: type[yaml.SafeLoader] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[valid-type, misc]
    """
    YAML 1.2 core scalars (so 1e-05 is a number and `no` is a text), no duplicate keys.

    """

    #: Only what JSON knows: an explicit !!binary, !!set or !!timestamp is undefined here.
    yaml_constructors = {  # noqa: RUF012
        tag: constructor
        for tag, constructor in _BASE.yaml_constructors.items()
        if tag is None or tag.rpartition(':')[2] in ('null', 'str', 'seq')
    }
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


def _construct_int(loader: Any, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    if len(text) > _INTEGER_DIGITS:
        raise yaml.constructor.ConstructorError(
            None, None, f'an integer of {len(text)} digits is not accepted', node.start_mark
        )
    return int(text, 10)


def _construct_float(loader: Any, node: yaml.ScalarNode) -> float:
    return float(loader.construct_scalar(node).replace('.inf', 'inf').replace('.nan', 'nan'))


def _construct_bool(loader: Any, node: yaml.ScalarNode) -> bool:
    return bool(loader.construct_scalar(node) == 'true')


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(
                None, None, f'a key must be a text, got {key!r:.40}', key_node.start_mark
            )
        if key in result:
            raise yaml.constructor.ConstructorError(
                None, None, f'the key {key!r:.60} stands twice', key_node.start_mark
            )
        result[key] = loader.construct_object(value_node, deep=True)
    return result


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:null', re.compile(r'^(?:~|null|)$'), ['~', 'n', '']
)
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:bool', re.compile(r'^(?:true|false)$'), list('tf')
)
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:int', re.compile(r'^[-+]?[0-9]+$'), list('-+0123456789')
)
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?|\.inf)$|^\.nan$'),
    list('-+.0123456789'),
)
_Loader.add_constructor('tag:yaml.org,2002:int', _construct_int)
_Loader.add_constructor('tag:yaml.org,2002:float', _construct_float)
_Loader.add_constructor('tag:yaml.org,2002:bool', _construct_bool)
_Loader.add_constructor('tag:yaml.org,2002:map', _construct_mapping)


def load_calibration(path: str | Path) -> Calibration:
    """
    Read and validate a calibration file.

    Parameters
    ----------
    path : str or Path
        The YAML file.

    Returns
    -------
    Calibration
        The one object it holds.

    Raises
    ------
    CalibrationError
        If the file cannot be read, is not YAML of the accepted kind, or holds a value that is
        not acceptable; names the file, the key, the value and what was expected.

    """
    try:
        content = read_bounded(path, SIZE_LIMIT)
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise CalibrationError(f'cannot be read: {reason}', path) from error
    return parse_calibration(content, path)


def parse_calibration(content: bytes, path: str | Path | None = None) -> Calibration:
    """
    Build a Calibration from the bytes of a calibration file.

    Parameters
    ----------
    content : bytes
        YAML text in UTF-8.
    path : str or Path or None, optional
        Named in errors.

    Returns
    -------
    Calibration
        The one object it holds.

    Raises
    ------
    CalibrationError
        As `load_calibration`.

    """
    data = _parse_yaml(content, path)
    if not isinstance(data, dict):
        raise CalibrationError('expected a mapping of keys at the top level', path)
    missing = [key for key in _REQUIRED if key not in data]
    rule = f'not a calibration: the key `{missing[0]}` is missing' if missing else None
    version = data.get('format_version')
    if isinstance(version, int) and not isinstance(version, bool) and version > FORMAT_VERSION:
        raise CalibrationError(
            f'this file is of version {version}, newer than the {FORMAT_VERSION} that this '
            'release reads; update thermo_comp',
            path,
            'format_version',
            rule,
        )
    try:
        return _ADAPTER.validate_json(json.dumps(data))
    except ValidationError as error:
        message, key = _first_problem(error)
        raise CalibrationError(message, path, key, rule) from error


def dump_calibration(calibration: Calibration) -> str:
    """
    Write a Calibration as YAML text with all digits.

    Parameters
    ----------
    calibration : Calibration
        The value.

    Returns
    -------
    str
        A text that `parse_calibration` turns into an equal value.

    Raises
    ------
    CalibrationError
        If the value would not be accepted when read back.

    """
    text: str = yaml.dump(
        _plain(calibration),
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=98,
        allow_unicode=True,
    )
    if parse_calibration(text.encode()) != calibration:
        raise CalibrationError('the calibration does not survive being written')
    return text


def save_calibration(
    calibration: Calibration, path: str | Path, *, overwrite: bool = True
) -> None:
    """
    Write a calibration file atomically.

    Parameters
    ----------
    calibration : Calibration
        The value.
    path : str or Path
        The file.
    overwrite : bool, optional
        Replace a calibration that is there.

    Raises
    ------
    CalibrationError
        If the value is not valid.
    OutputError
        If the file may not or cannot be written; an old one is then untouched.

    """
    text = dump_calibration(calibration)
    write_atomically(path, text.encode(), CALIBRATION, overwrite=overwrite)


def calibration_schema() -> dict[str, Any]:
    """
    Return the JSON Schema of the calibration file.

    """
    return {
        '$schema': 'https://json-schema.org/draft/2020-12/schema',
        **_ADAPTER.json_schema(mode='validation'),
    }


class _Dumper(yaml.SafeDumper):
    """
    Writes every number so that this reader and any YAML 1.1 reader see the same float.

    """

    def ignore_aliases(self, _data: Any) -> bool:
        return True


def _represent_str(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    # A text that one of the two YAML versions would take for a number is quoted: '1e5', 'no'.
    resolved = _Loader.yaml_implicit_resolvers.get(value[:1], [])
    quoted = any(pattern.match(value) for _, pattern in resolved)
    return dumper.represent_scalar(
        'tag:yaml.org,2002:str', value, style="'" if quoted or not value else None
    )


_Dumper.add_representer(str, _represent_str)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        # `kind` decides how the rest is read, so it stands first.
        return {'kind': items.pop('kind'), **items} if 'kind' in items else items
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _parse_yaml(content: bytes, path: str | Path | None) -> Any:
    try:
        text = content.decode('utf-8')
        _check_events(text, path)
        return yaml.load(text, Loader=_Loader)  # noqa: S506 - a SafeLoader with less, not more
    except UnicodeDecodeError as error:
        raise CalibrationError(f'not UTF-8 text (byte {error.start})', path) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' (line {mark.line + 1})' if mark is not None else ''
        problem = getattr(error, 'problem', None) or str(error).splitlines()[0]
        rule = f'not valid YAML{where}'
        raise CalibrationError(f'not valid YAML: {problem}{where}', path, rule=rule) from error


def _check_events(text: str, path: str | Path | None) -> None:
    depth = 0
    documents = 0
    for n, event in enumerate(yaml.parse(text, Loader=_BASE)):
        if n > NODE_LIMIT:
            raise CalibrationError(f'more than {NODE_LIMIT} keys and values', path)
        if isinstance(event, yaml.AliasEvent):
            raise CalibrationError(f'YAML aliases are not accepted ({_line(event)})', path)
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEPTH_LIMIT:
                raise CalibrationError(f'nested deeper than {DEPTH_LIMIT} ({_line(event)})', path)
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.DocumentStartEvent):
            documents += 1
            if documents > 1:
                raise CalibrationError('expected one YAML document, found more', path)


def _line(event: Any) -> str:
    return f'line {event.start_mark.line + 1}'


def _first_problem(error: ValidationError) -> tuple[str, str | None]:
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key gives two problems, and the spelling is the one to be told about.
    unknown = [p for p in problems if p['type'] == 'unexpected_keyword_argument']
    problem = (unknown or problems)[0]
    kinds = ('polynomial', 'spline', 'exponential')
    location = [part for part in problem['loc'] if part not in kinds]
    key = ''
    for part in location:
        if isinstance(part, int):
            key += f'[{part}]'
        else:
            # What is no name can be anything: lines, or pages of text.
            name = part if part.isprintable() and len(part) < _LONGEST_NAME else repr(part)
            key += ('.' if key else '') + f'{name:.{_LONGEST_NAME}}'
    message = problem['msg'].removeprefix('Value error, ')
    # What two keys have to do with each other is checked where both are known, and named there.
    named = _NAMED_FIRST.fullmatch(message)
    if named and problem['type'] == 'value_error':
        key += f'.{named["key"]}' if key else named['key']
        message = named['rest']
    shown = problem.get('input')
    if problem['type'] == 'missing':
        message = 'this key is missing'
    elif problem['type'] == 'unexpected_keyword_argument':
        message = 'unknown key'
    elif isinstance(shown, str | int | float | bool) or shown is None:
        message += f', got {shown!r:.60}'
    if len(problems) > 1:
        message += f' (and {len(problems) - 1} more)'
    return message, key or None
