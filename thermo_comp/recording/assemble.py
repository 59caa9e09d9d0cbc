# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the step from decoded runs of messages to Blocks of limited size.

Whatever reads a storage yields `Part` after `Part`. Within and across parts, the rank of a
message is its place in the reading order over all topics; a Block's ``board_after`` and
``case_after`` are nothing but counts of smaller ranks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..typing import Bytes, Floats, Ints
from .columns import Block, ImuColumns, RawMessages, Role
from .wire import IMU_ACCELERATION, imu_columns

#: A block is given out once it has so many messages, where nobody wants another number; a chunk
#: of usual size has more.
BLOCK_MESSAGES = 1 << 13


@dataclass(slots=True)
class Rows:
    """
    Messages of one role in reading order.

    Attributes
    ----------
    rank : ndarray of int64, shape (n,)
        Strictly increasing; comparable with every other role and part of the same reading.
    stamp_ns, log_ns : ndarray of int64, shape (n,)
    numbers : ndarray, shape (n, k)
    frames : list of (int, str)
        First row and text of each run of equal `frame_id`.
    raw : tuple of (ndarray of uint8, ndarray of int64) or None
        The serialized messages' bytes and the end of each, where they were asked for.

    """

    rank: Ints
    stamp_ns: Ints
    log_ns: Ints
    numbers: Floats
    frames: list[tuple[int, str]]
    raw: tuple[Bytes, Ints] | None = None

    def cut(self, begin: int, end: int) -> Rows:
        """Take the rows from `begin` up to `end` as views."""
        before = [text for row, text in self.frames if row <= begin][-1:]
        later = [(row - begin, text) for row, text in self.frames if begin < row < end]
        raw = self.raw
        if raw is not None:
            first = int(raw[1][begin - 1]) if begin else 0
            last = int(raw[1][end - 1]) if end else 0
            raw = (raw[0][first:last], raw[1][begin:end] - first)
        return Rows(
            self.rank[begin:end],
            self.stamp_ns[begin:end],
            self.log_ns[begin:end],
            self.numbers[begin:end],
            [(0, text) for text in before if end > begin] + later,
            raw,
        )


Part = dict[Role, Rows]


def join_rows(pieces: list[Rows], width: int) -> Rows:
    """
    Put rows of one role behind each other.

    Parameters
    ----------
    pieces : list of Rows
        In reading order.
    width : int
        Numbers per row where there is no piece at all.

    """
    if len(pieces) == 1:
        return pieces[0]
    if not pieces:
        none = np.empty(0, np.int64)
        return Rows(none, none, none, np.empty((0, width)), [])
    frames: list[tuple[int, str]] = []
    first = 0
    for piece in pieces:
        for row, text in piece.frames:
            if not frames or frames[-1][1] != text:
                frames.append((first + row, text))
        first += len(piece.rank)
    raws = [piece.raw for piece in pieces if piece.raw is not None]
    raw = None
    if raws:
        begins = np.cumsum([0] + [len(data) for data, _ in raws])
        raw = (
            np.concatenate([data for data, _ in raws]),
            np.concatenate([ends + begin for (_, ends), begin in zip(raws, begins, strict=False)]),
        )
    return Rows(
        np.concatenate([piece.rank for piece in pieces]),
        np.concatenate([piece.stamp_ns for piece in pieces]),
        np.concatenate([piece.log_ns for piece in pieces]),
        np.concatenate([piece.numbers for piece in pieces]),
        frames,
        raw,
    )


def assemble(
    parts: Iterable[Part], *, is_imu: bool, names: dict[Role, tuple[str, str]], n_messages: int = 0
) -> Iterator[Block]:
    """
    Gather parts into blocks.

    Parameters
    ----------
    parts : iterable of Part
        In reading order.
    is_imu : bool
        Whether the accelerometer's messages are sensor_msgs/Imu.
    names : dict of role to (str, str)
        Topic and type per role, for the raw messages.
    n_messages : int, optional
        A block is given out once it has so many; 0 = `BLOCK_MESSAGES`.

    """
    waiting: list[Part] = []
    n_waiting = 0
    n_wanted = n_messages or BLOCK_MESSAGES
    for part in parts:
        waiting.append(part)
        n_waiting += sum(len(rows.rank) for rows in part.values())
        if n_waiting >= n_wanted:
            yield from _blocks(waiting, is_imu, names)
            waiting, n_waiting = [], 0
    if n_waiting:
        yield from _blocks(waiting, is_imu, names)


def _blocks(
    parts: list[Part], is_imu: bool, names: dict[Role, tuple[str, str]]
) -> Iterator[Block]:
    accel = join_rows([part['accel'] for part in parts if 'accel' in part], 37 if is_imu else 3)
    board = join_rows([part['board'] for part in parts if 'board' in part], 1)
    case = join_rows([part['case'] for part in parts if 'case' in part], 1)
    starts = [row for row, _ in accel.frames] or [0]
    ends = [*starts[1:], len(accel.rank)]
    board_from = case_from = 0
    for begin, end in zip(starts, ends, strict=True):
        if end < len(accel.rank):
            board_to = int(np.searchsorted(board.rank, accel.rank[end]))
            case_to = int(np.searchsorted(case.rank, accel.rank[end]))
        else:
            board_to, case_to = len(board.rank), len(case.rank)
        yield _block(
            {
                'accel': accel.cut(begin, end),
                'board': board.cut(board_from, board_to),
                'case': case.cut(case_from, case_to),
            },
            is_imu,
            names,
        )
        board_from, case_from = board_to, case_to


def _block(part: Part, is_imu: bool, names: dict[Role, tuple[str, str]]) -> Block:
    accel, board, case = part['accel'], part['board'], part['case']
    return Block(
        accel_stamp_ns=accel.stamp_ns,
        accel_log_ns=accel.log_ns,
        accel=np.ascontiguousarray(accel.numbers[:, IMU_ACCELERATION])
        if is_imu
        else accel.numbers,
        frame_id=accel.frames[0][1] if accel.frames else '',
        imu=imu_columns(accel.numbers) if is_imu else None,
        board_stamp_ns=board.stamp_ns,
        board_log_ns=board.log_ns,
        board=board.numbers[:, 0],
        board_after=np.searchsorted(accel.rank, board.rank).astype(np.int64),
        case_stamp_ns=case.stamp_ns,
        case_log_ns=case.log_ns,
        case=case.numbers[:, 0],
        case_after=np.searchsorted(accel.rank, case.rank).astype(np.int64),
        raw=tuple(
            RawMessages(*names[role], rows.log_ns, *rows.raw)
            for role, rows in part.items()
            if rows.raw is not None and len(rows.rank)
        ),
    )


def join_blocks(blocks: Iterable[Block], is_imu: bool) -> Block:
    """
    Put blocks behind each other as one.

    Parameters
    ----------
    blocks : iterable of Block
        In reading order.
    is_imu : bool
        Whether the columns of sensor_msgs/Imu are there even if no block is.

    Returns
    -------
    Block
        With the `frame_id` of the first block that has accelerometer messages.

    """
    pieces = list(blocks)
    if len(pieces) == 1:
        return pieces[0]
    if not pieces:
        none = join_rows([], 37 if is_imu else 3)
        return _block(
            {'accel': none, 'board': join_rows([], 1), 'case': join_rows([], 1)}, is_imu, {}
        )
    begins = np.cumsum([0] + [len(block) for block in pieces])[:-1].tolist()
    shifted: dict[str, list[Ints]] = {
        name: [getattr(block, name) + begin for block, begin in zip(pieces, begins, strict=True)]
        for name in ('board_after', 'case_after')
    }

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate(shifted.get(name) or [getattr(block, name) for block in pieces])

    imus = [block.imu for block in pieces if block.imu is not None]
    names = [field.name for field in fields(Block) if field.name not in _NOT_COLUMNS]
    return Block(
        frame_id=next((block.frame_id for block in pieces if len(block)), ''),
        imu=ImuColumns(
            *(
                np.concatenate([getattr(imu, field.name) for imu in imus])
                for field in fields(ImuColumns)
            )
        )
        if imus
        else None,
        raw=tuple(raw for block in pieces for raw in block.raw),
        **{name: joined(name) for name in names},
    )


_NOT_COLUMNS = {'frame_id', 'imu', 'raw'}
