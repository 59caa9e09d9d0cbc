# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the columns of the thermal response: what there is to regress bias and scale on.

With ``t = T_board - T_ref``, ``g_s = T_s - T_board`` of a sensor s, ``L_tau(u)`` the first-order
lag of u, ``P_r(v)`` the play of half-width r on v, and w the weight of the dynamic regime:

=========  ==========================  ====================================================
kind       value u                     carries
=========  ==========================  ====================================================
now        g_s                         heat that flows now
rate       dT_board/dt [K/s]           the same, as seen by one thermometer
board      T_board - L_tau(T_board)    parts that lag the board
neighbour  L_tau(g_s)                  parts between the thermometers
square     (T_board - L_tau)^2, or     curves of parts that lag the board; losses of a flow
           g_s^2 where tau is 0
even       tanh((g_s / width)^2)       heat load whichever way the heat flows
size       abs(g_s)                    the same, as a heat pump's
play       P_r(v) - v, v = t or        rate-independent hysteresis
           v = L_tau(t)
=========  ==========================  ====================================================

A column is ``phi = u t^power (1 | 1 - w | w)``, with u held at the edges of the column's range
and t at those of the calibrated temperatures. The groups of the bank are its kinds; *product* and
*mixed* are board, and now and neighbour, of power 1: coefficients that change with temperature.

This is the one table of columns: tracker, fit, correction, covariance and file take theirs from
here, so that another regressor is an entry of `bank` and, if it is of a new kind, of `_value`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Literal

import numpy as np

from ..thermal.memory import BOARD_INPUT, MemorySpec
from ..thermal.state import BOARD, RATE, WEIGHT, Layout
from .functions import Number, hold
from .schema import Bounds, NotNegative

#: A range that holds nothing back, of any value.
UNBOUNDED: Final = (-1000.0, 1000.0)
#: Time constants of the bank: from a few readings to the longest memory that bags can show [s].
#: Lags themselves are fine enough for one of 100 ug/K between two of them; their products are not
#: so large, and take every other.
FINE_TAUS: Final = tuple(np.geomspace(60.0, 7680.0, 15).round(9).tolist())
BANK_TAUS: Final = FINE_TAUS[::2]
#: Widths of the even columns [K], half-widths of the plays [K], and the lag that some follow [s].
EVEN_WIDTHS: Final = (0.375, 0.75, 1.5, 3.0, 6.0)
PLAY_WIDTHS: Final = (0.4, 0.8, 1.6, 3.2)
PLAY_TAU: Final = 900.0


@dataclass(frozen=True)
class Column:
    """
    One regressor of the thermal response; its keys are the calibration file's.

    Raises ValueError if the keys contradict each other: naming the key, the rule and the value.
    """

    group: Annotated[
        Literal['now', 'rate', 'board', 'neighbour', 'product', 'mixed', 'square', 'even', 'play'],
        'What evidence judges together.',
    ]
    kind: Annotated[
        Literal['now', 'rate', 'board', 'neighbour', 'square', 'size', 'even', 'play'],
        'g_s; dT_board/dt [K/s]; T - lagged T; lagged g_s; (T - lagged T)^2, or g_s^2 without '
        'lag; abs(g_s); tanh((g_s / width)^2); play of t minus t, where '
        'g_s = T_s - T_board.',
    ]
    sensor: Annotated[str, 'Which further thermometer g_s is of.'] = 'case'
    tau_s: Annotated[
        NotNegative, 'Time constant of the lag (board, neighbour, square; play: 0 = none).'
    ] = 0.0
    width_k: Annotated[NotNegative, 'Width of even, half-width of play.'] = 0.0
    power: Annotated[int, Bounds(at_least=0), 'The value is multiplied by t to this power.'] = 0
    during: Annotated[
        Literal['always', 'static', 'dynamic'],
        'always, or multiplied by 1 - w (static) or by w (dynamic), w = weight of the regime.',
    ] = 'always'
    range: Annotated[
        tuple[float, float],
        'Range of the value before t and w multiply it; held at its edges outside.',
    ] = field(kw_only=True)

    def __post_init__(self) -> None:
        lower, upper = self.range
        if not lower < upper:
            raise ValueError(
                f'`range` must be [lower, upper] with lower < upper, got [{lower}, {upper}]'
            )
        for key, kinds in (('tau_s', ('board', 'neighbour')), ('width_k', ('even', 'play'))):
            if self.kind in kinds and not getattr(self, key) > 0.0:
                raise ValueError(
                    f'`{key}` must be greater than 0 for {self.kind}, got {getattr(self, key):g}'
                )

    @property
    def is_of_gradient(self) -> bool:
        """Whether the value is made of the present gradient of `sensor`."""
        return self.kind in ('now', 'even', 'size') or (self.kind == 'square' and not self.tau_s)

    @property
    def lag(self) -> tuple[str, float] | None:
        """Which lag of the memory the value is, or follows: input and time constant [s]."""
        if self.kind == 'neighbour':
            return self.sensor, self.tau_s
        return (BOARD_INPUT, self.tau_s) if self.tau_s and self.kind != 'even' else None


def bank(sensors: Sequence[str] = ('case',)) -> tuple[Column, ...]:
    """Return all columns that a response may have, none held to a range yet."""
    now = [Column('now', 'now', sensor, range=UNBOUNDED) for sensor in sensors]
    board = [Column('board', 'board', tau_s=tau, range=UNBOUNDED) for tau in FINE_TAUS]
    neighbour = [
        Column('neighbour', 'neighbour', sensor, tau, range=UNBOUNDED)
        for sensor in sensors
        for tau in FINE_TAUS
    ]
    coarse = [column for column in board if column.tau_s in BANK_TAUS]
    flow = [*now, *(column for column in neighbour if column.tau_s in BANK_TAUS)]
    product = [replace(column, group='product', power=1) for column in coarse]
    mixed = [replace(column, group='mixed', power=1) for column in flow]
    # A part's own curve bends over its own temperature t - m: (t - m)^2 = t^2 - 2 t m + m^2.
    square = [replace(column, group='square', kind='square') for column in coarse]
    even = [
        Column('even', 'even', sensor, width_k=width, power=power, range=(0.0, 1.0))
        for sensor in sensors
        for power in (0, 1, 2)
        for width in EVEN_WIDTHS
    ]
    even += [
        Column('even', kind, sensor, power=power, range=UNBOUNDED)
        for sensor in sensors
        for kind in ('size', 'square')
        for power in (0, 1, 2)
    ]
    play = [
        Column('play', 'play', tau_s=tau, width_k=width, range=UNBOUNDED)
        for tau in (0.0, PLAY_TAU)
        for width in PLAY_WIDTHS
    ]
    return (*now, *board, *neighbour, *product, *mixed, *square, *even, *play)


def memory_of(columns: Iterable[Column], sensors: Sequence[str] = ('case',)) -> MemorySpec:
    """
    Find what a tracker must remember for some columns.

    Raises ValueError if a column is of a sensor that is not among them.
    """
    lags: set[tuple[str, float]] = set()
    plays: set[tuple[float, float]] = set()
    for column in columns:
        if (column.is_of_gradient or column.kind == 'neighbour') and column.sensor not in sensors:
            raise ValueError(f'`sensor` must be one of {tuple(sensors)}, got {column.sensor}')
        if column.lag:
            lags.add(column.lag)
        if column.kind == 'play':
            plays.add((column.tau_s, column.width_k))
    order = (BOARD_INPUT, *sensors)
    return MemorySpec(
        tuple(sensors),
        tuple(sorted(lags, key=lambda lag: (order.index(lag[0]), lag[1]))),
        tuple(sorted(plays)),
    )


class ColumnTable:
    """
    Columns, ready to be evaluated; the same bits for one state and for many.

    reference_temperature: T_ref [degC]
    temperature_range_c: at the edges of which t is held [degC]
    """

    def __init__(
        self,
        columns: Sequence[Column],
        memory: MemorySpec,
        reference_temperature: float,
        temperature_range_c: tuple[float, float] = UNBOUNDED,
    ) -> None:
        layout = Layout(memory)
        self.columns = tuple(columns)
        self._reference = reference_temperature
        lower, upper = temperature_range_c
        self._t_range = lower - reference_temperature, upper - reference_temperature
        self._n_powers = max((column.power for column in columns), default=0)
        #: Whether any column belongs to one regime alone.
        self.differs = any(column.during != 'always' for column in columns)
        # What differs only in power, range or regime is evaluated once.
        sources: dict[tuple[str, int, float], int] = {}
        self._plan: list[tuple[int, float, float, int, str]] = []
        for column in columns:
            width = column.width_k if column.kind == 'even' else 0.0
            bend = column.kind if column.kind in ('even', 'size', 'square') else ''
            key = (bend, _place(column, layout), width)
            source = sources.setdefault(key, len(sources))
            self._plan.append((source, *column.range, column.power, column.during))
        self._sources = list(sources)

    def raw(self, state: Sequence[Number]) -> list[Number]:
        """Evaluate u of each column, not held."""
        found = [_value(bend, state[place], width) for bend, place, width in self._sources]
        return [found[source] for source, _, _, _, _ in self._plan]

    def held(self, raw: Sequence[Number]) -> list[Number]:
        """Hold what `raw` gives at the edges of the columns' ranges."""
        return [
            hold(u, lower, upper)
            for u, (_, lower, upper, _, _) in zip(raw, self._plan, strict=True)
        ]

    def excess(
        self, raw: Sequence[Number], held: Sequence[Number], nil: Number, which: Iterable[int]
    ) -> Number:
        """Say how far the farthest of some columns lies outside its range, in half ranges."""
        result = nil
        for k in which:
            _, lower, upper, _, _ = self._plan[k]
            excess = abs(raw[k] - held[k]) / ((upper - lower) / 2.0)
            if isinstance(excess, np.ndarray):
                result = np.maximum(result, excess)
            elif excess > result:
                result = excess
        return result

    def values(self, state: Sequence[Number]) -> list[Number]:
        """Evaluate phi of each column."""
        return self.weighted(self.held(self.raw(state)), state[BOARD], state[WEIGHT])

    def weighted(self, factors: Sequence[Number], board: Number, weight: Number) -> list[Number]:
        """
        Multiply a number per column by its power of t and share of its regime; u held makes phi.
        """
        powers = self._powers(board)
        rest = 1.0 - weight
        result = []
        for factor, (_, _, _, power, during) in zip(factors, self._plan, strict=True):
            phi = factor * powers[power] if power else factor
            if during != 'always':
                phi = phi * (rest if during == 'static' else weight)
            result.append(phi)
        return result

    def slopes(
        self, state: Sequence[Number], raw: Sequence[Number]
    ) -> tuple[list[Number], list[Number]]:
        """Differentiate phi, ranges aside."""
        board, weight = state[BOARD], state[WEIGHT]
        one = board * 0.0 + 1.0
        inner = []
        for u, (source, _, _, _, _) in zip(raw, self._plan, strict=True):
            bend, place, width = self._sources[source]
            slope = one
            if bend == 'even':
                slope = 2.0 / (width * width) * state[place] * (1.0 - u * u)
            elif bend == 'square':
                slope = 2.0 * state[place]
            elif bend == 'size':
                slope = _sign(state[place])
            inner.append(slope)
        powers = self._powers(board)
        rest = 1.0 - weight
        outer = []
        for u, (_, _, _, power, during) in zip(raw, self._plan, strict=True):
            slope = one * 0.0
            if power:
                slope = u * float(power)
            if power > 1:
                slope = slope * powers[power - 1]
            if during != 'always':
                slope = slope * (rest if during == 'static' else weight)
            outer.append(slope)
        return self.weighted(inner, board, weight), outer

    def _powers(self, board: Number) -> list[Number]:
        """Raise t to the powers that occur; that of 0 is not used."""
        t = hold(board - self._reference, *self._t_range)
        powers = [t, t]
        for _ in range(1, self._n_powers):
            powers.append(powers[-1] * t)
        return powers


def _place(column: Column, layout: Layout) -> int:
    """Find the number of a sample that a column is made of."""
    if column.kind == 'rate':
        return RATE
    if column.kind == 'play':
        return layout.plays[column.tau_s, column.width_k]
    if column.lag:
        return layout.lags[column.lag]
    return layout.gradients[column.sensor]


def _value(bend: str, u: Number, width: float) -> Number:
    if not bend:
        return u
    if bend == 'square':
        return u * u
    if bend == 'size':
        return abs(u)
    x = u / width
    return _tanh(x * x)


def _sign(x: Number) -> Number:
    if isinstance(x, np.ndarray):
        return np.sign(x)
    return math.copysign(1.0, x) if x else 0.0


def _tanh(x: Number) -> Number:
    """Hyperbolic tangent with the same bits for a float and for an array of them."""
    if isinstance(x, np.ndarray):
        return np.array([math.tanh(v) for v in x.ravel().tolist()]).reshape(x.shape)
    return math.tanh(x)
