# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The node converts serialized messages to the bytes that a conversion by rclpy would give."""

import struct

import pytest

pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')

from geometry_msgs.msg import Vector3Stamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, Temperature

from thermo_comp.ros.conversion import SampleConverter, read_temperature

floats = st.floats(allow_nan=True, allow_infinity=True, width=64)
STAMPS = {'sec': st.integers(-(2**31), 2**31 - 1), 'nanosec': st.integers(0, 2**32 - 1)}
# Frame names without NUL, which ends a string in CDR, and without characters outside UTF-8.
frames = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)


def process(stamp_ns, x, y, z):
    return (z, x, y, 1.5, 0.25, float(stamp_ns % 1009), 2.5, 0.125, 3.5)


def cdr(order, stamp, frame, values):
    """Serialize a message of a header and float64 values by the CDR standard, without rclpy."""
    name = frame.encode() + b'\0'
    head = struct.pack(f'{order}iII', *stamp, len(name)) + name
    head += bytes(-len(head) % 8)
    return (b'\0\1\0\0' if order == '<' else b'\0\0\0\0') + head + pack(order, values)


def pack(order, values):
    return struct.pack(f'{order}{len(values)}d', *values)


GOOD = cdr('<', (3, 4), 'imu', [1.0, 2.0, 3.0])


def doubles(data):
    """Return each of the 37 values of a serialized Imu as bytes: a NaN does not equal itself."""
    body = data[-37 * 8 :]
    return [body[i : i + 8] for i in range(0, len(body), 8)]


def convert(converter, *messages):
    written = (converter.convert(message, process) for message in messages)
    return [message for message in written if message is not None]


@given(
    order=st.sampled_from('<>'), frame=frames, values=st.lists(floats, min_size=3, max_size=3),
    **STAMPS,
)  # fmt: skip
def test_counts_are_converted_to_an_imu_message(order, sec, nanosec, frame, values):
    converter = SampleConverter(Vector3Stamped)
    written = convert(converter, *[cdr(order, (sec, nanosec), frame, values)] * 2)
    assert (written[0], converter.traffic.n_fallback) == (written[1], 2 * (order == '>'))
    imu = deserialize_message(written[0], Imu)
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec) == (sec, nanosec)
    assert imu.header.frame_id == frame
    x, y, z = (pack('<', [value]) for value in values)
    force = process(sec * 10**9 + nanosec, *values)
    covariance = [force[k] for k in (3, 4, 5, 4, 6, 7, 5, 7, 8)]
    fields = doubles(written[0])
    assert (fields[25:28], b''.join(fields[28:])) == ([z, x, y], pack('<', covariance))
    # A first covariance entry of -1 marks a quantity as not measured (REP 145).
    assert b''.join(fields[:4]) == pack('<', [0.0, 0.0, 0.0, 1.0])
    assert fields[4] == fields[16] == pack('<', [-1.0])
    assert not any(b''.join(fields[5:16] + fields[17:25]))


@given(
    order=st.sampled_from('<>'), frame=frames, override=st.sampled_from(['', 'other_link']),
    values=st.lists(floats, min_size=37, max_size=37),
)  # fmt: skip
def test_imu_fields_except_acceleration_are_copied_bit_for_bit(order, frame, override, values):
    converter = SampleConverter(Imu, override)
    (written,) = convert(converter, cdr(order, (5, 7), frame, values))
    assert converter.traffic.n_fallback == (order == '>')
    assert deserialize_message(written, Imu).header.frame_id == (override or frame)
    assert b''.join(doubles(written)[:25]) == pack('<', values[:25])
    x, y, z = values[25:28]
    assert b''.join(doubles(written)[25:28]) == pack('<', [z, x, y])


def test_the_byte_swap_keeps_the_bits_of_a_signalling_nan():
    # A processor may turn a signalling NaN into a quiet NaN when it loads it as a float64.
    payload = 0x7FF0_0000_0000_0001
    message = cdr('>', (1, 2), 'imu', []) + struct.pack('>37Q', *[payload] * 37)
    written = SampleConverter(Imu).convert(message, lambda *_: tuple(map(float, range(9))))
    assert written is not None
    assert doubles(written)[:25] == [struct.pack('<Q', payload)] * 25


def test_messages_with_frame_ids_of_different_lengths_are_converted():
    converter = SampleConverter(Vector3Stamped)
    names = ['a', 'imu_link', '', 'a', 'x' * 40, 'imu_link']
    written = convert(converter, *(cdr('<', (1, k), f, [k, 0, 0]) for k, f in enumerate(names)))
    read = [deserialize_message(data, Imu) for data in written]
    assert [imu.header.frame_id for imu in read] == names
    assert [imu.linear_acceleration.y for imu in read] == list(range(6))
    assert converter.traffic.n_fallback == 0


@pytest.mark.parametrize('kind', [Vector3Stamped, Imu])
@pytest.mark.parametrize('override', ['', 'other_link'])
def test_messages_with_extra_bytes_are_converted_by_rclpy(kind, override):
    good = cdr('<', (3, 4), 'imu', [float(k) for k in range(37 if kind is Imu else 3)])
    fast, slow = SampleConverter(kind, override), SampleConverter(kind, override)
    (expected,), (written,) = convert(fast, good), convert(slow, good + bytes(8))
    assert (fast.traffic.n_fallback, slow.traffic.n_fallback) == (0, 1)
    assert deserialize_message(written, Imu) == deserialize_message(expected, Imu)
    assert doubles(written) == doubles(expected)
    assert slow.last_result == fast.last_result is not None
    convert(slow, good)
    assert slow.traffic.n_fallback == 1


@pytest.mark.parametrize(
    'bad',
    [
        b'', b'\0', b'\0\1', cdr('<', (1, 2), 'imu', [1.0, 2.0]), b'\0\1\0\0' + b'\xff' * 60,
        cdr('<', (1, 2), 'imu', [1.0, 2.0, 3.0])[:-1],
    ],
)  # fmt: skip
def test_unreadable_messages_are_counted_and_later_messages_converted(bad):
    converter = SampleConverter(Vector3Stamped)
    written = convert(converter, GOOD, bad, GOOD)
    assert (len(written), written[0], converter.traffic.n_malformed) == (2, written[1], 1)


def test_unreadable_first_messages_are_counted_and_samples_without_correction_give_none():
    # WHY: the converter took a first message of one byte for a valid one (found by fuzzing).
    for n in range(40):
        converter = SampleConverter(Vector3Stamped)
        assert len(convert(converter, bytes(n), GOOD)) == 1
        assert converter.traffic.n_malformed == 1
    converter = SampleConverter(Vector3Stamped)
    for message in (GOOD, GOOD + bytes(8)):
        assert converter.convert(message, lambda *_: None) is None
    assert converter.last_result is None


@given(
    st.binary(max_size=80)
    | st.builds(
        lambda head, value, cut, tail: cdr(*head, [value, 0.0])[: 64 - cut] + tail,
        st.tuples(st.sampled_from('<>'), st.tuples(*STAMPS.values()), st.text(max_size=12)),
        st.floats(),
        st.integers(0, 40),
        st.sampled_from([b'', b'\0\0\0\0', bytes(8)]),
    )
)
def test_a_temperature_is_read_as_rclpy_reads_it(data):
    try:
        message = deserialize_message(data, Temperature)
    except (RuntimeError, ValueError):
        expected = None
    else:
        stamp = message.header.stamp
        expected = (stamp.sec * 10**9 + stamp.nanosec, message.temperature)
    # Temperatures are compared as text, because a NaN does not equal itself.
    assert repr(read_temperature(data)) == repr(expected)
