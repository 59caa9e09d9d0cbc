# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the recognition of headings of tables: time, triads, thermometers, and their units.

The recognised columns are printed as a column map, which the user may keep and edit.
"""

import re
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import yaml

_UNIT = re.compile(r'[\[(]([^\])]*)[\])]')
_TIME = re.compile(
    r'(^|_)(time|timestamp|stamp|now|date|datetime|epoch|elapsed|utc|t|ts)(_|$)'
    r'|^(seconds|millis|micros|nanos|(milli|micro|nano)seconds)(_|$)'
)
_TIMES = {
    **dict.fromkeys(('s', 'sec', 'secs', 'second', 'seconds'), 's'),
    **dict.fromkeys(('ms', 'msec', 'millis', 'milliseconds'), 'ms'),
    **dict.fromkeys(('us', 'µs', 'μs', 'usec', 'micros', 'microseconds'), 'us'),
    **dict.fromkeys(('ns', 'nsec', 'nanos', 'nanoseconds'), 'ns'),
}
# Units of time that a column map cannot state: a table with times in such a unit is refused.
_LONG_TIMES = {
    **dict.fromkeys(('min', 'mins', 'minute', 'minutes'), 'min'),
    **dict.fromkeys(('h', 'hr', 'hrs', 'hour', 'hours'), 'h'),
    **dict.fromkeys(('day', 'days'), 'days'),
}
_ACCEL = re.compile('acc|force|(^|_)ac?(_|$)')
_GYRO = re.compile('gyr|omega|rot|rate|angular|(^|_)(g|gy|w)(_|$)')
# `linear_acceleration` is the specific force in sensor_msgs/Imu, but on phones the acceleration
# without gravity, which the check of |f| at rest refuses.
_ROS_ACCEL = re.compile('(^|_)linear_acceleration$')
# Words in the headings of triads of columns that are neither accelerometer nor gyroscope.
_OTHER = re.compile('mag|mfield|orient|euler|quat|angle|lin|free|user|grav|pos|vel(?!ocity)')
_TEMPERATURE = re.compile(
    'temp|tmp|celsius|(^|_)t_?c($|_)|^t_(board|case|imu|die|chip|sensor|air|amb|room|baro)'
)
_OUTSIDE = re.compile('case|air|amb|baro|bmp|aht|room|hous|env')  # thermometers not on the board
# Unit of a temperature at the end of a heading; words of headings that name no temperature.
_DEGREES_END = re.compile('(^|_)(deg_?[cfk]|kelvin|fahrenheit)$')
_NO_READING = re.compile('(^|_)(raw|adc|counts?|lsb|id|rev|status|valid|voltage|volts?|mv)(_|$)')
# A heading like `magnet_c` (ends in the unit's letter) or `board` (a place alone) names a
# thermometer only if the values in its column can be temperatures.
_LETTER = re.compile('_[ck]$|^(board|case|imu|die|chip)_f$')
_PLACE = re.compile('board|case|imu|die|chip')
# Units as written in the brackets of a heading or, with underscores, at the end of a heading.
_ACCELS = {
    'g': 'g',
    'mg': 'mg',
    **dict.fromkeys(('m/s^2', 'm/s2', 'm/s²', 'm s^-2', 'm_s_2', 'm_s2', 'ms2', 'mps2'), 'm/s^2'),
}
_RATES = {
    **dict.fromkeys(('deg/s', '°/s', 'dps', 'deg_s'), 'deg/s'),
    **dict.fromkeys(('rad/s', 'rad s^-1', 'rad_s', 'rads'), 'rad/s'),
}
_DEGREES = {
    **dict.fromkeys(('c', '°c', 'ºc', 'degc', 'deg c', 'celsius'), 'degC'),
    **dict.fromkeys(('k', 'kelvin', 'degk', 'tempk'), 'K'),
    **dict.fromkeys(('f', '°f', 'degf', 'deg f', 'fahrenheit', 'tempf'), 'degF'),
}

Column = str | int
Triple = tuple[Column, Column, Column]


@dataclass(frozen=True)
class Headings:
    """The recognised columns, by heading or number, with units; '' if the heading has no unit."""

    time: Column | None
    time_unit: str  # a unit of a column map, or min, h, days
    accel: Triple
    accel_unit: str
    gyro: Triple | None
    gyro_unit: str
    thermometers: dict[str, tuple[str, str]]  # column and unit of each thermometer


def read_headings(
    headings: Sequence[str], is_plausible: Callable[[str, str], bool] = lambda *_: False
) -> Headings | None:
    """
    Recognise columns by their headings; None if no accelerometer is among the columns.
    `is_plausible(heading, unit)`: whether the values of a column can be temperatures in this unit.
    """
    names = {_plain(heading): heading for heading in reversed(headings)}
    times = [text for name, text in names.items() if _TIME.search(name)]
    times = [text for text in times if not _names_temperature(text)]
    # A heading like `T_magnet_C` is taken for the times only if no other heading names a time.
    times.sort(key=lambda text: _LETTER.search(_plain(text)) is None)
    every = dict(_triads(names))
    triads = {key: three for key, three in every.items() if not _OTHER.search(key)}
    accel = next((three for key, three in triads.items() if _ACCEL.search(key)), triads.get(''))
    accel = accel or next((three for key, three in every.items() if _ROS_ACCEL.search(key)), None)
    if accel is None:
        return None
    # Exclude the accelerometer: the g of a heading like `ax_g` is a unit, and no gyroscope.
    others = (key for key, three in triads.items() if three != accel)
    gyro = next((triads[key] for key in others if _GYRO.search(key)), None)
    time = times[-1] if times else ''
    time_unit, accel_unit = _stated(time, _TIMES | _LONG_TIMES), _stated(accel[0], _ACCELS)
    gyro_unit = _stated(gyro[0], _RATES) if gyro else ''
    taken = {time, *(heading for three in every.values() for heading in three)}
    free = [heading for heading in headings if heading not in taken]
    thermometers = _thermometers(free, names, is_plausible)
    return Headings(time or None, time_unit, accel, accel_unit, gyro, gyro_unit, thermometers)


def _thermometers(
    headings: Sequence[str], names: Container[str], is_plausible: Callable[[str, str], bool]
) -> dict[str, tuple[str, str]]:
    """Return each thermometer's column and unit; `names`: `_plain` of all headings."""
    units = {heading: _stated(heading, _DEGREES) or 'degC' for heading in headings}
    named, places = [], []
    for heading, unit in units.items():
        name = _plain(heading)
        # The last letters of headings like `phase_a`, `phase_b`, `phase_c` are not units.
        is_letter = _LETTER.search(name) is not None and f'{name[:-1]}b' not in names
        if _names_temperature(heading) or (is_letter and is_plausible(heading, unit)):
            named.append(heading)
        elif _PLACE.fullmatch(name) and is_plausible(heading, unit):
            places.append(heading)
    result: dict[str, tuple[str, str]] = {}
    outside = {heading for heading in headings if _OUTSIDE.search(_plain(heading))}
    for heading in sorted((*named, *places), key=outside.__contains__):
        name = 'case' if result and (heading in outside or heading in named) else 'board'
        if name not in result:
            result[name] = heading, units[heading]
        elif heading in named:  # a heading like `imu` names no further thermometer
            result[f't{len(result)}'] = heading, units[heading]
    return result


def map_lines(columns: Any) -> list[str]:
    """Return the lines of the YAML file of a column map."""
    text: str = yaml.safe_dump(
        _given(columns), sort_keys=False, default_flow_style=None, allow_unicode=True, width=10_000
    )
    return text.splitlines()


def _given(value: Any) -> Any:
    """Turn a dataclass into a mapping; leave out default values of all fields except `unit`."""
    if is_dataclass(value):
        pairs = ((field, getattr(value, field.name)) for field in fields(value))
        return {f.name: _given(x) for f, x in pairs if x != f.default or f.name == 'unit'}
    return list(map(_given, value)) if isinstance(value, tuple) else value


def _names_temperature(heading: str) -> bool:
    """Whether a heading names a temperature, by its words or by its unit."""
    unit, name = _UNIT.search(heading), _plain(heading)
    is_unit = unit is not None and unit[1].strip().lower() in _DEGREES
    is_name = _TEMPERATURE.search(name) and not _NO_READING.search(name)
    return bool(is_unit or _DEGREES_END.search(name) or is_name)


def _plain(heading: str) -> str:
    """Convert a heading to lower case with underscores, without its unit."""
    return re.sub(r'[^0-9a-z]+', '_', _UNIT.sub('', heading).strip().lower()).strip('_')


def _stated(heading: str, units: dict[str, str]) -> str:
    """Return the unit in the brackets of a heading or else at its end; '' if there is none."""
    match = _UNIT.search(heading)
    if match:
        return units.get(match[1].strip().lower(), '')
    name = _plain(heading)
    ends = (unit for unit in units if name == unit or name.endswith(f'_{unit}'))
    return units.get(max(ends, key=len, default=''), '')


def _triads(names: dict[str, str]) -> Iterator[tuple[str, tuple[str, str, str]]]:
    """For three headings that differ only in x, y, z, yield their common part and the headings."""
    for name in reversed(names):
        for at in (match.start() for match in re.finditer('x', name)):
            three = [f'{name[:at]}{axis}{name[at + 1 :]}' for axis in 'xyz']
            key = f'{name[:at]}{name[at + 1 :]}'.replace('__', '_').strip('_')
            if all(heading in names for heading in three):
                x, y, z = (names[heading] for heading in three)
                yield key, (x, y, z)
