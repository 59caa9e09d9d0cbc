# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the output of the command line: tables, JSON, progress, and one-line error messages.

Results go to stdout, all texts about the run (progress, notes, errors) to stderr, so that a pipe
carries results only. Serials, topics, metadata and file names may contain control characters and
line breaks: `_print` escapes these, and characters that the terminal cannot encode.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

import typer

from ..text import one_line
from ..unit.gravity import MICRO_G

if TYPE_CHECKING:
    from ..fitting.reduction import ReducedBag

Cell = str | int | float | None
# Matches a cell with a number, or with a dash for None.
_NUMBER = re.compile(r'-|[-+]?\d+\.?\d*(e[-+]\d+)?')


class Output:
    """The output of a command: tables and sentences, or a JSON object, or nothing but errors."""

    def __init__(self, as_json: bool = False, quiet: bool = False) -> None:
        self.as_json, self.quiet = as_json, quiet
        self._has_missing_parts = False

    def line(self, text: str = '') -> None:
        """Print a sentence of the result."""
        if not (self.as_json or self.quiet):
            _print(text, sys.stdout)

    def note(self, text: str) -> None:
        """Print a sentence about the run on stderr, unless `quiet`."""
        if not self.quiet:
            _print(f'thermo_comp: {text}', sys.stderr)

    def sources(self, bags: Iterable[tuple[object, str | None, str | None]]) -> None:
        """Print the notes on chosen topics (equal notes once), and the missing parts of bags."""
        by_note: dict[str, list[object]] = {}
        for bag, chosen, missing in bags:
            if chosen:
                by_note.setdefault(chosen, []).append(bag)
            if missing:
                # Missing parts make the exit code 1, so they are printed even with --quiet.
                _print(f'thermo_comp: {bag}: {missing}', sys.stderr)
                self._has_missing_parts = True
        for chosen, names in by_note.items():
            more = f' and {len(names) - 1} more' if len(names) > 1 else ''
            self.note(f'{names[0]}{more}: {chosen}')

    def recordings(self, bags: Sequence[ReducedBag]) -> None:
        """Print the notes on chosen topics, the missing parts of bags, and the joined bags."""
        self.sources((bag.info.path, bag.info.chosen, bag.info.truncated) for bag in bags)
        for bag in bags:
            if bag.parts:
                self.note(f'{bag.source.name}: {len(bag.parts)} bags of one recording, joined')

    def end(self, code: int = 0, /, **data: Any) -> None:
        """End a command: print JSON if requested; exit with `code`, or 1 if a bag lacks parts."""
        if self.as_json:
            print(json.dumps(plain(data), indent=2, allow_nan=False))
        if code or self._has_missing_parts:
            raise typer.Exit(code or 1)

    def points(self, findings: Iterable[object]) -> None:
        """Print texts as a list, one per line."""
        for finding in findings:
            self.line(f'- {finding}')

    def table(self, head: Sequence[str], rows: Iterable[Sequence[Cell]], title: str = '') -> None:
        """Print a table of aligned columns, numbers flush right; None is printed as a dash."""
        if not (self.as_json or self.quiet):
            for line in aligned(head, rows, title):
                _print(line, sys.stdout)

    @contextmanager
    def live(self) -> Iterator[Callable[..., None] | None]:
        """Yield a function that redraws a table and lines; None without a terminal or if quiet."""
        if self.quiet or not sys.stderr.isatty():
            yield None
            return
        from rich.console import Console
        from rich.live import Live
        from rich.text import Text

        console = Console(stderr=True)
        with Live(console=console, transient=True, auto_refresh=False) as view:

            def show(
                columns: Sequence[str], rows: Sequence[Sequence[Cell]], lines: Sequence[str]
            ) -> None:
                # In a short terminal, show all lines below the table, and the newest rows.
                newest = rows[-max(1, console.height - len(lines) - 3) :]
                shown = [*aligned(columns, newest), '', *lines]
                view.update(Text('\n'.join(_shown(x, sys.stderr) for x in shown)), refresh=True)

            yield show

    @contextmanager
    def progress(self, what: str, total: float | None = 1.0) -> Iterator[Callable[[float], None]]:
        """Show a progress bar on a terminal; yield a function that takes the amount done."""
        if self.quiet or not sys.stderr.isatty():
            yield lambda _done: None
            return
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress, TimeElapsedColumn

        columns = (*Progress.get_default_columns(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(escape(_shown(what, sys.stderr)), total=total)
            yield lambda done: bar.update(task, completed=done)


def error(message: str) -> None:
    """Print the error of a failed command on one line."""
    _print(f'thermo_comp: error: {" ".join(message.split())}', sys.stderr)


def _print(text: str, stream: TextIO) -> None:
    print(_shown(text, stream), file=stream)


def _shown(text: str, file: TextIO) -> str:
    """Escape control characters, and characters that the stream cannot encode."""
    encoding = file.encoding or 'utf-8'
    return one_line(text).encode(encoding, 'backslashreplace').decode(encoding)


def text(cell: Cell) -> str:
    """Return a cell as text: floats with 4 digits or more, up to 6 decimals; None, NaN as dash."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return '-'
    if isinstance(cell, float):
        if cell == 0.0 or abs(cell) >= 999.5:
            return f'{cell:.0f}'
        return f'{cell:.{min(3 - math.floor(math.log10(abs(cell))), 6)}f}'
    return one_line(str(cell))


def micro(value: float) -> str:
    """Return a number in ppm, micro-g or micro-rad as the tables show it."""
    # Adding 0.0 turns a negative zero into 0.0.
    return f'{round(value, 1) + 0.0:.1f}' if abs(value) < 99.95 else f'{value:.0f}'


def micro_g(value: float) -> str | None:
    """Return a residual [m/s^2] in micro-g as the tables show it, None if it is not finite."""
    return micro(value / MICRO_G) if math.isfinite(value) else None


def millidegrees(value: float) -> str | None:
    """Return an angular rate [rad/s] in mdeg/s as the tables show it, None if not finite."""
    return f'{1e3 * math.degrees(value):.3g}' if math.isfinite(value) else None


def aligned(head: Sequence[str], rows: Iterable[Sequence[Cell]], title: str = '') -> Iterator[str]:
    """Yield the lines of a table, two blanks between columns."""
    cells = [[text(cell) for cell in row] for row in rows]
    if title:
        yield title
    right = [all(_NUMBER.fullmatch(row[i]) for row in cells if row[i]) for i in range(len(head))]
    lines = [list(head), *cells]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for row in lines:
        yield '  '.join(
            cell.rjust(width) if is_right else cell.ljust(width)
            for cell, width, is_right in zip(row, widths, right, strict=True)
        ).rstrip()


def picked(value: object, names: str) -> dict[str, Any]:
    """Return the attributes of an object whose names `names` lists, separated by blanks."""
    return {name: getattr(value, name) for name in names.split()}


def plain(data: object) -> Any:
    """Return data in JSON's types: arrays as lists, dataclasses as objects, null if not finite."""
    return json.loads(json.dumps(data, default=_plainer), parse_constant=lambda _: None)


def _plainer(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    # Arrays and scalars of numpy have `tolist`, so numpy need not be imported.
    return value.tolist() if hasattr(value, 'tolist') else str(value)
