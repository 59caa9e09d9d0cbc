# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what is kept of a rest in one attitude: means of consecutive samples with their temperature.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..thermal.settings import DetectorSettings, ThermalConfig
from ..typing import Bools, Floats, Ints
from .branches import Branch
from .history import ThermalHistory, thermal_history
from .reduction import ReducedBag
from .sources import FitSource

_HISTORY_STEP_S = 2.0
# A window that takes this many times as long as usual holds a gap.
_GAP_RATIO = 1.5


@dataclass(frozen=True)
class PoseSeries:
    """
    Means of consecutive samples, in order.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Since the bag's first sample [s].
    count : ndarray, shape (n,)
        Samples in each.
    mean : ndarray, shape (n, 3)
        Mean reading [input units].
    temperature : ndarray, shape (n,)
        Board temperature, the thermal tracker's causal estimate.
    rate : ndarray, shape (n,)
        Its rate [K/s].
    branch : ndarray of int64, shape (n,)
        Number of the branch, -1 outside.
    is_still : ndarray of bool, shape (n,)
        Whether it lies in a still interval; a bump may be in the others.

    """

    time: Floats
    count: Floats
    mean: Floats
    temperature: Floats
    rate: Floats
    branch: Ints
    is_still: Bools

    @property
    def norm(self) -> Floats:
        """
        Norm of the mean reading, shape (n,).

        """
        return np.asarray(np.linalg.norm(self.mean, axis=1))

    def select(self, rows: Bools) -> PoseSeries:
        """
        Keep some windows.

        """
        columns = {name: getattr(self, name)[rows] for name in self.__dataclass_fields__}
        return replace(self, **columns)

    def coarsened(self, most: int) -> PoseSeries:
        """
        Merge neighbours until at most about `most` windows are left.

        Windows are merged that lie together in the recording, never over a gap in the series.

        """
        n = len(self.time)
        size = -(-n // most)
        if size <= 1:
            return self
        step = float(np.median(np.diff(self.time)))
        broken = np.diff(self.time) > _GAP_RATIO * step
        run = np.concatenate(([0], np.cumsum(broken)))
        starts = np.flatnonzero(np.concatenate(([True], broken)))
        within = np.arange(n) - starts[run]
        first = np.flatnonzero((within % size) == 0)
        total = np.add.reduceat(self.count, first)

        def mean(column: Floats) -> Floats:
            weights = self.count if column.ndim == 1 else self.count[:, None]
            shape = total if column.ndim == 1 else total[:, None]
            return np.asarray(np.add.reduceat(column * weights, first, axis=0) / shape)

        return replace(
            self,
            time=mean(self.time),
            count=total,
            mean=mean(self.mean),
            temperature=mean(self.temperature),
            rate=mean(self.rate),
            branch=self.branch[first],
            is_still=self.is_still[first],
        )


def pose_series(
    source: FitSource,
    bag: ReducedBag,
    branches: Sequence[Branch],
    detector: DetectorSettings,
    size: int,
) -> tuple[PoseSeries, ThermalHistory]:
    """
    Stream a source into means of `size` consecutive samples.

    Parameters
    ----------
    source : FitSource
        The bag's source.
    bag : ReducedBag
        Its temperature readings and its start.
    branches : sequence of Branch
        Its branches.
    detector : DetectorSettings
        Settings of the thermometers.
    size : int
        Samples per window.

    Returns
    -------
    series : PoseSeries
        The windows.
    history : ThermalHistory
        The thermal state that their temperatures come from.

    """
    history = thermal_history(bag, detector, _HISTORY_STEP_S, ThermalConfig())
    times: list[Floats] = []
    means: list[Floats] = []
    rest_time, rest = np.zeros(0), np.zeros((0, 3))
    for block in source.blocks():
        use = np.isfinite(block.accel).all(axis=1)
        since = (block.accel_stamp_ns[use] - bag.start_ns).astype(np.float64) * 1e-9
        time = np.concatenate((rest_time, since))
        accel = np.concatenate((rest, block.accel[use]))
        n = len(time) // size * size
        grid = time[:n].reshape(-1, size)
        length = grid[:, -1] - grid[:, 0]
        whole = length <= _GAP_RATIO * np.median(length) if n else np.zeros(0, dtype=bool)
        times.append(grid.mean(axis=1)[whole])
        means.append(accel[:n].reshape(-1, size, 3).mean(axis=1)[whole])
        rest_time, rest = time[n:], accel[n:]
    at = np.concatenate(times)
    branch = np.full(len(at), -1, dtype=np.int64)
    is_still = np.zeros(len(at), dtype=np.bool_)
    for number, one in enumerate(branches):
        branch[(at >= one.start_s) & (at < one.end_s)] = number
        for begin, end in one.still:
            is_still |= (at >= begin) & (at <= end)
    series = PoseSeries(
        time=at,
        count=np.full(len(at), float(size)),
        mean=np.concatenate(means),
        temperature=np.interp(at, history.time, history.board),
        rate=np.interp(at, history.time, history.rate),
        branch=branch,
        is_still=is_still,
    )
    return series, history
