# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Corrections of blocks and of single samples have equal bits, and their claimed sd is right."""

import math
from dataclasses import replace

import builders
import numpy as np
import pytest
from builders import term
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from thermo_comp.online.compensator import Compensator
from thermo_comp.thermal.lags import start_covariance
from thermo_comp.thermal.state import RATE, StateLayout
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.unit.calibration import ResponseTerm, parameter_layout
from thermo_comp.unit.columns import bank
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.covariance import CovarianceMap, covariance_at
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.prediction import SlowUncertainty

SENSORS = ('case', 'tip')


def full_bank(rng, size=1.0, axes=(0, 1, 2), posterior=False):
    """Draw a unit with random weights of all columns for a board and two further thermometers."""
    terms = []
    for column in bank(SENSORS):
        # At the edge of its range a column adds some counts of bias and 1e-4 of scale.
        sd = 10.0**-column.power * size
        bias, scale = np.zeros(3), np.zeros(3)
        bias[list(axes)] = 0.05 * sd * rng.standard_normal(len(axes))
        scale[list(axes)] = 1e-6 * sd * rng.standard_normal(len(axes))
        keys = {
            name: getattr(column, name)
            for name in ('group', 'kind', 'sensor', 'tau_s', 'width_k', 'power', 'during')
        }
        edge = 1.0 if column.kind == 'gradient_even' else 4.0 + 4.0 * rng.random()
        weights = {'bias': tuple(bias.tolist()), 'scale': tuple(scale.tolist())}
        terms.append(ResponseTerm(**keys, range=(-edge, edge), **weights))
    static = builders.axis_set((0.0, 0.3, 1e-3), (1.0, 7e-5), residual_sd_m_s2=1e-5)
    two = builders.axis_set((0.0, 0.3, 2e-3), (1.0, 6e-5), delta=0.05)
    unit = builders.calibration(
        static=builders.regime_set(static, static, static),
        dynamic=builders.regime_set(two, two, two),
        sensors=SENSORS,
        response=tuple(terms),
    )
    if not posterior:
        return unit
    n = parameter_layout(unit).n_parameters
    root = rng.standard_normal((n, 7)) * 1e-4
    return replace(unit, posterior=posterior_of(root @ root.T + 1e-10 * np.eye(n)))


def run_of(rng, seconds=240, rate=4, swing_k=12.0):
    """Make messages in order: samples, and three thermometers with jitter and lost readings."""
    events = []
    for k in range(seconds * rate):
        stamp = k * builders.SECOND_NS // rate + int(rng.integers(0, 1_000_000))
        if k % rate == 0:
            wave = swing_k * math.sin(k / rate / 150.0)
            for name, ahead in (('board', 0.0), ('case', 3.0), ('tip', -1.0)):
                if rng.random() > 0.1 and not (name == 'tip' and 60 < k / rate < 160):
                    late = int(rng.integers(-30_000_000, 2_000_000))
                    celsius = 22.0 + wave * (1.0 + 0.1 * ahead) + ahead
                    noise = 0.005 * rng.standard_normal()
                    events.append((name, max(stamp + late, 0), celsius + noise))
        events.append(('accel', stamp, (rng.normal(0, 900), rng.normal(0, 900), 2900.0)))
    return events


@given(st.integers(0, 2**32 - 1), st.integers(40, 900))
@settings(max_examples=3, deadline=None, phases=[Phase.generate])
def test_blocks_corrected_with_all_columns_have_the_bits_of_single_samples(seed, chunk):
    rng = np.random.default_rng(seed)
    unit = full_bank(rng, posterior=True)
    # Temperatures leave the range (5 to 35 degC) and its continuation (-2.5 to 42.5 degC).
    events = run_of(rng, seconds=30, swing_k=150.0)
    assert max(value for kind, _, value in events if kind == 'board') > 45.0
    rows, _, _ = builders.assert_equal_bits(unit, builders.UNCHECKED, events, chunk)
    assert len(rows) > 110


def test_columns_of_the_x_axis_do_not_change_the_output_of_y_and_z(rng):
    events = run_of(rng)
    plain, _ = builders.stream(Compensator(full_bank(rng, axes=()), builders.UNCHECKED), events)
    moved, _ = builders.stream(Compensator(full_bank(rng, axes=(0,)), builders.UNCHECKED), events)
    assert (moved[:, 0] != plain[:, 0]).all()
    for column in (1, 2, 6, 7, 8):
        np.testing.assert_array_equal(moved[:, column], plain[:, column])


def states_of(unit, rng, n=5):
    """Return stamp, thermal state and remaining shares of initial lag states at n times."""
    tracker = ThermalTracker(unit.detector, Correction(unit).memory)
    collected = []
    for k, (kind, stamp, value) in enumerate(run_of(rng, seconds=1200, rate=1)):
        if kind != 'accel':
            tracker.read(kind, stamp, value)
        if k % (4800 // n) == 4799 // n:
            shares = tracker.memory.remaining_shares(stamp)
            collected.append((stamp, tracker.sample(stamp), shares))
    return collected


@pytest.mark.slow
def test_corrections_drawn_from_the_posterior_scatter_by_the_claimed_sd(rng):
    unit = replace(full_bank(rng), noise_density_m_s2_sqrt_hz=(1e-4,) * 3)
    layout = parameter_layout(unit)
    n = layout.n_parameters
    sd = np.full(n, 1e-3)
    for block in layout.scale:
        sd[block.static : block.end] = 1e-6
    sd[layout.misalignment :] = 2e-6
    root = rng.standard_normal((n, 5)) * sd[:, np.newaxis]
    posterior = posterior_of(root @ root.T + np.diag(0.3 * sd**2))
    judged = replace(unit, posterior=posterior)
    states = states_of(unit, rng)
    slow = SlowUncertainty(judged, Correction(judged))
    no_shares = np.zeros((len(Correction(unit).memory.lags), 2))
    draws = rng.multivariate_normal(np.zeros(n), posterior.covariance(), size=300)
    weights = np.array([0.0, 0.3])
    pair = np.repeat(np.array([states[-1][1]]), 2, axis=0).T
    pair[3] = weights
    nominal = Correction(unit).bias_scale(pair)
    scatter = []
    for d in draws.tolist():
        moved = (Correction(builders.drawn(unit, layout, d)).bias_scale(pair) - nominal) / 300.0
        for axis, block in enumerate(layout.scale):
            moved[1, axis] += (1.0 - weights) * d[block.static] + weights * d[block.dynamic]
        scatter.append(moved)
    scatter = np.array(scatter)
    tilted = np.zeros((len(draws), 3, 3))
    tilted[:, [1, 2, 2], [0, 0, 1]] = draws[:, layout.misalignment :]
    M = np.array([[1.0, 0.0, 0.0], [0.1, 1.0, 0.0], [-0.2, 0.15, 1.0]])
    elements = CovarianceMap((0.1, -0.2, 0.15))
    rows = slow.at(pair, no_shares)
    each = zip(elements.coefficients(rows).T.tolist(), rows[:9].T.reshape(2, 3, 3), strict=True)
    for k, (coefficients, parts) in enumerate(each):
        for axis, (a, b, c) in enumerate(parts):
            for x in (-9.8, 0.0, 9.8):
                variance = np.var(scatter[:, 0, axis, k] + scatter[:, 1, axis, k] * x)
                # The variance of n draws is uncertain by sqrt(2 / n) = 8 %; tolerance: 4 * 8 %.
                assert a + b * x + c * x * x == pytest.approx(variance, rel=0.33)
        for force in rng.uniform(-9.8, 9.8, (5, 3)):
            along = -scatter[:, 0, :, k] - scatter[:, 1, :, k] * force
            errors = along @ M.T + tilted @ force
            expected = np.cov(errors.T)
            claimed = np.zeros((3, 3))
            claimed[np.triu_indices(3)] = covariance_at(coefficients, *force.tolist())
            claimed += np.triu(claimed, 1).T
            # The covariance of n draws is uncertain by at most 8 % of the product of both sd.
            sds = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            assert (np.abs(claimed - expected) < 0.33 * sds).all()
            # Claimed and drawn variances agree in any direction, so correlations agree, too.
            root = np.linalg.inv(np.linalg.cholesky(expected))
            assert np.abs(root @ claimed @ root.T - np.eye(3)).max() < 0.5


def test_corrections_with_random_initial_lag_states_scatter_by_the_claimed_sd(rng):
    unit = full_bank(rng)
    correction = Correction(unit)
    lags = correction.memory.lags
    _, state, shares = states_of(unit, rng)[0]
    state = (*state[:RATE], 0.0, *state[RATE + 1 :])
    column, of_start = np.array([state]).T, np.array([shares]).T
    slow = SlowUncertainty(unit, correction).at(column, of_start)
    layout = StateLayout(correction.memory)
    places = [layout.places[lag] for lag in layout.lags]
    draws = rng.multivariate_normal(np.zeros(len(lags)), start_covariance(lags), size=4000)
    moved = np.repeat(np.array(state)[:, np.newaxis], len(draws), axis=1)
    terms = tuple(replace(term, range=(-4000.0, 4000.0)) for term in unit.response)
    wide = replace(unit, response=terms)
    # Columns with squares of lags are nonlinear, so draw initial lag states with 0.05 of their sd.
    small = 0.05
    moved[places] += small * (draws * np.array(shares)).T
    values = Correction(wide).bias_scale(moved)
    for axis, (a, b, c) in enumerate(np.reshape(slow[:9], (3, 3))):
        bias, scale = values[:, axis]
        for x in (-9.8, 0.0, 9.8):
            expected = np.var(bias / 300.0 + scale / 300.0 * x) / small**2
            # The variance of 4000 draws is uncertain by 2.2 %; the tolerance is 4 * 2.2 %.
            assert a + b * x + c * x * x == pytest.approx(expected, rel=0.09)


def test_a_lost_thermometer_increases_the_variance_and_an_unknown_one_has_no_effect(rng):
    of_tip = term('gradient', (30.0, 0.0, 0.0), sensor='tip')
    unit = builders.calibration(sensors=SENSORS, response=(of_tip,))
    compensator = Compensator(unit, builders.UNCHECKED)
    variances = []
    for k in range(200):
        for name in ('board', 'case', 'tip') if k < 100 else ('board', 'case'):
            compensator.push(name, k * builders.SECOND_NS, 20.0 + 0.02 * k + (name == 'tip'))
        variances.append(compensator.process(k * builders.SECOND_NS, 0.0, 0.0, 1.0)[3])
    assert variances[-1] > variances[99] + (0.3 * 900.0 * 0.02 * 30.0 / 300.0) ** 2
    events = [('lid', stamp, 99.0) for _, stamp, _ in run_of(rng, seconds=20)]
    known = run_of(rng, seconds=20)
    both = [event for pair in zip(known, events, strict=False) for event in pair]
    unit = builders.rich_calibration()
    np.testing.assert_array_equal(
        builders.stream(Compensator(unit, builders.UNCHECKED), known)[0],
        builders.stream(Compensator(unit, builders.UNCHECKED), both)[0],
    )


def test_a_new_calibration_with_equal_lags_keeps_the_lag_states(rng):
    unit = full_bank(rng)
    events = run_of(rng, seconds=60)
    compensator = Compensator(unit, builders.UNCHECKED)
    builders.stream(compensator, events)
    tracker = compensator.thermal.tracker
    compensator.swap(replace(unit, response=full_bank(rng).response))
    assert compensator.thermal.tracker.memory is tracker.memory
    compensator.swap(replace(unit, response=unit.response[:5]))
    assert compensator.thermal.tracker.memory is not tracker.memory
    assert compensator.thermal.tracker.board.stamp_ns == tracker.board.stamp_ns
    assert compensator.process(61 * builders.SECOND_NS, 0.0, 0.0, 2900.0) is not None
