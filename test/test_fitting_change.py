# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits of effects that are even in T_case - T_board about 0 or about the value in a soak."""

from itertools import pairwise

import numpy as np
import pytest
from builders import source_of
from scipy.signal import lfilter

from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.fitting.sensors import gradients_at_rest
from thermo_comp.simulation.campaign import positions

GRAVITY, MICRO = 9.80665, 9.80665e-6
STEP_S, OWN_HEAT_K = 2.0, 0.6
#: Noise of a sample [m/s^2]; a window of 60 s contains 30 samples.
NOISE = 4.0 * MICRO


def lagged(values, tau):
    share = 1.0 - np.exp(-STEP_S / tau)
    return lfilter([share], [1.0, share - 1.0], values - values[0]) + values[0]


def recorded(rng, up, name, targets):
    """Simulate a bias that is even in (T_case - T_board) - (this difference in a soak)."""
    corners = [(0.0, targets[0]), (900.0, targets[0])]
    for before, after in pairwise(targets):
        corners += [(corners[-1][0] + 60.0 * abs(after - before), after)]
        corners += [(corners[-1][0] + 1500.0, after)]
    time = np.arange(0.0, corners[-1][0], STEP_S)
    case = lagged(np.interp(time, *zip(*corners, strict=True)), 120.0)
    board = lagged(case, 500.0)
    heated = case - board
    board = board + OWN_HEAT_K
    t = board - 20.0
    change = np.sqrt(heated**2 + 0.4**2) - 0.4
    bias = np.outer(t, (8.0, -5.0, 11.0)) + np.outer(t**2, (0.05, 0.1, -0.08))
    bias += np.outer(change, (9.0, -12.0, 6.0)) * (1.0 + 0.01 * t[:, None])
    force = GRAVITY * up * (1.0 + 6e-5 * t[:, None])
    stamps = 10**18 + np.rint(time * 1e9).astype(np.int64)
    noise = 0.003 * rng.standard_normal((2, len(time)))
    board, case = np.round(np.stack((board, case)) + noise, 4)
    accel = force + bias * MICRO + NOISE * rng.standard_normal((len(time), 3))
    # One reading in 10 s suffices for ramps of 1 K/min.
    readings = (stamps[::5], board[::5], stamps[::5] + 1, case[::5])
    return source_of(stamps, accel, *readings, name=name)


@pytest.mark.slow
def test_effects_even_about_the_rest_gradient_are_found(rng):
    programs = ((20.0, 35.0, 5.0, 20.0), (5.0, 25.0, 12.0), (35.0, 15.0, 30.0))
    bags = [recorded(rng, up, f'p{k}', programs[k % 3]) for k, up in enumerate(positions(4, 3))]
    reduced = [reduce_source(bag, full_scale=None) for bag in bags]
    # Rates computed over 120 s cause most of the error of the gradient; noise adds only 0.1 mK.
    assert abs(gradients_at_rest(reduced, ('case',))['case'] + OWN_HEAT_K) < 0.005
    groups = ('curve', 'gradient', 'board', 'gradient_even', 'gradient_even_about_rest')
    about_rest, about_0 = (
        fit(bags, FitOptions(gravity=GRAVITY, input='m/s^2', groups=names))
        for names in (groups, groups[:-1])
    )
    kept = {column.group for column in about_rest.calibration.response}
    assert 'gradient_even_about_rest' in kept
    assert 'gradient_even' not in kept
    # The effect is even about T_case - T_board = -0.6 K; functions even about 0 K fit only part.
    floor = NOISE / np.sqrt(30.0)
    assert about_rest.residuals[-1].fitted.rms < 1.1 * floor
    assert about_0.residuals[-1].fitted.rms > 1.5 * floor
    assert about_0.residuals[-1].left_out.rms > 1.5 * about_rest.residuals[-1].left_out.rms


def test_forced_groups_are_fitted_together_with_permitted_groups(rng):
    bags = [recorded(rng, up, f'p{k}', (20.0, 30.0, 20.0)) for k, up in enumerate(positions(3, 3))]
    options = FitOptions(gravity=GRAVITY, input='m/s^2', groups=('curve',), forced=('gradient',))
    assert {column.group for column in fit(bags, options).calibration.response} == {'gradient'}
