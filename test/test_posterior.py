# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The factor of the posterior in a calibration file gives the covariance of its parameters."""

from dataclasses import replace

import numpy as np
import pytest
from builders import FACES, axis_set, calibration, regime_set, term
from hypothesis import given, settings
from hypothesis import strategies as st
from position_helpers import GRAVITY, Rest

from thermo_comp.errors import CalibrationError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.coverage import least_known
from thermo_comp.simulation.campaign import positions
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import SIZE_LIMIT, dump_calibration, parse_calibration
from thermo_comp.unit.columns import bank
from thermo_comp.unit.functions import CubicSpline
from thermo_comp.unit.posterior import Block, Posterior, posterior_of


def random_covariance(seed, n, spread=1.0):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(n, n)) * np.geomspace(1.0, 1e-4, n) ** spread
    covariance = factor @ factor.T
    scale = 10.0 ** rng.uniform(-8.0, 2.0, n) / np.sqrt(np.diag(covariance))
    return covariance * scale * scale[:, np.newaxis]


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_variances_are_kept_and_correlation_errors_are_within_the_tolerance(seed, n):
    covariance, tolerance = random_covariance(seed, n), 1e-5
    posterior = posterior_of(covariance)
    sd = np.sqrt(np.diag(covariance))
    error = (posterior.covariance() - covariance) / sd / sd[:, np.newaxis]
    # The factor of the covariance is stored in single precision.
    np.testing.assert_allclose(np.diag(error), 0.0, atol=1e-6)
    np.testing.assert_allclose(error, 0.0, atol=tolerance + 2e-6)
    assert (posterior.variances <= (tolerance + 1e-6) * sd**2).all()
    assert posterior.matrix.shape == (n, posterior.rank)


def test_the_factor_is_small_and_read_only_and_known_parameters_have_zero_variance():
    covariance = np.zeros((4, 4))
    assert posterior_of(covariance) == Posterior.of(np.empty((4, 0)), np.zeros(4))
    covariance[2, 2] = 9.0
    posterior = posterior_of(covariance)
    assert posterior.rank == 1
    np.testing.assert_array_equal(posterior.covariance(), covariance)
    assert posterior_of(random_covariance(1, 30)).rank < 30
    posterior = posterior_of(np.eye(2))
    with pytest.raises(ValueError, match='read-only'):
        posterior.matrix[0, 0] = 1.0


@pytest.mark.parametrize(
    ('matrix', 'message'),
    [
        *(([[bad]], '`covariance` must not have a negative variance') for bad in (-1.0, np.nan)),
        *(([[1.0, bad], [bad, 1.0]], '`covariance` must be positive semidefinite')
          for bad in (2.0, np.inf, np.nan)),
        ([[0.0, 1.0], [1.0, 1.0]], '`covariance` must be positive semidefinite'),
        ([[1e80]], '`factor` must hold finite numbers'),  # too large for single precision
    ],
)  # fmt: skip
def test_a_matrix_that_is_no_covariance_in_single_precision_is_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        posterior_of(np.array(matrix))
    with pytest.raises(ValueError, match='`diagonal` must not have a negative variance'):
        Posterior.of(np.ones((1, 1)), np.array([-1.0]))


def test_the_order_of_parameters_equals_one_found_by_hand():
    spline = CubicSpline((-5.0, 0.0, 5.0, 9.0), (0.1, 0.0, 0.2, 0.3))
    value = calibration(
        static=regime_set(axis_set((0.0, 1.0, 2.0)), axis_set(), axis_set(scale=(1.0, 1e-4))),
        dynamic=regime_set(x=replace(axis_set(), bias_function=spline)),
        response=(term('gradient'), term('board', tau_s=60.0)),
    )
    layout = parameter_layout(value)
    # Bias of x: static level, t, t^2; dynamic level and three knots; two weights of the response.
    assert layout.bias == [Block(0, 3, 7, 9), Block(13, 14, 15, 17), Block(21, 22, 23, 25)]
    assert layout.scale == [Block(9, 10, 11, 13), Block(17, 18, 19, 21), Block(25, 27, 28, 30)]
    assert (layout.misalignment, layout.n_parameters) == (30, 33)


def whole_bank(sensors):
    curve = axis_set((0.0, 0.1, 0.01, 1e-3), (1.0, 1e-5, 1e-6, 1e-7))
    axes = regime_set(curve, curve, curve)
    keys = {'range': (-9.0, 9.0), 'bias': (1 / 3,) * 3, 'scale': (1e-7 / 3,) * 3}
    terms = tuple(term(**{**vars(column), **keys}) for column in bank(sensors))
    value = calibration(static=axes, dynamic=axes, sensors=sensors, response=terms)
    n = parameter_layout(value).n_parameters
    factor = np.random.default_rng(5).normal(size=(n, n)) / 3.0
    return replace(value, posterior=Posterior.of(factor, np.full(n, 1 / 3)))


def test_a_model_of_all_columns_of_two_thermometers_can_be_saved_and_of_three_not():
    value = whole_bank(('case', 'frame'))
    content = dump_calibration(value).encode()
    assert len(content) < SIZE_LIMIT
    assert parse_calibration(content) == value
    with pytest.raises(CalibrationError, match=rf'takes \d+ bytes, at most {SIZE_LIMIT} are'):
        dump_calibration(whole_bank(('case', 'frame', 'window')))


#: Six faces do not determine the sd of bias changes between mountings, so it is stated.
OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2', groups=('curve',), mounting_sd=1e-6)


def fitted(rng, ups):
    rests = [Rest(rng, 60.0, level=tuple(GRAVITY * up)) for up in ups]
    return fit([rest.source(name=f'bag{k}') for k, rest in enumerate(rests)], OPTIONS)


def said(result):
    return next((finding.message for finding in result.findings if finding.name == 'unseen'), '')


def test_the_least_determined_attitude_is_found_and_printed_if_a_side_was_never_up(rng):
    result = fitted(rng, FACES)
    least = result.least_known
    assert least_known(replace(result.calibration, posterior=None), FACES) is None
    # Near a corner of the cube the variance hardly changes, so the direction may be beside it.
    np.testing.assert_allclose(np.abs(least.up), 3.0**-0.5, atol=0.05)
    assert least.away_deg == pytest.approx(np.degrees(np.arccos(3.0**-0.5)), abs=4.0)
    # Each of three angles (sd 0.01 rad) changes |f| by g * product of two components, here 1 / 3.
    assert least.sd_m_s2 == pytest.approx(GRAVITY * 1e-2 / 3.0**0.5, rel=0.2)
    ups = positions(30, 4)
    result = fitted(rng, ups[ups[:, 2] > 0.2])
    np.testing.assert_allclose(result.least_known.up, (0.0, 0.0, -1.0), atol=0.06)
    assert '-z up' in said(result)
    assert said(result) in ' '.join(result.calibration.provenance.notes)
    result = fitted(rng, positions(18, 4))
    assert result.least_known.sd_m_s2 < 2.0 * result.least_known.seen_sd_m_s2
    assert not said(result)
