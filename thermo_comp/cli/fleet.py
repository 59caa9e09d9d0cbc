# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the command ``fleet fit``: fits many units, and prints their table and statistics."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..text import counted, one_line
from . import shared_options as options
from .output import Output, micro, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..fleet.run import FleetResult


def fleet_fit(
    folder: str = argument(
        'Folder of the bags DIR/[LOT/]UNIT/BAG, as a path or a URL.', metavar='DIR'
    ),
    output: Path = option('Folder of the results; an earlier run in it is continued.', ..., '-o'),
    settings: dict[str, Any] = options.fitting,
    scheduler: str | None = option(
        'Address of a running Dask scheduler, as tcp://host:8786; default: fit on this machine.',
        metavar='URL',
    ),
    workers: int | None = option('Processes on this machine; default: all processors.', min=1),
    no_certificates: bool = option(
        'Write no certificates, which halves the computing time.', False
    ),
    with_prior: bool = option(
        'Fit units with incomplete data again, with the prior of the other units.', False
    ),
    earlier: list[Path] | None = option(
        'Earlier fleet.parquet of these units, to show their drift.', metavar='TABLE'
    ),
    topics: Any = options.reading,
    out: Output = options.out,
) -> None:
    """
    Fit every unit below a folder.

    Each folder of bags is a thermal test of a unit; bags directly in DIR are
    grouped by the serial in their metadata. Calibrations go to OUT/units, the
    table of the tests to OUT/fleet.parquet and .csv, its statistics to
    OUT/fleet.html. OUT/prior.yaml is the prior (see `thermo_comp prior`) of the
    units with complete data and a valid calibration. A second run fits only
    tests without a result for the same bags and options. The exit code is 1
    unless every unit has a valid calibration from all of its bags.

    Example:
      thermo_comp fleet fit bags/fleet -o fleet --gravity 9.8154 --no-certificates
    """
    from ..fitting import FitOptions
    from ..fleet.run import fit_fleet
    from ..fleet.table import read_parquet
    from ..fleet.work import FleetOptions

    with options.usage_of():
        fleet_options = FleetOptions(
            fit=FitOptions(**settings), topics=topics, certificates=not no_certificates
        )
    before = [row for path in earlier or () for row in read_parquet(path)]
    state = 'no test has begun'
    with out.progress('fitting') as show:

        def progress(n: int, total: int) -> None:
            nonlocal state
            state = f'{n} of {counted(total, "test")} done'
            show(n / total)

        try:
            result = fit_fleet(
                folder,
                output,
                fleet_options,
                with_prior=with_prior,
                scheduler=scheduler,
                n_workers=workers,
                earlier=before,
                progress=progress,
            )
        except KeyboardInterrupt:
            out.note(f'interrupted: {state}; the same command continues the run in {output}')
            raise
    _print_result(out, result, with_prior)
    out.end(
        int(not result.is_whole),
        **picked(result, 'rows n_fitted n_done parquet csv page prior skipped'),
        **picked(result.summary, 'verdicts outliers drifts'),
    )


def _print_result(out: Output, result: 'FleetResult', with_prior: bool) -> None:
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
        title='|f| - g at rest, RMS; bags: number found - number left out',
    )
    out.sources((row['name'], str(row['chosen']), None) for row in result.rows)
    for row in result.rows:
        # `left_out` is printed only without `reservations`, which also name the left-out bags.
        text = (row['problem'], row['reservations'] or row['left_out'])
        out.points(f'{row["name"]}: {problem}' for problem in text if problem)
    out.points(
        f'{name}: has tables but no bag; thermo_comp convert makes bags' for name in result.skipped
    )
    out.points(
        f'{outlier.name}: {outlier.label} {outlier.value:.4g} {outlier.unit}, {outlier.z:+.1f} sd '
        f'from the median {outlier.middle:.4g} of the units'
        for outlier in summary.outliers
    )
    out.points(
        f'{retest.serial}: {retest.worst.constant} changed by {retest.worst.change:+.4g} '
        f'{retest.worst.unit} (sd {retest.worst.sd:.2g}) from {retest.earlier} to {retest.later}'
        for retest in summary.drifts
        if retest.is_significant
    )
    if result.prior is not None:
        out.line(
            f'{result.prior}: prior of the type, from units with complete data and a valid fit'
        )
    elif with_prior:
        out.line(f'- fitted without a prior: {result.no_prior}')
    out.line(
        f'{result.page}: {result.n_fitted} of {counted(len(result.rows), "test")} calibrated; '
        f'{counted(result.n_done, "test")} done in this run, '
        f'{len(result.rows) - result.n_done} in an earlier run'
    )


def _micro(value: object) -> str | None:
    return micro(value) if isinstance(value, float) else None


def _short(name: object) -> str:
    """Shorten a name above 22 characters to its end, so that the table fits 80 columns."""
    clean = one_line(str(name))
    return clean if len(clean) <= 22 else f'~{clean[-21:]}'
