# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Least squares under a wandering level: honest where ordinary least squares is not.

"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermo_comp.errors import FitError
from thermo_comp.fitting.wander import Noise, fit_with_wander


def wander(rng, time, sd, tau):
    """Make a stationary first-order process on a uniform grid."""
    keep = np.exp(-(time[1] - time[0]) / tau)
    kicks = sd * np.sqrt(1.0 - keep**2) * rng.standard_normal(len(time))
    kicks[0] = sd * rng.standard_normal()
    return lfilter([1.0], [1.0, -keep], kicks)


def ramp(time):
    t = 10.0 * np.exp(-time / 300.0)
    return np.column_stack((np.ones_like(t), t))


def test_white_noise_gives_ordinary_least_squares(rng):
    time = np.arange(120) * 5.0
    columns = ramp(time)
    data = columns @ (3.0, 0.5) + 0.1 * rng.standard_normal(120)
    found = fit_with_wander(columns, data, time, np.full(120, 25.0))
    plain, chi2, *_ = np.linalg.lstsq(columns, data, rcond=None)
    covariance = np.linalg.inv(columns.T @ columns) * chi2[0] / 118
    # Of 120 windows the wander is found below a third of the noise; the estimates move by less
    # than half of their sd for it.
    assert found.noise.wander_sd < 0.05
    np.testing.assert_allclose(
        found.parameters, plain, atol=0.5 * np.sqrt(covariance.diagonal().max())
    )
    assert found.noise.white_sd == pytest.approx(0.1 * 5.0, rel=0.2)


def test_each_candidate_equals_the_dense_solution(rng):
    # Second route: the whole covariance matrix, inverted; uneven times and counts.
    time = np.cumsum(rng.uniform(1.0, 9.0, 60))
    columns, count = ramp(time), rng.integers(1, 30, 60).astype(float)
    data = rng.standard_normal(60)
    found = fit_with_wander(columns, data, time, count)
    assert sum(one.weight for one in found.candidates) == pytest.approx(1.0)
    new = time[-1] + np.array([5.0, 500.0])
    variances = []
    for one in found.candidates:
        noise = one.noise
        dense = noise.wander(time, time) + np.diag(noise.white_sd**2 / count)
        weighted = np.linalg.solve(dense, columns)
        covariance = np.linalg.inv(columns.T @ weighted)
        gain = covariance @ weighted.T
        np.testing.assert_allclose(one.parameters, gain @ data, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(one.covariance, covariance, rtol=1e-6)
        # Of a new datum less its prediction: the variance of a linear combination.
        both = np.concatenate((time, new))
        joint = noise.wander(both, both)
        joint[:60, :60] = dense
        joint[60:, 60:] += np.eye(2) * noise.white_sd**2 / 25.0
        combination = np.hstack((-ramp(new) @ gain, np.eye(2)))
        off = ramp(new) @ (one.parameters - found.parameters)
        variance = np.diag(combination @ joint @ combination.T)
        variances.append(one.weight * (variance + off**2))
    sd = found.prediction_sd(ramp(new), new, np.full(2, 25.0))
    np.testing.assert_allclose(sd, np.sqrt(found.inflation * np.sum(variances, axis=0)), rtol=1e-6)


def test_counts_weigh(rng):
    # Windows of 100 samples beside windows of 1: the slope is as well known as from the former.
    time = np.arange(200) * 5.0
    columns = ramp(time)
    count = np.where(np.arange(200) % 2, 100.0, 1.0)
    data = columns @ (3.0, 0.5) + rng.standard_normal(200) / np.sqrt(count)
    found = fit_with_wander(columns, data, time, count)
    assert found.noise.white_sd == pytest.approx(1.0, rel=0.15)
    ideal = np.linalg.inv(columns.T @ (count[:, None] * columns))
    # The doubt about a slow wander costs something: less than a factor 2.5.
    assert 1.0 < np.sqrt(found.covariance[1, 1] / ideal[1, 1]) < 2.5


def test_predicted_sd_covers_later_data(rng):
    # The claim that matters: fit the first two thirds, predict the last one, over and over.
    # 60 runs of some 10 independent stretches: the pooled square has an sd of 10 %.
    time = np.arange(180) * 5.0
    columns = ramp(time)
    first = time < 600.0
    honest, naive = [], []
    for _ in range(60):
        data = columns @ (3.0, 0.5) + wander(rng, time, 0.3, 150.0)
        data += 0.2 * rng.standard_normal(180)
        count = np.full(180, 25.0)
        found = fit_with_wander(columns[first], data[first], time[first], count[first])
        left = (data - columns @ found.parameters)[~first]
        sd = found.prediction_sd(columns[~first], time[~first], count[~first])
        honest.append(np.mean((left / sd) ** 2))
        plain, chi2, *_ = np.linalg.lstsq(columns[first], data[first], rcond=None)
        slope_sd = np.sqrt(np.linalg.inv(columns[first].T @ columns[first])[1, 1] * chi2[0] / 118)
        naive.append((plain[1] - 0.5) / slope_sd)
    assert np.mean(honest) == pytest.approx(1.0, abs=0.35)
    # WHY this module exists: ordinary least squares is wrong by several of its own sd.
    assert np.std(naive) > 2.0


def test_slope_sd_is_honest(rng):
    time = np.arange(120) * 5.0
    columns = ramp(time)
    pulls = []
    for _ in range(60):
        data = columns @ (3.0, 0.5) + wander(rng, time, 0.3, 100.0)
        data += 0.2 * rng.standard_normal(120)
        found = fit_with_wander(columns, data, time, np.full(120, 25.0))
        pulls.append((found.parameters[1] - 0.5) / np.sqrt(found.covariance[1, 1]))
    # 60 draws of a unit normal have an rms of 1 within 0.09 (1 sd). With six time constants of
    # data the doubt about the noise makes the claim somewhat wide; it must not be narrow.
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.25


def test_smooth_errors_are_not_taken_for_small_ones(rng):
    # WHY: hysteresis is smooth. From window to window it looks like nothing, so that a
    # first-order process predicted a sixth of what was found. WHAT: the predicted sd covers it.
    time = np.arange(400) * 15.0
    columns = np.column_stack((np.ones(400), np.sin(time / 900.0)))
    data = columns @ (3.0, 0.5) + 0.2 * np.cos(time / 900.0) + 0.01 * rng.standard_normal(400)
    odd = (time // 300.0) % 2 == 1
    found = fit_with_wander(columns[~odd], data[~odd], time[~odd], np.full(200, 25.0))
    left = (data - columns @ found.parameters)[odd]
    sd = found.prediction_sd(columns[odd], time[odd], np.full(200, 25.0))
    assert found.inflation > 4.0
    assert np.sqrt(np.mean((left / sd) ** 2)) == pytest.approx(1.0, abs=0.3)


def test_drift_sd_is_that_of_a_difference():
    noise = Noise(white_sd=1.0, wander_sd=2.0, time_constant_s=100.0)
    # Forgotten after many time constants: two independent levels.
    assert noise.drift_sd(1e6) == pytest.approx(2.0 * np.sqrt(2.0))
    # A random walk while short: sd sqrt(2 / tau) per root second.
    assert noise.drift_sd(1.0) == pytest.approx(2.0 * np.sqrt(2.0 / 100.0), rel=0.01)
    level = noise.wander(np.array([0.0]), np.array([0.0, 100.0]))
    np.testing.assert_allclose(level, [[4.0, 4.0 * np.exp(-1.0)]])


def test_shift_in_time_changes_nothing(rng):
    time = np.arange(80) * 5.0
    columns, data = ramp(time), rng.standard_normal(80)
    one = fit_with_wander(columns, data, time, np.ones(80))
    two = fit_with_wander(columns, data, time + 4096.0, np.ones(80))
    np.testing.assert_allclose(one.parameters, two.parameters, rtol=1e-9)


def test_too_few_windows():
    with pytest.raises(FitError, match='6 windows cannot tell 2 parameters'):
        fit_with_wander(np.ones((6, 2)), np.ones(6), np.arange(6.0), np.ones(6))
