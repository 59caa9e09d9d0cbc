# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the base class of the quantities of the thermal state."""

from typing import ClassVar

from ..quantities import QUANTITIES


class Quantity:
    """A quantity of the thermal state, from readings of `input` (a gradient: and of the board)."""

    input: str
    #: Largest magnitude of the quantity that a calibration may contain.
    largest: ClassVar[float] = QUANTITIES['temperature span'].at_most or 0.0
    #: Typical change of the quantity per kelvin of temperature change.
    per_kelvin: ClassVar[float] = 1.0
    #: Whether the quantity is computed with the lag of one part of the unit; the board's lag is 0.
    is_of_part: ClassVar[bool] = True

    @property
    def inputs(self) -> tuple[str, ...]:
        """The thermometers of the quantity; of a gradient, the sensor without the board."""
        return (self.input,)

    @property
    def by_board(self) -> float:
        """Derivative w.r.t. the board temperature, with lags and other thermometers constant."""
        return float(self.input == 'board')
