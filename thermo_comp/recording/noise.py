# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the noise of samples at rest: glitches (single samples with wrong bits, as after a transfer
error), and limits of a cell's variance and roughness for low-pass filtered noise.

A cell is a run of samples of 0.5 s or longer; its roughness is half the mean square change from
sample to sample, which equals the variance for white noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..typing import Bools, Floats

if TYPE_CHECKING:
    from .stillness import Cells

_SDS = 25.0  # smallest distance of a glitch from the mean of its neighbours, in sd of the noise
# Smallest distance of a glitch from the mean of its neighbours, divided by the samples' norm. A
# change by one count, from the remainder that a converter adds to its next cycle, is no glitch.
_LEAST = 0.02
_FEWEST = 30  # smallest number of samples that are searched for glitches
_TENTH, _NEVER = -1.2816, 6.7  # standard normal quantiles of the probabilities 0.1 and 1 - 1e-11
_COLOURED = 0.5  # noise with less than this share of white noise's degrees of freedom is coloured
_FEWEST_FREE = 2.0  # smallest number of degrees of freedom of a cell
_ITERATIONS = 30  # iterations in `spread_of_variances`; trial values in `roughest_at_rest`


def is_glitch(samples: Floats, quantum: Floats) -> Bools:
    """
    Return which samples, shape (n, 3), are glitches: a glitch is far from the samples before and
    after it, which agree, and no motion is near. A glitch left in the data would end a rest.
    """
    result = np.zeros(len(samples), dtype=bool)
    if len(samples) < _FEWEST:
        return result
    # Noise and norm are estimated from at most 4000 samples, to save time.
    every = slice(None, None, max(len(samples) // 2000, 1))
    smallest = _LEAST * float(np.median(np.linalg.norm(samples[every], axis=1)))
    x = np.ascontiguousarray(samples.T)
    bend = np.abs(x[:, 1:-1] - 0.5 * (x[:, 2:] + x[:, :-2]))
    noise = np.maximum(np.median(bend[:, every], axis=1) / 0.6745, quantum)
    limit = np.maximum(_SDS * noise, smallest)[:, np.newaxis]
    is_moving = np.pad((bend > limit / 3.0).any(axis=0), 1)
    is_far = bend > limit
    if is_far.any():
        is_far &= np.abs(x[:, 2:] - x[:, :-2]) < 0.5 * bend
    at = 1 + np.flatnonzero(is_far.any(axis=0))
    # The second to fourth sample on each side of a glitch must show no motion.
    beside = np.array([-4, -3, -2, 2, 3, 4])
    around = np.clip(at[:, np.newaxis] + beside, 0, len(samples) - 1)
    result[at[~is_moving[around].any(axis=1)]] = True
    return result


def spread_of_variances(cells: Cells, plausible: Bools, level: Floats) -> Floats:
    """
    Return the spread of the variances of cells at rest, relative to white noise, per axis: the
    ratio of the 1 - 1e-11 quantile to the 0.1 quantile, divided by this ratio for white noise.
    With a correlation r of successive samples the effective number of samples is (1 - r) / (1 + r)
    times their number, and the roughness is (1 - r) times the mean variance. The mean variance
    follows from the tenth percentile `level` of the variances and the effective number of samples.
    """
    n_free = float(np.median(cells.count[plausible])) - 1.0
    quiet = plausible & (cells.variance <= level).any(axis=1)
    rough = np.median(cells.roughness[quiet], axis=0)
    result = np.ones(3)
    for axis in range(3):
        n = n_free
        for _ in range(_ITERATIONS if level[axis] > 0.0 else 0):
            white = min(rough[axis] / level[axis] * _quantile(n, _TENTH), 1.0)
            n = max(n_free * white / (2.0 - white), _FEWEST_FREE)
        if n < _COLOURED * n_free:
            tails = [_quantile(k, _NEVER) / _quantile(k, _TENTH) for k in (n, n_free)]
            result[axis] = tails[0] / tails[1]
    return result


def roughest_at_rest(cells: Cells, quiet: Bools, is_coloured: Bools, ratio: float) -> Floats:
    """
    Return the largest roughness of a cell at rest, per axis; infinite for white noise. `ratio`:
    largest variance at rest / noise variance. In coloured noise a step shows in the changes from
    sample to sample, but not in mean and variance. The roughness is taken as chi-square
    distributed; the ratio of its tenth percentile to its median gives the degrees of freedom.
    """
    result = np.full(3, np.inf)
    for axis in np.flatnonzero(is_coloured) if quiet.any() else ():
        tenth, median = np.quantile(cells.roughness[quiet, axis], (0.1, 0.5))
        n_free = float(np.median(cells.count[quiet])) - 1.0
        frees = np.geomspace(_FEWEST_FREE, n_free, _ITERATIONS) if n_free > _FEWEST_FREE else ()
        shares = [_quantile(n, _TENTH) / _quantile(n, 0.0) for n in frees]
        n = float(np.interp(tenth / max(median, 1e-300), shares, frees)) if shares else n_free
        widest = _quantile(n, _NEVER) / _quantile(n, 0.0)
        usual = _quantile(n_free, _NEVER) / _quantile(n_free, 0.0)
        floor = 0.25 * cells.quantum[axis] ** 2
        result[axis] = ratio * max(median * max(widest / usual, 1.0), floor)
    return result


def _quantile(n_free: float, sigmas: float) -> float:
    """Return the quantile of chi-square / `n_free` at a normal quantile (Wilson and Hilferty)."""
    width = 2.0 / (9.0 * n_free)
    return float((1.0 - width + sigmas * np.sqrt(width)) ** 3)
