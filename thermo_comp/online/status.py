# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the settings and counters of the compensator."""

from dataclasses import dataclass, fields
from typing import NamedTuple

from ..quantities import NotNegative
from ..thermal.settings import ThermalConfig


@dataclass(frozen=True)
class CompensatorConfig(ThermalConfig):
    """Settings of the compensator; ValueError if a value is out of its range."""

    #: Longest accepted repetition of equal readings [s], on all axes, or on one axis while the
    #: others change or show noise; later repetitions are dropped. Samples of three zeros are
    #: dropped at once. 0 = repetitions and zeros are accepted.
    stuck_timeout_s: NotNegative = 2.0
    #: Gravity at the place of use [m/s^2]; 0 = the gravity of the calibration.
    local_gravity_m_s2: NotNegative = 0.0
    #: Largest accepted error of |f| at rest [m/s^2], beyond 5 sd; after a larger error, as with a
    #: calibration of another unit, nothing is published; 0 = no limit.
    gravity_tolerance_m_s2: NotNegative = 0.5


@dataclass(slots=True)
class Dropped:
    """Numbers of dropped samples by reason."""

    n_not_finite: int = 0
    n_saturated: int = 0
    n_out_of_order: int = 0
    n_no_temperature: int = 0
    n_stale: int = 0
    n_stuck: int = 0
    n_too_fast: int = 0
    n_refuted: int = 0
    n_unsound: int = 0  # samples whose correction is not finite


DROPPED = tuple(field.name for field in fields(Dropped))


@dataclass(slots=True)
class Counters(Dropped):
    """Numbers of published and dropped samples, used and rejected readings, and time jumps."""

    n_out: int = 0
    n_board: int = 0
    n_board_rejected: int = 0
    n_case: int = 0
    n_case_rejected: int = 0
    n_time_jumps: int = 0

    @property
    def n_in(self) -> int:
        """Number of samples received."""
        n_dropped: int = sum(getattr(self, name) for name in DROPPED)
        return self.n_out + n_dropped


class GravityResidual(NamedTuple):
    """Mean |f| - g of still windows [m/s^2]; `is_still`: whether the last window was still."""

    residual: float
    residual_sd: float
    n_windows: int
    is_still: bool
