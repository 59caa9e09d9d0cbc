# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated runs agree with closed formulas and with numerical integration, in any blocks."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import welch
from simulation_helpers import noiseless, of_part, rippled
from triads import TRIAD_NAMES, unit_of

from thermo_comp.simulation.campaign import Cyclogram, parse_cyclogram, positions
from thermo_comp.simulation.drift import CreepEffect, PartHistory
from thermo_comp.simulation.network import AIR, ThermalResponse
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset
from thermo_comp.simulation.run import START_NS, simulate, simulate_blocks
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

UP = np.array([0.48, -0.6, 0.64])
DEMO = parse_cyclogram('demo')
SHORT = parse_cyclogram('20 4min, 26@1 5min')
COLUMNS = ('accel_stamp_ns', 'counts', 'board_stamp_ns', 'board', 'case_stamp_ns', 'case')
CYCLES = ('cycle_s', 'bias', 'scale')


@pytest.fixture(scope='module')
def unit():
    return unit_preset('thermostatted', 4)


@pytest.mark.parametrize('block_size', [1777, 6000, 10**6])
@pytest.mark.parametrize('name', ['thermostatted', 'mems'])
def test_a_run_in_blocks_equals_the_whole_run_bit_for_bit(name, block_size):
    options = {'rate_hz': 20.0, 'seed': 9}
    arguments = (unit_preset(name, 1), rippled(SHORT), UP)
    whole = simulate(*arguments, **options)
    blocks = list(simulate_blocks(*arguments, block_size=block_size, **options))
    assert len(blocks) == -(-len(whole.counts) // block_size)
    truths = [block.truth for block in blocks]
    for parts, run, names in ((blocks, whole, COLUMNS), (truths, whole.truth, CYCLES)):
        for column in names:
            joined = np.concatenate([getattr(part, column) for part in parts])
            np.testing.assert_array_equal(joined, getattr(run, column))
    # A block has the temperature readings up to the end of its last cycle.
    for block in blocks[:-1]:
        assert block.board_stamp_ns[-1] <= block.accel_stamp_ns[-1]


def test_equal_seeds_give_equal_runs_and_other_seeds_other_runs(unit):
    first, again, other = (simulate(unit, SHORT, UP, seed=seed) for seed in (5, 5, 6))
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(first, column), getattr(again, column))
    assert np.any(first.counts != other.counts)
    assert np.any(first.board != other.board)
    assert np.any(first.case != other.case)


def test_stamps_are_the_ends_of_the_cycles(unit):
    run = simulate(unit, SHORT, UP, rate_hz=300.0)
    assert len(run.counts) == SHORT.duration_s * 300
    assert run.accel_stamp_ns[0] == START_NS + 3_333_333
    assert run.accel_stamp_ns[-1] == START_NS + round(SHORT.duration_s * 1e9)
    since_s = (run.accel_stamp_ns - START_NS) * 1e-9
    np.testing.assert_allclose(since_s - run.truth.cycle_s, 0.5 / 300.0, atol=1e-9)


def test_a_further_error_source_does_not_change_the_random_numbers_of_other_sources(unit):
    """Thermometer noise does not change counts; bias drifts do not change the noise of counts."""
    plain = simulate(unit, SHORT, UP)
    noisy = simulate(replace(unit, board=replace(unit.board, noise_sd=0.05)), SHORT, UP)
    assert np.all(noisy.board != plain.board)
    np.testing.assert_array_equal(noisy.case, plain.case)
    np.testing.assert_array_equal(noisy.counts, plain.counts)
    still = simulate(replace(unit, drift=()), SHORT, UP)
    force = plain.truth.specific_force @ np.linalg.inv(unit.M).T
    moved = plain.truth.bias - still.truth.bias
    moved = moved + (plain.truth.scale - 1.0) * unit.scale_factor * force
    difference = np.cumsum(plain.counts - still.counts, axis=0) - np.cumsum(moved, axis=0)
    # Both runs begin with the same rounding remainder, so sums of counts agree within one count.
    assert np.abs(difference).max() < 1.0 + 1e-6


def test_the_sum_of_counts_without_noise_is_the_integral_of_the_truth(unit):
    """Summed counts equal the integral of ``bias + K scale inverse(M) f`` within one count."""
    run = simulate(noiseless(unit), DEMO, UP, rate_hz=50.0)
    truth = run.truth
    s = truth.specific_force @ np.linalg.inv(unit.M).T
    charge = truth.bias + np.array(unit.scale_factor) * truth.scale * s
    short = np.cumsum(charge - run.counts, axis=0)
    assert np.ptp(short, axis=0).max() < 1.0 + 1e-6
    assert np.linalg.norm(truth.specific_force) == pytest.approx(STANDARD_GRAVITY)


def test_simulated_white_noise_has_the_stated_density(unit):
    """The one-sided spectrum is ``2 density^2``, the sd of 60 s means ``density / sqrt(60)``."""
    still = replace(unit, drift=())
    run = simulate(still, parse_cyclogram('soak'), UP, rate_hz=50.0, seed=3)
    accel = run.counts / np.array(unit.scale_factor) / MICRO_G
    frequency, power = welch(accel, fs=50.0, nperseg=16384, axis=0)
    # A sample contains the last rounding remainder: noise rises with f^2, 1 (ug)^2/Hz at 0.4 Hz.
    band = (frequency > 0.01) & (frequency < 0.4)
    # The mean of 128 spectral lines, each from 86 half-overlapping segments, is uncertain by 1 %.
    density = np.array(unit.noise_density)
    np.testing.assert_allclose(power[band].mean(axis=0), 2.0 * density**2, rtol=0.05)
    means = accel.reshape(-1, 3000, 3).mean(axis=1)
    # The sd of 240 means is uncertain by 4.6 %; the limit is three times 4.6 %.
    np.testing.assert_allclose(means.std(axis=0), density / np.sqrt(60.0), rtol=0.15)


@pytest.mark.parametrize('quantum', [0.0625, 1.0])
def test_quantised_readings_are_multiples_of_the_quantum(unit, quantum):
    coarse = simulate(unit.with_thermometers(quantum=quantum), DEMO, UP, rate_hz=1.0)
    fine = simulate(unit, DEMO, UP, rate_hz=1.0)
    np.testing.assert_array_equal(coarse.board % quantum, 0.0)
    assert np.abs(coarse.board - fine.board).max() <= quantum / 2.0
    assert np.abs(coarse.case - fine.case).max() <= quantum / 2.0


@pytest.mark.parametrize('rate_hz', [0.1, 0.7, 10.0])
def test_simulated_thermometers_have_the_stated_rate_and_noise(unit, rate_hz):
    run = simulate(unit, DEMO, UP, rate_hz=1.0, temperature_rate_hz=rate_hz)
    np.testing.assert_allclose(np.diff(run.case_stamp_ns) * 1e-9, 1.0 / rate_hz, atol=2e-9)
    assert run.case_stamp_ns[0] == START_NS
    assert run.board_stamp_ns[0] == START_NS + round(0.5e9 / rate_hz)
    since_s = (run.case_stamp_ns - START_NS) * 1e-9
    error = run.case - np.interp(since_s, run.truth.grid_s, of_part(run.truth, 'case'))
    # 540 readings (noise 5 mK) determine the mean to 0.2 mK, the sd to 3 %; limits: 5 sd.
    assert error.mean() == pytest.approx(0.0, abs=1.1e-3)
    assert error.std() == pytest.approx(0.005, rel=0.16)


@pytest.mark.parametrize(
    ('n', 'least'), [(6, 0.0), (9, 0.4), (12, 0.6), (18, 0.7), (24, 0.8), (26, 1.2), (40, 2.0)]
)
def test_nine_or_more_positions_determine_nine_terms_of_a_quadric(n, least):
    """Nine or more positions determine all terms of a quadric: bias, scale, misalignment."""
    up = positions(n, 5)
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0)
    x, y, z = up.T
    quadric = np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1)
    weakest = np.linalg.eigvalsh(quadric.T @ quadric)[0]
    assert weakest > least if least else abs(weakest) < 1e-9
    assert np.any(up != positions(n, 6))
    assert np.abs(up.sum(axis=0)).max() < 0.1 * n


def test_wrong_arguments_of_simulate_are_refused(unit):
    for name, value in (('rate_hz', 0.0), ('temperature_rate_hz', 0.0), ('gravity', float('nan'))):
        with pytest.raises(ValueError, match=f'`{name}` must be positive, got {value:g}'):
            simulate(unit, SHORT, UP, **{name: value})
    with pytest.raises(ValueError, match='shorter than one conversion cycle of 1 s'):
        simulate(unit, Cyclogram((0.0, 0.5), (20.0, 20.0)), UP, rate_hz=1.0)


# Rounding error of closed solutions of a thermal network, at some 10 degC [K].
ROUNDING = 1e-9


def response_of(network, time, air):
    return ThermalResponse(network, np.array(time), np.array(air))


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
    # The integrator has an error of 2e-5 K, because it steps over the corners of the program.
    np.testing.assert_allclose(states, solved.y.T, atol=2e-5)


def test_creep_decays_with_its_time_constant():
    """The bias after a step of the part's temperature decays with the time constant."""
    step = np.full((7201, 1), 10.0)
    step[0] = 0.0
    history = PartHistory(('case',), step, np.zeros(1), 1.0)
    bias, scale = CreepEffect('case', 7200.0, bias=(1.0, 2.0, 0.0)).change(history)
    # The tolerance is the length of the step, 1 s, relative to the time constant.
    np.testing.assert_allclose(bias[-1], np.array([10.0, 20.0, 0.0]) * math.exp(-1.0), atol=2e-3)
    np.testing.assert_array_equal(scale, 0.0)


def test_the_steady_state_obeys_the_heat_balance():
    """In the steady state the heat flow to the air is the power of all parts."""
    network = unit_preset('bare-quartz', 5).network
    warm = network.equilibrium(12.0)
    to_air = next(link for link in network.links if AIR in (link.a, link.b))
    case, board = map(network.nodes.index, ('case', 'board'))
    assert to_air.conductance * (warm[case] - 12.0) == pytest.approx(sum(network.power.values()))
    response = response_of(network, [0.0, 3600.0], [12.0, 12.0])
    temperatures = response.temperatures(np.array([0.0, 1800.0, 3600.0]))
    np.testing.assert_allclose(temperatures, np.tile(warm, (3, 1)), atol=ROUNDING)
    assert network.equilibrium(network.air_for('board', 20.0))[board] == pytest.approx(20.0)


def test_a_thermostat_keeps_its_part_within_0_2_k_by_the_power_that_leaks():
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
    assert np.ptp(response.temperatures(grid)[:, head]) < 0.2
