# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the cost of a fit: CPU time and peak memory of fitting n bags, compared with reading the
bags, and the exponent p of CPU time ~ (number of samples)^p.

Bags of four hours are simulated once and written to disk. Reading and fitting run in separate
processes, so that the peak memory of each is measured.

    python benchmarks/fit_scaling.py --bags 6 12 24 --rate-hz 100
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate_blocks
from thermo_comp.unit.gravity import STANDARD_GRAVITY


def write_bags(folder: Path, n_bags: int, rate_hz: float) -> list[Path]:
    """Simulate the chamber program in each position, and write a bag per position."""
    from thermo_comp.recording.writer import BagWriter

    unit = unit_preset('thermostatted', 1)
    paths = []
    for number, up in enumerate(positions(n_bags, 1)):
        path = folder / f'position-{number:02d}.mcap'
        with BagWriter(path, metadata={'serial': unit.serial}) as bag:
            program = parse_cyclogram('chamber')
            for run in simulate_blocks(unit, program, up, rate_hz=rate_hz, seed=number):
                counts = run.counts.astype(np.float64)
                bag.write_counts('accel/counts', run.accel_stamp_ns, counts, 'accel_link')
                bag.write_temperature('temperature/board', run.board_stamp_ns, run.board)
                bag.write_temperature('temperature/case', run.case_stamp_ns, run.case)
                bag.flush()
        paths.append(path)
    return paths


def measure(task: str, paths: list[Path]) -> dict[str, float]:
    """Run a task ('read' or 'fit') in a separate process; return its CPU time and peak memory."""
    done = subprocess.run(
        [sys.executable, __file__, '--task', task, *map(str, paths)],
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        # A process that the system has killed, e.g. for lack of memory, prints nothing.
        lines = done.stderr.splitlines() or [f'exit code {done.returncode}']
        sys.exit(f'{task} of {len(paths)} bags failed: {lines[-1]}')
    return dict(json.loads(done.stdout))


def run_task(task: str, paths: list[Path]) -> dict[str, float]:
    """Read the bags, or fit them; return CPU time, peak memory and number of samples."""
    from thermo_comp.fitting import FitOptions, fit
    from thermo_comp.fitting.sources import fit_sources

    sources, _ = fit_sources(paths)
    began = time.process_time()
    n_samples = 0
    if task == 'read':
        for source in sources:
            for block in source.blocks():
                n_samples += len(block.accel_stamp_ns)
    else:
        result = fit(sources, FitOptions(gravity=STANDARD_GRAVITY))
        n_samples = sum(bag.n_samples for bag in result.bags)
    return {
        'seconds': time.process_time() - began,
        'peak_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        'n_samples': n_samples,
    }


def main() -> int:
    """Simulate bags, read and fit them, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('paths', nargs='*', type=Path, help=argparse.SUPPRESS)
    parser.add_argument('--task', choices=['read', 'fit'], help=argparse.SUPPRESS)
    parser.add_argument('--bags', type=int, nargs='+', default=[6, 12, 24], help='bags per fit')
    parser.add_argument('--rate-hz', type=float, default=100.0, help='samples per second')
    options = parser.parse_args()
    if options.task:
        print(json.dumps(run_task(options.task, options.paths)))
        return 0
    print('| bags of 4 h | samples | read s | fit s | fit / read | peak read MB | peak fit MB |')
    print('|---|---|---|---|---|---|---|')
    with tempfile.TemporaryDirectory() as folder:
        paths = write_bags(Path(folder), max(options.bags), options.rate_hz)
        measured = []
        for n in options.bags:
            read, fitted = measure('read', paths[:n]), measure('fit', paths[:n])
            print(
                f'| {n} | {fitted["n_samples"] / 1e6:.1f} M | {read["seconds"]:.1f} '
                f'| {fitted["seconds"]:.1f} | {fitted["seconds"] / read["seconds"]:.1f} '
                f'| {read["peak_mb"]:.0f} | {fitted["peak_mb"]:.0f} |',
                flush=True,
            )
            measured.append((fitted['n_samples'], fitted['seconds']))
    if len(measured) > 1:
        samples, seconds = np.log(measured).T
        slope = np.polyfit(samples, seconds, 1)[0]
        print(f'CPU time of the fit grows as (number of samples)^{slope:.2f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
