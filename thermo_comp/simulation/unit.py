# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the simulated unit: converter, thermometers, gyroscope, streams of random numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..typing import Floats, Ints
from ..unit.gravity import EARTH_RATE, MICRO_G, STANDARD_GRAVITY
from ..unit.rate_bias import MILLIDEGREE
from .drift import ZERO, Effect, PartHistory, Triple, drift_of
from .network import ThermalNetwork, ThermalResponse

_NS = 1_000_000_000
REFERENCE_C = 20.0  # board temperature, in a soak, at which K and bias are stated [degC]
_RANGE = -(1 << 15), (1 << 15) - 1  # range of the converter's output [counts]
_FRACTION_BITS = 40  # a charge is an integer multiple of 2^-40 counts
_ONE = 1 << _FRACTION_BITS
# Rows summed at a time: the sum of 2^20 fractions below 2^40 does not overflow 64 bits.
_ROWS = 1 << 20


class Stream(IntEnum):
    """
    Sources of random numbers, such as the noise of the accelerometer. Each source has a separate
    stream: numbers drawn from one source do not change the numbers of other sources. The value of
    a source must never change or be reused: it determines the random numbers of a seed.
    """

    ACCEL_NOISE = 0
    CONVERTER_PHASE = 1
    BOARD_NOISE = 2
    CASE_NOISE = 3
    UNIT = 8
    POSITIONS = 9
    CYCLOGRAM = 10
    BIAS_WALK = 11
    LOAD = 13
    SIBLING = 14
    GYRO_NOISE = 15
    GYRO_OFFSET = 16
    SPIN = 17


def generator(seed: int, stream: Stream, axis: int = 0) -> np.random.Generator:
    """Return the random generator of a source and an axis (or another index)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(stream), axis)))


def white(seed: int, stream: Stream) -> Callable[[int], Floats]:
    """Return a function that draws the next n standard normal numbers of each axis, (n, 3)."""
    axes = [generator(seed, stream, axis) for axis in range(3)]
    return lambda n: np.stack([axis.standard_normal(n) for axis in axes], axis=1)


def first_charge(seed: int) -> Ints:
    """Return the charge on the integrators at power-on, shape (3,), in units of 2^-40 counts."""
    phases = [generator(seed, Stream.CONVERTER_PHASE, axis).integers(_ONE) for axis in range(3)]
    return np.array(phases, dtype=np.int64)


def balanced(charge: Floats, remainder: Ints) -> tuple[NDArray[np.int32], Ints]:
    """
    Convert the real-valued counts of consecutive cycles, shape (n, 3), to 16-bit integers.

    The `remainder` of a cycle, in fixed point, is added to the next cycle: the sum of the counts
    follows the integral of the input to within one count at any time, whatever the block size.
    Charge beyond the output range is lost, as in a saturated integrator.
    """
    counts = np.empty(charge.shape, dtype=np.int32)
    for first in range(0, len(charge), _ROWS):
        rows = charge[first : first + _ROWS]
        # Eq. (1) of Golovach's paper.
        whole = np.floor(rows)
        fraction = np.rint((rows - whole) * _ONE).astype(np.int64)
        total = np.cumsum(fraction, axis=0) + remainder
        carried = total >> _FRACTION_BITS
        carry = np.diff(carried, axis=0, prepend=0)
        counts[first : first + _ROWS] = np.clip(whole + carry, *_RANGE)
        remainder = total[-1] - (carried[-1] << _FRACTION_BITS)
    return counts, remainder


def rounded(charge: Floats, remainder: Ints) -> tuple[NDArray[np.int32], Ints]:
    """Round the counts of every cycle independently, as a sampling converter does."""
    return np.clip(np.rint(charge), *_RANGE).astype(np.int32), remainder


@dataclass(frozen=True)
class ThermometerModel:
    """
    A thermometer on a part: ``reading = quantum * round((T + noise) / quantum)``; a quantum of 0
    means no rounding. `phase`: time of the first reading / interval between readings, 0..1.
    """

    node: str
    rate_hz: float = 1.0
    noise_sd: float = 0.005
    quantum: float = 0.0
    phase: float = 0.0

    def read(
        self, response: ThermalResponse, duration: float, seed: int, noise: Stream
    ) -> tuple[Ints, Floats]:
        """Return the stamps of readings, from the start of the run [ns], and readings [degC]."""
        n = math.floor(duration * self.rate_hz * (1.0 + 1e-12) - self.phase) + 1
        stamp_ns = np.rint((np.arange(max(n, 0)) + self.phase) * (_NS / self.rate_hz))
        time = stamp_ns / _NS
        true = response.temperatures(time)[:, response.network.nodes.index(self.node)]
        white = generator(seed, noise).standard_normal(len(time))
        reading = true + self.noise_sd * white
        if self.quantum > 0.0:
            reading = self.quantum * np.rint(reading / self.quantum)
        return stamp_ns.astype(np.int64), reading


@dataclass(frozen=True)
class GyroModel:
    """
    The gyroscope of a unit, with a scale of 1. All values are in mdeg/s, `noise_density` in mdeg/s
    per root Hz; the bias coefficients of `drift`, elsewhere in ug, are in mdeg/s, too. `turn_on`:
    sd of the bias between runs.
    """

    drift: tuple[Effect, ...]
    bias_at_reference: Triple
    noise_density: Triple
    turn_on: float

    def bias(self, history: PartHistory) -> Floats:
        """Return the gyroscope's bias at the times of `history` [rad/s], shape (m, 3)."""
        drift, _ = drift_of(self.drift, history)
        return np.asarray((drift + np.array(self.bias_at_reference)) * MILLIDEGREE)

    def constant(self, seed: int) -> Floats:
        """Return the Earth rate in a random attitude plus the turn-on bias [rad/s], (3,)."""
        rng = generator(seed, Stream.GYRO_OFFSET)
        north = rng.standard_normal(3)
        turn_on = self.turn_on * MILLIDEGREE * rng.standard_normal(3)
        return np.asarray(EARTH_RATE * north / np.linalg.norm(north) + turn_on)


@dataclass(frozen=True)
class Bend:
    """
    Nonlinear terms ``K2 f^2 + K3 f^3`` of the axes: K2 [ug/g^2] and K3 [ug/g^3] at the reference
    temperature, and the relative change of K2 and K3 per kelvin of board temperature.
    """

    square: Triple = ZERO
    cube: Triple = ZERO
    per_kelvin: float = 0.0

    def added(self, force: Floats, t: Floats) -> Floats:
        """Return the nonlinear terms [m/s^2], shape (n, 3); `t`: T_board - T_ref [K]."""
        f = force / STANDARD_GRAVITY
        terms = np.array(self.square) * f**2 + np.array(self.cube) * f**3
        return np.asarray(MICRO_G * (1.0 + self.per_kelvin * t)[:, None] * terms)


@dataclass(frozen=True)
class SwitchedLoad:
    """Electronics that heat a part by `power` [W], on and off for times uniform in `spell` [s]."""

    part: str
    power: float
    spell: tuple[float, float] = (900.0, 3600.0)


@dataclass(frozen=True)
class UnitModel:
    """
    A physical unit with all its constants: the truth that a calibration estimates.

    Per axis, ``counts = K * scale(T) * s + bias(T) + noise``, converted to whole counts; ``s =
    inverse(M) @ f`` is the specific force along the sensitivity axes, plus the terms of `bend`.
    `scale_factor` K [counts/cycle per m/s^2] and bias [counts/cycle] hold at the reference
    temperature. `noise_density` is in ug/sqrt(Hz): the mean over T seconds has the standard
    deviation ``noise_density / sqrt(T)``; `bias_walk` is in ug/sqrt(h).
    """

    serial: str
    network: ThermalNetwork
    drift: tuple[Effect, ...]
    scale_factor: Triple
    bias_at_reference: Triple
    misalignment: tuple[Triple, Triple, Triple]
    board: ThermometerModel = ThermometerModel('board', phase=0.5)
    case: ThermometerModel = ThermometerModel('case')
    noise_density: Triple = (5.0, 5.0, 5.0)
    converter: Callable[[Floats, Ints], tuple[NDArray[np.int32], Ints]] = balanced
    bias_walk: Triple = ZERO
    load: SwitchedLoad | None = None
    gyro: GyroModel | None = None
    bend: Bend | None = None

    @property
    def counts_per_micro_g(self) -> Floats:
        """Counts per cycle for a micro-g, by axis, shape (3,)."""
        return np.array(self.scale_factor) * MICRO_G

    @property
    def M(self) -> Floats:
        """Misalignment matrix, shape (3, 3)."""
        return np.array(self.misalignment)

    @property
    def origin(self) -> Floats:
        """Temperatures [degC] of the parts in the reference state, shape (n_parts,)."""
        air = self.network.air_for(self.board.node, REFERENCE_C)
        return self.network.equilibrium(air)

    def with_thermometers(self, **changes: Any) -> UnitModel:
        """Return the unit with `changes` in the fields of its thermometers on board and case."""
        board, case = (replace(sensor, **changes) for sensor in (self.board, self.case))
        return replace(self, board=board, case=case)
