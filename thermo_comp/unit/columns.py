# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the columns of the thermal response: the regressors of bias and scale.

A column is ``phi = u t^power r``. The value u is computed by the column's kind (`unit.terms`), t
is the board temperature less the reference, and r is 1, 1 - w or w, with w the weight of the
dynamic set. u is limited to the column's range, and t to the calibrated temperatures, because no
recording determines the effect of a column outside these limits.

The function `bank` makes the candidate columns of a fit. The group *part* has columns of the kinds
board, square and cube: their sum with a curve over the board temperature is a curve over the
temperature of a part.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from ..quantities import QUANTITIES
from ..thermal.lags import BOARD_INPUT, Lag, MemorySpec, Play, Quantity
from ..thermal.state import BOARD, WEIGHT, Gradient, Rate, StateLayout
from ..typing import Floats
from .functions import TANGENT_SPANS, by_element, hold
from .schema import broken, check_ranges
from .terms import GROUPS, LINE, TERMS, Term

UNBOUNDED: Final = (-1e9, 1e9)
#: Time constants of the columns of `bank` [s], in steps of a factor sqrt(2), from a few reading
#: intervals to the longest lag that bags determine. Columns linear in a lag have all 15 time
#: constants, so that their sums approximate a lag of any time constant. Products and powers of
#: lags have smaller effects than lags, so every second time constant suffices.
FINE_TAUS: Final = tuple(np.geomspace(60.0, 7680.0, 15).round(9).tolist())
BANK_TAUS: Final = FINE_TAUS[::2]
#: Widths of kind gradient_even [K]; half-widths of plays [K]; time constants of the lagged board
#: temperatures that are inputs of plays [s], 0 for the board temperature itself.
EVEN_WIDTHS: Final = (0.375, 0.75, 1.5, 3.0, 6.0)
PLAY_WIDTHS: Final = (0.4, 0.8, 1.6, 3.2, 6.4)
PLAY_TAUS: Final[tuple[float, ...]] = (0.0, 450.0, 900.0, 1800.0)
#: Time constants of kind bend [s].
BEND_TAUS: Final = (0.0, *FINE_TAUS[4:11])
#: At its knee [K] the slope of a bend changes: smallest span of board temperatures per knee [K];
#: largest number of knees per lag, and with the argument `parts` of `bank` (a third of the span).
LEAST_KNEE_K, MOST_KNEES, MOST_PART_KNEES = 1.0, 20, 60


# Name of a group or kind: any text for type checkers; for the schema, a key of GROUPS or TERMS.
if TYPE_CHECKING:
    _Group: TypeAlias = str
    _Kind: TypeAlias = str
else:
    _Group, _Kind = Literal[tuple(GROUPS)], Literal[tuple(TERMS)]
_Value = Annotated[float, QUANTITIES['value of a column']]
_Lag = Annotated[float, QUANTITIES['lag']]
_Kelvin = Annotated[float, QUANTITIES['gradient']]


class Part(NamedTuple):
    """
    The lag of a part of the unit behind the board; the fields are keys of a column.

    tau_s, second_tau_s: time constants of two stages [s]; the second is 0 for a single stage
    sensor_share: the part lags the board temperature plus this share of the sensor's gradient
    lead_s: lag of the board thermometer behind the temperature that drives the part [s]
    """

    tau_s: float
    second_tau_s: float = 0.0
    sensor_share: float = 0.0
    lead_s: float = 0.0

    @property
    def of_gradient(self) -> 'Part':
        """The lag of a gradient: the time constants alone, without `sensor_share` and `lead_s`."""
        return Part(self.tau_s, self.second_tau_s)


@dataclass(frozen=True)
class Column:
    """One regressor of the thermal response; the fields are keys of the calibration file."""

    group: Annotated[_Group, 'Group of columns that the fit keeps or drops together.']
    kind: Annotated[
        _Kind,
        '; '.join(term.formula for term in TERMS.values())
        + ', where g_s = T_s - T_board and q_s = g_s - rest_k.',
    ]
    sensor: Annotated[str, 'Thermometer s of the gradient g_s = T_s - T_board.'] = 'case'
    tau_s: Annotated[
        _Lag, 'Time constant of the lag; 0 = no lag. Above 0 in kinds board, gradient_lag, cube.'
    ] = 0.0
    second_tau_s: Annotated[
        _Lag, 'Time constant of a second stage of the lag, in series with the first; 0 = none.'
    ] = 0.0
    sensor_share: Annotated[
        float,
        QUANTITIES['share'],
        'A part lags T_board + sensor_share * g_s (kinds board, square, cube, play and bend).',
    ] = 0.0
    lead_s: Annotated[
        _Lag,
        'Lag of the board thermometer behind the temperature that drives the part, if '
        '`sensor_share` is 0; 0 = none.',
    ] = 0.0
    width_k: Annotated[
        float,
        QUANTITIES['width'],
        'Kind gradient_even: `width` in its formula; kind play: half-width of the hysteresis.',
    ] = 0.0
    rest_k: Annotated[
        _Kelvin,
        'Gradient g_s in a soak, for the kinds gradient_even, size, and square without lag.',
    ] = 0.0
    knee_k: Annotated[
        _Kelvin, 'Temperature of the part less T_ref at which the slope of a bend changes.'
    ] = 0.0
    power: Annotated[int, QUANTITIES['power'], 'Exponent of the factor T_board - T_ref.'] = 0
    during: Annotated[
        Literal['always', 'static', 'dynamic'],
        'Factor: 1 (always), 1 - w (static), w (dynamic); w: weight of the dynamic set, 0 to 1.',
    ] = 'always'
    range: Annotated[
        tuple[_Value, _Value],
        'Limits of the value of the formula in `kind`, without the factors `power` and `during`.',
    ] = field(kw_only=True)

    def __post_init__(self) -> None:
        check_ranges(self, range=QUANTITIES['span of a column'])
        if self.kind not in TERMS:
            raise broken('kind', f'be one of {tuple(TERMS)}', self.kind)
        for key in self.term.positive:
            if not getattr(self, key) > 0.0:
                raise broken(key, f'be greater than 0 for {self.kind}', float(getattr(self, key)))
        if self.second_tau_s > 0.9 * self.tau_s:
            raise broken('second_tau_s', 'be at most 0.9 of `tau_s`', float(self.second_tau_s))
        if self.lead_s and (self.sensor_share or not self.tau_s):
            rule = 'be 0 in a column without `tau_s` or with `sensor_share`'
            raise broken('lead_s', rule, float(self.lead_s))

    @property
    def term(self) -> Term:
        """The function of the column's kind."""
        return TERMS[self.kind]

    @property
    def source(self) -> Quantity:
        """The quantity of the thermal state of which the column is a function."""
        return self.term.source(self)

    @property
    def part(self) -> Part:
        """The lag of the part of the unit whose temperature determines the column's value."""
        return Part(self.tau_s, self.second_tau_s, self.sensor_share, self.lead_s)

    @property
    def is_of_sensor(self) -> bool:
        """Whether the column's value depends on readings of `sensor`."""
        return self.source.inputs != (BOARD_INPUT,)

    @property
    def is_gradient(self) -> bool:
        """Whether the column's value is the unlagged gradient T_s - T_board of `sensor`."""
        return self.term.form is LINE and isinstance(self.source, Gradient)


def bank(
    sensors: Sequence[str] = ('case',),
    at_rest: Mapping[str, float] | None = None,
    span_k: tuple[float, float] = (0.0, 0.0),
    parts: Sequence[Part] | None = None,
) -> tuple[Column, ...]:
    """
    Return all candidate columns, with ranges that exclude no value.

    at_rest: gradient g_s of each sensor in a soak [K]
    span_k: lowest and highest board temperature in the data, less the reference [K]
    parts: lag of each axis's part: the only lags of the columns; None: lags of all time constants
    """
    fine, coarse, of_plays, of_bends = (
        list(map(Part, taus)) for taus in (FINE_TAUS, BANK_TAUS, PLAY_TAUS, BEND_TAUS)
    )
    fine_gradient, coarse_gradient = fine, coarse
    most_knees = MOST_KNEES if parts is None else MOST_PART_KNEES
    if parts is not None:
        of_plays = of_bends = sorted({*parts})
        fine = coarse = [part for part in of_bends if part.tau_s]
        fine_gradient = coarse_gradient = sorted({part.of_gradient for part in fine})
    columns = _family('gradient', ['gradient'], sensors)
    columns += _family('board', ['board'], lags=fine)
    columns += _family('gradient_lag', ['gradient_lag'], sensors, lags=fine_gradient)
    columns += _family('product', ['board'], powers=(1, 2), lags=coarse)
    columns += _family('gradient_x_temperature', ['gradient'], sensors, powers=(1,))
    columns += _family('gradient_x_temperature', ['gradient_lag'], sensors, (1,), coarse_gradient)
    # A bias that is a polynomial of t - m, the temperature of a part of lag m, has the terms
    # (t - m)^2 = t^2 - 2 t m + m^2 and (t - m)^3 = t^3 - 3 t^2 m + 3 t m^2 - m^3.
    columns += _family('square', ['square'], powers=(0, 1), lags=coarse)
    columns += _family('square', ['cube'], lags=coarse)
    even = _family('gradient_even', ['gradient_even'], sensors, (0, 1, 2), widths=EVEN_WIDTHS)
    even += _family('gradient_even', ['size', 'square'], sensors, (0, 1, 2))
    # The load of a heat pump is an even function of the gradient; an effect that is equal in
    # heating and cooling is an even function of the gradient less its value in a soak.
    rest = at_rest or {}
    about_rest = partial(replace, group='gradient_even_about_rest')
    columns += even
    columns += [about_rest(c, rest_k=rest[c.sensor]) for c in even if rest.get(c.sensor)]
    columns += _family('play', ['play'], lags=of_plays, widths=PLAY_WIDTHS)
    least_k = LEAST_KNEE_K * MOST_KNEES / most_knees
    n_knees = min(int((span_k[1] - span_k[0]) / least_k), most_knees)
    knees = np.linspace(*span_k, n_knees + 2)[1:-1].round(3).tolist()
    bends = _family('bend', ['bend'], lags=of_bends)
    columns += [replace(column, knee_k=knee) for column in bends for knee in knees]
    return tuple(columns)


def _family(
    group: str,
    kinds: Sequence[str],
    sensors: Sequence[str] = ('case',),
    powers: Sequence[int] = (0,),
    lags: Sequence[Part] = (Part(0.0),),
    widths: Sequence[float] = (0.0,),
) -> list[Column]:
    """Return the columns of a group: all combinations of sensor, kind, power, lag and width."""
    ranges = {kind: TERMS[kind].bounds or UNBOUNDED for kind in kinds}
    return [
        Column(group, kind, sensor, *part, width, power=power, range=ranges[kind])
        for sensor, kind, power, part, width in product(sensors, kinds, powers, lags, widths)
    ]


def memory_of(columns: Iterable[Column], sensors: Sequence[str] = ('case',)) -> MemorySpec:
    """Return lags, plays and rates of columns; ValueError for a sensor not in `sensors`."""
    sources: set[Quantity] = set()
    for column in columns:
        sources.add(column.source)
        if not {*column.source.inputs} <= {BOARD_INPUT, *sensors}:
            raise ValueError(f'`sensor` must be one of {tuple(sensors)}, got {column.sensor}')
    plays = [source for source in sources if isinstance(source, Play)]
    lags = {source for source in sources if isinstance(source, Lag)}
    lags |= {play.lag for play in plays if play.lag}
    order = (BOARD_INPUT, *sensors)
    return MemorySpec(
        tuple(sensors),
        tuple(sorted(lags, key=lambda lag: (order.index(lag.input), *lag[1:]))),
        tuple(sorted(plays)),
        tuple(name for name in sensors if Rate(name) in sources),
    )


_DURING: Final = ('always', 'static', 'dynamic')


class ColumnTable:
    """Evaluates columns, (n_columns, n), at n independent thermal states, (width, n)."""

    def __init__(
        self,
        columns: Sequence[Column],
        memory: MemorySpec,
        reference_temperature: float,
        temperature_range_c: tuple[float, float] = UNBOUNDED,
    ) -> None:
        layout = StateLayout(memory)
        self.columns = tuple(columns)
        self._reference = reference_temperature
        coldest, hottest = temperature_range_c
        self._t_range = coldest - reference_temperature, hottest - reference_temperature
        ranges = np.array([column.range for column in columns])
        self._range = ranges.reshape(-1, 2).T[:, :, np.newaxis]
        # The value u of a column is constant outside its range. Only a bend, a curve over a part's
        # temperature, continues like a curve over T_board, for `TANGENT_SPANS` of its range.
        is_curve = np.array([c.term.is_temperature for c in columns], bool)[:, np.newaxis]
        lower, upper = self._range
        extension = np.where(is_curve, TANGENT_SPANS * (upper - lower), 0.0)
        self._limits = lower - extension, upper + extension
        self._power = np.array([column.power for column in columns], np.int64)
        self._during = np.array([_DURING.index(column.during) for column in columns], np.int64)
        self._orders = np.array([column.term.order for column in columns], np.int64)
        #: Whether any column applies in only one regime.
        self.differs = bool(self._during.any())
        self._places = np.array([layout.places[c.source] for c in columns], np.int64)
        self._centres = np.array([c.term.centre(c) for c in columns])[:, np.newaxis]
        self._widths = np.array([c.term.width(c) for c in columns])[:, np.newaxis]
        terms = np.array([c.term for c in columns], object)
        bent = [term for term in dict.fromkeys(terms.tolist()) if term.form is not LINE]
        self._terms = [(np.flatnonzero(terms == term), term) for term in bent]
        # The temperature of a part is the board temperature less the lag of the part [K].
        self._parts = np.flatnonzero([term.is_temperature for term in terms])
        self._is_lagging = self._places[self._parts][:, np.newaxis] != BOARD

    def raw(self, states: Floats) -> Floats:
        """Evaluate the value u of each column, without the limits of the column's range."""
        u = self._scaled(states)
        for rows, term in self._terms:
            u[rows] = term.form.value(u[rows])
        return u

    def _scaled(self, states: Floats) -> Floats:
        numbers = states[self._places]
        if len(self._parts):
            lag = np.where(self._is_lagging, numbers[self._parts], 0.0)
            numbers[self._parts] = states[BOARD] - self._reference - lag
        return np.asarray((numbers - self._centres) / self._widths)

    def held(self, raw: Floats) -> Floats:
        """Limit the values u of the columns to their ranges, which are extended for bends."""
        return hold(raw, *self._limits)

    def beyond(self, raw: Floats) -> Floats:
        """Return how far the values u of the columns are beyond the columns' ranges, signed."""
        return raw - hold(raw, *self._range)

    def excess(self, raw: Floats) -> Floats:
        """Return (1 + d)^(1/p) - 1; d: distance of u from its range / half range; p: order."""
        lower, upper = self._range
        excess = np.asarray(np.abs(self.beyond(raw)) / ((upper - lower) / 2.0))
        for order in {*self._orders.tolist()} - {1}:
            rows, root = self._orders == order, partial(pow, exp=1.0 / order)
            excess[rows] = by_element(root, 1.0 + excess[rows]) - 1.0
        return excess

    def factors(self, board: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """Return each column's factor ``phi / u = t^power r``, and its derivative w.r.t. t."""
        t = hold(board - self._reference, *self._t_range)
        n_powers = int(self._power.max(initial=0))
        powers = np.multiply.accumulate([np.ones_like(t), *[t] * n_powers])
        shares = np.array([np.ones_like(weight), 1.0 - weight, weight])[self._during]
        lowered = self._power[:, np.newaxis] * powers[np.maximum(self._power - 1, 0)]
        return powers[self._power] * shares, lowered * shares

    def values(self, states: Floats) -> Floats:
        """Evaluate each column phi at thermal states."""
        factors, _ = self.factors(states[BOARD], states[WEIGHT])
        return np.asarray(self.held(self.raw(states)) * factors)

    def slopes(self, states: Floats) -> tuple[Floats, Floats | None]:
        """
        Return derivatives of the unlimited u of each column: w.r.t. the column's quantity of the
        state; w.r.t. T_board at constant lag, None if no column is a function of t - lag.
        """
        slopes, scaled = np.ones((len(self._places), states.shape[1])), self._scaled(states)
        for rows, term in self._terms:
            slopes[rows] = term.form.slope(scaled[rows])
        slopes /= self._widths
        if not len(self._parts):
            return slopes, None
        by_board = np.zeros_like(slopes)
        by_board[self._parts] = slopes[self._parts]
        slopes[self._parts] *= np.where(self._is_lagging, -1.0, 1.0)
        return slopes, by_board
