# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the step from the parameter `calibration_file` to a calibration that this node may run.

"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from ..errors import CalibrationError
from ..files import read_bounded
from ..unit.calibration import Calibration
from ..unit.calibration_file import SIZE_LIMIT, parse_calibration
from .parameters import NodeConfig


@dataclass(frozen=True, slots=True)
class LoadedCalibration:
    """
    A calibration and the file it stands for.

    Attributes
    ----------
    calibration : Calibration
    path : str
        As the user gave it.
    sha256 : str
        Of the very bytes that were parsed.

    """

    calibration: Calibration
    path: str
    sha256: str


def load(config: NodeConfig) -> LoadedCalibration:
    """
    Read the calibration that a configuration asks for.

    Parameters
    ----------
    config : NodeConfig
        Names the file, the expected serial number and the input.

    Returns
    -------
    LoadedCalibration
        Parsed, validated, and of the right unit.

    Raises
    ------
    CalibrationError
        If no file is named, if it is not a valid calibration, or if it is not for this unit.

    """
    if not config.calibration_file:
        raise CalibrationError(
            'parameter `calibration_file` is not set; start with '
            '--ros-args -p calibration_file:=PATH'
        )
    loaded = read(config.calibration_file, config.calibration_directory)
    check(loaded, config)
    return loaded


def read(name: str, directory: str = '') -> LoadedCalibration:
    """
    Read a calibration, for whichever unit.

    Parameters
    ----------
    name : str
        Path of the file.
    directory : str, optional
        Where it must lie, symbolic links followed; anywhere if empty.

    Returns
    -------
    LoadedCalibration
        Parsed and validated.

    Raises
    ------
    CalibrationError
        If it is not a valid calibration; names the path as given and the rule, and quotes nothing
        of a file that is no calibration.

    """
    try:
        content = read_bounded(_allowed(name, directory), SIZE_LIMIT)
        calibration = parse_calibration(content, name)
    except CalibrationError as error:
        if error.rule is None:
            raise
        raise CalibrationError(error.rule, name) from error
    except Exception as error:
        # RuntimeError: the home folder of a user that there is not. Whatever else it may be, a
        # file does not end the node.
        is_told = isinstance(error, OSError) or type(error) is ValueError
        reason = getattr(error, 'strerror', None) or (is_told and str(error))
        raise CalibrationError(
            f'cannot be read: {reason or type(error).__name__}', name
        ) from error
    return LoadedCalibration(calibration, name, hashlib.sha256(content).hexdigest())


def _allowed(name: str, directory: str) -> Path:
    """
    Resolve a path, symbolic links included; CalibrationError where it leads out of the directory.

    """
    path = Path(name).expanduser()
    if not directory:
        return path
    path, root = path.resolve(), Path(directory).expanduser().resolve()
    if not path.is_relative_to(root):
        raise CalibrationError(
            'must be in the folder that the parameter `calibration_directory` names', name
        )
    return path


def check(loaded: LoadedCalibration, config: NodeConfig) -> None:
    """
    Make sure that a calibration is for the unit and the input of a configuration.

    Parameters
    ----------
    loaded : LoadedCalibration
        A valid calibration.
    config : NodeConfig
        Names the expected serial number and the input.

    Raises
    ------
    CalibrationError
        If the serial number or the unit of the input differ.

    """
    unit = loaded.calibration.unit
    if config.serial and unit.serial != config.serial:
        raise CalibrationError(
            f'must be {config.serial!r} (parameter `serial`), got {unit.serial!r}',
            loaded.path,
            'unit.serial',
        )
    if config.input == 'imu' and unit.input != 'm/s^2':
        raise CalibrationError(
            f"must be 'm/s^2' (parameter `input` is imu), got {unit.input!r}",
            loaded.path,
            'unit.input',
        )
