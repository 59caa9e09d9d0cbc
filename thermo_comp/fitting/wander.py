# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the noise of a long rest: white noise and a level that wanders; least squares under both.

Residuals of a sensor at rest are not white: the level drifts by itself. Ordinary least squares
takes that drift for a function of temperature and claims to know it far too well. Here the level
is a stationary process of first order, ``cov(w(s), w(t)) = sd^2 exp(-|s - t| / tau)``, which for
a long tau is a random walk. Parameters come by generalised least squares under the likeliest sd
and tau, by restricted likelihood [1]_. A rest of a few time constants leaves much doubt about its
noise, so every other sd and tau, by its likelihood, widens the claimed uncertainty.

References
----------
.. [1] H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are
   unequal", Biometrika 58, 1971.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from ..errors import FitError
from ..typing import Floats

# Time constants are searched from two windows to this many spans: a random walk by then.
_LONGEST_SPANS = 10.0
_N_TIME_CONSTANTS = 12
# Wander over white noise of a window, as a ratio of variances.
_RATIOS, _N_RATIOS = (1e-3, 1e3), 15
# Guesses of the noise this much less likely than the best are dropped.
_LEAST_WEIGHT = 1e-3


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

    def wander(self, first: Floats, second: Floats) -> Floats:
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
class Candidate:
    """
    The solution under one guess of the noise.

    Parameters
    ----------
    weight : float
        How likely the guess is; they sum to 1.
    noise : Noise
        The guess, its white noise estimated.
    parameters : ndarray, shape (p,)
        Estimates under it.
    covariance : ndarray, shape (p, p)
        Of the estimates.
    gain : ndarray, shape (p, n)
        What each datum moves each parameter by.

    """

    weight: float
    noise: Noise
    parameters: Floats
    covariance: Floats
    gain: Floats


@dataclass(frozen=True)
class WanderFit:
    """
    Generalised least squares, in doubt about the noise.

    Parameters
    ----------
    parameters : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p)
        Of the estimates; the wander's share and the doubt about the noise included. The level's
        own is that of the mean over all times, which a random walk has not: for the level as it
        was during the data see `prediction_sd`.
    time : ndarray, shape (n,)
        Times of the data [s].
    candidates : tuple of Candidate
        The guesses of the noise that count, the likeliest first.
    inflation : float
        Factor on all variances, at least 1, by which the data miss their own curve by more than
        any such noise explains: errors smoother than a first-order process, such as hysteresis,
        look small from window to window and are large over hours. `covariance` has it already.

    """

    parameters: Floats
    covariance: Floats
    time: Floats
    candidates: tuple[Candidate, ...]
    inflation: float = 1.0

    @property
    def noise(self) -> Noise:
        """
        The likeliest noise.

        """
        return self.candidates[0].noise

    def prediction_sd(self, columns: Floats, time: Floats, count: Floats) -> Floats:
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
        total = np.zeros(len(time))
        for one in self.candidates:
            shared = one.noise.wander(time, self.time) @ one.gain.T
            white = one.noise.white_sd**2 / count
            variance = (
                one.noise.wander_sd**2
                + white
                - 2.0 * np.einsum('mp,mp->m', columns, shared)
                + np.einsum('mp,pq,mq->m', columns, one.covariance, columns)
            )
            # Terms of a random walk nearly cancel: what is left is never below the white noise.
            total += one.weight * np.maximum(variance, white)
            total += one.weight * (columns @ (one.parameters - self.parameters)) ** 2
        return np.asarray(np.sqrt(self.inflation * total))

    def drift_sd(self, after_s: float) -> float:
        """
        How far the level is from itself after some time: sd of the difference.

        """
        total = sum(one.weight * one.noise.drift_sd(after_s) ** 2 for one in self.candidates)
        return float(np.sqrt(self.inflation * total))


def fit_with_wander(columns: Floats, data: Floats, time: Floats, count: Floats) -> WanderFit:
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
    solutions = [
        solution
        for constant in np.geomspace(2.0 * step, longest, _N_TIME_CONSTANTS).tolist()
        for solution in _solutions(columns, data, time, count, constant, max(1.0, constant / span))
    ]
    cost = np.array([solution.cost for solution in solutions])
    weight = np.exp(-0.5 * (cost - cost.min()))
    weight = np.where(weight > _LEAST_WEIGHT, weight, 0.0)
    weight /= weight.sum()
    order = np.argsort(-weight)[: int(np.count_nonzero(weight))].tolist()
    candidates = tuple(solutions[i].candidate(float(weight[i])) for i in order)
    parameters = candidates[0].parameters
    covariance = np.zeros((p, p))
    for one in candidates:
        off = one.parameters - parameters
        covariance += one.weight * (one.covariance + np.outer(off, off))
    found = WanderFit(parameters, covariance, time, candidates)
    left = data - columns @ parameters
    missed = float(np.mean((left / found.prediction_sd(columns, time, count)) ** 2))
    inflation = max(1.0, missed)
    return replace(found, covariance=inflation * covariance, inflation=inflation)


@dataclass(frozen=True)
class _Solution:
    """
    Least squares under one noise, and twice its negative log likelihood.

    """

    noise: Noise
    cost: float
    parameters: Floats
    covariance: Floats
    gain: Floats

    def candidate(self, weight: float) -> Candidate:
        return Candidate(weight, self.noise, self.parameters, self.covariance, self.gain)


def _solutions(
    columns: Floats, data: Floats, time: Floats, count: Floats, constant: float, scale: float
) -> list[_Solution]:
    """
    Solve for one time constant and all ratios of wander to white noise.

    A first-order process has a tridiagonal inverse covariance Q, so with the white noise's
    inverse W all is done in n steps: ``(1 / W + ratio / Q)^-1 = W - W (W + Q / ratio)^-1 W``.
    A random walk's level counts by its slope, not its size: `scale` keeps the range of slopes
    where tau exceeds the span.

    """
    n, p = columns.shape
    white = count / np.mean(count)
    ago = np.diff(time) / constant
    kept = np.exp(-ago)
    fresh = -np.expm1(-2.0 * ago)
    inverse = np.zeros((2, n))
    inverse[0] = 1.0
    inverse[0, 1:] += kept**2 / fresh
    inverse[0, :-1] += kept**2 / fresh
    inverse[1, :-1] = -kept / fresh
    weighted_columns = white[:, None] * columns
    result = []
    for ratio in (scale * np.geomspace(*_RATIOS, _N_RATIOS)).tolist():
        banded = inverse / ratio
        banded[0] += white
        factor = cholesky_banded(banded, lower=True, check_finite=False)
        shared = cho_solve_banded((factor, True), weighted_columns, check_finite=False)
        weighted = weighted_columns - white[:, None] * shared
        normal = columns.T @ weighted
        spread = np.linalg.inv(normal)
        parameters = spread @ (weighted.T @ data)
        left = white * (data - columns @ parameters)
        again = cho_solve_banded((factor, True), left, check_finite=False)
        variance = float(left @ ((data - columns @ parameters) - again)) / (n - p)
        log_determinant = (
            2.0 * np.sum(np.log(factor[0]))
            + n * np.log(ratio)
            + np.sum(np.log(fresh))
            - np.sum(np.log(white))
        )
        cost = (n - p) * np.log(variance) + log_determinant + np.linalg.slogdet(normal)[1]
        noise = Noise(
            white_sd=float(np.sqrt(variance * np.mean(count))),
            wander_sd=float(np.sqrt(variance * ratio)),
            time_constant_s=constant,
        )
        result.append(
            _Solution(noise, float(cost), parameters, variance * spread, spread @ weighted.T)
        )
    return result
