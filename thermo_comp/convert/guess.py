# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the guess at a table of numbers alone: ``[t] ax ay az [wx wy wz]``, as for imu_tk.

Times rise; what rests reads gravity in its unit; and a gyroscope that counts in degrees is faster
than any hand in radians. What was taken for what is said, and a column map says it otherwise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import RecordingError
from ..typing import Floats
from .columns import Accel, ColumnMap, Format, Gyro, Stamp
from .table import STAMP_EXPONENTS, read_text
from .units import believed_unit, find_stillness

#: Between two samples lies more than the first [s], and less than the second: so times are told.
_STEPS_S = (5e-5, 0.5)
#: No gyroscope is turned by hand faster than this [rad/s].
_FASTEST_RAD_S = 20.0
_GIVE_MAP = 'give a column map: --columns MAP'


def guess_columns(path: str | Path, rate_hz: float | None = None) -> ColumnMap:
    """
    Tell the columns of a table without headings; `rate_hz` is for one without times.

    Raises RecordingError if it has headings or another number of columns, its times are none, it
    has none and no rate is given, or what rests is no gravity.
    """
    path = Path(path)
    table = read_text(path)
    width = len(table.values)
    if table.headings or width not in (3, 4, 6, 7):
        raise RecordingError(
            f'{width} columns, {"with" if table.headings else "without"} headings, do not say '
            f'what they are: {_GIVE_MAP}',
            path=path,
        )
    first = int(width in (4, 7))
    stamp = _stamp(path, table.values[0] if first else None, rate_hz)
    x, y, z = first, first + 1, first + 2
    accel = np.column_stack([table.values[column] for column in (x, y, z)])
    accel = accel[np.isfinite(accel).all(axis=1)]
    # Stillness asks for the order of the samples, and hardly for their times.
    believed, reason = believed_unit(
        find_stillness(np.arange(len(accel)) * 10**7, accel).magnitude
    )
    if believed == 'unknown':
        raise RecordingError(f'{reason}: {_GIVE_MAP}', path=path)
    output: Literal['counts', 'imu'] = 'counts' if believed == 'counts' else 'imu'
    gyro = None
    if width > 4 and believed != 'counts':
        rates = np.abs([table.values[column + 3] for column in (x, y, z)])
        is_fast = np.nanquantile(rates, 0.999) > _FASTEST_RAD_S
        gyro = Gyro((x + 3, y + 3, z + 3), 'deg/s' if is_fast else 'rad/s')
    accel_map = Accel((x, y, z), believed, output)
    return ColumnMap(stamp, accel_map, gyro=gyro, format=Format(header=False))


def spoken_columns(columns: ColumnMap) -> str:
    """Say what the columns of a table were taken for."""
    stamp = columns.stamp
    said = [f'{stamp.rate_hz:g} Hz' if stamp.column is None else f'time [{stamp.unit}]']
    said.append(f'x y z [{columns.accel.unit}]')
    if columns.gyro is not None:
        said.append(f'angular rate x y z [{columns.gyro.unit}]')
    return ', '.join(said)


def _stamp(path: Path, times: Floats | None, rate_hz: float | None) -> Stamp:
    """Tell the unit of times by how often samples come."""
    if times is None:
        if rate_hz is None:
            raise RecordingError('it has no times: give --rate-hz', path=path)
        return Stamp(rate_hz=rate_hz)
    if rate_hz is not None:
        raise RecordingError('--rate-hz: its first column has the times', path=path)
    steps = np.diff(times[np.isfinite(times)])
    step = float(np.median(steps)) if len(steps) else 0.0
    is_time = len(steps) > 0 and (steps > 0.0).mean() > 0.9
    # From the largest unit on: a step of 5 is no time in seconds, but one in ms.
    for unit, exponent in STAMP_EXPONENTS.items():
        if is_time and _STEPS_S[0] < step * 10.0 ** (exponent - 9) < _STEPS_S[1]:
            return Stamp(0, unit)
    raise RecordingError(f'its first column is no time that rises: {_GIVE_MAP}', path=path)
