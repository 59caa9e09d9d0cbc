# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp report`` and ``view``: a calibration's certificate, in a file and live."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ..errors import ThermoCompError
from . import options
from .options import argument, option

if TYPE_CHECKING:
    from ..fitting import ReducedBag


def report(
    *,
    output: Annotated[Path, option('Page to write (HTML).', '--output', '-o')],
    bags: options.JudgedBags = None,
    calibration: Annotated[
        list[Path] | None,
        option('Calibration of the unit; more make its history (YAML).', '--calibration', '-c'),
    ] = None,
    figures: Annotated[
        Path | None, option('Folder for the figures as PNG files.', metavar='DIR')
    ] = None,
    certificate_info: options.CertificateInfo = None,
    judging: options.JudgingOptions,
    reading: options.ReadingPart,
    force: options.Force = False,
    out: options.Out,
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

    paths = bags or []
    if not paths and not calibration:
        raise options.usage('give bags, a calibration, or both')
    check_output(output, PAGE, overwrite=force, others=[*paths, *(calibration or [])])
    known = [load_calibration(path) for path in calibration or []]
    loaded = known[0] if known else None
    info = None
    if certificate_info is not None:
        info = load_certificate_info(certificate_info, loaded.unit.serial if loaded else None)
    opened: list[ReducedBag] = []
    with out.progress('reading', total=max(len(paths), 1)) as done:
        for path in paths:
            opened.append(
                open_bag(
                    path,
                    **reading,
                    window_s=judging['window_s'],
                    calibration=loaded,
                    require=('board',) if loaded is None else needed_roles(loaded),
                    progress=lambda part: done(len(opened) + part),
                )
            )
    with options.usage_of():
        evidence = evidence_of_bags(opened, loaded, **judging, others=known[1:])
    out.told((bag.info.path, bag.info.chosen, bag.info.truncated) for bag in opened)
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
    out.end(0 if judgement is None else judgement.exit_code)


def view(
    *,
    calibration: Annotated[Path, argument('Calibration of the unit (YAML).', metavar='YAML')],
    bags: options.JudgedBags = None,
    port: Annotated[
        int, option('Port on this machine; 0 takes any free one.', min=0, max=65535)
    ] = 8042,
    browser: Annotated[bool, option('Open it in the default browser, too.', '--browser')] = False,
    gravity: options.Place,
    serial: options.Serial = None,
    reading: options.ReadingOptions,
    quiet: options.Quiet = False,
) -> None:
    """
    Look at a calibration in the browser while you work on it.

    Serves the certificate on this machine only, until Ctrl-C. The page
    reloads itself whenever the calibration or a bag changes, as when fit
    runs again.

    Example:
      thermo_comp view unit42.yaml held_out.mcap
    """
    from ..report.live import LiveReport, LiveServer
    from .output import Output

    for path in (calibration, *(bags or [])):
        if not path.exists():
            raise ThermoCompError(f'{path}: no such file or directory')
    out = Output(quiet=quiet)
    live = LiveReport(
        calibration,
        bags or [],
        **reading,
        read=lambda info: out.told([(info.path, info.chosen, info.truncated)]),
        gravity=gravity,
        serial=serial,
    )
    try:
        server = LiveServer(live, port)
    except OSError as failure:
        raise ThermoCompError(
            f'port {port}: {failure.strerror}; give another one with --port'
        ) from failure
    with server:
        try:
            out.line(f'{server.url}  (Ctrl-C ends it)')
            sys.stdout.flush()  # whoever reads this through a pipe waits for the address
            if browser:
                webbrowser.open(server.url)
            server.serve_forever()
        except KeyboardInterrupt:
            out.note('ended')
