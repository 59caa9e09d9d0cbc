# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the node against a naive relay: CPU time per sample, loss and latency, in one run.

    python benchmarks/node_relay.py [--quick] [--floor] [--core 1] [--rates 400 2000] [--json FILE]

For each rate and reliability a source process publishes stamped samples at that rate and both
temperatures at 10 Hz, a sink process receives the Imu messages, and between them runs either the
node, with everything on, or the naive relay: an rclpy node that copies Vector3Stamped to Imu in a
callback. The CPU time is that of the whole relay process, all its threads, from the first sample
to the last; the latency runs from the source's publish call to the arrival in the sink's
middleware, before any Python of the sink. Only ratios travel. The node brings its own profile for
Fast DDS; source, sink and naive relay run without one. At the last rate the node is measured once
more while its `calibration_file` is set twice a second. `--core` keeps each relay to that core,
the node by its `cpu_affinity`. `--floor` measures a third relay, too: one wait set, one
subscription, bytes copied, nothing computed, the node's profile.

"""

from __future__ import annotations

import argparse
import json
import os
import platform
import select
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from thermo_comp import is_compiled

ROOT = Path(__file__).resolve().parent.parent
RATES = (100, 400, 1000, 2000, 5000, 10000)
RELIABILITIES = ('best_effort', 'reliable')
DEPTH = 2000
#: The sink calls it a day when nothing came for this long.
SILENCE_S = 2.0
#: The first sample may take this long.
PATIENCE_S = 30.0
#: It looks this often for what has arrived.
SINK_REST_S = 2e-3

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
        if arguments.role in ('naive', 'floor') and arguments.core >= 0:
            os.sched_setaffinity(0, {arguments.core})
        _ROLES[arguments.role](arguments)
        return
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    print(_machine(), flush=True)
    cases: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for rate in arguments.rates:
            calibration = _calibration_for(rate, Path(folder))
            for reliability in RELIABILITIES:
                options = [f'--rate={rate}', f'--reliability={reliability}']
                options += [f'--seconds={arguments.seconds}', f'--core={arguments.core}']
                options += [f'--calibration={calibration}']
                relays = ('naive', 'node', 'floor') if arguments.floor else ('naive', 'node')
                runs: dict[str, list[dict[str, Any]]] = {relay: [] for relay in relays}
                for _ in range(arguments.repeats):
                    for relay, done in runs.items():
                        done.append(_measure(relay, rate, arguments.seconds, options))
                case: dict[str, Any] = {'rate': rate, 'reliability': reliability}
                case |= {relay: _summary(done) for relay, done in runs.items()}
                for relay in relays[1:]:
                    case[relay]['cpu_ratio'] = _ratio(runs[relay], runs['naive'])
                _print_row(case)
                cases.append(case)
        reload = _measure('node', rate, arguments.seconds, options, reloads=True)
        _print_reload(rate, reload)
    document = {
        'machine': _machine(),
        **{name: getattr(arguments, name) for name in ('seconds', 'repeats', 'core')},
        'cases': cases,
        'reload': {'rate': rate, **reload},
    }
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(document, indent=1), encoding='utf-8')


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--quick', action='store_true', help='3 s, once, three rates')
    parser.add_argument('--seconds', type=float, help='length of a run (default 10)')
    parser.add_argument('--repeats', type=int, help='runs of each case (default 3)')
    parser.add_argument('--rates', type=int, nargs='+', help=f'default {RATES}')
    parser.add_argument('--floor', action='store_true', help='a loop that only copies, too')
    parser.add_argument('--core', type=int, default=-1, help='core for the relays (default any)')
    parser.add_argument('--json', help='write the figures to this file')
    parser.add_argument('--role', choices=tuple(_ROLES), help=argparse.SUPPRESS)
    parser.add_argument('--rate', type=int, help=argparse.SUPPRESS)
    parser.add_argument('--reliability', choices=RELIABILITIES, help=argparse.SUPPRESS)
    parser.add_argument('--calibration', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.seconds = arguments.seconds or (3.0 if arguments.quick else 10.0)
    arguments.repeats = arguments.repeats or (1 if arguments.quick else 3)
    arguments.rates = arguments.rates or ((400, 2000, 10000) if arguments.quick else RATES)
    return arguments


# --- the parent ----------------------------------------------------------------------------------


def _calibration_for(rate: int, folder: Path) -> str:
    """
    Write the example's calibration for a unit of this rate.

    """
    from dataclasses import replace

    from thermo_comp.calibration_file import load_calibration, save_calibration

    calibration = load_calibration(CALIBRATION)
    unit = replace(calibration.unit, cycle_time_s=1.0 / rate)
    path = folder / f'unit_{rate}.yaml'
    save_calibration(replace(calibration, unit=unit), path)
    return str(path)


def _measure(
    relay: str, rate: int, seconds: float, options: list[str], *, reloads: bool = False
) -> dict[str, Any]:
    """
    Run source, relay and sink as processes once; return the figures.

    """
    with ExitStack() as stack:
        middle, sink, source = (
            stack.enter_context(_process(role, options)) for role in (relay, 'sink', 'source')
        )
        _expect(sink, 'ready')
        reloader = stack.enter_context(_process('reloader', options)) if reloads else None
        if reloader:
            _expect(reloader, 'ready')
        _say(source, 'go')
        _expect(source, 'start')
        before = _cpu_time(middle.pid)
        _expect(source, 'end')
        received = json.loads(_line(sink))
        cpu = _cpu_time(middle.pid) - before
        if reloader:
            _say(reloader, 'enough')
            received['reload_ms'] = json.loads(_line(reloader))
    n_sent = round(rate * seconds)
    n_received = received.pop('n')
    return {
        'n_sent': n_sent,
        'n_lost': n_sent - n_received,
        'cpu_us': cpu / n_received * 1e6,
        **received,
    }


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """
    Sum up the loss; take the medians of CPU time and latencies.

    """
    summary = {name: sum(run[name] for run in runs) for name in ('n_sent', 'n_lost')}
    for name in ('cpu_us', 'p50_ms', 'p99_ms', 'p999_ms'):
        summary[name] = statistics.median(run[name] for run in runs)
    return summary


def _ratio(runs: list[dict[str, Any]], naive: list[dict[str, Any]]) -> float:
    """
    Compare each run's CPU time with that of the naive relay just before it; return the median.

    A machine changes its pace over minutes, by more than what is to be told apart.

    """
    return statistics.median(
        one['cpu_us'] / other['cpu_us'] for one, other in zip(runs, naive, strict=True)
    )


def _say(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdin
    print(word, file=process.stdin, flush=True)


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    line = process.stdout.readline()
    if not line:
        sys.exit(f'{process.args} ended early')
    return line


def _expect(process: subprocess.Popen[str], word: str) -> None:
    assert (line := _line(process).strip()) == word, line


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


def _print_row(case: dict[str, Any]) -> None:
    naive, node = case['naive'], case['node']
    latencies = [
        '/'.join(f'{relay[key]:.2f}' for key in ('p50_ms', 'p99_ms', 'p999_ms'))
        for relay in (node, naive)
    ]
    print(
        f'{case["rate"]:6d} Hz {case["reliability"]:11s} CPU/sample {node["cpu_us"]:6.1f} us = '
        f'{node["cpu_ratio"]:.3f} x naive ({naive["cpu_us"]:6.1f})   '
        f'lost {node["n_lost"]} ({naive["n_lost"]})   '
        f'p50/p99/p99.9 {latencies[0]} ms ({latencies[1]})'
        + (f'   floor {case["floor"]["cpu_ratio"]:.3f}' if 'floor' in case else ''),
        flush=True,
    )


def _print_reload(rate: int, run: dict[str, Any]) -> None:
    times = run['reload_ms']
    print(
        f'{rate:6d} Hz with {len(times)} reloads: answered in {statistics.median(times):.1f} ms '
        f'(median), {max(times):.1f} ms (worst); lost {run["n_lost"]}; p99 {run["p99_ms"]:.2f} ms'
    )


def _machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path('/proc/cpuinfo')
    if info.is_file():
        lines = info.read_text(encoding='utf-8').splitlines()
        model = next((line.split(':')[1].strip() for line in lines if 'model name' in line), model)
    core = 'compiled' if is_compiled() else 'interpreted'
    python = platform.python_version()
    return f'{model}, {os.cpu_count()} cores, Python {python}, {core} core'


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
        now = time.time_ns()
        reading.header.stamp.sec, reading.header.stamp.nanosec = divmod(now, 1_000_000_000)
        for publisher in temperatures:
            publisher.publish(serialize_message(reading))

    def publish(index: int, frame: bytes) -> None:
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        # A unit that stands, with a count or two of noise: anything else the node would doubt.
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

    The middleware notes when each message arrived, so they may wait here: a sink that woke up for
    each would take the relay's core away.

    """
    import numpy as np
    import rclpy
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.waitloop import WaitLoop

    rclpy.init()
    loop = WaitLoop(rclpy.create_node('sink'))
    imu = loop.subscribe(Imu, 'imu/data_raw', _qos(arguments.reliability))
    stamp = struct.Struct('<iI')
    latencies: list[int] = []
    n_expected = round(arguments.rate * arguments.seconds)
    last = time.monotonic() + PATIENCE_S
    is_ready = False
    while len(latencies) < n_expected and time.monotonic() - last < SILENCE_S:
        time.sleep(SINK_REST_S)
        messages, received_ns = imu.drain()
        if messages and not is_ready:
            is_ready = True
            print('ready', flush=True)
        for data, received in zip(messages, received_ns, strict=True):
            if data[16:23] != WARM_UP:
                sec, nanosec = stamp.unpack_from(data, 4)
                latencies.append(received - sec * 1_000_000_000 - nanosec)
        if messages and latencies:
            last = time.monotonic()
    loop.close()
    if not latencies:
        sys.exit('nothing came out of the relay')
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


def _floor(arguments: argparse.Namespace) -> None:
    """
    Copy the bytes of one subscription to a publisher around one wait set.

    """
    import rclpy
    from geometry_msgs.msg import Vector3Stamped
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from sensor_msgs.msg import Imu

    from thermo_comp.ros.middleware import use_profile

    use_profile()
    rclpy.init()
    node = rclpy.create_node('floor')
    publisher = node.create_publisher(Imu, 'imu/data_raw', _qos('reliable'))
    subscription = node.create_subscription(
        Vector3Stamped, 'accel/counts', print, _qos(arguments.reliability), raw=True
    )
    take, publish = subscription.handle.take_message, publisher.handle.publish_raw
    # The frame_id of both kinds of samples is as long, so the values always stand at the end.
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
    """
    Run the real node.

    """
    from thermo_comp.ros.node import main as run_node

    overrides = [
        f'calibration_file:={arguments.calibration}',
        f'cpu_affinity:={arguments.core}',
        f'qos_overrides./accel/counts.subscription.reliability:={arguments.reliability}',
    ]
    command = [argument for override in overrides for argument in ('-p', override)]
    run_node(['thermo_comp_node', '--ros-args', '--log-level', 'FATAL', *command])


def _reloader(arguments: argparse.Namespace) -> None:
    """
    Set `calibration_file` again and again; print how long each answer took.

    """
    import rclpy
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    rclpy.init()
    node = rclpy.create_node('reloader')
    client = node.create_client(SetParameters, 'thermo_comp/set_parameters')
    client.wait_for_service()
    value = Parameter('calibration_file', value=arguments.calibration).to_parameter_msg()
    times: list[float] = []
    print('ready', flush=True)
    while not select.select([sys.stdin], [], [], 0.5)[0]:
        start = time.monotonic()
        future = client.call_async(SetParameters.Request(parameters=[value]))
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        assert future.result().results[0].successful
        times.append((time.monotonic() - start) * 1e3)
    print(json.dumps(times), flush=True)
    sys.stdin.read()


_ROLES = {
    'source': _source,
    'sink': _sink,
    'naive': _naive,
    'floor': _floor,
    'node': _node,
    'reloader': _reloader,
}

if __name__ == '__main__':
    main()
