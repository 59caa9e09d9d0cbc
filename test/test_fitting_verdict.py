# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The verdict: each refusal and each advice, with its number, on tables made to deserve it.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitting_truth import GRAVITY, Truth, table_of, without_memory
from thermo_comp.fitting.model import ModelSpec, polynomial
from thermo_comp.fitting.regression import Freedom
from thermo_comp.fitting.selection import fit_model
from thermo_comp.fitting.table import WindowTable

from thermo_comp.errors import FitError
from thermo_comp.fitting import FitOptions
from thermo_comp.fitting.evidence import residual_rows, slow_error
from thermo_comp.fitting.start import constant_calibration, position_means
from thermo_comp.fitting.verdict import (
    Finding,
    can_tell_misalignment,
    distinct_directions,
    enforce,
    geometry,
    judge_result,
    judge_table,
)
from thermo_comp.simulation import positions
from thermo_comp.unit.gravity import MICRO_G


def findings_of(table: WindowTable, up: np.ndarray, **options: bool) -> dict[str, Finding]:
    wanted = {'with_misalignment': True, 'has_case': True, **options}
    return {finding.name: finding for finding in judge_table(table, up, **wanted)}


@pytest.fixture
def good(rng: np.random.Generator) -> tuple[WindowTable, np.ndarray]:
    return table_of(Truth(), 18, rng, window_s=300.0)


def test_a_good_test_passes(good: tuple[WindowTable, np.ndarray]) -> None:
    found = findings_of(*good)
    assert {finding.level for finding in found.values()} == {'good'}


def test_a_small_span_is_refused(good: tuple[WindowTable, np.ndarray]) -> None:
    table, up = good
    for factor, level in ((0.1, 'refusal'), (0.5, 'advice')):
        finding = findings_of(replace(table, t=factor * table.t), up)['span']
        assert finding.level == level
        assert 'need 10 (25 advised)' in finding.message


def test_no_ramp_and_one_direction_are_seen(good: tuple[WindowTable, np.ndarray]) -> None:
    table, up = good
    assert findings_of(replace(table, rate=0.0 * table.rate), up)['ramps'].level == 'refusal'
    heating = findings_of(replace(table, rate=np.abs(table.rate)), up)
    assert 'only heating was seen' in heating['directions'].message
    always = findings_of(replace(table, weight=np.ones_like(table.weight)), up)
    assert 'only 0 % of the windows are static' in always['soak'].message


def test_exchanged_sensors_are_seen(good: tuple[WindowTable, np.ndarray]) -> None:
    table, up = good
    finding = findings_of(replace(table, gradient=-table.gradient), up)['swapped']
    assert finding.level == 'refusal'
    assert 'are the two sensors exchanged?' in finding.message


def test_a_missing_case_is_said(good: tuple[WindowTable, np.ndarray]) -> None:
    assert findings_of(*good, has_case=False)['case'].level == 'advice'


def test_six_faces_tell_no_misalignment(good: tuple[WindowTable, np.ndarray]) -> None:
    table, _ = good
    faces = np.vstack((np.eye(3), -np.eye(3)))
    assert not can_tell_misalignment(faces)
    assert findings_of(table, faces)['misalignment'].level == 'refusal'
    assert findings_of(table, faces, with_misalignment=False)['positions'].level == 'advice'
    # The same face again, two degrees off, is no new position.
    tilted = faces + 0.03
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    assert len(distinct_directions(np.vstack((faces, tilted)))) == 6
    assert not can_tell_misalignment(np.vstack((faces, tilted)))


def test_too_few_and_badly_spread_positions_are_refused(
    good: tuple[WindowTable, np.ndarray],
) -> None:
    table, up = good
    assert '5 distinct positions, need 6' in findings_of(table, up[:5])['positions'].message
    flat = np.column_stack((np.cos(np.arange(12.0)), np.sin(np.arange(12.0)), np.zeros(12)))
    assert findings_of(table, flat)['geometry'].level == 'refusal'
    assert geometry(flat, with_misalignment=True) == np.inf


def test_geometry_is_the_scatter_of_the_parameters(rng: np.random.Generator) -> None:
    # By Monte Carlo: least squares of pure norm noise on the nine parameters.
    up = positions(12, 5)
    x, y, z = up.T
    jacobian = np.column_stack((x, y, z, x * x, y * y, z * z, x * y, x * z, y * z))
    noise = rng.standard_normal((4000, 12))
    scatter = (noise @ np.linalg.pinv(jacobian).T).std(axis=0).max()
    # 4000 draws know a standard deviation to 1.1 %.
    assert geometry(up, with_misalignment=True) == pytest.approx(scatter, rel=0.05)


def test_refusals_stop_and_may_be_allowed() -> None:
    refusal = Finding('span', 'refusal', 'temperature span 3.0 degC')
    with pytest.raises(
        FitError, match=r'temperature span 3.0 degC \(override with --allow span\)'
    ):
        enforce([refusal], FitOptions(gravity=9.81))
    (allowed,) = enforce([refusal], FitOptions(gravity=9.81, allow=('span',)))
    assert (allowed.level, allowed.message) == ('advice', 'allowed: temperature span 3.0 degC')


def test_a_drift_that_temperature_does_not_explain_is_said(rng: np.random.Generator) -> None:
    table, _ = table_of(without_memory(Truth()), 12, rng, window_s=60.0)
    # A jump of the sensor at half time, in every bag, upwards or downwards.
    jump = np.where(table.time > 6300.0, 5.0, 0.0) * (-1.0) ** table.bag
    jumped = replace(table, mean=table.mean + jump[:, None])
    constant = constant_calibration(position_means(jumped), GRAVITY, with_misalignment=True)
    spec = ModelSpec('quadratic', polynomial(2))
    outcome = fit_model(jumped, spec, GRAVITY, constant, Freedom())
    rows = residual_rows(jumped, outcome.solution, outcome.solution)
    options = FitOptions(gravity=GRAVITY)
    found = judge_result(outcome.solution, rows, slow_error(jumped, outcome), options)
    assert 'temperature does not explain' in next(f.message for f in found if f.name == 'misfit')
    # The jump is some 500 ug; the statement holds its size.
    assert slow_error(jumped, outcome).max() > 100.0 * MICRO_G


def test_data_without_drift_look_compensated(rng: np.random.Generator) -> None:
    truth = without_memory(Truth())
    truth = replace(truth, bias_curve=np.zeros((3, 2)), scale_curve=np.zeros((3, 2)))
    table, _ = table_of(truth, 12, rng, window_s=60.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    outcome = fit_model(table, ModelSpec('c', polynomial(0)), GRAVITY, constant, Freedom())
    rows = residual_rows(table, outcome.solution, outcome.solution)
    found = judge_result(
        outcome.solution, rows, slow_error(table, outcome), FitOptions(gravity=GRAVITY)
    )
    assert any('already compensated?' in finding.message for finding in found)


def test_scale_factors_far_from_one_are_said(rng: np.random.Generator) -> None:
    table, _ = table_of(without_memory(Truth()), 12, rng, window_s=300.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    outcome = fit_model(table, ModelSpec('q', polynomial(2)), GRAVITY, constant, Freedom())
    rows = residual_rows(table, outcome.solution, outcome.solution)
    options = FitOptions(gravity=GRAVITY, input='m/s^2')
    found = judge_result(outcome.solution, rows, slow_error(table, outcome), options)
    assert any(f.name == 'units' and 'expected near 1' in f.message for f in found)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'gravity': -1.0}, '`gravity` must be positive, got -1.0'),
        ({'window_s': 0.0}, '`window_s` must be positive, got 0.0'),
        ({'full_scale': -5.0}, '`full_scale` must be positive, got -5.0'),
        ({'cell_s': 20.0}, r'`cell_s` must not exceed `window_s` \(10.0\), got 20.0'),
        ({'input': 'g'}, "`input` must be 'counts' or 'm/s"),
    ],
)
def test_options_out_of_range_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FitOptions(**{'gravity': 9.81, **change})
