# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit as a whole: sources in, calibration with its evidence out.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import FitError
from ..text import valid_serial
from ..thermal.settings import DetectorSettings, ThermalConfig
from ..unit.calibration import Calibration, Unit
from ..unit.gravity import STANDARD_GRAVITY
from .assembly import UNKNOWN_SKEW, UnitFacts, build_calibration
from .evidence import (
    PositionReport,
    ResidualRow,
    noise_density,
    position_reports,
    residual_rows,
    slow_error,
)
from .history import ThermalHistory, thermal_history
from .ladder import model_spec
from .options import COUNTS_FULL_SCALE, FitOptions
from .reduction import ReducedBag, reduce_source
from .regression import Freedom, Outcome, regress
from .rests import judge_rests
from .selection import Candidate, Selector
from .sensors import learn_detector
from .solution import Solution
from .sources import FitSource
from .start import ConstantCalibration, constant_calibration, position_means
from .table import WindowTable, window_table
from .two_sets import even_handed
from .verdict import (
    POSITIONS_FOR_MISALIGNMENT,
    POSITIONS_NEEDED,
    Finding,
    can_tell_misalignment,
    enforce,
    judge_bags,
    judge_result,
    judge_table,
)
from .warm_up import find_warm_up

Progress = Callable[[str, float], None]

# Usual full scales of units that report m/s^2.
_G_RANGES = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
# Stands in where the bags do not tell how far the board lags behind the case.
_USUAL_BOARD_LAG_S = 900.0


@dataclass(frozen=True)
class FitResult:
    """
    A fit and its evidence.

    Parameters
    ----------
    calibration : Calibration
        The result.
    solution : Solution
        The estimates behind it, with the attitudes.
    outcome : Outcome
        The regression's end.
    candidates : tuple of Candidate
        The models that were tried, smallest first.
    residuals : tuple of ResidualRow
        Over the windows of the fit.
    positions : tuple of PositionReport
        The still intervals.
    findings : tuple of Finding
        What the data lacked, or not.
    table : WindowTable
        The windows.
    bags : tuple of ReducedBag
        The reduced bags.

    """

    calibration: Calibration
    solution: Solution
    outcome: Outcome
    candidates: tuple[Candidate, ...]
    residuals: tuple[ResidualRow, ...]
    positions: tuple[PositionReport, ...]
    findings: tuple[Finding, ...]
    table: WindowTable
    bags: tuple[ReducedBag, ...]


def fit(
    sources: Sequence[FitSource], options: FitOptions, progress: Progress | None = None
) -> FitResult:
    """
    Fit a calibration to bags of a thermal test.

    Parameters
    ----------
    sources : sequence of FitSource
        The bags, each streamed once.
    options : FitOptions
        What the user said.
    progress : callable, optional
        Told a stage's name and how far the whole is, 0..1.

    Returns
    -------
    FitResult
        Calibration and evidence.

    Raises
    ------
    FitError
        If the data cannot carry the fit.

    """
    tell = progress or _no_progress
    check_serial(sources, options)
    return fit_bags(reduce_sources(sources, options, tell), options, tell)


def fit_bags(
    bags: Sequence[ReducedBag], options: FitOptions, progress: Progress | None = None
) -> FitResult:
    """
    Fit a calibration to bags that have been reduced, by whomever.

    Parameters
    ----------
    bags : sequence of ReducedBag
        One per bag; each interval's number of the bag is its place here.
    options : FitOptions
        What the user said; the lengths are those of the reduction.
    progress : callable, optional
        Told a stage's name and how far the whole is, 0..1.

    Returns
    -------
    FitResult
        Calibration and evidence.

    Raises
    ------
    FitError
        If the data cannot carry the fit.

    """
    tell = progress or _no_progress
    detector = options.detector or learn_detector(bags)
    histories = []
    for number, bag in enumerate(bags):
        tell('temperatures', 0.6 + 0.1 * number / len(bags))
        histories.append(history_of(bag, detector, options))
    table = window_table(bags, histories, options.reference_temperature)
    return _fit_table(table, bags, detector, options, tell)


def reduce_sources(
    sources: Sequence[FitSource], options: FitOptions, progress: Progress
) -> list[ReducedBag]:
    """
    Stream all sources into their sufficient statistics.

    Parameters
    ----------
    sources : sequence of FitSource
        The bags.
    options : FitOptions
        Lengths and full scale.
    progress : callable
        Told how far it is.

    Returns
    -------
    list of ReducedBag
        One per source.

    Raises
    ------
    FitError
        If there is no source, or one has no samples, no still interval or no board temperature.

    """
    if not sources:
        raise FitError('no bag was given')
    bags = []
    for number, source in enumerate(sources):
        progress('reading', 0.6 * number / len(sources))
        bags.append(reduce_bag(source, number, options))
    return bags


def reduce_bag(source: FitSource, number: int, options: FitOptions) -> ReducedBag:
    """
    Stream one source into its sufficient statistics.

    Parameters
    ----------
    source : FitSource
        The bag.
    number : int
        Its place among the bags of the fit.
    options : FitOptions
        Lengths and full scale.

    Returns
    -------
    ReducedBag
        With all that a fit needs.

    Raises
    ------
    FitError
        If it has no samples, no still interval or no board temperature.

    """
    full_scale = options.full_scale
    if full_scale is None and options.input == 'counts':
        full_scale = COUNTS_FULL_SCALE
    bag = reduce_source(
        source,
        number,
        window_s=options.window_s,
        cell_s=options.cell_s,
        min_still_s=options.min_still_s,
        full_scale=full_scale,
    )
    if not bag.n_samples:
        raise FitError(f'{source.name}: no accelerometer samples')
    if not len(bag.board.value):
        raise FitError(f'{source.name}: no board temperature; a thermal fit needs it')
    if not bag.intervals:
        raise FitError(
            f'{source.name}: no still interval of {options.min_still_s:g} s; the unit must '
            'rest in each position'
        )
    return bag


def history_of(bag: ReducedBag, detector: DetectorSettings, options: FitOptions) -> ThermalHistory:
    """
    Run the thermal tracker over one bag, as the node would with these options.

    """
    config = ThermalConfig(transition_time_s=options.transition_time_s)
    return thermal_history(bag, detector, options.window_s / 5.0, config)


def _fit_table(
    table: WindowTable,
    bags: Sequence[ReducedBag],
    detector: DetectorSettings,
    options: FitOptions,
    tell: Progress,
) -> FitResult:
    findings = list(enforce(judge_bags(bags, options), options))
    findings += enforce(judge_rests(bags, options), options)
    constant, table_findings = first_guess(table, bags, options)
    findings += enforce(table_findings, options)
    tells_misalignment = bool(np.any(constant.misalignment != np.eye(3)))
    longest = max(len(history.board) * history.step_s for history in table.histories)
    freedom = Freedom(
        misalignment=options.misalignment is not False,
        skew_sd=np.inf if tells_misalignment else UNKNOWN_SKEW,
        time_constant_range_s=(2.0 * options.window_s, max(longest / 2.0, 4.0 * options.window_s)),
    )
    coarse = table.coarsened(_selection_window(table, options))
    tell('models', 0.7)
    warm_up = find_warm_up(coarse, options.gravity, constant, freedom)
    if warm_up is not None:
        findings.append(warm_up.finding())
        table = table.select(table.time >= warm_up.cut_s).renumbered()
        coarse = table.coarsened(_selection_window(table, options))
    n_tried = 0

    def trying(_name: str) -> None:
        nonlocal n_tried
        n_tried += 1
        tell('models', min(0.7 + 0.01 * n_tried, 0.95))

    transient_s = warm_up.time_constant_s if warm_up is not None else None
    selector = Selector(coarse, options.gravity, constant, freedom, trying, transient_s)
    if options.model == 'auto':
        name = selector.choose()
    else:
        name = selector.try_model(model_spec(options.model, coarse)).spec.name
    tell('regression', 0.95)
    chosen = _refined(table, selector, name, freedom)
    one_set = _refined(table, selector, 'quadratic', freedom)
    slow = slow_error(table, chosen)
    if not tells_misalignment:
        chosen, one_set = without_misalignment(chosen), without_misalignment(one_set)
    residuals = residual_rows(table, chosen.solution, one_set.solution)
    findings += judge_result(chosen.solution, residuals, slow, options)
    facts = UnitFacts(
        _unit(bags, options), noise_density(table, bags, chosen), board_lag(table), slow
    )
    try:
        calibration = build_calibration(
            chosen,
            table,
            bags,
            detector,
            facts,
            options.reference_temperature,
            residuals,
            findings,
        )
    except ValueError as error:
        raise FitError(f'these data give no calibration that can be used: {error}') from error
    return FitResult(
        calibration=calibration,
        solution=chosen.solution,
        outcome=chosen,
        candidates=selector.table_of(name),
        residuals=residuals,
        positions=position_reports(table, bags, chosen.solution),
        findings=tuple(findings),
        table=table,
        bags=tuple(bags),
    )


def _selection_window(table: WindowTable, options: FitOptions) -> float:
    """
    Length of the windows that candidates are compared on: some twenty of them per position.

    """
    spans = [float(np.ptp(table.time[rows])) for rows in table.position_slices()]
    wanted = min(options.selection_window_s, float(np.median(spans)) / 20.0)
    return max(wanted, options.window_s)


def first_guess(
    table: WindowTable, bags: Sequence[ReducedBag], options: FitOptions
) -> tuple[ConstantCalibration, list[Finding]]:
    """
    Fit the triad without temperature, and judge what the windows cover.

    Parameters
    ----------
    table : WindowTable
        The windows.
    bags : sequence of ReducedBag
        Where they come from.
    options : FitOptions
        Whether M is wanted.

    Returns
    -------
    ConstantCalibration
        First guess; M is the identity when it is not to be estimated.
    list of Finding
        Findings.

    Raises
    ------
    FitError
        If there are fewer positions than anything can be fitted to.

    """
    n = table.n_positions
    if n < POSITIONS_NEEDED:
        raise FitError(
            f'{n} still positions, need {POSITIONS_NEEDED} for bias and scale and '
            f'{POSITIONS_FOR_MISALIGNMENT} for the misalignment'
        )
    means = position_means(table)
    box = constant_calibration(means, options.gravity, with_misalignment=False)
    force = box.force(means)
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    wanted = can_tell_misalignment(up) if options.misalignment is None else options.misalignment
    has_case = all(len(bag.case.value) for bag in bags)
    findings = judge_table(table, up, wanted, has_case)
    if not wanted and options.misalignment is None:
        findings.append(
            Finding(
                'misalignment',
                'advice',
                'these positions identify bias and scale only, M stays the identity; it needs '
                f'{POSITIONS_FOR_MISALIGNMENT} well spread ones',
            )
        )
    if not wanted:
        return box, findings
    return constant_calibration(means, options.gravity, with_misalignment=True), findings


def without_misalignment(outcome: Outcome) -> Outcome:
    """
    Publish the identity for an M that the positions cannot tell.

    It was free within what a triad's M may be, lest it be taken for drift: the covariance of the
    other parameters keeps that doubt.

    """
    return replace(
        outcome,
        solution=replace(outcome.solution, skew=np.zeros(3)),
        layout=replace(outcome.layout, skew=np.full(3, -1)),
    )


def _refined(table: WindowTable, selector: Selector, name: str, freedom: Freedom) -> Outcome:
    """
    Repeat a candidate's fit on the fine windows, from where the coarse ones left it.

    """
    trial = selector.try_model(model_spec(name, table))
    return even_handed(table, regress(table, trial.outcome.solution, freedom), freedom)


def board_lag(table: WindowTable) -> float:
    """
    Time constant of the board behind the case: slope of the gradient over the board's rate.

    """
    rate = table.rate - np.mean(table.rate)
    power = float(rate @ rate)
    lag = float(rate @ table.gradient) / power if power > 0.0 else np.nan
    return lag if 1.0 <= lag <= 1e5 else _USUAL_BOARD_LAG_S


def check_serial(sources: Sequence[FitSource], options: FitOptions) -> str:
    """
    Find the unit's serial.

    Parameters
    ----------
    sources : sequence of FitSource
        The bags.
    options : FitOptions
        Its serial wins.

    Returns
    -------
    str
        The serial; ``unknown`` when nothing says it.

    Raises
    ------
    FitError
        If the bags name different units and the user none, or the serial is none.

    """
    serials = {source.serial for source in sources if source.serial}
    if options.serial is None and len(serials) > 1:
        raise FitError(f'the bags are of different units: {", ".join(sorted(serials))}')
    try:
        return valid_serial(options.serial or (serials.pop() if serials else 'unknown'))
    except ValueError as mistake:
        raise FitError(str(mistake)) from mistake


def _unit(bags: Sequence[ReducedBag], options: FitOptions) -> Unit:
    serial = check_serial([bag.source for bag in bags], options)
    full_scale = options.full_scale
    if full_scale is None and options.input == 'counts':
        full_scale = COUNTS_FULL_SCALE
    if full_scale is None:
        largest = max(float(np.abs(i.mean).max()) for bag in bags for i in bag.intervals)
        full_scale = next(
            (r * STANDARD_GRAVITY for r in _G_RANGES if r * STANDARD_GRAVITY > 1.1 * largest),
            2.0 * largest,
        )
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    return Unit(serial, options.input, full_scale, cycle)


def _no_progress(_stage: str, _part: float) -> None:
    return None
