# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The gravity check accepts good calibrations, reports aged calibrations, and ignores motion."""

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


def test_the_residual_of_a_good_calibration_is_near_0_and_its_sd_is_right(rng):
    result = watch(rng)
    # The mean of 99 samples has a noise of 0.2 mm/s^2, the mean of 30 such windows 0.04 mm/s^2.
    assert abs(result.residual) < 5 * NOISE_SD / math.sqrt(100 * 15)
    assert result.residual_sd == pytest.approx(math.hypot(BIAS_SD, NOISE_SD / math.sqrt(99)))
    assert result.n_windows == 59  # the first of 60 windows has no predecessor to compare with
    assert result.is_still


def test_an_aged_calibration_is_reported(rng):
    result = watch(rng, bias=3e-3)
    assert result.residual == pytest.approx(3e-3, abs=5 * NOISE_SD / math.sqrt(100 * 15))
    assert result.residual > 10 * result.residual_sd


def test_motion_gives_no_verdict(rng):
    assert watch(rng, motion=0.05) is None


def test_a_jump_of_the_stamps_starts_a_new_window(rng):
    monitor = GravityCheck(GRAVITY)
    watch(rng, seconds=10, monitor=monitor)
    result = watch(rng, seconds=10, monitor=monitor)
    assert result.n_windows == 19


def steps(rng, *, offset, at_s=20.0, ramp_s=0.0, rate_hz=2.5, scatter=0.0):
    """Change |f| at `at_s`; return the time from then to the refusal [s], and the result."""
    monitor = GravityCheck(GRAVITY, tolerance=0.1)
    up = np.array([0.3, -0.5, math.sqrt(1 - 0.34)])
    for k in range(round((at_s + 10.0) * rate_hz)):
        seconds = k / rate_hz
        grown = min(max((seconds - at_s) / ramp_s, 0.0), 1.0) if ramp_s else seconds >= at_s
        sd = math.hypot(NOISE_SD, scatter * (seconds >= at_s))
        force = (GRAVITY + offset * grown) * up + sd * rng.standard_normal(3)
        monitor.add(round(seconds * 1e9), tuple(force), COVARIANCE, 3 * NOISE_SD**2)
        if monitor.is_refuted:
            return seconds - at_s, monitor.result
    return math.inf, monitor.result


@pytest.mark.parametrize('rate_hz', [2.5, 5.0, 10.0])
@pytest.mark.parametrize('offset', [0.3, -3.0, 15.0])
def test_a_step_at_rest_refutes_the_calibration_within_a_second(rng, rate_hz, offset):
    # WHY: the refusal came after five seconds, and its printed mean included samples before the
    # change.
    after_s, result = steps(rng, offset=offset, rate_hz=rate_hz)
    assert after_s < 1.0
    assert result.residual == pytest.approx(offset, abs=5 * NOISE_SD)


def test_a_change_by_motion_does_not_refute_the_calibration_at_once(rng):
    # Such changes occur in a lift that accelerates for 0.8 s, and in a shaking car.
    assert steps(rng, offset=1.0, ramp_s=0.8, rate_hz=5.0)[0] > 2.0
    assert steps(rng, offset=1.0, scatter=0.05, rate_hz=5.0)[0] > 2.0


def test_the_message_states_the_deviation_of_the_latest_windows(rng):
    monitor = GravityCheck(GRAVITY, tolerance=0.1)
    watch(rng, seconds=40, bias=0.001, monitor=monitor)
    assert not monitor.is_refuted
    # The stamps start again at 0, so the change of |f| is taken for a restart, not for a step.
    result = watch(rng, seconds=8, bias=0.5, monitor=monitor)
    assert monitor.is_refuted
    assert result.residual == pytest.approx(0.5, abs=1e-3)
