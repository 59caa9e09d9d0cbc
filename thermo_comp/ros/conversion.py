# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the conversion of serialized samples to serialized Imu messages, without rclpy's classes.

Samples are read, and an Imu is written, at fixed offsets in plain CDR, which is little-endian: 4
bytes of encapsulation, int32 seconds, uint32 nanoseconds, uint32 length of the `frame_id` with its
final NUL, the string, and, at the next multiple of 8 from the end of the encapsulation, float64
values. A message in another form, such as big-endian, is first rewritten by rclpy.
"""

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, Temperature

#: Corrects a sample: takes stamp [ns], x, y, z; returns force and covariance, None if dropped.
Process = Callable[[int, float, float, float], 'tuple[float, ...] | None']
#: Corrects the angular rate of a sample: takes stamp [ns], x, y, z; returns rate and variances.
CorrectRate = Callable[[int, float, float, float], 'tuple[float, ...]']

#: Longest message read [bytes]; an Imu with the longest frame name is shorter.
_LONGEST_MESSAGE = 1024

_ENCAPSULATION = b'\0\1\0\0'
_HEADER = struct.Struct('<4siI4x')
# Number of bytes of an Imu that are passed on: orientation 4 + 9 and angular velocity 3 + 9
# float64 values; linear acceleration 3 + 9 follow. `_UNKNOWN`: these bytes of an
# Imu made from counts, in which -1 marks the quantities that are not measured.
_PASSED = 8 * 25
_UNKNOWN = struct.Struct('<25d').pack(*[0.0] * 3, 1.0, -1.0, *[0.0] * 11, -1.0, *[0.0] * 8)
#: Offset of the angular rate in the `_PASSED` bytes; formats of the rate with the first element of
#: its covariance (input), and with all nine elements (output).
_RATE_AT = 8 * 13
_RATE_IN, _RATE_OUT = struct.Struct('<4d'), struct.Struct('<12d')
_CELSIUS = struct.Struct('<d')


@dataclass(slots=True)
class Traffic:
    """The counters of the node, in addition to those of the compensator."""

    n_lost: int = 0  # samples that the driver sent and the node did not receive
    n_unpublished: int = 0  # output messages that the middleware did not accept
    n_malformed: int = 0  # messages that could not be read
    n_flags: int = 0  # regime flags published, one for each reading from which the regime follows
    n_fallback: int = 0  # samples that rclpy had to convert to plain CDR
    n_contested: int = 0  # messages dropped because more than one publisher may have sent them
    n_absent: int = 0  # samples whose covariance marks the acceleration as not measured


class SampleConverter:
    """Converts serialized samples to serialized Imu; `frame_id` '': the input's frame."""

    def __init__(self, kind: Any, frame_id: str = '', traffic: Traffic | None = None) -> None:
        self._kind, self._frame_id = kind, frame_id
        self.traffic = traffic or Traffic()
        # Layout of the last input message: frame name, offset of the `_PASSED` bytes, function to
        # unpack it. Layout of the Imu that is written: frame name, function to pack it.
        self._name, self._passed, self._frame = b'', 0, b''
        self._unpack: Callable[[bytes], tuple[Any, ...]] = struct.Struct('').unpack
        self._pack: Callable[..., bytes] = struct.Struct('').pack
        #: Force and covariance that `process` returned last, for the diagnostics.
        self.last_result: tuple[float, ...] | None = None

    def convert(
        self, data: bytes, process: Process, correct_rate: CorrectRate | None = None
    ) -> bytes | None:
        """Compensate a sample; None for a sample that is unreadable or that `process` drops."""
        try:
            encapsulation, sec, nanosec, name, x, y, z, *claimed = self._unpack(data)
            is_known = name == self._name and encapsulation == _ENCAPSULATION
        except (struct.error, ValueError):
            is_known = False
        if not is_known:
            data = self._learn(data)
            if not data:
                self.traffic.n_malformed += 1
                return None
            _, sec, nanosec, _, x, y, z, *claimed = self._unpack(data)
        if claimed and claimed[0] == -1.0:
            x = y = z = math.nan
            self.traffic.n_absent += 1
        result = process(sec * 1_000_000_000 + nanosec, x, y, z)
        if result is None:
            return None
        self.last_result = result
        block = _UNKNOWN
        if self._passed:
            block = data[self._passed : self._passed + _PASSED]
            if correct_rate is not None:
                x, y, z, claimed = _RATE_IN.unpack_from(block, _RATE_AT)
                if claimed != -1.0:
                    x, y, z, xx, yy, zz = correct_rate(sec * 1_000_000_000 + nanosec, x, y, z)
                    rate = x, y, z, xx, 0.0, 0.0, 0.0, yy, 0.0, 0.0, 0.0, zz
                    block = block[:_RATE_AT] + _RATE_OUT.pack(*rate)
        fx, fy, fz, c00, c01, c02, c11, c12, c22 = result
        return self._pack(
            _ENCAPSULATION, sec, nanosec, self._frame, block,
            fx, fy, fz, c00, c01, c02, c01, c11, c12, c02, c12, c22,
        )  # fmt: skip

    def _learn(self, data: bytes) -> bytes:
        """Store a message's layout; return the message as plain CDR, b'' if it is unreadable."""
        is_imu = self._kind is Imu
        # An Imu ends with nine covariances of the acceleration, and only the first is read.
        skip, n_read, n_after = (_PASSED, 4, 64) if is_imu else (0, 3, 0)
        size = skip + 8 * n_read + n_after
        given, (data, start) = data, _plain(data, size, self._kind)
        if not start:
            return b''
        self.traffic.n_fallback += data is not given
        self._passed = start if is_imu else 0
        end = 16 + int.from_bytes(data[12:16], 'little')
        # The padding after the frame name may hold any bytes.
        self._name, gap = data[12:end], start - end + skip
        self._unpack = struct.Struct(f'<4siI{len(self._name)}s{gap}x{n_read}d{n_after}x').unpack
        frame = self._frame_id.encode() + b'\0' if self._frame_id else self._name[4:]
        self._frame = len(frame).to_bytes(4, 'little') + frame + bytes(-(12 + len(frame)) % 8)
        self._pack = struct.Struct(f'<4siI{len(self._frame)}s{_PASSED}s12d').pack
        return data


def read_temperature(data: bytes) -> tuple[int, float] | None:
    """Read stamp [ns] and temperature of a serialized Temperature; None for malformed bytes."""
    # rclpy's deserialization would take the CPU time of several samples, because its code is not
    # in the processor's cache when the node wakes up.
    data, start = _plain(data, 16, Temperature)
    if not start:
        return None
    _, sec, nanosec = _HEADER.unpack_from(data)
    return sec * 1_000_000_000 + nanosec, _CELSIUS.unpack_from(data, start)[0]


def _values_at(data: bytes, size: int) -> int:
    """Return the offset of the last `size` bytes, the numbers; 0 if `data` is not plain CDR."""
    if not 16 < len(data) <= _LONGEST_MESSAGE or data[:4] != _ENCAPSULATION:
        return 0
    length = int.from_bytes(data[12:16], 'little')
    start = 16 + length + -(12 + length) % 8
    name = data[16 : 16 + length]
    if not length or len(data) != start + size or name.find(0) != length - 1:
        return 0
    with suppress(UnicodeDecodeError):
        name.decode()
        return start
    return 0


def _plain(data: bytes, size: int, message_type: Any) -> tuple[bytes, int]:
    """Return a message as plain CDR and the offset of its numbers; offset 0 if unreadable."""
    start = _values_at(data, size)
    if not start and len(data) <= _LONGEST_MESSAGE:
        # RuntimeError: rclpy cannot read the message. ValueError: a frame name is not UTF-8.
        with suppress(RuntimeError, ValueError):
            data = serialize_message(deserialize_message(data, message_type))
            start = _values_at(data, size)
    return data, start
