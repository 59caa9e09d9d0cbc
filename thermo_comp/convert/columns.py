# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns tables with a column map: which column is what, in which unit, and how it becomes a message.

A map is a small YAML file beside the log; config/columns/ has examples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ..errors import RecordingError
from ..files import read_bounded
from ..plain_yaml import load_plain_yaml
from ..recording.topics import is_thermometer
from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY
from ..unit.schema import Bounds, NotNegative, Positive, SchemaError, build
from .log import NO_READINGS, ForeignLog, Readings, origin, thin
from .table import NO_STAMP, STAMP_EXPONENTS, Column, Table, TimeUnit, read_parquet, read_text
from .units import PER_G

#: A map takes some kB.
_SIZE_LIMIT = 1 << 20


@dataclass(frozen=True)
class Format:
    """How the text is laid out; found out where it is not said."""

    delimiter: Literal[',', ';', '|', 'tab', 'blank'] | None = None
    header: bool | None = None

    @property
    def character(self) -> str | None:
        """The delimiter as one character."""
        names = {'tab': '\t', 'blank': ' '}
        return None if self.delimiter is None else names.get(self.delimiter, self.delimiter)


@dataclass(frozen=True)
class Stamp:
    """
    A column of time stamps, or a fixed rate.

    The start is not 0 by default, because ROS takes a zero stamp for "no time yet".
    """

    column: Column | None = None
    unit: TimeUnit | None = None
    rate_hz: Positive | None = None
    start_s: NotNegative = 1.0

    def __post_init__(self) -> None:
        if (self.column is None) == (self.rate_hz is None):
            raise ValueError('give either `column` and `unit`, or `rate_hz`')
        if self.column is not None and self.unit is None:
            raise ValueError('`unit` must be s, ms, us or ns where there is a column')

    @property
    def exponent(self) -> int:
        """Power of ten from the unit to nanoseconds."""
        return STAMP_EXPONENTS[self.unit or 'ns']


@dataclass(frozen=True)
class Accel:
    """
    The accelerometer's three columns.

    `output` is what becomes of them: ``counts`` (geometry_msgs/Vector3Stamped) or ``imu``
    (sensor_msgs/Imu, m/s^2). `clip` are the readings, in the table's unit, at and beyond which
    the sensor saturates; `offset` is what it reads without a force, as 32768 in offset binary,
    which is taken away.
    """

    columns: tuple[Column, Column, Column]
    unit: Literal['counts', 'm/s^2', 'g', 'mg']
    output: Literal['counts', 'imu']
    counts_per_g: Positive | None = None
    clip: tuple[float, float] | None = None
    offset: float = 0.0

    def __post_init__(self) -> None:
        if self.unit == 'counts' and self.output == 'imu' and self.counts_per_g is None:
            raise ValueError('counts become an Imu only with `counts_per_g`')
        if self.unit != 'counts' and self.output == 'counts':
            raise ValueError(f'{self.unit} cannot become counts: output must be imu')
        if self.clip is not None and not self.clip[0] < self.clip[1]:
            raise ValueError('`clip` must be [lowest, highest]')

    @property
    def factor(self) -> float:
        """What a reading is multiplied by to become the message's value."""
        if self.output == 'counts':
            return 1.0
        return STANDARD_GRAVITY / PER_G.get(self.unit, self.counts_per_g or 1.0)


@dataclass(frozen=True)
class Gyro:
    """The gyroscope's three columns; they travel in the Imu message."""

    columns: tuple[Column, Column, Column]
    unit: Literal['rad/s', 'deg/s']


@dataclass(frozen=True)
class Thermometer:
    """
    One temperature column; unit raw: ``degC = reading * degc_per_count + degc_at_zero``.

    Slow sensors hold their last value between readings of their own: a row becomes a message where
    the value differs from the last one, or after ten seconds.
    """

    column: Column
    unit: Literal['degC', 'K', 'degF', 'raw'] = 'degC'
    degc_per_count: float | None = None
    degc_at_zero: float | None = None

    def __post_init__(self) -> None:
        if (self.unit == 'raw') != (self.degc_per_count is not None):
            raise ValueError('unit raw needs `degc_per_count`, the other units forbid it')
        if (self.unit == 'raw') != (self.degc_at_zero is not None):
            raise ValueError('unit raw needs `degc_at_zero`, the other units forbid it')

    @property
    def linear(self) -> tuple[float, float]:
        """Slope and offset from the table's reading to degC."""
        if self.unit == 'raw':
            return self.degc_per_count or 0.0, self.degc_at_zero or 0.0
        return {'degC': (1.0, 0.0), 'K': (1.0, -273.15), 'degF': (5 / 9, -160 / 9)}[self.unit]


@dataclass(frozen=True)
class Further(Thermometer):
    """A thermometer beside board and case; its topic is ``temperature/<name>``."""

    name: Annotated[str, Bounds(shortest=1)] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not is_thermometer(self.name):
            raise ValueError(
                f'`name` must serve in a topic, as temperature/magnet, got {self.name!r}'
            )


@dataclass(frozen=True)
class ColumnMap:
    """The whole map."""

    stamp: Stamp
    accel: Accel
    board: Thermometer | None = None
    case: Thermometer | None = None
    further: tuple[Further, ...] = ()
    gyro: Gyro | None = None
    format: Format = Format()
    frame_id: str = 'imu_link'
    serial: Annotated[str, Bounds(shortest=1)] | None = None

    def __post_init__(self) -> None:
        if len({one.name for one in self.further}) < len(self.further):
            raise ValueError('`further` has two thermometers of one name')
        if self.gyro is not None and self.accel.output == 'counts':
            raise ValueError('a gyro travels in an Imu message: accel output must be imu')


def load_column_map(path: str | Path) -> ColumnMap:
    """
    Read and validate a column map.

    Raises RecordingError if the file cannot be read, or a key is unknown, missing or wrong; names
    the key.
    """
    try:
        data = load_plain_yaml(read_bounded(path, _SIZE_LIMIT).decode())
    except OSError as failure:
        raise RecordingError(failure.strerror or str(failure), path=path) from failure
    except UnicodeDecodeError as failure:
        raise RecordingError('a column map is YAML text in UTF-8', path=path) from failure
    except ValueError as failure:
        raise RecordingError(str(failure), path=path) from failure
    if not isinstance(data, dict):
        raise RecordingError('a column map is a mapping of keys (see config/columns)', path=path)
    try:
        return build(ColumnMap, data)
    except SchemaError as failure:
        raise RecordingError(failure.message, path=path, topic=failure.key or None) from failure


def table_log(path: str | Path, columns: ColumnMap) -> ForeignLog:
    """
    Read all rows of a table as its column map says, with the temperatures thinned.

    Raises RecordingError if the file cannot be read or lacks a column.
    """
    path = Path(path)
    wanted, stamp = _wanted(columns), columns.stamp
    if path.suffix.lower() in ('.parquet', '.pq'):
        table = read_parquet(path, wanted, stamp.column, stamp.exponent)
    else:
        separated = columns.format
        table = read_text(
            path, wanted, stamp.column, stamp.exponent, separated.character, separated.header
        )
    stamp_ns, clip = _stamps(table, columns), columns.accel.clip
    gyro = None
    if columns.gyro is not None:
        gyro = _stack(table, columns.gyro.columns)
        if columns.gyro.unit == 'deg/s':
            gyro = np.radians(gyro)
    return ForeignLog(
        path=str(path),
        input=columns.accel.output,
        unit=columns.accel.unit,
        factor=columns.accel.factor,
        stamp_ns=stamp_ns,
        accel=_stack(table, columns.accel.columns) - columns.accel.offset,
        gyro=gyro,
        board=_readings(table, stamp_ns, columns.board),
        case=_readings(table, stamp_ns, columns.case),
        further={one.name: _readings(table, stamp_ns, one) for one in columns.further},
        line=table.line,
        counts_per_g=columns.accel.counts_per_g,
        clip=clip and (clip[0] - columns.accel.offset, clip[1] - columns.accel.offset),
        frame_id=columns.frame_id,
        serial=columns.serial or '',
        n_short=table.n_short,
        metadata=origin(path, columns.serial),
    )


def _wanted(columns: ColumnMap) -> list[Column]:
    wanted = list(columns.accel.columns)
    if columns.gyro is not None:
        wanted += columns.gyro.columns
    wanted += [t.column for t in (columns.board, columns.case, *columns.further) if t]
    return list(dict.fromkeys(wanted))


def _stack(table: Table, names: tuple[Column, Column, Column]) -> Floats:
    return np.column_stack([table.values[name] for name in names])


def _stamps(table: Table, columns: ColumnMap) -> Ints:
    if table.stamp_ns is not None:
        return table.stamp_ns
    rate = columns.stamp.rate_hz or 1.0
    start_ns = round(columns.stamp.start_s * 1e9)
    # Each stamp from its own number, so that no rounding adds up.
    steps = np.rint(np.arange(len(table.line)) * (1e9 / rate))
    return np.asarray(start_ns + steps.astype(np.int64))


def _readings(table: Table, stamp_ns: Ints, thermometer: Thermometer | None) -> Readings:
    if thermometer is None:
        return NO_READINGS
    slope, offset = thermometer.linear
    known = stamp_ns != NO_STAMP
    celsius = table.values[thermometer.column][known] * slope + offset
    return thin(Readings(stamp_ns[known], celsius))
