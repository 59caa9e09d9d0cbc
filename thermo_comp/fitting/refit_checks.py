# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns two checks after which a fit is repeated: whether the bias at settled temperatures is less
certain with the chosen model than with a smaller model, and whether supports tilted slowly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..typing import Floats
from .evidence import PositionReport
from .left_out import settled_error
from .reduction import ReducedBag, StillInterval
from .selection import Fit
from .unknowns import Windows
from .windows import CURVE

# Length of a piece of a rest in which a slow tilt of the support is taken as constant [s].
_PIECE_S = 3600.0
# Smallest number of scored positions for a reliable standard error of the gain by slow tilts.
_FEWEST_NORMS = 6


def extrapolates(fit: Fit) -> bool:
    """
    Whether the left-out drift of the chosen model exceeds the noise, and the expected error of its
    bias at settled temperatures exceeds the expected error by a smaller model (`settled_error`).
    """
    settled, trials = fit.windows.data.settled, fit.selected.trials
    chosen = next(trial for trial in trials if trial.is_chosen)
    if settled is None or not chosen.score.exceeds_noise:
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
    Whether the RMS of hourly mean drifts in left-out positions exceeds 6 times the noise of an
    hourly mean, and a tenth of the error of left-out |f|; False if few positions have this error.
    Slow tilts change the specific force along axes across gravity, but hardly change |f|.
    """
    score, data = fit.selected.score, fit.windows.data
    if np.isfinite(score.norms.square).sum() < _FEWEST_NORMS:
        return False
    drift, n_windows = _slow_drift(data, score.drift)
    return bool(drift > max(6.0 * score.noise / n_windows**0.5, 0.1 * score.norms.rms))


def _slow_drift(data: Windows, drift: Floats) -> tuple[float, float]:
    """
    Return the RMS, over hours and axes, of the mean drift in each hour of a position, and the mean
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
    """Whether left-out |f| has clearly smaller errors if supports may tilt from hour to hour."""
    before, after = fit.selected.score.norms, tilted.selected.score.norms
    n_common = np.sum(np.isfinite(before.square) & np.isfinite(after.square))
    gain = before.gain_of(after)
    # A log ratio of mean square errors of 0.3 is a decrease of the RMS error by 14 %.
    return bool(n_common >= _FEWEST_NORMS and gain and gain[0] > max(gain[1], 0.3))


def in_pieces(bag: ReducedBag) -> ReducedBag:
    """Divide each rest of a bag into equal pieces of about an hour, as separate positions."""
    pieces = [piece for rest in bag.intervals for piece in _pieces(rest, bag.window_s)]
    return replace(bag, intervals=tuple(pieces))


def _pieces(rest: StillInterval, window_s: float) -> Iterator[StillInterval]:
    n = len(rest.time)
    n_pieces = max(round(n * window_s / _PIECE_S), 1)
    edges = np.linspace(0, n, n_pieces + 1).round().astype(int)
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
    """
    Make one report per rest from the reports of its pieces: mean attitude, RMS residuals. Pieces
    without a known temperature have no report; a rest of such pieces alone has no report either.
    """
    result, left = [], deque(pieces)
    for bag in bags:
        for rest in bag.intervals:
            parts = []
            for piece in _pieces(rest, bag.window_s):
                key = bag.source.name, piece.start_ns
                if left and (left[0].source, left[0].start_ns) == key:
                    parts.append(left.popleft())
            if not parts:
                continue
            # Weight of a piece: its duration, or the length of a window if this is longer.
            share = np.array([max(part.duration_s, bag.window_s) for part in parts])
            up = share @ np.array([part.up for part in parts])
            x, y, z = (up / np.linalg.norm(up)).tolist()
            pairs = [(part.residual_rms, part.left_out_rms) for part in parts]
            in_sample, left_out = (
                float(np.sqrt(np.average(np.square(rms), weights=share)))
                for rms in zip(*pairs, strict=True)
            )
            duration_s = (rest.end_ns - rest.start_ns) * 1e-9
            new = replace(parts[0], start_ns=rest.start_ns, duration_s=duration_s, up=(x, y, z))
            result.append(replace(new, residual_rms=in_sample, left_out_rms=left_out))
    return tuple(result)
