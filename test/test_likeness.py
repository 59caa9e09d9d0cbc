# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""If its bags do not separate two terms, a fit recommends a bag that separates them."""

from functools import cache

import numpy as np
import pytest
from simulation_helpers import sources_of
from strangers_cases import HALF, ROOM
from strangers_units import GRAVITY, STILL_AIR, navigation, positions, record, rng_of, spread

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.likeness import Likeness, judge_likeness

UP = np.array([[0.05, 0.0, 1.0], [0.0, 0.05, -1.0]]) / np.hypot(1.0, 0.05)


def fitted(bags):
    return fit(sources_of(bags), FitOptions(gravity=GRAVITY, full_scale=8388607.0))


@cache
def chamber():
    """Record 9 positions in the chamber of a unit whose board is cooled by the chamber's fan."""
    rng = rng_of('alike', 0)
    unit = navigation(rng, vent_share=0.3)
    return unit, positions(unit, HALF, spread(9, rng), rng)


def advice_of(result):
    return [finding.message for finding in result.findings if finding.name == 'alike']


def inflation_of(result, *groups):
    (pair,) = (pair for pair in result.likeness if pair.groups == groups)
    return pair.inflation


@pytest.mark.slow
def test_bags_of_one_environment_do_not_separate_lags_of_board_and_gradient():
    result = fitted(chamber()[1])
    # Unknown initial lag states and thermometer noise limit the correlation of the two lags.
    assert inflation_of(result, 'board', 'gradient_lag') > 300.0
    (message,) = advice_of(result)
    assert 'do not tell a lag of the board temperature from a lag of T_case - T_board' in message
    assert 'such as with the fan off' in message
    assert any(note.startswith('alike: ') for note in result.calibration.provenance.notes)
    # The unit starts in a soak, on rigid supports: lag states and tilts are below the noise.
    noise = result.fit.selected.score.noise
    assert max(result.contributions.initial_lag_states, result.contributions.support_tilt) < noise
    assert result.contributions.thermal_response > 50.0 * noise


@pytest.mark.slow
def test_a_bag_without_fan_separates_lags_of_board_and_gradient():
    unit, bags = chamber()
    rng = rng_of('alike', 'still')
    result = fitted((*bags, record(unit, HALF, spread(1, rng)[0], rng, environment=STILL_AIR)))
    assert all(finding.name != 'environment' for finding in result.findings)
    assert not advice_of(result)
    # Without fan the gradient of a ramp is 1 / 0.7 = 1.43 times as large. With one such bag in ten
    # the columns differ by 0.43 * sqrt(0.1 * 0.9) = 0.13 RMS: variance inflation 0.13^-2 = 60.
    assert 30.0 < inflation_of(result, 'board', 'gradient_lag') < 90.0


@pytest.mark.slow
def test_one_attitude_in_the_chamber_does_not_separate_bias_and_scale():
    rng = rng_of('alike', 'bench')
    unit = navigation(rng)
    bench = positions(unit, ROOM, spread(18, rng), rng)
    one, two = (fitted((*bench, *positions(unit, HALF, UP, rng)[:n])) for n in (1, 2))
    (message,) = advice_of(one)
    assert 'changes of the bias from changes of the scale factor' in message
    assert 'with this axis at another angle to the vertical' in message
    assert inflation_of(two, 'curve', 'curve') < 10.0
    assert 'scale' not in ''.join(advice_of(two))


@pytest.mark.parametrize(
    ('parts', 'correlation', 'n_directions', 'is_advised'),
    [
        (('bias', 'bias'), 0.996, 1, True),  # variance inflation factor: 125
        (('bias', 'bias'), 0.994, 9, False),  # variance inflation factor: 84
        (('bias', 'scale'), 0.996, 6, True),
        # The finding `positions` states that five attitudes do not separate bias and scale.
        (('bias', 'scale'), 0.996, 5, False),
    ],
)
def test_an_inflation_above_100_gives_advice(parts, correlation, n_directions, is_advised):
    groups = ('curve', 'curve') if 'scale' in parts else ('board', 'gradient')
    pairs = [
        Likeness(groups, parts, 'x', correlation),
        Likeness(('board', 'gradient_lag'), ('bias', 'bias'), 'y', 0.5),
    ]
    found = list(judge_likeness(pairs, n_directions))
    assert [finding.name for finding in found] == ['alike'] * is_advised
    if is_advised:
        assert 'on axis x' in found[0].message
        assert 'correlation 0.99600; in a model with both, the sd of a weight is 11' in (
            found[0].message
        )
