# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns finding the records in decompressed MCAP bytes: with an index as a hint, or one by one.

The index is never trusted. What it points at must be message records that, together with the
few other records between them, tile the chunk without gap or overlap; where they do not, the
records are walked from the first to the last, a run of equally long ones at a time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..typing import Bytes, Ints
from .mcap_records import MESSAGE, MESSAGE_INDEX, PREFIX_BYTES, DamagedError
from .wire import field, gather

#: Bytes of a message record before its serialized message.
MESSAGE_HEAD_BYTES = 31
#: Log time and offset of one message, 8 bytes each.
_INDEX_ROW_BYTES = 16
_PREFIX = struct.Struct('<BQ')
_INDEX_HEAD = struct.Struct('<BQHI')
_NOWHERE = np.empty(0, np.int64)
#: So many records are walked singly before the lengths met are taken for the usual ones.
_PATIENCE = 16
_MAX_LENGTHS = 16
_LEAP_BYTES = 1 << 20
#: False candidates met in one leap before it is given up.
_MAX_LINKS = 256

#: Why a walk stopped, besides damage that is said in other words.
ENDS_EARLY = 'a record ends too early'
OTHER_RECORD = 'a record of another kind'
ZERO_OPCODE = 'a record has the opcode 0'

OnRecord = Callable[[int, bytes], None]


@dataclass(frozen=True, slots=True)
class Messages:
    """
    The message records of some bytes, by place.

    Attributes
    ----------
    at : ndarray of int64, shape (n,)
        Of each record's opcode.
    size : ndarray of int64, shape (n,)
        Of each serialized message [bytes]; it begins `MESSAGE_HEAD_BYTES` after `at`.
    channel : ndarray of uint16, shape (n,)
    log_ns : ndarray of int64, shape (n,)

    """

    at: Ints
    size: Ints
    channel: NDArray[np.uint16]
    log_ns: Ints


def locate(data: Bytes, index: memoryview, on_record: OnRecord) -> Messages:
    """
    Find all messages of a whole chunk.

    Parameters
    ----------
    data : ndarray of uint8
        The decompressed chunk.
    index : memoryview
        The message index records behind it; may be empty or wrong.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.

    Returns
    -------
    Messages
        In the order of their places.

    Raises
    ------
    DamagedError
        Bytes that are no sequence of records.

    """
    hinted = _indexed(index, len(data))
    if hinted is not None:
        messages = _checked(data, hinted, on_record, [(0, len(data))], [0])
        if messages is not None:
            return messages
    messages, end, reason = walk(data, on_record)
    if end != len(data):
        raise DamagedError(reason)
    return messages


def locate_run(
    data: Bytes, areas: list[tuple[int, int]], indexes: list[memoryview], on_record: OnRecord
) -> tuple[Messages, Ints] | None:
    """
    Find all messages of several whole chunks at once.

    Parameters
    ----------
    data : ndarray of uint8
        The decompressed chunks, in this order, perhaps with other bytes between them.
    areas : list of (int, int)
        Where each chunk begins and ends in `data`.
    indexes : list of memoryview
        The message index records behind each.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.

    Returns
    -------
    messages : Messages
        In the order of their places.
    first : ndarray of int64, shape (len(areas),)
        The first message of each chunk.
    None
        Where the chunks have to be taken one by one: any doubt about one of them.

    """
    columns: list[Ints] = []
    for (begin, _), index in zip(areas, indexes, strict=True):
        found = _index_columns(index)
        if not found:
            return None
        columns += [column + begin for column in found]
    offsets = np.sort(np.concatenate(columns), kind='stable')
    begins, ends = np.array(areas, np.int64).T
    first = np.searchsorted(offsets, begins)
    after = np.searchsorted(offsets, ends)
    if (first == after).any() or first[0] or (after[:-1] != first[1:]).any():
        return None
    if int(after[-1]) != len(offsets) or int(offsets[-1]) > len(data) - MESSAGE_HEAD_BYTES:
        return None
    messages = _checked(data, offsets, on_record, areas, first.tolist())
    return None if messages is None else (messages, first)


def _indexed(index: memoryview, size: int) -> Ints | None:
    """Offsets of all messages by the index records; None where these are not usable."""
    columns = _index_columns(index)
    if not columns:
        return None
    offsets = np.sort(np.concatenate(columns), kind='stable')
    if not len(offsets) or offsets[0] < 0 or offsets[-1] > size - MESSAGE_HEAD_BYTES:
        return None
    return offsets


def _index_columns(index: memoryview) -> list[Ints] | None:
    """Offsets of the messages by each index record; None where these are not usable."""
    columns: list[Ints] = []
    at = 0
    while at + _INDEX_HEAD.size <= len(index):
        opcode, content, _, length = _INDEX_HEAD.unpack_from(index, at)
        at += _INDEX_HEAD.size
        if opcode != MESSAGE_INDEX:
            raise DamagedError('what follows it is not its message index')
        if content != length + 6 or length % _INDEX_ROW_BYTES:
            return None
        if at + length > len(index):
            return None
        if length:
            # An offset that no chunk can have comes out negative.
            rows = (length // _INDEX_ROW_BYTES,)
            columns.append(np.ndarray(rows, '<i8', index, at + 8, (_INDEX_ROW_BYTES,)))
        at += length
    return columns if at == len(index) else None


def _checked(
    data: Bytes, at: Ints, on_record: OnRecord, areas: list[tuple[int, int]], first: list[int]
) -> Messages | None:
    """
    Read the messages at these places if they tile each area with what is between them.

    Each area has messages; those of the area k begin with `first[k]`.
    """
    head = gather(data, at, MESSAGE_HEAD_BYTES)
    # Unsigned on purpose: a length that is too small wraps around to one that is too large.
    length = field(head, 1, '<u8') - np.uint64(MESSAGE_HEAD_BYTES - PREFIX_BYTES)
    if int(np.max(length)) > len(data) or (field(head, 0, 'u1') != MESSAGE).any():
        return None
    size = length.view(np.int64)
    ends = at + size
    ends += MESSAGE_HEAD_BYTES
    between = at[1:] - ends[:-1]
    if (between < 0).any():
        return None
    heads = np.array(first[1:], np.int64)
    between[heads - 1] = 0
    breaks = np.flatnonzero(between)
    gaps = list(zip(ends[breaks].tolist(), at[breaks + 1].tolist(), strict=True))
    last = [*first[1:], len(at)]
    for (begin, end), low, high in zip(areas, first, last, strict=True):
        stop = int(ends[high - 1])
        if stop > end:
            return None
        gaps += [(begin, int(at[low])), (stop, end)]
    gaps.sort()
    found: list[tuple[int, bytes]] = []
    for begin, end in gaps:
        if begin == end:
            continue
        extra, stop, _ = walk(data[begin:end], lambda *record: found.append(record))
        if len(extra.at) or stop != end - begin:
            return None
    for record in found:
        on_record(*record)
    return _messages(at, size, head)


def _messages(at: Ints, size: Ints, head: NDArray[np.void]) -> Messages:
    log_ns = field(head, 15, '<i8').astype(np.int64)
    if len(log_ns) and int(np.min(log_ns)) < 0:
        raise DamagedError('a message has a log time beyond the year 2262')
    # Copied: each role looks at all of them.
    return Messages(at, size, field(head, 9, '<u2').astype(np.uint16), log_ns)


def walk(
    data: Bytes, on_record: OnRecord, only: frozenset[int] | None = None
) -> tuple[Messages, int, str]:
    """
    Go from record to record as far as they are whole.

    Parameters
    ----------
    data : ndarray of uint8
        The bytes.
    on_record : callable of (int, bytes)
        Is given opcode and content of every record that is no message.
    only : frozenset of int, optional
        Stop before a record with another opcode.

    Returns
    -------
    messages : Messages
    end : int
        Where the first record begins that is not whole or not valid; the length of `data` where
        all are.
    reason : str
        What is wrong with that record.

    Raises
    ------
    DamagedError
        A message with an impossible time.

    """
    view = data.data
    runs: list[Ints] = []
    singles: list[int] = []
    lengths: set[int] = set()
    at, n_single, n_before_leap = 0, 0, _PATIENCE
    reason = ''
    while at < len(data):
        if at + PREFIX_BYTES > len(data):
            reason = ENDS_EARLY
            break
        opcode, length = _PREFIX.unpack_from(view, at)
        end = at + PREFIX_BYTES + length
        if opcode and only is not None and opcode not in only:
            reason = OTHER_RECORD
        else:
            reason = _fault(opcode, length, end > len(data))
        if reason:
            break
        if opcode != MESSAGE:
            on_record(opcode, bytes(view[at + PREFIX_BYTES : end]))
            at = end
            continue
        singles.append(at)
        at = end
        n_single += 1
        if len(lengths) < _MAX_LENGTHS:
            lengths.add(length)
        if n_single >= n_before_leap:
            places, at = _leap(data, at, lengths)
            runs += [np.array(singles, np.int64), places]
            singles, n_single = [], 0
            n_before_leap = _PATIENCE if len(places) > n_before_leap else 2 * n_before_leap
    runs.append(np.array(singles, np.int64))
    places = np.concatenate(runs)
    head = gather(data, places, MESSAGE_HEAD_BYTES)
    size = field(head, 1, '<i8') - (MESSAGE_HEAD_BYTES - PREFIX_BYTES)
    return _messages(places, size, head), at, reason


def _fault(opcode: int, length: int, is_beyond: bool) -> str:
    if opcode == 0:
        return ZERO_OPCODE
    if opcode == MESSAGE and length < MESSAGE_HEAD_BYTES - PREFIX_BYTES:
        return f'a message record has {length} bytes'
    return ENDS_EARLY if is_beyond else ''


def _leap(data: Bytes, at: int, lengths: set[int]) -> tuple[Ints, int]:
    """
    Find the message records from here on whose lengths have been met before, all at once.

    Whatever looks like the front of such a record is a candidate. Those that form a chain, each
    where the one before it ends, are the records; candidates inside a record are no records.

    Parameters
    ----------
    data : ndarray of uint8
        The bytes.
    at : int
        Where a record begins.
    lengths : set of int
        Lengths of the contents of message records.

    Returns
    -------
    places : ndarray of int64, shape (n,)
        Of the records; perhaps none.
    end : int
        Where the last of them ends.

    """
    stop = min(at + _LEAP_BYTES, len(data) - PREFIX_BYTES)
    places = np.flatnonzero(data[at:stop] == MESSAGE) + at if stop > at else _NOWHERE
    found = gather(data, places + 1, 8).view('<u8')
    is_known = np.zeros(len(places), np.bool_)
    for length in lengths:
        is_known |= found == length
    places, ends = places[is_known], found[is_known].astype(np.int64)
    ends += places + PREFIX_BYTES
    is_whole = ends <= len(data)
    places, ends = places[is_whole], ends[is_whole]
    chain: list[Ints] = []
    first = 0
    while len(chain) < _MAX_LINKS and first < len(places) and places[first] == at:
        breaks = np.flatnonzero(places[first + 1 :] != ends[first:-1])
        last = first + int(breaks[0]) if len(breaks) else len(places) - 1
        chain.append(places[first : last + 1])
        at = int(ends[last])
        first = int(np.searchsorted(places, at))
    return (np.concatenate(chain) if chain else _NOWHERE), at
