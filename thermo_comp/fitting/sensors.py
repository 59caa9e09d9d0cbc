# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the bags say of the thermometers: noise, quantum, ramp rates; the detector's settings.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..regime import DetectorSettings
from ..thermometer import ThermometerSettings
from .reduction import Readings, ReducedBag

Array = npt.NDArray[np.float64]

# Below this no thermometer is worth believing, and the recursion would follow rounding errors.
_SMALLEST_NOISE = 1e-4


def learn_detector(bags: Sequence[ReducedBag]) -> DetectorSettings:
    """
    Set the detector to the sensors and ramps that the bags show.

    Parameters
    ----------
    bags : sequence of ReducedBag
        The bags of the fit.

    Returns
    -------
    DetectorSettings
        Settings; what the bags cannot say keeps its default.

    """
    base = DetectorSettings()
    return replace(
        base,
        board=learn_thermometer([bag.board for bag in bags], base.board),
        case=learn_thermometer([bag.case for bag in bags], base.case),
    )


def learn_thermometer(
    recorded: Sequence[Readings], base: ThermometerSettings
) -> ThermometerSettings:
    """
    Estimate one sensor's quantum and noise.

    Parameters
    ----------
    recorded : sequence of Readings
        Its readings, bag by bag.
    base : ThermometerSettings
        What to keep where there are too few readings.

    Returns
    -------
    ThermometerSettings
        Settings.

    """
    long = [readings.value for readings in recorded if len(readings.value) >= 30]
    if not long:
        return base
    values = np.concatenate(long)
    quantum = quantum_of(values)
    # A straight ramp has no second difference; white noise of sd s gives s sqrt(6).
    second = np.concatenate([np.diff(value, 2) for value in long])
    if quantum:
        # Rounded readings stand still most of the time, so a median would say 0: the mean square
        # without the largest hundredth serves, less what rounding alone gives.
        square = np.sort(second**2)[: max(1, int(0.99 * len(second)))]
        variance = max(float(square.mean()) / 6.0 - quantum**2 / 12.0, (0.1 * quantum) ** 2)
        noise = float(np.sqrt(variance))
    else:
        noise = float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))
    return replace(base, noise_sd_c=max(noise, _SMALLEST_NOISE), quantum_c=quantum)


def quantum_of(values: Array) -> float:
    """
    Find the step of a rounded sensor.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Readings.

    Returns
    -------
    float
        The step, 0 when the readings are not multiples of any that matters.

    """
    levels = np.unique(np.round(values, 9))
    if len(levels) < 2 or len(levels) > 0.5 * len(values):
        return 0.0
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.min(gaps)]))
    steps = gaps / step
    is_grid = np.abs(steps - np.rint(steps)) < 0.1
    return step if is_grid.mean() > 0.9 else 0.0
