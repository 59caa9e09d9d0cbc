# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the detection of rests in a stream of samples: windows of 10 s without motion.

Samples are summed by whole seconds of their stamps. A cell is the smallest number of seconds with
at least five samples, which is one second at 5 Hz or more. A cell is still if the sd of its
samples is above 0 and at most `SCATTER_FACTOR` times the sd of the noise, and their mean agrees
with the means of the preceding cell and of the window's first cell. Still cells in a row that span
10 s form a window. In a long rest all windows of the first ten minutes are kept, then one window
per minute up to an hour, then one per five minutes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..online.checks import LARGEST_CHANGE, SCATTER_FACTOR, SMALLEST_WINDOW
from ..typing import Floats, Stamps
from .rest import Rest

SECONDS = 10  # shortest length of a window of a rest [s]
#: Largest step from one second with samples to the next within a window [s]: at 1 Hz, jitter of
#: the stamps leaves some seconds without a sample.
_LARGEST_STEP = 2
_SECOND_NS = 1_000_000_000
#: Pairs (k, n): every n-th window of a rest is kept, from its window number k on.
_SPACING = ((360, 30), (60, 6), (0, 1))

#: Thermal state, and the fraction of each lag's unknown initial state that has not yet decayed.
_State = tuple[Sequence[float], Sequence[float]]
#: Function that returns the thermal state, or None while the samples cannot be corrected.
StateNow = Callable[[], _State | None]


@dataclass
class _Cell:
    """Sums, over the seconds `begin` to `last`, of each sample less the first sample, `origin`."""

    begin: int
    last: int
    origin: Floats
    total: Floats
    squares: Floats = field(default_factory=lambda: np.zeros(3))
    n: int = 0
    state: _State | None = None  # thermal state after the cell's last samples; None: unknown

    @property
    def mean(self) -> Floats:
        return np.asarray(self.origin + self.total / self.n)


class RestFinder:
    """Finds the rests in a stream of samples of one unit."""

    def __init__(
        self, scale: Floats, noise: Floats, full_scale: float, state_now: StateNow, cycle_s: float
    ) -> None:
        # `scale`: scale factors [input units per m/s^2]; `noise`: variance of one sample of each
        # axis [m^2/s^4] at one sample per `cycle_s`; at a higher rate the variance is larger.
        self._scale, self._noise, self._full_scale = scale, float(noise.sum()), full_scale
        self._state_now, self._cycle_s = state_now, cycle_s
        self._cell: _Cell | None = None
        self._forget()

    def _forget(self) -> None:
        self._run: list[_Cell] = []
        self._last: list[_Cell] = []  # the last cell of the previous window
        self._n_windows = 0

    def add(self, stamps: Stamps, samples: Floats) -> list[Rest]:
        """Add samples of rising stamps, (n, 3) or, with angular rates, (n, 6); return rests."""
        rests: list[Rest] = []
        seconds = stamps // _SECOND_NS
        cuts = np.flatnonzero(np.diff(seconds)) + 1
        for begin, end in zip([0, *cuts], [*cuts, len(stamps)], strict=True):
            number, part = int(seconds[begin]), samples[begin:end]
            cell = self._cell
            if cell is not None and number != cell.last:
                is_next = 0 < number - cell.last <= _LARGEST_STEP
                if not is_next or cell.n >= SMALLEST_WINDOW:
                    rests += self._close(cell, is_followed=is_next)
                    cell = None
            if cell is None:
                cell = _Cell(number, number, part[0], np.zeros(part.shape[1]))
            deviation, self._cell, cell.last = part - cell.origin, cell, number
            cell.n += len(part)
            cell.total += deviation.sum(axis=0)
            cell.squares += (deviation[:, :3] ** 2).sum(axis=0)
            cell.state = self._state_now()
        return rests

    def _close(self, cell: _Cell, *, is_followed: bool) -> list[Rest]:
        if cell.state is None or not self._is_still(cell):
            self._forget()
            return []
        self._run.append(cell)
        rests = []
        if cell.last + 1 - self._run[0].begin >= SECONDS:
            spacing = next(spacing for begin, spacing in _SPACING if self._n_windows >= begin)
            if self._n_windows % spacing == 0:
                rests.append(self._window())
            self._n_windows += 1
            # Keep the window's last cell, with which the next window's first cell is compared.
            self._run, self._last = [], [cell]
        if not is_followed:
            self._forget()
        return rests

    def _is_still(self, cell: _Cell) -> bool:
        n = cell.n
        if n < SMALLEST_WINDOW or not np.isfinite(cell.squares).all():
            return False
        if np.abs(cell.mean[:3]).max() >= self._full_scale:
            return False
        scatter = (cell.squares - cell.total[:3] ** 2 / n) / (n - 1) / self._scale**2
        noise = self._noise * max(1.0, n * self._cycle_s / (cell.last + 1 - cell.begin))
        # Constant samples are a fault of the converter, not a rest.
        if not 0.0 < scatter.sum() <= SCATTER_FACTOR**2 * noise:
            return False
        change = LARGEST_CHANGE + 4.0 * np.sqrt(2.0 * noise / (3.0 * n))
        return all(
            (np.abs(cell.mean[:3] - other.mean[:3]) <= change * np.abs(self._scale)).all()
            for other in (self._run[-1:] or self._last) + self._run[:1]
        )

    def _window(self) -> Rest:
        n = sum(cell.n for cell in self._run)
        weights = np.array([cell.n for cell in self._run]) / n
        mean = weights @ np.array([cell.mean for cell in self._run])
        within = sum(cell.squares - cell.total[:3] ** 2 / cell.n for cell in self._run)
        sd = np.sqrt(within / (n - len(self._run)))
        states, shares = zip(*(cell.state for cell in self._run if cell.state), strict=True)
        rate = mean[3:] if np.isfinite(mean).all() else mean[:0]
        parts = mean[:3], sd, weights @ np.array(states), weights @ np.array(shares), rate
        stamp_ns = (self._run[0].begin + self._run[-1].last + 1) * _SECOND_NS // 2
        return Rest(stamp_ns, n, *(tuple(part.tolist()) for part in parts))
