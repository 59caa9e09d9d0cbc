# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
A triad without temperature: truth comes out, and M is refused where the positions cannot tell it.

"""

from __future__ import annotations

import numpy as np
import pytest
from pose_helpers import GRAVITY
from scipy.optimize import least_squares

from thermo_comp.errors import FitError
from thermo_comp.fitting.reduction import StillInterval
from thermo_comp.fitting.triad import fit_triad
from thermo_comp.simulation import positions

BIAS = np.array([12.0, -30.0, 5.0])
SCALE = np.array([210.0, 205.0, 198.0])
M = np.array([[1.0, 0.0, 0.0], [0.004, 1.0, 0.0], [-0.006, 0.003, 1.0]])
FACES = np.vstack((np.eye(3), -np.eye(3)))
TRUTH = np.concatenate((BIAS, SCALE, (M[1, 0], M[2, 0], M[2, 1])))


def still(rng, up, matrix=M, n=5, sd=0.3):
    """Make still intervals of n windows, noise in counts."""
    result = []
    for number, direction in enumerate(up):
        counts = BIAS + SCALE * np.linalg.solve(matrix, GRAVITY * direction)
        result.append(
            StillInterval(
                bag=0,
                start_ns=0,
                end_ns=1,
                begin_s=10.0 * number,
                n_whole=n,
                time=10.0 * number + np.arange(n),
                count=np.full(n, 100.0),
                mean=counts + sd * rng.standard_normal((n, 3)),
                sample_sd=np.full(3, 10.0 * sd),
            )
        )
    return result


def test_truth_comes_out_within_its_sd(rng):
    # 30 units, nine parameters: the rms of unit normals is 1 within 0.05 (1 sd).
    pulls = []
    for _ in range(30):
        found = fit_triad(still(rng, positions(18, 3)), GRAVITY)
        assert found.has_misalignment
        assert found.advice == ()
        pulls.append((found.parameters - TRUTH) / found.parameter_sd)
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.2)


def test_equals_a_direct_solution_of_the_norm(rng):
    # Second route: |f| - g over all windows, nine numbers, no attitudes.
    intervals = still(rng, positions(18, 3))
    windows = np.concatenate([interval.mean for interval in intervals])

    def residual(x):
        matrix = np.eye(3)
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = x[6:]
        return np.linalg.norm((windows - x[:3]) / x[3:6] @ matrix.T, axis=1) - GRAVITY

    start = np.concatenate((np.zeros(3), np.full(3, 200.0), np.zeros(3)))
    direct = least_squares(residual, start, x_scale='jac', xtol=1e-14, ftol=1e-14)
    found = fit_triad(intervals, GRAVITY)
    # Another weighting of the same data: a fraction of the sd apart.
    np.testing.assert_array_less(np.abs(found.parameters - direct.x), 0.5 * found.parameter_sd)
    rms, best = (np.sqrt(np.mean(r**2)) for r in (found.residual, direct.fun))
    assert best <= rms < 1.02 * best


def test_corrects_new_vectors(rng):
    found = fit_triad(still(rng, positions(18, 3), sd=1e-6), GRAVITY)
    force = np.array([[1.0, -2.0, 9.0]])
    counts = BIAS + SCALE * np.linalg.solve(M, force.T).T
    np.testing.assert_allclose(found.force(counts), force, atol=1e-6)


def test_six_faces_give_bias_and_scale_and_advice(rng):
    found = fit_triad(still(rng, FACES, matrix=np.eye(3)), GRAVITY)
    assert not found.has_misalignment
    np.testing.assert_array_equal(found.misalignment, np.eye(3))
    assert not found.covariance[6:].any()
    pull = (found.parameters - TRUTH)[:6] / found.parameter_sd[:6]
    # Six draws: none beyond 4 sd.
    assert np.abs(pull).max() < 4.0
    (advice,) = found.advice
    assert 'bias and scale only' in advice
    assert 'add positions between the faces' in advice


def test_misalignment_from_six_faces_is_refused(rng):
    with pytest.raises(FitError, match='6 distinct positions identify bias and scale only'):
        fit_triad(still(rng, FACES), GRAVITY, misalignment=True)


def test_misalignment_can_be_left_out(rng):
    found = fit_triad(still(rng, positions(18, 3), matrix=np.eye(3)), GRAVITY, misalignment=False)
    assert not found.has_misalignment
    assert found.advice == ()


def test_too_few_positions(rng):
    with pytest.raises(FitError, match='5 still positions, need 6'):
        fit_triad(still(rng, FACES[:5]), GRAVITY)
    with pytest.raises(FitError, match='3 distinct positions, need 6'):
        fit_triad(still(rng, np.vstack((FACES[:3], FACES[:3], FACES[:3]))), GRAVITY)
