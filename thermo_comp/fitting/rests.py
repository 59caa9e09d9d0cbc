# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the tests of the rests of a recording: whether temperatures and samples change in a rest,
which attitudes were heated, and to which attitudes the unit was returned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..thermal.state import VAR_BOARD
from ..typing import Bools, Floats, Ints
from .coverage import distinct_directions
from .initial_triad import block_means, white_noise_of, within_positions
from .unknowns import Windows
from .windows import LAGS, ThermalWindows

# Largest change of the board temperature by self-heating after power-on [K].
_WARM_UP_K = 10.0


def is_constant(windows: ThermalWindows, part: Ints) -> bool:
    """
    Whether the board temperature changes less (RMS) within parts of the data than between parts.
    `part`: index of each window's part, shape (n,); a part is a position or a bag.
    """
    t = windows.temperature
    within = within_positions(t[:, None], part)[:, 0]
    return bool(np.var(within) < np.var(t - within))


def only_warms_up(windows: ThermalWindows) -> bool:
    """
    Whether no bag contains a ramp of a chamber: the board temperature changes by at most
    `_WARM_UP_K` in each bag, and less (RMS) within bags than between bags.
    """
    t, bag = windows.temperature, windows.data.bag
    changes = [float(np.ptp(t[bag == number])) for number in np.unique(bag)]
    return max(changes) <= _WARM_UP_K and is_constant(windows, bag)


def is_bench(windows: ThermalWindows, up: Floats) -> bool:
    """Whether only one of several attitudes was heated or cooled; `up`: attitudes, (n, 3)."""
    n_heated = len(distinct_directions(up[_is_heated(windows)]))
    return n_heated == 1 and len(distinct_directions(up)) > 1


def _is_heated(windows: ThermalWindows) -> Bools:
    """
    Return whether each position was heated or cooled, shape (n_positions,); all True if none was.
    In a heated position the temperature changes, or its mean differs from the median of all
    positions, by more than a tenth of the range of all temperatures. Smaller changes, as of short
    rests in a room, hardly separate bias and scale.
    """
    t, edges, weight = windows.temperature, windows.data.edges[:-1], windows.data.weight
    mean = block_means(t[:, None], weight, edges)[:, 0]
    change = np.maximum.reduceat(t, edges) - np.minimum.reduceat(t, edges)
    is_heated = np.maximum(np.abs(mean - np.median(mean)), change) > 0.1 * np.ptp(t)
    return np.asarray(is_heated | ~is_heated.any())


def is_steady(windows: ThermalWindows) -> Bools:
    """
    Return whether each position has constant temperatures, shape (n_positions,): the RMS change of
    the board temperature and of the lags is below three sd of the error of the board temperature.
    A ninth of a mean square of (3 sd)^2 is noise, so a slope would be too small by a ninth.
    """
    data, model = windows.data, windows.model
    lags = [column.group in LAGS and not column.power for column in model.columns]
    celsius = np.column_stack((windows.temperature, windows.raw[:, lags]))
    square = within_positions(celsius, data.position) ** 2
    change = np.array([part.mean(axis=0).max() for part in np.split(square, data.edges[1:-1])])
    noise = np.array([np.median(track.states[:, VAR_BOARD]) for track in windows.tracks])
    return np.asarray(change < 9.0 * noise[data.bag_of_position])


def is_without_drift(data: Windows, scale: Floats) -> Bools:
    """Return whether each position's RMS drift is <= 3 sd of a window's noise, (n_positions,)."""
    drift = within_positions(data.mean / scale, data.position) * np.sqrt(data.weight)[:, None]
    square = np.add.reduceat(drift**2, data.edges[:-1], axis=0) / np.diff(data.edges)[:, None]
    return np.asarray((square <= (3.0 * white_noise_of(data, scale)) ** 2).all(axis=1))


def constant_in(data: Windows, steady: Bools, settled: Bools) -> Windows:
    """
    Replace columns by their means in positions where `steady` is True. Set the effects of initial
    lag states to 0 in positions where `settled` is True, because they would only fit noise.
    """
    in_steady = steady[data.position][:, np.newaxis]
    means = (data.columns - within_positions(data.columns, data.position))[data.edges[:-1]]
    columns = np.where(in_steady, means[data.position], data.columns)
    square, of_means = (np.mean(values**2, axis=0) for values in (data.columns, columns))
    kelvins = data.kelvins * np.sqrt(of_means / np.where(square > 0.0, square, 1.0))
    start = np.where(settled[data.position][:, np.newaxis], 0.0, data.start)
    return replace(data, columns=columns, kelvins=kelvins, start=start)


def poses_of(windows: ThermalWindows, up: Floats) -> Ints | None:
    """
    Return the index of each position's pose, -1 without pose, (n_positions,); None without poses.

    `up`: attitudes, shape (n_positions, 3). The positions of an attitude form a pose if the unit
    was returned to the attitude from another one, or if all (two or more) positions have it.
    """
    if len(up) == 1:
        return None
    directions, result = distinct_directions(up), np.full(len(up), -1)
    attitude = np.argmax(up @ directions.T, axis=1)
    order = np.argsort([bag.start_ns for bag, _ in windows.rests], kind='stable')
    for k in range(len(directions)):
        n_visits = np.sum(np.diff((attitude[order] == k).astype(int), prepend=0) > 0)
        if len(directions) == 1 or n_visits > 1:
            result[attitude == k] = result.max() + 1
    return result if result.max() >= 0 else None
