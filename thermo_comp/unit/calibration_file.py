# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the calibration file, from YAML to a validated Calibration and back.

Any bytes give a Calibration, or a CalibrationError that names the key of a wrong value. The size
and nesting of a file are limited; YAML aliases, tags and duplicate keys are refused.
"""

from pathlib import Path
from typing import Any

import yaml

from ..errors import CalibrationError
from ..files import CALIBRATION, read_bounded, write_atomically
from ..plain_yaml import PlainYamlError, is_plain_text, load_plain_yaml
from .calibration import FORMAT_VERSION, Calibration
from .schema import SchemaError, build, fields_of, plain

#: Largest calibration file [bytes]. A calibration with all columns of `columns.bank` but `bend`,
#: and a posterior of full rank, takes 3.3 MB with one sensor besides the board's, 6 MB with two.
SIZE_LIMIT = 1 << 23

#: First line of a written file. A file that begins with this line must end with `_END`, because
#: a file that was cut between two keys could be read as valid.
_HEADER = '# written by thermo_comp: the last line of a complete file is "..."'
_END = '...'

#: Groups and kinds of columns: their names in files of version 0.2.0, and their present names.
_FORMER = {
    'now': 'gradient',
    'neighbour': 'gradient_lag',
    'mixed': 'gradient_x_temperature',
    'even': 'gradient_even',
    'change': 'gradient_even_about_rest',
}
#: Sections of a calibration file with a renamed key: the name in version 0.2.0, the present name.
_FORMER_KEYS = {'detector': ('closes', 'end_condition'), 'posterior': ('rest', 'diagonal')}


def load_calibration(path: str | Path) -> Calibration:
    """
    Read and validate a calibration file.

    Raises CalibrationError, with the name of the file, if the file cannot be read or is not YAML
    of the accepted kind, or for a wrong value, with its key and the expected value.
    """
    try:
        content = read_bounded(path, SIZE_LIMIT)
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise CalibrationError(f'cannot be read: {reason}', path) from error
    return parse_calibration(content, path)


def parse_calibration(content: bytes, path: str | Path | None = None) -> Calibration:
    """Build a Calibration from the bytes of a file; raises CalibrationError if it is not valid."""
    try:
        text = content.decode('utf-8')
        if text.startswith(_HEADER) and text.split()[-1] != _END:
            raise CalibrationError('the file is cut: its last line is not "..."', path)
        data = load_plain_yaml(text)
    except UnicodeDecodeError as error:
        raise CalibrationError(f'not UTF-8 text (byte {error.start})', path) from error
    except PlainYamlError as error:
        raise CalibrationError(str(error), path, rule=error.rule) from error
    if not isinstance(data, dict):
        raise CalibrationError('expected a mapping of keys at the top level', path)
    missing = [key for key in fields_of(Calibration)[1] if key not in data]
    rule = f'not a calibration: the key `{missing[0]}` is missing' if missing else None
    version = data.get('format_version')
    # Check the version before the keys: keys of another version would be reported as unknown.
    if type(version) is int and version != FORMAT_VERSION:
        advice = 'the file is of a newer release; update thermo_comp'
        if version < FORMAT_VERSION:
            advice = 'fit the bags again'
        message = f'must be {FORMAT_VERSION}, got {version}: {advice}'
        raise CalibrationError(message, path, 'format_version', rule)
    _rename(data)
    try:
        return build(Calibration, data)
    except SchemaError as error:
        raise CalibrationError(error.message, path, error.key or None, rule) from error


def _rename(data: dict[str, Any]) -> None:
    """Replace former keys and former names of columns in the values of a calibration file."""
    gyroscope = data.get('gyroscope')
    for holder in (data, gyroscope) if isinstance(gyroscope, dict) else (data,):
        for name, (former, key) in _FORMER_KEYS.items():
            section = holder.get(name)
            if isinstance(section, dict) and former in section and key not in section:
                section[key] = section.pop(former)
        for entries in (holder.get('response'), holder.get('evidence')):
            for entry in entries if isinstance(entries, list) else ():
                for key in ('group', 'kind') if isinstance(entry, dict) else ():
                    if isinstance(name := entry.get(key), str):
                        entry[key] = _FORMER.get(name, name)


def dump_calibration(calibration: Calibration) -> str:
    """Return YAML of a Calibration; CalibrationError if too large, or not equal if read again."""
    content: str = yaml.dump(
        plain(calibration),
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=98,
        allow_unicode=True,
    )
    text = f'{_HEADER}\n{content}{_END}\n'
    size = len(text.encode())
    if size > SIZE_LIMIT:
        raise CalibrationError(
            f'the calibration takes {size} bytes, at most {SIZE_LIMIT} are accepted'
        )
    if parse_calibration(text.encode()) != calibration:
        raise CalibrationError('the written text, read again, gives other values')
    return text


def save_calibration(
    calibration: Calibration, path: str | Path, *, overwrite: bool = True
) -> None:
    """
    Write a calibration file atomically; an error leaves an existing file unchanged.

    Raises CalibrationError if the calibration is not valid or its text too large, and OutputError
    if the file may not or cannot be written.
    """
    text = dump_calibration(calibration)
    write_atomically(path, text.encode(), CALIBRATION, overwrite=overwrite)


_BASE: type[yaml.SafeDumper] = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)


class _Dumper(_BASE):  # type: ignore[valid-type, misc]
    """Writes YAML without aliases; `_represent_str` quotes texts that look like other types."""

    def ignore_aliases(self, _data: Any) -> bool:
        return True


def _represent_str(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    # Quote text that YAML 1.1 or 1.2 reads as another type: '1e5', 'no'.
    style = None if is_plain_text(value) else "'"
    return dumper.represent_scalar('tag:yaml.org,2002:str', value, style=style)


_Dumper.add_representer(str, _represent_str)
