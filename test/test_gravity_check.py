# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The field check: a good calibration passes, an aged one shows, motion is not mistaken for either.
"""

import math

import numpy as np
import pytest
from builders import GRAVITY

from thermo_comp.online.checks import GravityCheck

NOISE_SD = 2e-3
BIAS_SD = 1e-4
VARIANCE = NOISE_SD**2 + BIAS_SD**2
COVARIANCE = (VARIANCE, 0.0, 0.0, VARIANCE, 0.0, VARIANCE)


def watch(rng, *, bias=0.0, seconds=60, motion=0.0, rate_hz=100, monitor=None):
    monitor = monitor or GravityCheck(GRAVITY)
    up = np.array([0.3, -0.5, math.sqrt(1 - 0.34)])
    n = seconds * rate_hz
    t = np.arange(n) / rate_hz
    force = GRAVITY * up + bias * up + NOISE_SD * rng.standard_normal((n, 3))
    force += motion * np.sin(2 * np.pi * 1.3 * t)[:, None] * [0.7, 0.6, 0.1]
    for stamp, row in zip(np.rint(t * 1e9).astype(int).tolist(), force.tolist(), strict=True):
        monitor.add(stamp, tuple(row), COVARIANCE, 3 * NOISE_SD**2)
    return monitor.result


def test_residual_of_a_good_calibration_is_within_its_sd(rng):
    result = watch(rng)
    # One window of 99 samples (0.98 s) leaves 0.2 mm/s^2 of noise; 30 of them 0.04.
    assert abs(result.residual) < 5 * NOISE_SD / math.sqrt(100 * 15)
    assert result.residual_sd == pytest.approx(math.hypot(BIAS_SD, NOISE_SD / math.sqrt(99)))
    assert result.n_windows == 59  # the first has no window before it to agree with
    assert result.is_still


def test_aged_calibration_shows(rng):
    result = watch(rng, bias=3e-3)
    assert result.residual == pytest.approx(3e-3, abs=5 * NOISE_SD / math.sqrt(100 * 15))
    assert result.residual > 10 * result.residual_sd


def test_motion_says_nothing(rng):
    assert watch(rng, motion=0.05) is None


def test_time_that_jumps_starts_a_new_window(rng):
    monitor = GravityCheck(GRAVITY)
    watch(rng, seconds=10, monitor=monitor)
    result = watch(rng, seconds=10, monitor=monitor)
    assert result.n_windows == 19
