# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns thermal memory over recorded histories: first-order lags of T_board and their sensitivity.

``dL/dt = (T_board - L) / tau`` has an exact solution for a temperature that is linear between
grid points; the memory regressor is ``m = T_board - L``. The fit also needs its derivative with
respect to ``ln tau`` and the response to an unknown start, ``exp(-t / tau)``.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ..typing import Floats, Ints


@dataclass(frozen=True)
class Memory:
    """
    Memory regressors, one column per time constant.

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

    value: Floats
    slope: Floats
    decay: Floats
    decay_slope: Floats


@dataclass(frozen=True)
class BoardHistories:
    """
    Board temperatures of several bags on uniform grids of one step, and where windows lie on them.

    Parameters
    ----------
    change : ndarray, shape (n_grid, n_bags)
        Change of the temperature up to each grid point [K]; 0 at the first and past the end.
    step_s : float
        Grid step [s].
    bag : ndarray of int64, shape (n,)
        Bag of each window.
    since : ndarray, shape (n,)
        Time of each window since its grid's start [s].

    """

    change: Floats
    step_s: float
    bag: Ints
    since: Floats

    @staticmethod
    def of(boards: Sequence[Floats], step_s: float, bag: Ints, since: Floats) -> BoardHistories:
        """
        Stack temperature histories.

        Parameters
        ----------
        boards : sequence of ndarray
            Board temperature of each bag on its grid.
        step_s : float
            Grid step [s].
        bag : ndarray of int64, shape (n,)
            Bag of each window.
        since : ndarray, shape (n,)
            Time of each window since its grid's start [s].

        Returns
        -------
        BoardHistories
            The stack.

        """
        change = np.zeros((max(map(len, boards), default=1), len(boards)))
        for number, board in enumerate(boards):
            change[1 : len(board), number] = np.diff(board)
        return BoardHistories(change, step_s, bag, since)

    def memory(self, time_constants_s: Floats) -> Memory:
        """
        Run the lags over the histories and take them at the windows.

        Parameters
        ----------
        time_constants_s : ndarray, shape (k,)
            Time constants [s].

        Returns
        -------
        Memory
            Regressors, with one row per window.

        """
        n, k = len(self.since), len(time_constants_s)
        result = Memory(*(np.zeros((n, k)) for _ in range(4)))
        last = len(self.change) - 1
        place = np.clip(self.since / self.step_s, 0.0, last)
        index = np.minimum(place.astype(np.int64), max(last - 1, 0))
        following = np.minimum(index + 1, last)
        part = place - index
        for j, tau in enumerate(time_constants_s):
            ratio = self.step_s / float(tau)
            keep = math.exp(-ratio)
            # m_next = keep m + gain change, from the exact response to a linear piece.
            gain = (1.0 - keep) / ratio
            value = lfilter([gain], [1.0, -keep], self.change, axis=0)
            # Differentiated by ln tau: d keep = ratio keep, d gain = gain - keep.
            drive = (gain - keep) * self.change
            drive[1:] += ratio * keep * value[:-1]
            slope = lfilter([1.0], [1.0, -keep], drive, axis=0)
            for grid, column in ((value, result.value), (slope, result.slope)):
                before, after = grid[index, self.bag], grid[following, self.bag]
                column[:, j] = before + part * (after - before)
            since = np.maximum(self.since, 0.0)
            result.decay[:, j] = np.exp(-since / float(tau))
            result.decay_slope[:, j] = result.decay[:, j] * since / float(tau)
        return result
