# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""In seeded runs the regime detector detects ramps early, with few false alarms."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from thermal_signals import (
    BOARD_LAG_S,
    LAG_S,
    SECOND_NS,
    detector_settings,
    lagged,
    read,
    regimes,
    ripple,
    switches,
)

from thermo_comp.online.status import CompensatorConfig
from thermo_comp.thermal.change_detector import ChangeDetector
from thermo_comp.thermal.regime import Regime, RegimeDetector
from thermo_comp.thermal.settings import DetectorSettings, ThermalConfig, ThermometerSettings
from thermo_comp.thermal.thermometer import Thermometer

UNKNOWN, STATIC, DYNAMIC = Regime.UNKNOWN, Regime.STATIC, Regime.DYNAMIC
SENSORS = {'1 mK': (0.001, 0.0), '10 mK': (0.01, 0.0),
           '1 mK, 62.5 mK steps': (0.001, 0.0625),
           '10 mK, 62.5 mK steps': (0.01, 0.0625)}  # fmt: skip


def case_and_board(t, corners, lag=LAG_S, start=20.0):
    return start + lagged(t, corners, lag), start + 0.3 + lagged(t, corners, lag, BOARD_LAG_S)


def onsets(noise, quantum, rate_k_min, lag, n, *, dt=1.0, end_s=1500.0, soak_s=1500.0):
    """Run n ramps; return the regime switches of each, and how many ramps began in STATIC."""
    settings = detector_settings(noise, quantum, lag)
    collected, n_static = [], 0
    for seed in range(n):
        rng = np.random.default_rng([seed, 2])
        t = np.arange(-soak_s, end_s, dt)
        start, sign = 20.0 + rng.uniform(-0.5, 0.5) * max(quantum, 0.1), rng.choice([-1, 1])
        case, board = case_and_board(t, [(0.0, sign * rate_k_min)], lag, start)
        readings = (read(celsius, noise, quantum, rng) for celsius in (case, board))
        changes = switches(settings, t, *readings)
        before = [each for each in changes if each[0] < 0.0]
        n_static += bool(before) and before[-1][1] == STATIC
        collected.append([each for each in changes if each[0] >= 0.0])
        assert collected[-1][-1][2] == sign
    return collected, n_static


@cache
def headline(sensor):
    """Run the ramps of docs/regime.md: 0.5 K/min at 1 Hz, thermal lag of 15 min, after a soak."""
    return onsets(*SENSORS[sensor], 0.5, LAG_S, 12, end_s=300.0, soak_s=1800.0)


@pytest.mark.parametrize(
    ('sensor', 'median_s', 'late_s'),
    [
        ('1 mK', 45.0, 90.0),
        pytest.param('10 mK', 150.0, 180.0, marks=pytest.mark.slow),
        # The second step of 62.5 mK is detected: on average at 94 mK, 146 +- 6 s after the onset.
        pytest.param('1 mK, 62.5 mK steps', 158.0, 180.0, marks=pytest.mark.slow),
        ('10 mK, 62.5 mK steps', 150.0, 180.0),
    ],
)
def test_the_onset_of_a_ramp_is_detected_early(sensor, median_s, late_s):
    switched, n_static = headline(sensor)
    assert n_static == len(switched)
    assert all(len(each) == 1 and each[0][1] == DYNAMIC for each in switched)
    delays = [each[0][0] for each in switched]
    assert np.median(delays) <= median_s
    assert np.percentile(delays, 95) <= late_s


@pytest.mark.parametrize(
    ('sensor', 'threshold'), [('1 mK', 9.65), pytest.param('10 mK', 8.87, marks=pytest.mark.slow)]
)
def test_the_onset_delay_is_below_twice_that_of_a_cusum_test(sensor, threshold):
    # A CUSUM test that knows the ramp has the least delay; `threshold`: a false alarm per 50 h.
    noise = SENSORS[sensor][0]
    rng = np.random.default_rng(4)
    k = np.arange(1.0, 121.0)
    signature = lagged(np.append(0.0, k), [(0.0, 0.5)], LAG_S)[1:]
    delays = []
    for _ in range(40):
        # A likelihood-ratio test that also knows the onset is faster than CUSUM by 1 s at most.
        x = signature + rng.normal(0.0, noise, len(k))
        ratio = np.cumsum(signature * x - 0.5 * signature**2) / noise**2
        delays.append(k[np.argmax(ratio > threshold)])
    assert np.median([each[0][0] for each in headline(sensor)[0]]) <= 2.0 * np.median(delays)


@pytest.mark.parametrize(
    ('noise', 'quantum', 'rate_k_min', 'lag', 'dt', 'end_s'),
    [
        (0.001, 0.0, 0.2, 1200.0, 1.0, 3600.0),
        (0.01, 0.0, 0.2, 1200.0, 1.0, 3600.0),
        (0.01, 0.0, 3.0, 180.0, 1.0, 1800.0),
        (0.01, 0.0, 0.2, 900.0, 10.0, 6000.0),
        (0.01, 0.0, 0.5, 900.0, 0.1, 900.0),
        (0.001, 0.0625, 0.2, 1200.0, 1.0, 3600.0),
        (0.01, 0.0625, 3.0, 300.0, 10.0, 3600.0),
        (0.01, 0.0625, 0.2, 180.0, 10.0, 2400.0),  # a ramp as slow as a drift of the baseline
        (0.01, 1.0, 0.2, 900.0, 10.0, 7200.0),
        (0.01, 1.0, 3.0, 180.0, 1.0, 2400.0),
    ],
)
def test_each_ramp_switches_the_regime_to_dynamic_once(noise, quantum, rate_k_min, lag, dt, end_s):
    delays, _ = onsets(noise, quantum, rate_k_min, lag, 2 if dt < 1.0 else 3, dt=dt, end_s=end_s)
    for each in delays:
        assert [regime for _, regime, _ in each] in ([DYNAMIC], [STATIC, DYNAMIC])
        # The slowest detection needs two steps of 1 K, at 0.2 K/min behind a lag of 15 min.
        assert each[-1][0] < 0.5 * end_s


@pytest.mark.parametrize(
    'sensor',
    [
        *('1 mK', '10 mK, 62.5 mK steps'),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ('10 mK', '1 mK, 62.5 mK steps')),
    ],
)
def test_three_soaks_of_5_h_have_at_most_two_false_alarms(sensor):
    # With the default of 0.02 false alarms per hour, more than two in 15 h have p = 0.4 %.
    noise, quantum = SENSORS[sensor]
    n_openings = 0
    for seed in range(3):
        rng = np.random.default_rng([seed, 3])
        t = np.arange(0.0, 5.0 * 3600.0)
        drift = 0.01 / 60.0 * 5400.0 * (1.0 - np.exp(-t / 5400.0))
        case = 20.0 + rng.uniform(0.0, 0.1) + drift
        swing = ripple(t, LAG_S, rng.uniform(180.0, 900.0), rng.uniform(0.0, 6.0))
        readings = (read(each, noise, quantum, rng) for each in (case + swing, case + 0.3))
        changes = switches(detector_settings(noise, quantum), t, *readings)
        assert changes[0][1] == STATIC
        assert changes[0][0] < 2400.0
        n_openings += sum(regime == DYNAMIC for _, regime, _ in changes)
    assert n_openings <= 2


def test_the_rate_of_false_alarms_is_below_that_of_the_setting():
    # The setting allows 1000 false alarms in 50 h of noise. Rice's formula for the threshold
    # counts crossings, several per alarm; the lower limit excludes a detector without alarms.
    settings = ThermometerSettings(0.01, lag_s=LAG_S)
    test = ChangeDetector(settings, 0.2 / 60.0, ripple=0.0, false_alarms=20.0 / 3600.0)
    rng = np.random.default_rng(6)
    n = 50 * 3600
    sensor = Thermometer(settings)
    sensor.update(0, 20.0)
    sensor.update(1, 20.0)
    sensor.measured_variance = 0.01**2
    sensor.var_rate = 0.0
    n_departures, quiet_from = 0, 0
    for k, noise in enumerate(rng.normal(0.0, 0.01, n).tolist()):
        sensor.measured = 20.0 + noise
        if test.update((k + 1) * SECOND_NS, sensor, 1.0) and k >= quiet_from:
            n_departures += 1
            quiet_from = k + 60
    assert 50 < n_departures < 1000


@pytest.mark.parametrize('dt', [0.1, 1.0, 10.0])
def test_the_threshold_follows_from_the_noise_of_the_filter(dt):
    # Expected are the filter gain by the Riccati equation, noise and correlation by the impulse
    # response, alarms by Rice's formula. `_tune` uses first-order formulas with errors up to 4 %.
    test = ChangeDetector(ThermometerSettings(0.01, lag_s=LAG_S), 0.2 / 60.0, 0.0, 0.02 / 3600.0)
    test._tune(dt)
    for threshold, power in zip(test._thresholds, test._powers, strict=True):
        forward = np.array([[1.0, dt], [0.0, 1.0]])
        wander = power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        covariance = np.diag([1e-4, 1e-6])
        for _ in range(3000):
            ahead = forward @ covariance @ forward.T + wander
            gain = ahead[:, 0] / (ahead[0, 0] + 1e-4)
            covariance = ahead - np.outer(gain, ahead[0])
        response = np.empty(4000)
        x = gain
        for k in range(4000):
            response[k] = x[1]
            x = forward @ x
            x = x - gain * x[0]
        noise = 1e-4 * np.sum(response**2)
        correlation = np.sum(response[1:] * response[:-1]) / np.sum(response**2)
        per_reading = math.acos(correlation) / (2.0 * math.pi)
        allowed = 0.02 / 3600.0 / 4.0 * dt  # false alarms per reading, filter and sign
        squared = 2.0 * math.log(per_reading / allowed)
        assert threshold * covariance[1, 1] == pytest.approx(squared * noise, rel=0.04)


def recorded(corners, begin, end, *, quantum=0.0, start=20.0):
    """Return times and readings of case and board at 1 Hz, with a noise of 1 mK."""
    rng = np.random.default_rng(8)
    t = np.arange(begin, end)
    truths = case_and_board(t, corners, start=start)
    return t, *(read(truth, 0.001, quantum, rng) for truth in truths)


def run_once(corners, *, quantum=0.0, begin=-1800.0, end=8000.0, **parts):
    """Return a run's regime switches; `parts`: functions of (t, readings) that change readings."""
    t, *both = recorded(corners, begin, end, quantum=quantum)
    readings = dict(zip(('case', 'board'), both, strict=True))
    for name, change in parts.items():
        readings[name] = change(t, readings[name])
    return switches(detector_settings(0.001, quantum), t, readings['case'], readings['board'])


RAMP = [(0.0, 0.5), (3600.0, 0.0)]


def test_the_dynamic_regime_ends_when_the_board_or_else_the_case_has_the_relaxed_rate():
    # The regime ends when the board's rate has been below 0.05 K/min for 60 s, the dwell time.
    changes = run_once(RAMP)
    assert [regime for _, regime, _ in changes] == [STATIC, DYNAMIC, STATIC]
    t = np.arange(3600.0, 12000.0)
    rate = 60.0 * np.gradient(lagged(t, RAMP, LAG_S, BOARD_LAG_S), t)
    relaxed_at = t[np.argmax(rate < 0.05)]
    assert relaxed_at + 60.0 - 60.0 < changes[2][0] < relaxed_at + 60.0 + 120.0
    changes = run_once(RAMP, board=lambda t, celsius: np.where(t < 3600.0, celsius, np.nan))
    assert [regime for _, regime, _ in changes][-2:] == [DYNAMIC, STATIC]
    readings = recorded(RAMP, -1800.0, 9000.0)
    ends = [
        switches(detector_settings(0.001, relaxed_rate_k_min=rate), *readings)[-1][0]
        for rate in (0.025, 0.05, 0.1)
    ]
    # With half the relaxed rate the dynamic regime ends later by LAG_S (longest lag) * ln 2.
    assert -np.diff(ends) == pytest.approx([LAG_S * math.log(2.0)] * 2, rel=0.25)


@pytest.mark.parametrize('sensor', ['1 mK', '1 mK, 62.5 mK steps', '10 mK, 62.5 mK steps'])
def test_the_dynamic_regime_ends_by_the_case_or_the_board(sensor):
    # The case lags the chamber by 3 min, the board lags the case by 15 min. After the ramp their
    # rates fall to the relaxed rate, 0.1 of the ramp's, within 7 and 38 min. Steps of 62.5 mK do
    # not show the last 5 min of the case's change.
    noise, quantum = SENSORS[sensor]
    lag, behind = 180.0, 900.0
    of_case = ThermometerSettings(noise, quantum, lag_s=lag)
    board_too = DetectorSettings(case=of_case, board=replace(of_case, lag_s=lag + behind))
    case_alone = replace(board_too, end_condition='case')
    earlier = behind * math.log(10.0 * behind / (behind - lag)) - lag * math.log(10.0)
    rng = np.random.default_rng(5)
    t = np.arange(-1500.0, 6600.0)
    truths = lagged(t, RAMP, lag), lagged(t, RAMP, lag, behind)
    case, board = (read(20.0 + truth, noise, quantum, rng) for truth in truths)
    late, early = (switches(settings, t, case, board) for settings in (board_too, case_alone))
    assert [regime for _, regime, _ in late] == [STATIC, DYNAMIC, STATIC]
    assert [regime for _, regime, _ in early] == [STATIC, DYNAMIC, STATIC]
    assert early[1] == late[1]
    assert late[2][0] - early[2][0] == pytest.approx(earlier, abs=300.0)
    # For the end condition 'case' the board matters only if there is no case thermometer.
    assert early == switches(board_too, t, case, None)
    t, board = t[:3000], board[:3000]
    assert switches(case_alone, t, None, board) == switches(board_too, t, None, board)


TRIANGLE = [(0.0, 0.5), (3600.0, -0.5), (7200.0, 0.5), (10800.0, 0.0)]


@pytest.mark.parametrize('lost', [None, 'case', 'board'])
@pytest.mark.parametrize('quantum', [0.0, 0.0625])
def test_the_regime_stays_dynamic_at_a_reversal_of_the_ramp(lost, quantum):
    # Readings with steps of 62.5 mK are constant for minutes at a reversal of the ramp.
    parts = {lost: lambda *_: None} if lost else {}
    changes = run_once(TRIANGLE, quantum=quantum, end=16000.0, **parts)
    assert [regime for _, regime, _ in changes] == [STATIC, DYNAMIC, STATIC]


def test_the_direction_changes_when_the_case_reverses_and_not_by_repeated_readings():
    states = regimes(detector_settings(0.001), *recorded(TRIANGLE, -1800.0, 7200.0))
    directions = {at: direction for at, _, direction in states}
    assert directions[-100.0] == 0
    assert directions[600.0] == directions[3600.0] == 1
    # The case reverses LAG_S * ln(2 - exp(-3600 s / LAG_S)) = 616 s after the chamber.
    turn = next(at for at in directions if at > 3600.0 and directions[at] == -1)
    assert turn == pytest.approx(3600.0 + 616.0, abs=60.0)
    assert directions[7199.0] == -1
    # WHY: readings taken every 30 s, but published every second, gave false reversals.
    rng = np.random.default_rng(1)
    t = np.arange(-2400.0, 6000.0)
    truths = case_and_board(t, [(0.0, 2.0), (3000.0, 0.0)], 300.0)
    held = [np.repeat(read(x, 0.001, 0.0625, rng)[::30], 30) for x in truths]
    states = regimes(detector_settings(0.001, 0.0625, 300.0), t, *held)
    assert {state[1:] for state in states} == {(UNKNOWN, 0), (STATIC, 0), (DYNAMIC, 1)}


def test_the_first_regime_is_unknown_and_then_dynamic_if_readings_begin_in_a_ramp():
    changes = run_once([(-9000.0, 0.5), (1800.0, 0.0)])
    assert [regime for _, regime, _ in changes] == [DYNAMIC, STATIC]
    assert changes[0][0] < -1740.0
    assert changes[0][2] == 1
    settings, constant = detector_settings(0.001), np.full(30, 20.0)
    assert RegimeDetector(settings).update(0, None, None) == UNKNOWN
    states = regimes(settings, np.arange(30.0), constant, constant)
    assert {state[1:] for state in states} == {(UNKNOWN, 0)}


@pytest.mark.parametrize('quantum', [0.0, 0.0625])
def test_switches_are_equal_in_heating_and_cooling_and_at_any_origin_of_time(quantum):
    settings = detector_settings(0.001, quantum)
    t, case, board = recorded(RAMP, -1800.0, 7500.0, quantum=quantum, start=0.0)
    up, down = switches(settings, t, case, board), switches(settings, t, -case, -board)
    assert [(at, regime, -direction) for at, regime, direction in up] == down
    t, *readings = recorded([(1500.0, 0.5)], 0.0, 3000.0)
    near, far = (switches(detector_settings(0.001), t + by, *readings) for by in (0.0, 1e6))
    assert [(at + 1e6, *rest) for at, *rest in near] == [(at, *rest) for at, *rest in far]


@pytest.mark.parametrize(
    ('settings', 'changes', 'text'),
    [
        (DetectorSettings, {'smallest_ramp_k_min': -0.2}, 'must be greater than 0'),
        (DetectorSettings, {'false_alarms_per_hour': 0.0}, 'must be greater than 0'),
        (DetectorSettings, {'relaxed_rate_k_min': math.nan}, 'must be greater than 0'),
        (DetectorSettings, {'ripple_c': -0.1}, 'must be at least 0, got -0.1'),
        (DetectorSettings, {'dwell_s': math.inf}, r'must be at most 1e\+07, got inf'),
        (DetectorSettings, {'end_condition': 'chamber'}, "must be 'board' or 'case', got 'chambe"),
        (DetectorSettings, {'relaxed_rate_k_min': 0.15}, 'must be below `smallest_ramp_k_min` / '),
        (ThermometerSettings, {'noise_sd_c': 0.0}, 'must be greater than 0, got 0.0'),
        (ThermometerSettings, {'fastest_ramp_k_min': -1.0}, 'must be greater than 0, got -1'),
        (ThermometerSettings, {'lag_s': math.inf}, r'must be at most 1e\+08, got inf'),
        (ThermometerSettings, {'quantum_c': -0.1}, 'must be at least 0'),
        (ThermalConfig, {'transition_time_s': math.nan}, 'must be at least 0'),
        (ThermalConfig, {'case_timeout_s': 0.0}, 'must be greater than 0'),
        (CompensatorConfig, {'temperature_timeout_s': 0.0}, 'must be greater than 0'),
        (CompensatorConfig, {'stuck_timeout_s': -1.0}, 'must be at least 0'),
        (CompensatorConfig, {'local_gravity_m_s2': math.nan}, 'must be at least 0'),
        (CompensatorConfig, {'gravity_tolerance_m_s2': -0.1}, 'must be at least 0'),
    ],
)
def test_contradictory_detector_settings_are_refused(settings, changes, text):
    (name,) = changes
    with pytest.raises(ValueError, match=f'`{name}` {text}'):
        settings(**changes)
