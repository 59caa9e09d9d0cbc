# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The inertial navigator of benchmarks/ins.py agrees with closed forms."""

import numpy as np
import pytest
from ins import EARTH_RADIUS, FREE_S, Model, Navigator, fly, levelled

G = 9.80665
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize('axis', [0, 1])
def test_a_bias_causes_a_schuler_oscillation(axis):
    # With w^2 = g / radius of the Earth, a bias b moves the position by b / w^2 (1 - cos(w t)).
    bias, dt, minutes = 1e-4, 0.5, 84
    force = G * UP
    force[axis] += bias
    navigator = Navigator(np.eye(3), G)
    omega = np.sqrt(G / EARTH_RADIUS)
    for k in range(1, minutes * 120 + 1):
        navigator.step(dt, force)
        if k % 1200 == 0:
            angle = omega * k * dt
            expected = bias / omega**2 * (1.0 - np.cos(angle))
            # In a time step the position, up to 130 m, changes by 0.04 m: the tolerance is 0.1 m.
            assert navigator.position[axis] == pytest.approx(expected, abs=0.1)
            speed = bias / omega * np.sin(angle)
            assert navigator.velocity[axis] == pytest.approx(speed, abs=1e-4)
            tilt = np.hypot(*(navigator.attitude @ UP)[:2])
            assert tilt == pytest.approx(expected / EARTH_RADIUS, abs=0.1 / EARTH_RADIUS)
    assert np.abs(navigator.position[1 - axis]) < 1e-6


def test_levelling_makes_the_force_vertical(rng):
    force = rng.normal(0.0, 3.0, (20, 3)) + G * UP
    attitude = levelled(force)
    product = attitude @ attitude.transpose(0, 2, 1)
    np.testing.assert_allclose(product, [np.eye(3)] * 20, atol=1e-12)
    expected = np.linalg.norm(force, axis=1)[:, None] * UP
    np.testing.assert_allclose((attitude @ force[..., None])[..., 0], expected, atol=1e-12)


def test_the_sd_of_the_filter_equals_the_closed_form_for_white_noise(rng):
    # The position variance has a part by levelling, and by noise (impulse response sin(w t) / w).
    density, dt = 1e-4, 0.5
    force = G * UP + rng.normal(0.0, density / np.sqrt(dt), (40_000, 3))
    free = fly(Model(force, density, 0.0), dt, UP, G, 0.0)
    omega, T = np.sqrt(G / EARTH_RADIUS), FREE_S
    by_levelling = density**2 / 300.0 * ((1.0 - np.cos(omega * T)) / omega**2) ** 2
    by_noise = density**2 * (T / 2.0 - np.sin(2.0 * omega * T) / (4.0 * omega)) / omega**2
    expected = np.sqrt(2.0 * (by_levelling + by_noise))
    assert free.sigma[-1, 0] == pytest.approx(expected, rel=0.01)
    # The 298 flights overlap: their RMS error is as uncertain as that of eight separate flights.
    assert 0.5 < np.sqrt(np.mean(free.position[-1] ** 2)) / expected < 1.5


def test_zupt_removes_a_bias_that_appears_after_levelling():
    # 25 min of zero-velocity updates must remove 90 % of a bias of 1e-3 m/s^2.
    dt, n_align = 0.5, 600
    force = np.tile(G * UP, (n_align + 3600 + 1, 1))
    force[n_align:, 0] += 1e-3
    message = fly(Model(force, 1e-4, 1e-3), dt, UP, G, 1500.0)
    assert fly(Model(force, 1e-4, 1e-3), dt, UP, G, 0.0).position[-1, 0] > 1000.0
    coasted = message.position[-1, 0] - message.position[2999, 0]
    # Uncorrected, this bias would cause a position error of 45 m in five minutes without updates.
    assert abs(coasted) < 4.5
