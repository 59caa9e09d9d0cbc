# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns PX4's ULog files (``.ulg``), behind the extra ``px4``.

``sensor_accel`` holds what the driver read, before PX4's own thermal correction and calibration,
with the temperature of the same chip; ``sensor_baro`` holds a second temperature. PX4 logs them at
1 Hz unless the logger's profile asks for more (``SDLOG_PROFILE``: thermal calibration). Where it
is missing, ``sensor_combined`` stands in: after PX4's calibration, and without a temperature.

The format: https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Floats, Ints
from .autopilot import chosen, stamps_ns
from .log import NO_STAMP, SLOW_HZ, ForeignLog, Readings

_TOPICS = (
    *('sensor_accel', 'sensor_gyro', 'sensor_baro'),
    *('sensor_combined', 'vehicle_air_data'),
)
_AXES = ('x', 'y', 'z')
_PROFILE = 'add 4 to SDLOG_PROFILE (thermal calibration): PX4 then logs sensor_accel at 10 Hz'
_INFORMATION = {'px4_hardware': 'ver_hw', 'px4_software': 'ver_sw_release', 'px4_uuid': 'sys_uuid'}
#: `accelerometer_timestamp_relative` of a message without an accelerometer.
_NOT_THERE = 2**31 - 1

_Columns = dict[str, Any]


def read_ulog(
    path: str | Path,
    imu: int | None = None,
    baro: int | None = None,
    allow_compensated: bool = False,
) -> ForeignLog:
    """Read an IMU of a PX4 log."""
    try:
        from pyulog import ULog
    except ImportError as failure:
        raise RecordingError(
            "a PX4 log needs pyulog: pip install 'thermo_comp[px4]'", path=path
        ) from failure
    with open_regular(path) as file, redirect_stdout(StringIO()):
        # Its own exception has no base but Exception, and a torn file makes it raise others: none
        # of them says more than that this is not a whole ULog.
        try:
            log = ULog(file, list(_TOPICS))
        except Exception as failure:
            raise RecordingError(f'not a ULog file ({failure})', path=path) from failure
    by_topic: dict[str, dict[int, _Columns]] = {topic: {} for topic in _TOPICS}
    for data in log.data_list:
        # A damaged format may have lost its time stamp.
        if len(data.data.get('timestamp', ())):
            by_topic[data.name][int(data.multi_id)] = data.data
    baros = {
        number: Readings(_stamps(columns), _column(columns, name))
        for topic, name in (
            ('vehicle_air_data', 'baro_temp_celcius'),
            ('sensor_baro', 'temperature'),
        )
        for number, columns in by_topic[topic].items()
    }
    metadata = {
        key: str(log.msg_info_dict[name])
        for key, name in _INFORMATION.items()
        if name in log.msg_info_dict
    }
    if log.dropouts:
        lost_ms = sum(int(dropout.duration) for dropout in log.dropouts)
        metadata['px4_dropouts'] = f'{len(log.dropouts)}, {lost_ms} ms in all'
    if log.file_corruption:
        metadata['px4_corruption'] = 'parts of the file could not be read'
    imus, compensated = {}, {}
    for number, columns in by_topic['sensor_accel'].items():
        stamp_ns = _stamps(columns)
        is_slow = len(stamp_ns) > 1 and np.median(np.diff(stamp_ns[:100])) > 1e9 / SLOW_HZ
        imus[number] = ForeignLog(
            str(path),
            stamp_ns,
            _vectors(columns, _AXES),
            _matched(stamp_ns, by_topic['sensor_gyro'].get(number)),
            {'imu': Readings(stamp_ns, _column(columns, 'temperature'))},
            serial=f'px4-accel-{int(columns["device_id"][0])}' if 'device_id' in columns else '',
            metadata=metadata,
            hint=_PROFILE if is_slow else '',
        )
    for number, columns in by_topic['sensor_combined'].items() if not imus else ():
        stamp_ns, accel, gyro = _combined(columns)
        metadata = {**metadata, 'px4_topic': 'sensor_combined'}
        hint = f'sensor_accel is missing, sensor_combined is after CAL_ACC*; {_PROFILE}'
        imus[number] = ForeignLog(str(path), stamp_ns, accel, gyro, metadata=metadata, hint=hint)
        if log.initial_parameters.get('TC_A_ENABLE') == 1:
            compensated[number] = (
                'it holds sensor_combined alone, and TC_A_ENABLE was 1: PX4 has already taken the '
                f'thermal drift out of these readings; {_PROFILE}'
            )
    return chosen(Path(path), imus, baros, compensated, imu, baro, allow_compensated)


def _combined(columns: _Columns) -> tuple[Ints, Floats, Floats | None]:
    relative = _column(columns, 'accelerometer_timestamp_relative')
    is_there = np.isfinite(relative) & (relative != _NOT_THERE)
    published = columns['timestamp'][is_there].astype(np.int64)
    stamp_ns = stamps_ns(published + relative[is_there].astype(np.int64))
    # A message with news of the gyroscope alone repeats what the accelerometer said last.
    is_new = np.concatenate((np.ones(len(stamp_ns[:1]), bool), np.diff(stamp_ns) != 0))
    accel, gyro = (
        _vectors(columns, [f'{name}[{axis}]' for axis in range(3)])[is_there][is_new]
        for name in ('accelerometer_m_s2', 'gyro_rad')
    )
    return stamp_ns[is_new], accel, gyro if np.isfinite(gyro).all() else None


def _stamps(columns: _Columns) -> Ints:
    # When the sample was taken, where the log says it; older logs only say when it was published.
    name = 'timestamp_sample' if 'timestamp_sample' in columns else 'timestamp'
    return stamps_ns(columns[name])


def _column(columns: _Columns, name: str) -> Floats:
    n = len(columns['timestamp'])
    return np.asarray(columns.get(name, np.full(n, np.nan)), dtype=np.float64)


def _vectors(columns: _Columns, names: Sequence[str]) -> Floats:
    return np.column_stack([_column(columns, name) for name in names])


def _matched(stamp_ns: Ints, columns: _Columns | None) -> Floats | None:
    """Interpolate the rate to the accelerometer's stamps; None where it was logged sparsely."""
    if columns is None:
        return None
    gyro_ns, gyro = _stamps(columns), _vectors(columns, _AXES)
    use = gyro_ns != NO_STAMP
    gyro_ns, gyro = gyro_ns[use], gyro[use]
    if 2 * len(gyro_ns) < len(stamp_ns) or not np.isfinite(gyro).all():
        return None
    at, where = (stamp_ns - stamp_ns[0]) * 1e-9, (gyro_ns - stamp_ns[0]) * 1e-9
    return np.column_stack([np.interp(at, where, gyro[:, i]) for i in range(3)])
