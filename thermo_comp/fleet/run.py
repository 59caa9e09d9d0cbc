# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns a run over a fleet: fits the tests that have no stored result, and stores the results."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from .. import files
from ..errors import FitError, ThermoCompError
from ..fitting.population import UNITS_NEEDED, population
from ..judging.verdicts import Verdict
from ..text import counted
from ..unit.calibration import Calibration
from ..unit.calibration_file import load_calibration, save_calibration
from .summary import Summary, summarise
from .table import Row, is_fitted, is_valid, row_of, write_tables
from .units import FoundUnit, Storage, find_units, folders_of_tables
from .work import FleetOptions, UnitOutcome, connected, run, sha256

PAGE, PRIOR = 'fleet.html', 'prior.yaml'
CALIBRATION, CERTIFICATE, RESULT = 'calibration.yaml', 'certificate.html', 'result.json'
_FORMAT = 3  # version of the format of `RESULT`
_LONGEST_NAME = 100  # longest name of a folder of results [characters]
_MOST_ROWS = 60  # largest number of units listed on the fleet's page; fleet.csv lists all units
# Verdicts on tests whose bags contradict the fit; a new fit with a prior would hide the fault.
_CONTRADICTIONS = Verdict.RECALIBRATE.value, Verdict.NO_BETTER.value, Verdict.SWAPPED.value


@dataclass(frozen=True)
class FleetResult:
    """The result of a run over a fleet: rows of the table sorted by name, statistics, files."""

    rows: tuple[Row, ...]
    summary: Summary
    n_done: int  # number of tests that this run fitted or tried to fit
    parquet: Path
    csv: Path
    page: Path
    prior: Path | None
    no_prior: str  # reason if there is no prior
    skipped: tuple[str, ...] = ()  # folders with tables but no bag

    @property
    def n_fitted(self) -> int:
        """Number of units with a calibration."""
        return sum(is_fitted(row) for row in self.rows)

    @property
    def is_whole(self) -> bool:
        """Whether every unit has a valid calibration, and no bag is incomplete or left out."""
        return all(is_valid(row) and not (row['n_left_out'] or row['n_torn']) for row in self.rows)


def fit_fleet(
    url: str,
    output: str | Path,
    options: FleetOptions,
    *,
    with_prior: bool = False,
    scheduler: str | None = None,
    n_workers: int | None = None,
    earlier: Sequence[Row] = (),
    progress: Callable[[int, int], None] = lambda *_: None,
) -> FleetResult:
    """
    Fit all units without a stored result. Raises ThermoCompError if the folder has no bag, a
    package is missing or the Dask cluster cannot be used, OutputError if a file cannot be written.

    `progress` is called with the numbers of finished and of all tests, first for the fits without
    a prior, then for the fits with the prior. `earlier`: rows of tables of earlier runs.
    """
    _require_packages()
    storage = Storage(url)
    units = find_units(storage)
    results = Results(Path(output))
    done: set[str] = set()
    client: Any = None
    with ExitStack() as stack:

        def fitted(some: Sequence[FoundUnit], how: FleetOptions) -> dict[str, Row]:
            nonlocal client
            rows = {unit.name: row for unit in some if (row := results.look_up(unit, how))}
            missing = [unit for unit in some if unit.name not in rows]
            if missing and client is None:
                n_used = min(n_workers or os.cpu_count() or 1, len(some))
                client = stack.enter_context(connected(scheduler, n_used))
            progress(len(rows), len(some))
            for unit, outcome in run(client, storage.address, missing, how) if missing else ():
                rows[unit.name] = results.store(unit, how, outcome)
                done.add(unit.name)
                progress(len(rows), len(some))
            return rows

        rows = fitted(units, options)
        prior, no_prior = _common(list(rows.values()), results)
        if with_prior and prior is not None:
            lacking = [unit for unit in units if lacks_data(rows[unit.name])]
            again = fitted(lacking, replace(options, fit=replace(options.fit, prior=prior)))
            for name, row in again.items():
                notes = rows[name]['reservations'], f'not fitted with the prior: {row["problem"]}'
                kept = {'reservations': '; '.join(map(str, filter(None, notes)))}
                rows[name] = row if is_fitted(row) else {**rows[name], **kept}
    ordered = tuple(rows[unit.name] for unit in units)
    summary = summarise(ordered, earlier)
    tables = write_tables(ordered, results.folder)
    page = results.folder / PAGE
    content = render_fleet(ordered, summary, results.certificate_of).encode()
    files.write_atomically(page, content, files.PAGE)
    prior_path = None if prior is None else results.folder / PRIOR
    skipped = folders_of_tables(storage)
    return FleetResult(ordered, summary, len(done), *tables, page, prior_path, no_prior, skipped)


def _require_packages() -> None:
    for name in ('distributed', 'fsspec', 'pyarrow'):
        if find_spec(name) is None:
            raise ThermoCompError(
                f"a fleet needs Dask: pip install 'thermo_comp[fleet]' ({name} is not installed)"
            )


def lacks_data(row: Row) -> bool:
    """
    Whether a unit's data are incomplete, so that the unit is fitted again with the prior of the
    fleet. False for data that contradict themselves or the fit: a prior would hide the fault.
    """
    return row['is_whole'] == 0 and row['verdict'] not in _CONTRADICTIONS


def _common(rows: Sequence[Row], results: Results) -> tuple[Calibration | None, str]:
    """
    Build and save the prior, from the last test of each serial with complete data and a valid
    calibration. If there is no prior, return None and the reason.
    """
    usable = (row for row in rows if is_valid(row) and row['is_whole'] == 1)
    tests = sorted(usable, key=lambda row: str(row['start']))
    latest = {row['serial']: str(row['name']) for row in tests}
    if len(latest) < UNITS_NEEDED:
        return None, (
            f'{counted(len(latest), "unit")} with a valid calibration from complete data, '
            f'{UNITS_NEEDED} are needed'
        )
    units = [load_calibration(results.folder_of(name) / CALIBRATION) for name in latest.values()]
    try:
        prior = population(sorted(units, key=lambda unit: unit.unit.serial))
    except FitError as error:
        return None, str(error)
    save_calibration(prior, results.folder / PRIOR, overwrite=True)
    return prior, ''


def render_fleet(
    rows: Sequence[Row], summary: Summary, certificate_of: Callable[[Row], str]
) -> str:
    """Render the fleet's page; `certificate_of` returns a certificate's relative path, or ''."""
    from ..report.figures import draw_distances, draw_shares
    from ..report.page import drawn_figures, report_figure
    from ..report.style import render

    fitted = [row for row in rows if is_fitted(row)]
    curves = {
        section: np.array([row[f'{section}_ug'] for row in fitted], np.float64)
        for section in ('raw', 'static', 'dynamic')
    }
    # A fleet of fewer than eight units is not searched for outliers: all limits are infinite.
    limits = [spread.limit for spread in summary.spreads]
    is_comparable = bool(np.isfinite(limits).any())
    figures = [report_figure(draw_shares, curves)] if fitted else []
    if is_comparable:
        labels = [spread.quantity.label for spread in summary.spreads]
        distances = [spread.z for spread in summary.spreads]
        figures.append(report_figure(draw_distances, labels, distances, limits))
    return render(
        'fleet.html',
        title='Fleet report',
        most=_MOST_ROWS,
        level='good' if all(map(is_valid, rows)) else 'reserved' if fitted else 'poor',
        rows=rows,
        summary=summary,
        n_fitted=len(fitted),
        refused=[row for row in rows if not is_fitted(row)],
        is_comparable=is_comparable,
        figures=drawn_figures(figures),
        links={row['name']: quote(certificate_of(row)) for row in fitted},
    )


class Results:
    """The folder of results, created if missing; ThermoCompError if this fails."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            (folder / 'units').mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ThermoCompError(f'{folder}: cannot be created: {error.strerror}') from error

    def folder_of(self, name: str, with_prior: object = False) -> Path:
        """Return the folder of a unit's files; no name leads out of the folder of results."""
        kind = 'with_prior' if with_prior else 'units'
        return self.folder.joinpath(kind, *map(_safe, name.split('/')))

    def certificate_of(self, row: Row) -> str:
        """Return the path of a unit's certificate in the folder of results; '' without one."""
        path = self.folder_of(str(row['name']), row['prior']) / CERTIFICATE
        return path.relative_to(self.folder).as_posix() if path.is_file() else ''

    def look_up(self, unit: FoundUnit, options: FleetOptions) -> Row | None:
        """Return the stored row of a unit; None if bags, options or stored files have changed."""
        folder = self.folder_of(unit.name, options.fit.prior)
        try:
            record = json.loads((folder / RESULT).read_bytes())
            row = row_of(**record.pop('row'))
            if not record['is_final'] or record != record | _key(unit, options):
                return None
            if is_fitted(row):
                content = (folder / CALIBRATION).read_bytes()
                is_there = (folder / CERTIFICATE).is_file() or not options.certificates
                if not is_there or sha256(content) != row['calibration_sha256']:
                    return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        return row

    def store(self, unit: FoundUnit, options: FleetOptions, outcome: UnitOutcome) -> Row:
        """Store a unit's outcome, return its table row; a failed fit keeps an old calibration."""
        folder = self.folder_of(unit.name, options.fit.prior)
        row = outcome.row
        if (folder / CALIBRATION).is_file() and not (outcome.calibration and outcome.is_final):
            texts = (row['problem'], f'{folder / CALIBRATION} of an earlier run stays')
            return row_of(**{**row, 'problem': '; '.join(map(str, filter(None, texts)))})
        if outcome.calibration:
            # The record is written last. Until then the old record has another hash than the new
            # calibration, so the unit counts as not fitted.
            content = outcome.calibration.encode()
            files.write_atomically(folder / CALIBRATION, content, files.CALIBRATION)
            (folder / CERTIFICATE).unlink(missing_ok=True)
            if outcome.certificate:
                content = outcome.certificate.encode()
                files.write_atomically(folder / CERTIFICATE, content, files.PAGE)
        record = {'is_final': outcome.is_final, 'bags': outcome.hashes, 'row': row}
        content = (json.dumps(_key(unit, options) | record, indent=1) + '\n').encode()
        files.write_atomically(folder / RESULT, content, files.RECORD)
        return row


def _key(unit: FoundUnit, options: FleetOptions) -> dict[str, Any]:
    """Return all inputs on which a unit's result depends, for JSON."""
    files = [list(file) for bag in unit.bags.values() for file in bag]
    return {'format': _FORMAT, 'options': options.digest(), 'files': files}


def _safe(part: str) -> str:
    """Return a valid file name for any name."""
    name = quote(part, safe=" +,=@()'")
    if name.strip('.') and len(name) <= _LONGEST_NAME:
        return name
    return f'{name[:_LONGEST_NAME].strip(".")}-{sha256(part)[:16]}'
