# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the options that several commands share, each with one meaning everywhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ..errors import ThermoCompError
from ..text import valid_serial

if TYPE_CHECKING:
    from ..recording import Topics


InputChoice = Literal['auto', 'counts', 'imu']
ModelChoice = Literal['response', 'golovach']
CurveChoice = Literal['linear', 'quadratic', 'cubic', 'spline', 'exponential']


def check_serial(serial: str | None) -> str | None:
    """Refuse what can be no serial; an empty one is for the command to judge."""
    if serial:
        with usage_of():
            valid_serial(serial)
    return serial


TableRate = Annotated[
    float | None,
    typer.Option(help='Samples per second of a table without times.', min=0.01, max=1e6),
]
Model = Annotated[
    ModelChoice, typer.Option(help="The thermal response, or the paper's two sets alone.")
]
StaticCurve = Annotated[
    CurveChoice | None,
    typer.Option(help="Bias and scale over temperature; else the model's own.", metavar='CURVE'),
]
DynamicCurve = Annotated[
    CurveChoice | None,
    typer.Option(help='The same of the dynamic set, by itself.', metavar='CURVE'),
]
Json = Annotated[bool, typer.Option('--json', help='Print the result as one JSON object.')]
Quiet = Annotated[bool, typer.Option('--quiet', '-q', help='Print nothing but errors.')]
Force = Annotated[bool, typer.Option('--force', '-f', help='Overwrite one of the same kind.')]
CalibrationFile = Annotated[
    Path, typer.Option('--calibration', '-c', help='Calibration of the unit (YAML).')
]
Bag = Annotated[
    Path, typer.Argument(help='rosbag2 directory, .mcap, .db3 or ROS 1 .bag.', metavar='BAG')
]
Topic = Annotated[
    list[str] | None,
    typer.Option(
        help='Where an input stands: counts, imu, board, case, temperature/NAME.',
        metavar='INPUT=TOPIC',
    ),
]
TopicsFile = Annotated[
    Path | None, typer.Option(help='The same from a file, INPUT: TOPIC a line.', metavar='YAML')
]
Begin = Annotated[
    float | None,
    typer.Option(
        '--from',
        help='Read each bag from there on: seconds from its first sample, or a stamp.',
        metavar='S',
    ),
]
End = Annotated[float | None, typer.Option('--to', help='Read to there.', metavar='S')]
InputOption = Annotated[InputChoice, typer.Option('--input', help='What is read from the bag.')]
Gravity = Annotated[
    float | None, typer.Option('--gravity', help='Local gravity in m/s^2.', metavar='G')
]
Latitude = Annotated[
    float | None, typer.Option('--latitude', help='Latitude in degrees, with --height.')
]
Height = Annotated[float | None, typer.Option('--height', help='Height above the ellipsoid in m.')]
Serial = Annotated[
    str | None,
    typer.Option(
        '--serial',
        help="Serial of the unit, instead of the bag's; '' accepts any calibration.",
        callback=check_serial,
    ),
]
NewSerial = Annotated[
    str | None,
    typer.Option('--serial', help="Serial, instead of the bags'.", callback=check_serial),
]
FullScale = Annotated[
    float | None, typer.Option(help='Magnitude of a saturated sample, in input units.')
]
ReferenceTemperature = Annotated[
    float, typer.Option(help='Reference temperature in degC.', min=-273.15, max=1000.0)
]
Allow = Annotated[
    list[str] | None, typer.Option(help='Refusal to override, as its message names it.')
]
JudgedBags = Annotated[
    list[Path] | None, typer.Argument(help='Bags to judge it on.', metavar='[BAG]...')
]
Offset = Annotated[
    float | None,
    typer.Option(
        help='What raw words read without a force, as 32768; found out by itself if it can.',
        metavar='WORD',
    ),
]
Window = Annotated[
    float, typer.Option('--window', help='Length of a window at rest, in s.', metavar='S')
]
CertificateInfo = Annotated[
    Path | None, typer.Option(help='What the laboratory states: number, customer, ... (YAML).')
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        '--tolerance', help='Largest RMS of |f| - g you accept: 100ug, 0.5mg, 1e-3m/s^2.'
    ),
]
AgeingBias = Annotated[
    str | None,
    typer.Option(help="What the biases may have changed by since the prior's: 50ug, 0.1mg."),
]

MinRest = Annotated[
    float | None,
    typer.Option(
        help='Shortest rest used, in s; else 3, or less where short ones tell more.',
        metavar='S',
        show_default=False,
    ),
]
StillSd = Annotated[
    str, typer.Option(help="Largest scatter of samples at rest: a few times the sensor's noise.")
]


def acceleration(text: str | None, name: str = '--tolerance') -> float | None:
    """Read an acceleration with its unit [m/s^2]; None where none is given."""
    from ..unit.gravity import parse_acceleration

    with usage_of(f'{name}: '):
        return None if text is None else parse_acceleration(text)


def positive(value: float, name: str) -> float:
    """Refuse a number that is not positive and finite."""
    if not 0.0 < value < float('inf'):
        raise usage(f'{name} must be positive, got {value:g}')
    return value


def duration(text: str, name: str) -> float:
    """Read a duration with its unit, like ``45min``, ``1.5h`` or ``30s`` [s]."""
    found = re.fullmatch(r'\s*(\d+\.?\d*|\.\d+)\s*(h|min|s)\s*', text)
    if found is None:
        raise usage(f'{name}: expected a duration like 45min, 1.5h or 30s, got {text!r}')
    return positive(float(found[1]) * {'h': 3600.0, 'min': 60.0, 's': 1.0}[found[2]], name)


def named_topics(given: list[str] | None, profile: Path | None) -> dict[str, str]:
    """Collect what `--topic` says, and what of the profile it does not."""
    names = {} if profile is None else _read_profile(profile)
    for one in given or ():
        name, equals, topic = one.partition('=')
        if not equals:
            raise usage(f'--topic: expected INPUT=TOPIC, got {one}')
        names[name] = topic
    return names


def _read_profile(path: Path) -> dict[str, str]:
    from ..plain_yaml import read_plain_yaml

    names = read_plain_yaml(path)
    if not isinstance(names, dict) or not all(isinstance(one, str) for one in names.values()):
        raise ThermoCompError(f'{path}: expected INPUT: TOPIC, one a line')
    return names


def topics_of(
    given: list[str] | None,
    profile: Path | None,
    begin: float | None = None,
    end: float | None = None,
) -> Topics:
    """Read where the inputs stand in a bag, and what part of it is meant."""
    from ..recording import Part, Topics

    with usage_of('--from, --to: '):
        part = Part(begin, end)
    with usage_of('--topic: '):
        return Topics.named(named_topics(given, profile), part)


def place(gravity: float | None, latitude: float | None, height: float | None) -> float | None:
    """Return local gravity, None where nothing was given; latitude and height go together."""
    if gravity is not None or (latitude is None and height is None):
        return gravity
    if latitude is None or height is None:
        raise usage('give --gravity, or --latitude and --height')
    from ..fitting import normal_gravity

    with usage_of():
        return normal_gravity(latitude, height)


def needed_place(gravity: float | None, latitude: float | None, height: float | None) -> float:
    """Return local gravity where a command cannot do without; FitError where it is none."""
    from ..fitting import resolve_gravity

    known = place(gravity, latitude, height)
    if known is None:
        raise usage('give --gravity, or --latitude and --height')
    return resolve_gravity(known, None, None)


def usage(message: str, **context: Any) -> typer.BadParameter:
    """Return a mistake in the command line, to be raised: exit code 2."""
    return typer.BadParameter(message, **context)


@contextmanager
def usage_of(what: str = '') -> Iterator[None]:
    """Take a ValueError of the block for a mistake in the command line."""
    try:
        yield
    except ValueError as mistake:
        raise usage(f'{what}{mistake}') from mistake
