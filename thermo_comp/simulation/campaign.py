# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns a whole test in memory: which attitudes go through which programs, and what they record.

``arrays(unit_preset('own-lags', 1), plan('chamber-18', 1))`` is 171 h of records in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats
from ..unit.gravity import STANDARD_GRAVITY
from .cyclogram import Cyclogram, parse_cyclogram
from .run import SimulatedRun, Truth, simulate
from .unit import Stream, UnitModel, generator

_FACES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
# Edges of the cube: one per pair of axes and adding up to nothing, their opposites, the rest.
_EDGES = [
    *[(1, 1, 0), (0, -1, 1), (-1, 0, -1), (-1, -1, 0), (0, 1, -1), (1, 0, 1)],
    *[(1, -1, 0), (0, 1, 1), (-1, 0, 1), (-1, 1, 0), (0, -1, -1), (1, 0, -1)],
]
# Corners: three diagonals with their opposites first.
_CORNERS = [
    *[(1, 1, 1), (-1, -1, -1), (1, -1, -1), (-1, 1, 1), (-1, 1, -1), (1, -1, 1)],
    *[(-1, -1, 1), (1, 1, -1)],
]
# Of the small turn about each transverse direction, since nobody levels the block.
_SPREAD_DEG = 3.0
# Each axis has both signs, and none sees the same gravity throughout.
_THREE = np.array([(1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
PLAN_NAMES = ('chamber-18', 'chamber-9', 'tumble-3', 'tumble-1', 'tumble', 'held-out')


def positions(n: int, seed: int = 0) -> Floats:
    """
    Return attitudes of a calibration test as unit vectors of the specific force, shape (n, 3).

    Six are the faces of a cube, nine the corners of a three-capped prism, twelve those of an
    icosahedron: the sets that tell bias, scale and misalignment apart best for their number. Other
    sets take the faces of a cube, then its edges, then its corners; beyond 26, an even spiral over
    the sphere. 6, 9, 12, 18, 24 and 26 are balanced. `seed` turns each by a small random angle.
    """
    if n < 1:
        raise ValueError(f'`n` must be at least 1, got {n}')
    if n == 9:
        # Three on the equator, six 44 degrees above and below between them.
        third = np.arange(3) * 2.0 * math.pi / 3.0
        ring = np.stack([np.cos(third), np.sin(third)], axis=1)
        height, radius = 0.7, math.sqrt(1.0 - 0.7**2)
        levels = ((-1.0, 0.0), (radius, height), (radius, -height))
        up = np.concatenate([np.insert(size * ring, 2, z, axis=1) for size, z in levels])
    elif n == 12:
        golden = (1.0 + math.sqrt(5.0)) / 2.0
        quad = np.array([(0.0, a, b * golden) for a in (1.0, -1.0) for b in (1.0, -1.0)])
        up = np.concatenate([np.roll(quad, turn, axis=1) for turn in range(3)])
    elif n <= 26:
        up = np.array((_FACES + _EDGES + _CORNERS)[:n], dtype=float)
    else:
        k = np.arange(n)
        z = 1.0 - (2.0 * k + 1.0) / n
        turn = math.pi * (3.0 - math.sqrt(5.0)) * k
        across = np.sqrt(1.0 - z * z)
        up = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    for row in range(n):
        push = generator(seed, Stream.POSITIONS, row).standard_normal(3)
        up[row] += math.radians(_SPREAD_DEG) * np.cross(push, up[row])
    result: Floats = up / np.linalg.norm(up, axis=1, keepdims=True)
    return result


@dataclass(frozen=True, eq=False)
class Position:
    """One position of a test: the chamber's program, and the direction of the specific force."""

    name: str
    program: Cyclogram
    up: Floats


def plan(name: str, seed: int = 0) -> tuple[Position, ...]:
    """
    Return the positions of a test in the order of their recording.

    'chamber-18' (18 positions of 9.5 h), 'chamber-9' (9 of 3 h), 'tumble' (18 of 20 min at room
    temperature), 'tumble-3', 'tumble-1' (the same and 3 or 1 of 3 h in the chamber) or 'held-out'
    (3 positions with other ramps and attitudes, for judging). `seed` is that of the attitudes and
    of the room's temperature.
    """
    if name not in PLAN_NAMES:
        raise ValueError(f'`name` must be one of {", ".join(PLAN_NAMES)}, got {name!r}')
    rng = generator(seed, Stream.CYCLOGRAM, PLAN_NAMES.index(name))
    if name == 'held-out':
        # Attitudes that no plan has: any direction, but no axis upright.
        ups = rng.uniform(0.3, 1.0, (3, 3)) * rng.choice((-1.0, 1.0), (3, 3))
        return _positions(name, parse_cyclogram('held-out'), ups)
    if name.startswith('chamber'):
        n, preset = (18, 'long') if name == 'chamber-18' else (9, 'three-hours')
        return _positions('chamber', parse_cyclogram(preset), positions(n, seed))
    bench: list[Position] = []
    for up in positions(18, seed):
        room = rng.normal(21.5, 0.7)
        program = Cyclogram((0.0, 1200.0), (room, room + rng.normal(0.0, 0.3)))
        bench += _positions(f'bench-{len(bench) + 1:02d}', program, up[None])
    if name == 'tumble':
        return tuple(bench)
    ups = _THREE[: int(name[-1])] + rng.normal(0.0, 0.15, (int(name[-1]), 3))
    return (*bench, *_positions('chamber', parse_cyclogram('three-hours'), ups))


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
) -> list[SimulatedRun]:
    """Run a unit through a test in memory; each position has a seed of its own, stamps from 0."""
    solved: dict[Cyclogram, Truth] = {}
    runs = []
    for number, one in enumerate(stations):
        run = simulate(
            unit,
            one.program,
            one.up,
            rate_hz=rate_hz,
            seed=1000 * seed + number,
            gravity=gravity,
            start_ns=0,
            # A load is switched by the seed.
            like=None if unit.load else solved.get(one.program),
        )
        solved[one.program] = run.truth
        runs.append(replace(run, name=one.name))
    return runs
