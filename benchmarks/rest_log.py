# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures what the rest log costs the node: CPU time per sample with it and without.

    python benchmarks/rest_log.py [--rates 400 1000 10000] [--seconds 60]

The node runs in this process and a source of samples in another; the log is switched on and off
every second. Neighbouring seconds are compared, because a shared machine changes its pace. The
time of one block of sums, on the clock, is the longest that a sample can wait for it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# A domain that no user and no test has.
os.environ |= {'ROS_DOMAIN_ID': '87', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

import numpy as np
from node_relay import ROLES, ROOT, _calibration_for

from thermo_comp.ros.node import CompensationNode, node_in_thread
from thermo_comp.ros.relay import Relay
from thermo_comp.ros.rest_log import RestKeeper

MEETING_S = 6.0  # until source and node know each other [s]


def cost(
    node: CompensationNode, relay: Relay, keeper: RestKeeper, seconds: int
) -> tuple[list, list]:
    """Return CPU time per sample [us] of seconds with the log, and without."""
    found: tuple[list, list] = ([], [])
    for second in range(seconds):
        relay.gather()
        relay.rests, relay.waiting = (None, None) if second % 2 else (keeper, [])
        n_before, before = node.counts()[0], time.process_time()
        time.sleep(1.0)
        used = time.process_time() - before
        found[second % 2].append(used / (node.counts()[0] - n_before) * 1e6)
    return found


def measure(rate: int, seconds: int, folder: Path) -> None:
    """Print the figures of one rate."""
    calibration = _calibration_for(rate, folder)
    options = [f'--rate={rate}', '--reliability=best_effort', '--seconds=1', '--depth=100']
    source = subprocess.Popen(
        [sys.executable, str(ROLES), 'source', *options, f'--calibration={calibration}'],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
    )
    blocks: list[float] = []

    class Timed(RestKeeper):
        def gather(self, *given: object) -> None:
            before = time.perf_counter()
            super().gather(*given)
            blocks.append(1e3 * (time.perf_counter() - before))

    words = [f'calibration_file:={calibration}', f'rest_log:={folder}/{rate}']
    try:
        with node_in_thread(*[word for one in words for word in ('-p', one)]) as node:
            relay = node._relay  # noqa: SLF001 - the log can be switched on at start only
            keeper = relay.rests
            keeper.__class__ = Timed
            time.sleep(MEETING_S)
            blocks.clear()
            with_log, without = map(np.array, cost(node, relay, keeper, seconds))
            relay.rests, relay.waiting = keeper, []
    finally:
        source.kill()
        source.wait()
    more = with_log - without
    sd = more.std(ddof=1) / np.sqrt(len(more))
    whole = float(without.mean())
    print(
        f'{rate:6d} Hz: {whole:.1f} us per sample without, {more.mean():+.2f} +- {sd:.2f} us = '
        f'{more.mean() / whole:+.1%} +- {sd / whole:.1%} with the log; a block takes '
        f'{np.median(blocks):.2f} ms (median)',
        flush=True,
    )


def main() -> None:
    """Measure each rate."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--rates', type=int, nargs='+', default=(400, 1000, 10000))
    parser.add_argument('--seconds', type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for rate in arguments.rates:
            measure(rate, arguments.seconds // 2 * 2, Path(folder))


if __name__ == '__main__':
    main()
