# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The expected accuracy for given positions agrees with closed forms and simulated estimates."""

import numpy as np
import pytest

from thermo_comp.fitting import coverage
from thermo_comp.simulation.campaign import positions

PRIOR_SD = np.repeat([1.0 / 9.80665, 0.05, 1e-3], 3)  # bias [g], scale, misalignment [rad]
FACES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
NOTHING = np.empty((0, 3))
SD = 2e-5


def units(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def mean_variance(ups, at):
    covariance = coverage.constants_covariance(ups, np.full(len(ups), SD))
    columns = coverage.force_columns(at)
    return float(np.mean(np.trace(columns @ covariance @ columns.transpose(0, 2, 1), 0, 1, 2)))


def test_the_columns_equal_the_derivatives_of_the_measured_force(rng):
    up, step = units(rng, 20), 1e-6

    def force(constants):
        bias, scale, skew = constants.reshape(3, 3)
        inverse = np.eye(3)
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = skew
        return (up @ inverse.T) * (1.0 + scale) + bias

    for k, step_of in enumerate(step * np.eye(9)):
        slope = (force(step_of) - force(-step_of)) / (2.0 * step)
        np.testing.assert_allclose(coverage.force_columns(up)[:, :, k], slope, atol=1e-9)
        norm = [np.linalg.norm(force(step), axis=1) for step in (step_of, -step_of)]
        slope = (norm[0] - norm[1]) / (2.0 * step)
        np.testing.assert_allclose(coverage.norm_columns(up)[:, k], slope, atol=1e-9)


def test_none_or_two_opposite_positions_determine_no_other_constants():
    covariance = coverage.constants_covariance(NOTHING, np.empty(0))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), PRIOR_SD)
    # Along an axis the variance of |f| is the sum of the variances of its bias and scale.
    assert coverage.worst_sd(covariance) == pytest.approx(
        np.hypot(PRIOR_SD[0], PRIOR_SD[3]), rel=1e-3
    )
    sd = np.sqrt(np.diag(coverage.constants_covariance(FACES[:2], np.full(2, SD))))
    # Bias and scale errors: half the difference and half the sum of errors of |f| on +x and -x.
    assert sd[[0, 3]] == pytest.approx(SD / np.sqrt(2.0), rel=1e-6)
    np.testing.assert_allclose(sd[[1, 2, 4, 5, 6, 7, 8]], PRIOR_SD[[1, 2, 4, 5, 6, 7, 8]])


def test_the_covariance_equals_that_of_simulated_estimates(rng):
    up, n = positions(12, 3), 4000
    covariance = coverage.constants_covariance(up, np.full(12, SD))
    truth = rng.standard_normal((n, 9)) * PRIOR_SD
    columns = coverage.norm_columns(up)
    seen = truth @ columns.T + SD * rng.standard_normal((n, 12))
    # The estimate is the conditional mean of the constants for the given values of |f|.
    joint = columns * PRIOR_SD**2 @ columns.T + SD**2 * np.eye(12)
    estimate = seen @ np.linalg.solve(joint, columns * PRIOR_SD**2)
    # 4000 trials determine a standard deviation to 1.1 %.
    scatter = np.std(estimate - truth, axis=0)
    np.testing.assert_allclose(scatter, np.sqrt(np.diag(covariance)), rtol=0.06)


@pytest.mark.parametrize('n', [0, 1, 4, 7, 11])
def test_the_next_direction_reduces_the_mean_variance(n, rng):
    up, at = units(rng, n), units(rng, 2000)
    covariance = coverage.constants_covariance(up, np.full(n, SD))
    proposed = coverage.next_direction(covariance, SD, up)
    before = mean_variance(up, at)
    gain = before - mean_variance(np.vstack([up, proposed]), at)
    others = [before - mean_variance(np.vstack([up, unit]), at) for unit in units(rng, 300)]
    # A face is proposed if it reduces the variance at least half as much as the best direction.
    assert gain > 0.45 * max(others)
    assert np.max(up @ proposed, initial=-1.0) < np.cos(np.radians(20.0))


def test_the_proposed_directions_are_nearly_as_good_as_spread_positions():
    up = NOTHING
    for _ in range(18):
        covariance = coverage.constants_covariance(up, np.full(len(up), SD))
        up = np.vstack([up, coverage.next_direction(covariance, SD, up)])
    # The six faces are proposed first, beginning with +z, then directions for the misalignment.
    assert up[0].tolist() == [0.0, 0.0, 1.0]
    assert {tuple(row) for row in up[:6]} == {tuple(face) for face in FACES}
    proposed = coverage.worst_sd(coverage.constants_covariance(up, np.full(18, SD)))
    spread = coverage.worst_sd(coverage.constants_covariance(positions(18), np.full(18, SD)))
    assert proposed < 1.1 * spread
    assert coverage.farthest(up)[1] < 36.0


def test_farthest_returns_the_direction_farthest_from_all_given_directions():
    up, angle = coverage.farthest(FACES)
    assert np.abs(up) == pytest.approx(1.0 / np.sqrt(3.0))
    assert angle == pytest.approx(np.degrees(np.arccos(1.0 / np.sqrt(3.0))))
    assert coverage.farthest(FACES[4:5])[0] == pytest.approx([0.0, 0.0, -1.0])
    assert coverage.farthest(NOTHING)[1] == 180.0


@pytest.mark.parametrize(
    ('up', 'words'),
    [
        ((0, 0, 1), '+z up: x +0.00 g, y +0.00 g, z +1.00 g'),
        ((1, -1, 0), '+x and -y equally up: x +0.71 g, y -0.71 g, z +0.00 g'),
        ((-1, 1, 1), '-x, +y and +z equally up: x -0.58 g, y +0.58 g, z +0.58 g'),
        ((3, 1, 0), '+x and +y partly up: x +0.95 g, y +0.32 g, z +0.00 g'),
    ],
)
def test_a_direction_is_described_in_words(up, words):
    assert coverage.direction_text(np.array(up, float) / np.linalg.norm(up)) == words
