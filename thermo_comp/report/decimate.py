# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thinning of long series to what a line of some hundred pixels can show."""

from __future__ import annotations

import numpy as np

from ..typing import Floats


def thin(time: Floats, value: Floats, n_bins: int) -> tuple[Floats, Floats]:
    """
    Keep, of each of `n_bins` equal stretches of time, the lowest and the highest point.

    So a line through the result covers the same pixels as a line through all points, and no
    spike is lost. Where values are missing a NaN stays, so that the line breaks there.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising times.
    value : ndarray, shape (n,)
        Values; what is not finite counts as missing.
    n_bins : int
        Number of stretches, about the width of the line in pixels.

    Returns
    -------
    time, value : ndarray, shape (m,)
        At most three points per stretch, in time order.

    Raises
    ------
    ValueError
        If `n_bins` is below 1.

    """
    if n_bins < 1:
        raise ValueError(f'`n_bins` must be at least 1, got {n_bins}')
    use = np.isfinite(value)
    if len(time) <= 2 * n_bins or not use.any():
        return time, np.where(use, value, np.nan)
    width = (float(time[-1]) - float(time[0])) / n_bins
    bins = np.minimum(((time - time[0]) / width).astype(np.int64), n_bins - 1)
    kept, at, found = bins[use], time[use], value[use]
    order = np.lexsort((found, kept))
    first = np.flatnonzero(np.concatenate(([True], np.diff(kept[order]) > 0)))
    last = np.concatenate((first[1:], [len(order)])) - 1
    rows = np.unique(np.concatenate((order[first], order[last])))
    times, values = at[rows], found[rows]
    # A missing stretch: not thinned away, because a line must not cross it.
    broken = np.flatnonzero(~use & np.concatenate(([True], use[:-1])))
    if len(broken):
        times = np.concatenate((times, time[broken]))
        values = np.concatenate((values, np.full(len(broken), np.nan)))
        by_time = np.argsort(times, kind='stable')
        times, values = times[by_time], values[by_time]
    return times, values
