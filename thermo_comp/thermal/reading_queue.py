# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the readings that wait for the sample at which they take effect, in the order of their stamps.

"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Final

#: (stamp [ns], kind: 0 board, 1 case, order of arrival, degC).
Entry = tuple[int, int, int, float]

#: More readings than this that wait mean that their clock is not the samples'.
PENDING_LIMIT: Final = 4096
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

    @property
    def next_ns(self) -> int:
        """
        Stamp of the first reading; later than any where none waits.

        """
        return self._entries[0][0] if self._entries else NEVER_NS

    def push(self, stamp_ns: int, kind: int, celsius: float) -> bool:
        """
        Add a reading; False where too many wait already.

        """
        if len(self._entries) >= PENDING_LIMIT:
            return False
        heapq.heappush(self._entries, (stamp_ns, kind, self._n_pushed, celsius))
        self._n_pushed += 1
        return True

    def due(self, stamp_ns: int) -> Iterator[Entry]:
        """
        Take the readings up to a stamp, one by one.

        """
        while self._entries and self._entries[0][0] <= stamp_ns:
            yield heapq.heappop(self._entries)

    def drop_after(self, stamp_ns: int) -> None:
        """
        Drop the readings beyond a stamp.

        """
        self._entries = [entry for entry in self._entries if entry[0] <= stamp_ns]
        heapq.heapify(self._entries)

    def take(self) -> list[Entry]:
        """
        Take all readings, in no order.

        """
        entries, self._entries = self._entries, []
        return entries

    def ahead(self, stamp_ns: int) -> float:
        """
        Say how far the farthest reading lies beyond a stamp [s]; 0 if none waits.

        """
        if not self._entries:
            return 0.0
        return (max(entry[0] for entry in self._entries) - stamp_ns) * 1e-9
