# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns a run: a unit in a chamber over a program, whole or block by block."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..typing import Floats, Ints
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from ..unit.gyroscope import MILLIDEGREE
from .cyclogram import Cyclogram
from .drift import PartHistory
from .response import ThermalResponse
from .streams import Stream, generator
from .truth import SimulatedRun, Truth, on_cycles
from .unit import UnitModel

START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
_NS = 1_000_000_000
_GRID_S = 1.0  # step of the thermal grid; bias and scale are straight between its points


@dataclass(frozen=True)
class RunOptions:
    """
    The keywords of `simulate`, `simulate_blocks` and `arrays`.

    rate_hz: conversion cycles per second. The elementary charge is sized to the cycle, so K in
        counts per cycle does not depend on it
    temperature_rate_hz: readings per second of both thermometers; None takes each one's own
    seed: seed of everything random in this run; the specimen has its own
    start_ns: stamp of the start of the run, ns
    gravity: local gravity, m/s^2
    warm: true starts in thermal equilibrium; False switches the unit on at the start

    Raises ValueError if rate or gravity is not positive.
    """

    rate_hz: float = 100.0
    temperature_rate_hz: float | None = None
    seed: int = 0
    start_ns: int = START_NS
    gravity: float = STANDARD_GRAVITY
    warm: bool = True

    def __post_init__(self) -> None:
        for name in ('rate_hz', 'gravity'):
            if not (getattr(self, name) > 0.0 and math.isfinite(getattr(self, name))):
                raise ValueError(f'`{name}` must be positive, got {getattr(self, name)}')


def simulate(unit: UnitModel, cyclogram: Cyclogram, up: ArrayLike, **options: Any) -> SimulatedRun:
    """
    Run a unit through a program, with `RunOptions` as keywords.

    `up`, shape (3,), is the direction of the specific force in the orthogonal frame of the
    accelerometer.

    Raises ValueError if the program is shorter than a cycle, or the options, `up` or the
    thermostat's power do not fit (see `RunOptions` and `ThermalResponse`).
    """
    chamber = Chamber(unit, cyclogram, up, RunOptions(**options))
    return next(chamber.blocks(chamber.n_cycles))


def simulate_blocks(
    unit: UnitModel,
    cyclogram: Cyclogram,
    up: ArrayLike,
    *,
    block_size: int = 65536,
    **options: Any,
) -> Iterator[SimulatedRun]:
    """
    Run a unit through a program in bounded memory: the bits of `simulate`, block by block.

    A reading of a thermometer is in the block whose cycles it falls among: after the last stamp of
    the block before, up to the last of its own; those after the very last cycle are in the last
    block. Each truth holds the whole thermal grid.

    Raises ValueError if as in `simulate`, or if `block_size` is below 1.
    """
    if block_size < 1:
        raise ValueError(f'`block_size` must be at least 1, got {block_size}')
    return Chamber(unit, cyclogram, up, RunOptions(**options)).blocks(block_size)


class ThermalTruth:
    """The temperatures of a run and what they do to bias and scale, on the thermal grid."""

    def __init__(self, unit: UnitModel, cyclogram: Cyclogram, options: RunOptions) -> None:
        knots = np.array(cyclogram.time_s)
        air = np.array(cyclogram.temperature_c)
        power = None
        if unit.loads:
            knots, air, power = _switched(unit, knots, air, options.seed)
        self.response = ThermalResponse(
            unit.network, knots, air, power=power, is_warm=options.warm
        )
        n_grid = math.ceil(cyclogram.duration_s / _GRID_S) + 1
        self.grid: Floats = np.arange(n_grid, dtype=float) * _GRID_S
        self.air = np.interp(self.grid, knots, air)
        self.temperatures = self.response.temperatures(self.grid)
        origin = unit.origin
        history = PartHistory(unit.network.nodes, self.temperatures - origin, origin, _GRID_S)
        bias_ug, scale = unit.drift.evaluate(history)
        self.rate_bias = None if unit.gyro is None else unit.gyro.bias(history)
        self.bias = np.array(unit.bias_at_reference) + bias_ug * unit.counts_per_micro_g
        self.scale = 1.0 + scale


class Chamber:
    """
    The whole run prepared: thermal truth on its grid, thermometers read; cycles still to come.
    """

    def __init__(
        self,
        unit: UnitModel,
        cyclogram: Cyclogram,
        up: ArrayLike,
        options: RunOptions,
        thermal: ThermalTruth | None = None,
    ) -> None:
        duration = cyclogram.duration_s
        self.n_cycles = math.floor(duration * options.rate_hz * (1.0 + 1e-12))
        if self.n_cycles < 1:
            raise ValueError(f'the program of {duration} s is shorter than one cycle')
        self._unit, self._options = unit, options
        direction = np.asarray(up, dtype=float)
        length = np.linalg.norm(direction, axis=-1)
        if direction.shape != (3,) or not length > 0.0:
            raise ValueError(f'`up` must be a vector other than zero, shape (3,), got {up!r}')
        self._force: Floats = options.gravity * (direction / length)
        self.thermal = thermal or ThermalTruth(unit, cyclogram, options)
        self.bias = self.thermal.bias + _walk(unit, self.thermal.grid, options.seed)

        if options.temperature_rate_hz is not None:
            unit = unit.with_thermometers(rate_hz=options.temperature_rate_hz)
        response = self.thermal.response
        self.board = unit.board.read(response, duration, options.seed, Stream.BOARD_NOISE)
        self.case = unit.case.read(response, duration, options.seed, Stream.CASE_NOISE)

    def blocks(self, block_size: int) -> Iterator[SimulatedRun]:
        """Return the run in stretches of so many cycles."""
        unit, options = self._unit, self._options
        seed, rate = options.seed, options.rate_hz
        K = np.array(unit.scale_factor)
        to_axes = np.linalg.inv(unit.M)
        s = sum(self._force[j] * to_axes[:, j] for j in range(3))
        # A mean over one cycle of white noise: density times the root of the cycle rate.
        noise_sd = np.array(unit.noise_density) * MICRO_G * K * math.sqrt(rate)
        noise = [generator(seed, Stream.ACCEL_NOISE, i) for i in range(3)]
        rate_noise = [generator(seed, Stream.GYRO_NOISE, i) for i in range(3)]
        remainder = unit.converter.start(seed)
        passed = -1
        for first in range(0, self.n_cycles, block_size):
            last = min(first + block_size, self.n_cycles)
            cycle = np.arange(first, last)
            stamp_ns = np.rint((cycle + 1.0) * (_NS / rate)).astype(np.int64)
            truth = self._truth((cycle + 0.5).astype(np.float64) / rate)
            # Eq. (2), (8) and (9)
            charge = truth.bias + K * truth.scale * s
            for i in range(3):
                charge[:, i] += noise_sd[i] * noise[i].standard_normal(len(cycle))
            counts, remainder = unit.converter.convert(charge, remainder)
            until = np.iinfo(np.int64).max if last == self.n_cycles else int(stamp_ns[-1])
            board_ns, board = _between(self.board, passed, until)
            case_ns, case = _between(self.case, passed, until)
            passed = until
            start = options.start_ns
            yield SimulatedRun(
                accel_stamp_ns=stamp_ns + start,
                counts=counts,
                board_stamp_ns=board_ns + start,
                board=board,
                case_stamp_ns=case_ns + start,
                case=case,
                truth=truth,
                angular_rate=self._angular_rate(truth.cycle_s, rate_noise),
            )

    def _angular_rate(self, cycle_s: Floats, noise: list[np.random.Generator]) -> Floats | None:
        gyro, bias = self._unit.gyro, self.thermal.rate_bias
        if gyro is None or bias is None:
            return None
        rate = on_cycles(bias, self.thermal.grid, cycle_s) + gyro.constant(self._options.seed)
        sd = np.array(gyro.noise_density) * MILLIDEGREE * math.sqrt(self._options.rate_hz)
        for i in range(3):
            rate[:, i] += sd[i] * noise[i].standard_normal(len(cycle_s))
        return rate

    def _truth(self, cycle_s: Floats) -> Truth:
        thermal = self.thermal
        return Truth(
            unit=self._unit,
            gravity=self._options.gravity,
            nodes=self._unit.network.nodes,
            grid_s=thermal.grid,
            air=thermal.air,
            temperatures=thermal.temperatures,
            bias_grid=self.bias,
            scale_grid=thermal.scale,
            cycle_s=cycle_s,
            specific_force=self._force,
        )


def _switched(
    unit: UnitModel, knots: Floats, air: Floats, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Return the knots with the switching of the loads among them, and the power between them."""
    flips = []
    for number, load in enumerate(unit.loads):
        spells = generator(seed, Stream.LOAD, number).uniform(
            *load.spell, size=2 + int(knots[-1] // load.spell[0])
        )
        flips.append(np.cumsum(spells))
    fine = np.unique(np.concatenate([knots, *flips]))
    fine = fine[fine <= knots[-1]]
    power = np.zeros((len(fine) - 1, len(unit.network.nodes)))
    for load, at in zip(unit.loads, flips, strict=True):
        is_on = np.searchsorted(at, fine[:-1], side='right') % 2 == 1
        power[:, unit.network.nodes.index(load.part)] += load.power * is_on
    return fine, np.interp(fine, knots, air), power


def _walk(unit: UnitModel, grid: Floats, seed: int) -> Floats:
    """Return what the bias does of itself: a walk, counts/cycle."""
    result = np.zeros((len(grid), 3))
    step_h = grid[1] / 3600.0
    for i, density in enumerate(unit.bias_walk):
        if density:
            steps = generator(seed, Stream.BIAS_WALK, i).standard_normal(len(grid) - 1)
            result[1:, i] += density * math.sqrt(step_h) * np.cumsum(steps)
    return result * unit.counts_per_micro_g


def _between(readings: tuple[Ints, Floats], after: int, until: int) -> tuple[Ints, Floats]:
    first, last = np.searchsorted(readings[0], (after, until), side='right')
    return readings[0][first:last], readings[1][first:last]
