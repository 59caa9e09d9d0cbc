# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the serialized layout of stamped messages: decodes batches to blocks, and encodes columns.

Vector3Stamped, Imu and Temperature consist of a std_msgs/Header and float64 numbers. In CDR::

    0   encapsulation: 00, endianness (0 big, 1 little), options
    4   stamp: int32 seconds, uint32 nanoseconds
    12  uint32 length of frame_id with its final NUL, then its characters
    4 + align8(12 + length)   the float64 numbers

The size of messages of one type depends on `frame_id` alone; messages of one layout become rows
of bytes, with stamps and numbers as views. `rosbags` converts ROS 1 messages one by one.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from struct import pack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RecordingError
from ..topics import IMU, N_NUMBERS, TEMPERATURE, VECTOR3_STAMPED
from ..typing import Bytes, Floats, Ints
from .blocks import ROLES, Block, ImuColumns, Readings, Role, Topic
from .fields import Field, typestore
from .serialized import Messages, gather, number_at
from .topics import shown

#: Indices of the fields of `ImuColumns` among the 37 numbers of sensor_msgs/Imu.
IMU_COLUMNS = (slice(0, 4), slice(4, 13), slice(13, 16), slice(16, 25), slice(28, 37))
IMU_ACCELERATION = slice(25, 28)

HEAD_BYTES = 16  # number of bytes before the characters of frame_id
_MAX_PADDING = 7  # largest number of padding bytes at the end of a message
_NS = 1_000_000_000  # nanoseconds per second


def decode_blocks(
    messages: Messages,
    channels: Mapping[Role, Mapping[int, Topic]],
    fields: Mapping[Role, Field],
    *,
    keep_raw: bool = False,
) -> list[Block]:
    """
    Decode messages in their order; a block ends where `frame_id` changes. `channels`: for
    each role, the topic of each channel number; `fields`: the field with a thermometer's reading.
    A reading in a field of another message type is put into `raw` as a Temperature message.
    Raises RecordingError, without a path, if the bytes do not fit the message type.
    """
    is_imu = any(topic.type == IMU for topic in channels.get('accel', {}).values())
    temperatures, log_ns, raw = {}, {}, {}
    for role in dict.fromkeys((*ROLES, *channels)):
        kind = TEMPERATURE if role != 'accel' else IMU if is_imu else VECTOR3_STAMPED
        topics = channels.get(role, {})
        rank = messages.places_of(topics)
        taken = messages.take(rank)
        topic = next(iter(topics.values()), Topic('', kind, 'cdr'))
        try:
            if len({other[:3] for other in topics.values()}) > 1:
                raise RecordingError('its messages have several encodings')
            if topic.encoding == 'ros1':
                taken = as_cdr(taken, topic.type)
            if topics and role in fields:
                read_ns, values = fields[role].read(taken)
                pieces = [(slice(0, 1), values[:, None])]
                rows = encode_stamped(read_ns, '', N_NUMBERS[kind], pieces)
                taken = Messages.of_rows(rows, taken.channel, taken.log_ns)
            stamp_ns, numbers, frame = decode_stamped(taken, kind)
        except RecordingError as error:
            raise RecordingError(error.message, key=shown(topic.name)) from error
        if role == 'accel':
            text = frame.tobytes()  # comparing bytes is a fast test of a constant frame_id
            is_equal = text == text[: frame.itemsize] * len(frame)
            changes = [] if is_equal else rank[1:][frame[1:] != frame[:-1]].tolist()
            if changes:
                runs = (slice(*run) for run in pairwise([0, *changes, len(messages)]))
                return [
                    decode_blocks(messages.take(run), channels, fields, keep_raw=keep_raw)[0]
                    for run in runs
                ]
            accel, samples_ns, samples, frames = rank, stamp_ns, numbers, frame
        else:
            after = np.searchsorted(accel, rank).astype(np.int64)
            temperatures[role] = Readings(stamp_ns, numbers[:, 0], after)
        log_ns[role] = taken.log_ns
        if keep_raw and len(taken):
            raw[role] = taken.packed()
    imu = ImuColumns(*(samples[:, c] for c in IMU_COLUMNS)) if is_imu else None
    if imu is not None:
        # A covariance with the first element -1 marks an acceleration that was not measured.
        is_absent = imu.linear_acceleration_covariance[:, :1] == -1.0
        samples = np.where(is_absent, np.nan, samples[:, IMU_ACCELERATION])
    frame_id = frames[0].decode('utf-8', 'replace') if len(frames) else ''
    return [Block(samples_ns, samples, frame_id, imu, temperatures, log_ns, raw)]


def decode_stamped(messages: Messages, kind: str) -> tuple[Ints, Floats, NDArray[Any]]:
    """Decode headers and k float64 numbers each; return stamps, numbers (n, k) and frame_ids."""
    n, n_numbers, size = len(messages), N_NUMBERS[kind], messages.size
    if not n:
        return size, np.empty((0, n_numbers)), np.empty(0, 'S1')
    if int(np.min(size)) < HEAD_BYTES + 8 * n_numbers:
        raise _misfit(kind)
    width = int(size[0]) if (size == size[0]).all() else HEAD_BYTES
    rows = gather(messages.data, messages.start, width)
    # Usually all messages have the same length, byte order and length of frame_id.
    for key in (size, number_at(rows, 0, 'u2'), number_at(rows, 12, 'u4')):
        if (key != key[0]).any():
            columns = np.empty(n, np.int64), np.empty((n, n_numbers)), np.empty(n, object)
            order = np.argsort(key, kind='stable')
            for alike in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
                parts = decode_stamped(messages.take(alike), kind)
                for column, part in zip(columns, parts, strict=True):
                    column[alike] = part
            return columns
    representation = int(number_at(rows, 0, '>u2')[0])
    if representation > 1:
        reason = f'serialized with representation {representation:#06x}, '
        raise RecordingError(reason + 'expected plain CDR (0x0000 or 0x0001)')
    endian = '<' if representation else '>'
    frame_size = int(number_at(rows, 12, f'{endian}u4')[0])
    # The numbers start (12 + length of frame_id + 7) // 8 * 8 bytes after the encapsulation.
    at = (frame_size + (HEAD_BYTES + 3) & -8) + 4
    length = rows.dtype.itemsize
    if not 0 <= length - (at + 8 * n_numbers) <= _MAX_PADDING:
        raise _misfit('a header and its numbers')
    stamp_ns = number_at(rows, 4, f'{endian}i4').astype(np.int64)
    stamp_ns *= _NS
    stamp_ns += number_at(rows, 8, f'{endian}u4')
    values: Floats = np.ndarray(
        (n, n_numbers), f'{endian}f8', rows.data, offset=at, strides=(length, 8)
    )
    frame = number_at(rows, HEAD_BYTES, f'S{frame_size}') if frame_size else np.zeros(n, 'S1')
    return stamp_ns, values.astype(np.float64, 'C'), frame


def encode_stamped(
    stamp_ns: Ints, frame_id: str, n_numbers: int, pieces: Sequence[tuple[slice, Floats]]
) -> Bytes:
    """
    Serialize (CDR, little-endian) a header and float64 numbers as rows of bytes, shape (n, size).
    Each of `pieces` has a slice that selects numbers of a message, and their values, of shape
    (n, width), or (width,) if equal in all messages. Numbers in no piece are 0.
    """
    text = frame_id.encode() + b'\0'
    head = pack('<BBHiII', 0, 1, 0, 0, 0, len(text)) + text
    body = 4 + (len(head) + 3) // 8 * 8
    row = np.frombuffer(bytearray(head.ljust(body, b'\0') + bytes(8 * n_numbers)), np.uint8)
    # Values that are equal in all messages are written once, into `row`, before `row` is copied.
    for place, values in pieces:
        if values.ndim == 1:
            row[body:].view('<f8')[place] = values
    data = np.empty((len(stamp_ns), len(row)), np.uint8)
    data[:] = row
    seconds = stamp_ns // _NS
    data[:, 4:8].view('<i4')[:, 0] = seconds
    data[:, 8:12].view('<u4')[:, 0] = stamp_ns - seconds * _NS
    numbers = data[:, body:].view('<f8')
    for place, values in pieces:
        if values.ndim > 1:
            numbers[:, place] = values
    return data


def as_cdr(messages: Messages, kind: str) -> Messages:
    """Convert ROS 1 messages to CDR; RecordingError for invalid bytes."""
    convert = typestore().ros1_to_cdr
    try:
        pieces = [bytes(convert(message, kind)) for message in messages]
    except Exception as error:  # rosbags raises nearly any exception on damaged bytes
        raise _misfit(kind) from error
    return Messages.of(pieces, messages.channel, messages.log_ns)


def _misfit(kind: str) -> RecordingError:
    return RecordingError(f'damaged message: its size does not fit {kind}')
