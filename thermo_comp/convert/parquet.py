# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns Parquet tables, behind the extra ``parquet``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Floats, Ints
from .table import NO_STAMP, Column, Table, place

#: What packs numbers more tightly holds no measurement.
_MOST_ROWS_PER_BYTE = 1000
_EXPONENTS = {'s': 9, 'ms': 6, 'us': 3, 'ns': 0}


def read_parquet(
    path: Path, columns: Sequence[Column], stamp: Column | None, stamp_exponent: int
) -> Table:
    """
    Read some columns of a Parquet file.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str or int
        Headings, or numbers counted from 0.
    stamp : str or int or None
        The column of time stamps; a column of Parquet's own timestamp type states its unit
        itself.
    stamp_exponent : int
        Power of ten from the stamp's unit to nanoseconds.

    Returns
    -------
    Table
        The columns; `Table.line` is the row number from 1.

    Raises
    ------
    RecordingError
        If pyarrow is not installed, the file is no Parquet file, is empty, or lacks a column.

    """
    try:
        from pyarrow import parquet as pq
    except ImportError as failure:
        raise RecordingError(
            "a Parquet file needs pyarrow: pip install 'thermo_comp[parquet]'", path=path
        ) from failure
    try:
        with open_regular(path) as file:
            found = pq.ParquetFile(file)
            if found.metadata.num_rows > _MOST_ROWS_PER_BYTE * os.fstat(file.fileno()).st_size:
                raise RecordingError(f'it claims {found.metadata.num_rows} rows', path=path)
            headings = list(found.schema_arrow.names)
            names: list[Column] = [*columns] if stamp is None else [*columns, stamp]
            places = {name: place(path, name, headings, len(headings)) for name in names}
            table = found.read(columns=[headings[i] for i in sorted(set(places.values()))])
    except RecordingError:
        raise
    except Exception as failure:  # a damaged file surfaces there as nearly any exception type
        reason = ' '.join(str(failure).split())
        raise RecordingError(f'not a readable Parquet file ({reason})', path=path) from failure
    if not table.num_rows:
        raise RecordingError('the table is empty', path=path)
    return Table(
        path=str(path),
        line=np.arange(1, table.num_rows + 1, dtype=np.int64),
        values={
            name: _floats(path, headings[places[name]], table.column(headings[places[name]]))
            for name in columns
        },
        stamp_ns=None
        if stamp is None
        else _stamps(
            path, headings[places[stamp]], table.column(headings[places[stamp]]), stamp_exponent
        ),
        n_short=0,
    )


def _floats(path: Path, name: str, column: Any) -> Floats:
    import pyarrow as pa

    try:
        values = column.cast(pa.float64(), safe=False).to_numpy()
    except (pa.ArrowException, ValueError) as failure:
        raise RecordingError(f'column {name!r} holds {column.type}', path=path) from failure
    return np.asarray(values, dtype=np.float64)


def _stamps(path: Path, name: str, column: Any, exponent: int) -> Ints:
    import pyarrow as pa

    known = np.asarray(column.is_valid().to_numpy(), dtype=np.bool_)
    if pa.types.is_timestamp(column.type):
        exponent = _EXPONENTS[column.type.unit]
        column = column.cast(pa.int64())
    if pa.types.is_integer(column.type):
        values = column.fill_null(0).to_numpy()
        limit = (2**63 - 1) // 10**exponent
        known &= (values <= limit) & (values >= -limit if values.dtype.kind == 'i' else True)
        factor = 10**exponent
    else:
        factor = 1
        values = np.rint(_floats(path, name, column) * 10.0**exponent)
        known &= np.abs(values) < 2.0**63
    stamps = np.full(len(values), NO_STAMP, dtype=np.int64)
    stamps[known] = values[known].astype(np.int64) * factor
    return stamps
