# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated runs agree with closed formulas, numerical integration and their description."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from accuracy import corrected_by_truth
from scipy.integrate import solve_ivp
from scipy.signal import welch
from simulation_helpers import noiseless, of_part, rippled
from triads import TRIAD_NAMES, triad, unit_of

from thermo_comp.simulation.campaign import (
    PLAN_NAMES,
    Cyclogram,
    Position,
    parse_cyclogram,
    plan,
    positions,
)
from thermo_comp.simulation.drift import CreepEffect, FlowEffect, PartHistory, drift_of
from thermo_comp.simulation.network import AIR, ThermalResponse
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset
from thermo_comp.simulation.run import START_NS, arrays, simulate, simulate_blocks
from thermo_comp.simulation.unit import SwitchedLoad, balanced, first_charge, rounded
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


def test_equal_seeds_give_equal_runs_whose_stamps_are_the_ends_of_the_cycles(unit):
    first, again, other = (simulate(unit, SHORT, UP, seed=seed) for seed in (5, 5, 6))
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(first, column), getattr(again, column))
    assert np.any(first.counts != other.counts)
    assert np.any(first.board != other.board)
    assert np.any(first.case != other.case)
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
    # Both runs begin with an equal rounding remainder: sums of counts agree within a count.
    assert np.abs(difference).max() < 1.0 + 1e-6


def test_the_sum_of_counts_without_noise_is_the_integral_of_the_truth(unit):
    """Summed counts equal the integral of ``bias + K scale inverse(M) f`` within one count."""
    run = simulate(noiseless(unit), DEMO, UP, rate_hz=50.0)
    truth = run.truth
    s = truth.specific_force @ np.linalg.inv(unit.M).T
    charge = truth.bias + np.array(unit.scale_factor) * truth.scale * s
    assert np.ptp(np.cumsum(charge - run.counts, axis=0), axis=0).max() < 1.0 + 1e-6
    assert np.linalg.norm(truth.specific_force) == pytest.approx(STANDARD_GRAVITY)


def test_simulated_white_noise_has_the_stated_density(unit):
    """The one-sided spectrum is ``2 density^2``, the sd of 60 s means ``density / sqrt(60)``."""
    run = simulate(replace(unit, drift=()), parse_cyclogram('soak'), UP, rate_hz=50.0, seed=3)
    accel = run.counts / np.array(unit.scale_factor) / MICRO_G
    frequency, power = welch(accel, fs=50.0, nperseg=16384, axis=0)
    # The last rounding remainder is in a sample: noise grows with f^2, by 1 (ug)^2/Hz at 0.4 Hz.
    band = (frequency > 0.01) & (frequency < 0.4)
    # A mean over 128 lines, each of 86 half-overlapping segments, is uncertain by 1 %.
    density = np.array(unit.noise_density)
    np.testing.assert_allclose(power[band].mean(axis=0), 2.0 * density**2, rtol=0.05)
    means = accel.reshape(-1, 3000, 3).mean(axis=1)
    # 240 means determine the sd to 4.6 %; the limit is three times 4.6 %.
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
    # 540 readings with 5 mK of noise determine the mean to 0.2 mK, the sd to 3 %; limits: 5 sd.
    assert error.mean() == pytest.approx(0.0, abs=1.1e-3)
    assert error.std() == pytest.approx(0.005, rel=0.16)


@pytest.mark.parametrize(
    ('n', 'least'), [(6, 0.0), (9, 0.4), (12, 0.6), (18, 0.7), (24, 0.8), (26, 1.2), (40, 2.0)]
)
def test_nine_or_more_positions_determine_nine_terms_of_a_quadric(n, least):
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


# Rounding error of closed solutions for a thermal network at some 10 degC [K].
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
    # The integrator errs by 2e-5 K, because its steps do not end at corners of the program.
    np.testing.assert_allclose(states, solved.y.T, atol=2e-5)


def test_the_steady_state_obeys_the_heat_balance_also_with_a_thermostat():
    network = unit_preset('bare-quartz', 5).network
    warm = network.equilibrium(12.0)
    to_air = next(link for link in network.links if AIR in (link.a, link.b))
    case, board = map(network.nodes.index, ('case', 'board'))
    assert to_air.conductance * (warm[case] - 12.0) == pytest.approx(sum(network.power.values()))
    response = response_of(network, [0.0, 3600.0], [12.0, 12.0])
    temperatures = response.temperatures(np.array([0.0, 1800.0, 3600.0]))
    np.testing.assert_allclose(temperatures, np.tile(warm, (3, 1)), atol=ROUNDING)
    assert network.equilibrium(network.air_for('board', 20.0))[board] == pytest.approx(20.0)
    network = unit_preset('thermostatted', 2).network
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
    assert np.ptp(response.temperatures(np.arange(0.0, program.duration_s, 30.0))[:, head]) < 0.2


PROGRAM = parse_cyclogram('20 10min, 30@1 20min, 24@0.5 10min')
STATION = Position(PROGRAM, np.array([0.48, -0.6, 0.64]))


def _history(temperature, step=1.0):
    deviation = np.reshape(temperature, (len(temperature), -1))
    nodes = ('a', 'b')[: deviation.shape[1]]
    return PartHistory(nodes, deviation, np.zeros(len(nodes)), step)


@pytest.mark.parametrize('kind', ['own-lags', 'switched-load', 'slow-noise', 'convection'])
def test_a_record_of_arrays_equals_a_run_of_simulate(kind):
    unit = triad(kind, 1)
    _, record = arrays(unit, [STATION, STATION], 3)
    run = simulate(unit, PROGRAM, STATION.up, rate_hz=4.0, seed=3001, start_ns=0)
    for name in ('counts', 'board', 'case', 'accel_stamp_ns', 'case_stamp_ns'):
        np.testing.assert_array_equal(getattr(record, name), getattr(run, name))
    for name in ('specific_force', 'scale_grid'):
        np.testing.assert_array_equal(getattr(record.truth, name), getattr(run.truth, name))


@pytest.mark.parametrize('kind', TRIAD_NAMES)
def test_the_true_thermal_model_leaves_only_noise(kind):
    """In means over 60 s the noise is 0.65 ug in |f| and 1.12 ug in the vector."""
    unit = triad(kind, 2)
    errors, norms = [], []
    for record in arrays(unit, plan('held-out', 2), 7):
        force = corrected_by_truth(record) / MICRO_G
        errors.append(np.sum((force - record.truth.specific_force / MICRO_G) ** 2, axis=1))
        norms.append(np.linalg.norm(force, axis=1) - STANDARD_GRAVITY / MICRO_G)
    vector = np.sqrt(np.mean(np.concatenate(errors)))
    if kind == 'slow-noise':
        # In 7.3 h the random walk has a mean square of 9 * 7.3 / 2 ug^2, known to a factor of 4.
        assert 4.0 < vector < 20.0
    else:
        # 1311 means determine the RMS to 2 % (|f|) and 1.2 % (vector); the limits are 5 sd.
        assert np.sqrt(np.mean(np.concatenate(norms) ** 2)) == pytest.approx(0.65, abs=0.065)
        assert vector == pytest.approx(1.12, abs=0.07)


def test_plans_have_the_stated_durations_and_attitudes():
    plans = {name: plan(name, 1) for name in PLAN_NAMES}
    hours = {name: sum(p.program.duration_s for p in plans[name]) / 3600.0 for name in plans}
    expected = {
        'chamber-18': 171.0, 'chamber-9': 27.0, 'tumble': 6.0, 'tumble-3': 15.0, 'tumble-1': 9.0,
        'held-out': 3 * 26220 / 3600, 'centrifuge': 45.0, 'rate-table': 45.0,
    }  # fmt: skip
    assert hours == pytest.approx(expected, rel=1e-2)
    ups = {name: np.array([p.up for p in stations]) for name, stations in plans.items()}
    for name, up in ups.items():
        np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0)
        assert np.any(up != np.array([p.up for p in plan(name, 2)]))
    # The chamber positions of plan tumble-3 vary the force on each axis by more than 0.5 g.
    assert np.ptp(ups['tumble-3'][18:], axis=0).min() > 0.5
    assert (ups['held-out'] @ ups['chamber-18'].T).max() < 0.999


def test_the_effect_of_heat_flow_is_even_and_may_saturate_and_creep_decays():
    up = np.stack([np.linspace(0, 3, 50), np.zeros(50)], axis=1)
    effect = FlowEffect('a', 'b', 1.25, bias=(1.0, 0.0, 0.0))
    warm, cold = (effect.change(_history(sign * up))[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(warm, cold)
    assert (warm[-1, 0], warm[0, 0]) == (pytest.approx(3.0**1.25), 0.0)
    up = np.stack([np.array([0.0, 0.5, 50.0]), np.full(3, 2.0)], axis=1)
    up[:, 0] += 2.0
    bias, _ = FlowEffect('a', 'b', 2.0, 0.5, True, 1, bias=(1.0, 0.0, 0.0)).change(_history(up))
    np.testing.assert_allclose(bias[:, 0], [0.0, 1.0, 2.0], atol=1e-3)
    step = np.full((7201, 1), 10.0)
    step[0] = 0.0
    history = PartHistory(('case',), step, np.zeros(1), 1.0)
    bias, scale = CreepEffect('case', 7200.0, bias=(1.0, 2.0, 0.0)).change(history)
    # The tolerance is a step of 1 s divided by the time constant.
    np.testing.assert_allclose(bias[-1], np.array([10.0, 20.0, 0.0]) * math.exp(-1.0), atol=2e-3)
    np.testing.assert_array_equal(scale, 0.0)


def test_a_switched_load_warms_its_part_by_the_steady_heat_balance():
    unit = triad('own-lags', 1)
    spell, rates = 30_000.0, {'rate_hz': 0.1, 'temperature_rate_hz': 0.01}
    loaded = replace(unit, load=SwitchedLoad('board', 0.5, (spell, 1.0001 * spell)))
    given = parse_cyclogram('20 16h'), STATION.up
    on, off = (simulate(model, *given, **rates).truth for model in (loaded, unit))
    warmer = of_part(on, 'board') - of_part(off, 'board')
    np.testing.assert_allclose(warmer[: int(spell)], 0.0, atol=1e-9)
    # The 0.5 W of the load flow through 0.4 W/K to the case, and from the case to the air.
    to_air = next(link.conductance for link in unit.network.links if link.a == 'air')
    assert warmer[-1] == pytest.approx(0.5 / 0.4 + 0.5 / to_air, rel=1e-6)


def test_a_chamber_program_is_read_from_text():
    program = parse_cyclogram('20 30min, 35@0.5 1h; -5.5@1.5\n-5.5 90s, 20')
    np.testing.assert_allclose(program.temperature_c, [20, 20, 35, 35, -5.5, -5.5, 20])
    steps_s = [1800, 30 * 60, 3600, 40.5 / 1.5 * 60, 90, 25.5 / 1.5 * 60]
    np.testing.assert_allclose(np.diff(program.time_s), steps_s)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('20, 35@', "step 2 '35@' must read TARGET"),
        *((f'20, {step}', f"step 2 '{step}' must read")
          for step in ('30@0 5min', '30@0.00 5min', '30 5')),
        *((step, f"step 1 '{step}' must read") for step in ('20@1', 'nan', 'oven')),
        *((' ,\n', 'cyclogram is empty'), ('20', 'a ramp or a soak')),
        (f'20, {"9" * 400}', 'finite numbers'),
    ],
)  # fmt: skip
def test_a_wrong_chamber_program_is_refused_with_the_step(text, message):
    with pytest.raises(ValueError, match=message):
        parse_cyclogram(text)


NAMES = (*UNIT_NAMES, *TRIAD_NAMES)


def _static(unit, board):
    network, still = unit.network, []
    for temperature in board:
        parts = network.equilibrium(network.air_for('board', float(temperature)))
        history = PartHistory(network.nodes, (parts - unit.origin)[None], unit.origin, 1.0)
        still.append(drift_of(unit.drift, history))
    return map(np.concatenate, zip(*still, strict=True))


@pytest.mark.parametrize('name', NAMES)
def test_units_of_equal_seeds_are_equal_and_start_at_the_reference_temperature(name):
    unit = unit_of(name, 3)
    bias, scale = _static(unit, np.array([20.0]))
    np.testing.assert_allclose(bias, 0.0, atol=1e-9)
    np.testing.assert_allclose(scale, 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.triu(unit.M, 1), 0.0)
    np.testing.assert_array_equal(np.diag(unit.M), 1.0)
    assert unit_of(name, 3) == unit != unit_of(name, 2)
    assert unit.serial == f'{name}-0003'


@pytest.mark.parametrize('seed', range(8))
def test_the_presets_bare_quartz_and_mems_have_the_published_slopes(seed):
    # Published scale slopes of Q-Flex are 68 ppm/K at 5 degC and 87 ppm/K at 35 degC. Bias slopes
    # are 0.3 to 5 ug/K for Q-Flex, 90 to 550 ug/K for a MEMS.
    unit = unit_preset('bare-quartz', seed)
    bias, scale = _static(unit, np.array([4.5, 5.5, 19.5, 20.0, 20.5, 34.5, 35.5]))
    cold, hot = (scale[1] - scale[0]) * 1e6, (scale[6] - scale[5]) * 1e6
    # The slopes of simulated units differ by 1 % (1 sd) from the published slopes.
    np.testing.assert_allclose(cold, 68.0, atol=1.5)
    np.testing.assert_allclose(hot, 87.0, atol=1.5)
    curvature = 2.0 * (scale[4] + scale[2] - 2.0 * scale[3]) * 1e6
    np.testing.assert_allclose(curvature, 0.31, rtol=0.03)
    slope = np.abs(bias[4] - bias[2])
    assert np.all((slope > 0.29) & (slope < 5.05))
    bias, _ = _static(unit_preset('mems', seed), np.array([19.5, 20.5]))
    slope = np.abs(bias[1] - bias[0])
    assert np.all((slope > 90.0) & (slope < 550.0))


def test_the_converter_is_exact_to_one_count_a_day_and_saturates_at_16_bits():
    """In each of 8.8 million cycles the charge is a third of a count above a whole number."""
    charge = np.full((400_000, 1), 2978.0 + 1.0 / 3.0)
    remainder = np.zeros(1, dtype=np.int64)
    total, n_cycles = 0, 0
    for _ in range(22):  # 24 h at 100 Hz are 8.64 million cycles
        counts, remainder = balanced(charge, remainder)
        total += int(counts.sum())
        n_cycles += len(counts)
    exact = n_cycles * Fraction(8935, 3)
    # In 8.8e6 cycles roundings of the charge to 2^-40 counts add up to 8e-6 counts.
    assert abs(total - exact) < 1 + 1e-4
    charge = np.array([[4e4, -4e4, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    counts, _ = balanced(charge, np.zeros(3, dtype=np.int64))
    np.testing.assert_array_equal(counts, [[32767, -32768, 0], [0, 0, 1], [1, 1, 0]])
    counts, _ = rounded(np.full((5, 3), 10.4), first_charge(0))
    np.testing.assert_array_equal(counts, 10)
