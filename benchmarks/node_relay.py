# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the node against a naive relay: CPU time per sample, loss and latency, in one run.

    python benchmarks/node_relay.py [--quick] [--rates 400 2000] [--json FILE]

For each rate and reliability a source process publishes stamped samples at that rate and both
temperatures at 10 Hz, a sink process receives the Imu messages, and between them runs either the
node, with everything on, or the naive relay: an rclpy node that copies Vector3Stamped to Imu in a
callback. The CPU time is that of the whole relay process, all its threads, from the first sample
to the last; the latency runs from the source's publish call to the sink's take. The figures of
interest are the ratios; absolute ones depend on the machine and on what else it does.

"""

from __future__ import annotations

import argparse
import json
import os
import platform
import select
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RATES = (100, 400, 1000, 2000, 5000, 10000)
RELIABILITIES = ('best_effort', 'reliable')
DEPTH = 2000
#: The sink calls it a day when nothing came for this long.
SILENCE_S = 2.0

CALIBRATION = ROOT / 'config' / 'calibration.example.yaml'
COUNTS = struct.Struct('<4siII7s5x3d')
ENCAPSULATION = b'\0\1\0\0'
#: The frame_id goes through any relay: it tells the samples that count from those before them.
WARM_UP, SAMPLE = b'warmup\0', b'sensor\0'


def main() -> None:
    """
    Run all cases, or, in a subprocess, one role of one case.

    """
    arguments = _arguments()
    if arguments.role:
        _ROLES[arguments.role](arguments)
        return
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    results = []
    print(_machine(), flush=True)
    for rate in arguments.rates:
        for reliability in RELIABILITIES:
            naive, node = (
                _measure(relay, rate, reliability, arguments.seconds)
                for relay in ('naive', 'node')
            )
            _print_row(naive, node)
            results += [naive, node]
    document = {'machine': _machine(), 'seconds': arguments.seconds, 'results': results}
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(document, indent=1), encoding='utf-8')


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--quick', action='store_true', help='3 s per case, three rates')
    parser.add_argument('--seconds', type=float, help='length of each case (default 20)')
    parser.add_argument('--rates', type=int, nargs='+', help=f'default {RATES}')
    parser.add_argument('--json', help='write the figures to this file')
    parser.add_argument('--role', choices=tuple(_ROLES), help=argparse.SUPPRESS)
    parser.add_argument('--rate', type=int, help=argparse.SUPPRESS)
    parser.add_argument('--reliability', choices=RELIABILITIES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.seconds = arguments.seconds or (3.0 if arguments.quick else 20.0)
    arguments.rates = arguments.rates or ((400, 2000, 10000) if arguments.quick else RATES)
    return arguments


# --- the parent ----------------------------------------------------------------------------------


def _measure(relay: str, rate: int, reliability: str, seconds: float) -> dict[str, Any]:
    """
    Run one case: source, relay and sink as processes; return its figures.

    """
    options = ['--rate', str(rate), '--reliability', reliability, '--seconds', str(seconds)]
    with (
        _process(relay, options) as middle,
        _process('sink', options) as sink,
        _process('source', options) as source,
    ):
        assert source.stdin
        _expect(sink, 'ready')
        source.stdin.write('go\n')
        source.stdin.flush()
        _expect(source, 'start')
        before = _cpu_time(middle.pid)
        _expect(source, 'end')
        received = json.loads(_line(sink))
        cpu = _cpu_time(middle.pid) - before
    n_sent = round(rate * seconds)
    return {
        'relay': relay,
        'rate': rate,
        'reliability': reliability,
        'n_sent': n_sent,
        'n_lost': n_sent - received['n'],
        'cpu_us': cpu / received['n'] * 1e6,
        **{key: received[key] for key in ('p50_ms', 'p99_ms', 'p999_ms')},
    }


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    line = process.stdout.readline()
    if not line:
        sys.exit(f'{process.args} ended early')
    return line


def _expect(process: subprocess.Popen[str], word: str) -> None:
    line = _line(process).strip()
    assert line == word, line


@contextmanager
def _process(role: str, options: list[str]) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(Path(__file__).resolve()), '--role', role, *options]
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        yield process
    finally:
        assert process.stdin
        process.stdin.close()
        process.terminate()
        try:
            process.wait(timeout=3)
        except subprocess.TimeoutExpired:
            # rclpy.spin now and then sleeps through a signal.
            process.kill()


def _cpu_time(pid: int) -> float:
    """
    CPU time of another process, all threads, to the nanosecond (Linux: clock_getcpuclockid).

    """
    return time.clock_gettime((~pid << 3) | 2)


def _print_row(naive: dict[str, Any], node: dict[str, Any]) -> None:
    print(
        f'{node["rate"]:6d} Hz {node["reliability"]:11s} CPU/sample {node["cpu_us"]:6.1f} us = '
        f'{node["cpu_us"] / naive["cpu_us"]:.3f} x naive ({naive["cpu_us"]:6.1f})   '
        f'lost {node["n_lost"]} ({naive["n_lost"]})   p50/p99/p99.9 '
        + '/'.join(f'{node[key]:.2f}' for key in ('p50_ms', 'p99_ms', 'p999_ms'))
        + ' ms ('
        + '/'.join(f'{naive[key]:.2f}' for key in ('p50_ms', 'p99_ms', 'p999_ms'))
        + ')',
        flush=True,
    )


def _machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path('/proc/cpuinfo')
    if info.is_file():
        lines = info.read_text(encoding='utf-8').splitlines()
        model = next((line.split(':')[1].strip() for line in lines if 'model name' in line), model)
    return f'{model}, {os.cpu_count()} cores, Python {platform.python_version()}'


# --- the processes -------------------------------------------------------------------------------


def _qos(reliability: str) -> Any:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy[reliability.upper()])


def _source(arguments: argparse.Namespace) -> None:
    """
    Publish samples at the rate, temperatures at 10 Hz.

    """
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Temperature

    rclpy.init()
    node = rclpy.create_node('source')
    # Reliable, so that it matches either kind of subscription.
    counts = node.create_publisher(Vector3Stamped, 'accel/counts', _qos('reliable'))
    temperatures = [
        node.create_publisher(Temperature, f'temperature/{name}', _qos('reliable'))
        for name in ('board', 'case')
    ]
    reading = Temperature(temperature=21.0)

    def publish_temperatures() -> None:
        now = time.monotonic_ns()
        reading.header.stamp.sec, reading.header.stamp.nanosec = divmod(now, 1_000_000_000)
        for publisher in temperatures:
            publisher.publish(serialize_message(reading))

    def publish(frame: bytes) -> None:
        sec, nanosec = divmod(time.monotonic_ns(), 1_000_000_000)
        counts.publish(COUNTS.pack(ENCAPSULATION, sec, nanosec, 7, frame, 5.0, -3.0, 2940.0))

    def run(n: int, frame: bytes, until: Callable[[], bool]) -> None:
        period, tenth = 1e9 / arguments.rate, max(1, arguments.rate // 10)
        start = time.monotonic_ns()
        n_sent = 0
        while n_sent < n and not until():
            due = min(n, int((time.monotonic_ns() - start) / period) + 1)
            for index in range(n_sent, due):
                if index % tenth == 0:
                    publish_temperatures()
                publish(frame)
            n_sent = due
            wait = start + n_sent * period - time.monotonic_ns()
            if wait > 0:
                time.sleep(wait * 1e-9)

    # Warm up until the sink has seen something, and go on until then at the very rate.
    run(sys.maxsize, WARM_UP, lambda: bool(select.select([sys.stdin], [], [], 0)[0]))
    time.sleep(0.5)
    print('start', flush=True)
    run(round(arguments.rate * arguments.seconds), SAMPLE, lambda: False)
    print('end', flush=True)
    sys.stdin.read()


def _sink(arguments: argparse.Namespace) -> None:
    """
    Receive Imu messages until all are there or silence; print count and latency percentiles.

    """
    import numpy as np
    import rclpy
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.waitloop import WaitLoop

    rclpy.init()
    node = rclpy.create_node('sink')
    loop = WaitLoop(node)
    imu = loop.subscribe(Imu, 'imu/data_raw', _qos(arguments.reliability))
    stamp = struct.Struct('<iI')
    latencies: list[int] = []
    n_expected = round(arguments.rate * arguments.seconds)
    last = 0.0
    is_ready = False

    def on_data() -> None:
        nonlocal last, is_ready
        messages, _ = imu.drain()
        now = time.monotonic_ns()
        if messages and not is_ready:
            is_ready = True
            print('ready', flush=True)
        for data in messages:
            if data[16:23] == WARM_UP:
                continue
            sec, nanosec = stamp.unpack_from(data, 4)
            latencies.append(now - sec * 1_000_000_000 - nanosec)
        if latencies:
            last = time.monotonic()
        if len(latencies) >= n_expected:
            loop.stop()

    def check_silence() -> None:
        if latencies and time.monotonic() - last > SILENCE_S:
            loop.stop()

    node.create_timer(0.5, check_silence)
    loop.run(on_data)
    percentiles = np.percentile(latencies, (50, 99, 99.9)) * 1e-6
    figures = dict(zip(('p50_ms', 'p99_ms', 'p999_ms'), percentiles, strict=True))
    print(json.dumps({'n': len(latencies), **figures}), flush=True)


def _naive(arguments: argparse.Namespace) -> None:
    """
    Copy Vector3Stamped to Imu as the tutorials do it.

    """
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


def _node(arguments: argparse.Namespace) -> None:
    """
    Run the real node, with a calibration for this rate.

    """
    from dataclasses import replace

    from thermo_comp.calibration_file import load_calibration, save_calibration
    from thermo_comp.ros.node import main as run_node

    calibration = load_calibration(CALIBRATION)
    unit = replace(calibration.unit, cycle_time_s=1.0 / arguments.rate)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'unit.yaml'
        save_calibration(replace(calibration, unit=unit), path)
        overrides = [
            f'calibration_file:={path}',
            f'qos_overrides./accel/counts.subscription.reliability:={arguments.reliability}',
        ]
        command = [argument for override in overrides for argument in ('-p', override)]
        run_node(['thermo_comp_node', '--ros-args', '--log-level', 'WARN', *command])


_ROLES = {'source': _source, 'sink': _sink, 'naive': _naive, 'node': _node}

if __name__ == '__main__':
    main()
