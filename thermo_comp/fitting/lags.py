# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns thermal memory over a recorded history: first-order lags of T_board and their sensitivity.

``dL/dt = (T_board - L) / tau`` has an exact solution for a temperature that is linear between
grid points; the memory regressor is ``m = T_board - L``. The fit also needs its derivative with
respect to ``ln tau`` and the response to an unknown start, ``exp(-t / tau)``.

"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Memory:
    """
    Memory regressors on a grid, one column per time constant.

    Parameters
    ----------
    value : ndarray, shape (n, k)
        ``T_board - L_k`` when every lag starts at the first temperature [K].
    slope : ndarray, shape (n, k)
        Derivative of `value` with respect to ``ln tau_k`` [K].
    decay : ndarray, shape (n, k)
        ``exp(-t / tau_k)``: what an unknown start adds, per K.
    decay_slope : ndarray, shape (n, k)
        Derivative of `decay` with respect to ``ln tau_k``.

    """

    value: Array
    slope: Array
    decay: Array
    decay_slope: Array

    def at(self, where: Array, grid: Array) -> Memory:
        """
        Interpolate to other times.

        Parameters
        ----------
        where : ndarray, shape (m,)
            Times wanted.
        grid : ndarray, shape (n,)
            Times of the rows.

        Returns
        -------
        Memory
            With m rows.

        """
        index = np.clip(np.searchsorted(grid, where) - 1, 0, max(len(grid) - 2, 0))
        following = np.minimum(index + 1, len(grid) - 1)
        width = np.maximum(grid[following] - grid[index], 1e-12)
        part = np.clip((where - grid[index]) / width, 0.0, 1.0)[:, None]
        return Memory(
            *(
                column[index] * (1.0 - part) + column[following] * part
                for column in (self.value, self.slope, self.decay, self.decay_slope)
            )
        )


def memory_regressors(board: Array, step_s: float, time_constants_s: Array) -> Memory:
    """
    Run the lags over a temperature history.

    Parameters
    ----------
    board : ndarray, shape (n,)
        Board temperature on a uniform grid.
    step_s : float
        Grid step [s].
    time_constants_s : array_like, shape (k,)
        Time constants [s].

    Returns
    -------
    Memory
        Regressors on the grid.

    """
    n, k = len(board), len(time_constants_s)
    value, slope = np.zeros((n, k)), np.zeros((n, k))
    decay, decay_slope = np.zeros((n, k)), np.zeros((n, k))
    time = np.arange(n) * step_s
    change = np.diff(board)
    for j, tau in enumerate(time_constants_s):
        ratio = step_s / float(tau)
        keep = math.exp(-ratio)
        # m_next = keep m + gain change, from the exact response to a linear piece.
        gain = (1.0 - keep) / ratio
        value[1:, j] = lfilter([gain], [1.0, -keep], change)
        # Differentiated by ln tau: d keep = ratio keep, d gain = gain - keep.
        drive = ratio * keep * value[:-1, j] + (gain - keep) * change
        slope[1:, j] = lfilter([1.0], [1.0, -keep], drive)
        decay[:, j] = np.exp(-time / float(tau))
        decay_slope[:, j] = decay[:, j] * time / float(tau)
    return Memory(value, slope, decay, decay_slope)
