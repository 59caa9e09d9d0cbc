# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns log-time order across chunks whose time spans overlap.

Chunks come in the order of their first log time. Once the next one begins at time t, whatever
was read before t is final: nothing that is still to come can stand before it. So only the
messages of chunks that overlap at one instant are ever held back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ..typing import Ints
from .assemble import Part, Rows, join_rows
from .columns import Role
from .decode import pack
from .mcap_records import DamagedError

#: Messages that are held back at most, times the numbers in each.
_MAX_HELD = 1 << 25


def in_log_order(parts: Iterable[tuple[Part, int | None]]) -> Iterator[Part]:
    """
    Merge overlapping parts.

    Parameters
    ----------
    parts : iterable of (Part, int or None)
        Rows ranked by their place in the file, and the first log time of what comes next (None
        at the end).

    Yields
    ------
    Part
        In order of log time and, for equal ones, of the place in the file; ranked from 0.

    Raises
    ------
    DamagedError
        So many chunks overlap that they cannot be merged in bounded memory.

    """
    held: list[Part] = []
    first_ns: int | None = None
    n_held = 0
    for part, next_ns in parts:
        held.append(part)
        for rows in part.values():
            n_held += rows.numbers.size
            earliest = int(np.min(rows.log_ns))
            first_ns = earliest if first_ns is None else min(first_ns, earliest)
        if first_ns is None:
            held = []
        elif next_ns is None or next_ns > first_ns:
            done, kept = _split(_merged(held), next_ns)
            yield done
            held = [kept] if kept else []
            first_ns = min((int(rows.log_ns[0]) for rows in kept.values()), default=None)
            n_held = sum(rows.numbers.size for rows in kept.values())
        if n_held > _MAX_HELD:
            raise DamagedError(
                'too many of its chunks overlap in time to be read in bounded memory; '
                'sort it by time with another tool'
            )


def _merged(parts: list[Part]) -> Part:
    """Join the rows of each role in order of log time and place."""
    roles: list[Role] = sorted({role for part in parts for role in part})
    merged: Part = {}
    for role in roles:
        rows = join_rows([part[role] for part in parts if role in part], 0)
        order = np.lexsort((rows.rank, rows.log_ns))
        is_sorted = (order[1:] > order[:-1]).all()
        merged[role] = rows if is_sorted else _taken(rows, order)
    return merged


def _split(part: Part, next_ns: int | None) -> tuple[Part, Part]:
    """Part what stands before a time, ranked from 0, from the rest."""
    done: Part = {}
    kept: Part = {}
    for role, rows in part.items():
        n_rows = len(rows.rank)
        n_done = n_rows if next_ns is None else int(np.searchsorted(rows.log_ns, next_ns))
        if n_done:
            done[role] = rows.cut(0, n_done)
        if n_done < n_rows:
            kept[role] = rows.cut(n_done, n_rows)
    log_ns = np.concatenate([rows.log_ns for rows in done.values()])
    place = np.concatenate([rows.rank for rows in done.values()])
    rank = np.empty(len(place), np.int64)
    rank[np.lexsort((place, log_ns))] = np.arange(len(place))
    begin = 0
    for rows in done.values():
        end = begin + len(rows.rank)
        rows.rank = rank[begin:end]
        begin = end
    return done, kept


def _taken(rows: Rows, order: Ints) -> Rows:
    starts = np.array([row for row, _ in rows.frames], np.int64)
    run = np.searchsorted(starts, order, side='right') - 1
    changes = np.flatnonzero(np.diff(run, prepend=-1))
    raw = rows.raw
    if raw is not None:
        size = np.diff(raw[1], prepend=0)
        raw = pack(raw[0], (raw[1] - size)[order], size[order])
    return Rows(
        rows.rank[order],
        rows.stamp_ns[order],
        rows.log_ns[order],
        rows.numbers[order],
        [(row, rows.frames[run[row]][1]) for row in changes.tolist()],
        raw,
    )
