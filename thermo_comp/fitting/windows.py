# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the windows: reduced bags in, the regression's table of samples and columns out.

The thermal tracker that the compensator runs is run here over the bags' readings, and the columns
are those of `unit.columns`, so a regressor means in the fit what it means online.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import FitError
from ..thermal.memory import MemorySpec, memory_on_grid, start_covariance
from ..thermal.settings import DetectorSettings, ThermalConfig
from ..thermal.state import BOARD, GRADIENT, RATE, VAR_BOARD, WEIGHT, Layout
from ..thermal.tracker import ThermalTracker
from ..typing import Bools, Floats, Ints
from ..unit.columns import Column, ColumnTable, memory_of
from ..unit.functions import TemperatureFunction
from .reduction import ReducedBag, StillInterval
from .sensors import thermal_states
from .unknowns import Windows

# Neighbouring windows of a position are merged up to this length [s].
_WINDOW_S = 60.0
#: Groups of the sets themselves, beside those of the response.
CURVE, SET, BEND = 'curve', 'set', 'bend'
#: A short rest still has so many windows: from less, no noise is learnt.
FEWEST_WINDOWS = 20
#: A position is cut into so many sections of equal length; chamber programs repeat over bags, so
#: these are sections of the program.
N_SECTIONS = 6
# After this every lag has forgotten how it began [s].
_EVER_S = 1e9


@dataclass(frozen=True)
class Sets:
    """
    How the curves of the two sets are made.

    static, dynamic: the families and their shapes; only `basis` counts
    is_shared: whether the dynamic curve is the static one plus a difference: else each has its own
    """

    static: TemperatureFunction
    dynamic: TemperatureFunction
    is_shared: bool = True

    def columns(self, t: Floats, weight: Floats) -> list[Floats]:
        """Evaluate the columns of the sets."""
        static, dynamic = self.static.basis(t), self.dynamic.basis(t)
        if not self.is_shared:
            static = [(1.0 - weight) * value for value in static]
        return [*static, weight, *(weight * value for value in dynamic)]

    @property
    def families(self) -> tuple[TemperatureFunction, TemperatureFunction]:
        """Return the families of the two sets: a sum is of the higher order."""
        is_higher = self.is_shared and self.static.n_free > self.dynamic.n_free
        return self.static, self.static if is_higher else self.dynamic

    def levels(self) -> list[tuple[str, bool]]:
        """Group of each column, and whether it is a level."""
        curve = [(CURVE, False)] * self.static.n_free
        return [*curve, (SET, True), *[(SET, False)] * self.dynamic.n_free]


@dataclass(frozen=True)
class Model:
    """
    What is fitted: curves and columns, and how the states are told that they follow.

    name: for the provenance
    sensors: thermometers beside the board; the first leads, the others stay where they are of use
    """

    name: str
    sets: Sets
    columns: tuple[Column, ...]
    sensors: tuple[str, ...]
    detector: DetectorSettings
    reference_temperature: float


@dataclass(frozen=True)
class ThermalWindows:
    """
    The regression's windows, and what the calibration says of the states they were taken in.

    model: what the columns are of
    data: samples and columns, for the regression
    temperature, rate, weight: board temperature, its rate, weight of the dynamic set, shape (n,)
    gradient: T - T_board of the sensor that leads, shape (n,)
    raw: the response's columns before powers of t and ranges, shape (n, k)
    angular_rate: mean of it [rad/s], shape (n, 3); (n, 0) where a bag lacks it
    typical_count: samples in a typical window
    rests: the bag and the interval of each position
    """

    model: Model
    data: Windows
    temperature: Floats
    rate: Floats
    weight: Floats
    gradient: Floats
    raw: Floats
    angular_rate: Floats
    typical_count: float
    rests: tuple[tuple[ReducedBag, StillInterval], ...] = ()

    @property
    def was_measured(self) -> bool:
        """Whether any temperature was recorded: else the first curve's column, t, is 0."""
        return self.has_temperature or bool(self.data.columns[:, 0].any())

    @property
    def has_temperature(self) -> bool:
        """Whether any change of temperature was recorded."""
        return bool(np.ptp(self.temperature) > 0.0)


def thermal_windows(bags: Sequence[ReducedBag], model: Model) -> ThermalWindows:
    """
    Join the windows of all bags with the columns of their thermal state.

    Windows before the board's first reading, while its estimate is still settling, and where a
    thermometer is lost are left out. A bag without any temperature stands at the reference, where
    no column says anything.
    """
    sets, columns, reference = model.sets, model.columns, model.reference_temperature
    spec = memory_of(columns, model.sensors)
    table = ColumnTable(columns, spec, reference)
    parts: list[tuple[Floats, ...]] = []
    numbers: list[tuple[Ints, Ints]] = []
    groups = [group for group, _ in sets.levels()]
    rests: list[tuple[ReducedBag, StillInterval]] = []
    has_rate = all(one.angular_rate is not None for bag in bags for one in bag.intervals)
    for bag, reduced in enumerate(bags):
        grid, states, is_known = _states(reduced, spec, model)
        for interval in reduced.intervals:
            use = np.interp(interval.time, grid, is_known, left=0.0) == 1.0
            if not use.any():
                continue
            time, count = interval.time[use], interval.count[use]
            at = np.array([np.interp(time, grid, column) for column in states.T])
            board, weight = at[BOARD], at[WEIGHT]
            raw = table.raw(at)
            curves = sets.columns(board - reference, weight)
            factors, _ = table.factors(board, weight)
            moved = _moved(table, table.slopes(at) * factors, time - grid[0])
            rows = np.array(
                [board, at[RATE], weight, at[GRADIENT], *raw, *curves, *(raw * factors), *moved]
            ).T
            if has_rate and interval.angular_rate is not None:
                rows = np.hstack((rows, interval.angular_rate[use]))
            merged = _merged(time, count, interval.mean[use], rows)
            n = len(merged[0])
            parts.append(merged)
            numbers.append((np.full(n, len(rests)), np.full(n, bag)))
            rests.append((reduced, interval))
        if not rests or rests[-1][0] is not reduced:
            said = 'no temperatures while it rests: two clocks?'
            raise FitError(f'{reduced.source.name}: {said}')
    time, count, mean, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
    position, bag_of = (np.concatenate(part) for part in zip(*numbers, strict=True))
    k, m = len(columns), len(groups) + len(columns)
    moved_at, end = 4 + k + m, 4 + k + m + len(columns)
    lag = [spec.lags.index(one.lag) if one.lag and one.kind != 'play' else -1 for one in columns]
    t, gradient = rows[:, 0] - reference, rows[:, 3]
    # A support follows the chamber, linearly and not: partly the board, partly what is around it.
    tilt = np.column_stack((t, gradient, (t + gradient) ** 2))
    tilt_rms = np.sqrt(np.mean(tilt**2, axis=0))
    is_tilting = tilt_rms > 0.0
    values = rows[:, 4 + k : moved_at]
    data = Windows(
        position=position,
        bag=bag_of,
        section=_sections(position, time),
        time=time,
        weight=count / float(np.median(count)),
        mean=mean,
        columns=values,
        groups=(*groups, *(column.group for column in columns)),
        lag=np.array([-1] * len(groups) + lag, dtype=np.int64),
        kelvins=_kelvins(sets, columns, values, rows[:, 4 : 4 + k], t, gradient),
        start=np.hstack((np.zeros((len(time), len(groups))), rows[:, moved_at:end])),
        start_covariance=start_covariance(spec.lags),
        # Fc is 1 at the reference in either regime, so the scale has no level of its own there;
        # a play or a bend in the scale has never been seen.
        in_scale=np.array(
            [not (group == SET and is_level) for group, is_level in sets.levels()]
            + [column.kind not in ('play', 'bend') for column in columns]
        ),
        tilt=tilt[:, is_tilting] / tilt_rms[is_tilting],
    )
    return ThermalWindows(
        model,
        data,
        temperature=rows[:, 0],
        rate=rows[:, 1],
        weight=rows[:, 2],
        gradient=rows[:, 3],
        raw=rows[:, 4 : 4 + k],
        angular_rate=rows[:, end:],
        typical_count=float(np.median(count)),
        rests=tuple(rests),
    )


def _sections(position: Ints, time: Floats) -> Ints:
    """Return the number of the section of each window in its position, shape (n,)."""
    first = np.searchsorted(position, np.arange(int(position[-1]) + 1))
    last = np.append(first[1:], len(position)) - 1
    begin, end = time[first][position], time[last][position]
    part = (time - begin) / np.maximum(end - begin, 1e-9)
    return np.asarray(np.minimum((part * N_SECTIONS).astype(np.int64), N_SECTIONS - 1))


def _kelvins(
    sets: Sets, columns: Sequence[Column], values: Floats, raw: Floats, t: Floats, gradient: Floats
) -> Floats:
    """
    Say for which temperature change the RMS of each column stands [K], shape (m,): the RMS over
    the steepest slope that the column has in these data. It is 0 where a column never moved.
    """
    farthest = float(np.abs(t).max(initial=0.0))
    flow = float(np.sqrt(np.mean(gradient**2))) or 1.0
    grid = np.linspace(float(t.min()), float(t.max()) + 1e-9, 100)
    curves = sets.columns(grid, np.full_like(grid, 0.5))
    slopes = [float(np.abs(np.gradient(one, grid)).max()) for one in curves]
    rms = np.sqrt(np.mean(values**2, axis=0))
    # The level of a set is of the size of what else tells ramps from soaks: a gradient.
    levels = [is_level for _, is_level in sets.levels()]
    steepest = [1.0 / flow if lev else one for lev, one in zip(levels, slopes, strict=True)]
    for column, own in zip(columns, raw.T, strict=True):
        steepest.append(column.steepest(own, flow) * farthest**column.power)
    slope = np.array(steepest)
    return np.where(slope > 0.0, rms / np.where(slope > 0.0, slope, 1.0), 0.0)


def _states(bag: ReducedBag, spec: MemorySpec, model: Model) -> tuple[Floats, Floats, Bools]:
    """Run the tracker: grid from its first reading, states, where they are known."""
    if not len(bag.board.value):
        # Nothing is known: a unit that has always been at the reference.
        still = np.zeros((2, Layout(spec).width))
        still[:, BOARD] = model.reference_temperature
        ends: Floats = np.array([-_EVER_S, 1.0 + (bag.end_ns - bag.start_ns) * 1e-9])
        return ends, still, np.ones(2, dtype=bool)
    tracker = ThermalTracker(model.detector, MemorySpec(spec.sensors), ThermalConfig())
    shortest = min(
        (float(np.median(np.diff(i.time))) for i in bag.intervals if len(i.time) > 1), default=1.0
    )
    step_s = max(shortest / 5.0, 0.1)
    start_s, states, is_known = thermal_states(bag, tracker, step_s)
    grid = np.asarray(start_s + step_s * np.arange(len(states)), dtype=np.float64)
    # The memory is the tracker's, on the grid at once: reading by reading it takes longer than all
    # the rest of a fit.
    gradients = [states[:, GRADIENT + 2 * k] for k in range(len(spec.sensors))]
    memory = memory_on_grid(spec, step_s, states[:, BOARD], gradients)
    states = np.hstack((states, memory))
    settled = states[:, VAR_BOARD] <= 4.0 * np.median(states[:, VAR_BOARD])
    is_known[: int(np.argmax(settled))] = False
    return grid, states, is_known


def _moved(table: ColumnTable, slopes: Floats, age_s: Floats) -> Floats:
    """Differentiate each column by the start state of its lag, shape (k, n)."""
    result = np.zeros_like(slopes)
    for k, column in enumerate(table.columns):
        if column.lag and column.kind != 'play':
            _, tau = column.lag
            result[k] = slopes[k] * np.exp(-age_s / tau)
    return result


def _merged(
    time: Floats, count: Floats, mean: Floats, rows: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Count-weighted means of neighbours up to a length, or to a part of a short rest."""
    window_s = min(_WINDOW_S, float(time[-1] - time[0]) / (FEWEST_WINDOWS - 1) or _WINDOW_S)
    slot = np.floor((time - time[0]) / window_s * (1.0 + 1e-9))
    first = np.flatnonzero(np.r_[True, np.diff(slot) != 0])
    total = np.add.reduceat(count, first)

    def averaged(values: Floats) -> Floats:
        summed = np.add.reduceat(values * count[:, None], first, axis=0)
        return np.asarray(summed / total[:, None])

    return averaged(time[:, None])[:, 0], total, averaged(mean), averaged(rows)
