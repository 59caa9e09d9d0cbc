# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the commands ``fit`` (bags to a calibration) and ``prior`` (calibrations to a prior)."""

import re
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from ..files import CALIBRATION, PAGE, check_output
from ..text import counted
from . import shared_options as options
from .bags import print_nonlinearity
from .convert import print_guess
from .output import Cell, Output, micro_g, millidegrees, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..convert.log import ForeignLog
    from ..fitting import FitResult
    from ..fitting.selection import Trial
    from ..unit.calibration import Calibration
    from ..unit.columns import Part
    from ..unit.rate_bias import Gyroscope

#: Largest width of a model's name in a table [characters].
_MODEL_WIDTH = 46
#: Attributes of `Gyroscope` that `fit` prints.
_RATES = 'bias_rad_s noise_density_rad_s_sqrt_hz slow_noise_rad_s_sqrt_h'
Curve = Literal['linear', 'quadratic', 'cubic', 'spline', 'exponential']


def fit(
    context: typer.Context,
    bags: list[Path] = argument('Bags, tables or logs of one unit.', metavar='BAG...'),
    output: Path = options.NEW_CALIBRATION,
    settings: dict[str, Any] = options.fitting,
    static_curve: Curve | None = option(
        'Curve of bias and scale over temperature in a soak: linear, quadratic, cubic, spline '
        'or exponential; default: cubic, or linear for --model golovach.',
        metavar='CURVE',
    ),
    dynamic_curve: Curve | None = option(
        'Curve of bias and scale over temperature in ramps; default: quadratic for --model '
        'golovach, else the curve in a soak plus a quadratic; if the curve in a soak is a spline '
        'or exponential, a separate curve of this kind.',
        metavar='CURVE',
    ),
    groups: str | None = option(
        'Groups of regression columns from which the fit selects; default: all.', metavar='A,B'
    ),
    force_groups: str = option('Groups that the fit keeps without a test.', '', metavar='A,B'),
    prior: Path | None = option(
        'Prior: the output of thermo_comp prior for this type of unit, or an old calibration of '
        'this unit.',
        metavar='YAML',
    ),
    ageing_bias: str | None = option(
        'Assumed bias change (1 sd) since the prior calibration, e.g. 50ug; default: estimated '
        'from the bags.'
    ),
    ageing_scale: float = option(
        'Assumed scale change (1 sd) since the prior calibration, in ppm; if neither this option '
        'nor --ageing-bias is given, the changes are estimated from the bags.',
        0.0,
        metavar='PPM',
        min=0.0,
    ),
    report: Path | None = option('Certificate to write (HTML).', metavar='HTML'),
    certificate_info: Path | None = options.CERTIFICATE_INFO,
    serial: str | None = option(
        'Serial of the unit, instead of the serial in the bags.', callback=options.check_serial
    ),
    offset: float | None = options.OFFSET,
    known_force: Any = options.force,
    columns: Path | None = option('Column map of the tables, as for convert.', metavar='YAML'),
    rate_hz: float | None = options.TABLE_RATE,
    topics: Any = options.reading_part,
    force: bool = options.FORCE,
    verbose: bool = option('Also print the table of positions.', False, '-v'),
    out: Output = options.out,
) -> None:
    """
    Fit a calibration to bags of a thermal test.

    The unit rests in unknown positions while the chamber runs its program:
    six faces determine bias and scale, nine or more well spread positions also
    the misalignment. Parameters that the bags do not determine keep the value
    and the uncertainty of the prior. Local gravity must be given.

    Groups of regression columns: curve, set, part, gradient, board,
    gradient_lag, product, gradient_x_temperature, square, gradient_even,
    gradient_even_about_rest, play, bend. A group of columns is kept if it
    improves the correction of data left out of the fit.

    Example:
      thermo_comp fit bags/unit42/* -o unit42.yaml --gravity 9.8154
      thermo_comp fit tumble.txt -o unit42.yaml --gravity 9.8154
    """
    from ..convert.readers import as_bags
    from ..fitting import FitOptions
    from ..fitting import fit as run
    from ..fitting.sources import fit_sources
    from ..unit.calibration_file import load_calibration, save_calibration

    inputs = bags if prior is None else [*bags, prior]
    check_output(output, CALIBRATION, overwrite=force, others=inputs)
    if report is not None:
        check_output(report, PAGE, overwrite=force, others=[*inputs, output])
    if certificate_info is not None and report is None:
        raise options.usage('--certificate-info fills the page of --report: give both')

    printed: dict[str, str] = {}

    def print_log(log: 'ForeignLog') -> None:
        print_guess(out, log, printed)
        out.sources([(log.path, log.chosen, None)])

    with options.usage_of():
        # `as_bags` converts tables to temporary bags, which exist until the command ends.
        bags = context.with_resource(as_bags(bags, print_log, columns=columns, rate_hz=rate_hz))
    sources, kind = fit_sources(bags, topics, known_force)
    info = None
    if certificate_info is not None:
        from ..report.statements import load_certificate_info

        info = load_certificate_info(certificate_info, serial or sources[0].serial)
    with options.usage_of():
        fit_options = FitOptions(
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
        result = run(sources, fit_options, done)
    out.recordings(result.bags)
    save_calibration(result.calibration, output, overwrite=force)
    if report is not None:
        from ..report.evidence import evidence_of_fit
        from ..report.page import write_report

        evidence = evidence_of_fit(result)
        write_report(evidence, report, info=info, overwrite=force)
    _print_fit(out, result, output, report, verbose)


def prior(
    calibrations: list[Path] = argument(
        'Calibrations of different units of one type.', metavar='YAML...'
    ),
    output: Path = option('Prior to write (YAML).', ..., '-o'),
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Make the prior of a type of unit from calibrations of several units.

    A prior is the mean and scatter of the parameters over units. With
    `fit --prior` a further unit of the type needs less time in the chamber.
    Nonlinear terms (K2, K3) of the calibrations are left out.

    Example:
      thermo_comp prior unit01.yaml unit02.yaml unit03.yaml -o type.yaml
    """
    from ..fitting.population import population
    from ..unit.calibration_file import load_calibration, save_calibration

    check_output(output, CALIBRATION, overwrite=force, others=calibrations)
    units = [load_calibration(path) for path in calibrations]
    common = population(units)
    save_calibration(common, output, overwrite=force)
    out.line(f'{output}: prior from {len(units)} units, {len(common.response)} columns')
    bent = [unit.unit.serial for unit in units if unit.nonlinearity and unit.nonlinearity.terms]
    if bent:
        out.line(f'- the prior leaves out the nonlinear terms K2, K3 of units {", ".join(bent)}')
    out.end(output=output, units=[unit.unit.serial for unit in units])


def _names(text: str) -> tuple[str, ...]:
    return tuple(name for name in map(str.strip, text.split(',')) if name)


def _print_fit(
    out: Output, result: 'FitResult', output: Path, page: Path | None, verbose: bool
) -> None:
    import numpy as np

    from ..fitting.coverage import distinct_directions
    from ..unit.gravity import ug_text

    calibration = result.calibration
    gyroscope = calibration.gyroscope if result.rates else None
    model, left_out = calibration.provenance.model, result.residuals[-1].left_out
    n_positions = len(distinct_directions(np.array([rest.up for rest in result.positions])))
    if verbose:
        _print_positions(out, result)
    _print_models(out, result.fit.selected.trials)
    parts = result.fit.windows.model.parts
    if parts:
        out.line(_parts_text(parts))
    _print_groups(out, calibration, has_prior=result.fit.posterior.prior.informative is not None)
    print_nonlinearity(out, calibration)
    _print_contributions(out, result)
    _print_residuals(out, result, n_positions)
    if gyroscope is not None:
        _print_rates(out, result, gyroscope)
    out.points(finding.message for finding in result.findings if finding.level != 'good')
    headline = counted(n_positions, 'position')
    if len(result.positions) > n_positions:
        headline += f' ({counted(len(result.positions), "rest")})'
    if left_out.n:
        headline += f', error {ug_text(left_out.rms)} RMS on data left out'
    out.line(f'{output}: unit {calibration.unit.serial}, {model}, {headline}')
    if page is not None:
        out.line(f'{page}: certificate')
    out.end(
        output=output,
        serial=calibration.unit.serial,
        model=model,
        gravity=calibration.gravity_m_s2,
        left_out_rms_m_s2=left_out.rms,
        residuals_m_s2=result.residuals,
        models=[_model(trial) for trial in result.fit.selected.trials],
        part_lags_s=parts and _behind_s(parts),
        part_case_shares=parts and [part.sensor_share for part in parts],
        part_leads_s=parts and [part.lead_s for part in parts],
        **picked(calibration, 'evidence noise_density_m_s2_sqrt_hz slow_noise_m_s2_sqrt_h'),
        gyroscope=gyroscope and picked(gyroscope, _RATES) | {'residuals_rad_s': result.rates},
        contributions_m_s2=result.contributions,
        **picked(result, 'positions least_known likeness findings'),
    )


def _behind_s(parts: Sequence['Part']) -> list[float]:
    """Return the time by which each part's temperature lags its surroundings in a ramp [s]."""
    return [part.tau_s + part.second_tau_s for part in parts]


def _parts_text(parts: Sequence['Part']) -> str:
    """Describe, for each axis, the lag of the part that determines bias and scale."""
    lags = ', '.join(f'{behind_s:.0f}' for behind_s in _behind_s(parts))
    text = f'lags the board by {lags} s (x, y, z)'
    if any(part.sensor_share for part in parts):
        shares = ', '.join(f'{part.sensor_share:.2f}' for part in parts)
        source = f'a temperature between board and case (case share {shares})'
        text = f'lags {source} by {lags} s (x, y, z)'
    elif any(part.lead_s for part in parts):
        leads = ', '.join(f'{part.lead_s:.0f}' for part in parts)
        source = f'a temperature that leads the board thermometer by {leads} s'
        text = f'lags by {lags} s (x, y, z) {source}'
    return f'bias and scale of each axis depend on the temperature of one part, which {text}'


def _print_positions(out: Output, result: 'FitResult') -> None:
    out.table(
        ('bag', 'UTC', 'minutes', 'up x', 'y', 'z', 'in sample ug', 'left out ug'),
        [
            (
                position.source,
                time.strftime('%m-%d %H:%M:%S', time.gmtime(position.start_ns // 10**9)),
                f'{position.duration_s / 60.0:.1f}',
                *(f'{component:+.3f}' for component in position.up),
                *(micro_g(position.residual_rms), micro_g(position.left_out_rms)),
            )
            for position in result.positions
        ],
        title='positions at rest; RMS of |f| - g in the fit, and RMS error on data left out',
    )


def _print_groups(out: Output, calibration: 'Calibration', has_prior: bool) -> None:
    if calibration.evidence:
        instead = "keeps the prior's values" if has_prior else 'is removed'
        out.table(
            ('group', 'of', 'explains ug', 'parameters', 'log evidence'),
            [
                (
                    *(group.group, group.part, micro_g(group.explains_m_s2)),
                    *(f'{group.effective_parameters:.1f}', f'{group.log_evidence_change:.1f}'),
                )
                for group in calibration.evidence
            ],
            title=f'groups kept; explains: RMS effect; log evidence: loss if the group {instead}',
        )
    white = _of_axes(calibration.noise_density_m_s2_sqrt_hz, micro_g)
    walk = _of_axes(calibration.slow_noise_m_s2_sqrt_h, micro_g)
    out.line(f'noise of x y z: white {white} ug/sqrt(Hz), random walk {walk} ug/sqrt(h)')


def _print_contributions(out: Output, result: 'FitResult') -> None:
    """Print the RMS effects of the thermal response and of the unknowns of the bags."""
    effects = {name: x for name, x in vars(result.contributions).items() if x is not None}
    out.table(
        ('effect', 'RMS ug'),
        [(name.replace('_', ' '), micro_g(value)) for name, value in effects.items()],
        title="effects on an axis: first the unit's thermal response, then unknowns of the bags",
    )


def _print_residuals(out: Output, result: 'FitResult', n_positions: int) -> None:
    steps = {'raw': 'raw', 'one_set': 'one set', 'two_sets': 'two sets'}
    steps['fitted'] = result.calibration.provenance.model
    out.table(
        ('section', 'windows', *steps.values(), 'left out'),
        _steps(result.residuals, (*steps, 'left_out'), micro_g),
        title='|f| - g at rest, RMS in ug',
    )
    if not result.residuals[-1].left_out.n:
        out.line('left out: not computed, because the fit needs all of the data')
    elif n_positions == 1:
        out.line('left out: RMS drift of an axis in sections of the program left out of the fit')
    else:
        out.line(
            'left out: |f| - g in positions left out of the fit; if the other positions do not '
            'determine |f|: RMS drift of the axes'
        )


def _print_rates(out: Output, result: 'FitResult', gyroscope: 'Gyroscope') -> None:
    out.table(
        ('section', 'windows', 'raw', 'fitted', 'left out'),
        _steps(result.rates, ('raw', 'fitted', 'left_out'), millidegrees, axes=3),
        title='angular rate at rest less the mean of each position, RMS of an axis in mdeg/s',
    )
    bias, white, walk = (
        _of_axes(values, millidegrees) for values in picked(gyroscope, _RATES).values()
    )
    out.line(
        f'angular rate of x y z: bias {bias} mdeg/s, white {white} mdeg/s/sqrt(Hz), '
        f'random walk {walk} mdeg/s/sqrt(h)'
    )


def _print_models(out: Output, trials: Sequence['Trial']) -> None:
    """Print the errors of each model on data left out of the fit, and the legend of the table."""
    columns = {
        'positions': 'drift of an axis in a left-out position',
        'sections': 'drift of an axis in a left-out section of the temperature program',
        'norm': '|f| - g in a left-out position',
    }
    left = [[micro_g(folds.rms) for folds in trial.score.kinds] for trial in trials]
    kept = [k for k in range(len(columns)) if any(row[k] for row in left)]
    if not kept or len(trials) < 2:
        return
    names = [list(columns)[k] for k in kept]
    rows: list[tuple[Cell, ...]] = []
    for model, row in zip(trials, left, strict=True):
        first, *more = _name_lines(model.groups)
        mark = '*' if model.is_chosen else '~' if model.is_near else ''
        rows.append((mark, *(row[k] for k in kept), first))
        rows += [('', *[''] * len(kept), line) for line in more]
    out.table(
        ('', *names, 'model'), rows, title='RMS error of each model on data left out of it, in ug'
    )
    for name in names:
        out.line(f'{name}: {columns[name]}')
    out.line('*: chosen; ~: worse than * by at most a standard error; +: curve plus groups')


def _name_lines(groups: tuple[str, ...]) -> list[str]:
    """
    Name a model by its groups, without a leading `curve` before other groups; break a long name
    before a group, so that the table fits 80 columns.
    """
    name = '+'.join(groups) or 'constants'
    if len(groups) > 1:
        name = name.removeprefix('curve')
    lines = ['']
    for part in re.split(r'(?=\+)', name):
        if len(lines[-1]) + len(part) > _MODEL_WIDTH:
            lines.append('  ')
        lines[-1] += part
    return lines


def _model(trial: 'Trial') -> dict[str, Any]:
    names = ('positions', 'sections', 'norms')
    left_out = {name: folds.rms for name, folds in zip(names, trial.score.kinds, strict=True)}
    kept = picked(trial, 'groups is_chosen is_near')
    return {**kept, 'left_out_rms_m_s2': left_out}


def _of_axes(values: Iterable[float], shown: Callable[[float], str | None]) -> str:
    return ' '.join(str(shown(value)) for value in values)


def _steps(
    rows: Iterable[Any], steps: Iterable[str], shown: Callable[[float], str | None], axes: int = 1
) -> list[tuple[Cell, ...]]:
    """Return a table row per section: number of windows, RMS residual of each of `steps`."""
    return [
        (row.section, row.fitted.n // axes, *(shown(getattr(row, x).rms) for x in steps))
        for row in rows
        if row.fitted.n
    ]
