# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The generators of benchmarks/strangers.py against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import strangers
import strangers_cases as cases
from strangers_helpers import ATTITUDES, LEVEL, unit
from strangers_limits import Result
from strangers_units import (
    BOARD,
    CASE,
    CHAMBER,
    GRAVITY,
    HIDDEN,
    PARTS,
    STILL_AIR,
    UG,
    Bag,
    integrate,
    network,
    program,
    quantised,
    record,
    rng_of,
    spread,
)


def ramp(given, rate, hours, environment=CHAMBER):
    """Integrate a ramp of the air [K/s] from rest; returns times and states."""
    A, b, h = network(given, environment)
    at = np.arange(0.0, 3600.0 * hours, 10.0)
    return at, integrate(A, b, h, rate * at, 10.0, np.linalg.solve(A, -h))


def test_a_node_lags_a_ramp_by_its_time_constant():
    # After many time constants x' = (u - x) / tau leaves u - x = rate * tau.
    lags = np.array([500.0, 900.0, 1500.0])
    given = unit(board_s=700.0, part_s=lags)
    _, states = ramp(given, 0.01, 12)
    case, board = states[-1, CASE], states[-1, BOARD]
    assert case - board == pytest.approx(0.01 * 700.0, rel=1e-6)
    assert board - states[-1, PARTS] == pytest.approx(0.01 * lags, rel=1e-6)


def test_the_integration_is_exact_on_the_way():
    # One lag behind a ramp from rest: u - x = rate * tau * (1 - exp(-t / tau)).
    A, b, h = np.array([[-1 / 300.0]]), np.array([1 / 300.0]), np.zeros(1)
    at = np.arange(0.0, 1500.0, 5.0)
    states = integrate(A, b, h, 0.01 * at, 5.0, np.zeros(1))
    behind = 0.01 * at - states[:, 0]
    assert behind == pytest.approx(3.0 * (1.0 - np.exp(-at / 300.0)), abs=1e-12)


def test_own_heat_warms_the_board_above_the_case():
    A, b, h = network(unit(heat_k=1.5, part_s=np.full(3, 900.0)))
    at_rest = np.linalg.solve(A, -b * 20.0 - h)
    assert at_rest[BOARD] - at_rest[CASE] == pytest.approx(1.5)
    assert at_rest[PARTS] == pytest.approx([at_rest[BOARD]] * 3)


def test_still_air_is_another_law_of_the_hidden_node():
    # In still air the hidden node has another temperature between case and board than in the
    # chamber, so that a prediction from the board in the chamber is wrong outside.
    shares = []
    for environment in (CHAMBER, STILL_AIR):
        _, states = ramp(unit(), 0.01, 12, environment)
        above = states[-1, HIDDEN] - states[-1, BOARD]
        shares.append(above / (states[-1, CASE] - states[-1, BOARD]))
    assert abs(shares[1] - shares[0]) > 0.3


def test_noise_bias_scale_and_misalignment_follow_their_definition():
    # corrected = M (measured - bias) / scale must give the force, except for white noise.
    given = unit(
        bias=np.array([100.0, -200.0, 300.0]), gain=np.array([0.01, -0.02, 0.03]),
        skew=np.array([1e-3, 2e-3, -3e-3]), density=5.0,
    )  # fmt: skip
    bag = record(given, program(20, 120), ATTITUDES[3], rng_of('noise'))
    a, b, c = given.skew
    M = np.array([[1.0, 0.0, 0.0], [a, 1.0, 0.0], [b, c, 1.0]])
    corrected = (bag.samples - UG * given.bias) / (1.0 + given.gain) @ M.T
    error = corrected - bag.force
    n = len(error)
    sd = 5.0 * UG * np.sqrt(0.5)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * sd / np.sqrt(n)
    # The sd of an sd over n samples is 1 / sqrt(2 n); gain and M change it by 3 %.
    assert error.std(axis=0) == pytest.approx([sd] * 3, rel=0.03 + 4.0 / np.sqrt(2 * n))


def test_a_support_tilts_with_the_square_of_temperature():
    axis = np.array([1e-6, 0.0, 0.0])
    bag = record(unit(), program(20, 10, (35, 1, 60)), LEVEL, rng_of('tilt'), tilt=axis)
    case = np.interp(bag.time_s - 1.0, *bag.temperatures['case'])
    angle = np.arctan2(-bag.force[:, 1], bag.force[:, 2])
    # Readings are 5 s apart and interpolated linearly; half a micro-radian is 1/450 of the largest
    # tilt.
    assert angle == pytest.approx(1e-6 * (case - 20.0) ** 2, abs=5e-7)
    assert np.linalg.norm(bag.force, axis=1) == pytest.approx(GRAVITY)


def test_cold_start_is_as_cold_as_the_air_and_then_warms_up():
    given = unit(heat_k=2.0)
    cold = record(given, cases.FROST, LEVEL, rng_of('cold'), is_cold=True)
    warm = record(given, cases.FROST, LEVEL, rng_of('cold'))
    for bag, heat in ((cold, 0.0), (warm, 2.0)):
        board, case = bag.temperatures['board'][1][0], bag.temperatures['case'][1][0]
        # The chamber's control oscillates by 0.03 K, and the first reading is 0.3 s after the
        # switch-on.
        assert board - case == pytest.approx(heat, abs=0.1)


def test_a_carry_on_loses_no_part_of_a_count():
    words = np.full((1000, 3), 0.3)
    kept, lost = (quantised(words, carries) for carries in (True, False))
    assert np.abs(np.cumsum(kept, axis=0) - np.cumsum(words, axis=0)).max() <= 0.5
    assert not lost.any()


def test_attitudes_are_unit_vectors_far_from_each_other():
    up = spread(18, rng_of('spread'))
    cosine = up @ up.T - np.eye(18)
    assert np.linalg.norm(up, axis=1) == pytest.approx(1.0)
    # 18 points on a sphere can be at most 49 degrees apart; random ones reach most of that.
    assert np.degrees(np.arccos(cosine.max())) > 30.0


@pytest.fixture
def recorded(monkeypatch):
    """Replace recordings by notes of their programs."""
    notes = {}

    def note(given, corners, up, rng, *, name='bag', **keys):
        bag = Bag(name, np.zeros(0), np.zeros((0, 3)), {})
        notes[id(bag)] = (bag, given, np.asarray(corners), np.asarray(up), keys)
        return bag

    monkeypatch.setattr(cases, 'record', note)
    monkeypatch.setattr(cases, 'bias_bound', lambda *_: np.ones(3))
    monkeypatch.setattr(cases, 'replace', lambda bag, **_: bag)
    return lambda bag: notes[id(bag)][1:]


@pytest.mark.parametrize('case', sorted(cases.CASES))
def test_held_out_bags_take_no_part_in_the_fit(case, recorded):
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


def test_turn_on_draws_its_positions_and_its_shifts(recorded):
    found = {}
    for number in range(1, 9):
        for study in cases.turn_on(number):
            shifts = [recorded(bag)[3]['shift'] for bag in (*study.bags, *study.tests[''])]
            found.setdefault((len(study.bags), study.label), []).append(shifts)
    expected = {(n, f'{n} at {sd} ug') for n in (9, 10, 12, 18) for sd in (0, 30, 300)}
    assert set(found) == expected
    for (_, label), shifts in found.items():
        sd, n = float(label.split()[2]), np.size(shifts)
        # The sd of an sd over n draws is 1 / sqrt(2 n).
        assert np.std(shifts) == pytest.approx(sd, rel=5.0 / np.sqrt(2 * n), abs=1e-12)


def test_the_bound_falls_with_noise_and_with_data():
    rng = rng_of('bound')
    given = cases.navigation(rng, part_s=np.zeros(3))
    up = spread(12, rng)
    bags = cases.positions(given, program(20, 10, (30, 2, 10), (10, 2, 10)), up, rng)
    sd = cases.bias_bound(given, up, bags)
    louder = cases.bias_bound(replace(given, density=2.0 * given.density), up, bags)
    assert louder == pytest.approx(2.0 * sd, rel=1e-6)
    twice = cases.bias_bound(given, np.concatenate((up, up)), bags + bags)
    assert twice == pytest.approx(sd / np.sqrt(2.0), rel=1e-6)
    # If only the bias is unknown, its sd is the noise of the mean over all samples.
    least = UG * given.density / np.sqrt(sum(len(bag.time_s) for bag in bags) * 2.0)
    assert (sd > least).all()
    assert (sd < 100.0 * least).all()
