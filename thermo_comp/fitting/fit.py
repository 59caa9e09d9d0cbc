# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit as a whole: sources in, calibration with its evidence out.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..calibration import Calibration, ResidualSummary, Unit
from ..errors import FitError
from ..metrics import ResidualStatistics, norm_residual, statistics_by_regime
from ..regime import DetectorSettings
from ..thermal import ThermalConfig
from .assembly import UnitFacts, build_calibration
from .history import ThermalHistory, thermal_history
from .model import ModelSpec, polynomial
from .options import COUNTS_FULL_SCALE, FitOptions
from .reduction import ReducedBag, StillInterval, reduce_source
from .regression import Freedom, Outcome, regress
from .sensors import learn_detector
from .solution import Solution, correct, regressors
from .sources import FitSource
from .start import constant_calibration, position_means, starting_solution
from .table import WindowTable, window_table

Array = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]

# Fewer positions than the nine unknowns of the triad leave M to chance.
_POSITIONS_FOR_MISALIGNMENT = 9
_FEWEST_POSITIONS = 6
# Usual full scales of units that report m/s^2.
_G_RANGES = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
_STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class PositionReport:
    """
    One still interval as the fit saw it.

    Parameters
    ----------
    source : str
        The bag's name.
    start_ns : int
        Stamp of its start.
    duration_s : float
        Length.
    up : tuple of float
        Estimated direction of the specific force, in the output frame.
    residual_rms : float
        RMS of ``|f| - g`` over its windows.

    """

    source: str
    start_ns: int
    duration_s: float
    up: tuple[float, float, float]
    residual_rms: float


@dataclass(frozen=True)
class ResidualRow:
    """
    ``|f| - g`` of one section, uncorrected and corrected.

    Parameters
    ----------
    section : str
        ``static``, ``dynamic`` or ``all``.
    raw : ResidualStatistics
        With the constants at the reference temperature.
    one_set : ResidualStatistics
        With one quadratic set, blind to the regime.
    fitted : ResidualStatistics
        With the calibration.

    """

    section: str
    raw: ResidualStatistics
    one_set: ResidualStatistics
    fitted: ResidualStatistics


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
    residuals : tuple of ResidualRow
        Over the windows of the fit.
    positions : tuple of PositionReport
        The still intervals.
    table : WindowTable
        The windows.
    bags : tuple of ReducedBag
        The reduced bags.

    """

    calibration: Calibration
    solution: Solution
    outcome: Outcome
    residuals: tuple[ResidualRow, ...]
    positions: tuple[PositionReport, ...]
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
    bags = reduce_sources(sources, options, tell)
    detector = options.detector or learn_detector(bags)
    histories = []
    for number, bag in enumerate(bags):
        tell('temperatures', 0.6 + 0.2 * number / len(bags))
        histories.append(history_of(bag, detector, options))
    table = window_table(bags, histories, options.reference_temperature)
    tell('regression', 0.8)
    return _fit_table(table, bags, detector, options)


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
    full_scale = options.full_scale
    if full_scale is None and options.input == 'counts':
        full_scale = COUNTS_FULL_SCALE
    bags = []
    for number, source in enumerate(sources):
        progress('reading', 0.6 * number / len(sources))
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
        bags.append(bag)
    return bags


def history_of(bag: ReducedBag, detector: DetectorSettings, options: FitOptions) -> ThermalHistory:
    """
    Run the thermal tracker over one bag, as the node would with these options.

    """
    config = ThermalConfig(transition_time_s=options.transition_time_s)
    return thermal_history(bag, detector, options.window_s / 5.0, config)


def golovach_spec() -> ModelSpec:
    """
    Give the paper's scheme: static linear, dynamic quadratic.

    """
    return ModelSpec('golovach', polynomial(1), polynomial(2))


def _fit_table(
    table: WindowTable,
    bags: Sequence[ReducedBag],
    detector: DetectorSettings,
    options: FitOptions,
) -> FitResult:
    n_positions = table.n_positions
    if n_positions < _FEWEST_POSITIONS:
        raise FitError(
            f'{n_positions} still positions, need {_FEWEST_POSITIONS} for bias and scale and '
            f'{_POSITIONS_FOR_MISALIGNMENT} for the misalignment'
        )
    with_misalignment = (
        n_positions >= _POSITIONS_FOR_MISALIGNMENT
        if options.misalignment is None
        else options.misalignment
    )
    constant = constant_calibration(position_means(table), options.gravity, with_misalignment)
    freedom = Freedom(misalignment=with_misalignment)

    def run(spec: ModelSpec) -> Outcome:
        start = starting_solution(table, spec, options.gravity, constant, np.zeros(0))
        return regress(table, start, freedom)

    one_set = run(ModelSpec('quadratic', polynomial(2)))
    chosen = run(golovach_spec())
    residuals = residual_rows(table, chosen.solution, one_set.solution)
    density = noise_density(bags, chosen.solution)
    facts = UnitFacts(_unit(bags, options), density, 900.0)
    calibration = build_calibration(
        chosen,
        table,
        bags,
        detector,
        facts,
        options.reference_temperature,
        [
            ResidualSummary(
                row.section, row.fitted.n, row.raw.rms, row.fitted.rms, row.fitted.peak
            )
            for row in residuals
            if row.fitted.n
        ],
    )
    return FitResult(
        calibration=calibration,
        solution=chosen.solution,
        outcome=chosen,
        residuals=residuals,
        positions=position_reports(table, bags, chosen.solution),
        table=table,
        bags=tuple(bags),
    )


def residual_rows(
    table: WindowTable, fitted: Solution, one_set: Solution
) -> tuple[ResidualRow, ...]:
    """
    Compare raw, one set and the fitted sets on the same windows.

    Raw is what the constants at the reference temperature leave: scale factor, bias and M of the
    fitted calibration, no temperature.

    """
    raw = (table.mean - fitted.bias[:, 0]) / fitted.scale[:, 0] @ fitted.misalignment.T
    by_model = [statistics_by_regime(norm_residual(raw, fitted.gravity), table.is_dynamic)]
    for solution in (one_set, fitted):
        columns = regressors(
            table, solution.spec, solution.time_constants_s, solution.start_memory
        )
        force = correct(table, solution, columns)
        by_model.append(
            statistics_by_regime(norm_residual(force, fitted.gravity), table.is_dynamic)
        )
    return tuple(
        ResidualRow(section, *(model[section] for model in by_model))
        for section in ('static', 'dynamic', 'all')
    )


def noise_density(bags: Sequence[ReducedBag], solution: Solution) -> Array:
    """
    White noise of a sample, as a density, from the scatter inside the still cells.

    """
    sample_sd = np.median(
        [interval.sample_sd for bag in bags for interval in bag.intervals], axis=0
    )
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    density = sample_sd / np.abs(solution.scale[:, 0]) * np.sqrt(cycle)
    return np.asarray(np.maximum(density, 1e-12))


def position_reports(
    table: WindowTable, bags: Sequence[ReducedBag], solution: Solution
) -> tuple[PositionReport, ...]:
    """
    List the positions of a table with what the fit left on each.

    """
    columns = regressors(table, solution.spec, solution.time_constants_s, solution.start_memory)
    residual = norm_residual(correct(table, solution, columns), solution.gravity)
    result = []
    for number, rows in enumerate(table.position_slices()):
        bag = bags[int(table.bag[rows.start])]
        interval = _interval_at(bag, float(table.time[rows.start]))
        x, y, z = (float(v) for v in solution.up[number])
        result.append(
            PositionReport(
                source=bag.source.name,
                start_ns=interval.start_ns,
                duration_s=(interval.end_ns - interval.start_ns) * 1e-9,
                up=(x, y, z),
                residual_rms=float(np.sqrt(np.mean(residual[rows] ** 2))),
            )
        )
    return tuple(result)


def _interval_at(bag: ReducedBag, time: float) -> StillInterval:
    starts = [interval.time[0] for interval in bag.intervals]
    return bag.intervals[max(0, int(np.searchsorted(starts, time, side='right')) - 1)]


def _unit(bags: Sequence[ReducedBag], options: FitOptions) -> Unit:
    serials = {bag.source.serial for bag in bags if bag.source.serial}
    if options.serial is None and len(serials) > 1:
        raise FitError(f'the bags are of different units: {", ".join(sorted(serials))}')
    serial = options.serial or (serials.pop() if serials else 'unknown')
    full_scale = options.full_scale
    if full_scale is None and options.input == 'counts':
        full_scale = COUNTS_FULL_SCALE
    if full_scale is None:
        largest = max(float(np.abs(i.mean).max()) for bag in bags for i in bag.intervals)
        full_scale = next(
            (r * _STANDARD_GRAVITY for r in _G_RANGES if r * _STANDARD_GRAVITY > 1.1 * largest),
            2.0 * largest,
        )
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    return Unit(serial, options.input, full_scale, cycle)


def _no_progress(_stage: str, _part: float) -> None:
    return None
