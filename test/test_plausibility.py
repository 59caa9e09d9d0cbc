# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Faults of thermometers are detected, and readings of working thermometers are accepted."""

import math
from functools import cache
from itertools import count

import numpy as np
import pytest
from builders import SECOND_NS
from simulation_helpers import rippled

from thermo_comp.simulation.campaign import parse_cyclogram
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate
from thermo_comp.thermal.lags import MemorySpec
from thermo_comp.thermal.plausibility import STILL_READINGS, Fault, still_readings
from thermo_comp.thermal.regime import Regime
from thermo_comp.thermal.settings import DetectorSettings, ThermalConfig, ThermometerSettings
from thermo_comp.thermal.state import GRADIENT, VAR_BOARD, VAR_GRADIENT
from thermo_comp.thermal.tracker import ThermalTracker

LAG = MemorySpec(lags=(('board', 900.0),))
SENSORS = {
    'continuous': ThermometerSettings(noise_sd_c=0.005),
    'sixteenths': ThermometerSettings(noise_sd_c=0.005, quantum_c=0.0625),
    'degrees': ThermometerSettings(noise_sd_c=0.02, quantum_c=1.0),
}


def tracker_of(sensor='continuous', memory=None, board_lag_s=900.0, **config):
    settings = DetectorSettings(case=SENSORS[sensor], board=SENSORS[sensor])
    return ThermalTracker(settings, memory, ThermalConfig(**config), board_lag_s)


def soak(tracker, celsius=20.0, seconds=60, start_s=0):
    """Give both thermometers a reading per second, alternating by +-4 mK; return the end [s]."""
    for second in range(start_s, start_s + seconds):
        flicker = 0.004 * (-1) ** second
        tracker.read('board', second * SECOND_NS, celsius + flicker)
        tracker.read('case', second * SECOND_NS, celsius - flicker)
    return start_s + seconds


@pytest.mark.parametrize('wrong', [85.0, 24.2, -40.0])
@pytest.mark.parametrize('sensor', ['board', 'case'])
def test_a_wrong_first_reading_does_not_change_later_thermal_states(sensor, wrong):
    # WHY: one reading of 85 degC after power-on caused force errors of 1 mg for 20 min.
    memory = MemorySpec(lags=(('board', 900.0), ('case', 600.0)))
    tracker, without = tracker_of(memory=memory), tracker_of(memory=memory)
    for second in range(0, 900, 5):
        board = 20.0 + max(second - 300, 0) / 60.0 + 0.004 * (-1) ** (second // 5)
        for name, celsius in (('board', board), ('case', board + 0.5)):
            is_wrong = name == sensor and second == 0
            tracker.read(name, second * SECOND_NS, wrong if is_wrong else celsius)
            if name != sensor or second >= 10:
                without.read(name, second * SECOND_NS, celsius)
    state = tracker.sample(900 * SECOND_NS)
    np.testing.assert_allclose(state, without.sample(900 * SECOND_NS), rtol=1e-9, atol=1e-12)
    shares = tracker.memory.remaining_shares(900 * SECOND_NS)
    assert shares == without.memory.remaining_shares(900 * SECOND_NS)
    assert tracker.checks['board'].fault is tracker.checks['case'].fault is Fault.NONE


@pytest.mark.parametrize('lag_s', [0.0, 300.0])
def test_a_fast_change_at_the_start_is_not_taken_for_a_wrong_reading(lag_s):
    tracker = tracker_of(memory=LAG)
    for second in range(0, 60, 5):
        # The board's temperature changes by 12 K/min, or by 40 K with a time constant of 300 s.
        changed = 40.0 * (1.0 - math.exp(-second / lag_s)) if lag_s else 0.2 * second
        tracker.read('board', second * SECOND_NS, 20.0 + changed)
    assert tracker.memory.board.start_ns == 0


@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('frozen', ['board', 'case'])
def test_a_frozen_sensor_is_detected_by_changes_of_the_second_sensor(sensor, frozen):
    tracker = tracker_of(sensor, board_lag_s=300.0)
    quantum = SENSORS[sensor].quantum_c
    rng = np.random.default_rng(5)

    def read(celsius):
        value = celsius + SENSORS[sensor].noise_sd_c * rng.standard_normal()
        return quantum * round(value / quantum) if quantum else value

    last, board, case = {}, 20.0, 20.0
    for second in count():
        case += 2.0 / 60.0 * (second > 300)
        board += (case - board) / 300.0
        values = {'board': read(board), 'case': read(case)}
        if second > 250:
            values[frozen] = last[frozen]
        last = values
        tracker.read('board', second * SECOND_NS, values['board'])
        tracker.read('case', second * SECOND_NS, values['case'])
        guard = tracker.checks[frozen]
        if guard.fault == Fault.FROZEN:
            break
        assert second < 1200
    other = tracker.checks['case'] if frozen == 'board' else tracker.checks['board']
    assert other.fault == Fault.NONE
    seen = getattr(tracker, frozen)
    # Until detected a frozen board reading errs by up to 4 quanta + 2 K, the case by 10 K more.
    lead = 10.0 if frozen == 'case' else 0.0
    off = (board if frozen == 'board' else case) - seen.temperature
    assert abs(off) < 4.0 * quantum + 2.0 + lead
    state = tracker.sample(second * SECOND_NS)
    assert math.sqrt(state[VAR_BOARD if frozen == 'board' else VAR_GRADIENT]) > 0.5
    assert not tracker.read(frozen, (second + 1) * SECOND_NS, last[frozen])
    assert tracker.read(frozen, (second + 2) * SECOND_NS, last[frozen] + 0.07)
    assert guard.fault == Fault.NONE


@pytest.mark.parametrize('sensor', ['board', 'case'])
def test_a_jump_that_stays_is_claimed_until_the_readings_jump_back(sensor):
    # WHY: after three time constants the claimed sd no longer covered a wrong jump by 5 K.
    tracker = tracker_of(memory=LAG)
    place = VAR_BOARD if sensor == 'board' else VAR_GRADIENT
    for second in range(12_000):
        flicker = 0.004 * (-1) ** second
        for name in ('board', 'case'):
            is_wrong = name == sensor and 1000 <= second < 6000
            tracker.read(name, second * SECOND_NS, 20.0 + flicker + (5.0 if is_wrong else 0.0))
        if second == 5999:
            assert tracker.sample(second * SECOND_NS)[place] == pytest.approx(25.0, rel=0.02)
            assert tracker.checks[sensor].finding == (Fault.SHIFTED, pytest.approx(5.0, abs=0.02))
    # The square of the jump fades with a time constant of 600 s, to 25 K^2 * exp(-10).
    assert tracker.sample(12_000 * SECOND_NS)[place] < 0.1**2
    assert tracker.checks[sensor].finding[0] is Fault.NONE


def test_constant_readings_are_no_fault_and_do_not_end_the_dynamic_regime():
    tracker = tracker_of('sixteenths')
    for second in range(3600):
        tracker.read('board', second * SECOND_NS, 20.0)
        tracker.read('case', second * SECOND_NS, 20.0)
    assert tracker.checks['board'].fault == tracker.checks['case'].fault == Fault.NONE
    # With noise of 0.5 quanta a reading repeats with p = 0.68, and 54 times with p = 1e-9.
    assert still_readings(ThermometerSettings(0.005, 0.01)) == 54
    assert still_readings(ThermometerSettings(0.005, 0.0)) == STILL_READINGS
    tracker = tracker_of()
    soak(tracker, seconds=1500)
    for second in range(1500, 2500):
        flicker = 0.004 * (-1) ** second
        ramp = min(second, 1900) - 1500
        tracker.read('board', second * SECOND_NS, 20.0 + ramp / 90.0 + flicker * (ramp < 400))
        tracker.read('case', second * SECOND_NS, 20.0 + ramp / 60.0 + flicker * (ramp < 400))
    assert tracker.checks['case'].fault == Fault.STILL
    assert tracker.detector.regime == Regime.DYNAMIC


@cache
def in_its_chamber(preset, sensor):
    """Simulate a unit; return its readings: (stamp [ns], 0 for board or 1 for case, degC)."""
    sd, quantum = SENSORS[sensor].noise_sd_c, SENSORS[sensor].quantum_c
    unit = unit_preset(preset, 1).with_thermometers(noise_sd=sd, quantum=quantum, rate_hz=0.5)
    run = simulate(unit, rippled(parse_cyclogram('fast')), (0.0, 0.0, 1.0), rate_hz=0.02, seed=1)
    readings = [(int(s), 0, float(v)) for s, v in zip(run.board_stamp_ns, run.board, strict=True)]
    readings += [(int(s), 1, float(v)) for s, v in zip(run.case_stamp_ns, run.case, strict=True)]
    return sorted(readings)


IN_CHAMBER = [('thermostatted', sensor) for sensor in SENSORS]


@pytest.mark.parametrize(
    ('preset', 'sensor'), [*IN_CHAMBER, ('bare-quartz', 'sixteenths'), ('mems', 'sixteenths')]
)
def test_no_fault_is_reported_of_a_working_unit_in_a_chamber(preset, sensor):
    tracker = tracker_of(sensor)
    for stamp_ns, is_case, celsius in in_its_chamber(preset, sensor):
        tracker.read('case' if is_case else 'board', stamp_ns, celsius)
        assert not tracker.lead.is_reversed
        assert tracker.checks['board'].fault == Fault.NONE
        assert tracker.checks['case'].fault == Fault.NONE


# The board of the preset 'mems' lags the case by seconds: T_case - T_board is below 1 K.
@pytest.mark.parametrize(
    ('preset', 'sensor'), [*IN_CHAMBER, *(('bare-quartz', name) for name in list(SENSORS)[:2])]
)
def test_swapped_topics_are_reported(preset, sensor):
    tracker = tracker_of(sensor)
    for stamp_ns, is_case, celsius in in_its_chamber(preset, sensor):
        tracker.read('board' if is_case else 'case', stamp_ns, celsius)
        if tracker.lead.is_reversed:
            flat = tracker.sample(stamp_ns)
            assert flat[VAR_BOARD] >= flat[GRADIENT] ** 2
            return
    pytest.fail('the board has never led the case')


def test_a_ramp_after_a_soak_without_board_readings_has_finite_variances():
    tracker = tracker_of()
    for second in range(120):
        tracker.read('case', second * SECOND_NS, 20.0 + 0.004 * (-1) ** second)
    assert tracker.detector.regime is Regime.STATIC
    for second in range(120, 300):
        tracker.read('board', second * SECOND_NS, 20.0 + 0.01 * (second - 120))
        tracker.read('case', second * SECOND_NS, 20.0 + 0.05 * (second - 120))
        assert all(map(math.isfinite, tracker.sample(second * SECOND_NS)))
    assert tracker.detector.regime is Regime.DYNAMIC


def test_the_warm_up_after_power_on_is_not_taken_for_swapped_topics():
    tracker = tracker_of(memory=LAG)
    for second in range(3 * 3600):
        warm = 4.0 * (1.0 - math.exp(-second / 500.0))
        air = max(second - 5400, 0) / 60.0 * 0.3
        flicker = 0.004 * (-1) ** second
        tracker.read('board', second * SECOND_NS, 20.0 + warm + 0.7 * air + flicker)
        tracker.read('case', second * SECOND_NS, 20.0 + warm / 3.0 + air - flicker)
        assert not tracker.lead.is_reversed


@pytest.mark.parametrize('order', [('board', 'case'), ('case', 'board')])
def test_one_topic_given_for_both_thermometers_is_named_and_claimed(order):
    # In a ramp of 1 K/min both thermometers have the same reading each second.
    tracker, rng = tracker_of(), np.random.default_rng(8)
    for second in range(300):
        celsius = 20.0 + second / 60.0 + 0.005 * rng.standard_normal()
        for name in order:
            tracker.read(name, second * SECOND_NS, celsius)
    state = tracker.sample(300 * SECOND_NS)
    assert tracker.copies['case'].is_copy
    # With a board lag of 900 s the case is 15 K above the board in a ramp of 1 K/min.
    assert abs(state[GRADIENT]) < 0.1
    assert state[VAR_GRADIENT] ** 0.5 == pytest.approx(15.0, rel=0.2)
    # If one case reading differs from the board reading, the topics are two thermometers.
    tracker.read('board', 300 * SECOND_NS, 25.0)
    tracker.read('case', 300 * SECOND_NS, 25.1)
    assert not tracker.copies['case'].is_copy


@pytest.mark.parametrize('quantum', [0.0, 0.0625, 1.0])
def test_two_thermometers_at_one_temperature_are_not_taken_for_one(quantum):
    def rounded(celsius):
        return quantum * round(celsius / quantum) if quantum else celsius

    tracker = tracker_of('degrees')
    rng = np.random.default_rng(9)
    for second in range(20_000):
        true = 20.0 + 10.0 * math.sin(second / 1000.0)
        for name in ('board', 'case'):
            tracker.read(name, second * SECOND_NS, rounded(true + 0.02 * rng.standard_normal()))
        assert not tracker.copies['case'].is_copy
