# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the evidence: widths of the priors and noises, learnt within a model whose columns are given.

Each column has a prior standard deviation of its own, shared by the axes, bias and scale apart. It
follows MacKay's fixed point with a log-normal hyperprior per kelvin: the mode of log evidence plus
hyperprior satisfies ``effective parameters + log(sd / sd0) / tau^2 = sum w^2 / sd^2``. A column
that the data cannot see keeps its typical width instead of vanishing.

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

from ..typing import Bools, Floats
from .bayes_factors import log_bayes_factors
from .regression import Posterior, Regression
from .unknowns import Prior, State

# Standard deviation of the natural logarithm of a column's typical width: a factor of ten.
_LOG_SD = float(np.log(10.0))
# Degrees of freedom of the half-Student prior of the mounting's standard deviation.
STUDENT_NU = 4.0
# A support tilts by no more than some of this [rad/K]: aluminium of 23 ppm/K, heated unevenly.
_TILT_PER_K = 1.5e-5
# No mounting or turn-on repeats worse than this [m/s^2]: 5 mg, as of the cheapest consumer MEMS.
_LARGEST_OFFSET_SD = 0.05
# A round that moves no logarithm of a width by more than this is the last.
_SETTLED = 0.05
# The largest change of a logarithm in one round.
_STRIDE = 2.0
# No sensor is quieter [m/s^2]; samples that never change would leave no noise at all.
_LEAST_SIGMA = 1e-8
# Windows this many standard deviations off their neighbours lose weight; the largest counted.
_FAR_SDS, _FARTHEST_SDS = 3.0, 1e3
# A fifth of a normal sample lies farther off than this many standard deviations ...
_FIFTH_SDS = 1.2816
# ... from the median of this many windows on both sides.
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
    Repeat the fixed point until it stands.

    typical, largest: widths of the columns that the hyperprior centres on, and that none exceeds;
    fixed: columns that keep their width; shape (2, m)
    """
    posterior = regression.solve(state, prior, n_steps=3)
    for _ in range(rounds):
        found, change = _updated(regression, posterior, prior, typical, largest, fixed)
        prior = found
        posterior = regression.solve(posterior.state, prior, n_steps=1)
        if change < _SETTLED:
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
    """Move each width towards its fixed point; the largest change of a logarithm."""
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
        bound = _TILT_PER_K * temperature_rms(regression)
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
    told = float(posterior.determined[layout.misalignment].sum())
    if told > 1.0 and prior.informative is None:
        misalignment_sd = max(np.sqrt(np.sum(state.misalignment**2) / told), 1e-5)
    start_share = prior.start_share
    if layout.start.size:
        # The run-time prior counts for one: a single bag must not be sure of itself.
        told = float(posterior.determined[layout.start].sum())
        start_share = float(min((np.sum(state.start**2) + 1.0) / (told + 1.0), 1.0))
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
    """Newton's step of log sd towards ``power / sd^2 = effective + slope``."""
    ratio = power / (sd * sd)
    pull = ratio - effective - slope
    stiffness = 2.0 * np.minimum(ratio, 2.0 * effective + 1.0) + 0.5 * effective + bend
    return np.asarray(np.clip(pull / stiffness, -_STRIDE, _STRIDE))


def _offset_sd(posterior: Posterior, prior: Prior) -> tuple[float, float]:
    """Move the mounting's standard deviation towards its mode under its prior, see `claim`."""
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
    # No mounting repeats to a thousandth of the prior's scale.
    bounds = 1e-3 * prior.offset_scale, _LARGEST_OFFSET_SD
    new = float(np.clip(prior.offset_sd * np.exp(step), *bounds))
    return new, float(np.abs(np.log(new / prior.offset_sd))) if effective > 1.0 else 0.0


def temperature_rms(regression: Regression) -> float:
    """RMS of the board temperature about the reference [K]: of the first curve column."""
    return max(float(regression.windows.kelvins[0]), 1.0)


def white_noise(regression: Regression, posterior: Posterior) -> Floats:
    """White noise of each axis from its residuals and the parameters spent on them, (3,)."""
    n = len(regression.weight)
    determined, layout = posterior.determined, posterior.layout
    own = determined[layout.axis].sum(axis=1) + determined[layout.offset].sum(axis=0)
    # Attitudes, tilts, misalignment and start states are determined by all three axes.
    common = (layout.shared, layout.up, layout.stretch, layout.tilt, layout.start)
    shared = sum(determined[at].sum() for at in common)
    spent = own + shared / 3.0
    sigma = np.sqrt(posterior.square / np.maximum(n - spent, 0.05 * n))
    return np.asarray(np.maximum(sigma, _LEAST_SIGMA))


def pruned(posterior: Posterior, prior: Prior, fixed: Bools, least_gain: float) -> Prior:
    """
    Drop columns whose log Bayes factor is below `least_gain`: the least first, the others then
    without it.
    """
    state, covariance = posterior.state, posterior.covariance
    layout = posterior.layout
    mode = np.zeros(len(covariance))
    where = layout.weights >= 0
    mode[layout.weights[where]] = state.weights[where]
    asked = np.argwhere((prior.column_sd > 0.0) & ~fixed).tolist()
    column_sd = prior.column_sd.copy()
    while asked:
        part, column = np.array(asked).T
        places = layout.weights[part, :, column]
        gains = log_bayes_factors(mode, covariance, places, prior.column_sd[part, column])
        least = int(np.argmin(gains))
        if gains[least] >= least_gain:
            break
        column_sd[tuple(asked.pop(least))] = 0.0
        at = places[least]
        gone = np.linalg.solve(covariance[np.ix_(at, at)], covariance[at])
        mode = mode - gone.T @ mode[at]
        covariance = covariance - covariance[:, at] @ gone
    return replace(prior, column_sd=column_sd)


def downweigh(regression: Regression, posterior: Posterior, prior: Prior) -> None:
    """Take windows far off their neighbours for as noisy as they look: a knock stands alone."""
    base = regression.windows.weight
    size = regression.residual(posterior.state, posterior.layout) / prior.sigma
    size *= np.sqrt(base)[:, None]
    edges = np.flatnonzero(np.diff(regression.windows.position)) + 1
    for part in np.split(size, edges):
        if len(part) >= 2 * _NEIGHBOURS + 1:
            around = np.pad(part, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)), mode='reflect')
            usual = sliding_window_view(around, 2 * _NEIGHBOURS + 1, axis=0)
            np.subtract(part, np.median(usual, axis=-1), out=part)
    size = np.abs(size)
    # A converter that carries its remainder makes means of few values, most of them equal: their
    # median deviation is 0, where that of the largest fifth is not.
    usual = np.quantile(size, 0.8, axis=0) / _FIFTH_SDS
    size = np.minimum(size / np.maximum(usual, 1e-300), _FARTHEST_SDS).max(axis=1)
    regression.reweigh(base * (_FAR_SDS / np.maximum(size, _FAR_SDS)) ** 2)
