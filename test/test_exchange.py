# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Exchange with autopilots: their formulas written out again here, round trips, losses, refusals.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from builders import term

from thermo_comp.convert.exchange import export_ardupilot, export_px4, import_parameters
from thermo_comp.errors import CalibrationError
from thermo_comp.unit.calibration import Axes, AxisReference, AxisSet, Calibration, RegimeSet, Unit
from thermo_comp.unit.functions import CubicSpline, Polynomial

ONE = Polynomial((1.0,))


def calibration_of(bias: list[Polynomial], **change: object) -> Calibration:
    axes = [AxisSet(function, ONE) for function in bias]
    regime = RegimeSet((5.0, 45.0), (-2.0, 2.0), *axes)
    base = Calibration(
        format_version=2,
        unit=Unit('7', 'm/s^2', 160.0, 0.005),
        reference_temperature_c=20.0,
        gravity_m_s2=9.81,
        axes=Axes(AxisReference(1.0, 0.1), AxisReference(1.0, -0.2), AxisReference(1.0, 0.3)),
        static=regime,
        dynamic=regime,
        noise_density_m_s2_sqrt_hz=(1e-3, 1e-3, 1e-3),
    )
    return replace(base, **change)


@pytest.fixture
def cubic() -> Calibration:
    return calibration_of(
        [
            Polynomial((0.0, 1e-3, 2e-5, -3e-7)),
            Polynomial((0.0, -2e-3)),
            Polynomial((0.0, 5e-4, -1e-5)),
        ]
    )


@pytest.mark.parametrize('to', [export_px4, export_ardupilot])
def test_foreign_text_makes_no_live_line(cubic: Calibration, to: Callable[..., Any]) -> None:
    # WHY: a serial with a line break set a parameter of the vehicle.
    clean = to(cubic).text
    unit = replace(cubic.unit)
    forged = '7\nINS_TCAL1_ENABLE,0\r1\t1\tTC_A_ENABLE\t0\t6\x1b[2J\u2028x,1'
    object.__setattr__(unit, 'serial', forged)
    text = to(replace(cubic, unit=unit)).text
    assert [line for line in text.splitlines() if not line.startswith('#')] == [
        line for line in clean.splitlines() if not line.startswith('#')
    ]
    assert len(text.splitlines()) == len(clean.splitlines())


def numbers(text: str, separator: str) -> dict[str, float]:
    result = {}
    for line in text.splitlines():
        if not line.startswith('#'):
            cells = line.split(separator)
            result[cells[2] if separator == '\t' else cells[0]] = float(
                cells[3] if separator == '\t' else cells[1]
            )
    return result


def bias_at(calibration: Calibration, axis: int, celsius: float) -> float:
    reference = (calibration.axes.x, calibration.axes.y, calibration.axes.z)[axis]
    one = calibration.static.axes()[axis]
    return reference.bias + one.bias_function.value(celsius - calibration.reference_temperature_c)


def test_px4_formula_gives_our_bias(cubic: Calibration) -> None:
    p = numbers(export_px4(cubic, instance=2, device_id=1376264).text, '\t')
    assert (p['TC_A_ENABLE'], p['TC_A2_ID']) == (1, 1376264)
    assert (p['TC_A2_TMIN'], p['TC_A2_TMAX']) == (5.0, 45.0)
    for axis in range(3):
        for celsius in (5.0, 20.0, 33.0, 45.0):
            d = celsius - p['TC_A2_TREF']
            offset = sum(p[f'TC_A2_X{power}_{axis}'] * d**power for power in range(4))
            # Nine digits are written, as a float holds.
            assert offset == pytest.approx(bias_at(cubic, axis, celsius), rel=1e-8, abs=1e-9)


def test_ardupilot_formula_gives_our_bias_changes(cubic: Calibration) -> None:
    p = numbers(export_ardupilot(cubic, imu=3).text, ',')

    def polynomial(axis: str, celsius: float) -> float:
        d = celsius - 35.0
        return sum(p[f'INS_TCAL3_ACC{n}_{axis}'] * d**n for n in (1, 2, 3)) * 1e-6

    for number, axis in enumerate('XYZ'):
        for celsius in (5.0, 33.0, 45.0):
            change = polynomial(axis, celsius) - polynomial(axis, 20.0)
            ours = bias_at(cubic, number, celsius) - bias_at(cubic, number, 20.0)
            assert change == pytest.approx(ours, rel=1e-7, abs=1e-9)


def test_px4_round_trip(cubic: Calibration) -> None:
    back = import_parameters(export_px4(cubic).text, serial='7')
    assert back.static.temperature_range_c == (5.0, 45.0)
    for axis in range(3):
        for celsius in (5.0, 20.0, 45.0):
            assert bias_at(back, axis, celsius) == pytest.approx(
                bias_at(cubic, axis, celsius), rel=1e-8, abs=1e-9
            )


def test_ardupilot_import_has_no_bias_where_it_was_calibrated(cubic: Calibration) -> None:
    text = export_ardupilot(cubic).text.replace(',', '=') + 'INS_ACC1_CALTEMP=28.0\n'
    back = import_parameters(text, serial='7')
    for axis in range(3):
        assert bias_at(back, axis, 28.0) == pytest.approx(0.0, abs=1e-12)
        ours = bias_at(cubic, axis, 41.0) - bias_at(cubic, axis, 28.0)
        assert bias_at(back, axis, 41.0) == pytest.approx(ours, rel=1e-7, abs=1e-9)


def test_counts_are_divided_by_the_scale_factor(cubic: Calibration) -> None:
    axes = Axes(*(AxisReference(300.0, 300.0 * bias) for bias in (0.1, -0.2, 0.3)))
    scaled = [
        replace(
            one, bias_function=Polynomial(tuple(300.0 * c for c in one.bias_function.coefficients))
        )
        for one in cubic.static.axes()
    ]
    regime = RegimeSet((5.0, 45.0), (-2.0, 2.0), *scaled)
    counts = replace(
        cubic, unit=Unit('7', 'counts', 32767.0, 0.005), axes=axes, static=regime, dynamic=regime
    )
    ours, expected = export_px4(counts), export_px4(cubic)
    assert any('counts divided by K' in note for note in ours.notes)
    for name, value in numbers(expected.text, '\t').items():
        assert numbers(ours.text, '\t')[name] == pytest.approx(value, rel=1e-8, abs=1e-12)


def test_scale_drift_is_folded_in_at_an_attitude(cubic: Calibration) -> None:
    drifting = replace(cubic.static.z, scale_function=Polynomial((1.0, 1e-4)))
    regime = replace(cubic.static, z=drifting)
    calibration = replace(cubic, static=regime, dynamic=regime)
    plain, level = export_px4(calibration), export_px4(calibration, up=(0.0, 0.0, 1.0))
    assert any(
        re.search(r'scale over temperature is lost: up to 2.5e\+03 ppm', n) for n in plain.notes
    )
    # 100 ppm/K of 9.81 m/s^2 on z, nothing on x.
    slope = [numbers(one.text, '\t')['TC_A0_X1_2'] for one in (plain, level)]
    assert slope[1] - slope[0] == pytest.approx(9.81e-4, rel=1e-5)
    assert numbers(plain.text, '\t')['TC_A0_X1_0'] == numbers(level.text, '\t')['TC_A0_X1_0']


def test_what_is_lost_is_said(cubic: Calibration) -> None:
    spline = CubicSpline((-15.0, 0.0, 10.0, 25.0), (0.01, 0.0, 0.02, -0.01))
    static = replace(cubic.static, x=AxisSet(spline, ONE))
    dynamic = replace(static, y=replace(static.y, delta=0.1))
    calibration = replace(
        cubic,
        static=static,
        dynamic=dynamic,
        response=(term('now', (0.0, 1e-3, 0.0)), term('board', tau_s=60.0)),
        misalignment=((1.0, 0.0, 0.0), (1e-3, 1.0, 0.0), (0.0, 0.0, 1.0)),
    )
    text = export_ardupilot(calibration)
    for expected in (
        'replaced by cubics',
        '1e+03 urad',
        r'response is lost (now): ',
        'dynamic set is lost',
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
    ],
)
def test_bad_parameters_are_refused(text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        import_parameters(text, serial='7')


def test_an_absent_set_and_an_empty_range_are_refused(cubic: Calibration) -> None:
    text = export_px4(cubic).text
    with pytest.raises(CalibrationError, match='no set of parameters 1'):
        import_parameters(text, serial='7', number=1)
    empty = re.sub(r'TMAX\t45', 'TMAX\t5', text)
    with pytest.raises(CalibrationError, match=r'range 5\.\.5 degC is empty'):
        import_parameters(empty, serial='7')


def test_impossible_arguments_are_refused(cubic: Calibration) -> None:
    with pytest.raises(ValueError, match=r'`instance` must be 0\.\.3, got 4'):
        export_px4(cubic, instance=4)
    with pytest.raises(ValueError, match=r'`imu` must be 1\.\.3, got 0'):
        export_ardupilot(cubic, imu=0)
    with pytest.raises(ValueError, match='`up` must be a unit vector'):
        export_px4(cubic, up=(0.0, 0.0, 9.81))
