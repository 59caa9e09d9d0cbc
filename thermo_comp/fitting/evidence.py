# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a fit shows for itself: positions, residuals before and after, what is left unexplained.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from .reduction import ReducedBag, StillInterval
from .regression import Outcome
from .solution import Solution, correct, regressors, warming_up
from .table import WindowTable

# Slow errors are told from white noise by what averaging over so many windows takes away.
_BLOCK = 6
_LONG_BLOCK_S = 900.0


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


def residual_rows(
    table: WindowTable, fitted: Solution, one_set: Solution
) -> tuple[ResidualRow, ...]:
    """
    Compare raw, one set and the fitted sets on the same windows.

    Parameters
    ----------
    table : WindowTable
        The windows.
    fitted, one_set : Solution
        The chosen model, and one quadratic set.

    Returns
    -------
    tuple of ResidualRow
        Static, dynamic, all.

    """
    bias, scale = reference_constants(table, fitted)
    raw = (table.mean - warming_up(table, fitted) - bias) / scale @ fitted.misalignment.T
    by_model = [statistics_by_regime(norm_residual(raw, fitted.gravity), table.is_dynamic)]
    for solution in (one_set, fitted):
        residual = norm_residual(corrected(table, solution), fitted.gravity)
        by_model.append(statistics_by_regime(residual, table.is_dynamic))
    return tuple(
        ResidualRow(section, *(model[section] for model in by_model))
        for section in ('static', 'dynamic', 'all')
    )


def corrected(table: WindowTable, solution: Solution) -> Floats:
    """
    Correct a table's windows with a solution, shape (n, 3).

    """
    columns = regressors(table, solution.spec, solution.time_constants_s, solution.start_memory)
    return correct(table, solution, columns)


def reference_constants(table: WindowTable, solution: Solution) -> tuple[Floats, Floats]:
    """
    Bias and scale at the reference temperature in still air.

    A unit that heats itself has a gradient in still air, too; the level of a model with a
    gradient term alone is no state that the unit is ever in.

    Parameters
    ----------
    table : WindowTable
        Gives the gradient in still air.
    solution : Solution
        The estimates.

    Returns
    -------
    bias, scale : ndarray, shape (3,)
        Input units; input units per m/s^2.

    """
    spec = solution.spec
    bias, scale = solution.bias[:, 0].copy(), solution.scale[:, 0].copy()
    if spec.gradient and spec.live == 'both':
        calm = np.abs(table.rate) <= np.quantile(np.abs(table.rate), 0.1)
        gradient = float(np.median(table.gradient[calm]))
        behind = spec.rate + spec.n_lags + 1
        bias += gradient * solution.bias[:, -behind]
        scale += gradient * solution.scale[:, -behind]
    return bias, scale


def position_reports(
    table: WindowTable, bags: Sequence[ReducedBag], solution: Solution
) -> tuple[PositionReport, ...]:
    """
    List the positions of a table with what the fit left on each.

    Parameters
    ----------
    table : WindowTable
        The windows.
    bags : sequence of ReducedBag
        Where they come from.
    solution : Solution
        The estimates.

    Returns
    -------
    tuple of PositionReport
        In order.

    """
    residual = norm_residual(corrected(table, solution), solution.gravity)
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


def slow_error(table: WindowTable, outcome: Outcome) -> Floats:
    """
    Split what is left into white noise and a slow part, and return the slow part.

    Averaging over m windows divides the variance of white noise by m and leaves a slow error as
    it is: ``v(1) = s^2 + w^2`` and ``v(m) = s^2 + w^2 / m``.

    Parameters
    ----------
    table : WindowTable
        The windows.
    outcome : Outcome
        The regression.

    Returns
    -------
    ndarray, shape (2, 3)
        Standard deviation of the slow error per regime and axis [m/s^2].

    """
    scale = np.abs(outcome.solution.scale[:, 0])
    residual = outcome.residual / scale
    result = np.zeros((2, 3))
    dynamic = table.is_dynamic
    for regime, wanted in enumerate((~dynamic, dynamic)):
        single, block = _variances(table, residual, wanted, _BLOCK)
        if block is None:
            single, block = _variances(table, residual, np.ones_like(wanted), _BLOCK)
        if block is not None:
            square = (_BLOCK * block - single) / (_BLOCK - 1)
            result[regime] = np.sqrt(np.maximum(square, 0.0))
    return result


def noise_density(table: WindowTable, bags: Sequence[ReducedBag], outcome: Outcome) -> Floats:
    """
    White noise of the specific force as a density, from the scatter of the window means.

    This is the noise that an integrating filter meets. A converter that carries its remainder
    scatters more from sample to sample, but that part cancels in a sum.

    Parameters
    ----------
    table : WindowTable
        The windows.
    bags : sequence of ReducedBag
        Their cycle, and the samples' scatter where the windows are too few.
    outcome : Outcome
        The regression.

    Returns
    -------
    ndarray, shape (3,)
        [m/s^2/sqrt(Hz)].

    """
    scale = np.abs(outcome.solution.scale[:, 0])
    cycle = float(np.median([bag.cycle_s for bag in bags]))
    everything = np.ones(len(table.time), dtype=bool)
    single, block = _variances(table, outcome.residual / scale, everything, 2)
    if block is None:
        samples = [interval.sample_sd for bag in bags for interval in bag.intervals]
        density = np.median(samples, axis=0) / scale * np.sqrt(cycle)
    else:
        # Pairs: v(1) - v(2) = w^2 / 2.
        white = 2.0 * np.maximum(single - block, 0.0)
        density = np.sqrt(white * float(np.median(table.count)) * cycle)
    return np.asarray(np.maximum(density, 1e-9))


def inflation(table: WindowTable, outcome: Outcome) -> Floats:
    """
    Tell by how much correlated residuals make the covariance of white ones too small.

    Means over long blocks of white residuals have the variance of one divided by their number;
    what they have more is what the parameters' variance lacks.

    Parameters
    ----------
    table : WindowTable
        The windows.
    outcome : Outcome
        The regression.

    Returns
    -------
    ndarray, shape (3,)
        Factor of each axis' covariance, at least 1.

    """
    steps = np.diff(table.time)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else _LONG_BLOCK_S
    size = max(2, round(_LONG_BLOCK_S / usual))
    # The regression took the means of each position and more out: as many blocks are not free.
    residual = outcome.residual
    while size >= 2:
        single, block = _variances(table, residual, np.ones(len(residual), bool), size)
        if block is not None:
            return np.maximum(1.0, size * block / np.maximum(single, 1e-300))
        size //= 2
    return np.ones(3)


def _variances(
    table: WindowTable, residual: Floats, wanted: Bools, size: int
) -> tuple[Floats, Floats | None]:
    """
    Mean squares of single windows and of block means; None when there are too few blocks.

    """
    singles, means = [], []
    for rows in table.position_slices():
        part = residual[rows][wanted[rows]]
        n = len(part) // size
        if n:
            part = part[: n * size]
            singles.append(part)
            means.append(part.reshape(n, size, 3).mean(axis=1))
    if sum(map(len, means)) < 10:
        return np.mean(residual**2, axis=0), None
    single, block = np.concatenate(singles), np.concatenate(means)
    return _trimmed_square(single), _trimmed_square(block)


def _trimmed_square(values: Floats) -> Floats:
    """
    Mean square with outliers pulled in to 4 robust sd.

    """
    limit = 4.0 * 1.4826 * np.median(np.abs(values), axis=0)
    return np.asarray(np.mean(np.clip(values, -limit, limit) ** 2, axis=0))
