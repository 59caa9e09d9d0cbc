# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples in rests are averaged over windows; thermometer settings are estimated from readings."""

from dataclasses import replace

import numpy as np
import pytest
from builders import ArrayBlock
from position_helpers import GRAVITY, Rest

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions, FitSource, normal_gravity
from thermo_comp.fitting.raw_checks import judge_bags
from thermo_comp.fitting.reduction import Readings, is_spike, reduce_source, rounding_sd
from thermo_comp.fitting.sensors import averaged, learn_detector, learn_thermometer
from thermo_comp.recording.stillness import CellAccumulator
from thermo_comp.simulation.campaign import positions
from thermo_comp.thermal.settings import DetectorSettings, ThermometerSettings

START_NS = 1_700_000_000_123_456_789
RATE_HZ = 100
UP = (0.0, 0.0, 3000.0)  # counts at rest, z up


def stamps(n, rate_hz=RATE_HZ):
    return START_NS + np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64)


def block(accel, seconds=None):
    n = len(accel)
    readings = stamps(int(n / RATE_HZ if seconds is None else seconds) + 1, 1.0)
    celsius = np.full(len(readings), 20.0)
    return ArrayBlock(stamps(n), accel, readings, celsius, readings, celsius + 1.0)


def reduced(blocks, **options):
    kept = list(blocks)
    settings = {'window_s': 10.0, 'cell_s': 0.5, 'min_rest_s': 3.0, 'full_scale': 32767.0}
    return reduce_source(FitSource('bag', lambda: kept), **{**settings, **options})


def still(rng, seconds, level):
    return np.array(level) + 0.3 * rng.standard_normal((int(seconds * RATE_HZ), 3))


def test_the_reduction_does_not_depend_on_blocks_or_on_the_origin_of_time(rng):
    whole = block(np.rint(still(rng, 61.0, (10.0, -3000.0, 50.0))))
    at_once = reduced([whole])
    for n_parts in (2, 7, 50):
        *columns, _ = vars(whole).values()  # all fields but `imu`
        parts = zip(*(np.array_split(column, n_parts) for column in columns), strict=True)
        other = reduced([ArrayBlock(*part) for part in parts])
        for a, b in zip(at_once.intervals, other.intervals, strict=True):
            np.testing.assert_array_equal(a.count, b.count)
            # The size of the blocks determines the order of additions, and so the rounding.
            np.testing.assert_allclose(a.mean, b.mean, rtol=1e-13, atol=1e-11)
            np.testing.assert_allclose(a.time, b.time, rtol=1e-12)
        np.testing.assert_array_equal(at_once.board.value, other.board.value)
    samples = still(rng, 30.0, UP)
    results = []
    for origin in (0, 1_900_000_000_000_000_000):
        accumulator = CellAccumulator(0.5, None)
        accumulator.add(np.arange(3000, dtype=np.int64) * 10_000_000 + origin, samples)
        results.append(accumulator.cells())
    np.testing.assert_array_equal(results[0].mean, results[1].mean)
    np.testing.assert_array_equal(results[0].time, results[1].time)


@pytest.mark.parametrize('rest_s', [30, 45])
def test_short_rests_of_slow_samples_are_found(rng, rest_s):
    # WHY: at 1 Hz a mean over 30 s contained several attitudes, and so had |f| of 0.07 m/s^2.
    ups = np.repeat(positions(18, 1), rest_s, axis=0)
    samples = 9.8 * (ups + 5e-6 * rng.standard_normal(ups.shape))
    tumble = ArrayBlock(stamps(len(samples), 1.0), samples)
    bag = reduced([tumble], min_rest_s=None, full_scale=None)
    assert len(bag.intervals) >= 18
    for interval in bag.intervals:
        size = np.linalg.norm(interval.mean, axis=1)
        # A sample has 5 ug of noise; a window has ten samples, or fewer at the end of a rest.
        np.testing.assert_allclose(size, 9.8, rtol=2e-5)
    # Samples at 1 Hz in random attitudes contain no rest, and keep windows of 30 s.
    alone = replace(tumble, accel=samples[rng.integers(rest_s, size=len(samples))])
    assert reduced([alone], full_scale=None).window_s == 30.0


@pytest.mark.parametrize('cycle_s', [0.01, 0.02, 0.04, 0.05, 0.1, 0.3, 1.0])
def test_the_estimated_interval_between_samples_is_right_to_0_1_percent(rng, cycle_s):
    # WHY: means at 10 Hz have 33 or 34 samples, from which a sample rate of 9.9 Hz was computed.
    n = round(1800.0 / cycle_s)
    kept = rng.random(n) > 2.0 / n  # a few samples are lost
    samples = 9.8 + 0.01 * rng.standard_normal((n, 3))
    block = ArrayBlock(stamps(n, 1.0 / cycle_s)[kept], samples[kept])
    assert reduced([block], full_scale=None).cycle_s == pytest.approx(cycle_s, rel=1e-3)


def test_windows_are_means_of_their_samples_without_the_bad_samples(rng):
    samples = still(rng, 60.0, UP)
    (interval,) = reduced([block(samples)]).intervals
    assert (interval.count.sum(), len(interval.time)) == (len(samples), 6)
    np.testing.assert_allclose(interval.mean[2], samples[2000:3000].mean(axis=0), atol=1e-10)
    assert interval.time[2] == pytest.approx(24.995, abs=1e-9)
    np.testing.assert_allclose(interval.sample_sd, 0.3, rtol=0.1)
    accel = still(rng, 30.0, UP)
    accel[10, 1] = np.nan
    accel[20, 2] = 32767.0
    bag = reduced([block(accel)])
    assert (bag.n_samples, bag.n_dropped, bag.n_saturated) == (3000, 1, 1)
    assert sum(interval.count.sum() for interval in bag.intervals) == 2998


def test_positions_in_one_bag_are_separated_but_not_by_vibrations_of_a_compressor(rng):
    turn = np.linspace(UP, (3000.0, 0.0, 0.0), 3 * RATE_HZ)
    turn += 40.0 * rng.standard_normal(turn.shape)
    parts = still(rng, 40.0, UP), turn, still(rng, 30.0, (3000.0, 0.0, 0.0))
    first, second = reduced([block(np.vstack(parts))]).intervals
    np.testing.assert_allclose(first.mean[0], UP, atol=0.1)
    np.testing.assert_allclose(second.mean[-1], (3000.0, 0.0, 0.0), atol=0.1)
    assert (first.end_ns - first.start_ns) * 1e-9 == pytest.approx(40.0, abs=1.6)
    assert (second.end_ns - second.start_ns) * 1e-9 == pytest.approx(30.0, abs=1.6)
    # WHY: vibration counted as motion: 18 bags had 1135 positions. A turn by 300 urad ends a rest.
    accel = still(rng, 720.0, UP)
    for start in range(3000, 72000, 6000):
        accel[start : start + 3000] += 0.9 * rng.standard_normal((3000, 3))
    (only,) = reduced([block(accel)]).intervals
    assert (only.end_ns - only.start_ns) * 1e-9 > 680.0
    accel[34500:] += (1.0, 0.0, 0.0)
    first, second = reduced([block(accel)]).intervals
    assert first.time[-1] < 345.0 < second.time[0]


def test_readings_of_a_lost_thermometer_and_glitches_are_counted_and_left_out(rng):
    # WHY: -127 degC in every 60th reading increased the error of a fit by a factor of 25.
    whole = block(still(rng, 2000.0, UP))
    whole.board[:] = 20.0 + 0.02 * rng.standard_normal(len(whole.board))
    whole.board[30::60] = -127.0
    # WHY: each wrong sample ended a rest: with 1 % wrong samples a fit took minutes, not 2 s.
    whole.accel[50::100, 1] += 1500.0
    whole.accel[100_000:100_010] += 1500.0 * np.array([[-1.0], [1.0]] * 5)
    bag = reduced([whole])
    assert bag.n_spikes == {'board': 33, 'case': 0}
    assert bag.board.value.min() > 19.0
    noise = learn_thermometer([bag.board], ThermometerSettings()).noise_sd_c
    assert noise == pytest.approx(0.02, rel=0.1)
    findings = {f.name: f.message for f in judge_bags([bag], FitOptions(gravity=9.8))}
    assert '33 readings' in findings['spikes']
    assert '2000 samples' in findings['glitches']
    assert (bag.n_glitches, len(bag.intervals)) == (len(whole.accel) // 100, 2)
    assert abs(bag.intervals[0].mean[:, 1].mean()) < 1.0
    turned = block(still(rng, 200.0, UP))
    turned.accel[9000:11_000] += 600.0 * rng.standard_normal((2000, 3))
    assert reduced([turned]).n_glitches == 0
    at_ends = np.array([85.0, 20.0, 20.1, 20.2, 20.3, 20.4, -127.0])
    assert np.flatnonzero(is_spike(at_ends)).tolist() == [0, 6]
    assert not is_spike(np.array([np.inf, np.inf, np.inf, np.inf, 20.0, 20.0, np.inf])).all()
    # A temperature that changes by up to 18 K from reading to reading has no spikes.
    assert not is_spike(np.array([-18.0, 0.0, 12.0, 18.0, 20.0, 21.0, 21.0])).any()


def test_samples_in_bursts_are_a_rest_and_several_with_one_stamp_are_reported(rng):
    # WHY: cells between bursts were empty, so a unit at rest was reported as worn or driven.
    whole = block(still(rng, 600.0, UP))
    number = np.arange(len(whole.accel))
    for size in (20, 100, 200):
        # The mean rate is 100 Hz; within a burst the stamps are 0.3 ms apart.
        stamps = (number // size * size + size) * 10_000_000 + number % size * 300_000
        bag = reduced([replace(whole, accel_stamp_ns=whole.accel_stamp_ns[0] + stamps)])
        assert (len(bag.intervals), bag.cycle_s) == (1, pytest.approx(0.01, rel=0.1))
        assert bag.n_dropped == 0
    whole = block(still(rng, 600.0, UP))
    stamps = whole.accel_stamp_ns[np.arange(len(whole.accel)) // 10 * 10]
    bag = reduced([replace(whole, accel_stamp_ns=stamps)])
    assert bag.n_repeated == bag.n_dropped == 0.9 * len(whole.accel)
    (finding,) = (f for f in judge_bags([bag], FitOptions(gravity=9.8)) if f.name == 'dropped')
    assert 'several samples with one stamp' in finding.message


@pytest.mark.parametrize('n', [0, 1, 70])
def test_a_few_stamps_that_do_not_rise_are_reported(n, rng):
    # WHY: `info` reported any stamps that do not rise, but `fit` only 1 % of them or more.
    whole = block(still(rng, 300.0, UP))
    cycle_ns = int(np.median(np.diff(whole.accel_stamp_ns)))
    # The clock is set back by n cycles, so the stamps of n samples occur twice.
    whole.accel_stamp_ns[20_000:] -= n * cycle_ns
    bag = reduced([whole])
    assert bag.n_dropped == n
    findings = [f for f in judge_bags([bag], FitOptions(gravity=9.8)) if f.name == 'dropped']
    assert len(findings) == (n > 0)
    for finding in findings:
        assert f'have a stamp that does not rise, are left out ({n}, ' in finding.message


@pytest.mark.parametrize(
    ('rate_hz', 'cell_s', 'window_s'),
    # A window is 20 means over 0.5 s at 100 Hz (10 s), and one mean at 4 and at 1 Hz.
    [(100.0, 0.5, 10.0), (20.0, 10.0 / 6.0, 10.0), (4.0, 10.0, 10.0), (1.0, 30.0, 30.0)],
)
def test_windows_of_a_fit_have_the_stated_length(rate_hz, cell_s, window_s, rng):
    n = round(150 * rate_hz)
    accel = np.array(UP) + 0.3 * rng.standard_normal((n, 3))
    bag = reduced([ArrayBlock(stamps(n, rate_hz), accel)])
    (interval,) = bag.intervals
    assert (bag.window_s, bag.n_cells) == (window_s, pytest.approx(150 / cell_s))
    assert interval.n_whole == len(interval.time) == 150 / window_s
    np.testing.assert_allclose(interval.count, window_s * rate_hz, atol=1.0)
    np.testing.assert_allclose(np.diff(interval.time), window_s, atol=1.0 / rate_hz)


@pytest.mark.parametrize(('seconds', 'left'), [(24.0, 0), (26.0, 600)])
def test_a_last_window_is_kept_if_it_is_at_least_half_full(seconds, left, rng):
    (interval,) = reduced([block(still(rng, seconds, UP))]).intervals
    assert interval.n_whole == 2
    assert interval.count.tolist() == [1000.0, 1000.0, *([float(left)] if left else [])]


def test_fast_readings_are_averaged_but_each_change_of_a_wide_quantum_is_kept(rng):
    n = 60 * RATE_HZ
    at, celsius = stamps(n), 20.0 + 0.1 * rng.standard_normal(n)
    board = reduced([ArrayBlock(at, still(rng, 60.0, UP), at, celsius, at, celsius)]).board
    assert len(board.value) <= n / 19
    assert board.value.mean() == pytest.approx(celsius.mean(), abs=1e-3)
    bag, noise = dense(rng, 0.05), ThermometerSettings(noise_sd_c=0.05)
    bag.board.value[3000] = 85.0
    detector = DetectorSettings(board=noise, case=noise)
    means, settings = averaged(bag, detector, ('board', 'case'), 2.0)
    for readings, sensor in ((means.board, settings.board), (means.case, settings.case)):
        assert sensor.noise_sd_c == pytest.approx(0.05 / np.sqrt(20.0), rel=0.01)
        is_mean = np.diff(readings.stamp_ns, prepend=0) > 1_500_000_000
        error = readings.value - 20.0 - 1e-11 * (readings.stamp_ns - START_NS)
        # An sd estimated from some 300 means is uncertain by 1 / sqrt(2 * 300) = 4 %.
        assert np.std(error[is_mean]) == pytest.approx(sensor.noise_sd_c, rel=0.16)
    assert 85.0 in means.board.value
    assert averaged(bag, detector, ('board', 'case'), 0.1) == (bag, detector)
    bag = dense(rng, 0.05)
    bag.board.value[:] = 20.1
    means, _ = averaged(bag, DetectorSettings(), ('board', 'case'), 1.7)
    assert set(means.board.value) == {20.1}
    bag = dense(rng, 0.0, quantum=0.5)
    wide = ThermometerSettings(quantum_c=0.5)
    detector = DetectorSettings(board=wide, case=wide)
    kept, settings = averaged(bag, detector, ('board', 'case'), 2.0)
    assert settings == detector
    changed = np.flatnonzero(np.diff(bag.board.value)) + 1
    assert np.isin(bag.board.stamp_ns[changed], kept.board.stamp_ns).all()
    assert len(kept.board.value) <= 301 + len(changed)


def test_normal_gravity_agrees_with_published_values_and_impossible_places_are_refused():
    # Published normal gravity of WGS 84 at the equator, the pole and 45 degrees.
    for latitude, expected in ((0.0, 9.7803253359), (90.0, 9.8321849379), (45.0, 9.8061977694)):
        assert normal_gravity(latitude, 0.0) == pytest.approx(expected, abs=1e-8)
        assert normal_gravity(-latitude, 0.0) == normal_gravity(latitude, 0.0)
    # The free-air gradient is 0.3086 mGal/m at the surface, 0.02 % less at a height of 1 km.
    fall = normal_gravity(50.0, 0.0) - normal_gravity(50.0, 1000.0)
    assert fall == pytest.approx(3.086e-3, rel=1e-3)
    for latitude, height in ((91.0, 0.0), (np.nan, 0.0), (0.0, 2e4)):
        with pytest.raises(ValueError, match=r'`(latitude_deg|height_m)` must be within'):
            normal_gravity(latitude, height)
    for gravity in (98.1, -1.0, np.nan):
        with pytest.raises(FitError, match='not found on Earth'):
            FitOptions(gravity=gravity)


def soak_ramp_soak(quantum, noise, rng):
    # The thermometer lags the air by 300 s; 3 h at 1 Hz: a soak, a ramp of 1 K/min, a soak.
    time = np.arange(0.0, 10800.0)
    air = np.interp(time, [0.0, 3600.0, 5400.0], [5.0, 5.0, 35.0])
    celsius = np.empty_like(air)
    celsius[0] = air[0]
    for i in range(1, len(air)):
        celsius[i] = celsius[i - 1] + (air[i] - celsius[i - 1]) / 300.0
    celsius += noise * rng.standard_normal(len(time))
    if quantum:
        celsius = np.round(celsius / quantum) * quantum
    return Readings(stamps(len(time), 1.0), celsius)


@pytest.mark.parametrize(('quantum', 'noise'), [(0.0, 0.005), (0.0, 0.05), (0.0625, 0.005)])
def test_thermometer_settings_are_estimated_from_readings(quantum, noise, rng):
    learned = learn_thermometer([soak_ramp_soak(quantum, noise, rng)], ThermometerSettings())
    assert learned.quantum_c == pytest.approx(quantum, rel=1e-6)
    # Rounded readings show their noise only near rounding edges, at the slow end of the ramp.
    assert learned.noise_sd_c == pytest.approx(noise, rel=0.4 if quantum else 0.1)
    # Means over 60 s determine the lag of the thermometer, 300 s, to 100 s.
    assert learned.lag_s == pytest.approx(300.0, rel=0.35)
    assert learned.fastest_ramp_k_min >= 1.0


@pytest.mark.parametrize(('noise', 'found'), [(0.02, 0.02), (0.05, 0.05), (0.09, 0.09), (0, 0.01)])
def test_readings_that_alternate_at_edges_of_1_k_steps_show_their_noise(noise, found, rng):
    learned = learn_thermometer([soak_ramp_soak(1.0, noise, rng)], ThermometerSettings())
    # Only the two slowest crossings of an edge show the noise; the least noise is 0.01 quanta.
    assert learned.noise_sd_c == pytest.approx(found, rel=0.3 if noise else 1e-6)


def test_thermometer_settings_have_defaults_and_the_detector_s_follow_the_slowest_ramp(rng):
    # WHY: with readings every 60 s and a lag of 50 s, the estimated rate of any ramp was 0.
    time = np.arange(0.0, 14400.0, 60.0)
    celsius = np.interp(time, [0.0, 3600.0, 5400.0], [5.0, 5.0, 35.0])
    celsius += 0.01 * rng.standard_normal(len(time))
    readings = Readings(stamps(len(time), 1.0 / 60.0), celsius)
    assert learn_thermometer([readings], ThermometerSettings()).lag_s == pytest.approx(180.0)
    empty = Readings(np.zeros(0, dtype=np.int64), np.zeros(0))
    base = DetectorSettings()
    assert learn_thermometer([empty], base.board) == base.board
    n = 9 * 3600
    celsius = np.interp(np.arange(0.0, n), [0.0, 7200.0, 25200.0], [10.0, 10.0, 55.0])
    readings = Readings(stamps(n, 1.0), celsius + 0.005 * rng.standard_normal(n))
    bag = reduced([block(still(rng, 30.0, UP))])
    slow = learn_detector([replace(bag, temperatures={'board': readings, 'case': readings})])
    # The setting `smallest_ramp_k_min` is 0.7 times the rate of the slowest ramp, 0.15 K/min.
    assert slow.smallest_ramp_k_min == pytest.approx(0.105, rel=0.05)
    assert slow.relaxed_rate_k_min < slow.smallest_ramp_k_min / 1.5


@pytest.mark.parametrize('step', [1.0, 16.0, 1.0 / 300.0])
def test_a_rest_is_found_at_any_quantum_of_the_samples(step, rng):
    slow = 0.6 * np.sin(np.arange(60 * RATE_HZ) / 900.0)
    accel = 2900.0 + slow[:, None] + 0.05 * rng.standard_normal((len(slow), 3))
    bag = reduced([block(np.round(accel) * step)], full_scale=None)
    assert (len(bag.intervals), bag.n_still_cells) == (1, bag.n_cells)


def test_the_rounding_sd_is_that_of_simulated_rounding_and_smaller_with_a_drift(rng):
    level = rng.uniform(-0.5, 0.5, 1000)
    (expected, _, _) = rounding_sd(np.zeros(3), np.zeros(3), np.ones(3))
    # The RMS of 1000 errors has an sd of 2 %.
    assert np.sqrt(np.mean((np.rint(level) - level) ** 2)) == pytest.approx(expected, rel=0.08)
    level = rng.uniform(-0.5, 0.5, 400)
    drift = np.linspace(0.0, 5.3, 1000)
    error = np.mean(np.rint(level[:, None] + drift) - level[:, None] - drift, axis=1)
    (expected, _, _) = rounding_sd(np.zeros(3), np.full(3, 5.3), np.ones(3))
    assert np.sqrt(np.mean(error**2)) < expected


@pytest.mark.parametrize('step', [1.0, 0.04])
def test_steps_of_a_converter_after_a_constant_soak_do_not_divide_a_rest_but_a_turn_does(
    rng, step
):
    # WHY: after 20000 constant samples each change by a converter step began a new rest.
    rest = Rest(rng, duration_s=3600.0, sd=0.0)
    ramp = np.maximum(rest.time - 1800.0, 0.0) / 1800.0
    rest.accel = np.rint(rest.accel / 0.04 + 6.0 * np.outer(ramp, (1.0, -1.3, 0.7))) * step
    assert len(reduce_source(rest.source(), full_scale=None).intervals) == 1
    # WHY: a turn between two rests of constant samples counted as a step of the converter.
    rest = Rest(rng, sd=0.0)
    rest.accel[rest.time > 300.0] = (GRAVITY, 0.0, 0.0)
    assert len(reduce_source(rest.source(), full_scale=None).intervals) == 2


def dense(rng, noise_sd, quantum=0.0):
    """Return a bag with readings at 10 Hz of a temperature that rises by 0.01 K/s."""
    stamp = stamps(6000, 10.0)
    celsius = 20.0 + 1e-11 * (stamp - START_NS) + noise_sd * rng.standard_normal(len(stamp))
    celsius = np.rint(celsius / quantum) * quantum if quantum else celsius
    bag = reduced([block(still(rng, 30.0, UP))])
    return replace(bag, temperatures=dict.fromkeys(('board', 'case'), Readings(stamp, celsius)))
