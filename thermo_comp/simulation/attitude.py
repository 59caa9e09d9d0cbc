# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the block's attitudes: well-spread positions."""

from __future__ import annotations

import math

import numpy as np

from ..typing import Floats
from .streams import Stream, generator

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


def positions(n: int, seed: int = 0) -> Floats:
    """
    Return attitudes of a calibration test as unit vectors of the specific force, shape (n, 3).

    Six are the faces of a cube, nine the corners of a three-capped prism, twelve those of an
    icosahedron: the sets that tell bias, scale and misalignment apart best for their number. Other
    sets take the faces of a cube, then its edges, then its corners; beyond 26, an even spiral over
    the sphere. 6, 9, 12, 18, 24 and 26 are balanced. `seed` turns each by a small random angle.

    Raises ValueError if `n` is below 1.
    """
    if n < 1:
        raise ValueError(f'`n` must be at least 1, got {n}')
    if n == 9:
        up = _capped_prism()
    elif n == 12:
        up = _icosahedron()
    elif n <= 26:
        up = np.array((_FACES + _EDGES + _CORNERS)[:n], dtype=float)
    else:
        up = _spiral(n)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    for row in range(n):
        push = generator(seed, Stream.POSITIONS, row).standard_normal(3)
        up[row] += math.radians(_SPREAD_DEG) * np.cross(push, up[row])
    result: Floats = up / np.linalg.norm(up, axis=1, keepdims=True)
    return result


def _capped_prism() -> Floats:
    # Three on the equator, six 44 degrees above and below between them.
    third = np.arange(3) * 2.0 * math.pi / 3.0
    ring = np.stack([np.cos(third), np.sin(third)], axis=1)
    height, radius = 0.7, math.sqrt(1.0 - 0.7**2)
    levels = ((-1.0, 0.0), (radius, height), (radius, -height))
    return np.concatenate([np.insert(size * ring, 2, z, axis=1) for size, z in levels])


def _icosahedron() -> Floats:
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    quad = np.array([(0.0, a, b * golden) for a in (1.0, -1.0) for b in (1.0, -1.0)])
    return np.concatenate([np.roll(quad, turn, axis=1) for turn in range(3)])


def _spiral(n: int) -> Floats:
    k = np.arange(n)
    z = 1.0 - (2.0 * k + 1.0) / n
    turn = math.pi * (3.0 - math.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
