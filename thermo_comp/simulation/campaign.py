# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a whole test in memory: which positions go through which programs, and what they record.

``arrays(unit_preset('own-lags', 1), plan('chamber-18', 1))`` is 171 h of records in seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..typing import Floats, Ints
from ..unit.gravity import STANDARD_GRAVITY
from .attitude import positions
from .cyclogram import Cyclogram, cyclogram_preset
from .run import Chamber, RunOptions, ThermalTruth
from .streams import Stream, generator
from .unit import UnitModel

# Each axis has both signs, and none sees the same gravity throughout.
_THREE = np.array([(1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
PLAN_NAMES = ('chamber-18', 'chamber-9', 'tumble-3', 'tumble-1', 'tumble', 'held-out')


@dataclass(frozen=True, eq=False)
class Position:
    """One position of a test: the chamber's program, and the direction of the specific force."""

    name: str
    program: Cyclogram
    up: Floats


@dataclass(frozen=True, eq=False)
class Record:
    """
    What one position recorded, and its truth.

    time_s: ends of the cycles from the start, s, shape (n,)
    counts: output per cycle, counts, shape (n, 3)
    board_time_s, board, case_time_s, case: readings of the thermometers: instants [s] and values
        [degC], shape (m,)
    specific_force: true specific force in the orthogonal frame, m/s^2, shape (3,)
    angular_rate: of a unit with a gyroscope, mean of each cycle, rad/s, shape (n, 3)
    bias, scale: what the unit's temperatures make of bias [counts/cycle] and relative scale, every
        second from 0; without the walk of the bias, which no model can know, shape (k, 3)
    """

    name: str
    time_s: Floats
    counts: Floats
    board_time_s: Floats
    board: Floats
    case_time_s: Floats
    case: Floats
    specific_force: Floats
    bias: Floats
    scale: Floats
    angular_rate: Floats | None = None

    def means(self, window_s: float = 60.0) -> Floats:
        """Return the means of the counts over whole windows, shape (w, 3)."""
        per = round(window_s / self.time_s[0])
        n = len(self.counts) // per
        result: Floats = self.counts[: n * per].reshape(n, per, 3).mean(axis=1)
        return result

    def corrected_by_truth(self, unit: UnitModel, window_s: float = 60.0) -> Floats:
        """
        Return the specific force that a perfect model makes of the counts, shape (w, 3), m/s^2.
        """
        counts, per = self.means(window_s), round(window_s)
        at = slice(0, len(counts) * per)
        bias, scale = (x[at].reshape(-1, per, 3).mean(axis=1) for x in (self.bias, self.scale))
        result: Floats = ((counts - bias) / scale / unit.scale_factor) @ unit.M.T
        return result


def plan(name: str, seed: int = 0) -> tuple[Position, ...]:
    """
    Return the positions of a test in the order of their recording.

    'chamber-18' (18 positions of 9.5 h), 'chamber-9' (9 of 3 h), 'tumble' (18 of 20 min at room
    temperature), 'tumble-3', 'tumble-1' (the same and 3 or 1 of 3 h in the chamber) or 'held-out'
    (3 positions with other ramps and attitudes, for judging). `seed` is that of the attitudes and
    of the room's temperature.

    Raises ValueError if there is no such plan.
    """
    if name not in PLAN_NAMES:
        raise ValueError(f'`name` must be one of {", ".join(PLAN_NAMES)}, got {name!r}')
    rng = generator(seed, Stream.CYCLOGRAM, PLAN_NAMES.index(name))
    if name == 'held-out':
        # Attitudes that no plan has: any direction, but no axis upright.
        ups = rng.uniform(0.3, 1.0, (3, 3)) * rng.choice((-1.0, 1.0), (3, 3))
        return _positions(name, cyclogram_preset('held-out'), ups)
    if name.startswith('chamber'):
        n, preset = (18, 'long') if name == 'chamber-18' else (9, 'three-hours')
        return _positions('chamber', cyclogram_preset(preset), positions(n, seed))
    bench: list[Position] = []
    for up in positions(18, seed):
        room = rng.normal(21.5, 0.7)
        program = Cyclogram((0.0, 1200.0), (room, room + rng.normal(0.0, 0.3)))
        bench += _positions(f'bench-{len(bench) + 1:02d}', program, up[None])
    if name == 'tumble':
        return tuple(bench)
    ups = _THREE[: int(name[-1])] + rng.normal(0.0, 0.15, (int(name[-1]), 3))
    return (*bench, *_positions('chamber', cyclogram_preset('three-hours'), ups))


def _positions(name: str, program: Cyclogram, ups: Floats) -> tuple[Position, ...]:
    ups = ups / np.linalg.norm(ups, axis=1, keepdims=True)
    names = [name] if len(ups) == 1 else [f'{name}-{i:02d}' for i in range(1, len(ups) + 1)]
    return tuple(Position(name, program, up) for name, up in zip(names, ups, strict=True))


def arrays(
    unit: UnitModel,
    stations: Iterable[Position],
    seed: int = 0,
    *,
    rate_hz: float = 4.0,
    gravity: float = STANDARD_GRAVITY,
) -> list[Record]:
    """Run a unit through a test in memory; each position has a seed of its own."""
    solved: dict[Cyclogram, ThermalTruth] = {}
    records = []
    for number, station in enumerate(stations):
        options = RunOptions(
            rate_hz=rate_hz, seed=1000 * seed + number, gravity=gravity, start_ns=0
        )
        thermal = None if unit.loads else solved.get(station.program)
        chamber = Chamber(unit, station.program, station.up, options, thermal)
        solved[station.program] = chamber.thermal
        (run,) = chamber.blocks(chamber.n_cycles)
        records.append(
            Record(
                station.name,
                _seconds(run.accel_stamp_ns),
                run.counts.astype(np.float64),
                _seconds(chamber.board[0]),
                chamber.board[1],
                _seconds(chamber.case[0]),
                chamber.case[1],
                gravity * station.up,
                chamber.thermal.bias,
                chamber.thermal.scale,
                run.angular_rate,
            )
        )
    return records


def _seconds(stamp_ns: Ints) -> Floats:
    return stamp_ns.astype(np.float64) * 1e-9
