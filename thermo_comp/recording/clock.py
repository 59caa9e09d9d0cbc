# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns stamps on which no jump is a long one.

A clock that is set while it runs or a recorder that slept leaves a hole of years in the stamps,
and whatever walks a grid of time would walk it. After an hour without a reading nothing is known
of a unit's thermal state, so a longer jump, either way, becomes an hour.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import RecordingError
from ..typing import Ints
from .columns import Block

#: What a longer jump of the stamps becomes [ns].
LONGEST_PAUSE_NS = 3600 * 10**9
#: More jumps are no clock; and so many days need a message every so many seconds.
_MOST_JUMPS = 100
_SPARSE_NS, _SPARSEST_NS = 10 * 86400 * 10**9, 10 * 10**9


def without_jumps(blocks: Iterable[Block], path: Path) -> Iterator[Block]:
    """Move stamps behind a jump, all by the same; RecordingError for stamps that are no clock."""
    last_ns: int | None = None
    offset = 0
    n_jumps = n_messages = span_ns = 0
    for block in blocks:
        thermometers = block.temperatures.values()
        # Reading order; a reading stands before the sample that it counts for.
        places = [*(one.after for one in thermometers), np.arange(len(block))]
        stamps = np.concatenate([*(one.stamp_ns for one in thermometers), block.accel_stamp_ns])
        if not len(stamps):
            yield block
            continue
        order = np.argsort(np.concatenate(places), kind='stable')
        read: Ints = stamps[order]
        steps = np.diff(read, prepend=read[0] if last_ns is None else last_ns)
        is_jump = np.abs(steps) > LONGEST_PAUSE_NS
        moved = offset + np.cumsum(np.where(is_jump, LONGEST_PAUSE_NS - steps, 0))
        last_ns, offset = int(read[-1]), int(moved[-1])
        n_jumps += int(np.count_nonzero(is_jump))
        n_messages += len(read)
        span_ns += int(np.sum(np.where(is_jump, LONGEST_PAUSE_NS, np.maximum(steps, 0))))
        if n_jumps > _MOST_JUMPS:
            raise RecordingError(
                f'its stamps jump by more than an hour more than {_MOST_JUMPS} times', path
            )
        if span_ns > max(_SPARSE_NS, n_messages * _SPARSEST_NS):
            raise RecordingError(
                f'{n_messages} messages stamped over {span_ns * 1e-9 / 86400:.0f} days: '
                'no recording of a thermal test',
                path,
            )
        offsets = np.empty_like(moved)
        offsets[order] = moved
        parts = np.split(offsets, np.cumsum([len(one.after) for one in thermometers]))
        yield replace(
            block,
            accel_stamp_ns=block.accel_stamp_ns + parts[-1],
            temperatures={
                name: one._replace(stamp_ns=one.stamp_ns + by)
                for (name, one), by in zip(block.temperatures.items(), parts, strict=False)
            },
        )
