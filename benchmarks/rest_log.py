# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the cost of the rest log: CPU time per sample and latency of the node with and without the
log.

    python benchmarks/rest_log.py [--rates 400 1000 10000] [--seconds 60]

The node runs in this process, source and sink of samples in two other processes; the rest log is
on in even seconds of the clock and off in odd seconds. Neighbouring seconds are compared, because
the speed of a shared machine changes. The latency is the time from the source's publish call to
the arrival in the sink's middleware. For the rest log the node sums samples in blocks; summing a
block delays the next sample. The time of summing a block is printed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

# A ROS domain that no user and no test uses.
os.environ |= {'ROS_DOMAIN_ID': '87', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

import numpy as np
from live_node import node_in_thread
from node_relay import (
    MEETING_S,
    _calibration_for,
    _cores_kept_awake,
    _expect,
    _line,
    _process,
    _say,
)

from thermo_comp.ros.node import CompensationNode
from thermo_comp.ros.relay import Relay
from thermo_comp.ros.rest_log import RestKeeper
from thermo_comp.typing import Floats


def cost(
    node: CompensationNode, relay: Relay, keeper: RestKeeper, seconds: int
) -> tuple[list[float], list[float]]:
    """Return CPU times per sample [us] in each second with the rest log, and in each without."""
    found: tuple[list[float], list[float]] = ([], [])
    time.sleep(2.0 - time.time() % 2.0)
    for _ in range(seconds):
        begin = time.time()
        is_off = int(begin) % 2
        relay.gather()
        relay.rests, relay.waiting = (None, None) if is_off else (keeper, [])
        n_before, before = node.counts()[0], time.process_time()
        time.sleep(int(begin) + 1.0005 - begin)
        used = time.process_time() - before
        found[is_off].append(used / (node.counts()[0] - n_before) * 1e6)
    return found


def tail_latencies(file: Path) -> tuple[Floats, Floats]:
    """Return 99th percentiles of the latency [ms]: of the even seconds, and of the odd seconds."""
    stamp_ns, latency_ns = np.load(file)
    second = stamp_ns // 1_000_000_000
    # Exclude the first and the last second, which are incomplete.
    seconds = np.unique(second)[1:-1]
    tails = np.array([np.percentile(latency_ns[second == at], 99) for at in seconds]) * 1e-6
    return tails[seconds % 2 == 0], tails[seconds % 2 == 1]


def measure(rate: int, seconds: int, folder: Path) -> None:
    """Measure the node at one sample rate [Hz], and print the results."""
    calibration = _calibration_for(rate, folder)
    latencies = folder / f'{rate}.npy'
    options = [f'--rate={rate}', '--reliability=best_effort', f'--seconds={seconds + 4}']
    options += ['--depth=100', f'--calibration={calibration}', f'--latencies={latencies}']
    blocks: list[float] = []

    class Timed(RestKeeper):
        def gather(self, *given: object) -> None:
            before = time.perf_counter()
            super().gather(*given)
            blocks.append(1e3 * (time.perf_counter() - before))

    words = [f'calibration_file:={calibration}', f'rest_log:={folder}/{rate}']
    with (
        _cores_kept_awake(False),
        node_in_thread(*[word for text in words for word in ('-p', text)]) as node,
        _process('sink', options) as sink,
        _process('source', options) as source,
    ):
        relay = node._relay  # noqa: SLF001 - users can switch the log on at start only
        keeper = relay.rests
        keeper.__class__ = Timed
        _expect(sink, 'ready')
        time.sleep(MEETING_S)
        _say(source, 'go')
        _expect(source, 'start')
        blocks.clear()
        with_log, without = map(np.array, cost(node, relay, keeper, seconds))
        relay.rests, relay.waiting = keeper, []
        _expect(source, 'end')
        _line(sink)
    print(
        f'{rate:6d} Hz: CPU {_compared(with_log, without, "us")}, '
        f'p99 {_compared(*tail_latencies(latencies), "ms")}; '
        f'summing a block takes {np.median(blocks):.2f} ms (median)',
        flush=True,
    )


def _compared(with_log: Floats, without: Floats, unit: str) -> str:
    """Format the median of CPU time or latency without the log, and its change by the log."""
    n = min(len(with_log), len(without))
    more, usual = with_log[:n] - without[:n], float(np.median(without))
    # Medians, because the host may stop the machine and so make some seconds outliers.
    sd = 1.2533 * 1.4826 * float(np.median(np.abs(more - np.median(more)))) / np.sqrt(n)
    change = float(np.median(more))
    more_by = f'{change / usual:+.1%} +- {sd / usual:.1%}'
    return f'{usual:.3g} {unit} without the log, {more_by} with the log'


def main() -> None:
    """Measure the node with and without the rest log at each sample rate."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    rates = (400, 1000, 10000)
    parser.add_argument('--rates', type=int, nargs='+', default=rates, help='sample rates [Hz]')
    parser.add_argument('--seconds', type=int, default=60, help='length of a measurement [s]')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for rate in arguments.rates:
            measure(rate, arguments.seconds // 2 * 2, Path(folder))


if __name__ == '__main__':
    main()
