# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the search for the inputs' topics in a bag, and the sentences said when one is not there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..errors import RecordingError
from .columns import Input, Role, Topics

VECTOR3_STAMPED = 'geometry_msgs/msg/Vector3Stamped'
IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
BOOL = 'std_msgs/msg/Bool'

_TYPES = {'counts': VECTOR3_STAMPED, 'imu': IMU, 'board': TEMPERATURE, 'case': TEMPERATURE}
_OPTIONS = {key: f'--{key}-topic' for key in _TYPES}


_MAX_LISTED = 20
_MAX_SHOWN = 80


def shown(name: str) -> str:
    """
    Make a name that comes from a bag fit for one line of text.

    Parameters
    ----------
    name : str
        Whatever stands in the bag.

    Returns
    -------
    str
        Without control characters, shortened.

    """
    short = name if len(name) <= _MAX_SHOWN else name[:_MAX_SHOWN] + '...'
    return ''.join(c if c.isprintable() else c.encode('unicode_escape').decode() for c in short)


@dataclass(frozen=True, slots=True)
class Selection:
    """
    Which topics of a bag feed which role.

    Attributes
    ----------
    topics : mapping of {'accel', 'board', 'case'} to str
        The bag's own name of each topic that is there and has messages.
    input : {'counts', 'imu'} or None
        What the accelerometer topic is; None where the bag has none.

    """

    topics: Mapping[Role, str]
    input: Literal['counts', 'imu'] | None


def select_topics(
    path: Path,
    present: Mapping[str, tuple[str, int]],
    topics: Topics,
    input: Input,  # noqa: A002 - the parameter's public name
    require: Collection[Role],
) -> Selection:
    """
    Find the topics of the accelerometer and of the two thermometers.

    Parameters
    ----------
    path : Path
        The bag, for the error's text.
    present : mapping of str to (str, int)
        The bag's topics with their type and number of messages.
    topics : Topics
        The names looked for.
    input : {'auto', 'counts', 'imu'}
        With ``auto`` the counts are taken where the bag has them, else the Imu messages.
    require : collection of {'accel', 'board', 'case'}
        The roles without which the bag is of no use.

    Raises
    ------
    RecordingError
        Empty bag; a required topic that is missing, ambiguous or without messages; a topic of
        another type than expected.

    """
    if require and not any(count for _, count in present.values()):
        raise RecordingError('the bag holds no messages', path)
    found: dict[Role, str] = {}
    accel = _accel_key(path, present, topics, input)
    keys: dict[Role, str | None] = {'accel': accel, 'board': 'board', 'case': 'case'}
    for role, key in keys.items():
        name = None if key is None else _find(path, present, getattr(topics, key), key)
        if name is None or key is None:
            if role in require:
                raise _missing(path, present, topics, key)
            continue
        _check_type(path, name, present[name][0], key)
        if present[name][1]:
            found[role] = name
        elif role in require:
            raise RecordingError('the topic has no messages', path, shown(name))
    return Selection(found, accel if 'accel' in found else None)


def _accel_key(
    path: Path,
    present: Mapping[str, tuple[str, int]],
    topics: Topics,
    input: Input,  # noqa: A002
) -> Literal['counts', 'imu'] | None:
    if input != 'auto':
        return input
    empty: Literal['counts', 'imu'] | None = None
    for key in ('counts', 'imu'):
        name = _find(path, present, getattr(topics, key), key)
        if name is not None:
            if present[name][1]:
                return key
            empty = empty or key
    return empty


def _find(path: Path, present: Mapping[str, tuple[str, int]], wanted: str, key: str) -> str | None:
    bare = wanted.strip('/')
    exact = [name for name in present if name.strip('/') == bare]
    if exact:
        return exact[0]
    spaced = sorted(name for name in present if name.endswith('/' + bare))
    if len(spaced) > 1:
        raise RecordingError(
            f'several topics end in it: {", ".join(map(shown, spaced[:_MAX_LISTED]))}; '
            f'choose one with {_OPTIONS[key]}',
            path,
            wanted,
        )
    return spaced[0] if spaced else None


def _check_type(path: Path, name: str, found: str, key: str) -> None:
    if found != _TYPES[key]:
        raise RecordingError(
            f'the topic has type {shown(found)}, expected {_TYPES[key]}', path, shown(name)
        )


def _missing(
    path: Path, present: Mapping[str, tuple[str, int]], topics: Topics, key: str | None
) -> RecordingError:
    names = sorted(present)[:_MAX_LISTED]
    listed = ', '.join(f'{shown(name)} ({shown(present[name][0])})' for name in names)
    if len(present) > len(names):
        listed += f' and {len(present) - len(names)} more'
    if key is None:
        wanted = f'{topics.counts} or {topics.imu}'
        option = f'{_OPTIONS["counts"]} or {_OPTIONS["imu"]}'
    else:
        wanted, option = getattr(topics, key), _OPTIONS[key]
    return RecordingError(
        f'no such topic; the bag has {listed}; name another with {option}', path, wanted
    )
