# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns simulated forces beyond 1 g: a rotation in the chamber, and the nonlinearity of axes."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from .drift import ZERO, Triple


@dataclass(frozen=True)
class Bend:
    """
    Nonlinear terms ``K2 f^2 + K3 f^3`` of the axes: K2 [ug/g^2] and K3 [ug/g^3] at the reference
    temperature, and the relative change of K2 and K3 per kelvin of the board.
    """

    square: Triple = ZERO
    cube: Triple = ZERO
    per_kelvin: float = 0.0

    def added(self, force: Floats, t: Floats) -> Floats:
        """Return the nonlinear terms [m/s^2], shape (n, 3), t [K] above the reference."""
        f = force / STANDARD_GRAVITY
        terms = np.array(self.square) * f**2 + np.array(self.cube) * f**3
        return np.asarray(MICRO_G * (1.0 + self.per_kelvin * t)[:, None] * terms)


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


def steps(
    begins_s: tuple[float, ...], rates: tuple[float, ...], dwell_s: float, ramp_s: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return times and rates of runs from `begins_s` [s] on: all `rates`, with ramps between."""
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
