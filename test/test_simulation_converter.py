# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The charge-balancing converter: no charge is lost, and no result depends on blocks."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from thermo_comp.simulation.unit import balanced, first_charge, rounded


def test_sum_of_counts_is_the_integral_within_one_count(rng: np.random.Generator) -> None:
    charge = rng.uniform(-3000.0, 3000.0, (200_000, 3))
    start = first_charge(7)
    counts, _ = balanced(charge, start)
    # At every cycle, not only at the end; 1e-6 is the rounding of the float sum here.
    short = np.cumsum(charge, axis=0) + start / 2.0**40 - np.cumsum(counts, axis=0)
    assert short.min() > -1e-6
    assert short.max() < 1.0 + 1e-6


def test_a_day_at_100_hz_of_a_third_of_a_count_loses_nothing() -> None:
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


def test_blocks_of_any_size_give_the_same_counts(rng: np.random.Generator) -> None:
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


def test_output_saturates_at_the_words_ends_and_recovers() -> None:
    charge = np.array([[4e4, -4e4, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    counts, _ = balanced(charge, np.zeros(3, dtype=np.int64))
    np.testing.assert_array_equal(counts, [[32767, -32768, 0], [0, 0, 1], [1, 1, 0]])


def test_without_a_carry_each_cycle_is_rounded_by_itself() -> None:
    charge = np.full((5, 3), 10.4)
    counts, _ = rounded(charge, first_charge(0))
    np.testing.assert_array_equal(counts, 10)
