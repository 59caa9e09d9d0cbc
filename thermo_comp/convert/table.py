# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns tables of numbers: CSV, TSV, blank-separated or Parquet -> named columns of float64.

A cell that is no number becomes NaN and its row is counted; a stamp is read exactly, as decimal
digits, because nanoseconds since 1970 do not fit a float.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..files import open_regular
from ..typing import Floats, Ints

Column = str | int

# A row is parsed in one go with this many others: bounded memory for text, one array each.
_CHUNK_ROWS = 65536
_SNIFF_BYTES = 65536


@dataclass(frozen=True)
class Table:
    """
    Columns of one table, in file order.

    Parameters
    ----------
    path : str
        The file.
    line : ndarray of int64, shape (n,)
        Line of each row in the file, counted from 1 (the row number for Parquet).
    values : dict of {str or int: ndarray, shape (n,)}
        The columns asked for; NaN where a cell is no number.
    stamp_ns : ndarray of int64, shape (n,), or None
        The stamp column; the smallest int64 where a cell is no number.
    n_short : int
        Rows with too few cells (the last line of a log that was cut off), left out.

    """

    path: str
    line: Ints
    values: dict[Column, Floats]
    stamp_ns: Ints | None
    n_short: int


NO_STAMP = np.iinfo(np.int64).min


def read_text(
    path: Path,
    columns: Sequence[Column],
    stamp: Column | None = None,
    stamp_exponent: int = 0,
    delimiter: str | None = None,
    has_header: bool | None = None,
) -> Table:
    """
    Read some columns of a table of text.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str or int
        Headings, or numbers counted from 0.
    stamp : str or int or None, optional
        The column of time stamps.
    stamp_exponent : int, optional
        Power of ten from the stamp's unit to nanoseconds: 9 for s, 6 for ms, 3 for us, 0 for ns.
    delimiter : str or None, optional
        One character, or a blank for any run of white space; found out by default.
    has_header : bool or None, optional
        Whether the first line holds headings; found out by default.

    Raises
    ------
    RecordingError
        If the file cannot be read, is empty, or lacks a column.

    """
    try:
        with TextIOWrapper(
            open_regular(path), encoding='utf-8-sig', errors='replace', newline=''
        ) as file:
            head = file.read(_SNIFF_BYTES)
            if not head.strip():
                raise RecordingError('the table is empty', path=path)
            if '\0' in head:
                raise RecordingError('not a table of text: it holds zero bytes', path=path)
            file.seek(0)
            rows = _rows(file, delimiter if delimiter is not None else sniff(head))
            return _collect(path, rows, columns, stamp, stamp_exponent, has_header)
    except UnicodeError as failure:
        raise RecordingError(f'not a table of text ({failure})', path=path) from failure
    except csv.Error as failure:
        raise RecordingError(f'not a table of text ({failure})', path=path) from failure
    except OSError as failure:
        raise RecordingError(failure.strerror or str(failure), path=path) from failure


def sniff(head: str) -> str:
    """
    Return the delimiter of a text table: the one that splits most lines alike.

    Parameters
    ----------
    head : str
        The beginning of the file.

    Returns
    -------
    str
        One of comma, semicolon, tab, bar, or a blank for any run of white space.

    """
    lines = [line for line in head.splitlines()[:50] if line.strip() and line.lstrip()[0] != '#']
    best, best_score = ' ', 0
    for delimiter in (',', ';', '\t', '|'):
        counts = [line.count(delimiter) for line in lines]
        typical = max(set(counts), key=counts.count, default=0)
        score = counts.count(typical) if typical else 0
        if score > best_score:
            best, best_score = delimiter, score
    return best


def _rows(file: Iterable[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """
    Yield (line number, cells) of every line that holds something; ``#`` starts a comment line.
    """
    if delimiter == ' ':
        cells: Iterable[list[str]] = (line.split() for line in file)
    else:
        cells = csv.reader(file, delimiter=delimiter)
    for number, row in enumerate(cells, 1):
        if row and not row[0].lstrip().startswith('#') and any(cell.strip() for cell in row):
            yield number, row


def is_number(cell: str) -> bool:
    """Return whether a cell reads as a number (NaN and infinity count as such)."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _collect(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    columns: Sequence[Column],
    stamp: Column | None,
    stamp_exponent: int,
    has_header: bool | None,
) -> Table:
    first = next(rows, None)
    if first is None:
        raise RecordingError('the table is empty', path=path)
    if has_header is None:
        has_header = not any(is_number(cell) for cell in first[1])
    headings = [cell.strip() for cell in first[1]] if has_header else []
    if not has_header:
        rows = chain([first], rows)
    width = len(first[1])
    places = {name: place(path, name, headings, width) for name in columns}
    stamp_place = None if stamp is None else place(path, stamp, headings, width)
    needed = 1 + max([*places.values(), -1 if stamp_place is None else stamp_place])

    lines: list[Ints] = []
    blocks: list[Floats] = []
    stamps: list[Ints] = []
    n_short = 0
    while chunk := list(islice(rows, _CHUNK_ROWS)):
        whole = [(number, row) for number, row in chunk if len(row) >= needed]
        n_short += len(chunk) - len(whole)
        lines.append(np.array([number for number, _ in whole], dtype=np.int64))
        blocks.append(
            np.stack([_floats([row[i] for _, row in whole]) for i in places.values()])
            if places
            else np.empty((0, len(whole)))
        )
        if stamp_place is not None:
            stamps.append(exact_ns([row[stamp_place] for _, row in whole], stamp_exponent))
    if not lines:
        raise RecordingError('the table has headings but no rows', path=path)
    values = np.concatenate(blocks, axis=1)
    return Table(
        path=str(path),
        line=np.concatenate(lines),
        values=dict(zip(places, values, strict=True)),
        stamp_ns=np.concatenate(stamps) if stamps else None,
        n_short=n_short,
    )


def place(path: Path, name: Column, headings: Sequence[str], width: int) -> int:
    """
    Return the number of a column.

    Parameters
    ----------
    path : Path
        The file, for the error's sake.
    name : str or int
        Heading, or number counted from 0.
    headings : sequence of str
        The table's headings; empty where it has none.
    width : int
        How many columns the table has.

    Returns
    -------
    int
        Counted from 0.

    Raises
    ------
    RecordingError
        If there is no such column, or more than one.

    """
    if isinstance(name, int):
        if not 0 <= name < width:
            raise RecordingError(
                f'no column {name}: the table has {width}, 0 to {width - 1}', path=path
            )
        return name
    if not headings:
        raise RecordingError(
            f'no column {name!r}: the table has no headings, give numbers from 0', path=path
        )
    if headings.count(name) > 1:
        raise RecordingError(f'{headings.count(name)} columns are called {name!r}', path=path)
    if name not in headings:
        raise RecordingError(
            f'no column {name!r}; there are: {", ".join(map(repr, headings))}', path=path
        )
    return headings.index(name)


def _floats(cells: Sequence[str]) -> Floats:
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return np.array([_float(cell) for cell in cells], dtype=np.float64)


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float('nan')


_WHOLE = re.compile(r'\s*[+-]?\d{1,19}\s*')


def exact_ns(cells: Sequence[str], exponent: int) -> Ints:
    """
    Return stamps in nanoseconds, exact to the last digit.

    Parameters
    ----------
    cells : sequence of str
        Decimal numbers in some power-of-ten unit.
    exponent : int
        Power of ten from that unit to nanoseconds.

    Returns
    -------
    ndarray of int64
        `NO_STAMP` where a cell is no finite number or out of range.

    """
    factor = 10**exponent
    stamps = np.full(len(cells), NO_STAMP, dtype=np.int64)
    for i, cell in enumerate(cells):
        if _WHOLE.fullmatch(cell):
            value = int(cell) * factor
        else:
            try:
                number = Decimal(cell.strip())
            except InvalidOperation:
                continue
            if not number.is_finite() or abs(number.adjusted()) > 30:
                continue
            value = round(number * factor)
        if abs(value) < 2**63:
            stamps[i] = value
    return stamps
