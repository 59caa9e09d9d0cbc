# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the commands for rest logs of a unit in use: ``update``, and ``evaluate`` on a rest log."""

from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import CALIBRATION, check_output
from . import shared_options as options
from .output import Output, micro, micro_g, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..field.ageing import Ageing
    from ..field.update import Update

#: Exit code of an update that determines no axis, or is not clearly better on left-out days.
NOTHING_GAINED = 3


def update(
    calibration: Path = argument('Calibration of the unit (YAML).', metavar='YAML'),
    rests: list[Path] = argument('Folders or files of rest logs.', metavar='RESTS...'),
    output: Path = options.NEW_CALIBRATION,
    where: tuple[float | None, float] = options.place,
    ahead: float = option(
        'Days of ageing after the last rest that the claimed sd covers.', 1.0, min=0.0, max=3650.0
    ),
    allow: list[str] | None = option(
        'gravity: take local gravity as exact; unit: accept an |f| like that of another unit.'
    ),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Update a calibration in the field, by rests that the node has logged.

    The calibration is the prior; the ageing since the fit is estimated from
    the rests, which may be in any attitude. Old and new calibration are
    compared on days left out of the update. The new calibration is written only
    if the rests determine an axis and lower the mean square of |f| - g by more than
    its standard error; else the exit code is 3, and the present sds are printed.

    Example:
      thermo_comp update unit42.yaml rests -o unit42_new.yaml
    """
    from ..field.series import read_rests, series_of
    from ..field.update import OVERRIDES, change_texts, refuse_another_unit
    from ..field.update import update as run
    from ..unit.calibration_file import load_calibration, save_calibration

    allowed = _overrides(allow, OVERRIDES)
    check_output(output, CALIBRATION, overwrite=force, others=[calibration, *rests])
    old = load_calibration(calibration)
    logged, source, notes = read_rests(rests, old, ahead=ahead)
    created = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')
    series = series_of(logged, old, gravity=where[0])
    is_certain = 'gravity' in allowed
    result = run(series, old, source, created, ahead, is_gravity_certain=is_certain)
    if 'unit' not in allowed:
        refuse_another_unit(result)
    out.points(notes)
    _show_axis_changes(result, out)
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


def _show_axis_changes(result: 'Update', out: Output) -> None:
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
        'starts of the node (at rest: change of the reading at the mean force; sds: at rest / +-)',
    )


def _overrides(allow: list[str] | None, names: tuple[str, ...]) -> list[str]:
    for word in allow or ():
        if word not in names:
            raise options.usage(f'--allow: expected one of {", ".join(names)}, got {word!r}')
    return allow or []


def _ageing(ageing: 'Ageing | None') -> dict[str, Any]:
    """Return the sds of `Ageing` [m/s^2] and the ratio of the lags' sd to the assumed sd."""
    values = vars(ageing).copy() if ageing else {}
    share = values.pop('lags', None)
    return {'ageing_m_s2': values or None, 'lags_at_start': share}


def evaluate_rests(
    rests: list[Path],
    calibration: Path,
    gravity: float | None,
    tolerance: float | None,
    out: Output,
) -> None:
    """Print |f| - g over a rest log; exit with 1 if the unit is outside the limit."""
    from ..field.series import read_rests, series_of
    from ..field.watch import LIMIT, watch
    from ..unit.calibration_file import load_calibration
    from ..unit.gravity import ug_text

    known = load_calibration(calibration)
    logged, _, notes = read_rests(rests, known, is_for_update=False)
    result = watch(series_of(logged, known, gravity), known, tolerance)
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
