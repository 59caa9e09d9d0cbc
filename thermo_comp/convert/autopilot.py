# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the logs of autopilots have in common: numbered IMUs, their thermometer and the baro's.

The thermometer inside the IMU sits with the converter and lags: it becomes the board temperature.
The barometer beside it hardly heats itself and follows the surroundings: it becomes the case
temperature, and the board's where the IMU has none. A simulator's log is refused: it has no noise,
so nothing can be weighed by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..typing import Bools, Floats, Ints
from .log import NO_READINGS, ForeignLog, Readings, origin, thin
from .table import NO_STAMP
from .units import find_stillness

T = TypeVar('T')

_CENTURY_US = 100 * 366 * 86400 * 10**6


@dataclass(frozen=True)
class ImuRows:
    """
    One IMU's rows in an autopilot's log: stamps since its start, m/s^2, rad/s, degC or NaN.

    `serial` tells this sensor from another where the log does, `n_short` counts rows that the file
    holds in part only.
    """

    stamp_ns: Ints
    accel: Floats
    gyro: Floats | None
    celsius: Floats
    serial: str = ''
    n_short: int = 0


@dataclass(frozen=True)
class AutopilotLog:
    """What an autopilot's log says of its IMUs and barometers, by instance, and of itself."""

    path: str
    imus: dict[int, ImuRows]
    baros: dict[int, Readings]
    metadata: dict[str, str] = field(default_factory=dict)
    #: How a log would hold more.
    hint: str = ''
    #: Why the thermal drift of an IMU is gone from its readings already.
    compensated: dict[int, str] = field(default_factory=dict)


def foreign_log(
    log: AutopilotLog,
    imu: int | None = None,
    baro: int | None = None,
    allow_compensated: bool = False,
) -> ForeignLog:
    """
    Take one IMU and one barometer out of an autopilot's log; None takes the lowest instance.

    Raises RecordingError if the instance is not there, its drift is already corrected and that is
    not allowed, or the readings have no noise: a simulator's.
    """
    why = log.compensated.get(min(log.imus, default=0) if imu is None else imu)
    if why and not allow_compensated:
        raise RecordingError(why, path=log.path)
    rows = _choose(log.imus, imu, 'IMU', log.path)
    _refuse_noiseless(log.path, rows)
    baros = {number: _reported(readings) for number, readings in log.baros.items()}
    if baro is None:
        baros = {number: readings for number, readings in baros.items() if len(readings.celsius)}
    case = NO_READINGS
    if baros or baro is not None:
        case = _choose(baros, baro, 'barometer', log.path)
    board = _reported(Readings(rows.stamp_ns, rows.celsius))
    if not len(board.celsius):
        board, case = case, NO_READINGS
    return ForeignLog(
        path=log.path,
        input='imu',
        unit='m/s^2',
        factor=1.0,
        stamp_ns=rows.stamp_ns,
        accel=rows.accel,
        gyro=rows.gyro,
        board=thin(board),
        case=thin(case),
        line=np.arange(1, len(rows.stamp_ns) + 1),
        serial=rows.serial,
        n_short=rows.n_short,
        hint=log.hint,
        metadata={**log.metadata, **origin(log.path, rows.serial)},
    )


def stamps_ns(microseconds: npt.NDArray[Any]) -> Ints:
    """
    Turn microseconds since the autopilot's start into stamps.

    `NO_STAMP` where the number is no time: beyond a century, from a damaged file.
    """
    whole = np.asarray(microseconds)
    size = whole.astype(np.float64)
    is_time = (size >= 0.0) & (size < _CENTURY_US)
    return np.where(is_time, np.where(is_time, whole, 0).astype(np.int64) * 1000, NO_STAMP)


def _choose(found: Mapping[int, T], wanted: int | None, what: str, path: str) -> T:
    if not found:
        raise RecordingError(f'the log holds no {what}', path=path)
    number = min(found) if wanted is None else wanted
    if number not in found:
        there = ', '.join(map(str, sorted(found)))
        raise RecordingError(f'the log holds no {what} {number}; there are: {there}', path=path)
    return found[number]


def _reported(readings: Readings) -> Readings:
    """Leave out what no thermometer said: NaN, and the zeros of a sensor that has none."""
    use: Bools = np.isfinite(readings.celsius) & (readings.stamp_ns != NO_STAMP)
    if not readings.celsius[use].any():
        use = np.zeros(len(use), dtype=np.bool_)
    return Readings(readings.stamp_ns[use], readings.celsius[use])


def _refuse_noiseless(path: str, rows: ImuRows) -> None:
    use = np.asarray(np.all(np.isfinite(rows.accel), axis=1))
    stamp_ns, accel = rows.stamp_ns[use], rows.accel[use]
    newer = np.concatenate(([True], np.diff(stamp_ns) > 0)) if len(stamp_ns) else use[:0]
    if find_stillness(stamp_ns[newer], accel[newer]).noise == 0.0:
        raise RecordingError(
            'the accelerometer at rest has no noise at all: this is a log of a simulator (SITL), '
            'from which no calibration of a real sensor can come',
            path=path,
        )
