# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Temperature functions, predicted sd and statistics agree with hand numbers and with scipy."""

from dataclasses import replace

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set, rich_calibration, term
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline as ReferenceSpline

from thermo_comp.convert.exchange import export_calibration
from thermo_comp.thermal.lags import Lag, Play
from thermo_comp.thermal.memory import memory_on_grid
from thermo_comp.thermal.state import BOARD, RATE, WEIGHT, Gradient, StateLayout
from thermo_comp.unit import functions
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.metrics import norm_residual, residual_statistics, statistics_by_regime
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.prediction import bias_scale_and_sd, in_a_soak, ramp_states

KNOTS = (-15.0, -6.0, 0.0, 4.0, 15.0)
FUNCTIONS = [functions.Polynomial((1.0,)), functions.Polynomial((0.0, 2e-3, -3e-5, 4e-7, 1e-9)),
             functions.CubicSpline(KNOTS, (1.5, 0.4, 0.0, -0.2, 0.9)),
             functions.Exponential(-0.5, (0.2, 0.3), (12.0, -7.0))]  # fmt: skip
temperatures = st.floats(-15.0, 15.0)


def test_curves_agree_with_hand_numbers_and_splines_with_scipy():
    # The term with a4 in Eq. (10) is a4 t^4; Golovach's paper prints a4 t.
    assert functions.Polynomial((1.0, 2.0, 0.5, 0.25, 1.0)).value(3.0) == 1 + 6 + 4.5 + 6.75 + 81
    function = functions.Exponential(-2.0, (2.0,), (10.0,))
    assert function.value(0.0) == 0.0
    assert function.value(10.0) == pytest.approx(2.0 * (np.e - 1.0), rel=1e-15)
    values = (1.5, 0.4, 0.0, -0.2, 0.9)
    ours = functions.CubicSpline(KNOTS, values)
    reference = ReferenceSpline(KNOTS, values, bc_type='natural')
    t = np.linspace(-15.0, 15.0, 301)
    np.testing.assert_allclose(ours.value(t), reference(t), atol=1e-13)
    np.testing.assert_allclose(ours.slope(t), reference(t, 1), atol=1e-13)
    assert ours.value(-100.0) == ours.value(-15.0)
    assert ours.value(100.0) == pytest.approx(0.9, abs=1e-15)


@pytest.mark.parametrize('function', FUNCTIONS)
def test_functions_of_arrays_have_the_bits_of_floats(function):
    t = np.concatenate((np.linspace(-16.0, 16.0, 1001), KNOTS))
    for method in (function.value, function.slope):
        assert method(t).tolist() == [method(x) for x in t.tolist()]
    columns = function.basis(t)
    rows = [function.basis(x) for x in t.tolist()]
    assert [list(row) for row in zip(*columns, strict=True)] == rows or function.n_free == 0


@pytest.mark.parametrize('function', FUNCTIONS)
@given(t=temperatures)
def test_the_slope_of_a_function_is_its_derivative(function, t):
    step = 1e-4
    t = min(max(t, -15.0 + step), 15.0 - step)
    # A central difference has an error of (third derivative) * step^2 / 6, here below 1e-8.
    expected = (function.value(t + step) - function.value(t - step)) / (2.0 * step)
    assert function.slope(t) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize('function', FUNCTIONS)
@given(t=temperatures, data=st.data())
def test_the_value_of_a_function_is_linear_in_its_free_coefficients(function, t, data):
    change = data.draw(st.tuples(*[st.floats(-1.0, 1.0)] * function.n_free))
    other = function.with_free(
        tuple(a + b for a, b in zip(function.free_coefficients, change, strict=True)),
        float(function.value(0.0)),
    )
    expected = function.value(t) + np.dot(function.basis(t), change)
    # The rounding error of t^4 at 15 K with coefficients near 1 is 1e-11.
    assert other.value(t) == pytest.approx(expected, rel=1e-12, abs=1e-9)
    assert other.value(0.0) == pytest.approx(function.value(0.0), abs=1e-15)


@pytest.mark.parametrize(
    ('build', 'message'),
    [
        (lambda: functions.Polynomial(()), 'at least the value'),
        (lambda: functions.CubicSpline((0.0, 1.0), (0.0, 1.0)), 'at least 3 knots'),
        (lambda: functions.CubicSpline((-1.0, 0.0, 1.0), (0.0, 1.0)), 'one number per knot'),
        (lambda: functions.CubicSpline((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)), 'must rise'),
        (lambda: functions.CubicSpline((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), 'must contain 0'),
        (lambda: functions.Exponential(0.0, (), ()), 'at least one number'),
        (lambda: functions.Exponential(0.0, (1.0,), (1.0, 2.0)), 'one number per amplitude'),
        (lambda: functions.Exponential(0.0, (1.0,), (0.0,)), 'at least 1 K'),
    ],
)
def test_impossible_functions_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize('bad', [float('nan'), float('inf')])
def test_a_curve_that_is_not_finite_is_refused(bad):
    for function in (functions.Polynomial((0.0, bad)), functions.Exponential(bad, (1.0,), (9.0,))):
        with pytest.raises(ValueError, match='`bias_function` must be 0 at t = 0'):
            functions.check_reference('bias_function', function, 0.0)


def test_the_predicted_sd_agrees_with_hand_numbers_or_is_that_of_the_residual():
    unit = calibration(
        static=regime_set(*[axis_set((0.0, 0.3), residual_sd_m_s2=3e-5)] * 3),
        dynamic=regime_set(*[axis_set((0.0, 0.3))] * 3),
        response=(term('board', (0.3, 0.0, 0.0), tau_s=600.0),),
    )
    # Parameters of x: bias level and slope per set (0-3), weight of the lag (4), scales (5, 6).
    variances = np.zeros(parameter_layout(unit).n_parameters)
    variances[:7] = 4e-4, 1e-6, 9e-4, 0.0, 1e-6, 1e-12, 4e-12
    unit = replace(unit, posterior=posterior_of(np.diag(variances)))
    states = ramp_states(unit, np.array([20.0, 30.0]), 0.0, np.inf)
    _, bias, _, scale = bias_scale_and_sd(unit, states)
    # The bias variance at 30 degC is (4e-4 + 100 * 1e-6) counts^2, plus (30 um/s^2)^2.
    assert bias[:, 0] == pytest.approx(np.hypot(np.sqrt([4e-4, 5e-4]) / 300.0, 3e-5), rel=1e-6)
    assert bias[:, 1] == pytest.approx([3e-5, 3e-5])
    assert scale[:, 0] == pytest.approx([1e-6, 1e-6], rel=1e-6)
    # In an endless ramp of 0.6 K/min a part with a lag of 600 s is 6 K behind the board.
    _, bias, _, scale = bias_scale_and_sd(unit, ramp_states(unit, np.array([25.0]), 0.01, np.inf))
    assert bias[0, 0] == pytest.approx(np.sqrt(9e-4 + 36e-6) / 300.0, rel=1e-6)
    assert scale[0, 0] == pytest.approx(2e-6, rel=1e-6)
    unit = replace(rich_calibration(), posterior=None)
    _, bias, _, scale = bias_scale_and_sd(unit, ramp_states(unit, np.array([20.0]), 0.0, np.inf))
    assert bias == pytest.approx(np.full((1, 3), 1e-5))
    assert not scale.any()


def test_the_bias_in_a_soak_includes_the_gradient_by_self_heating():
    # WHY: the certified bias lacked the effect of a soak's gradient: 50 ug for 3 K and 16 ug/K.
    unit = calibration(
        response=(
            term('gradient', (30.0, 0.0, 0.0), scale=(0.0, 2e-5, 0.0)),
            term('gradient_lag', (0.0, 60.0, 0.0), tau_s=600.0),
            term('board', (0.0, 0.0, 90.0), tau_s=600.0, sensor_share=0.5),
        ),
        soak_gradient_k=(-3.0, 0.2),
    )
    bias, bias_sd, scale, scale_sd = in_a_soak(unit)
    # A part midway between board and case is colder than the board by half of the gradient.
    by_kelvin = np.array([30.0, 60.0, -45.0]) / 300.0
    assert bias == pytest.approx(-3.0 * by_kelvin)
    assert bias_sd == pytest.approx(0.2 * np.abs(by_kelvin))
    assert scale / 300.0 - 1.0 == pytest.approx([0.0, -6e-5, 0.0])
    assert scale_sd == pytest.approx([0.0, 0.4e-5, 0.0])
    exported = export_calibration(unit, 'imu_tk')
    assert exported.bias[:, 0] == pytest.approx(300.0 * bias)
    assert 1.0 / np.diag(exported.matrix) == pytest.approx(scale)


@pytest.mark.parametrize('rate', [0.01, -0.02])
def test_ramp_states_equal_those_of_the_memory_of_the_fit(rate):
    unit = replace(rich_calibration(), board_lag_s=100.0)
    spec = Correction(unit).memory
    first = StateLayout(spec).width - 2 * len(spec.lags) - len(spec.plays)
    gradient = np.append(0.0, np.full(900, 100.0 * rate))
    board = 25.0 + rate * np.arange(-900.0, 1.0)
    lived = memory_on_grid(spec, 1.0, board, [gradient] * len(spec.sensors))[-1]
    (state,) = ramp_states(unit, board[-1:], rate, 900.0)
    layout = StateLayout(spec)
    assert state[[BOARD, RATE, WEIGHT]].tolist() == [25.0, rate, 1.0]
    for quantity, place in layout.places.items():
        if isinstance(quantity, Gradient):
            assert state[place] == pytest.approx(100.0 * rate)
        elif isinstance(quantity, Lag):
            # `gradient` rises within 1 s in `memory_on_grid`, but at once in `ramp_states`.
            assert state[place] == pytest.approx(lived[place - first], rel=2e-3), quantity
        elif isinstance(quantity, Play) and not quantity.tau_s:
            # A play of a lag is not tested: the lag needs half an hour to change by `width_k`.
            assert state[place] == pytest.approx(-quantity.width_k * np.sign(rate))
            assert state[place] == pytest.approx(lived[place - first])


def test_statistics_of_residuals_agree_with_hand_numbers(rng):
    # 3 and -4 have the mean -0.5 and the mean square 12.5; infinite and NaN values do not count.
    for values in ((3.0, -4.0), (3.0, np.nan, -4.0), (np.inf, 3.0, -4.0)):
        statistics = residual_statistics(np.array(values))
        assert (statistics.n, statistics.mean, statistics.peak) == (2, -0.5, 4.0)
        assert statistics.rms == pytest.approx(12.5**0.5, rel=1e-15)
    statistics = residual_statistics(np.zeros(0))
    assert statistics.n == 0
    assert np.isnan([statistics.mean, statistics.rms, statistics.peak]).all()
    summary = statistics_by_regime(np.array([1.0, 2.0, 5.0]), np.array([False, False, True]))
    assert (summary['static'].n, summary['dynamic'].n, summary['all'].n) == (2, 1, 3)
    assert summary['dynamic'].peak == 5.0
    force = rng.normal(size=(5, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    residual = norm_residual(force, 9.8)
    np.testing.assert_allclose(norm_residual(force @ turn.T, 9.8), residual, atol=1e-14)
    assert norm_residual(np.array([0.0, 3.0, 4.0]), 4.5) == pytest.approx(0.5, abs=1e-15)
