# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the data teach the prior: a width for each column, both noises, what earns a place.

Each column has a width of its own, shared by the axes, bias and scale apart. Widths and white
noise follow MacKay's fixed point (``alpha = gamma / sum w^2``); a column that the data do not need
gets an ever smaller width and leaves. The walk's share is found by a search along the log evidence
of each axis. At the end a column stays if the log evidence would fall without it; then all that
was asked for is asked once more from there, and the better of the two is kept.

References
----------
.. [1] D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992), eqs 4.8 to 4.10.
.. [2] M. E. Tipping, Sparse Bayesian learning and the relevance vector machine, JMLR 1 (2001).

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..typing import Bools, Floats
from ..unit.calibration import GroupEvidence
from .posterior import Posterior, Regression
from .unknowns import Known, Prior, State
from .windows import SET
from .worth import earned, group_worth, told_of

# Of the three weights of a column, what the data must tell under a wide prior to be asked.
_SILENT = 0.05
# A column with fewer effective parameters than this leaves while the widths settle ...
_IDLE = 0.1
# ... once they have moved this often.
_PATIENCE = 4
# A round that moves no width by more than this part is the last.
_SETTLED = 0.03
# Of a unit with one kind of physics beside parts that lag, the columns of the others make a guess
# among thousands that say the same of these bags and not of the next: one kind is asked for first.
_KINDS = (('even',), ('change',), ('product', 'mixed', 'square'), ('play',), (SET,))
# Sets that gain so much of what the best kind does may be the best if they closed otherwise.
_LIKE_SETS = 0.4
# The memory is as short as it can be [s]: the longest lags of a bank and the curves over
# temperature are almost one thing to bags that all begin at one temperature. Last come the
# columns of the third order, which few units need.
_REACHES_S = (2000.0, 4000.0, np.inf)
# What more columns must gain in log evidence to be asked for; so many rounds are enough to say.
_MORE_EARNED, _ROUNDS = 4.0, 8
# Powers of ten of the walk's share that are tried first.
_WALKS = (-6.0, -4.0, -2.0)
# What must be gained in log evidence to stay: of the many columns few are needed.
_EARNED = 3.0
# No sensor is quieter [m/s^2]; samples that never change would leave no noise at all.
_LEAST_SIGMA = 1e-8
# Of the noise of a window, what a column may add unseen before it counts.
_OPEN = 4.0
# Windows more sds off than this lose weight.
_FAR_SDS, _FARTHEST_SDS = 3.0, 1e3
# A fifth of a normal sample lies farther off than so many sds.
_FIFTH_SDS = 1.2816
# ... as seen against the median of so many windows on both sides.
_NEIGHBOURS = 3


@dataclass(frozen=True)
class Learnt:
    """What the data chose; `claim` leaves open what nobody saw; `has_sets`: or `_LIKE_SETS`."""

    posterior: Posterior
    prior: Prior
    worth: tuple[GroupEvidence, ...]
    claim: Posterior
    has_sets: bool


def learn(
    regression: Regression,
    state: State,
    prior: Prior,
    forced: Bools | bool = False,
    tell: Callable[[float], None] = lambda _part: None,
    held: Bools | bool = False,
    walks: bool = True,
    knowns: Sequence[Known] = (),
) -> Learnt:
    """
    Find widths, noises and columns by the evidence.

    `forced`: columns that stay whatever they earn, shape (m,). `held`: columns of the scale that
    keep their width, and their place: the data cannot tell them from those of the bias, shape
    (m,). `knowns`: what may be known beforehand, for `prior.known`.
    """
    kept = np.broadcast_to(forced, prior.widths.shape).copy()
    kept[1] |= held
    allowed = prior
    asks = prior.known is None and not kept.all()
    if asks:
        # Looked at from where it begins: told by what the fit begins to believe, it is chance.
        silent = told_of(regression.solve(state, prior, n_steps=1)) < _SILENT
        silent &= prior.widths > 0.0
    else:
        # Nothing is asked of columns whose weights are known beforehand, nor where all must stay.
        kept = np.ones(prior.widths.shape, dtype=bool)
        silent = prior.widths > 0.0
    silent[1] |= held
    settle = partial(_settle, regression, silent=silent, kept=kept)

    def finish(posterior: Posterior, prior: Prior) -> tuple[Posterior, Prior]:
        while (idle := _idle(regression, posterior, prior, kept)).any():
            prior = _without(prior, idle)
            posterior, prior = settle(posterior.state, prior, rounds=6)
        return posterior, prior

    groups, reach = regression.windows.groups, regression.windows.reach
    alone = [np.isin(groups, names) & (reach <= _REACHES_S[0]) for names in _KINDS]
    # A curve of the dynamic set beside that of the static one comes last of all: where no soak
    # was static, bags do not tell which of the two is which.
    rest = [(reach <= one) & ~alone[-1] for one in _REACHES_S] + [np.ones(len(groups), dtype=bool)]
    asked = rest[0] & ~np.any(alone, axis=0) if asks else np.ones_like(rest[0])
    prior = _without(allowed, ~asked & ~kept)
    posterior = regression.solve(state, prior)
    prior = replace(prior, sigma=_sigma(posterior, prior))
    has_grown = False
    for k, more in enumerate((alone, *([one] for one in rest)) if asks else (alone, alone)):
        gains = [0.0]
        if asks:
            absent = regression.ask_absent(posterior.state, prior, allowed)
            gains = [absent.gain(allowed.widths, one & ~asked) for one in more]
        if k == 0:
            has_sets = gains[-1] > max(_MORE_EARNED, _LIKE_SETS * max(gains))
        if is_more := max(gains) > _MORE_EARNED:
            asked = asked | more[int(np.argmax(gains))]
            has_grown = k > 0
        if is_more or k == 0:
            prior = _without(allowed, ~asked & ~kept)
            # Before knocks have lost their weight nothing may leave: beside them nothing is seen.
            posterior, prior = settle(state, prior, rounds=_PATIENCE)
            _downweight(regression, posterior)
            posterior, prior = settle(posterior.state, prior, rounds=_ROUNDS)
        if walks and (k == 1 or (is_more and k > 1)):
            # A walk takes what a missing column leaves: it comes where there are columns enough.
            prior = _walk(regression, posterior, prior)
            posterior, prior = settle(posterior.state, prior, rounds=_ROUNDS)
        tell(0.16 * (k + 1))
    posterior, prior = settle(posterior.state, prior)
    _downweight(regression, posterior)
    posterior, prior = settle(posterior.state, prior)
    tell(0.85)
    if knowns:
        tried = [
            regression.solve(posterior.state, replace(prior, known=one), n_steps=3)
            for one in knowns
        ]
        best = int(np.argmax([one.log_evidence for one in tried]))
        prior = replace(prior, known=knowns[best])
        posterior, prior = settle(tried[best].state, prior)
    posterior, prior = finish(posterior, prior)
    if has_grown:
        # Widths settle near where they began, with starts and attitudes of few columns: once more.
        wide = _without(replace(prior, widths=allowed.widths), ~asked & ~kept)
        again = finish(*settle(posterior.state, wide))
        posterior, prior = max((posterior, prior), again, key=lambda one: one[0].log_evidence)
    tell(0.9)
    if walks:
        prior = _walk(regression, posterior, prior)
    posterior, prior = settle(posterior.state, prior)
    claim = posterior
    if asks:
        wider = _left_open(regression, posterior, prior, allowed)
        claim = regression.solve(posterior.state, wider, n_steps=1)
    tell(1.0)
    worth = group_worth(regression, posterior, prior)
    has_sets |= any(one.group == SET for one in worth)
    return Learnt(posterior, prior, worth, claim, has_sets)


def _without(prior: Prior, gone: Bools) -> Prior:
    """Leave out columns, of bias and scale or of both, shape (2, m) or (m,)."""
    return replace(prior, widths=np.where(gone, 0.0, prior.widths))


def _idle(regression: Regression, posterior: Posterior, prior: Prior, kept: Bools) -> Bools:
    """Find the columns that earn no place: the least first, the others then without it."""
    mode, covariance = regression.vector(posterior.state, posterior.layout), posterior.covariance
    mode = mode[: len(covariance)]
    asked = np.argwhere((prior.widths > 0.0) & ~kept).tolist()
    result = np.zeros(prior.widths.shape, dtype=bool)
    while asked:
        places = [posterior.layout.weights[part, :, column] for part, column in asked]
        gains = [
            earned(mode, covariance, at, prior.widths[part, column])
            for at, (part, column) in zip(places, asked, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= _EARNED:
            break
        result[tuple(asked.pop(least))] = True
        at = places[least]
        gone = np.linalg.solve(covariance[np.ix_(at, at)], covariance[at])
        mode = mode - gone.T @ mode[at]
        covariance = covariance - covariance[:, at] @ gone
    return result


def _left_open(
    regression: Regression, posterior: Posterior, prior: Prior, allowed: Prior
) -> Prior:
    """
    Let the claim keep open what the data could not have seen, lest it be claimed to be 0.

    A column that left was not needed; whether it is 0 the data tell to ``1 / sqrt(S)``, S what
    they say of it beside the columns that stayed. Where that is more than some sds of a window's
    noise the covariance has it back, with this width; its weight stays 0, the likeliest.
    """
    absent = regression.ask_absent(posterior.state, prior, allowed)
    S = np.append(np.diag(absent.information), 0.0)[absent.places].mean(axis=1)
    sd = np.minimum(1.0 / np.sqrt(np.maximum(S, 1e-300)), allowed.widths)
    matters = (prior.widths == 0.0) & (allowed.widths > 0.0)
    matters &= sd > _OPEN * float(np.mean(prior.sigma)) * _units(regression)
    return replace(prior, widths=np.where(matters, sd, prior.widths))


def _units(regression: Regression) -> Floats:
    """Return what 1 m/s^2 is to a weight in the bias, and in the scale, shape (2, 1)."""
    return np.array([[1.0], [1.0 / (regression.gravity or 1.0)]])


def _settle(
    regression: Regression,
    state: State,
    prior: Prior,
    *,
    silent: Bools,
    kept: Bools,
    rounds: int = 40,
) -> tuple[Posterior, Prior]:
    """Repeat the fixed point; silent columns keep their width, kept ones may not leave, (2, m)."""
    for k in range(rounds):
        posterior = regression.solve(state, prior, n_steps=0)
        state = posterior.state
        layout, sd, told = posterior.layout, prior.widths, told_of(posterior)
        power = np.sum(state.weights**2, axis=1)
        asked = (sd > 0.0) & ~silent
        # A width that is as good as 0; a column that stays all the same keeps it.
        smallest = 1e-2 * float(np.mean(prior.sigma) / np.sqrt(len(regression.windows.time)))
        new = np.maximum(np.sqrt(power / np.maximum(told, 1e-9)), smallest * _units(regression))
        new = np.where(asked, new, sd)
        lively = asked & (told > _IDLE)
        change = float(np.abs(np.log(new[lively] / sd[lively])).max(initial=0.0))
        gone = asked & (told < _IDLE) & ~kept & (k >= _PATIENCE)
        offset_sd, skew_sd = prior.offset_sd, prior.skew_sd
        if (told_offset := float(posterior.told[layout.offset].sum())) > 0.3:
            per_position = len(regression.windows.time) / regression.windows.n_positions
            of_mean = float(np.mean(prior.sigma)) / np.sqrt(per_position)
            least = max(0.03 * of_mean, prior.least_offset_sd)
            offset_sd = max(np.sqrt(np.sum(state.offset**2) / told_offset), least)
            if told_offset > 1.0:
                change = max(change, float(np.abs(np.log(offset_sd / prior.offset_sd))))
        lean_sd = prior.lean_sd
        if (told_lean := float(posterior.told[layout.lean].sum())) > 0.3:
            lean_sd = max(np.sqrt(np.sum(state.lean**2) / told_lean), 1e-9)
        if (told_skew := float(posterior.told[layout.skew].sum())) > 1.0:
            skew_sd = max(np.sqrt(np.sum(state.skew**2) / told_skew), 1e-6)
        start_share = _start_share(regression, posterior)
        change = max(change, float(np.abs(np.log(start_share / prior.start_share))) / 2.0)
        sigma = _sigma(posterior, prior)
        change = max(change, float(np.abs(np.log(sigma / prior.sigma)).max()))
        prior = replace(
            prior,
            widths=np.where(gone, 0.0, new),
            offset_sd=float(offset_sd),
            skew_sd=float(skew_sd),
            lean_sd=float(lean_sd),
            sigma=sigma,
            start_share=start_share,
        )
        if change < _SETTLED and not gone.any():
            break
    return regression.solve(state, prior), prior


def _start_share(regression: Regression, posterior: Posterior) -> float:
    """
    Learn how far from rest the bags began, in parts of the run-time prior's variance.

    Bags of a chamber begin in a soak, and what is free there at every start hides in lags of hours
    with opposite weights, which another start then shows.
    """
    places, start = posterior.layout.start, posterior.state.start
    if not places.size:
        return 1.0
    told = float(posterior.told[places].sum())
    power = float(np.einsum('bi,ij,bj->', start, regression.start_information, start))
    # The run-time prior counts for one: a single bag must not be sure of itself.
    return float(min((power + 1.0) / (told + 1.0), 1.0))


def _sigma(posterior: Posterior, prior: Prior) -> Floats:
    """White noise of each axis, from what is left and what was spent on it."""
    n = len(posterior.whitened)
    square = np.sum(posterior.whitened**2, axis=0)
    told, layout = posterior.told, posterior.layout
    own = told[layout.axis].sum(axis=1) + told[layout.offset].sum(axis=0)
    # Attitudes, what they lean by, misalignment and start states are told by all three.
    shared = sum(told[at].sum() for at in (layout.skew, layout.up, layout.lean, layout.start))
    spent = own + shared / 3.0
    sigma = prior.sigma * np.sqrt(square / np.maximum(n - spent, 0.05 * n))
    return np.asarray(np.maximum(sigma, _LEAST_SIGMA))


def _downweight(regression: Regression, posterior: Posterior) -> None:
    """Take windows far off their neighbours for as noisy as they look: a knock stands alone."""
    base = regression.windows.weight[:, None]
    size = posterior.whitened * np.sqrt(base / regression.weight)
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
    size = np.minimum(size / np.maximum(usual, 1e-300), _FARTHEST_SDS)
    regression.reweight(base * (_FAR_SDS / np.maximum(size, _FAR_SDS)) ** 2)


def _walk(regression: Regression, posterior: Posterior, prior: Prior) -> Prior:
    """Search the walk's share of each axis along the log evidence."""
    rho = prior.rho.copy()
    for axis in range(3):

        def evidence(value: float, axis: int = axis, before: Prior = prior) -> tuple[float, Prior]:
            trial = before.rho.copy()
            trial[axis] = value
            found = replace(before, rho=trial)
            # The white noise gives way to the walk.
            left = replace(posterior, whitened=regression.whiten(posterior.state, found)[1])
            found = replace(found, sigma=_sigma(left, found))
            return regression.solve(posterior.state, found, n_steps=1).log_evidence, found

        none, tried = evidence(0.0)[0], {one: evidence(10.0**one)[0] for one in _WALKS}
        best = max(tried, key=tried.__getitem__)
        rho[axis] = 0.0
        # Less than this is what a walk that is not there gains by chance.
        if tried[best] > none + 2.0:
            low, high = (evidence(10.0 ** (best + one))[0] for one in (-1.0, 1.0))
            bend = low - 2.0 * tried[best] + high
            move = 0.5 * (low - high) / bend if bend < 0.0 else np.sign(high - low)
            rho[axis] = 10.0 ** (best + float(np.clip(move, -1.0, 1.0)))
        prior = evidence(float(rho[axis]))[1]
    return prior
