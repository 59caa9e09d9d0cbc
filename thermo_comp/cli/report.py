# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp report``: a certificate of a calibration, from bags."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from . import options
from .output import Output


def report(
    output: Annotated[Path, typer.Option('--output', '-o', help='Page to write (HTML).')],
    bags: options.JudgedBags = None,
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            '--calibration', '-c', help='Calibration of the unit; more make its history (YAML).'
        ),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help='Folder for the figures as PNG files.', metavar='DIR')
    ] = None,
    certificate_info: options.CertificateInfo = None,
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    window: options.Window = 60.0,
    tolerance: options.Tolerance = None,
    serial: options.Serial = None,
    input_: options.InputOption = 'auto',
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
    begin: options.Begin = None,
    end: options.End = None,
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Write the certificate of a unit: one HTML page, no network needed.

    Shows temperatures, regime, |f| before and after, the functions of
    temperature with their uncertainty, and the verdict of evaluate, with
    its exit code. The report of a fit itself comes from: fit --report.

    Example:
      thermo_comp report held_out.mcap -c unit42.yaml -o unit42.html
    """
    from ..files import PAGE, check_output
    from ..judging import open_bag
    from ..judging.history import drifts_of
    from ..replay import needed_roles
    from ..report import evidence_of_bags, load_certificate_info, write_report
    from ..unit.calibration_file import load_calibration

    out = Output(as_json, quiet)
    if not bags and not calibration:
        raise options.usage('give bags, a calibration, or both')
    gravity = options.place(gravity, latitude, height)
    read = [*(bags or []), *(calibration or [])]
    check_output(output, PAGE, overwrite=force, others=read)
    limit = options.acceleration(tolerance)
    options.positive(window, '--window')
    where = options.topics_of(topic, topics, begin, end)
    paths = bags or []
    known = [load_calibration(path) for path in calibration or []]
    loaded = known[0] if known else None
    info = None
    if certificate_info is not None:
        info = load_certificate_info(
            certificate_info, None if loaded is None else loaded.unit.serial
        )
    opened = []
    with out.progress('reading', total=max(len(paths), 1)) as done:
        for number, path in enumerate(paths):
            opened.append(
                open_bag(
                    path,
                    where,
                    input_,
                    number=number,
                    window_s=window,
                    calibration=loaded,
                    require=('board',) if loaded is None else needed_roles(loaded),
                    progress=partial(_tell, done, number),
                )
            )
    with options.usage_of():
        evidence = evidence_of_bags(
            opened,
            loaded,
            gravity=gravity,
            window_s=window,
            tolerance=limit,
            serial=serial,
            others=known[1:],
        )
    is_torn = out.told(bag.info for bag in opened)
    write_report(evidence, output, info=info, figures=figures, overwrite=force)
    for finding in evidence.findings:
        out.line(f'- {finding}')
    judgement = evidence.judgement
    out.line(f'{output}: {evidence.headline}')
    out.json(
        {
            'output': output,
            'headline': evidence.headline,
            'findings': evidence.findings,
            'history': drifts_of(evidence.history),
            **({} if judgement is None else judgement.facts()),
        }
    )
    if judgement is not None and judgement.exit_code:
        raise typer.Exit(judgement.exit_code)
    out.end(is_torn=is_torn)


def _tell(done: Callable[[float], None], before: int, part: float) -> None:
    done(before + part)
