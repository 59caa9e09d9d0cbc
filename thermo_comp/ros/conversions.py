# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the step from a serialized sample to a serialized `sensor_msgs/Imu`.

A sample is read and an Imu is written at fixed places of their CDR form. Where these places are
follows from the byte order and the length of `frame_id`, and is not taken on trust: for the first
message of each kind the result is compared, byte by byte, with what rclpy's own deserialization
and serialization give. A message that does not fit goes through rclpy, with identical values.

CDR of a stamped message: 4 bytes of encapsulation (the second one odd: little endian), int32
seconds, uint32 nanoseconds, uint32 length of the string with its final NUL, the string, and, at
the next multiple of 8 counted from the end of the encapsulation, float64 values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from struct import Struct
from struct import error as StructError  # noqa: N812
from typing import Any

from geometry_msgs.msg import Vector3Stamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, Temperature

#: Compensates one sample: stamp and three components in, force and covariance out, None = drop.
Process = Callable[[int, float, float, float], 'tuple[float, ...] | None']
#: Corrects the angular rate that came with that sample: rate and variances out.
CorrectRate = Callable[[int, float, float, float], 'tuple[float, ...]']

# An Imu is orientation 4 + 9, angular velocity 3 + 9, linear acceleration 3 + 9 float64 values.
_PASSED = 25
_IMU = 37
_LAYOUTS_KEPT = 64
#: The longest name of a frame, in bytes, given or received.
LONGEST_FRAME = 255
#: An Imu with such a name is shorter; what is longer is not kept, and not even read.
_LONGEST_MESSAGE = 1024

# What rclpy raises for bytes that are not the message, or for a name that is not UTF-8.
_UNREADABLE = (RuntimeError, ValueError)

_ENCAPSULATION = b'\0\1\0\0'
_NO_GYRO = Struct('<25d').pack(*[0.0] * 3, 1.0, -1.0, *[0.0] * 11, -1.0, *[0.0] * 8)
_HEADER = Struct('<iII')
_VALUE = Struct('<d')
_SHORTEST_READING = 36  # no frame_id: its NUL, padding, temperature and variance
#: Where the rate stands in what is passed on, and its form with the first of its covariance.
_RATE_AT = 8 * 13
_RATE_IN, _RATE_OUT = Struct('<4d'), Struct('<12d')
_FOREIGN = Struct('>25Q')
_NATIVE = Struct('<25Q')


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where a sample of one kind has its values; what of an Imu is passed on, from `passed`."""

    unpack: Callable[[bytes], tuple[Any, ...]]
    encapsulation: bytes
    name: bytes
    pack: Callable[..., bytes]
    frame: bytes
    passed: int
    is_foreign: bool

    def write(
        self,
        data: bytes,
        sec: int,
        nanosec: int,
        result: tuple[float, ...],
        correct_rate: CorrectRate | None = None,
    ) -> bytes:
        block = _NO_GYRO
        if self.passed:
            block = data[self.passed : self.passed + 8 * _PASSED]
            if self.is_foreign:
                block = _NATIVE.pack(*_FOREIGN.unpack(block))
            if correct_rate is not None:
                x, y, z, claimed = _RATE_IN.unpack_from(block, _RATE_AT)
                if claimed != -1.0:
                    rate = correct_rate(sec * 1_000_000_000 + nanosec, x, y, z)
                    block = block[:_RATE_AT] + _RATE_OUT.pack(*_spelt_out(*rate))
        fx, fy, fz, c00, c01, c02, c11, c12, c22 = result
        return self.pack(
            _ENCAPSULATION, sec, nanosec, self.frame, block,
            fx, fy, fz, c00, c01, c02, c01, c11, c12, c02, c12, c22,
        )  # fmt: skip


@dataclass(slots=True)
class Traffic:
    """What the node itself counts, beside the compensator's counters."""

    n_lost: int = 0  # samples that the driver sent and the node did not get
    n_unpublished: int = 0  # output messages that the middleware did not accept
    n_malformed: int = 0  # messages that could not be read
    n_flags: int = 0  # regime flags published, one for each reading that decides
    n_fallback: int = 0  # samples that took the slow way through rclpy's deserialization
    n_contested: int = 0  # messages not used because their input had more than one publisher
    n_failures: int = 0  # callbacks of the node that ended in an exception


_NOTHING = Struct('')
_UNKNOWN = _Layout(_NOTHING.unpack, b'', b'', _NOTHING.pack, b'', 0, False)


class SampleConverter:
    """Turns samples into Imu, both serialized; an empty `frame_id` keeps the input's."""

    def __init__(
        self, message_type: Any, frame_id: str = '', traffic: Traffic | None = None
    ) -> None:
        self._message_type = message_type
        self._frame_id = frame_id
        self.traffic = traffic or Traffic()
        self._layout = _UNKNOWN
        self._layouts: dict[tuple[bytes, bytes, int], _Layout | None] = {}
        #: What `process` last gave, for reports.
        self.last_result: tuple[float, ...] | None = None

    def convert(
        self, data: bytes, process: Process, correct_rate: CorrectRate | None = None
    ) -> bytes | None:
        """Compensate one sample; None if it is not readable or `process` dropped it."""
        layout = self._layout
        try:
            encapsulation, sec, nanosec, name, x, y, z = layout.unpack(data)
            is_known = name == layout.name and encapsulation == layout.encapsulation
        except (StructError, ValueError):
            is_known = False
        if not is_known:
            found = self._layout_of(data)
            if found is None:
                return self._convert_message(data, process, correct_rate)
            self._layout = layout = found
            encapsulation, sec, nanosec, name, x, y, z = layout.unpack(data)
        result = process(sec * 1_000_000_000 + nanosec, x, y, z)
        if result is None:
            return None
        self.last_result = result
        return layout.write(data, sec, nanosec, result, correct_rate)

    def _layout_of(self, data: bytes) -> _Layout | None:
        """Look up, or learn and check, where this message holds its values."""
        if len(data) < 16:
            return None
        order = '<' if data[1] & 1 else '>'
        (length,) = Struct(order + 'I').unpack_from(data, 12)
        if not 0 < length <= min(len(data) - 16, LONGEST_FRAME + 1):
            return None
        key = (data[:4], data[12 : 16 + length], len(data))
        if key not in self._layouts:
            if len(self._layouts) >= _LAYOUTS_KEPT:
                self._layouts.clear()
            self._layouts[key] = self._learn(data, order, length)
        return self._layouts[key]

    def _learn(self, data: bytes, order: str, length: int) -> _Layout | None:
        """Build the layout of this message; None if rclpy reads or writes anything else."""
        is_imu = self._message_type is Imu
        padding = -(12 + length) % 8
        skip = 8 * _PASSED if is_imu else 0
        rest = 72 if is_imu else 0
        pattern = Struct(f'{order}4siI{4 + length}s{padding + skip}x3d{rest}x')
        name = data[12 : 16 + length]
        frame = self._frame_id.encode() + b'\0' if self._frame_id else name[4:]
        gap = -(12 + len(frame)) % 8
        head = Struct('<I').pack(len(frame)) + frame + bytes(gap)
        imu = Struct(f'<4siI{len(head)}s{8 * _PASSED}s12d')
        start = 16 + length + padding
        layout = _Layout(
            pattern.unpack, data[:4], name, imu.pack, head, start if is_imu else 0, order == '>'
        )
        try:
            sec, nanosec, _, *values = pattern.unpack(data)[1:]
            message = deserialize_message(data, self._message_type)
            # Looked at before the message is written over.
            is_read = _bits(values) == _bits(_components(message))
            example = tuple(range(1, 10))
            written = layout.write(data, sec, nanosec, example)
            expected = self._write_message(message, example)
        except (StructError, *_UNREADABLE):
            return None
        # Not compared: the bytes of padding, which are whatever rclpy found in memory.
        end, body = 16 + len(frame), 12 + len(head)
        is_written = written[:end] == expected[:end] and written[body:] == expected[body:]
        return layout if is_read and is_written else None

    def _convert_message(
        self, data: bytes, process: Process, correct_rate: CorrectRate | None
    ) -> bytes | None:
        """Take the ordinary way, for what no layout fits."""
        if len(data) > _LONGEST_MESSAGE:
            self.traffic.n_malformed += 1
            return None
        try:
            message = deserialize_message(data, self._message_type)
        except _UNREADABLE:
            self.traffic.n_malformed += 1
            return None
        self.traffic.n_fallback += 1
        result = process(_stamp_ns(message), *_components(message))
        if result is None:
            return None
        self.last_result = result
        if correct_rate is not None and self._message_type is Imu:
            _set_rate(message, correct_rate)
        return self._write_message(message, result)

    def _write_message(self, message: Any, result: tuple[float, ...]) -> bytes:
        """Write the Imu through rclpy; an Imu message is changed on the way."""
        if self._message_type is Imu:
            imu = message
        else:
            imu = Imu(header=message.header)
            imu.orientation_covariance[0] = -1.0
            imu.angular_velocity_covariance[0] = -1.0
        if self._frame_id:
            imu.header.frame_id = self._frame_id
        fx, fy, fz, c00, c01, c02, c11, c12, c22 = map(float, result)
        force = imu.linear_acceleration
        force.x, force.y, force.z = fx, fy, fz
        imu.linear_acceleration_covariance[:] = [c00, c01, c02, c01, c11, c12, c02, c12, c22]
        written: bytes = serialize_message(imu)
        return written


def read_temperature(data: bytes) -> tuple[int, float] | None:
    """Read the stamp [ns] and the temperature of a serialized Temperature; None if it is none."""
    # A node that sleeps between samples pays for each line of code it has not touched for long:
    # rclpy's deserialization costs it as much as several samples.
    if len(data) > _LONGEST_MESSAGE:
        return None
    if data[:4] == _ENCAPSULATION and len(data) >= _SHORTEST_READING:
        sec, nanosec, length = _HEADER.unpack_from(data, 4)
        values = 16 + length + -(12 + length) % 8
        name = data[16 : 16 + length]
        if len(data) == values + 16 and name[-1:] == b'\0' and name.isascii():
            return sec * 1_000_000_000 + nanosec, _VALUE.unpack_from(data, values)[0]
    try:
        message = deserialize_message(data, Temperature)
    except _UNREADABLE:
        return None
    return _stamp_ns(message), message.temperature


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def _components(message: Any) -> tuple[float, float, float]:
    vector = message.vector if isinstance(message, Vector3Stamped) else message.linear_acceleration
    return vector.x, vector.y, vector.z


def _set_rate(message: Any, correct_rate: CorrectRate) -> None:
    if message.angular_velocity_covariance[0] == -1.0:
        return
    rate = message.angular_velocity
    found = _spelt_out(*correct_rate(_stamp_ns(message), rate.x, rate.y, rate.z))
    rate.x, rate.y, rate.z, *message.angular_velocity_covariance[:] = found


def _spelt_out(x: float, y: float, z: float, xx: float, yy: float, zz: float) -> tuple[float, ...]:
    return x, y, z, xx, 0.0, 0.0, 0.0, yy, 0.0, 0.0, 0.0, zz


def _bits(values: Iterable[float]) -> bytes:
    return Struct('<3d').pack(*values)
