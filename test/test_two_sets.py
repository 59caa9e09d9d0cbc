# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the paper's two sets learn from the bags, and how a set goes on where its own bags ended.

"""

from dataclasses import replace

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set, rich_calibration
from fitting_truth import GRAVITY, Truth, table_of, without_memory

from thermo_comp.fitting.ladder import golovach_spec
from thermo_comp.fitting.regression import Freedom, regress
from thermo_comp.fitting.selection import Selector
from thermo_comp.fitting.start import constant_calibration, position_means, starting_solution
from thermo_comp.fitting.two_sets import even_handed, may_bend
from thermo_comp.unit.correction import Correction


@pytest.mark.parametrize(('power', 'order'), [(1, 1), (2, 2)])
def test_the_static_set_bends_where_the_soaks_do(power, order, rng):
    kept = np.arange(1, 3) <= power
    truth = without_memory(Truth())
    truth = replace(
        truth, bias_curve=truth.bias_curve * kept, scale_curve=truth.scale_curve * kept
    )
    table, _ = table_of(truth, 9, rng, window_s=300.0)
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    selector = Selector(table, GRAVITY, constant, Freedom(), lambda _name: None)
    assert selector.try_model(golovach_spec()).spec.static.n_free == order


def test_two_soaks_show_no_bend(rng):
    table, _ = table_of(Truth(), 3, rng, window_s=60.0)
    assert may_bend(table)
    assert not may_bend(table.select(table.is_dynamic | (table.t > 5.0)))


def test_the_dynamic_set_does_not_take_a_side(rng):
    # WHY: bags that cool by 30 K and warm by 15 K; a lag of 100 s shifts the bias by 13 counts
    # per K/min of rate, one way or the other.
    # WHAT: in truth the two directions have nothing in common, so a set for both must stay at the
    # static one. A plain fit goes to the side of the longer ramp.
    truth = Truth(
        time_constants_s=np.array([100.0]),
        bias_memory=np.array([[8.0], [-8.0], [8.0]]),
        scale_memory=np.zeros((3, 1)),
    )
    table, _ = table_of(truth, 9, rng, window_s=60.0)
    table = table.select(table.time < 10500.0)
    ramps = table.is_dynamic
    assert abs(table.rate[ramps].sum()) > 0.2 * np.abs(table.rate[ramps]).sum()
    constant = constant_calibration(position_means(table), GRAVITY, with_misalignment=True)
    start = starting_solution(table, golovach_spec(), GRAVITY, constant, np.zeros(0))
    plain = regress(table, start)
    even = even_handed(table, plain, Freedom())
    wrong = [worst(one.solution, truth) for one in (plain, even)]
    # Of 6.7 counts in a ramp of 0.5 K/min. What stays is the share of the lag that is not the
    # rate's: the acceleration times 100 s, a tenth in a board that relaxes with 600 s and more.
    assert wrong[0] > 2.0
    assert wrong[1] < 0.15 * 6.7


def worst(solution, truth):
    """Largest error of the dynamic set's bias within 10 K of the reference, counts."""
    t = np.linspace(-10.0, 10.0, 21)
    powers = np.stack((t, t * t))
    found = solution.bias[:, [0]] + solution.bias[:, [2]] + solution.bias[:, 3:5] @ powers
    return np.abs(found - truth.bias[:, None] - truth.bias_curve @ powers).max()


# thermal state: board, variance, rate, gradient, variance, weight, unknown
def state(board, weight):
    return (board, 0.0, board * 0.0, board * 0.0, 0.0, board * 0.0 + weight, board * 0.0)


UNIT = calibration(
    static=regime_set(axis_set((0.0, 0.3), (1.0, 1e-4)), temperature_range_c=(10.0, 25.0)),
    dynamic=regime_set(
        axis_set((0.0, 0.2, 0.01), (1.0, 0.0, 1e-5), delta=2.0), temperature_range_c=(5.0, 35.0)
    ),
)


@pytest.mark.parametrize(
    ('board', 'bias', 'scale'),
    [
        (22.0, 0.6, 1.0002),
        # 1.5 at the edge of 25 degC, on by the dynamic 3.0 - 1.25; the scale by 1e-3 - 2.5e-4
        (30.0, 3.25, 1.00125),
        # where neither goes on, 35 degC: 5.25 - 1.25
        (45.0, 1.5 + 4.0, 1.0005 + 2e-3),
        # -3 at 10 degC, on by the dynamic (-3 + 2.25) - (-2 + 1); at 5 degC it ends
        (0.0, -2.75, 0.999 + 1.25e-3),
    ],
)
def test_a_set_goes_on_as_the_other_does(board, bias, scale):
    # Sums of a few terms near 1: to the last digits.
    found = Correction(UNIT).bias_scale(state(board, 0.0))[0]
    assert found == pytest.approx((bias, 300.0 * scale), rel=1e-12)


def test_the_wider_set_keeps_to_itself():
    found = Correction(UNIT).bias_scale(state(45.0, 1.0))[0]
    # held at 35 degC: 2 + 0.2 * 15 + 0.01 * 225
    assert found == pytest.approx((7.25, 300.0 * (1.0 + 225e-5)), rel=1e-12)


def test_arrays_get_the_bits_of_floats():
    correction = Correction(UNIT)
    board = np.linspace(-5.0, 45.0, 101)
    weight = np.linspace(0.0, 1.0, 101)
    bias, scale = correction.bias_scale(state(board, weight))[0]
    for k, one in enumerate(board.tolist()):
        assert correction.bias_scale(state(one, float(weight[k])))[0] == (bias[k], scale[k])


def test_a_set_alone_is_what_the_blend_says_of_it(rng):
    # WHY: where one set counts alone the other one is not evaluated at all.
    # WHAT: a column in which both count somewhere is evaluated in full; each of its rows alone
    # must give the same bits, inside and outside the ranges, the regime known or not.
    unit = rich_calibration()
    correction = Correction(unit)
    n = 200
    columns = [
        rng.uniform(-5.0, 45.0, n),
        np.full(n, 1e-4),
        rng.uniform(-0.02, 0.02, n),
        rng.uniform(-3.0, 3.0, n),
        np.full(n, 1e-4),
        rng.choice([0.0, 1.0, 0.25], n),
        rng.choice([0.0, 0.0, 1.0], n),
    ]
    for _ in unit.memory_time_constants_s:
        columns += [rng.uniform(-3.0, 3.0, n), np.full(n, 1e-3)]
    values, variances = correction.evaluate(tuple(columns))
    n_alone = 0
    for k in range(n):
        row = tuple(float(column[k]) for column in columns)
        n_alone += row[5] != 0.25 and row[6] == 0.0
        assert correction.bias_scale(row) == [(bias[k], scale[k]) for bias, scale in values]
        assert correction.evaluate(row) == (
            [(bias[k], scale[k]) for bias, scale in values],
            [(a[k], b[k], c[k]) for a, b, c in variances],
        )
    assert n_alone > n / 4
