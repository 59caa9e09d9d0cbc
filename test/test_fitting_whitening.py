# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Whitening: what the filter makes of series is what the dense covariance matrix makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from thermo_comp.fitting.design import Whitener


def uneven(rng):
    """Make positions of several lengths - one of a single window - with gaps and weights."""
    lengths = (7, 1, 12, 4)
    position = np.repeat(np.arange(len(lengths)), lengths)
    steps = rng.uniform(1.0, 9.0, len(position))
    # A gap in which a walk goes far.
    steps[12] = 4000.0
    time = np.concatenate(
        [100.0 * k + np.cumsum(steps[position == k]) for k in range(len(lengths))]
    )
    return position, time, rng.uniform(0.1, 3.0, len(position))


def dense(position, time, weight, rho):
    """Write down the covariance: a walk that begins at 0 with each position, and white noise."""
    first = np.array([time[position == p][0] for p in position])
    since = time - first
    same = position[:, None] == position
    walk = np.where(same, rho * np.minimum(since[:, None], since), 0.0)
    return walk + np.diag(1.0 / weight)


@pytest.mark.parametrize('rho', [0.0, 1e-6, 1e-2, 10.0])
def test_products_and_determinant_are_those_of_the_dense_matrix(rng, rho):
    position, time, weight = uneven(rng)
    series = rng.standard_normal((len(time), 5))
    whitener = Whitener(position, time)
    gains = whitener.gains(weight, rho)
    white = whitener.filter(series, gains)
    covariance = dense(position, time, weight, rho)
    expected = series.T @ np.linalg.solve(covariance, series)
    # Rounding alone, of a matrix whose condition is below 1e6.
    np.testing.assert_allclose(white.T @ white, expected, rtol=1e-9, atol=1e-10)
    determinant = np.linalg.slogdet(covariance)[1]
    assert whitener.log_determinant(gains) == pytest.approx(determinant, abs=1e-9)


def test_each_position_is_filtered_by_itself(rng):
    position, time, weight = uneven(rng)
    series = rng.standard_normal((len(time), 2))
    whole = Whitener(position, time)
    found = whole.filter(series, whole.gains(weight, 0.05))
    for p in range(4):
        rows = position == p
        alone = Whitener(np.zeros(rows.sum(), dtype=int), time[rows])
        one = alone.filter(series[rows], alone.gains(weight[rows], 0.05))
        np.testing.assert_allclose(found[rows], one, rtol=1e-12)


def test_a_walk_is_whitened(rng):
    # 300 positions of 40 windows: the covariance of 12000 innovations is known to 1 / sqrt(300)
    # per entry, 5 sd are 0.3.
    n, steps = 300, 40
    time = np.tile(np.cumsum(rng.uniform(20.0, 100.0, steps)), n)
    position = np.repeat(np.arange(n), steps)
    rho, weight = 0.02, np.tile(rng.uniform(0.3, 1.0, steps), n)
    interval = np.diff(time[:steps], prepend=time[0])
    walk = np.cumsum(np.sqrt(rho * interval) * rng.standard_normal((n, steps)), axis=1)
    series = walk.ravel() + rng.standard_normal(n * steps) / np.sqrt(weight)
    whitener = Whitener(position, time)
    white = whitener.filter(series[:, None], whitener.gains(weight, rho)).reshape(n, steps)
    np.testing.assert_allclose(white.T @ white / n, np.eye(steps), atol=0.35)
    assert np.mean(white**2) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / series.size))
