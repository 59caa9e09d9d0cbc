# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compares the node with a naive relay: CPU time per sample, lost samples and latency.

    python benchmarks/node_relay.py [--quick] [--floor] [--core 1] [--sleep] [--rates 400]

For each rate and reliability a source process publishes stamped samples at this rate and both
temperatures at 10 Hz, and a sink process receives the Imu messages. Between source and sink runs
either the node, with all functions, or the naive relay: an rclpy node that copies Vector3Stamped
to Imu in a callback. The CPU time is that of all threads of the relay process, from the first
sample to the last. The latency is the time from the source's publish call to the arrival in the
sink's middleware, before any Python code of the sink runs. The ratios node / naive relay of CPU
times vary less between machines than the CPU times. The node uses its profile for Fast DDS;
source, sink and naive relay use the default profile. At the last rate the node is measured once
more while the parameter `calibration_file` is set twice a second. `--core` binds each relay to a
core. `--floor` also measures a third relay, which copies the bytes of each message to Imu in a
loop over a wait set, with the node's profile, and computes nothing.

The source keeps `--depth` samples to send lost samples again. With a reliable relay Fast DDS
removes samples from the source's store 859 at a time; with 2000 kept samples the removal delays
the source by 1 to 3 ms, with the node and with the naive relay.

Processes that missed each other's first DDS announcements discover each other at the next
announcements, 3 s later. Fast DDS may block a process for a third of a second
when the process opens the shared memory of another one. The measurement begins when all processes
have discovered each other.

An idle core sleeps and needs time to wake up, and the host may use an idle virtual core for other
machines. On Linux, as root, all cores are kept awake for all relays, by a request for a wake-up
time of 0 us in /dev/cpu_dma_latency, as in cyclictest; with `--sleep` the cores may sleep. The
host may stop a virtual machine with all its processes. "stolen" at the end of each row is the
percentage of time for which the machine was stopped. Above some percent the latencies are mainly
due to the host.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from relay_roles import RELIABILITIES

import thermo_comp

ROOT = Path(__file__).resolve().parent.parent
RATES = (100, 400, 1000, 2000, 5000, 10000)
ROLES = ROOT / 'benchmarks' / 'relay_roles.py'
# Wait for discovery [s]: the 3 s between DDS announcements, and a third of a second for each of
# source, relay and sink.
MEETING_S = 4.0
# While this file is open, the 32-bit number in it limits the wake-up time of the cores [us].
LATENCY_REQUEST = Path('/dev/cpu_dma_latency')
CALIBRATION = ROOT / 'config' / 'calibration.example.yaml'


def main() -> None:
    """Run all combinations of rate, reliability and relay."""
    arguments = _arguments()
    os.environ['ROS_DOMAIN_ID'] = str(81 + os.getpid() % 21)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    cases: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, _cores_kept_awake(arguments.sleep) as awake:
        machine = f'{_machine()}, cores {"kept awake" if awake else "may sleep"}'
        print(machine, flush=True)
        for rate in arguments.rates:
            calibration = _calibration_for(rate, Path(folder))
            for reliability in RELIABILITIES:
                options = [f'--rate={rate}', f'--reliability={reliability}']
                options += [f'--seconds={arguments.seconds}', f'--core={arguments.core}']
                options += [f'--calibration={calibration}', f'--depth={arguments.depth}']
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
        'machine': machine,
        **{name: getattr(arguments, name) for name in ('seconds', 'repeats', 'core', 'depth')},
        'cases': cases,
        'reload': {'rate': rate, **reload},
    }
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(document, indent=1), encoding='utf-8')


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--quick', action='store_true', help='three rates, one run of 3 s each')
    parser.add_argument('--seconds', type=float, help='length of a run [s] (default 10)')
    parser.add_argument('--repeats', type=int, help='runs of each case (default 3)')
    parser.add_argument('--rates', type=int, nargs='+', help=f'default {RATES}')
    parser.add_argument(
        '--floor', action='store_true', help='also measure a relay that only copies bytes'
    )
    parser.add_argument('--core', type=int, default=-1, help='core of the relays (default any)')
    parser.add_argument('--depth', type=int, default=100, help='samples kept to resend (100)')
    parser.add_argument('--sleep', action='store_true', help='let idle cores sleep')
    parser.add_argument('--json', help='file for the figures')
    arguments = parser.parse_args()
    arguments.seconds = arguments.seconds or (3.0 if arguments.quick else 10.0)
    arguments.repeats = arguments.repeats or (1 if arguments.quick else 3)
    arguments.rates = arguments.rates or ((400, 2000, 10000) if arguments.quick else RATES)
    return arguments


def _calibration_for(rate: int, folder: Path) -> str:
    """Write the example calibration with `rate` conversion cycles per second; return its path."""
    from dataclasses import replace

    from thermo_comp.unit.calibration_file import load_calibration, save_calibration

    calibration = load_calibration(CALIBRATION)
    unit = replace(calibration.unit, cycle_time_s=1.0 / rate)
    path = folder / f'unit_{rate}.yaml'
    save_calibration(replace(calibration, unit=unit), path)
    return str(path)


def _measure(
    relay: str, rate: int, seconds: float, options: list[str], *, reloads: bool = False
) -> dict[str, Any]:
    """Run source, relay and sink once as processes; return losses, CPU time and latencies."""
    with ExitStack() as stack:
        middle, sink, source = (
            stack.enter_context(_process(role, options)) for role in (relay, 'sink', 'source')
        )
        _expect(sink, 'ready')
        reloader = stack.enter_context(_process('reloader', options)) if reloads else None
        if reloader:
            _expect(reloader, 'ready')
        time.sleep(MEETING_S)
        _say(source, 'go')
        _expect(source, 'start')
        before, times = _cpu_time(middle.pid), _machine_time()
        _expect(source, 'end')
        stolen, spent = (new - old for new, old in zip(_machine_time(), times, strict=True))
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
        'stolen': stolen / spent if spent else 0.0,
        **received,
    }


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the sum over runs of lost samples, and the medians of CPU time and latencies."""
    summary = {name: sum(run[name] for run in runs) for name in ('n_sent', 'n_lost')}
    for name in ('cpu_us', 'stolen', 'p50_ms', 'p99_ms', 'p999_ms'):
        summary[name] = statistics.median(run[name] for run in runs)
    return summary


def _ratio(runs: list[dict[str, Any]], naive: list[dict[str, Any]]) -> float:
    """
    Return the median over runs of CPU time / CPU time of the neighbouring run of the naive relay.

    Neighbouring runs are compared, because the speed of a shared machine changes over minutes.
    """
    return statistics.median(
        run['cpu_us'] / other['cpu_us'] for run, other in zip(runs, naive, strict=True)
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
def _cores_kept_awake(may_sleep: bool) -> Iterator[bool]:
    """Keep the cores awake while the context is open; yield whether the system allows this."""
    with ExitStack() as stack:
        asked = False
        if not may_sleep:
            with suppress(OSError):
                request = stack.enter_context(LATENCY_REQUEST.open('wb', buffering=0))
                request.write((0).to_bytes(4, sys.byteorder))
                asked = True
        yield asked


@contextmanager
def _process(role: str, options: list[str]) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(ROLES), role, *options]
    # The process imports the package that this script imports, even if it is not installed.
    environment = {**os.environ, 'PYTHONPATH': str(Path(thermo_comp.__file__).parents[1])}
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
            # Kill the process, as rclpy.spin sometimes misses SIGTERM.
            process.kill()


def _cpu_time(pid: int) -> float:
    """Return the CPU time of all threads of a process [ns] (Linux: clock_getcpuclockid)."""
    return time.clock_gettime((~pid << 3) | 2)


def _machine_time() -> tuple[int, int]:
    """Return ticks stolen by the host and all ticks since boot, each summed over the cores."""
    file = Path('/proc/stat')
    if not file.is_file():
        return 0, 0
    # /proc/stat begins with the times: user nice system idle iowait irq softirq steal.
    ticks = [int(field) for field in file.read_text(encoding='utf-8').split()[1:9]]
    return ticks[7], sum(ticks)


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
        f'p50/p99/p99.9 {latencies[0]} ms ({latencies[1]})   '
        f'stolen {node["stolen"]:.1%} ({naive["stolen"]:.1%})'
        + (f'   floor {case["floor"]["cpu_ratio"]:.3f}' if 'floor' in case else ''),
        flush=True,
    )


def _print_reload(rate: int, run: dict[str, Any]) -> None:
    times = run['reload_ms']
    print(
        f'{rate:6d} Hz with {len(times)} reloads: answered in {statistics.median(times):.1f} ms '
        f'(median), {max(times):.1f} ms (longest); lost {run["n_lost"]}; '
        f'p99 {run["p99_ms"]:.2f} ms; stolen {run["stolen"]:.1%}'
    )


def _machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path('/proc/cpuinfo')
    if info.is_file():
        lines = info.read_text(encoding='utf-8').splitlines()
        model = next((line.split(':')[1].strip() for line in lines if 'model name' in line), model)
    return f'{model}, {os.cpu_count()} cores, Python {platform.python_version()}'


if __name__ == '__main__':
    main()
