# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Lags, play operators and priors of initial lag states agree with closed formulas."""

import math

import numpy as np
import pytest
from builders import SECOND_NS
from scipy.integrate import solve_ivp

from thermo_comp.thermal.lags import START_JITTER, Lag, MemorySpec, start_covariance
from thermo_comp.thermal.memory import LagBank, ThermalMemory, memory_on_grid

TAUS = (60.0, 900.0, 7680.0)
TWO_STAGES = Lag('board', 900.0, 150.0)


@pytest.mark.parametrize('step_s', [0.5, 5.0, 77.0])
def test_the_lag_of_a_ramp_agrees_with_the_closed_formula(step_s):
    # After a soak, in a ramp u = r t, u - lagged u is r tau (1 - exp(-t / tau)) for any step.
    rate, n = 0.01, 200
    bank = LagBank(TAUS)
    for k in range(n + 1):
        bank.step(round(k * step_s * 1e9), rate * k * step_s)
    end = (n + 0.3) * step_s
    lag, extra = bank.at(round(end * 1e9), rate * end)
    assert lag == pytest.approx([rate * tau * -math.expm1(-end / tau) for tau in TAUS], rel=1e-9)
    assert (max(extra) > 0.0) == (step_s > 6.0)


def test_errors_of_a_lag_after_a_gap_a_jump_wrong_or_stuck_readings_agree_with_formulas():
    bank = LagBank((100.0, 1000.0))
    bank.step(0, 0.0)
    # A gap above tau / 10 adds variance to a lag: 50 s if tau is 100 s, but not if it is 1000 s.
    bank.step(50 * SECOND_NS, 2.0)
    lost = 2.0 * (1.0 - math.exp(-0.5))
    assert bank.extra == pytest.approx([lost**2, 0.0])
    assert bank.at(150 * SECOND_NS, 2.0)[1] == pytest.approx([lost**2 * math.exp(-2.0), 0.0])
    bank.note_jump(3.0)
    assert bank.extra == pytest.approx([lost**2 + 9.0, 9.0])
    bank = LagBank((100.0,))
    bank.step(0, 1.0)
    bank.step(0, 3.0)
    assert bank.at(0, 3.0)[0] == [2.0]
    bank = LagBank((100.0,))
    for second in range(2000):
        bank.step(second * SECOND_NS, 0.0, 0.5 if second else 0.0)
    assert bank.extra == pytest.approx([0.25], rel=1e-6)
    memory = ThermalMemory(MemorySpec(lags=(TWO_STAGES,)))
    memory.board_step(0, 0.0)
    memory.note_jump(2.0)
    # The lag is (900 * lag_900 - 150 * lag_150) / 750: errors of +-2 K add up to 2 K * 1.4.
    assert memory.at(0, 0.0, [0.0])[1] == pytest.approx((2.0 * 1.4) ** 2)
    memory = ThermalMemory(MemorySpec(lags=(('board', 900.0), ('case', 600.0))))
    memory.board_step(0, 20.0)
    memory.banks['case'].step(0, 1.0)
    at = (0, 20.0, [1.0])
    stuck, right = (2.0, 300.0), (0.0, 0.0)
    some = (), (stuck, right), (stuck, stuck)
    moving, board, both = (np.array(memory.at(*at, still)[1::2]) for still in some)
    share = 1.0 - np.exp(-300.0 / np.array([900.0, 600.0]))
    np.testing.assert_allclose(board - moving, (2.0 * share) ** 2)
    np.testing.assert_allclose(both - moving, (2.0 * share) ** 2 * [1.0, 2.0])


def after_two_stages(times, board):
    """Integrate two lags in series after a soak, whose input is the board; return the output."""

    def slope(t, parts):
        return [(np.interp(t, times, board) - parts[0]) / 900.0, (parts[0] - parts[1]) / 150.0]

    start = [board[0], board[0]]
    solved = solve_ivp(slope, (times[0], times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-9,
                       max_step=5.0)  # fmt: skip
    return solved.y[1]


def test_a_lag_of_two_stages_equals_two_parts_in_series(rng):
    times = np.arange(0.0, 7200.0, 30.0)
    board = 20.0 + np.cumsum(0.2 * rng.standard_normal(len(times)))
    spec = MemorySpec(lags=(TWO_STAGES, ('case', 900.0, 150.0)), plays=((900.0, 0.4, 150.0),))
    memory = ThermalMemory(spec)
    streamed = []
    for time, celsius in zip(times, board, strict=True):
        stamp = round(time * 1e9)
        memory.board_step(stamp, celsius)
        memory.banks['case'].step(stamp, celsius)
        streamed.append(memory.at(stamp, celsius, [celsius]))
    streamed = np.array(streamed)
    part = after_two_stages(times, board)
    # The solver has an error of some uK, because its steps do not end at corners of the input.
    np.testing.assert_allclose(streamed[:, 0], board - part, atol=1e-5)
    np.testing.assert_allclose(streamed[:, 2], part, atol=1e-5)
    assert np.abs(streamed[:, 4]).max() <= 0.4 + 1e-12
    held = streamed[:, 4] + part
    is_inside = np.abs(streamed[:, 4]) < 0.4 - 1e-9
    np.testing.assert_allclose(np.diff(held)[is_inside[1:] & is_inside[:-1]], 0.0, atol=1e-5)
    on_grid = memory_on_grid(spec, 30.0, board, [board])
    np.testing.assert_allclose(on_grid[:, [0, 2, 4]], streamed[:, [0, 2, 4]], atol=1e-9)


def test_the_lag_of_a_part_coupled_to_board_and_case_agrees_with_a_solver(rng):
    times = np.arange(0.0, 7200.0, 30.0)
    board, case = 20.0 + np.cumsum(0.2 * rng.standard_normal((2, len(times))), axis=1)
    lag = Lag('board', 900.0, 150.0, 'case', 0.4)
    spec = MemorySpec(lags=(lag, ('case', 900.0)), plays=((900.0, 0.4, 150.0, 'case', 0.4),))
    memory = ThermalMemory(spec)
    streamed = []
    for time, of_board, of_case in zip(times, board, case, strict=True):
        stamp, gradient = round(time * 1e9), of_case - of_board
        memory.banks['case'].step(stamp, gradient)
        memory.board_step(stamp, of_board)
        streamed.append(memory.at(stamp, of_board, [gradient]))
    streamed = np.array(streamed)
    part = after_two_stages(times, 0.6 * board + 0.4 * case)
    np.testing.assert_allclose(board - streamed[:, 0], part, atol=1e-5)
    on_grid = memory_on_grid(spec, 30.0, board, [case - board])
    np.testing.assert_allclose(on_grid[:, [0, 2, 4]], streamed[:, [0, 2, 4]], atol=1e-9)
    # The lag of a part contains the lagged gradient with a minus sign: the covariance is < 0.
    P = start_covariance(spec.lags)
    assert P[0, 1] < 0.0 < P[0, 0] + 2.0 * P[0, 1] + P[1, 1]
    # A lag with two inputs begins with the first value of the input that begins later.
    late = ThermalMemory(spec)
    late.board_step(0, 20.0)
    late.banks['case'].step(600 * SECOND_NS, 1.0)
    assert late.remaining_shares(700 * SECOND_NS)[0] == lag.remaining_share(100.0)


@pytest.mark.parametrize('second_s', [0.0, 150.0])
def test_the_lag_of_a_part_agrees_with_a_solver_if_the_thermometer_lags(rng, second_s):
    times = np.arange(0.0, 3600.0, 30.0)
    board = 20.0 + np.cumsum(0.2 * rng.standard_normal(len(times)))
    thermometer_s = 60.0

    def slope(t, nodes):
        u = np.interp(t, times, board)
        ahead = nodes[1] if second_s else u
        lags = thermometer_s, second_s or 1.0, 900.0
        return (np.array((u, u, ahead)) - nodes) / lags

    lag = Lag('board', 900.0, second_s, lead_s=thermometer_s)
    fine = np.arange(0.0, times[-1], 1.0)
    reading, _, part = solve_ivp(slope, (0.0, fine[-1]), [board[0]] * 3, t_eval=fine, rtol=1e-9,
                                 atol=1e-9, max_step=1.0).y  # fmt: skip
    behind = memory_on_grid(MemorySpec(lags=(lag,)), 1.0, reading, [reading])[:, 0]
    # `memory_on_grid` interpolates the readings linearly between their stamps.
    np.testing.assert_allclose(reading - behind, part, atol=1e-3)
    memory = ThermalMemory(MemorySpec(lags=(lag,)))
    for time, celsius in zip(fine, reading, strict=True):
        memory.board_step(round(time * 1e9), celsius)
    streamed = memory.at(round(fine[-1] * 1e9), reading[-1], [0.0])
    assert streamed[0] == pytest.approx(behind[-1], abs=1e-9)
    assert lag.by_board == pytest.approx(1.0 if second_s else 1.0 - thermometer_s / 900.0)
    assert sum(lag.shares) == pytest.approx(lag.by_board)


def test_the_prior_of_the_initial_state_of_two_stages_is_that_of_a_random_walk(rng):
    # The board temperature walks at random for 90 min, then is constant.
    D, step, n = 0.005, 6.0, 4000
    tau = np.array([900.0, 150.0])
    parts = np.zeros((n, 2))
    for _ in range(900):
        parts -= math.sqrt(D * step) * rng.standard_normal((n, 1))
        parts[:, 0] *= math.exp(-step / tau[0])
        parts[:, 1] += (parts[:, 0] - parts[:, 1]) * -math.expm1(-step / tau[1])
    P = start_covariance([TWO_STAGES])
    # n draws determine the variance to sqrt(2 / n) = 2.2 %; a time step is 4 % of tau = 150 s.
    assert np.mean(parts[:, 1] ** 2) == pytest.approx(P[0, 0], rel=0.11)
    for age in (150.0, 900.0, 2700.0):
        first = parts[:, 0] * math.exp(-age / tau[0])
        a, b = TWO_STAGES.shares
        late = a * first + (parts[:, 1] - a * parts[:, 0]) * math.exp(-age / tau[1])
        share = math.sqrt(np.mean(late**2) / np.mean(parts[:, 1] ** 2))
        assert TWO_STAGES.remaining_share(age) == pytest.approx(share, rel=0.05)
        assert b < 0.0 < share < 1.0


def test_the_hysteresis_loop_of_a_play_agrees_with_the_formula():
    # The play of an input v is v - 1 in rises, v + 1 in falls, and constant for 2 K at a reversal.
    memory = ThermalMemory(MemorySpec(plays=((0.0, 1.0),)))
    way = np.concatenate((np.linspace(0, 5, 51), np.linspace(5, 0, 51), np.linspace(0, 5, 51)))
    P = []
    for k, v in enumerate(way.tolist()):
        memory.board_step(k, v)
        P.append(memory.at(k, v, [0.0])[0] + v)
    up, down, again = P[:51], P[51:102], P[102:]
    assert up == pytest.approx([max(v - 1.0, 0.0) for v in way[:51]])
    assert down == pytest.approx([min(4.0, v + 1.0) for v in way[51:102]])
    assert again == pytest.approx([max(1.0, v - 1.0) for v in way[102:]])
    assert memory.at(200, 9.0, [0.0]) == [-1.0]
    assert memory.at(200, -9.0, [0.0]) == [1.0]


def test_initial_lag_states_have_the_prior_of_a_random_walk_and_decay(rng):
    D = 0.005
    tau = np.array([60.0, 240.0, 960.0])
    n, step = 4000, 6.0
    m = np.zeros((n, 3))
    for _ in range(900):
        walk = math.sqrt(D * step) * rng.standard_normal((n, 1))
        e = np.exp(-step / tau)
        m = m * e + walk * (tau / step) * (1.0 - e)
    P = start_covariance([('board', t) for t in tau])
    # n draws determine the variance to sqrt(2 / n) = 2.2 %; a time step is 10 % of tau = 60 s.
    np.testing.assert_allclose(m.T @ m / n, P, rtol=0.11)
    P = start_covariance((('board', 60.0), ('board', 3600.0), ('case', 3600.0), ('tip', 3600.0)))
    assert math.sqrt(P[1, 1]) == pytest.approx(3.0, rel=START_JITTER)
    assert math.sqrt(P[0, 0]) == pytest.approx(0.39, abs=0.005)
    assert math.sqrt(P[2, 2]) == pytest.approx(1.0, rel=START_JITTER)
    assert P[0, 1] == pytest.approx(0.005 * 60.0 * 3600.0 / 3660.0)
    assert not P[:2, 2:].any()
    assert P[2, 3] == 0.0
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert start_covariance(()).shape == (0, 0)
    memory = ThermalMemory(MemorySpec(lags=(('board', 60.0), ('board', 600.0), ('case', 600.0))))
    assert memory.remaining_shares(5) == [1.0, 1.0, 1.0]
    memory.board_step(0, 20.0)
    memory.banks['case'].step(300 * SECOND_NS, 2.0)
    shares = memory.remaining_shares(600 * SECOND_NS)
    assert shares == pytest.approx([math.exp(-10.0), math.exp(-1.0), math.exp(-0.5)])
