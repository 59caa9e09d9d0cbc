# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The claimed covariance includes errors after a start in a ramp, and outside the ranges."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import (
    GRAVITY,
    SECOND_NS,
    UNCHECKED,
    axis_set,
    calibration,
    drawn,
    regime_set,
    rich_calibration,
    term,
    warm,
)

from thermo_comp.online.compensator import Compensator
from thermo_comp.thermal.state import BOARD, RATE, WEIGHT, StateLayout
from thermo_comp.unit.calibration import AxisSet, LackOfFit, parameter_layout
from thermo_comp.unit.correction import VARIANCES, Correction
from thermo_comp.unit.covariance import N_ROWS
from thermo_comp.unit.functions import CubicSpline, Exponential, Polynomial
from thermo_comp.unit.prediction import SlowUncertainty, bias_scale_and_sd, ramp_states


def at_1_hz(unit, board, case=()):
    """Correct a sample per second; return all rows and the sd of the last x without noise."""
    compensator, rows = Compensator(unit, UNCHECKED), []
    for second, celsius in enumerate(board.tolist()):
        # With exactly constant readings both thermometers would count as faulty.
        stamp, flicker = 10**12 + second * SECOND_NS, 1e-5 * (-1) ** second
        compensator.push('board', stamp, celsius + flicker)
        if second < len(case):
            compensator.push('case', stamp, float(case[second]) - flicker)
        rows.append(compensator.process(stamp, 300.0, 300.0, 2943.0))
    return compensator, rows, math.sqrt(rows[-1][3] - compensator.thermal.correction.noise[0])


def test_the_claimed_sd_of_lags_covers_a_start_in_a_ramp():
    # WHY: after a restart in a ramp of 1 K/min an unknown lag has an sd of 1 K; 0.4 K was claimed.
    unit = calibration(response=(term('board', (30.0, 0.0, 0.0), tau_s=60.0),))
    soak, *ramps = (
        at_1_hz(unit, *[10.0 + rate / 60.0 * np.minimum(np.arange(61), end)] * 2)[2]
        for rate, end in ((0.0, 60), (1.0, 60), (1.0, 40))
    )
    # A lag error of 1 K is 30 / 300 m/s^2; after 60 s (tau) it has decayed to 1 / e.
    left = 30.0 / 300.0 / math.e
    assert soak == pytest.approx(0.387 * left, rel=0.2)
    assert ramps == pytest.approx([math.hypot(1.0, 0.387) * left] * 2, rel=0.2)
    # WHY: with the case 5 K above the board at the start, a lagged gradient erred by 5 claimed sd.
    response = (term('gradient_lag', (30.0, 0.0, 0.0), tau_s=600.0),)
    unit = replace(calibration(response=response), board_lag_s=300.0)
    risen = (np.maximum(np.arange(761) - begin, 0) / 60.0 for begin in (0, 700))
    at_once, late = (at_1_hz(unit, 10.0 + rise, 15.0 + rise)[2] for rise in risen)
    # A gradient error of 1 K is 30 / 300 m/s^2; it decays with tau = 600 s for 760 s.
    left = 30.0 / 300.0 * math.exp(-760.0 / 600.0)
    assert at_once == pytest.approx(math.hypot(5.0, 0.41) * left, rel=0.2)
    assert late < 0.2 * at_once


def test_without_case_readings_the_gradient_is_that_at_rest():
    of_gradient = (term('gradient', (30.0, 0.0, 0.0)),)
    soak = np.full(2000, 20.0)
    _, corrected, _ = at_1_hz(calibration(response=of_gradient), soak, soak[:1500] - 1.0)
    # An error of 0.1 K of the gradient is 3 counts (30 counts/K), or 0.01 m/s^2.
    assert corrected[-1][0] == pytest.approx(corrected[1499][0], abs=0.01)
    unit = calibration(response=of_gradient, rest_gradient_range_k=(-1.1, -0.9))
    compensator, corrected, _ = at_1_hz(unit, soak[:60])
    # A gradient of -1 K changes the raw value by -30 counts, or 0.1 m/s^2.
    assert corrected[-1][0] == pytest.approx(1.1, abs=0.01)
    assert not compensator.thermal.tracker.loose_k(-1.0)


def test_beyond_1_g_the_covariance_includes_an_unknown_k2():
    # Beyond 1.01 g the claimed sd contains K2 (|f| - 1.01 g)^2, where K2 has an sd of 100 ug/g^2.
    compensator = Compensator(calibration(), UNCHECKED)
    warm(compensator, start_s=1000, until_s=1001)
    at_1_g, at_4_g = (
        compensator.process(10**12 + k * 10**6, 0.0, 0.0, 300.0 * 9.80665 * force)
        for k, force in enumerate((1.0, 4.0))
    )
    grown = 9.80665e-4 * (4.0 - 1.01) ** 2
    assert math.sqrt(at_4_g[8] - at_1_g[8]) == pytest.approx(grown, rel=0.01)
    assert at_4_g[3] == pytest.approx(at_1_g[3])


@pytest.mark.parametrize('fault', ['both stand still', 'swapped topics'])
def test_the_claimed_sd_covers_thermometer_errors_for_parts_that_lag_the_board(fault):
    # WHY: the claimed sd lacked errors of T_board that last and act through a part that lags.
    per_kelvin, axis = 30.0, axis_set((0.0, 30.0))
    part = term('board', (-per_kelvin, 0.0, 0.0), tau_s=600.0)
    parts = regime_set(x=axis, rate_range_k_min=(-5.0, 5.0))
    unit = calibration(static=parts, dynamic=parts, response=(part,), board_lag_s=60.0)
    compensator = Compensator(unit, UNCHECKED)
    of_part, errors, sds = 20.0, [], []
    for second in range(3600):
        stamp = 10**12 + second * SECOND_NS
        ramp_s = max(second - 1200.0, 0.0)
        # The case changes by 1 K/min, and the board lags the case by 60 s, which is 1 K.
        case, board = 20.0 + ramp_s / 60.0, 20.0 + max(ramp_s - 60.0, 0.0) / 60.0
        of_part += (board - of_part) / 600.0
        flicker = 2e-3 * (second % 3)
        readings = {'board': board + flicker, 'case': case - flicker}
        if fault == 'swapped topics':
            readings = {'board': readings['case'], 'case': readings['board']}
        elif second >= 1500:
            readings = {'board': 24.0, 'case': 25.0}
        for name, celsius in readings.items():
            compensator.push(name, stamp, celsius)
        if second % 4:
            continue
        row = compensator.process(stamp, per_kelvin * (of_part - 20.0), 0.0, 2943.0)
        if second >= 1800:
            errors.append(row[0])
            sds.append(math.sqrt(row[3] - compensator.thermal.correction.noise[0]))
    ratio = np.abs(errors) / sds
    assert ratio.max() < 3.0
    assert ratio.max() > 0.1


def test_the_lack_of_fit_is_included_in_the_sd_of_bias_and_of_scale():
    # WHY: the lack of fit increased the sd of the bias only, not the sd of the scale factor.
    lacks = LackOfFit(0.0, (0.0, 3e-3, 4e-3)), LackOfFit(20.0, (0.0, 0.0, 0.0))
    plain = calibration()
    lacking = replace(plain, static=replace(plain.static, lack_of_fit=lacks))
    states = ramp_states(plain, np.array([0.0, 20.0]))
    before, after = (np.square(bias_scale_and_sd(unit, states)) for unit in (plain, lacking))
    added = np.array([[0.0, 3e-3, 4e-3], [0.0, 0.0, 0.0]]) ** 2
    np.testing.assert_allclose(after[1] - before[1], added, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(after[3] - before[3], added / GRAVITY**2, rtol=1e-9, atol=1e-18)


def test_a_state_beyond_the_edge_of_a_column_is_limited_and_increases_the_sd():
    unit = calibration(response=(term('gradient', (30.0, 0.0, 0.0), range=(-1.0, 1.0)),))
    correction = Correction(unit)
    inside, outside = ((20.0, 0.0, 0.0, 0.0, 0.0, g, 0.0) for g in (1.0, 3.0))
    edge, beyond = (correction.line(s, s, np.zeros(N_ROWS), 0.0) for s in (inside, outside))
    assert beyond[:12].tolist() == edge[:12].tolist()
    assert math.sqrt(beyond[12] - edge[12]) == pytest.approx(30.0 / 300.0 * 2.0)
    of_y = [27, 29, 32]  # rows with the coefficients of 1, f and f^2 in the variance of axis y
    assert beyond[of_y].tolist() == edge[of_y].tolist()
    excess = correction.excess(outside, is_dynamic=False)
    assert (excess.relative, excess[:3]) == (pytest.approx(2.0), (0.0, 0.0, 2.0))


def sd_at(unit, board, behind=0.0, force=0.0):
    """Return the claimed sd of x in a soak, without noise; `behind`: lag of its part [K]."""
    correction = Correction(unit)
    layout = StateLayout(correction.memory)
    state = [0.0] * layout.width
    state[BOARD] = board
    for lag in layout.lags:
        state[layout.places[lag]] = behind
    a, b, c = correction.line(tuple(state), tuple(state), np.zeros(N_ROWS), 0.0)[12:15]
    return math.sqrt(a - correction.noise[0] + b * force + c * force**2)


def test_a_line_of_many_states_takes_one_noise_excess_for_all():
    # `update` evaluates the states of all rests of a log at once, with a `noise_excess` of 0.
    correction = Correction(rich_calibration())
    states = ramp_states(rich_calibration(), np.linspace(10.0, 30.0, 2049)).T
    line = correction.line(states, states, np.zeros((N_ROWS, 2049)), 0.0)
    last = correction.line(states[:, -1], states[:, -1], np.zeros(N_ROWS), 0.0)
    assert line.shape == (52, 2049)
    np.testing.assert_array_equal(line[:, -1], last)


def test_outside_the_range_the_claimed_sd_is_that_of_curve_and_parts():
    # Outside the range no lag cancels the slope of the curve, so the slope adds to the claimed sd.
    parts = regime_set(axis_set((0.0, 0.5), residual_sd_m_s2=1e-6))
    lag = term('board', (-0.5, 0.0, 0.0), tau_s=600.0)
    unit = calibration(static=parts, dynamic=parts, response=(lag,))
    assert sd_at(unit, 35.0) == pytest.approx(1e-6, rel=1e-6)
    # The board is at 41 degC, 6 K above the range of 20 +- 15 degC.
    far = math.sqrt(1.0 + (6.0 / 15.0) ** 2)
    assert sd_at(unit, 41.0) == pytest.approx(0.5 * 6.0 / 300.0 * far, rel=1e-3)
    # At 35 degC the bias slope is 0.8 counts/K; at 10 m/s^2 the scale slope cancels it.
    bent = axis_set((0.0, 0.5, 0.01), (1.0, -0.8 / 3000.0), residual_sd_m_s2=1e-6)
    unit = calibration(static=regime_set(bent), dynamic=regime_set(bent))
    # The bias slope changes by 0.02 counts/K^2: over 30 K its sd is 0.02 * 30 / sqrt(12) counts/K.
    bends = 0.6 / math.sqrt(12.0)
    far = math.sqrt(1.0 + (6.0 / 15.0) ** 2)
    assert sd_at(unit, 41.0, force=10.0) == pytest.approx(bends * 6.0 / 300.0 * far, rel=0.05)
    assert sd_at(unit, 41.0) == pytest.approx(math.hypot(bends, 0.8) * 6.0 / 300.0 * far, rel=0.05)
    bent = regime_set(axis_set((0.0, 0.5, 0.01), residual_sd_m_s2=1e-6))
    unit = calibration(static=bent, dynamic=bent, response=(lag,))
    # The range is 5 to 35 degC. A part at 34 degC adds no variance; a part at 41 degC does.
    assert sd_at(unit, 33.0, behind=-1.0) == pytest.approx(1e-6, rel=1e-6)
    assert sd_at(unit, 33.0, behind=-8.0) == pytest.approx(bends * 6.0 / 300.0, rel=0.05)
    # WHY: a bump of the bias over a part's temperature caused 230 ug of error, 14 ug were claimed.
    unit = calibration(response=(term('bend', (0.5, 0.0, 0.0), tau_s=600.0),))
    # The slope is 0 below 20 degC and 0.5 counts/K above: over the range its sd is 0.25 counts/K.
    assert sd_at(unit, 7.0, behind=5.0) == pytest.approx(0.25 * 3.0 / 300.0, rel=0.1)


def curves_at(unit, celsius):
    """Return bias and relative scale of x in both regimes at n temperatures, shape (2, 2, n)."""
    return Correction(unit).curves.values(np.array(celsius))[:, ::3]


BENT, WAVY = (0.0, 0.5, 0.01), (0.0, -0.3, 0.02, 1e-3)


def test_beyond_the_range_curves_follow_their_tangent_or_the_other_set():
    static, dynamic = axis_set(BENT, (1.0, 1e-4, 2e-6)), axis_set(WAVY, (1.0, 5e-5), delta=2.0)
    unit = calibration(static=regime_set(static), dynamic=regime_set(dynamic))
    for edge, sign in ((35.0, 1.0), (5.0, -1.0)):
        celsius = edge + sign * np.array([0.0, 1e-9, 3.0, 7.5, 7.5 + 1e-9, 300.0])
        at_edge, *outside = np.moveaxis(curves_at(unit, celsius), 2, 0)
        t = edge - 20.0
        slopes = [
            [np.polynomial.Polynomial(c).deriv()(t) for c in rows]
            for rows in ((BENT, (1.0, 1e-4, 2e-6)), (WAVY, (1.0, 5e-5)))
        ]
        for value, beyond in zip(outside, (1e-9, 3.0, 7.5, 7.5, 7.5), strict=True):
            expected = at_edge + sign * beyond * np.array(slopes)
            np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12)
    # The static set of curves is valid from 5 to 35 degC, the dynamic set from 0 to 30 degC.
    unit = calibration(
        static=regime_set(axis_set(BENT)),
        dynamic=regime_set(axis_set(WAVY, delta=2.0), temperature_range_c=(0.0, 30.0)),
    )
    celsius = [-20.0, -7.5, -3.0, 0.0, 5.0, 30.0, 35.0, 38.0, 42.5, 60.0]
    static, dynamic = curves_at(unit, celsius)[:, 0]
    # Outside their common range, 5 to 30 degC, the sets differ as at the nearer end of this range.
    np.testing.assert_allclose((dynamic - static)[:5], dynamic[4] - static[4], rtol=1e-12)
    np.testing.assert_allclose((dynamic - static)[5:], dynamic[5] - static[5], rtol=1e-12)
    wavy, bent = np.polynomial.Polynomial(WAVY), np.polynomial.Polynomial(BENT)
    lower, upper = wavy.deriv()(-20.0), bent.deriv()(15.0)
    np.testing.assert_allclose(dynamic[:4] - dynamic[3], lower * np.array([-7.5, -7.5, -3, 0]))
    np.testing.assert_allclose(static[6:] - static[6], upper * np.array([0, 3, 7.5, 7.5]))


def test_the_sd_beyond_the_range_includes_every_parameter_of_the_tangents(rng):
    # A change of the parameters times the regressors is the change of bias and scale.
    spline = CubicSpline((-15.0, 0.0, 15.0), (-4.0, 0.0, 6.0))
    exponential = Exponential(-1.0, (1.0,), (18.0,))
    splined = AxisSet(spline, Polynomial((1.0, 1e-4)))
    two = AxisSet(exponential, Polynomial((1.0, 1e-4, 1e-6)))
    unit = calibration(
        static=regime_set(splined, two, axis_set(BENT)),
        dynamic=regime_set(two, splined, axis_set(WAVY), temperature_range_c=(0.0, 30.0)),
    )
    layout = parameter_layout(unit)
    change = 1e-3 * rng.standard_normal(layout.n_parameters)
    change[[level for block in layout.scale for level in (block.static, block.dynamic)]] = 0.0
    states = np.zeros((StateLayout(Correction(unit).memory).width, 9))
    states[BOARD] = -40.0, -5.0, 3.0, 20.0, 33.0, 36.0, 42.0, 43.0, 90.0
    states[WEIGHT] = 0.0, 1.0, 0.3, 0.5, 1.0, 0.3, 0.0, 0.7, 1.0
    regressors = Correction(unit).curves.regressors(states, np.zeros((0, 9)))
    moved_by = Correction(drawn(unit, layout, change)).bias_scale(states)
    moved_by -= Correction(unit).bias_scale(states)
    moved_by[1] /= 300.0
    for axis in range(3):
        for block, of, row in (
            (layout.bias[axis], regressors[axis], moved_by[0, axis]),
            (layout.scale[axis], regressors[axis + 3], moved_by[1, axis]),
        ):
            expected = change[block.static : block.end] @ of
            np.testing.assert_allclose(row, expected, rtol=1e-9, atol=1e-12)


def test_the_claimed_sd_grows_with_the_distance_from_the_range():
    unit = rich_calibration()
    correction = Correction(unit)
    slow = SlowUncertainty(unit, correction)
    no_shares = np.zeros((len(correction.memory.lags), 1))
    for sign in (1.0, -1.0):
        variances = []
        for beyond in (0.0, 0.1, 1.0, 3.0, 7.4, 7.6, 15.0, 40.0):
            state = np.zeros((StateLayout(correction.memory).width, 1))
            state[BOARD] = 20.0 + sign * (15.0 + beyond)
            line = correction.line(state, state, slow.at(state, no_shares), 0.0)
            variances.append(line[list(VARIANCES), 0])
        assert (np.diff(variances, axis=0) > 0.0).all()
        # If the true curve is constant outside the range, the error is within the claimed sd.
        slopes = np.abs(correction.curves.slopes(np.array([35.0]))[0, :3, 0]) / correction.K[:, 0]
        assert (np.sqrt(variances[3]) > 3.0 * np.abs(slopes)).all()


def test_rates_and_squares_beyond_their_range_increase_the_sd_by_their_distance():
    # WHY: in a ramp the variance of a unit fitted to soaks was too large by a factor of hundreds.
    soaks = regime_set(axis_set(residual_sd_m_s2=1e-5), rate_range_k_min=(-0.1, 0.1))
    sds = []
    for response in ((), (term('board', tau_s=600.0),)):
        correction = Correction(calibration(static=soaks, dynamic=soaks, response=response))
        state = np.zeros(StateLayout(correction.memory).width)
        state[BOARD], state[RATE] = 20.0, 2.0 / 60.0
        line = correction.line(state, state, np.zeros(N_ROWS), 0.0)
        sds.append(math.sqrt(line[VARIANCES[0]] - correction.noise[0]))
    # 2 K/min exceed the calibrated 0.1 K/min by 19 times 0.1 K/min: without lags the sd grows.
    assert sds == pytest.approx([1e-5 * math.hypot(1.0, 19.0), 1e-5], rel=1e-6)
    # WHY: for 100 times the largest fitted lag the ratio of squares, 10000, gave an sd of 0.1 g.
    unit = calibration(response=(term('square', (1.0, 0.0, 0.0), tau_s=600.0, range=(0.0, 0.01)),))
    correction = Correction(unit)
    state = np.zeros(StateLayout(correction.memory).width)
    state[BOARD], state[correction.layout.places[unit.response[0].source]] = 20.0, 10.0
    assert 99.0 < correction.excess(state, is_dynamic=False).relative < 150.0
