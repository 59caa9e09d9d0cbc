# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures the cost of fitting a fleet: speed-up by workers, overhead of the scheduler, network
traffic, and results lost when workers are killed.

Units are simulated and written to bags once (``--folder`` keeps the bags), and fitted as in the
command `fleet fit`, whose workers are processes of one thread.
    python benchmarks/fleet.py scaling              strong and weak scaling, 1 and 2 workers
    python benchmarks/fleet.py overhead             500 small units; estimate for 100 workers
    python benchmarks/fleet.py kill --units 200     200 units of 12 bags, two workers killed
"""

from __future__ import annotations

import argparse
import heapq
import os
import resource
import shutil
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermo_comp.fitting import FitOptions
from thermo_comp.fleet.run import fit_fleet
from thermo_comp.fleet.units import FoundUnit, Storage, find_units
from thermo_comp.fleet.work import FleetOptions, connected, run
from thermo_comp.recording.writer import BagWriter
from thermo_comp.simulation.campaign import parse_cyclogram, positions
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import simulate
from thermo_comp.unit.gravity import STANDARD_GRAVITY

#: Program over 35 K with a sample per second, so that hundreds of units are simulated in minutes.
PROGRAM, RATE_HZ, TEMPERATURE_HZ = '15 6min, 40@2 12min, 5@2 15min', 1.0, 0.2
#: A thermal test that is fitted quickly: the shorter the fits, the higher the scheduler's load.
SMALL_PROGRAM, SMALL_BAGS = '20 2min, 45@5 8min, 5@5 10min', 6
N_LOTS = 4
_IDLE_S = 4.0


def write_fleet(folder: Path, n_units: int, n_bags: int, program: str) -> Path:
    """Simulate units, except those whose bags exist, and write a bag per position."""
    chamber = parse_cyclogram(program)
    for seed in range(1, n_units + 1):
        unit = unit_preset('mems', seed)
        done = folder / f'lot-{1 + seed % N_LOTS}' / unit.serial
        if done.is_dir():
            continue
        made = folder / f'.{unit.serial}'
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir(parents=True)
        for number, up in enumerate(positions(n_bags, 1)):
            run = simulate(
                unit,
                chamber,
                up,
                rate_hz=RATE_HZ,
                temperature_rate_hz=TEMPERATURE_HZ,
                seed=1000 * seed + number,
            )
            with BagWriter(
                made / f'{number + 1:02d}.mcap', metadata={'serial': unit.serial}
            ) as bag:
                bag.write_temperature('temperature/board', run.board_stamp_ns, run.board)
                bag.write_temperature('temperature/case', run.case_stamp_ns, run.case)
                counts = run.counts.astype(np.float64)
                bag.write_counts('accel/counts', run.accel_stamp_ns, counts, 'imu_link')
        done.parent.mkdir(parents=True, exist_ok=True)
        made.rename(done)
    return folder


def units_of(folder: Path, n_units: int) -> list[FoundUnit]:
    """Return `n_units` units of a fleet; the units of a smaller fleet are repeated."""
    units = find_units(Storage(str(folder)))
    return [units[i % len(units)] for i in range(n_units)]


@dataclass(frozen=True)
class Measured:
    """
    Durations, network traffic and processor time of a fit of a fleet.

    Parameters
    ----------
    seconds : float
        Time from the submission of the first task to the last result [s].
    tasks : tuple of float
        Time of each task on its worker [s].
    own_cpu_s : float
        Processor time of the benchmark's process, which is client and scheduler [s].
    idle_cpu : float
        Processor time per second of the benchmark's process while no task runs, as for heartbeats.
    n_bytes : int
        Number of bytes that all processes wrote to their connections.
    cpu_s : float
        Processor time of the workers for the fits [s].

    """

    seconds: float
    tasks: tuple[float, ...]
    own_cpu_s: float
    idle_cpu: float
    n_bytes: int
    cpu_s: float

    @property
    def per_task_s(self) -> float:
        """Return the processor time of client and scheduler for a task [s]."""
        return max(self.own_cpu_s - self.idle_cpu * self.seconds, 0.0) / len(self.tasks)

    def busy(self, n_workers: int) -> float:
        """Return the summed time of the tasks / (number of workers times duration of the fit)."""
        return sum(self.tasks) / (n_workers * self.seconds)


def measure(folder: Path, n_units: int, n_workers: int, options: FleetOptions) -> Measured:
    """Measure a fit of units on a cluster that is running and has fitted some units before."""
    units = units_of(folder, n_units)
    with connected(None, n_workers) as client:
        count_bytes()
        client.run(count_bytes)
        list(run(client, str(folder), units[: 2 * n_workers], options))
        client.get_task_stream()
        cpu, began = process_cpu(), time.perf_counter()
        time.sleep(_IDLE_S)
        idle_cpu = (process_cpu() - cpu) / (time.perf_counter() - began)
        before = bytes_written() + sum(client.run(bytes_written).values())
        cpu, began, started = process_cpu(), time.perf_counter(), time.time()
        outcomes = list(run(client, str(folder), units, options))
        seconds, spent = time.perf_counter() - began, process_cpu() - cpu
        n_bytes = bytes_written() + sum(client.run(bytes_written).values()) - before
        tasks = tuple(
            part['stop'] - part['start']
            for task in client.get_task_stream(start=started)
            for part in task['startstops']
            if part['action'] == 'compute'
        )
    assert len(outcomes) == n_units
    assert len(tasks) == n_units
    assert all(outcome.calibration for _, outcome in outcomes)
    cpu_s = sum(float(outcome.row['cpu_s'] or 0.0) for _, outcome in outcomes)
    return Measured(seconds, tasks, spent, idle_cpu, n_bytes, cpu_s)


def process_cpu() -> float:
    """Return the processor time of this process including its threads [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def count_bytes() -> None:
    """Count the bytes that this process writes to its connections from now on."""
    from distributed.comm.tcp import TCP

    if hasattr(TCP, 'n_written'):
        return
    TCP.n_written = 0
    plain: Callable[..., Any] = TCP.write

    async def counted(self: Any, *args: Any, **keys: Any) -> Any:
        n_bytes = await plain(self, *args, **keys)
        TCP.n_written += n_bytes
        return n_bytes

    TCP.write = counted


def bytes_written() -> int:
    """Return the number of bytes that this process wrote to connections since `count_bytes`."""
    from distributed.comm.tcp import TCP

    return int(TCP.n_written)


def scaling(folder: Path, n_units: int, repeats: int, model: str) -> None:
    """Compare fits of n units by one and by two workers, and of n / 2 units by one worker."""
    write_fleet(folder / 'fleet', n_units, 12, PROGRAM)
    fit = FitOptions(gravity=STANDARD_GRAVITY, model=model)
    options = FleetOptions(fit, certificates=False)
    print(f'{n_units} units x 12 bags, model {model}; load {loads()}')
    print('| run | 1 worker s | 2 workers s | speed-up | with free cores | 1 worker, half of the '
          'units s | throughput of 2 workers / of 1 |')  # fmt: skip
    print('|---|---|---|---|---|---|---|')
    collected: list[tuple[float, float, float]] = []
    for number in range(repeats):
        solo, pair, half = (
            measure(folder / 'fleet', units, workers, options)
            for units, workers in ((n_units, 1), (n_units, 2), (n_units // 2, 1))
        )
        # Other programs on the cores slow two workers more than one worker. `free`: speed-up if
        # each worker had a core for itself; below 2, because workers wait and share memory.
        free = 2.0 * pair.busy(2) / solo.busy(1) * solo.cpu_s / pair.cpu_s
        collected.append((solo.seconds / pair.seconds, free, 2.0 * half.seconds / pair.seconds))
        print(
            f'| {number + 1} | {solo.seconds:.1f} | {pair.seconds:.1f} | {collected[-1][0]:.2f} '
            f'| {free:.2f} | {half.seconds:.1f} | {collected[-1][2]:.2f} |',
            flush=True,
        )
    strong, free, weak = (statistics.median(column) for column in zip(*collected, strict=True))
    print(
        f'medians: speed-up {strong:.2f}, with a free core per worker {free:.2f}; throughput of 2 '
        f'workers / of 1 worker {weak:.2f}; load {loads()}'
    )


def overhead(folder: Path, n_units: int) -> None:
    """Measure the scheduler's overhead with small units; extrapolate to many workers."""
    write_fleet(folder / 'small', 20, SMALL_BAGS, SMALL_PROGRAM)
    fit = FitOptions(gravity=STANDARD_GRAVITY, model='golovach')
    cost = measure(folder / 'small', n_units, 2, FleetOptions(fit, certificates=False))
    busy = sum(cost.tasks)
    print(f'{n_units} units x {SMALL_BAGS} bags, model golovach, 2 workers; load {loads()}')
    print(f'elapsed {cost.seconds:.1f} s; all tasks of both workers took {busy:.1f} s')
    print(f'workers idle for {100.0 * (1.0 - busy / (2.0 * cost.seconds)):.2f} % of the time')
    print(
        f'processor time of scheduler and client: {100.0 * cost.own_cpu_s / busy:.2f} % of the '
        f'time of the tasks; {1e3 * cost.per_task_s:.2f} ms per unit, and '
        f'{100.0 * cost.idle_cpu:.1f} % of a processor while no task runs'
    )
    print(f'network: {cost.n_bytes / n_units / 1e3:.1f} kB per unit, all connections together')
    paper(cost)


def kill(folder: Path, n_units: int, model: str) -> int:
    """Kill a worker at two times in a fit with two workers; return the number of lost results."""
    write_fleet(folder / 'fleet', n_units, 12, PROGRAM)
    fleet = Path(tempfile.mkdtemp(prefix='fleet-', dir=folder))
    for unit in find_units(Storage(str(folder / 'fleet')))[:n_units]:
        (fleet / unit.name).parent.mkdir(exist_ok=True)
        (fleet / unit.name).symlink_to(folder / 'fleet' / unit.name)
    fit = FitOptions(gravity=STANDARD_GRAVITY, model=model)
    options = FleetOptions(fit, certificates=False)
    killed: list[int] = []
    print(f'load {loads()}', flush=True)
    try:
        with connected(None, 2) as client:

            def report(n: int, total: int) -> None:
                if n in (total // 4, total // 2):
                    killed.append(max(client.run(os.getpid).values()))
                    os.kill(killed[-1], signal.SIGKILL)

            began = time.perf_counter()
            address = client.cluster.scheduler_address
            out = fleet / '.out'
            result = fit_fleet(str(fleet), out, options, scheduler=address, progress=report)
            seconds = time.perf_counter() - began
    finally:
        shutil.rmtree(fleet)
    n_lost = n_units - result.n_fitted
    cpu_s = sum(float(row['cpu_s'] or 0.0) for row in result.rows)
    print(
        f'{n_units} units x 12 bags, {model}: {seconds:.0f} s, {len(killed)} workers killed, '
        f'{len(result.rows)} rows, {n_lost} lost; {cpu_s:.0f} s of processor time in the fits; '
        f'load {loads()}'
    )
    print(f'verdicts {result.summary.verdicts}; outliers {len(result.summary.outliers)}')
    return n_lost + (len(result.rows) != n_units)


def paper(found: Measured) -> None:
    """Estimate durations of fits with 100 and 1000 workers from the scheduler's time per task."""
    kilobytes = found.n_bytes / len(found.tasks) / 1e3
    print('\n| unit takes s | units | workers | elapsed s | efficiency | scheduler busy | MB/s |')
    print('|---|---|---|---|---|---|---|')
    for unit_s, n_units, n_workers in (
        (1.0, 500, 100),
        (1.0, 5000, 100),
        (10.0, 500, 100),
        (10.0, 5000, 100),
        (10.0, 5000, 1000),
        (100.0, 5000, 1000),
    ):
        tasks = np.array(found.tasks) * unit_s / statistics.mean(found.tasks)
        drawn = np.random.default_rng(1).choice(tasks, n_units)
        seconds = makespan(drawn, n_workers, found.per_task_s)
        print(
            f'| {unit_s:g} | {n_units} | {n_workers} | {seconds:.0f} '
            f'| {100.0 * drawn.sum() / n_workers / seconds:.0f} % '
            f'| {100.0 * n_units * found.per_task_s / seconds:.0f} % '
            f'| {n_units * kilobytes / 1e3 / seconds:.2f} |'
        )


def makespan(tasks: Sequence[float] | np.ndarray, n_workers: int, per_task: float) -> float:
    """Return the duration of all tasks [s] if the scheduler takes `per_task` [s] to send each."""
    free = [0.0] * n_workers
    scheduler = end = 0.0
    for task in tasks:
        scheduler = max(scheduler, heapq.heappop(free)) + per_task
        heapq.heappush(free, scheduler + float(task))
        end = max(end, scheduler + float(task))
    return end


def loads() -> str:
    """Return the machine's load averages."""
    return ' '.join(f'{load:.1f}' for load in os.getloadavg())


def main() -> int:
    """Run a part of the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('part', choices=['scaling', 'overhead', 'kill'], help='what to measure')
    parser.add_argument('--units', type=int, help='number of units (default 16, 500, 200)')
    parser.add_argument('--repeats', type=int, default=3, help='repetitions of part scaling')
    parser.add_argument('--model', default='response', help='model of the fits')
    parser.add_argument('--folder', type=Path, help='folder that keeps the bags')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.folder or Path(scratch)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        if options.part == 'scaling':
            scaling(folder, options.units or 16, options.repeats, options.model)
        elif options.part == 'overhead':
            overhead(folder, options.units or 500)
        else:
            return kill(folder, options.units or 200, options.model)
    return 0


if __name__ == '__main__':
    sys.exit(main())
