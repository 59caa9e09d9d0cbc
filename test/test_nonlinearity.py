# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of nonlinear axes agrees with closed formulas, for blocks and single samples."""

from dataclasses import replace

import numpy as np
import pytest
from builders import UNCHECKED, assert_equal_bits, calibration, rich_calibration, stream, warm
from field_helpers import in_any_attitude, rests
from test_correction import run_of

from thermo_comp.errors import CalibrationError
from thermo_comp.field.series import series_of
from thermo_comp.fitting.assembly import parameters_of, with_parameters
from thermo_comp.online.compensator import Compensator
from thermo_comp.thermal.state import BOARD, StateLayout
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.covariance import N_ROWS
from thermo_comp.unit.gravity import STANDARD_GRAVITY as G
from thermo_comp.unit.nonlinearity import Nonlinearity, NonlinearTerm, linearised
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.prediction import SlowUncertainty


def term(kind, x, y, z, slope=0.0):
    return NonlinearTerm(kind, (x, y, z), (slope * x, slope * y, slope * z), 1e-4)


SQUARE = term('square', 1e-5, -2e-5, 3e-5, 0.01)
ODD = term('odd_square', 5e-6, -5e-6, 1e-5, 0.01)
CUBE = term('cube', 1e-6, -1e-6, 2e-6, 0.01)
BENT = Nonlinearity((9.0, 60.0), 1e-4, (SQUARE, ODD, CUBE))


def with_covariance(unit, rng, size=1e-5):
    n = parameter_layout(unit).n_parameters
    root = size * rng.standard_normal((n, 4))
    return replace(unit, posterior=posterior_of(root @ root.T + size**2 * np.eye(n)))


@pytest.mark.parametrize(('k2', 'tolerance'), [(1e-5, 1e-12), (-1e-4, 1e-12), (1e-3, 3e-9)])
def test_the_inverses_of_a_square_and_of_a_cube_are_roots(k2, tolerance):
    x = np.linspace(-10.0, 10.0, 41)
    root = 2.0 * x / (1.0 + np.sqrt(1.0 + 4.0 * k2 * x))
    np.testing.assert_allclose(linearised(x, k2, 0.0, 0.0), root, rtol=0.0, atol=tolerance)
    for reading, expected in zip(x.tolist(), root.tolist(), strict=True):
        signed = np.copysign(k2, k2 * reading)
        odd = 2.0 * reading / (1.0 + np.sqrt(1.0 + 4.0 * signed * reading))
        forces = linearised(reading, 0.0, k2, 0.0), linearised(reading, k2, 0.0, 0.0)
        assert forces == pytest.approx((odd, expected), abs=tolerance)
    for x in np.linspace(-10.0, 10.0, 9).tolist():
        roots = np.roots([1e-6, 1e-5, 1.0, -x])
        real = roots[np.argmin(np.abs(roots - x))].real
        assert linearised(x, 1e-5, 0.0, 1e-6) == pytest.approx(real, abs=1e-11)


def test_a_correction_inverts_the_terms_and_blocks_have_the_bits_of_single_samples(rng):
    unit = calibration(nonlinearity=BENT)
    f = np.array([5.0, -3.0, 2.0])
    t = 6.0
    at = [np.array(term.coefficient) + t * np.array(term.per_kelvin) for term in BENT.terms]
    x = f + at[0] * f**2 + at[1] * np.abs(f) * f + at[2] * f**3
    compensator = Compensator(unit, UNCHECKED)
    warm(compensator, 20.0 + t, until_s=120)
    corrected = compensator.process(119 * 10**9, *(300.0 * G * x).tolist())
    assert np.array(corrected[:3]) / G == pytest.approx(f, abs=1e-11)
    unit = with_covariance(replace(rich_calibration(), posterior=None, nonlinearity=BENT), rng)
    # Forces reach 10 g on an axis; the largest force of the fit is 6 g.
    events = [
        (kind, stamp, tuple(9.0 * count for count in value) if kind == 'accel' else value)
        for kind, stamp, value in run_of(rng, seconds=60)
    ]
    rows, _, _ = assert_equal_bits(unit, UNCHECKED, events, 77)
    assert (np.abs(rows[:, 2]) > BENT.force_range_m_s2[1]).any()


def test_a_nonlinearity_without_terms_changes_no_bit_and_with_a_slope_needs_a_thermometer(rng):
    plain, events = rich_calibration(), run_of(rng, seconds=30)
    empty = replace(plain, nonlinearity=Nonlinearity((9.0, 100.0), 1e-4))
    before, _ = stream(Compensator(plain, UNCHECKED), events)
    np.testing.assert_array_equal(stream(Compensator(empty, UNCHECKED), events)[0], before)
    assert 'nonlinearity: null' in dump_calibration(plain)
    # WHY: if only a nonlinear term had a slope, `needs_temperature` was false.
    for slope in (0.0, 1e-7):
        square = NonlinearTerm('square', (1e-5,) * 3, (0.0, 0.0, slope), 1e-4)
        value = calibration(nonlinearity=Nonlinearity((0.0, 20.0), 1e-5, (square,)))
        assert value.needs_temperature == bool(slope)


def test_the_variance_includes_all_parameters_and_beyond_the_fit_an_unknown_square(rng):
    # The unit has no term |f| f, with which the claimed variance would exceed the exact one.
    unit = with_covariance(calibration(nonlinearity=replace(BENT, terms=(SQUARE, CUBE))), rng)
    layout, correction = parameter_layout(unit), Correction(unit)
    whole, t = unit.posterior.covariance(), 7.0
    state = np.zeros(StateLayout(correction.memory).width)
    state[BOARD] = 20.0 + t
    slow = SlowUncertainty(unit, correction).at(state[:, np.newaxis], np.zeros((0, 1)))[:, 0]
    linear, beyond = np.reshape(slow[:9], (3, 3)), np.reshape(slow[N_ROWS:], (3, 5))
    for axis in range(3):
        for f in (-60.0, -9.8, 0.0, 30.0):
            along = np.zeros(layout.n_parameters)
            along[layout.bias[axis].static] = 1.0 / 300.0
            along[layout.scale[axis].static] = f
            powers = np.array([f**2 / G, f**3 / G**2])
            first = layout.nonlinear + 4 * axis
            along[first : first + 4] = [*powers, *(t * powers)]
            extended = np.polyval(linear[axis, ::-1], f) + f**2 * np.polyval(beyond[axis, ::-1], f)
            assert extended == pytest.approx(along @ whole @ along, rel=1e-5)
    compensator = Compensator(calibration(nonlinearity=Nonlinearity((9.0, 60.0), 1e-4)), UNCHECKED)
    variances = []
    for k, f in enumerate((50.0, 59.99, 70.0, 90.0)):
        warm(compensator, start_s=k, until_s=k + 1)
        variances.append(compensator.process(k * 10**9, 300.0 * f, 0.0, 1.0)[3])
    assert variances[1] == pytest.approx(variances[0], rel=0.01)
    for f, variance in zip((70.0, 90.0), variances[2:], strict=True):
        grown = (1e-4 / G * (f - 60.0) ** 2) ** 2
        assert variance - variances[0] == pytest.approx(grown, rel=0.01)


def test_a_file_keeps_nonlinear_terms_and_refuses_impossible_terms():
    unit = calibration(nonlinearity=BENT)
    text = dump_calibration(unit)
    assert parse_calibration(text.encode()) == unit
    for before, after, said in (
        ('kind: square', 'kind: quartic', "must be 'square', 'odd_square' or 'cube'"),
        ('coefficient: [1.0e-05', 'coefficient: [0.1', 'must have a slope below 0.2'),
        ('[9.0, 60.0]', '[60.0, 9.0]', 'must be [lower, upper] with lower < upper'),
    ):
        assert before in text
        with pytest.raises(CalibrationError, match='nonlinearity') as caught:
            parse_calibration(text.replace(before, after).encode())
        assert said in str(caught.value)
    with pytest.raises(ValueError, match='at most one each, in this order'):
        replace(BENT, terms=(CUBE, SQUARE))


def test_rests_in_the_field_depend_on_every_nonlinear_coefficient():
    unit = with_covariance(calibration(nonlinearity=BENT), np.random.default_rng(1))
    logged = rests(unit, in_any_attitude, lambda _days: np.zeros(3), days=1, rate=0.5 / 60.0)
    series = series_of(logged, unit)
    values, scale, step = parameters_of(unit), np.full(3, 300.0), 1e-7
    layout, covariance = parameter_layout(unit), unit.posterior.covariance()
    assert (series.claim > 0.0).all()
    for k in range(layout.nonlinear, layout.misalignment):
        changed = values + step * (np.arange(len(values)) == k)
        moved = with_parameters(unit, scale, changed, covariance)
        slope = (series.residual - series_of(logged, moved).residual) / step
        # The derivatives neglect d(K2 f^2)/df, and so have a relative error of 2 * K2 * 1 g.
        assert np.allclose(slope, series.by_parameter[:, k], atol=1e-3 * abs(slope).max() + 1e-7)
