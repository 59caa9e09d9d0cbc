# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp view``: a calibration's certificate in the browser, live."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from ..errors import ThermoCompError
from . import options
from .output import Output


def view(
    calibration: Annotated[
        Path, typer.Argument(help='Calibration of the unit (YAML).', metavar='YAML')
    ],
    bags: options.JudgedBags = None,
    port: Annotated[
        int, typer.Option(help='Port on this machine; 0 takes any free one.', min=0, max=65535)
    ] = 8042,
    browser: Annotated[
        bool, typer.Option('--browser', help='Open it in the default browser, too.')
    ] = False,
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    serial: options.Serial = None,
    input_: options.InputOption = 'auto',
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
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

    for path in (calibration, *(bags or [])):
        if not path.exists():
            raise ThermoCompError(f'{path}: no such file or directory')
    out = Output(quiet=quiet)
    report = LiveReport(
        calibration,
        bags or [],
        options.topics_of(topic, topics),
        input_,
        gravity=options.place(gravity, latitude, height),
        serial=serial,
    )
    try:
        server = LiveServer(report, port)
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
