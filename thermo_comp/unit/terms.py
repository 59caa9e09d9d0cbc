# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the kinds of regressors of the thermal response; each kind is a class.

The value of a column is ``u = form.value(x)``, ``x = (n - centre) / width``. The number n is a
quantity of the thermal state, the `source`; if `is_temperature`, n is ``t - source``, the
temperature of a part that lags the board. Notation: ``t = T_board - T_ref``,
``g_s = T_s - T_board`` of a sensor s, and ``q_s = g_s - rest``. The constant `rest` is 0, or the
gradient at rest if self-heating makes the board warmer than the case. Even functions of q_s have
the same value for heating and for cooling at the same rate.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple, TypeAlias

import numpy as np

from ..thermal import lags, state
from ..thermal.quantity import Quantity
from ..typing import Floats
from .functions import by_element

if TYPE_CHECKING:
    from .columns import Column


class Form(NamedTuple):
    """A function of x and its derivative; equal x give equal bits in arrays of any length."""

    value: Callable[[Floats], Floats]
    slope: Callable[[Floats], Floats]


_Names: TypeAlias = tuple[str, ...]
_Pairs: TypeAlias = tuple[tuple[str, str], ...]
LINE: Final = Form(lambda x: x, np.ones_like)
_CLASSES: Final[list[type[Term]]] = []


class Term(ABC):
    """The base class of the kinds of regressors."""

    kind: ClassVar[str]  # name of the kind in the calibration file
    formula: ClassVar[str]  # formula of the value, for the description of the file
    #: Groups of columns that are defined with this kind, each with its name in a certificate.
    groups: ClassVar[_Pairs] = ()
    form: ClassVar[Form] = LINE
    #: Power of temperature in the value of a column, without the column's factor t^power.
    order: ClassVar[int] = 1
    #: Keys of a column that hold the centre and the width of x; '' for centre 0 and width 1.
    centre_key: ClassVar[str] = ''
    width_key: ClassVar[str] = ''
    #: Keys of a column that must be greater than 0.
    positive: ClassVar[_Names] = ()
    #: Range of all possible values of the kind; None: the range is that of the fitted bags.
    bounds: ClassVar[tuple[float, float] | None] = None
    is_temperature: ClassVar[bool] = False
    #: Whether the fit estimates weights for the scale as well as for the bias.
    has_scale: ClassVar[bool] = True

    def __init_subclass__(cls) -> None:
        _CLASSES.append(cls)

    @abstractmethod
    def source(self, column: Column) -> Quantity:
        """Return the quantity of the thermal state that a column is computed from."""

    def centre(self, column: Column) -> float:
        """Return the centre in ``x = (n - centre) / width`` of a column."""
        return float(getattr(column, self.centre_key, 0.0))

    def width(self, column: Column) -> float:
        """Return the width in ``x = (n - centre) / width`` of a column."""
        return float(getattr(column, self.width_key, 1.0))

    def largest(self, column: Column) -> float:
        """Return the largest possible magnitude of the value u of a column."""
        if self.bounds is not None:
            return max(map(abs, self.bounds))
        return (column.source.largest + abs(self.centre(column))) ** self.order

    def steepest(self, column: Column, raw: Floats, flow_k: float) -> float:
        """Return the largest slope [1/K] of values u; `flow_k` is the RMS of the gradient [K]."""
        if self.bounds is not None:
            return 1.0 / flow_k
        largest = float(np.abs(raw).max(initial=0.0)) ** (1.0 / self.order)
        return float(self.order * largest ** (self.order - 1)) * column.source.per_kelvin


def _lag_of_part(column: Column) -> lags.Lag:
    sensor = column.sensor if column.sensor_share else ''
    tau, second, share, lead = column.part
    return lags.Lag(lags.BOARD_INPUT, tau, second, sensor, share, lead)


class Gradient(Term):
    """The gradient g_s: effect of a heat flow between thermometer s and board."""

    kind, formula = 'gradient', 'g_s'
    groups: ClassVar[_Pairs] = (('gradient', 'heat flow (case − board)'),)

    def source(self, column: Column) -> Quantity:
        """Return g_s."""
        return state.Gradient(column.sensor)


class Rate(Term):
    """Rate of the board temperature: effect of a heat flow in a unit without case thermometer."""

    kind, formula = 'rate', 'dT_board/dt [K/s]'
    groups = (('rate', 'rate of the board temperature'),)

    def source(self, column: Column) -> Quantity:  # noqa: ARG002
        """Return dT_board/dt."""
        return state.Rate()


class Board(Term):
    """The lag of a part behind the board: effect of the part's temperature."""

    kind, formula = 'board', 'T_board - lagged T_board'
    positive: ClassVar[_Names] = ('tau_s',)
    groups: ClassVar[_Pairs] = (
        ('board', 'parts that lag the board'),
        # A curve of group `part` is a sum of the curve over the board temperature and of columns
        # of `board`, `product` and `square`, for each axis.
        ('part', 'curve of the part of each axis'),
    )

    def source(self, column: Column) -> Quantity:
        """Return ``T_board - L_tau(T_board)``, or for a bend without lag the board temperature."""
        return _lag_of_part(column) if column.tau_s else state.Board()


class GradientLag(Term):
    """A lagged gradient: effect of parts between the thermometers."""

    kind, formula, positive = 'gradient_lag', 'lagged g_s', ('tau_s',)
    groups = (
        ('gradient_lag', 'parts between case and board'),
        # The columns of the next two groups give coefficients that change with temperature.
        ('product', 'lags, with effects that change with temperature'),
        ('gradient_x_temperature', 'heat flow, with an effect that changes with temperature'),
    )

    def source(self, column: Column) -> Quantity:
        """Return ``L_tau(g_s)``."""
        return lags.Lag(column.sensor, *column.part[:2])


class Square(Term):
    """Square of the lag of a part, for a curve over its temperature; or square of g_s - rest."""

    kind, formula = 'square', '(T_board - lagged T_board)^2, or q_s^2 without lag'
    groups = (('square', 'curves of parts that lag'),)
    order, form, centre_key = 2, Form(lambda x: x * x, lambda x: 2.0 * x), 'rest_k'

    def source(self, column: Column) -> Quantity:
        """Return ``T_board - L_tau(T_board)``, or g_s."""
        return _lag_of_part(column) if column.tau_s else state.Gradient(column.sensor)


class Cube(Board):
    """Cube of the lag of a part, for a cubic curve over the temperature of the part."""

    kind, formula, groups = 'cube', '(T_board - lagged T_board)^3', ()
    order, form, centre_key = 3, Form(lambda x: x * x * x, lambda x: 3.0 * x * x), 'rest_k'


class Size(Gradient):
    """Magnitude of a gradient: effect of a heat load, such as the load of a heat pump."""

    kind, formula, groups = 'size', 'abs(q_s)', ()
    form, centre_key = Form(np.abs, np.sign), 'rest_k'


class GradientEven(Gradient):
    """Even function of a gradient, limited to 0..1: effect of a heat load that saturates."""

    kind, formula = 'gradient_even', 'tanh((q_s / width)^2)'
    groups = (
        ('gradient_even', 'size of the heat flow'),
        ('gradient_even_about_rest', 'size of the heat flow less that in a soak'),
    )
    form = Form(
        lambda x: by_element(math.tanh, x * x),
        lambda x: 2.0 * x * (1.0 - by_element(math.tanh, x * x) ** 2),
    )
    centre_key, width_key, positive, bounds = 'rest_k', 'width_k', ('width_k',), (0.0, 1.0)


class Play(Term):
    """A play operator: rate-independent hysteresis over temperature."""

    kind, formula, positive, has_scale = 'play', 'play(t) - t', ('width_k',), False
    groups = (('play', 'hysteresis'),)

    def source(self, column: Column) -> Quantity:
        """Return ``P(v) - v``, P the play of half-width `width_k`, v: t, or t lagged."""
        lag = _lag_of_part(column)
        return lags.Play(lag.tau_s, column.width_k, *lag[2:])


class Bend(Board):
    """A curve whose slope changes at one temperature of a part."""

    kind, formula, positive = 'bend', 'max(lagged t - knee_k, 0)', ()
    groups = (('bend', 'change of slope'),)
    form = Form(lambda x: np.maximum(x, 0.0), lambda x: (x > 0.0).astype(np.float64))
    centre_key, is_temperature, has_scale = 'knee_k', True, False


#: All kinds by name, in the order of their classes, which is also the order in the file's schema.
TERMS: Final[dict[str, Term]] = {cls.kind: cls() for cls in _CLASSES}
#: All groups of columns, each with its name in a certificate.
GROUPS: Final = {name: text for term in TERMS.values() for name, text in term.groups}
