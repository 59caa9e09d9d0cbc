# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the queue of readings, ordered by stamps, that wait for a sample with a later stamp."""

import heapq
from collections.abc import Callable, Iterator
from typing import Final

from .lags import BOARD_INPUT

#: A waiting reading: stamp [ns], whether the thermometer is not the board's, name of the
#: thermometer, order of arrival, temperature [degC].
Entry = tuple[int, bool, str, int, float]
#: Number of waiting readings at which the oldest half is dropped: readings and samples have
#: different clocks, or no samples arrive.
PENDING_LIMIT: Final = 4096
#: If consecutive stamps of a sensor step back by more than this time [ns], the sensor's earlier
#: readings are taken to be from another clock.
DISORDER_NS: Final = 5_000_000_000
NEVER_NS: Final = 1 << 62  # a stamp later than any real stamp [ns]


class ReadingQueue:
    """Waiting readings in order of stamps; at equal stamps the board's reading is the first."""

    def __init__(self) -> None:
        self._entries: list[Entry] = []
        self._n_pushed = 0
        self._last_ns: dict[str, int] = {}  # stamp of the last received reading by thermometer

    @property
    def next_ns(self) -> int:
        """Stamp of the earliest waiting reading; `NEVER_NS` if none waits."""
        return self._entries[0][0] if self._entries else NEVER_NS

    def push(self, name: str, stamp_ns: int, celsius: float) -> list[str]:
        """Add a reading; return the thermometers of dropped readings (full queue, new clock)."""
        dropped = []
        last_ns, self._last_ns[name] = self._last_ns.get(name, -NEVER_NS), stamp_ns
        if stamp_ns < last_ns - DISORDER_NS:
            latest_ns = stamp_ns + DISORDER_NS
            dropped += self.keep(lambda entry: entry[2] != name or entry[0] <= latest_ns)
        if len(self) >= PENDING_LIMIT:
            oldest = self._n_pushed - PENDING_LIMIT // 2
            dropped += self.keep(lambda entry: entry[3] >= oldest)
        entry = (stamp_ns, name != BOARD_INPUT, name, self._n_pushed, celsius)
        heapq.heappush(self._entries, entry)
        self._n_pushed += 1
        return dropped

    def keep(self, is_kept: Callable[[Entry], bool]) -> list[str]:
        """Drop the readings for which `is_kept` is False; return the thermometer of each."""
        before, self._entries = self._entries, list(filter(is_kept, self._entries))
        heapq.heapify(self._entries)
        return [entry[2] for entry in before if not is_kept(entry)]

    def due(self, stamp_ns: int) -> Iterator[Entry]:
        """Remove and yield the readings up to a stamp, in order of stamps."""
        while self._entries and self._entries[0][0] <= stamp_ns:
            yield heapq.heappop(self._entries)

    def ahead(self, stamp_ns: int) -> float:
        """Return the time from a stamp to the latest waiting reading [s]; 0 if none waits."""
        return (max((entry[0] for entry in self._entries), default=stamp_ns) - stamp_ns) * 1e-9

    def __len__(self) -> int:
        return len(self._entries)
