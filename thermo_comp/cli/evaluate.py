# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp evaluate``: what a calibration leaves of |g| on bags it has not seen.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import FitError
from . import options
from .output import Cell, Output, micro_g

if TYPE_CHECKING:
    from ..fitting import Assessment
    from ..judging.evaluation import Evaluation


def evaluate(
    bags: Annotated[
        list[Path], typer.Argument(help='Bags of one unit, any positions.', metavar='BAG...')
    ],
    calibration: Annotated[
        list[Path],
        typer.Option(
            '--calibration', '-c', help='Calibration; the first is judged, more are compared.'
        ),
    ],
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    window: Annotated[float, typer.Option(help='Length of a window at rest, in s.')] = 10.0,
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
    Judge a calibration on new bags: |f| - g at rest, raw and corrected.

    The verdict holds the residual against what the calibration claims; six
    positions or more tell which axis has moved. Exit code 1 when it does not
    hold: it makes |g| worse, leaves much more than on the bags of its fit or
    than it claims, or an axis has moved.

    Example:
      thermo_comp evaluate held_out.mcap -c unit42.yaml

    """
    from ..fitting import assess
    from ..fitting.fit_sources import fit_sources
    from ..judging.evaluation import evaluate as run
    from ..judging.evaluation import joined
    from ..online.status import CompensatorConfig
    from ..replay import input_for
    from ..unit.calibration_file import load_calibration

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
    topics = options.topics_of(counts_topic, imu_topic, board_topic, case_topic)
    config = CompensatorConfig()
    with out.progress('evaluating', total=1.0) as done:
        # half of the way to the table, half to the verdict
        part = 0.5 / len(bags)
        parts = [
            run(
                bag,
                models,
                gravity=gravity,
                window_s=window,
                config=config,
                topics=topics,
                input=input_.value,
                serial=serial,
                progress=_part_of(done, part * number, part),
            )
            for number, bag in enumerate(bags)
        ]
        _, judged = models[0]
        kind = input_for(judged, input_.value)
        sources, _ = fit_sources(bags, topics, kind, serial, hashed=False)
        verdict: Assessment | str
        try:
            verdict = assess(
                judged,
                # whose they are has been checked
                [replace(source, serial=None) for source in sources],
                gravity=gravity,
                config=config,
                progress=_part_of(done, 0.5, 0.5),
            )
        except FitError as why:
            verdict = f'no verdict: {why}'
    result = joined(parts, judged)
    is_torn = out.torn(part.info for part in parts)
    say(out, result, verdict, bags)
    if result.findings or not (isinstance(verdict, str) or verdict.is_valid):
        raise typer.Exit(1)
    out.end(is_torn=is_torn)


def _part_of(
    done: Callable[[float], None], begin: float, length: float
) -> Callable[[float], None]:
    return lambda share: done(begin + length * share)


def say(out: Output, result: Evaluation, verdict: Assessment | str, bags: Sequence[Path]) -> None:
    """
    Print an evaluation.

    Parameters
    ----------
    out : Output
        Where to.
    result : Evaluation
        The evaluation.
    verdict : Assessment or str
        The judgement, or why there is none.
    bags : sequence of Path
        The recordings.

    """
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
    if isinstance(verdict, str):
        out.line(f'- {verdict}')
    else:
        _say_axes(out, verdict)
    for line in (*result.notes, *result.findings):
        out.line(f'- {line}')
    if not isinstance(verdict, str):
        out.line(verdict.verdict)
    out.json(
        {
            'bags': [str(bag) for bag in bags],
            'gravity': result.gravity,
            'window_s': result.window_s,
            'statistics_m_s2': result.statistics,
            'counters': result.counters,
            'notes': result.notes,
            'findings': result.findings,
            'verdict': verdict if isinstance(verdict, str) else verdict.verdict,
            'is_valid': None if isinstance(verdict, str) else verdict.is_valid,
            'shifts': () if isinstance(verdict, str) else verdict.shifts,
            'wander_m_s2': None if isinstance(verdict, str) else verdict.wander.tolist(),
        }
    )


def _say_axes(out: Output, verdict: Assessment) -> None:
    """
    Print what is known axis by axis: wander always, shifts where the positions tell.

    """
    from ..unit.gravity import MICRO_G

    columns = ['axis', 'static ug', 'dynamic ug']
    if verdict.shifts:
        columns += ['bias ug', '+-', 'scale ppm', '+-']
    rows: list[tuple[Cell, ...]] = []
    for axis, name in enumerate('xyz'):
        row: list[Cell] = [name, *(micro_g(one / MICRO_G) for one in verdict.wander[:, axis])]
        if verdict.shifts:
            shift = verdict.shifts[axis]
            row += [
                micro_g(shift.bias / MICRO_G),
                micro_g(shift.bias_sd / MICRO_G),
                micro_g(1e6 * shift.scale),
                micro_g(1e6 * shift.scale_sd),
            ]
        rows.append(tuple(row))
    title = 'what temperature moves each axis at rest (60 s means, RMS)'
    if verdict.shifts:
        title += '; shift since the fit'
    out.table(columns, rows, title=title)
