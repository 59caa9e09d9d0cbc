# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The ready-made units have the published properties; their converter loses no charge."""

from fractions import Fraction

import numpy as np
import pytest
from triads import TRIAD_NAMES, unit_of

from thermo_comp.simulation.drift import PartHistory, drift_of
from thermo_comp.simulation.presets import UNIT_NAMES, unit_preset
from thermo_comp.simulation.unit import balanced, first_charge, rounded

NAMES = (*UNIT_NAMES, *TRIAD_NAMES)


def _static(unit, board):
    """Return bias [ug] and relative scale after endless soaks at board temperatures."""
    still = []
    for temperature in board:
        parts = unit.network.equilibrium(unit.network.air_for('board', float(temperature)))
        deviation = (parts - unit.origin)[None]
        history = PartHistory(unit.network.nodes, deviation, unit.origin, 1.0)
        still.append(drift_of(unit.drift, history))
    bias, scale = zip(*still, strict=True)
    return np.concatenate(bias), np.concatenate(scale)


@pytest.mark.parametrize('name', NAMES)
def test_constants_hold_at_the_reference(name):
    unit = unit_of(name, 3)
    bias, scale = _static(unit, np.array([20.0]))
    np.testing.assert_allclose(bias, 0.0, atol=1e-9)
    np.testing.assert_allclose(scale, 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.triu(unit.M, 1), 0.0)
    np.testing.assert_array_equal(np.diag(unit.M), 1.0)


@pytest.mark.parametrize('seed', range(8))
def test_bare_quartz_has_the_published_slopes(seed):
    """
    Q-Flex class: scale slope 68..87 ppm/K from 5 to 35 degC with 0.31 ppm/K^2 of curvature, bias
    slope 0.3..5 ug/K.
    """
    unit = unit_preset('bare-quartz', seed)
    board = np.array([4.5, 5.5, 19.5, 20.0, 20.5, 34.5, 35.5])
    bias, scale = _static(unit, board)
    cold, hot = (scale[1] - scale[0]) * 1e6, (scale[6] - scale[5]) * 1e6
    # Specimens scatter by 1 % of the slope about the published values.
    np.testing.assert_allclose(cold, 68.0, atol=1.5)
    np.testing.assert_allclose(hot, 87.0, atol=1.5)
    curvature = 2.0 * (scale[4] + scale[2] - 2.0 * scale[3]) * 1e6
    np.testing.assert_allclose(curvature, 0.31, rtol=0.03)
    slope = np.abs(bias[4] - bias[2])
    assert np.all((slope > 0.29) & (slope < 5.05))


@pytest.mark.parametrize('seed', range(8))
def test_mems_bias_moves_by_hundreds_of_micro_g(seed):
    bias, _ = _static(unit_preset('mems', seed), np.array([19.5, 20.5]))
    slope = np.abs(bias[1] - bias[0])
    assert np.all((slope > 90.0) & (slope < 550.0))


def test_specimens_differ_and_return():
    for name in NAMES:
        assert unit_of(name, 1) == unit_of(name, 1)
        assert unit_of(name, 1) != unit_of(name, 2)
        assert unit_of(name, 1).serial == f'{name}-0001'
    with pytest.raises(ValueError, match=r"`name` must be one of thermostatted, .*, got 'laser'"):
        unit_preset('laser')

    # Noise of the reference: 5 ug/sqrt(Hz) over 60 s is 0.65 ug; a count per minute at 10 Hz adds
    # 0.23.


def test_sum_of_counts_is_the_integral_within_one_count(rng):
    charge = rng.uniform(-3000.0, 3000.0, (200_000, 3))
    start = first_charge(7)
    counts, _ = balanced(charge, start)
    # At every cycle, not only at the end; 1e-6 is the rounding of the float sum here.
    short = np.cumsum(charge, axis=0) + start / 2.0**40 - np.cumsum(counts, axis=0)
    assert short.min() > -1e-6
    assert short.max() < 1.0 + 1e-6


def test_a_day_at_100_hz_of_a_third_of_a_count_loses_nothing():
    """
    WHY: a float sum of 1e9 counts has no digits left for the fraction.

    WHAT: integer and fraction are separate, so that a day ends at the exact count.
    """
    charge = np.full((400_000, 1), 2978.0 + 1.0 / 3.0)
    remainder = np.zeros(1, dtype=np.int64)
    total, n_cycles = 0, 0
    for _ in range(22):  # 24 h at 100 Hz are 8.64 million cycles
        counts, remainder = balanced(charge, remainder)
        total += int(counts.sum())
        n_cycles += len(counts)
    exact = n_cycles * Fraction(8935, 3)
    # The fraction is kept to 2^-40 count: 8.8e6 of them could be off by 8e-6 count.
    assert abs(total - exact) < 1 + 1e-4


def test_blocks_of_any_size_give_the_same_counts(rng):
    charge = rng.normal(0.0, 2e4, (10_000, 3))
    start = first_charge(1)
    whole, last = balanced(charge, start)
    for size in (1, 7, 999, 10_000):
        remainder, pieces = start, []
        for first in range(0, len(charge), size):
            counts, remainder = balanced(charge[first : first + size], remainder)
            pieces.append(counts)
        np.testing.assert_array_equal(np.concatenate(pieces), whole)
        np.testing.assert_array_equal(remainder, last)


def test_output_saturates_at_the_words_ends_and_recovers():
    charge = np.array([[4e4, -4e4, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    counts, _ = balanced(charge, np.zeros(3, dtype=np.int64))
    np.testing.assert_array_equal(counts, [[32767, -32768, 0], [0, 0, 1], [1, 1, 0]])


def test_without_a_carry_each_cycle_is_rounded_by_itself():
    charge = np.full((5, 3), 10.4)
    counts, _ = rounded(charge, first_charge(0))
    np.testing.assert_array_equal(counts, 10)
