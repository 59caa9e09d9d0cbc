# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the simulation of a unit in a chamber program: raw data, true bias, scale and force."""

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..typing import Bools, Floats, Ints
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from ..unit.rate_bias import MILLIDEGREE
from .campaign import Cyclogram, Position, Spin
from .drift import PartHistory, drift_of
from .network import ThermalResponse
from .unit import REFERENCE_C, Stream, SwitchedLoad, UnitModel, first_charge, generator, white

START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
_NS = 1_000_000_000
_GRID_S = 1.0  # step of the thermal grid [s]; bias and scale are linear between grid points


@dataclass(frozen=True, eq=False)
class Truth:
    """
    The true bias, scale and force of a run, on the thermal grid (m points) and in the n conversion
    cycles of the accelerometer.

    Bias is in counts per conversion (`rate_bias`: rad/s), scale is relative to `scale_factor`;
    `bias_grid` is `thermal_bias` plus a random walk. `cycle_s` holds the middles of the cycles
    [s]. `specific_force` is constant, (3,), or in a rotation the force in each cycle, (n, 3).
    """

    unit: UnitModel
    response: ThermalResponse
    grid_s: Floats
    temperatures: Floats
    thermal_bias: Floats
    scale_grid: Floats
    rate_bias: Floats
    bias_grid: Floats
    specific_force: Floats
    cycle_s: Floats

    @property
    def bias(self) -> Floats:
        """Bias in each conversion cycle [counts], shape (n, 3)."""
        return self.on_cycles(self.bias_grid)

    @property
    def scale(self) -> Floats:
        """Relative scale in each conversion cycle, shape (n, 3)."""
        return self.on_cycles(self.scale_grid)

    def on_cycles(self, grid: Floats) -> Floats:
        """Interpolate values linearly from the thermal grid to each conversion cycle."""
        # np.interp is not used, because its rounding depends on the number of points.
        place = self.cycle_s / self.grid_s[1]
        left = np.minimum(place.astype(np.int64), len(self.grid_s) - 2)
        share = (place - left)[:, None]
        result: Floats = (1.0 - share) * grid[left] + share * grid[left + 1]
        return result


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """
    The data that a recorder would store, and the truth. The data are the counts of each conversion
    cycle, stamped at its end, readings of the thermometers [degC] and, of a unit with a gyroscope,
    the angular rate in each cycle [rad/s].
    """

    accel_stamp_ns: Ints
    counts: NDArray[np.int32]
    board_stamp_ns: Ints
    board: Floats
    case_stamp_ns: Ints
    case: Floats
    truth: Truth
    angular_rate: Floats | None = None


def simulate(unit: UnitModel, cyclogram: Cyclogram, up: ArrayLike, **options: Any) -> SimulatedRun:
    """Simulate a unit in a chamber program as one block, with options of `simulate_blocks`."""
    return next(simulate_blocks(unit, cyclogram, up, block_size=sys.maxsize, **options))


def arrays(
    unit: UnitModel, stations: Sequence[Position], seed: int = 0, *, rate_hz: float = 4.0
) -> list[SimulatedRun]:
    """Simulate all positions of a test in memory, each with a separate seed and stamps from 0."""
    runs = []
    for number, station in enumerate(stations, 1000 * seed):
        options: dict[str, Any] = {'seed': number, 'spin': station.spin, 'start_ns': 0}
        runs.append(simulate(unit, station.program, station.up, rate_hz=rate_hz, **options))
    return runs


def simulate_blocks(
    unit: UnitModel,
    cyclogram: Cyclogram,
    up: ArrayLike,
    *,
    block_size: int = 65536,
    rate_hz: float = 100.0,
    temperature_rate_hz: float | None = None,
    seed: int = 0,
    start_ns: int = START_NS,
    gravity: float = STANDARD_GRAVITY,
    spin: Spin | None = None,
) -> Iterator[SimulatedRun]:
    """
    Simulate a unit in a chamber program, in blocks; the block size does not change the result.

    A temperature reading is in the block that spans its stamp, or else in the last block.
    `up` is the direction of the specific force without `spin`; the scale factor [counts/cycle per
    m/s^2] does not depend on `rate_hz`. `seed` determines all random numbers of the run.
    """
    readings_hz = 1.0 if temperature_rate_hz is None else temperature_rate_hz
    positive = {'rate_hz': rate_hz, 'temperature_rate_hz': readings_hz, 'gravity': gravity}
    for name, value in positive.items():
        if not (value > 0.0 and math.isfinite(value)):
            raise ValueError(f'`{name}` must be positive, got {value}')
    duration = cyclogram.duration_s
    n_cycles = math.floor(duration * rate_hz * (1.0 + 1e-12))
    if n_cycles < 1:
        raise ValueError(
            f'the chamber program of {duration:g} s is shorter than one conversion cycle of '
            f'{1.0 / rate_hz:g} s'
        )
    direction = np.asarray(up, dtype=float)
    # The temperatures depend on the seed only if a load switches at random times.
    truth = _thermal_truth(unit, cyclogram, seed if unit.load else 0)
    truth = replace(
        truth,
        bias_grid=truth.thermal_bias + _random_walk(unit, truth.grid_s, seed),
        specific_force=gravity * (direction / np.linalg.norm(direction)),
    )
    changed = {} if temperature_rate_hz is None else {'rate_hz': temperature_rate_hz}
    read = unit.with_thermometers(**changed)
    sensors = (read.board, Stream.BOARD_NOISE), (read.case, Stream.CASE_NOISE)
    readings = [each.read(truth.response, duration, seed, noise) for each, noise in sensors]
    return _blocks(truth, readings, spin, (n_cycles, block_size, rate_hz), seed, start_ns)


def _blocks(
    truth: Truth,
    readings: Sequence[tuple[Ints, Floats]],
    spin: Spin | None,
    cycles: tuple[int, int, float],
    seed: int,
    start_ns: int,
) -> Iterator[SimulatedRun]:
    """Yield a run in blocks; `cycles`: total number, number per block, rate [Hz]."""
    unit, (n_cycles, block_size, rate_hz) = truth.unit, cycles
    K = np.array(unit.scale_factor)
    to_axes = np.asarray(np.linalg.inv(unit.M), np.float64)
    # Sd of white noise averaged over a cycle: density times the root of the cycle rate.
    root = math.sqrt(rate_hz)
    noise_sd = np.array(unit.noise_density) * MICRO_G * K * root
    noise, rate_noise = white(seed, Stream.ACCEL_NOISE), white(seed, Stream.GYRO_NOISE)
    remainder = first_charge(seed)
    passed = -1
    for first in range(0, n_cycles, block_size):
        last = min(first + block_size, n_cycles)
        cycle = np.arange(first, last)
        stamp_ns = np.rint((cycle + 1.0) * (_NS / rate_hz)).astype(np.int64)
        part = replace(truth, cycle_s=(cycle + 0.5).astype(np.float64) / rate_hz)
        if spin is not None:
            force = spin.forces(truth.specific_force, part.cycle_s)
            part = replace(part, specific_force=force)
        # Eqs. (2), (8) and (9) of Golovach's paper.
        s = _along_axes(part, to_axes)
        charge = part.bias + K * part.scale * s + noise_sd * noise(len(cycle))
        counts, remainder = unit.converter(charge, remainder)
        rate: Floats | None = None
        gyro = unit.gyro
        if gyro is not None:
            rate_sd = np.array(gyro.noise_density) * MILLIDEGREE * root
            rate = part.on_cycles(part.rate_bias) + gyro.constant(seed)
            rate += rate_sd * rate_noise(len(cycle))
            if spin is not None:
                turning = spin.rate_at(part.cycle_s)[:, None]
                rate += turning * truth.specific_force / np.linalg.norm(truth.specific_force)
        until = sys.maxsize if last == n_cycles else int(stamp_ns[-1])
        (board_ns, board), (case_ns, case) = (
            (stamps[rows] + start_ns, values[rows])
            for stamps, values in readings
            for rows in [slice(*np.searchsorted(stamps, (passed, until), side='right'))]
        )
        passed = until
        yield SimulatedRun(stamp_ns + start_ns, counts, board_ns, board, case_ns, case, part, rate)


def _along_axes(part: Truth, to_axes: Floats) -> Floats:
    """Return the force along the sensitivity axes, with the nonlinear terms [m/s^2], (n, 3)."""
    s: Floats = np.zeros(3)
    for j in range(3):
        s = s + part.specific_force[..., j, None] * to_axes[:, j]
    unit = part.unit
    if unit.bend is not None:
        node = unit.network.nodes.index(unit.board.node)
        t = part.temperatures[:, [node]] - REFERENCE_C
        s = s + unit.bend.added(s, part.on_cycles(t)[:, 0])
    return s


@lru_cache(maxsize=1)
def _thermal_truth(unit: UnitModel, cyclogram: Cyclogram, seed: int) -> Truth:
    """Compute temperatures and thermal errors, which do not depend on the attitude."""
    knots, air, power = np.array(cyclogram.time_s), np.array(cyclogram.temperature_c), None
    if unit.load is not None:
        knots, is_on = _switched(unit.load, knots, seed)
        air = np.interp(knots, cyclogram.time_s, air)
        heated = [part == unit.load.part for part in unit.network.nodes]
        power = np.where(np.outer(is_on, heated), unit.load.power, 0.0)
    response = ThermalResponse(unit.network, knots, air, power)
    grid = np.arange(math.ceil(cyclogram.duration_s / _GRID_S) + 1, dtype=float) * _GRID_S
    temperatures = response.temperatures(grid)
    origin = unit.origin
    history = PartHistory(unit.network.nodes, temperatures - origin, origin, _GRID_S)
    bias_ug, scale = drift_of(unit.drift, history)
    bias = np.array(unit.bias_at_reference) + bias_ug * unit.counts_per_micro_g
    none = np.empty(0)
    rate = none if unit.gyro is None else unit.gyro.bias(history)
    return Truth(unit, response, grid, temperatures, bias, 1.0 + scale, rate, none, none, none)


def _switched(load: SwitchedLoad, knots: Floats, seed: int) -> tuple[Floats, Bools]:
    """Add a load's switching times to `knots` [s]; return whether the load is on between knots."""
    n = 2 + int(knots[-1] // load.spell[0])
    flips = np.cumsum(generator(seed, Stream.LOAD).uniform(*load.spell, size=n))
    fine = np.unique(np.concatenate([knots, flips[flips <= knots[-1]]]))
    return fine, np.searchsorted(flips, fine[:-1], side='right') % 2 == 1


def _random_walk(unit: UnitModel, grid: Floats, seed: int) -> Floats:
    """Return the random walk of the bias [counts/cycle]."""
    steps = white(seed, Stream.BIAS_WALK)(len(grid) - 1)
    per_step = np.array(unit.bias_walk) * math.sqrt(grid[1] / 3600.0)
    walk = np.concatenate((np.zeros((1, 3)), per_step * np.cumsum(steps, axis=0)))
    return np.asarray(walk * unit.counts_per_micro_g)
