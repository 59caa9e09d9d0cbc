# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The judge of benchmarks/strangers.py, and the curves drawn by hand, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import strangers
import strangers_cases as cases
from builders import axis_set, calibration, regime_set
from conftest import ROOT
from strangers_baselines import Minutes, by_drift, by_norm, minutes
from strangers_helpers import ATTITUDES, LEVEL, ZEROS, unit
from strangers_limits import LIMITS, Limit, Result, Score, best_baseline, misses, rows_of
from strangers_recorded import blocks_of, part, rests_of
from strangers_units import GRAVITY, UG, Bag, rng_of

from thermo_comp.unit.calibration import Axes, AxisReference


def of_attitudes(given, board):
    """Make minute means of a unit in all attitudes at some temperatures of the board."""
    force = GRAVITY * np.repeat(ATTITUDES, len(board), axis=0)
    at = np.tile(board, len(ATTITUDES))
    parts = np.repeat(at[:, None], 3, axis=1)
    samples = given.sensed(force) * given.scale_at(parts) + UG * given.bias_at(parts)
    return Minutes(samples, at, force)


def curved_unit():
    """Make a unit that the cubic fitted by hand describes."""
    rng = rng_of('curved')
    return unit(
        bias=1500.0 * rng.standard_normal(3), gain=0.01 * rng.standard_normal(3),
        skew=1e-3 * rng.standard_normal(3),
        bias_curve=rng.standard_normal((3, 3)) * [[20.0], [1.0], [0.05]],
        scale_curve=50.0 * rng.standard_normal((1, 3)),
    )  # fmt: skip


def test_a_cubic_by_hand_finds_a_cubic_and_constants_do_not():
    given = curved_unit()
    fit, held = (
        of_attitudes(given, np.linspace(5, 35, 7)),
        of_attitudes(given, np.array([8.0, 29])),
    )
    cubic, constants = (
        strangers.error_of([by_norm([fit], order=order)(held)], [held], is_drift=False)
        for order in (3, 0)
    )
    # Remaining error: products of two small terms that the cubic does not contain.
    assert cubic.vector < 5.0
    assert constants.vector > 50.0


def test_constants_by_hand_keep_the_scale_of_few_attitudes():
    # One attitude and much scatter: the best fit is a scale that makes all forces equal.
    rng = rng_of('few')
    samples = GRAVITY * LEVEL + 0.3 * rng.standard_normal((200, 3))
    few = Minutes(samples, np.full(200, 20.0), np.full((200, 3), np.nan))
    force = by_norm([few])(few)
    assert force.std(axis=0) == pytest.approx(samples.std(axis=0), rel=0.4)


def test_a_bias_at_the_reference_is_held_against_its_bound():
    # A calibration in counts whose bias is wrong by 1 count, 1 / 300 m/s^2, on x.
    bias = np.array([0.1, -0.2, 0.3])
    axes = Axes(*(AxisReference(300.0, 300.0 * b) for b in bias + np.array([1 / 300.0, 0.0, 0.0])))
    bound = cases.Bound(unit(counts=300.0), bias, np.full(3, 1e-3))
    study = cases.Study('', (), {}, bound=bound)
    # An sd of 2e-3 m/s^2 that the calibration claims in addition to its white noise.
    claimed = axis_set(residual_sd_m_s2=2e-3)
    known = regime_set(x=claimed, y=claimed, z=claimed)
    found = strangers.bias_score(calibration(axes=axes, static=known, dynamic=known), study)
    assert found.ratio == pytest.approx(1 / 0.6 / np.sqrt(3.0))
    assert found.vector == pytest.approx(1 / 300.0 / UG)
    assert found.bound_ratio == pytest.approx(1 / 0.3 / np.sqrt(3.0))


def test_a_cubic_by_hand_finds_a_pose_s_drift():
    given = replace(curved_unit(), scale_curve=ZEROS)
    minutes_ = [
        of_attitudes(given, board) for board in (np.linspace(5, 35, 31), np.array([9.0, 22]))
    ]
    fit, held = (
        Minutes(one.samples[: len(one.board) // 18], one.board[: len(one.board) // 18],
                one.force[: len(one.board) // 18])
        for one in minutes_
    )  # fmt: skip
    error = strangers.error_of([by_drift([fit], 1.0, order=3)(held)], [held], is_drift=True)
    assert error.vector < 1e-6


def test_minutes_are_means_of_whole_minutes():
    time_s = np.arange(1.0, 151.0)
    samples = np.repeat(time_s[:, None], 3, axis=1)
    mean = minutes(Bag('', time_s, samples, {'board': (time_s, 2.0 * time_s)}))
    assert mean.samples[:, 0].tolist() == [30.5, 90.5]
    assert mean.board.tolist() == [61.0, 181.0]
    assert np.isnan(mean.force).all()


def test_a_ratio_is_1_where_errors_are_as_claimed():
    rng = rng_of('ratio')
    n = 20000
    truth = np.broadcast_to(GRAVITY * LEVEL, (n, 3))
    root = 20.0 * UG * np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.2, -0.3, 2.0]])
    error = rng.standard_normal((n, 3)) @ root.T
    claim = np.broadcast_to(root @ root.T, (n, 3, 3))
    out = strangers.Corrected(truth + error, claim, np.zeros(3))
    found = strangers.score([out], [Minutes(truth, np.zeros(n), truth)], is_drift=False)
    # 20000 windows determine an RMS to half a percent.
    assert (found.ratio, found.norm_ratio) == pytest.approx((1.0, 1.0), rel=0.02)
    assert found.claim == pytest.approx(found.vector, rel=0.02)


def test_a_claim_of_a_minute_is_the_noise_of_its_mean():
    # The calibration of the tests only claims white noise and the rounding of counts.
    samples = np.tile(300.0 * GRAVITY * LEVEL, (30000, 1))
    samples[::2] += 1.0
    samples[1::2] -= 1.0
    bag = Bag('', np.arange(1, 30001) * 0.01, samples, {})
    out = strangers.corrected(calibration(), bag)
    assert np.sqrt(np.diagonal(out.claim, axis1=1, axis2=2)) == pytest.approx(1e-4 / np.sqrt(60.0))
    assert out.white == pytest.approx([1e-8 / 60.0] * 3)
    assert out.force == pytest.approx(np.tile(GRAVITY * LEVEL, (5, 1)))


def test_minutes_that_are_not_published_may_be_few():
    truth = np.broadcast_to(GRAVITY * LEVEL, (100, 3))
    force = truth + UG
    claim = np.broadcast_to(UG**2 * np.eye(3), (100, 3, 3))
    for n_missing, expected in ((1, 1.0), (3, np.inf)):
        force[:n_missing] = np.nan
        out = strangers.Corrected(force, claim, np.zeros(3))
        found = strangers.score([out], [Minutes(truth, np.zeros(100), truth)], is_drift=False)
        assert found.ratio == pytest.approx(expected)


def test_a_row_says_what_it_misses_and_nothing_else():
    baselines = {'cubic': Score(50.0, 100.0), 'constants': Score(40.0, 200.0)}

    def missed(fit, title='ageing'):
        [row] = rows_of([Result(title, 1, {'fit': fit, **baselines})])
        assert (best_baseline(row, 'norm'), best_baseline(row, 'vector')) == (40.0, 100.0)
        return misses(row, [row])

    assert missed(Score(41.0, 104.0, 1.0, 1.4, 90.0)) == []
    assert missed(Score(43.0, 104.0, 1.0, 1.4, 90.0)) == ['norm / best 1.07 > 1.05']
    assert missed(Score(41.0, 104.0, 1.0, 1.6, 90.0)) == ['ratio 1.6 > 1.5']
    assert missed(Score(30.0, 90.0, 1.0, 0.6, 90.0), 'turn-on 9') == ['ratio 0.6 < 0.7']
    assert missed(Score(13.0, 90.0, 1.0, 1.0, 90.0), 'kink') == ['norm 13 > 12']


def test_a_fit_that_refuses_its_bags_misses():
    [row] = rows_of([Result('ageing', 1, {'cubic': Score(1.0, 1.0)}, refused='no rest')])
    assert misses(row, [row]) == ['refused']


def test_more_data_is_held_against_the_row_without_it():
    rows = rows_of(
        [
            Result(
                'third-node alone: its attitude', 1, {'fit': Score(20.0, 40.0, 1.0, 1.0, 40.0)}
            ),
            Result('third-node joint: its attitude', 1, {'fit': Score(9.0, 30.0, 1.0, 1.0, 40.0)}),
        ]
    )
    assert misses(rows[0], rows) == []
    assert misses(rows[1], rows) == ['vector / alone: its attitude 0.75 > 0.5']


def test_units_of_a_row_join_by_their_mean_square():
    [row] = rows_of(
        [
            Result('ageing', unit, {'fit': Score(norm, 1.0, 1.0, ratio, 1.0)}, fit_s=unit)
            for unit, norm, ratio in ((1, 3.0, 0.5), (2, 4.0, 1.2))
        ]
    )
    assert row.scores['fit'].norm == pytest.approx(np.sqrt(12.5))
    assert (row.worst, row.fit_s) == (1.2, 1.5)


@pytest.mark.parametrize('name', ['units', 'cases', 'baselines', 'limits'])
def test_generators_and_judge_share_no_code_with_the_package(name):
    source = (ROOT / 'benchmarks' / f'strangers_{name}.py').read_text(encoding='utf-8')
    imports = [line for line in source.splitlines() if 'import ' in line]
    assert imports
    assert not [line for line in imports if 'thermo_comp' in line]


def test_each_case_has_a_limit_and_each_limit_a_case():
    names = (*strangers.RECORDED, *cases.CASES)
    assert all(any(key.startswith(name) for key in LIMITS) for name in names)
    assert all(any(key.startswith(name) for name in names) for key in LIMITS)
    assert all(isinstance(limit, Limit) for limit in LIMITS.values())


def carried_bag():
    """Make a day at 1 Hz whose attitude changes after 5 h, with bumps for two minutes at 10 h."""
    time_s = np.arange(1.0, 86401.0)
    force = np.where((time_s > 18000.0)[:, None], GRAVITY * LEVEL, GRAVITY * ATTITUDES[0])
    force[36000:36120] = 0.5
    return Bag('day', time_s, force, {'board': (time_s, np.full(len(time_s), 20.0))})


def test_rests_of_a_recording_are_its_long_stays():
    rows = rests_of(carried_bag())
    # Without a minute at each end.
    expected = [(60, 17940), (18060, 35940), (36180, 86340)]
    assert [(rest.start, rest.stop) for rest in rows] == expected


def test_blocks_go_by_the_clock_and_share_no_sample():
    bag = carried_bag()
    blocks = blocks_of(part(bag, slice(9000, 86400), 'rest'), 'rest')
    assert list(blocks) == list(range(8))
    times = np.concatenate([block.time_s for block in blocks.values()])
    # The last sample would be a block alone.
    assert times.tolist() == bag.time_s[9000:-1].tolist()
    assert all((block.time_s // 10800.0 == number).all() for number, block in blocks.items())
