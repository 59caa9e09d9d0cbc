# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp fit``: bags of a thermal test to a calibration, once per unit."""

from __future__ import annotations

from datetime import datetime, timezone
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .convert import as_bags
from .output import Output, micro_g

if TYPE_CHECKING:
    from ..fitting import FitResult


def fit(
    context: typer.Context,
    bags: Annotated[
        list[Path], typer.Argument(help='Bags of one unit, or tables and logs.', metavar='BAG...')
    ],
    output: Annotated[Path, typer.Option('--output', '-o', help='Calibration to write (YAML).')],
    gravity: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    model: options.Model = 'response',
    static_curve: options.StaticCurve = None,
    dynamic_curve: options.DynamicCurve = None,
    groups: Annotated[
        str | None, typer.Option(help='Groups that may take part, by commas.', metavar='A,B')
    ] = None,
    force_groups: Annotated[
        str, typer.Option(help='Groups that stay whatever they earn.', metavar='A,B')
    ] = '',
    prior: Annotated[
        Path | None,
        typer.Option(
            help='Calibration to begin with: of the type, or an old one.', metavar='YAML'
        ),
    ] = None,
    ageing_bias: options.AgeingBias = None,
    ageing_scale: Annotated[
        float,
        typer.Option(help='What the scale may have changed by since, in ppm.', metavar='PPM'),
    ] = 0.0,
    report: Annotated[
        Path | None, typer.Option(help='Certificate to write (HTML).', metavar='HTML')
    ] = None,
    certificate_info: options.CertificateInfo = None,
    serial: options.NewSerial = None,
    full_scale: options.FullScale = None,
    offset: options.Offset = None,
    reference_temperature: options.ReferenceTemperature = 20.0,
    min_rest: options.MinRest = None,
    still_sd: options.StillSd = '50mg',
    allow: options.Allow = None,
    columns: Annotated[
        Path | None, typer.Option(help='Column map of the tables, as for convert.', metavar='YAML')
    ] = None,
    rate_hz: options.TableRate = None,
    input_: options.InputOption = 'auto',
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
    begin: options.Begin = None,
    end: options.End = None,
    force: options.Force = False,
    verbose: Annotated[
        bool, typer.Option('--verbose', '-v', help='List the positions that were found, too.')
    ] = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Fit a calibration to bags of a thermal test.

    The unit rests in unknown positions while the chamber goes through its
    program: six faces give bias and scale, nine or more well spread positions
    the misalignment, too. What the bags do not show stays at its prior, with
    the prior's uncertainty. Local gravity is yours to give.

    Groups: curve, set, now, board, neighbour, product, mixed, square, even,
    play. Those that the evidence does not want leave by themselves.

    Example:
      thermo_comp fit bags/unit42/* -o unit42.yaml --gravity 9.8154
      thermo_comp fit tumble.txt -o unit42.yaml --gravity 9.8154
    """
    from ..files import CALIBRATION, PAGE, check_output
    from ..fitting import FitOptions
    from ..fitting import fit as run
    from ..fitting.fit_sources import fit_sources
    from ..fitting.options import Ageing
    from ..unit.calibration_file import load_calibration, save_calibration

    out = Output(as_json, quiet)
    gravity = options.needed_place(gravity, latitude, height)
    inputs = bags if prior is None else [*bags, prior]
    check_output(output, CALIBRATION, overwrite=force, others=inputs)
    if report is not None:
        check_output(report, PAGE, overwrite=force, others=[*inputs, output])
    if certificate_info is not None and report is None:
        raise options.usage('--certificate-info fills the page of --report: give that, too')
    # Until the command ends.
    bags = context.with_resource(as_bags(out, bags, columns, rate_hz))
    where = options.topics_of(topic, topics, begin, end)
    sources, kind = fit_sources(bags, where, input_, serial)
    info = None
    if certificate_info is not None:
        from ..report import load_certificate_info

        info = load_certificate_info(certificate_info, serial or sources[0].serial)
    with options.usage_of():
        settings = FitOptions(
            gravity=gravity,
            model=model,
            static_curve=static_curve,
            dynamic_curve=dynamic_curve,
            groups=None if groups is None else _names(groups),
            forced=_names(force_groups),
            prior=None if prior is None else load_calibration(prior),
            ageing=Ageing(
                options.acceleration(ageing_bias, '--ageing-bias') or 0.0, ageing_scale * 1e-6
            ),
            serial=serial,
            input='counts' if kind == 'counts' else 'm/s^2',
            full_scale=full_scale,
            offset=offset,
            reference_temperature=reference_temperature,
            min_rest_s=min_rest,
            still_sd=options.acceleration(still_sd, '--still-sd') or 0.0,
            allow=tuple(allow or ()),
        )
    with out.progress('fitting', total=1.0) as done:
        result = run(sources, settings, lambda _stage, part: done(part))
    out.chosen((source.name, source.chosen) for source in sources)
    losses = [f'{source.name}: {loss}' for source in sources if (loss := source.missing())]
    for loss in losses:
        out.note(loss)
    save_calibration(result.calibration, output, overwrite=force)
    if report is not None:
        from ..report import write_report

        write_report(result, report, info=info, overwrite=force)
    _say(out, result, output, verbose)
    if report is not None:
        out.line(f'{report}: certificate')
    out.end(is_torn=bool(losses))


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in (part.strip() for part in text.split(',')) if name)


def _say(out: Output, result: FitResult, output: Path, verbose: bool) -> None:
    from ..text import counted
    from ..unit.gravity import spoken

    calibration = result.calibration
    if verbose:
        _say_positions(out, result)
    _say_groups(out, result)
    _say_residuals(out, result)
    _say_gyroscope(out, result)
    for finding in result.findings:
        if finding.level != 'good':
            out.line(f'- {finding.message}')
    left_out = result.residuals[-1].left_out
    headline = counted(len(result.positions), 'position')
    if left_out.n:
        headline += f', {spoken(left_out.rms)} RMS of |f| - g on each by the others alone'
    out.line(
        f'{output}: unit {calibration.unit.serial}, {calibration.provenance.model}, {headline}'
    )
    out.json(
        {
            'output': output,
            'serial': calibration.unit.serial,
            'model': calibration.provenance.model,
            'gravity': calibration.gravity_m_s2,
            'left_out_rms_m_s2': left_out.rms,
            'residuals_m_s2': result.residuals,
            'evidence': calibration.evidence,
            'noise_density_m_s2_sqrt_hz': calibration.noise_density_m_s2_sqrt_hz,
            'slow_noise_m_s2_sqrt_h': calibration.slow_noise_m_s2_sqrt_h,
            'gyroscope': _facts_of_gyroscope(result),
            'positions': result.positions,
            'least_known': result.least_known,
            'findings': result.findings,
        }
    )


def _say_positions(out: Output, result: FitResult) -> None:
    """
    Print every position: where, when, how long, which way was up; |f| - g by the fit and without.
    """
    from ..unit.gravity import MICRO_G

    out.table(
        ('bag', 'UTC', 'minutes', 'up x', 'y', 'z', 'in sample ug', 'left out ug'),
        [
            (
                one.source,
                f'{datetime.fromtimestamp(one.start_ns // 10**9, timezone.utc):%m-%d %H:%M:%S}',
                f'{one.duration_s / 60.0:.1f}',
                *(f'{component:+.3f}' for component in one.up),
                _ug(one.residual_rms / MICRO_G),
                _ug(one.left_out_rms / MICRO_G),
            )
            for one in result.positions
        ],
        title='positions at rest',
    )


def _say_groups(out: Output, result: FitResult) -> None:
    """Print what each group of the model earns, and the noise that is left."""
    from ..unit.gravity import MICRO_G

    calibration = result.calibration
    if calibration.evidence:
        out.table(
            ('group', 'of', 'explains ug', 'parameters', 'log evidence'),
            [
                (
                    one.group,
                    one.part,
                    micro_g(one.explains_m_s2 / MICRO_G),
                    f'{one.effective_parameters:.1f}',
                    f'{one.log_evidence_change:.1f}',
                )
                for one in calibration.evidence
            ],
            title='what the data need; log evidence: how much it falls without the group',
        )
    white, walk = (
        ' '.join(micro_g(value / MICRO_G) for value in values)
        for values in (calibration.noise_density_m_s2_sqrt_hz, calibration.slow_noise_m_s2_sqrt_h)
    )
    out.line(f'noise of x y z: white {white} ug/sqrt(Hz), walk {walk} ug/sqrt(h)')


def _say_residuals(out: Output, result: FitResult) -> None:
    """Print |f| - g by step of the model; the last column is what a new attitude will see."""
    response = result.calibration.provenance.model
    out.table(
        ('section', 'windows', 'raw', 'one set', 'two sets', response, 'left out'),
        [
            (
                row.section,
                row.fitted.n,
                *(
                    _ug(one.micro_g.rms)
                    for one in (row.raw, row.one_set, row.two_sets, row.fitted, row.left_out)
                ),
            )
            for row in result.residuals
            if row.fitted.n
        ],
        title='|f| - g at rest, RMS in ug; left out: each position by the others',
    )


def _say_gyroscope(out: Output, result: FitResult) -> None:
    """Print what the angular rate does within the positions, and its constants."""
    from ..unit.gyroscope import MILLIDEGREE

    found = result.gyroscope
    if found is None:
        return
    out.table(
        ('section', 'windows', 'raw', 'fitted', 'left out'),
        [
            (
                row.section,
                row.fitted.n // 3,
                *(
                    f'{one.rms / MILLIDEGREE:.3g}' if one.n else None
                    for one in (row.raw, row.fitted, row.left_out)
                ),
            )
            for row in found.residuals
            if row.fitted.n
        ],
        title='angular rate at rest less the mean of each position, RMS of an axis in mdeg/s',
    )
    unit = found.gyroscope
    white, walk, bias = (
        ' '.join(f'{value / MILLIDEGREE:.3g}' for value in values)
        for values in (
            unit.noise_density_rad_s_sqrt_hz,
            unit.slow_noise_rad_s_sqrt_h,
            unit.bias_rad_s,
        )
    )
    out.line(
        f'angular rate of x y z: bias {bias} mdeg/s, white {white} mdeg/s/sqrt(Hz), '
        f'walk {walk} mdeg/s/sqrt(h)'
    )


def _facts_of_gyroscope(result: FitResult) -> dict[str, object] | None:
    if result.gyroscope is None:
        return None
    unit = result.gyroscope.gyroscope
    return {
        'bias_rad_s': unit.bias_rad_s,
        'noise_density_rad_s_sqrt_hz': unit.noise_density_rad_s_sqrt_hz,
        'slow_noise_rad_s_sqrt_h': unit.slow_noise_rad_s_sqrt_h,
        'residuals_rad_s': result.gyroscope.residuals,
    }


def _ug(value: float) -> str | None:
    return micro_g(value) if isfinite(value) else None
