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
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ..errors import RecordingError
from ..typing import Ints
from .log import NO_STAMP, ForeignLog, Readings, thin
from .units import find_stillness

T = TypeVar('T')

_CENTURY_US = 100 * 366 * 86400 * 10**6
#: No noise at all, but for the rounding of sums [parts of g].
_NO_NOISE = 1e-6


def chosen(
    path: Path,
    imus: Mapping[int, ForeignLog],
    baros: Mapping[int, Readings],
    compensated: Mapping[int, str],
    imu: int | None,
    baro: int | None,
    allow_compensated: bool,
) -> ForeignLog:
    """
    Take one IMU and one barometer out of what a log holds, by default those of lowest instance;
    `compensated` says why the thermal drift of an IMU is gone from its readings already.
    """
    why = compensated.get(min(imus, default=0) if imu is None else imu)
    if why and not allow_compensated:
        raise RecordingError(why, path=path)
    rows = _instance(imus, imu, 'IMU', path)
    stamped = rows.stamp_ns != NO_STAMP
    rest = find_stillness(rows.stamp_ns[stamped], rows.accel[stamped])
    if rest.noise <= _NO_NOISE * rest.magnitude:
        raise RecordingError(
            'the accelerometer at rest has no noise at all: this is a log of a simulator (SITL), '
            'from which no calibration of a real sensor can come',
            path=path,
        )
    heard = {number: _reported(readings) for number, readings in baros.items()}
    if baro is None:
        heard = {number: readings for number, readings in heard.items() if len(readings.celsius)}
    found = [_reported(one) for one in rows.temperatures.values()]
    if heard or baro is not None:
        found.append(_instance(heard, baro, 'barometer', path))
    named = zip(('board', 'case'), (thin(one) for one in found if len(one.celsius)), strict=False)
    return replace(rows, temperatures=dict(named))


def stamps_ns(microseconds: npt.NDArray[Any]) -> Ints:
    """
    Turn microseconds since the autopilot's start into stamps; `NO_STAMP` where the number is no
    time: beyond a century, from a damaged file.
    """
    whole = np.asarray(microseconds)
    size = whole.astype(np.float64)
    is_time = (size >= 0.0) & (size < _CENTURY_US)
    return np.where(is_time, np.where(is_time, whole, 0).astype(np.int64) * 1000, NO_STAMP)


def _instance(found: Mapping[int, T], wanted: int | None, what: str, path: Path) -> T:
    if not found:
        raise RecordingError(f'the log holds no {what}', path=path)
    number = min(found) if wanted is None else wanted
    if number not in found:
        there = ', '.join(map(str, sorted(found)))
        raise RecordingError(f'the log holds no {what} {number}; there are: {there}', path=path)
    return found[number]


def _reported(readings: Readings) -> Readings:
    """Leave out what no thermometer said: NaN, and the zeros of a sensor that has none."""
    use = np.isfinite(readings.celsius) & (readings.stamp_ns != NO_STAMP)
    use &= bool(readings.celsius[use].any())
    return readings.take(use)
