# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of windows and columns of the regression, made from the statistics of bags.

The fit and the compensator use the same thermal tracker and the columns of `unit.columns`, so a
column has the same values in both; if the fit averages temperature readings (`sensors.averaged`),
the values agree within the noise of a reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from math import comb
from typing import NamedTuple

import numpy as np

from ..errors import FitError
from ..thermal.lags import Lag, MemorySpec, start_covariance
from ..thermal.memory import memory_on_grid
from ..thermal.settings import DetectorSettings, ThermalConfig
from ..thermal.state import BOARD, GRADIENT, RATE, VAR_BOARD, WEIGHT, Gradient, StateLayout
from ..thermal.tracker import ThermalTracker
from ..typing import Bools, Floats, Ints
from ..unit.columns import Column, ColumnTable, Part, memory_of
from ..unit.functions import Polynomial, TemperatureFunction
from .initial_triad import block_means
from .reduction import ReducedBag, StillInterval
from .sensors import averaged, readings_in_order
from .unknowns import Windows

#: Groups of columns: the static curve, its difference from the dynamic curve, changes of the slope
#: of the curve at one temperature, and the curves over the temperatures of parts.
CURVE, SET, BEND, PART = 'curve', 'set', 'bend', 'part'
#: `LAGS`: groups of columns linear in a difference of temperatures. `PRODUCTS`: groups of products
#: of a lag and powers of the temperature, and of squares and cubes of a lag. A curve over a part's
#: temperature is a sum of columns of the groups `CURVE`, 'board' and `PRODUCTS`.
LAGS, PRODUCTS = ('gradient', 'board', 'gradient_lag'), ('product', 'square')
#: Number of windows into which a short rest is divided, to determine the noise of the rest.
FEWEST_WINDOWS = 20
#: Number of sections of equal length into which a position is divided. The chamber's program is
#: the same in all positions, so section k is the same part of the program in each position.
N_SECTIONS = 6


@dataclass(frozen=True)
class Sets:
    """
    Function families of the static and the dynamic curve; the functions' coefficients are unused.

    is_shared: whether the fitted dynamic curve is the static curve plus a fitted difference
    """

    static: TemperatureFunction
    dynamic: TemperatureFunction
    is_shared: bool = True

    def columns(self, t: Floats, weight: Floats) -> list[Floats]:
        """Return basis functions of the static and dynamic curves at `t`, each of shape (n,)."""
        static, dynamic = self.static.basis(t), self.dynamic.basis(t)
        if not self.is_shared:
            static = [(1.0 - weight) * value for value in static]
        return [*static, weight, *(weight * value for value in dynamic)]

    @property
    def families(self) -> tuple[TemperatureFunction, TemperatureFunction]:
        """Function families of both curves; if `is_shared`, the dynamic order is >= the static."""
        is_higher = self.is_shared and self.static.n_free > self.dynamic.n_free
        return self.static, self.static if is_higher else self.dynamic

    @property
    def groups(self) -> tuple[str, ...]:
        """Group of each column of the static and the dynamic set."""
        return (CURVE,) * self.static.n_free + (SET,) * (1 + self.dynamic.n_free)

    @property
    def level(self) -> int:
        """Index of the column of the dynamic set's level; its values are the weight of the set."""
        return self.static.n_free


@dataclass(frozen=True)
class Model:
    """
    The model of a fit: curves and columns, and the settings of the thermal state.

    name: name of the model in the provenance
    parts: the lag of the part of each axis, or None in a model without one lag per axis
    sensors: thermometers other than the board's; the first is the case thermometer
    range_c: board temperatures of windows used [degC]; a rest with no window inside is used whole
    """

    name: str
    sets: Sets
    columns: tuple[Column, ...]
    sensors: tuple[str, ...]
    detector: DetectorSettings
    reference_temperature: float
    parts: tuple[Part, Part, Part] | None = None
    range_c: tuple[float, float] = (-np.inf, np.inf)

    @property
    def acts_on(self) -> Bools | None:
        """Axes on which each column of `Windows` acts, shape (m, 3); None if on all axes."""
        if self.parts is None:
            return None
        own = [(part, part.of_gradient) for part in self.parts]
        acts = [[True] * 3] * len(self.sets.groups)
        for column in self.columns:
            acts.append([not column.source.is_of_part or column.part in lags for lags in own])
        return np.vstack((acts, np.eye(3, dtype=bool)[np.arange(len(self.part_sums)) // 3]))

    @cached_property
    def part_sums(self) -> Floats:
        """
        Factors that combine the model's m columns to powers of a part's temperature, (9, m).

        Rows: powers x, x^2, x^3 for axis x, then for y, z. No rows if `parts` is None, if a column
        is missing, or if the sets share no cubic. The temperature of a part less the reference is
        ``x = t - m``: board temperature less reference, less the part's lag m. x^p is a sum of
        t^p, t^(p-1) m, ..., m^p (binomial theorem), so one weight per power describes a curve over
        x. If all bags repeat one warm-up, m is a function of t, and the data would not determine
        separate weights of t^p, t^(p-1) m, ..., m^p.
        """
        static, n_curves = self.sets.static, len(self.sets.groups)
        n_columns = n_curves + len(self.columns)
        has_cubic = isinstance(static, Polynomial) and static.n_free == 3 and self.sets.is_shared
        places = {(c.kind, c.power, c.part): k for k, c in enumerate(self.columns, n_curves)}
        rows = []
        for part, power in product(self.parts or () if has_cubic else (), (1, 2, 3)):
            row = np.zeros(n_columns)
            row[power - 1] = 1.0  # the first columns are t, t^2 and t^3
            # Kinds of the columns with the powers m, m^2 and m^3 of a lag m.
            kinds = ('board', 'square', 'cube')[:power] if part.tau_s else ()
            for k, kind in enumerate(kinds, 1):
                if (place := places.get((kind, power - k, part))) is None:
                    return np.empty((0, n_columns))
                row[place] = comb(power, k) * (-1.0) ** k
            rows.append(row)
        return np.array(rows).reshape(-1, n_columns)


class Track(NamedTuple):
    """
    The thermal states of a tracker over a bag, without states of lags and of hysteresis.

    start_s, step_s: start and step of the time grid [s]
    states: thermal states, shape (n, width); is_known: which states are valid, shape (n,)
    settled_s: time from which the estimate of the board temperature is accurate [s]: before coarse
        readings first change, the estimate may be wrong by the resolution of the readings
    """

    start_s: float
    step_s: float
    states: Floats
    is_known: Bools
    settled_s: float = -np.inf

    @property
    def grid_s(self) -> Floats:
        """Time of each state [s], shape (n,)."""
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.states)))


@dataclass(frozen=True)
class ThermalWindows:
    """
    The windows of a regression with their thermal states.

    data: means of the samples, and columns, for the regression
    temperature, rate, weight: board temperature [degC] and its rate [K/s]; weight of the dynamic
        set; each of shape (n,)
    gradient: T_case - T_board [K], shape (n,)
    raw: values of the response's columns before limits and powers of temperature apply, (n, k)
    angular_rate: mean angular rate [rad/s], shape (n, 3), or (n, 0) if a bag has no angular rate
    typical_count: median number of samples of a window
    rests: bag and interval of each position
    tracks: thermal states of each bag
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
    tracks: tuple[Track, ...] = ()

    @property
    def is_dynamic(self) -> Bools:
        """Whether each window is in the dynamic regime, shape (n,)."""
        return np.asarray(self.weight > 0.5)

    @property
    def static_span(self) -> float:
        """Range of the board temperatures of the static windows [K]."""
        static = self.temperature[~self.is_dynamic]
        return float(np.ptp(static)) if len(static) else 0.0

    @property
    def has_soaks(self) -> bool:
        """Whether >= 5 % of windows are static and they span half the range of temperatures."""
        is_short = self.static_span < 0.5 * float(np.ptp(self.temperature))
        return bool(np.mean(self.is_dynamic) <= 0.95) and not is_short

    @property
    def was_measured(self) -> bool:
        """Whether a board temperature was recorded, even if it is constant over the bags."""
        return self.has_temperature or bool(self.data.columns[:, 0].any())

    @property
    def has_temperature(self) -> bool:
        """Whether the board temperature differs between windows."""
        return bool(np.ptp(self.temperature) > 0.0)


class _Rows(NamedTuple):
    """
    The windows of one rest, or of all rests: one row for each window.

    thermal: board temperature [degC] and variance of its estimate [K^2], rate [K/s], weight of the
        dynamic set, gradient [K], and the k columns `ThermalWindows.raw`, shape (n, 5 + k)
    columns: values of the columns of sets and response, shape (n, m)
    start: derivatives of the k response columns w.r.t. the initial states of their lags, (n, k)
    angular_rate: mean angular rate [rad/s], shape (n, 3) or (n, 0)
    """

    time: Floats
    n_samples: Floats
    mean: Floats
    thermal: Floats
    columns: Floats
    start: Floats
    angular_rate: Floats


def thermal_windows(
    bags: Sequence[ReducedBag], model: Model, tracks: Sequence[Track] | None = None
) -> ThermalWindows:
    """
    Combine the windows of all bags with the columns of their thermal states.

    Windows before the board's first reading, while the estimate of the board temperature settles,
    or while a thermometer gives no readings, are not used. A bag without any board temperature is
    taken to be at the reference temperature, where all columns are 0.

    `tracks`: thermal states of the bags, if already computed with the detector of `model`
    """
    spec = memory_of(model.columns, model.sensors)
    tracks = tracks or [_track(bag, model, spec) for bag in bags]
    table = ColumnTable(model.columns, spec, model.reference_temperature)
    places = StateLayout(spec).places
    parts: list[_Rows] = []
    rests: list[tuple[ReducedBag, StillInterval]] = []
    numbers: list[int] = []
    has_rate = all(interval.angular_rate is not None for bag in bags for interval in bag.intervals)
    for number, (bag, track) in enumerate(zip(bags, tracks, strict=True)):
        # Computing all lags of a bag at once is faster than reading by reading.
        gradients = [track.states[:, places[Gradient(name)]] for name in spec.sensors]
        memory = memory_on_grid(spec, track.step_s, track.states[:, BOARD], gradients)
        # `np.interp` would copy a strided or boolean series at each call.
        states = np.ascontiguousarray(np.hstack((track.states, memory)).T)
        grid, known = track.grid_s, track.is_known.astype(np.float64)
        for interval in bag.intervals:
            use = np.interp(interval.time, grid, known, left=0.0) == 1.0
            board = np.interp(interval.time, grid, states[BOARD])
            inside = use & (board >= model.range_c[0]) & (board <= model.range_c[1])
            use = inside if inside.any() else use
            if use.any():
                time = interval.time[use]
                at = np.array([np.interp(time, grid, series) for series in states])
                parts.append(_rows(interval, has_rate, use, at, grid[0], model, table))
                rests.append((bag, interval))
                numbers.append(number)
        if not rests or rests[-1][0] is not bag:
            raise FitError(
                f'{bag.source.name}: no temperatures during its rests: do the stamps of '
                'thermometer and accelerometer come from two clocks?'
            )
    sizes = [len(part.time) for part in parts]
    rows = _Rows(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    position, bag_of = np.repeat(np.arange(len(parts)), sizes), np.repeat(numbers, sizes)
    temperature, rate, weight, gradient = rows.thermal[:, [0, 2, 3, 4]].T
    return ThermalWindows(
        *(model, _windows(model, spec, rows, position, bag_of, table)),
        *(temperature, rate, weight, gradient),
        raw=rows.thermal[:, 5:],
        angular_rate=rows.angular_rate,
        typical_count=float(np.median(rows.n_samples)),
        rests=tuple(rests),
        tracks=tuple(tracks),
    )


def _rows(
    interval: StillInterval,
    has_rate: bool,
    use: Bools,
    states: Floats,
    begin_s: float,
    model: Model,
    table: ColumnTable,
) -> _Rows:
    """
    Average the windows of a rest for which `use` is True to windows of 60 s (shorter if the rest
    would give fewer than 20). `states`: (width, n); `begin_s`: time of the initial lag states [s]
    """
    time, count = interval.time[use], interval.count[use]
    window_s = min(60.0, float(time[-1] - time[0]) / (FEWEST_WINDOWS - 1) or 60.0)
    slot = np.floor((time - time[0]) / window_s * (1.0 + 1e-9))
    first = np.flatnonzero(np.r_[True, np.diff(slot) != 0])
    board, weight = states[BOARD], states[WEIGHT]
    raw, (factors, _) = table.raw(states), table.factors(board, weight)
    curves = model.sets.columns(board - model.reference_temperature, weight)
    by_start = np.zeros_like(raw)
    slopes = table.slopes(states)[0] * factors
    for k, column in enumerate(table.columns):
        if isinstance(lag := column.source, Lag):
            by_start[k] = slopes[k] * lag.remaining_share(time - begin_s, np.exp)
    rate = interval.angular_rate if has_rate else None
    mean = partial(block_means, weight=count, first=first)
    return _Rows(
        mean(time[:, None])[:, 0],
        np.add.reduceat(count, first),
        mean(interval.mean[use]),
        mean(np.array([*states[[BOARD, VAR_BOARD, RATE]], weight, states[GRADIENT], *raw]).T),
        mean(np.array([*curves, *(raw * factors)]).T),
        mean(by_start.T),
        mean(np.empty((len(time), 0)) if rate is None else rate[use]),
    )


def _windows(
    model: Model, spec: MemorySpec, rows: _Rows, position: Ints, bag: Ints, table: ColumnTable
) -> Windows:
    """Make the data of the regression from the windows of all rests."""
    sums, groups, columns = model.part_sums, model.sets.groups, model.columns
    n_curves, lags = len(groups), StateLayout(spec).lags
    t, gradient = rows.thermal[:, 0] - model.reference_temperature, rows.thermal[:, 4]
    # A support's tilt is linear in the board temperature, the case temperature and the square of
    # the case temperature.
    tilt = np.column_stack((t, gradient, (t + gradient) ** 2))
    tilt_rms = np.sqrt(np.mean(tilt**2, axis=0))
    is_tilting = tilt_rms > 0.0
    # The dynamic set's level acts on the bias only, as the relative scale is 1 at the reference
    # temperature in both regimes; terms without `has_scale` act on the bias only, too.
    in_scale = [True] * n_curves + [c.term.has_scale for c in columns] + [True] * len(sums)
    in_scale[model.sets.level] = False
    start = np.hstack((np.zeros((len(t), n_curves)), rows.start))
    lag = np.array([-1] * n_curves + [lags.get(c.source, -1) for c in columns], np.int64)
    of_part = rows.columns @ sums.T
    kelvins = _kelvins(model, rows.columns, rows.thermal[:, 5:], t, gradient)
    # All columns with a lag in the curve over a part's temperature have this part's lag.
    lag_of_part = np.where(sums != 0.0, lag, -1).max(axis=1, initial=-1)
    settled = _settled(model, spec, rows, table)
    return Windows(
        position=position,
        bag=bag,
        section=_sections(position, rows.time),
        time=rows.time,
        weight=rows.n_samples / float(np.median(rows.n_samples)),
        mean=rows.mean,
        columns=np.hstack((rows.columns, of_part)),
        groups=(*groups, *(column.group for column in columns), *[PART] * len(sums)),
        lag=np.append(lag, lag_of_part),
        kelvins=np.append(kelvins, _part_kelvins(of_part)),
        start=np.hstack((start, start @ sums.T)),
        start_covariance=start_covariance(spec.lags),
        in_scale=np.array(in_scale),
        tilt=tilt[:, is_tilting] / tilt_rms[is_tilting],
        acts_on=model.acts_on,
        board=rows.thermal[:, :2],
        board_noise=model.detector.board.noise_sd_c,
        settled=np.hstack((settled, settled @ sums.T)),
    )


def _settled(model: Model, spec: MemorySpec, rows: _Rows, table: ColumnTable) -> Floats:
    """Return the columns with all lags 0, at 9 board temperatures from lowest to highest."""
    board, is_static = rows.thermal[:, 0], rows.thermal[:, 3] <= 0.5
    some = is_static if is_static.any() else np.ones_like(is_static)
    states = np.zeros((StateLayout(spec).width, 9))
    states[BOARD] = np.linspace(board.min(), board.max(), 9)
    states[GRADIENT] = np.median(rows.thermal[some, 4])
    weight = np.zeros(9)
    curves = model.sets.columns(states[BOARD] - model.reference_temperature, weight)
    factors, _ = table.factors(states[BOARD], weight)
    return np.asarray(np.vstack((curves, table.raw(states) * factors)).T)


def _sections(position: Ints, time: Floats) -> Ints:
    """Return the index of each window's section in its position, shape (n,)."""
    first = np.searchsorted(position, np.arange(int(position[-1]) + 1))
    last = np.append(first[1:], len(position)) - 1
    begin, end = time[first][position], time[last][position]
    part = (time - begin) / np.maximum(end - begin, 1e-9)
    return np.asarray(np.minimum((part * N_SECTIONS).astype(np.int64), N_SECTIONS - 1))


def _kelvins(model: Model, values: Floats, raw: Floats, t: Floats, gradient: Floats) -> Floats:
    """Return each column's RMS divided by its largest slope over temperature [K], shape (m,)."""
    farthest = float(np.abs(t).max(initial=0.0))
    flow = float(np.sqrt(np.mean(gradient**2))) or 1.0
    grid = np.linspace(float(t.min()), float(t.max()) + 1e-9, 100)
    curves = model.sets.columns(grid, np.full_like(grid, 0.5))
    steepest = [float(np.abs(np.gradient(curve, grid)).max()) for curve in curves]
    rms = np.sqrt(np.mean(values**2, axis=0))
    # The slope of the dynamic set's weight over temperature is taken as 1 / RMS gradient [1/K].
    steepest[model.sets.level] = 1.0 / flow
    for column, series in zip(model.columns, raw.T, strict=True):
        steepest.append(column.term.steepest(column, series, flow) * farthest**column.power)
    slope = np.array(steepest)
    return np.asarray(np.divide(rms, slope, out=np.zeros_like(rms), where=slope > 0.0))


def _part_kelvins(values: Floats) -> Floats:
    """Return RMS / largest slope [K] of each power of a part's temperature, shape (9,)."""
    power = np.tile((1, 2, 3), values.shape[1] // 3)
    # The largest slope of x^p is p |x|^(p - 1) at the largest |x|.
    largest = np.repeat(np.abs(values[:, ::3]).max(axis=0, initial=0.0), 3)
    steepest = power * largest ** (power - 1)
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)) / np.maximum(steepest, 1e-300))


def _track(bag: ReducedBag, model: Model, spec: MemorySpec) -> Track:
    """Run the thermal tracker over the readings of a bag; sample its state 5 times per window."""
    spec = replace(spec, lags=(), plays=())
    if not len(bag.board.value):
        # Without readings the temperature is taken as the reference since 1e9 s: all lags are 0.
        still = np.zeros((2, StateLayout(spec).width))
        still[:, BOARD] = model.reference_temperature
        end_s = 1.0 + (bag.end_ns - bag.start_ns) * 1e-9
        return Track(-1e9, 1e9 + end_s, still, np.ones(2, dtype=bool))
    lengths_s = (float(np.median(np.diff(i.time))) for i in bag.intervals if len(i.time) > 1)
    step_s = max(min(lengths_s, default=1.0) / 5.0, 0.1)
    inputs = spec.inputs
    # A reading costs more computing time than a sample of the state, so readings are averaged over
    # two steps, but over one step if two exceed 8 s, which would delay the dynamic regime.
    mean_s = 2.0 * step_s if step_s <= 4.0 else step_s
    bag, detector = averaged(bag, model.detector, inputs, mean_s)
    config = ThermalConfig()
    tracker = ThermalTracker(detector, spec, config)
    thermometers = tracker.thermometers.values()  # the board's first
    timeouts_s = np.full(len(thermometers), config.case_timeout_s)
    timeouts_s[0] = config.temperature_timeout_s
    step_ns, begin_ns = round(step_s * 1e9), max(int(bag.board.stamp_ns[0]), bag.start_ns)
    rows, overdue_s = [], []
    readings = iter(readings_in_order(bag, inputs))
    reading = next(readings, None)
    for stamp_ns in range(begin_ns, max(bag.end_ns, begin_ns) + step_ns, step_ns):
        # As in the node, a state depends on all readings stamped up to the state's stamp. A mean
        # of readings has their mean stamp, so some of these may be later than the state.
        while reading is not None and reading[1] <= stamp_ns:
            tracker.read(*reading)
            reading = next(readings, None)
        rows.append(tracker.sample(stamp_ns))
        overdue_s.append([thermometer.beyond(stamp_ns) for thermometer in thermometers])
    states, overdue = np.array(rows), np.array(overdue_s)
    is_known = np.all(overdue <= timeouts_s, axis=1)
    _bridge_pauses(states, overdue == 0.0, spec)
    n_unsettled = int(np.argmax(states[:, VAR_BOARD] <= 4.0 * np.median(states[:, VAR_BOARD])))
    is_known[:n_unsettled] = False
    start_s = (begin_ns - bag.start_ns) * 1e-9
    return Track(start_s, step_s, states, is_known, start_s + step_s * n_unsettled)


def _bridge_pauses(states: Floats, is_fresh: Bools, spec: MemorySpec) -> None:
    """
    Interpolate board temperature and gradients in pauses of the readings, in place.

    Lags after a pause depend on the temperatures in the pause, which the tracker holds constant.
    `states`: (n, width); `is_fresh`: whether the board's thermometer (column 0) and the others
    have a recent reading, (n, n_thermometers)
    """
    places, row = StateLayout(spec).places, np.arange(len(states))
    of_gradients = [(places[Gradient(name)], is_fresh.all(axis=1)) for name in spec.sensors]
    for place, fresh in ((BOARD, is_fresh[:, 0]), *of_gradients):
        if fresh.any():
            states[:, place] = np.interp(row, row[fresh], states[fresh, place])
