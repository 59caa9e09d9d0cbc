# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of an IMU and a barometer from logs of autopilots, with the libraries of the
optional dependencies ``px4`` and ``ardupilot``.

The thermometer of an IMU lags the surroundings, so its readings become the board temperature. The
thermometer of a barometer follows the surroundings, so its readings become the case temperature,
or the board temperature if the IMU has no thermometer. A log without noise at rest, such as a
simulator's, is refused, because the fit cannot weight samples without noise.

PX4's ULog (``.ulg``): ``sensor_accel`` holds the driver's samples before PX4's corrections, with
the temperature of the same chip, at 1 Hz unless ``SDLOG_PROFILE`` sets a higher rate. If
``sensor_accel`` is missing, ``sensor_combined`` is read: its samples are corrected by PX4's
calibration, and it has no temperature.

ArduPilot's DataFlash (``.BIN``): old logs have one message type per IMU (``IMU``, ``IMU2``), new
logs have one message type for all IMUs, whose field ``I`` is the number of the IMU; the IMU's
temperature is ``T`` or ``Temp``. Samples logged while ``INS_TCALn_ENABLE`` was 1 are dropped by
default, because ArduPilot has corrected their thermal drift. While ``INS_TCALn_ENABLE`` is 2
(learning), ArduPilot does not correct the drift; after learning it sets the parameter to 1.

https://docs.px4.io/main/en/dev_log/ulog_file_format
https://ardupilot.org/copter/docs/logmessages.html
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..files import open_regular
from ..recording.blocks import Readings
from ..typing import Floats, Ints
from .log import NO_STAMP, SLOW_HZ, ForeignLog, find_stillness, import_extra

T = TypeVar('T')


class _Correction(NamedTuple):
    """A parameter that is 1 while the autopilot corrects thermal drift, and its history."""

    parameter: str
    history: Sequence[tuple[int, float]]  # time since boot [ns], value from this time on
    advice: str  # how to log samples without this correction


#: Content of a log: IMUs with their thermal corrections, and barometers, by instance number.
_Content = tuple[Mapping[int, tuple[ForeignLog, _Correction | None]], Mapping[int, Readings]]
_Columns = dict[str, npt.NDArray[Any]]

_CENTURY_US = 100 * 366 * 86400 * 10**6
_NO_NOISE = 1e-6  # largest sd at rest of a log without noise: the sd of rounding errors [g]
_AXES = ('x', 'y', 'z')
_PROFILE = 'add 4 to SDLOG_PROFILE (thermal calibration): PX4 then logs sensor_accel at 10 Hz'
_BAROMETERS = {'vehicle_air_data': 'baro_temp_celcius', 'sensor_baro': 'temperature'}
_TOPICS = ('sensor_accel', 'sensor_gyro', 'sensor_combined', *_BAROMETERS)
_NOT_THERE = 2**31 - 1  # `accelerometer_timestamp_relative` of a message without an accelerometer
_HEADER_BYTES = 3  # number of bytes of a DataFlash message before its fields
_MESSAGE_TYPES = re.compile(r'IMU\d?|BARO|BAR\d|PARM')  # DataFlash messages that are read
_VECTORS = ('AccX', 'AccY', 'AccZ', 'GyrX', 'GyrY', 'GyrZ')


def read_autopilot(
    path: Path, imu: int | None = None, baro: int | None = None, allow_compensated: bool = False
) -> ForeignLog:
    """Read an IMU and a barometer by their numbers from 0; default: the lowest number in a log."""
    read = _ulog if path.suffix.lower() == '.ulg' else _dataflash
    try:
        # Integer conversions may overflow without a warning: `_stamps` finds impossible times.
        with np.errstate(invalid='ignore', over='ignore'):
            imus, baros = read(path)
    except OSError as failure:
        raise RecordingError(failure.strerror or str(failure)) from failure
    except (ArithmeticError, LookupError, TypeError, ValueError) as failure:
        # The messages of a damaged file do not have the declared formats.
        raise RecordingError(f'damaged: {failure}') from failure
    rows, correction = _instance(imus, imu, 'IMU')
    if correction and not allow_compensated:
        rows = _uncorrected(rows, correction)
    stamped = rows.stamp_ns != NO_STAMP
    still = find_stillness(rows.stamp_ns[stamped], rows.accel[stamped])
    if still.noise <= _NO_NOISE * still.magnitude:
        raise RecordingError(
            'the accelerometer at rest has no noise at all: this is a log of a simulator (SITL), '
            'which cannot calibrate a real sensor'
        )
    valid = {number: _valid_readings(readings) for number, readings in baros.items()}
    if baro is None:
        valid = {number: readings for number, readings in valid.items() if len(readings.celsius)}
    readings = [_valid_readings(temperature) for temperature in rows.temperatures.values()]
    if valid or baro is not None:
        readings.append(_instance(valid, baro, 'barometer'))
    thinned = (thermometer.thinned() for thermometer in readings if len(thermometer.celsius))
    named = zip(('board', 'case'), thinned, strict=False)
    return replace(rows, temperatures=dict(named))


def _uncorrected(rows: ForeignLog, correction: _Correction) -> ForeignLog:
    """Drop samples that the autopilot has corrected; RecordingError if no sample is left."""
    name, history, advice = correction
    since_ns, values = zip(*history, strict=True)
    at = np.searchsorted(np.array(since_ns, np.int64), rows.stamp_ns, 'right') - 1
    is_corrected = np.array(values)[np.maximum(at, 0)] == 1.0
    reason = 'the autopilot has already corrected the thermal drift of these samples'
    if is_corrected.all():
        raise RecordingError(
            f'{name} was 1: {reason}; {advice}; or accept these samples with --allow-compensated'
        )
    if not is_corrected.any():
        return rows
    share = 100.0 * float(is_corrected.mean())
    chosen = f'{name} was 1 for {share:.0f} % of the samples, which are left out: {reason}'
    return replace(rows.take(~is_corrected), chosen=chosen)


def _ulog(path: Path) -> _Content:
    with open_regular(path) as file:
        log = _read('pyulog', 'ULog', 'px4', 'a ULog file', file, list(_TOPICS))
    by_topic: dict[str, dict[int, _Columns]] = {topic: {} for topic in _TOPICS}
    for data in log.data_list:
        if len(data.data.get('timestamp', ())):  # in a damaged file the time stamps may be missing
            by_topic[data.name][int(data.multi_id)] = data.data
    baros = {
        number: Readings(_stamps(columns), _column(columns, name))
        for topic, name in _BAROMETERS.items()
        for number, columns in by_topic[topic].items()
    }
    notes = {'px4_corruption': 'parts of the file could not be read'}
    metadata = notes if log.file_corruption else {}
    accels, gyros, hint = by_topic['sensor_accel'], by_topic['sensor_gyro'], ''
    correction = None
    if not accels:
        for number, columns in by_topic['sensor_combined'].items():
            accels[number], gyros[number] = _combined(columns)
        hint = (
            'the log has no sensor_accel: the samples come from sensor_combined, which PX4 has '
            f'corrected by CAL_ACC*; to record raw samples, {_PROFILE}'
        )
        name = 'TC_A_ENABLE'
        history = [(0, float(log.initial_parameters.get(name, 0)))]
        history += [
            (int(at) * 1000, float(x)) for at, key, x in log.changed_parameters if key == name
        ]
        correction = _Correction(name, history, f'the log has only sensor_combined: {_PROFILE}')
    imus = {}
    for number, columns in accels.items():
        stamp_ns = _stamps(columns)
        is_slow = len(stamp_ns) > 1 and np.median(np.diff(stamp_ns[:100])) > 1e9 / SLOW_HZ
        rows = ForeignLog(
            str(path),
            stamp_ns,
            _vectors(columns, _AXES),
            _matched(stamp_ns, gyros.get(number)),
            {'imu': Readings(stamp_ns, _column(columns, 'temperature'))},
            serial=f'px4-accel-{int(columns["device_id"][0])}' if 'device_id' in columns else '',
            metadata=metadata,
            hint=hint or (_PROFILE if is_slow else ''),
        )
        imus[number] = rows, correction
    return imus, baros


def _combined(columns: _Columns) -> list[_Columns]:
    """Split ``sensor_combined`` into an accelerometer and a gyroscope."""
    relative = _column(columns, 'accelerometer_timestamp_relative')
    rows = np.flatnonzero(np.isfinite(relative) & (relative != _NOT_THERE))
    stamp_us = columns['timestamp'][rows].astype(np.int64) + relative[rows].astype(np.int64)
    # A message that has no new sample repeats the last accelerometer sample and its stamp.
    is_new = np.diff(stamp_us, prepend=stamp_us[:1] - 1) != 0
    names = [f'{name}[{i}]' for name in ('accelerometer_m_s2', 'gyro_rad') for i in range(3)]
    parts = _vectors(columns, names)[rows[is_new]].T.reshape(2, 3, -1)
    stamps = {'timestamp': stamp_us[is_new]}
    return [stamps | dict(zip(_AXES, part, strict=True)) for part in parts]


def _stamps(columns: _Columns) -> Ints:
    """Return times since boot as stamps [ns]; `NO_STAMP` for times below 0 or over a century."""
    # New logs have the time of the sample, old logs only the time of its publication.
    micros = columns['timestamp_sample' if 'timestamp_sample' in columns else 'timestamp']
    size = micros.astype(np.float64)
    is_time = (size >= 0.0) & (size < _CENTURY_US)
    return np.where(is_time, np.where(is_time, micros, 0).astype(np.int64) * 1000, NO_STAMP)


def _column(columns: _Columns, name: str) -> Floats:
    n = len(columns['timestamp'])
    return np.asarray(columns.get(name, np.full(n, np.nan)), dtype=np.float64)


def _vectors(columns: _Columns, names: Sequence[str]) -> Floats:
    return np.column_stack([_column(columns, name) for name in names])


def _matched(stamp_ns: Ints, columns: _Columns | None) -> Floats | None:
    """Interpolate angular rates to n stamps; None for fewer than n / 2 rates, or NaN in a rate."""
    if columns is None:
        return None
    gyro_ns, gyro = _stamps(columns), _vectors(columns, _AXES)
    use = gyro_ns != NO_STAMP
    gyro_ns, gyro = gyro_ns[use], gyro[use]
    if len(gyro_ns) < max(len(stamp_ns) / 2, 1) or not np.isfinite(gyro).all():
        return None
    at, where = (stamp_ns - stamp_ns[0]) * 1e-9, (gyro_ns - stamp_ns[0]) * 1e-9
    return np.column_stack([np.interp(at, where, gyro[:, i]) for i in range(3)])


def _dataflash(path: Path) -> _Content:
    with open_regular(path) as file:
        magic = file.read(2)
    if magic != b'\xa3\x95':
        raise RecordingError(
            'not a DataFlash log of ArduPilot: it does not begin with the bytes a3 95'
        )
    reader = _read(
        'pymavlink.DFReader', 'DFReader_binary', 'ardupilot', 'a DataFlash log', str(path)
    )
    imus: dict[int, ForeignLog] = {}
    baros: dict[int, Readings] = {}
    notes = {'ardupilot_simulated': 'the log has SIM_ parameters: a simulator wrote it'}
    metadata = notes if any(str(key).startswith('SIM_') for key in reader.params) else {}
    changes: dict[str, list[tuple[int, float]]] = {}
    try:
        for name in filter(_MESSAGE_TYPES.fullmatch, sorted(reader.name_to_id)):
            table, short = _messages(reader, name)
            stamp_us = table.get('TimeUS', table.get('TimeMS', np.empty(0)) * 1000.0)
            if name == 'PARM' and table.keys() >= {'Name', 'Value'}:
                for at, label, value in zip(stamp_us, table['Name'], table['Value'], strict=False):
                    title = label.decode('ascii', 'replace')
                    changes.setdefault(title, []).append((int(at) * 1000, float(value)))
                continue
            by_name = int(name[-1]) - 1 if name[-1].isdigit() else 0  # `IMU2` has the number 1
            numbers = table.get('I', np.full(len(stamp_us), by_name))
            table['timestamp'] = stamp_us
            for number in np.unique(numbers[: len(stamp_us)]).tolist():
                columns = {title: column[numbers == number] for title, column in table.items()}
                stamp_ns = _stamps(columns)
                readings = Readings(stamp_ns, _column(columns, 'T' if 'T' in columns else 'Temp'))
                if not name.startswith('IMU'):
                    baros[number] = readings
                elif columns.keys() >= {*_VECTORS}:
                    imus[number] = ForeignLog(
                        str(path),
                        stamp_ns,
                        _vectors(columns, _VECTORS[:3]),
                        _vectors(columns, _VECTORS[3:]),
                        {'imu': readings},
                        short=short,
                        metadata=metadata,
                    )
    finally:
        reader.close()
    corrected = {}
    for number, rows in imus.items():
        name = f'INS_TCAL{number + 1}_ENABLE'
        history = changes.get(name) or [(0, float(reader.params.get(name, 0.0)))]
        corrected[number] = rows, _Correction(name, history, f'set {name} to 0 and record again')
    return corrected, baros


def _messages(reader: Any, name: str) -> tuple[_Columns, list[int]]:
    """Return the columns of a message type, and the numbers (from 1) of truncated messages."""
    number = reader.name_to_id[name]
    layout = reader.formats[number]
    codes = re.findall(r'(\d*)([a-zA-Z])', layout.msg_struct)  # type codes of module `struct`
    kinds = [f'S{size or 1}' if code == 's' else f'<{code}' for size, code in codes]
    if len({*layout.columns}) < len(layout.columns):
        raise RecordingError(f'damaged: the format of {name} has a column twice')
    kind = np.dtype(list(zip(layout.columns, kinds, strict=False)))
    if _HEADER_BYTES + kind.itemsize > layout.len:
        raise RecordingError(f'damaged: the format of {name} is longer than its stated length')
    offsets = reader.offsets[number]
    is_short = np.array(offsets, np.int64) + layout.len > reader.data_len
    begins = [at + _HEADER_BYTES for at, short in zip(offsets, is_short, strict=True) if not short]
    content = b''.join(reader.data_map[at : at + kind.itemsize] for at in begins)
    rows = np.frombuffer(content, kind)
    columns = {
        title: rows[title] if factor is None else rows[title] * factor
        for title, factor in zip(layout.columns, layout.msg_mults, strict=False)
    }
    return columns, (np.flatnonzero(is_short) + 1).tolist()


def _read(module: str, name: str, extra: str, what: str, *arguments: Any) -> Any:
    """Read a file with the class `name` of a library, which the dependency `extra` installs."""
    read = getattr(import_extra(module, extra, what), name)
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        # On damaged files the libraries raise any type of exception.
        try:
            return read(*arguments)
        except Exception as failure:
            raise RecordingError(f'not {what} ({failure})') from failure


def _instance(present: Mapping[int, T], wanted: int | None, what: str) -> T:
    if not present:
        raise RecordingError(f'the log holds no {what}')
    number = min(present) if wanted is None else wanted
    if number not in present:
        numbers = ', '.join(map(str, sorted(present)))
        raise RecordingError(f'the log holds no {what} {number}; there are: {numbers}')
    return present[number]


def _valid_readings(readings: Readings) -> Readings:
    """Drop invalid readings, and all readings if all are 0: the sensor has no thermometer."""
    use = np.isfinite(readings.celsius) & (readings.stamp_ns != NO_STAMP)
    use &= bool(readings.celsius[use].any())
    return readings.take(use)
