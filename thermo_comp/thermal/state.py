# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal state of a unit at one stamp, by name.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from .regime import Regime

#: A memory is called settled when its start-up uncertainty is below this [K].
MEMORY_SETTLED_SD: Final = 0.05


@dataclass(frozen=True, slots=True)
class ThermalState:
    """
    The thermal state at one stamp.

    """

    #: Board temperature [degC], its variance [K^2] and its rate [K/s].
    board: float
    var_board: float
    rate: float
    #: T_case - T_board [K] and the part of its variance that does not come from the board.
    gradient: float
    var_gradient: float
    #: Weight of the dynamic set, 0..1.
    weight: float
    regime: Regime
    #: -1 cooling, +1 heating, 0 neither.
    direction: int
    #: T_board minus its lags [K], and the variance that start-up left in them [K^2].
    memory: tuple[float, ...]
    var_memory: tuple[float, ...]

    @property
    def is_settled(self) -> bool:
        """
        Whether the memory has forgotten that its start was not seen.

        """
        return all(variance < MEMORY_SETTLED_SD**2 for variance in self.var_memory)
