# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the score of a model: the error of its correction on data that took no part in the fit.

Each position is left out in turn, and so is each section and each half of the program, in all
positions at once. Left-out halves detect columns that interpolate between the sections of one
program and fail in another one. The left-out windows are corrected as the node would correct them:
with the unit's parameters alone, initial lag states at their run-time mean, no mounting offsets
and no tilts of the support.
The errors are the drift (each axis less its mean over the position, which does not depend on the
attitude) and ``|f| - g`` of the position, if the other positions determine it.

References
----------
.. [1] D. R. Roberts et al., Cross-validation strategies for data with temporal, spatial,
   hierarchical, or phylogenetic structure, Ecography 40 (2017): leave out blocks.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..typing import Floats, Ints
from .elimination import inverse_root
from .equations import moved_by
from .regression import Posterior, Regression
from .unknowns import Prior, State

# Largest ratio of the variance of a position's norm or drift without this position in the fit to
# that with it, mounting offset and noise included. Above it the position is not scored.
_VARIANCE_RATIO = 10.0
# Smallest number of windows of a position from which its drift is scored.
_FEWEST_WINDOWS = 8


@dataclass(frozen=True)
class Folds:
    """
    Left-out errors of the n folds of one kind.

    square: mean square error of each fold [(m/s^2)^2], NaN if the fold is not scored, shape (n,)
    windows: number of windows of each fold, shape (n,)
    """

    square: Floats
    windows: Floats

    @property
    def rms(self) -> float:
        """RMS error over all windows of the folds [m/s^2]; NaN without folds."""
        known = np.isfinite(self.square)
        if not known.any():
            return float('nan')
        return float(np.sqrt(np.average(self.square[known], weights=self.windows[known])))

    def gain_of(self, other: Folds) -> tuple[float, float] | None:
        """
        Return the log ratio of the mean square error to that of another model, and its standard
        error, over the folds that both have; None without such folds.

        There are two estimates: the mean over folds of their log ratios, which is robust to a few
        large folds, and the log ratio of the sums with its jackknife error, which is robust to
        small folds. If their signs agree the more significant one is returned, else the gain is 0.
        """
        known = np.isfinite(self.square) & np.isfinite(other.square)
        n = int(known.sum())
        if not n:
            return None
        before, after = ((one.square * one.windows)[known] + 1e-300 for one in (self, other))
        whole = float(np.log(before.sum() / after.sum()))
        if n == 1:
            # One fold has no scatter; 0.1 is 5 % of an RMS.
            return whole, 0.1
        each = np.log(before / after)
        without = np.log((before.sum() - before) / (after.sum() - after))
        spread = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
        found = [(whole, spread), (float(each.mean()), float(each.std(ddof=1) / np.sqrt(n)))]
        if found[0][0] * found[1][0] < 0.0:
            return 0.0, max(error for _, error in found)
        return max(found, key=lambda one: abs(one[0]) / max(one[1], 1e-12))


@dataclass(frozen=True)
class Score:
    """
    Left-out errors of a model.

    positions, sections: drift of left-out positions, and of left-out sections of the program
    norms: ``|f| - g`` of left-out positions whose norm the others determine
    force: windows of each position corrected by a fit without it, NaN if its norm is not scored,
        shape (n, 3)
    drift: drift of each window by a fit without its position or, if that does not determine it,
        without its section, shape (n, 3)
    halves: drift of left-out halves of the program, at temperatures that occur in the other half
    """

    positions: Folds
    sections: Folds
    norms: Folds
    force: Floats
    drift: Floats
    halves: Folds

    @property
    def kinds(self) -> tuple[Folds, Folds, Folds]:
        """Folds of each kind."""
        return self.positions, self.sections, self.norms

    @property
    def rms(self) -> float:
        """RMS of the left-out drift: the larger of that of positions and of sections."""
        found = [one.rms for one in (self.positions, self.sections) if np.isfinite(one.rms)]
        return max(found, default=float('nan'))


def score_of(regression: Regression, posterior: Posterior, prior: Prior) -> Score:
    """Score a model on left-out positions, sections and halves of the program."""
    regression.whiten(prior.noise)
    windows = regression.windows
    share = regression.weight / windows.weight
    positions, norms, force, drift = _by_positions(regression, posterior, prior, share)
    n_sections = windows.n_sections if windows.n_sections > 1 else 0
    numbers = np.arange(n_sections)
    single, halves = list(numbers[:, None]), np.array_split(numbers, 2) if n_sections else []
    by_section, section_drift = _by_sections(regression, posterior, prior, share, single)
    by_half, _ = _by_sections(regression, posterior, prior, share, halves, is_within=True)
    drift = np.where(np.isfinite(drift), drift, section_drift)
    return Score(positions, by_section, norms, force, drift, by_half)


def _by_positions(
    regression: Regression, posterior: Posterior, prior: Prior, share: Floats
) -> tuple[Folds, Folds, Floats, Floats]:
    """Leave out each position; return folds of drift and norm, corrected windows and drift."""
    windows, state, layout = regression.windows, posterior.state, posterior.layout
    products = regression.products(layout.used)
    tangent, _ = regression.linearised(state, layout, products.whole)
    means = tangent.of(regression.at_starts(products.means[:, None], state, products.base))
    n_positions = windows.n_positions
    edges = np.searchsorted(windows.position, np.arange(n_positions + 1))
    counts = np.diff(edges).astype(np.float64)
    force = np.full((len(windows.time), 3), np.nan)
    sizes = regression.norms(state)
    drift = np.full_like(force, np.nan)
    squares, norms = np.full(n_positions, np.nan), np.full(n_positions, np.nan)
    matrices = regression.without_each(state, prior, layout) if n_positions > 1 else ()
    for p, matrix in enumerate(matrices):
        rows = slice(edges[p], edges[p + 1])
        moved, root = _refitted(regression, posterior, prior, matrix)
        own = regression.force(moved, rows)
        weight = share[rows]
        level = np.average(own, axis=0, weights=weight)
        away = own - level
        is_known = _is_drift_determined(regression, posterior, prior, root, rows)
        if rows.stop - rows.start >= _FEWEST_WINDOWS and is_known:
            drift[rows] = away
            square = np.mean(away**2, axis=1)
            squares[p] = np.average(square, weights=weight)
        if _is_norm_determined(regression, posterior, prior, means[p, :, 0], root, p):
            force[rows] = own
            error = np.linalg.norm(own, axis=1) - sizes[p]
            norms[p] = np.average(error**2, weights=weight)
    return Folds(squares, counts), Folds(norms, counts), force, drift


def _refitted(
    regression: Regression, posterior: Posterior, prior: Prior, matrix: Floats
) -> tuple[State, Floats]:
    """
    Return the state of a fit with other normal equations, to first order, and the root of its
    covariance, see `Posterior`.
    """
    state, layout = posterior.state, posterior.layout
    step, factor = regression.unit_step(matrix, prior, layout, state)
    whole = np.zeros(layout.n)
    whole[: layout.n_unit] = step
    return moved_by(state, whole, layout), inverse_root(factor)


def _is_drift_determined(
    regression: Regression, posterior: Posterior, prior: Prior, root: Floats, rows: slice
) -> bool:
    """Whether a fit without this position, with this root, determines its drift."""
    state, layout = posterior.state, posterior.layout
    in_bias, in_scale = layout.used
    if not in_bias.any():
        return True
    # Every n-th window: 50 of them are sufficient for the variance.
    some = regression.columns[rows][:: max((rows.stop - rows.start) // 50, 1)]
    some = some - some.mean(axis=0)
    p = regression.windows.position[rows.start]
    force = regression.along_axes(state)[p]
    by_others = everything = 0.0
    for axis in range(3):
        along = np.hstack((some[:, in_bias], force[axis] * some[:, in_scale]))
        at = layout.axis[axis, 2 : 2 + along.shape[1]]
        by_others += float(np.sum((along @ root[at]) ** 2))
        everything += float(np.sum((along @ posterior.root[at]) ** 2))
    noise = float(np.sum(prior.sigma**2)) * len(some)
    return by_others < _VARIANCE_RATIO * (everything + noise)


def _is_norm_determined(
    regression: Regression, posterior: Posterior, prior: Prior, means: Floats, root: Floats, p: int
) -> bool:
    """
    Whether a fit without this position, with this root, determines its norm; `means`: derivatives
    of its mean reading, see `Tangent.of`.
    """
    if not regression.gravity:
        return False
    state, layout = posterior.state, posterior.layout
    on_axes = np.linalg.inv(state.inverse).T @ state.up[p] / state.kappa
    along = np.zeros(layout.n_unit)
    for axis in range(3):
        places = layout.unit[axis, :-1]
        along[places] += on_axes[axis] * means[axis, -1 - len(places) : -1]
    everything = float(np.sum((along @ posterior.root) ** 2)) + prior.offset_sd**2
    return float(np.sum((along @ root) ** 2)) < _VARIANCE_RATIO * everything


def _by_sections(
    regression: Regression,
    posterior: Posterior,
    prior: Prior,
    share: Floats,
    folds: Sequence[Ints],
    *,
    is_within: bool = False,
) -> tuple[Folds, Floats]:
    """
    Score the drift of left-out sections about the mean of the windows that stay in the fit.

    `folds`: the sections left out at once, in all positions; `is_within`: score only windows at
    temperatures that occur in the fit
    """
    windows, layout = regression.windows, posterior.layout
    products = regression.products(layout.used)
    edges = np.searchsorted(windows.position, np.arange(windows.n_positions + 1))
    drift = np.full((len(windows.time), 3), np.nan)
    squares, counts = np.full(len(folds), np.nan), np.zeros(len(folds))
    for k, fold in enumerate(folds):
        grams = products.without(fold)
        state = posterior.state
        # Two Gauss-Newton steps from the fit of all data are sufficient.
        for _ in range(2):
            step, *_rest = regression.step(state, prior, layout, grams)
            state = moved_by(state, step, layout)
        force = regression.force(state)
        gone = np.isin(windows.section, fold)
        if is_within:
            t = windows.columns[:, 0]
            judged = gone & (t >= t[~gone].min()) & (t <= t[~gone].max())
        else:
            judged = gone
        for p in range(windows.n_positions):
            rows = np.arange(edges[p], edges[p + 1])
            out, stayed = rows[judged[rows]], rows[~gone[rows]]
            if len(out) and len(stayed) >= _FEWEST_WINDOWS:
                level = np.average(force[stayed], axis=0, weights=share[stayed])
                drift[out] = force[out] - level
        known = judged & np.isfinite(drift[:, 0])
        if known.any():
            square = np.mean(drift[known] ** 2, axis=1)
            squares[k] = np.average(square, weights=share[known])
            counts[k] = known.sum()
    return Folds(squares, counts), drift
