# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the parameters of autopilots: PX4's ``TC_A*`` and ``TC_G*``, and ArduPilot's ``INS_TCAL*``.

Both correct each axis' bias by a cubic of the sensor's own temperature, held at the edges of a
range, in m/s^2 or, of a gyroscope, in rad/s, and nothing else::

    PX4        a = raw - (X0 + X1 d + X2 d^2 + X3 d^3),        d = T - TREF
    ArduPilot  a = raw - 1e-6 (p(T) - p(CALTEMP)),  p(T) = ACC1 d + ACC2 d^2 + ACC3 d^3, d = T - 35

A gyroscope's are ``TC_Gn`` in the place of ``TC_An``, and ``GYR`` in that of ``ACC``. ``raw`` is
already in m/s^2 there, scaled by the driver: counts are divided by K.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from ..errors import CalibrationError
from ..typing import Floats
from .content import Content

ARDUPILOT_REFERENCE_C = 35.0
_ARDUPILOT_SCALE = 1e6
# ArduPilot's value for a temperature of calibration that was never recorded.
_NO_TEMPERATURE = -273.0
_AXES = ('X', 'Y', 'Z')
_NOTE = (
    'imported: bias over the temperature of the board thermometer only; no scale, misalignment, '
    'ramp terms or uncertainty'
)
_NAME = re.compile(r'\b(TC_[AG]\d_\w+|TC_[AG]_ENABLE|INS_TCAL\d_\w+|INS_(?:ACC|GYR)\d_CALTEMP)\b')
_NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?')


def write_px4(content: Content, number: int | None, device_id: int) -> str:
    """Write PX4 parameters, in QGroundControl's format; ``TC_An`` has n from 0."""
    instance = _within(number, 0, 3)
    lower, upper = content.range_c
    values: list[tuple[str, float | int]] = []
    for letter, bias, known_id in (('A', content.bias, device_id), ('G', content.rate_bias, 0)):
        if bias is None:
            continue
        prefix = f'TC_{letter}{instance}_'
        values += [(f'TC_{letter}_ENABLE', 1), (f'{prefix}ID', known_id)]
        for axis, cubic in enumerate(bias):
            values += [(f'{prefix}X{power}_{axis}', value) for power, value in enumerate(cubic)]
        values += [(f'{prefix}TREF', content.reference_c), (f'{prefix}TMIN', lower)]
        values.append((f'{prefix}TMAX', upper))
        if not known_id:
            content.notes.append(
                f'{prefix}ID is 0: set it to the device id of the sensor, PX4 matches by it'
            )
    lines = [
        f'1\t1\t{name}\t{value}\t6' if isinstance(value, int) else f'1\t1\t{name}\t{value:.9g}\t9'
        for name, value in values
    ]
    return '\n'.join(['# Vehicle-Id Component-Id Name Value Type', *lines]) + '\n'


def write_ardupilot(content: Content, number: int | None, _device_id: int) -> str:
    """Write ArduPilot parameters; ``INS_TCALn`` has n from 1."""
    imu = _within(number, 1, 3)
    lower, upper = content.range_c
    prefix = f'INS_TCAL{imu}_'
    content.notes.append(
        'the offset itself is not written: calibrate the accelerometer as usual afterwards '
        f'(ArduPilot keeps its temperature in INS_ACC{imu}_CALTEMP)'
    )
    lines = [f'{prefix}ENABLE,1', f'{prefix}TMIN,{lower:.9g}', f'{prefix}TMAX,{upper:.9g}']
    for sensor, bias in (('ACC', content.bias), ('GYR', content.rate_bias)):
        if bias is None:
            continue
        for power in (1, 2, 3):
            lines += [
                f'{prefix}{sensor}{power}_{name},{bias[axis, power] * _ARDUPILOT_SCALE:.9g}'
                for axis, name in enumerate(_AXES)
            ]
    return '\n'.join(lines) + '\n'


def _within(number: int | None, lowest: int, highest: int) -> int:
    if number is None:
        return lowest
    if not lowest <= number <= highest:
        raise ValueError(f'`number` must be {lowest}..{highest}, got {number}')
    return number


def read_px4(text: str, number: int | None) -> Content | None:
    """Read PX4 parameters as QGroundControl saves them, or as ``NAME=VALUE``; None if not one."""
    values = _parse(text)
    found = {int(name[4]) for name in values if re.match(r'TC_A\d_X1_', name)}
    if not found:
        return None
    number = _choose(
        found,
        number,
        lambda n: any(values.get(f'TC_A{n}_X{p}_{a}') for p in range(4) for a in range(3)),
    )
    prefix = f'TC_A{number}_'
    if values.get('TC_A_ENABLE', 1.0) != 1.0:
        raise CalibrationError('is 0: the set is not in use', key='TC_A_ENABLE')
    bias, reference, edges = _px4_set(values, prefix)
    rate_bias = None
    of_rate = f'TC_G{number}_'
    if values.get('TC_G_ENABLE', 1.0) == 1.0 and f'{of_rate}X1_0' in values:
        rate_bias, its_own, (lower, upper) = _px4_set(values, of_rate)
        # One reference for both, and the range where both hold.
        moved = np.polynomial.Polynomial((reference - its_own, 1.0))
        for row in rate_bias:
            coefficients = np.polynomial.Polynomial(row)(moved).coef
            row[:] = np.pad(coefficients, (0, 4 - len(coefficients)))
        edges = max(edges[0], lower), min(edges[1], upper)
    source = f'PX4 {prefix}*'
    return Content(np.eye(3), bias, reference, edges, [_NOTE], source, rate_bias=rate_bias)


def read_ardupilot(text: str, number: int | None) -> Content | None:
    """Read ArduPilot parameters as Mission Planner or MAVProxy save them; None if not one."""
    values = _parse(text)
    found = {int(name[8]) for name in values if name.startswith('INS_TCAL')}
    if not found:
        return None
    number = _choose(found, number, lambda n: values.get(f'INS_TCAL{n}_ENABLE') == 1.0)
    prefix = f'INS_TCAL{number}_'
    if _need(values, f'{prefix}ENABLE') != 1.0:
        raise CalibrationError('is not 1: the set is not in use', key=f'{prefix}ENABLE')

    def cubics(sensor: str) -> tuple[Floats, tuple[float, float]]:
        bias = np.zeros((3, 4))
        for axis, name in enumerate(_AXES):
            for power in (1, 2, 3):
                value = _need(values, f'{prefix}{sensor}{power}_{name}')
                bias[axis, power] = value / _ARDUPILOT_SCALE
        edges = (_need(values, f'{prefix}TMIN'), _need(values, f'{prefix}TMAX'))
        # The correction is relative to the temperature of the offset calibration: no offset there.
        calibrated = values.get(f'INS_{sensor}{number}_CALTEMP', _NO_TEMPERATURE)
        d = min(max(calibrated, edges[0]), edges[1]) - ARDUPILOT_REFERENCE_C
        bias[:, 0] = -(bias[:, 1] * d + bias[:, 2] * d**2 + bias[:, 3] * d**3)
        return bias, edges

    bias, edges = cubics('ACC')
    # An autopilot that has learnt nothing of its gyroscope lists zeros.
    has_rate = any(v for name, v in values.items() if name.startswith(f'{prefix}GYR'))
    return Content(
        np.eye(3),
        bias,
        ARDUPILOT_REFERENCE_C,
        edges,
        [_NOTE],
        f'ArduPilot {prefix}*',
        rate_bias=cubics('GYR')[0] if has_rate else None,
    )


def _px4_set(values: dict[str, float], prefix: str) -> tuple[Floats, float, tuple[float, float]]:
    bias = np.array(
        [[_need(values, f'{prefix}X{p}_{axis}') for p in range(4)] for axis in range(3)]
    )
    edges = (_need(values, f'{prefix}TMIN'), _need(values, f'{prefix}TMAX'))
    return bias, _need(values, f'{prefix}TREF'), edges


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


def _choose(found: set[int], number: int | None, is_in_use: Callable[[int], bool]) -> int:
    """Choose a set: the one asked for, or the only one in use."""
    if number is None:
        live = [n for n in sorted(found) if is_in_use(n)] or sorted(found)
        if len(live) > 1:
            raise CalibrationError(f'several sets of parameters {live}: choose one')
        return live[0]
    if number not in found:
        raise CalibrationError(f'no set of parameters {number}, there is {sorted(found)}')
    return number


def _need(values: dict[str, float], name: str) -> float:
    if name not in values:
        raise CalibrationError('is missing', key=name)
    return values[name]
