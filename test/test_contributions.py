# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A fit reports the sizes of initial lag states, tilts, offsets and slow noise in its bags."""

from dataclasses import fields, replace

import numpy as np
import pytest
import strangers_units as units
from builders import rms
from fitting_truth import GRAVITY, MICRO, NOMINAL, Truth, begin, candidates_of, prior_of, table_of
from simulation_helpers import sources_of
from strangers_cases import HALF

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.contributions import Contributions, contributions_of, judge_contributions
from thermo_comp.fitting.hyperparameters import settle
from thermo_comp.fitting.initial_triad import within_positions
from thermo_comp.fitting.unknowns import Noise
from thermo_comp.unit.gravity import MICRO_G

#: This sd of tilts has no visible effect, but is not 0: all truths draw equal random numbers.
NOTHING = Truth(tilt_sd=1e-15)


def table(truth):
    return table_of(truth, 24, np.random.default_rng(3), n_windows=60)


def settled(truth):
    windows, up = table(truth)
    regression, state = begin(windows, up)
    prior = prior_of(truth, offset_scale=30.0 * MICRO)
    posterior = settle(regression, state, prior, candidates_of(windows))
    return windows, contributions_of(regression, posterior)


@pytest.mark.parametrize(
    ('name', 'effect', 'tolerance'),
    [
        ('initial_lag_states', {'start_sd': 0.5, 'on_bias': 5.0 * NOTHING.on_bias}, 0.05),
        ('support_tilt', {'tilt_sd': 5e-6}, 0.05),
        # |f| determines 24 combinations of the 72 offsets. 9 of them act like changes of the
        # constants; from the other 15 the sd is known to 1 / sqrt(2 * 15) = 18 %.
        ('mounting_offsets', {'offset_sd': 30.0 * MICRO}, 0.36),
    ],
)
def test_the_size_of_an_effect_is_the_rms_that_it_adds_to_the_readings(name, effect, tolerance):
    truth = replace(NOTHING, **effect)
    windows, found = settled(truth)
    without, _ = table(replace(truth, start_sd=0.0, offset_sd=0.0, tilt_sd=NOTHING.tilt_sd))
    true = (table(truth)[0].mean - without.mean) / NOMINAL
    if name == 'support_tilt':
        true = within_positions(true, windows.position)
    hidden = truth.sigma[0] / np.sqrt(60.0)
    assert rms(true) > 5.0 * hidden
    assert getattr(found, name) == pytest.approx(rms(true), rel=tolerance)
    for other in ('initial_lag_states', 'support_tilt', 'mounting_offsets', 'slow_noise'):
        if other != name:
            assert getattr(found, other) < 2.0 * hidden


def test_a_plain_unit_has_its_thermal_response_and_nothing_else():
    windows, found = settled(NOTHING)
    moved = windows.columns - windows.columns.mean(axis=0)
    _, up = table(NOTHING)
    force = GRAVITY * up[windows.position]
    true = moved @ NOTHING.on_bias.T + force * (moved @ NOTHING.on_scale.T)
    assert found.thermal_response == pytest.approx(rms(true), rel=0.02)
    hidden = NOTHING.sigma[0] / np.sqrt(60.0)
    assert found.initial_lag_states < hidden
    assert found.support_tilt < hidden
    assert found.mounting_offsets < hidden
    assert (found.turn_on_offsets, found.slow_noise) == (None, 0.0)


def test_the_sd_of_correlated_noise_is_that_of_the_process():
    truth = replace(NOTHING, noise=Noise(4.0, 1800.0))
    _, found = settled(truth)
    assert found.slow_noise == pytest.approx(2.0 * truth.sigma[0], rel=0.15)


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('initial_lag_states', 90.0, ['starts']), ('initial_lag_states', 50.0, []),
        ('support_tilt', 90.0, ['supports']), ('support_tilt', None, []),
        ('mounting_offsets', 90.0, []),
    ],
)  # fmt: skip
def test_starts_and_tilts_larger_than_the_response_are_findings(name, value, expected):
    usual = dict.fromkeys((field.name for field in fields(Contributions)), 0.0)
    micro = None if value is None else value * MICRO_G
    values = Contributions(**{**usual, 'thermal_response': 60.0 * MICRO_G, name: micro})
    found = list(judge_contributions(values, 1.0 * MICRO_G))
    assert [finding.name for finding in found] == expected
    if expected:
        assert 'explain 90 ug RMS' in found[0].message
        assert 'thermal response of the unit, 60 ug' in found[0].message
    assert not list(judge_contributions(values, 100.0 * MICRO_G))


def test_a_support_that_tilts_more_than_the_unit_drifts_is_found():
    rng = units.rng_of('tilting support')
    slopes = np.array([[0.2, -0.3, 0.1]])
    unit = units.navigation(
        rng, bias_curve=slopes, scale_curve=0.0 * slopes, part_s=np.zeros(3), heat_k=1.0
    )
    # The support turns by 45 urad at 15 K from the reference temperature.
    bags = units.positions(
        unit, HALF, units.spread(9, rng), rng, tilt=np.array([1e-7, -2e-7, 1.5e-7])
    )
    options = FitOptions(gravity=units.GRAVITY, full_scale=8388607.0, groups=('curve',))
    result = fit(sources_of(bags), options)
    true = rms(np.concatenate([bag.force - bag.force.mean(axis=0) for bag in bags]))
    assert true > 5.0 * units.UG
    assert result.contributions.support_tilt == pytest.approx(true, rel=0.05)
    assert result.contributions.thermal_response < true
    assert result.contributions.initial_lag_states is None
    assert 'supports' in [finding.name for finding in result.findings]
