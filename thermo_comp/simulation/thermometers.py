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

    Parameters
    ----------
    node : str
        Part whose temperature it reads.
    rate_hz : float, optional
        Readings per second.
    noise_sd : float, optional
        White noise of a reading, K.
    quantum : float, optional
        Step of the readings, K; 0 is continuous.
    offset : float, optional
        Constant error, K.
    phase : float, optional
        Instant of the first reading within its period, 0..1.
    outlier_probability : float, optional
        Chance that a reading is hit by an outlier.
    outlier_size : float, optional
        Largest outlier, either sign, K.
    gaps_s : tuple of (float, float), optional
        Spans from the start of the run in which readings are lost, start included, end not, s.

    Raises
    ------
    ValueError
        If the rate is not positive, or noise, quantum, phase or probability is out of range.

    """

    node: str
    rate_hz: float = 1.0
    noise_sd: float = 0.005
    quantum: float = 0.0
    offset: float = 0.0
    phase: float = 0.0
    outlier_probability: float = 0.0
    outlier_size: float = 5.0
    gaps_s: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if not (self.rate_hz > 0.0 and math.isfinite(self.rate_hz)):
            raise ValueError(f'`rate_hz` must be positive, got {self.rate_hz}')
        for name in ('noise_sd', 'quantum'):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f'`{name}` must not be negative, got {getattr(self, name)}')
        if not 0.0 <= self.phase < 1.0:
            raise ValueError(f'`phase` must lie in [0, 1), got {self.phase}')
        if not 0.0 <= self.outlier_probability <= 1.0:
            raise ValueError(
                f'`outlier_probability` must lie in [0, 1], got {self.outlier_probability}'
            )

    def read(
        self,
        response: ThermalResponse,
        duration: float,
        seed: int,
        noise: Stream,
        outliers: Stream,
    ) -> tuple[Ints, Floats]:
        """
        Take the readings of a run.

        Parameters
        ----------
        response : ThermalResponse
            True temperatures.
        duration : float
            Length of the run, s.
        seed : int
            Seed of the run.
        noise, outliers : Stream
            Streams of this thermometer.

        Returns
        -------
        stamp_ns : ndarray of int64, shape (m,)
            Instants from the start of the run, ns.
        reading : ndarray, shape (m,)
            Readings, degC.

        """
        n = math.floor(duration * self.rate_hz * (1.0 + 1e-12) - self.phase) + 1
        stamp_ns = np.rint((np.arange(max(n, 0)) + self.phase) * (_NS / self.rate_hz))
        time = stamp_ns / _NS
        true = response.temperatures(time)[:, response.network.nodes.index(self.node)]
        white = generator(seed, noise).standard_normal(len(time))
        reading = true + self.offset + self.noise_sd * white
        rng = generator(seed, outliers)
        chance = rng.random((len(time), 2))
        reading += np.where(
            chance[:, 0] < self.outlier_probability,
            self.outlier_size * (2.0 * chance[:, 1] - 1.0),
            0.0,
        )
        if self.quantum > 0.0:
            reading = self.quantum * np.rint(reading / self.quantum)
        is_kept = np.ones(len(time), dtype=bool)
        for first, last in self.gaps_s:
            is_kept &= (time < first) | (time >= last)
        return stamp_ns[is_kept].astype(np.int64), reading[is_kept]
