# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the covariance of a triad's constants after a test, and the choice of a further position.

At rest |f| = g, so each position gives one equation for the nine constants of a triad: bias x y z
[g], relative scale x y z, elements yx zx zy of the misalignment matrix [rad], in this order. The
equations are linearised about an ideal triad. The directions of the positions, the noise and the
prior of the fit determine the covariance of the constants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import FitError
from ..typing import Floats
from ..unit.calibration import Calibration, parameter_layout
from ..unit.gravity import STANDARD_GRAVITY
from .initial_triad import constant_calibration
from .unknowns import BIAS_SD, MISALIGNMENT_SD, SCALE_SD

#: Two rests are taken as one position if their directions differ by at most this angle [deg].
SAME_DIRECTION_DEG = 5.0


def force_columns(up: Floats) -> Floats:
    """Return derivatives (n, 3, 9) of the force in attitudes `up`, (n, 3), by the constants."""
    columns, axes = np.zeros((len(up), 3, 9)), np.arange(3)
    columns[:, axes, axes] = 1.0
    columns[:, axes, 3 + axes] = up
    columns[:, [1, 2, 2], [6, 7, 8]] = up[:, [0, 0, 1]]
    return columns


def norm_columns(up: Floats) -> Floats:
    """Return derivatives (n, 9) of |f| in attitudes `up`, (n, 3), by a triad's constants."""
    return np.asarray(np.einsum('ni,nij->nj', up, force_columns(up)))


def constants_covariance(
    up: Floats, sd: Floats, misalignment_sd: float = MISALIGNMENT_SD
) -> Floats:
    """Return the constants' covariance; `up`: attitudes, (n, 3); `sd`: noise of each |f| [g]."""
    rows = norm_columns(up) / sd[:, None]
    prior_sd = np.repeat([BIAS_SD / STANDARD_GRAVITY, SCALE_SD, misalignment_sd], 3)
    return np.asarray(np.linalg.inv(np.diag(prior_sd**-2) + rows.T @ rows))


def worst_sd(covariance: Floats) -> float:
    """Return the largest sd [g] of a component of the force, over attitudes and components."""
    columns = force_columns(_SPHERE)
    return math.sqrt(np.max(np.linalg.eigvalsh(columns @ covariance @ columns.transpose(0, 2, 1))))


def next_direction(covariance: Floats, sd: float, positions: Floats) -> Floats:
    """
    Find the direction of a new position, of noise `sd` [g], that most reduces the variance of the
    force, averaged over all attitudes.

    A cubic unit is held most easily on a face. The faces, edges and corners of a cube are tried in
    this order, then all other directions: the first kind is used that has a direction at least
    half as good as the best direction. Directions within 20 degrees of a vector in `positions`,
    shape (n, 3), are not proposed; if no direction is left, the result is +z.
    """
    columns = force_columns(_SPHERE)
    weight = np.einsum('nij,nik->jk', columns, columns) / len(columns)
    of_norm = norm_columns(_SPHERE)
    moved = of_norm @ covariance
    gain = np.einsum('ij,jk,ik->i', moved, weight, moved)
    gain /= np.einsum('ij,ij->i', moved, of_norm) + sd * sd
    gain[np.max(_SPHERE @ positions.T, axis=1, initial=-1.0) > math.cos(math.radians(20.0))] = 0.0
    good = gain >= 0.5 * gain.max()
    # Slices of `_SPHERE`: faces, edges and corners of a cube, and all other directions.
    tiers = slice(0, 6), slice(6, 18), slice(18, 26), slice(26, None)
    tier = next(tier for tier in tiers if good[tier].any())
    return np.asarray(_SPHERE[tier][np.argmax(gain[tier] >= 0.99 * gain[tier].max())])


def farthest(up: Floats) -> tuple[Floats, float]:
    """Return the direction farthest from all `up`, (n, 3), and its angle to the nearest [deg]."""
    nearest = np.max(_SPHERE @ up.T, axis=1, initial=-1.0)
    chosen = int(np.argmin(nearest))
    return _SPHERE[chosen], float(np.degrees(np.arccos(np.minimum(nearest[chosen], 1.0))))


def distinct_directions(up: Floats) -> Floats:
    """Return `up`, (n, 3), less NaN and vectors near (`SAME_DIRECTION_DEG`) an earlier vector."""
    kept: list[Floats] = []
    limit = np.cos(np.radians(SAME_DIRECTION_DEG))
    for direction in up[np.isfinite(up).all(axis=1)]:
        if all(float(direction @ other) < limit for other in kept):
            kept.append(direction)
    return np.array(kept).reshape(-1, 3)


def directions(means: Floats, centre: Floats) -> Floats:
    """Return unit vectors from a centre to mean samples, (n, 3); NaN for samples at the centre."""
    norms = np.linalg.norm(means - centre, axis=1, keepdims=True)
    return np.asarray((means - centre) / np.where(norms > 0.0, norms, np.nan))


def n_directions(means: Floats) -> int:
    """Return the number of distinct directions of mean samples, (n, 3), about `rough_centre`."""
    return len(distinct_directions(directions(means, rough_centre(means))))


def rough_centre(means: Floats) -> Floats:
    """
    Return the sample at zero force: 0, or a sphere's centre if the norms of the samples differ.

    `means`: mean samples, shape (n, 3). The centre is taken as 0 for fewer than four samples,
    for samples in a plane or almost one attitude, and for an implausible sphere.
    """
    zero = np.zeros(3)
    if len(means) < 4:
        return zero
    arms = means - means.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
    # Norms whose sd is below 30 % of the RMS distance of the samples from their mean agree with
    # a sphere about 0.
    if np.std(np.linalg.norm(means, axis=1)) < 0.3 * spread:
        return zero
    values = np.linalg.eigvalsh(arms.T @ arms)
    # Samples whose smallest principal variance is below 2 % of the largest principal variance are
    # almost in a plane, and do not determine a sphere.
    if values[0] < 0.02 * values[2]:
        return zero
    # A sample m on a sphere about c (m and c less the mean of all) has |m|^2 = 2 c m + const.
    columns = np.column_stack((2.0 * arms, np.ones(len(arms))))
    centre = np.linalg.lstsq(columns, np.sum(arms**2, axis=1), rcond=None)[0][:3]
    radii = np.linalg.norm(arms - centre, axis=1)
    # Accept the sphere if the sd of the distances from its centre is below 10 % of the radius, and
    # the RMS distance of the samples from their mean exceeds half of the radius (this distance is
    # 1 radius for six faces, and 0.1 radius for samples within 6 degrees of each other).
    is_sphere = np.std(radii) < 0.1 * np.mean(radii) < 0.2 * spread
    # A sphere exists through any four samples. Accept a sphere only if the coordinates of its
    # centre agree: the three zero-g outputs of an analog triad are within 20 % of their mean
    # (ADXL335 data sheet, 1.2 to 1.8 V).
    centre = means.mean(axis=0) + centre
    is_common = np.ptp(centre) < 0.4 * abs(centre.mean())
    return np.asarray(centre) if is_sphere and is_common else zero


def geometry(up: Floats, with_misalignment: bool) -> float:
    """Return the largest ratio of a constant's sd to the noise of |f|; inf if undetermined."""
    jacobian = norm_columns(up)[:, : 9 if with_misalignment else 6]
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    if values[0] < 1e-9 * values[-1]:
        return float('inf')
    return float(np.sqrt(np.max((vectors**2) @ (1.0 / values))))


def best_rests(candidates: list[Floats]) -> int:
    """
    Return the index of the best of several sets of n rests, each given by mean samples, (n, 3).

    A set's cost is the largest sd of a constant, by the directions of the rests and the residuals
    of |f|. The best set is the first set whose cost is within 2 % of the smallest cost, because
    earlier sets have longer, quieter rests. The index is 0 if no set has rests in six attitudes.
    """
    counts = [n_directions(means) for means in candidates]
    costs = np.array([
        _cost(means, max(counts) >= 12) if n >= 6 else np.inf
        for means, n in zip(candidates, counts, strict=True)
    ])  # fmt: skip
    return int(np.argmax(costs <= 1.02 * np.min(costs)))


def _cost(means: Floats, with_misalignment: bool) -> float:
    """Return the largest sd [g] of a constant fitted to rests, from the scatter of |f|."""
    n_free = len(means) - (9 if with_misalignment else 6)
    if n_free < 0:
        return np.inf
    try:
        force = constant_calibration(means, 1.0, MISALIGNMENT_SD * with_misalignment).force(means)
    except FitError:
        return np.inf
    norms = np.linalg.norm(force, axis=1)
    # A prior scatter of 1e-3 g, with the weight of four rests, prevents the choice of a set of few
    # rests whose |f| agrees by chance.
    square = float(np.sum((norms - 1.0) ** 2)) + 4 * 1e-3**2
    scatter = float(np.sqrt(square / (n_free + 4)))
    return geometry(force / norms[:, None], with_misalignment) * scatter


@dataclass(frozen=True)
class LeastKnown:
    """
    The attitude with the largest sd of |f|, at rest and at the reference temperature.

    up: direction of the specific force, in the frame of the unit
    away_deg: angle between this attitude and the nearest position [deg]
    sd_m_s2: sd of |f| in this attitude [m/s^2]
    seen_sd_m_s2: median over the positions of the sd of |f| [m/s^2]
    """

    up: tuple[float, float, float]
    away_deg: float
    sd_m_s2: float
    seen_sd_m_s2: float


def least_known(calibration: Calibration, up: Floats) -> LeastKnown | None:
    """Find the attitude of the largest sd of |f|; `up`: positions. None without a covariance."""
    if calibration.posterior is None:
        return None
    layout = parameter_layout(calibration)
    levels = [block.static for block in (*layout.bias, *layout.scale)]
    places = [*levels, *range(layout.misalignment, layout.misalignment + 3)]
    # Signs are negative because a bias or scale that is too large makes corrected force smaller.
    unit = np.array([-1.0 / axis.scale_factor for axis in calibration.axes])
    unit = np.concatenate((unit, np.repeat((-1.0, 1.0), 3) * calibration.gravity_m_s2))
    covariance = calibration.posterior.covariance()[np.ix_(places, places)] * np.outer(unit, unit)
    sd, seen_sd = (
        np.sqrt(np.einsum('ij,jk,ik->i', columns, covariance, columns))
        for columns in (norm_columns(_SPHERE), norm_columns(up))
    )
    worst = int(np.argmax(sd))
    x, y, z = _SPHERE[worst].tolist()
    nearest = min(float(np.max(up @ _SPHERE[worst], initial=-1.0)), 1.0)
    away_deg = math.degrees(math.acos(nearest))
    return LeastKnown((x, y, z), away_deg, float(sd[worst]), float(np.median(seen_sd)))


def direction_text(up: Floats) -> str:
    """Describe an attitude: the axes that point up (+x or -x), and the force on each axis [g]."""
    # Adding 0 turns a rounded -0 into +0.
    rounded = zip('xyz', (np.round(up, 2) + 0.0).tolist(), strict=True)
    reading = ', '.join(f'{name} {value:+.2f} g' for name, value in rounded)
    is_up = np.abs(up) > 0.1
    axes = [f'{"-" if up[k] < 0.0 else "+"}{"xyz"[k]}' for k in np.flatnonzero(is_up)]
    names = ' and '.join(filter(None, (', '.join(axes[:-1]), axes[-1])))
    how = 'partly ' if np.ptp(np.abs(up[is_up])) > 0.1 else 'equally ' if len(axes) > 1 else ''
    return f'{names} {how}up: {reading}'


def _cube() -> Floats:
    """Return the directions of faces, edges and corners of a cube, in this order, +z first."""
    steps = np.array([(x, y, z) for z in (1, 0, -1) for y in (0, 1, -1) for x in (0, 1, -1)])
    order = np.argsort(np.abs(steps).sum(axis=1), kind='stable')[1:]
    cube = steps[order].astype(np.float64)
    return np.asarray(cube / np.linalg.norm(cube, axis=1, keepdims=True))


def _spiral(n: int) -> Floats:
    """Return n unit vectors spread evenly over the sphere, shape (n, 3)."""
    k = np.arange(n)
    z = 1.0 - (2.0 * k + 1.0) / n
    turn, radius = math.pi * (3.0 - math.sqrt(5.0)) * k, np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


# Unit vectors: 26 to faces, edges and corners of a cube, then 500 at intervals of 8 degrees.
_SPHERE = np.concatenate([_cube(), _spiral(500)])
