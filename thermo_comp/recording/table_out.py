# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the way out as a table: columns, block by block, to CSV or (extra ``parquet``) Parquet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

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
    place for the metadata. OutputError if it may not or cannot be written, or pyarrow is missing.
    """
    kind = TABLES[Path(path).suffix]
    with drafted(path, kind, overwrite=overwrite) as partial, partial.open('wb') as file:
        if kind is CSV:
            yield lambda columns: _write_csv(file, columns)
            return
        try:
            import pyarrow as pa
            from pyarrow import parquet as pq
        except ImportError as error:
            raise OutputError("needs pyarrow: pip install 'thermo_comp[parquet]'", path) from error
        with ExitStack() as stack:
            writer: Any = None

            def write(columns: Mapping[str, NDArray[Any]]) -> None:
                nonlocal writer
                arrays = {name: pa.array(column) for name, column in columns.items()}
                table = pa.table(arrays, metadata=dict(metadata))
                writer = writer or stack.enter_context(pq.ParquetWriter(file, table.schema))
                writer.write_table(table)

            yield write


def _write_csv(file: BinaryIO, columns: Mapping[str, NDArray[Any]]) -> None:
    # str of a float has all its digits.
    cells = [map(str, column.tolist()) for column in columns.values()]
    rows: Iterable[Iterable[str]] = zip(*cells, strict=True)
    if not file.tell():
        rows = chain([columns], rows)
    file.writelines(f'{",".join(row)}\n'.encode() for row in rows)
