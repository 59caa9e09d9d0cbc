# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the part of a bag that is read: from one time to another, by the stamps of its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..typing import Bools, Ints
from .columns import Block, RawMessages, Role
from .messages import pack
from .topics import Part


class Cut:
    """
    Leaves out of blocks what is outside a part.

    `topics` are those of the roles, by which serialized messages are told; `since_s` is where the
    first sample that was kept stands, since the bag's first one.
    """

    def __init__(self, path: Path, part: Part, topics: Mapping[Role, str]) -> None:
        self._path = path
        self._part = part
        self._roles = {topic: role for role, topic in topics.items()}
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
        keep = self._is_inside(block.accel_stamp_ns)
        by_role = {'accel': keep}
        n_before = np.concatenate(([0], np.cumsum(keep)))
        temperatures = {}
        for name, one in block.temperatures.items():
            own = by_role[name] = self._is_inside(one.stamp_ns)
            temperatures[name] = one._replace(
                stamp_ns=one.stamp_ns[own],
                celsius=one.celsius[own],
                after=n_before[one.after[own]],
            )
        if all(own.all() for own in by_role.values()):
            return block
        return replace(
            block,
            accel_stamp_ns=block.accel_stamp_ns[keep],
            accel=block.accel[keep],
            imu=block.imu and block.imu.take(np.flatnonzero(keep)),
            temperatures=temperatures,
            log_ns={role: log_ns[by_role[role]] for role, log_ns in block.log_ns.items()},
            raw=tuple(_chosen(one, by_role[self._roles[one.topic]]) for one in block.raw),
        )

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


def _chosen(messages: RawMessages, keep: Bools) -> RawMessages:
    size = np.diff(messages.ends, prepend=0)
    data, ends = pack(messages.data, (messages.ends - size)[keep], size[keep])
    return replace(messages, log_ns=messages.log_ns[keep], data=data, ends=ends)
