# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the limits of a cell's variance and roughness at rest, if a low pass has coloured the noise.

A cell is a run of about 0.5 s of samples; its roughness is half the mean square change from sample
to sample, which equals the variance for white noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..typing import Bools, Floats

if TYPE_CHECKING:
    from .stillness import Cells

# Standard normal quantiles of the probabilities 0.1 and 1 - 1e-11.
_TENTH, _NEVER = -1.2816, 6.7
# Noise is coloured if a cell's degrees of freedom are below this fraction of those of white noise;
# smallest number of degrees of freedom of a cell; number of iterations in `spread_of_variances`
# and of trial values in `roughest_at_rest`.
_COLOURED, _FEWEST_FREE, _ITERATIONS = 0.5, 2.0, 30


def spread_of_variances(cells: Cells, plausible: Bools, level: Floats) -> Floats:
    """
    Return the spread of the variances of cells at rest, relative to white noise, per axis: the
    ratio of the 1 - 1e-11 quantile to the 0.1 quantile, divided by that ratio of white noise.
    With a correlation r of successive samples the effective number of samples is (1 - r) / (1 + r)
    times their number, and the roughness is 1 - r times the mean variance. The mean variance
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
    Return the largest roughness of a cell at rest, per axis, for the largest ratio of variances
    `ratio`; infinite for white noise. Coloured noise hides a step in a cell's mean and variance,
    but not in the changes from sample to sample. The roughness is taken as chi-square distributed,
    with the degrees of freedom that give the ratio of its tenth percentile to its median.
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
    """Return a quantile of chi-square / degrees of freedom (Wilson and Hilferty); 0.0: median."""
    width = 2.0 / (9.0 * n_free)
    return float((1.0 - width + sigmas * np.sqrt(width)) ** 3)
