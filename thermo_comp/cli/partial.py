# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp partial``: what a recording tells that is too little for a calibration.

"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from . import options
from .output import Output

if TYPE_CHECKING:
    from ..fitting.one_pose import BranchFit, Pose
    from ..fitting.partial import Partial
    from ..fitting.triad import TriadFit

_HOUR_S = 3600.0


def partial(
    bag: options.Bag,
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    branches: Annotated[
        bool, typer.Option('--branches', help='Fit each run between jumps by itself.')
    ] = False,
    begin: Annotated[float | None, typer.Option('--from', help='Use it from here, in s.')] = None,
    end: Annotated[float | None, typer.Option('--to', help='Use it up to here, in s.')] = None,
    input_: options.InputOption = options.InputChoice.auto,
    counts_topic: options.CountsTopic = 'accel/counts',
    imu_topic: options.ImuTopic = 'imu/uncompensated',
    board_topic: options.BoardTopic = 'temperature/board',
    case_topic: options.CaseTopic = 'temperature/case',
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Say what a recording tells that is too little for a calibration.

    One attitude over temperature: the drift along gravity, for this attitude
    only. Many attitudes without temperature: bias, scale and misalignment as
    they were. A sensor that jumps at rest is found and the fit over the jump
    refused. Exit code 1 when nothing can be told.

    Example:
      thermo_comp partial freezer.mcap --branches

    """
    from ..fitting import resolve_gravity
    from ..fitting.one_pose import PoseOptions
    from ..fitting.partial import tell

    out = Output(as_json, quiet)
    if gravity is not None or latitude is not None or height is not None:
        gravity = resolve_gravity(gravity, latitude, height)
    infinite = float('inf')
    try:
        settings = PoseOptions(
            gravity=gravity,
            begin_s=-infinite if begin is None else begin,
            end_s=infinite if end is None else end,
        )
    except ValueError as mistake:
        raise options.usage(str(mistake)) from mistake
    with out.progress('reading', total=None):
        result = tell(
            bag,
            settings,
            by_branch=branches,
            topics=options.topics_of(counts_topic, imu_topic, board_topic, case_topic),
            input=input_.value,
        )
    if result.missing:
        out.note(f'{bag}: {result.missing}')
    if result.pose is not None:
        _say_pose(out, result, result.pose)
    elif result.triad is not None:
        _say_triad(out, result, result.triad)
    if result.pose is not None and not any(fit.model for fit in result.fits):
        raise typer.Exit(1)
    out.end(is_torn=bool(result.missing))


def _say_pose(out: Output, result: Partial, pose: Pose) -> None:
    from ..fitting.rests import describe

    events = [describe(event, pose.milli_g) for event in pose.events]
    for event in events:
        out.line(f'- {event}')
    out.line(
        'one attitude: the reading along gravity over the board temperature, for this attitude '
        'only; bias and scale of the axes cannot be told apart'
    )
    rows = [_summary(fit, pose) for fit in result.fits]
    for row in rows:
        where = f'{row["begin_s"]:.0f} .. {row["end_s"]:.0f} s'
        out.line(f'{where}: {row["refusal"] or _words(row)}')
    out.json(
        {
            'bag': result.source,
            'kind': 'along gravity in one attitude',
            'events': pose.events,
            'event_texts': events,
            'branches': rows,
        }
    )


def _summary(fit: BranchFit, pose: Pose) -> dict[str, Any]:
    import numpy as np

    row: dict[str, Any] = {
        'begin_s': fit.branch.start_s,
        'end_s': fit.branch.end_s,
        'refusal': fit.refusal,
    }
    model, mg = fit.model, pose.milli_g
    if model is None:
        return row
    gravity = pose.options.gravity
    level = None
    if gravity is not None and pose.options.input == 'm/s^2':
        level = (model.coefficients[0] - gravity) / mg
    return row | {
        'direction': model.direction,
        'reference_temperature_c': model.reference_temperature,
        'temperature_range_c': model.temperature_range,
        'level_from_gravity_mg': level,
        'coefficients_mg': [value / mg for value in model.coefficients[1:]],
        'thermal_error_sd_mg': float(
            np.max(model.thermal_error_sd(np.array(model.temperature_range)))
        )
        / mg,
        'residual_rms_mg': model.residual_rms / mg,
        'wander_in_an_hour_mg': model.solution.drift_sd(_HOUR_S) / mg,
    }


def _words(row: dict[str, Any]) -> str:
    terms = ' '.join(
        f'{value:+.3g} t' + (f'^{power}' if power > 1 else '')
        for power, value in enumerate(row['coefficients_mg'], 1)
    )
    low, high = row['temperature_range_c']
    level = row['level_from_gravity_mg']
    return (
        ('' if level is None else f'{level:+.1f} mg from gravity; ')
        + f'{terms} mg, t = T - {row["reference_temperature_c"]:.1f} degC, within {low:.1f} .. '
        f'{high:.1f} degC, sd up to {row["thermal_error_sd_mg"]:.2g} mg; leaves '
        f'{row["residual_rms_mg"]:.2g} mg; the level wanders by '
        f'{row["wander_in_an_hour_mg"]:.2g} mg in an hour'
    )


def _say_triad(out: Output, result: Partial, triad: TriadFit) -> None:
    from ..fitting.partial import temperature_span
    from ..unit.gravity import MICRO_G
    from ..unit.metrics import residual_statistics

    out.table(
        ('axis', 'bias', 'sd', 'scale', 'sd'),
        [
            (axis, *(float(v[i]) for v in (triad.bias, sds[:3], triad.scale, sds[3:6])))
            for sds in (triad.parameter_sd,)
            for i, axis in enumerate('xyz')
        ],
        title=f'{len(triad.up)} positions; input units, and input units per m/s^2',
    )
    if triad.has_misalignment:
        out.table(
            ('M', 'value', 'sd'),
            [
                (name, float(triad.parameters[6 + k]), float(triad.parameter_sd[6 + k]))
                for k, name in enumerate(('[1][0]', '[2][0]', '[2][1]'))
            ],
        )
    left = residual_statistics(triad.residual)
    out.line(f'|f| - g at rest: {left.rms / MICRO_G:.0f} ug RMS over {left.n} windows')
    advice = list(triad.advice)
    span = temperature_span(result.bag)
    advice.append(
        f'it has temperatures over {span:.1f} degC: `thermo_comp fit` makes a calibration of it'
        if span
        else 'no temperature: it holds at the temperature of the recording and is no calibration'
    )
    for line in advice:
        out.line(f'- {line}')
    out.json(
        {
            'bag': result.source,
            'kind': 'bias, scale and misalignment at one temperature',
            'positions': len(triad.up),
            'bias': triad.bias.tolist(),
            'scale': triad.scale.tolist(),
            'misalignment': triad.misalignment.tolist() if triad.has_misalignment else None,
            'parameter_sd': triad.parameter_sd.tolist(),
            'residual_m_s2': left,
            'advice': advice,
        }
    )
