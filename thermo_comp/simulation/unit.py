# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the simulated instrument: its parts, its drift, its converter and its thermometers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..typing import Floats
from ..unit.gravity import MICRO_G
from .converter import Converter
from .drift import ZERO, DriftModel, Effect, Triple
from .gyro import GyroModel
from .network import ThermalNetwork
from .streams import Stream, generator
from .thermometers import ThermometerModel


@dataclass(frozen=True)
class SwitchedLoad:
    """Electronics that heat a part with `power` [W] for random spells [s], off at first."""

    part: str
    power: float
    spell: tuple[float, float] = (900.0, 3600.0)


@dataclass(frozen=True)
class UnitModel:
    """
    One physical unit with all its constants: the truth that a calibration looks for.

    Per axis, ``counts = K * scale(T) * s + bias(T) + noise`` summed into whole counts, where ``s =
    inverse(M) @ f`` is the specific force along the sensitivity axes.

    scale_factor: K per axis at the reference temperature, counts/cycle per m/s^2
    bias_at_reference: bias per axis at the reference temperature, counts/cycle
    misalignment: M, lower triangular with unit diagonal: from the sensitivity axes to the
        orthogonal frame, shape (3, 3)
    noise_density: white noise of the acceleration per axis, ug/sqrt(Hz): the mean over `T` seconds
        has the standard deviation ``noise_density / sqrt(T)``
    reference_temperature: reading of the board's part at which K and bias hold in still air, degC
    bias_walk: random walk of the bias per axis within a run, ug per square root of an hour
    loads: loads beside the constant powers
    gyro: the gyroscope beside it, if there is one
    """

    name: str
    serial: str
    network: ThermalNetwork
    drift: DriftModel
    board: ThermometerModel
    case: ThermometerModel
    scale_factor: Triple
    bias_at_reference: Triple
    misalignment: tuple[Triple, Triple, Triple]
    noise_density: Triple
    converter: Converter
    reference_temperature: float = 20.0
    bias_walk: Triple = ZERO
    loads: tuple[SwitchedLoad, ...] = ()
    gyro: GyroModel | None = None

    @property
    def counts_per_micro_g(self) -> Floats:
        """What a micro-g is per axis, shape (3,), counts/cycle."""
        return np.array(self.scale_factor) * MICRO_G

    @property
    def M(self) -> Floats:
        """Misalignment matrix, shape (3, 3)."""
        return np.array(self.misalignment)

    @property
    def origin(self) -> Floats:
        """
        Temperatures [degC] of the parts in the still state of the reference, shape (n_parts,).
        """
        air = self.network.air_for(self.board.node, self.reference_temperature)
        return self.network.equilibrium(air)

    def with_thermometers(self, **changes: Any) -> UnitModel:
        """Return the unit with other thermometers, the same changes on board and case."""
        board, case = (replace(one, **changes) for one in (self.board, self.case))
        return replace(self, board=board, case=case)

    def sibling(self, seed: int, spread: float = 0.15) -> UnitModel:
        """
        Return another unit of the same type: every coefficient and time constant a bit different.

        `spread` is the largest relative difference of a coefficient, a width or a heat capacity;
        constants and misalignment are its own.
        """
        rng = generator(seed, Stream.SIBLING)

        def near(value: float) -> float:
            return float(value * (1.0 + spread * rng.uniform(-1.0, 1.0)))

        def changed(effect: Effect) -> Effect:
            values: dict[str, float | Triple] = {}
            for name, value in vars(effect).items():
                if isinstance(value, tuple):
                    values[name] = near(value[0]), near(value[1]), near(value[2])
                elif isinstance(value, float) and name != 'exponent':
                    values[name] = near(value)
            return replace(effect, **values)  # type: ignore[arg-type]

        capacity = {name: near(value) for name, value in self.network.capacity.items()}
        K = np.array(self.scale_factor) * (1.0 + 0.005 * rng.standard_normal(3))
        bias = np.array(self.bias_at_reference) + 200.0 * MICRO_G * K * rng.standard_normal(3)
        M = self.M + 1e-3 * np.tril(rng.standard_normal((3, 3)), -1)
        return replace(
            self,
            serial=f'{self.serial}-{seed:02d}',
            network=replace(self.network, capacity=capacity),
            drift=DriftModel(tuple(changed(effect) for effect in self.drift.effects)),
            scale_factor=_triple(K),
            bias_at_reference=_triple(bias),
            misalignment=(_triple(M[0]), _triple(M[1]), _triple(M[2])),
        )

    def without_noise(self) -> UnitModel:
        """Return the unit with no white noise on the axes and the thermometers."""
        return replace(self.with_thermometers(noise_sd=0.0), noise_density=ZERO)

    def without_drift(self) -> UnitModel:
        """Return the unit with bias and scale that do not depend on temperature."""
        return replace(self, drift=DriftModel())


def _triple(values: Floats) -> Triple:
    x, y, z = values.tolist()
    return x, y, z
