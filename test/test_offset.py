# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits to unsigned and to signed integer samples differ only in the bias, by the offset."""

from dataclasses import replace

import numpy as np
import pytest
from position_helpers import GRAVITY, source

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.coverage import rough_centre
from thermo_comp.fitting.fit import with_code_offset
from thermo_comp.simulation.campaign import positions

OPTIONS = FitOptions(gravity=GRAVITY)
K = np.array((4130.0, 4080.0, 4200.0)) / GRAVITY
BIAS = np.array((120.0, -340.0, 55.0))
M = np.array(((1.0, 0.0, 0.0), (0.004, 1.0, 0.0), (-0.006, 0.003, 1.0)))


def words_of(ups, rng, seconds=20.0):
    """Draw integer codes at 100 Hz: in each attitude 1 s of motion, then `seconds` of rest."""
    parts = []
    for up in ups:
        n = round(100 * seconds)
        force = np.linalg.solve(M, GRAVITY * up)
        rest = force * K + BIAS + 12.0 * rng.standard_normal((n, 3))
        parts += [BIAS + 3000.0 * rng.standard_normal((100, 3)), rest]
    return np.rint(np.concatenate(parts))


def constants(result):
    triad = result.calibration.axes
    return np.array([axis.bias for axis in triad]), np.array([axis.scale_factor for axis in triad])


@pytest.fixture(scope='module')
def words():
    return words_of(positions(14, 3), np.random.default_rng(1))


@pytest.fixture(scope='module')
def plain(words):
    return fit([source(words)], OPTIONS)


@pytest.mark.parametrize(
    ('offset', 'declared'), [(32768.0, False), (32768.0, True), (8192.0, False), (20000.0, False)]
)
def test_constants_of_unsigned_words_equal_those_of_signed_words(words, plain, offset, declared):
    result = fit([source(words + offset)], replace(OPTIONS, offset=offset if declared else None))
    bias, scale = constants(result)
    np.testing.assert_allclose(bias - offset, constants(plain)[0], atol=0.02)
    np.testing.assert_allclose(scale, constants(plain)[1], rtol=1e-6)
    # The tolerances are for 14 means over 2000 samples with 12 counts of noise.
    np.testing.assert_allclose(bias - offset, BIAS, atol=1.0)
    np.testing.assert_allclose(scale, K, rtol=3e-4)
    np.testing.assert_allclose(result.calibration.misalignment, M, atol=3e-4)
    assert any(finding.name == 'offset' for finding in result.findings)
    assert 'zero force reads' in result.calibration.provenance.notes[0]
    assert not any(finding.name == 'offset' for finding in plain.findings)


def test_a_bag_per_position_needs_no_other_bag_for_the_offset(rng):
    # Only readings above 32767 show that 16-bit words are unsigned; some bags have none.
    ups = positions(10, 3)
    ups[0] = -np.full(3, 3.0**-0.5)
    bags = [source(words_of([up], rng) + 32768.0, name=f'bag{k}') for k, up in enumerate(ups)]
    result = fit(bags, OPTIONS)
    bias, scale = constants(result)
    np.testing.assert_allclose(bias - 32768.0, BIAS, atol=2.0)
    np.testing.assert_allclose(scale, K, rtol=6e-4)
    assert result.bags[0].n_saturated == result.bags[1].n_saturated == 0


def test_16_bit_words_in_one_attitude_have_the_right_scale_and_are_saturated_at_their_limits(rng):
    result = fit([source(words_of([np.array((0.0, 0.0, 1.0))], rng) + 32768.0)], OPTIONS)
    bias, scale = constants(result)
    # In one attitude scale and bias keep their prior, with sd 5 % and 1 m/s^2 (about 400 counts).
    np.testing.assert_allclose(scale, 4200.0 / GRAVITY, rtol=0.05)
    np.testing.assert_allclose(bias, 32768.0, atol=400.0)
    assert result.calibration.unit.full_scale == 65535.0
    words = words_of([np.array((0.0, 0.0, 1.0))], rng) + 32768.0
    words[500, 0], words[600, 2] = 65535.0, 0.0
    (bag,) = fit([source(words)], OPTIONS).bags
    assert bag.n_saturated == 2


def test_the_offset_of_a_prior_is_used(rng, plain):
    known = with_code_offset(plain.calibration, np.full(3, 32768.0))
    up = np.array((0.6, 0.0, 0.8))
    result = fit([source(words_of([up], rng) + 32768.0)], replace(OPTIONS, prior=known))
    np.testing.assert_allclose(constants(result)[0], 32768.0 + BIAS, atol=2.0)


def test_an_offset_is_found_only_if_positions_determine_it(rng):
    # WHY: readings in one pose fit a sphere by chance: the corrected drift had an error of 143 mg.
    for up in (np.eye(3)[2], np.array([-0.06, -0.25, -0.97])):
        for n in (4, 6, 8):
            for _ in range(100):
                drift = np.outer(rng.uniform(-15.0, 45.0, n), 1e-4 * rng.standard_normal(3))
                turned = up + 1e-3 * rng.standard_normal((n, 3)) + drift
                assert not rough_centre(4e6 * turned).any()
    ups = positions(12, 5)
    assert not rough_centre(4096.0 * ups + (800.0, -900.0, 700.0)).any()
    np.testing.assert_allclose(rough_centre(100.0 * ups + 338.0), 338.0, atol=1e-6)
    # Positions in one plane do not determine the offset along the normal of this plane.
    flat = ups * (1.0, 1.0, 0.0)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert not rough_centre(100.0 * flat + 338.0).any()
    assert not rough_centre(100.0 * ups[:3] + 338.0).any()
