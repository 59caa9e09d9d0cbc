# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the noise of the windows: white plus exponentially correlated (first-order Gauss-Markov).

Within a position the error of window k is ``c_k + e_k``: e_k is white with variance
``sigma^2 / weight_k``, c_k a stationary Gauss-Markov process of variance ``ratio sigma^2`` and
correlation time T (IEEE Std 952, Annex B.4.3); a random walk is its limit for a long T. The
innovations of its Kalman filter, divided by their standard deviations, are white and carry the
same information, so samples and columns that are filtered alike can be treated by ordinary least
squares.

References
----------
.. [1] A. C. Harvey, Forecasting, structural time series models and the Kalman filter, Cambridge
   University Press (1989), section 3.4: likelihood by prediction errors.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..typing import Floats, Ints
from .unknowns import Noise

# Candidate ratios of the Gauss-Markov variance to the white variance of a window.
_RATIOS = 10.0 ** np.arange(-2.5, 3.6, 0.5)
# Ratio of neighbouring candidates of the correlation time.
_TIME_STEP = 10.0**0.5


class Whitener:
    """Filters series of windows, in order of position and time, position by position."""

    def __init__(self, position: Ints, time: Floats) -> None:
        starts = np.flatnonzero(np.r_[True, position[1:] != position[:-1]])
        lengths = np.diff(np.r_[starts, len(position)])
        n_steps = int(lengths.max())
        step = np.arange(n_steps)[:, None]
        #: Row of each step of each position in the table; 0 for steps beyond the position's end.
        self._is_there = step < lengths
        self._row = np.where(self._is_there, starts + step, 0)
        self._n = len(position)
        interval = np.zeros((n_steps, len(starts)))
        interval[1:] = np.where(
            self._is_there[1:], time[self._row[1:]] - time[self._row[:-1]], 0.0
        )
        self._interval = interval
        #: Candidate correlation times [s]: from 3 windows to a sixth of a position's length.
        span = float(np.median(interval.sum(axis=0)))
        typical = float(np.median(interval[1:][self._is_there[1:]])) if n_steps > 1 else 1.0
        self.times_s: list[float] = []
        time_s = 3.0 * typical
        while time_s <= span / 6.0:
            self.times_s.append(time_s)
            time_s *= _TIME_STEP

    def shows(self, time_s: float) -> bool:
        """Whether a correlation time is within the range of the candidates."""
        return bool(self.times_s) and self.times_s[0] <= time_s <= self.times_s[-1] * _TIME_STEP

    def gains(self, weight: Floats, noise: Noise) -> tuple[Floats, Floats, Floats]:
        """Return decay, Kalman gain and sd of the innovation [sigma], (n_steps, n_positions)."""
        white = 1.0 / weight[self._row]
        gain, root = np.zeros_like(white), np.sqrt(white)
        decay = np.exp(-self._interval / noise.time_s)
        if noise.ratio <= 0.0:
            return decay, gain, root
        variance = np.full(white.shape[1], noise.ratio)
        for k in range(len(white)):
            if k:
                variance = noise.ratio + decay[k] ** 2 * (variance - noise.ratio)
            total = variance + white[k]
            gain[k] = variance / total
            root[k] = np.sqrt(total)
            variance = variance * (1.0 - gain[k])
        return decay, gain, root

    def filter(self, series: Floats, gains: tuple[Floats, Floats, Floats]) -> Floats:
        """Whiten series, shape (n, k)."""
        decay, gain, root = gains
        result = np.empty_like(series)
        if not gain.any():
            scale = np.empty(self._n)
            scale[self._row[self._is_there]] = 1.0 / root[self._is_there]
            return np.asarray(series * scale[:, None])
        level = np.zeros((self._row.shape[1], series.shape[1]))
        for k, rows in enumerate(self._row):
            level *= decay[k][:, None]
            innovation = series[rows] - level
            level += gain[k][:, None] * innovation
            there = self._is_there[k]
            result[rows[there]] = (innovation / root[k][:, None])[there]
        return result

    def log_determinant(self, gains: tuple[Floats, Floats, Floats]) -> float:
        """Return the log determinant of the noise covariance, in units of sigma^2."""
        return 2.0 * float(np.log(gains[2][self._is_there]).sum())

    def estimate(self, residual: Floats, weight: Floats) -> Noise:
        """
        Find the Gauss-Markov noise of residuals, shape (n, 3), by their profile likelihood.

        The axes have a common ratio and correlation time; their white variances are profiled out.
        The result is white noise unless twice the log likelihood gains 9.2, the 1 % point of a
        chi-square with two degrees of freedom.
        """
        candidates = [Noise(float(r), t) for t in self.times_s for r in _RATIOS]
        if not candidates:
            return Noise()
        white = float(self._deviances(residual, weight, [Noise()])[0])
        deviances = self._deviances(residual, weight, candidates)
        best = int(np.argmin(deviances))
        if white - float(deviances[best]) < 9.2:
            return Noise()
        at, on = divmod(best, len(_RATIOS))
        table = deviances.reshape(-1, len(_RATIOS))
        log_ratio = np.log10(_RATIOS[on]) + 0.5 * _vertex(table[at], on)
        log_time = np.log10(self.times_s[at]) + 0.5 * _vertex(table[:, on], at)
        return Noise(float(10.0**log_ratio), float(10.0**log_time))

    def _deviances(self, residual: Floats, weight: Floats, noises: Sequence[Noise]) -> Floats:
        """Return -2 times the profile log likelihood of each noise, shape (n_noises,)."""
        ratio = np.array([noise.ratio for noise in noises])[:, None]
        time_s = np.array([noise.time_s for noise in noises])[:, None]
        shape = len(noises), self._row.shape[1]
        level, variance = np.zeros((*shape, 3)), np.broadcast_to(ratio, shape)
        square, size = np.zeros((len(noises), 3)), np.zeros(len(noises))
        for k, rows in enumerate(self._row):
            there = self._is_there[k]
            decay = np.exp(-self._interval[k] / time_s)
            if k:
                variance = ratio + decay**2 * (variance - ratio)
            total = variance + 1.0 / weight[rows]
            level = level * decay[:, :, None]
            innovation = residual[rows] - level
            gain = variance / total
            level = level + gain[:, :, None] * innovation
            variance = variance * (1.0 - gain)
            square += np.sum((innovation**2 / total[:, :, None])[:, there], axis=1)
            size += np.log(total[:, there]).sum(axis=1)
        spread = np.log(np.maximum(square, 1e-300) / self._n).sum(axis=1)
        return np.asarray(3.0 * size + self._n * spread)


def _vertex(values: Floats, at: int) -> float:
    """Return the minimum of the parabola through three neighbouring values, -1 .. 1."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2].tolist()
    bend = before - 2.0 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
