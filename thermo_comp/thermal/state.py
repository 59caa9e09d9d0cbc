# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thermal state of a unit at one stamp: by name, and as the flat tuple of a sample."""

from typing import Final

from .memory import MemorySpec

#: Sd of every lag below which the memory counts as settled [K].
MEMORY_SETTLED_SD: Final = 0.05

#: Layout of `ThermalTracker.sample`: from `GRADIENT` on (gradient, variance) per sensor, then
#: (lag, extra variance) per lag, then each play less its input (`Layout` says where).
(BOARD, VAR_BOARD, RATE, WEIGHT, UNKNOWN, GRADIENT, VAR_GRADIENT) = range(7)


class Layout:
    """Index of each gradient, lag and play in a sample; a variance follows a gradient or lag."""

    def __init__(self, spec: MemorySpec) -> None:
        self.gradients = {name: GRADIENT + 2 * k for k, name in enumerate(spec.sensors)}
        self.first_lag = GRADIENT + 2 * len(spec.sensors)
        self.lags = {lag: self.first_lag + 2 * k for k, lag in enumerate(spec.lags)}
        self.first_play = self.first_lag + 2 * len(spec.lags)
        self.plays = {play: self.first_play + k for k, play in enumerate(spec.plays)}
        self.width = self.first_play + len(spec.plays)
