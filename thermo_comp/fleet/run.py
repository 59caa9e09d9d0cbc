# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns a run over a fleet: find, do what is missing, write the table and the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import FleetError
from ..files import PAGE as PAGE_FILE
from ..files import write_atomically
from .discovery import FoundUnit, find_units
from .engine import Job, connected, n_tasks, require_libraries, run
from .ledger import Ledger
from .row import Row, is_fitted, is_valid
from .storage import Storage
from .summary import Summary, summarise
from .table import write_tables
from .unit import FleetOptions

PAGE = 'fleet.html'
Tell = Callable[[int, int, Row], None]


@dataclass(frozen=True)
class FleetResult:
    """
    A fleet, done.

    Parameters
    ----------
    rows : tuple of mapping
        The fleet table, in the order of names.
    summary : Summary
        What it tells.
    n_done : int
        Units that this run did; the others were there.
    parquet, csv, page : Path
        The files.

    """

    rows: tuple[Row, ...]
    summary: Summary
    n_done: int
    parquet: Path
    csv: Path
    page: Path

    @property
    def n_fitted(self) -> int:
        """Units with a calibration."""
        return sum(is_fitted(row) for row in self.rows)

    @property
    def is_whole(self) -> bool:
        """Whether every unit has a calibration that is valid on its bags, on all of them."""
        return all(is_valid(row) for row in self.rows) and not any(
            row['n_left_out'] or row['n_torn'] for row in self.rows
        )


def fit_fleet(
    url: str,
    output: str | Path,
    options: FleetOptions,
    *,
    scheduler: str | None = None,
    n_workers: int | None = None,
    client: Any = None,
    earlier: Sequence[Row] = (),
    tell: Tell | None = None,
) -> FleetResult:
    """
    Fit all units of a fleet whose results are not there yet.

    Parameters
    ----------
    url : str
        Folder of the fleet, on any file system that fsspec knows.
    output : str or Path
        Folder of the results on this machine.
    options : FleetOptions
        What the user said.
    scheduler : str or None, optional
        Address of a Dask scheduler; None makes a cluster of this machine.
    n_workers : int or None, optional
        Processes of the own cluster.
    client : distributed.Client or None, optional
        A client that is there already, instead of the two.
    earlier : sequence of mapping, optional
        Rows of earlier fleet tables, for the drift.
    tell : callable or None, optional
        Told, after each unit: units done, units in all, its row.

    Returns
    -------
    FleetResult
        The table and what it tells.

    Raises
    ------
    FleetError
        If a library is missing, there is no bag or no scheduler.
    OutputError
        If results cannot be written.

    """
    require_libraries()
    storage = Storage(url)
    units = find_units(storage)
    ledger = Ledger(Path(output))
    _refuse_alike(units, ledger)
    rows: dict[str, Row] = {}
    jobs = []
    for unit in units:
        known = ledger.look_up(unit, options)
        if known is not None and known.is_current:
            rows[unit.name] = known.row
        else:
            jobs.append(Job(unit, known.key if known is not None else ''))

    def work(on: Any) -> None:
        for unit, outcome in run(on, storage.address, jobs, options):
            row = ledger.store(unit, options, outcome)
            rows[unit.name] = row
            if tell is not None:
                tell(len(rows), len(units), row)

    if jobs and client is not None:
        work(client)
    elif jobs:
        with connected(scheduler, n_workers, n_tasks(jobs)) as own:
            work(own)
    ordered = tuple(rows[unit.name] for unit in units)
    return _written(ordered, summarise(ordered, earlier), len(jobs), ledger)


def _refuse_alike(units: Sequence[FoundUnit], ledger: Ledger) -> None:
    """Refuse two units whose results would lie in one folder."""
    seen: dict[Path, str] = {}
    for unit in units:
        other = seen.setdefault(ledger.folder_of(unit.name), unit.name)
        if other != unit.name:
            raise FleetError(f'{unit.name} and {other} are too much alike: rename one')


def _written(rows: tuple[Row, ...], summary: Summary, n_done: int, ledger: Ledger) -> FleetResult:
    from .page import render_fleet

    parquet, csv = write_tables(rows, ledger.folder)
    page = ledger.folder / PAGE
    content = render_fleet(rows, summary, ledger.certificate_of)
    write_atomically(page, content.encode(), PAGE_FILE)
    return FleetResult(rows, summary, n_done, parquet, csv, page)
