# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the state of the regression: everything it estimates, and the prediction made from it.

Measurement model of window w of position p, axis i::

    N = columns_bias(w) . bias_i + g (A u_p)_i columns_scale(w) . scale_i + noise,  A = M^-1

"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..typing import Floats
from .lags import Memory
from .model import ModelSpec
from .table import WindowTable


@dataclass(frozen=True)
class Solution:
    """
    Estimates of one model.

    Parameters
    ----------
    spec : ModelSpec
        The model.
    gravity : float
        Local gravity.
    bias : ndarray, shape (3, n_columns('bias'))
        Bias parameters per axis, in input units.
    scale : ndarray, shape (3, n_columns('scale'))
        Scale parameters per axis; the first is K.
    skew : ndarray, shape (3,)
        A[1, 0], A[2, 0], A[2, 1] of ``A = M^-1``.
    up : ndarray, shape (n_positions, 3)
        Unit vectors of the specific force.
    time_constants_s : ndarray, shape (n_lags,)
        Time constants of the lags.
    start_memory : ndarray, shape (n_bags, n_lags)
        Memory at each bag's start [K].
    noise_sd : ndarray, shape (2, 3)
        Residual sd of a window of typical length, per regime and axis, in input units.
    transient : ndarray, shape (n_bags, 3) or (0, 3), optional
        What warming-up adds at each bag's start, in input units; empty when it is not modelled.
    transient_s : float, optional
        Its time constant [s].

    """

    spec: ModelSpec
    gravity: float
    bias: Floats
    scale: Floats
    skew: Floats
    up: Floats
    time_constants_s: Floats
    start_memory: Floats
    noise_sd: Floats
    transient: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    transient_s: float = 1800.0

    @property
    def inverse_misalignment(self) -> Floats:
        """
        A: from the frame to the sensitivity axes, lower triangular with a unit diagonal.

        """
        matrix = np.eye(3)
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = self.skew
        return matrix

    @property
    def misalignment(self) -> Floats:
        """
        M, from the sensitivity axes to the frame.

        """
        a, b, c = self.skew
        matrix = np.eye(3)
        matrix[1, 0], matrix[2, 1] = -a, -c
        matrix[2, 0] = a * c - b
        return matrix


@dataclass(frozen=True)
class Regressors:
    """
    The columns of a model over a table, at given time constants.

    Parameters
    ----------
    bias, scale : ndarray, shape (n, n_columns)
        Columns, with the start memories in.
    live : ndarray, shape (n,)
        Weight of the thermal terms.
    slope, decay : ndarray, shape (n, n_lags)
        Derivatives of the memory by ``ln tau`` and by the start memory.

    """

    bias: Floats
    scale: Floats
    live: Floats
    slope: Floats
    decay: Floats


def regressors(
    table: WindowTable,
    spec: ModelSpec,
    time_constants_s: Floats,
    start_memory: Floats,
    memory: Memory | None = None,
) -> Regressors:
    """
    Evaluate a model's columns over a table.

    Parameters
    ----------
    table : WindowTable
        The windows.
    spec : ModelSpec
        The model.
    time_constants_s : ndarray, shape (n_lags,)
        Time constants [s].
    start_memory : ndarray, shape (n_bags, n_lags)
        Memory at each bag's start [K].
    memory : Memory or None, optional
        The memory at these time constants, when it is already known.

    Returns
    -------
    Regressors
        The columns.

    """
    if memory is None:
        memory = table.memory(time_constants_s)
    start = start_memory[table.bag]
    value = memory.value + start * memory.decay
    return Regressors(
        bias=spec.columns(table, value, 'bias'),
        scale=spec.columns(table, value, 'scale'),
        live=spec.live_weight(table),
        slope=memory.slope + start * memory.decay_slope,
        decay=memory.decay,
    )


def predict(table: WindowTable, solution: Solution, columns: Regressors) -> Floats:
    """
    Predict the window means.

    Parameters
    ----------
    table : WindowTable
        The windows.
    solution : Solution
        The estimates.
    columns : Regressors
        The model's columns over the table.

    Returns
    -------
    ndarray, shape (n, 3)
        In input units.

    """
    force = solution.gravity * solution.up @ solution.inverse_misalignment.T
    return np.asarray(
        columns.bias @ solution.bias.T
        + force[table.position] * (columns.scale @ solution.scale.T)
        + warming_up(table, solution)
    )


def warming_up(table: WindowTable, solution: Solution) -> Floats:
    """
    Evaluate what warming-up adds to the windows.

    Parameters
    ----------
    table : WindowTable
        The windows.
    solution : Solution
        The estimates.

    Returns
    -------
    ndarray, shape (n, 3)
        In input units; zero when it is not modelled.

    """
    if not len(solution.transient):
        return np.zeros_like(table.mean)
    decay = np.exp(-table.time / solution.transient_s)
    return np.asarray(solution.transient[table.bag] * decay[:, None])


def correct(table: WindowTable, solution: Solution, columns: Regressors) -> Floats:
    """
    Correct the window means, as the compensator would; what warming-up added is taken out first.

    Returns
    -------
    ndarray, shape (n, 3)
        Specific force.

    """
    settled = table.mean - warming_up(table, solution)
    along = (settled - columns.bias @ solution.bias.T) / (columns.scale @ solution.scale.T)
    return np.asarray(along @ solution.misalignment.T)
