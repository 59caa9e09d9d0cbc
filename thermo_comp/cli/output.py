# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns how the command line speaks: tables, JSON, progress, and one line per error.

Results go to stdout, everything about the run (progress, notes, errors) to stderr, so that a pipe
carries results only. Everything goes through `_print`: what somebody else chose (serials, topics,
metadata, file names) can neither forge a line nor move the cursor, and any terminal can show it.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer

from ..text import one_line

if TYPE_CHECKING:
    from ..recording import RecordingInfo

Cell = str | int | float | None


class Output:
    """
    Where one command prints: tables and sentences, one JSON object instead, or nothing but errors.
    """

    def __init__(self, as_json: bool = False, quiet: bool = False) -> None:
        self.as_json = as_json
        self.quiet = quiet

    def line(self, text: str = '') -> None:
        """Print one sentence of the result."""
        if not (self.as_json or self.quiet):
            _print(text)

    def note(self, text: str) -> None:
        """Print one sentence about the run, on stderr."""
        if not self.quiet:
            _print(f'thermo_comp: {text}', sys.stderr)

    def told(self, infos: Iterable[RecordingInfo]) -> bool:
        """Say what was chosen in each bag, and where it was cut off; tell whether one was."""
        found = list(infos)
        self.chosen((info.path, info.chosen) for info in found)
        torn = [info for info in found if info.truncated]
        for info in torn:
            self.note(f'{info.path}: {info.truncated}')
        return bool(torn)

    def chosen(self, bags: Iterable[tuple[object, str | None]]) -> None:
        """Say which topics were taken by their type, once for all bags that are alike."""
        alike: dict[str, list[object]] = {}
        for bag, said in bags:
            if said:
                alike.setdefault(said, []).append(bag)
        for said, names in alike.items():
            more = f' and {len(names) - 1} more' if len(names) > 1 else ''
            self.note(f'{names[0]}{more}: {said}')

    @staticmethod
    def end(*, is_torn: bool) -> None:
        """End a command that has done its work; what it read was not whole, if a bag was torn."""
        if is_torn:
            raise typer.Exit(1)

    def json(self, data: Mapping[str, Any]) -> None:
        """Print the result for machines, in ASCII; numbers that JSON does not know become null."""
        if self.as_json:
            print(json.dumps(plain(data), indent=2, allow_nan=False))

    def table(
        self, columns: Sequence[str], rows: Sequence[Sequence[Cell]], title: str = ''
    ) -> None:
        """
        Print a table: with rules and colour on a terminal, as plain aligned columns in a pipe.

        Columns of numbers are set flush right, None is a dash.
        """
        if self.as_json or self.quiet:
            return
        cells = [[_shown(text(cell), sys.stdout) for cell in row] for row in rows]
        right = [all(_is_number(row[i]) for row in cells) for i in range(len(columns))]
        if sys.stdout.isatty():
            from rich.console import Console

            table = _rich_table(columns, cells, right, title)
            Console(highlight=False, markup=False).print(table)
            return
        for text_line in aligned(columns, cells, right, title):
            _print(text_line)

    @contextmanager
    def live(self) -> Iterator[Callable[..., None] | None]:
        """
        Show a table with lines below it, anew with each call of what is yielded; None where stderr
        is no terminal or nothing is to be shown.
        """
        if self.quiet or not sys.stderr.isatty():
            yield None
            return
        from rich.console import Console, Group
        from rich.live import Live
        from rich.text import Text

        console = Console(stderr=True)
        with Live(console=console, transient=True, auto_refresh=False) as view:

            def show(
                columns: Sequence[str], rows: Sequence[Sequence[Cell]], lines: Sequence[str]
            ) -> None:
                # The lines are what it is looked at for, and then the newest rows.
                newest = rows[-max(1, console.height - len(lines) - 5) :]
                cells = [[_shown(text(cell), sys.stderr) for cell in row] for row in newest]
                table = _rich_table(columns, cells, [False] * len(columns), '')
                below = [Text(_shown(line, sys.stderr)) for line in lines]
                view.update(Group(table, *below), refresh=True)

            yield show

    @contextmanager
    def progress(self, what: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
        """
        Show a progress bar on a terminal; yields what is to be called with the amount done so far,
        of a total that is None where nobody knows it.
        """
        if self.quiet or not sys.stderr.isatty():
            yield _ignore
            return
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        with Progress(
            TextColumn('{task.description}', markup=False),
            BarColumn(),
            TaskProgressColumn(show_speed=True),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        ) as bar:
            task = bar.add_task(_shown(what, sys.stderr), total=total)
            yield lambda done: bar.update(task, completed=done)


def _rich_table(
    columns: Sequence[str], cells: Sequence[Sequence[str]], right: Sequence[bool], title: str
) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, title_justify='left', box=box.SIMPLE_HEAD, pad_edge=False)
    for heading, is_right in zip(columns, right, strict=True):
        table.add_column(heading, justify='right' if is_right else 'left')
    for row in cells:
        table.add_row(*map(Text, row))
    return table


def _ignore(_done: float) -> None:
    return


def error(message: str) -> None:
    """Print the one line that a failed command leaves behind."""
    line = ' '.join(message.split())
    _print(f'thermo_comp: error: {line}', sys.stderr)


def _print(text: str, file: TextIO | None = None) -> None:
    """Print one line."""
    stream = sys.stdout if file is None else file
    print(_shown(text, stream), file=stream)


def _shown(text: str, file: TextIO) -> str:
    """Return a line as the stream can carry it."""
    encoding = file.encoding or 'utf-8'
    return one_line(text).encode(encoding, 'backslashreplace').decode(encoding)


def text(cell: Cell) -> str:
    """Return a table cell as text: at most four significant digits, a dash for nothing."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return '-'
    if isinstance(cell, float):
        if cell == 0.0 or abs(cell) >= 999.5:
            return f'{cell:.0f}'
        return f'{cell:.{min(3 - math.floor(math.log10(abs(cell))), 6)}f}'
    return str(cell)


def micro_g(value: float) -> str:
    """Return a residual in micro-g as the tables show it."""
    # Not -0.0.
    return f'{round(value, 1) + 0.0:.1f}' if abs(value) < 99.95 else f'{value:.0f}'


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell == '-'
    return True


def aligned(
    columns: Sequence[str], cells: Sequence[Sequence[str]], right: Sequence[bool], title: str = ''
) -> Iterator[str]:
    """Yield the lines of a table as plain text, two blanks between columns."""
    widths = [
        max(len(column), *(len(row[i]) for row in cells)) if cells else len(column)
        for i, column in enumerate(columns)
    ]
    if title:
        yield title
    for row in [columns, *cells]:
        yield '  '.join(
            cell.rjust(width) if is_right else cell.ljust(width)
            for cell, width, is_right in zip(row, widths, right, strict=True)
        ).rstrip()


def plain(value: Any) -> Any:
    """Return a value in JSON's types: arrays as lists, dataclasses as objects, NaN as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, (str, bool, type(None))):
        return value
    if isinstance(value, os.PathLike):
        return str(Path(value))
    if hasattr(value, 'tolist'):  # numpy arrays and scalars, without importing numpy
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, int):
        return int(value)
    return str(value)
