# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the table of the kinds of regressors of the thermal response.

The value of a column is ``u = form.value(x)``, ``x = (n - centre) / width``; n is a quantity of
the thermal state (`source`) or, if `is_temperature`, ``t - source``: the temperature of a part
that lags the board by `source`, less T_ref. Formulas contain ``t = T_board - T_ref``, the gradient
``g_s = T_s - T_board`` of a sensor s, and ``q_s = g_s - rest``; the constant `rest` is 0 or, in a
unit that heats itself, g_s in a soak. Even functions of q_s have equal values in heating and in
cooling at the same rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ..thermal import lags, state
from ..thermal.lags import Quantity
from ..typing import Floats
from .functions import by_element

if TYPE_CHECKING:
    from .columns import Column


class Form(NamedTuple):
    """A function of x and its derivative; a single x gives the same bits as x in an array."""

    value: Callable[[Floats], Floats]
    slope: Callable[[Floats], Floats]


LINE: Final = Form(lambda x: x, np.ones_like)
_SQUARE: Final = Form(lambda x: x * x, lambda x: 2.0 * x)
_CUBE: Final = Form(lambda x: x * x * x, lambda x: 3.0 * x * x)
_SIZE: Final = Form(np.abs, np.sign)
_EVEN: Final = Form(
    lambda x: by_element(math.tanh, x * x),
    lambda x: 2.0 * x * (1.0 - by_element(math.tanh, x * x) ** 2),
)
_BEND: Final = Form(lambda x: np.maximum(x, 0.0), lambda x: (x > 0.0).astype(np.float64))


@dataclass(frozen=True, eq=False)
class Term:
    """
    A kind of regressor.

    kind: name of the kind in the calibration file
    formula: formula of the value, for the description of the file
    source: function of a column, returns the quantity of the thermal state that determines it
    form, is_temperature: see this module's docstring
    order: power of temperature in the value u of a column
    centre_key, width_key: keys of a column with centre and width of x; '' for centre 0 and width 1
    positive: keys of a column that must be greater than 0
    bounds: range of all possible values of the kind; None: the range is that of the fitted bags
    has_scale: whether the fit estimates weights for the scale as well as for the bias
    """

    kind: str
    formula: str
    source: Callable[[Column], Quantity]
    form: Form = LINE
    order: int = 1
    centre_key: str = ''
    width_key: str = ''
    positive: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    is_temperature: bool = False
    has_scale: bool = True

    def centre(self, column: Column) -> float:
        """Return the centre in a column's ``x = (n - centre) / width`` (see module docstring)."""
        return float(getattr(column, self.centre_key, 0.0))

    def width(self, column: Column) -> float:
        """Return the width in a column's ``x = (n - centre) / width`` (see module docstring)."""
        return float(getattr(column, self.width_key, 1.0))

    def largest(self, column: Column) -> float:
        """Return the largest possible magnitude of the value u of a column."""
        if self.bounds is not None:
            return max(map(abs, self.bounds))
        return (column.source.largest + abs(self.centre(column))) ** self.order

    def steepest(self, column: Column, raw: Floats, flow_k: float) -> float:
        """Return the largest slope of u over temperature; for bounded u, 1 / `flow_k` [1/K]."""
        if self.bounds is not None:
            return 1.0 / flow_k
        largest = float(np.abs(raw).max(initial=0.0)) ** (1.0 / self.order)
        return float(self.order * largest ** (self.order - 1)) * column.source.per_kelvin


def _lag_of_part(column: Column) -> lags.Lag:
    sensor = column.sensor if column.sensor_share else ''
    tau, second, share, lead = column.part
    return lags.Lag(lags.BOARD_INPUT, tau, second, sensor, share, lead)


def _gradient(column: Column) -> Quantity:
    return state.Gradient(column.sensor)


def _lagged_gradient(column: Column) -> Quantity:
    return lags.Lag(column.sensor, *column.part[:2])


def _part(column: Column) -> Quantity:
    # A column of kind `bend` without lag is computed from the board temperature.
    return _lag_of_part(column) if column.tau_s else state.Board()


def _part_or_gradient(column: Column) -> Quantity:
    return _lag_of_part(column) if column.tau_s else state.Gradient(column.sensor)


def _play(column: Column) -> Quantity:
    lag = _lag_of_part(column)
    return lags.Play(lag.tau_s, column.width_k, *lag[2:])


_ALL: Final = (
    # `gradient`: heat flow from a thermometer to the board; `rate`: a fit never uses this kind.
    Term('gradient', 'g_s', _gradient),
    Term('rate', 'dT_board/dt [K/s]', lambda _: state.Rate()),
    # `board`: lag of a part behind the board; `gradient_lag`: the lagged gradient, a further
    # column for a part between two thermometers.
    Term('board', 'T_board - lagged T_board', _part, positive=('tau_s',)),
    Term('gradient_lag', 'lagged g_s', _lagged_gradient, positive=('tau_s',)),
    # `square` with a lag: a term of a curve over a part's temperature; else: squared heat flow.
    Term(
        *('square', '(T_board - lagged T_board)^2, or q_s^2 without lag', _part_or_gradient),
        *(_SQUARE, 2, 'rest_k'),
    ),
    # `cube`: a term of a curve over a part's temperature.
    Term('cube', '(T_board - lagged T_board)^3', _part, _CUBE, 3, 'rest_k', positive=('tau_s',)),
    # Even functions of q_s. `size`: heat pump load; `gradient_even`: a load that saturates.
    Term('size', 'abs(q_s)', _gradient, _SIZE, centre_key='rest_k'),
    Term(
        *('gradient_even', 'tanh((q_s / width)^2)', _gradient, _EVEN),
        centre_key='rest_k',
        width_key='width_k',
        positive=('width_k',),
        bounds=(0.0, 1.0),
    ),
    # `play`: rate-independent hysteresis over t, or over the temperature of a part.
    Term('play', 'play(t) - t', _play, positive=('width_k',), has_scale=False),
    # `bend`: a curve whose slope changes at one temperature of a part.
    Term(
        *('bend', 'max(lagged t - knee_k, 0)', _part, _BEND),
        centre_key='knee_k',
        is_temperature=True,
        has_scale=False,
    ),
)
#: All kinds by name, in the order of the file's schema.
TERMS: Final = {term.kind: term for term in _ALL}
#: All groups of columns, each with its name in a certificate.
GROUPS: Final = {
    'gradient': 'heat flow (case − board)',
    'rate': 'rate of the board temperature',
    'board': 'parts that lag the board',
    # For each axis the curve of group `part` is the sum of the curve over the board temperature
    # and of columns of the groups `board`, `product` and `square`.
    'part': 'curve of the part of each axis',
    'gradient_lag': 'parts between case and board',
    # `product`, `gradient_x_temperature`: the effect of a lag or gradient changes with T_board.
    'product': 'lags, with effects that change with temperature',
    'gradient_x_temperature': 'heat flow, with an effect that changes with temperature',
    'square': 'curves of parts that lag',
    'gradient_even': 'size of the heat flow',
    'gradient_even_about_rest': 'size of the heat flow less that in a soak',
    'play': 'hysteresis',
    'bend': 'change of slope',
}
