# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The claimed sd is larger for axes that no position had along gravity at a temperature."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import strangers
from strangers_baselines import minutes
from strangers_cases import FULL_SCALE, Study, positions
from strangers_units import navigation, program, rng_of, spread

from thermo_comp.fitting import thermal_ranges
from thermo_comp.unit.calibration import LackOfFit

WARM = program(20, 20, (35, 1, 45), (5, 1, 45), (20, 1, 5))
COLD = program(0, 20, (-25, 1, 45), (0, 1, 30))
HELD = program(-5, 20, (-22, 1, 45), (-8, 1, 20))
#: Slopes of the scale factors of y and z below 5 degC [1/K].
KINK = np.array([0.0, 1e-5, -1e-5])


def fit_of(temperature, up, position, slope=1e-5, gravity=10.0):
    """Return the parts of a fit that the functions read; the scale has a curve of one slope."""
    windows = SimpleNamespace(
        temperature=np.asarray(temperature, dtype=float),
        data=SimpleNamespace(
            position=np.asarray(position), groups=('curve',), kelvins=np.array([1.0])
        ),
    )
    weights = np.zeros((2, 3, 1))
    weights[1] = slope
    state = SimpleNamespace(up=np.asarray(up, dtype=float), weights=weights)
    return SimpleNamespace(
        windows=windows,
        regression=SimpleNamespace(gravity=gravity),
        posterior=SimpleNamespace(state=state),
    )


def prior_of(lower, upper, *lacks):
    regime = SimpleNamespace(temperature_range_c=(lower, upper), lack_of_fit=lacks)
    return SimpleNamespace(regime_sets=lambda: (regime, regime))


def test_axes_never_along_gravity_at_some_temperatures_have_a_larger_sd():
    # Six positions, one per face, cover 0 to 40 degC; one position with x up covers -40 to 0 degC.
    faces = [*np.eye(3), *-np.eye(3), np.eye(3)[0]]
    fit = fit_of([0, 40] * 6 + [-40, 0], faces, np.repeat(np.arange(7), 2))
    (lack, _) = thermal_ranges.with_unseen_axes(fit, ((), ()), None)
    assert [point.temperature_c for point in lack] == pytest.approx([-40, -31, -22, -13, -4])
    for point in lack:
        # The curve of a scale is used to 4 K (a tenth of its range) beyond its range; farther out
        # the slope of the scale is assumed to have an sd of 5 ppm/K, half of the fitted slope.
        sd = 0.5e-5 * 10.0 * (-4.0 - point.temperature_c)
        assert point.sd_m_s2 == pytest.approx((0.0, sd, sd), abs=1e-12)
    (finding,) = thermal_ranges.judge_unseen_axes(fit, None)
    assert 'below -4 degC no position has gravity along y and z' in finding.message


@pytest.mark.parametrize(
    'up', [[[0.58, 0.58, 0.58], [-0.6, 0.6, 0.53]], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
)
def test_no_sd_is_added_if_the_same_axes_are_along_gravity_at_all_temperatures(up):
    fit = fit_of([0, 40, -40, 0], [up[0], up[1]], [0, 0, 1, 1])
    only_x = np.allclose(up, [1.0, 0.0, 0.0])
    assert thermal_ranges.with_unseen_axes(fit, ((), ()), None) == [(), ()]
    assert thermal_ranges.judge_unseen_axes(fit, None) == []
    # A prior determines all axes within its temperature range, from 0 to 40 degC.
    (lack, _) = thermal_ranges.with_unseen_axes(fit, ((), ()), prior_of(0.0, 40.0))
    assert bool(lack) == only_x


def test_an_update_keeps_the_lack_of_fit_of_axes_that_it_does_not_observe():
    lacks = LackOfFit(0.0, (1e-3, 1e-3, 1e-3)), LackOfFit(40.0, (1e-3, 1e-3, 1e-3))
    fit = fit_of([10, 30], [[1.0, 0.0, 0.0]], [0, 0])
    new = (LackOfFit(20.0, (2e-4, 2e-4, 2e-3)),)
    (points, _) = thermal_ranges.with_unseen_axes(fit, (new, new), prior_of(0.0, 40.0, *lacks))
    by_temperature = {point.temperature_c: point.sd_m_s2 for point in points}
    assert by_temperature[20.0] == pytest.approx((2e-4, 1e-3, 2e-3))
    assert by_temperature[0.0] == pytest.approx((1e-3, 1e-3, 2e-3))


def kinked(bag, unit):
    """Add a change of the scale factors of y and z below 5 degC."""
    board = np.interp(bag.time_s, *bag.temperatures['board'])[:, np.newaxis]
    change = bag.force * np.minimum(board - 5.0, 0.0) * KINK
    return replace(bag, samples=np.rint(bag.samples + unit.counts * change))


@pytest.mark.slow
@pytest.mark.parametrize('number', [1, 2])
@pytest.mark.parametrize('is_prior', [False, True])
def test_after_one_cold_bag_the_claimed_sd_covers_the_scale_errors_of_all_axes(number, is_prior):
    # WHY: after a cold bag of one position the force error was 138 ug, its claimed sd 14 ug.
    rng = rng_of('unseen axes', number)
    unit = navigation(rng)
    warm = positions(unit, WARM, spread(12, rng), rng)
    (cold,) = positions(unit, COLD, np.eye(3)[:1], rng)
    cold = replace(kinked(cold, unit), name='cold')
    held = tuple(kinked(bag, unit) for bag in positions(unit, HELD, spread(6, rng), rng))
    prior = None
    if is_prior:
        prior = strangers.fitted(Study('', tuple(warm), {}, FULL_SCALE))
    bags = (cold,) if is_prior else (*warm, cold)
    study = Study('', bags, {'': held}, FULL_SCALE)
    calibration = strangers.fitted(study, prior)
    score = strangers.scored(study, calibration, {'': [minutes(bag) for bag in held]})['']
    assert score.vector > 50.0
    assert score.ratio < 2.0
