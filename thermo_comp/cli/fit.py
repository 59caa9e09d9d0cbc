# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns ``thermo_comp fit`` and ``prior``: bags to a calibration, calibrations to that of their type.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from . import options
from .convert import as_bags
from .options import argument, option
from .output import Cell, Output, micro_g, millidegrees, picked

if TYPE_CHECKING:
    from ..fitting import FitResult

Curve = Literal['linear', 'quadratic', 'cubic', 'spline', 'exponential']


def fit(
    context: typer.Context,
    bags: list[Path] = argument('Bags of one unit, or tables and logs.', metavar='BAG...'),
    output: Path = options.NEW_CALIBRATION,
    settings: dict[str, Any] = options.fitting,
    static_curve: Curve | None = option(
        "Bias and scale over temperature; else the model's own.", None, metavar='CURVE'
    ),
    dynamic_curve: Curve | None = option(
        'The same of the dynamic set, by itself.', None, metavar='CURVE'
    ),
    groups: str | None = option('Groups that may take part, by commas.', None, metavar='A,B'),
    force_groups: str = option('Groups that stay whatever they earn.', '', metavar='A,B'),
    prior: Path | None = option(
        'Calibration to begin with: of the type, or an old one.', None, metavar='YAML'
    ),
    ageing_bias: str | None = option(
        "What the biases may have changed by since the prior's: 50ug, 0.1mg.", None
    ),
    ageing_scale: float = option(
        'What the scale may have changed by since, in ppm.', 0.0, metavar='PPM'
    ),
    report: Path | None = option('Certificate to write (HTML).', None, metavar='HTML'),
    certificate_info: Path | None = options.CERTIFICATE_INFO,
    serial: str | None = option(
        "Serial, instead of the bags'.", None, callback=options.check_serial
    ),
    offset: float | None = options.OFFSET,
    columns: Path | None = option(
        'Column map of the tables, as for convert.', None, metavar='YAML'
    ),
    rate_hz: float | None = options.TABLE_RATE,
    reading: dict[str, Any] = options.reading_part,
    force: bool = options.FORCE,
    verbose: bool = option('List the positions that were found, too.', False, '--verbose', '-v'),
    out: Output = options.out,
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
    from ..fitting.sources import fit_sources
    from ..unit.calibration_file import load_calibration, save_calibration

    inputs = bags if prior is None else [*bags, prior]
    check_output(output, CALIBRATION, overwrite=force, others=inputs)
    if report is not None:
        check_output(report, PAGE, overwrite=force, others=[*inputs, output])
    if certificate_info is not None and report is None:
        raise options.usage('--certificate-info fills the page of --report: give that, too')
    # Until the command ends.
    bags = context.with_resource(as_bags(out, bags, columns, rate_hz))
    sources, kind = fit_sources(bags, **reading)
    info = None
    if certificate_info is not None:
        from ..report import load_certificate_info

        info = load_certificate_info(certificate_info, serial or sources[0].serial)
    with options.usage_of():
        wanted = FitOptions(
            **settings,
            static_curve=static_curve,
            dynamic_curve=dynamic_curve,
            groups=None if groups is None else _names(groups),
            forced=_names(force_groups),
            prior=None if prior is None else load_calibration(prior),
            ageing_bias=options.acceleration(ageing_bias, '--ageing-bias') or 0.0,
            ageing_scale=ageing_scale * 1e-6,
            serial=serial,
            input='counts' if kind == 'counts' else 'm/s^2',
            offset=offset,
        )
    with out.progress('fitting') as done:
        result = run(sources, wanted, done)
    out.told((bag.source.name, bag.info.chosen, bag.info.truncated) for bag in result.bags)
    save_calibration(result.calibration, output, overwrite=force)
    if report is not None:
        from ..report import evidence_of_fit, write_report

        write_report(evidence_of_fit(result), report, info=info, overwrite=force)
    _say(out, result, output, verbose)
    if report is not None:
        out.line(f'{report}: certificate')
    out.end()


def prior(
    calibrations: list[Path] = argument(
        'Calibrations of different units of one type.', metavar='YAML...'
    ),
    output: Path = option('Prior to write (YAML).', ..., '--output', '-o'),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Make the prior of a type of unit from the calibrations of some.

    Mean and scatter of what the units' calibrations say; `fit --prior` begins
    with it, so that a further unit of the type needs less time in the chamber.

    Example:
      thermo_comp prior unit01.yaml unit02.yaml unit03.yaml -o type.yaml
    """
    from ..files import CALIBRATION, check_output
    from ..fitting.priors import population
    from ..unit.calibration_file import load_calibration, save_calibration

    check_output(output, CALIBRATION, overwrite=force, others=calibrations)
    units = [load_calibration(path) for path in calibrations]
    found = population(units)
    save_calibration(found, output, overwrite=force)
    out.line(f'{output}: what {len(units)} units have in common, {len(found.response)} columns')
    out.json({'output': output, 'units': [one.unit.serial for one in units]})


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in map(str.strip, text.split(',')) if name)


def _say(out: Output, result: 'FitResult', output: Path, verbose: bool) -> None:
    from ..text import counted
    from ..unit.gravity import spoken

    calibration = result.calibration
    gyroscope = calibration.gyroscope if result.rates else None
    model, left_out = calibration.provenance.model, result.residuals[-1].left_out
    if verbose:
        out.table(
            ('bag', 'UTC', 'minutes', 'up x', 'y', 'z', 'in sample ug', 'left out ug'),
            [
                (
                    one.source,
                    time.strftime('%m-%d %H:%M:%S', time.gmtime(one.start_ns // 10**9)),
                    f'{one.duration_s / 60.0:.1f}',
                    *(f'{component:+.3f}' for component in one.up),
                    *(micro_g(one.residual_rms), micro_g(one.left_out_rms)),
                )
                for one in result.positions
            ],
            title='positions at rest',
        )
    if calibration.evidence:
        out.table(
            ('group', 'of', 'explains ug', 'parameters', 'log evidence'),
            [
                (
                    *(one.group, one.part, micro_g(one.explains_m_s2)),
                    *(f'{one.effective_parameters:.1f}', f'{one.log_evidence_change:.1f}'),
                )
                for one in calibration.evidence
            ],
            title='what the data need; log evidence: how much it falls without the group',
        )
    white = _of_axes(calibration.noise_density_m_s2_sqrt_hz, micro_g)
    walk = _of_axes(calibration.slow_noise_m_s2_sqrt_h, micro_g)
    out.line(f'noise of x y z: white {white} ug/sqrt(Hz), walk {walk} ug/sqrt(h)')
    steps = {'raw': 'raw', 'one_set': 'one set', 'two_sets': 'two sets', 'fitted': model}
    out.table(
        ('section', 'windows', *steps.values(), 'left out'),
        _steps(result.residuals, (*steps, 'left_out'), micro_g),
        title='|f| - g at rest, RMS in ug; left out: each position by the others',
    )
    if gyroscope is not None:
        out.table(
            ('section', 'windows', 'raw', 'fitted', 'left out'),
            _steps(result.rates, ('raw', 'fitted', 'left_out'), millidegrees, n_axes=3),
            title='angular rate at rest less the mean of each position, RMS of an axis in mdeg/s',
        )
        bias = _of_axes(gyroscope.bias_rad_s, millidegrees)
        white = _of_axes(gyroscope.noise_density_rad_s_sqrt_hz, millidegrees)
        walk = _of_axes(gyroscope.slow_noise_rad_s_sqrt_h, millidegrees)
        out.line(
            f'angular rate of x y z: bias {bias} mdeg/s, white {white} mdeg/s/sqrt(Hz), '
            f'walk {walk} mdeg/s/sqrt(h)'
        )
    for finding in result.findings:
        if finding.level != 'good':
            out.line(f'- {finding.message}')
    headline = counted(len(result.positions), 'position')
    if left_out.n:
        headline += f', {spoken(left_out.rms)} RMS of |f| - g on each by the others alone'
    out.line(f'{output}: unit {calibration.unit.serial}, {model}, {headline}')
    out.json(
        {
            'output': output,
            'serial': calibration.unit.serial,
            'model': model,
            'gravity': calibration.gravity_m_s2,
            'left_out_rms_m_s2': left_out.rms,
            'residuals_m_s2': result.residuals,
            **picked(calibration, 'evidence noise_density_m_s2_sqrt_hz slow_noise_m_s2_sqrt_h'),
            'gyroscope': gyroscope
            and {
                **picked(
                    gyroscope, 'bias_rad_s noise_density_rad_s_sqrt_hz slow_noise_rad_s_sqrt_h'
                ),
                'residuals_rad_s': result.rates,
            },
            **picked(result, 'positions least_known findings'),
        }
    )


def _of_axes(values: Iterable[float], shown: Callable[[float], str | None]) -> str:
    return ' '.join(str(shown(value)) for value in values)


def _steps(
    residuals: Iterable[Any],
    steps: Iterable[str],
    shown: Callable[[float], str | None],
    n_axes: int = 1,
) -> list[tuple[Cell, ...]]:
    """Give what each step of the model leaves in each section; the last is a new attitude's."""
    return [
        (row.section, row.fitted.n // n_axes, *(shown(getattr(row, x).rms) for x in steps))
        for row in residuals
        if row.fitted.n
    ]
