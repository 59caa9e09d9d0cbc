# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The regression: exact Jacobian, truth recovered at the noise bound, gauge, outliers, parity.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitting_truth import GRAVITY, Truth, history, lagged, table_of, without_memory
from scipy.optimize import least_squares

from thermo_comp.errors import FitError
from thermo_comp.fitting.assembly import parameter_covariance
from thermo_comp.fitting.lags import BoardHistories
from thermo_comp.fitting.model import ModelSpec, polynomial
from thermo_comp.fitting.regression import (
    START_MEMORY_SD,
    Freedom,
    Outcome,
    _moved,
    layout_of,
    regress,
    tangent_basis,
)
from thermo_comp.fitting.selection import fit_model
from thermo_comp.fitting.solution import Solution, correct, predict, regressors
from thermo_comp.fitting.start import constant_calibration, position_means
from thermo_comp.fitting.table import WindowTable

QUADRATIC = ModelSpec('quadratic', polynomial(2))
MEMORY = ModelSpec('quadratic+memory2', polynomial(2), n_lags=2)
EVERYTHING = ModelSpec(
    'everything', polynomial(1), polynomial(2), gradient=True, rate=True, n_lags=2, live='dynamic'
)


def run(table: WindowTable, spec: ModelSpec, freedom: Freedom | None = None) -> Outcome:
    freedom = freedom or Freedom()
    means = position_means(table)
    constant = constant_calibration(means, GRAVITY, with_misalignment=freedom.misalignment)
    return fit_model(table, spec, GRAVITY, constant, freedom)


def residual_vector(table: WindowTable, state: Solution) -> np.ndarray:
    columns = regressors(table, state.spec, state.time_constants_s, state.start_memory)
    prior = -state.start_memory.ravel() / START_MEMORY_SD
    sd = np.where(table.is_dynamic[:, None], state.noise_sd[1], state.noise_sd[0])
    return np.append(((table.mean - predict(table, state, columns)) / sd).ravel(), prior)


@pytest.mark.parametrize('spec', [QUADRATIC, MEMORY, EVERYTHING], ids=lambda spec: spec.name)
def test_normal_matrix_is_that_of_the_numerical_jacobian(
    spec: ModelSpec, rng: np.random.Generator
) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=600.0, thermal=history(step_s=20.0))
    outcome = run(table, spec)
    state = outcome.solution
    # Away from the minimum and with a start memory, so that no term of the Jacobian is zero.
    state = replace(state, start_memory=0.3 * rng.standard_normal(state.start_memory.shape))
    frozen = Freedom()
    layout = layout_of(state, frozen, table)
    at = regress(table, state, frozen, is_robust=False, max_rounds=1, max_steps=0)
    numeric = np.empty((table.mean.size + state.start_memory.size, layout.n))
    scale = 1.0 / np.sqrt(np.diag(at.information))
    for j in range(layout.n):
        step = np.zeros(layout.n)
        # A hundredth of each parameter's weight in the data: the differences are linear to 1e-6
        # there and 1e9 times rounding.
        step[j] = 0.01 * scale[j]
        forward = residual_vector(table, _moved(state, step, layout, frozen))
        backward = residual_vector(table, _moved(state, -step, layout, frozen))
        numeric[:, j] = (backward - forward) / (2.0 * step[j])
    expected = numeric.T @ numeric
    difference = (at.information - expected) * np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-5


def test_memory_matches_fine_steps_and_its_derivatives() -> None:
    thermal = history(step_s=10.0)
    where = np.arange(0.0, thermal.time[-1], 130.0)
    stack = BoardHistories.of([thermal.board], 10.0, np.zeros(len(where), dtype=np.int64), where)
    tau = np.array([300.0, 4000.0])
    found = stack.memory(tau)
    for k in range(2):
        slow = thermal.board - lagged(thermal.board, 10.0, tau[k])
        # Euler steps of 0.25 s err by half a step of the memory's own rate, 5 K in 300 s.
        np.testing.assert_allclose(
            found.value[:, k], np.interp(where, thermal.time, slow), atol=3e-3
        )
    step = 1e-5
    up, down = stack.memory(tau * np.exp(step)), stack.memory(tau * np.exp(-step))
    # Central differences of step 1e-5 leave 1e-10 of the third derivative and 1e-10 of rounding.
    np.testing.assert_allclose(found.slope, (up.value - down.value) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(found.decay_slope, (up.decay - down.decay) / (2 * step), atol=1e-8)


def test_truth_is_recovered_without_noise(rng: np.random.Generator) -> None:
    truth = replace(Truth(), noise_sd=0.0)
    table, up = table_of(truth, 12, rng, window_s=120.0)
    found = run(table, MEMORY).solution
    # What is left is the interpolation of the slow road's lags, 1e-6 of the signal.
    np.testing.assert_allclose(found.scale[:, 0], truth.scale, rtol=1e-7)
    np.testing.assert_allclose(found.bias[:, 0], truth.bias, atol=1e-3)
    np.testing.assert_allclose(
        found.scale[:, 1:3] / found.scale[:, :1], truth.scale_curve, rtol=1e-3
    )
    np.testing.assert_allclose(found.skew, truth.skew, atol=1e-7)
    np.testing.assert_allclose(found.up, up, atol=1e-7)
    np.testing.assert_allclose(found.time_constants_s, truth.time_constants_s, rtol=2e-3)


def test_correction_undoes_the_forward_model(rng: np.random.Generator) -> None:
    table, _ = table_of(replace(Truth(), noise_sd=0.0), 9, rng, window_s=300.0)
    state = run(table, MEMORY).solution
    columns = regressors(table, MEMORY, state.time_constants_s, state.start_memory)
    exact = replace(table, mean=predict(table, state, columns))
    force = correct(exact, state, columns)
    # Forward and back again: only rounding is left.
    np.testing.assert_allclose(force, GRAVITY * state.up[table.position], atol=1e-11)


def test_claimed_sd_is_the_scatter_and_the_bound(rng: np.random.Generator) -> None:
    # The inverse normal matrix at white noise is the Cramer-Rao bound, so errors over claimed sd
    # must have rms 1 (not more: efficient; not less: no false pride). 20 units give 6 x 20
    # numbers: their rms is 1 +- 0.065, checked at 3 sd.
    truth = without_memory(Truth())
    errors = []
    for _ in range(20):
        table, _ = table_of(truth, 12, rng, window_s=300.0)
        outcome = run(table, QUADRATIC)
        sd = np.sqrt(np.diag(parameter_covariance(outcome)))
        found, place = outcome.solution, outcome.layout.axis
        for axis in range(3):
            errors.append((found.bias[axis, 0] - truth.bias[axis]) / sd[place[axis, 0]])
            errors.append((found.scale[axis, 0] - truth.scale[axis]) / sd[place[axis, 3]])
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2
    # 95 % of 120 lie within 1.96 sd, +- 2 % (one sd).
    assert 0.89 <= np.mean(np.abs(errors) < 1.96) <= 1.0


def test_outliers_do_not_pull(rng: np.random.Generator) -> None:
    truth = without_memory(Truth())
    clean, _ = table_of(truth, 12, rng, window_s=300.0)
    dirty = replace(clean, mean=clean.mean.copy())
    struck = rng.choice(len(clean.time), len(clean.time) // 50, replace=False)
    dirty.mean[struck] += rng.normal(0.0, 200.0 * truth.noise_sd, (len(struck), 3))
    one, other = run(clean, QUADRATIC), run(dirty, QUADRATIC)
    plain = regress(dirty, one.solution, is_robust=False)
    sd = np.sqrt(np.diag(parameter_covariance(one)))[one.layout.axis[:, 0]]
    shift = np.abs(other.solution.bias[:, 0] - one.solution.bias[:, 0]) / sd
    pulled = np.abs(plain.solution.bias[:, 0] - one.solution.bias[:, 0]) / sd
    # 2 % of the windows, each worth 3 sd at most, shift by about one sd; unbridled, each is worth
    # 200.
    assert shift.max() < 2.0
    assert pulled.max() > 5.0


def test_axes_may_be_renamed(rng: np.random.Generator) -> None:
    # Without misalignment nothing tells the axes apart: permuted data give permuted results.
    truth = replace(without_memory(Truth()), skew=np.zeros(3))
    table, _ = table_of(truth, 9, rng, window_s=300.0)
    order = [2, 0, 1]
    freedom = Freedom(misalignment=False)
    one = run(table, QUADRATIC, freedom).solution
    other = run(replace(table, mean=table.mean[:, order]), QUADRATIC, freedom).solution
    # Both stop within a hundredth of a sd of the same minimum (sd of K is 1e-3 here).
    np.testing.assert_allclose(other.scale, one.scale[order], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(other.up, one.up[:, order], atol=1e-8)


def test_nine_parameters_equal_a_direct_solution_of_the_imu_tk_cost(
    rng: np.random.Generator,
) -> None:
    # imu_tk minimises sum (g - |M (a - b) / K|)^2 over static intervals. Without temperature
    # effects and with equal noise on all axes, our forward fit has the same minimum to first
    # order in noise / g = 1e-6 relative, far below the noise itself.
    truth = replace(
        without_memory(Truth()),
        scale=np.full(3, 1000.0),
        bias_curve=np.zeros((3, 2)),
        scale_curve=np.zeros((3, 2)),
    )
    table, _ = table_of(truth, 18, rng, window_s=300.0)
    means = position_means(table)

    def cost(p: np.ndarray) -> np.ndarray:
        matrix = np.array([[1.0, 0.0, 0.0], [p[6], 1.0, 0.0], [p[7], p[8], 1.0]])
        force = ((means / 1000.0 - p[:3]) * (1.0 + p[3:6])) @ matrix.T
        return GRAVITY - np.linalg.norm(force, axis=1)

    direct = least_squares(cost, np.zeros(9), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale='jac').x
    start = run(table, ModelSpec('constant', polynomial(0))).solution
    equal = replace(start, noise_sd=np.full((2, 3), truth.noise_sd))
    outcome = regress(table, equal, is_robust=False, max_rounds=1)
    found, M = outcome.solution, outcome.solution.misalignment
    noise = truth.noise_sd / 1000.0
    np.testing.assert_allclose(found.bias[:, 0] / 1000.0, direct[:3], atol=1e-2 * noise)
    np.testing.assert_allclose(
        1000.0 / found.scale[:, 0] - 1.0, direct[3:6], atol=1e-2 * noise / GRAVITY
    )
    np.testing.assert_allclose(
        [M[1, 0], M[2, 0], M[2, 1]], direct[6:], atol=1e-2 * noise / GRAVITY
    )


def test_published_huygens_coefficients_come_back(rng: np.random.Generator) -> None:
    # Huygens HASI accelerometer: sf = 1.30675e-3 - 1.35046e-7 T + 4.02821e-10 T^2 [A/g] and
    # offset = -8.9642327e-4 + 3.83652e-6 T - 7.61e-9 T^2 [g], T in kelvin. Sampled on the
    # chamber's program, fitted in our variables (t from 20 degC, counts of 1 pA), converted back.
    sf, offset = (1.30675e-3, -1.35046e-7, 4.02821e-10), (-8.9642327e-4, 3.83652e-6, -7.61e-9)
    counts_per_ampere = 1e9
    table, up = table_of(replace(without_memory(Truth()), noise_sd=0.0), 12, rng, window_s=300.0)
    kelvin = table.t + 293.15
    per_g = np.polynomial.polynomial.polyval(kelvin, sf) * counts_per_ampere
    zero = np.polynomial.polynomial.polyval(kelvin, offset)
    counts = per_g[:, None] * (up[table.position] + zero[:, None])
    found = run(replace(table, mean=counts), ModelSpec('q', polynomial(4)))
    fitted = found.solution

    def in_kelvin(coefficients: np.ndarray) -> np.ndarray:
        shifted = np.polynomial.Polynomial([-293.15, 1.0])
        return np.polynomial.Polynomial(coefficients)(shifted).coef

    for axis in range(3):
        got_sf = in_kelvin(fitted.scale[axis]) * GRAVITY / counts_per_ampere
        printed = [f'{got_sf[0]:.5e}', f'{got_sf[1]:.5e}', f'{got_sf[2]:.5e}']
        assert printed == ['1.30675e-03', '-1.35046e-07', '4.02821e-10']
        # The bias is in counts, sf times offset: the offset in g is their ratio.
        bias = np.polynomial.polynomial.polyval(table.t[:40], fitted.bias[axis])
        scale = np.polynomial.polynomial.polyval(table.t[:40], fitted.scale[axis]) * GRAVITY
        # Its three coefficients: the temperature span in kelvin gives them to the printed digits.
        got = np.polynomial.Polynomial.fit(kelvin[:40], bias / scale, 2).convert().coef
        assert f'{got[0]:.7e}' == '-8.9642327e-04'
        assert f'{got[1]:.5e}' == '3.83652e-06'
        assert f'{got[2]:.2e}' == '-7.61e-09'


def test_tangent_basis_is_orthonormal(rng: np.random.Generator) -> None:
    up = rng.standard_normal((20, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    up[0] = (1.0, 0.0, 0.0)
    basis = np.concatenate((tangent_basis(up), up[:, :, None]), axis=2)
    product = np.einsum('pij,pik->pjk', basis, basis)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-14)


def test_nothing_to_fit_is_refused(rng: np.random.Generator) -> None:
    table, _ = table_of(Truth(), 9, rng, window_s=600.0, thermal=history(step_s=20.0))
    start = run(table, QUADRATIC).solution
    with pytest.raises(FitError, match='no still window'):
        regress(table.select(np.zeros(len(table.time), dtype=bool)), start)


def test_a_dead_axis_is_refused() -> None:
    means = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(FitError, match='reads the same in all positions'):
        constant_calibration(means, GRAVITY, with_misalignment=False)


def test_positions_in_motion_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(FitError, match='no ellipsoid'):
        constant_calibration(rng.standard_normal((30, 3)), GRAVITY, with_misalignment=False)
