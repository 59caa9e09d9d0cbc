# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the serialized layout of stamped messages: many messages to columns in a few array passes.

All three input types are a std_msgs/Header followed by nothing but float64 numbers. In CDR::

    0   encapsulation: 00, endianness (0 big, 1 little), options
    4   stamp: int32 seconds, uint32 nanoseconds
    12  uint32 length of frame_id with its final NUL, then its characters
    4 + align8(12 + length)   the float64 numbers

and in ROS 1 a sequence number stands in place of the encapsulation, the string has no NUL and
nothing is aligned. Only `frame_id` makes the size vary: messages that are alike are gathered as
rows of bytes, of which stamps and numbers are views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import RecordingError
from ..typing import Bytes, Floats, Ints
from .topics import IMU, TEMPERATURE, VECTOR3_STAMPED

Encoding = Literal['cdr', 'ros1']

#: How many float64 numbers follow the header of each type.
N_NUMBERS = {VECTOR3_STAMPED: 3, IMU: 37, TEMPERATURE: 2}

HEAD_BYTES = 16
_MAX_PADDING = 7
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Stamped:
    """Decoded messages of one topic, shape (n,) and `numbers` (n, k)."""

    stamp_ns: Ints
    numbers: Floats
    frame: NDArray[Any]


def gather(buffer: Bytes, at: Ints, n_bytes: int) -> NDArray[Any]:
    """
    Copy `n_bytes` from each position, at least so far before the buffer's end, as rows of void.
    """
    kind = np.dtype((np.void, n_bytes))
    if len(at) == 0:
        return np.empty(0, kind)
    everywhere: NDArray[Any] = np.ndarray(
        (buffer.size - n_bytes + 1,), kind, buffer.data, strides=(1,)
    )
    return everywhere[at]


def scatter(buffer: Bytes, at: Ints, rows: NDArray[Any]) -> None:
    """Copy rows to positions of a buffer, the inverse of `gather`."""
    if len(at):
        everywhere: NDArray[Any] = np.ndarray(
            (buffer.size - rows.itemsize + 1,), rows.dtype, buffer.data, strides=(1,)
        )
        everywhere[at] = rows


def field(rows: NDArray[Any], offset: int, kind: str) -> NDArray[Any]:
    """Look at one number of each gathered row, by its offset [bytes] and numpy type: a view."""
    if len(rows) == 0:
        return np.empty(0, kind)
    view: NDArray[Any] = np.ndarray(
        (len(rows),), kind, rows.data, offset=offset, strides=(rows.itemsize,)
    )
    return view


def decode_stamped(
    buffer: Bytes,
    start: Ints,
    size: Ints,
    kind: str,
    encoding: Encoding,
    n_wanted: int | None = None,
) -> Stamped:
    """
    Decode messages that are a header and float64 numbers, each at `start` of the buffer.

    `kind` is a key of `N_NUMBERS`; with `n_wanted` only so many leading numbers are taken. Raises
    RecordingError for bytes that are no message of that type.
    """
    n, n_numbers = len(start), N_NUMBERS[kind]
    n_taken = n_wanted or n_numbers
    if not n:
        return Stamped(np.empty(0, np.int64), np.empty((0, n_taken)), np.empty(0, 'S1'))
    if int(np.min(size)) < HEAD_BYTES + 8 * n_numbers:
        raise _misfit(kind)
    rows = gather(buffer, start, int(size[0]) if (size == size[0]).all() else HEAD_BYTES)
    # Usually they are alike: of one length, in one byte order, with one length of the frame.
    for key in (size, field(rows, 0, 'u2'), field(rows, 12, 'u4')):
        if (key != key[0]).any() and (encoding == 'cdr' or key.dtype != np.uint16):
            found = Stamped(np.empty(n, np.int64), np.empty((n, n_taken)), np.empty(n, object))
            order = np.argsort(key, kind='stable')
            for own in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
                part = decode_stamped(buffer, start[own], size[own], kind, encoding, n_wanted)
                found.stamp_ns[own], found.numbers[own] = part.stamp_ns, part.numbers
                found.frame[own] = part.frame
            return found
    endian = '<'
    if encoding == 'cdr':
        representation = int(field(rows, 0, '>u2')[0])
        if representation > 1:
            raise RecordingError(
                f'serialized with representation {representation:#06x}, '
                'only plain CDR (0 or 1) is read'
            )
        endian = '<' if representation else '>'
    frame_size = int(field(rows, 12, f'{endian}u4')[0])
    at = frame_size + HEAD_BYTES
    if encoding == 'cdr':
        # (12 + length + 7) // 8 * 8, counted from after the encapsulation
        at = (frame_size + (HEAD_BYTES + 3) & -8) + 4
    length = rows.dtype.itemsize
    if not 0 <= length - (at + 8 * n_numbers) <= _MAX_PADDING:
        raise _misfit('a header and its numbers')
    stamp_ns = field(rows, 4, f'{endian}i4' if encoding == 'cdr' else '<u4').astype(np.int64)
    stamp_ns *= _NS
    stamp_ns += field(rows, 8, f'{endian}u4')
    values: Floats = np.ndarray(
        (n, n_taken), f'{endian}f8', rows.data, offset=at, strides=(length, 8)
    )
    frame = field(rows, HEAD_BYTES, f'S{frame_size}') if frame_size else np.zeros(n, 'S1')
    return Stamped(stamp_ns, values.astype(np.float64, 'C'), frame)


def _misfit(kind: str) -> RecordingError:
    return RecordingError(f'damaged message: its size does not fit {kind}')


def frame_runs(frame: NDArray[Any]) -> list[tuple[int, str]]:
    """Find the first row and the text of each run of equal `frame_id`."""
    changes = np.flatnonzero(frame[1:] != frame[:-1]) + 1
    rows = [0, *changes.tolist()] if len(frame) else []
    return [(row, frame[row].decode('utf-8', 'replace')) for row in rows]
