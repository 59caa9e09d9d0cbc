# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the reassessment of a calibration on new bags: does it still hold, and what has moved.

The norm needs no attitude: ``|f| - g`` is compared with what the calibration claims. With enough
positions the corrected data are fitted once more by nine constants; what they differ from
identity by is the shift of each axis since the calibration, with its standard deviation.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import FitError
from ..online.status import CompensatorConfig
from ..thermal.settings import ThermalConfig
from ..thermal.tracker import WEIGHT, ThermalTracker
from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.correction import Correction
from ..unit.gravity import MICRO_G
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from .assembly import parameter_covariance
from .evidence import inflation
from .history import thermal_states
from .model import ModelSpec, polynomial
from .reduction import ReducedBag, reduce_source
from .regression import Freedom, Outcome, regress
from .solution import Solution
from .sources import FitSource
from .start import position_means
from .table import WindowTable
from .verdict import POSITIONS_NEEDED, can_tell_misalignment, distinct_directions

#: A calibration holds while its error is within this many times what it claims.
LARGEST_RATIO = 2.0
# A shift must be this sure, and as large as what the calibration claims, to be called one.
_SURE_SDS = 4.0
# Nobody knows a misalignment better than this [rad].
_EXACT_SKEW = 1e-6
_CELL_S, _MIN_STILL_S = 0.5, 3.0


@dataclass(frozen=True)
class AxisShift:
    """
    What one axis differs by from the calibration.

    Parameters
    ----------
    bias, bias_sd : float
        Shift of the bias [m/s^2] and its standard deviation, the calibration's own included.
    scale, scale_sd : float
        Relative shift of the scale, and its standard deviation.

    """

    bias: float
    bias_sd: float
    scale: float
    scale_sd: float


@dataclass(frozen=True)
class AssessmentRow:
    """
    ``|f| - g`` of one section of the new bags.

    Parameters
    ----------
    section : str
        ``static``, ``dynamic`` or ``all``.
    raw, corrected : ResidualStatistics
        With the constants at the reference temperature, and with the calibration.
    claimed_sd : float
        Median of the standard deviation that the calibration claims for a window's norm.

    """

    section: str
    raw: ResidualStatistics
    corrected: ResidualStatistics
    claimed_sd: float


@dataclass(frozen=True)
class Assessment:
    """
    Judgement of a calibration on new bags.

    Parameters
    ----------
    rows : tuple of AssessmentRow
        Norm residuals per regime.
    wander : ndarray, shape (2, 3)
        RMS of each axis' specific force about its mean in a position, per regime [m/s^2]: what
        the temperature leaves on that axis, to a constant, for any number of positions.
    shifts : tuple of AxisShift
        Per axis; empty with fewer than six distinct positions.
    n_positions : int
        Distinct positions.
    ratio : float
        RMS of each window's norm residual over the standard deviation claimed for it.
    is_valid : bool
        Whether the calibration still holds.
    verdict : str
        One line with the numbers.

    """

    rows: tuple[AssessmentRow, ...]
    wander: Floats
    shifts: tuple[AxisShift, ...]
    n_positions: int
    ratio: float
    is_valid: bool
    verdict: str


def assess(
    calibration: Calibration,
    sources: Sequence[FitSource],
    *,
    gravity: float | None = None,
    window_s: float = 60.0,
    config: CompensatorConfig | None = None,
    progress: Callable[[float], None] | None = None,
) -> Assessment:
    """
    Judge a calibration on new bags.

    Parameters
    ----------
    calibration : Calibration
        The unit's calibration.
    sources : sequence of FitSource
        Bags of the same unit, in any number of positions.
    gravity : float or None, optional
        Local gravity where they were recorded; the calibration's by default.
    window_s : float, optional
        Length of a window [s].
    config : CompensatorConfig or None, optional
        The node's settings.
    progress : callable or None, optional
        Told how far it is, 0..1.

    Returns
    -------
    Assessment
        Table, shifts and verdict.

    Raises
    ------
    FitError
        If there is no bag, a bag is of another unit, or it has no still interval with a board
        temperature.

    """
    if not sources:
        raise FitError('no bag was given')
    config = config or CompensatorConfig()
    gravity = calibration.gravity_m_s2 if gravity is None else gravity
    parts: list[_Corrected] = []
    position = 0
    for number, source in enumerate(sources):
        if source.serial not in (None, calibration.unit.serial):
            raise FitError(
                f'{source.name} is of unit {source.serial}, the calibration of '
                f'{calibration.unit.serial}'
            )
        bag = reduce_source(
            source,
            number,
            window_s=window_s,
            cell_s=min(_CELL_S, window_s),
            min_still_s=_MIN_STILL_S,
            full_scale=calibration.unit.full_scale,
        )
        if not bag.intervals or not len(bag.board.value):
            raise FitError(
                f'{source.name}: no still interval with a board temperature to judge by'
            )
        parts.append(_corrected(bag, calibration, config, position, window_s))
        position += len(bag.intervals)
        if progress is not None:
            progress((number + 1) / len(sources))
    return _judged(calibration, gravity, _joined(parts))


@dataclass(frozen=True)
class _Corrected:
    """
    Corrected windows: numbers of position and bag, times, force, claimed variances, weight.

    """

    position: Ints
    bag: Ints
    time: Floats
    count: Floats
    raw: Floats
    force: Floats
    variance: Floats
    weight: Floats


def _corrected(
    bag: ReducedBag,
    calibration: Calibration,
    config: CompensatorConfig,
    first_position: int,
    window_s: float,
) -> _Corrected:
    correction = Correction(calibration)
    thermal = ThermalConfig(
        correction.gentle_transition(config.transition_time_s),
        config.case_timeout_s,
        calibration.board_lag_s,
    )
    tracker = ThermalTracker(calibration.detector, calibration.memory_time_constants_s, thermal)
    step_s = max(window_s / 10.0, 1.0)
    start_s, states = thermal_states(bag, tracker, step_s)
    grid = start_s + step_s * np.arange(len(states))
    M = np.array(calibration.misalignment)
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    K = np.array([axis.scale_factor for axis in axes])
    zero = np.array([axis.bias for axis in axes])
    density = np.array(calibration.noise_density_m_s2_sqrt_hz)
    cycle = calibration.unit.cycle_time_s
    parts = []
    for number, interval in enumerate(bag.intervals):
        use = interval.time >= grid[0]
        time, mean, count = interval.time[use], interval.mean[use], interval.count[use]
        state = tuple(np.interp(time, grid, column) for column in states.T)
        along, variance = np.empty_like(mean), np.empty_like(mean)
        terms = zip(correction.bias_scale(state), correction.variance(state), strict=True)
        for axis, ((bias, scale), (a, b, c)) in enumerate(terms):
            x = (mean[:, axis] - bias) / scale
            along[:, axis] = x
            # The noise of one sample becomes that of the window's mean.
            slow = a + b * x + c * x * x - density[axis] ** 2 / cycle
            variance[:, axis] = np.maximum(slow, 0.0) + density[axis] ** 2 / (cycle * count)
        parts.append(
            _Corrected(
                position=np.full(len(time), first_position + number),
                bag=np.full(len(time), interval.bag),
                time=time,
                count=count,
                raw=(mean - zero) / K @ M.T,
                force=along @ M.T,
                variance=variance,
                weight=state[WEIGHT],
            )
        )
    return _joined(parts)


def _joined(parts: Sequence[_Corrected]) -> _Corrected:
    return _Corrected(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in _Corrected.__dataclass_fields__
        }
    )


def _judged(calibration: Calibration, gravity: float, data: _Corrected) -> Assessment:
    if not len(data.time):
        raise FitError('no still window with a board temperature to judge by')
    dynamic = data.weight > 0.5
    up = data.force / np.linalg.norm(data.force, axis=1, keepdims=True)
    claimed = np.sqrt(np.einsum('ni,ni->n', up**2, data.variance))
    raw = statistics_by_regime(norm_residual(data.raw, gravity), dynamic)
    corrected = statistics_by_regime(norm_residual(data.force, gravity), dynamic)
    masks = {'static': ~dynamic, 'dynamic': dynamic, 'all': np.ones_like(dynamic)}
    rows = tuple(
        AssessmentRow(
            name, raw[name], corrected[name],
            float(np.median(claimed[rows])) if rows.any() else np.nan,
        )
        for name, rows in masks.items()
    )  # fmt: skip
    table = _table(data, dynamic)
    means = position_means(table)
    directions = distinct_directions(means / np.linalg.norm(means, axis=1, keepdims=True))
    about = data.force - means[table.position]
    wander = np.array(
        [
            np.sqrt(np.mean(about[rows] ** 2, axis=0)) if rows.any() else np.full(3, np.nan)
            for rows in (~dynamic, dynamic)
        ]
    )
    expected = rows[2].claimed_sd
    # Window by window: while the memory settles a calibration claims little, and is held to it.
    ratio = float(np.sqrt(np.mean((norm_residual(data.force, gravity) / claimed) ** 2)))
    shifts = _shifts(calibration, table, gravity, directions)
    moved = [
        f'{"xyz"[axis]} {what}'
        for axis, shift in enumerate(shifts)
        for what in _significant(shift, expected, gravity)
    ]
    is_valid = ratio <= LARGEST_RATIO and not moved
    numbers = (
        f'{corrected["all"].micro_g.rms:.2g} ug RMS over {len(data.time)} windows, '
        f'{expected / MICRO_G:.2g} ug claimed (ratio {ratio:.1f}, limit {LARGEST_RATIO:g})'
    )
    verdict = f'{"still valid" if is_valid else "re-calibrate"}: {numbers}'
    if moved:
        verdict += '; moved: ' + ', '.join(moved)
    return Assessment(rows, wander, shifts, len(directions), ratio, is_valid, verdict)


def _table(data: _Corrected, dynamic: Bools) -> WindowTable:
    _, position = np.unique(data.position, return_inverse=True)
    zero = np.zeros_like(data.time)
    return WindowTable(
        position=position,
        bag=data.bag,
        section=dynamic.astype(np.int64),
        time=data.time,
        count=data.count,
        mean=data.force,
        t=zero,
        gradient=zero,
        rate=zero,
        weight=dynamic.astype(np.float64),
        histories=(),
    )


def _shifts(
    calibration: Calibration, table: WindowTable, gravity: float, directions: Floats
) -> tuple[AxisShift, ...]:
    """
    Fit the corrected windows by constants once more; empty when the positions are too few.

    """
    if len(directions) < POSITIONS_NEEDED:
        return ()
    spec = ModelSpec('constant', polynomial(0))
    means = position_means(table)
    start = Solution(
        spec=spec,
        gravity=gravity,
        bias=np.zeros((3, 1)),
        scale=np.ones((3, 1)),
        skew=np.zeros(3),
        up=means / np.linalg.norm(means, axis=1, keepdims=True),
        time_constants_s=np.zeros(0),
        start_memory=np.zeros((int(np.max(table.bag)) + 1, 0)),
        noise_sd=np.full((2, 3), 1e-5 * gravity),
    )
    # What the positions cannot tell of M is within what the calibration says of its own.
    known_skew = max(*calibration.misalignment_sd, _EXACT_SKEW)
    freedom = Freedom(skew_sd=np.inf if can_tell_misalignment(directions) else known_skew)
    outcome = regress(table, start, freedom)
    return tuple(_shift(calibration, table, outcome, axis) for axis in range(3))


def _shift(calibration: Calibration, table: WindowTable, outcome: Outcome, axis: int) -> AxisShift:
    covariance = parameter_covariance(outcome) * inflation(table, outcome)[axis]
    place = outcome.layout.axis[axis]
    one = calibration.static.axes()[axis]
    reference = (calibration.axes.x, calibration.axes.y, calibration.axes.z)[axis]
    known_bias = known_scale = 0.0
    if one.covariance:
        at = one.n_bias_parameters
        known_bias = one.covariance[0][0] / reference.scale_factor**2
        known_scale = one.covariance[at][at]
    return AxisShift(
        bias=float(outcome.solution.bias[axis, 0]),
        bias_sd=float(np.sqrt(covariance[place[0], place[0]] + known_bias)),
        scale=float(outcome.solution.scale[axis, 0] - 1.0),
        scale_sd=float(np.sqrt(covariance[place[1], place[1]] + known_scale)),
    )


def _significant(shift: AxisShift, expected: float, gravity: float) -> list[str]:
    said = []
    if abs(shift.bias) > max(_SURE_SDS * shift.bias_sd, expected):
        said.append(f'bias {shift.bias / MICRO_G:+.3g} +- {shift.bias_sd / MICRO_G:.2g} ug')
    if abs(shift.scale) > max(_SURE_SDS * shift.scale_sd, expected / gravity):
        said.append(f'scale {1e6 * shift.scale:+.3g} +- {1e6 * shift.scale_sd:.2g} ppm')
    return said
