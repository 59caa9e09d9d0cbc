# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the plan of a thermal test: program of the chamber, attitudes and rotations of the unit."""

import math
import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats
from ..unit.gravity import STANDARD_GRAVITY
from .unit import Stream, generator

_STEP = re.compile(
    r'^(?P<target>[+-]?\d+(?:\.\d*)?|[+-]?\.\d+)'
    r'(?:\s*@\s*(?P<rate>\d+(?:\.\d*)?|\.\d+))?'
    r'(?:\s+(?P<soak>\d+(?:\.\d*)?|\.\d+)\s*(?P<unit>h|min|s))?$'
)
_SECONDS = {'h': 3600.0, 'min': 60.0, 's': 1.0}
_PROGRAMS = {
    # A program with the temperature range and the style of Fig. 3 of Golovach's paper: up, down
    # and back, with long soaks.
    'paper': '20 60min, 35@0.5 90min, 20 60min, 5 90min, 20 60min, 35 60min',
    # A program of 4 h 20 min for one bag of a thermal test: 5 to 35 degC, ramps up and down.
    'chamber': '20 20min, 35@0.75 35min, 5@0.6 45min, 20@0.75 35min, 8@1 23min',
    # A program of 3 h from 5 to 35 degC: ramps in both directions and short soaks.
    'three-hours': '20 10min, 35@0.8 30min, 5@1.2 40min, 22@0.5 22.25min',
    # A program of 9.5 h for the chamber test of 18 positions: ramps of 0.3 to 1 K/min in both
    # directions.
    'long': '20 30min, 35@0.5 60min, 5@1 60min, 25@0.3 40min, 10@0.7 45min, 33@0.9 40min, '
    '15@0.35 40min, 20@0.5 19.92063492063492min',
    # No ramp of 'held-out' (start, end and rate) occurs in a program for a fit.
    'held-out': '12 40min, 31@0.35 45min, 17@0.9 30min, 26@0.6 50min, 7@0.7 60min, 22@0.25 40min',
    'slow': '20 60min, 35@0.1 60min, 5@0.2 60min, 20@0.15 60min',
    'fast': '20 45min, 35@3 75min, 5@2 90min, 25@1.5 75min, 10@3 60min',
    # The program of the sample bags: soaks, and ramps in both directions.
    'demo': '15 12min, 30@1 22min, 8@1.1 21min',
    'soak': '20 4h',
    # Soaks at three temperatures, long enough to settle, for runs on a centrifuge or a rate table.
    'three-soaks': '20 60min, 35@1 60min, 5@1 60min',
}
_FACES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
# Midpoints of a cube's edges: three vectors of sum 0, their opposites, then the other six.
_EDGES = [
    *[(1, 1, 0), (0, -1, 1), (-1, 0, -1), (-1, -1, 0), (0, 1, -1), (1, 0, 1)],
    *[(1, -1, 0), (0, 1, 1), (-1, 0, 1), (-1, 1, 0), (0, -1, -1), (1, 0, -1)],
]
# Corners of the cube, as pairs: the ends of the four space diagonals.
_CORNERS = [
    *[(1, 1, 1), (-1, -1, -1), (1, -1, -1), (-1, 1, 1), (-1, 1, -1), (1, -1, 1)],
    *[(-1, -1, 1), (1, 1, -1)],
]
_SPREAD_DEG = 3.0  # sd of an attitude's random tilt about each of two perpendicular axes [deg]
# Attitudes of 'tumble-3' in the chamber: gravity has both signs on each axis.
_THREE = np.array([(1.0, 1.0, -1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
PLAN_NAMES = (
    *('chamber-18', 'chamber-9', 'tumble-3', 'tumble-1', 'tumble', 'held-out'),
    *('centrifuge', 'rate-table'),
)
# Times [s] at which a run through all rotation rates begins: half an hour before each soak ends.
_BEGINS_S = tuple(end - 1800.0 for end in (3600.0, 8100.0, 13500.0))
_DWELL_S, _RAMP_S = 300.0, 60.0  # duration of each rotation rate, and of each change of the rate
# Radius [m] and rotation rates [rad/s] of the simulated centrifuge (2 to 10 g horizontally) and of
# the simulated rate table (up to 1000 deg/s).
_CENTRIFUGE = 1.0, tuple(math.sqrt(g * STANDARD_GRAVITY) for g in (2.0, 4.0, 7.0, 10.0))
_RATE_TABLE = 0.25, tuple(math.radians(rate) for rate in (400.0, 600.0, 800.0, 1000.0))


@dataclass(frozen=True)
class Cyclogram:
    """Air temperature [degC] over time [s]: linear between the points, constant outside."""

    time_s: tuple[float, ...]
    temperature_c: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Duration of the chamber program [s]."""
        return self.time_s[-1]


def parse_cyclogram(text: str) -> Cyclogram:
    """
    Read a chamber program in the form below, or the name of a ready-made chamber program.

    Steps are separated by commas, semicolons or lines: ``TARGET[@RATE] [SOAK]`` with the target in
    degC, the rate in K/min and the soak as ``90min``, ``1.5h`` or ``30s``. The first step is the
    starting temperature and takes no rate; a later step without a rate keeps the last rate (1
    K/min at first). Example: ``20 30min, 35@0.5 1h, 5@1 1h, 20``.
    """
    text = _PROGRAMS.get(text.strip(), text)
    time, temperature, rate = [0.0], list[float](), 1.0
    for number, raw in enumerate(filter(None, map(str.strip, re.split(r'[,;\n]', text))), 1):
        match = _STEP.match(raw)
        is_first = not temperature
        if match is None or (match['rate'] and (is_first or float(match['rate']) == 0.0)):
            raise ValueError(
                f"cyclogram step {number} '{raw}' must read TARGET[@RATE] [SOAK] in degC, K/min "
                "and h, min or s, e.g. '35@0.5 90min' (the first step without a rate); or the "
                f'cyclogram is one of {", ".join(_PROGRAMS)}'
            )
        target, rate = float(match['target']), float(match['rate'] or rate)
        if is_first:
            temperature.append(target)
        elif target != temperature[-1]:
            time.append(time[-1] + abs(target - temperature[-1]) / rate * 60.0)
            temperature.append(target)
        soak = float(match['soak'] or 0.0) * _SECONDS[match['unit'] or 's']
        if soak > 0.0:
            time.append(time[-1] + soak)
            temperature.append(target)
    if not temperature:
        raise ValueError('cyclogram is empty')
    if len(time) < 2 or not all(map(math.isfinite, time + temperature)):
        raise ValueError('cyclogram must have a ramp or a soak, and finite numbers')
    return Cyclogram(tuple(time), tuple(temperature))


def positions(n: int, seed: int = 0) -> Floats:
    """
    Return attitudes of a calibration test as unit vectors of the specific force, shape (n, 3).

    Six attitudes are the faces of a cube, nine the corners of a three-capped prism, twelve the
    corners of an icosahedron: the best sets of 6, 9 and 12 attitudes to determine bias, scale and
    misalignment. Sets of up to 26 attitudes, except 9 and 12, consist of the faces of a cube, then
    its edges, then its corners; larger sets follow a uniform spiral on the sphere. Sets of 6, 9,
    12, 18, 24 and 26 vectors sum to about 0. `seed` tilts each attitude by a small random angle.
    """
    if n == 9:
        # The prism has three corners on the equator and, at azimuths between them, three corners
        # each at elevations of +44 and -44 degrees.
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
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Spin:
    """
    A rotation about a vertical axis: `rate` [rad/s], linear between the times [s]; `radius` [m];
    `inward`: horizontal direction from the unit to the axis, in the frame of the unit.
    """

    time_s: tuple[float, ...]
    rate: tuple[float, ...]
    radius: float
    inward: Floats

    def rate_at(self, time: Floats) -> Floats:
        """Return the rotation rate [rad/s] at times [s]."""
        return np.interp(time, self.time_s, self.rate)

    def forces(self, upward: Floats, time: Floats) -> Floats:
        """Return the specific force of rotation and gravity at times [s], shape (n, 3)."""
        return np.asarray(upward + (self.rate_at(time) ** 2 * self.radius)[:, None] * self.inward)

    def sections(self, gravity: float) -> list[tuple[float, float, float]]:
        """List the intervals of constant rotation rate: begin [s], end [s], |f| [m/s^2]."""
        knots = zip(self.time_s, self.rate, strict=True)
        return [
            (begin, end, math.hypot(gravity, rate * rate * self.radius))
            for (begin, rate), (end, after) in pairwise(knots)
            if rate == after
        ]


@dataclass(frozen=True, eq=False)
class Position:
    """A position of a test: chamber program, direction of the force without rotation, rotation."""

    program: Cyclogram
    up: Floats
    spin: Spin | None = None


def plan(name: str, seed: int = 0) -> tuple[Position, ...]:
    """
    Return the positions of a test in recording order: 'chamber-18' (18 positions of 9.5 h),
    'chamber-9' (9 positions of 3 h), 'tumble' (18 positions of 20 min at room temperature),
    'tumble-3', 'tumble-1' ('tumble', then 3 positions, or 1 position, of 3 h in the chamber),
    'held-out' (3 positions with ramps and attitudes of no other plan), 'centrifuge', 'rate-table'
    (12 mountings, at rest and at four rotation rates in three soaks). `seed` sets attitudes and
    temperatures.
    """
    if name not in PLAN_NAMES:
        raise ValueError(f'`name` must be one of {", ".join(PLAN_NAMES)}, got {name!r}')
    rng = generator(seed, Stream.CYCLOGRAM, PLAN_NAMES.index(name))
    if name == 'held-out':
        # No axis is near the vertical or the horizontal, unlike in a tumble.
        ups = rng.uniform(0.3, 1.0, (3, 3)) * rng.choice((-1.0, 1.0), (3, 3))
        return _positions(parse_cyclogram('held-out'), ups)
    if name in ('centrifuge', 'rate-table'):
        return _spinning(*(_CENTRIFUGE if name == 'centrifuge' else _RATE_TABLE), seed)
    if name.startswith('chamber'):
        n, preset = (18, 'long') if name == 'chamber-18' else (9, 'three-hours')
        return _positions(parse_cyclogram(preset), positions(n, seed))
    bench: list[Position] = []
    for up in positions(18, seed):
        room = rng.normal(21.5, 0.7)
        program = Cyclogram((0.0, 1200.0), (room, room + rng.normal(0.0, 0.3)))
        bench += _positions(program, up[None])
    if name == 'tumble':
        return tuple(bench)
    ups = _THREE[: int(name[-1])] + rng.normal(0.0, 0.15, (int(name[-1]), 3))
    return (*bench, *_positions(parse_cyclogram('three-hours'), ups))


def steps(
    begins_s: tuple[float, ...], rates: tuple[float, ...], dwell_s: float, ramp_s: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return times [s] and rotation rates: at each of `begins_s` begins a run through `rates`."""
    time, rate = [0.0], [0.0]
    for begin in begins_s:
        now = begin
        for wanted in (*rates, 0.0):
            time += [now, now + ramp_s]
            rate += [rate[-1], wanted]
            now += ramp_s + dwell_s
    time.append(math.inf)
    rate.append(0.0)
    return tuple(time), tuple(rate)


def _spinning(radius: float, rates: tuple[float, ...], seed: int) -> tuple[Position, ...]:
    program = parse_cyclogram('three-soaks')
    time, rate = steps(_BEGINS_S, rates, _DWELL_S, _RAMP_S)
    inward = positions(12, seed)
    ups = np.cross(inward, np.roll(inward, 1, axis=1))
    return tuple(
        Position(program, up / np.linalg.norm(up), Spin(time, rate, radius, direction))
        for up, direction in zip(ups, inward, strict=True)
    )


def _positions(program: Cyclogram, ups: Floats) -> tuple[Position, ...]:
    ups = ups / np.linalg.norm(ups, axis=1, keepdims=True)
    return tuple(Position(program, up) for up in ups)
