# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The thermal tracker agrees with closed formulas: lags, transitions, lost sensors, restarts."""

import math

import numpy as np
import pytest
from builders import SECOND_NS

from thermo_comp.thermal.lags import MemorySpec
from thermo_comp.thermal.regime import Regime
from thermo_comp.thermal.settings import DetectorSettings, ThermalConfig
from thermo_comp.thermal.state import GRADIENT, MEMORY_SETTLED_SD, VAR_GRADIENT, Rate, StateLayout
from thermo_comp.thermal.tracker import LOST_GRADIENT_RELATIVE_SD, ThermalTracker

TAU_S = 900.0
LAG = MemorySpec(lags=(('board', TAU_S),))


def feed(tracker, board, case=None, *, start_s=0, step_s=1):
    for k, celsius in enumerate(board):
        stamp_ns = (start_s + k * step_s) * SECOND_NS
        tracker.read('board', stamp_ns, float(celsius))
        if case is not None:
            tracker.read('case', stamp_ns, float(case[k]))


def test_a_lag_is_known_after_some_time_and_without_readings_follows_the_board():
    tracker = ThermalTracker(DetectorSettings(), LAG)
    feed(tracker, np.full(10, 20.0))
    assert not tracker.is_settled(10 * SECOND_NS)
    # A lag of 900 s has an sd of 1.5 K at the start, which decays to 50 mK within 3061 s.
    feed(tracker, np.full(5000, 20.0), start_s=10)
    settled_s = TAU_S * math.log(1.5 / MEMORY_SETTLED_SD)
    assert not tracker.is_settled(round((settled_s - 10.0) * 1e9))
    assert tracker.is_settled(round((settled_s + 10.0) * 1e9))
    # WHY: without case readings the gradient was used as its own lag, an error of 3 claimed sd.
    spec = MemorySpec(lags=(('case', 600.0),))
    tracker = ThermalTracker(DetectorSettings(), spec, board_lag_s=500.0)
    feed(tracker, 20.0 + np.maximum(np.arange(1301) - 1000.0, 0.0) / 60.0)
    state = tracker.sample(1300 * SECOND_NS)
    expected = 500.0 / 60.0 * (1.0 - math.exp(-0.5))
    assert state[StateLayout(spec).places[spec.lags[0]]] == pytest.approx(expected, rel=0.1)


def test_the_thermal_state_depends_on_no_earlier_query_and_no_origin_of_time():
    tracker, other = (ThermalTracker(DetectorSettings(), LAG) for _ in range(2))
    board = 20.0 + 0.005 * np.arange(3000)
    feed(tracker, board, board + 1.0)
    for k, celsius in enumerate(board.tolist()):
        other.read('board', k * SECOND_NS, celsius)
        other.read('case', k * SECOND_NS, celsius + 1.0)
        other.sample(k * SECOND_NS + 123)
        other.is_settled(k * SECOND_NS + 456_000_000)
    at = 3000 * SECOND_NS
    assert tracker.sample(at) == other.sample(at)
    epoch_ns = 1_790_000_000 * SECOND_NS
    tracker, other = (ThermalTracker(DetectorSettings(), LAG) for _ in range(2))
    board = 20.0 + 0.01 * np.arange(500)
    feed(tracker, board, board + 2.0)
    feed(other, board, board + 2.0, start_s=1_790_000_000)
    assert tracker.sample(500 * SECOND_NS) == other.sample(epoch_ns + 500 * SECOND_NS)


@pytest.mark.parametrize(('transition_s', 'n_steps'), [(20.0, 20), (0.0, 1)])
def test_the_dynamic_weight_is_linear_over_the_transition_time(transition_s, n_steps):
    config, soak = ThermalConfig(transition_time_s=transition_s), np.full(1200, 20.0)
    tracker, weights = ThermalTracker(DetectorSettings(), None, config), []
    feed(tracker, soak, soak)
    assert tracker.detector.regime == Regime.STATIC
    for k in range(1, 600):
        feed(tracker, [20.0 + (k / 60.0) * 0.2], [20.0 + k / 60.0], start_s=1199 + k)
        weights.append(tracker.weight_at((1199 + k) * SECOND_NS))
    assert tracker.detector.regime == Regime.DYNAMIC
    steps = np.diff(weights)
    np.testing.assert_allclose(steps[steps != 0.0], [1.0 / n_steps] * n_steps, atol=1e-9)
    assert (weights[0], weights[-1]) == (0.0, 1.0)


def test_gradient_and_rate_follow_from_the_board_rate_if_the_case_sensor_is_lost():
    spec, config = MemorySpec(rates=('case',)), ThermalConfig(case_timeout_s=10.0)
    tracker = ThermalTracker(DetectorSettings(), spec, config, 600.0)
    t = np.arange(0, 1000)
    feed(tracker, 20.0 + 0.01 * t, 20.0 + 0.02 * t)
    place = StateLayout(spec).places[Rate('case')]
    state = tracker.sample(999 * SECOND_NS)
    assert state[GRADIENT] == pytest.approx(9.99, abs=0.05)
    assert state[place] == pytest.approx(0.02, rel=0.01)
    assert 0.0 < state[place + 1] < 0.001**2
    feed(tracker, 20.0 + 0.01 * np.arange(1000, 1100), start_s=1000)
    state = tracker.sample(1099 * SECOND_NS)
    # In a ramp the board lags the case by rate times lag, 0.01 K/s times 600 s.
    assert state[GRADIENT] == pytest.approx(600.0 * 0.01, abs=0.1)
    assert math.sqrt(state[VAR_GRADIENT]) >= LOST_GRADIENT_RELATIVE_SD * 5.9
    assert state[place] == pytest.approx(0.01, rel=0.01)
    assert math.sqrt(state[place + 1]) == pytest.approx(0.01, rel=0.01)
