# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Rests and jumps of the bias are found; flights, turns and shocks are not taken for them."""

from dataclasses import replace

import numpy as np
import pytest
from builders import source_of
from position_helpers import GRAVITY, MG, START_NS, Rest, source
from scipy.signal import lfilter

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, fit, reduce_bag
from thermo_comp.fitting.jumps import find_jumps
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.simulation.campaign import positions

RATE_HZ = 100.0
OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2')


def time_of(seconds):
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def ground(rng, seconds):
    n = len(time_of(seconds))
    level = np.array((0.0, 0.0, GRAVITY)) + 3.0 * MG * rng.standard_normal((n, 3))
    return level, np.radians(2.0) + np.radians(0.05) * rng.standard_normal((n, 3))


def hover(rng, seconds, vibration):
    """Simulate a drone: thrust of about g, slow swaying by 3 degrees, vibration of propellers."""
    time = time_of(seconds)
    tilt = np.radians(3.0) * np.sin(2.0 * np.pi * time[:, None] / np.array((5.0, 7.0)))
    thrust = GRAVITY * (1.0 + 0.03 * np.sin(2.0 * np.pi * time / 11.0))
    accel = thrust[:, None] * np.column_stack((tilt, np.ones(len(time))))
    accel += vibration * rng.standard_normal(accel.shape)
    gyro = np.column_stack((np.gradient(tilt, 1.0 / RATE_HZ, axis=0), np.zeros(len(time))))
    return accel, gyro + np.radians(2.0) + np.radians(0.5) * rng.standard_normal(gyro.shape)


def test_only_the_time_on_the_ground_is_a_rest_of_a_flight(rng):
    accel, gyro = hover(rng, 120.0, vibration=1.0)
    for rate in (gyro, None):
        with pytest.raises(FitError, match=r'log: no still interval: .* scatter by at least 9\d'):
            reduce_bag(source(accel, rate), OPTIONS)
    # A noisy accelerometer at rest may scatter by 15 mg, but the drone turns at up to 4 deg/s.
    accel, gyro = hover(rng, 120.0, vibration=15.0 * MG)
    with pytest.raises(FitError, match='the angular rate mostly varies more than at rest'):
        reduce_bag(source(accel, gyro), OPTIONS)
    parts = [ground(rng, 12.0), hover(rng, 240.0, 15.0 * MG), ground(rng, 12.0)]
    accel, gyro = (np.concatenate(each) for each in zip(*parts, strict=True))
    bag = reduce_bag(source(accel, gyro), OPTIONS)
    ends = [((i.start_ns - START_NS) * 1e-9, (i.end_ns - START_NS) * 1e-9) for i in bag.intervals]
    assert len(ends) == 2
    assert ends[0][1] < 12.0
    assert ends[1][0] > 252.0


def test_the_user_can_set_noise_and_length_of_a_rest(rng):
    accel, _ = hover(rng, 120.0, vibration=15.0 * MG)
    quiet, _ = ground(rng, 30.0)
    options = FitOptions(gravity=GRAVITY, input='m/s^2', still_sd=10.0 * MG)
    with pytest.raises(FitError, match=r'the limit at rest is 10 mg \(--still-sd\)'):
        reduce_bag(source(accel), options)
    assert len(reduce_bag(source(quiet), options).intervals) == 1
    accel = by_hand(rng, 10, 3.5, ())
    bag = reduce_bag(source(accel), FitOptions(gravity=GRAVITY, input='m/s^2', min_rest_s=2.0))
    assert len(bag.intervals) == 10
    with pytest.raises(FitError, match='must rest in each position'):
        reduce_bag(source(accel), FitOptions(gravity=GRAVITY, input='m/s^2', min_rest_s=60.0))


def test_a_rest_is_found_although_the_gyroscope_drifts_with_temperature(rng):
    accel, gyro = ground(rng, 1200.0)
    gyro[:, 0] += np.radians(10.0) * np.linspace(0.0, 1.0, len(gyro)) ** 2
    bag = reduce_bag(source(accel, gyro), OPTIONS)
    assert (len(bag.intervals), bag.n_still_cells) == (1, bag.n_cells)


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
    return np.concatenate(parts) @ np.linalg.inv(matrix).T * (1.01, 0.99, 1.02) + (0.3, -0.2, 0.1)


@pytest.mark.parametrize(('rest_s', 'shaky'), [(6.0, (2, 5, 9)), (3.5, (0, 3, 7))])
def test_each_short_rest_of_a_hand_held_unit_is_found(rng, rest_s, shaky):
    result = fit([source(by_hand(rng, 10, rest_s, shaky))], OPTIONS)
    assert len(result.positions) == 10
    axes = result.calibration.axes
    # A rest of 350 samples with 3 to 12 mg of noise has a mean with an error of 0.2 to 0.6 mg.
    np.testing.assert_allclose([axes.x.bias, axes.y.bias, axes.z.bias], (0.3, -0.2, 0.1),
                               atol=1.5 * MG)  # fmt: skip
    assert result.residuals[-1].fitted.rms < 2.0 * MG


def test_motion_is_not_taken_for_a_rest_nor_a_drift_in_a_ramp_for_a_motion(rng):
    # In the last 10 s the unit is accelerated: |f| is 1.04 g, with the noise of a shaky rest.
    accel = by_hand(rng, 14, 6.0, (3,), misalignment=5e-3)
    push = GRAVITY * np.array((0.0, 0.6, 0.8)) * 1.04 + 0.0 * time_of(10.0)[:, None]
    accel = np.concatenate((accel, push + 12.0 * MG * rng.standard_normal(push.shape)))
    result = fit([source(accel)], OPTIONS)
    assert 13 <= len(result.positions) <= 14
    assert result.residuals[-1].fitted.rms < 2.0 * MG
    # A tilt by 0.1 mrad is a motion; a drift of 60 ug in 30 s is none (noise of a mean: 1 ug).
    time = np.arange(7200.0)
    stamps = START_NS + np.rint(time * 1e9).astype(np.int64)
    ramp = np.clip(time - 1800.0, 0.0, 2400.0) * 2e-3 * MG
    ramp -= 300.0 * 2e-3 * MG * (1.0 - np.exp(-np.clip(time - 1800.0, 0.0, None) / 300.0))
    for knock, n_rests in ((0.0, 1), (0.1, 2)):
        accel = np.array((0.0, 0.0, GRAVITY)) + 5e-3 * MG * rng.standard_normal((7200, 3))
        accel[:, :2] += ramp[:, None] + knock * MG * (time[:, None] > 3000.0)
        assert len(reduce_bag(source_of(stamps, accel), OPTIONS).intervals) == n_rests


def look(rest, **keys):
    source = rest.source(**keys)
    bag = reduce_source(source, window_s=10.0, cell_s=2.0, min_rest_s=5.0, full_scale=None)
    return find_jumps(bag)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('sd', [0.05, 0.1, 0.2, 0.5])
def test_steps_of_a_coarse_converter_are_not_taken_for_jumps(rng, sd):
    # WHY: a rest in which most samples were equal caused a division by zero.
    rest = Rest(rng, sd=4.0 * sd * MG)
    drift = 20.0 * MG * np.linspace(0.0, 1.0, len(rest.accel))
    rest.accel = np.rint((rest.accel + drift[:, np.newaxis]) / (4.0 * MG)) * 4.0 * MG
    assert look(rest) == ()


@pytest.mark.parametrize('with_gyro', [False, True])
def test_time_and_size_of_a_jump_along_gravity_are_found(rng, with_gyro):
    rest = Rest(rng)
    rest.add((2.0 * MG, 0.0, 20.0 * MG), from_s=301.0)
    (event,) = look(rest, with_gyro=with_gyro)
    # The jump is between two samples: `find_jumps` returns the interval between these samples.
    assert event.time == pytest.approx(301.0, abs=1.5 / rest.rate_hz)
    assert event.duration_s == pytest.approx(1.0 / rest.rate_hz, rel=1e-6)
    # Lines fitted to 250 samples (3 mg) have a step with sd 2 * 3 mg * sqrt(2 / 250); limit: 4 sd.
    np.testing.assert_allclose(np.array(event.step) / MG, (2.0, 0.0, 20.0), atol=2.2)
    assert event.along / MG == pytest.approx(20.0, abs=2.2)
    # Lines fitted to 20 readings (20 mK noise) have a step with sd 2 * 0.02 K * sqrt(2 / 20).
    assert event.temperature_change_sd == pytest.approx(0.0126, rel=0.4)
    assert abs(event.temperature_change) < 4.0 * event.temperature_change_sd


@pytest.mark.parametrize('rate_hz', [0.5, 2.0, 5.0])
def test_a_jump_is_found_at_low_sample_rates(rng, rate_hz):
    # WHY: at 2 Hz the rests beside a jump were 60 s apart; jumps were found only within 30 s.
    rest = Rest(rng, duration_s=8000.0 / rate_hz, rate_hz=rate_hz, pace_s=4000.0)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=4000.0 / rate_hz)
    source = rest.source()
    (event,) = find_jumps(reduce_source(source, window_s=60.0, min_rest_s=5.0, full_scale=None))
    assert event.time == pytest.approx(4000.0 / rate_hz, abs=1.5 / rate_hz)


def turned(rest, from_s, angle, with_rate):
    rows = rest.time >= from_s
    c, s = np.cos(angle), np.sin(angle)
    rest.accel[rows] = rest.accel[rows] @ np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]).T
    if with_rate:
        rest.gyro[np.flatnonzero(rows)[0]] += (angle * rest.rate_hz, 0.0, 0.0)


@pytest.mark.parametrize('seen', [True, False])
def test_a_turn_is_recognised_by_the_gyroscope(rng, seen):
    # Only the gyroscope observes a turn by 20 mrad within one sample: |f| does not change.
    rest = Rest(rng)
    turned(rest, 250.0, 0.02, with_rate=seen)
    assert [round(event.time) for event in look(rest, with_gyro=True)] == ([] if seen else [250])


def changed_in_motion(rest, end, sd, step):
    rows = (rest.time > 300.0) & (rest.time < end)
    rest.accel[rows] += sd * rest.rng.standard_normal((rows.sum(), 3))
    rest.add(np.array(step) * MG, from_s=0.5 * (300.0 + end))


@pytest.mark.parametrize(
    'change',
    [
        lambda _: None,
        lambda rest: rest.add((0.0, 0.0, 40.0 * MG), from_s=300.0, to_s=302.0),
        lambda rest: changed_in_motion(rest, 312.0, 200.0 * MG, (50.0, 0, 0)),
        lambda rest: changed_in_motion(rest, 360.0, GRAVITY, (0, 0, 20.0)),
        lambda rest: turned(rest, 250.0, 0.02, with_rate=False),
        lambda rest: rest.add(  # the bias changes by 2 mg/K, at up to 6 K/min
            np.outer(rest.temperature(rest.time) - 20.0, (0.0, 0.0, 2.0 * MG)), from_s=0.0
        ),
    ],
    ids=['none', 'for two seconds', 'in a motion', 'in a large motion', 'a turn', 'temperature'],
)
def test_no_change_but_a_lasting_one_at_rest_is_taken_for_a_jump(rng, change):
    rest = Rest(rng)
    change(rest)
    assert look(rest) == ()


def test_jumps_do_not_depend_on_blocks_and_one_rest_is_read_once(rng):
    rest = Rest(rng)
    rest.add((0.0, 5.0 * MG, 20.0 * MG), from_s=300.0)
    whole = look(rest)
    assert whole == look(rest, n_blocks=37)
    assert len(whole) == 1
    n_passes = 0
    source = Rest(rng).source()

    def blocks():
        nonlocal n_passes
        n_passes += 1
        return source.blocks()

    bag = reduce_source(replace(source, blocks=blocks), full_scale=None)
    assert (len(bag.intervals), find_jumps(bag), n_passes) == (1, (), 1)


def test_a_steep_curve_over_temperature_is_not_taken_for_a_jump(rng):
    # WHY: a fit refused bags in which readings changed by 15 mg over 0.2 K, within 4 s.
    for _ in range(4):
        rest = Rest(rng)
        rest.accel[:, 2] += 7.5 * MG * np.tanh((rest.temperature(rest.time) - 25.0) / 0.1)
        assert look(rest) == ()
    rest.add((0.0, 0.0, 15.0 * MG), from_s=301.0)
    assert [round(event.time) for event in look(rest)] == [301]


def behind_a_low_pass(rng, rest, tau_s, sd):
    """Replace the noise by first-order noise with time constant `tau_s` and sd `sd` [m/s^2]."""
    r = np.exp(-1.0 / (rest.rate_hz * tau_s))
    white = sd * np.sqrt(1.0 - r * r) * rng.standard_normal(rest.accel.shape)
    rest.accel[:] = np.array(rest.level) + lfilter([1.0], [1.0, -r], white, axis=0)


@pytest.mark.parametrize('tau_s', [0.1, 0.5, 1.0, 3.0])
def test_low_pass_filtered_noise_gives_one_rest_without_a_jump(rng, tau_s):
    # WHY: low-pass filtered samples were taken for independent, and a rest became 8 to 37 rests.
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, 3.0 * MG)
    bag = reduce_source(rest.source(), full_scale=None)
    assert (len(bag.intervals), find_jumps(bag)) == (1, ())
    # At most 2 % of the means, at the ends of the rest, may count as motion.
    assert bag.n_still_cells > 0.98 * bag.n_cells


@pytest.mark.parametrize(('tau_s', 'sd'), [(0.1, 1.0), (0.5, 3.0), (1.0, 3.0), (3.0, 3.0)])
def test_a_jump_in_low_pass_filtered_noise_is_found(rng, tau_s, sd):
    # WHY: means over 10 s hardly reduce 3 mg of correlated noise, and jumps of 20 mg were missed.
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, sd * MG)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=301.0)
    bag = reduce_source(rest.source(), full_scale=None)
    assert len(bag.intervals) == 2
    (event,) = find_jumps(bag)
    assert event.time == pytest.approx(301.0, abs=1.5 / rest.rate_hz)
    # `new` is the sd of the part of a sample that earlier samples do not determine.
    new = sd * np.sqrt(1.0 - np.exp(-2.0 / (rest.rate_hz * tau_s)))
    assert event.along / MG == pytest.approx(20.0, abs=4.0 * new)


@pytest.mark.parametrize('tau_s', [0.5, 3.0])
def test_a_shock_that_decays_behind_a_low_pass_is_not_taken_for_a_jump(rng, tau_s):
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, 3.0 * MG)
    since = rest.time - 301.0
    rest.accel[:, 2] += np.where(since >= 0.0, 40.0 * MG * np.exp(-since.clip(0.0) / tau_s), 0.0)
    assert find_jumps(reduce_source(rest.source(), full_scale=None)) == ()
