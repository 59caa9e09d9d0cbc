# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the quantities of a unit's thermal state at a stamp, and their indices in a flat tuple."""

from dataclasses import dataclass
from typing import Final

from ..quantities import QUANTITIES
from .lags import BOARD_INPUT, MemorySpec, Quantity

#: The thermal memory is settled if the sd of every lag is below this limit [K].
MEMORY_SETTLED_SD: Final = 0.05
#: Lag of a board behind its case if the bags do not determine the lag [s]: 15 min, typical of a
#: housing of a few hundred grams in a chamber.
USUAL_BOARD_LAG_S: Final = 900.0

#: Indices of the first numbers of a thermal state: board temperature and its variance, its rate,
#: weight of the dynamic set, flag (1.0 while the regime is unknown), gradient of the first sensor
#: and its variance.
(BOARD, VAR_BOARD, RATE, WEIGHT, UNKNOWN, GRADIENT, VAR_GRADIENT) = range(7)


@dataclass(frozen=True)
class Board(Quantity):
    """The board temperature [degC]."""

    input: str = BOARD_INPUT


@dataclass(frozen=True)
class Rate(Quantity):
    """The rate of change of a thermometer's temperature [K/s]."""

    input: str = BOARD_INPUT
    largest = (QUANTITIES['temperature rate'].at_most or 0.0) / 60.0
    per_kelvin = 1.0 / USUAL_BOARD_LAG_S
    is_of_part = False
    by_board = 0.0


@dataclass(frozen=True)
class Gradient(Quantity):
    """The temperature of a sensor less the board temperature [K]."""

    input: str
    is_of_part = False
    by_board = -1.0


class StateLayout:
    """
    Order of the numbers of a thermal state: BOARD to UNKNOWN, (value, variance) pairs, plays.

    pairs: index of each quantity among the pairs; lag_pairs: slice of the lags among the pairs
    lags: index of each lag in `MemorySpec.lags`
    variances: slice of the state with the variances of all pairs
    numbers: meaning of each number: a quantity, (quantity, 'variance'), VAR_BOARD, WEIGHT, UNKNOWN
    places: index of each quantity in the state
    """

    def __init__(self, spec: MemorySpec) -> None:
        sensors: list[Quantity] = [*map(Gradient, spec.sensors), *map(Rate, spec.rates)]
        self.lags: dict[Quantity, int] = {lag: k for k, lag in enumerate(spec.lags)}
        quantities = [*sensors, *self.lags]
        self.pairs = {quantity: k for k, quantity in enumerate(quantities)}
        self.lag_pairs = slice(len(sensors), len(self.pairs))
        self.variances = slice(VAR_GRADIENT, GRADIENT + 2 * len(self.pairs), 2)
        numbers = [number for each in quantities for number in (each, (each, 'variance'))]
        self.numbers = (Board(), VAR_BOARD, Rate(), WEIGHT, UNKNOWN, *numbers, *spec.plays)
        self.width = len(self.numbers)
        self.places = {key: k for k, key in enumerate(self.numbers) if isinstance(key, Quantity)}
