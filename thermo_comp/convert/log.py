# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the conversion of a log of any format to a bag: checks, and a report on the rows left out.

At rest the norm of the specific force is gravity in any attitude. A log is refused if its samples
at rest do not have this norm in the stated unit, because a wrong unit would remain in the
calibration as a factor, such as 9.8.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .. import __version__
from ..errors import RecordingError
from ..files import shown_name
from ..fitting.sources import digest
from ..recording.blocks import ImuColumns, Readings
from ..recording.overview import KELVINS
from ..recording.stillness import CellAccumulator, is_full
from ..recording.topics import Topics
from ..recording.writer import STAMP_END_NS, BagWriter
from ..text import valid_serial
from ..topics import thermometer
from ..typing import Bools, Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY

Unit = Literal['m/s^2', 'g', 'mg', 'counts']

PER_G: dict[Unit, float] = {'g': 1.0, 'm/s^2': STANDARD_GRAVITY, 'mg': 1000.0}  # 1 g in each unit
_TOLERANCE = 0.2  # relative tolerance of |sample| at rest: above the errors of cheap sensors
_SENSITIVITIES = (2048, 4096, 8192, 16384)  # 16-bit sensors of +-16 g to +-2 g [counts/g]

_CELL_S, _MIN_SAMPLES = 0.5, 12  # length of a cell of samples [s], least number of samples in it
_MOVING_RATIO = 4.0  # largest sd of a still cell / lower quartile of sds; below 2 for noise alone
_MERGE_NS = 10 * 10**9  # shortest rest between two separate movements [ns]

NO_STAMP = np.iinfo(np.int64).min  # stands for the stamp of a row without a stamp
#: Range of plausible temperatures [degC]; readings in kelvins or in raw counts are mostly outside,
#: as is -127 degC of a DS18B20 without contact.
PLAUSIBLE_CELSIUS = (-90.0, 200.0)
_RUN_ROWS = 100_000  # number of rows processed at a time, to limit the memory
_EXAMPLES = 5  # largest number of line numbers in a `Finding`
_RESTART_NS = 10**9  # a larger backward step of stamps is a restart of the clock [ns]
SLOW_HZ = 5.0  # sample rate below which short rests have too few samples [Hz]


@dataclass(frozen=True)
class ForeignLog:
    """The content of a log of any format, in file order."""

    path: str
    stamp_ns: Ints  # `NO_STAMP` if missing, shape (n,)
    accel: Floats  # samples in the stated unit, NaN if no number, shape (n, 3)
    gyro: Floats | None = None  # [rad/s], shape (n, 3)
    temperatures: Mapping[str, Readings] = field(default_factory=dict)
    line: Ints | None = None  # line of each row in the file, shape (n,); None: numbers from 1
    input: Literal['counts', 'imu'] = 'imu'  # type of the messages to write
    unit: Unit = 'm/s^2'
    counts_per_g: float | None = None
    clip: tuple[float, float] | None = None  # readings at which the sensor is saturated
    frame_id: str = 'imu_link'
    serial: str = ''
    short: Sequence[int] = ()  # numbers of the lines or messages dropped for missing cells
    not_used: tuple[str, ...] = ()  # columns of a table that are not written to the bag
    continued: tuple[int, ...] = ()  # numbers of the lines after an overflow of a 32-bit time
    metadata: Mapping[str, str] = field(default_factory=dict)
    missing: str | None = None  # description of unreadable parts
    chosen: str | None = None  # note on topics chosen by type, or on samples left out
    guessed: Any = None  # column map, if it was guessed
    hint: str = ''  # advice on how to log better data

    def take(self, rows: Bools) -> 'ForeignLog':
        """Select samples; all temperatures are kept."""
        gyro = None if self.gyro is None else self.gyro[rows]
        return replace(self, stamp_ns=self.stamp_ns[rows], accel=self.accel[rows], gyro=gyro)


@dataclass(frozen=True)
class Stillness:
    """Rests and movements of a log; `magnitude`, `noise`: in the log's unit, NaN if unknown."""

    magnitude: float  # median norm of the mean samples of the quiet cells
    noise: float  # median sd per axis of the quiet cells
    still_s: float  # total time of the quiet cells
    moving_ns: tuple[tuple[int, int], ...]  # stamps of begin and end of each movement


@dataclass(frozen=True)
class Finding:
    """Number of rows of a log with a property, and the line numbers of the first five rows."""

    count: int
    lines: tuple[int, ...] = ()


@dataclass(frozen=True)
class ConversionReport:
    """Summary of a conversion."""

    log: ForeignLog  # the rows of the log that were written to the bag
    rows: int
    messages: Mapping[str, int]  # number of messages by the name of the input
    rate_hz: float
    duration_s: float
    findings: dict[str, Finding]
    inferred_unit: str  # unit that follows from the samples at rest, and the reason
    stillness: Stillness


def import_extra(module: str, extra: str, what: str) -> Any:
    """Import a module of the optional dependency `extra`; RecordingError if it is missing."""
    try:
        return import_module(module)
    except ImportError as failure:
        package = module.partition('.')[0]
        reason = f"{what} needs {package}: pip install 'thermo_comp[{extra}]'"
        raise RecordingError(reason) from failure


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path of a log to RecordingErrors that name no file."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(error.message, error.path or path, error.key) from error


def write_log(
    log: ForeignLog,
    output: str | Path,
    force: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> ConversionReport:
    """Check a log and write it as a bag: a file ``*.mcap`` or a rosbag2 directory."""
    try:
        valid_serial(log.serial or 'without')
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
    log = _with_readings(log.take(usable), lambda part: _is_in_range(part.stamp_ns))
    line, stamp_ns = line[usable], log.stamp_ns
    stillness = find_stillness(stamp_ns, log.accel)
    _refuse_wrong_units(log, stillness)
    low, high = PLAUSIBLE_CELSIUS
    n_readings = sum(len(part.celsius) for part in log.temperatures.values())
    log = _with_readings(log, lambda part: (part.celsius >= low) & (part.celsius <= high))
    _write(log, Path(output), force, progress)
    newest = np.maximum.accumulate(stamp_ns)
    steps = np.diff(newest)
    lower, upper = log.clip or (-np.inf, np.inf)
    is_clipped = np.any((log.accel <= lower) | (log.accel >= upper), axis=1)
    counts = {name: len(part.celsius) for name, part in log.temperatures.items()}
    return ConversionReport(
        log,
        rows=len(usable) + len(log.short),
        messages={'accel': len(stamp_ns), 'board': 0, 'case': 0, **counts},
        rate_hz=1e9 / float(np.median(steps[steps > 0])) if steps.any() else float('nan'),
        duration_s=float(newest[-1] - stamp_ns[0]) * 1e-9,
        findings={
            'short_rows': Finding(len(log.short), tuple(log.short[:_EXAMPLES])),
            'non_numeric': not_numeric,
            'out_of_range': out_of_range,
            'clipped': _finding(is_clipped, line),
            'impossible': Finding(n_readings - sum(counts.values())),
            'continued': Finding(len(log.continued), log.continued[:_EXAMPLES]),
            'backwards': _finding(np.diff(stamp_ns, prepend=stamp_ns[0]) < 0, line),
            'repeated': _finding(np.diff(stamp_ns, prepend=stamp_ns[0] - 1) == 0, line),
        },
        inferred_unit=infer_unit(stillness.magnitude)[1],
        stillness=stillness,
    )


def _with_readings(log: ForeignLog, is_good: Callable[[Readings], Bools]) -> ForeignLog:
    kept = {name: part.take(is_good(part)) for name, part in log.temperatures.items()}
    return replace(log, temperatures=kept)


def _is_in_range(stamp_ns: Ints) -> Bools:
    return np.asarray((stamp_ns >= 0) & (stamp_ns < STAMP_END_NS))


def _finding(rows: Bools, line: Ints) -> Finding:
    indices = np.flatnonzero(rows)
    return Finding(len(indices), tuple(line[indices[:_EXAMPLES]].tolist()))


def _refuse_wrong_units(log: ForeignLog, stillness: Stillness) -> None:
    reason = contradiction(log.unit, stillness.magnitude, log.counts_per_g)
    if reason is not None:
        reason = f'the stated unit of the accelerometer is {log.unit}, but {reason}'
        raise RecordingError(reason, path=log.path)
    low, high = PLAUSIBLE_CELSIUS
    for name, readings in log.temperatures.items():
        typical = float(np.nanmedian(readings.celsius)) if len(readings.celsius) else low
        if not low <= typical <= high:
            guess = ': that looks like kelvins' if KELVINS[0] < typical < KELVINS[1] else ''
            raise RecordingError(
                f'the {name} temperature is {typical:.4g} degC in the median{guess}; expected '
                f'{low:g} to {high:g}: the unit in a column map may be degC, K, degF or raw',
                path=log.path,
            )


def _log_times(stamp_ns: Ints, shifts: Ints | None = None) -> tuple[Ints, Ints]:
    """
    Return log times that never decrease, and the shift added after each restart of the clock [ns].
    `shifts`: the shifts of the samples' stamps, if `stamp_ns` are stamps of temperature readings.
    """
    is_restart = np.diff(stamp_ns, prepend=stamp_ns[:1]) < -_RESTART_NS
    if shifts is None or len(shifts) != is_restart.sum():
        newest = np.maximum.reduceat(stamp_ns, [0, *np.flatnonzero(is_restart)])
        shifts = np.cumsum(newest[:-1] + 1 - stamp_ns[is_restart])
    moved = stamp_ns + np.concatenate(([0], shifts))[np.cumsum(is_restart)]
    return np.maximum.accumulate(moved), shifts


def _write(log: ForeignLog, output: Path, force: bool, progress: Callable[[float], None]) -> None:
    """Write the messages with log times that never decrease, so that the order of rows is kept."""
    topics, n = Topics(), len(log.stamp_ns)
    newest, shifts = _log_times(log.stamp_ns)
    per_g = PER_G.get(log.unit, log.counts_per_g or 1.0)
    factor = STANDARD_GRAVITY / per_g if log.input == 'imu' else 1.0
    waiting = [
        (thermometer(name), readings, _log_times(readings.stamp_ns, shifts)[0])
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
                due = readings.take(run)
                writer.write_temperature(topic, *due[:2], log_ns[run], log.frame_id)
            since = until
            stamp_ns, values = log.stamp_ns[rows], log.accel[rows] * factor
            if log.input == 'counts':
                writer.write_counts(topics.counts, stamp_ns, values, log.frame_id, newest[rows])
            else:
                imu = ImuColumns.of_rate(None if log.gyro is None else log.gyro[rows])
                writer.write_imu(
                    topics.imu, stamp_ns, values, np.zeros(9), log.frame_id, imu, newest[rows]
                )
            writer.flush()
            progress(rows.stop / n)


def find_stillness(stamp_ns: Ints, accel: Floats) -> Stillness:
    """Find the rests and movements in samples, shape (n, 3), by their scatter."""
    reduced = CellAccumulator(_CELL_S, None, least=_MIN_SAMPLES)
    for first in range(0, len(accel), _RUN_ROWS):
        run = slice(first, first + _RUN_ROWS)
        reduced.add(stamp_ns[run], accel[run])
    cells = reduced.cells()
    full = is_full(cells, _MIN_SAMPLES)
    if not full.any():
        return Stillness(float('nan'), float('nan'), 0.0, ())
    sd = np.sqrt(cells.variance[full].mean(axis=1))
    # The quiet level is the lower quartile and not the median of the cells' sd, because a unit may
    # be handled for most of a log. The smallest quiet level is a quantum: less noise is invisible.
    is_quiet = sd <= _MOVING_RATIO * max(np.quantile(sd, 0.25), cells.quantum.max())
    cell_ns = round(cells.cell_s * 1e9)
    moving: list[tuple[int, int]] = []
    for begin in (cells.start_ns + cells.index[full][~is_quiet] * cell_ns).tolist():
        is_next = moving and begin - moving[-1][1] <= _MERGE_NS
        moving.append((moving.pop()[0] if is_next else begin, begin + cell_ns))
    return Stillness(
        magnitude=float(np.median(np.linalg.norm(cells.mean[full][is_quiet], axis=1))),
        noise=float(np.median(sd[is_quiet])),
        still_s=float(is_quiet.sum() * cells.cell_s),
        moving_ns=tuple(moving),
    )


def infer_unit(magnitude: float) -> tuple[Unit | Literal['unknown'], str]:
    """Return the unit (or ``unknown``) that follows from the norm of samples at rest, and why."""
    if not np.isfinite(magnitude):
        return 'unknown', 'the sensor never rests, so |a| at rest cannot identify g or m/s^2'
    reading = f'|a| at rest is {magnitude:.4g}'
    for unit, gravity in PER_G.items():
        if abs(magnitude / gravity - 1.0) <= _TOLERANCE:
            return unit, f'{reading}, gravity is {gravity:.4g} {unit}'
    for sensitivity in _SENSITIVITIES:
        if abs(magnitude / sensitivity - 1.0) <= _TOLERANCE:
            return 'counts', f'{reading}, as for a sensor with {sensitivity} counts per g'
    if magnitude > 50.0:
        return 'counts', f'{reading}, which is not gravity in g or m/s^2'
    return 'unknown', f'{reading}, which is not gravity in any known unit'


def contradiction(stated: str, magnitude: float, counts_per_g: float | None) -> str | None:
    """Return why the norm of samples at rest excludes the stated unit; None if it does not."""
    if not np.isfinite(magnitude):
        return None
    inferred, reason = infer_unit(magnitude)
    if stated != 'counts' and inferred == 'unknown':
        return reason
    if stated != 'counts':
        return None if inferred == stated else f'{reason}: that looks like {inferred}'
    if counts_per_g is not None and abs(magnitude / counts_per_g - 1.0) > _TOLERANCE:
        text = f'|a| at rest is {magnitude:.4g} counts, but {counts_per_g:g} counts/g are stated'
        return f'{text}: is there an `offset`?' if magnitude > 2.0 * counts_per_g else text
    return f'{reason}: that looks like {inferred}' if magnitude < 50.0 else None
