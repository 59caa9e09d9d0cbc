# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Residual statistics against numbers computed by hand."""

import numpy as np
import pytest

from thermo_comp.unit.gravity import MICRO_G
from thermo_comp.unit.metrics import norm_residual, residual_statistics, statistics_by_regime


def test_statistics_of_scalars_by_hand():
    # 3 and -4: mean -0.5, mean square 12.5.
    found = residual_statistics(np.array([3.0, -4.0]))
    assert (found.n, found.mean, found.peak) == (2, -0.5, 4.0)
    assert found.rms == pytest.approx(12.5**0.5, rel=1e-15)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_values_that_are_not_finite_are_left_out(bad):
    assert residual_statistics(np.array([1.0, bad, 1.0])) == residual_statistics(np.ones(2))


def test_nothing_to_count_gives_nan():
    found = residual_statistics(np.zeros(0))
    assert found.n == 0
    assert np.isnan([found.mean, found.rms, found.peak]).all()


def test_micro_g_is_a_millionth_of_standard_gravity():
    assert pytest.approx(9.80665e-6) == MICRO_G


def test_norm_residual_does_not_see_a_rotation(rng):
    force = rng.normal(size=(5, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    # A rotation moves each norm by rounding only.
    np.testing.assert_allclose(
        norm_residual(force @ turn.T, 9.8), norm_residual(force, 9.8), atol=1e-14
    )
    assert norm_residual(np.array([0.0, 3.0, 4.0]), 4.5) == pytest.approx(0.5, abs=1e-15)


def test_regimes_are_told_apart():
    found = statistics_by_regime(np.array([1.0, 2.0, 5.0]), np.array([False, False, True]))
    assert (found['static'].n, found['dynamic'].n, found['all'].n) == (2, 1, 3)
    assert found['dynamic'].peak == 5.0
