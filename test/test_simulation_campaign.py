# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated chamber programs, test plans, units and ADC agree with their description."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from accuracy import corrected_by_truth
from simulation_helpers import of_part
from triads import TRIAD_NAMES, triad, unit_of

from thermo_comp.simulation.campaign import PLAN_NAMES, Position, parse_cyclogram, plan
from thermo_comp.simulation.drift import FlowEffect, PartHistory, drift_of
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset
from thermo_comp.simulation.run import arrays, simulate
from thermo_comp.simulation.unit import SwitchedLoad, balanced, first_charge, rounded
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

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
        # In 7.3 h the random walk has a mean square of 9 * 7.3 / 2 ug^2 per axis; three runs
        # determine the RMS to a factor of two.
        assert 4.0 < vector < 20.0
    else:
        # The RMS of 1311 means is uncertain by 2 % (|f|) and 1.2 % (vector); limits: 5 sd.
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
    # Between the chamber positions of plan tumble-3 the force on each axis varies by over 0.5 g.
    assert np.ptp(ups['tumble-3'][18:], axis=0).min() > 0.5
    assert (ups['held-out'] @ ups['chamber-18'].T).max() < 0.999


def test_the_effect_of_heat_flow_is_even_and_zero_at_rest_and_may_saturate():
    up = np.stack([np.linspace(0, 3, 50), np.zeros(50)], axis=1)
    effect = FlowEffect('a', 'b', 1.25, bias=(1.0, 0.0, 0.0))
    warm, cold = (effect.change(_history(sign * up))[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(warm, cold)
    assert warm[-1, 0] == pytest.approx(3.0**1.25)
    assert warm[0, 0] == 0.0
    up = np.stack([np.array([0.0, 0.5, 50.0]), np.full(3, 2.0)], axis=1)
    up[:, 0] += 2.0
    effect = FlowEffect('a', 'b', 2.0, 0.5, True, 1, bias=(1.0, 0.0, 0.0))
    bias, _ = effect.change(_history(up))
    np.testing.assert_allclose(bias[:, 0], [0.0, 1.0, 2.0], atol=1e-3)


def test_a_switched_load_warms_its_part_by_the_steady_heat_balance():
    """A load that is off warms nothing; a lasting load warms by power * thermal resistance."""
    unit = triad('own-lags', 1)
    spell, rates = 30_000.0, {'rate_hz': 0.1, 'temperature_rate_hz': 0.01}
    loaded = replace(unit, load=SwitchedLoad('board', 0.5, (spell, 1.0001 * spell)))
    given = parse_cyclogram('20 16h'), STATION.up
    on, off = (simulate(model, *given, **rates).truth for model in (loaded, unit))
    warmer = of_part(on, 'board') - of_part(off, 'board')
    np.testing.assert_allclose(warmer[: int(spell)], 0.0, atol=1e-9)
    # The load of 0.5 W flows through 0.4 W/K to the case, and from there to the air.
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
    """
    Q-Flex: scale slope 68 ppm/K at 5 degC, 87 ppm/K at 35 degC; bias slope 0.3 to 5 ug/K. MEMS:
    bias slope 90 to 550 ug/K.
    """
    unit = unit_preset('bare-quartz', seed)
    board = np.array([4.5, 5.5, 19.5, 20.0, 20.5, 34.5, 35.5])
    bias, scale = _static(unit, board)
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


def test_the_sum_of_counts_of_a_day_at_100_hz_is_exact_to_one_count():
    """The charge is a third of a count above a whole number in each of 8.8 million cycles."""
    charge = np.full((400_000, 1), 2978.0 + 1.0 / 3.0)
    remainder = np.zeros(1, dtype=np.int64)
    total, n_cycles = 0, 0
    for _ in range(22):  # 24 h at 100 Hz are 8.64 million cycles
        counts, remainder = balanced(charge, remainder)
        total += int(counts.sum())
        n_cycles += len(counts)
    exact = n_cycles * Fraction(8935, 3)
    # Rounding the charge to 2^-40 counts in each of 8.8e6 cycles adds up to 8e-6 counts.
    assert abs(total - exact) < 1 + 1e-4


def test_the_converter_saturates_at_16_bits_and_may_round_each_cycle_separately():
    charge = np.array([[4e4, -4e4, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    counts, _ = balanced(charge, np.zeros(3, dtype=np.int64))
    np.testing.assert_array_equal(counts, [[32767, -32768, 0], [0, 0, 1], [1, 1, 0]])
    charge = np.full((5, 3), 10.4)
    counts, _ = rounded(charge, first_charge(0))
    np.testing.assert_array_equal(counts, 10)
