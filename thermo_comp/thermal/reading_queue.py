# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the readings that wait for the sample at which they take effect, by their stamps."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from typing import Final

from .memory import BOARD_INPUT

#: (stamp [ns], whether it is not the board's, thermometer, order of arrival, degC).
Entry = tuple[int, bool, str, int, float]

#: More readings than this that wait mean that their clock is not the samples'.
PENDING_LIMIT: Final = 4096
#: A reading that comes after another of its sensor is stamped earlier by no more than this [ns],
#: or the other one was not of this clock.
DISORDER_NS: Final = 5_000_000_000
#: Later than any stamp.
NEVER_NS: Final = 1 << 62


class ReadingQueue:
    """
    Readings by stamp; of equal stamps the board first, then by name and arrival.

    So the detector, which the case reading wakes, decides with the newest of both.
    """

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        self._n_pushed = 0
        #: Stamp of the reading of each thermometer that arrived last.
        self._last_ns: dict[str, int] = {}

    @property
    def next_ns(self) -> int:
        """Stamp of the first reading; later than any where none waits."""
        return self._entries[0][0] if self._entries else NEVER_NS

    def push(self, name: str, stamp_ns: int, celsius: float) -> int:
        """
        Add a reading; return how many were refused: this one where too many wait, or those that
        wait with stamps which this one shows to be of another clock.
        """
        n_before = len(self._entries)
        last_ns, self._last_ns[name] = self._last_ns.get(name, -NEVER_NS), stamp_ns
        if stamp_ns < last_ns - DISORDER_NS:
            latest_ns = stamp_ns + DISORDER_NS
            self.keep(lambda entry: entry[2] != name or entry[0] <= latest_ns)
        n_refused = n_before - len(self._entries)
        if len(self._entries) >= PENDING_LIMIT:
            return 1
        entry = (stamp_ns, name != BOARD_INPUT, name, self._n_pushed, celsius)
        heapq.heappush(self._entries, entry)
        self._n_pushed += 1
        return n_refused

    def keep(self, is_kept: Callable[[Entry], bool]) -> None:
        """Drop all readings but some."""
        self._entries = [entry for entry in self._entries if is_kept(entry)]
        heapq.heapify(self._entries)

    def due(self, stamp_ns: int) -> Iterator[Entry]:
        """Take the readings up to a stamp, one by one."""
        while self._entries and self._entries[0][0] <= stamp_ns:
            yield heapq.heappop(self._entries)

    def ahead(self, stamp_ns: int) -> float:
        """Say how far the farthest reading lies beyond a stamp [s]; 0 if none waits."""
        if not self._entries:
            return 0.0
        return (max(entry[0] for entry in self._entries) - stamp_ns) * 1e-9

    def __len__(self) -> int:
        """Count the readings that wait."""
        return len(self._entries)
