# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the score of a model on data left out of the fit, and the comparison of two scores.

Each mounting (a position, or the rests into which knocks divide a position) is left out in turn,
and so is each section and each half of the chamber's program, in all positions at once. Left-out
halves detect columns that interpolate between sections of one chamber program but would fail in
another program. The left-out windows are corrected as the node would correct them: with the unit's
parameters alone, initial lag states at their prior mean, no mounting offsets and no tilts of the
support. One error is the drift: the corrected force along each axis less its mean over the
position. The drift does not depend on the attitude. The other error is ``|f| - g``; it is scored
if the other positions determine |f|.

Model A is better than B if the error of A is smaller by more than the standard error over folds,
both for positions and for sections of the program; `gain` lists exceptions. Left-out positions
detect columns that fit only one recording; left-out sections detect columns that fit only one
program.

References
----------
.. [1] D. R. Roberts et al., Cross-validation strategies for data with temporal, spatial,
   hierarchical, or phylogenetic structure, Ecography 40 (2017): leave out blocks.
.. [2] A. Vehtari, A. Gelman, J. Gabry, Practical Bayesian model evaluation using leave-one-out
   cross-validation, Statistics and Computing 27 (2017).

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..typing import Floats, Ints
from .elimination import inverse_root
from .initial_triad import thermometer_error_of, white_noise_of
from .layout import Layout
from .regression import Point, PosteriorMode, Regression

# Smallest number of windows of a position for a score of the position's drift.
_FEWEST_WINDOWS = 8
# Largest log ratio of two mean square errors that count as equal: 5 % of an RMS error.
_NEGLIGIBLE_LOG_RATIO = 0.1
# Noise explains an RMS error of up to 1.7 times the white noise: in a soak, unknown lags behind
# temperature changes of hundredths of a kelvin add an error to the white noise.
_NOISE_RATIO = 1.7


@dataclass(frozen=True)
class Folds:
    """
    Left-out errors of the n folds of one kind, such as positions or sections.

    square: mean square error of each fold [(m/s^2)^2], NaN if the fold is not scored, shape (n,)
    windows: number of windows of each fold, shape (n,)
    """

    square: Floats
    windows: Floats

    @classmethod
    def of(cls, square: Floats, windows: Floats, fold: Ints) -> Folds:
        """Average mean square errors of positions, (p,), over each fold's positions; skip NaN."""
        is_scored = np.isfinite(square)
        count = np.bincount(fold, np.where(is_scored, windows, 0.0))
        total = np.bincount(fold, np.where(is_scored, square * windows, 0.0))
        square = total / np.where(count > 0.0, count, np.nan)
        return cls(square, np.bincount(fold, windows).astype(np.float64))

    @property
    def rms(self) -> float:
        """RMS error over all windows of the scored folds [m/s^2]; NaN if no fold is scored."""
        is_scored = np.isfinite(self.square)
        if not is_scored.any():
            return np.nan
        return float(np.sqrt(np.average(self.square[is_scored], weights=self.windows[is_scored])))

    def gain_of(self, other: Folds) -> tuple[float, float] | None:
        """
        Return the log ratio of this model's mean square error to that of the model `other`
        (positive if `other` is better), and the standard error of the log ratio, over the folds
        that are scored for both models; None without such folds.

        The more significant of two estimates of this log ratio is returned, or 0 if their signs
        differ. The mean over the folds depends little on a few folds of large errors; the log
        ratio of sums of squares (with a jackknife error) depends little on folds of small errors.
        """
        is_scored = np.isfinite(self.square) & np.isfinite(other.square)
        n = int(is_scored.sum())
        if not n:
            return None
        before, after = ((f.square * f.windows)[is_scored] + 1e-300 for f in (self, other))
        of_sums = float(np.log(before.sum() / after.sum()))
        if n == 1:
            # One fold has no standard error: return the largest negligible log ratio instead.
            return of_sums, _NEGLIGIBLE_LOG_RATIO
        each = np.log(before / after)
        others = (np.maximum(square.sum() - square, 1e-300) for square in (before, after))
        without = np.subtract(*map(np.log, others))
        spread = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
        estimates = [(of_sums, spread), (float(each.mean()), float(each.std(ddof=1) / np.sqrt(n)))]
        if estimates[0][0] * estimates[1][0] < 0.0:
            return 0.0, max(error for _, error in estimates)
        return max(estimates, key=lambda estimate: abs(estimate[0]) / max(estimate[1], 1e-12))

    def is_noise(self, other: Folds, noise: float) -> bool:
        """Whether white noise explains the errors in the folds that are scored for both models."""
        is_scored = np.isfinite(self.square) & np.isfinite(other.square)
        square = np.average(self.square[is_scored], weights=self.windows[is_scored])
        return bool(square <= (_NOISE_RATIO * noise) ** 2)


@dataclass(frozen=True)
class Score:
    """
    Left-out errors of a model.

    positions, sections: drift of left-out positions, and of left-out sections of the program
    norms: ``|f| - g`` of left-out positions in which the other positions determine |f|
    force: specific force in windows, by fits without their position, (n, 3); NaN if not scored
    drift: drift of each window, (n, 3), by a fit without its position; if that fit does not
        determine the drift, by a fit without its section
    halves: drift of each left-out half of the program, at temperatures that both halves contain
    noise: white noise of a window, RMS of the axes [m/s^2]
    by_thermometer: error of a window due to a coarse board thermometer, RMS of the axes [m/s^2]
    settled: expected error of the bias at settled temperatures [m/s^2] (`settled_error`), or 0
    by_offsets: expected error of left-out |f| [m/s^2] if the user states the sd of the mounting
        offsets, which determines most of this error; else 0
    """

    positions: Folds
    sections: Folds
    norms: Folds
    force: Floats
    drift: Floats
    halves: Folds
    noise: float = 0.0
    by_thermometer: float = 0.0
    settled: float = 0.0
    by_offsets: float = 0.0

    @property
    def kinds(self) -> tuple[Folds, Folds, Folds]:
        """The errors of left-out positions, of left-out sections, and of |f|."""
        return self.positions, self.sections, self.norms

    @property
    def rms(self) -> float:
        """RMS of the left-out drift, the larger of the RMS over positions and over sections."""
        return float(np.fmax(self.positions.rms, self.sections.rms))

    @property
    def exceeds_noise(self) -> bool:
        """Whether noise plus errors of a coarse thermometer do not explain the left-out drift."""
        return self.rms > _NOISE_RATIO * float(np.hypot(self.noise, self.by_thermometer))

    @property
    def excess(self) -> float:
        """RMS left-out drift in excess of noise and thermometer errors [m/s^2]; 0 if unknown."""
        square = self.rms**2 - self.noise**2 - self.by_thermometer**2
        return float(np.sqrt(square)) if square > 0.0 else 0.0

    @property
    def is_by_thermometer(self) -> bool:
        """Whether errors of a coarse thermometer explain the left-out drift."""
        return self.rms <= _NOISE_RATIO * self.by_thermometer


def is_better(before: Score, after: Score, *, by_halves: bool = True) -> bool:
    """Whether the model of `after` is better on left-out data than the model of `before`."""
    return gain(before, after, by_halves=by_halves) > 0.0


def gain(before: Score, after: Score, *, by_halves: bool = True) -> float:
    """
    Return the gain of the model of `after` over the model of `before`, 0 if it is insignificant.

    The gain is the sum of the log ratios (`Folds.gain_of`) of the drift of positions and of
    sections. For drifts that agree to 5 %, the gain is the log ratio of the errors of left-out
    |f|, or 0 if this ratio is below two standard errors. The gain is 0 if `after` has a larger
    error of left-out |f|; a larger drift of left-out halves of the program (with `by_halves`), a
    sign of too many columns; or a drift above the noise and a larger expected error of the bias at
    settled temperatures. A drift that noise explains need not decrease for a gain, because the
    drift of left-out soaks contains no effects of ramps.
    """
    *drifts, norms = _beyond_thermometer(before, after)
    drift = [ratio for ratio in drifts if ratio]
    must_decrease = [
        ratio
        for ratio, first, second in zip(drifts, before.kinds, after.kinds, strict=False)
        if ratio and (ratio[0] > ratio[1] or not second.is_noise(first, after.noise))
    ]
    # The RMS error of left-out halves may rise by a quarter, which is its usual scatter.
    is_worse_by_halves = by_halves and after.halves.rms > 1.25 * before.halves.rms
    if is_worse_by_norms(before, after) or is_worse_by_halves:
        return 0.0
    if after.exceeds_noise and after.settled > before.settled:
        return 0.0
    total = sum(ratio for ratio, _ in drift)
    is_sure = bool(must_decrease) and all(ratio > error for ratio, error in must_decrease)
    if is_sure and total > _NEGLIGIBLE_LOG_RATIO * len(drift):
        return total
    if norms is None or not all(abs(ratio) < _NEGLIGIBLE_LOG_RATIO for ratio, _ in drift):
        return 0.0
    return norms[0] if norms[0] > max(2.0 * norms[1], _NEGLIGIBLE_LOG_RATIO) else 0.0


def is_worse_by_norms(before: Score, after: Score) -> bool:
    """
    Whether errors of left-out |f| are larger in `after` by more than a standard error, and the
    stated sd of the mounting offsets does not explain these errors.
    """
    norms = before.norms.gain_of(after.norms)
    is_explained = after.norms.rms <= _NOISE_RATIO * after.by_offsets
    return norms is not None and norms[0] < -norms[1] and not is_explained


def is_undecided(before: Score, after: Score) -> bool:
    """
    Whether left-out data do not decide between `before` and a model `after` that is not better:
    the two drifts agree to 5 %, and the errors of |f| are either smaller in `after` by more than a
    standard error, or not scored, or explained by a coarse thermometer or by mounting offsets.
    """
    *drift, norms = _beyond_thermometer(before, after)
    is_equal = all(abs(gain[0]) < _NEGLIGIBLE_LOG_RATIO for gain in drift if gain)
    return is_equal and (norms is None or norms[0] > norms[1])


def is_near(chosen: Score, other: Score) -> bool:
    """Whether left-out errors of `other` exceed the chosen model's by at most a standard error."""
    gains = [gain for gain in _gains(chosen, other) if gain]
    return bool(gains) and all(gain > -error for gain, error in gains)


def _beyond_thermometer(before: Score, after: Score) -> list[tuple[float, float] | None]:
    """
    Return the log ratio of mean square errors, `before` / `after` (`Folds.gain_of`), for each kind
    of folds; None if a coarse thermometer, or the stated sd of mounting offsets, explains the
    errors. Errors of a thermometer repeat in all bags of one chamber program: a model that fits
    these errors is better on left-out bags, but fails in another program.
    """
    explained = float(np.hypot(before.by_thermometer, before.by_offsets))
    is_norm_kept = before.norms.rms > _NOISE_RATIO * explained
    keep = (not before.is_by_thermometer, not before.is_by_thermometer, is_norm_kept)
    ratios = _gains(before, after)
    return [ratio if kept else None for ratio, kept in zip(ratios, keep, strict=True)]


def _gains(before: Score, after: Score) -> list[tuple[float, float] | None]:
    return [b.gain_of(a) for b, a in zip(before.kinds, after.kinds, strict=True)]


def score_of(regression: Regression, posterior: PosteriorMode) -> Score:
    """Score a model on left-out positions, sections and halves of the chamber program."""
    regression.whiten(posterior.prior.noise)
    last = int(regression.windows.section.max())
    numbers = np.arange(last + 1 if last else 0)
    positions, norms, force, drift, norm_sd = _by_positions(regression, posterior)
    sections, section_drift = _by_sections(regression, posterior, numbers[:, None])
    halves = np.array_split(numbers, 2) if len(numbers) else []
    by_halves, _ = _by_sections(regression, posterior, halves, n_steps=2, is_within=True)
    drift = np.where(np.isfinite(drift), drift, section_drift)
    scale = regression.nominal_scale
    by_thermometer = thermometer_error_of(regression.windows, scale, beyond_noise=True)
    errors = white_noise_of(regression.windows, scale), by_thermometer
    rms = (float(np.sqrt(np.mean(error**2))) for error in errors)
    score = Score(positions, sections, norms, force, drift, by_halves, *rms)
    if not posterior.prior.offset_scale:
        score = replace(score, by_offsets=norm_sd)
    if (settled := regression.windows.settled) is None:
        return score
    return replace(score, settled=settled_error(regression, posterior, score.excess, settled))


def settled_error(
    regression: Regression, posterior: PosteriorMode, excess: float, settled: Floats
) -> float:
    """
    Return the expected error of the bias after all lags settled [m/s^2]; inf without bias columns.

    In bags that all begin at one temperature the lags change together with the board temperature,
    so the bias after the lags have settled is extrapolated from such bags. The expected error of
    the settled bias is the root sum of squares of the posterior sd of this bias and of ``excess *
    growth``. `excess`: left-out drift beyond the noise [m/s^2]; growth: posterior sd of the
    settled bias / posterior sd of the bias in the windows, at least 1. `settled`: columns at
    settled temperatures, shape (k, m).
    """
    if not posterior.layout.used[0].any():
        return np.inf
    # 500 windows are sufficient to compute the RMS, over the windows, of the bias sd.
    seen = regression.columns[:: max(len(regression.columns) // 500, 1)]
    layout, root = posterior.layout, posterior.root
    sd, seen_sd = (
        float(np.sqrt(_variance(layout, columns, np.zeros(3), root) / (3 * len(columns))))
        for columns in (settled / regression.rms, seen)
    )
    # `seen_sd`, the sd of the bias in the windows, is 0 if no column changes in the windows.
    growth = max(sd / seen_sd, 1.0) if seen_sd else 1.0
    return float(np.hypot(sd, excess * growth))


def _variance(layout: Layout, columns: Floats, force: Floats, root: Floats) -> float:
    """
    Return the variance of the predicted samples less their mean over k windows, summed over
    windows and axes; ``root @ root.T``: covariance of the unknowns; `columns`: (k, m)
    """
    parts = layout.by_weights(columns - columns.mean(axis=0), force)
    return sum(float(np.sum((along @ root[at]) ** 2)) for along, at in parts)


def _by_positions(
    regression: Regression, posterior: PosteriorMode
) -> tuple[Folds, Folds, Floats, Floats, float]:
    """
    Leave out mountings; return `positions`, `norms`, `force` and `drift` of the `Score`, and the
    expected RMS error of the scored |f| [m/s^2].
    """
    windows, share = regression.windows, regression.weight / regression.windows.weight
    point, edges = regression.at(posterior.state, posterior.prior), windows.edges
    counts = np.diff(edges).astype(np.float64)
    force = np.full((len(windows.time), 3), np.nan)
    sizes = regression.norms(point.state)
    drift = np.full_like(force, np.nan)
    squares, norms, expected = np.full((3, windows.n_positions), np.nan)
    for places, matrix in point.without_each():
        step, factor = point.unit_step(matrix)
        state = point.with_step(np.pad(step, (0, point.layout.n - len(step)))).state
        root = inverse_root(factor)
        for p in places.tolist():
            rows = slice(edges[p], edges[p + 1])
            corrected, weight = regression.force(state, rows), share[rows]
            is_known = _determines_drift(point, posterior, root, rows)
            if counts[p] >= _FEWEST_WINDOWS and is_known:
                drift[rows] = corrected - np.average(corrected, axis=0, weights=weight)
                squares[p] = np.average(np.mean(drift[rows] ** 2, axis=1), weights=weight)
            expected[p] = _norm_variance(point, posterior, root, p)
            if np.isfinite(expected[p]):
                force[rows] = corrected
                error = np.linalg.norm(corrected, axis=1) - sizes[p]
                norms[p] = np.average(error**2, weights=weight)
    of_drift, of_norm = (Folds.of(square, counts, windows.mounting) for square in (squares, norms))
    is_scored = np.isfinite(expected)
    norm_sd = float(np.sqrt(expected[is_scored].mean())) if is_scored.any() else 0.0
    return of_drift, of_norm, force, drift, norm_sd


def _determines_drift(point: Point, posterior: PosteriorMode, root: Floats, rows: slice) -> bool:
    """
    Whether the fit without a position, with the covariance ``root @ root.T``, determines the drift
    in the position's windows `rows`: the variance of the drift is below 10 times (variance by the
    fit to all data + noise).
    """
    regression, sigma = point.regression, point.prior.sigma
    if not point.layout.used[0].any():
        return True
    # Use every k-th window of the position: 50 windows are sufficient for the variance.
    some = regression.columns[rows][:: max((rows.stop - rows.start) // 50, 1)]
    force = regression.along(point.state)[regression.windows.position[rows.start]]
    by_others = _variance(point.layout, some, force, root)
    by_all = _variance(point.layout, some, force, posterior.root)
    noise = float(np.sum(sigma**2)) * len(some)
    return by_others < 10.0 * (by_all + noise)


def _norm_variance(point: Point, posterior: PosteriorMode, root: Floats, p: int) -> float:
    """
    Return the variance of |f| in position `p` by the fit without `p`, of covariance
    ``root @ root.T``, plus the variance of bias offsets. The result is NaN unless the variance of
    |f| by this fit is below 10 times (variance by the fit to all data + variance of offsets).
    """
    if not point.regression.gravity:
        return np.nan
    along = point.norms_by_unit[p]
    by_offset = point.prior.offset_sd**2
    if point.regression.has_turn_ons:
        by_offset += point.prior.turn_on_sd**2
    by_all = float(np.sum((along @ posterior.root) ** 2))
    by_others = float(np.sum((along @ root) ** 2))
    return by_others + by_offset if by_others < 10.0 * (by_all + by_offset) else np.nan


def _by_sections(
    regression: Regression,
    posterior: PosteriorMode,
    folds: Sequence[Ints] | Ints,
    *,
    n_steps: int = 1,
    is_within: bool = False,
) -> tuple[Folds, Floats]:
    """
    Score left-out sections by their drift about the mean of the position's remaining windows. The
    fit without the sections of a fold is `n_steps` Gauss-Newton steps from the fit of all data.

    `folds`: sections of each fold; `is_within`: score only temperatures that occur in the fit
    """
    windows, share = regression.windows, regression.weight / regression.windows.weight
    products = regression.products(posterior.layout.used)
    drift = np.full((len(windows.time), 3), np.nan)
    squares, counts = np.full(len(folds), np.nan), np.zeros(len(folds))
    for k, fold in enumerate(folds):
        point = regression.at(posterior.state, posterior.prior, products.without(fold))
        for _ in range(n_steps):
            point = point.with_step(point.solution[0])
        force = regression.force(point.state)
        judged = left_out = np.isin(windows.section, fold)
        if is_within:
            # Of separate static and dynamic curves, no column is the temperature.
            t = windows.columns[:, 0] if windows.board is None else windows.board[:, 0]
            judged = left_out & (t >= t[~left_out].min()) & (t <= t[~left_out].max())
        for p in range(windows.n_positions):
            rows = np.arange(*windows.edges[p : p + 2])
            out, stayed = rows[judged[rows]], rows[~left_out[rows]]
            if len(out) and len(stayed) >= _FEWEST_WINDOWS:
                level = np.average(force[stayed], axis=0, weights=share[stayed])
                drift[out] = force[out] - level
        is_scored = judged & np.isfinite(drift[:, 0])
        if is_scored.any():
            square = np.mean(drift[is_scored] ** 2, axis=1)
            squares[k] = np.average(square, weights=share[is_scored])
            counts[k] = is_scored.sum()
    return Folds(squares, counts), drift
