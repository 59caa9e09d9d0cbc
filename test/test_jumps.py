# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of the bias at rest are found; turns, motions and shocks are not taken for jumps."""

from dataclasses import replace

import numpy as np
import pytest
from position_helpers import GRAVITY, MG, Rest
from scipy.signal import lfilter

from thermo_comp.fitting.jumps import find_jumps
from thermo_comp.fitting.reduction import reduce_source


def look(rest, **keys):
    source = rest.source(**keys)
    bag = reduce_source(source, window_s=10.0, cell_s=2.0, min_rest_s=5.0, full_scale=None)
    return find_jumps(bag)


def test_no_jump_is_found_in_an_undisturbed_rest(rng):
    assert look(Rest(rng)) == ()


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('sd', [0.05, 0.1, 0.2, 0.5])
def test_steps_of_a_coarse_converter_are_not_taken_for_jumps(rng, sd):
    # WHY: a rest in which most samples were equal ended in a division by zero.
    rest = Rest(rng, sd=4.0 * sd * MG)
    drift = 20.0 * MG * np.linspace(0.0, 1.0, len(rest.accel))
    rest.accel = np.rint((rest.accel + drift[:, np.newaxis]) / (4.0 * MG)) * 4.0 * MG
    assert look(rest) == ()


@pytest.mark.parametrize('with_gyro', [False, True])
def test_time_and_size_of_a_jump_along_gravity_are_found(rng, with_gyro):
    rest = Rest(rng)
    rest.add((2.0 * MG, 0.0, 20.0 * MG), from_s=301.0)
    (event,) = look(rest, with_gyro=with_gyro)
    # The jump is between two samples, and `find_jumps` returns the interval between these samples.
    assert event.time == pytest.approx(301.0, abs=1.5 / rest.rate_hz)
    assert event.duration_s == pytest.approx(1.0 / rest.rate_hz, rel=1e-6)
    # Trends through 250 samples (noise 3 mg) per side: sd 2 * 3 mg * sqrt(2 / 250); limit 4 sd.
    np.testing.assert_allclose(np.array(event.step) / MG, (2.0, 0.0, 20.0), atol=2.2)
    assert event.along / MG == pytest.approx(20.0, abs=2.2)
    # Trends through 20 readings (noise 20 mK) per side: sd 2 * 0.02 K * sqrt(2 / 20).
    assert event.temperature_change_sd == pytest.approx(0.0126, rel=0.4)
    assert abs(event.temperature_change) < 4.0 * event.temperature_change_sd


@pytest.mark.parametrize('rate_hz', [0.5, 2.0, 5.0])
def test_a_jump_is_found_at_low_sample_rates(rng, rate_hz):
    # WHY: at 2 Hz the gap of 120 samples between the rests before and after a jump was 60 s, above
    # the limit of 30 s, so the jump was not found.
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
        at = np.flatnonzero(rows)[0]
        rest.gyro[at] += (angle * rest.rate_hz, 0.0, 0.0)


@pytest.mark.parametrize('seen', [True, False])
def test_a_turn_is_recognised_by_the_gyroscope(rng, seen):
    # A turn by 20 mrad within one sample does not change |f|: only the gyroscope observes it.
    rest = Rest(rng)
    turned(rest, 250.0, 0.02, with_rate=seen)
    events = look(rest, with_gyro=True)
    assert [round(event.time) for event in events] == ([] if seen else [250])


def test_without_a_gyroscope_a_turn_is_not_taken_for_a_jump(rng):
    rest = Rest(rng)
    turned(rest, 250.0, 0.02, with_rate=False)
    assert look(rest) == ()


@pytest.mark.parametrize(
    ('end', 'sd', 'step'), [(312.0, 200.0 * MG, (50.0, 0, 0)), (360.0, GRAVITY, (0, 0, 20.0))]
)
def test_a_change_during_a_motion_is_not_taken_for_a_jump(rng, end, sd, step):
    rest = Rest(rng)
    rows = (rest.time > 300.0) & (rest.time < end)
    rest.accel[rows] += sd * rng.standard_normal((rows.sum(), 3))
    rest.add(np.array(step) * MG, from_s=0.5 * (300.0 + end))
    assert look(rest) == ()


def test_a_disturbance_of_two_seconds_is_not_taken_for_a_jump(rng):
    rest = Rest(rng)
    rest.add((0.0, 0.0, 40.0 * MG), from_s=300.0, to_s=302.0)
    assert look(rest) == ()


def test_jumps_do_not_depend_on_the_lengths_of_blocks(rng):
    rest = Rest(rng)
    rest.add((0.0, 5.0 * MG, 20.0 * MG), from_s=300.0)
    whole = look(rest)
    assert whole == look(rest, n_blocks=37)
    assert len(whole) == 1


def test_drift_with_temperature_is_not_taken_for_a_jump(rng):
    # The bias changes by 2 mg/K, at up to 6 K/min.
    rest = Rest(rng)
    rest.accel[:, 2] += 2.0 * MG * (rest.temperature(rest.time) - 20.0)
    assert look(rest) == ()


def behind_a_low_pass(rng, rest, tau_s, sd):
    """Replace the noise by first-order noise with time constant `tau_s` and sd `sd`."""
    r = np.exp(-1.0 / (rest.rate_hz * tau_s))
    white = sd * np.sqrt(1.0 - r * r) * rng.standard_normal(rest.accel.shape)
    rest.accel[:] = np.array(rest.level) + lfilter([1.0], [1.0, -r], white, axis=0)


@pytest.mark.parametrize('tau_s', [0.1, 0.5, 1.0, 3.0])
def test_low_pass_filtered_noise_gives_one_rest_without_a_jump(rng, tau_s):
    # WHY: low-pass filtered samples were taken for independent: one rest became 8 to 37 rests.
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, 3.0 * MG)
    bag = reduce_source(rest.source(), full_scale=None)
    assert len(bag.intervals) == 1
    assert find_jumps(bag) == ()
    # At most 2 % of the cells, those at the ends of the rest, may count as motion.
    assert bag.n_still_cells > 0.98 * bag.n_cells


@pytest.mark.parametrize(('tau_s', 'sd'), [(0.1, 1.0), (0.5, 3.0), (1.0, 3.0), (3.0, 3.0)])
def test_a_jump_in_low_pass_filtered_noise_is_found(rng, tau_s, sd):
    # WHY: means over 10 s hardly reduce the correlated noise of 3 mg: jumps of 20 mg were missed.
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, sd * MG)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=301.0)
    bag = reduce_source(rest.source(), full_scale=None)
    assert len(bag.intervals) == 2
    (event,) = find_jumps(bag)
    assert event.time == pytest.approx(301.0, abs=1.5 / rest.rate_hz)
    # `new` is the sd of the part of a sample that does not depend on earlier samples.
    new = sd * np.sqrt(1.0 - np.exp(-2.0 / (rest.rate_hz * tau_s)))
    assert event.along / MG == pytest.approx(20.0, abs=4.0 * new)


@pytest.mark.parametrize('tau_s', [0.5, 3.0])
def test_a_shock_that_decays_behind_a_low_pass_is_not_taken_for_a_jump(rng, tau_s):
    rest = Rest(rng)
    behind_a_low_pass(rng, rest, tau_s, 3.0 * MG)
    since = rest.time - 301.0
    rest.accel[:, 2] += np.where(since >= 0.0, 40.0 * MG * np.exp(-since.clip(0.0) / tau_s), 0.0)
    assert find_jumps(reduce_source(rest.source(), full_scale=None)) == ()


def test_a_bag_with_one_rest_is_not_read_a_second_time(rng):
    n_passes = 0
    source = Rest(rng).source()

    def blocks():
        nonlocal n_passes
        n_passes += 1
        return source.blocks()

    bag = reduce_source(replace(source, blocks=blocks), full_scale=None)
    assert len(bag.intervals) == 1
    assert find_jumps(bag) == ()
    assert n_passes == 1
