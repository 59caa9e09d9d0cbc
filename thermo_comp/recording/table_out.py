# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way out as a table: columns, block by block, to CSV or (extra ``parquet``) Parquet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..errors import OutputError
from ..files import CSV, PARQUET, Kind, drafted

#: What a suffix stands for.
TABLES: Mapping[str, Kind] = {'.csv': CSV, '.parquet': PARQUET}
WriteRows = Callable[[Mapping[str, NDArray[Any]]], None]


@contextmanager
def table_writer(
    path: str | Path, metadata: Mapping[str, str], *, overwrite: bool = False
) -> Iterator[WriteRows]:
    """
    Write a table, by its suffix one of `TABLES`; it takes its name when the block ends well.

    Yields what takes columns by name, shape (n,) each, the same ones every time. A CSV file has no
    place for the metadata. Raises OutputError if it may not or cannot be written, or pyarrow is
    missing.
    """
    kind = TABLES[Path(path).suffix]
    with drafted(path, kind, overwrite=overwrite) as partial:
        if kind is CSV:
            yield from _csv(partial)
        else:
            yield from _parquet(partial, path, metadata)


def _csv(partial: Path) -> Iterator[WriteRows]:
    with partial.open('w', encoding='utf-8', newline='') as file:

        def write(columns: Mapping[str, NDArray[Any]]) -> None:
            if not file.tell():
                file.write(','.join(columns) + '\n')
            # str of a float has all its digits.
            cells = [map(str, column.tolist()) for column in columns.values()]
            file.writelines(','.join(row) + '\n' for row in zip(*cells, strict=True))

        yield write


def _parquet(partial: Path, path: str | Path, metadata: Mapping[str, str]) -> Iterator[WriteRows]:
    try:
        import pyarrow as pa
        from pyarrow import parquet as pq
    except ImportError as error:
        raise OutputError("needs pyarrow: pip install 'thermo_comp[parquet]'", path) from error
    with partial.open('wb') as file:
        writer: Any = None

        def write(columns: Mapping[str, NDArray[Any]]) -> None:
            nonlocal writer
            arrays = {name: pa.array(column) for name, column in columns.items()}
            table = pa.table(arrays, metadata=dict(metadata))
            if writer is None:
                writer = pq.ParquetWriter(file, table.schema)
            writer.write_table(table)

        try:
            yield write
        finally:
            if writer is not None:
                writer.close()
