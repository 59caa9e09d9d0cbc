# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what is found in recordings of units turned by hand, without temperature.

The same still windows go to the project's regression (unknown attitudes, |u| = 1) and to a direct
least squares of the nine-parameter cost, ``|M (N - b) / K| - g`` over all windows, by scipy.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from thermo_comp.fitting.partial import recording_source
from thermo_comp.fitting.triad import TriadFit, fit_triad

from thermo_comp.fitting.reduction import StillInterval
from thermo_comp.typing import Floats
from thermo_comp.unit.metrics import norm_residual

from .data import GRAVITY, handheld_bag, still_bag

MG = GRAVITY * 1e-3
FOLDS = 5
PARAMETERS = ('b_x', 'b_y', 'b_z', 'K_x', 'K_y', 'K_z', 'M10', 'M20', 'M21')


@dataclass(frozen=True)
class Handheld:
    """
    One unit.

    Parameters
    ----------
    unit : int
        Its number.
    intervals : tuple of StillInterval
        Positions, found by themselves.
    ours : TriadFit
        The project's fit.
    direct : ndarray, shape (9,)
        The direct solution.
    in_sample, held_out : (float, float)
        RMS of ``|f| - g``, ours and direct [mg]; all windows, and windows of left-out positions.
    jackknife_sd : ndarray, shape (9,)
        Sd of our parameters from leaving out one position at a time.

    """

    unit: int
    intervals: tuple[StillInterval, ...]
    ours: TriadFit
    direct: Floats
    in_sample: tuple[float, float]
    held_out: tuple[float, float]
    jackknife_sd: Floats

    @property
    def ratio(self) -> float:
        """
        Held-out RMS, ours over direct.

        """
        return self.held_out[0] / self.held_out[1]

    @property
    def pulls(self) -> Floats:
        """
        Ours less direct, in our sd.

        """
        return (self.ours.parameters - self.direct) / self.ours.parameter_sd


def read_handheld(folder: Path, work: Path, unit: int, jackknife: bool = True) -> Handheld:
    """
    Find positions, fit both ways, cross-validate over positions.

    """
    source, _ = recording_source(handheld_bag(folder, work, unit))
    intervals = still_bag(source).intervals
    ours = fit_triad(intervals, GRAVITY)
    direct = direct_solution(windows_of(intervals))
    in_sample = (rms(ours.residual), rms(direct_residual(direct, windows_of(intervals))))
    left: tuple[list[Floats], list[Floats]] = ([], [])
    for fold in range(FOLDS):
        train = [one for i, one in enumerate(intervals) if i % FOLDS != fold]
        test = windows_of([one for i, one in enumerate(intervals) if i % FOLDS == fold])
        left[0].append(norm_residual(fit_triad(train, GRAVITY).force(test), GRAVITY))
        left[1].append(direct_residual(direct_solution(windows_of(train)), test))
    n = len(intervals)
    sd = np.full(9, np.nan)
    if jackknife:
        without = np.array(
            [
                fit_triad([*intervals[:i], *intervals[i + 1 :]], GRAVITY).parameters
                for i in range(n)
            ]
        )
        sd = np.sqrt((n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
    return Handheld(
        unit=unit,
        intervals=intervals,
        ours=ours,
        direct=direct,
        in_sample=in_sample,
        held_out=(rms(np.concatenate(left[0])), rms(np.concatenate(left[1]))),
        jackknife_sd=sd,
    )


def windows_of(intervals: Sequence[StillInterval]) -> Floats:
    """
    Stack the window means of some positions, shape (n, 3).

    """
    return np.concatenate([interval.mean for interval in intervals])


def direct_residual(parameters: Floats, windows: Floats) -> Floats:
    """
    Evaluate ``|M (N - b) / K| - g`` for nine parameters.

    """
    matrix = np.eye(3)
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = parameters[6:]
    force = (windows - parameters[:3]) / parameters[3:6] @ matrix.T
    return np.asarray(np.linalg.norm(force, axis=1) - GRAVITY)


def direct_solution(windows: Floats) -> Floats:
    """
    Minimise its squares, from a perfect sensor.

    """
    start = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    found = least_squares(
        direct_residual, start, args=(windows,), x_scale='jac', xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return np.asarray(found.x)


def rms(residual: Floats) -> float:
    """
    Root mean square in mg.

    """
    return float(np.sqrt(np.mean(residual**2))) / MG
