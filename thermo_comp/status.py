# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what surrounds the compensator's arithmetic: its settings, its counters, its status.

"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .thermal import ThermalConfig, ThermalState


@dataclass(frozen=True)
class CompensatorConfig:
    """
    What the user sets beside the calibration.

    Parameters
    ----------
    transition_time_s : float
        Time over which the sets cross over after a switch [s]; 0 = the paper's hard switch.
    temperature_timeout_s : float
        Age of the board temperature at which nothing is published any more [s].
    case_timeout_s : float
        Age of the case temperature at which the regime falls back to the board sensor [s].

    Raises
    ------
    ValueError
        If a value is out of its range.

    """

    transition_time_s: float = 30.0
    temperature_timeout_s: float = 60.0
    case_timeout_s: float = 30.0

    def __post_init__(self) -> None:
        if not 0.0 < self.temperature_timeout_s < math.inf:
            raise ValueError(
                f'`temperature_timeout_s` must be positive, got {self.temperature_timeout_s}'
            )
        ThermalConfig(self.transition_time_s, self.case_timeout_s)


@dataclass(slots=True)
class Counters:
    """
    What came in and why some of it did not go out.

    """

    n_out: int = 0
    n_not_finite: int = 0
    n_saturated: int = 0
    n_out_of_order: int = 0
    n_no_temperature: int = 0
    n_stale: int = 0
    n_board: int = 0
    n_board_rejected: int = 0
    n_case: int = 0
    n_case_rejected: int = 0
    n_time_jumps: int = 0

    @property
    def n_dropped(self) -> int:
        """
        Samples that came in and did not go out.

        """
        return (
            self.n_not_finite
            + self.n_saturated
            + self.n_out_of_order
            + self.n_no_temperature
            + self.n_stale
        )

    @property
    def n_in(self) -> int:
        """
        Samples that came in.

        """
        return self.n_out + self.n_dropped


@dataclass(frozen=True, slots=True)
class CompensatorStatus:
    """
    Snapshot for diagnostics.

    """

    counters: Counters
    stamp_ns: int | None
    #: None until there is a board temperature.
    state: ThermalState | None
    #: Ages of the last used readings at the last sample [s]; infinite when there was none.
    board_age_s: float
    case_age_s: float
    is_board_stale: bool
    is_board_lost: bool
    is_case_lost: bool
    #: How far outside the calibrated ranges, in half ranges; 0 inside.
    relative_excess: float
    #: Board temperature beyond the calibrated range [K], signed; rate beyond [K/min].
    temperature_excess_k: float
    rate_excess_k_min: float
