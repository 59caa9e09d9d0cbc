# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what the attitudes of rests tell: how many there are, about which centre, and how well."""

from __future__ import annotations

import numpy as np

from ..errors import FitError
from ..typing import Floats
from .coverage import norm_columns
from .start import constant_calibration

#: Directions closer than this are one position measured twice.
SAME_DIRECTION_DEG = 5.0
# About their centre readings have one norm: elsewhere it differs by this part of their spread, and
# about a good centre by less than this part of its own.
_OFF_CENTRE, _ON_CENTRE = 0.3, 0.1
# Readings that lie this flat have no centre across.
_FLAT = 0.02
# What a scan expects of a rest before it sees any: an error in parts of g, as if so many had shown
# it, else few rests that agree by luck would win; and what it takes for better.
_EXPECTED_ERROR, _EXPECTED_N, _BETTER = 1e-3, 4, 1.02
_FEWEST, _FEWEST_FOR_MISALIGNMENT = 6, 12


def distinct_directions(up: Floats) -> Floats:
    """Drop unit vectors, shape (n, 3), that repeat another."""
    kept: list[Floats] = []
    limit = np.cos(np.radians(SAME_DIRECTION_DEG))
    for direction in up:
        if all(float(direction @ other) < limit for other in kept):
            kept.append(direction)
    return np.array(kept).reshape(-1, 3)


def directions(means: Floats) -> Floats:
    """Make unit vectors of mean readings, shape (n, 3), about their rough centre."""
    arms = means - rough_centre(means)
    norms = np.linalg.norm(arms, axis=1, keepdims=True)
    return np.asarray(arms / np.where(norms > 0.0, norms, 1.0))


def rough_centre(means: Floats) -> Floats:
    """
    Find the reading of no force: zeros, where they will do, else the centre of a sphere.

    Angles between raw vectors mean nothing where the zero of the words is far away, as in offset
    binary. `means` has shape (n, 3); too few, or flat ones, have no centre but zero.
    """
    zero = np.zeros(3)
    if len(means) < 4:
        return zero
    arms = means - means.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
    if np.std(np.linalg.norm(means, axis=1)) < _OFF_CENTRE * spread:
        return zero
    values = np.linalg.eigvalsh(arms.T @ arms)
    if values[0] < _FLAT * values[2]:
        return zero
    # |m|^2 = 2 c m + const, of the arms, where numbers are small.
    columns = np.column_stack((2.0 * arms, np.ones(len(arms))))
    centre = np.linalg.lstsq(columns, np.sum(arms**2, axis=1), rcond=None)[0][:3]
    radii = np.linalg.norm(arms - centre, axis=1)
    is_sphere = np.std(radii) < _ON_CENTRE * np.mean(radii)
    return np.asarray(means.mean(axis=0) + centre) if is_sphere else zero


def geometry(up: Floats, with_misalignment: bool) -> float:
    """
    Worst standard deviation of bias, scale and misalignment per unit of norm noise.

    `up`: directions, shape (n, 3).
    """
    jacobian = norm_columns(up)[:, : 9 if with_misalignment else 6]
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    if values[0] < 1e-9 * values[-1]:
        return float('inf')
    return float(np.sqrt(np.max((vectors**2) @ (1.0 / values))))


def best_rests(candidates: list[Floats]) -> int:
    """
    Choose among sets of rests, the strictest first: mean readings, shape (n, 3) each.

    The one that tells bias and scale best: by what its rests leave of |f| - g, and how they are
    spread. The first, unless another is clearly better, or where no set has enough attitudes.
    """
    enough = [len(distinct_directions(directions(means))) for means in candidates]
    n_most = max(enough, default=0)
    costs = np.full(len(candidates), np.inf)
    for number, means in enumerate(candidates):
        if enough[number] >= _FEWEST:
            costs[number] = _cost(means, n_most >= _FEWEST_FOR_MISALIGNMENT)
    if not np.isfinite(costs).any():
        return 0
    return int(np.argmax(costs <= _BETTER * np.min(costs)))


def _cost(means: Floats, with_misalignment: bool) -> float:
    """Worst standard deviation of the constants by the scatter that is left, in parts of g."""
    n_free = len(means) - (9 if with_misalignment else 6)
    if n_free < 0:
        return np.inf
    try:
        force = constant_calibration(means, 1.0, with_misalignment).force(means)
    except FitError:
        return np.inf
    norms = np.linalg.norm(force, axis=1)
    left = float(np.sum((norms - 1.0) ** 2)) + _EXPECTED_N * _EXPECTED_ERROR**2
    scatter = float(np.sqrt(left / (n_free + _EXPECTED_N)))
    return geometry(force / norms[:, None], with_misalignment) * scatter
