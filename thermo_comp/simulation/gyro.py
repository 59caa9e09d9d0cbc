# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the simulated gyroscope: a bias driven by the parts' temperatures, of scale 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..typing import Floats
from ..unit.gravity import EARTH_RATE
from ..unit.gyroscope import MILLIDEGREE
from .drift import DriftModel, PartHistory, Triple
from .streams import Stream, generator


@dataclass(frozen=True)
class GyroModel:
    """
    The gyroscope of a unit at rest.

    drift: as of the accelerometer, but with biases in mdeg/s instead of ug
    bias_at_reference: in still air at the reference temperature, mdeg/s
    noise_density: white noise per axis, mdeg/s per sqrt(Hz)
    turn_on: what the bias differs by from run to run, sd, mdeg/s
    """

    drift: DriftModel
    bias_at_reference: Triple
    noise_density: Triple
    turn_on: float

    def bias(self, history: PartHistory) -> Floats:
        """Return the bias on the thermal grid, rad/s, shape (m, 3)."""
        drift, _ = self.drift.evaluate(history)
        return np.asarray((drift + np.array(self.bias_at_reference)) * MILLIDEGREE)

    def constant(self, seed: int) -> Floats:
        """
        Return what a run reads beside the bias: the Earth's rate, in an attitude of its own, and
        the turn-on; rad/s, shape (3,).
        """
        rng = generator(seed, Stream.GYRO_OFFSET)
        north = rng.standard_normal(3)
        turn_on = self.turn_on * MILLIDEGREE * rng.standard_normal(3)
        return np.asarray(EARTH_RATE * north / np.linalg.norm(north) + turn_on)
