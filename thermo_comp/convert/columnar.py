# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the conversion of a table with a column map."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from .. import __version__
from ..files import open_regular, shown_name
from ..typing import Floats, Ints
from .columns import ColumnMap, Thermometer
from .log import ForeignLog, Readings, thin
from .parquet import read_parquet
from .table import NO_STAMP, Column, Table, read_text


def table_log(path: str | Path, columns: ColumnMap) -> ForeignLog:
    """
    Read a table as its column map says.

    Parameters
    ----------
    path : str or Path
        The table.
    columns : ColumnMap
        What its columns are.

    Returns
    -------
    ForeignLog
        All rows, with their temperatures thinned.

    Raises
    ------
    RecordingError
        If the file cannot be read or lacks a column.

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
    stamp_ns = _stamps(table, columns)
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
        accel=_stack(table, columns.accel.columns),
        gyro=gyro,
        board=_readings(table, stamp_ns, columns.board),
        case=_readings(table, stamp_ns, columns.case),
        line=table.line,
        counts_per_g=columns.accel.counts_per_g,
        clip=columns.accel.clip,
        frame_id=columns.frame_id,
        serial=columns.serial or '',
        n_short=table.n_short,
        metadata=origin(path, columns.serial),
    )


def origin(path: str | Path, serial: str | None) -> dict[str, str]:
    """
    Return what a converted bag says about where it comes from.

    Parameters
    ----------
    path : str or Path
        The log.
    serial : str or None
        The unit.

    Returns
    -------
    dict of {str: str}
        For the bag's metadata.

    """
    digest = hashlib.sha256()
    with open_regular(path) as file:
        for chunk in iter(lambda: file.read(1 << 20), b''):
            digest.update(chunk)
    return {
        'converted_from': shown_name(path),
        'converted_from_sha256': digest.hexdigest(),
        'converted_by': f'thermo_comp {__version__}',
        **({'serial': serial} if serial else {}),
    }


def _wanted(columns: ColumnMap) -> list[Column]:
    wanted = list(columns.accel.columns)
    if columns.gyro is not None:
        wanted += columns.gyro.columns
    wanted += [t.column for t in (columns.board, columns.case) if t is not None]
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


def _readings(table: Table, stamp_ns: Ints, thermometer: Thermometer | None) -> Readings | None:
    if thermometer is None:
        return None
    slope, offset = thermometer.linear
    known = stamp_ns != NO_STAMP
    return thin(
        Readings(stamp_ns[known], table.values[thermometer.column][known] * slope + offset),
        thermometer.publish,
        thermometer.heartbeat_s,
        thermometer.period_s,
    )
