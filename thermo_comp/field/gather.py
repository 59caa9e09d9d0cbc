# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the detection of rests in a stream of samples: windows of 10 s without motion.

Samples are summed by whole seconds of their stamps. A second is still if its standard deviation is
that of the noise and its mean agrees with the mean of the second before (thresholds as in
`online.checks.GravityCheck`). Ten still seconds in a row form a window. In a long rest all windows
of the first ten minutes are kept, then one window per minute up to an hour, then one window per
five minutes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..online.checks import LARGEST_CHANGE, SCATTER_FACTOR, SMALLEST_WINDOW
from ..typing import Floats, Stamps
from .rest import Rest

SECONDS = 10  # length of a window of a rest [s]
_SECOND_NS = 1_000_000_000
#: Pairs (k, n): from the window number k of a rest on, every n-th window is kept.
_SPACING = ((360, 30), (60, 6), (0, 1))


@dataclass
class _Second:
    """
    Sums over one second of the stamps; subtracting the first sample, `origin`, keeps them small.
    """

    number: int
    origin: Floats
    n: int = 0
    total: Floats = field(default_factory=lambda: np.zeros(0))
    squares: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def mean(self) -> Floats:
        return np.asarray(self.origin + self.total / self.n)


#: A function that returns the thermal state and the remaining shares of the unknown initial lag
#: states; None before the first temperature reading.
StateNow = Callable[[], tuple[Sequence[float], Sequence[float]] | None]


class RestFinder:
    """Finds the rests in a stream of samples of one unit."""

    def __init__(
        self, scale: Floats, noise: Floats, full_scale: float, state_now: StateNow
    ) -> None:
        # `scale`: scale factors [input units per m/s^2]; `noise`: variance of one sample
        # [m^2/s^4], by axis.
        self._scale, self._noise, self._full_scale = scale, float(noise.sum()), full_scale
        self._state_now = state_now
        self._second: _Second | None = None
        self._run: list[_Second] = []
        self._states: list[tuple[Sequence[float], Sequence[float]]] = []
        self._n_windows = 0
        self._last: list[_Second] = []  # sums of the last second of the previous window

    def add(self, stamps: Stamps, samples: Floats) -> list[Rest]:
        """
        Take samples with rising stamps, (n, 3), or (n, 6) with angular rates; return new rests.
        """
        rests: list[Rest] = []
        seconds = stamps // _SECOND_NS
        cuts = np.flatnonzero(np.diff(seconds)) + 1
        for begin, end in zip([0, *cuts], [*cuts, len(stamps)], strict=True):
            number, part = int(seconds[begin]), samples[begin:end]
            if self._second is None or self._second.number != number:
                if self._second is not None:
                    rests += self._close(self._second, number)
                self._second = _Second(number, part[0], total=np.zeros(part.shape[1]))
            second, centred = self._second, part - self._second.origin
            second.n += len(part)
            second.total += centred.sum(axis=0)
            second.squares += (centred[:, :3] ** 2).sum(axis=0)
        return rests

    def _close(self, second: _Second, following: int) -> list[Rest]:
        state = self._state_now() if self._is_still(second) else None
        if state is None:
            self._forget()
            return []
        self._run.append(second)
        self._states.append(state)
        rests = []
        if len(self._run) == SECONDS:
            spacing = next(spacing for begin, spacing in _SPACING if self._n_windows >= begin)
            if self._n_windows % spacing == 0:
                rests.append(self._window())
            self._n_windows += 1
            # The first second of the next window is compared with the last second of this window.
            self._run, self._states = [], []
            self._last = [second]
        if following != second.number + 1:
            self._forget()
        return rests

    def _forget(self) -> None:
        self._run, self._states, self._n_windows, self._last = [], [], 0, []

    def _is_still(self, second: _Second) -> bool:
        n = second.n
        if n < SMALLEST_WINDOW or not np.isfinite(second.squares).all():
            return False
        if np.abs(second.mean[:3]).max() >= self._full_scale:
            return False
        scatter = (second.squares - second.total[:3] ** 2 / n) / (n - 1) / self._scale**2
        # Constant samples are a fault of the converter, not a rest.
        if not 0.0 < scatter.sum() <= SCATTER_FACTOR**2 * self._noise:
            return False
        change = LARGEST_CHANGE + 4.0 * np.sqrt(2.0 * self._noise / (3.0 * n))
        return all(
            (np.abs(second.mean[:3] - other.mean[:3]) <= change * np.abs(self._scale)).all()
            for other in (self._run[-1:] or self._last) + self._run[:1]
        )

    def _window(self) -> Rest:
        n = sum(second.n for second in self._run)
        weights = np.array([second.n for second in self._run]) / n
        mean = weights @ np.array([second.mean for second in self._run])
        within = sum(second.squares - second.total[:3] ** 2 / second.n for second in self._run)
        states, shares = (np.array(part) for part in zip(*self._states, strict=True))
        return Rest(
            self._run[0].number * _SECOND_NS + SECONDS * _SECOND_NS // 2,
            n,
            tuple(mean[:3].tolist()),
            tuple(np.sqrt(within / (n - len(self._run))).tolist()),
            tuple((weights @ states).tolist()),
            tuple((weights @ shares).tolist()),
            tuple(mean[3:].tolist()),
        )
