# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the block's attitudes: well-spread positions, and the handling between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..typing import Floats, Ints
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


def positions(n: int, seed: int = 0, *, spread_deg: float = 3.0) -> Floats:
    """
    Return attitudes of a calibration test as the direction of the specific force.

    Six are the faces of a cube, nine the corners of a three-capped prism, twelve those of an
    icosahedron: the sets that tell bias, scale and misalignment apart best for their number. Other
    sets take the faces of a cube, then its edges, then its corners; beyond 26, an even spiral over
    the sphere. Each position is turned by a small random angle, since nobody levels the block.

    Parameters
    ----------
    n : int
        Number of positions; 6, 9, 12, 18, 24 and 26 are balanced sets.
    seed : int, optional
        Seed of the small turns.
    spread_deg : float, optional
        Standard deviation of the small turn about each transverse direction, degrees.

    Returns
    -------
    ndarray, shape (n, 3)
        Unit vectors in the accelerometer's frame.

    Raises
    ------
    ValueError
        If `n` is below 1 or `spread_deg` is negative.

    """
    if n < 1:
        raise ValueError(f'`n` must be at least 1, got {n}')
    if not spread_deg >= 0.0:
        raise ValueError(f'`spread_deg` must not be negative, got {spread_deg}')
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
        up[row] += math.radians(spread_deg) * np.cross(push, up[row])
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


@dataclass(frozen=True)
class Handling:
    """
    What happens when the block is taken from one position to the next.

    The turn from one attitude to the other takes the shortest way plus a whole turn; its rate
    rises and falls smoothly and reaches a few rad/s.

    Parameters
    ----------
    duration : float, optional
        From the first touch to rest, s.
    vibration : float, optional
        Standard deviation of the broadband vibration at its height, per axis, m/s^2.

    Raises
    ------
    ValueError
        If `duration` is not positive or `vibration` is negative.

    """

    duration: float = 10.0
    vibration: float = 2.0

    def __post_init__(self) -> None:
        if not self.duration > 0.0:
            raise ValueError(f'`duration` must be positive, got {self.duration}')
        if not self.vibration >= 0.0:
            raise ValueError(f'`vibration` must not be negative, got {self.vibration}')


class Attitude:
    """
    Specific force of a block that stands in one position, or in several in turn.

    Parameters
    ----------
    up : array_like, shape (3,) or (p, 3)
        Directions of the specific force at rest; normalised here.
    switch_s : array_like, shape (p - 1,)
        Instants at which the handling towards the next position begins, increasing, s.
    gravity : float
        Local gravity, m/s^2.
    handling : Handling
        How it is handled.

    Raises
    ------
    ValueError
        If `up` has another shape or a zero row, there is not one switch between each two
        positions, the switches leave no rest between them, or gravity is not positive.

    """

    def __init__(
        self, up: ArrayLike, switch_s: ArrayLike, gravity: float, handling: Handling
    ) -> None:
        up = np.atleast_2d(np.asarray(up, dtype=float))
        length = np.linalg.norm(up, axis=-1)
        if up.ndim != 2 or up.shape[1] != 3 or not np.all(length > 0.0):
            raise ValueError(f'`up` must hold non-zero vectors, shape (3,) or (p, 3), got {up}')
        if not (gravity > 0.0 and math.isfinite(gravity)):
            raise ValueError(f'`gravity` must be positive, got {gravity}')
        self.switch_s = np.atleast_1d(np.asarray(switch_s, dtype=float))
        if len(self.switch_s) != len(up) - 1:
            raise ValueError(
                f'`switch_s` must hold {len(up) - 1} instants for {len(up)} positions, '
                f'got {len(self.switch_s)}'
            )
        if np.any(np.diff(self.switch_s) <= handling.duration):
            raise ValueError(f'`switch_s` must be more than {handling.duration} s apart')
        self.up = up / length[:, None]
        self.gravity = gravity
        self.handling = handling

    def position(self, time: Floats) -> Ints:
        """
        Return the number of the position at rest, -1 while handled.

        Parameters
        ----------
        time : ndarray, shape (m,)
            Seconds from the start of the run.

        """
        passed = np.searchsorted(self.switch_s, time, side='right')
        since = time - np.concatenate([[-np.inf], self.switch_s])[passed]
        return np.where(since < self.handling.duration, -1, passed).astype(np.int64)

    def specific_force(self, time: Floats, vibration: list[np.random.Generator]) -> Floats:
        """
        Return the specific force, drawing the vibration of the handled instants.

        Parameters
        ----------
        time : ndarray, shape (m,)
            Seconds from the start of the run, following the instants of the call before.
        vibration : list of numpy.random.Generator
            Generator per axis; one number is drawn from each for every handled instant.

        Returns
        -------
        ndarray, shape (m, 3)
            Specific force, m/s^2; a read-only view where the block stands still throughout.

        """
        where = self.position(time)
        if np.all(where == where[0]) and where[0] >= 0:
            return np.broadcast_to(self.gravity * self.up[where[0]], (len(time), 3))
        direction = self.up[where]
        handled = np.flatnonzero(where < 0)
        after = np.searchsorted(self.switch_s, time[handled], side='right')
        part = (time[handled] - self.switch_s[after - 1]) / self.handling.duration
        for k in np.unique(after):
            is_this = after == k
            axis, angle = _turn(self.up[k - 1], self.up[k])
            share = part[is_this]
            turned = angle * (share - np.sin(2.0 * math.pi * share) / (2.0 * math.pi))
            direction[handled[is_this]] = _rotated(self.up[k - 1], axis, turned)
        force = self.gravity * direction
        envelope = self.handling.vibration * np.sin(math.pi * part) ** 2
        for i, rng in enumerate(vibration):
            force[handled, i] += envelope * rng.standard_normal(len(handled))
        return np.asarray(force)


def _turn(start: Floats, end: Floats) -> tuple[Floats, float]:
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
    angle = math.atan2(sine, float(start @ end)) + 2.0 * math.pi
    return axis / np.linalg.norm(axis), angle


def _rotated(vector: Floats, axis: Floats, angle: Floats) -> Floats:
    # Rodrigues' formula with the vector across the axis.
    across = np.cross(axis, vector)
    return np.cos(angle)[:, None] * vector + np.sin(angle)[:, None] * across
