# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the noise of a long rest: white noise and a level that wanders; least squares under both.

Residuals of a sensor at rest are not white: the level drifts by itself. Ordinary least squares
takes that drift for a function of temperature and claims to know it far too well. Here the level
is a stationary process of first order, ``cov(w(s), w(t)) = sd^2 exp(-|s - t| / tau)``, which for
a long tau is a random walk; its sd, tau and the white noise come out of the data by restricted
maximum likelihood [1]_, and the parameters by generalised least squares.

References
----------
.. [1] H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are
   unequal", Biometrika 58, 1971.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from ..errors import FitError

Array = npt.NDArray[np.float64]

# Time constants are searched from two windows to this many spans: a random walk by then.
_LONGEST_SPANS = 10.0
_N_TIME_CONSTANTS = 8
# Wander over white noise of a window, as a ratio of variances; its logarithm is searched.
_LOG_RATIOS = (-9.0, 12.0)


@dataclass(frozen=True)
class Noise:
    """
    White noise and wander.

    Parameters
    ----------
    white_sd : float
        White noise of one sample.
    wander_sd : float
        Sd of the wandering level.
    time_constant_s : float
        Its time constant [s].

    """

    white_sd: float
    wander_sd: float
    time_constant_s: float

    def wander(self, first: Array, second: Array) -> Array:
        """
        Covariance of the level at some times with itself at others, shape (n, m).

        """
        apart = np.abs(first[:, None] - second[None, :])
        return np.asarray(self.wander_sd**2 * np.exp(-apart / self.time_constant_s))

    def drift_sd(self, after_s: float) -> float:
        """
        How far the level is from itself after some time: sd of the difference.

        """
        forgotten = 1.0 - np.exp(-after_s / self.time_constant_s)
        return float(self.wander_sd * np.sqrt(2.0 * forgotten))


@dataclass(frozen=True)
class WanderFit:
    """
    A generalised least squares solution.

    Parameters
    ----------
    parameters : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p)
        Of the estimates, the wander's share included.
    noise : Noise
        Under which they were made.
    time : ndarray, shape (n,)
        Times of the data [s].
    gain : ndarray, shape (p, n)
        What each datum moves each parameter by.

    """

    parameters: Array
    covariance: Array
    noise: Noise
    time: Array
    gain: Array

    def prediction_sd(self, columns: Array, time: Array, count: Array) -> Array:
        """
        Predict the sd of ``data - columns @ parameters`` for data that were not in the fit.

        Parameters
        ----------
        columns : ndarray, shape (m, p)
            Regressors of the new data.
        time : ndarray, shape (m,)
            Their times, on the fit's axis [s]: the level may still be near where the fit saw it.
        count : ndarray, shape (m,)
            Samples in each.

        Returns
        -------
        ndarray, shape (m,)
            Standard deviation.

        """
        noise = self.noise
        shared = noise.wander(time, self.time) @ self.gain.T
        variance = (
            noise.wander_sd**2
            + noise.white_sd**2 / count
            - 2.0 * np.einsum('mp,mp->m', columns, shared)
            + np.einsum('mp,pq,mq->m', columns, self.covariance, columns)
        )
        # The first and third term nearly cancel for a random walk: never below the white noise.
        return np.asarray(np.sqrt(np.maximum(variance, noise.white_sd**2 / count)))


def fit_with_wander(columns: Array, data: Array, time: Array, count: Array) -> WanderFit:
    """
    Fit a linear model to data whose level wanders.

    Parameters
    ----------
    columns : ndarray, shape (n, p)
        Regressors; the first is the level's, all ones.
    data : ndarray, shape (n,)
        Window means.
    time : ndarray, shape (n,)
        Rising times [s].
    count : ndarray, shape (n,)
        Samples in each window.

    Returns
    -------
    WanderFit
        Estimates with their covariance.

    Raises
    ------
    FitError
        If there are too few data to tell parameters and noise apart.

    """
    n, p = columns.shape
    if n < p + 5:
        raise FitError(f'{n} windows cannot tell {p} parameters and the noise, need {p + 5}')
    step = float(np.median(np.diff(time)))
    span = float(time[-1] - time[0])
    longest = max(_LONGEST_SPANS * span, 4.0 * step)
    constants: list[float] = np.geomspace(2.0 * step, longest, _N_TIME_CONSTANTS).tolist()
    apart = np.abs(time[:, None] - time[None, :])
    relative = count / np.mean(count)
    best: tuple[float, float, float] = (np.inf, 0.0, constants[0])
    for constant in constants:
        shape = np.exp(-apart / constant)

        def cost(log_ratio: float, shape: Array = shape) -> float:
            return _Solution(columns, data, shape, relative, float(np.exp(log_ratio))).cost

        found = minimize_scalar(cost, bounds=_LOG_RATIOS, method='bounded', options={'xatol': 0.1})
        if found.fun < best[0]:
            best = (float(found.fun), float(np.exp(found.x)), constant)
    _, ratio, constant = best
    solution = _Solution(columns, data, np.exp(-apart / constant), relative, ratio)
    noise = Noise(
        white_sd=float(np.sqrt(solution.variance * np.mean(count))),
        wander_sd=float(np.sqrt(solution.variance * ratio)),
        time_constant_s=constant,
    )
    return WanderFit(
        solution.parameters,
        solution.variance * solution.inverse,
        noise,
        time,
        solution.inverse @ solution.weighted.T,
    )


class _Solution:
    """
    Least squares at one ratio of wander to white noise; `variance` is a mean window's white noise.

    """

    def __init__(
        self, columns: Array, data: Array, shape: Array, relative: Array, ratio: float
    ) -> None:
        n, p = columns.shape
        covariance = ratio * shape
        covariance[np.diag_indices(n)] += 1.0 / relative
        factor = cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
        self.weighted = cho_solve(factor, columns, check_finite=False)
        normal = columns.T @ self.weighted
        self.inverse = np.linalg.inv(normal)
        self.parameters = self.inverse @ (self.weighted.T @ data)
        left = data - columns @ self.parameters
        self.variance = float(left @ cho_solve(factor, left, check_finite=False)) / (n - p)
        log_determinant = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
        self.cost = float(
            (n - p) * np.log(self.variance) + log_determinant + np.linalg.slogdet(normal)[1]
        )
