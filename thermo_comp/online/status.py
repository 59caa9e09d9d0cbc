# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what surrounds the compensator's arithmetic: its settings, its counters, its status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from operator import attrgetter

from ..thermal.plausibility import Fault
from ..thermal.settings import ThermalConfig, refuse_outside
from ..thermal.state import ThermalState


@dataclass(frozen=True)
class CompensatorConfig(ThermalConfig):
    """What the user sets beside the calibration; ValueError if a value is out of its range."""

    #: Time after which samples that are equal to the bit are not believed [s], and three exact
    #: zeros never are; 0 = any sample is believed.
    stuck_timeout_s: float = 2.0
    #: Gravity where the platform stands [m/s^2]; 0 = that of the calibration.
    local_gravity_m_s2: float = 0.0
    #: What |f| at rest may miss gravity by [m/s^2]; beyond it the calibration is another unit's,
    #: or an axis is reversed, and nothing is published; 0 = anything.
    gravity_tolerance_m_s2: float = 0.5

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        super().__post_init__()
        refuse_outside(
            self,
            positive=(),
            not_negative=('stuck_timeout_s', 'local_gravity_m_s2', 'gravity_tolerance_m_s2'),
        )


#: The counters of samples that came in and did not go out.
DROPPED = (
    'n_not_finite',
    'n_saturated',
    'n_out_of_order',
    'n_no_temperature',
    'n_stale',
    'n_stuck',
    'n_too_fast',
    'n_refuted',
)
_dropped = attrgetter(*DROPPED)


@dataclass(slots=True)
class Counters:
    """What came in and why some of it did not go out."""

    n_out: int = 0
    n_not_finite: int = 0
    n_saturated: int = 0
    n_out_of_order: int = 0
    n_no_temperature: int = 0
    n_stale: int = 0
    n_stuck: int = 0
    n_too_fast: int = 0
    n_refuted: int = 0
    n_board: int = 0
    n_board_rejected: int = 0
    n_case: int = 0
    n_case_rejected: int = 0
    n_time_jumps: int = 0

    @property
    def n_dropped(self) -> int:
        """Samples that came in and did not go out."""
        return sum(_dropped(self))

    @property
    def n_in(self) -> int:
        """Samples that came in."""
        return self.n_out + self.n_dropped


@dataclass(frozen=True, slots=True)
class GravityResidual:
    """What the still windows say."""

    #: |f| - g [m/s^2], averaged over the recent still windows.
    residual: float
    #: Its standard deviation [m/s^2]: what calibration and noise leave uncertain.
    residual_sd: float
    #: Still windows that went into it.
    n_windows: int
    #: Whether the last window was still.
    is_still: bool

    @property
    def sigmas(self) -> float:
        """Size of the residual in its own standard deviations."""
        return abs(self.residual) / self.residual_sd


@dataclass(frozen=True, slots=True)
class CompensatorStatus:
    """Snapshot for diagnostics."""

    counters: Counters
    stamp_ns: int | None
    #: None until there is a board temperature.
    state: ThermalState | None = None
    #: Ages of the last used readings at the last sample [s]; infinite when there was none.
    board_age_s: float = inf
    case_age_s: float = inf
    is_board_stale: bool = True
    is_board_lost: bool = True
    is_case_lost: bool = True
    #: How far outside the calibrated ranges, in half ranges; 0 inside.
    relative_excess: float = 0.0
    #: Board temperature beyond the calibrated range [K], signed; rate beyond [K/min].
    temperature_excess_k: float = 0.0
    rate_excess_k_min: float = 0.0
    #: T_case - T_board beyond the calibrated range [K], signed.
    gradient_excess_k: float = 0.0
    #: By thermometer what is wrong with its readings, and the size of a step not believed [K].
    faults: Mapping[str, tuple[Fault, float]] = field(default_factory=dict)
    #: Whether the board has led the case in a ramp: the two topics are swapped, most likely.
    is_lead_reversed: bool = False
    #: |f| - g while the platform stands; None before it has stood.
    gravity: GravityResidual | None = None
    #: Whether |f| at rest misses gravity by more than the tolerance: nothing is published.
    is_refuted: bool = False
    #: What is uncertain of the bias of each axis' angular rate [rad/s]; None where none is known.
    rate_bias_sd: tuple[float, ...] | None = None
    #: How far the stamps of the readings that wait are ahead of the samples' [s].
    pending_ahead_s: float = 0.0
