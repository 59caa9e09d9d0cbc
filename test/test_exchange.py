# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Exports and imports agree with the formulas of PX4, ArduPilot, imu_tk, imu_calib and Kalibr."""

import re
from dataclasses import replace
from itertools import starmap
from typing import get_args

import numpy as np
import pytest
import yaml
from builders import axis_set, calibration, regime_set, term

from thermo_comp.cli.convert import Tool
from thermo_comp.convert.exchange import export_calibration, import_calibration
from thermo_comp.convert.tools import TOOLS
from thermo_comp.errors import CalibrationError
from thermo_comp.unit.calibration import Axes, AxisReference, AxisSet, Unit, rate_triad
from thermo_comp.unit.functions import CubicSpline, Polynomial
from thermo_comp.unit.nonlinearity import Nonlinearity, NonlinearTerm
from thermo_comp.unit.prediction import bias_and_scale, ramp_states
from thermo_comp.unit.rate_bias import Gyroscope, RateCurve, RateSet


def axes_of(scale, biases):
    return Axes(*(AxisReference(scale, bias) for bias in biases))


def calibration_of(bias, **change):
    ranges = {'temperature_range_c': (5.0, 45.0), 'rate_range_k_min': (-2.0, 2.0)}
    regime = regime_set(*map(axis_set, bias), **ranges)
    keys = {'unit': Unit('7', 'm/s^2', 160.0, 0.005), 'axes': axes_of(1.0, (0.1, -0.2, 0.3))}
    return calibration(gravity_m_s2=9.81, static=regime, dynamic=regime, **(keys | change))


@pytest.fixture
def cubic():
    return calibration_of([(0.0, 1e-3, 2e-5, -3e-7), (0.0, -2e-3), (0.0, 5e-4, -1e-5)])


@pytest.mark.parametrize('to', get_args(Tool))
def test_a_serial_with_line_breaks_adds_no_line_to_an_export(cubic, to):
    assert get_args(Tool) == tuple(TOOLS)
    clean = export_calibration(cubic, to).text
    unit = replace(cubic.unit)
    forged = '7\nINS_TCAL1_ENABLE,0\r1\t1\tTC_A_ENABLE\t0\t6\x1b[2J\u2028x,1'
    object.__setattr__(unit, 'serial', forged)
    text = export_calibration(replace(cubic, unit=unit), to).text
    assert [line for line in text.splitlines() if not line.startswith('#')] == [
        line for line in clean.splitlines() if not line.startswith('#')
    ]
    assert len(text.splitlines()) == len(clean.splitlines())


def numbers(text, separator):
    first = 2 if separator == '\t' else 0
    rows = (line.split(separator) for line in text.splitlines() if not line.startswith('#'))
    return {cells[first]: float(cells[first + 1]) for cells in rows}


def bias_at(calibration, axis, celsius):
    reference = (calibration.axes.x, calibration.axes.y, calibration.axes.z)[axis]
    curves = calibration.static.axes()[axis]
    t = celsius - calibration.reference_temperature_c
    return reference.bias + curves.bias_function.value(t)


def test_formulas_of_px4_and_ardupilot_give_the_bias_of_the_calibration(cubic):
    p = numbers(export_calibration(cubic, 'px4', number=2, device_id=1376264).text, '\t')
    assert (p['TC_A_ENABLE'], p['TC_A2_ID']) == (1, 1376264)
    assert (p['TC_A2_TMIN'], p['TC_A2_TMAX']) == (5.0, 45.0)
    for axis in range(3):
        for celsius in (5.0, 20.0, 33.0, 45.0):
            d = celsius - p['TC_A2_TREF']
            offset = sum(p[f'TC_A2_X{power}_{axis}'] * d**power for power in range(4))
            # A parameter file of PX4 has nine digits, enough for a number of single precision.
            assert offset == pytest.approx(bias_at(cubic, axis, celsius), rel=1e-8, abs=1e-9)
    p = numbers(export_calibration(cubic, 'ardupilot', number=3).text, ',')

    def polynomial(axis, celsius):
        d = celsius - 35.0
        return sum(p[f'INS_TCAL3_ACC{n}_{axis}'] * d**n for n in (1, 2, 3)) * 1e-6

    for number, axis in enumerate('XYZ'):
        for celsius in (5.0, 33.0, 45.0):
            change = polynomial(axis, celsius) - polynomial(axis, 20.0)
            ours = bias_at(cubic, number, celsius) - bias_at(cubic, number, 20.0)
            assert change == pytest.approx(ours, rel=1e-7, abs=1e-9)
    text = export_calibration(cubic, 'ardupilot').text.replace(',', '=')
    back = import_calibration(text + 'INS_ACC1_CALTEMP=28.0\n', serial='7')
    for axis in range(3):
        assert bias_at(back, axis, 28.0) == pytest.approx(0.0, abs=1e-12)
        ours = bias_at(cubic, axis, 41.0) - bias_at(cubic, axis, 28.0)
        assert bias_at(back, axis, 41.0) == pytest.approx(ours, rel=1e-7, abs=1e-9)


def test_the_bias_of_a_gyroscope_is_exported_and_imported(cubic):
    curves = [(0.0, 2e-4, -3e-6, 1e-8), (0.0, -1e-4, 2e-6, 0.0), (0.0, 5e-5, 0.0, -2e-8)]
    rates = RateSet(*(RateCurve(Polynomial(curve)) for curve in curves))
    gyroscope = Gyroscope((0.02, -0.01, 0.03), rates, rates, (1e-4,) * 3)
    unit = replace(cubic, gyroscope=gyroscope)
    celsius = np.linspace(*unit.static.temperature_range_c, 7)
    changes = [Polynomial(curve).value(celsius - unit.reference_temperature_c) for curve in curves]
    true = np.array(gyroscope.bias_rad_s) + np.column_stack(changes)

    def again(text):
        triad = rate_triad(import_calibration(text, serial='7'))
        return bias_and_scale(triad, ramp_states(triad, celsius))[0]

    px4 = export_calibration(unit, 'px4')
    value = numbers(px4.text, '\t')
    assert value['TC_G_ENABLE'] == 1.0
    # PX4 subtracts X0 + X1 d + X2 d^2 + X3 d^3 [rad/s], with d = temperature - TREF.
    d = celsius[2] - value['TC_G0_TREF']
    for axis in range(3):
        bias = sum(value[f'TC_G0_X{power}_{axis}'] * d**power for power in range(4))
        assert bias == pytest.approx(true[2, axis], rel=1e-6)
    np.testing.assert_allclose(again(px4.text), true, atol=1e-9)
    shifted = Polynomial((0.02, *curves[0][1:]))
    moved = px4.text.replace('TC_G0_TREF\t20\t', 'TC_G0_TREF\t30\t')
    assert moved != px4.text
    np.testing.assert_allclose(again(moved)[:, 0], shifted.value(celsius - 30.0), atol=1e-9)
    assert 'angular rate' not in ' '.join(px4.notes)
    ardupilot = export_calibration(unit, 'ardupilot', number=2).text
    assert 'INS_TCAL2_GYR1_X' in ardupilot
    # ArduPilot stores the bias at CALTEMP in another parameter, so its cubic is 0 at CALTEMP.
    found = again(f'{ardupilot}INS_GYR2_CALTEMP,{celsius[3]}\n')
    np.testing.assert_allclose(found, true - true[3], atol=1e-9)
    zeros = re.sub(r'(GYR\d_.),.*', r'\1,0', ardupilot)
    assert import_calibration(zeros, serial='7').gyroscope is None
    off = px4.text.replace('TC_G_ENABLE\t1', 'TC_G_ENABLE\t0')
    assert import_calibration(off, serial='7').gyroscope is None
    assert 'the bias of the angular rate is lost' in export_calibration(unit, 'kalibr').notes
    with pytest.raises(CalibrationError, match='TC_G0_X3_1: is missing'):
        import_calibration(px4.text.replace('TC_G0_X3_1', 'TC_G0_Y3_1'), serial='7')
    # WHY: the import failed for an axis whose rate polynomial has no third power.
    rows = [(1e-3, 0.0, 0.0, 0.0), (2e-3, 1e-4, 0.0, 0.0), (0.0, 1e-4, -2e-6, 3e-8)]
    lines = [f'TC_G0_X{p}_{axis}={row[p]!r}' for axis, row in enumerate(rows) for p in range(4)]
    lines += ['TC_G_ENABLE=1', 'TC_G0_TREF=31', 'TC_G0_TMIN=0', 'TC_G0_TMAX=50']
    text = export_calibration(cubic, 'px4').text + '\n'.join(lines) + '\n'
    back = import_calibration(text, serial='7')
    for axis, row in enumerate(rows):
        curve = back.gyroscope.static.axes()[axis].bias_function
        for celsius in (5.0, 20.0, 44.0):
            theirs = sum(c * (celsius - 31.0) ** p for p, c in enumerate(row))
            ours = back.gyroscope.bias_rad_s[axis] + curve.value(celsius - 20.0)
            assert ours == pytest.approx(theirs, abs=1e-12)


def test_px4_offsets_are_in_m_s2_and_contain_scale_errors_in_a_stated_attitude(cubic):
    curves = [axis.bias_function.coefficients for axis in cubic.static.axes()]
    counts = calibration_of(
        [tuple(300.0 * coefficient for coefficient in curve) for curve in curves],
        unit=Unit('7', 'counts', 32767.0, 0.005), axes=axes_of(300.0, (30.0, -60.0, 90.0)),
    )  # fmt: skip
    ours, expected = export_calibration(counts, 'px4'), export_calibration(cubic, 'px4')
    assert any('the driver must divide counts by K' in note for note in ours.notes)
    for name, value in numbers(expected.text, '\t').items():
        assert numbers(ours.text, '\t')[name] == pytest.approx(value, rel=1e-8, abs=1e-12)
    # WHY: PX4 subtracts offsets in m/s^2; for a stated attitude they must contain the scale error.
    scaled = replace(cubic, axes=axes_of(0.995, (0.1, -0.2, 0.3)))
    plain = export_calibration(scaled, 'px4')
    for name, value in numbers(expected.text, '\t').items():
        assert numbers(plain.text, '\t')[name] == pytest.approx(value, rel=1e-8, abs=1e-12)
    assert any('constant scale is lost' in n and '5000 ppm' in n for n in plain.notes)
    up = (0.6, 0.0, 0.8)
    level = numbers(export_calibration(scaled, 'px4', up=up).text, '\t')
    for axis in range(3):
        d = 20.0 - level['TC_A0_TREF']
        reading = 0.995 * 9.81 * up[axis] + (0.1, -0.2, 0.3)[axis]
        offset = sum(level[f'TC_A0_X{power}_{axis}'] * d**power for power in range(4))
        assert reading - offset == pytest.approx(9.81 * up[axis], abs=1e-7)
    drifting = replace(cubic.static.z, scale_function=Polynomial((1.0, 1e-4)))
    regime = replace(cubic.static, z=drifting)
    bent = replace(cubic, static=regime, dynamic=regime)
    plain = export_calibration(bent, 'px4')
    level = export_calibration(bent, 'px4', up=(0.0, 0.0, 1.0))
    lost = re.compile(r'scale over temperature is lost: up to 2[45]\d\d ppm')
    assert any(map(lost.search, plain.notes))
    # If z measures +g, a scale drift of 100 ppm/K is an offset drift of 9.81e-4 m/s^2 per K.
    slope = [numbers(export.text, '\t')['TC_A0_X1_2'] for export in (plain, level)]
    assert slope[1] - slope[0] == pytest.approx(9.81e-4, rel=1e-5)
    assert numbers(plain.text, '\t')['TC_A0_X1_0'] == numbers(level.text, '\t')['TC_A0_X1_0']


def test_losses_of_an_export_are_noted(cubic):
    spline = CubicSpline((-15.0, 0.0, 10.0, 25.0), (0.01, 0.0, 0.02, -0.01))
    static = replace(cubic.static, x=AxisSet(spline, Polynomial((1.0,))))
    dynamic = replace(static, y=replace(static.y, delta=0.1))
    square = NonlinearTerm('square', (1e-5,) * 3, (0.0,) * 3, 1e-4)
    lossy = replace(
        cubic, static=static, dynamic=dynamic,
        response=(term('gradient', (0.0, 1e-3, 0.0)), term('board', tau_s=60.0)),
        misalignment=((1.0, 0.0, 0.0), (1e-3, 1.0, 0.0), (0.0, 0.0, 1.0)),
        nonlinearity=Nonlinearity((9.81, 20.0), 1e-4, (square,)),
    )  # fmt: skip
    text = export_calibration(lossy, 'ardupilot')
    for expected in (
        *('cubics replace', '1000 urad', 'response is lost (gradient): '),
        *('dynamic coefficients are lost', 'the terms nonlinear in specific force are lost'),
    ):
        assert any(expected in note for note in text.notes), expected
        assert expected in text.text


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('SYS_AUTOSTART 4001', 'no TC_A'),
        ('INS_TCAL1_ENABLE,0\nINS_TCAL1_TMIN,0', 'INS_TCAL1_ENABLE: is not 1'),
        ('INS_TCAL1_ENABLE,1\nINS_TCAL1_TMIN,0', 'INS_TCAL1_ACC1_X: is missing'),
        ('TC_A_ENABLE 0\nTC_A0_X1_0 1', 'TC_A_ENABLE: is 0'),
        ('TC_A0_X1_0 1\nTC_A1_X1_0 1', 'several sets'),
        ('TC_A0_X1_0', 'has no value'),
        ('SM: [1, 0, 0]\nbias: [0, 0, 0]', 'SM: must be 9 finite numbers'),
        ('SM: [1, 0, 0, 0, 1, 0, 0, 0, -1]\nbias: [0, 0, 0]', 'singular or mirrors'),
        ('SM: [9.8, 0, 0, 0, 9.8, 0, 0, 0, 9.8]\nbias: [0, 0, 0]', 'neither in m/s.2 nor in'),
        ('1 0 0 0 1 0 0 0 1  0 0 0 0 0 0 0 0 0  1 2 3', 'singular or mirrors'),
        ('imu0: {accelerometers: {M: [[1, 0], [0, 1]]}}', 'M: must be 9 finite numbers'),
        ('imu0: {rostopic: /imu}', 'nor the matrices of imu_tk'),
    ],
)
def test_files_that_are_no_calibrations_are_refused(text, message):
    with pytest.raises(CalibrationError, match=message):
        import_calibration(text, serial='7')


def test_impossible_arguments_of_import_and_export_are_refused(cubic):
    text = export_calibration(cubic, 'px4').text
    with pytest.raises(CalibrationError, match='no set of parameters 1'):
        import_calibration(text, serial='7', number=1)
    for text_of_one in (
        'SM: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nbias: [0, 0, 0]',
        '1 0 0 0 1 0 0 0 1  1 0 0 0 1 0 0 0 1  1 2 3',
    ):
        with pytest.raises(CalibrationError, match='no set of parameters 1, only one set'):
            import_calibration(text_of_one, serial='7', number=1)
    empty = re.sub(r'TMAX\t45', 'TMAX\t5', text)
    with pytest.raises(CalibrationError, match=r'range 5\.\.5 degC is empty'):
        import_calibration(empty, serial='7')
    for to, given, reason in (
        ('px4', {'number': 4}, r'`number` must be 0\.\.3, got 4'),
        ('ardupilot', {'number': 0}, r'`number` must be 1\.\.3, got 0'),
        ('px4', {'up': (0.0, 0.0, 9.81)}, '`up` must be a unit vector'),
    ):
        with pytest.raises(ValueError, match=reason):
            export_calibration(cubic, to, **given)


@pytest.fixture
def tumbled():
    constants = (373.0, 32800.0), (381.0, 32650.0), (369.0, 32790.0)
    axes, unit = Axes(*starmap(AxisReference, constants)), Unit('7', 'counts', 65536.0, 0.01)
    M = (1.0, 0.0, 0.0), (0.02, 1.0, 0.0), (-0.03, 0.05, 1.0)
    return calibration_of([(0.0,)] * 3, unit=unit, axes=axes, misalignment=M)


def ours(calibration, raw):
    axes = calibration.axes
    x = (raw - [axis.bias for axis in axes]) / [axis.scale_factor for axis in axes]
    return x @ np.array(calibration.misalignment).T


def turn(notes):
    text = next(note for note in notes if 'roll' in note)
    roll, pitch, yaw = (float(number) for number in text.split()[-4:-1])
    x = [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    y = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    z = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    return np.array(z) @ np.array(y) @ np.array(x)


RAW = np.array([[36400.0, 33100.0, 33300.0], [32500.0, 29000.0, 32000.0], [1.0, 65535.0, 30000.0]])


def test_formulas_of_imu_tk_imu_calib_and_kalibr_give_the_correction_of_the_calibration(tumbled):
    # A file of imu_tk has 9 numbers of T, 9 of K and 3 of B for the formula X' = T K (X - B).
    file = export_calibration(tumbled, 'imu_tk')
    numbers = [float(cell) for cell in file.text.split()]
    T, K = np.reshape(numbers[:9], (3, 3)), np.reshape(numbers[9:18], (3, 3))
    assert np.all(np.diag(T) == 1.0)
    assert np.all(np.tril(T, -1) == 0.0)
    assert np.count_nonzero(K - np.diag(np.diag(K))) == 0
    theirs = (RAW - numbers[18:]) @ (T @ K).T
    # The notes round roll, pitch and yaw to 1e-6 rad, which is an error of 1e-6 * 90 m/s^2.
    np.testing.assert_allclose(theirs, ours(tumbled, RAW) @ turn(file.notes).T, atol=1e-4)
    norms, expected = (np.linalg.norm(force, axis=1) for force in (theirs, ours(tumbled, RAW)))
    np.testing.assert_allclose(norms, expected, rtol=1e-12)
    data = yaml.safe_load(export_calibration(tumbled, 'imu_calib').text)
    theirs = RAW @ np.reshape(data['SM'], (3, 3)).T - data['bias']
    np.testing.assert_allclose(theirs, ours(tumbled, RAW), rtol=1e-10)
    imu = yaml.safe_load(export_calibration(tumbled, 'kalibr', number=1).text)['imu1']
    part = imu['accelerometers']
    reading = ours(tumbled, RAW) @ np.array(part['M']).T + part['bias']
    np.testing.assert_allclose(reading, RAW, rtol=1e-12)
    assert np.all(np.triu(part['M'], 1) == 0.0)
    assert (imu['model'], imu['update_rate']) == ('scale-misalignment', 100.0)


@pytest.mark.parametrize('to', ['imu_tk', 'imu_calib', 'kalibr'])
def test_constants_are_unchanged_by_export_and_import(tumbled, to):
    file = export_calibration(tumbled, to)
    back = import_calibration(file.text, serial='7')
    assert back.unit.input == 'counts'
    np.testing.assert_allclose(ours(back, RAW), ours(tumbled, RAW), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.misalignment, tumbled.misalignment, atol=1e-12)
    assert any('hold at 20 degC' in note for note in file.notes)


def test_imported_matrices_become_a_triangular_matrix_and_a_rotation():
    # The text was written by imu_tk; `theirs` is imu_tk's formula, written by hand.
    text = (
        '          1 -0.00354989 -0.00890444\n          0           1 -0.0213032\n'
        '          0           0           1\n\n'
        '0.00241278          0          0\n         0 0.00242712          0\n'
        '         0          0 0.00241168\n\n33124.2\n33275.2\n32364.4\n\n'
    )
    back = import_calibration(text, serial='7')
    assert back.unit.input == 'counts'
    x = (RAW - [33124.2, 33275.2, 32364.4]) * [0.00241278, 0.00242712, 0.00241168]
    theirs = x @ np.array([[1.0, -0.00354989, -0.00890444], [0.0, 1.0, -0.0213032],
                           [0.0, 0.0, 1.0]]).T  # fmt: skip
    np.testing.assert_allclose(ours(back, RAW) @ turn(back.provenance.notes).T, theirs, atol=1e-4)
    SM = np.array([[1.02, 0.03, -0.01], [-0.02, 0.99, 0.02], [0.01, -0.03, 1.01]])
    text = f'SM: {SM.ravel().tolist()}\nbias: [0.12, -0.05, 0.2]\n'
    back = import_calibration(text, serial='7')
    raw = np.array([[3.0, -4.0, 8.0], [-9.0, 1.0, 2.0]])
    force, expected = ours(back, raw) @ turn(back.provenance.notes).T, raw @ SM.T
    np.testing.assert_allclose(force, expected - [0.12, -0.05, 0.2], atol=1e-5)
    assert not np.triu(back.misalignment, 1).any()


def test_kalibr_files_without_bias_with_rates_and_with_several_imus_are_read():
    imu = '  accelerometers:\n    M: [[1.01, 0, 0], [0.01, 0.99, 0], [0.02, -0.01, 1.02]]\n'
    back = import_calibration(f'imu0:\n{imu}  update_rate: 200.0\n', serial='7')
    assert back.unit.input == 'm/s^2'
    assert 'no bias' in back.provenance.notes[0]
    # The reading (1.01, 1.99, 3.06) is M a for a = (1, 2, 3) m/s^2.
    np.testing.assert_allclose(ours(back, np.array([[1.01, 1.99, 3.06]])), [[1, 2, 3]], rtol=1e-12)
    with pytest.raises(CalibrationError, match='an IMU with --number: the file has imu0, imu1'):
        import_calibration(f'imu0:\n{imu}imu1:\n{imu}', serial='7')
    # WHY: for a file with 400 Hz the calibration had 200 Hz, so the node dropped samples.
    imu = 'imu0:\n  accelerometers:\n    M: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
    text = f'{imu}  update_rate: 400.0\n  accelerometer_noise_density: 0.0025\n'
    back = import_calibration(text, serial='7')
    assert (back.unit.cycle_time_s, back.noise_density_m_s2_sqrt_hz) == (0.0025, (0.0025,) * 3)
    assert import_calibration(text, serial='7', cycle_time_s=0.01).unit.cycle_time_s == 0.01
    assert import_calibration(imu, serial='7').unit.cycle_time_s == 0.005
    with pytest.raises(CalibrationError, match=r'imu0\.update_rate: must be 0 or more'):
        import_calibration(f'{imu}  update_rate: -1\n', serial='7')
