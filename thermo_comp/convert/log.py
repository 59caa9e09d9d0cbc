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
from typing import Literal

import numpy as np

from .. import __version__
from ..errors import RecordingError
from ..files import shown_name
from ..fitting.sources import digest
from ..online.blocks import said_anew
from ..recording import STAMP_END_NS, BagWriter, ImuColumns, Topics
from ..text import valid_serial
from ..typing import Bools, Floats, Ints
from .table import NO_STAMP
from .units import Stillness, believed_unit, contradiction, find_stillness

# No sensor on a circuit board is read outside this range; kelvins and raw counts are.
_PLAUSIBLE_CELSIUS = (-90.0, 200.0)
# Messages are written in runs of this many rows: bounded memory in the writer.
_RUN_ROWS = 100_000
_EXAMPLES = 5
#: Slower logs tell of soaks alone.
SLOW_HZ = 5.0
_OUT_OF_RANGE = 'before 1970 or after January 2038, which no ROS message can hold'


@dataclass(frozen=True)
class Readings:
    """One thermometer's readings [degC] with their stamps, shape (n,), in file order."""

    stamp_ns: Ints
    celsius: Floats


@dataclass(frozen=True)
class ForeignLog:
    """
    What a log of any format holds, in file order.

    path: the log
    input, unit: what the accelerometer's messages become, and the unit that the log states
    factor: from that unit to the message's
    stamp_ns: stamps of the rows; `NO_STAMP` of `table` where there is none, shape (n,)
    accel: readings in the stated unit; NaN where a cell is no number, shape (n, 3)
    gyro: angular rate [rad/s], shape (n, 3)
    line: where each row stands in the file, shape (n,)
    counts_per_g, clip: the stated sensitivity; readings at and beyond which the sensor saturates
    n_short: rows that were left out because they are too short
    missing: what of the log could not be read
    hint: how its recorder would have logged more
    further: thermometers beside board and case, by name
    """

    path: str
    input: Literal['counts', 'imu']
    unit: Literal['counts', 'm/s^2', 'g', 'mg']
    factor: float
    stamp_ns: Ints
    accel: Floats
    gyro: Floats | None
    board: Readings
    case: Readings
    line: Ints
    counts_per_g: float | None = None
    clip: tuple[float, float] | None = None
    frame_id: str = 'imu_link'
    serial: str = ''
    n_short: int = 0
    metadata: dict[str, str] = field(default_factory=dict)
    missing: str | None = None
    hint: str = ''
    further: Mapping[str, Readings] = field(default_factory=dict)


@dataclass(frozen=True)
class Finding:
    """Something that `count` rows have in common, the first few of which stand in `lines`."""

    count: int
    lines: tuple[int, ...]


@dataclass(frozen=True)
class ConversionReport:
    """
    What came in, what went out, and what was seen on the way.

    Rows are left out that are short, hold no numbers, or a stamp that ROS has not; rows whose time
    goes back or stands still, or whose reading is clipped, are kept. `unit` is the one stated,
    `believed` what the readings at rest speak for.
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
    hint: str


NO_READINGS = Readings(np.empty(0, dtype=np.int64), np.empty(0))


def thin(readings: Readings) -> Readings:
    """Keep the finite readings that say something new: a change, or ten seconds without one."""
    read = said_anew(readings.stamp_ns, readings.celsius)
    return Readings(readings.stamp_ns[read], readings.celsius[read])


def origin(path: str | Path, serial: str | None) -> dict[str, str]:
    """Return what a converted bag says about where it comes from."""
    return {
        'converted_from': shown_name(path),
        'converted_from_sha256': digest(Path(path)),
        'converted_by': f'thermo_comp {__version__}',
        **({'serial': serial} if serial else {}),
    }


def write_log(
    log: ForeignLog,
    output: str | Path,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> ConversionReport:
    """
    Check a log and write it as a bag: ``*.mcap`` makes a bare file, else a rosbag2 directory.

    Raises RecordingError if no row is usable, a stated unit contradicts the readings, or the
    serial is none. Raises OutputError if the bag may not or cannot be written.
    """
    if log.serial:
        try:
            valid_serial(log.serial)
        except ValueError as mistake:
            raise RecordingError(str(mistake), path=log.path) from mistake
    log = replace(
        log,
        board=_stampable(log.board),
        case=_stampable(log.case),
        further={name: _stampable(readings) for name, readings in log.further.items()},
    )
    holds_numbers = _usable(log)
    usable = holds_numbers & _is_in_range(log.stamp_ns)
    if holds_numbers.any() and not usable.any():
        raise RecordingError(f'all its stamps are {_OUT_OF_RANGE}', path=log.path)
    stamp_ns, accel, line = log.stamp_ns[usable], log.accel[usable], log.line[usable]
    if not len(stamp_ns):
        raise RecordingError(
            f'none of its {len(usable)} rows holds numbers in the accelerometer and stamp columns',
            path=log.path,
        )
    newest = np.maximum.accumulate(stamp_ns)
    rises = np.concatenate(([True], stamp_ns[1:] > newest[:-1]))
    back = np.concatenate(([False], stamp_ns[1:] < stamp_ns[:-1]))
    repeat = np.concatenate(([False], stamp_ns[1:] == stamp_ns[:-1]))
    clipped: Bools = np.zeros(len(accel), dtype=np.bool_)
    if log.clip is not None:
        beyond = (accel <= log.clip[0]) | (accel >= log.clip[1])
        clipped = np.asarray(np.any(beyond, axis=1))
    stillness = find_stillness(stamp_ns[rises], accel[rises])
    _refuse_wrong_units(log, stillness)

    _write(log, Path(output), force, usable, newest, progress)
    steps = np.diff(stamp_ns[rises])
    return ConversionReport(
        source=log.path,
        output=str(output),
        rows=len(log.stamp_ns) + log.n_short,
        accel_messages=len(stamp_ns),
        board_messages=len(log.board.stamp_ns),
        case_messages=len(log.case.stamp_ns),
        further_messages={name: len(one.stamp_ns) for name, one in log.further.items()},
        input=log.input,
        rate_hz=1e9 / float(np.median(steps)) if len(steps) else float('nan'),
        duration_s=float(newest[-1] - stamp_ns[0]) * 1e-9,
        short_rows=Finding(log.n_short, ()),
        non_numeric=_finding(~holds_numbers, log.line),
        out_of_range=_finding(holds_numbers & ~usable, log.line),
        backwards=_finding(back, line),
        repeated=_finding(repeat, line),
        clipped=_finding(clipped, line),
        unit=log.unit,
        believed=believed_unit(stillness.magnitude)[1]
        if np.isfinite(stillness.magnitude)
        else 'it never rests, so its unit was not checked',
        stillness=stillness,
        start_ns=int(stamp_ns[0]),
        missing=log.missing,
        hint=log.hint,
    )


def _usable(log: ForeignLog) -> Bools:
    usable: Bools = (log.stamp_ns != NO_STAMP) & np.isfinite(log.accel).all(axis=1)
    if log.gyro is not None:
        usable &= np.isfinite(log.gyro).all(axis=1)
    return usable


def _is_in_range(stamp_ns: Ints) -> Bools:
    return np.asarray((stamp_ns >= 0) & (stamp_ns < STAMP_END_NS))


def _stampable(readings: Readings) -> Readings:
    use = _is_in_range(readings.stamp_ns)
    return Readings(readings.stamp_ns[use], readings.celsius[use])


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
    for name, readings in (('board', log.board), ('case', log.case), *log.further.items()):
        if not len(readings.celsius):
            continue
        typical = float(np.nanmedian(readings.celsius))
        if not low <= typical <= high:
            guess = ': that looks like kelvins' if 180.0 < typical < 480.0 else ''
            raise RecordingError(
                f'the {name} temperature is {typical:.4g} degC in the median{guess}', path=log.path
            )


def _write(
    log: ForeignLog,
    output: Path,
    force: bool,
    usable: Bools,
    newest: Ints,
    progress: Callable[[float], None] | None,
) -> None:
    """
    Write the messages; a stamp that goes back keeps its place in the bag through its log time.
    """
    topics = Topics()
    stamp_ns = log.stamp_ns[usable]
    values = log.accel[usable] * log.factor
    gyro = None if log.gyro is None else log.gyro[usable]
    waiting = [
        (topic, readings, np.maximum.accumulate(readings.stamp_ns))
        for topic, readings in (
            (topics.board, log.board),
            (topics.case, log.case),
            *((f'temperature/{name}', readings) for name, readings in log.further.items()),
        )
        if len(readings.celsius)
    ]
    with BagWriter(output, metadata=log.metadata, overwrite=force) as writer:
        since = np.iinfo(np.int64).min
        for first in range(0, len(stamp_ns), _RUN_ROWS):
            last = min(first + _RUN_ROWS, len(stamp_ns))
            until = newest[last - 1] if last < len(stamp_ns) else np.iinfo(np.int64).max
            for topic, readings, log_ns in waiting:
                run = slice(*np.searchsorted(log_ns, (since, until), side='right'))
                writer.write_temperature(
                    topic,
                    readings.stamp_ns[run],
                    readings.celsius[run],
                    log_ns=log_ns[run],
                    frame_id=log.frame_id,
                )
            since = until
            rows = slice(first, last)
            if log.input == 'counts':
                writer.write_counts(
                    topics.counts, stamp_ns[rows], values[rows], log.frame_id, log_ns=newest[rows]
                )
            else:
                n = last - first
                writer.write_imu(
                    topics.imu,
                    stamp_ns[rows],
                    values[rows],
                    np.zeros((n, 9)),
                    log.frame_id,
                    imu=_imu_columns(n, None if gyro is None else gyro[rows]),
                    log_ns=newest[rows],
                )
            writer.flush()
            if progress is not None:
                progress(last / len(stamp_ns))


def _imu_columns(n: int, gyro: Floats | None) -> ImuColumns:
    """Return the rest of an Imu message: what the log has not is marked with -1, REP 145."""
    absent = np.zeros((n, 9))
    absent[:, 0] = -1.0
    return ImuColumns(
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        orientation_covariance=absent,
        angular_velocity=np.zeros((n, 3)) if gyro is None else gyro,
        # All zeros: the rate is there, its covariance is not known.
        angular_velocity_covariance=absent if gyro is None else np.zeros((n, 9)),
        linear_acceleration_covariance=np.zeros((n, 9)),
    )
