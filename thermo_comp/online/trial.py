# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the trial of a calibration: correction of a few samples before the calibration is used."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from ..errors import CalibrationError
from ..thermal.lags import BOARD_INPUT
from ..unit.calibration import Calibration
from .compensator import Compensator, Corrected
from .segments import Model
from .status import CompensatorConfig

#: Lowest and highest test temperature, beyond any calibrated range [degC].
_BEYOND: Final = (-273.0, 999.0)
_STEP_NS: Final = 1_000_000_000


def tried(calibration: Calibration, path: str | Path | None = None) -> None:
    """
    Apply a calibration to a few samples; CalibrationError if the test of any sample fails.

    The test samples are near zero and near +- full scale, at the edges of the temperature ranges
    and far beyond these ranges; each result must be finite, with a positive definite covariance.
    """
    try:
        is_sound = all(map(is_sound_sample, _samples(Model(calibration))))
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        rule = f'cannot be applied: {type(error).__name__}: {error}'
        raise CalibrationError(rule, path) from error
    if not is_sound:
        rule = 'cannot be applied: a force is not finite, or its covariance not positive definite'
        raise CalibrationError(rule, path)


def is_sound_sample(row: Corrected) -> bool:
    """Whether the force of a sample is finite and its covariance positive definite."""
    if not np.isfinite(row).all():
        return False
    xx, xy, xz, yy, yz, zz = row[3:]
    if min(xx, yy, zz) <= 0.0:
        return False
    # The variances of two axes may differ by more than the 16 digits of a float, so that rounding
    # would exceed the smaller variance: test the correlations instead.
    sd = np.sqrt((xx, yy, zz))
    correlations = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) / sd / sd[:, np.newaxis]
    return bool(np.linalg.eigvalsh(correlations)[0] > 0.0)


def _samples(model: Model) -> Iterator[Corrected]:
    calibration = model.calibration
    edges = [edge for set_ in calibration.regime_sets() for edge in set_.temperature_range_c]
    largest = 0.999 * calibration.unit.full_scale
    for celsius in (calibration.reference_temperature_c, *edges, *_BEYOND):
        compensator = Compensator(model, CompensatorConfig(gravity_tolerance_m_s2=0.0))
        for k, size in enumerate((1e-3 * largest, largest, -largest)):
            for name in model.inputs:
                # At sample k the other thermometers read k K more than the board thermometer.
                celsius_there = celsius + k * (name != BOARD_INPUT)
                compensator.push(name, k * _STEP_NS, celsius_there)
            row = compensator.process(k * _STEP_NS, size, 0.5 * size, size)
            if row is not None:
                yield row
