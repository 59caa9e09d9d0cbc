# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp evaluate``: what a calibration leaves of |g| on a bag it has not seen.

"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .output import Cell, Output, micro_g

if TYPE_CHECKING:
    from ..evaluation import Evaluation


def evaluate(
    bag: options.Bag,
    calibration: Annotated[
        list[Path],
        typer.Option(
            '--calibration', '-c', help='Calibration; the first is judged, more are compared.'
        ),
    ],
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    window: Annotated[float, typer.Option(help='Length of a window at rest [s].')] = 10.0,
    serial: options.Serial = None,
    input_: options.InputOption = options.InputChoice.auto,
    counts_topic: options.CountsTopic = 'accel/counts',
    imu_topic: options.ImuTopic = 'imu/uncompensated',
    board_topic: options.BoardTopic = 'temperature/board',
    case_topic: options.CaseTopic = 'temperature/case',
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Judge a calibration on a bag: |f| - g at rest, raw and corrected.

    Exit code 1 when the calibration does not hold: it makes |g| worse, or
    leaves much more than it did on the bags of its fit.

    Example:
      thermo_comp evaluate held_out.mcap -c unit42.yaml

    """
    from ..calibration_file import load_calibration
    from ..evaluation import evaluate as run

    out = Output(as_json, quiet)
    if not window > 0.0:
        raise options.usage(f'--window must be positive, got {window:g}')
    gravity = options.place(gravity, latitude, height)
    names = [path.stem for path in calibration]
    if len(set(names)) < len(names):
        names = [str(path) for path in calibration]
    models = [
        (name, load_calibration(path)) for name, path in zip(names, calibration, strict=True)
    ]
    with out.progress('evaluating', total=1.0) as done:
        result = run(
            bag,
            models,
            gravity=gravity,
            window_s=window,
            topics=options.topics_of(counts_topic, imu_topic, board_topic, case_topic),
            input=input_.value,
            serial=serial,
            progress=done,
        )
    say(out, result)
    if result.findings:
        raise typer.Exit(1)


def say(out: Output, result: Evaluation) -> None:
    """
    Print an evaluation.

    Parameters
    ----------
    out : Output
        Where to.
    result : Evaluation
        The evaluation.

    """
    if result.info.truncated:
        out.note(f'{result.info.path}: {result.info.truncated}')
    rows: list[tuple[Cell, ...]] = []
    for section in ('static', 'dynamic', 'all'):
        for name, statistics in result.statistics.items():
            one = statistics[section]
            if one.n:
                ug = one.micro_g
                rows.append((section, name, one.n, *map(micro_g, (ug.mean, ug.rms, ug.peak))))
    out.table(
        ('section', 'model', 'windows', 'mean ug', 'RMS ug', 'max ug'),
        rows,
        title=f'|f| - g over {result.window_s:g} s at rest',
    )
    for finding in result.findings:
        out.line(f'- {finding}')
    out.json(
        {
            'bag': result.info.path,
            'gravity': result.gravity,
            'window_s': result.window_s,
            'statistics_m_s2': result.statistics,
            'counters': result.counters,
            'findings': result.findings,
        }
    )
