# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the noise of the windows: white plus a random walk of the bias, whitened exactly.

Within a position the error of window k is ``c_k + e_k``, where e_k is white with variance
``sigma^2 / weight_k`` and c_k a random walk that starts at 0 with the position and gains the
variance ``rho sigma^2`` per second. The innovations of its Kalman filter, divided by their
standard deviations, are white and carry the same information, so whatever is filtered alike -
samples and columns - can be treated by ordinary least squares afterwards.

References
----------
.. [1] A. C. Harvey, Forecasting, structural time series models and the Kalman filter, Cambridge
   University Press (1989), section 3.4: likelihood by prediction errors.

"""

from __future__ import annotations

import numpy as np

from ..typing import Floats, Ints


class Whitener:
    """
    Filters series of windows, position by position, side by side.

    position: position of each window; windows of a position are consecutive and in time order,
        shape (n,)
    time: their times [s], shape (n,)
    """

    def __init__(self, position: Ints, time: Floats) -> None:
        starts = np.flatnonzero(np.r_[True, position[1:] != position[:-1]])
        lengths = np.diff(np.r_[starts, len(position)])
        n_steps = int(lengths.max())
        step = np.arange(n_steps)[:, None]
        #: Row of the table at each step of each position; those beyond its end point to row 0.
        self._is_there = step < lengths
        self._row = np.where(self._is_there, starts + step, 0)
        self._n = len(position)
        interval = np.zeros((n_steps, len(starts)))
        interval[1:] = np.where(
            self._is_there[1:], time[self._row[1:]] - time[self._row[:-1]], 0.0
        )
        self._interval = interval

    def gains(self, weight: Floats, rho: float) -> tuple[Floats, Floats]:
        """
        Run the filter's variances.

        `weight`: relative information of each window, shape (n,). Returns kalman gain, and sd of
        the innovation in units of sigma, shape (n_steps, n_positions).
        """
        noise = 1.0 / weight[self._row]
        gain, root = np.zeros_like(noise), np.sqrt(noise)
        if rho <= 0.0:
            return gain, root
        variance = np.zeros(noise.shape[1])
        for k in range(len(noise)):
            variance = variance + rho * self._interval[k]
            total = variance + noise[k]
            gain[k] = variance / total
            root[k] = np.sqrt(total)
            variance = variance * (1.0 - gain[k])
        return gain, root

    def filter(self, series: Floats, gains: tuple[Floats, Floats]) -> Floats:
        """
        Whiten series.

        `series`: one series per column, shape (n, k).
        """
        gain, root = gains
        result = np.empty_like(series)
        if not gain.any():
            scale = np.empty(self._n)
            scale[self._row[self._is_there]] = 1.0 / root[self._is_there]
            return np.asarray(series * scale[:, None])
        level = np.zeros((self._row.shape[1], series.shape[1]))
        for k, rows in enumerate(self._row):
            innovation = series[rows] - level
            level += gain[k][:, None] * innovation
            there = self._is_there[k]
            result[rows[there]] = (innovation / root[k][:, None])[there]
        return result

    def log_determinant(self, gains: tuple[Floats, Floats]) -> float:
        """Logarithm of the determinant of the noise's covariance, in units of sigma^2."""
        return 2.0 * float(np.log(gains[1][self._is_there]).sum())
