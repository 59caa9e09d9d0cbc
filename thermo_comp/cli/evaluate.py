# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp evaluate``: what a calibration leaves of |f| on bags it has not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .output import Cell, Output, micro_g

if TYPE_CHECKING:
    from ..judging import Evaluation, Judgement
    from ..judging.history import Drift


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
    window: options.Window = 60.0,
    tolerance: options.Tolerance = None,
    csv: Annotated[
        Path | None, typer.Option(help='File for the windows, one a line.', metavar='FILE')
    ] = None,
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
    Judge a calibration on new bags: |f| - g at rest, raw and corrected.

    The verdict holds the RMS residual against your --tolerance or, without
    one, against what the calibration claims for the same windows; six
    positions or more tell which axis has moved. Exit code 0 only where the
    calibration is shown to be valid.

    Example:
      thermo_comp evaluate held_out.mcap -c unit42.yaml --tolerance 100ug
    """
    from ..files import CSV, check_output, write_atomically
    from ..judging import evaluate as run
    from ..judging.history import drifts_of, history_of
    from ..judging.windows import csv_of
    from ..unit.calibration_file import load_calibration

    out = Output(as_json, quiet)
    limit = options.acceleration(tolerance)
    window_s = options.positive(window, '--window')
    gravity = options.place(gravity, latitude, height)
    if csv is not None:
        check_output(csv, CSV, overwrite=force, others=[*bags, *calibration])
    names = [path.stem for path in calibration]
    if len(set(names)) < len(names):
        names = [str(path) for path in calibration]
    models = [
        (name, load_calibration(path)) for name, path in zip(names, calibration, strict=True)
    ]
    with out.progress('evaluating', total=1.0) as done:
        result = run(
            bags,
            models,
            gravity=gravity,
            window_s=window_s,
            tolerance=limit,
            topics=options.topics_of(topic, topics, begin, end),
            input=input_,
            serial=serial,
            progress=done,
        )
    is_torn = out.told(bag.info for bag in result.bags)
    judged = result.judgements[names[0]]
    if csv is not None:
        text = csv_of(judged.windows, [bag.name for bag in bags])
        write_atomically(csv, text.encode(), CSV, overwrite=force)
    drifts = drifts_of(history_of([one for _, one in models]))
    _say(out, result, drifts)
    out.json(
        {
            'bags': bags,
            'notes': result.notes,
            **judged.facts(),
            'history': drifts,
            'calibrations': {name: one.facts() for name, one in result.judgements.items()},
        }
    )
    if judged.exit_code:
        raise typer.Exit(judged.exit_code)
    out.end(is_torn=is_torn)


def _say(out: Output, result: Evaluation, drifts: Sequence[Drift]) -> None:
    """
    Print an evaluation: a table of all calibrations, what is known of the first one, its verdict.
    """
    from ..judging import SECTIONS
    from ..unit.gravity import MICRO_G

    judgements = result.judgements
    judged = next(iter(judgements.values()))
    rows: list[tuple[Cell, ...]] = []
    for section in SECTIONS:
        raw = judged.sections[section]
        if raw.n:
            rms, peak = micro_g(raw.raw_rms / MICRO_G), micro_g(raw.raw_peak / MICRO_G)
            rows.append((section, 'raw', raw.n, rms, peak, None, None))
        for name, judgement in judgements.items():
            one = judgement.sections[section]
            if one.n:
                rms, peak = micro_g(one.rms / MICRO_G), micro_g(one.peak / MICRO_G)
                claim: tuple[Cell, Cell] = (None, None)
                if isfinite(one.claimed_rms):
                    claim = (micro_g(one.claimed_rms / MICRO_G), f'{one.ratio:.2f}')
                rows.append((section, name, one.n, rms, peak, *claim))
    out.table(
        ('section', 'model', 'windows', 'RMS ug', 'max ug', 'claimed ug', 'ratio'),
        rows,
        title=f'|f| - g over {judged.windows.window_s:g} s at rest; outside: of the calibrated '
        'ranges',
    )
    _say_axes(out, judged)
    _say_rates(out, judgements)
    if drifts:
        out.table(
            ('from', 'to', 'constant', 'change', '+-', 'unit', 'sure'),
            [
                (
                    *(one.earlier[:10], one.later[:10], one.constant),
                    *(f'{one.change:+.3g}', micro_g(one.sd), one.unit),
                    'yes' if one.is_sure else 'no',
                )
                for one in drifts
            ],
            title='what drifted between the calibrations, in a soak at the reference temperature',
        )
    for line in result.notes:
        out.line(f'- {line}')
    out.line(str(judged))
    if judged.rate is not None:
        out.line(str(judged.rate))


def _say_rates(out: Output, judgements: Mapping[str, Judgement]) -> None:
    """Print what the gyroscopes make of the angular rate at rest."""
    from ..judging import SECTIONS
    from ..unit.gyroscope import MILLIDEGREE

    found = {name: one.rate for name, one in judgements.items() if one.rate is not None}
    rows: list[tuple[Cell, ...]] = []
    for section in SECTIONS:
        for k, (name, judged) in enumerate(found.items()):
            one = judged.sections[section]
            if not one.n:
                continue
            if not k:
                raw = (f'{value / MILLIDEGREE:.3g}' for value in (one.raw_rms, one.raw_peak))
                rows.append((section, 'raw', one.n, *raw, None, None))
            said = (f'{value / MILLIDEGREE:.3g}' for value in (one.rms, one.peak))
            claim: tuple[Cell, Cell] = (None, None)
            if isfinite(one.claimed_rms):
                claim = (f'{one.claimed_rms / MILLIDEGREE:.3g}', f'{one.ratio:.2f}')
            rows.append((section, name, one.n, *said, *claim))
    if rows:
        out.table(
            ('section', 'model', 'windows', 'RMS', 'max', 'claimed', 'ratio'),
            rows,
            title='angular rate at rest less the mean of each rest, of all axes in mdeg/s',
        )


def _say_axes(out: Output, judged: Judgement) -> None:
    """Print what is known axis by axis: its RMS always, shifts where the positions tell."""
    from ..unit.gravity import MICRO_G

    columns = ['axis', 'static ug', 'dynamic ug']
    if judged.shifts:
        columns += ['bias ug', '+-', 'scale ppm', '+-']
    rows: list[tuple[Cell, ...]] = []
    for axis, name in enumerate('xyz'):
        row: list[Cell] = [name, *(micro_g(one / MICRO_G) for one in judged.axis_rms[:, axis])]
        if judged.shifts:
            shift = judged.shifts[axis]
            row += [
                micro_g(shift.bias / MICRO_G),
                micro_g(shift.bias_sd / MICRO_G),
                micro_g(1e6 * shift.scale),
                micro_g(1e6 * shift.scale_sd),
            ]
        rows.append(tuple(row))
    title = 'what temperature moves each axis at rest (RMS of its windows)'
    if judged.shifts:
        title += '; shift since the fit'
    out.table(columns, rows, title=title)
