# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the part of a bag that is read: from one time to another, by the stamps of its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import inf
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..typing import Bools, Ints
from .columns import Block
from .topics import Part


class Cut:
    """
    Leaves out of blocks what is outside a part.

    `since_s` is where the first sample that was kept stands, since the bag's first one.
    """

    def __init__(self, path: Path, part: Part) -> None:
        self._path = path
        self._part = part
        self._first_ns: int | None = None
        self.since_s = 0.0

    def blocks(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Cut blocks; RecordingError where no sample is left."""
        n_kept, last_ns = 0, 0
        self._first_ns = None
        for block in blocks:
            if len(block):
                last_ns = int(block.accel_stamp_ns[-1])
                if self._first_ns is None:
                    self._first_ns = int(block.accel_stamp_ns[0])
            left = self._cut(block)
            if len(left) and not n_kept:
                self.since_s = (int(left.accel_stamp_ns[0]) - (self._first_ns or 0)) * 1e-9
            n_kept += len(left)
            if left.n_messages:
                yield left
        if not n_kept and self._first_ns is not None:
            raise RecordingError(
                f'no sample is in {self._part}: they are stamped from {self._first_ns * 1e-9:.3f} '
                f'to {last_ns * 1e-9:.3f}, which is {(last_ns - self._first_ns) * 1e-9:.1f} s',
                self._path,
            )

    def _cut(self, block: Block) -> Block:
        inside = {name: self._is_inside(one.stamp_ns) for name, one in block.temperatures.items()}
        inside['accel'] = self._is_inside(block.accel_stamp_ns)
        return block if all(own.all() for own in inside.values()) else block.take(inside)

    def _is_inside(self, stamp_ns: Ints) -> Bools:
        if self._first_ns is None and not self._part.is_stamped:
            # Before the first sample.
            return np.full(len(stamp_ns), self._part.begin is None)
        origin_ns = 0 if self._part.is_stamped else self._first_ns or 0
        begin, end = (
            default if limit is None else origin_ns + round(limit * 1e9)
            for limit, default in ((self._part.begin, -inf), (self._part.end, inf))
        )
        return (stamp_ns >= begin) & (stamp_ns < end)
