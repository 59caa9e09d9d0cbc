# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the options that several commands share, and their conversion to arguments of the library.

The default of a command's parameter is an option, or a function that builds the parameter from
several options; `expanded` replaces such a parameter by its options, for typer.
"""

import inspect
import math
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import typer

from ..errors import ThermoCompError
from ..quantities import QUANTITIES
from ..text import valid_serial
from ..unit.gravity import parse_acceleration
from .output import Output

# Placeholder of an option's value in `--help`, by the value's type: short, so that all names of
# options fit a terminal of 80 columns.
_VALUES: dict[Any, str] = {
    bool: ' ',
    **dict.fromkeys((int, int | None), 'N'),
    **dict.fromkeys((float, float | None), 'X'),
    **dict.fromkeys((str, str | None, list[str] | None), 'TEXT'),
    **dict.fromkeys((Path, Path | None, list[Path], list[Path] | None), 'PATH'),
}

#: Options whose names do not follow from the name of their parameter or of the library's argument.
_FLAGS = {
    'as_json': '--json',
    'begin': '--from',
    'case_timeout_s': '--case-timeout',
    'end': '--to',
    'forced': '--force-groups',
    'height_m': '--height',
    'input_': '--input',
    'latitude_deg': '--latitude',
    'min_rest_s': '--min-rest',
    'temperature_timeout_s': '--temperature-timeout',
    'transition_time_s': '--transition-time',
    'window_s': '--window',
}

usage = typer.BadParameter  # error in the command line, exit code 2


def option(text: str, default: Any = None, *flags: str, **rules: Any) -> Any:
    """
    Return a typer option; `rules`: further settings of typer. `flags`: names of the option; if
    none begins with two dashes, the parameter's name is added.
    """
    return typer.Option(default, *flags, help=text, **rules)


def argument(text: str, default: Any = ..., **rules: Any) -> Any:
    """Return a typer argument, a value without a flag; `rules`: further settings of typer."""
    return typer.Argument(default, help=text, **rules)


def expanded(command: Callable[..., Any]) -> Any:
    """Replace parameters of a command whose defaults are functions by the functions' options."""
    makers: dict[str, Callable[..., Any]] = {}
    options: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if inspect.isfunction(parameter.default):
            makers[name] = parameter.default
            options += inspect.signature(makers[name]).parameters.values()
        else:
            options.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @wraps(command)
    def run(**values: Any) -> Any:
        for name, make in makers.items():
            keys = inspect.signature(make).parameters
            values[name] = make(**{key: values.pop(key) for key in keys})
        return command(**values)

    for parameter in options:
        made = parameter.default
        if isinstance(made, typer.models.OptionInfo):
            made.metavar = made.metavar or _VALUES.get(parameter.annotation)
            flags = made.param_decls or ()
            if not any(flag.startswith('--') for flag in flags):
                made.param_decls = (_flag_of(parameter.name), *flags)
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in options}
    return run


def _flag_of(name: str) -> str:
    return _FLAGS.get(name, f'--{name.replace("_", "-")}')


@contextmanager
def usage_of(what: str = '', **flags: str) -> Iterator[None]:
    """
    Turn a ValueError of a `with` block into a usage error, whose text begins with `what`. Without
    `what`, names of options (by `flags`, else `_flag_of`) replace argument names in the text.
    """
    try:
        yield
    except ValueError as mistake:
        text = str(mistake)
        if not what:
            text = re.sub(r'`(\w+)`', lambda name: flags.get(name[1]) or _flag_of(name[1]), text)
        raise usage(f'{what}{text}') from mistake


def check_serial(serial: str | None) -> str | None:
    """Refuse an invalid serial; return the serial, also if it is empty."""
    if serial:
        with usage_of(serial='the serial'):
            valid_serial(serial)
    return serial


def check_rate(rate_hz: float | None) -> float | None:
    """Refuse a sample rate above 1 MHz, which no accelerometer has."""
    if rate_hz is not None and rate_hz > 1e6:
        raise usage(f'expected at most 1e6 Hz, got {rate_hz:g} Hz')
    return rate_hz


FORCE = option('Overwrite an existing output of the same kind.', False, '-f')
QUIET = option('Print only errors and missing parts of bags.', False, '-q')
NEW_CALIBRATION = option('Calibration to write (YAML).', ..., '-o')
CERTIFICATE_INFO = option(
    'Statements of the laboratory for the certificate: number, customer, ... (YAML).'
)
TABLE_RATE = option('Samples per second of a table without times.', min=0.01, callback=check_rate)
SERIAL = option(
    "Serial of the unit, instead of the bag's; '': accept a calibration of any unit.",
    callback=check_serial,
)
OFFSET = option(
    'Reading of raw samples at zero force, in counts, e.g. 32768; default: detected.',
    metavar='COUNTS',
)


@expanded
def out(
    as_json: bool = option('Print the result as one JSON object.', False), quiet: bool = QUIET
) -> Output:
    """Build the output of a command."""
    return Output(as_json, quiet)


@expanded
def named_topics(
    topic: list[str] | None = option(
        'Topic of an input: counts, imu, board, case, temperature/NAME.', metavar='INPUT=TOPIC'
    ),
    topics: Path | None = option('File of topics, with lines INPUT: TOPIC.', metavar='YAML'),
) -> dict[str, str]:
    """Return topics by input, from `--topic` and else from the file of `--topics`."""
    from ..recording.topics import parse_name, read_names

    named = {} if topics is None else read_names(topics)
    with usage_of('--topic: '):
        named |= map(parse_name, topic or ())
    return named


@expanded
def reading(
    input_: Literal['auto', 'counts', 'imu'] = option(
        'Samples to read from the bag: counts, imu, or auto (counts if present, else imu).',
        'auto',
        metavar='KIND',
    ),
    names: dict[str, str] = named_topics,
) -> Any:
    """Build `Topics`, the topics of the inputs in a bag, for the whole bag."""
    from ..recording.topics import Topics

    with usage_of('--topic, --topics: '):
        return Topics.named(names, input=input_)


@expanded
def reading_part(
    topics: Any = reading,
    begin: float | None = option(
        'Begin of the part to read: seconds from the first sample, or a stamp (seconds since '
        '1970).',
        metavar='S',
    ),
    end: float | None = option(
        'End of the part to read: seconds or a stamp, as for --from.', metavar='S'
    ),
) -> Any:
    """Build `Topics`, the topics of the inputs in a bag and the part of the bag to read."""
    from ..recording.topics import BagPart

    with usage_of('--from, --to: '):
        return replace(topics, part=BagPart(begin, end))


#: Sd of the difference between local gravity and normal gravity in mountains [m/s^2]: some 50 mGal
#: (EGM2008, Pavlis et al., Journal of Geophysical Research 117 (2012): anomalies of 30 mGal RMS).
NORMAL_GRAVITY_SD = 5e-4


@expanded
def place(
    gravity: float | None = option('Local gravity in m/s^2.', metavar='G'),
    latitude: float | None = option('Latitude in degrees, with --height.'),
    height: float | None = option('Height above the ellipsoid in m.'),
) -> tuple[float | None, float]:
    """Return local gravity (None if not stated) and its default standard deviation [m/s^2]."""
    if gravity is not None and not (latitude is None and height is None):
        raise usage('give --gravity, or --latitude and --height, not both')
    if latitude is None and height is None:
        return gravity, 0.0
    if latitude is None or height is None:
        raise usage('give --gravity, or --latitude and --height')
    from ..fitting import normal_gravity

    with usage_of():
        return normal_gravity(latitude, height), NORMAL_GRAVITY_SD


@expanded
def site(
    where: tuple[float | None, float] = place,
    gravity_sd: str | None = option(
        'Standard uncertainty of gravity, e.g. 5ug; default: 0 for --gravity, 50ug for --latitude.'
    ),
) -> dict[str, float]:
    """Return local gravity and its standard deviation; usage error if gravity is not stated."""
    gravity, usual_sd = where
    if gravity is None:
        raise usage('give --gravity, or --latitude and --height')
    sd = acceleration(gravity_sd, '--gravity-sd')
    return {'gravity': gravity, 'gravity_sd': usual_sd if sd is None else sd}


#: Default length of a window at rest [s].
WINDOW_S = 60.0


@expanded
def judging(
    where: tuple[float | None, float] = place,
    window_s: float = option(
        'Length of a window at rest, in s.', WINDOW_S, metavar='S', min=1e-3, max=86400.0
    ),
    tolerance: str | None = option('Largest accepted RMS of |f| - g, e.g. 100ug, 1e-3m/s^2.'),
    serial: str | None = SERIAL,
) -> dict[str, Any]:
    """Return the keywords of `evaluation.evaluate`, which judges a calibration."""
    return {
        'gravity': where[0],
        'window_s': window_s,
        'tolerance': acceleration(tolerance, '--tolerance'),
        'serial': serial,
    }


@expanded
def force(
    specific_force: str | None = option(
        'Known |f| of rests not at 1 g: a value for all bags, e.g. 5g, or a file of lines '
        "[BAG] BEGIN END |f| [SD] in s and m/s^2; default: the bags' metadata.",
        metavar='VALUE|FILE',
    ),
    rotation: str | None = option(
        'Topic of the rotation rate about a vertical axis in rad/s, with --radius.',
        metavar='TOPIC[:FIELD]',
    ),
    radius: float | None = option(
        'Distance of the unit from the axis of rotation, in m.', min=1e-3
    ),
    radius_sd: float | None = option(
        'Standard deviation of --radius, in m; if above 0, the fit estimates the radius.', min=0.0
    ),
) -> Any:
    """Build `ForceOptions`: the |f| that the user states for rests that are not at 1 g."""
    from ..fitting.sources import ForceOptions

    with usage_of():
        return ForceOptions(specific_force, rotation, radius, radius_sd)


@expanded
def fitting(
    where: dict[str, float] = site,
    model: Literal['response', 'golovach'] = option(
        'response: curves for soaks and ramps, and a thermal response; golovach: curves alone.',
        'response',
        metavar='MODEL',
    ),
    full_scale: float | None = option(
        'Magnitude of a saturated sample, in the unit of the input; default: 32767 counts, or the '
        'smallest usual range (2 g or more) above all samples.',
        metavar='VALUE',
    ),
    reference_temperature: float = option(
        'Temperature at which bias and scale are stated, in degC.', 20.0, metavar='DEGC'
    ),
    min_rest_s: float | None = option(
        'Shortest rest used, in s; default: 3 (1 or 2 if this determines bias and scale better).',
        metavar='S',
        show_default=False,
    ),
    still_sd: str = option(
        "Largest sd of samples at rest; state a few times the sensor's noise.", '50mg'
    ),
    mounting_sd: str | None = option(
        'Repeatability of mounting and turn-on (sd of the bias), e.g. 30ug; default: estimated '
        'from the bags.'
    ),
    k2_sd: float | None = option(
        'Data-sheet bound (1 sd) of the quadratic nonlinearity, in ug/g^2; default: 100 with '
        '--k3-sd or if some rests are not at 1 g, else no nonlinearity.',
        min=1e-6,
    ),
    k3_sd: float | None = option(
        'Data-sheet bound (1 sd) of the cubic nonlinearity, in ug/g^3; default: 10 with --k2-sd '
        'or if some rests are not at 1 g, else no nonlinearity.',
        min=1e-6,
    ),
    allow: list[str] | None = option('Name of a refusal to override, as in the error message.'),
) -> dict[str, Any]:
    """Return keywords of `FitOptions`."""
    given = locals() | where
    if fault := QUANTITIES['temperature'].fault(reference_temperature):
        raise usage(f'--reference-temperature: {fault} degC, got {reference_temperature:g}')
    for name, value, unit in (('--k2-sd', k2_sd, 'ug/g^2'), ('--k3-sd', k3_sd, 'ug/g^3')):
        if value is not None and value > 1e6 * (QUANTITIES['nonlinearity'].at_most or math.inf):
            raise usage(f'{name}: must be at most 1e6 {unit}, got {value:g}')
    del given['where']
    return given | {
        'still_sd': acceleration(still_sd, '--still-sd'),
        'mounting_sd': acceleration(mounting_sd, '--mounting-sd'),
        'k2_sd': None if k2_sd is None else k2_sd * 1e-6,
        'k3_sd': None if k3_sd is None else k3_sd * 1e-6,
        'allow': tuple(allow or ()),
    }


def acceleration(text: str | None, name: str) -> float | None:
    """Parse an acceleration with its unit [m/s^2]; None if no text is given."""
    with usage_of(f'{name}: '):
        return None if text is None else parse_acceleration(text)


def require_ros() -> None:
    """Raise ThermoCompError, with advice, if ROS cannot be imported by this interpreter."""
    try:
        import_module('rclpy')
    except ImportError as error:
        raise ThermoCompError(
            f'this command needs ROS 2, which {sys.executable} cannot import '
            f'({str(error).splitlines()[0]}): source the setup file of ROS 2 for this version of '
            "Python, or pip install 'thermo_comp[ros]'"
        ) from error
