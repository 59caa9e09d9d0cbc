# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the two thermometers as built: rate, noise, quantum, offset, outliers and gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..typing import Floats, Ints
from .response import ThermalResponse
from .streams import Stream, generator

_NS = 1_000_000_000


@dataclass(frozen=True)
class ThermometerModel:
    """
    One thermometer on one part: ``reading = quantum * round((T + offset + noise) / quantum)``.

    White noise, quantum (0 is continuous) and offset in K; `phase` is the instant of the first
    reading within its period, 0..1.

    Raises ValueError if the rate is not positive, or noise, quantum or phase is out of range.
    """

    node: str
    rate_hz: float = 1.0
    noise_sd: float = 0.005
    quantum: float = 0.0
    offset: float = 0.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        if not (self.rate_hz > 0.0 and math.isfinite(self.rate_hz)):
            raise ValueError(f'`rate_hz` must be positive, got {self.rate_hz}')
        for name in ('noise_sd', 'quantum'):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f'`{name}` must not be negative, got {getattr(self, name)}')
        if not 0.0 <= self.phase < 1.0:
            raise ValueError(f'`phase` must lie in [0, 1), got {self.phase}')

    def read(
        self, response: ThermalResponse, duration: float, seed: int, noise: Stream
    ) -> tuple[Ints, Floats]:
        """Take the readings [degC] of a run, with their stamps [ns] from its start."""
        n = math.floor(duration * self.rate_hz * (1.0 + 1e-12) - self.phase) + 1
        stamp_ns = np.rint((np.arange(max(n, 0)) + self.phase) * (_NS / self.rate_hz))
        time = stamp_ns / _NS
        true = response.temperatures(time)[:, response.network.nodes.index(self.node)]
        white = generator(seed, noise).standard_normal(len(time))
        reading = true + self.offset + self.noise_sd * white
        if self.quantum > 0.0:
            reading = self.quantum * np.rint(reading / self.quantum)
        return stamp_ns.astype(np.int64), reading
