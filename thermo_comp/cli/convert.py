# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp convert``: other people's logs into bags.

"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .output import Output

if TYPE_CHECKING:
    from ..convert import ConversionReport
    from ..convert.log import Finding


def convert(
    log: Annotated[
        Path, typer.Argument(help='Table of numbers: .csv, .tsv, .txt, .parquet.', metavar='FILE')
    ],
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Bag to write; *.mcap makes a bare file.')
    ],
    columns: Annotated[
        Path, typer.Option(help='Column map (YAML): what is where, in which unit.')
    ],
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Make a bag of any table of numbers.

    The column map says which column is what and in which unit; what the
    sensor reads at rest must agree with it. config/columns has examples.

    Example:
      thermo_comp convert log.csv --columns map.yaml -o unit42

    """
    from ..convert import load_column_map, table_log, write_log

    out = Output(as_json, quiet)
    options.refuse_existing(output, force)
    column_map = load_column_map(columns)
    with out.progress('converting', total=1.0) as done:
        report = write_log(table_log(log, column_map), output, force, done)
    say(out, report)


def say(out: Output, report: ConversionReport) -> None:
    """
    Print the account of a conversion.

    Parameters
    ----------
    out : Output
        Where to.
    report : ConversionReport
        The account.

    """
    out.line(
        f'{report.source}: {report.rows} rows, {report.duration_s:.1f} s '
        f'at {report.rate_hz:.4g} Hz'
    )
    topic = 'accel/counts' if report.input == 'counts' else 'imu/uncompensated'
    out.line(f'{report.output}:')
    out.line(f'  {report.accel_messages:8} {topic}')
    out.line(f'  {report.board_messages:8} temperature/board')
    out.line(f'  {report.case_messages:8} temperature/case')
    out.line(f'unit: {report.unit}; {report.believed}')
    _say_finding(out, 'rows left out, too short', report.short_rows)
    _say_finding(out, 'rows left out, no number', report.non_numeric)
    _say_finding(out, 'rows clipped, kept', report.clipped)
    _say_finding(out, 'rows whose time goes back, kept', report.backwards)
    _say_finding(out, 'rows whose time stands still, kept', report.repeated)
    if report.stillness.moving_ns:
        out.line('moved or shaken, not at rest:')
        for first, last in report.stillness.moving_ns:
            begin, end = ((t - report.start_ns) * 1e-9 for t in (first, last))
            out.line(f'  {begin:9.1f} .. {end:.1f} s')
    out.json({name: getattr(report, name) for name in report.__dataclass_fields__})


def _say_finding(out: Output, what: str, finding: Finding) -> None:
    if finding.count:
        lines = ', '.join(map(str, finding.lines))
        more = ', ...' if finding.count > len(finding.lines) else ''
        out.line(f'{what}: {finding.count}' + (f' (line {lines}{more})' if lines else ''))
