# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated units and scores of benchmarks/strangers.py agree with closed formulas."""

from dataclasses import replace

import numpy as np
import pytest
import strangers
import strangers_cases as cases
import strangers_units as units
from builders import axis_set, calibration, regime_set
from conftest import ROOT
from strangers_baselines import Minutes, by_drift, by_norm, minutes
from strangers_limits import LIMITS, Limit, Result, Score, best_baseline, misses, rows_of
from strangers_recorded import blocks_of, part, rests_of
from strangers_units import GRAVITY, UG, Bag, record, rng_of, spread

from thermo_comp.unit.calibration import Axes, AxisReference, parameter_layout
from thermo_comp.unit.posterior import posterior_of

ZEROS = np.zeros((1, 3))
LEVEL = np.array([0.0, 0.0, 1.0])
#: Six faces and the twelve edges of a cube.
ATTITUDES = np.array([
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)
    if 0 < abs(x) + abs(y) + abs(z) < 3
])  # fmt: skip
ATTITUDES = ATTITUDES / np.linalg.norm(ATTITUDES, axis=1)[:, None]


def unit(**given):
    perfect = {
        'bias': np.zeros(3), 'gain': np.zeros(3), 'misalignment': np.zeros(3), 'bias_curve': ZEROS,
        'scale_curve': ZEROS, 'counts': 0.0, 'density': 0.0, 'reading_sd': 0.0,
        'reading_step': 1e-9, 'heat_k': 0.0,
    }  # fmt: skip
    return units.Unit(**{**perfect, **given})


def ramp(given, rate, hours, environment=units.CHAMBER):
    """Ramp the air at `rate` [K/s] after a soak; return times [s] and all nodes' temperatures."""
    A, b, h = units.network(given, environment)
    at = np.arange(0.0, 3600.0 * hours, 10.0)
    return at, units.integrate(A, b, h, rate * at, 10.0, np.linalg.solve(A, -h))


def test_a_node_lags_a_ramp_by_its_time_constant_and_the_hidden_node_depends_on_the_air():
    # A node with x' = (u - x) / tau lags a ramp u by rate * tau after many time constants.
    lags = np.array([500.0, 900.0, 1500.0])
    _, states = ramp(unit(board_s=700.0, part_s=lags), 0.01, 12)
    case, board = states[-1, units.CASE], states[-1, units.BOARD]
    assert case - board == pytest.approx(0.01 * 700.0, rel=1e-6)
    assert board - states[-1, units.PARTS] == pytest.approx(0.01 * lags, rel=1e-6)
    # Behind a ramp u after a soak the lag of x is u - x = rate * tau * (1 - exp(-t / tau)).
    A, b, h = np.array([[-1 / 300.0]]), np.array([1 / 300.0]), np.zeros(1)
    at = np.arange(0.0, 1500.0, 5.0)
    states = units.integrate(A, b, h, 0.01 * at, 5.0, np.zeros(1))
    behind = 0.01 * at - states[:, 0]
    assert behind == pytest.approx(3.0 * (1.0 - np.exp(-at / 300.0)), abs=1e-12)
    # In a ramp (hidden node - board) / (case - board) depends on the air: still or in a chamber.
    shares = []
    for environment in (units.CHAMBER, units.STILL_AIR):
        _, states = ramp(unit(), 0.01, 12, environment)
        above = states[-1, units.HIDDEN] - states[-1, units.BOARD]
        shares.append(above / (states[-1, units.CASE] - states[-1, units.BOARD]))
    assert abs(shares[1] - shares[0]) > 0.3


def test_a_board_cooled_by_the_fan_follows_the_case_in_another_way_without_fan():
    given = unit(board_s=700.0, vent_share=0.3)
    lags = []
    for environment in (units.CHAMBER, units.STILL_AIR):
        at, states = ramp(given, 0.01, 12, environment)
        case, board, air = states[-1, units.CASE], states[-1, units.BOARD], 0.01 * at[-1]
        to_air = 0.3 * environment.vent
        # In a ramp the board stores heat that comes from the case and from the air.
        stored = 0.7 * (case - board) + to_air * (air - board)
        assert stored == pytest.approx(0.01 * 700.0, rel=1e-6)
        lags.append(case - board)
    assert lags[1] > 1.3 * lags[0]


def test_simulated_samples_have_the_stated_noise_bias_scale_and_misalignment():
    given = unit(
        bias=np.array([100.0, -200.0, 300.0]), gain=np.array([0.01, -0.02, 0.03]),
        misalignment=np.array([1e-3, 2e-3, -3e-3]), density=5.0,
    )  # fmt: skip
    bag = record(given, units.program(20, 120), ATTITUDES[3], rng_of('noise'))
    a, b, c = given.misalignment
    M = np.array([[1.0, 0.0, 0.0], [a, 1.0, 0.0], [b, c, 1.0]])
    corrected = (bag.samples - UG * given.bias) / (1.0 + given.gain) @ M.T
    error = corrected - bag.force
    n = len(error)
    sd = 5.0 * UG * np.sqrt(0.5)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * sd / np.sqrt(n)
    # n errors determine their sd to 1 / sqrt(2 n); scale errors change the sd by up to 3 %.
    assert error.std(axis=0) == pytest.approx([sd] * 3, rel=0.03 + 4.0 / np.sqrt(2 * n))


def test_a_support_tilts_with_temperature_squared_and_a_cold_start_is_at_air_temperature():
    axis = np.array([1e-6, 0.0, 0.0])
    bag = record(unit(), units.program(20, 10, (35, 1, 60)), LEVEL, rng_of('tilt'), tilt=axis)
    case = np.interp(bag.time_s - 1.0, *bag.temperatures['case'])
    angle = np.arctan2(-bag.force[:, 1], bag.force[:, 2])
    # The tolerance is the error of interpolation between case readings, which are 5 s apart.
    assert angle == pytest.approx(1e-6 * (case - 20.0) ** 2, abs=5e-7)
    assert np.linalg.norm(bag.force, axis=1) == pytest.approx(GRAVITY)
    given = unit(heat_k=2.0)
    cold = record(given, cases.FROST, LEVEL, rng_of('cold'), is_cold=True)
    warm = record(given, cases.FROST, LEVEL, rng_of('cold'))
    for bag, heat in ((cold, 0.0), (warm, 2.0)):
        board, case = bag.temperatures['board'][1][0], bag.temperatures['case'][1][0]
        # The tolerance: the chamber's ripple, 0.03 K, and self-heating in the first 0.3 s.
        assert board - case == pytest.approx(heat, abs=0.1)


def test_carried_remainders_give_exact_sums_and_flicker_noise_a_flat_allan_deviation():
    words = np.full((1000, 3), 0.3)
    kept, lost = (units.quantised(words, carries) for carries in (True, False))
    assert np.abs(np.cumsum(kept, axis=0) - np.cumsum(words, axis=0)).max() <= 0.5
    assert not lost.any()
    noise = units.flicker_noise(40_000, 2.0, 3.0, rng_of('flicker'))
    for size in (10, 100, 1000):
        means = noise.reshape(-1, size, 3).mean(axis=1)
        deviation = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))
        # 39 differences on each of three axes determine the Allan deviation to 7 %.
        assert deviation == pytest.approx(3.0, rel=0.2)


@pytest.fixture
def recorded(monkeypatch):
    """Replace `record` by a stub; return a function that gives the arguments that made a bag."""
    notes = {}

    def note(given, corners, up, rng, *, name='bag', **keys):
        bag = Bag(name, np.zeros(0), np.zeros((0, 3)), {}, np.asarray(up))
        notes[id(bag)] = (bag, given, np.asarray(corners), np.asarray(up), keys)
        return bag

    monkeypatch.setattr(cases, 'record', note)
    monkeypatch.setattr(units, 'record', note)
    monkeypatch.setattr(cases, 'bias_bound', lambda *_: np.ones(3))
    monkeypatch.setattr(cases, 'replace', lambda bag, **_: bag)
    return lambda bag: notes[id(bag)][1:]


@pytest.mark.parametrize('case', sorted(cases.CASES))
def test_the_fit_has_none_of_the_held_out_bags_and_none_of_their_programs(case, recorded):
    labels = []
    for study in cases.CASES[case][0](1):
        labels.append(study.label)
        held = [bag for name, bags in study.tests.items() if name != 'own bag' for bag in bags]
        assert held or study.bound is not None
        assert not {id(bag) for bag in held} & {id(bag) for bag in study.bags}
        programs = [recorded(bag)[1].tolist() for bag in study.bags]
        assert not [bag for bag in held if recorded(bag)[1].tolist() in programs]
        assert study.prior_of in ('', *labels)
        for name in study.tests or ('',):
            title = f'{case} {study.label}'.strip() + (f': {name}' if name else '')
            strangers.misses(strangers.rows_of([Result(title, 1)])[0], [])
    assert len(set(labels)) == len(labels)


def test_bias_offsets_of_the_case_turn_on_have_the_stated_sd(recorded):
    collected = {}
    for number in range(1, 9):
        for study in cases.turn_on(number):
            shifts = [recorded(bag)[3]['shift'] for bag in (*study.bags, *study.tests[''])]
            collected.setdefault((len(study.bags), study.label), []).append(shifts)
    expected = {(n, f'{n} at {sd} ug') for n in (9, 10, 12, 18) for sd in (0, 30, 300)}
    assert set(collected) == expected
    for (_, label), shifts in collected.items():
        sd, n = float(label.split()[2]), np.size(shifts)
        # n random offsets determine their sd to 1 / sqrt(2 n).
        assert np.std(shifts) == pytest.approx(sd, rel=5.0 / np.sqrt(2 * n), abs=1e-12)


def test_the_cramer_rao_bound_is_proportional_to_noise_over_root_of_the_data():
    rng = rng_of('bound')
    given = cases.navigation(rng, part_s=np.zeros(3))
    up = spread(12, rng)
    bags = cases.positions(given, units.program(20, 10, (30, 2, 10), (10, 2, 10)), up, rng)
    sd = cases.bias_bound(given, up, bags)
    louder = cases.bias_bound(replace(given, density=2.0 * given.density), up, bags)
    assert louder == pytest.approx(2.0 * sd, rel=1e-6)
    twice = cases.bias_bound(given, np.concatenate((up, up)), bags + bags)
    assert twice == pytest.approx(sd / np.sqrt(2.0), rel=1e-6)
    # If only the bias were unknown, its sd would be the noise of the mean of all samples.
    least = UG * given.density / np.sqrt(sum(len(bag.time_s) for bag in bags) * 2.0)
    assert (sd > least).all()
    assert (sd < 100.0 * least).all()


def of_attitudes(given, board):
    """Return noise-free means of samples in all `ATTITUDES` at each board temperature."""
    force = GRAVITY * np.repeat(ATTITUDES, len(board), axis=0)
    at = np.tile(board, len(ATTITUDES))
    parts = np.repeat(at[:, None], 3, axis=1)
    samples = given.sensed(force) * given.scale_at(parts) + UG * given.bias_at(parts)
    return Minutes(samples, at, force)


def curved_unit():
    """Make a unit whose bias is a cubic and whose scale is a linear function of temperature."""
    rng = rng_of('curved')
    return unit(
        bias=1500.0 * rng.standard_normal(3), gain=0.01 * rng.standard_normal(3),
        misalignment=1e-3 * rng.standard_normal(3),
        bias_curve=rng.standard_normal((3, 3)) * [[20.0], [1.0], [0.05]],
        scale_curve=50.0 * rng.standard_normal((1, 3)),
    )  # fmt: skip


def test_the_scipy_cubic_fits_a_cubic_bias_in_many_attitudes_and_its_drift_in_one():
    given = curved_unit()
    fit = of_attitudes(given, np.linspace(5, 35, 7))
    held = of_attitudes(given, np.array([8.0, 29]))
    forces = (by_norm([fit], order=order)(held) for order in (3, 0))
    cubic, constants = (strangers.error_of([force], [held], is_drift=False) for force in forces)
    # The cubic by scipy neglects products such as misalignment times bias, which are below 5 ug.
    assert cubic.vector < 5.0
    assert constants.vector > 50.0
    given = replace(curved_unit(), scale_curve=ZEROS)

    def one_pose(board):
        bag = of_attitudes(given, board)
        rows = slice(len(board))
        return Minutes(bag.samples[rows], bag.board[rows], bag.force[rows])

    fit, held = one_pose(np.linspace(5, 35, 31)), one_pose(np.array([9.0, 22]))
    error = strangers.error_of([by_drift([fit], 1.0, order=3)(held)], [held], is_drift=True)
    assert error.vector < 1e-6


def test_a_scipy_fit_to_one_attitude_does_not_change_the_scatter_of_forces():
    # WHY: without bounds a fit to one attitude found scale factors that made all forces equal.
    samples = GRAVITY * LEVEL + 0.3 * rng_of('few').standard_normal((200, 3))
    few = Minutes(samples, np.full(200, 20.0), np.full((200, 3), np.nan))
    assert by_norm([few])(few).std(axis=0) == pytest.approx(samples.std(axis=0), rel=0.4)


def test_the_bias_score_is_error_over_bound_and_error_over_claimed_sd():
    # The bias of x in the calibration has an error of 1 count, 1 / 300 m/s^2.
    bias = np.array([0.1, -0.2, 0.3])
    axes = Axes(*(AxisReference(300.0, 300.0 * b) for b in bias + np.array([1 / 300.0, 0.0, 0.0])))
    study = cases.Study('', (), {}, bound=cases.Bound(unit(counts=300.0), bias, np.full(3, 1e-3)))
    # The calibration claims a bias sd of 2e-3 m/s^2; the turn-on sd, 5e-3 m/s^2, is not counted.
    again = axis_set(residual_sd_m_s2=5e-3)
    known = regime_set(x=again, y=again, z=again)
    unknown = calibration(axes=axes, static=known, dynamic=known)
    layout = parameter_layout(unknown)
    variances = np.zeros(layout.n_parameters)
    variances[[block.static for block in layout.bias]] = (300.0 * 2e-3) ** 2
    posterior = posterior_of(np.diag(variances))
    score = strangers.bias_score(replace(unknown, posterior=posterior), study)
    assert score.ratio == pytest.approx(1 / 0.6 / np.sqrt(3.0))
    assert score.vector == pytest.approx(1 / 300.0 / UG)
    assert score.bound_ratio == pytest.approx(1 / 0.3 / np.sqrt(3.0))


def test_a_minute_is_a_mean_whose_claimed_sd_is_its_noise():
    time_s = np.arange(1.0, 151.0)
    samples = np.repeat(time_s[:, None], 3, axis=1)
    mean = minutes(Bag('', time_s, samples, {'board': (time_s, 2.0 * time_s)}))
    assert (mean.samples[:, 0].tolist(), mean.board.tolist()) == ([30.5, 90.5], [61.0, 181.0])
    assert np.isnan(mean.force).all()
    samples = np.tile(300.0 * GRAVITY * LEVEL, (30000, 1))
    samples[::2] += 1.0
    samples[1::2] -= 1.0
    out = strangers.corrected(calibration(), Bag('', np.arange(1, 30001) * 0.01, samples, {}))
    assert np.sqrt(np.diagonal(out.claim, axis1=1, axis2=2)) == pytest.approx(1e-4 / np.sqrt(60.0))
    assert out.white == pytest.approx([1e-8 / 60.0] * 3)
    assert out.force == pytest.approx(np.tile(GRAVITY * LEVEL, (5, 1)))


def test_the_ratio_is_1_for_the_claimed_covariance_and_infinite_if_minutes_are_missing():
    rng = rng_of('ratio')
    n = 20000
    truth = np.broadcast_to(GRAVITY * LEVEL, (n, 3))
    root = 20.0 * UG * np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.2, -0.3, 2.0]])
    error = rng.standard_normal((n, 3)) @ root.T
    claim = np.broadcast_to(root @ root.T, (n, 3, 3))
    out = strangers.Corrected(truth + error, claim, np.zeros(3))
    scores = strangers.score([out], [Minutes(truth, np.zeros(n), truth)], is_drift=False)
    # 20000 windows determine the RMS of the errors to 0.5 %.
    assert (scores.ratio, scores.norm_ratio) == pytest.approx((1.0, 1.0), rel=0.02)
    assert scores.claim == pytest.approx(scores.vector, rel=0.02)
    truth = np.broadcast_to(GRAVITY * LEVEL, (100, 3))
    force = truth + UG
    claim = np.broadcast_to(UG**2 * np.eye(3), (100, 3, 3))
    for n_missing, expected in ((1, 1.0), (3, np.inf)):
        force[:n_missing] = np.nan
        out = strangers.Corrected(force, claim, np.zeros(3))
        scores = strangers.score([out], [Minutes(truth, np.zeros(100), truth)], is_drift=False)
        assert scores.ratio == pytest.approx(expected)


@pytest.mark.parametrize('name', ['units', 'cases', 'baselines', 'limits'])
def test_the_simulation_and_the_limits_import_nothing_of_the_package(name):
    source = (ROOT / 'benchmarks' / f'strangers_{name}.py').read_text(encoding='utf-8')
    imports = [line for line in source.splitlines() if 'import ' in line]
    assert imports
    assert not [line for line in imports if 'thermo_comp' in line]


def test_each_case_has_a_limit_and_misses_names_exactly_the_violated_limits():
    names = (*strangers.RECORDED, *cases.CASES)
    assert all(any(key.startswith(name) for key in LIMITS) for name in names)
    assert all(any(key.startswith(name) for name in names) for key in LIMITS)
    assert all(isinstance(limit, Limit) for limit in LIMITS.values())
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
    alone, joint = Score(20.0, 40.0, 1.0, 1.0, 40.0), Score(9.0, 30.0, 1.0, 1.0, 40.0)
    rows = rows_of([Result('third-node alone: its attitude', 1, {'fit': alone}),
                    Result('third-node joint: its attitude', 1, {'fit': joint})])  # fmt: skip
    assert misses(rows[0], rows) == []
    assert misses(rows[1], rows) == ['vector / alone: its attitude 0.75 > 0.5']


def carried_bag():
    """Return a day at 1 Hz: a turn to another attitude after 5 h, handling for 2 min at 10 h."""
    time_s = np.arange(1.0, 86401.0)
    force = np.where((time_s > 18000.0)[:, None], GRAVITY * LEVEL, GRAVITY * ATTITUDES[0])
    force[36000:36120] = 0.5
    return Bag('day', time_s, force, {'board': (time_s, np.full(len(time_s), 20.0))})


def test_a_recorded_day_is_divided_into_rests_and_blocks_of_3_h():
    rows = rests_of(carried_bag())
    expected = [(60, 17940), (18060, 35940), (36180, 86340)]
    assert [(rest.start, rest.stop) for rest in rows] == expected
    bag = carried_bag()
    blocks = blocks_of(part(bag, slice(9000, 86400), 'rest'), 'rest')
    assert list(blocks) == list(range(8))
    times = np.concatenate([block.time_s for block in blocks.values()])
    # The last sample, at 24 h, begins a block of one sample, which is too short.
    assert times.tolist() == bag.time_s[9000:-1].tolist()
    assert all((block.time_s // 10800.0 == number).all() for number, block in blocks.items())
