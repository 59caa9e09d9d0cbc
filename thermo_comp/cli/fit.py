# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp fit``: bags of a thermal test to a calibration, once per unit.

"""

from __future__ import annotations

from datetime import datetime, timezone
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .output import Output, micro_g

if TYPE_CHECKING:
    from ..fitting import FitResult


def fit(
    bags: Annotated[
        list[Path], typer.Argument(help='Bags of one unit: its positions.', metavar='BAG...')
    ],
    output: Annotated[Path, typer.Option('--output', '-o', help='Calibration to write (YAML).')],
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    model: Annotated[
        str, typer.Option(help='auto, golovach (the paper), quadratic (one set), or a candidate.')
    ] = 'auto',
    report: Annotated[
        Path | None, typer.Option(help='Certificate to write (HTML).', metavar='HTML')
    ] = None,
    serial: options.NewSerial = None,
    full_scale: Annotated[
        float | None, typer.Option(help='Magnitude of a saturated sample, in input units.')
    ] = None,
    reference_temperature: Annotated[
        float, typer.Option(help='Reference temperature in degC.')
    ] = 20.0,
    min_still: Annotated[float, typer.Option(help='Shortest still interval used, in s.')] = 3.0,
    allow: Annotated[
        list[str] | None, typer.Option(help='Refusal to override, as its message names it.')
    ] = None,
    input_: options.InputOption = options.InputChoice.auto,
    counts_topic: options.CountsTopic = 'accel/counts',
    imu_topic: options.ImuTopic = 'imu/uncompensated',
    board_topic: options.BoardTopic = 'temperature/board',
    case_topic: options.CaseTopic = 'temperature/case',
    force: options.Force = False,
    verbose: Annotated[
        bool, typer.Option('--verbose', '-v', help='List the positions that were found, too.')
    ] = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Fit a calibration to bags of a thermal test.

    The unit rests in several unknown positions while the chamber goes
    through its program: six faces give bias and scale, nine or more well
    spread positions the misalignment, too. Local gravity is yours to give.

    Example:
      thermo_comp fit bags/unit42/* -o unit42.yaml --gravity 9.8154

    """
    from ..files import CALIBRATION, PAGE, check_output
    from ..fitting import FitOptions, resolve_gravity
    from ..fitting import fit as run
    from ..fitting.fit_sources import fit_sources
    from ..unit.calibration_file import save_calibration

    out = Output(as_json, quiet)
    gravity = options.place(gravity, latitude, height)
    if gravity is None:
        raise options.usage('give --gravity, or --latitude and --height')
    check_output(output, CALIBRATION, overwrite=force, others=bags)
    if report is not None:
        check_output(report, PAGE, overwrite=force, others=[*bags, output])
    topics = options.topics_of(counts_topic, imu_topic, board_topic, case_topic)
    sources, kind = fit_sources(bags, topics, input_.value, serial)
    try:
        settings = FitOptions(
            gravity=resolve_gravity(gravity, None, None),
            model=model,
            serial=serial,
            input='counts' if kind == 'counts' else 'm/s^2',
            full_scale=full_scale,
            reference_temperature=reference_temperature,
            min_still_s=min_still,
            allow=tuple(allow or ()),
        )
    except ValueError as mistake:
        raise options.usage(str(mistake)) from mistake
    with out.progress('fitting', total=1.0) as done:
        result = run(sources, settings, lambda _stage, part: done(part))
    losses = [f'{source.name}: {loss}' for source in sources if (loss := source.missing())]
    for loss in losses:
        out.note(loss)
    save_calibration(result.calibration, output, overwrite=force)
    if report is not None:
        from ..report import write_report

        write_report(result, report, paths=bags, overwrite=force)
    _say(out, result, output, verbose)
    if report is not None:
        out.line(f'{report}: certificate')
    out.end(is_torn=bool(losses))


def _say(out: Output, result: FitResult, output: Path, verbose: bool) -> None:
    calibration = result.calibration
    if verbose:
        _say_positions(out, result)
    _say_candidates(out, result)
    out.table(
        ('section', 'windows', 'raw ug', 'one set ug', 'fitted ug', 'max ug'),
        [
            (
                row.section,
                row.fitted.n,
                micro_g(row.raw.micro_g.rms),
                micro_g(row.one_set.micro_g.rms),
                micro_g(row.fitted.micro_g.rms),
                micro_g(row.fitted.micro_g.peak),
            )
            for row in result.residuals
            if row.fitted.n
        ],
        title='|f| - g at rest, RMS',
    )
    for finding in result.findings:
        if finding.level != 'good':
            out.line(f'- {finding.message}')
    out.line(
        f'{output}: unit {calibration.unit.serial}, {calibration.provenance.model}, '
        f'{len(result.positions)} positions'
    )
    out.json(
        {
            'output': output,
            'serial': calibration.unit.serial,
            'model': calibration.provenance.model,
            'gravity': calibration.gravity_m_s2,
            'residuals_m_s2': result.residuals,
            'positions': result.positions,
            'candidates': result.candidates,
            'findings': result.findings,
        }
    )


def _say_positions(out: Output, result: FitResult) -> None:
    """
    Print every rest: where, when, how long, which way was up, what the fit leaves of |f| - g.

    """
    from ..unit.gravity import MICRO_G

    out.table(
        ('bag', 'UTC', 'minutes', 'up x', 'y', 'z', '|f| - g ug'),
        [
            (
                one.source,
                f'{datetime.fromtimestamp(one.start_ns // 10**9, timezone.utc):%m-%d %H:%M:%S}',
                f'{one.duration_s / 60.0:.1f}',
                *(f'{component:+.3f}' for component in one.up),
                micro_g(one.residual_rms / MICRO_G),
            )
            for one in result.positions
        ],
        title='positions at rest',
    )


def _say_candidates(out: Output, result: FitResult) -> None:
    """
    Print what each model left per axis; the held-out error decides, ties go to the simpler one.

    """
    from ..unit.gravity import MICRO_G

    out.table(
        ('candidate', 'parameters', 'fitted ug', 'held out ug', 'BIC', ''),
        [
            (
                one.name,
                one.n_parameters,
                micro_g(one.fitted_rms / MICRO_G),
                micro_g(one.held_out_rms / MICRO_G) if isfinite(one.held_out_rms) else '-',
                f'{one.bic:.3g}',
                'chosen' if one.is_chosen else '',
            )
            for one in result.candidates
        ],
        title='error of each axis, RMS',
    )
