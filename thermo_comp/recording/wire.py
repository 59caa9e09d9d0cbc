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
nothing is aligned. Only `frame_id` makes the size vary, so two gathers per message (the fixed
head, then the numbers) read any mixture of lengths; short messages of one length, the usual case,
are gathered as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import RecordingError
from ..typing import Bytes, Floats, Ints
from .topics import IMU, TEMPERATURE, VECTOR3_STAMPED

Encoding = Literal['cdr', 'ros1']
Size = TypeVar('Size', int, Ints)

#: How many float64 numbers follow the header of each type.
N_NUMBERS = {VECTOR3_STAMPED: 3, IMU: 37, TEMPERATURE: 2}

HEAD_BYTES = 16
#: Messages up to this length are gathered as a whole where all have the same.
_SHORT_BYTES = 128
_MAX_PADDING = 7
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Stamped:
    """
    Decoded messages of one topic, shape (n,) and `numbers` (n, k).

    The characters of `frame_id` stand at `frame_start` of the buffer; `rows` are the messages,
    where they and their `frame_id` are equally long and short.
    """

    stamp_ns: Ints
    numbers: Floats
    frame_start: Ints
    frame_size: Ints
    rows: NDArray[Any] | None = None


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
    n_numbers = N_NUMBERS[kind]
    if len(start) and int(np.min(size)) < HEAD_BYTES + 8 * n_numbers:
        raise _misfit(kind)
    length = int(size[0]) if len(size) else 0
    is_short = length <= _SHORT_BYTES and bool((size == length).all())
    head = gather(buffer, start, length if is_short and length else HEAD_BYTES)
    orders = _byte_orders(head) if encoding == 'cdr' else ['<']
    if len(orders) == 1:
        return _decode(buffer, start, size, head, orders[0], n_numbers, encoding, n_wanted)
    n = len(start)
    stamp_ns, frame_start, frame_size = np.empty((3, n), np.int64)
    numbers = np.empty((n, n_wanted or n_numbers))
    joined = Stamped(stamp_ns, numbers, frame_start, frame_size)
    is_little = field(head, 1, 'u1') == 1
    for own in (np.flatnonzero(is_little), np.flatnonzero(~is_little)):
        part = decode_stamped(buffer, start[own], size[own], kind, encoding, n_wanted)
        for name in ('stamp_ns', 'numbers', 'frame_start', 'frame_size'):
            getattr(joined, name)[own] = getattr(part, name)
    return joined


def _byte_orders(head: NDArray[Any]) -> list[str]:
    first = field(head, 0, '>u2')
    if not len(first):
        return ['<']
    low = high = int(first[0])
    # Equal in any byte order, which saves turning each.
    same = field(head, 0, 'u2')
    if (same != same[0]).any():
        low, high = int(first.min()), int(first.max())
    if high > 1:
        raise RecordingError(
            f'serialized with representation {high:#06x}, only plain CDR (0 or 1) is read'
        )
    return ['<' if high else '>'] if low == high else ['<', '>']


def _decode(
    buffer: Bytes,
    start: Ints,
    size: Ints,
    head: NDArray[Any],
    order: str,
    n_numbers: int,
    encoding: Encoding,
    n_wanted: int | None,
) -> Stamped:
    seconds = field(head, 4, f'{order}i4' if encoding == 'cdr' else '<u4')
    stamp_ns = seconds.astype(np.int64)
    stamp_ns *= _NS
    stamp_ns += field(head, 8, f'{order}u4')
    n_taken = n_numbers if n_wanted is None else n_wanted
    sizes = field(head, 12, f'{order}u4')
    if head.dtype.itemsize > HEAD_BYTES and (sizes == sizes[0]).all():
        first_size, length = int(sizes[0]), head.dtype.itemsize
        at = int(_body(first_size, encoding))
        if not 0 <= length - (at + 8 * n_numbers) <= _MAX_PADDING:
            raise _misfit('a header and its numbers')
        values: Floats = np.ndarray(
            (len(head), n_taken), f'{order}f8', head.data, offset=at, strides=(length, 8)
        )
        frame_size = np.broadcast_to(np.int64(first_size), len(head))
        return Stamped(
            stamp_ns, values.astype(np.float64, 'C'), start + HEAD_BYTES, frame_size, head
        )
    frame_size = sizes.astype(np.int64)
    body = _body(frame_size, encoding)
    # Unsigned on purpose: too few bytes wrap around to far too many.
    padding = (size - (body + 8 * n_numbers)).view(np.uint64)
    if len(padding) and int(np.max(padding)) > _MAX_PADDING:
        raise _misfit('a header and its numbers')
    body += start
    numbers = gather(buffer, body, 8 * n_taken).view(f'{order}f8').reshape(len(start), n_taken)
    return Stamped(
        stamp_ns, numbers.astype(np.float64, copy=False), start + HEAD_BYTES, frame_size
    )


def _body(frame_size: Size, encoding: Encoding) -> Size:
    """Say where the numbers begin in a message."""
    if encoding != 'cdr':
        return frame_size + HEAD_BYTES
    # (12 + length + 7) // 8 * 8, counted from after the encapsulation
    return (frame_size + (HEAD_BYTES + 3) & -8) + 4


def _misfit(kind: str) -> RecordingError:
    return RecordingError(f'damaged message: its size does not fit {kind}')


def frame_runs(buffer: Bytes, messages: Stamped) -> list[tuple[int, str]]:
    """Find the first row and the text of each run of equal `frame_id`."""
    start, size = messages.frame_start, messages.frame_size
    if not len(start):
        return []
    first_size = int(size[0])
    if first_size == 0 and not size.any():
        return [(0, '')]
    if messages.rows is not None and _all_equal(messages.rows, HEAD_BYTES, first_size):
        at = int(start[0])
        return [(0, _text(buffer[at : at + first_size].tobytes()))]
    if (size == first_size).all():
        texts = gather(buffer, start, first_size)
        if _all_equal(texts, 0, first_size):
            return [(0, _text(texts[0].tobytes()))]
        rows: list[bytes] = [row.tobytes() for row in texts]
    else:
        rows = [
            buffer[at : at + length].tobytes()
            for at, length in zip(start.tolist(), size.tolist(), strict=True)
        ]
    runs: list[tuple[int, str]] = []
    before: bytes | None = None
    for row, characters in enumerate(rows):
        if characters != before:
            text = _text(characters)
            if not runs or runs[-1][1] != text:
                runs.append((row, text))
            before = characters
    return runs


def _all_equal(rows: NDArray[Any], offset: int, size: int) -> bool:
    """Tell whether all rows have the same bytes at a place, compared word by word."""
    end = offset + size
    while offset < end:
        width = next(w for w in (8, 4, 2, 1) if offset + w <= end)
        words = field(rows, offset, f'u{width}')
        if (words != words[0]).any():
            return False
        offset += width
    return True


def _text(characters: bytes) -> str:
    return characters.rstrip(b'\0').decode('utf-8', 'replace')
