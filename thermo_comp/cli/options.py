# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the options that several commands share, and what the library takes made of them.

An alias is one option, or, with `Given`, a value that a function makes of several: a command says
what it wants, and `expanded` offers typer the options.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from ..errors import ThermoCompError
from ..text import valid_serial
from .output import Output

if TYPE_CHECKING:
    from ..recording import Topics

#: A mistake in the command line, to be raised: exit code 2.
usage = typer.BadParameter


def option(text: str, *flags: str, **rules: Any) -> Any:
    """Describe an option: what it is for, its flags where they are not its name's, its bounds."""
    return typer.Option(*flags, help=text, **rules)


def argument(text: str, **rules: Any) -> Any:
    """Describe what stands on the command line without a flag."""
    return typer.Argument(help=text, **rules)


@contextmanager
def usage_of(what: str = '') -> Iterator[None]:
    """Take a ValueError of the block for a mistake in the command line."""
    try:
        yield
    except ValueError as mistake:
        raise usage(f'{what}{mistake}') from mistake


def check_serial(serial: str | None) -> str | None:
    """Refuse what can be no serial; an empty one is for the command to judge."""
    if serial:
        with usage_of():
            valid_serial(serial)
    return serial


Force = Annotated[bool, option('Overwrite one of the same kind.', '--force', '-f')]
Quiet = Annotated[bool, option('Print nothing but errors.', '--quiet', '-q')]
NewCalibration = Annotated[Path, option('Calibration to write (YAML).', '--output', '-o')]
JudgedBags = Annotated[list[Path] | None, argument('Bags to judge it on.', metavar='[BAG]...')]
CertificateInfo = Annotated[
    Path | None, option('What the laboratory states: number, customer, ... (YAML).')
]
TableRate = Annotated[
    float | None, option('Samples per second of a table without times.', min=0.01, max=1e6)
]
Serial = Annotated[
    str | None,
    option(
        "Serial of the unit, instead of the bag's; '' accepts any calibration.",
        callback=check_serial,
    ),
]
Offset = Annotated[
    float | None,
    option(
        'What raw words read without a force, as 32768; found out by itself if it can.',
        metavar='WORD',
    ),
]
InputOption = Annotated[
    Literal['auto', 'counts', 'imu'], option('What is read from the bag.', '--input')
]


@dataclass(frozen=True)
class Given:
    """Marks a parameter that is made of the options which `make` takes."""

    make: Callable[..., Any]


def expanded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Make a function of options alone, as typer takes it, of one of what is made of them."""
    makers: dict[str, Callable[..., Any]] = {}
    options: list[inspect.Parameter] = []
    # No option has a type that is imported for a checker alone.
    hints = get_type_hints(command, localns={'Topics': Any}, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        marks = getattr(hints[name], '__metadata__', ())
        given = next((mark for mark in marks if isinstance(mark, Given)), None)
        if given is None:
            kind = inspect.Parameter.KEYWORD_ONLY
            options.append(parameter.replace(annotation=hints[name], kind=kind))
        else:
            makers[name] = expanded(given.make)
            options += inspect.signature(makers[name]).parameters.values()

    @wraps(command)
    def run(**values: Any) -> Any:
        for name, make in makers.items():
            keys = inspect.signature(make).parameters
            values[name] = make(**{key: values.pop(key) for key in keys})
        return command(**values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in options}
    return run


def _output(
    as_json: Annotated[bool, option('Print the result as one JSON object.', '--json')] = False,
    quiet: Quiet = False,
) -> Output:
    return Output(as_json, quiet)


def _names(
    topic: Annotated[
        list[str] | None,
        option(
            'Where an input stands: counts, imu, board, case, temperature/NAME.',
            metavar='INPUT=TOPIC',
        ),
    ] = None,
    topics: Annotated[
        Path | None, option('The same from a file, INPUT: TOPIC a line.', metavar='YAML')
    ] = None,
) -> dict[str, str]:
    """Collect what `--topic` says, and what of the file it does not."""
    from ..plain_yaml import read_plain_yaml

    names: Any = {} if topics is None else read_plain_yaml(topics)
    if not isinstance(names, dict) or not all(isinstance(one, str) for one in names.values()):
        raise ThermoCompError(f'{topics}: expected INPUT: TOPIC, one a line')
    for one in topic or ():
        name, equals, where = one.partition('=')
        if not equals:
            raise usage(f'--topic: expected INPUT=TOPIC, got {one}')
        names[name] = where
    return names


TopicNames = Annotated[dict[str, str], Given(_names)]


def _topics(
    names: TopicNames,
    begin: Annotated[
        float | None,
        option(
            'Read each bag from there on: seconds from its first sample, or a stamp.',
            '--from',
            metavar='S',
        ),
    ] = None,
    end: Annotated[float | None, option('Read to there.', '--to', metavar='S')] = None,
) -> Topics:
    from ..recording import Part, Topics

    with usage_of('--from, --to: '):
        part = Part(begin, end)
    with usage_of('--topic: '):
        return Topics.named(names, part)


def _reading(*, input_: InputOption = 'auto', names: TopicNames) -> dict[str, Any]:
    return {'topics': _topics(names), 'input': input_}


TopicsPart = Annotated['Topics', Given(_topics)]


def _reading_part(*, input_: InputOption = 'auto', topics: TopicsPart) -> dict[str, Any]:
    return {'topics': topics, 'input': input_}


def _place(
    gravity: Annotated[float | None, option('Local gravity in m/s^2.', metavar='G')] = None,
    latitude: Annotated[float | None, option('Latitude in degrees, with --height.')] = None,
    height: Annotated[float | None, option('Height above the ellipsoid in m.')] = None,
) -> float | None:
    """Give local gravity, None where nothing was said; latitude and height go together."""
    if gravity is not None or (latitude is None and height is None):
        return gravity
    if latitude is None or height is None:
        raise usage('give --gravity, or --latitude and --height')
    from ..fitting import normal_gravity

    with usage_of():
        return normal_gravity(latitude, height)


Place = Annotated[float | None, Given(_place)]


def _judging(
    gravity: Place,
    window: Annotated[float, option('Length of a window at rest, in s.', metavar='S')] = 60.0,
    tolerance: Annotated[
        str | None, option('Largest RMS of |f| - g you accept: 100ug, 0.5mg, 1e-3m/s^2.')
    ] = None,
    serial: Serial = None,
) -> dict[str, Any]:
    return {
        'gravity': gravity,
        'window_s': positive(window, '--window'),
        'tolerance': acceleration(tolerance, '--tolerance'),
        'serial': serial,
    }


def _fitting(
    gravity: Place,
    model: Annotated[
        Literal['response', 'golovach'],
        option("The thermal response, or the paper's two sets alone."),
    ] = 'response',
    full_scale: Annotated[
        float | None, option('Magnitude of a saturated sample, in input units.')
    ] = None,
    reference_temperature: Annotated[
        float, option('Reference temperature in degC.', min=-273.15, max=1000.0)
    ] = 20.0,
    min_rest: Annotated[
        float | None,
        option(
            'Shortest rest used, in s; else 3, or less where short ones tell more.',
            metavar='S',
            show_default=False,
        ),
    ] = None,
    still_sd: Annotated[
        str, option("Largest scatter of samples at rest: a few times the sensor's noise.")
    ] = '50mg',
    allow: Annotated[
        list[str] | None, option('Refusal to override, as its message names it.')
    ] = None,
) -> dict[str, Any]:
    """Give keywords of FitOptions; FitError where gravity is none that is found on Earth."""
    from ..fitting import resolve_gravity

    if gravity is None:
        raise usage('give --gravity, or --latitude and --height')
    return {
        'gravity': resolve_gravity(gravity, None, None),
        'model': model,
        'full_scale': full_scale,
        'reference_temperature': reference_temperature,
        'min_rest_s': min_rest,
        'still_sd': acceleration(still_sd, '--still-sd'),
        'allow': tuple(allow or ()),
    }


Out = Annotated[Output, Given(_output)]
ReadingOptions = Annotated[dict[str, Any], Given(_reading)]
ReadingPart = Annotated[dict[str, Any], Given(_reading_part)]
JudgingOptions = Annotated[dict[str, Any], Given(_judging)]
FittingOptions = Annotated[dict[str, Any], Given(_fitting)]


def acceleration(text: str | None, name: str) -> float | None:
    """Read an acceleration with its unit [m/s^2]; None where none is given."""
    from ..unit.gravity import parse_acceleration

    with usage_of(f'{name}: '):
        return None if text is None else parse_acceleration(text)


def positive(value: float, name: str) -> float:
    """Refuse a number that is not positive and finite."""
    if not 0.0 < value < float('inf'):
        raise usage(f'{name} must be positive, got {value:g}')
    return value


def require_ros() -> None:
    """Raise ThermoCompError, which says what to do, where there is no ROS."""
    if find_spec('rclpy') is None:
        raise ThermoCompError(
            f'this command needs ROS 2 for {sys.executable}: source its setup file, or '
            "pip install 'thermo_comp[ros]'"
        )
