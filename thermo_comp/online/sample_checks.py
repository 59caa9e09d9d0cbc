# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what physics says about raw samples before they are corrected: a converter that stands still,
samples that come faster than conversions can.

A converter with noise does not give the same three numbers to the bit for seconds, and three exact
zeros are no measurement but a dead wire. A count is charge per conversion cycle, so samples that
come at another rate are of another scale, whatever else they are.
"""

from __future__ import annotations

from math import nan
from typing import Final

import numpy as np

from ..thermal.reading_queue import NEVER_NS
from ..typing import Bools, Floats, Ints

#: Fewer equal samples in a row than this are chance, however far they lie apart.
STUCK_SAMPLES: Final = 50
#: Samples may come this many times as fast as the calibrated cycle in the long run ...
LARGEST_RATE: Final = 1.5
#: ... with so many of them, or so many seconds' worth, at once (a driver that empties a buffer).
BURST_SAMPLES: Final = 50
BURST_S: Final = 0.25
#: Samples this much faster than calibrated, relative, still have the calibrated noise.
RATE_TOLERANCE: Final = 0.1
_WINDOW_S: Final = 1.0  # a rate is measured over so many seconds


class StuckCheck:
    """Counts equal samples in a row; beyond the time-out [s], if any, they are not believed."""

    def __init__(self, timeout_s: float) -> None:
        self.is_on = timeout_s > 0.0  # whether anything is watched
        self.limit_ns = round(timeout_s * 1e9) if self.is_on else NEVER_NS
        self.run = (nan, nan, nan, 0)  # the sample that the run began with and its stamp
        self.n_same = 0  # how often it has come again

    def again(self, stamp_ns: int) -> bool:
        """Count one more equal sample; say whether it is too many."""
        self.n_same += 1
        return self.n_same >= STUCK_SAMPLES and stamp_ns - self.run[3] > self.limit_ns

    def find(self, stamps: Ints, samples: Floats) -> Bools:
        """Find the samples (n > 0, 3) that the stream would call stuck, or three exact zeros."""
        n = len(stamps)
        x, y, z = samples.T
        same = np.empty(n, dtype=np.bool_)
        same[0] = (x[0], y[0], z[0]) == self.run[:3]
        same[1:] = (x[1:] == x[:-1]) & (y[1:] == y[:-1]) & (z[1:] == z[:-1])
        changed = np.flatnonzero(~same)
        found = np.zeros(n, dtype=np.bool_)
        if int(np.max(np.diff(changed, prepend=-1 - self.n_same, append=n))) > STUCK_SAMPLES:
            row = np.arange(n)
            begin = np.maximum.accumulate(np.where(same, -1, row))
            n_same = np.where(begin < 0, row + 1 + self.n_same, row - begin)
            since = np.where(begin < 0, self.run[3], stamps[begin])
            found |= same & (n_same >= STUCK_SAMPLES) & (stamps - since > self.limit_ns)
        if len(changed):
            last = changed.item(-1)
            self.run = (x.item(last), y.item(last), z.item(last), int(stamps[last]))
            self.n_same = n - 1 - last
        else:
            self.n_same += n
        if self.is_on:
            zeros = np.flatnonzero(x == 0.0)
            found[zeros[~samples[zeros].any(axis=1)]] = True
        return found


class RateCheck:
    """Compares the rate of the samples with the calibrated one, at the start of each segment."""

    def __init__(self, cycle_s: float, counts_cycles: bool = True) -> None:
        self._cycle_s, self._counts_cycles = cycle_s, counts_cycles
        self._allowance = max(BURST_SAMPLES, BURST_S / cycle_s)
        #: Whether more samples have come than conversions can make.
        self.is_too_fast = False
        self.ratio = 1.0  # samples per calibrated cycle over the last second or so
        self._level = 0.0
        self._last: tuple[int, int] | None = None
        self._window = (0, 0)

    @property
    def noise_excess(self) -> float:
        """What the rate adds to a sample's noise, relative to the calibrated cycle's."""
        excess = self.ratio - 1.0
        return excess if excess > RATE_TOLERANCE else 0.0

    def update(self, n_seen: int, stamp_ns: int) -> None:
        """Take the count of samples, of different stamps, before a stamp."""
        last = self._last
        self._last = (n_seen, stamp_ns)
        if last is None:
            self._window = self._last
            return
        n, dt = n_seen - last[0], (stamp_ns - last[1]) * 1e-9
        level = self._level + n - LARGEST_RATE * dt / self._cycle_s
        if level <= 0.0:
            self._level = 0.0
            self.is_too_fast = False
        else:
            # Twice the allowance at most, so that a long excess is soon forgiven.
            self._level = min(level, 2.0 * self._allowance)
            self.is_too_fast = self._counts_cycles and self._level > self._allowance
        n, dt = n_seen - self._window[0], (stamp_ns - self._window[1]) * 1e-9
        if dt >= _WINDOW_S:
            self.ratio = n * self._cycle_s / dt
            self._window = (n_seen, stamp_ns)
