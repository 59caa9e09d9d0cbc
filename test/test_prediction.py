# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Predictions for soaks and ramps: against hand calculations and the compensator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set, rich_calibration, term

from thermo_comp.thermal.memory import memory_on_grid
from thermo_comp.thermal.state import BOARD, RATE, WEIGHT, Layout
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.prediction import ramp_states, sd_of_states


def slope_and_lag(variances: dict[int, float]):
    """
    Make a unit with a slope and a lag of 600 s, and variances of some parameters of its x axis.
    """
    one = calibration(
        static=regime_set(*[axis_set((0.0, 0.3), residual_sd_m_s2=3e-5)] * 3),
        dynamic=regime_set(*[axis_set((0.0, 0.3))] * 3),
        response=(term('board', (0.3, 0.0, 0.0), tau_s=600.0),),
    )
    own = np.zeros(parameter_layout(one).n_parameters)
    for place, variance in variances.items():
        own[place] = variance
    return replace(one, posterior=posterior_of(np.diag(own)))


def test_sd_by_hand():
    # x: level and slope of the static bias, level and slope of the dynamic bias, weight of the
    # lag; then static and dynamic level of the scale.
    one = slope_and_lag({0: 4e-4, 1: 1e-6, 2: 9e-4, 3: 0.0, 4: 1e-6, 5: 1e-12, 6: 4e-12})
    states = ramp_states(one, np.array([20.0, 30.0]), 0.0, np.inf)
    bias, scale = sd_of_states(one, states)
    # sqrt(4e-4 + 100 * 1e-6) counts, 300 of them per m/s^2, and 30 um/s^2 of unexplained residual.
    own = np.sqrt([4e-4, 5e-4]) / 300.0
    assert bias[:, 0] == pytest.approx(np.hypot(own, 3e-5), rel=1e-6)
    assert bias[:, 1] == pytest.approx([3e-5, 3e-5])
    assert scale[:, 0] == pytest.approx([1e-6, 1e-6], rel=1e-6)
    # An endless ramp of 0.6 K/min: 600 s behind are 6 K.
    bias, scale = sd_of_states(one, ramp_states(one, np.array([25.0]), 0.01, np.inf))
    assert bias[0, 0] == pytest.approx(np.sqrt(9e-4 + 36e-6) / 300.0, rel=1e-6)
    assert scale[0, 0] == pytest.approx(2e-6, rel=1e-6)


def test_what_is_known_has_no_sd():
    one = replace(rich_calibration(), posterior=None)
    bias, scale = sd_of_states(one, ramp_states(one, np.array([20.0]), 0.0, np.inf))
    assert bias == pytest.approx(np.full((1, 3), 1e-5))
    assert not scale.any()


@pytest.mark.parametrize('rate', [0.01, -0.02])
def test_ramp_is_what_the_memory_makes_of_one(rate):
    # Second route: the memory of the fit goes through a ramp after a soak, second by second.
    one = replace(rich_calibration(), board_lag_s=100.0)
    spec = Correction(one).memory
    gradient = np.append(0.0, np.full(900, 100.0 * rate))
    board = 25.0 + rate * np.arange(-900.0, 1.0)
    lived = memory_on_grid(spec, 1.0, board, [gradient] * len(spec.sensors))[-1]
    (state,) = ramp_states(one, board[-1:], rate, 900.0)
    layout = Layout(spec)
    assert state[[BOARD, RATE, WEIGHT]].tolist() == [25.0, rate, 1.0]
    assert state[list(layout.gradients.values())] == pytest.approx(100.0 * rate)
    # The gradient is reached within a second of the 900, not at once.
    for lag, place in layout.lags.items():
        assert state[place] == pytest.approx(lived[place - layout.first_lag], rel=2e-3), lag
    for (tau, width), place in layout.plays.items():
        # Half an hour would also push the play on the lag to its end.
        if not tau:
            assert state[place] == pytest.approx(-width * np.sign(rate))
            assert state[place] == pytest.approx(lived[place - layout.first_lag])
