# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the files of tools that calibrate a triad at one temperature: imu_tk, imu_calib, Kalibr.

With the raw reading N and the specific force a::

    imu_tk      a = T K (N - B)      T upper triangular, unit diagonal; K diagonal    (.calib)
    imu_calib   a = SM N - bias      SM any matrix                                    (YAML)
    Kalibr      N = M a + b          M lower triangular                               (YAML)
    here        a = M K^-1 (N - b)   M lower triangular, unit diagonal; K diagonal

A triangle of the other kind, or a full matrix, belongs to a frame that is turned against ours.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from ..errors import CalibrationError
from ..plain_yaml import load_plain_yaml
from ..typing import Floats
from .content import Content

#: What their tools do not say: where their constants were found.
_REFERENCE_C, _RANGE_C = 20.0, (-60.0, 120.0)
_NOTE = 'imported: constants of one temperature, taken for all; no uncertainty'
_HEADING = re.compile(r'\s*(#|Misalignment Matrix|Scale Matrix|Bias Vector)')


def ql(matrix: Floats) -> tuple[Floats, Floats]:
    """Take a matrix apart into a rotation and a lower triangle with a positive diagonal."""
    flip = np.eye(3)[::-1]
    rotation, upper = qr(flip @ matrix @ flip)
    return flip @ rotation @ flip, flip @ upper @ flip


def qr(matrix: Floats) -> tuple[Floats, Floats]:
    """Take a matrix apart into a rotation and an upper triangle with a positive diagonal."""
    rotation, upper = np.linalg.qr(matrix)
    signs = np.diag(np.sign(np.diag(upper)))
    return rotation @ signs, signs @ upper


def turned(rotation: Floats) -> list[str]:
    """Say by what our frame is turned in theirs, as tf takes it; nothing where it is not."""
    if np.abs(rotation - np.eye(3)).max() < 1e-9:
        return []
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    angles = f'{roll:.6g} {pitch:.6g} {yaw:.6g}'
    return [f'the frames differ: tf from theirs to ours has roll, pitch, yaw {angles} rad']


def write_imu_tk(content: Content, _number: int | None, _device_id: int) -> str:
    """Write the three blocks of imu_tk's ``.calib``; its reader knows no comments."""
    rotation, upper = qr(content.matrix)
    scale = np.diag(upper)
    content.notes.extend(turned(rotation.T))
    return ''.join(
        ''.join(' '.join(map(repr, row)) + '\n' for row in block.tolist()) + '\n'
        for block in (upper / scale, np.diag(scale), content.bias[:, :1])
    )


def write_imu_calib(content: Content, _number: int | None, _device_id: int) -> str:
    """Write imu_calib's YAML: the matrix row by row, the bias behind it."""
    bias = content.matrix @ content.bias[:, 0]
    return f'SM: {content.matrix.ravel().tolist()}\nbias: {bias.tolist()}\n'


def write_kalibr(content: Content, number: int | None, _device_id: int) -> str:
    """Write the accelerometer's part of an IMU in Kalibr's YAML."""
    white, walk, rate = content.noise
    rows = ''.join(f'    - {row}\n' for row in np.linalg.inv(content.matrix).tolist())
    content.notes.append('Kalibr finds the bias anew each time and overlooks the key `bias`')
    content.notes.append('topic and gyroscope are yours to add')
    return (
        f'imu{number or 0}:\n  model: scale-misalignment\n  update_rate: {rate:.9g}\n'
        f'  accelerometer_noise_density: {white!r}\n'
        f'  accelerometer_random_walk: {walk / 60.0!r}\n'
        f'  accelerometers:\n    M:\n{rows}    bias: {content.bias[:, 0].tolist()}\n'
    )


def read_imu_tk(text: str, _number: int | None) -> Content | None:
    """Read imu_tk's ``.calib``: 21 numbers, perhaps with its headings; None if not one."""
    lines = (line for line in text.splitlines() if not _HEADING.match(line))
    try:
        numbers = np.array([float(cell) for line in lines for cell in line.split()])
    except ValueError:
        return None
    if len(numbers) != 21:
        return None
    T, K = numbers[:18].reshape(2, 3, 3)
    return _content('imu_tk', _regular(T @ K), numbers[18:], _NOTE)


def read_imu_calib(text: str, _number: int | None) -> Content | None:
    """Read imu_calib's YAML; None if not one."""
    data = _mapping(text)
    if not {'SM', 'bias'} <= data.keys():
        return None
    matrix = _regular(_array(data['SM'], 'SM', 9).reshape(3, 3))
    bias = np.asarray(np.linalg.solve(matrix, _array(data['bias'], 'bias', 3)), np.float64)
    return _content('imu_calib', matrix, bias, _NOTE)


def read_kalibr(text: str, number: int | None) -> Content | None:
    """Read one IMU of Kalibr's YAML, by its number; None if there is none with a matrix."""
    imus = {
        str(name): part
        for name, part in _mapping(text).items()
        if isinstance(part, dict)
        and isinstance(part.get('accelerometers'), dict)
        and 'M' in part['accelerometers']
    }
    if not imus:
        return None
    name = next(iter(imus)) if number is None else f'imu{number}'
    if name not in imus or (number is None and len(imus) > 1):
        raise CalibrationError(f'choose one of the IMUs: there are {", ".join(imus)}')
    part = imus[name]['accelerometers']
    matrix = _regular(_array(part['M'], f'{name}.accelerometers.M', 9).reshape(3, 3))
    bias = _array(part.get('bias', [0, 0, 0]), f'{name}.accelerometers.bias', 3)
    note = _NOTE if 'bias' in part else f'{_NOTE}; Kalibr keeps no bias: it is 0 here'
    inverse = np.asarray(np.linalg.inv(matrix), np.float64)
    return _content(f'Kalibr {name}', inverse, bias, note)


def _regular(matrix: Floats) -> Floats:
    if not 0.0 < np.linalg.det(matrix) < np.inf:
        raise CalibrationError('its matrix mirrors or flattens: it is no correction of a triad')
    return matrix


def _content(source: str, matrix: Floats, bias: Floats, note: str) -> Content:
    cubic = np.zeros((3, 4))
    cubic[:, 0] = bias
    return Content(matrix, cubic, _REFERENCE_C, _RANGE_C, [note], source)


def _mapping(text: str) -> dict[str, Any]:
    try:
        data = load_plain_yaml(text)
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}


def _array(value: object, key: str, size: int) -> Floats:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != size or not np.isfinite(array).all():
        raise CalibrationError(f'must be {size} finite numbers', key=key)
    return array.ravel()
