# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The thermal network against cases solved by hand, an integrator and its heat balance."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from triads import TRIAD_NAMES, unit_of

from thermo_comp.simulation.campaign import parse_cyclogram
from thermo_comp.simulation.drift import CreepEffect, PartHistory
from thermo_comp.simulation.network import AIR, Link, ThermalNetwork, ThermalResponse
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset

# Both are closed forms, so only rounding differs; temperatures are tens of degrees.
ROUNDING = 1e-9


def response_of(network, time, air):
    return ThermalResponse(network, np.array(time), np.array(air))


def test_two_parts_follow_a_ramp_as_solved_by_hand():
    """
    Air - case - board with heat flow back: eigenvalues from the quadratic formula, lags from the
    heat balance of an endless ramp, amplitudes from the start at rest.
    """
    c0, c1, g0, g1, rate = 700.0, 300.0, 3.0, 0.4, 1.0 / 60.0
    network = ThermalNetwork(
        {'case': c0, 'board': c1}, (Link(AIR, 'case', g0), Link('case', 'board', g1))
    )
    trace, determinant = -(g0 + g1) / c0 - g1 / c1, g0 * g1 / (c0 * c1)
    root = math.sqrt(trace * trace - 4.0 * determinant)
    modes = np.array([(trace + root) / 2.0, (trace - root) / 2.0])
    # In a ramp the path to the air heats both capacities, the inner path the board's.
    lag = np.array([(c0 + c1) / g0, (c0 + c1) / g0 + c1 / g1])
    shapes = np.array([modes + g1 / c1, [g1 / c1, g1 / c1]])
    amplitude = np.linalg.solve(shapes, lag)
    time = np.linspace(0.0, 5400.0, 91)
    decaying = np.exp(np.outer(time, modes)) * amplitude
    expected = rate * (time[:, None] - lag + decaying @ shapes.T)

    response = response_of(network, [0.0, 5400.0], [0.0, rate * 5400.0])
    np.testing.assert_allclose(response.temperatures(time), expected, atol=ROUNDING)


@pytest.mark.parametrize('name', [*UNIT_NAMES, *TRIAD_NAMES])
def test_presets_agree_with_a_numerical_integrator(name):
    unit = unit_of(name, 3)
    program = parse_cyclogram('demo')
    response = response_of(unit.network, program.time_s, program.temperature_c)
    network = unit.network
    A, b, p = network.system()
    time = np.linspace(0.0, program.duration_s, 200)
    states = response.states(time)

    def air(t):
        return float(np.interp(t, program.time_s, program.temperature_c))

    solved = solve_ivp(
        lambda t, x: A @ x + b * air(t) + p + network.convection(x, air(t)),
        (0.0, program.duration_s), states[0], method='LSODA', t_eval=time, rtol=1e-10, atol=1e-10,
        max_step=60.0,
    )  # fmt: skip
    # The integrator steps over the corners of the program, which is its error.
    np.testing.assert_allclose(states, solved.y.T, atol=2e-5)


def test_creep_relaxes_towards_its_part():
    """The creep after a step of a part lags it by its time constant."""
    step = np.full((7201, 1), 10.0)
    step[0] = 0.0
    history = PartHistory(('case',), step, np.zeros(1), 1.0)
    bias, scale = CreepEffect('case', 7200.0, bias=(1.0, 2.0, 0.0)).change(history)
    # The step takes 1 s, 1.4e-4 of the time constant.
    np.testing.assert_allclose(bias[-1], np.array([10.0, 20.0, 0.0]) * math.exp(-1.0), atol=2e-3)
    np.testing.assert_array_equal(scale, 0.0)


def test_still_state_obeys_the_heat_balance():
    """In the steady state all power leaves through the path to the air."""
    unit = unit_preset('bare-quartz', 5)
    warm = unit.network.equilibrium(12.0)
    to_air = next(link for link in unit.network.links if AIR in (link.a, link.b))
    case = warm[unit.network.nodes.index('case')]
    assert to_air.conductance * (case - 12.0) == pytest.approx(sum(unit.network.power.values()))
    response = response_of(unit.network, [0.0, 3600.0], [12.0, 12.0])
    np.testing.assert_allclose(
        response.temperatures(np.array([0.0, 1800.0, 3600.0])),
        np.tile(warm, (3, 1)),
        atol=ROUNDING,
    )
    board = unit.network.nodes.index('board')
    assert unit.network.equilibrium(unit.network.air_for('board', 20.0))[board] == pytest.approx(
        20.0
    )


def test_thermostat_holds_its_part_and_spends_what_leaks():
    unit = unit_preset('thermostatted', 2)
    network = unit.network
    heat = network.thermostat
    oven, head = network.nodes.index('oven'), network.nodes.index('head')
    for air in (5.0, 20.0, 35.0):
        still = network.equilibrium(air)
        assert still[oven] == pytest.approx(heat.set_point)
        leak = sum(
            link.conductance * (heat.set_point - still[network.nodes.index(other)])
            for link in network.links
            for here, other in ((link.a, link.b), (link.b, link.a))
            if here == 'oven'
        )
        assert network.settled(air)[len(network.nodes)] == pytest.approx(leak)
    program = parse_cyclogram('fast')
    response = response_of(network, program.time_s, program.temperature_c)
    grid = np.arange(0.0, program.duration_s, 30.0)
    # At 30 K outside and 3 K/min an oven of this class keeps the head within 0.2 K.
    assert np.ptp(response.temperatures(grid)[:, head]) < 0.2


def test_an_oven_refuses_air_that_it_cannot_hold_off():
    network = unit_preset('thermostatted', 0).network
    with pytest.raises(ValueError, match=r'air of 5\.\.90 degC needs -.* W of a thermostat'):
        response_of(network, [0.0, 60.0], [5.0, 90.0])
