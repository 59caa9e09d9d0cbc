# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the data teach the prior: widths of the groups, both noises, which groups earn a place.

Widths and white noise follow MacKay's fixed point (``alpha = gamma / sum w^2``); the walk's share
is found by a search along the log evidence of each axis; a group whose removal does not lower the
log evidence (Savage-Dickey ratio) leaves.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992), eqs 4.8 to 4.10.
.. [2] J. M. Dickey, The weighted likelihood ratio, linear hypotheses on normal location
   parameters, Annals of Mathematical Statistics 42 (1971).

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats, Ints
from .posterior import Posterior, Prior, Regression, State

Key = tuple[str, str]

# A group whose effective parameters are below this, under a wide prior, is not seen by the data.
_SILENT = 0.3
# Widths settle within this many rounds, as a rule in half of them.
_MOST_ROUNDS = 40
# A round that moves no width by more than this part is the last.
_SETTLED = 0.02
# Windows this many sds off lose weight, after Huber.
_HUBER_SDS = 3.0


@dataclass(frozen=True)
class GroupWorth:
    """
    What one group is worth.

    Parameters
    ----------
    part, group : str
        'bias' or 'scale', and its name.
    explains : float
        RMS over windows and axes of what it adds to the prediction [m/s^2].
    effective : float
        Effective parameters, of all axes.
    evidence : float
        How much the log evidence falls without it.
    sd : float
        Prior sd of its weights, for columns of unit RMS ([m/s^2], relative).

    """

    part: str
    group: str
    explains: float
    effective: float
    evidence: float
    sd: float


@dataclass(frozen=True)
class Learnt:
    """
    A posterior under the prior that the data chose.

    """

    posterior: Posterior
    prior: Prior
    worth: tuple[GroupWorth, ...]


def learn(
    regression: Regression,
    state: State,
    prior: Prior,
    forced: frozenset[Key] = frozenset(),
    tell: Callable[[float], None] | None = None,
) -> Learnt:
    """
    Find widths, noises and groups by the evidence.

    Parameters
    ----------
    regression : Regression
        The data.
    state : State
        Where to begin.
    prior : Prior
        Wide: its widths are where those of silent groups stay.
    forced : frozenset of (part, group), optional
        Groups that stay whatever they earn.
    tell : callable, optional
        Told how far it is, 0..1.

    Returns
    -------
    Learnt
        The end.

    """
    tell = tell or (lambda _part: None)
    silent = _silent(regression.solve(state, prior), regression, prior)
    posterior, prior = _settle(regression, state, prior, silent, walks=False)
    tell(0.3)
    _downweight(regression, posterior)
    prior = _walk(regression, posterior, prior)
    posterior, prior = _settle(regression, posterior.state, prior, silent)
    tell(0.6)
    n_groups = len(prior.groups)
    while True:
        worth = group_worth(regression, posterior, prior)
        idle = [w for w in worth if w.evidence < 0.5 and (w.part, w.group) not in forced]
        if not idle:
            break
        # All that are as good as nothing leave at once, others one by one: the rest take over.
        nothing = [w for w in idle if w.effective < 0.1] or [min(idle, key=lambda w: w.evidence)]
        gone = {(w.part, w.group) for w in nothing}
        prior = replace(
            prior, groups={key: sd for key, sd in prior.groups.items() if key not in gone}
        )
        posterior, prior = _settle(regression, posterior.state, prior, silent, rounds=8)
        tell(0.6 + 0.3 * (1.0 - len(prior.groups) / n_groups))
    prior = _walk(regression, posterior, prior)
    posterior, prior = _settle(regression, posterior.state, prior, silent)
    tell(1.0)
    return Learnt(posterior, prior, group_worth(regression, posterior, prior))


def _silent(posterior: Posterior, regression: Regression, prior: Prior) -> frozenset[Key]:
    """
    Find the groups that the data do not see.

    """
    found = []
    for key, places in _places(posterior, regression, prior).items():
        if places.size:
            seen = 1.0 - posterior.variance[places] / prior.groups[key] ** 2
            if seen.sum() < _SILENT:
                found.append(key)
    return frozenset(found)


def _places(
    posterior: Posterior, regression: Regression, prior: Prior
) -> dict[Key, Ints]:
    layout = posterior.layout
    names = np.array(regression.windows.groups)
    result = {}
    for part, group in prior.groups:
        places = layout.on_bias if part == 'bias' else layout.on_scale
        result[part, group] = places[:, (names == group) & (places[0] >= 0)].ravel()
    return result


def _settle(
    regression: Regression,
    state: State,
    prior: Prior,
    silent: frozenset[Key],
    *,
    walks: bool = True,
    rounds: int = _MOST_ROUNDS,
) -> tuple[Posterior, Prior]:
    """
    Repeat the fixed point of widths and white noise until nothing moves.

    """
    for _ in range(rounds):
        posterior = regression.solve(state, prior, n_steps=2)
        state = posterior.state
        diagonal = posterior.variance
        vector = regression.vector(state, posterior.layout)
        groups, change = {}, 0.0
        total = _effective_sum(regression, prior)
        for key, places in _places(posterior, regression, prior).items():
            sd = prior.groups[key]
            groups[key] = sd
            if key in silent or not places.size:
                continue
            gamma = max(float(np.sum(1.0 - diagonal[places] / sd**2)), 1e-6)
            power = float(np.sum(vector[places] ** 2))
            groups[key] = max(np.sqrt(power / gamma), 1e-4 * total[key[0]])
            if gamma > 0.05:
                change = max(change, abs(np.log(groups[key] / sd)))
        places = posterior.layout.offset.ravel()
        gamma = float(np.sum(1.0 - diagonal[places] / prior.offset_sd**2))
        power = float(np.sum(vector[places] ** 2))
        offset_sd = prior.offset_sd
        if gamma > _SILENT:
            offset_sd = max(np.sqrt(power / gamma), 0.03 * _position_sd(regression, prior))
            if gamma > 1.0:
                change = max(change, abs(np.log(offset_sd / prior.offset_sd)))
        sigma = _sigma(posterior, prior)
        change = max(change, float(np.abs(np.log(sigma / prior.sigma)).max()))
        prior = replace(prior, groups=groups, offset_sd=offset_sd, sigma=sigma)
        if change < _SETTLED:
            break
    return regression.solve(state, prior), prior


def _effective_sum(regression: Regression, prior: Prior) -> dict[str, float]:
    """
    The smallest width that matters: a weight of it moves no window by more than the noise.

    """
    sigma = float(np.mean(prior.sigma)) / np.sqrt(len(regression.windows.time))
    return {'bias': sigma, 'scale': sigma / regression.gravity}


def _position_sd(regression: Regression, prior: Prior) -> float:
    n = len(regression.windows.time) / regression.windows.n_positions
    return float(np.mean(prior.sigma)) / np.sqrt(n)


def _sigma(posterior: Posterior, prior: Prior) -> Floats:
    """
    White noise of each axis, from what is left and what was spent on it.

    """
    n = len(posterior.whitened)
    square = np.sum(posterior.whitened**2, axis=0)
    learnt = 1.0 - posterior.precision * posterior.variance
    layout = posterior.layout
    own = learnt[layout.axis].sum(axis=1) + learnt[layout.offset].sum(axis=0)
    # Attitudes, misalignment and start states are told by all three.
    shared = learnt[layout.skew].sum() + layout.up.size
    spent = own + shared / 3.0
    return np.asarray(prior.sigma * np.sqrt(square / np.maximum(n - spent, 0.05 * n)))


def _downweight(regression: Regression, posterior: Posterior) -> None:
    size = np.abs(posterior.whitened)
    usual = 1.4826 * np.median(size, axis=0)
    size = size / np.maximum(usual, 1e-300)
    base = regression.windows.weight[:, None]
    regression.reweight(base * np.where(size > _HUBER_SDS, _HUBER_SDS / size, 1.0))


def _walk(regression: Regression, posterior: Posterior, prior: Prior) -> Prior:
    """
    Search the walk's share of each axis along the log evidence.

    """
    rho = prior.rho.copy()
    for axis in range(3):

        def evidence(value: float, axis: int = axis) -> tuple[float, Prior]:
            trial = prior.rho.copy()
            trial[axis] = value
            found = replace(prior, rho=trial)
            # The white noise gives way to the walk.
            fitted = regression.solve(posterior.state, found, n_steps=1)
            found = replace(found, sigma=_sigma(fitted, found))
            return regression.solve(posterior.state, found, n_steps=1).log_evidence, found

        grid = 10.0 ** np.arange(-7.0, -0.9, 1.0)
        none = evidence(0.0)[0]
        values = [evidence(float(value))[0] for value in grid]
        best = int(np.argmax(values))
        rho[axis] = 0.0
        # Less than this is what a walk that is not there gains by chance.
        if values[best] > none + 2.0:
            around = np.clip(best + np.array([-1, 0, 1]), 0, len(grid) - 1)
            low, top, high = (values[k] for k in around)
            bend = low - 2.0 * top + high
            move = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
            rho[axis] = grid[best] * 10.0 ** float(np.clip(move, -0.5, 0.5))
        prior = evidence(float(rho[axis]))[1]
    return prior


def group_worth(
    regression: Regression, posterior: Posterior, prior: Prior
) -> tuple[GroupWorth, ...]:
    """
    Say what each group explains, spends and earns.

    Parameters
    ----------
    regression : Regression
        The data.
    posterior : Posterior
        The mode under `prior`.
    prior : Prior
        The widths.

    Returns
    -------
    tuple of GroupWorth
        In the order of the prior.

    """
    vector = regression.vector(posterior.state, posterior.layout)
    names = np.array(regression.windows.groups)
    columns = regression.windows.columns / regression.rms
    force = regression.gravity * posterior.state.up[regression.windows.position]
    result = []
    for (part, group), places in _places(posterior, regression, prior).items():
        sd = prior.groups[part, group]
        covariance = posterior.covariance[np.ix_(places, places)]
        root = np.sqrt(np.diag(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(root, root))
        values = np.maximum(values, 1e-12)
        along = vectors.T @ (vector[places] / root)
        determinant = float(np.log(values).sum() + 2.0 * np.log(root).sum())
        earned = 0.5 * float(np.sum(along**2 / values)) + 0.5 * determinant
        earned -= len(places) * np.log(sd)
        state = posterior.state
        weights = state.on_bias if part == 'bias' else state.on_scale
        added = columns[:, names == group] @ weights[:, names == group].T
        if part == 'scale':
            added = added * force
        result.append(
            GroupWorth(
                part,
                group,
                float(np.sqrt(np.mean(added**2))),
                float(np.sum(1.0 - root**2 / sd**2)),
                earned,
                sd,
            )
        )
    return tuple(result)
