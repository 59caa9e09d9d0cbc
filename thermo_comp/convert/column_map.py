# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns column maps of tables: content and unit of each column, and the message type to write.

A map is a small YAML file; config/columns/ has examples. Without a map the columns are recognised
by their headings (see `headings`). A table without headings must have the columns ``[t] ax ay az
[wx wy wz]``, as for imu_tk. If the unit of the times is not stated, the times must rise in most
rows. If the unit of the acceleration is not stated, it is the unit in which the norm of samples at
rest is gravity. If the unit of the angular rate is not stated, it is rad/s, or deg/s if the values
in rad/s would exceed the rate of a turn by hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ..errors import RecordingError
from ..plain_yaml import read_plain_yaml
from ..quantities import Bounds, Positive
from ..recording.blocks import Readings
from ..recording.topics import is_thermometer
from ..typing import Floats, Ints
from ..unit.schema import SchemaError, build
from .headings import Column, Headings, Triple, read_headings
from .log import NO_STAMP, PLAUSIBLE_CELSIUS, ForeignLog, Unit, find_stillness, infer_unit
from .table import STAMP_EXPONENTS, Format, Stamp, Table, TimeUnit, read_parquet, read_text

#: Slope and offset that convert a temperature of each unit to degC.
_CELSIUS = {'degC': (1.0, 0.0), 'K': (1.0, -273.15), 'degF': (5 / 9, -160 / 9)}
_STEPS_S = (5e-5, 0.5)  # range of plausible intervals between samples [s]
_SLOW_S = 2.0  # longest plausible interval [s] if the unit turns within a block of samples
_BLOCK, _QUIET = 12, 0.02  # number of samples of a block; largest sd of a still block [g]
_TURN = 0.5  # turn that a hand cannot make within a block of samples at 1 kHz [rad]
_FASTEST_RAD_S = 20.0  # largest angular rate of a unit that is turned by hand [rad/s]
#: Range of stamps from 2000 to 2038, and largest interval between such stamps [s]. Times since
#: power-up in us, taken for seconds, may lie in this range, but have intervals above 60 s.
_SINCE_1970_S, _SINCE_1970_STEP_S = (946_684_800.0, 2_147_483_648.0), 60.0
_FASTEST_K_S = 0.5  # largest mean rate of temperature over a log [K/s] (a hair dryer: 0.1 K/s)
# Largest share of rows in which a temperature in whole degrees changes. A column with the numbers
# of boards or sensors alternates from row to row, so the number changes in nearly all rows.
_FEW_CHANGES = 0.1
_RISING = 0.7  # smallest share of rows whose time is later than the time of the row before
_WRAP_EDGE = 0.1  # an overflow is a step from the last to the first tenth of the 32-bit range
_A_MAP = 'a column map: --columns MAP'


@dataclass(frozen=True)
class Accel:
    """The accelerometer's three columns; `clip` and `offset` are in `unit`."""

    columns: Triple
    unit: Unit
    output: Literal['counts', 'imu']  # message to write; Imu is in m/s^2
    counts_per_g: Positive | None = None
    clip: tuple[float, float] | None = None  # lowest and highest reading, at saturation
    offset: float = 0.0  # reading at zero force, which is subtracted, such as 32768

    def __post_init__(self) -> None:
        if self.unit == 'counts' and self.output == 'imu' and self.counts_per_g is None:
            raise ValueError(
                '`counts_per_g` must be given if `unit` is counts and `output` is imu'
            )
        if self.unit != 'counts' and self.output == 'counts':
            raise ValueError(f'`output` must be imu if `unit` is {self.unit}, got counts')
        if self.clip is not None and not self.clip[0] < self.clip[1]:
            raise ValueError(
                f'`clip` must be [lowest, highest] with lowest < highest, got {list(self.clip)}'
            )


@dataclass(frozen=True)
class Gyro:
    """The gyroscope's three columns, which become the angular rate in the Imu message."""

    columns: Triple
    unit: Literal['rad/s', 'deg/s']


@dataclass(frozen=True)
class Thermometer:
    """A temperature column; if `unit` is raw, degC = reading * degc_per_count + degc_at_zero."""

    column: Column
    unit: Literal['degC', 'K', 'degF', 'raw'] = 'degC'
    degc_per_count: float | None = None
    degc_at_zero: float | None = None

    def __post_init__(self) -> None:
        for name in ('degc_per_count', 'degc_at_zero'):
            if (self.unit == 'raw') != (getattr(self, name) is not None):
                raise ValueError(
                    f'`{name}` must be given if `unit` is raw, and only then; `unit`: {self.unit}'
                )


@dataclass(frozen=True)
class Further(Thermometer):
    """A further thermometer; its topic is ``temperature/<name>``."""

    name: Annotated[str, Bounds(shortest=1)] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not is_thermometer(self.name):
            raise ValueError(
                f'`name` must fit into a topic, as temperature/magnet, got {self.name!r}'
            )


@dataclass(frozen=True)
class ColumnMap:
    """A column map: the columns of stamps, accelerometer, gyroscope and thermometers."""

    stamp: Stamp
    accel: Accel
    board: Thermometer | None = None
    case: Thermometer | None = None
    further: tuple[Further, ...] = ()
    gyro: Gyro | None = None
    format: Format | None = None
    frame_id: str = 'imu_link'
    serial: Annotated[str, Bounds(shortest=1)] | None = None

    def __post_init__(self) -> None:
        if len({thermometer.name for thermometer in self.further}) < len(self.further):
            raise ValueError('`further` has two thermometers with the same name')
        given = [*self.accel.columns, *(self.gyro.columns if self.gyro else ())]
        given += [sensor.column for sensor in (self.board, self.case, *self.further) if sensor]
        if twice := {str(name) for name in given if given.count(name) > 1}:
            raise ValueError(f'column {min(twice)!r} is given twice')
        if self.gyro is not None and self.accel.output == 'counts':
            raise ValueError(
                '`accel.output` must be imu if `gyro` is given: messages of counts have no '
                'angular rate'
            )


def load_column_map(path: Path) -> ColumnMap:
    """Read a column map from YAML; RecordingError with the key if the map is invalid."""
    data = read_plain_yaml(path)
    try:
        if not isinstance(data, dict):
            raise SchemaError('', 'a column map is a mapping of keys (see config/columns)')
        return build(ColumnMap, data)
    except SchemaError as failure:
        raise RecordingError(failure.message, path, failure.key or None) from failure


def table_log(path: Path, columns: ColumnMap) -> ForeignLog:
    """Read all rows of a table by its column map; drop temperatures repeated within 10 s."""
    accel, gyro = columns.accel, columns.gyro
    thermometers = {'board': columns.board, 'case': columns.case}
    thermometers |= {thermometer.name: thermometer for thermometer in columns.further}
    used = {name: column for name, column in thermometers.items() if column is not None}
    wanted = [*accel.columns, *(gyro.columns if gyro else ()), *(t.column for t in used.values())]
    table = _read(path, wanted, columns.stamp, columns.format)
    stamp_ns, continued = _without_wraps(table, columns.stamp.unit)
    known = stamp_ns != NO_STAMP
    temperatures = {}
    for name, thermometer in used.items():
        raw = thermometer.degc_per_count or 0.0, thermometer.degc_at_zero or 0.0
        slope, offset = _CELSIUS.get(thermometer.unit, raw)
        celsius = table.values[thermometer.column][known] * slope + offset
        temperatures[name] = Readings(stamp_ns[known], celsius).thinned()
    rate = None
    if gyro is not None:
        rate = np.column_stack([table.values[name] for name in gyro.columns])
        rate = np.radians(rate) if gyro.unit == 'deg/s' else rate
    return ForeignLog(
        str(path),
        stamp_ns,
        np.column_stack([table.values[name] for name in accel.columns]) - accel.offset,
        rate,
        temperatures,
        table.line,
        accel.output,
        accel.unit,
        counts_per_g=accel.counts_per_g,
        clip=accel.clip and (accel.clip[0] - accel.offset, accel.clip[1] - accel.offset),
        frame_id=columns.frame_id,
        serial=columns.serial or '',
        short=table.short,
        not_used=table.not_used,
        continued=continued,
    )


def _without_wraps(table: Table, unit: TimeUnit | None) -> tuple[Ints, tuple[int, ...]]:
    """Continue 32-bit times beyond overflows; return stamps, and lines that follow overflows."""
    stamp_ns, rows = table.stamp_ns.copy(), np.flatnonzero(table.stamp_ns != NO_STAMP)
    if unit not in ('ms', 'us') or not len(rows):
        return stamp_ns, ()
    size_ns = 2**32 * 10 ** STAMP_EXPONENTS[unit]
    share = stamp_ns[rows] / size_ns
    ends = np.zeros(len(rows), dtype=bool)
    if share.min() >= 0.0 and share.max() < 1.0:
        ends[1:] = (share[:-1] > 1.0 - _WRAP_EDGE) & (share[1:] < _WRAP_EDGE)
    stamp_ns[rows] += np.cumsum(ends) * size_ns
    return stamp_ns, tuple(table.line[rows[ends]].tolist())


def _read(
    path: Path, columns: Sequence[Column] | None, stamp: Stamp, style: Format | None = None
) -> Table:
    if path.suffix.lower() in ('.parquet', '.pq'):
        return read_parquet(path, columns, stamp)
    return read_text(path, columns, stamp, style)


def guess_columns(path: Path, rate_hz: float | None = None) -> ColumnMap:
    """Guess the column map of a table; `rate_hz` is the sample rate of a table without times."""
    table = _read(path, None, Stamp(rate_hz=1.0))
    place = {name: number for number, name in reversed(list(enumerate(table.headings)))}

    def values(columns: Sequence[Column]) -> Floats:
        return np.column_stack([table.values[place.get(str(col), col)] for col in columns])

    def is_plausible(heading: str, unit: str) -> bool:
        return _is_temperature(values([heading])[:, 0], unit)

    if table.headings:
        named = read_headings(table.headings, is_plausible)
    else:
        named = _unnamed(len(table.values))
    if named is None or (named.time is None and rate_hz is None):
        lacks, instead = ('accelerometer', '') if named is None else ('time', '--rate-hz, or ')
        listed = ', '.join(map(repr, table.headings[:20]))
        problem = f'its headings name no {lacks}: {listed}' if listed else 'the table has no times'
        raise RecordingError(f'{problem}; give {instead}{_A_MAP}')
    accel = values(named.accel)
    unit = named.accel_unit
    if not unit:
        # The unit of the times is not known yet: the search for rests assumes 1 s between samples.
        still = find_stillness(np.arange(len(accel)) * 10**9, accel)
        unit, reason = infer_unit(still.magnitude)
        if unit == 'unknown':
            raise RecordingError(
                f'the unit of the accelerometer cannot be guessed, {reason}: give {_A_MAP}'
            )
    gyro = None
    if named.gyro is not None and unit != 'counts':
        is_fast = np.nanquantile(np.abs(values(named.gyro)), 0.999) > _FASTEST_RAD_S
        rates = named.gyro_unit or ('deg/s' if is_fast else 'rad/s')
        gyro = build(Gyro, {'columns': list(named.gyro), 'unit': rates})
    output = 'counts' if unit == 'counts' else 'imu'
    thermometers = {
        name: build(Thermometer, {'column': column, 'unit': degrees})
        for name, (column, degrees) in named.thermometers.items()
    }
    times = None if named.time is None else values([named.time])[:, 0]
    span = max((_span(values([item.column])) for item in thermometers.values()), default=0.0)
    stamp = _stamp(named, times, rate_hz, accel, span)
    triad = build(Accel, {'columns': list(named.accel), 'unit': unit, 'output': output})
    board, case = thermometers.pop('board', None), thermometers.pop('case', None)
    further = (Further(item.column, item.unit, name=name) for name, item in thermometers.items())
    style = None if table.headings else Format(header=False)
    return ColumnMap(stamp, triad, board, case, tuple(further), gyro, style)


def _unnamed(width: int) -> Headings:
    """Return the numbers of columns ``[t] ax ay az [wx wy wz]`` without headings."""
    if width not in (3, 4, 6, 7):
        raise RecordingError(
            f'{width} columns without headings cannot be identified, only 3, 4, 6 or 7 columns '
            f'[t] ax ay az [wx wy wz]: give {_A_MAP}'
        )
    x = int(width in (4, 7))
    gyro = (x + 3, x + 4, x + 5) if width > 4 else None
    return Headings(0 if x else None, '', (x, x + 1, x + 2), '', gyro, '', {})


def column_map_text(columns: ColumnMap) -> str:
    """Describe the columns of a column map with their units, in one line."""
    stamp = columns.stamp
    parts = [f'{stamp.rate_hz:g} Hz' if stamp.column is None else f'time [{stamp.unit}]']
    parts.append(f'x y z [{columns.accel.unit}]')
    if columns.gyro is not None:
        parts.append(f'angular rate x y z [{columns.gyro.unit}]')
    return ', '.join(parts)


def _is_temperature(values: Floats, unit: str) -> bool:
    """Whether the values of a column can be temperatures in a unit of `_CELSIUS`."""
    slope, offset = _CELSIUS[unit]
    celsius = values[np.isfinite(values)] * slope + offset
    if not len(celsius):
        return False
    low, high = np.quantile(celsius, (0.02, 0.98))
    changes = np.mean(np.diff(celsius) != 0.0) if len(celsius) > 1 else 0.0
    is_whole = bool(np.all(values[np.isfinite(values)] % 1.0 == 0.0))
    is_within = PLAUSIBLE_CELSIUS[0] <= low and high <= PLAUSIBLE_CELSIUS[1]
    return bool(is_within and (not is_whole or 0.0 < changes < _FEW_CHANGES))


def _span(values: Floats) -> float:
    low, high = np.nanquantile(values, (0.02, 0.98)) if np.isfinite(values).any() else (0.0, 0.0)
    return float(high - low)


def _stamp(
    named: Headings, times: Floats | None, rate_hz: float | None, accel: Floats, span: float
) -> Stamp:
    """Guess the unit of times by heading or values; `span`: range of the temperatures [K]."""
    if times is None:
        return Stamp(rate_hz=rate_hz)
    column = f'its column {named.time!r}'
    if rate_hz is not None:
        raise RecordingError(f'{column} has the times of the samples: leave out --rate-hz')
    times = times[np.isfinite(times)]
    if not len(times):
        return Stamp(named.time, 'iso')
    if named.time_unit in STAMP_EXPONENTS:
        return build(Stamp, {'column': named.time, 'unit': named.time_unit})
    if named.time_unit:
        raise RecordingError(
            f'{column} is in {named.time_unit}: the times must be in s, ms, us or ns, or dates'
        )
    steps = np.diff(times)
    if not len(steps) or (steps >= 0.0).mean() <= 0.9:
        raise RecordingError(f'{column} is not a rising time: give {_A_MAP}')
    if (steps > 0.0).mean() <= _RISING:
        raise RecordingError(
            f'{column} has the same time as the row before in {(steps == 0.0).mean():.0%} of '
            f'rows: give {_A_MAP}, with `stamp: {{rate_hz: HZ}}` for samples at a fixed rate'
        )
    step, first = float(np.median(steps[steps > 0.0])), float(times[0])
    shortest_s = span / _FASTEST_K_S  # shortest plausible duration of the log [s]
    longest = _SLOW_S if _turns_at_once(accel) else _STEPS_S[1]
    # Take the largest unit that gives dates or plausible intervals. An interval above `longest`
    # is accepted if times in the next smaller unit would make the log shorter than `shortest_s`.
    for unit, exponent in STAMP_EXPONENTS.items():
        size = 10.0 ** (exponent - 9)
        begin, step_s = first * size, step * size
        is_date = _SINCE_1970_S[0] <= begin < _SINCE_1970_S[1] and step_s < _SINCE_1970_STEP_S
        is_next_too_short = step_s * len(times) / 1000.0 < shortest_s
        if is_date or (_STEPS_S[0] < step_s and (step_s < longest or is_next_too_short)):
            return Stamp(named.time, unit)
    raise RecordingError(
        f'{column} rises by {np.median(steps):.3g} from row to row, which is no plausible '
        f'interval of samples in s, ms, us or ns: give {_A_MAP}'
    )


def _turns_at_once(accel: Floats) -> bool:
    """Whether the unit turns within a block of samples, between two still blocks."""
    blocks = accel[: len(accel) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, 3)
    mean = blocks.mean(axis=1)
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    rests = (blocks.std(axis=1) < _QUIET * size).all(axis=1)
    turn = np.linalg.norm((mean / size)[2:] - (mean / size)[:-2], axis=1)
    return bool((rests[2:] & rests[:-2] & (turn > _TURN)).any())
