# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a recording without temperature tells: bias, scale and misalignment as they were then.

The same positions, the same regression and the same refusals as in the full fit, with a model
that knows no temperature. The result holds at the temperature of the recording, whichever it was,
and therefore is no calibration file.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import FitError
from ..typing import Floats, Ints
from ..unit.metrics import norm_residual
from .assembly import parameter_covariance
from .history import ThermalHistory
from .model import ModelSpec, polynomial
from .reduction import StillInterval
from .regression import Freedom, Outcome, regress
from .start import constant_calibration, position_means, starting_solution
from .table import WindowTable
from .verdict import (
    POSITIONS_FOR_MISALIGNMENT,
    POSITIONS_NEEDED,
    can_tell_misalignment,
    distinct_directions,
)


@dataclass(frozen=True)
class TriadFit:
    """
    Nine numbers of a triad, or six.

    Parameters
    ----------
    bias, scale : ndarray, shape (3,)
        Input units; input units per m/s^2.
    misalignment : ndarray, shape (3, 3)
        M, lower triangular with a unit diagonal; the identity where it is not estimated.
    has_misalignment : bool
        Whether M is estimated.
    covariance : ndarray, shape (9, 9)
        Of bias, scale and M[1, 0], M[2, 0], M[2, 1]; zeros for M where it is not estimated.
    up : ndarray, shape (n, 3)
        Direction of the specific force in each position.
    residual : ndarray, shape (m,)
        ``|f| - g`` of all windows.
    position : ndarray of int64, shape (m,)
        Position of each window.
    advice : tuple of str
        What the recording could not tell, and what to record for it.

    """

    bias: Floats
    scale: Floats
    misalignment: Floats
    has_misalignment: bool
    covariance: Floats
    up: Floats
    residual: Floats
    position: Ints
    advice: tuple[str, ...]

    @property
    def parameters(self) -> Floats:
        """
        Bias, scale, M[1, 0], M[2, 0], M[2, 1], shape (9,).

        """
        M = self.misalignment
        return np.concatenate((self.bias, self.scale, (M[1, 0], M[2, 0], M[2, 1])))

    @property
    def parameter_sd(self) -> Floats:
        """
        Standard deviations of `parameters`, shape (9,).

        """
        return np.sqrt(np.diag(self.covariance))

    def force(self, measured: Floats) -> Floats:
        """
        Correct measured vectors, shape (n, 3), to specific force [m/s^2].

        """
        return np.asarray((measured - self.bias) / self.scale @ self.misalignment.T)


def fit_triad(
    intervals: Sequence[StillInterval], gravity: float, misalignment: bool | None = None
) -> TriadFit:
    """
    Fit bias, scale and, where the positions can tell it, misalignment.

    Parameters
    ----------
    intervals : sequence of StillInterval
        Still intervals, one position each.
    gravity : float
        Local gravity.
    misalignment : bool or None, optional
        Whether M is estimated; None decides by the positions.

    Returns
    -------
    TriadFit
        The estimates.

    Raises
    ------
    FitError
        If there are too few positions for bias and scale, or for M when it is asked for.

    """
    n = len(intervals)
    if n < POSITIONS_NEEDED:
        raise FitError(
            f'{n} still positions, need {POSITIONS_NEEDED} for bias and scale and '
            f'{POSITIONS_FOR_MISALIGNMENT} for the misalignment'
        )
    table = _table(intervals)
    means = position_means(table)
    box = constant_calibration(means, gravity, with_misalignment=False)
    force = box.force(means)
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    distinct = len(distinct_directions(up))
    if distinct < POSITIONS_NEEDED:
        raise FitError(
            f'{distinct} distinct positions, need {POSITIONS_NEEDED} for bias and scale and '
            f'{POSITIONS_FOR_MISALIGNMENT} for the misalignment'
        )
    can_tell = can_tell_misalignment(up)
    why = (
        f'{distinct} distinct positions identify bias and scale only: M stays the identity; it '
        f'needs {POSITIONS_FOR_MISALIGNMENT} well spread ones: add positions between the faces'
    )
    if misalignment and not can_tell:
        raise FitError(why)
    wanted = can_tell if misalignment is None else misalignment
    start = constant_calibration(means, gravity, wanted) if wanted else box
    solution = starting_solution(
        table, ModelSpec('constant', polynomial(0)), gravity, start, np.zeros(0)
    )
    outcome = regress(
        table, solution, Freedom(misalignment=wanted, lags=False, start_memory=False)
    )
    found = outcome.solution
    corrected = (table.mean - found.bias[:, 0]) / found.scale[:, 0] @ found.misalignment.T
    return TriadFit(
        bias=found.bias[:, 0],
        scale=found.scale[:, 0],
        misalignment=found.misalignment,
        has_misalignment=wanted,
        covariance=_covariance(outcome),
        up=found.up,
        residual=norm_residual(corrected, gravity),
        position=table.position,
        advice=() if can_tell else (why,),
    )


def _table(intervals: Sequence[StillInterval]) -> WindowTable:
    """
    Put still intervals into a table whose temperature never moves.

    """
    length = [len(interval.time) for interval in intervals]
    n = sum(length)
    nothing, whole = np.zeros(n), np.zeros(n, dtype=np.int64)
    still = np.zeros(2)
    history = ThermalHistory(
        start_s=0.0,
        step_s=1.0,
        board=still,
        var_board=still,
        rate=still,
        gradient=still,
        weight=still,
        is_unknown=np.zeros(2, dtype=np.bool_),
    )
    return WindowTable(
        position=np.repeat(np.arange(len(intervals)), length),
        bag=whole,
        section=whole,
        time=np.concatenate([interval.time for interval in intervals]),
        count=np.concatenate([interval.count for interval in intervals]),
        mean=np.concatenate([interval.mean for interval in intervals]),
        t=nothing,
        gradient=nothing,
        rate=nothing,
        weight=nothing,
        histories=(history,),
    )


def _covariance(outcome: Outcome) -> Floats:
    """
    Covariance of bias, scale and the elements of M, from that of the regression's parameters.

    """
    everything = parameter_covariance(outcome)
    layout, solution = outcome.layout, outcome.solution
    places = [*layout.axis[:, 0], *layout.axis[:, 1]]
    if layout.skew[0] < 0:
        result = np.zeros((9, 9))
        result[:6, :6] = everything[np.ix_(places, places)]
        return result
    places += [*layout.skew]
    a, _, c = solution.skew
    to_elements = np.eye(9)
    # M[1, 0] = -a, M[2, 0] = a c - b, M[2, 1] = -c of the skew (a, b, c) of its inverse.
    to_elements[6:, 6:] = [[-1.0, 0.0, 0.0], [c, -1.0, a], [0.0, 0.0, -1.0]]
    return np.asarray(to_elements @ everything[np.ix_(places, places)] @ to_elements.T)
