# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""What the evidence chooses: groups, widths and noises of tables whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitting_truth import GROUPS, MICRO, Truth, begin, prior_of, table_of, widths

from thermo_comp.fitting.learning import Learnt, _downweight, _without, learn
from thermo_comp.fitting.posterior import Regression
from thermo_comp.fitting.unknowns import Known, Prior, Windows
from thermo_comp.fitting.windows import SET
from thermo_comp.fitting.worth import group_worth
from thermo_comp.typing import Bools, Floats

ALL = ('curve', 'board', 'idle')
STEPS = 12


def wide(truth: Truth) -> Prior:
    """All groups as wide as the fit begins with, and noises that are wrong."""
    return prior_of(
        truth,
        widths=widths(ALL, 1e-3, 1e-4),
        offset_sd=MICRO,
        sigma=np.full(3, 5.0 * MICRO),
        rho=np.zeros(3),
    )


def learnt_of(
    truth: Truth, n_positions: int, seed: int, forced: Bools | bool = False
) -> tuple[Regression, Learnt]:
    windows, up = table_of(truth, n_positions, np.random.default_rng(seed), n_windows=60)
    regression, state = begin(windows, up)
    return regression, learn(regression, state, wide(truth), forced)


@pytest.fixture(scope='module')
def noisy() -> tuple[Regression, Learnt, Truth]:
    truth = Truth(
        sigma=np.array([1.0, 2.0, 3.0]) * MICRO,
        walk=0.1 * MICRO,
        offset_sd=20.0 * MICRO,
        start_sd=0.3,
    )
    regression, found = learnt_of(truth, 18, 3)
    return regression, found, truth


@pytest.fixture(scope='module')
def calm() -> tuple[Regression, Learnt, Truth]:
    truth = Truth()
    regression, found = learnt_of(truth, 12, 4)
    return regression, found, truth


def test_what_explains_nothing_leaves(calm: tuple[Regression, Learnt, Truth]) -> None:
    _, found, _ = calm
    used = np.array(GROUPS) != 'idle'
    np.testing.assert_array_equal(found.prior.widths > 0.0, [used, used])
    assert {(worth.part, worth.group) for worth in found.worth} == {
        (part, group) for part in ('bias', 'scale') for group in ('curve', 'board')
    }
    # Its weights are 0, not small.
    idle = np.array(GROUPS) == 'idle'
    assert not found.posterior.state.weights[..., idle].any()


def test_what_is_forced_stays() -> None:
    kept = np.array([False, False, False, False, True, False])
    _, found = learnt_of(Truth(), 12, 4, kept)
    assert (found.prior.widths > 0.0).tolist() == 2 * [[True, True, True, True, True, False]]


def test_noises_come_out(noisy: tuple[Regression, Learnt, Truth]) -> None:
    _, found, truth = noisy
    prior = found.prior
    # 1080 windows per axis: white noise is known to 3 % and somewhat worse beside a walk.
    np.testing.assert_allclose(prior.sigma, truth.sigma, rtol=0.15)
    # A walk of 1 ug per root window beside 1, 2 and 3 ug of white noise: its square is known to
    # 1 / sqrt of some 500 / 170 / 90 effective steps; the curve takes a part of it.
    np.testing.assert_allclose(prior.sigma * np.sqrt(prior.rho), truth.walk, rtol=0.4)
    # 18 positions x 3 axes, of which directions, scale, bias and M take 36 + 9: nine are left,
    # a sd of 24 %.
    assert 0.5 < prior.offset_sd / truth.offset_sd < 1.7


def test_white_noise_is_not_taken_for_a_walk(calm: tuple[Regression, Learnt, Truth]) -> None:
    _, found, truth = calm
    np.testing.assert_allclose(found.prior.sigma, truth.sigma, rtol=0.12)
    # At the end of two hours it would have gone no further than the noise of one window.
    assert (found.prior.rho * 7200.0 < 1.0).all()


def test_widths_are_those_of_the_weights(calm: tuple[Regression, Learnt, Truth]) -> None:
    # The fixed point: sd^2 = sum of squares / effective parameters, three where all is seen.
    regression, found, truth = calm
    true = np.sqrt(np.mean((truth.on_bias * regression.rms) ** 2, axis=0))
    np.testing.assert_allclose(found.prior.widths[0, :4], true[:4], rtol=0.15)
    for worth in found.worth:
        assert 0.0 < worth.effective_parameters <= 6.0 + 1e-9
        assert len(worth.prior_sd) == 2


def test_truth_lies_within_the_claimed_sd(noisy: tuple[Regression, Learnt, Truth]) -> None:
    regression, found, truth = noisy
    posterior = found.posterior
    sd = np.sqrt(posterior.variance)
    pulls: list[Floats] = []
    for name in ('kappa', 'bias', 'skew', 'weights'):
        places, error = getattr(posterior.layout, name), getattr(posterior.state, name)
        error = error - getattr(truth, name) * (regression.rms if name == 'weights' else 1.0)
        if name == 'weights':
            # Those of the bias.
            places, error = places[0], error[0]
        used = places >= 0
        pulls.append((error[used] / sd[places[used]]).ravel())
    every = np.concatenate(pulls)
    # Some twenty numbers: their rms is known to 16 %, and learnt widths make it a little less so.
    assert 0.5 < np.sqrt(np.mean(every**2)) < 1.5
    assert np.abs(every).max() < 4.0


def test_worth_is_the_fall_of_the_evidence_without_it() -> None:
    # Savage-Dickey against brute force: solve without the group, the rest of the prior the same.
    # Exact in a linear problem; that of the directions is linear to noise / g.
    truth = Truth()
    windows, up = table_of(truth, 12, np.random.default_rng(8))
    # No start states: their product with the weights is not linear.
    windows = replace(
        windows, lag=np.full(len(GROUPS), -1), start=np.zeros_like(windows.start),
        start_covariance=np.zeros((0, 0)),
    )  # fmt: skip
    regression, state = begin(windows, up)
    prior = prior_of(truth, widths=widths(ALL, 3e-4, 3e-5))
    posterior = regression.solve(state, prior, n_steps=STEPS, tolerance=1e-9)
    worths = group_worth(regression, posterior, prior)
    assert [(worth.part, worth.group) for worth in worths] == [
        (part, group) for part in ('bias', 'scale') for group in ALL
    ]
    for worth in worths:
        rest = prior.widths.copy()
        rest[['bias', 'scale'].index(worth.part), np.array(GROUPS) == worth.group] = 0.0
        without = regression.solve(
            posterior.state, replace(prior, widths=rest), n_steps=STEPS, tolerance=1e-9
        )
        fall = posterior.log_evidence - without.log_evidence
        assert worth.log_evidence_change == pytest.approx(fall, rel=0.01, abs=0.02), worth
    told = {(worth.part, worth.group): worth for worth in worths}
    assert told['bias', 'board'].log_evidence_change > 10.0
    assert told['bias', 'idle'].log_evidence_change < 0.5


def test_what_a_group_explains_is_what_it_adds(calm: tuple[Regression, Learnt, Truth]) -> None:
    regression, found, truth = calm
    columns = regression.windows.columns[:, 2:4]
    told = {(worth.part, worth.group): worth for worth in found.worth}
    expected = np.sqrt(np.mean((columns @ truth.on_bias[:, 2:4].T) ** 2))
    # Some 100 ug beside a noise of 2.
    assert told['bias', 'board'].explains_m_s2 == pytest.approx(expected, rel=0.05)


def test_outliers_do_not_pull(calm: tuple[Regression, Learnt, Truth]) -> None:
    regression, one, truth = calm
    rng = np.random.default_rng(6)
    clean = regression.windows
    dirty = replace(clean, mean=clean.mean.copy())
    struck = rng.choice(len(clean.time), len(clean.time) // 50, replace=False)
    dirty.mean[struck] += 1000.0 * rng.normal(0.0, 200.0 * MICRO, (len(struck), 3))
    regression, state = begin(dirty, one.posterior.state.up)
    other = learn(regression, state, wide(truth))
    sd = np.sqrt(one.posterior.variance[one.posterior.layout.bias])
    # 2 % of the windows, each worth 3 sd at most, shift by about one sd; unbridled, each is worth
    # 100, and beside them the curve is not seen.
    assert np.abs((other.posterior.state.bias - one.posterior.state.bias) / sd).max() < 1.0
    np.testing.assert_allclose(other.prior.sigma, truth.sigma, rtol=0.2)
    np.testing.assert_array_equal(other.prior.widths[0] > 0.0, one.prior.widths[0] > 0.0)


def test_means_of_few_values_are_no_knocks() -> None:
    # A converter that carries its remainder: most means are equal, others a count more or less.
    windows, up = table_of(Truth(), 9, np.random.default_rng(2))
    regression, state = begin(windows, up)
    posterior = regression.solve(state, wide(Truth()), n_steps=1)
    values = np.random.default_rng(3).choice(
        [-2.0, 0.0, 2.0], posterior.whitened.shape, p=[0.15, 0.7, 0.15]
    )
    values[100] = 50.0
    before = regression.weight.copy()
    _downweight(regression, replace(posterior, whitened=values))
    changed = regression.weight / before
    assert changed[100].max() < 0.02
    np.testing.assert_array_equal(np.delete(changed, 100, axis=0), 1.0)


def test_progress_is_told() -> None:
    windows, up = table_of(Truth(), 9, np.random.default_rng(2), n_windows=20)
    regression, state = begin(windows, up)
    told: list[float] = []
    learn(regression, state, wide(Truth()), tell=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_of_two_that_are_almost_one_the_better_stays() -> None:
    truth = Truth()
    windows, up = table_of(truth, 18, np.random.default_rng(6), n_windows=60)
    columns = windows.columns.copy()
    noise = np.random.default_rng(7).standard_normal(len(columns))
    columns[:, 4] = columns[:, 2] + 0.02 * columns[:, 2].std() * noise
    regression, state = begin(replace(windows, columns=columns), up)
    found = learn(regression, state, wide(truth))
    assert found.prior.widths[0, 2] > 0.0
    assert found.prior.widths[0, 4] == 0.0
    left = regression.residual(found.posterior.state) / truth.sigma
    assert np.sqrt(np.mean(left**2)) < 1.05


@pytest.mark.parametrize('seed', range(4))
def test_where_no_soak_was_static_the_curve_is_of_both_sets(seed: int) -> None:
    # Static near the reference alone: beside it the set's slope says what the curve's does.
    truth = Truth()
    windows, up = table_of(truth, 12, np.random.default_rng(seed), n_windows=60)
    columns = windows.columns.copy()
    t = columns[:, 0]
    columns[:, 4] = t * (np.abs(t) > 0.1 * np.ptp(t))
    groups = tuple(SET if k == 4 else name for k, name in enumerate(GROUPS))
    regression, state = begin(replace(windows, columns=columns, groups=groups), up)
    found = learn(regression, state, wide(truth))
    assert found.prior.widths[0, 4] == 0.0
    assert not found.has_sets


def test_a_longer_memory_promises_what_it_brings() -> None:
    truth = Truth()
    windows, up = table_of(truth, 12, np.random.default_rng(8), n_windows=60)
    regression, state = begin(windows, up)
    allowed = prior_of(truth)
    short = _without(allowed, windows.reach > 2000.0)
    assert (short.widths[0] > 0.0).tolist() == [True, True, True, False, False, False]
    posterior = regression.solve(state, short, n_steps=12, tolerance=1e-9)
    absent = regression.ask_absent(posterior.state, short, allowed)
    promised = absent.gain(allowed.widths, windows.reach > 2000.0)

    def gain(part: float) -> float:
        longer = np.where(windows.reach > 2000.0, part * allowed.widths, short.widths)
        found = regression.solve(state, replace(short, widths=longer), 12, 1e-9)
        return found.log_evidence - posterior.log_evidence

    # What its start state takes beside it is not promised, nor how far the mode then moves.
    best = max(gain(float(part)) for part in 10.0 ** np.arange(-4.0, 1.01, 0.25))
    assert best > 100.0
    assert promised == pytest.approx(best, rel=0.05)
    # Of what is not there, nothing is promised.
    gone = truth.on_bias.copy(), truth.on_scale.copy()
    gone[0][:, 3], gone[1][:, 3] = 0.0, 0.0
    truth = replace(truth, on_bias=gone[0], on_scale=gone[1])
    windows, up = table_of(truth, 12, np.random.default_rng(8), n_windows=60)
    regression, state = begin(windows, up)
    posterior = regression.solve(state, short, n_steps=12, tolerance=1e-9)
    absent = regression.ask_absent(posterior.state, short, allowed)
    assert absent.gain(allowed.widths, windows.reach > 2000.0) < 3.0


@pytest.mark.parametrize(('start_sd', 'lower', 'upper'), [(0.0, 0.0, 0.15), (1.0, 0.8, 1.0)])
def test_how_bags_begin_is_learnt(start_sd: float, lower: float, upper: float) -> None:
    _, found = learnt_of(Truth(start_sd=start_sd), 18, 9)
    assert lower <= found.prior.start_share <= upper


@pytest.mark.parametrize('away', [0.0, 30.0])
def test_what_is_known_beforehand_is_believed_as_far_as_the_data_do(
    calm: tuple[Regression, Learnt, Truth], away: float
) -> None:
    # WHY: siblings, or a unit's last calibration, may be nearer to this unit than they look, or
    # farther. WHAT: of a narrow and a wide knowledge the evidence takes the one that is true.
    regression, found, truth = calm
    layout = regression.layout(wide(truth).widths > 0.0)
    mean = regression.vector(found.posterior.state, layout)[: layout.n_unit].copy()
    sd = np.full(layout.n_unit, 1e-5)
    mean[layout.weights[0, :, 0]] += away * sd[0]
    knowns = [Known(mean, np.diag((part * sd) ** -2.0)) for part in (1.0, 100.0)]
    prior = replace(wide(truth), known=knowns[-1])
    told = learn(regression, found.posterior.state, prior, knowns=knowns)
    assert told.prior.known is knowns[int(away > 0.0)]
    curve = regression.vector(told.posterior.state, layout)[layout.weights[0, :, 0]]
    true = regression.vector(found.posterior.state, layout)[layout.weights[0, :, 0]]
    # The same data say it: the two differ by less than each is uncertain.
    sd = np.sqrt(told.posterior.variance[layout.weights[0, :, 0]])
    assert np.abs(curve - true).max() < 2.0 * sd.max()


def test_what_supports_lean_by_comes_out_and_leaves_the_unit_alone() -> None:
    truth = Truth(lean_sd=5e-6)
    windows, up = table_of(truth, 12, np.random.default_rng(0), n_windows=60)
    stiff = replace(windows, lean=windows.lean[:, :0])

    def drift_left(table: Windows) -> tuple[Learnt, float]:
        regression, state = begin(table, up)
        found = learn(regression, state, wide(truth))
        missed = found.posterior.state.weights[0] / regression.rms - truth.on_bias
        return found, float(np.sqrt(np.mean((table.columns @ missed.T) ** 2)))

    found, left = drift_left(windows)
    # 12 positions x 2 angles x 2 columns: a sd of 10 %.
    assert 0.7 < found.prior.lean_sd / truth.lean_sd < 1.3
    # 5 urad lean 5 ug of any axis; the noise of 720 windows hides 0.1 ug of each weight.
    assert left < 0.5 * MICRO
    assert drift_left(stiff)[1] > 1.0 * MICRO


def test_a_stiff_support_is_not_seen_leaning(calm: tuple[Regression, Learnt, Truth]) -> None:
    regression, found, _ = calm
    assert np.abs(regression.gravity * found.posterior.state.lean).max() < 0.01 * MICRO


@pytest.mark.parametrize('seed', [3, 4, 5])
def test_no_better_choice_is_near_the_truth(seed: int) -> None:
    # Bags that began far from rest: each start is a product with the weights that are to be found.
    truth = Truth(start_sd=1.0)
    regression, found = learnt_of(truth, 12, seed)
    needed = np.array(GROUPS) != 'idle'
    prior = replace(wide(truth), widths=np.where(needed, wide(truth).widths, 0.0))
    state = replace(
        found.posterior.state,
        weights=truth.weights * regression.rms,
        start=np.zeros_like(found.posterior.state.start),
    )
    told = learn(regression, state, prior, forced=True)
    assert found.posterior.log_evidence > told.posterior.log_evidence - 1.0
