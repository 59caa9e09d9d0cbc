# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp evaluate``: what a calibration leaves of |f| on bags it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from . import options
from .options import argument, option
from .output import Cell, Output, micro, micro_g, millidegrees

if TYPE_CHECKING:
    from ..judging import Judgement


def evaluate(
    *,
    bags: Annotated[list[Path], argument('Bags of one unit, any positions.', metavar='BAG...')],
    calibration: Annotated[
        list[Path],
        option('Calibration; the first is judged, more are compared.', '--calibration', '-c'),
    ],
    judging: options.JudgingOptions,
    csv: Annotated[
        Path | None, option('File for the windows, one a line.', metavar='FILE')
    ] = None,
    reading: options.ReadingPart,
    force: options.Force = False,
    out: options.Out,
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

    if csv is not None:
        check_output(csv, CSV, overwrite=force, others=[*bags, *calibration])
    names = [path.stem for path in calibration]
    if len(set(names)) < len(names):
        names = [str(path) for path in calibration]
    models = [
        (name, load_calibration(path)) for name, path in zip(names, calibration, strict=True)
    ]
    with out.progress('evaluating') as done:
        result = run(bags, models, **judging, **reading, progress=done)
    out.told((bag.info.path, bag.info.chosen, bag.info.truncated) for bag in result.bags)
    judged = result.judgements[names[0]]
    if csv is not None:
        text = csv_of(judged.windows, [bag.name for bag in bags])
        write_atomically(csv, text.encode(), CSV, overwrite=force)
    drifts = drifts_of(history_of([one for _, one in models]))
    out.table(
        ('section', 'model', 'windows', 'RMS ug', 'max ug', 'claimed ug', 'ratio'),
        _sections(result.judgements, micro_g),
        title=f'|f| - g over {judged.windows.window_s:g} s at rest; outside: of the calibrated '
        'ranges',
    )
    _say_axes(out, judged)
    rates = {name: one.rate for name, one in result.judgements.items() if one.rate is not None}
    if rows := _sections(rates, millidegrees):
        out.table(
            ('section', 'model', 'windows', 'RMS', 'max', 'claimed', 'ratio'),
            rows,
            title='angular rate at rest less the mean of each rest, of all axes in mdeg/s',
        )
    if drifts:
        out.table(
            ('from', 'to', 'constant', 'change', '+-', 'unit', 'sure'),
            [
                (
                    *(one.earlier[:10], one.later[:10], one.constant),
                    *(f'{one.change:+.3g}', micro(one.sd), one.unit),
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
    out.json(
        {
            'bags': bags,
            'notes': result.notes,
            **judged.facts(),
            'history': drifts,
            'calibrations': {name: one.facts() for name, one in result.judgements.items()},
        }
    )
    out.end(judged.exit_code)


def _sections(
    judgements: Mapping[str, Any], shown: Callable[[float], str | None]
) -> list[tuple[Cell, ...]]:
    """Give what each calibration leaves in each section, below what there was."""
    from ..judging import SECTIONS

    rows: list[tuple[Cell, ...]] = []
    for section in SECTIONS:
        for number, (name, judgement) in enumerate(judgements.items()):
            one = judgement.sections[section]
            if not one.n:
                continue
            if not number:
                raw = (shown(one.raw_rms), shown(one.raw_peak))
                rows.append((section, 'raw', one.n, *raw, None, None))
            left = (shown(one.rms), shown(one.peak), shown(one.claimed_rms))
            ratio = f'{one.ratio:.2f}' if isfinite(one.claimed_rms) else None
            rows.append((section, name, one.n, *left, ratio))
    return rows


def _say_axes(out: Output, judged: Judgement) -> None:
    """Print what is known axis by axis: its RMS always, shifts where the positions tell."""
    columns = ['axis', 'static ug', 'dynamic ug']
    title = 'what temperature moves each axis at rest (RMS of its windows)'
    if judged.shifts:
        columns += ['bias ug', '+-', 'scale ppm', '+-']
        title += '; shift since the fit'
    rows: list[list[Cell]] = []
    for axis, name in enumerate('xyz'):
        rows.append([name, *map(micro_g, judged.axis_rms[:, axis])])
        if judged.shifts:
            one = judged.shifts[axis]
            rows[-1] += [micro_g(one.bias), micro_g(one.bias_sd)]
            rows[-1] += [micro(1e6 * one.scale), micro(1e6 * one.scale_sd)]
    out.table(columns, rows, title=title)
