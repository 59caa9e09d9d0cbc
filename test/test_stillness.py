# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The reduction finds short rests of a hand-held unit, and no rest in a flight of a drone."""

import numpy as np
import pytest
from position_helpers import START_NS, Imu, ImuBlock

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, FitSource, fit, reduce_bag
from thermo_comp.simulation.campaign import positions

GRAVITY = 9.80665
MG = GRAVITY * 1e-3
RATE_HZ = 100.0
OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2')


def source(accel, gyro=None):
    stamps = START_NS + np.rint(np.arange(len(accel)) * 1e9 / RATE_HZ).astype(np.int64)
    nothing = np.zeros(0)
    imu = None if gyro is None else Imu(gyro)
    block = ImuBlock(stamps, accel, nothing.astype(np.int64), nothing,
                     nothing.astype(np.int64), nothing, imu=imu)  # fmt: skip
    return FitSource('log', lambda: [block])


def time_of(seconds):
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def ground(rng, seconds):
    n = len(time_of(seconds))
    level = np.array((0.0, 0.0, GRAVITY)) + 3.0 * MG * rng.standard_normal((n, 3))
    return level, np.radians(2.0) + np.radians(0.05) * rng.standard_normal((n, 3))


def hover(rng, seconds, vibration):
    """Simulate a drone: thrust of about g, a slow sway by 3 degrees, vibration of propellers."""
    time = time_of(seconds)
    tilt = np.radians(3.0) * np.sin(2.0 * np.pi * time[:, None] / np.array((5.0, 7.0)))
    thrust = GRAVITY * (1.0 + 0.03 * np.sin(2.0 * np.pi * time / 11.0))
    accel = thrust[:, None] * np.column_stack((tilt, np.ones(len(time))))
    accel += vibration * rng.standard_normal(accel.shape)
    gyro = np.column_stack((np.gradient(tilt, 1.0 / RATE_HZ, axis=0), np.zeros(len(time))))
    return accel, gyro + np.radians(2.0) + np.radians(0.5) * rng.standard_normal(gyro.shape)


@pytest.mark.parametrize('with_gyro', [True, False])
def test_no_rest_is_found_in_a_flight(rng, with_gyro):
    accel, gyro = hover(rng, 120.0, vibration=1.0)
    with pytest.raises(
        FitError, match=r'log: no still interval: the samples scatter by at least 9\d mg'
    ):
        reduce_bag(source(accel, gyro if with_gyro else None), OPTIONS)


def test_a_flight_with_little_vibration_is_recognised_by_its_gyroscope(rng):
    # A noisy accelerometer at rest may scatter by 15 mg, but the sway reaches rates of 4 deg/s.
    accel, gyro = hover(rng, 120.0, vibration=15.0 * MG)
    with pytest.raises(FitError, match='the angular rate mostly varies more than at rest'):
        reduce_bag(source(accel, gyro), OPTIONS)


def test_only_the_time_on_the_ground_of_a_flight_is_a_rest(rng):
    parts = [ground(rng, 12.0), hover(rng, 240.0, 15.0 * MG), ground(rng, 12.0)]
    accel, gyro = (np.concatenate(each) for each in zip(*parts, strict=True))
    bag = reduce_bag(source(accel, gyro), OPTIONS)
    ends = [((i.start_ns - START_NS) * 1e-9, (i.end_ns - START_NS) * 1e-9) for i in bag.intervals]
    assert len(ends) == 2
    assert ends[0][1] < 12.0
    assert ends[1][0] > 252.0


def test_the_noise_stated_by_the_user_decides_what_is_a_rest(rng):
    accel, _ = hover(rng, 120.0, vibration=15.0 * MG)
    quiet, _ = ground(rng, 30.0)
    options = FitOptions(gravity=GRAVITY, input='m/s^2', still_sd=10.0 * MG)
    with pytest.raises(FitError, match=r'the limit at rest is 10 mg \(--still-sd\)'):
        reduce_bag(source(accel), options)
    assert len(reduce_bag(source(quiet), options).intervals) == 1


def test_a_rest_is_found_although_the_gyroscope_drifts_with_temperature(rng):
    accel, gyro = ground(rng, 1200.0)
    gyro[:, 0] += np.radians(10.0) * np.linspace(0.0, 1.0, len(gyro)) ** 2
    bag = reduce_bag(source(accel, gyro), OPTIONS)
    assert len(bag.intervals) == 1
    assert bag.n_still_cells == bag.n_cells


def by_hand(rng, n_rests, rest_s, shaky, misalignment=0.0):
    """Simulate hand-held rests with turns between; rests in `shaky` have four times the noise."""
    ups = positions(n_rests, 4)
    matrix = np.eye(3)
    matrix[1, 0] = matrix[2, 1] = misalignment
    parts = []
    for k in range(n_rests):
        n = len(time_of(rest_s))
        sd = 3.0 * MG * (4.0 if k in shaky else 1.0)
        parts.append(GRAVITY * ups[k] + sd * rng.standard_normal((n, 3)))
        way = np.linspace(0.0, 1.0, len(time_of(3.0)))[:, None]
        turn = ups[k] + way * (ups[(k + 1) % n_rests] - ups[k])
        turn /= np.linalg.norm(turn, axis=1, keepdims=True) + 1e-9
        parts.append(GRAVITY * turn + 60.0 * MG * rng.standard_normal(turn.shape))
    force = np.concatenate(parts)
    return force @ np.linalg.inv(matrix).T * (1.01, 0.99, 1.02) + (0.3, -0.2, 0.1)


@pytest.mark.parametrize(('rest_s', 'shaky'), [(6.0, (2, 5, 9)), (3.5, (0, 3, 7))])
def test_each_short_rest_of_a_hand_held_unit_is_found(rng, rest_s, shaky):
    accel = by_hand(rng, 10, rest_s, shaky)
    result = fit([source(accel)], OPTIONS)
    assert len(result.positions) == 10
    axes = result.calibration.axes
    # With 350 samples and a noise of 3 to 12 mg the mean of a rest has an error of 0.2 to 0.6 mg.
    np.testing.assert_allclose([axes.x.bias, axes.y.bias, axes.z.bias], (0.3, -0.2, 0.1),
                               atol=1.5 * MG)  # fmt: skip
    assert result.residuals[-1].fitted.rms < 2.0 * MG


def test_motion_is_not_taken_for_a_rest(rng):
    # For the last 10 s |f| is 1.04 g, with the noise of a shaky rest: the unit is accelerated.
    accel = by_hand(rng, 14, 6.0, (3,), misalignment=5e-3)
    time = time_of(10.0)
    push = GRAVITY * np.array((0.0, 0.6, 0.8)) * 1.04 + 0.0 * time[:, None]
    accel = np.concatenate((accel, push + 12.0 * MG * rng.standard_normal(push.shape)))
    result = fit([source(accel)], OPTIONS)
    assert 13 <= len(result.positions) <= 14
    assert result.residuals[-1].fitted.rms < 2.0 * MG


def test_the_user_can_set_the_length_of_the_shortest_rest(rng):
    accel = by_hand(rng, 10, 3.5, ())
    bag = reduce_bag(source(accel), FitOptions(gravity=GRAVITY, input='m/s^2', min_rest_s=2.0))
    assert len(bag.intervals) == 10
    with pytest.raises(FitError, match='must rest in each position'):
        reduce_bag(source(accel), FitOptions(gravity=GRAVITY, input='m/s^2', min_rest_s=60.0))


def test_a_drift_in_a_ramp_is_not_taken_for_a_motion(rng):
    # A drift of 60 ug per cell, 60 times the noise, is no motion; a sudden tilt by 0.1 mrad is.
    time = np.arange(7200.0)
    stamps = START_NS + np.rint(time * 1e9).astype(np.int64)
    ramp = np.clip(time - 1800.0, 0.0, 2400.0) * 2e-3 * MG
    ramp -= 300.0 * 2e-3 * MG * (1.0 - np.exp(-np.clip(time - 1800.0, 0.0, None) / 300.0))
    for knock, n_rests in ((0.0, 1), (0.1, 2)):
        accel = np.array((0.0, 0.0, GRAVITY)) + 5e-3 * MG * rng.standard_normal((7200, 3))
        accel[:, :2] += ramp[:, None] + knock * MG * (time[:, None] > 3000.0)
        nothing = np.zeros(0)
        block = ImuBlock(stamps, accel, nothing.astype(np.int64), nothing,
                         nothing.astype(np.int64), nothing)  # fmt: skip
        bag = reduce_bag(FitSource('slow', lambda block=block: [block]), OPTIONS)
        assert len(bag.intervals) == n_rests
