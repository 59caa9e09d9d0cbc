# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from columns to MCAP message records: one structured array per call, no loop.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .columns import Floats, ImuColumns, Ints
from .wire import Bytes, gather, scatter

OPCODE_MESSAGE = 5


def layout(n_bytes: int, /, **fields: tuple[Any, int]) -> np.dtype[Any]:
    """
    Describe rows of bytes.

    Parameters
    ----------
    size : int
        Bytes of a row.
    **fields : (type, int)
        Type and offset of each field.

    Returns
    -------
    dtype

    """
    content: Any = {
        'names': list(fields),
        'formats': [kind for kind, _ in fields.values()],
        'offsets': [offset for _, offset in fields.values()],
        'itemsize': n_bytes,
    }
    described: np.dtype[Any] = np.dtype(content)
    return described


#: Opcode, length, channel, sequence, log time, publish time.
RECORD_HEAD = layout(
    31,
    opcode=('u1', 0),
    size=('<u8', 1),
    channel=('<u2', 9),
    sequence=('<u4', 11),
    log=('<u8', 15),
    publish=('<u8', 23),
)
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Records:
    """
    Message records of one channel.

    Attributes
    ----------
    channel : int
    log_ns : ndarray of int64, shape (n,)
    size : ndarray of int64, shape (n,)
        Bytes of each whole record.
    rows : list of (ndarray of int64, ndarray of void)
        Records of equal size: their indices and their bytes.

    """

    channel: int
    log_ns: Ints
    size: Ints
    rows: list[tuple[Ints, NDArray[Any]]]


def stamped_records(
    channel: int, stamp_ns: Ints, log_ns: Ints, frame_id: str, numbers: Floats
) -> Records:
    """
    Make records of messages that are a header and float64 numbers.

    Parameters
    ----------
    channel : int
        Number of the channel.
    stamp_ns, log_ns : ndarray of int64, shape (n,)
        Header stamps and log times.
    frame_id : str
        Of all of them.
    numbers : ndarray, shape (n, k)
        What follows the header.

    Returns
    -------
    Records

    """
    payload = _stamped_layout(frame_id, numbers.shape[1])
    size = RECORD_HEAD.itemsize + payload.itemsize
    rows: NDArray[Any] = np.zeros(
        len(stamp_ns), layout(size, head=(RECORD_HEAD, 0), payload=(payload, RECORD_HEAD.itemsize))
    )
    _fill_head(rows['head'], channel, log_ns, size)
    _fill_stamped(rows['payload'], stamp_ns, frame_id, numbers)
    return _uniform(channel, log_ns, rows)


def stamped_payloads(stamp_ns: Ints, frame_id: str, numbers: Floats) -> Bytes:
    """
    Serialize messages that are a header and float64 numbers.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (n,)
        Header stamps.
    frame_id : str
        Of all of them.
    numbers : ndarray, shape (n, k)
        What follows the header.

    Returns
    -------
    ndarray of uint8, shape (n, size)
        CDR, little-endian.

    """
    payload = _stamped_layout(frame_id, numbers.shape[1])
    rows: NDArray[Any] = np.zeros(len(stamp_ns), payload)
    _fill_stamped(rows, stamp_ns, frame_id, numbers)
    return rows.view(np.uint8).reshape(len(stamp_ns), payload.itemsize)


def _stamped_layout(frame_id: str, n_numbers: int) -> np.dtype[Any]:
    length = len(frame_id.encode()) + 1
    body = 4 + (12 + length + 7) // 8 * 8
    return layout(
        body + 8 * n_numbers,
        order=('u1', 1),
        sec=('<i4', 4),
        nanosec=('<u4', 8),
        length=('<u4', 12),
        frame=(np.dtype((np.void, length)), 16),
        numbers=(('<f8', (n_numbers,)), body),
    )


def _fill_stamped(rows: NDArray[Any], stamp_ns: Ints, frame_id: str, numbers: Floats) -> None:
    characters = frame_id.encode() + b'\0'
    rows['order'] = 1
    rows['sec'] = stamp_ns // _NS
    rows['nanosec'] = stamp_ns % _NS
    rows['length'] = len(characters)
    rows['frame'] = np.void(characters)
    rows['numbers'] = numbers


def bool_records(channel: int, log_ns: Ints, values: NDArray[np.bool_]) -> Records:
    """
    Records of std_msgs/Bool.

    Parameters
    ----------
    channel : int
    log_ns : ndarray of int64, shape (n,)
    values : ndarray of bool, shape (n,)

    Returns
    -------
    Records

    """
    rows: NDArray[Any] = np.zeros(
        len(log_ns), layout(36, head=(RECORD_HEAD, 0), order=('u1', 32), value=('u1', 35))
    )
    _fill_head(rows['head'], channel, log_ns, 36)
    rows['order'] = 1
    rows['value'] = values
    return _uniform(channel, log_ns, rows)


def raw_records(channel: int, log_ns: Ints, data: Bytes, ends: Ints) -> Records:
    """
    Records of messages that are serialized already.

    Parameters
    ----------
    channel : int
    log_ns : ndarray of int64, shape (n,)
    data : ndarray of uint8
        The messages behind each other.
    ends : ndarray of int64, shape (n,)
        Where each ends.

    Returns
    -------
    Records

    """
    length = np.diff(ends, prepend=0)
    size = length + RECORD_HEAD.itemsize
    groups: list[tuple[Ints, NDArray[Any]]] = []
    for each in np.unique(length).tolist():
        index = np.flatnonzero(length == each)
        payload = np.dtype((np.void, each))
        rows: NDArray[Any] = np.zeros(
            len(index),
            layout(
                RECORD_HEAD.itemsize + each,
                head=(RECORD_HEAD, 0),
                payload=(payload, RECORD_HEAD.itemsize),
            ),
        )
        _fill_head(rows['head'], channel, log_ns[index], rows.itemsize)
        if each:
            rows['payload'] = gather(data, ends[index] - each, each)
        groups.append((index, _as_void(rows)))
    return Records(channel, log_ns, size, groups)


def _fill_head(head: NDArray[Any], channel: int, log_ns: Ints, size: int) -> None:
    head['opcode'] = OPCODE_MESSAGE
    head['size'] = size - 9
    head['channel'] = channel
    head['log'] = log_ns
    head['publish'] = log_ns


def _uniform(channel: int, log_ns: Ints, rows: NDArray[Any]) -> Records:
    size = np.full(len(rows), rows.itemsize, np.int64)
    return Records(channel, log_ns, size, [(np.arange(len(rows)), _as_void(rows))])


def _as_void(rows: NDArray[Any]) -> NDArray[Any]:
    return rows.view(np.dtype((np.void, rows.itemsize)))


def merge_records(batches: list[Records]) -> tuple[Bytes, NDArray[np.uint16], Ints, Ints]:
    """
    Lay the records of several channels behind each other in log-time order.

    Parameters
    ----------
    batches : list of Records
        For equal log times the earlier batch goes first.

    Returns
    -------
    data : ndarray of uint8
    channel : ndarray of uint16, shape (n,)
    log_ns : ndarray of int64, shape (n,)
    size : ndarray of int64, shape (n,)
        Of each record in the order of `data`.

    """
    log_ns = np.concatenate([batch.log_ns for batch in batches])
    size = np.concatenate([batch.size for batch in batches])
    channel = np.repeat(
        np.array([batch.channel for batch in batches], np.uint16),
        [len(batch.log_ns) for batch in batches],
    )
    order = np.argsort(log_ns, kind='stable')
    size = size[order]
    begin = np.empty(len(order), np.int64)
    begin[order] = np.cumsum(size) - size
    data = np.empty(int(size.sum()), np.uint8)
    first = 0
    for batch in batches:
        for index, rows in batch.rows:
            scatter(data, begin[first + index], rows)
        first += len(batch.log_ns)
    return data, channel[order], log_ns[order], size


def imu_numbers(
    n: int, linear_acceleration: Floats, covariance: Floats, imu: ImuColumns | None
) -> Floats:
    """
    The numbers of sensor_msgs/Imu after its header.

    Parameters
    ----------
    n : int
    linear_acceleration : ndarray, shape (n, 3)
    covariance : ndarray, shape (n, 9) or (9,)
    imu : ImuColumns or None
        The rest; without it no orientation and no angular velocity is claimed: the first element
        of either covariance is -1, the orientation is the identity.

    Returns
    -------
    ndarray, shape (n, 37)

    """
    numbers = np.zeros((n, 37))
    if imu is None:
        numbers[:, 3] = 1.0
        numbers[:, 4] = numbers[:, 16] = -1.0
    else:
        numbers[:, 0:4] = imu.orientation
        numbers[:, 4:13] = imu.orientation_covariance
        numbers[:, 13:16] = imu.angular_velocity
        numbers[:, 16:25] = imu.angular_velocity_covariance
    numbers[:, 25:28] = linear_acceleration
    numbers[:, 28:37] = covariance
    return numbers


def as_times(name: str, values: ArrayLike, n: int | None = None) -> Ints:
    """
    Check a column of nanoseconds.

    Parameters
    ----------
    name : str
        The argument's name, for the error.
    values : array_like of int, shape (n,)
    n : int, optional
        The length it must have.

    Returns
    -------
    ndarray of int64, shape (n,)

    Raises
    ------
    ValueError
        Not integers, not one row, or a negative time.

    """
    times = np.atleast_1d(np.asarray(values))
    if times.size == 0:
        times = times.astype(np.int64)
    if times.dtype.kind not in 'iu' or times.ndim != 1:
        raise ValueError(f'`{name}` must be one row of integers, got {times.dtype}')
    if n is not None and len(times) != n:
        raise ValueError(f'`{name}` must have {n} values, got {len(times)}')
    times = times.astype(np.int64, copy=False)
    if len(times) and int(np.min(times)) < 0:
        raise ValueError(f'`{name}` must not be negative, got {int(np.min(times))}')
    return times


def as_numbers(name: str, values: ArrayLike, n: int, width: int) -> Floats:
    """
    Check a column of numbers.

    Parameters
    ----------
    name : str
    values : array_like, shape (n, width), or (width,) for the same in each row
    n, width : int

    Returns
    -------
    ndarray, shape (n, width)

    Raises
    ------
    ValueError
        Another shape.

    """
    numbers = np.asarray(values, np.float64)
    if numbers.shape not in {(n, width), (width,)}:
        raise ValueError(f'`{name}` must have shape ({n}, {width}), got {numbers.shape}')
    return np.broadcast_to(numbers, (n, width))
