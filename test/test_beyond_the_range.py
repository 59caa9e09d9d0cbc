# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Corrections beyond calibrated ranges follow tangents, with a claimed sd that grows."""

import math

import numpy as np
import pytest
from builders import axis_set, calibration, drawn, regime_set, rich_calibration, term

from thermo_comp.thermal.state import BOARD, RATE, WEIGHT, Layout
from thermo_comp.unit.calibration import Axes, AxisReference, AxisSet, parameter_layout
from thermo_comp.unit.correction import VARIANCES, Correction
from thermo_comp.unit.covariance import N_ROWS
from thermo_comp.unit.functions import CubicSpline, Exponential, Polynomial
from thermo_comp.unit.prediction import SlowUncertainty


def test_a_state_beyond_the_edge_of_a_column_is_clipped_and_widens_the_sd():
    unit = calibration(
        axes=Axes(*[AxisReference(300.0, 0.0)] * 3),
        response=(term('gradient', (30.0, 0.0, 0.0), range=(-1.0, 1.0)),),
    )
    correction = Correction(unit)
    inside, outside = ((20.0, 0.0, 0.0, 0.0, 0.0, g, 0.0) for g in (1.0, 3.0))
    edge, beyond = (correction.line(s, s, np.zeros(N_ROWS), 0.0) for s in (inside, outside))
    assert beyond[:12].tolist() == edge[:12].tolist()
    assert math.sqrt(beyond[12] - edge[12]) == pytest.approx(30.0 / 300.0 * 2.0)
    of_y = [27, 29, 32]  # terms 1, y and y^2 of the covariance element yy
    assert beyond[of_y].tolist() == edge[of_y].tolist()
    excess = correction.excess(outside, is_dynamic=False)
    assert excess.relative == pytest.approx(2.0)
    assert excess[:3] == (0.0, 0.0, 2.0)


def sd_at(unit, board, behind=0.0, force=0.0):
    """Return the claimed sd of the x axis in a soak, without the noise of a message [m/s^2]."""
    correction = Correction(unit)
    layout = Layout(correction.memory)
    state = [0.0] * layout.width
    state[BOARD] = board
    for lag in layout.lags:
        state[layout.places[lag]] = behind
    line = correction.line(tuple(state), tuple(state), np.zeros(N_ROWS), 0.0)
    a, b, c = line[12:15]
    return math.sqrt(a - correction.noise[0] + b * force + c * force**2)


def test_beyond_the_range_lagging_parts_do_not_lower_the_claimed_sd():
    # For an error of the thermometer the slopes of curve and lag cancel inside the range only.
    bias = axis_set((0.0, 0.5), residual_sd_m_s2=1e-6)
    unit = calibration(
        static=regime_set(bias), dynamic=regime_set(bias),
        response=(term('board', (-0.5, 0.0, 0.0), tau_s=600.0),),
    )  # fmt: skip
    assert sd_at(unit, 35.0) == pytest.approx(1e-6, rel=1e-6)
    # The board is at 41 degC, 6 K outside a range of +-15 K.
    far = math.sqrt(1.0 + (6.0 / 15.0) ** 2)
    assert sd_at(unit, 41.0) == pytest.approx(0.5 * 6.0 / 300.0 * far, rel=1e-3)


def test_beyond_the_range_slopes_that_cancel_do_not_lower_the_claimed_sd():
    # At the upper edge the bias slope is 0.8 counts/K, which the scale slope cancels at a force of
    # 10 m/s^2.
    bent = axis_set((0.0, 0.5, 0.01), (1.0, -0.8 / 3000.0), residual_sd_m_s2=1e-6)
    unit = calibration(static=regime_set(bent), dynamic=regime_set(bent))
    # Over the range of 30 K the bias slope varies with an sd of 0.02 * 30 / sqrt(12) counts/K,
    # more on a coarse grid.
    bends = 0.6 / math.sqrt(12.0)
    far = math.sqrt(1.0 + (6.0 / 15.0) ** 2)
    assert sd_at(unit, 41.0, force=10.0) == pytest.approx(bends * 6.0 / 300.0 * far, rel=0.05)
    assert sd_at(unit, 41.0) == pytest.approx(math.hypot(bends, 0.8) * 6.0 / 300.0 * far, rel=0.05)


def curves_at(unit, celsius):
    """Return bias and relative scale of x in both sets at temperatures, shape (2, 2, n)."""
    return Correction(unit).curves.values(np.array(celsius))[:, ::3]


BENT, WAVY = (0.0, 0.5, 0.01), (0.0, -0.3, 0.02, 1e-3)


def test_beyond_the_range_curves_follow_their_tangent_for_a_quarter_of_the_span():
    static, dynamic = axis_set(BENT, (1.0, 1e-4, 2e-6)), axis_set(WAVY, (1.0, 5e-5), delta=2.0)
    unit = calibration(static=regime_set(static), dynamic=regime_set(dynamic))
    for edge, sign in ((35.0, 1.0), (5.0, -1.0)):
        at_edge, *outside = np.moveaxis(
            curves_at(unit, edge + sign * np.array([0.0, 1e-9, 3.0, 7.5, 7.5 + 1e-9, 300.0])), 2, 0
        )
        t = edge - 20.0
        slopes = [
            [np.polynomial.Polynomial(c).deriv()(t) for c in rows]
            for rows in ((BENT, (1.0, 1e-4, 2e-6)), (WAVY, (1.0, 5e-5)))
        ]
        for value, beyond in zip(outside, (1e-9, 3.0, 7.5, 7.5, 7.5), strict=True):
            expected = at_edge + sign * beyond * np.array(slopes)
            np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12)


def test_beyond_the_narrower_range_of_a_set_it_follows_the_other_set_and_then_a_tangent():
    # The static set has a range of 5 to 35 degC, the dynamic set of 0 to 30 degC.
    unit = calibration(
        static=regime_set(axis_set(BENT)),
        dynamic=regime_set(axis_set(WAVY, delta=2.0), temperature_range_c=(0.0, 30.0)),
    )
    celsius = [-20.0, -7.5, -3.0, 0.0, 5.0, 30.0, 35.0, 38.0, 42.5, 60.0]
    static, dynamic = curves_at(unit, celsius)[:, 0]
    # Outside the common range the sets differ by as much as at its nearest edge, 5 or 30 degC.
    np.testing.assert_allclose((dynamic - static)[:5], dynamic[4] - static[4], rtol=1e-12)
    np.testing.assert_allclose((dynamic - static)[5:], dynamic[5] - static[5], rtol=1e-12)
    wavy, bent = np.polynomial.Polynomial(WAVY), np.polynomial.Polynomial(BENT)
    lower, upper = wavy.deriv()(-20.0), bent.deriv()(15.0)
    np.testing.assert_allclose(dynamic[:4] - dynamic[3], lower * np.array([-7.5, -7.5, -3, 0]))
    np.testing.assert_allclose(static[6:] - static[6], upper * np.array([0, 3, 7.5, 7.5]))


def test_the_sd_beyond_the_range_includes_every_parameter_of_the_tangents(rng):
    # Bias and scale must change by the regressors times the change of the parameters. The dynamic
    # range, 0 to 30 degC, ends before the static range at the top and after it at the bottom.
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
    states = np.zeros((Layout(Correction(unit).memory).width, 9))
    states[BOARD] = -40.0, -5.0, 3.0, 20.0, 33.0, 36.0, 42.0, 43.0, 90.0
    states[WEIGHT] = 0.0, 1.0, 0.3, 0.5, 1.0, 0.3, 0.0, 0.7, 1.0
    moved, nominal = (
        Correction(each).bias_scale(states) for each in (drawn(unit, layout, change), unit)
    )
    regressors = Correction(unit).curves.regressors(states, np.zeros((0, 9)))
    moved_by = moved - nominal
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
    nobody = np.zeros((len(correction.memory.lags), 1))
    for sign in (1.0, -1.0):
        variances = []
        for beyond in (0.0, 0.1, 1.0, 3.0, 7.4, 7.6, 15.0, 40.0):
            state = np.zeros((Layout(correction.memory).width, 1))
            state[BOARD] = 20.0 + sign * (15.0 + beyond)
            line = correction.line(state, state, slow.at(state, nobody), 0.0)
            variances.append(line[list(VARIANCES), 0])
        assert (np.diff(variances, axis=0) > 0.0).all()
        # The claimed sd covers the case that the true curve is constant beyond the edge.
        slopes = np.abs(correction.curves.slopes(np.array([35.0]))[0, :3, 0]) / correction.K[:, 0]
        assert (np.sqrt(variances[3]) > 3.0 * np.abs(slopes)).all()


def test_a_ramp_after_soaks_alone_is_claimed_by_its_lags_only_once():
    # WHY: bags of soaks have rates below 0.1 K/min, and a ramp multiplied the variance of all
    # parameters by several hundred, although the variance of the lag grew with the ramp already.
    axis = axis_set(residual_sd_m_s2=1e-5)
    soaks = regime_set(axis, rate_range_k_min=(-0.1, 0.1))
    sds = []
    for response in ((), (term('board', tau_s=600.0),)):
        correction = Correction(calibration(static=soaks, dynamic=soaks, response=response))
        state = np.zeros(Layout(correction.memory).width)
        state[BOARD], state[RATE] = 20.0, 2.0 / 60.0
        line = correction.line(state, state, np.zeros(N_ROWS), 0.0)
        sds.append(math.sqrt(line[VARIANCES[0]] - correction.noise[0]))
    # Without a lag the sd grows with the 19 half ranges by which the ramp exceeds the range of
    # rates.
    assert sds == pytest.approx([1e-5 * math.hypot(1.0, 19.0), 1e-5], rel=1e-6)


def test_a_squared_column_is_as_far_outside_its_range_as_its_quantity():
    # WHY: a temperature difference of 10 K, after bags with up to 0.1 K, is 100 times the range,
    # the square of the difference 10000 times. The claimed sd was 0.1 g, for 10000 half ranges.
    unit = calibration(response=(term('square', (1.0, 0.0, 0.0), tau_s=600.0, range=(0.0, 0.01)),))
    correction = Correction(unit)
    state = np.zeros(Layout(correction.memory).width)
    state[BOARD], state[correction.layout.places[unit.response[0].source]] = 20.0, 10.0
    excess = correction.excess(state, is_dynamic=False)
    assert 99.0 < excess.relative < 150.0


def test_a_part_that_is_still_outside_the_range_widens_the_claimed_sd():
    bent = axis_set((0.0, 0.5, 0.01), residual_sd_m_s2=1e-6)
    unit = calibration(
        static=regime_set(bent), dynamic=regime_set(bent),
        response=(term('board', (-0.5, 0.0, 0.0), tau_s=600.0),),
    )  # fmt: skip
    # The board is back at 33 degC; a part at 34 degC adds no variance, a part at 41 degC does.
    assert sd_at(unit, 33.0, behind=-1.0) == pytest.approx(1e-6, rel=1e-6)
    bends = 0.6 / math.sqrt(12.0)
    assert sd_at(unit, 33.0, behind=-8.0) == pytest.approx(bends * 6.0 / 300.0, rel=0.05)
