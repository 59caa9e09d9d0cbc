# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates of temperature and rate agree with the truth, also if some readings are outliers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thermal_signals import LAG_S, SECOND_NS, lagged, read

from thermo_comp.thermal.settings import ThermometerSettings
from thermo_comp.thermal.thermometer import Thermometer, correct, mix, predict

SOAK_S, RAMP_S = 1800.0, 2400.0
SENSORS = {
    '1 mK': (0.001, 0.0, 1.0), '10 mK': (0.01, 0.0, 1.0), '10 mK, 0.1 Hz': (0.01, 0.0, 10.0),
    '10 mK, 10 Hz': (0.01, 0.0, 0.1), '1 mK, 62.5 mK steps': (0.001, 0.0625, 1.0),
    '10 mK, 62.5 mK steps': (0.01, 0.0625, 1.0), '10 mK, 1 K steps': (0.01, 1.0, 1.0),
}  # fmt: skip


def run(thermometer, t, readings):
    """Return temperature, rate and their variances after each reading, shape (n, 4)."""
    names, rows = ('temperature', 'rate', 'var_temperature', 'var_rate'), []
    stamps = np.round(t * 1e9).astype(np.int64)
    for stamp_ns, reading in zip(stamps.tolist(), readings.tolist(), strict=True):
        thermometer.update(stamp_ns, reading)
        rows.append([getattr(thermometer, name) for name in names])
    return np.array(rows)


def state(thermometer):
    return (
        thermometer.temperature, thermometer.rate, thermometer.acceleration,
        thermometer.var_temperature, thermometer.var_rate,
        thermometer.at((thermometer.stamp_ns or 0) + SECOND_NS),
    )  # fmt: skip


def settled(noise=0.001, n=600, **changes):
    thermometer = Thermometer(ThermometerSettings(noise, **changes))
    run(thermometer, np.arange(n), read(np.full(n, 20.0), noise, 0.0, np.random.default_rng(5)))
    return thermometer


@pytest.fixture(scope='module')
def errors():
    """Return times, squared errors and claimed variances by sensor, in a soak, a ramp, a soak."""
    collected = {}
    for name, (noise, quantum, dt) in SENSORS.items():
        runs = []
        # A run at 10 Hz has as many readings as ten runs at 1 Hz, so one run is sufficient.
        for seed in range(1 if dt < 1.0 else 3):
            rng = np.random.default_rng([seed, 1])
            t = np.arange(-SOAK_S, RAMP_S + 3600.0, dt)
            if dt == 10.0:
                t = t + rng.uniform(-3.0, 3.0, len(t))
            corners = [(0.0, 0.5), (RAMP_S, 0.0)]
            truth = 20.0 + rng.uniform(-0.5, 0.5) * quantum + lagged(t, corners, LAG_S)
            rate = np.gradient(truth, t)
            thermometer = Thermometer(ThermometerSettings(noise, quantum, lag_s=LAG_S))
            out = run(thermometer, t, read(truth, noise, quantum, rng))
            squares = (out[:, 0] - truth) ** 2, (out[:, 1] - rate) ** 2
            runs.append(np.column_stack([t, *squares, out[:, 2:]]))
        collected[name] = np.concatenate(runs)
    return collected


PARTS = {
    'soak': (-0.5 * SOAK_S, 0.0), 'onset': (0.0, 300.0), 'ramp': (600.0, RAMP_S),
    'end': (RAMP_S, RAMP_S + 600.0), 'late': (RAMP_S + 600.0, RAMP_S + 3600.0),
}  # fmt: skip


@pytest.mark.parametrize('part', PARTS)
@pytest.mark.parametrize('sensor', SENSORS)
def test_squared_errors_are_on_average_below_5_claimed_variances(errors, sensor, part):
    # The claimed variance allows for the onset or the end of a ramp at any time.
    begin, end = PARTS[part]
    rows = errors[sensor]
    rows = rows[(rows[:, 0] >= begin) & (rows[:, 0] < end)]
    for error, variance, limit in ((rows[:, 1], rows[:, 3], 2.5), (rows[:, 2], rows[:, 4], 5.0)):
        assert np.mean(error / variance) < limit
    if 'steps' not in sensor and part in {'soak', 'ramp'}:
        assert np.mean(rows[:, 1] / rows[:, 3]) > 0.4
        assert np.mean(rows[:, 2] / rows[:, 4]) > 0.1


@pytest.mark.parametrize(
    ('sensor', 'temperature_k', 'rate_k_min'),
    [
        ('1 mK', 0.0004, 0.001), ('10 mK', 0.003, 0.006), ('10 mK, 10 Hz', 0.0015, 0.005),
        ('1 mK, 62.5 mK steps', 0.004, 0.01), ('10 mK, 62.5 mK steps', 0.006, 0.01),
        ('10 mK, 1 K steps', 0.1, 0.06),
    ],
)  # fmt: skip
def test_errors_in_a_ramp_are_bounded(errors, sensor, temperature_k, rate_k_min):
    # The limits are 1.5 times the errors of an earlier run of this test.
    rows = errors[sensor]
    rows = rows[(rows[:, 0] >= 600.0) & (rows[:, 0] < RAMP_S)]
    assert math.sqrt(np.mean(rows[:, 1])) < temperature_k
    assert 60.0 * math.sqrt(np.mean(rows[:, 2])) < rate_k_min


def test_a_change_of_1_k_steps_shows_the_temperature_and_without_noise_it_is_exact():
    # Readings with steps of 1 K change from 20 to 21 degC at a temperature of 20.5 degC.
    thermometer = Thermometer(ThermometerSettings(0.01, 1.0))
    for k in range(600):
        thermometer.update(k * SECOND_NS, 20.0)
    assert thermometer.var_temperature == pytest.approx(1.0 / 12.0, rel=0.2)
    thermometer.update(600 * SECOND_NS, 21.0)
    assert thermometer.temperature == pytest.approx(20.5, abs=0.03)
    # When the reading changes, the temperature is known to the noise plus the change in a second.
    assert 0.005 < math.sqrt(thermometer.var_temperature) < 0.03
    thermometer = Thermometer(ThermometerSettings())
    for k in range(100):
        assert thermometer.update(k * SECOND_NS, 20.25)
        assert (thermometer.temperature, thermometer.rate) == (20.25, 0.0)
        assert thermometer.acceleration[0] == 0.0
    assert type(thermometer.temperature) is float
    # After minutes of readings the prior of the rate (sd 3 K/min) has no effect.
    thermometer = Thermometer(ThermometerSettings())
    for k in range(600):
        thermometer.update(k * SECOND_NS, 20.0 + 0.01 * k)
    assert thermometer.temperature == pytest.approx(25.99, abs=1e-5)
    assert thermometer.rate == pytest.approx(0.01, abs=1e-6)
    assert abs(thermometer.acceleration[0]) < 1e-7


@pytest.mark.parametrize(('quantum', 'lag_s'), [(0.1, 120.0), (0.5, 180.0), (1.0, 600.0)])
def test_equal_readings_each_minute_keep_the_error_below_1_5_quanta(quantum, lag_s):
    # WHY: equal readings had no weight: the claimed sd rose to 24 K within an hour of soak.
    t = np.arange(-3600.0, 9000.0, 60.0)
    truth = 20.0 + lagged(t, [(0.0, 1.0), (1200.0, 0.0)], lag_s)
    thermometer = Thermometer(ThermometerSettings(0.01 * quantum, quantum, lag_s=lag_s))
    out = run(thermometer, t, np.round(truth / quantum) * quantum)
    error, sd = out[:, 0] - truth, np.sqrt(out[:, 2])
    assert np.abs(error).max() < 1.5 * quantum
    assert sd[1:].max() < quantum
    # In the ramp of 1 K/min the estimated rate is right, although readings come once a minute.
    rows = np.flatnonzero((t > 2.0 * lag_s) & (t < 1200.0))
    assert np.abs(out[rows, 1] - 1.0 / 60.0).max(initial=0.0) < max(quantum, 0.3) / 60.0


UPPER = np.triu_indices(3)


def drawn(rng):
    root = rng.normal(size=(3, 3))
    return rng.normal(size=3), root @ root.T


def test_prediction_correction_and_blend_equal_matrix_algebra():
    mean, covariance = drawn(np.random.default_rng(0))
    dt, lag, power = 1.7, 50.0, 0.3
    forward = np.array([[1.0, dt, dt**2 / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1 / (1.0 + dt / lag)]])
    wander = power * np.array([[dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0],
                               [dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0],
                               [dt**3 / 6.0, dt**2 / 2.0, dt]])  # fmt: skip
    out = predict((*mean, *covariance[UPPER]), dt, lag, power)
    np.testing.assert_allclose(out[:3], forward @ mean, rtol=1e-13)
    expected = forward @ covariance @ forward.T + wander
    np.testing.assert_allclose(out[3:], expected[UPPER], rtol=1e-12)
    mean, covariance = drawn(np.random.default_rng(1))
    out, innovation, spread = correct((*mean, *covariance[UPPER]), 5.0, 0.2)
    gain = covariance[:, 0] / (covariance[0, 0] + 0.2)
    np.testing.assert_allclose(out[:3], mean + gain * (5.0 - mean[0]), rtol=1e-13)
    np.testing.assert_allclose(out[3:], (covariance - np.outer(gain, covariance[0]))[UPPER])
    assert (innovation, spread) == (5.0 - mean[0], pytest.approx(covariance[0, 0] + 0.2))
    rng = np.random.default_rng(2)
    states, samples = [], []
    for n in (300_000, 100_000):
        mean, covariance = drawn(rng)
        states.append((*mean, *covariance[UPPER]))
        samples.append(rng.multivariate_normal(mean, covariance, n))
    out, back = mix(*states, 0.25), mix(*states[::-1], 0.75)
    np.testing.assert_allclose(back, out, rtol=1e-12)
    mixed = np.concatenate(samples)
    # 400 000 samples determine the covariances to 1 %.
    np.testing.assert_allclose(out[:3], mixed.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(out[3:], np.cov(mixed.T)[UPPER], atol=0.1)


@pytest.mark.parametrize(
    ('stamp_s', 'reading'),
    [(700, math.nan), (700, math.inf), (700, -math.inf), (599, 20.0), (300, 20.0), (-5, 20.0)],
)
def test_readings_that_are_not_finite_or_not_newer_do_not_change_the_state(stamp_s, reading):
    thermometer = settled()
    before = state(thermometer)
    assert not thermometer.update(stamp_s * SECOND_NS, reading)
    assert (state(thermometer), thermometer.n_in_row) == (before, 600)


def test_a_far_reading_has_little_weight_and_a_lasting_step_is_accepted_after_four():
    thermometer = settled()
    used = [thermometer.update((600 + k) * SECOND_NS, 60.0) for k in range(6)]
    assert used == [False, False, False, True, True, True]
    assert thermometer.temperature == pytest.approx(60.0, abs=0.01)
    assert (thermometer.n_in_row, thermometer.n_restarts) == (3, 1)
    # A reading 6 to 30 sd from its prediction counts as 6 sd away; a farther reading is not used.
    thermometer = settled()
    assert thermometer.update(600 * SECOND_NS, 20.015)
    assert abs(thermometer.temperature - 20.0) < 0.004
    thermometer = settled()
    for k in range(8):
        assert not thermometer.update((600 + k) * SECOND_NS, 60.0 if k % 2 else -20.0)
    assert thermometer.n_restarts == 0
    assert thermometer.temperature == pytest.approx(20.0, abs=0.002)


def test_a_gap_increases_the_variance_or_restarts_and_changed_ns_is_the_stamp_of_a_change():
    thermometer = settled()
    narrow = thermometer.var_temperature
    thermometer.update(900 * SECOND_NS, 20.0)
    assert thermometer.var_temperature > 2.0 * narrow
    assert thermometer.n_restarts == 0
    thermometer.update((900 + 601) * SECOND_NS, 25.0)
    assert thermometer.n_restarts == 1
    assert not thermometer.is_ready
    assert (thermometer.temperature, thermometer.rate) == (25.0, 0.0)
    thermometer = settled()
    for k in range(600, 700):
        thermometer.update(k * SECOND_NS, 20.0)
    assert (thermometer.changed_ns, thermometer.stamp_ns) == (600 * SECOND_NS, 699 * SECOND_NS)


def test_the_noise_is_estimated_if_the_setting_is_too_small():
    thermometer = Thermometer(ThermometerSettings(0.005))
    rng = np.random.default_rng(3)
    out = run(thermometer, np.arange(4000.0), read(np.full(4000, 20.0), 0.125, 0.0, rng))
    assert math.sqrt(thermometer._noise_scale) == pytest.approx(25.0, rel=0.2)
    assert np.mean((out[1000:, 0] - 20.0) ** 2 / out[1000:, 2]) < 2.0


def test_the_extrapolation_is_linear_for_5_s_and_then_constant():
    thermometer = Thermometer(ThermometerSettings(0.001))
    for k in range(600):
        thermometer.update(k * SECOND_NS, 20.0 + 0.01 * k)
    last_ns = 599 * SECOND_NS
    temperature, rate, variance = thermometer.at(last_ns)
    assert (temperature, rate) == (thermometer.temperature, thermometer.rate)
    assert variance == thermometer.var_temperature
    assert thermometer.interval_s == pytest.approx(1.0)
    for ahead in (0.25, 2.0, 5.0):
        value, _, wider = thermometer.at(last_ns + round(ahead * 1e9))
        assert value == pytest.approx(temperature + 0.01 * ahead, abs=1e-5)
        assert wider > variance
    held, _, wide = thermometer.at(last_ns + 60 * SECOND_NS)
    assert held == pytest.approx(temperature + 0.05, abs=1e-5)
    # After 5 s the extrapolation is constant; its sd after 60 s is 0.01 K/s times 55 s.
    assert math.sqrt(wide) == pytest.approx(0.55, rel=0.05)
    assert thermometer.at(last_ns - SECOND_NS)[0] == pytest.approx(temperature - 0.01, abs=1e-5)


def test_one_reading_is_a_temperature_without_a_rate_also_after_a_reset():
    thermometer = Thermometer(ThermometerSettings(0.01))
    nothing = thermometer.at(0)
    assert np.isnan(nothing[:2]).all()
    assert (nothing[2], thermometer.stamp_ns, thermometer.is_ready) == (math.inf, None, False)
    assert thermometer.update(5, 21.0)
    assert thermometer.at(10**9) == (21.0, 0.0, 0.01**2)
    assert not thermometer.is_ready
    thermometer = settled()
    thermometer.reset()
    assert thermometer.stamp_ns is None
    assert thermometer.update(0, 30.0)  # this stamp is before the stamps of the old readings
    assert thermometer.temperature == 30.0


STEPS = st.integers(1, 400 * SECOND_NS)


@settings(max_examples=60, deadline=None)
@given(
    quantum=st.sampled_from([0.0, 0.0625, 1.0]),
    rows=st.lists(st.tuples(STEPS, st.floats(-80.0, 150.0)), min_size=1, max_size=60),
)
def test_estimates_after_any_readings_are_finite_with_a_valid_covariance(quantum, rows):
    thermometer = Thermometer(ThermometerSettings(0.01, quantum))
    stamp_ns = 0
    for step_ns, reading in rows:
        stamp_ns += step_ns
        value = round(reading / quantum) * quantum if quantum else reading
        thermometer.update(stamp_ns, value)
        assert np.isfinite([thermometer.temperature, thermometer.rate]).all()
        variances = thermometer.var_temperature, thermometer.var_rate, thermometer.acceleration[1]
        assert all(0.0 < variance < math.inf for variance in variances)
        assert thermometer.at(stamp_ns + 10**8)[2] > 0.0
