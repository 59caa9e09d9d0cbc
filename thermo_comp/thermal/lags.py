# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the definitions of lags and play operators, and the covariance of their initial states.

The lagged value L of an input u obeys ``dL/dt = (u - L) / tau``; the stored state is
``m = u - L``. For two stages in series, of time constants ``tau_1 > tau_2``, and a lead theta, m
is a weighted sum of the states m_1 and m_2 of two first-order lags,
``m = ((tau_1 - theta) m_1 - (tau_2 - theta) m_2) / (tau_1 - tau_2)``. A part between the board
and a sensor s lags ``T + v G``, with the board temperature T, the gradient ``G = T_s - T`` and its
share v, so ``m = T - L(T + v G)`` is ``T - L(T)`` less ``v L(G)`` (docs/theory.md, Parts).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from ..quantities import QUANTITIES
from ..typing import Floats

#: Name of the board temperature as the input of a lag or play.
BOARD_INPUT: Final = 'board'
#: Relative increase of the variances of initial lag states: the states of lags with similar time
#: constants are almost collinear, so that their covariance would not be invertible.
START_JITTER: Final = 3e-4
#: Prior sd [K] of the initial state of a lag with the time constant `START_TAU_S` [s].
BOARD_START_SD: Final = 3.0  # for a lag of the board temperature
GRADIENT_START_SD: Final = 1.0  # for a lag of a gradient
START_TAU_S: Final = 3600.0


class Quantity:
    """A quantity of the thermal state; `input`: its thermometer, for a gradient the sensor."""

    input: str
    #: Largest magnitude of the quantity that a calibration may contain.
    largest: ClassVar[float] = QUANTITIES['temperature span'].at_most or 0.0
    #: Typical change of the quantity per kelvin of temperature change.
    per_kelvin: ClassVar[float] = 1.0
    #: Whether the quantity depends on the temperature of a part, which lags the board by >= 0 s.
    is_of_part: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the thermometers; for a gradient (sensor less board) the sensor alone."""
        return (self.input,)

    @property
    def by_board(self) -> float:
        """Derivative of the quantity w.r.t. T_board, with lags and other thermometers constant."""
        return float(self.input == BOARD_INPUT)


class _Lag(NamedTuple):
    input: str
    tau_s: float
    second_tau_s: float = 0.0
    sensor: str = ''
    sensor_share: float = 0.0
    lead_s: float = 0.0


class Lag(_Lag, Quantity):
    """
    A lag [K]: T_board less the temperature of a part or, if `input` is a sensor, the lagged
    gradient of the sensor.

    tau_s, second_tau_s: time constants of two stages [s]; the second is shorter, 0 for one stage
    sensor, sensor_share: a part may lag T_board plus `sensor_share` times the gradient of `sensor`
    lead_s: lag of the board thermometer behind the temperature that drives the part [s]
    """

    @property
    def by_board(self) -> float:
        """Derivative of the lag w.r.t. T_board at constant lagged values (L, module docstring)."""
        if self.input != BOARD_INPUT:
            return 0.0
        return 1.0 if self.second_tau_s else self.shares[0]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the lag's thermometers: `input`, and `sensor` if its gradient has a share."""
        return (self.input, self.sensor) if self.sensor else (self.input,)

    @property
    def first_order_weights(self) -> dict[tuple[str, float], float]:
        """Weights of the first-order lags that sum to this lag, by (input, time constant [s])."""
        stages = list(zip((self.tau_s, self.second_tau_s), self.shares, strict=True))
        return {
            (name, tau): factor * share
            for name, factor in zip(self.inputs, (1.0, -self.sensor_share), strict=False)
            for tau, share in stages
            if tau
        }

    @property
    def shares(self) -> tuple[float, float]:
        """Weights of the first-order lags with time constants `tau_s` and `second_tau_s`."""
        tau, second, lead = self.tau_s, self.second_tau_s, self.lead_s
        return (tau - lead) / (tau - second), (lead - second) / (tau - second) if second else 0.0

    def remaining_share(self, age_s: Any, exp: Any = math.exp) -> Any:
        """Return sd of the lag due to its initial state after `age_s` [s] / this sd at age 0."""
        first = exp(-age_s / self.tau_s)
        if not self.second_tau_s:
            return first
        # The variance of the sum of two first-order lags follows from `start_covariance`.
        second = exp(-age_s / self.second_tau_s)
        a, b = self.shares
        tau, tau_2 = self.tau_s, self.second_tau_s
        both = 4.0 * a * b * tau * tau_2 / (tau + tau_2)
        remaining = a * a * tau * first * first + both * first * second
        remaining = remaining + b * b * tau_2 * second * second
        return (remaining / (a * a * tau + both + b * b * tau_2)) ** 0.5


class _Play(NamedTuple):
    tau_s: float
    width_k: float
    second_tau_s: float = 0.0
    sensor: str = ''
    sensor_share: float = 0.0
    lead_s: float = 0.0


class Play(_Play, Quantity):
    """
    Output of a play of half-width `width_k` less its input [K]. The input is the lagged board
    temperature, or the board temperature if `tau_s` is 0. An error of the input shifts input and
    output equally, so their difference is taken as free of error.
    """

    input = BOARD_INPUT

    @property
    def lag(self) -> Lag | None:
        """The lag of the play's input behind the board; None if the input has no lag."""
        return Lag(BOARD_INPUT, self.tau_s, *self[2:]) if self.tau_s else None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the play's thermometers: 'board', and the `sensor` of its lag if it has one."""
        return self.lag.inputs if self.lag else (self.input,)


@dataclass(frozen=True)
class MemorySpec:
    """
    Contents of the thermal state of a tracker.

    sensors: names of the thermometers other than the board's, the leading sensor first
    lags: lags of the board, then lags of each sensor
    rates: sensors whose temperature rate is in the thermal state
    """

    sensors: tuple[str, ...] = ('case',)
    lags: tuple[Lag, ...] = ()
    plays: tuple[Play, ...] = ()
    rates: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, 'lags', tuple(Lag(*lag) for lag in self.lags))
        object.__setattr__(self, 'plays', tuple(Play(*play) for play in self.plays))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the thermometers: the board, then `sensors`."""
        return (BOARD_INPUT, *self.sensors)


def first_order_lags(lags: Iterable[Lag]) -> tuple[tuple[str, float], ...]:
    """Return input and time constant [s] of each first-order lag in the sums of `lags`."""
    return tuple(dict.fromkeys(term for lag in lags for term in lag.first_order_weights))


def start_covariance(lags: Sequence[tuple[Any, ...]]) -> Floats:
    """Return the prior covariance of lags at the first reading of their input, (n, n) [K^2]."""
    root = start_root(lags)
    return np.asarray(root @ root.T)


def start_root(lags: Sequence[tuple[Any, ...]]) -> Floats:
    """
    Return a matrix whose product with its transpose is `start_covariance`, shape (n, number of
    first-order lags) [K]. (Nearly equal lags may make `start_covariance` singular.)

    The input before the first reading is modelled as a random walk with ``D = 2 sd^2 /
    START_TAU_S`` [K^2/s]: lags k, l of one input have the covariance ``P_kl = D tau_k tau_l /
    (tau_k + tau_l)``, lags of different inputs are uncorrelated. In s seconds P_kl changes by the
    factor ``exp(-s/tau_k - s/tau_l)``.
    """
    all_lags = [Lag(*lag) for lag in lags]
    terms = first_order_lags(all_lags)
    tau = np.array([tau for _, tau in terms])
    names = np.array([name for name, _ in terms])
    sd = np.where(names == BOARD_INPUT, BOARD_START_SD, GRADIENT_START_SD)
    with np.errstate(invalid='ignore'):
        shape = tau[:, np.newaxis] * tau / (tau[:, np.newaxis] + tau)
    is_same = names[:, np.newaxis] == names
    shape[np.diag_indices_from(shape)] *= 1.0 + START_JITTER
    covariance = np.where(is_same, 2.0 / START_TAU_S * sd * sd * shape, 0.0)
    weights = [[lag.first_order_weights.get(term, 0.0) for term in terms] for lag in all_lags]
    matrix = np.array(weights).reshape(len(all_lags), len(terms))
    return np.asarray(matrix @ np.linalg.cholesky(covariance))
