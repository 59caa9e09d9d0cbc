# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the judgement of a one-attitude fit on windows that it has not seen.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..typing import Bools, Floats
from .one_pose import AlongGravity
from .pose_series import PoseSeries


@dataclass(frozen=True)
class HeldOut:
    """
    What a model leaves of windows that it has not seen.

    Parameters
    ----------
    time, residual, predicted_sd : ndarray, shape (n,)
        When, ``|a|`` less its prediction, and the sd that was predicted for it [input units].

    """

    time: Floats
    residual: Floats
    predicted_sd: Floats

    @property
    def rms(self) -> float:
        """
        Root mean square of the residuals.

        """
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def normalised_rms(self) -> float:
        """
        Of residual over predicted sd: about 1 where the prediction is honest.

        """
        return float(np.sqrt(np.mean((self.residual / self.predicted_sd) ** 2)))

    @property
    def coverage(self) -> float:
        """
        Part of the residuals within the predicted 95 % interval.

        """
        return float(np.mean(np.abs(self.residual) <= 1.959964 * self.predicted_sd))

    def __add__(self, other: HeldOut) -> HeldOut:
        """
        Pool two folds.

        """
        return HeldOut(
            np.concatenate((self.time, other.time)),
            np.concatenate((self.residual, other.residual)),
            np.concatenate((self.predicted_sd, other.predicted_sd)),
        )


def held_out(
    model: AlongGravity, series: PoseSeries, rows: Bools | Sequence[bool], extend: bool = False
) -> HeldOut:
    """
    Judge a model on windows that were not in its fit.

    Parameters
    ----------
    model : AlongGravity
        Fitted to other windows of the same recording.
    series : PoseSeries
        The recording.
    rows : array_like of bool, shape (n,)
        The windows to be judged; all of them count, still or not.
    extend : bool, optional
        See `AlongGravity.reading`.

    Returns
    -------
    HeldOut
        Residuals and their predicted sd.

    """
    part = series.select(np.asarray(rows, dtype=np.bool_))
    residual = part.norm - model.reading(part.temperature, extend)
    sd = model.solution.prediction_sd(
        model.columns(part.temperature, extend), part.time, part.count
    )
    return HeldOut(part.time, residual, sd)
