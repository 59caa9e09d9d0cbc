# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the checks of a chosen model for effects that no column describes: a drift after power-on, and
slow tilts of the supports. The fit is repeated if a check finds such an effect.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np

from ..typing import Floats
from .data_checks import advice
from .evidence import PositionReport
from .reduction import ReducedBag, StillInterval
from .selection import Fit
from .settled_bias import settled_error
from .unknowns import Windows
from .windows import CURVE

# Length of a piece of a rest in which a slow tilt of the support is constant [s].
_PIECE_S = 3600.0
# Slow tilts are tried if the drift of left-out positions, averaged over each piece, exceeds these
# multiples of the white noise of the average, and of the error of the left-out norms.
_DRIFT_TO_NOISE, _DRIFT_TO_NORMS = 6.0, 0.1
# Smallest number of positions with left-out norms: the norms of fewer positions give no reliable
# standard error of the gain from slow tilts.
_FEWEST_NORMS = 6
# Smallest log gain of the mean square left-out norm from slow tilts: 14 % of the RMS.
_TILT_GAIN = 0.3
SLOW_TILTS = advice(
    'tilt',
    'left-out |f| - g is smaller if the supports may tilt from hour to hour: each hour of a rest '
    'was fitted with its own attitude',
)


def extrapolates(fit: Fit) -> bool:
    """
    Whether the left-out drift of the chosen model exceeds noise, and the expected error of the
    settled bias is larger than that of a smaller model, see `settled_bias`.
    """
    settled, trials = fit.windows.data.settled, fit.selected.trials
    chosen = next((trial for trial in trials if trial.is_chosen), None)
    if chosen is None or settled is None or not chosen.score.exceeds_noise:
        return False
    smaller = [
        trial for trial in trials if trial.groups == (CURVE,) or {*trial.groups} < {*chosen.groups}
    ]
    error, *errors = (
        settled_error(fit.regression, trial.posterior, trial.score.excess, settled)
        for trial in (chosen, *smaller)
    )
    return bool(min(errors, default=np.inf) < error < np.inf)


def may_have_slow_tilts(fit: Fit) -> bool:
    """
    Whether the drifts of left-out positions exceed noise and a tenth of the error of left-out
    norms. Slow tilts of a support change the axes across gravity, and hardly the norms.
    """
    score, data = fit.selected.score, fit.windows.data
    if np.isfinite(score.norms.square).sum() < _FEWEST_NORMS:
        return False
    drift, n_windows = _slow_drift(data, score.drift)
    least = max(_DRIFT_TO_NOISE * score.noise / n_windows**0.5, _DRIFT_TO_NORMS * score.norms.rms)
    return bool(drift > least)


def _slow_drift(data: Windows, drift: Floats) -> tuple[float, float]:
    """
    Return the RMS over the axes of the means of drifts over each hour of a position, and the mean
    number of windows per hour; `drift`: drift of each window, NaN if unknown, shape (n, 3).
    """
    known = np.isfinite(drift).all(axis=1)
    if not known.any():
        return 0.0, 1.0
    hour = np.floor((data.time - data.time[data.edges[:-1]][data.position]) / _PIECE_S)
    _, piece = np.unique(np.stack((data.position, hour))[:, known], axis=1, return_inverse=True)
    count = np.bincount(piece)
    means = [np.bincount(piece, axis[known]) / count for axis in drift.T]
    square = np.average(np.mean(np.square(means), axis=0), weights=count)
    return float(np.sqrt(square)), float(np.mean(count))


def is_better_with_tilts(fit: Fit, tilted: Fit) -> bool:
    """Whether the left-out norms decrease if the supports may tilt from hour to hour."""
    before, after = fit.selected.score.norms, tilted.selected.score.norms
    n_common = np.sum(np.isfinite(before.square) & np.isfinite(after.square))
    gain = before.gain_of(after)
    return bool(n_common >= _FEWEST_NORMS and gain and gain[0] > max(gain[1], _TILT_GAIN))


def in_pieces(bag: ReducedBag) -> ReducedBag:
    """
    Divide the rests of a bag into pieces of equal numbers of windows, nearest to an hour each.
    Each piece has its own attitude, as if the support had tilted between the pieces.
    """
    pieces = [piece for rest in bag.intervals for piece in _pieces(rest, bag.window_s)]
    return replace(bag, intervals=tuple(pieces))


def _n_pieces(n_windows: int, window_s: float) -> int:
    return max(round(n_windows * window_s / _PIECE_S), 1)


def _pieces(rest: StillInterval, window_s: float) -> Iterator[StillInterval]:
    n = len(rest.time)
    edges = np.linspace(0, n, _n_pieces(n, window_s) + 1).round().astype(int)
    for first, last in pairwise(edges.tolist()):
        rows = slice(first, last)
        yield replace(
            rest,
            start_ns=rest.start_ns + round(first * window_s * 1e9),
            end_ns=rest.end_ns if last == n else rest.start_ns + round(last * window_s * 1e9),
            begin_s=rest.begin_s + first * window_s,
            n_whole=min(max(rest.n_whole - first, 0), last - first),
            time=rest.time[rows],
            count=rest.count[rows],
            mean=rest.mean[rows],
            angular_rate=None if rest.angular_rate is None else rest.angular_rate[rows],
        )


def of_whole_rests(
    pieces: Sequence[PositionReport], bags: Sequence[ReducedBag]
) -> tuple[PositionReport, ...]:
    """Join the reports of the pieces of each rest: mean attitude, and RMS over the pieces."""
    result, left = [], iter(pieces)
    for bag in bags:
        for rest in bag.intervals:
            parts = list(islice(left, _n_pieces(len(rest.time), bag.window_s)))
            # A rest of one sample has a window, and a duration of 0.
            share = np.array([max(part.duration_s, bag.window_s) for part in parts])
            up = share @ np.array([part.up for part in parts])
            x, y, z = (up / np.linalg.norm(up)).tolist()
            in_sample, left_out = (
                float(np.sqrt(np.average(np.square(rms), weights=share)))
                for rms in (
                    [part.residual_rms for part in parts],
                    [part.left_out_rms for part in parts],
                )
            )
            duration_s = (rest.end_ns - rest.start_ns) * 1e-9
            new = replace(parts[0], duration_s=duration_s, up=(x, y, z))
            result.append(replace(new, residual_rms=in_sample, left_out_rms=left_out))
    return tuple(result)
