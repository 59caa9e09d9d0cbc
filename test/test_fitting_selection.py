# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choice of the model, sets and ranges of a calibration, verdict: on tables of known truth.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitting_truth import GRAVITY, Truth, history, table_of, without_memory

from thermo_comp.errors import FitError
from thermo_comp.fitting.assembly import UnitFacts, build_calibration
from thermo_comp.fitting.evidence import (
    corrected,
    inflation,
    reference_constants,
    residual_rows,
    slow_error,
)
from thermo_comp.fitting.ladder import function_shape, golovach_spec, model_spec
from thermo_comp.fitting.model import ModelSpec, normalised, polynomial
from thermo_comp.fitting.regression import Freedom, regress
from thermo_comp.fitting.selection import (
    N_FOLDS,
    Selector,
    fit_model,
    fold_numbers,
)
from thermo_comp.fitting.solution import regressors
from thermo_comp.fitting.start import constant_calibration, position_means
from thermo_comp.fitting.table import WindowTable
from thermo_comp.fitting.uncertainty import full_covariance, predicted_sd
from thermo_comp.fitting.warm_up import find_warm_up
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.functions import CubicSpline, Exponential


def selector_of(table: WindowTable) -> Selector:
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    freedom = Freedom(time_constant_range_s=(60.0, 6000.0))
    return Selector(table, GRAVITY, constant, freedom, lambda _name: None)


def test_memory_is_found_where_there_is_memory(rng: np.random.Generator) -> None:
    table, _ = table_of(replace(Truth(), noise_sd=0.002), 9, rng, window_s=200.0)
    selector = selector_of(table)
    assert selector.choose() == 'quadratic+memory2'
    found = selector.try_model(model_spec('quadratic+memory2', table)).outcome.solution
    # Lags of 400 and 2500 s from noisy windows: to some per cent.
    np.testing.assert_allclose(found.time_constants_s, [400.0, 2500.0], rtol=0.1)
    listed = {candidate.name: candidate for candidate in selector.table_of('quadratic+memory2')}
    assert listed['quadratic+memory2'].is_chosen
    # Without memory the ramps' errors stay: held out many times worse.
    assert listed['quadratic'].held_out_rms > 5.0 * listed['quadratic+memory2'].held_out_rms
    assert listed['quadratic+memory2'].bic < listed['quadratic'].bic
    assert 'golovach' in listed


@pytest.mark.parametrize(('power', 'expected'), [(0, 'constant'), (1, 'linear'), (2, 'quadratic')])
def test_the_simplest_that_does_is_taken(
    power: int, expected: str, rng: np.random.Generator
) -> None:
    kept = np.arange(1, 3) <= power
    truth = without_memory(Truth())
    truth = replace(
        truth, bias_curve=truth.bias_curve * kept, scale_curve=truth.scale_curve * kept
    )
    table, _ = table_of(truth, 9, rng, window_s=300.0)
    assert selector_of(table).choose() == expected


def test_folds_are_whole_stretches_and_spare_the_first(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 6, rng, window_s=60.0)
    folds = fold_numbers(table)
    assert set(folds) <= {-1, *range(N_FOLDS)}
    for bag in range(6):
        rows = table.bag == bag
        for section in np.unique(table.section[rows]):
            assert len(set(folds[rows & (table.section == section)])) == 1
        assert (folds[rows][table.section[rows] == 0] == -1).all()


def test_sections_follow_the_program() -> None:
    thermal = history()
    sections = thermal.sections()
    # The program: soak, up, soak, down, soak, up. The reversal of a ramp is a border within two
    # minutes of its own window and the case's none.
    for border_s in (1200.0, 3000.0, 5400.0, 9000.0, 11400.0):
        near = np.abs(thermal.time - border_s) < 180.0
        assert len(set(sections[near])) == 2, border_s
    assert (np.diff(sections) >= 0).all()


@pytest.mark.parametrize('name', ['quartic', 'linear+magic', 'linear@static', 'linear+memory3'])
def test_unknown_models_are_refused(name: str, rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 6, rng, window_s=600.0)
    with pytest.raises(FitError, match='is not known: give auto, golovach'):
        model_spec(name, table)


@pytest.mark.parametrize(
    'name',
    ['golovach', 'cubic+gradient+memory1', 'spline+rate', 'linear+gradient@dynamic',
     'exponential+memory2'],
)  # fmt: skip
def test_sets_say_what_the_model_says(name: str, rng: np.random.Generator) -> None:
    # The calibration's two sets, blended by hand with the flag's weight, must give the bias and
    # the scale that the regression's columns give, for any parameters.
    table, _ = table_of(Truth(), 3, rng, window_s=300.0, thermal=history(step_s=10.0))
    table = replace(table, weight=rng.uniform(0.0, 1.0, len(table.weight)))
    spec = model_spec(name, table)
    tau = np.array([300.0, 2000.0])[: spec.n_lags]
    columns = regressors(table, spec, tau, np.zeros((3, spec.n_lags)))
    bias = rng.normal(size=spec.n_columns('bias')) * 1e-2
    scale = 1000.0 * np.concatenate(([1.0], rng.normal(size=spec.n_columns('scale') - 1) * 1e-5))
    memory = table.memory(tau).value
    sets = [spec.axis_set(regime, bias, scale, None, 0.0) for regime in ('static', 'dynamic')]
    parts = []
    for one in sets:
        terms = [table.gradient, table.rate, *memory.T]
        on_bias = [one.gradient.bias, one.rate.bias, *one.memory.bias]
        on_scale = [one.gradient.scale, one.rate.scale, *one.memory.scale]
        parts.append(
            (
                bias[0] + one.delta + one.bias_function.value(table.t)
                + sum(c * x for c, x in zip(on_bias, terms, strict=True)),
                1000.0 * (one.scale_function.value(table.t)
                + sum(c * x for c, x in zip(on_scale, terms, strict=True))),
            )
        )  # fmt: skip
    w = table.weight
    for number, expected in enumerate((columns.bias @ bias, columns.scale @ scale)):
        blended = (1.0 - w) * parts[0][number] + w * parts[1][number]
        # The same sums in another order.
        np.testing.assert_allclose(blended, expected, rtol=1e-11, atol=1e-11)


def test_covariance_of_a_set_is_that_of_its_parameters(rng: np.random.Generator) -> None:
    spec = golovach_spec()
    n = spec.n_columns('bias') + spec.n_columns('scale')
    root = rng.normal(size=(n, n)) * 1e-3
    covariance = root @ root.T
    dynamic = spec.axis_set('dynamic', np.zeros(spec.n_columns('bias')),
                            np.eye(1, spec.n_columns('scale'))[0], covariance, 0.0)  # fmt: skip
    # Columns: level, static slope, delta, dynamic t and t^2, then the scale's.
    level = covariance[0, 0] + covariance[2, 2] + 2.0 * covariance[0, 2]
    assert dynamic.covariance[0][0] == pytest.approx(level, rel=1e-12)
    assert dynamic.covariance[1][1] == pytest.approx(covariance[3, 3], rel=1e-12)
    # Gradient and rate are not in this model: no variance.
    assert dynamic.covariance[3][3] == dynamic.covariance[4][4] == 0.0


def test_shapes_hold_the_reference() -> None:
    spline = CubicSpline((-10.0, 0.0, 15.0), (0.0, 0.0, 0.0))
    for shape in (spline, Exponential(0.0, (0.0,), (15.0,)), polynomial(2)):
        for at_reference in (0.0, 1.0):
            free = np.arange(1.0, 1.0 + shape.n_free)
            found = normalised(shape, free, at_reference)
            assert found.value(0.0) == pytest.approx(at_reference, abs=1e-12)
            change = sum(f * b for f, b in zip(free, shape.basis(7.0), strict=True))
            assert found.value(7.0) == pytest.approx(at_reference + change, rel=1e-12)


def test_a_spline_has_the_reference_among_its_knots(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 3, rng, window_s=300.0, thermal=history(step_s=10.0))
    assert 0.0 in function_shape('spline', table).knots_k
    above = replace(table, t=table.t - table.t.min() + 5.0)
    assert function_shape('spline', above).knots_k[0] == 0.0


def test_slow_error_is_told_from_noise(rng: np.random.Generator) -> None:
    truth = without_memory(Truth())
    table, _ = table_of(truth, 12, rng, window_s=30.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    outcome = fit_model(table, ModelSpec('q', polynomial(2)), GRAVITY, constant, Freedom())
    noise = truth.noise_sd / 1000.0
    # White noise alone: the split leaves a tenth of it at most, from 5000 windows.
    assert slow_error(table, outcome).max() < 0.15 * noise
    # White residuals need no inflation; 13 blocks a position give it to 15 %.
    assert inflation(table, outcome).max() < 1.3
    wave = 2.0 * truth.noise_sd * np.sin(table.time / 500.0)
    slow = replace(outcome, residual=outcome.residual + wave[:, None])
    np.testing.assert_allclose(slow_error(table, slow), 2.0 * noise / np.sqrt(2.0), rtol=0.15)
    assert inflation(table, slow).min() > 5.0


def test_constants_are_those_of_still_air(rng: np.random.Generator) -> None:
    # A board that heats itself is 2 K above the case in still air. A gradient model puts part of
    # the level into the gradient's coefficient; the constants that are reported do not care.
    thermal = history()
    thermal = replace(thermal, gradient=thermal.gradient - 2.0)
    truth = without_memory(Truth())
    table, _ = table_of(truth, 12, rng, window_s=120.0, thermal=thermal)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    spec = model_spec('quadratic+gradient', table)
    found = fit_model(table, spec, GRAVITY, constant, Freedom()).solution
    bias, scale = reference_constants(table, found)
    # Five times the claimed sd of some 1e-3 counts and 1e-4 counts per m/s^2.
    np.testing.assert_allclose(bias, truth.bias, atol=5e-3)
    np.testing.assert_allclose(scale, truth.scale, atol=5e-4)


def test_residuals_fall_from_raw_to_fitted(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 12, rng, window_s=60.0)
    selector = selector_of(table)
    fitted = selector.try_model(model_spec('quadratic+memory2', table)).outcome.solution
    one_set = selector.try_model(model_spec('quadratic', table)).outcome.solution
    for row in residual_rows(table, fitted, one_set):
        assert row.fitted.rms < row.one_set.rms < row.raw.rms
    # What is left is the noise of one axis: 0.01 counts of 1000 per m/s^2.
    assert residual_rows(table, fitted, one_set)[2].fitted.rms == pytest.approx(1e-5, rel=0.05)
    force = corrected(table, fitted)
    assert force.shape == table.mean.shape


def settling(table: WindowTable, size: float, *tau_s: float) -> WindowTable:
    """
    Add what warming-up adds: per axis another size, per bag another start.

    """
    signs = np.array([1.0, -0.6, 0.8])
    starts = size * (1.0 + 0.1 * np.sin(table.bag))
    decay = sum(np.exp(-table.time / tau) for tau in tau_s)
    return replace(table, mean=table.mean + (starts * decay)[:, None] * signs)


def test_warming_up_is_found_and_taken_out(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=60.0)
    # 3000 ug that die with 25 minutes, and at first with 4 minutes, too.
    warming = settling(table, 30.0, 1500.0, 240.0)
    constant = constant_calibration(position_means(warming), GRAVITY, with_misalignment=True)
    freedom = Freedom(time_constant_range_s=(60.0, 6000.0))
    found = find_warm_up(warming, GRAVITY, constant, freedom)
    assert found is not None
    # The slow exponential is known once the fast one has died and is left out.
    assert found.time_constant_s == pytest.approx(1500.0, rel=0.1)
    assert 600.0 <= found.cut_s <= 3600.0
    assert 'switch on 2.' in found.finding().message
    kept = warming.select(warming.time >= found.cut_s).renumbered()
    spec = model_spec('quadratic+memory2', kept)
    outcome = fit_model(kept, spec, GRAVITY, constant, freedom, transient_s=found.time_constant_s)
    # 3000 ppm of warming-up leave a few ppm; the residuals are the noise of 0.01 counts.
    np.testing.assert_allclose(outcome.solution.scale[:, 0], Truth().scale, rtol=1e-5)
    assert outcome.residual.std() < 0.0115


def test_a_settled_unit_is_not_warming_up(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=120.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    freedom = Freedom(time_constant_range_s=(60.0, 6000.0))
    assert find_warm_up(table, GRAVITY, constant, freedom) is None


def test_positions_that_were_left_out_leave_no_gap(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 4, rng, window_s=600.0, thermal=history(step_s=20.0))
    kept = table.select(table.position != 1).renumbered()
    assert kept.n_positions == 3
    assert len(position_means(kept)) == 3


def test_linear_terms_reach_further_than_the_curve(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=300.0)
    for name, reach in (('quadratic', 1.0), ('quadratic+memory2', 2.0)):
        outcome = selector_of(table).try_model(model_spec(name, table)).outcome
        calibration = build_calibration(
            outcome, table, [], DetectorSettings(),
            UnitFacts(Unit('7', 'counts', 32767.0, 0.01), np.ones(3), 900.0, np.zeros((2, 3))),
            20.0,
        )  # fmt: skip
        fastest = float(np.max(table.rate)) * 60.0
        assert calibration.static.rate_range_k_min[1] == pytest.approx(reach * fastest, rel=0.06)
        edges = np.array(calibration.static.temperature_range_c) - 20.0
        # Two per cent of the span on either side.
        np.testing.assert_allclose(edges, [table.t.min(), table.t.max()], atol=0.6)


def test_a_misalignment_that_was_not_measured_is_not_claimed(rng: np.random.Generator) -> None:
    table, _ = table_of(replace(Truth(), skew=np.zeros(3)), 9, rng, window_s=300.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=False)
    spec = model_spec('quadratic', table)
    outcome = fit_model(table, spec, GRAVITY, constant, Freedom(misalignment=False))
    facts = UnitFacts(Unit('7', 'counts', 32767.0, 0.01), np.ones(3), 900.0, np.zeros((2, 3)))
    found = build_calibration(outcome, table, [], DetectorSettings(), facts, 20.0)
    assert found.misalignment == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert min(found.misalignment_sd) > 1e-3


def test_predicted_sd_is_the_scatter_over_drawn_parameters(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=300.0)
    outcome = selector_of(table).try_model(model_spec('quadratic+memory2', table)).outcome
    slow = np.full((2, 3), 3e-6)
    facts = UnitFacts(Unit('7', 'counts', 32767.0, 0.01), np.ones(3), 900.0, slow)
    calibration = build_calibration(outcome, table, [], DetectorSettings(), facts, 20.0)
    rate = 0.7 / 60.0
    found = predicted_sd(calibration, np.array([8.0, 33.0]), np.array([0.0, rate]))
    axis = calibration.dynamic.y
    covariance = full_covariance(axis)
    draws = rng.multivariate_normal(np.zeros(len(covariance)), covariance, 4000, tol=1e-6)
    tau = calibration.memory_time_constants_s
    for row, t in enumerate((-12.0, 13.0)):
        # Level, t, t^2, gradient and rate (not in this model), the two memories.
        bias = draws[:, 0] + draws[:, 1] * t + draws[:, 2] * t * t
        bias += (draws[:, 5] * tau[0] + draws[:, 6] * tau[1]) * rate
        scale = draws[:, 7] + draws[:, 8] * t + draws[:, 9] * t * t
        scale += (draws[:, 12] * tau[0] + draws[:, 13] * tau[1]) * rate
        spread = np.hypot(bias.std() / calibration.axes.y.scale_factor, 3e-6)
        # 4000 draws know a standard deviation to 1.1 %.
        assert found.bias[row, 1, 1] == pytest.approx(spread, rel=0.05)
        assert found.scale[row, 1, 1] == pytest.approx(scale.std(), rel=0.05)
    # In a ramp no less is unknown than in a soak, and the edges are known worse than the middle.
    assert (found.scale[:, 1] > found.scale[:, 0]).all()


def test_held_lags_stay(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=300.0)
    trial = selector_of(table).try_model(model_spec('quadratic+memory2', table))
    state = replace(trial.outcome.solution, time_constants_s=np.array([500.0, 2000.0]))
    again = regress(table, state, Freedom(lags=False)).solution
    np.testing.assert_array_equal(again.time_constants_s, [500.0, 2000.0])
