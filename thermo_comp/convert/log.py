# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from any foreign log to a bag: checks, thinning, and the account of every row.

A reader of a format makes a `ForeignLog`; `write_log` does the rest, the same for all formats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from .. import __version__
from ..errors import RecordingError
from ..files import shown_name
from ..fitting.sources import digest
from ..online.blocks import said_anew
from ..recording import STAMP_END_NS, BagWriter, ImuColumns, Topics
from ..text import valid_serial
from ..typing import Bools, Floats, Ints
from .units import Stillness, Unit, believed_unit, contradiction, find_stillness

#: The stamp of a row that has none.
NO_STAMP = np.iinfo(np.int64).min
# No sensor on a circuit board is read outside this range; kelvins and raw counts are.
_PLAUSIBLE_CELSIUS = (-90.0, 200.0)
# Messages are written in runs of this many rows: bounded memory in the writer.
_RUN_ROWS = 100_000
_EXAMPLES = 5
#: Slower logs tell of soaks alone.
SLOW_HZ = 5.0


class Readings(NamedTuple):
    """One thermometer's readings [degC] with their stamps, shape (n,), in file order."""

    stamp_ns: Ints
    celsius: Floats

    def take(self, rows: Bools | Ints) -> Readings:
        """Choose some of them."""
        return Readings(self.stamp_ns[rows], self.celsius[rows])


@dataclass(frozen=True)
class ForeignLog:
    """
    What a log of any format holds, in file order.

    path: the log
    stamp_ns: stamps of the rows; `NO_STAMP` where there is none, shape (n,)
    accel: readings in the stated unit; NaN where a cell is no number, shape (n, 3)
    gyro: angular rate [rad/s], shape (n, 3)
    temperatures: readings by the name of the thermometer
    line: where each row stands in the file, shape (n,); None counts the rows
    input, unit: what the accelerometer's messages become, and the unit that the log states
    factor: from that unit to the message's
    counts_per_g, clip: the stated sensitivity; readings at and beyond which the sensor saturates
    n_short: rows that were left out because they are too short
    missing: what of the log could not be read
    chosen: which topics were taken without being named
    hint: how its recorder would have logged more
    """

    path: str
    stamp_ns: Ints
    accel: Floats
    gyro: Floats | None = None
    temperatures: Mapping[str, Readings] = field(default_factory=dict)
    line: Ints | None = None
    input: Literal['counts', 'imu'] = 'imu'
    unit: Unit = 'm/s^2'
    factor: float = 1.0
    counts_per_g: float | None = None
    clip: tuple[float, float] | None = None
    frame_id: str = 'imu_link'
    serial: str = ''
    n_short: int = 0
    metadata: Mapping[str, str] = field(default_factory=dict)
    missing: str | None = None
    chosen: str | None = None
    hint: str = ''


@dataclass(frozen=True)
class Finding:
    """Something that `count` rows have in common, the first few of which stand in `lines`."""

    count: int
    lines: tuple[int, ...] = ()


@dataclass(frozen=True)
class ConversionReport:
    """
    What came in, what went out, and what was seen on the way.

    Rows are left out that are short, hold no numbers, or a stamp that ROS has not; the other
    findings are kept. `unit` is the one stated, `believed` what the readings at rest speak for.
    """

    source: str
    output: str
    rows: int
    accel_messages: int
    board_messages: int
    case_messages: int
    further_messages: Mapping[str, int]
    input: str
    rate_hz: float
    duration_s: float
    short_rows: Finding
    non_numeric: Finding
    out_of_range: Finding
    backwards: Finding
    repeated: Finding
    clipped: Finding
    unit: str
    believed: str
    stillness: Stillness
    start_ns: int
    missing: str | None
    chosen: str | None
    hint: str


def thin(readings: Readings) -> Readings:
    """Keep the finite readings that say something new: a change, or ten seconds without one."""
    return readings.take(said_anew(readings.stamp_ns, readings.celsius))


def write_log(
    log: ForeignLog,
    output: str | Path,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> ConversionReport:
    """Check a log and write it as a bag: a bare file ``*.mcap``, else a rosbag2 directory."""
    if log.serial:
        try:
            valid_serial(log.serial)
        except ValueError as mistake:
            raise RecordingError(str(mistake), path=log.path) from mistake
    holds_numbers = (log.stamp_ns != NO_STAMP) & np.isfinite(log.accel).all(axis=1)
    if log.gyro is not None:
        holds_numbers &= np.isfinite(log.gyro).all(axis=1)
    usable = holds_numbers & _is_in_range(log.stamp_ns)
    if not usable.any():
        raise RecordingError(
            'all its stamps are before 1970 or after January 2038, which no ROS message can hold'
            if holds_numbers.any()
            else f'none of its {len(usable)} rows holds numbers in the accelerometer and stamp '
            'columns',
            path=log.path,
        )
    line = np.arange(1, len(usable) + 1) if log.line is None else log.line
    not_numeric = _finding(~holds_numbers, line)
    out_of_range = _finding(holds_numbers & ~usable, line)
    log = replace(
        log,
        stamp_ns=log.stamp_ns[usable],
        accel=log.accel[usable],
        gyro=None if log.gyro is None else log.gyro[usable],
        temperatures={
            name: one.take(_is_in_range(one.stamp_ns)) for name, one in log.temperatures.items()
        },
    )
    line, stamp_ns = line[usable], log.stamp_ns
    stillness = find_stillness(stamp_ns, log.accel)
    _refuse_wrong_units(log, stillness)
    newest = np.maximum.accumulate(stamp_ns)
    _write(log, Path(output), force, newest, progress)
    steps = np.diff(newest)
    beyond: Bools = np.zeros(log.accel.shape, dtype=np.bool_)
    if log.clip is not None:
        beyond = (log.accel <= log.clip[0]) | (log.accel >= log.clip[1])
    messages = {name: len(one.stamp_ns) for name, one in log.temperatures.items()}
    return ConversionReport(
        source=log.path,
        output=str(output),
        rows=len(usable) + log.n_short,
        accel_messages=len(stamp_ns),
        board_messages=messages.pop('board', 0),
        case_messages=messages.pop('case', 0),
        further_messages=messages,
        input=log.input,
        rate_hz=1e9 / float(np.median(steps[steps > 0])) if steps.any() else float('nan'),
        duration_s=float(newest[-1] - stamp_ns[0]) * 1e-9,
        short_rows=Finding(log.n_short),
        non_numeric=not_numeric,
        out_of_range=out_of_range,
        backwards=_finding(np.diff(stamp_ns, prepend=stamp_ns[0]) < 0, line),
        repeated=_finding(np.diff(stamp_ns, prepend=stamp_ns[0] - 1) == 0, line),
        clipped=_finding(np.any(beyond, axis=1), line),
        unit=log.unit,
        believed=believed_unit(stillness.magnitude)[1]
        if np.isfinite(stillness.magnitude)
        else 'it never rests, so its unit was not checked',
        stillness=stillness,
        start_ns=int(stamp_ns[0]),
        missing=log.missing,
        chosen=log.chosen,
        hint=log.hint,
    )


def _is_in_range(stamp_ns: Ints) -> Bools:
    return np.asarray((stamp_ns >= 0) & (stamp_ns < STAMP_END_NS))


def _finding(rows: Bools, line: Ints) -> Finding:
    found = np.flatnonzero(rows)
    return Finding(len(found), tuple(line[found[:_EXAMPLES]].tolist()))


def _refuse_wrong_units(log: ForeignLog, stillness: Stillness) -> None:
    reason = contradiction(log.unit, stillness.magnitude, log.counts_per_g)
    if reason is not None:
        raise RecordingError(
            f'the accelerometer is stated in {log.unit}, but {reason}', path=log.path
        )
    low, high = _PLAUSIBLE_CELSIUS
    for name, readings in log.temperatures.items():
        typical = float(np.nanmedian(readings.celsius)) if len(readings.celsius) else low
        if not low <= typical <= high:
            guess = ': that looks like kelvins' if 180.0 < typical < 480.0 else ''
            raise RecordingError(
                f'the {name} temperature is {typical:.4g} degC in the median{guess}', path=log.path
            )


def _write(
    log: ForeignLog,
    output: Path,
    force: bool,
    newest: Ints,
    progress: Callable[[float], None] | None,
) -> None:
    """Write the messages; a stamp that goes back keeps its place through its log time."""
    topics, n = Topics(), len(log.stamp_ns)
    waiting = [
        (f'temperature/{name}', readings, np.maximum.accumulate(readings.stamp_ns))
        for name, readings in log.temperatures.items()
        if len(readings.celsius)
    ]
    metadata = {
        **log.metadata,
        'converted_from': shown_name(log.path),
        'converted_from_sha256': digest(Path(log.path)),
        'converted_by': f'thermo_comp {__version__}',
        **({'serial': log.serial} if log.serial else {}),
    }
    with BagWriter(output, metadata=metadata, overwrite=force) as writer:
        since = -1
        for first in range(0, n, _RUN_ROWS):
            rows = slice(first, min(first + _RUN_ROWS, n))
            until = newest[rows.stop - 1] if rows.stop < n else np.iinfo(np.int64).max
            for topic, readings, log_ns in waiting:
                run = slice(*np.searchsorted(log_ns, (since, until), side='right'))
                stamp_ns, celsius = (column[run] for column in readings)
                writer.write_temperature(topic, stamp_ns, celsius, log_ns[run], log.frame_id)
            since = until
            stamp_ns, values = log.stamp_ns[rows], log.accel[rows] * log.factor
            if log.input == 'counts':
                writer.write_counts(topics.counts, stamp_ns, values, log.frame_id, newest[rows])
            else:
                imu = None if log.gyro is None else ImuColumns.of_rate(log.gyro[rows])
                writer.write_imu(
                    topics.imu, stamp_ns, values, np.zeros(9), log.frame_id, imu, newest[rows]
                )
            writer.flush()
            if progress is not None:
                progress(rows.stop / n)
