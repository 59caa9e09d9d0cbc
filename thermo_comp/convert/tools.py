# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the files of other calibration tools: `TOOLS` writes and reads the file of each tool.

The thermal parameters of autopilots correct only the bias of an axis, by a cubic of the sensor's
temperature, which is limited to a range. ``a`` is the corrected reading ``raw`` [m/s^2, rad/s]::

    PX4        a = raw - (X0 + X1 d + X2 d^2 + X3 d^3),        d = T - TREF
    ArduPilot  a = raw - 1e-6 (p(T) - p(CALTEMP)),  p(T) = ACC1 d + ACC2 d^2 + ACC3 d^3, d = T - 35

For a gyroscope ``TC_Gn`` replaces ``TC_An``, and ``GYR`` replaces ``ACC``. The other tools
calibrate a triad at one temperature; with the reading N and the specific force a::

    imu_tk      a = T K (N - B)      T upper triangular, unit diagonal; K diagonal    (.calib)
    imu_calib   a = SM N - bias      SM any matrix                                    (YAML)
    Kalibr      N = M a + b          M lower triangular                               (YAML)
    thermo_comp a = M K^-1 (N - b)   M lower triangular, unit diagonal; K diagonal

If a tool's matrix is not lower triangular, the tool's frame is rotated relative to thermo_comp's.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import CalibrationError
from ..plain_yaml import load_plain_yaml
from ..typing import Floats

_ARDUPILOT_REFERENCE_C = 35.0  # temperature at which d of ArduPilot's cubic is 0 [degC]
_ARDUPILOT_SCALE = 1e6  # ArduPilot's coefficient / the same coefficient in m/s^2 or rad/s per K^n
_NO_TEMPERATURE = -273.0  # ArduPilot's value for an unknown calibration temperature [degC]
_AXES = ('X', 'Y', 'Z')
_THERMAL_NOTE = (
    'imported: bias over the temperature of the board thermometer only; no scale, misalignment, '
    'ramp terms or uncertainty'
)
_NAME = re.compile(r'\b(TC_[AG]\d_\w+|TC_[AG]_ENABLE|INS_TCAL\d_\w+|INS_(?:ACC|GYR)\d_CALTEMP)\b')
_NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?')
#: Assumed reference temperature and range [degC]: imu_tk, imu_calib and Kalibr state neither.
_REFERENCE_C, _RANGE_C = 20.0, (-60.0, 120.0)
_TRIAD_NOTE = 'imported: constants of one temperature, used at all temperatures; no uncertainty'
_HEADING = re.compile(r'\s*(#|Misalignment Matrix|Scale Matrix|Bias Vector)')


@dataclass(frozen=True)
class Content:
    """Content of a tool's file: ``a = matrix (N - bias)``, with the reading N."""

    matrix: Floats  # shape (3, 3); the identity in an autopilot's file
    bias: Floats  # coefficients of each axis' cubic over temperature [unit of readings], (3, 4)
    reference_c: float  # temperature at which the argument of the cubics is 0
    range_c: tuple[float, float]
    notes: list[str]  # parts of the calibration that are lost or missing
    source: str = ''  # the tool and the parameter set that was read
    number: int | None = None  # number of the parameter set or IMU to write
    device_id: int = 0  # identity of the sensor in PX4; 0: unknown
    # White noise [m/s^2/sqrt(Hz)], random walk [m/s^2/sqrt(h)], sample rate [Hz]; in a file that
    # was read, 0 means that the file does not state the value.
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_bias: Floats | None = None  # like `bias`, for the angular rate [rad/s]
    text: str = ''  # the written file


def _write_px4(content: Content) -> str:
    """Write PX4 parameters in QGroundControl's format; the n of ``TC_An`` counts from 0."""
    instance = _within(content.number, 0)
    lower, upper = content.range_c
    lines = ['# Vehicle-Id Component-Id Name Value Type']
    sensors = ('A', content.bias, content.device_id), ('G', content.rate_bias, 0)
    for letter, bias, known_id in sensors:
        if bias is None:
            continue
        prefix = f'TC_{letter}{instance}_'
        values = {f'X{power}_{axis}': bias[axis, power] for axis in range(3) for power in range(4)}
        values |= {'TREF': content.reference_c, 'TMIN': lower, 'TMAX': upper}
        lines += [f'1\t1\tTC_{letter}_ENABLE\t1\t6', f'1\t1\t{prefix}ID\t{known_id}\t6']
        lines += [f'1\t1\t{prefix}{name}\t{value:.9g}\t9' for name, value in values.items()]
        if not known_id:
            content.notes.append(
                f'{prefix}ID is 0: set it to the device id of the sensor, by which PX4 finds the '
                'parameters of a sensor' + ' (--device-id)' * (letter == 'A')
            )
    return '\n'.join(lines) + '\n'


def _write_ardupilot(content: Content) -> str:
    """Write ArduPilot parameters; the n of ``INS_TCALn`` counts from 1."""
    imu = _within(content.number, 1)
    lower, upper = content.range_c
    content.notes.append(
        'the file has the changes of the offset with temperature, not the offset: calibrate the '
        'accelerometer in ArduPilot as usual afterwards (ArduPilot keeps the temperature of that '
        f'calibration in INS_ACC{imu}_CALTEMP)'
    )
    values = {'ENABLE': 1.0, 'TMIN': lower, 'TMAX': upper}
    for sensor, bias in (('ACC', content.bias), ('GYR', content.rate_bias)):
        if bias is None:
            continue
        for power in (1, 2, 3):
            cubics = zip(_AXES, bias[:, power] * _ARDUPILOT_SCALE, strict=True)
            values |= {f'{sensor}{power}_{axis}': value for axis, value in cubics}
    return ''.join(f'INS_TCAL{imu}_{name},{value:.9g}\n' for name, value in values.items())


def _within(number: int | None, lowest: int) -> int:
    if number is not None and not lowest <= number <= 3:
        raise ValueError(f'`number` must be {lowest}..3, got {number}')
    return lowest if number is None else number


def _read_px4(text: str, number: int | None) -> Content | None:
    """Read PX4 parameters (QGroundControl's format or ``NAME=VALUE``); None if no TC_A exists."""
    values = _Parameters(text)
    numbers = {int(name[4]) for name in values if re.match(r'TC_A\d_X1_', name)}
    if not numbers:
        return None
    number = _choose(numbers, number, lambda n: values.has(f'TC_A{n}_X'))
    if values.get('TC_A_ENABLE', 1.0) != 1.0:
        raise CalibrationError('is 0: PX4 uses no TC_A set', key='TC_A_ENABLE')

    def cubics(prefix: str) -> tuple[Floats, float, float, float]:
        bias = [[values[f'{prefix}X{p}_{axis}'] for p in range(4)] for axis in range(3)]
        edges = values[f'{prefix}TMIN'], values[f'{prefix}TMAX']
        return np.array(bias), values[f'{prefix}TREF'], *edges

    bias, reference, lower, upper = cubics(f'TC_A{number}_')
    rate_bias = None
    if values.get('TC_G_ENABLE', 1.0) == 1.0 and f'TC_G{number}_X1_0' in values:
        rate_bias, rate_reference, *rate_range = cubics(f'TC_G{number}_')
        # Expand the cubics about `reference`, the temperature at which d of TC_A is 0.
        moved = np.polynomial.Polynomial((reference - rate_reference, 1.0))
        for row in rate_bias:
            coefficients = np.polynomial.Polynomial(row)(moved).coef
            row[:] = np.pad(coefficients, (0, 4 - len(coefficients)))
        lower, upper = max(lower, rate_range[0]), min(upper, rate_range[1])
    source, notes = f'PX4 TC_A{number}_*', [_THERMAL_NOTE]
    return Content(np.eye(3), bias, reference, (lower, upper), notes, source, rate_bias=rate_bias)


def _read_ardupilot(text: str, number: int | None) -> Content | None:
    """Read ArduPilot parameters (Mission Planner, MAVProxy); None for another tool."""
    values = _Parameters(text)
    numbers = {int(name[8]) for name in values if name.startswith('INS_TCAL')}
    if not numbers:
        return None
    number = _choose(numbers, number, lambda n: values.get(f'INS_TCAL{n}_ENABLE') == 1.0)
    prefix = f'INS_TCAL{number}_'
    if values[f'{prefix}ENABLE'] != 1.0:
        raise CalibrationError('is not 1: ArduPilot ignores this set', key=f'{prefix}ENABLE')

    def cubics(sensor: str) -> Floats:
        names = [[f'{prefix}{sensor}{power}_{axis}' for power in (1, 2, 3)] for axis in _AXES]
        slopes = np.array([[values[name] for name in row] for row in names]) / _ARDUPILOT_SCALE
        # The correction is 0 at the temperature of ArduPilot's offset calibration.
        calibrated = values.get(f'INS_{sensor}{number}_CALTEMP', _NO_TEMPERATURE)
        held = min(max(calibrated, values[f'{prefix}TMIN']), values[f'{prefix}TMAX'])
        powers = (held - _ARDUPILOT_REFERENCE_C) ** np.arange(1, 4)
        return np.column_stack((-slopes @ powers, slopes))

    bias, range_c = cubics('ACC'), (values[f'{prefix}TMIN'], values[f'{prefix}TMAX'])
    # The parameters of a gyroscope without a thermal calibration are zeros.
    rate_bias = cubics('GYR') if values.has(f'{prefix}GYR') else None
    source, notes = f'ArduPilot {prefix}*', [_THERMAL_NOTE]
    reference = _ARDUPILOT_REFERENCE_C
    return Content(np.eye(3), bias, reference, range_c, notes, source, rate_bias=rate_bias)


class _Parameters(dict[str, float]):
    """Thermal parameters in a text, by name; CalibrationError for a missing parameter."""

    def __init__(self, text: str) -> None:
        for line in text.splitlines():
            name = None if line.lstrip().startswith('#') else _NAME.search(line)
            if name is None:
                continue
            value = _NUMBER.search(line, name.end())
            if value is None:
                raise CalibrationError(f'{name[0]} has no value', key=name[0])
            self[name[0]] = float(value[0])

    def has(self, prefix: str) -> bool:
        """Whether any parameter with this prefix is not 0."""
        return any(value for name, value in self.items() if name.startswith(prefix))

    def __missing__(self, name: str) -> float:
        raise CalibrationError('is missing', key=name)


def _choose(numbers: set[int], number: int | None, is_in_use: Callable[[int], bool]) -> int:
    """Return the number of the parameter set, by default of the only set in use."""
    if number is None:
        live = [n for n in sorted(numbers) if is_in_use(n)] or sorted(numbers)
        if len(live) > 1:
            raise CalibrationError(
                f'the file has several sets of parameters, {live}: choose a set with --number'
            )
        return live[0]
    if number not in numbers:
        raise CalibrationError(
            f'no set of parameters {number} (--number); the file has the sets {sorted(numbers)}'
        )
    return number


def ql(matrix: Floats) -> tuple[Floats, Floats]:
    """Decompose a matrix into a rotation and a lower triangle with a positive diagonal."""
    rotation, lower = _qr(matrix[::-1, ::-1])
    return rotation[::-1, ::-1], lower[::-1, ::-1]


def _qr(matrix: Floats) -> tuple[Floats, Floats]:
    """Decompose a matrix into a rotation and an upper triangle with a positive diagonal."""
    rotation, upper = np.linalg.qr(matrix)
    signs = np.diag(np.sign(np.diag(upper)))
    return rotation @ signs, signs @ upper


def rotation_notes(rotation: Floats) -> list[str]:
    """Describe the rotation from a tool's frame to thermo_comp's; empty without a rotation."""
    if np.abs(rotation - np.eye(3)).max() < 1e-9:
        return []
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    angles = f'{roll:.6g} {pitch:.6g} {yaw:.6g}'
    return [
        "the axes of the other tool's frame differ from thermo_comp's: the tf from the other "
        f"tool's frame to thermo_comp's has roll, pitch, yaw {angles} rad"
    ]


def _write_imu_tk(content: Content) -> str:
    """Write the three blocks of imu_tk's ``.calib``; imu_tk's reader accepts no comments."""
    rotation, upper = _qr(content.matrix)
    scale = np.diag(upper)
    content.notes.extend(rotation_notes(rotation.T))
    return ''.join(
        ''.join(' '.join(map(repr, row)) + '\n' for row in block.tolist()) + '\n'
        for block in (upper / scale, np.diag(scale), content.bias[:, :1])
    )


def _write_imu_calib(content: Content) -> str:
    bias = content.matrix @ content.bias[:, 0]
    return f'SM: {content.matrix.ravel().tolist()}\nbias: {bias.tolist()}\n'


def _write_kalibr(content: Content) -> str:
    """Write Kalibr's YAML of an IMU, without topic and gyroscope."""
    white, walk, rate = content.noise
    rows = ''.join(f'    - {row}\n' for row in np.linalg.inv(content.matrix).tolist())
    content.notes.append('Kalibr estimates the bias in each run and ignores the key `bias`')
    content.notes.append('the file lacks rostopic and gyroscope of the IMU: add these for Kalibr')
    return (
        f'imu{content.number or 0}:\n  model: scale-misalignment\n  update_rate: {rate:.9g}\n'
        f'  accelerometer_noise_density: {white!r}\n'
        f'  accelerometer_random_walk: {walk / 60.0!r}\n'
        f'  accelerometers:\n    M:\n{rows}    bias: {content.bias[:, 0].tolist()}\n'
    )


def _read_imu_tk(text: str, number: int | None) -> Content | None:
    """Read imu_tk's ``.calib``: 21 numbers, with or without headings; None for another format."""
    lines = (line for line in text.splitlines() if not _HEADING.match(line))
    try:
        numbers = np.array([float(cell) for line in lines for cell in line.split()])
    except ValueError:
        return None
    if len(numbers) != 21:
        return None
    _refuse_number('imu_tk', number)
    T, K = numbers[:18].reshape(2, 3, 3)
    return _triad('imu_tk', _regular(T @ K), numbers[18:])


def _read_imu_calib(text: str, number: int | None) -> Content | None:
    """Read imu_calib's YAML; None for another tool's file."""
    data = _mapping(text)
    if not {'SM', 'bias'} <= data.keys():
        return None
    _refuse_number('imu_calib', number)
    matrix = _regular(_array(data['SM'], 'SM', 9).reshape(3, 3))
    bias = np.linalg.solve(matrix, _array(data['bias'], 'bias', 3))
    return _triad('imu_calib', matrix, np.asarray(bias, np.float64))


def _refuse_number(tool: str, number: int | None) -> None:
    if number is not None:
        raise CalibrationError(f'a file of {tool} has no set of parameters {number}, only one set')


def _read_kalibr(text: str, number: int | None) -> Content | None:
    """Read an IMU of Kalibr's YAML, by the number of the IMU; None if no IMU has a matrix."""
    imus = {
        name: part
        for name, part in _mapping(text).items()
        if 'M' in _dictionary(_dictionary(part).get('accelerometers'))
    }
    if not imus:
        return None
    name = next(iter(imus)) if number is None else f'imu{number}'
    if name not in imus or (number is None and len(imus) > 1):
        raise CalibrationError(f'choose an IMU with --number: the file has {", ".join(imus)}')
    part = imus[name]['accelerometers']
    matrix = _regular(_array(part['M'], f'{name}.accelerometers.M', 9).reshape(3, 3))
    bias = _array(part.get('bias', [0, 0, 0]), f'{name}.accelerometers.bias', 3)
    lacks = '' if 'bias' in part else '; the file of Kalibr has no bias: 0 is used'
    stated = []
    for key in ('accelerometer_noise_density', 'update_rate'):
        value = float(_array(imus[name].get(key, 0.0), f'{name}.{key}', 1)[0])
        if value < 0.0:
            raise CalibrationError('must be 0 or more', key=f'{name}.{key}')
        stated.append(value)
    white, rate = stated
    inverse = np.asarray(np.linalg.inv(matrix), np.float64)
    return replace(_triad(f'Kalibr {name}', inverse, bias, lacks), noise=(white, 0.0, rate))


def _regular(matrix: Floats) -> Floats:
    if not 0.0 < np.linalg.det(matrix) < np.inf:
        raise CalibrationError(
            'the matrix is singular or mirrors the axes (its determinant must be above 0), so it '
            'cannot correct an accelerometer'
        )
    return matrix


def _triad(source: str, matrix: Floats, bias: Floats, lacks: str = '') -> Content:
    cubic = np.pad(bias[:, None], ((0, 0), (0, 3)))
    return Content(matrix, cubic, _REFERENCE_C, _RANGE_C, [_TRIAD_NOTE + lacks], source)


def _mapping(text: str) -> dict[str, Any]:
    try:
        return _dictionary(load_plain_yaml(text))
    except ValueError:
        return {}


def _dictionary(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _array(value: object, key: str, size: int) -> Floats:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != size or not np.isfinite(array).all():
        raise CalibrationError(f'must be {size} finite numbers', key=key)
    return array.ravel()


@dataclass(frozen=True)
class Tool:
    """Writer and reader of a tool's files, which hold bias curves (`is_thermal`) or constants."""

    write: Callable[[Content], str]
    read: Callable[[str, int | None], Content | None]  # returns None for the file of another tool
    is_thermal: bool = False
    reference_c: float | None = None  # the fixed reference temperature of an autopilot


TOOLS = {
    'px4': Tool(_write_px4, _read_px4, is_thermal=True),
    'ardupilot': Tool(_write_ardupilot, _read_ardupilot, True, _ARDUPILOT_REFERENCE_C),
    'imu_tk': Tool(_write_imu_tk, _read_imu_tk),
    'imu_calib': Tool(_write_imu_calib, _read_imu_calib),
    'kalibr': Tool(_write_kalibr, _read_kalibr),
}
