# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp fleet``: the thermal tests of many units, on all the processors there are."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..text import one_line
from . import options
from .options import argument, option
from .output import Output, micro, picked

if TYPE_CHECKING:
    from ..fleet import FleetResult


def fit(
    folder: str = argument('DIR/[LOT/]UNIT/BAG; a path or a URL.', metavar='DIR'),
    output: Path = option('Folder of the results; goes on where it was.', ..., '--output', '-o'),
    settings: dict[str, Any] = options.fitting,
    scheduler: str | None = option(
        'Dask scheduler (tcp://HOST:PORT), instead of this machine alone.', None
    ),
    workers: int | None = option('Processes on this machine; all processors.', None, min=1),
    certificates: bool = option('Write a certificate for each unit.', True),
    with_prior: bool = option(
        'Fit the units that lack data again with what the others share.', False, '--with-prior'
    ),
    earlier: list[Path] | None = option(
        'fleet.parquet of an earlier fleet, to see drift.', None, metavar='TABLE'
    ),
    reading: dict[str, Any] = options.reading,
    out: Output = options.out,
) -> None:
    """
    Fit every unit below a folder.

    Each folder of bags is one thermal test of one unit; bags that lie in
    DIR itself are sorted by the serial in them. Results go to OUT/units,
    the table of all to OUT/fleet.parquet and .csv, what it tells to
    OUT/fleet.html, what the units that hold have in common to OUT/prior.yaml,
    a prior as `thermo_comp prior` makes it. A second run does only what is missing or has changed.
    Exit code 1 if a unit has no valid calibration, or not of all of its bags.

    Example:
      thermo_comp fleet fit bags/fleet -o fleet --gravity 9.8154 --no-certificates
    """
    from ..fitting import FitOptions
    from ..fleet import FleetOptions, fit_fleet, read_parquet

    with options.usage_of():
        wanted = FleetOptions(fit=FitOptions(**settings), **reading, certificates=certificates)
    before = [row for path in earlier or () for row in read_parquet(path)]
    with out.progress('fitting') as done:
        result = fit_fleet(
            folder,
            output,
            wanted,
            with_prior=with_prior,
            scheduler=scheduler,
            n_workers=workers,
            earlier=before,
            tell=lambda n, total, _row: done(n / total),
        )
    _say(out, result, with_prior)
    out.end(int(not result.is_whole))


def _say(out: Output, result: 'FleetResult', with_prior: bool) -> None:
    summary = result.summary
    out.table(
        ('test', 'serial', 'verdict', 'static ug', 'dynamic ug', 'bags'),
        [
            (
                *(_short(row['name']), _short(row['serial']), row['verdict']),
                *(_micro(row[name]) for name in ('static_ug', 'dynamic_ug')),
                f'{row["n_bags"]}-{row["n_left_out"]}' if row['n_left_out'] else row['n_bags'],
            )
            for row in result.rows
        ],
        title='|f| - g at rest, RMS',
    )
    out.told((row['name'], str(row['chosen']), None) for row in result.rows)
    for row in result.rows:
        for said in ('problem', 'left_out'):
            if row[said]:
                out.line(f'- {row["name"]}: {row[said]}')
        if row['n_torn']:
            out.line(f'- {row["name"]}: {row["reservations"]}')
    for one in summary.outliers:
        out.line(
            f'- {one.name}: {one.label} {one.value:.4g} {one.unit}, median {one.middle:.4g}: '
            f'{one.z:+.1f} sd'
        )
    for drift in summary.drifts:
        if drift.is_significant:
            worst = drift.worst
            out.line(
                f'- {drift.serial}: {worst.constant} changed by {worst.change:+.4g} {worst.unit} '
                f'(sd {worst.sd:.2g}) from {drift.earlier} to {drift.later}'
            )
    if result.prior is not None:
        out.line(f'{result.prior}: what the units that hold have in common')
    elif with_prior:
        out.line(f'- fitted without a prior: {result.no_prior}')
    out.line(
        f'{result.page}: {result.n_fitted} of {len(result.rows)} tests calibrated, '
        f'{result.n_done} of them in this run'
    )
    out.json(
        picked(result, 'rows n_fitted n_done parquet csv page prior')
        | picked(summary, 'verdicts outliers drifts')
    )


def _micro(value: object) -> str | None:
    return micro(value) if isinstance(value, float) else None


def _short(name: object) -> str:
    """Keep the end of a long name, which tells units apart, so that the table fits 80 columns."""
    clean = one_line(str(name))
    return clean if len(clean) <= 22 else f'~{clean[-21:]}'
