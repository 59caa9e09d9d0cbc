# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Contains the processes that `node_relay.py` runs side by side: source, relays, sink, reloader.

The processes communicate with their parent by lines on standard input and output, and with each
other by DDS.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import select
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

RELIABILITIES = ('best_effort', 'reliable')
DEPTH = 2000
#: Time without a new message after which the sink ends [s].
SILENCE_S = 2.0
#: Longest wait of the sink for the first message [s].
PATIENCE_S = 30.0
#: Interval at which the sink checks for arrived messages [s].
SINK_REST_S = 2e-3

COUNTS = struct.Struct('<4siII7s5x3d')
ENCAPSULATION = b'\0\1\0\0'
#: frame_id of warm-up samples, and of samples that the sink counts; relays copy the frame_id.
WARM_UP, SAMPLE = b'warmup\0', b'sensor\0'


def _qos(reliability: str, depth: int = DEPTH) -> Any:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability.upper()])


def _source(arguments: argparse.Namespace) -> None:
    """Publish samples at the rate of the options, and temperatures at 10 Hz."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Temperature

    rclpy.init()
    node = rclpy.create_node('source')
    # A reliable publisher matches reliable and best-effort subscriptions.
    qos = _qos('reliable', arguments.depth)
    counts = node.create_publisher(Vector3Stamped, 'accel/counts', qos)
    temperatures = [
        node.create_publisher(Temperature, f'temperature/{name}', _qos('reliable'))
        for name in ('board', 'case')
    ]
    reading = Temperature(temperature=21.0)

    def publish_temperatures() -> None:
        now = time.time_ns()
        reading.header.stamp.sec, reading.header.stamp.nanosec = divmod(now, 1_000_000_000)
        for publisher in temperatures:
            publisher.publish(serialize_message(reading))

    def publish(index: int, frame: bytes) -> None:
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        # The samples vary by some counts, because the node rejects samples that stay constant.
        x, y, z = 5.0 + index % 3, -3.0 + index % 2, 2950.0 + index % 5
        counts.publish(COUNTS.pack(ENCAPSULATION, sec, nanosec, 7, frame, x, y, z))

    def run(n: int, frame: bytes, until: Callable[[], bool]) -> None:
        period, tenth = 1e9 / arguments.rate, max(1, arguments.rate // 10)
        start = time.monotonic_ns()
        n_sent = 0
        while n_sent < n and not until():
            due = min(n, int((time.monotonic_ns() - start) / period) + 1)
            for index in range(n_sent, due):
                if index % tenth == 0:
                    publish_temperatures()
                publish(index, frame)
            n_sent = due
            wait = start + n_sent * period - time.monotonic_ns()
            if wait > 0:
                time.sleep(wait * 1e-9)

    # Publish warm-up samples, which the sink does not count, until it has received a message.
    run(sys.maxsize, WARM_UP, lambda: bool(select.select([sys.stdin], [], [], 0)[0]))
    time.sleep(0.5)
    print('start', flush=True)
    run(round(arguments.rate * arguments.seconds), SAMPLE, lambda: False)
    print('end', flush=True)
    sys.stdin.read()


def _sink(arguments: argparse.Namespace) -> None:
    """
    Receive Imu messages until all have arrived or none arrives for `SILENCE_S`; print the number
    of messages and percentiles of the latency.

    The middleware stores the time of arrival of each message, so the sink may take messages later;
    a sink that wakes up for each message would disturb the relay.
    """
    import numpy as np
    import rclpy
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.waitloop import WaitLoop

    rclpy.init()
    loop = WaitLoop(rclpy.create_node('sink'))
    imu = loop.subscribe(Imu, 'imu/data_raw', _qos(arguments.reliability))
    stamp = struct.Struct('<iI')
    stamps: list[int] = []
    latencies: list[int] = []
    n_expected = round(arguments.rate * arguments.seconds)
    last = time.monotonic() + PATIENCE_S
    is_ready = False
    while len(latencies) < n_expected and time.monotonic() - last < SILENCE_S:
        time.sleep(SINK_REST_S)
        messages, received_ns, _ = imu.drain()
        if messages and not is_ready:
            is_ready = True
            print('ready', flush=True)
        for data, received in zip(messages, received_ns, strict=True):
            if data[16:23] != WARM_UP:
                sec, nanosec = stamp.unpack_from(data, 4)
                stamps.append(sec * 1_000_000_000 + nanosec)
                latencies.append(received - stamps[-1])
        if messages and latencies:
            last = time.monotonic()
    if not latencies:
        sys.exit('nothing came out of the relay')
    if arguments.latencies:
        np.save(arguments.latencies, np.array((stamps, latencies)))
    percentiles = np.percentile(latencies, (50, 99, 99.9)) * 1e-6
    figures = dict(zip(('p50_ms', 'p99_ms', 'p999_ms'), percentiles, strict=True))
    print(json.dumps({'n': len(latencies), **figures}), flush=True)


def _naive(arguments: argparse.Namespace) -> None:
    """Copy Vector3Stamped to Imu in a callback, as in the ROS tutorials."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import Imu

    rclpy.init()
    node = rclpy.create_node('naive')
    publisher = node.create_publisher(Imu, 'imu/data_raw', _qos('reliable'))

    def callback(message: Any) -> None:
        imu = Imu()
        imu.header = message.header
        imu.linear_acceleration.x = message.vector.x
        imu.linear_acceleration.y = message.vector.y
        imu.linear_acceleration.z = message.vector.z
        publisher.publish(imu)

    node.create_subscription(Vector3Stamped, 'accel/counts', callback, _qos(arguments.reliability))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def _floor(arguments: argparse.Namespace) -> None:
    """Copy the bytes of each message to an Imu message, in a loop over an rclpy wait set."""
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.process import use_profile

    use_profile()
    rclpy.init()
    node = rclpy.create_node('floor')
    publisher = node.create_publisher(Imu, 'imu/data_raw', _qos('reliable'))
    subscription = node.create_subscription(
        Vector3Stamped, 'accel/counts', print, _qos(arguments.reliability), raw=True
    )
    take, publish = subscription.handle.take_message, publisher.handle.publish_raw
    # Both frame_ids have 7 bytes, so x, y and z of a sample have the same offset in all messages.
    head, frame = COUNTS.size - 24, bytearray(COUNTS.size - 24 + 37 * 8)
    with subscription.handle, node.context.handle:
        wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
        while True:
            wait_set.clear_entities()
            wait_set.add_subscription(subscription.handle)
            wait_set.wait(-1)
            while (taken := take(Vector3Stamped, True)) is not None:
                frame[:head] = taken[0][:head]
                frame[-96:-72] = taken[0][head:]
                publish(bytes(frame))


def _node(arguments: argparse.Namespace) -> None:
    """Run the node of thermo_comp."""
    from thermo_comp.ros.node import main as run_node

    overrides = [
        f'calibration_file:={arguments.calibration}',
        f'qos_overrides./accel/counts.subscription.reliability:={arguments.reliability}',
    ]
    command = [argument for override in overrides for argument in ('-p', override)]
    run_node(['thermo_comp_node', '--ros-args', '--log-level', 'FATAL', *command])


def _reloader(arguments: argparse.Namespace) -> None:
    """
    Set `calibration_file` twice a second, in turn to a calibration and to the largest file that
    the node parses before it refuses the file; print the time until each answer [ms].
    """
    import rclpy
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    from thermo_comp.plain_yaml import NODE_LIMIT
    from thermo_comp.unit.calibration_file import SIZE_LIMIT

    rclpy.init()
    node = rclpy.create_node('reloader')
    client = node.create_client(SetParameters, 'thermo_comp/set_parameters')
    client.wait_for_service()
    times: list[float] = []
    print('ready', flush=True)
    with tempfile.TemporaryDirectory() as folder:
        worst = Path(folder) / 'worst.yaml'
        worst.write_text('a:\n' + '- [[], {}]\n' * (NODE_LIMIT // 7) + '#' * (SIZE_LIMIT // 2))
        files = itertools.cycle([arguments.calibration, str(worst)])
        while not select.select([sys.stdin], [], [], 0.5)[0]:
            path = next(files)
            value = Parameter('calibration_file', value=path).to_parameter_msg()
            start = time.monotonic()
            future = client.call_async(SetParameters.Request(parameters=[value]))
            rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
            assert future.result().results[0].successful == (path == arguments.calibration)
            times.append((time.monotonic() - start) * 1e3)
    print(json.dumps(times), flush=True)
    sys.stdin.read()


ROLES = {
    'source': _source,
    'sink': _sink,
    'naive': _naive,
    'floor': _floor,
    'node': _node,
    'reloader': _reloader,
}


def main() -> None:
    """Run the process with the given role."""
    parser = argparse.ArgumentParser(description='One process of node_relay.py.')
    parser.add_argument('role', choices=tuple(ROLES))
    parser.add_argument('--rate', type=int, required=True)
    parser.add_argument('--reliability', choices=RELIABILITIES, required=True)
    parser.add_argument('--seconds', type=float, required=True)
    parser.add_argument('--core', type=int, default=-1)
    parser.add_argument('--depth', type=int, required=True)
    parser.add_argument('--calibration', required=True)
    parser.add_argument('--latencies', help='file for the stamp and latency [ns] of each sample')
    arguments = parser.parse_args()
    if arguments.role in ('naive', 'floor', 'node') and arguments.core >= 0:
        os.sched_setaffinity(0, {arguments.core})
    ROLES[arguments.role](arguments)


if __name__ == '__main__':
    main()
