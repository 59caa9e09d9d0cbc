# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the readings that wait for the sample at which they take effect, in the order of their stamps.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from ..typing import Bools, Ints, Stamps

#: (stamp [ns], kind: 0 board, 1 and up the others, order of arrival, degC).
Entry = tuple[int, int, int, float]

#: More readings than this that wait mean that their clock is not the samples'.
PENDING_LIMIT: Final = 4096
#: A reading that comes after another of its sensor is stamped earlier by no more than this [ns],
#: or the other one was not of this clock.
DISORDER_NS: Final = 5_000_000_000
#: Later than any stamp.
NEVER_NS: Final = 1 << 62


class ReadingQueue:
    """
    Readings by stamp; of equal stamps the board first, then by arrival.

    So the detector, which the case reading wakes, decides with the newest of both.
    """

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        self._n_pushed = 0
        #: Stamp of the reading of each kind that arrived last.
        self.last_ns: dict[int, int] = {}

    @property
    def next_ns(self) -> int:
        """Stamp of the first reading; later than any where none waits."""
        return self._entries[0][0] if self._entries else NEVER_NS

    def push(self, stamp_ns: int, kind: int, celsius: float) -> int:
        """
        Add a reading; return how many were refused: this one where too many wait, or those that
        wait with stamps which this one shows to be of another clock.
        """
        n_before = len(self._entries)
        last_ns, self.last_ns[kind] = self.last_ns.get(kind, -NEVER_NS), stamp_ns
        if stamp_ns < last_ns - DISORDER_NS:
            latest_ns = stamp_ns + DISORDER_NS
            self._entries = [e for e in self._entries if e[1] != kind or e[0] <= latest_ns]
            heapq.heapify(self._entries)
        n_refused = n_before - len(self._entries)
        return n_refused if self.put(stamp_ns, kind, celsius) else 1

    def put(self, stamp_ns: int, kind: int, celsius: float) -> bool:
        """Add a reading that has been judged; False where too many wait."""
        if len(self._entries) >= PENDING_LIMIT:
            return False
        heapq.heappush(self._entries, (stamp_ns, kind, self._n_pushed, celsius))
        self._n_pushed += 1
        return True

    def due(self, stamp_ns: int) -> Iterator[Entry]:
        """Take the readings up to a stamp, one by one."""
        while self._entries and self._entries[0][0] <= stamp_ns:
            yield heapq.heappop(self._entries)

    def drop_after(self, stamp_ns: int) -> None:
        """Drop the readings beyond a stamp."""
        self._entries = [entry for entry in self._entries if entry[0] <= stamp_ns]
        heapq.heapify(self._entries)

    def take(self) -> list[Entry]:
        """Take all readings, in order of arrival."""
        entries, self._entries = self._entries, []
        return sorted(entries, key=lambda entry: entry[2])

    def ahead(self, stamp_ns: int) -> float:
        """Say how far the farthest reading lies beyond a stamp [s]; 0 if none waits."""
        if not self._entries:
            return 0.0
        return (max(entry[0] for entry in self._entries) - stamp_ns) * 1e-9


def refused_readings(
    stamps: Stamps,
    kinds: Ints,
    arrival: Ints,
    effect: Ints,
    n_waiting: int,
    last_ns: Mapping[int, int],
) -> Bools | None:
    """
    Find what a queue refuses of many readings, as a later one is of another clock; None if
    nothing. First `n_waiting` that were pushed before, then those of each kind in order of
    arrival; `arrival`, `effect`: samples before a reading comes, and before it takes effect.
    """
    refused = np.zeros(len(stamps), dtype=np.bool_)
    for kind in range(int(kinds.max(initial=-1)) + 1):
        own = np.flatnonzero(kinds == kind)
        n_old = int(np.searchsorted(own, n_waiting))
        new_ns = stamps[own[n_old:]]
        before_ns = np.concatenate(([last_ns.get(kind, -NEVER_NS)], new_ns[:-1]))
        for k in (np.flatnonzero(new_ns < before_ns - DISORDER_NS) + n_old).tolist():
            before, this = own[:k], own[k]
            is_other = stamps[before] > stamps[this] + DISORDER_NS
            refused[before[is_other & (effect[before] >= arrival[this])]] = True
    return refused if refused.any() else None
