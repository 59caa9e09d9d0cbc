# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the window table: all windows of all positions with their thermal regressors.

This is the whole data set as the regression sees it; from here on no samples are needed.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ..typing import Bools, Floats, Ints
from .history import ThermalHistory
from .lags import BoardHistories, Memory
from .reduction import ReducedBag

_NUMBERS = ('position', 'bag', 'section')
_MEANS = ('time', 'mean', 't', 'gradient', 'rate', 'weight')
_COLUMNS = (*_NUMBERS, 'count', *_MEANS)


@dataclass(frozen=True)
class WindowTable:
    """
    Windows, sorted by position.

    Parameters
    ----------
    position, bag, section : ndarray of int64, shape (n,)
        Number of the position, of the bag, and of the stretch of the chamber's program within
        the bag.
    time : ndarray, shape (n,)
        Time since the bag's first sample [s].
    count : ndarray, shape (n,)
        Samples in the window.
    mean : ndarray, shape (n, 3)
        Mean of the raw samples.
    t, gradient, rate, weight : ndarray, shape (n,)
        ``T_board - T_ref``, ``T_case - T_board``, ``dT_board/dt``, weight of the dynamic set.
    histories : tuple of ThermalHistory
        One per bag, all of one grid step, for the lags.

    """

    position: Ints
    bag: Ints
    section: Ints
    time: Floats
    count: Floats
    mean: Floats
    t: Floats
    gradient: Floats
    rate: Floats
    weight: Floats
    histories: tuple[ThermalHistory, ...]

    @property
    def n_positions(self) -> int:
        """
        Number of positions.

        """
        return int(self.position[-1]) + 1 if len(self.position) else 0

    @property
    def is_dynamic(self) -> Bools:
        """
        Whether the dynamic set prevails, shape (n,).

        """
        return np.asarray(self.weight > 0.5)

    def position_slices(self) -> list[slice]:
        """
        Rows of each position.

        """
        edges = np.searchsorted(self.position, np.arange(self.n_positions + 1)).tolist()
        return [slice(start, stop) for start, stop in pairwise(edges)]

    def memory(self, time_constants_s: Floats) -> Memory:
        """
        Memory regressors at the windows.

        Parameters
        ----------
        time_constants_s : ndarray, shape (k,)
            Time constants [s].

        Returns
        -------
        Memory
            With one row per window.

        """
        if not len(time_constants_s):
            return Memory(*(np.zeros((len(self.time), 0)) for _ in range(4)))
        return self._board.memory(time_constants_s)

    @cached_property
    def _board(self) -> BoardHistories:
        starts = np.array([history.start_s for history in self.histories])
        return BoardHistories.of(
            [history.board for history in self.histories],
            self.histories[0].step_s,
            self.bag,
            self.time - starts[self.bag],
        )

    def select(self, rows: Bools) -> WindowTable:
        """
        Keep some windows; positions keep their numbers.

        """
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def renumbered(self) -> WindowTable:
        """
        Close the gaps that positions without windows left in the numbers.

        """
        _, position = np.unique(self.position, return_inverse=True)
        return replace(self, position=position)

    def coarsened(self, window_s: float) -> WindowTable:
        """
        Merge neighbouring windows of one position and section into longer ones.

        Parameters
        ----------
        window_s : float
            Length of the merged windows [s].

        Returns
        -------
        WindowTable
            Count-weighted means.

        """
        if not len(self.time):
            return self
        slot = np.floor(self.time / window_s).astype(np.int64)
        keys = np.column_stack((self.position, self.section, slot))
        first = np.flatnonzero(np.concatenate(([True], (np.diff(keys, axis=0) != 0).any(axis=1))))
        total = np.add.reduceat(self.count, first)

        def mean(column: Floats) -> Floats:
            weights = self.count if column.ndim == 1 else self.count[:, None]
            shape = total if column.ndim == 1 else total[:, None]
            return np.asarray(np.add.reduceat(column * weights, first, axis=0) / shape)

        merged: dict[str, Any] = {name: getattr(self, name)[first] for name in _NUMBERS}
        merged |= {name: mean(getattr(self, name)) for name in _MEANS}
        factor = max(1, int(window_s / 6.0 / self.histories[0].step_s))
        histories = tuple(history.coarsened(factor) for history in self.histories)
        return replace(self, count=total, histories=histories, **merged)


def window_table(
    bags: Sequence[ReducedBag], histories: Sequence[ThermalHistory], reference_temperature: float
) -> WindowTable:
    """
    Join the windows of all bags with their thermal state.

    Windows before the board's first reading, or while its estimate is still settling, are left
    out.

    Parameters
    ----------
    bags : sequence of ReducedBag
        The bags.
    histories : sequence of ThermalHistory
        Their thermal histories.
    reference_temperature : float
        T_ref [degC].

    Returns
    -------
    WindowTable
        The table; a position none of whose windows is usable has no rows.

    """
    columns: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in _COLUMNS}
    position = 0
    for bag, (reduced, history) in enumerate(zip(bags, histories, strict=True)):
        grid = history.time
        settled = history.var_board <= 4.0 * np.median(history.var_board)
        begin = float(grid[int(np.argmax(settled))])
        sections = history.sections()
        for interval in reduced.intervals:
            use = interval.time >= begin
            if not use.any():
                continue
            time = interval.time[use]
            columns['time'].append(time)
            columns['count'].append(interval.count[use])
            columns['mean'].append(interval.mean[use])
            columns['t'].append(np.interp(time, grid, history.board) - reference_temperature)
            for name in ('gradient', 'rate', 'weight'):
                columns[name].append(np.interp(time, grid, getattr(history, name)))
            nearest = np.clip(np.searchsorted(grid, time), 0, len(grid) - 1)
            columns['section'].append(sections[nearest])
            columns['position'].append(np.full(len(time), position))
            columns['bag'].append(np.full(len(time), bag))
            position += 1
    empty: dict[str, npt.NDArray[Any]] = dict.fromkeys(_NUMBERS, np.zeros(0, dtype=np.int64))
    empty['mean'] = np.zeros((0, 3))
    joined = {
        name: np.concatenate(parts) if parts else empty.get(name, np.zeros(0))
        for name, parts in columns.items()
    }
    return WindowTable(**joined, histories=tuple(histories))
