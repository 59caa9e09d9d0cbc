# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fleet table as files: Parquet for programs, CSV for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from ..errors import FleetError
from ..files import CSV, PARQUET, write_atomically
from .row import COLUMNS, Row, empty_row


def write_tables(rows: Sequence[Row], folder: Path) -> tuple[Path, Path]:
    """
    Write the table twice.

    Parameters
    ----------
    rows : sequence of mapping
        One per unit, each with all columns.
    folder : Path
        Where fleet.parquet and fleet.csv go.

    Returns
    -------
    parquet, csv : Path
        The files; each is replaced as a whole.

    Raises
    ------
    OutputError
        If one cannot be written.

    """
    parquet, text = folder / 'fleet.parquet', folder / 'fleet.csv'
    write_atomically(parquet, to_parquet(rows), PARQUET)
    write_atomically(text, to_csv(rows).encode(), CSV)
    return parquet, text


def to_parquet(rows: Sequence[Row]) -> bytes:
    """Return the table as Parquet; what a column means stands in its metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    types = {'text': pa.string(), 'whole': pa.int64(), 'number': pa.float64()}
    schema = pa.schema(
        [
            pa.field(column.name, types[column.kind], metadata={'meaning': column.meaning})
            for column in COLUMNS
        ]
    )
    columns = {column.name: [row[column.name] for row in rows] for column in COLUMNS}
    buffer = pa.BufferOutputStream()
    parquet.write_table(pa.table(columns, schema=schema), buffer)
    return bytes(buffer.getvalue())


def to_csv(rows: Sequence[Row]) -> str:
    """Return the table as CSV with a heading; numbers have all their digits."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow([column.name for column in COLUMNS])
    for row in rows:
        writer.writerow([_text(row[column.name]) for column in COLUMNS])
    return out.getvalue()


def read_parquet(path: Path) -> list[Row]:
    """
    Read a fleet table that an earlier run wrote.

    Parameters
    ----------
    path : Path
        A fleet.parquet.

    Returns
    -------
    list of mapping
        One per unit; columns that it lacks are empty.

    Raises
    ------
    FleetError
        If it is no such table.

    """
    from pyarrow import ArrowException, parquet

    try:
        found = parquet.read_table(path).to_pylist()
    except (ArrowException, OSError) as error:
        raise FleetError(f'{path}: no fleet table: {" ".join(str(error).split())}') from error
    names = {column.name for column in COLUMNS}
    if not all('serial' in row and 'verdict' in row for row in found):
        raise FleetError(f'{path}: no fleet table: it lacks the columns serial and verdict')
    return [empty_row(**{k: v for k, v in row.items() if k in names}) for row in found]


def _text(cell: object) -> str:
    if cell is None:
        return ''
    if isinstance(cell, float):
        return repr(cell)
    text = str(cell)
    # A spreadsheet would run a cell that begins like a formula.
    return f"'{text}" if text[:1] in ('=', '+', '-', '@', '\t', '\r') else text
