# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fuzz targets: the readers of bytes from outside, and the properties that must hold.

Each target takes any bytes and raises if a property is violated; its seeds are small and complete,
so that the fuzzer passes the first checks of the readers from the start.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import files
import lz4.frame
import zstandard

from thermo_comp.errors import CalibrationError, RecordingError
from thermo_comp.online.compensator import Compensator
from thermo_comp.online.segments import EVER_NS
from thermo_comp.recording.reader import open_recording
from thermo_comp.unit.calibration import Axes, AxisReference, AxisSet, Calibration, RegimeSet, Unit
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration
from thermo_comp.unit.functions import Polynomial

START_NS = 1_767_225_600_000_000_000
MAGIC = b'\x89MCAP0\r\n'
#: File to which an input is written before it is read as a bag.
BAG = Path(files.FOLDER.name, 'any.mcap')


@dataclass(frozen=True)
class Target:
    """A fuzz target."""

    check: Callable[[bytes], None]
    seeds: list[bytes]
    max_length: int


def small_calibration() -> Calibration:
    """Make a valid calibration with few terms."""
    axis = AxisSet(Polynomial((0.0, 0.5)), Polynomial((1.0, 1e-5)))
    sets = RegimeSet(x=axis, y=axis, z=axis, temperature_range_c=(5, 35), rate_range_k_min=(-1, 1))
    return Calibration(
        format_version=2,
        unit=Unit('T-1', 'counts', 32767.0, 0.01),
        reference_temperature_c=20.0,
        gravity_m_s2=9.80665,
        axes=Axes(*[AxisReference(300.0, 0.0)] * 3),
        static=sets,
        dynamic=sets,
        noise_density_m_s2_sqrt_hz=(1e-4, 1e-4, 1e-4),
    )


UNIT = small_calibration()
#: Largest number of messages in an input: more would only slow the fuzzer down.
MOST_MESSAGES = 6
#: One compensator serves all inputs: making a compensator takes longer than checking an input.
COMPENSATOR = Compensator(UNIT)


def check_calibration(data: bytes) -> None:
    """
    Read any bytes as a calibration: an error is one line, a calibration stays equal when written.
    """
    try:
        value = parse_calibration(data, 'fuzz.yaml')
    except CalibrationError as error:
        text = str(error)
        assert text.startswith('fuzz.yaml: '), text
        assert '\n' not in text, text
        return
    assert parse_calibration(dump_calibration(value).encode()) == value
    row = Compensator(value).process(START_NS, 1.0, 2.0, 3.0)
    # Before the first temperature, only a calibration of constants corrects a sample.
    assert row is None or not value.needs_temperature


#: Bias and scale functions without optional keys, as the fuzzer tries short inputs more often.
_FUNCTIONS = (
    '{bias_function: {kind: polynomial, coefficients: [0]}, '
    'scale_function: {kind: polynomial, coefficients: [1]}}'
)
_SET = f'{{temperature_range_c: [5, 35], rate_range_k_min: [-1, 1], x: {_FUNCTIONS}'
_SET += f', y: {_FUNCTIONS}, z: {_FUNCTIONS}}}'
_AXIS = '{scale_factor: 300, bias: 0}'
SMALLEST = f"""\
format_version: 2
unit: {{serial: T, input: counts, full_scale: 9999, cycle_time_s: 0.01}}
reference_temperature_c: 20
gravity_m_s2: 9.8
axes: {{x: {_AXIS}, y: {_AXIS}, z: {_AXIS}}}
static: {_SET}
dynamic: {_SET}
noise_density_m_s2_sqrt_hz: [1, 1, 1]
""".encode()


def check_mcap(data: bytes) -> None:
    """Read any bytes as a bag: an error is one line, the output is limited by the input's size."""
    with suppress(RecordingError):
        try:
            BAG.write_bytes(data)
            with open_recording(BAG, require=()) as reader:
                n = sum(block.n_messages for block in reader.blocks())
                # A message record has at least 31 bytes, and zstd expands a byte to at most 30 kB.
                assert n <= 1000 * len(data), n
        except RecordingError as error:
            assert '\n' not in str(error), error
            raise


def check_cdr(data: bytes) -> None:
    """For any messages the node's output is a complete, finite Imu message."""
    # Import ROS here, because only the targets `parameters` and `cdr` need ROS.
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.relay import SampleConverter, read_temperature

    compensator = COMPENSATOR
    compensator.jump_back(EVER_NS)
    compensator.push('board', 0, 20.0)
    converters = [SampleConverter(Vector3Stamped), SampleConverter(Imu, 'body')]
    at = n = 0
    while at + 2 <= len(data) and n < MOST_MESSAGES:
        n += 1
        kind, length = data[at], data[at + 1]
        message = data[at + 2 : at + 2 + length * 2]
        at += 2 + length * 2
        if kind % 4 > 1:
            reading = read_temperature(message)
            if reading is not None:
                compensator.push('board' if kind % 4 == 2 else 'case', *reading)
            continue
        written = converters[kind % 4].convert(message, compensator.process)
        if written is not None:
            imu = deserialize_message(written, Imu)
            force = imu.linear_acceleration
            covariance = imu.linear_acceleration_covariance
            assert all(map(math.isfinite, (force.x, force.y, force.z, *covariance)))
            assert min(covariance[0], covariance[4], covariance[8]) > 0.0
    compensator.flush(1 << 62)
    assert compensator.counters.n_in >= compensator.counters.n_out


def check_parameters(data: bytes) -> None:
    """Send any bytes as a request to set parameters: the answer to a bad request has a reason."""
    # Import ROS here, because only the targets `parameters` and `cdr` need ROS.
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from rclpy.serialization import deserialize_message

    from thermo_comp.errors import CalibrationError
    from thermo_comp.ros.parameters import NodeConfig, ParameterError, read_parameter, updated
    from thermo_comp.ros.reader import read

    try:
        messages = deserialize_message(data, SetParameters.Request).parameters
    except (RuntimeError, ValueError):
        # Bytes that are not a request become a parameter value: first its type, then its text.
        text = data[1:].decode(errors='replace').replace('\0', '')
        value = ParameterValue(type=data[0] if data else 0, string_value=text)
        messages = [Parameter(name=name, value=value) for name in ('frame_id', 'calibration_file')]

    def ask(message: Parameter) -> None:
        try:
            config = updated(NodeConfig(), [read_parameter(message)])
            if config.calibration_file:
                read(config.calibration_file, '/nowhere')
        except (ParameterError, CalibrationError) as error:
            assert str(error)
            assert '\n' not in str(error), error

    for message in messages[:MOST_MESSAGES]:
        ask(message)


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack('<I', len(text)) + text.encode()


def cdr(stamp_ns: int, *numbers: float) -> bytes:
    """Serialize a stamped message of doubles."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    head = struct.pack('<4siII', b'\0\1\0\0', sec, nanosec, 4) + b'imu\0'
    return head + bytes(-(len(head) - 4) % 8) + struct.pack(f'<{len(numbers)}d', *numbers)


_KINDS = (
    ('accel/counts', 'geometry_msgs/msg/Vector3Stamped', 3),
    ('temperature/board', 'sensor_msgs/msg/Temperature', 2),
    ('imu/uncompensated', 'sensor_msgs/msg/Imu', 37),
)


def _bag(compression: str) -> bytes:
    heads, messages = b'', b''
    for number, (topic, kind, width) in enumerate(_KINDS, 1):
        heads += _record(3, struct.pack('<H', number) + _text(kind) + _text('ros2msg') + _text(''))
        heads += _record(
            4, struct.pack('<HH', number, number) + _text(topic) + _text('cdr') + _text('')
        )
        for k in range(3):
            log_ns = START_NS + 10 * k + number
            content = cdr(log_ns, *range(k, k + width))
            messages += _record(5, struct.pack('<HIQQ', number, k, log_ns, log_ns) + content)
    plain = heads + messages
    packed = {'': plain, 'zstd': zstandard.compress(plain), 'lz4': lz4.frame.compress(plain)}
    body = struct.pack('<QQQI', START_NS, START_NS + 30, len(plain), 0) + _text(compression)
    content = packed[compression]
    chunk = _record(6, body + struct.pack('<Q', len(content)) + content)
    end = _record(15, bytes(4)) + _record(2, bytes(20))
    return MAGIC + _record(1, _text('ros2') + _text('')) + heads + chunk + end + MAGIC


def _messages() -> list[bytes]:
    readings = [(2, cdr(START_NS, 20.0, 0.0)), (3, cdr(START_NS, 21.0, 0.0))]
    counts = [(0, cdr(START_NS + k, 10.0 + k, 20.0, 2900.0)) for k in (1, 2)]
    imu = [(1, cdr(START_NS + 3, *map(float, range(37))))]
    foreign = [(0, b'\0\0\0\0' + bytes(12) + bytes(28))]
    seeds = []
    for rows in ([*readings, counts[0]], [*counts, *foreign], imu):
        seed = b''
        for kind, message in rows:
            padded = message + bytes(len(message) % 2)
            seed += bytes([kind, len(padded) // 2]) + padded
        seeds.append(seed)
    return seeds


def targets() -> dict[str, Target]:
    """Return the targets by name."""
    return {
        'calibration': Target(
            check_calibration,
            [SMALLEST, b'{unit: {serial: a}}', b'a: &a [*a]', b'[' * 20, b'a: 1e5'],
            1600,
        ),
        'mcap': Target(check_mcap, [_bag(''), _bag('zstd'), _bag('lz4')], 4096),
        'cdr': Target(check_cdr, _messages(), 340),
        'parameters': Target(check_parameters, [b'\4~nobody/unit.yaml', b'\4imu', b'\x4d'], 340),
        **file_targets(),
    }


def file_targets() -> dict[str, Target]:
    """Return the targets that need a file."""
    messages = [
        (topic, kind, START_NS + k, cdr(START_NS + k, *range(k, k + width)))
        for topic, kind, width in _KINDS
        for k in range(3)
    ]
    text, table = files.tables(START_NS)
    return {
        'db3': Target(files.check_database, [files.database(messages)], 16384),
        'zstd': Target(files.check_compressed, [files.compressed(_bag(''))], 4096),
        'csv': Target(files.check_csv, [text], 1024),
        'parquet': Target(files.check_parquet, [table], 8192),
    }
