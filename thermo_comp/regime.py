# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the causal static/dynamic decision with its memory; it has no clock of its own.

"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

from .thermometer import Thermometer, ThermometerSettings

_SIGMAS = 5.0


class Regime(IntEnum):
    """
    What the surroundings do to the unit.

    """

    UNKNOWN = -1
    STATIC = 0
    DYNAMIC = 1


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """
    What the detector must see and what it must not; the calibration file's `detector` section.

    Parameters
    ----------
    smallest_ramp_k_min : float
        The slowest ramp that must never be missed, K/min.
    false_alarms_per_hour : float
        How often noise alone may open the dynamic state, per hour of soak.
    soak_rate_k_min : float
        The rate that a soak itself shows (ripple of the chamber), K/min.
    relaxed_rate_k_min : float
        The lag has died when both rates are surely below this, K/min.
    dwell_s : float
        The shortest stay in a state, s.
    case, board : ThermometerSettings
        The two sensors.

    Raises
    ------
    ValueError
        If a value is not finite or outside its range.

    """

    smallest_ramp_k_min: float = 0.2
    false_alarms_per_hour: float = 0.01
    soak_rate_k_min: float = 0.015
    relaxed_rate_k_min: float = 0.05
    dwell_s: float = 60.0
    case: ThermometerSettings = field(default_factory=ThermometerSettings)
    board: ThermometerSettings = field(default_factory=ThermometerSettings)

    def __post_init__(self) -> None:
        """
        Refuse values that contradict each other.

        """
        for name in ('smallest_ramp_k_min', 'false_alarms_per_hour', 'relaxed_rate_k_min'):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f'`{name}` must be positive and finite, got {value}')
        for name in ('soak_rate_k_min', 'dwell_s'):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f'`{name}` must be zero or positive, got {value}')


class RegimeDetector:
    """
    State machine over the estimates of the case and the board.

    Parameters
    ----------
    settings : DetectorSettings
        Thresholds in physical terms.

    """

    def __init__(self, settings: DetectorSettings) -> None:
        self.settings = settings
        self._soak_rate = settings.soak_rate_k_min / 60.0
        self._relaxed_rate = settings.relaxed_rate_k_min / 60.0
        self._dwell_ns = round(settings.dwell_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """
        Back to unknown.

        """
        self.regime = Regime.UNKNOWN
        self.direction = 0
        self.switched_ns: int | None = None
        self._calm_ns: int | None = None

    def update(self, stamp_ns: int, case: Thermometer | None, board: Thermometer | None) -> Regime:
        """
        Decide after an accepted reading of the leading sensor.

        Parameters
        ----------
        stamp_ns : int
            Stamp of that reading, ns.
        case, board : Thermometer or None
            The two estimates; None for a sensor that is lost.

        Returns
        -------
        Regime
            The regime from this stamp on.

        """
        lead = case if case is not None else board
        if lead is None or not lead.is_ready:
            return self.regime
        speed = abs(lead.rate)
        doubt = math.sqrt(lead.var_rate)
        sensors = [one for one in (case, board) if one is not None and one.is_ready]
        is_calm = all(
            abs(one.rate) + 2.0 * math.sqrt(one.var_rate) < self._relaxed_rate for one in sensors
        )
        if not is_calm:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = stamp_ns
        if self.regime != Regime.DYNAMIC:
            floor = self._soak_rate if self.regime == Regime.STATIC else self._relaxed_rate
            if speed > floor + _SIGMAS * doubt:
                self._switch(stamp_ns, Regime.DYNAMIC)
        if self.regime != Regime.STATIC and self._calm_ns is not None:
            start = self._calm_ns
            if self.switched_ns is not None and self.switched_ns > start:
                start = self.switched_ns
            if stamp_ns - start >= self._dwell_ns:
                self._switch(stamp_ns, Regime.STATIC)
        if self.regime == Regime.DYNAMIC and speed > self._soak_rate + 2.0 * doubt:
            self.direction = 1 if lead.rate > 0.0 else -1
        return self.regime

    def _switch(self, stamp_ns: int, regime: Regime) -> None:
        self.regime = regime
        self.switched_ns = stamp_ns
        if regime == Regime.STATIC:
            self.direction = 0
