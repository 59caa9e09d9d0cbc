# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the commands on a calibration in use: ``evaluate`` and ``report`` judge a calibration on new
bags or rest logs, ``update`` updates a calibration by rest logs.
"""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CalibrationError
from ..files import CALIBRATION, CSV, PAGE, check_output
from ..unit.gravity import STANDARD_GRAVITY, ug_text
from . import shared_options as options
from .output import Cell, Output, micro, micro_g, millidegrees, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..field.ageing import Ageing
    from ..field.update import Update
    from ..judging.evaluation import Drift
    from ..judging.judgement import Judgement
    from ..unit.calibration import Calibration

#: Exit code of an update that determines the bias and scale of no axis, or does not clearly reduce
#: |f| - g on left-out days.
NOTHING_GAINED = 3


def evaluate(
    bags: list[Path] = argument(
        'Bags of one unit in any positions, or rest logs of the unit.', metavar='BAG...'
    ),
    calibration: list[Path] = option(
        'Calibration (YAML); further calibrations are compared with the first.', ..., '-c'
    ),
    judging: dict[str, Any] = options.judging,
    known_force: Any = options.force,
    csv: Path | None = option(
        'Table of the windows to write (*.csv or *.parquet), one window per line.', metavar='FILE'
    ),
    topics: Any = options.reading_part,
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Judge a calibration on new bags: |f| - g at rest, raw and corrected.

    The verdict compares the RMS residual with --tolerance or, without
    --tolerance, with twice the uncertainty that the calibration claims for the
    same windows; six positions or more show which axis has shifted. The exit
    code is 0 only if the bags show that the calibration is valid. With rest logs
    of the node instead of bags, the command prints the drift over the days, and
    the day from which the drift exceeds the claimed uncertainty.

    Example:
      thermo_comp evaluate held_out.mcap -c unit42.yaml --tolerance 100ug
    """
    from ..field.series import is_rest_log
    from ..fitting.sources import ForceOptions
    from ..judging.evaluation import drifts_of, history_of
    from ..judging.evaluation import evaluate as run
    from ..judging.windows import columns_of
    from ..recording.topics import Topics
    from ..recording.writer import TABLES, table_writer
    from ..unit.calibration_file import load_calibration

    logs = [path for path in bags if is_rest_log(path)]
    if logs:
        of_bags = topics != Topics() or known_force != ForceOptions() or judging['serial']
        if of_bags or csv is not None or judging['window_s'] != options.WINDOW_S:
            raise options.usage('rest logs take no options except --tolerance and --gravity')
        if len(logs) < len(bags) or len(calibration) > 1:
            raise options.usage('rest logs need one calibration, and cannot be mixed with bags')
        _evaluate_rests(logs, calibration[0], judging, out)
        return
    if csv is not None:
        kind = TABLES.get(csv.suffix, CSV)
        check_output(csv, kind, overwrite=force, others=[*bags, *calibration])
    is_named = len({path.stem for path in calibration}) == len(calibration)
    names = [path.stem if is_named else str(path) for path in calibration]
    models = list(zip(names, map(load_calibration, calibration), strict=True))
    with out.progress('evaluating') as done:
        result = run(bags, models, **judging, topics=topics, force=known_force, progress=done)
    out.recordings(result.bags)
    judged = result.judgements[models[0][0]]
    if csv is not None:
        with table_writer(csv, {}, overwrite=force) as write:
            write(columns_of(judged.windows, [bag.source.name for bag in result.bags]))
    drifts = drifts_of(history_of([model for _, model in models]))
    print_sections(out, result.judgements)
    _print_axes(out, judged)
    _print_expectations(out, judged)
    _print_by_force(out, judged)
    rates = {k: judged.rate for k, judged in result.judgements.items() if judged.rate is not None}
    if rows := _sections(rates, millidegrees):
        out.table(
            ('section', 'model', 'windows', 'RMS', 'max', 'claimed', 'ratio'),
            rows,
            title='angular rate at rest less the mean of each rest, all axes together, in mdeg/s',
        )
    _print_drifts(out, drifts)
    out.points(result.notes)
    out.line(str(judged))
    if judged.rate is not None:
        out.line(str(judged.rate))
    out.end(
        judged.exit_code,
        bags=bags,
        notes=result.notes,
        **judged.facts(),
        history=drifts,
        calibrations={name: judgement.facts() for name, judgement in result.judgements.items()},
    )


def _print_axes(out: Output, judged: 'Judgement') -> None:
    """Print the thermal drift of each axis; if determined, also the shifts of bias and scale."""
    columns = ['axis', 'static ug', 'dynamic ug']
    title = 'thermal drift of each axis at rest (RMS of its windows)'
    if judged.shifts:
        columns += ['bias ug', '+-', 'scale ppm', '+-']
        title += '; shifts of bias and scale since the fit'
    axes = [[name, *map(micro_g, rms)] for name, rms in zip('xyz', judged.axis_rms.T, strict=True)]
    for row, shift in zip(axes, judged.shifts, strict=False):
        row += [micro_g(shift.bias), micro_g(shift.bias_sd)]
        row += [micro(1e6 * shift.scale), micro(1e6 * shift.scale_sd)]
    out.table(columns, axes, title=title)


def _print_expectations(out: Output, judged: 'Judgement') -> None:
    """Print errors found and expected, if the calibration states errors on left-out data."""
    names = {'norm': '|f| - g', 'drift': 'drift of an axis'}
    parts = {names[key]: part for key, part in judged.expectations.items()}
    if any(isfinite(part.expected_rms) for part in parts.values()):
        out.table(
            ('RMS in ug', 'found', 'expected', 'claimed sd'),
            [
                (name, *map(micro_g, (part.found_rms, part.expected_rms, part.claimed_rms)))
                for name, part in parts.items()
            ],
            title='errors within the calibrated ranges; expected: on data left out of the fit',
        )


def _print_by_force(out: Output, judged: 'Judgement') -> None:
    """Print the residuals for each value of |f|, if |f| differed from gravity in any window."""
    if judged.by_force:
        out.table(
            ('|f| g', 'windows', 'raw ug', 'RMS ug', 'mean ug', 'claimed ug'),
            [
                (
                    *(f'{size / STANDARD_GRAVITY:.4g}', section.n, micro_g(section.raw_rms)),
                    *(micro_g(section.rms), micro_g(section.mean), micro_g(section.claimed_rms)),
                )
                for size, section in judged.by_force.items()
            ],
            title='residual for each known |f|: corrected magnitude less known |f|',
        )


def _print_drifts(out: Output, drifts: Sequence['Drift']) -> None:
    if drifts:
        out.table(
            ('from', 'to', 'constant', 'change', '+-', 'unit', 'significant'),
            [
                (
                    *(diff.earlier[:10], diff.later[:10], diff.constant, f'{diff.change:+.3g}'),
                    *(micro(diff.sd), diff.unit, 'yes' if diff.is_sure else 'no'),
                )
                for diff in drifts
            ],
            title='changes of bias and scale, in a soak at the reference temperature',
        )


def print_sections(out: Output, judgements: Mapping[str, Any]) -> None:
    """Print a row of errors and claimed sd for each section (static, dynamic) and model."""
    (window_s,) = {judgement.windows.window_s for judgement in judgements.values()}
    out.table(
        ('section', 'model', 'windows', 'RMS ug', 'max ug', 'claimed ug', 'ratio'),
        _sections(judgements, micro_g),
        title=f'|f| - g over {window_s:g} s at rest; outside: beyond the calibrated '
        'temperatures or rates',
    )


def _sections(
    judgements: Mapping[str, Any], shown: Callable[[float], str | None]
) -> list[tuple[Cell, ...]]:
    """Return a table row per section: raw residuals, then the residuals of each calibration."""
    from ..judging.verdicts import SECTIONS

    rows: list[tuple[Cell, ...]] = []
    for section in SECTIONS:
        for number, (name, judgement) in enumerate(judgements.items()):
            part = judgement.sections[section]
            if not part.n:
                continue
            if not number:
                raw = (shown(part.raw_rms), shown(part.raw_peak))
                rows.append((section, 'raw', part.n, *raw, None, None))
            left = (shown(part.rms), shown(part.peak), shown(part.claimed_rms))
            ratio = f'{part.ratio:.2f}' if isfinite(part.claimed_rms) else None
            rows.append((section, name, part.n, *left, ratio))
    return rows


def report(
    output: Path = option('Page to write (HTML).', ..., '-o'),
    bags: list[Path] | None = argument(
        'Bags to judge the calibration on.', None, metavar='[BAG]...'
    ),
    calibration: list[Path] | None = option(
        'Calibrations of the unit (YAML), whose changes are shown.', None, '-c'
    ),
    figures: Path | None = option('Folder for the figures as PNG files.', metavar='DIR'),
    certificate_info: Path | None = options.CERTIFICATE_INFO,
    judging: dict[str, Any] = options.judging,
    known_force: Any = options.force,
    topics: Any = options.reading_part,
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Write the certificate of a unit: one HTML page without network access.

    The page shows temperatures, regime, |f| before and after the correction, the
    functions of temperature with their uncertainty, and the verdict. The exit
    code is as for `evaluate`. `fit --report` writes the certificate of a fit.

    Example:
      thermo_comp report held_out.mcap -c unit42.yaml -o unit42.html
    """
    from ..judging.evaluation import drifts_of, open_bags
    from ..report.evidence import evidence_of_bags
    from ..report.page import write_report
    from ..report.statements import load_certificate_info
    from ..unit.calibration_file import load_calibration

    paths = bags or []
    if not paths and not calibration:
        raise options.usage('give bags, a calibration, or both')
    check_output(output, PAGE, overwrite=force, others=[*paths, *(calibration or [])])
    calibrations = [load_calibration(path) for path in calibration or []]
    first = calibrations[0] if calibrations else None
    _require_one_unit(calibration or [], calibrations)
    info = None
    if certificate_info is not None:
        info = load_certificate_info(certificate_info, first.unit.serial if first else None)
    with out.progress('reading') as done:
        usual: dict[str, Any] = {'topics': topics, 'force': known_force, 'progress': done}
        opened = open_bags(paths, calibrations[:1], window_s=judging['window_s'], **usual)
    with options.usage_of():
        evidence = evidence_of_bags(opened, first, **judging, others=calibrations[1:])
    out.recordings(opened)
    write_report(evidence, output, info=info, figures=figures, overwrite=force)
    out.points(evidence.findings)
    judgement = evidence.judgement
    out.line(f'{output}: {evidence.headline}')
    out.end(
        judgement.exit_code if judgement else int(bool(opened and first)),
        output=output,
        **picked(evidence, 'headline findings'),
        history=drifts_of(evidence.history),
        **(judgement.facts() if judgement else {}),
    )


def _require_one_unit(paths: Sequence[Path], calibrations: 'Sequence[Calibration]') -> None:
    for path, calibration in zip(paths, calibrations, strict=True):
        first, serial = calibrations[0].unit.serial, calibration.unit.serial
        if serial != first:
            rule = f'must be {first!r}, as in the first calibration'
            raise CalibrationError(f'unit.serial: {rule}, got {serial!r}', path)


def update(
    calibration: Path = argument('Calibration of the unit (YAML).', metavar='YAML'),
    rests: list[Path] = argument('Folders or files of rest logs.', metavar='RESTS...'),
    output: Path = options.NEW_CALIBRATION,
    where: tuple[float | None, float] = options.place,
    ahead: float = option(
        'Days after the last rest for which the claimed sd includes ageing.',
        1.0,
        min=0.0,
        max=3650.0,
    ),
    allow: list[str] | None = option(
        'gravity: take local gravity as exact; unit: accept a |f| that suggests another unit.'
    ),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Update a calibration in the field, by rests that the node has logged.

    The calibration is the prior; the ageing since the fit is estimated from the
    rests, which may be in any attitude. Old and new calibration are compared on
    days left out of the update. The new calibration is written only if the rests
    determine bias and scale of an axis, and if the mean decrease of (|f| - g)^2
    on left-out days exceeds its standard error; else the exit code is 3, and the
    command prints the sd of each axis with ageing.

    Example:
      thermo_comp update unit42.yaml rests -o unit42_new.yaml
    """
    from ..field.series import read_rests, series_of
    from ..field.update import OVERRIDES, change_texts, refuse_another_unit
    from ..field.update import update as run
    from ..unit.calibration_file import load_calibration, save_calibration

    allowed = allow or []
    for word in allowed:
        if word not in OVERRIDES:
            raise options.usage(f'--allow: expected one of {", ".join(OVERRIDES)}, got {word!r}')
    check_output(output, CALIBRATION, overwrite=force, others=[calibration, *rests])
    old = load_calibration(calibration)
    logged, source, notes = read_rests(rests, old, ahead=ahead)
    created = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')
    series = series_of(logged, old, gravity=where[0])
    result = run(series, old, source, created, ahead, is_gravity_certain='gravity' in allowed)
    if 'unit' not in allowed:
        refuse_another_unit(result)
    out.points(notes)
    _print_axis_changes(out, result)
    out.points(change_texts(result))
    out.line(str(result.judged))
    is_better = result.judged.is_better and any(axis.is_determined for axis in result.axis_changes)
    if is_better:
        save_calibration(result.calibration, output, overwrite=force)
        out.line(f'{output}: written')
    else:
        out.line(f'the update is no improvement: {output} is not written, keep {calibration}')
        sds = [
            f'{row.axis} {micro_g(row.present_sd)} ug ({micro_g(row.claimed_sd)} ug in the file)'
            for row in result.axis_changes
        ]
        out.line(f'sd of the correction at the last rest, with ageing: {", ".join(sds)}')
    out.end(
        0 if is_better else NOTHING_GAINED,
        output=output if is_better else None,
        moved=result.axis_changes,
        **picked(result, 'changes judged'),
        **_ageing(result.ageing),
        is_better=is_better,
        notes=[*notes, *change_texts(result)],
    )


def _print_axis_changes(out: Output, result: 'Update') -> None:
    out.table(
        ('axis', 'bias ug', '+-', 'scale ppm', '+-', 'curve ug', '+-', 'at rest ug', '+-', 'sds'),
        [
            (
                axis.axis,
                *(micro_g(axis.bias), micro_g(axis.bias_sd)),
                *(micro(1e6 * axis.scale), micro(1e6 * axis.scale_sd)),
                *(micro_g(axis.curve), micro_g(axis.curve_sd)),
                *(micro_g(axis.reading), micro_g(axis.reading_sd)),
                f'{axis.reading / axis.reading_sd:+.1f}' if axis.is_determined else 'unknown',
            )
            for axis in result.axis_changes
        ],
        title=f'changes shown by {len(result.series)} rests in {result.series.start.max() + 1} '
        'starts of the node (at rest: change at the mean force; sds: this change / its sd)',
    )


def _ageing(ageing: 'Ageing | None') -> dict[str, Any]:
    """Return the sds of `Ageing` [m/s^2] and, separately, `lags`, a ratio of two sds."""
    values = vars(ageing).copy() if ageing else {}
    share = values.pop('lags', None)
    return {'ageing_m_s2': values or None, 'lags_at_start': share}


def _evaluate_rests(
    rests: list[Path], calibration: Path, judging: dict[str, Any], out: Output
) -> None:
    """Print |f| - g over a rest log; exit with 1 if the unit's error is above the limit."""
    from ..field.series import read_rests, series_of
    from ..field.watch import LIMIT, watch
    from ..unit.calibration_file import load_calibration

    loaded, tolerance = load_calibration(calibration), judging['tolerance']
    logged, _, notes = read_rests(rests, loaded, is_for_update=False)
    result = watch(series_of(logged, loaded, judging['gravity']), loaded, tolerance)
    out.points(notes)
    limit = f'{LIMIT:g} times the claimed sd' if tolerance is None else ug_text(tolerance)
    for rows, name in ((result.periods, 'from'), (result.temperatures, 'board')):
        out.table(
            (name, 'rests', 'degC', 'mean ug', 'RMS ug', 'claimed ug', 'within'),
            [
                (
                    *(row.name, row.n_rests, row.temperature, micro_g(row.mean)),
                    *(micro_g(row.rms), micro_g(row.claim), 'yes' if row.is_within else 'no'),
                )
                for row in rows
            ],
            title=f'|f| - g at rest; within: RMS of at most {limit}',
        )
    out.line(str(result))
    out.end(
        result.exit_code,
        **picked(result, 'days temperatures'),
        left=result.outside_since,
        forecast_days=result.forecast,
        interval_days=result.interval,
        **_ageing(result.ageing),
        notes=notes,
    )
