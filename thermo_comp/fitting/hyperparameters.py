# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the estimation of prior standard deviations and noises in a model with given columns.

Each column has one prior standard deviation for the bias of all axes and one for the scale. They
follow MacKay's fixed point with a log-normal hyperprior per kelvin: the mode of log evidence plus
hyperprior satisfies ``effective parameters + log(sd / sd0) / tau^2 = sum w^2 / sd^2``. The sd of a
column about which the data have no information stays at the centre of the hyperprior.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992), eqs 4.8 to 4.10.
.. [2] A. Gelman, Prior distributions for variance parameters in hierarchical models, Bayesian
   Analysis 1 (2006): half-t priors for standard deviations.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..typing import Bools, Floats, Ints
from .bayes_factors import log_bayes_factors
from .regression import Posterior, Regression
from .unknowns import Prior, State

# Hyperprior sd of the natural logarithm of a column's prior sd: a factor of ten.
_LOG_SD = float(np.log(10.0))
#: Degrees of freedom of the half-Student prior of the mounting's standard deviation; 4 as in [2]_.
STUDENT_NU = 4.0
# Number of windows on each side whose median is the local level of the residuals.
_NEIGHBOURS = 3


def settle(
    regression: Regression,
    state: State,
    prior: Prior,
    typical: Floats,
    largest: Floats,
    fixed: Bools,
    rounds: int = 25,
) -> tuple[Posterior, Prior]:
    """
    Repeat the fixed point until no logarithm of a standard deviation changes by more than 0.05.

    typical, largest: centre of the hyperprior and upper bound of each column's sd, shape (2, m)
    fixed: columns whose sd is not estimated, shape (2, m)
    """
    posterior = regression.solve(state, prior, n_steps=3)
    for _ in range(rounds):
        prior, change = _updated(regression, posterior, prior, typical, largest, fixed)
        posterior = regression.solve(posterior.state, prior, n_steps=1)
        if change < 0.05:
            break
    return posterior, prior


def _updated(
    regression: Regression,
    posterior: Posterior,
    prior: Prior,
    typical: Floats,
    largest: Floats,
    fixed: Bools,
) -> tuple[Prior, float]:
    """Move each sd towards its fixed point; return also the largest change of a logarithm."""
    state, layout, sd = posterior.state, posterior.layout, prior.column_sd
    moves = (sd > 0.0) & ~fixed
    safe, centre = np.where(moves, sd, 1.0), np.where(moves, typical, 1.0)
    effective = posterior.effective_parameters
    slope = np.log(safe / centre) / _LOG_SD**2
    step = _toward(effective, np.sum(state.weights**2, axis=1), safe, slope, 1.0 / _LOG_SD**2)
    new = np.where(moves, np.minimum(safe * np.exp(step), largest), sd)
    matters = moves & (effective > 0.3)
    change = float(np.abs(np.log(np.where(matters, new / safe, 1.0))).max(initial=0.0))
    offset_sd = prior.offset_sd
    if prior.offset_scale > 0.0:
        offset_sd, moved = _offset_sd(posterior, prior)
        change = max(change, moved)
    tilt_sd = prior.tilt_sd
    if state.tilt.size:
        # Scale of the half-normal prior: 15 urad/K, aluminium of 23 ppm/K heated unevenly.
        bound = 1.5e-5 * temperature_rms(regression)
        step = _toward(
            np.array(posterior.determined[layout.tilt].sum()),
            np.array(np.sum(state.tilt**2)),
            np.array(tilt_sd),
            np.array((tilt_sd / bound) ** 2 - 1.0),
            2.0 * (tilt_sd / bound) ** 2,
        )
        tilt_sd = float(tilt_sd * np.exp(step))
        change = max(change, float(np.abs(step)) / 3.0)
    misalignment_sd = prior.misalignment_sd
    gamma = float(posterior.determined[layout.misalignment].sum())
    if gamma > 1.0 and prior.informative is None:
        misalignment_sd = max(np.sqrt(np.sum(state.misalignment**2) / gamma), 1e-5)
    start_share = prior.start_share
    if layout.start.size:
        # The run-time prior has the weight of one state, so that one bag cannot make it small.
        gamma = float(posterior.determined[layout.start].sum())
        start_share = float(min((np.sum(state.start**2) + 1.0) / (gamma + 1.0), 1.0))
        change = max(change, float(np.abs(np.log(start_share / prior.start_share))) / 4.0)
    sigma = white_noise(regression, posterior)
    change = max(change, float(np.abs(np.log(sigma / prior.sigma)).max()))
    return (
        replace(
            prior,
            column_sd=new,
            offset_sd=offset_sd,
            tilt_sd=tilt_sd,
            misalignment_sd=float(misalignment_sd),
            sigma=sigma,
            start_share=start_share,
        ),
        change,
    )


def _toward(
    effective: Floats, power: Floats, sd: Floats, slope: Floats, bend: Floats | float
) -> Floats:
    """Return Newton's step of log sd towards ``power / sd^2 = effective + slope``, at most 2."""
    ratio = power / (sd * sd)
    gradient = ratio - effective - slope
    curvature = 2.0 * np.minimum(ratio, 2.0 * effective + 1.0) + 0.5 * effective + bend
    return np.asarray(np.clip(gradient / curvature, -2.0, 2.0))


def _offset_sd(posterior: Posterior, prior: Prior) -> tuple[float, float]:
    """Move the sd of mounting offsets towards its mode, see `claim` for its prior."""
    at = posterior.layout.offset
    effective = float(posterior.determined[at].sum())
    power = float(np.sum(posterior.state.offset**2))
    square = (prior.offset_sd / prior.offset_scale) ** 2
    slope = (STUDENT_NU + 1.0) * square / (STUDENT_NU + square)
    bend = 2.0 * (STUDENT_NU + 1.0) * STUDENT_NU * square / (STUDENT_NU + square) ** 2
    step = _toward(
        np.array(effective),
        np.array(power),
        np.array(prior.offset_sd),
        np.array(slope),
        bend + 0.1,
    )
    # Bounds [m/s^2]: a thousandth of the prior's scale; 5 mg, as of the cheapest consumer MEMS.
    bounds = 1e-3 * prior.offset_scale, 0.05
    new = float(np.clip(prior.offset_sd * np.exp(step), *bounds))
    return new, float(np.abs(np.log(new / prior.offset_sd))) if effective > 1.0 else 0.0


def log_density(posterior: Posterior, prior: Prior) -> float:
    """Return the log evidence plus the log prior density of the sd of mounting offsets."""
    if not prior.offset_scale:
        return posterior.log_evidence
    square = (prior.offset_sd / prior.offset_scale) ** 2
    return posterior.log_evidence - (STUDENT_NU + 1.0) / 2.0 * float(np.log1p(square / STUDENT_NU))


def temperature_rms(regression: Regression) -> float:
    """Return the RMS of the board temperature about the reference [K], at least 1."""
    return max(float(regression.windows.kelvins[0]), 1.0)


def white_noise(regression: Regression, posterior: Posterior) -> Floats:
    """Return the white noise of each axis from residuals and effective parameters, (3,)."""
    n = len(regression.weight)
    determined, layout = posterior.determined, posterior.layout
    own = determined[layout.axis].sum(axis=1) + determined[layout.offset].sum(axis=0)
    # Attitudes, tilts, misalignment and lag states are determined by all three axes.
    common = (layout.shared, layout.up, layout.stretch, layout.tilt, layout.start)
    shared = sum(determined[at].sum() for at in common)
    spent = own + shared / 3.0
    sigma = np.sqrt(posterior.square / np.maximum(n - spent, 0.05 * n))
    # The bound of 1e-8 m/s^2 is below any sensor's noise; constant samples would give 0.
    return np.asarray(np.maximum(sigma, 1e-8))


def pruned(
    regression: Regression, posterior: Posterior, prior: Prior, fixed: Bools, least_gain: float
) -> Prior:
    """
    Drop columns with a log Bayes factor below `least_gain`, one at a time, the smallest first; the
    factors of the others are then those without it.
    """
    state, covariance = posterior.state, posterior.covariance.copy()
    layout = posterior.layout
    mode = np.zeros(len(covariance))
    where = layout.weights >= 0
    mode[layout.weights[where]] = state.weights[where]
    asked = np.argwhere((prior.column_sd > 0.0) & ~fixed).tolist()
    column_sd, weight_sd = prior.column_sd.copy(), regression.weight_sd(prior)
    while asked:
        part, column = np.array(asked).T
        places = layout.weights[part, :, column]
        gains = log_bayes_factors(mode, covariance, places, weight_sd[part, :, column])
        least = int(np.argmin(gains))
        if gains[least] >= least_gain:
            break
        column_sd[tuple(asked.pop(least))] = 0.0
        at = places[least]
        gone = np.linalg.solve(covariance[np.ix_(at, at)], covariance[at])
        mode = mode - gone.T @ mode[at]
        covariance -= covariance[:, at] @ gone
    return replace(prior, column_sd=column_sd)


def downweigh(regression: Regression, posterior: Posterior, prior: Prior) -> None:
    """
    Reduce the weight of windows more than 3 sd from the local median: short disturbances.

    The weight is that at which the window would be 3 sd away.
    """
    windows = regression.windows
    if windows.undisturbed is None:
        size = regression.residual(posterior.state, posterior.layout) / prior.sigma
        regression.reweigh(windows.weight * undisturbed(size, windows.weight, windows.position))


def undisturbed(residual: Floats, weight: Floats, position: Ints) -> Floats:
    """Return the factors, up to 1, of the weights of windows with some residuals, (n, 3)."""
    size = residual * np.sqrt(weight)[:, None]
    edges = np.flatnonzero(np.diff(position)) + 1
    for part in np.split(size, edges):
        if len(part) >= 2 * _NEIGHBOURS + 1:
            around = np.pad(part, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)), mode='reflect')
            usual = sliding_window_view(around, 2 * _NEIGHBOURS + 1, axis=0)
            np.subtract(part, np.median(usual, axis=-1), out=part)
    size = np.abs(size)
    # The window means of a charge-balancing converter often have few distinct values, with a
    # median deviation of 0. The 80 % quantile of |x| is robust, too: 1.2816 sd of a normal.
    usual = np.quantile(size, 0.8, axis=0) / 1.2816
    size = np.minimum(size / np.maximum(usual, 1e-300), 1e3).max(axis=1)
    return np.asarray((3.0 / np.maximum(size, 3.0)) ** 2)
