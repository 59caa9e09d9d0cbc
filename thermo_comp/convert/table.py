# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reading of tables (CSV, TSV, blank-separated, Parquet) into named columns of float64.

A cell that is not a number becomes NaN. Stamps are read exactly, by their decimal digits, because
a float does not resolve nanoseconds since 1970.
"""

import csv
import os
import re
from array import array
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from io import TextIOWrapper
from itertools import chain, islice, takewhile
from math import nan
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import RecordingError
from ..files import open_regular
from ..quantities import NotNegative, Positive
from ..typing import Floats, Ints
from .headings import Column, read_headings
from .log import NO_STAMP, import_extra

TimeUnit = Literal['s', 'ms', 'us', 'ns', 'iso']

_SNIFF_BYTES = 65536
_LAYOUT_ROWS = 50  # number of rows, at the end of the first 64 KiB, that determine the layout
_PREAMBLE_ROWS = 1000  # largest number of rows before the table, as some loggers write
_ROWS_AT_ONCE = 4096  # number of rows whose cells are read together
_MOST_ROWS_PER_BYTE = 4  # largest plausible number of rows per byte of a Parquet file
#: Exponent n of each unit of time: the unit is 10^n nanoseconds.
STAMP_EXPONENTS: dict[TimeUnit, int] = {'s': 9, 'ms': 6, 'us': 3, 'ns': 0}
#: Date of ISO 8601, in UTC unless an offset is given; the name of a zone may follow in brackets.
_ISO = re.compile(
    r'(\d{4}-\d\d-\d\d[T ]\d\d:\d\d)(?:(:\d\d)(?:[.,](\d{1,9})\d*)?)?'
    r'\s*(?:(Z|UTC)|([+-])(\d\d):?(\d\d)?)?(?:\s*\[[^\]]*\])?'
)

_DELIMITERS = {'tab': '\t', 'blank': ' '}

_Rows = Iterator[tuple[int, list[str]]]  # line number and cells of each row


@dataclass(frozen=True)
class Format:
    """Layout of a text table; an attribute that is None is detected from the text."""

    delimiter: Literal[',', ';', '|', 'tab', 'blank'] | None = None
    header: bool | None = None


@dataclass(frozen=True)
class Stamp:
    """The source of stamps: a column of times, or a fixed sample rate."""

    column: Column | None = None
    unit: TimeUnit | None = None
    rate_hz: Positive | None = None
    start_s: NotNegative = 1.0  # stamp of the first row; in ROS the stamp 0 means "no time yet"

    def __post_init__(self) -> None:
        if (self.column is None) == (self.rate_hz is None):
            raise ValueError('give either `column` and `unit`, or `rate_hz`')
        if self.column is not None and self.unit is None:
            raise ValueError('`unit` must be s, ms, us, ns or iso if `column` is given')

    def ticks(self, n: int) -> Ints:
        """Return stamps of n rows at the fixed rate [ns]; rounding errors do not accumulate."""
        steps: Ints = np.rint(np.arange(n) * (1e9 / (self.rate_hz or 1.0))).astype(np.int64)
        return steps + round(self.start_s * 1e9)


@dataclass(frozen=True)
class Table:
    """Columns of a table of n rows, in file order."""

    line: Ints  # line of each row in the file, from 1; in Parquet the number of the row
    values: dict[Column, Floats]  # NaN if a cell is not a number
    stamp_ns: Ints  # `NO_STAMP` if a cell is not a number
    short: Sequence[int] = ()  # lines of dropped rows with too few cells, such as a cut row
    not_used: tuple[str, ...] = ()  # headings (or numbers) of the columns that were not read
    headings: tuple[str, ...] = ()


def read_text(
    path: Path, columns: Sequence[Column] | None, stamp: Stamp, style: Format | None = None
) -> Table:
    """Read columns of a text table, by headings or numbers from 0; all if `columns` is None."""
    try:
        with open_regular(path) as raw:
            file = TextIOWrapper(raw, encoding='utf-8-sig', errors='replace', newline='')
            head = file.read(_SNIFF_BYTES)
            if '\0' in head:
                raise RecordingError('not a table of text: it holds zero bytes')
            file.seek(0)
            style = style or Format()
            given = _DELIMITERS.get(style.delimiter or '', style.delimiter)
            delimiter, width = layout(head, given)
            headings, rows = _begin(_rows(file, delimiter), width, style.header)
            if not headings and style.header is None:
                headings = _commented(head, delimiter, width)
            return _collect(headings, rows, columns, stamp)
    except (UnicodeError, csv.Error) as failure:
        raise RecordingError(f'not a table of text ({failure})') from failure
    except OSError as failure:
        raise RecordingError(failure.strerror or str(failure)) from failure


def layout(head: str, delimiter: str | None = None) -> tuple[str, int]:
    """
    Return the delimiter of a text table and the number of cells per row: the delimiter that splits
    most lines into the same number of cells (a blank is any run of white space). `head` may begin
    with a preamble and end in a cut line: only the 50 lines before its last line are examined.
    """
    lines = [line for line in head.splitlines() if line.strip() and not _is_comment(line)]
    lines = lines[:-1] if len(lines) > 2 else lines
    candidates: list[tuple[int, str, int]] = []
    # The comma is tried late: it may be the decimal sign in a table with another delimiter.
    for sign in (';', '\t', '|', ',', ' ') if delimiter is None else (delimiter,):
        rows = [row for _, row in _rows(lines, sign)]
        width, n_rows = _most_frequent([_n_cells(row) for row in rows[-_LAYOUT_ROWS:]])
        # If a slow thermometer is in the last column, most rows end in an empty cell: rows without
        # an empty cell then determine the width.
        whole, _ = _most_frequent([len(row) for row in rows[-_LAYOUT_ROWS:]])
        is_whole = any(len(row) == whole and row[-1].strip() for row in rows)
        candidates.append((n_rows if width > 1 else 0, sign, whole if is_whole else width))
    return max(candidates, key=itemgetter(0))[1:]


def _most_frequent(numbers: Sequence[int]) -> tuple[int, int]:
    commonest = max(set(numbers), key=numbers.count, default=0)
    return commonest, numbers.count(commonest)


def _is_comment(cell: str) -> bool:
    return cell.lstrip().startswith(('#', '%', '//'))


def _n_cells(row: Sequence[str]) -> int:
    return len(row) - (not row[-1].strip())


def _rows(file: Iterable[str], delimiter: str) -> _Rows:
    """Yield line number and cells of every line that is neither empty nor a comment."""
    if delimiter == ' ':
        cells: Iterable[list[str]] = (line.split() for line in file)
    else:
        cells = csv.reader(file, delimiter=delimiter)
    for number, row in enumerate(cells, 1):
        # A row that begins with a digit, as nearly all rows do, is no comment and not empty.
        if row and (
            row[0][:1].isdigit() or (not _is_comment(row[0]) and any(map(str.strip, row)))
        ):
            yield number, row


def _begin(rows: _Rows, width: int, has_header: bool | None) -> tuple[list[str], _Rows]:
    """
    Skip the preamble; return the headings, if any, and the rows of a table. A row has `width`
    cells; its last cell may be blank. Rows of `width` cells directly before the first row of
    numbers belong to the table, and the first of these rows has the headings.
    """
    first = list(islice(rows, _PREAMBLE_ROWS))
    is_row = [_n_cells(row) <= width <= len(row) for _, row in first]
    n_numbers = [sum(_number(cell) is not None for cell in row) for _, row in first]
    is_first = [fits and 2 * n > width for fits, n in zip(is_row, n_numbers, strict=True)]
    if not any(is_first):
        is_first, has_header = is_row, has_header is not False
    begin = is_first.index(True) if any(is_first) else 0
    while begin and is_row[begin - 1]:
        begin -= 1
    if has_header is None:
        has_header = not n_numbers[begin]
    headings = first[begin][1] if has_header and first else []
    return [cell.strip() for cell in headings], chain(first[begin + bool(headings) :], rows)


def _commented(head: str, delimiter: str, width: int) -> list[str]:
    """Return headings from the last comment before a table, where numpy.savetxt writes them."""
    lines = (line.strip() for line in head.splitlines() if line.strip())
    text = [*takewhile(_is_comment, ('#', *lines))][-1].lstrip('#%/ ')
    cells = text.split() if delimiter == ' ' else next(csv.reader([text], delimiter=delimiter), [])
    cells = [cell.strip() for cell in cells]
    return cells if len(cells) == width and read_headings(cells) is not None else []


def _number(cell: str) -> float | None:
    """Read a cell as a number, including NaN and infinity; None if the cell is no number."""
    try:
        return float(cell)
    except ValueError:
        return None


def _numbers(cells: list[str]) -> list[float]:
    try:
        return list(map(float, cells))
    except ValueError:
        return [nan if (number := _number(cell)) is None else number for cell in cells]


def _collect(
    headings: list[str], rows: _Rows, columns: Sequence[Column] | None, stamp: Stamp
) -> Table:
    first = next(rows, None)
    if first is None:
        what = 'has headings but no rows' if headings else 'is empty'
        raise RecordingError(f'the table {what}')
    width = len(first[1])
    wanted = range(width) if columns is None else columns
    places = {name: _place(name, headings, width) for name in wanted}
    at = None if stamp.column is None else _place(stamp.column, headings, width)
    needed = 1 + max([*places.values(), -1 if at is None else at])
    for name, place in places.items():
        if re.fullmatch(r'\s*[+-]?[0-9]+,[0-9]+\s*', first[1][place]):
            why = f'column {name!r} has decimal commas, it begins with {first[1][place].strip()}: '
            raise RecordingError(why + 'write decimal points')
    line, stamps, short = array('q'), array('q'), array('q')
    values = {name: array('d') for name in places}
    rows = chain([first], rows)
    while part := list(islice(rows, _ROWS_AT_ONCE)):
        whole = [(number, row) for number, row in part if len(row) >= needed]
        short.extend(number for number, row in part if len(row) < needed)
        line.extend(number for number, _ in whole)
        for name, place in places.items():
            values[name].extend(_numbers([row[place] for _, row in whole]))
        if at is not None:
            stamps.extend(exact_ns(row[at], stamp.unit) for _, row in whole)
    if at is not None and stamp.unit == 'iso' and stamps and max(stamps) == NO_STAMP:
        raise RecordingError(
            f'no cell of its column {stamp.column!r} is a date of ISO 8601, like '
            f'2026-03-29T01:30:00.5Z; the first cell is {first[1][at].strip()!r}'
        )
    return Table(
        line=np.array(line),
        values={name: np.array(column) for name, column in values.items()},
        stamp_ns=stamp.ticks(len(line)) if at is None else np.array(stamps),
        short=short,
        not_used=_not_used(headings, width, {*places.values(), at}),
        headings=tuple(headings),
    )


def _place(name: Column, headings: Sequence[str], width: int) -> int:
    """Return the index of a column; RecordingError unless the column exists exactly once."""
    if isinstance(name, int):
        if 0 <= name < width:
            return name
        why = f'no column {name}: the table has {width} columns, 0 to {width - 1}'
    elif not headings:
        why = f'no column {name!r}: the table has no headings, give numbers from 0'
    elif headings.count(name) > 1:
        why = f'{headings.count(name)} columns are called {name!r}'
    elif name not in headings:
        why = f'no column {name!r}; there are: {", ".join(map(repr, headings))}'
    else:
        return headings.index(name)
    raise RecordingError(why)


def _not_used(headings: Sequence[str], width: int, used: Container[int | None]) -> tuple[str, ...]:
    names = headings or [str(number) for number in range(width)]
    return tuple(name for place, name in enumerate(names) if name and place not in used)


def exact_ns(cell: object, unit: TimeUnit | None) -> int:
    """Return the exact stamp of a number or date; `NO_STAMP` for other text, or beyond 64 bits."""
    text = str(cell).strip()
    try:
        number = (
            _iso_ns(text) if unit == 'iso' else Decimal(text) * 10 ** STAMP_EXPONENTS[unit or 'ns']
        )
        return round(number) if abs(number) < 2**63 - 1 else NO_STAMP
    except (ArithmeticError, ValueError):
        return NO_STAMP


def _iso_ns(text: str) -> int:
    """Return nanoseconds since 1970; ValueError for an invalid date, such as 2026-02-30."""
    match = _ISO.fullmatch(text)
    if match is None:
        raise ValueError('not a date of ISO 8601')
    minute, second, fraction, _, sign, east_h, east_min = match.groups()
    seconds = int(np.datetime64(minute + (second or ''), 's').astype(np.int64))
    east_s = 3600 * int(east_h or 0) + 60 * int(east_min or 0)
    seconds += east_s if sign == '-' else -east_s
    return seconds * 10**9 + int((fraction or '').ljust(9, '0'))


def read_parquet(path: Path, columns: Sequence[Column] | None, stamp: Stamp) -> Table:
    """Read columns of a Parquet file like `read_text`; with `columns` None, texts become NaN."""
    pq = import_extra('pyarrow.parquet', 'parquet', 'a Parquet file')
    import pyarrow as pa

    try:
        with open_regular(path) as file:
            parquet = pq.ParquetFile(file)
            if parquet.metadata.num_rows > _MOST_ROWS_PER_BYTE * os.fstat(file.fileno()).st_size:
                raise RecordingError(f'the file is too small for {parquet.metadata.num_rows} rows')
            headings = list(parquet.schema_arrow.names)
            wanted = range(len(headings)) if columns is None else columns
            names = [*wanted] if stamp.column is None else [*wanted, stamp.column]
            places = {name: _place(name, headings, len(headings)) for name in names}
            table = parquet.read(columns=[headings[i] for i in sorted(set(places.values()))])
    except RecordingError:
        raise
    except Exception as failure:  # a damaged file may raise any type of exception
        reason = ' '.join(str(failure).split())
        raise RecordingError(f'not a readable Parquet file ({reason})') from failure
    if not table.num_rows:
        raise RecordingError('the table is empty')
    cells: dict[Column, Any] = {name: table.column(headings[i]) for name, i in places.items()}
    values = {}
    for name in wanted:
        try:
            column = cells[name].cast(pa.float64(), safe=False).to_numpy()
        except (pa.ArrowException, ValueError) as failure:
            if columns is not None:
                problem = f'column {name!r} holds {cells[name].type}, expected numbers'
                raise RecordingError(problem) from failure
            column = np.full(table.num_rows, nan)
        values[name] = np.asarray(column, dtype=np.float64)
    stamp_ns = stamp.ticks(table.num_rows)
    if stamp.column is not None:
        stamps, unit = cells[stamp.column], stamp.unit
        if pa.types.is_timestamp(stamps.type):  # a timestamp of Parquet states its unit
            unit, stamps = stamps.type.unit, stamps.cast(pa.int64())
        stamp_ns = np.array([exact_ns(cell, unit) for cell in stamps.to_pylist()])
    line = np.arange(1, table.num_rows + 1, dtype=np.int64)
    not_used = _not_used(headings, len(headings), set(places.values()))
    return Table(line, values, stamp_ns, not_used=not_used, headings=tuple(headings))
