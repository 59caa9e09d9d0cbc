# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the step from the parameter `calibration_file` to a calibration that this node may run."""

from __future__ import annotations

from ..errors import CalibrationError
from .parameters import NodeConfig
from .reader import LoadedCalibration, read


def load(config: NodeConfig) -> LoadedCalibration:
    """
    Read the calibration that a configuration asks for; CalibrationError where it cannot be used.
    """
    if not config.calibration_file:
        raise CalibrationError(
            'parameter `calibration_file` is not set; start with '
            '--ros-args -p calibration_file:=PATH'
        )
    loaded = read(config.calibration_file, config.calibration_directory)
    check(loaded, config)
    return loaded


def check(loaded: LoadedCalibration, config: NodeConfig) -> None:
    """Make sure that a calibration is for the serial number and the input of a configuration."""
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
