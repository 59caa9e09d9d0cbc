# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns exchange with autopilots: PX4 ``TC_A*`` and ArduPilot ``INS_TCAL*`` parameters, both ways.

Both correct each axis' bias by a cubic of the sensor's own temperature, held at the edges of a
range, in m/s^2, and nothing else::

    PX4        a = raw - (X0 + X1 d + X2 d^2 + X3 d^3),        d = T - TREF
    ArduPilot  a = raw - 1e-6 (p(T) - p(CALTEMP)),  p(T) = ACC1 d + ACC2 d^2 + ACC3 d^3, d = T - 35

What a calibration holds beyond that is named in the notes of an export, with the error that its
loss leaves. ``raw`` there is already in m/s^2, scaled by the driver: counts are divided by K.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ..errors import CalibrationError
from ..text import one_line
from ..typing import Floats
from ..unit.calibration import (
    FORMAT_VERSION,
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    Provenance,
    RegimeSet,
    Unit,
)
from ..unit.functions import Polynomial
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY

ARDUPILOT_REFERENCE_C = 35.0
_ARDUPILOT_SCALE = 1e6
# ArduPilot's value for a temperature of calibration that was never recorded.
_NO_TEMPERATURE = -273.0
_AXES = ('X', 'Y', 'Z')
_GRID = 257
_NAME = re.compile(r'\b(TC_A\d_\w+|TC_A_ENABLE|INS_TCAL\d_\w+|INS_ACC\d_CALTEMP)\b')
_NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?')


@dataclass(frozen=True)
class ParameterFile:
    """
    A parameter file, and what the autopilot cannot express, one line each with what it costs.
    """

    text: str
    notes: tuple[str, ...]


def export_px4(
    calibration: Calibration,
    *,
    instance: int = 0,
    device_id: int = 0,
    up: tuple[float, float, float] | None = None,
) -> ParameterFile:
    """
    Write a calibration's static set as PX4 parameters (QGroundControl's format).

    `instance` is the ``n`` of ``TC_An``, `device_id` the sensor's id, by which PX4 matches the
    set. At the attitude `up`, a unit vector, the drift of the scale is folded into the offset.

    Raises ValueError if `instance` is not 0..3 or `up` is not a unit vector.
    """
    if not 0 <= instance <= 3:
        raise ValueError(f'`instance` must be 0..3, got {instance}')
    reference = calibration.reference_temperature_c
    cubics, notes = _cubics(calibration, reference, up)
    lower, upper = calibration.static.temperature_range_c
    prefix = f'TC_A{instance}_'
    values: list[tuple[str, float | int]] = [('TC_A_ENABLE', 1), (f'{prefix}ID', device_id)]
    for axis in range(3):
        values += [(f'{prefix}X{power}_{axis}', cubics[axis, power]) for power in range(4)]
    values += [(f'{prefix}TREF', reference), (f'{prefix}TMIN', lower), (f'{prefix}TMAX', upper)]
    if not device_id:
        notes.append(f'{prefix}ID is 0: set it to the device id of the sensor, PX4 matches by it')
    lines = _comments(calibration, [*notes, 'Vehicle-Id Component-Id Name Value Type'])
    lines += [
        f'1\t1\t{name}\t{value}\t6' if isinstance(value, int) else f'1\t1\t{name}\t{value:.9g}\t9'
        for name, value in values
    ]
    return ParameterFile('\n'.join(lines) + '\n', tuple(notes))


def export_ardupilot(
    calibration: Calibration, *, imu: int = 1, up: tuple[float, float, float] | None = None
) -> ParameterFile:
    """
    Write a calibration's static set as ArduPilot parameters; `imu` is the ``n`` of ``INS_TCALn``.

    Raises ValueError if `imu` is not 1..3 or `up` is not a unit vector.
    """
    if not 1 <= imu <= 3:
        raise ValueError(f'`imu` must be 1..3, got {imu}')
    cubics, notes = _cubics(calibration, ARDUPILOT_REFERENCE_C, up)
    lower, upper = calibration.static.temperature_range_c
    prefix = f'INS_TCAL{imu}_'
    notes.append(
        'the offset itself is not written: calibrate the accelerometer as usual afterwards '
        f'(ArduPilot keeps its temperature in INS_ACC{imu}_CALTEMP)'
    )
    lines = _comments(calibration, notes)
    lines += [f'{prefix}ENABLE,1', f'{prefix}TMIN,{lower:.9g}', f'{prefix}TMAX,{upper:.9g}']
    for power in (1, 2, 3):
        lines += [
            f'{prefix}ACC{power}_{name},{cubics[axis, power] * _ARDUPILOT_SCALE:.9g}'
            for axis, name in enumerate(_AXES)
        ]
    return ParameterFile('\n'.join(lines) + '\n', tuple(notes))


def import_parameters(
    text: str,
    *,
    serial: str,
    number: int | None = None,
    gravity: float = STANDARD_GRAVITY,
    cycle_time_s: float = 0.005,
    full_scale: float = 16.0 * STANDARD_GRAVITY,
    noise_density: float = 200.0 * MICRO_G,
) -> Calibration:
    """
    Read PX4 or ArduPilot parameters as a calibration of a unit that speaks m/s^2.

    The text is QGroundControl's, Mission Planner's, MAVProxy's or ``NAME=VALUE``. `number` chooses
    an instance (PX4, from 0) or IMU (ArduPilot, from 1); None takes the only one there is. The
    result has scale 1, no misalignment and the same set in both regimes.

    Raises CalibrationError if the text holds no thermal parameters, several sets and none was
    chosen, an incomplete or disabled one, or an empty temperature range.
    """
    values = _parse(text)
    px4 = sorted({int(name[4]) for name in values if re.match(r'TC_A\d_X1_', name)})
    ardupilot = sorted({int(name[8]) for name in values if name.startswith('INS_TCAL')})
    found = px4 or ardupilot
    if not found:
        raise CalibrationError('no TC_A* (PX4) or INS_TCAL* (ArduPilot) parameters in the text')
    if number is None:
        live = [n for n in found if _is_in_use(values, n, bool(px4))] or found
        if len(live) > 1:
            raise CalibrationError(f'several sets of parameters {live}: choose one')
        number = live[0]
    elif number not in found:
        raise CalibrationError(f'no set of parameters {number}, there is {found}')
    if px4:
        bias, reference, edges, source = _read_px4(values, number)
    else:
        bias, reference, edges, source = _read_ardupilot(values, number)
    if not edges[0] < edges[1]:
        raise CalibrationError(f'temperature range {edges[0]:g}..{edges[1]:g} degC is empty')
    one = Polynomial((1.0,))
    axes = [
        AxisSet(Polynomial((0.0, *(float(c) for c in bias[axis, 1:]))), one) for axis in range(3)
    ]
    regime = RegimeSet(edges, (-60.0, 60.0), axes[0], axes[1], axes[2])
    return Calibration(
        format_version=FORMAT_VERSION,
        unit=Unit(serial, 'm/s^2', full_scale, cycle_time_s),
        reference_temperature_c=reference,
        gravity_m_s2=gravity,
        axes=Axes(*(AxisReference(1.0, float(bias[axis, 0])) for axis in range(3))),
        static=regime,
        dynamic=regime,
        noise_density_m_s2_sqrt_hz=(noise_density,) * 3,
        provenance=Provenance(
            model=source,
            notes=(
                'imported: bias over the temperature of the board thermometer only; no scale, '
                'misalignment, ramp terms or uncertainty',
            ),
        ),
    )


def _comments(calibration: Calibration, notes: list[str]) -> list[str]:
    """Head a parameter file; whatever a note holds, it ends with its line."""
    title = f'Thermal calibration of unit {calibration.unit.serial}, by thermo_comp'
    return [f'# {one_line(said)}' for said in (title, *notes)]


def _cubics(
    calibration: Calibration, reference: float, up: tuple[float, float, float] | None
) -> tuple[Floats, list[str]]:
    """Cubic of each axis' offset [m/s^2] about a reference, shape (3, 4), and what it lacks."""
    direction = np.zeros(3) if up is None else np.array(up, dtype=np.float64)
    if up is not None and not abs(np.linalg.norm(direction) - 1.0) < 1e-6:
        raise ValueError(f'`up` must be a unit vector, got {up}')
    lower, upper = calibration.static.temperature_range_c
    temperature = np.linspace(lower, upper, _GRID)
    t = temperature - calibration.reference_temperature_c
    loads = calibration.gravity_m_s2 * direction
    cubics = np.empty((3, 4))
    misfit, scale_drift = 0.0, 0.0
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    for axis, (one, of_axis) in enumerate(zip(calibration.static.axes(), axes, strict=True)):
        offset = (of_axis.bias + one.delta + one.bias_function.value(t)) / of_axis.scale_factor
        drift = one.scale_function.value(t) - 1.0
        scale_drift = max(scale_drift, float(np.max(np.abs(drift))))
        offset = offset + loads[axis] * drift
        fitted = np.polynomial.Polynomial.fit(temperature - reference, offset, 3).convert().coef
        cubics[axis] = np.pad(fitted, (0, 4 - len(fitted)))
        error = np.polynomial.polynomial.polyval(temperature - reference, cubics[axis]) - offset
        misfit = max(misfit, float(np.max(np.abs(error))))
    return cubics, _losses(calibration, misfit, scale_drift, up)


def _losses(
    calibration: Calibration,
    misfit: float,
    scale_drift: float,
    up: tuple[float, float, float] | None,
) -> list[str]:
    notes = []
    if misfit > 0.01 * MICRO_G:
        notes.append(f'bias functions replaced by cubics, off by {misfit / MICRO_G:.2g} ug')
    if scale_drift > 1e-8:
        rest = 'folded into the offset at one attitude' if up else 'lost'
        notes.append(f'scale over temperature is {rest}: up to {1e6 * scale_drift:.2g} ppm')
    matrix = np.array(calibration.misalignment)
    worst = float(np.max(np.abs(matrix - np.eye(3))))
    if worst:
        notes.append(f'misalignment is lost: up to {1e6 * worst:.3g} urad')
    lost = sorted({term.group for term in calibration.response if any(term.bias + term.scale)})
    if lost:
        notes.append(
            f'the thermal response is lost ({", ".join(lost)}): heating and cooling read the same'
        )
    curves = [
        [(one.delta, one.bias_function, one.scale_function) for one in regime.axes()]
        for regime in calibration.regime_sets()
    ]
    if curves[0] != curves[1]:
        notes.append('the dynamic set is lost: the static one is used in ramps, too')
    if calibration.unit.input == 'counts':
        notes.append('offsets are counts divided by K: the driver must scale by these K')
    return notes


def _parse(text: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for line in text.splitlines():
        if line.lstrip().startswith('#'):
            continue
        name = _NAME.search(line)
        if name is None:
            continue
        value = _NUMBER.search(line, name.end())
        if value is None:
            raise CalibrationError(f'{name[0]} has no value', key=name[0])
        values[name[0]] = float(value[0])
    return values


def _is_in_use(values: dict[str, float], number: int, is_px4: bool) -> bool:
    if is_px4:
        return any(values.get(f'TC_A{number}_X{p}_{a}') for p in range(4) for a in range(3))
    return values.get(f'INS_TCAL{number}_ENABLE') == 1.0


def _need(values: dict[str, float], name: str) -> float:
    if name not in values:
        raise CalibrationError('is missing', key=name)
    return values[name]


def _read_px4(
    values: dict[str, float], number: int
) -> tuple[Floats, float, tuple[float, float], str]:
    prefix = f'TC_A{number}_'
    if values.get('TC_A_ENABLE', 1.0) != 1.0:
        raise CalibrationError('is 0: the set is not in use', key='TC_A_ENABLE')
    bias = np.array(
        [[_need(values, f'{prefix}X{p}_{axis}') for p in range(4)] for axis in range(3)]
    )
    edges = (_need(values, f'{prefix}TMIN'), _need(values, f'{prefix}TMAX'))
    return bias, _need(values, f'{prefix}TREF'), edges, f'PX4 {prefix}*'


def _read_ardupilot(
    values: dict[str, float], number: int
) -> tuple[Floats, float, tuple[float, float], str]:
    prefix = f'INS_TCAL{number}_'
    if _need(values, f'{prefix}ENABLE') != 1.0:
        raise CalibrationError('is not 1: the set is not in use', key=f'{prefix}ENABLE')
    bias = np.zeros((3, 4))
    for axis, name in enumerate(_AXES):
        for power in (1, 2, 3):
            value = _need(values, f'{prefix}ACC{power}_{name}')
            bias[axis, power] = value / _ARDUPILOT_SCALE
    edges = (_need(values, f'{prefix}TMIN'), _need(values, f'{prefix}TMAX'))
    # The correction is relative to the temperature of the offset calibration: no offset there.
    calibrated = values.get(f'INS_ACC{number}_CALTEMP', _NO_TEMPERATURE)
    d = min(max(calibrated, edges[0]), edges[1]) - ARDUPILOT_REFERENCE_C
    bias[:, 0] = -(bias[:, 1] * d + bias[:, 2] * d**2 + bias[:, 3] * d**3)
    return bias, ARDUPILOT_REFERENCE_C, edges, f'ArduPilot {prefix}*'
