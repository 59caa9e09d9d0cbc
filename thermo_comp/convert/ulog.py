# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns PX4's ULog files (``.ulg``), behind the extra ``px4``.

``sensor_accel`` holds what the driver read, before PX4's own thermal correction and calibration,
with the temperature of the same chip; ``sensor_baro`` holds a second temperature. PX4 logs them at
1 Hz unless the logger's profile asks for more (``SDLOG_PROFILE``: thermal calibration). Where it
is missing, ``sensor_combined`` stands in: after PX4's calibration, and without a temperature.

References
----------
.. [1] https://docs.px4.io/main/en/dev_log/ulog_file_format

"""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Floats, Ints
from .autopilot import AutopilotLog, ImuRows, stamps_ns
from .log import SLOW_HZ, Readings
from .table import NO_STAMP

_TOPICS = (
    *('sensor_accel', 'sensor_gyro', 'sensor_baro'),
    *('sensor_combined', 'vehicle_air_data'),
)
_AXES = ('x', 'y', 'z')
_PROFILE = 'add 4 to SDLOG_PROFILE (thermal calibration): PX4 then logs sensor_accel at 10 Hz'
#: `accelerometer_timestamp_relative` of a message without an accelerometer.
_NOT_THERE = 2**31 - 1


def read_ulog(path: str | Path) -> AutopilotLog:
    """
    Read the inertial sensors of a PX4 log.

    Raises RecordingError if pyulog is not installed, or the file is no ULog.
    """
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
    by_topic: dict[str, dict[int, Any]] = {topic: {} for topic in _TOPICS}
    for data in log.data_list:
        # A damaged format may have lost its time stamp.
        if len(data.data.get('timestamp', ())):
            by_topic[data.name][int(data.multi_id)] = data.data
    gyros = by_topic['sensor_gyro']
    imus = {
        number: _imu(columns, gyros.get(number))
        for number, columns in by_topic['sensor_accel'].items()
    }
    baros = {
        number: Readings(_stamps(columns), _column(columns, name))
        for topic, name in (
            ('vehicle_air_data', 'baro_temp_celcius'),
            ('sensor_baro', 'temperature'),
        )
        for number, columns in by_topic[topic].items()
    }
    metadata = _metadata(log)
    is_slow = any(
        len(one.stamp_ns) > 1 and np.median(np.diff(one.stamp_ns[:100])) > 1e9 / SLOW_HZ
        for one in imus.values()
    )
    hint = _PROFILE if is_slow else ''
    compensated: dict[int, str] = {}
    if not imus and by_topic['sensor_combined']:
        imus = {n: _combined(columns) for n, columns in by_topic['sensor_combined'].items()}
        metadata['px4_topic'] = 'sensor_combined'
        hint = f'sensor_accel is missing, sensor_combined is after CAL_ACC*; {_PROFILE}'
        if log.initial_parameters.get('TC_A_ENABLE') == 1:
            why = (
                'it holds sensor_combined alone, and TC_A_ENABLE was 1: PX4 has already taken the '
                f'thermal drift out of these readings; {_PROFILE}'
            )
            compensated = dict.fromkeys(imus, why)
    return AutopilotLog(str(path), imus, baros, metadata, hint, compensated)


def _imu(columns: dict[str, Any], gyro: dict[str, Any] | None) -> ImuRows:
    stamp_ns = _stamps(columns)
    device = columns.get('device_id')
    return ImuRows(
        stamp_ns=stamp_ns,
        accel=_vectors(columns),
        gyro=None if gyro is None else _matched(stamp_ns, _stamps(gyro), _vectors(gyro)),
        celsius=_column(columns, 'temperature'),
        serial='' if device is None else f'px4-accel-{int(device[0])}',
    )


def _combined(columns: dict[str, Any]) -> ImuRows:
    relative = _column(columns, 'accelerometer_timestamp_relative')
    is_there = np.isfinite(relative) & (relative != _NOT_THERE)
    published = columns['timestamp'][is_there].astype(np.int64)
    stamp_ns = stamps_ns(published + relative[is_there].astype(np.int64))
    # A message with news of the gyroscope alone repeats what the accelerometer said last.
    is_new = np.concatenate((np.ones(len(stamp_ns[:1]), bool), np.diff(stamp_ns) != 0))
    accel, gyro = (
        np.column_stack([_column(columns, f'{name}[{axis}]') for axis in range(3)])[is_there][
            is_new
        ]
        for name in ('accelerometer_m_s2', 'gyro_rad')
    )
    rate = gyro if np.isfinite(gyro).all() else None
    return ImuRows(stamp_ns[is_new], accel, rate, np.full(len(accel), np.nan))


def _stamps(columns: dict[str, Any]) -> Ints:
    # When the sample was taken, where the log says it; older logs only say when it was published.
    microseconds = columns.get('timestamp_sample', columns['timestamp'])
    return stamps_ns(microseconds)


def _column(columns: dict[str, Any], name: str) -> Floats:
    n = len(columns['timestamp'])
    return np.asarray(columns.get(name, np.full(n, np.nan)), dtype=np.float64)


def _vectors(columns: dict[str, Any]) -> Floats:
    return np.column_stack([_column(columns, axis) for axis in _AXES])


def _matched(stamp_ns: Ints, gyro_ns: Ints, gyro: Floats) -> Floats | None:
    """
    Interpolate the rate to the accelerometer's stamps; None where it was logged more sparsely.
    """
    use = gyro_ns != NO_STAMP
    gyro_ns, gyro = gyro_ns[use], gyro[use]
    if 2 * len(gyro_ns) < len(stamp_ns) or not np.isfinite(gyro).all():
        return None
    origin_ns = stamp_ns[0]
    at, where = (stamp_ns - origin_ns) * 1e-9, (gyro_ns - origin_ns) * 1e-9
    return np.column_stack([np.interp(at, where, gyro[:, i]) for i in range(3)])


def _metadata(log: Any) -> dict[str, str]:
    said = {'px4_hardware': 'ver_hw', 'px4_software': 'ver_sw_release', 'px4_uuid': 'sys_uuid'}
    metadata = {
        key: str(log.msg_info_dict[name])
        for key, name in said.items()
        if name in log.msg_info_dict
    }
    if log.dropouts:
        lost_ms = sum(int(dropout.duration) for dropout in log.dropouts)
        metadata['px4_dropouts'] = f'{len(log.dropouts)}, {lost_ms} ms in all'
    if log.file_corruption:
        metadata['px4_corruption'] = 'parts of the file could not be read'
    return metadata
