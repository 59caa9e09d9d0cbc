# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the columns of the thermal response: the regressors of bias and scale.

With ``t = T_board - T_ref``, ``g_s = T_s - T_board`` of a sensor s, ``L_tau(u)`` the lag of u,
``P_r(v)`` the play of half-width r on v, and w the weight of the dynamic regime:

=============  ==========================  ================================================
kind           value u                     effect
=============  ==========================  ================================================
gradient       g_s                         heat flow
rate           dT_board/dt [K/s]           the same, from one thermometer
board          T_board - L_tau(T_board)    parts that lag the board
gradient_lag   L_tau(g_s)                  parts between the thermometers
square         (T_board - L_tau)^2, or     curves of parts that lag the board; losses of a
               q_s^2 where tau is 0        flow
cube           (T_board - L_tau)^3         the same, and a flow that is not linear
gradient_even  tanh((q_s / width)^2)       heat load, equal for both directions of the flow
size           abs(q_s)                    the same, as of a heat pump
play           P_r(v) - v, v = t or        rate-independent hysteresis
               v = L_tau(t)
bend           max(v - knee, 0)            a slope that changes at one temperature of a part
=============  ==========================  ================================================

Kinds *gradient_even* and *size* have the same value for heating and cooling. They are computed
from ``q_s = g_s - rest``: rest is 0 in the group *gradient_even*, and in the group
*gradient_even_about_rest* the gradient at rest, where self-heating makes the board warmer than
the case.

A column is ``phi = u t^power (1 | 1 - w | w)``, with u held at the edges of the column's range
and t at those of the calibrated temperatures. Curves go on along their tangent beyond them, the
powers of t do not: with power p the tangent of a product would be u p t^(p - 1), and no recording
tells how a coefficient that changes with temperature goes on.

The groups of the bank are its kinds. *product* contains board, and *gradient_x_temperature*
contains gradient and gradient_lag, times a power of temperature: coefficients that change with
temperature.

Tracker, fit, correction, covariance and file use this table.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Annotated, Any, Final, Literal

import numpy as np

from ..quantities import QUANTITIES
from ..thermal.memory import BOARD_INPUT, Lag, MemorySpec, Play
from ..thermal.state import BOARD, RATE, WEIGHT, Layout
from ..typing import Floats
from .functions import by_element, hold
from .schema import check_ranges

#: A column range that limits no value.
UNBOUNDED: Final = (-1e9, 1e9)
#: Kinds of columns whose value is a power of a temperature difference.
_ORDERS: Final = {
    'square': 2,
    'cube': 3,
    **dict.fromkeys(('gradient', 'board', 'gradient_lag', 'size', 'play', 'bend'), 1),
}
#: Lag of a board behind its case if the bags do not determine it [s]: 15 min, typical of a housing
#: of a few hundred grams in a chamber.
USUAL_BOARD_LAG_S: Final = 900.0
#: Time constants of the bank [s], in ratios of sqrt(2), from a few readings to the longest memory
#: that bags show. Linear lags use all of them, so that a part of 100 ug/K with a time constant
#: between two of them is matched; products and powers, which are smaller, use every other.
FINE_TAUS: Final = tuple(np.geomspace(60.0, 7680.0, 15).round(9).tolist())
BANK_TAUS: Final = FINE_TAUS[::2]
#: Widths of the even columns [K], half-widths of the plays [K], and the lags that they follow [s].
EVEN_WIDTHS: Final = (0.375, 0.75, 1.5, 3.0, 6.0)
PLAY_WIDTHS: Final = (0.4, 0.8, 1.6, 3.2, 6.4)
PLAY_TAUS: Final[tuple[float, ...]] = (0.0, 450.0, 900.0, 1800.0)
#: Lags of the parts whose slope changes at a knee [s]; distance [K] and number of the knees.
BEND_TAUS: Final = (0.0, *FINE_TAUS[4:11])
LEAST_KNEE_K, MOST_KNEES, MOST_PART_KNEES = 1.0, 20, 60


_Value = Annotated[float, QUANTITIES['value of a column']]
#: Time constants of the two stages of a lag [s]; the second is 0 for a lag of one stage.
Stages = tuple[float, float]


@dataclass(frozen=True)
class Column:
    """One regressor of the thermal response; its keys are the calibration file's."""

    group: Annotated[
        Literal[
            'gradient',
            'rate',
            'board',
            'gradient_lag',
            'product',
            'gradient_x_temperature',
            'square',
            'gradient_even',
            'gradient_even_about_rest',
            'play',
            'bend',
        ],
        'Group of columns that the fit keeps or drops together.',
    ]
    kind: Annotated[
        Literal[
            'gradient',
            'rate',
            'board',
            'gradient_lag',
            'square',
            'cube',
            'size',
            'gradient_even',
            'play',
            'bend',
        ],
        'g_s; dT_board/dt [K/s]; T - lagged T; lagged g_s; (T - lagged T)^2, or q_s^2 without '
        'lag; (T - lagged T)^3; abs(q_s); tanh((q_s / width)^2); play of t minus t; max(t - '
        'knee_k, 0), of t lagged, where g_s = T_s - T_board and q_s = g_s - rest_k.',
    ]
    sensor: Annotated[str, 'The thermometer s of g_s.'] = 'case'
    tau_s: Annotated[
        float,
        QUANTITIES['lag'],
        'Time constant of the lag (board, gradient_lag, square, cube; play, bend: 0 = none).',
    ] = 0.0
    second_tau_s: Annotated[
        float,
        QUANTITIES['lag'],
        'Time constant of a second stage of the lag, in series with the first; 0 = none.',
    ] = 0.0
    width_k: Annotated[
        float, QUANTITIES['width'], 'Width of gradient_even, half-width of play.'
    ] = 0.0
    rest_k: Annotated[
        float,
        QUANTITIES['gradient'],
        'g_s at rest, for gradient_even, size and square without lag.',
    ] = 0.0
    knee_k: Annotated[
        float, QUANTITIES['gradient'], 'Where the slope of bend changes, from the reference.'
    ] = 0.0
    power: Annotated[int, QUANTITIES['power'], 'The value is multiplied by t to this power.'] = 0
    during: Annotated[
        Literal['always', 'static', 'dynamic'],
        'always, or multiplied by 1 - w (static) or w (dynamic), w = weight of the dynamic set.',
    ] = 'always'
    range: Annotated[
        tuple[_Value, _Value],
        'Range of the value before t and w multiply it; held at its edges outside.',
    ] = field(kw_only=True)

    def __post_init__(self) -> None:
        check_ranges(self, range=QUANTITIES['span of a column'])
        for key, kinds in (
            ('tau_s', ('board', 'gradient_lag', 'cube')),
            ('width_k', ('gradient_even', 'play')),
        ):
            if self.kind in kinds and not getattr(self, key) > 0.0:
                raise ValueError(
                    f'`{key}` must be greater than 0 for {self.kind}, got {getattr(self, key):g}'
                )
        if self.second_tau_s > 0.9 * self.tau_s:
            raise ValueError(
                f'`second_tau_s` must be at most 0.9 of `tau_s`, got {self.second_tau_s:g}'
            )

    @property
    def is_of_sensor(self) -> bool:
        """Whether the value is computed from readings of `sensor`."""
        is_loss = self.kind == 'square' and not self.tau_s
        return is_loss or self.kind in ('gradient', 'gradient_lag', 'gradient_even', 'size')

    @property
    def lag(self) -> Lag | None:
        """The lag that the value is computed from; None if it has none."""
        if self.kind == 'gradient_lag':
            return Lag(self.sensor, self.tau_s, self.second_tau_s)
        if self.tau_s and self.kind != 'gradient_even':
            return Lag(BOARD_INPUT, self.tau_s, self.second_tau_s)
        return None

    @property
    def order(self) -> int:
        """Power of temperature in the value, not counting the factor t^power."""
        return _ORDERS.get(self.kind, 1)

    def steepest(self, raw: Floats, flow_k: float) -> float:
        """Return the largest slope [1/K] of values u; `flow_k` is the RMS of the gradient [K]."""
        if self.kind == 'gradient_even':
            return 1.0 / flow_k
        if self.kind == 'rate':
            return 1.0 / USUAL_BOARD_LAG_S
        order = _ORDERS[self.kind]
        largest = float(np.abs(raw).max(initial=0.0)) ** (1.0 / order)
        return float(order * largest ** (order - 1))


def bank(
    sensors: Sequence[str] = ('case',),
    at_rest: Mapping[str, float] | None = None,
    span_k: tuple[float, float] = (0.0, 0.0),
    parts: Sequence[Stages] | None = None,
) -> tuple[Column, ...]:
    """
    Return all columns that a response may have, without limits of range; `at_rest` is the gradient
    of each sensor at rest [K], `span_k` the temperatures seen, from the reference [K],
    `parts` the only time constants of lags, those of the part of each axis.
    """
    fine, coarse, of_plays, of_bends = (
        [(tau, 0.0) for tau in taus] for taus in (FINE_TAUS, BANK_TAUS, PLAY_TAUS, BEND_TAUS)
    )
    most_knees = MOST_KNEES if parts is None else MOST_PART_KNEES
    if parts is not None:
        of_plays = of_bends = sorted({*parts})
        fine = coarse = [stages for stages in of_bends if stages[0]]
    gradient = _family('gradient', ['gradient'], sensors)
    board = _family('board', ['board'], lags=fine)
    gradient_lag = _family('gradient_lag', ['gradient_lag'], sensors, lags=fine)
    products = _family('product', ['board'], powers=(1, 2), lags=coarse)
    mixed = _family('gradient_x_temperature', ['gradient'], sensors, powers=(1,))
    mixed += _family('gradient_x_temperature', ['gradient_lag'], sensors, (1,), coarse)
    # The bias of a part that lags the board by m is a polynomial in its temperature t - m:
    # (t - m)^2 = t^2 - 2 t m + m^2, (t - m)^3 = t^3 - 3 t^2 m + 3 t m^2 - m^3.
    square = _family('square', ['square'], powers=(0, 1), lags=coarse)
    square += _family('square', ['cube'], lags=coarse)
    even = _family('gradient_even', ['gradient_even'], sensors, (0, 1, 2), widths=EVEN_WIDTHS)
    even = [replace(column, range=(0.0, 1.0)) for column in even]
    even += _family('gradient_even', ['size', 'square'], sensors, (0, 1, 2))
    # A heat pump's load is even in the heat flow; the effect of a change is even about rest.
    rest = at_rest or {}
    even += [
        replace(column, group='gradient_even_about_rest', rest_k=rest[column.sensor])
        for column in even
        if rest.get(column.sensor)
    ]
    play = _family('play', ['play'], lags=of_plays, widths=PLAY_WIDTHS)
    least_k = LEAST_KNEE_K * MOST_KNEES / most_knees
    n_knees = min(int((span_k[1] - span_k[0]) / least_k), most_knees)
    bend = [
        Column('bend', 'bend', tau_s=tau, second_tau_s=second, knee_k=knee, range=UNBOUNDED)
        for tau, second in of_bends
        for knee in np.linspace(*span_k, n_knees + 2)[1:-1].round(3).tolist()
    ]
    return (*gradient, *board, *gradient_lag, *products, *mixed, *square, *even, *play, *bend)


def _family(
    group: Any,
    kinds: Sequence[Any],
    sensors: Sequence[str] = ('case',),
    powers: Sequence[int] = (0,),
    lags: Sequence[Stages] = ((0.0, 0.0),),
    widths: Sequence[float] = (0.0,),
) -> list[Column]:
    """Return the columns of a group with all combinations of the properties."""
    return [
        Column(group, kind, sensor, tau, second, width, power=power, range=UNBOUNDED)
        for sensor, kind, power, (tau, second), width in product(
            sensors, kinds, powers, lags, widths
        )
    ]


def memory_of(columns: Iterable[Column], sensors: Sequence[str] = ('case',)) -> MemorySpec:
    """Return the memory that columns need of a tracker; ValueError if a sensor is missing."""
    lags: set[Lag] = set()
    plays: set[Play] = set()
    for column in columns:
        if column.is_of_sensor and column.sensor not in sensors:
            raise ValueError(f'`sensor` must be one of {tuple(sensors)}, got {column.sensor}')
        if column.lag:
            lags.add(column.lag)
        if column.kind == 'play':
            plays.add(Play(column.tau_s, column.width_k, column.second_tau_s))
    order = (BOARD_INPUT, *sensors)
    return MemorySpec(
        tuple(sensors),
        tuple(sorted(lags, key=lambda lag: (order.index(lag.input), *lag[1:]))),
        tuple(sorted(plays)),
    )


#: Form of a value and its derivative, as functions of x = number of the state / width.
_FORMS: Final[dict[str, tuple[Callable[[Floats], Floats], Callable[[Floats], Floats]]]] = {
    'line': (lambda x: x, np.ones_like),
    'square': (lambda x: x * x, lambda x: 2.0 * x),
    'cube': (lambda x: x * x * x, lambda x: 3.0 * x * x),
    'size': (np.abs, np.sign),
    'bend': (lambda x: np.maximum(x, 0.0), lambda x: (x > 0.0).astype(np.float64)),
    'gradient_even': (
        lambda x: by_element(math.tanh, x * x),
        lambda x: 2.0 * x * (1.0 - by_element(math.tanh, x * x) ** 2),
    ),
}
_DURING: Final = ('always', 'static', 'dynamic')


class ColumnTable:
    """Columns over states (width, n), each state evaluated alone; results have (n_columns, n)."""

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
        self._range = (
            np.array([column.range for column in columns]).reshape(-1, 2).T[:, :, np.newaxis]
        )
        self._power = np.array([column.power for column in columns], np.int64)
        self._lowered = np.maximum(self._power - 1, 0)
        self._during = np.array([_DURING.index(column.during) for column in columns], np.int64)
        #: Whether any column belongs to one regime alone.
        self.differs = bool(self._during.any())
        # Columns that differ only in power, range or regime share one evaluation.
        of = [_source(column, layout) for column in columns]
        sources = list(dict.fromkeys(of))
        self._source = np.array([sources.index(source) for source in of], np.int64)
        self._places = np.array([source[0] for source in sources], np.int64)
        self._widths = np.array([source[2] for source in sources])[:, np.newaxis]
        self._rests = np.array([source[3] for source in sources])[:, np.newaxis]
        # A bend is of the board less its lag: two numbers of a state.
        self._bends = np.array([k for k, one in enumerate(sources) if one[1] == 'bend'], np.int64)
        self._is_lagging = self._places[self._bends][:, np.newaxis] != BOARD
        rows = {
            form: [k for k, source in enumerate(sources) if source[1] == form] for form in _FORMS
        }
        self._forms = [
            (rows[form], *both) for form, both in _FORMS.items() if rows[form] and form != 'line'
        ]
        #: Index in a state of the number that each column is computed from.
        self.places = self._places[self._source]

    def raw(self, states: Floats) -> Floats:
        """Evaluate u of each column, without the limits of its range."""
        u = self._scaled(states)
        for rows, value, _ in self._forms:
            u[rows] = value(u[rows])
        return np.asarray(u[self._source])

    def _scaled(self, states: Floats) -> Floats:
        numbers = states[self._places]
        if len(self._bends):
            lag = np.where(self._is_lagging, numbers[self._bends], 0.0)
            numbers[self._bends] = states[BOARD] - self._reference - lag
        return np.asarray((numbers - self._rests) / self._widths)

    def held(self, raw: Floats) -> Floats:
        """Limit the result of `raw` to the columns' ranges."""
        return hold(raw, *self._range)

    def excess(self, raw: Floats) -> Floats:
        """Return the distance of each column outside its range, in half ranges."""
        lower, upper = self._range
        return np.asarray(np.abs(raw - self.held(raw)) / ((upper - lower) / 2.0))

    def factors(self, board: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """Return the factor phi / u (power of t times regime weight) and its slope by t."""
        t = hold(board - self._reference, *self._t_range)
        n_powers = int(self._power.max(initial=0))
        powers = np.multiply.accumulate([np.ones_like(t), *[t] * n_powers])
        shares = np.array([np.ones_like(weight), 1.0 - weight, weight])[self._during]
        lowered = self._power[:, np.newaxis] * powers[self._lowered] if n_powers else 0.0
        return powers[self._power] * shares, lowered * shares

    def values(self, states: Floats) -> Floats:
        """Evaluate phi of each column."""
        factors, _ = self.factors(states[BOARD], states[WEIGHT])
        return np.asarray(self.held(self.raw(states)) * factors)

    def slopes(self, states: Floats) -> Floats:
        """Differentiate u by the number that it is computed from, without limits of range."""
        slopes = np.ones((len(self._places), states.shape[1]))
        scaled = self._scaled(states)
        for rows, _, slope in self._forms:
            slopes[rows] = slope(scaled[rows])
        slopes[self._bends] *= np.where(self._is_lagging, -1.0, 1.0)
        return np.asarray((slopes / self._widths)[self._source])

    def board_slopes(self, states: Floats) -> Floats | None:
        """Differentiate u by the board temperature at a given lag; None if none depends on it."""
        if not len(self._bends):
            return None
        slopes = np.zeros((len(self._places), states.shape[1]))
        slopes[self._bends] = self._scaled(states)[self._bends] > 0.0
        return np.asarray(slopes[self._source])


def _source(column: Column, layout: Layout) -> tuple[int, str, float, float]:
    """Return the index in a state that a column is computed from, its form, width and rest."""
    form = column.kind if column.kind in _FORMS else 'line'
    if column.kind == 'rate':
        place = RATE
    elif column.kind == 'play':
        place = layout.plays[Play(column.tau_s, column.width_k, column.second_tau_s)]
    elif column.lag:
        place = layout.lags[column.lag]
    elif column.kind == 'bend':
        place = BOARD
    elif column.is_of_sensor:
        place = layout.gradients[column.sensor]
    else:
        raise ValueError(f'no number of the state belongs to columns of kind {column.kind}')
    width = column.width_k if form == 'gradient_even' else 1.0
    rest = column.knee_k if form == 'bend' else column.rest_k
    return place, form, width, rest if form != 'line' else 0.0
