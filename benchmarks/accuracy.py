# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the accuracy figures of docs/accuracy.md: the fit against the simulator's truth.

Run ``python benchmarks/accuracy.py`` for everything (about an hour on one core), or one part with
fewer seeds: ``python benchmarks/accuracy.py held-out --seeds 1 --rate-hz 50``.

Every fit sees the program 'chamber' in unknown attitudes and is applied by the compensator, sample
by sample, to the program 'held-out' (other ramp rates, other soaks, other attitudes); errors are
those of 60 s means, in micro-g, against the simulated truth.

"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermo_comp.calibration import Calibration
from thermo_comp.compensator import Compensator
from thermo_comp.fitting import FitOptions, FitResult, FitSource, fit
from thermo_comp.metrics import norm_residual, residual_statistics
from thermo_comp.simulation import (
    STANDARD_GRAVITY,
    UnitModel,
    cyclogram_preset,
    positions,
    simulate_blocks,
    unit_preset,
)

Array = npt.NDArray[np.float64]
WINDOW_S = 60.0
TEST_POSITIONS = 4
LIMITS = {'thermostatted': (1.0, 1.8, 5.0), 'bare-quartz': (2.0, 3.0, 5.0)}


@dataclass(frozen=True)
class SimulatedBlock:
    """
    A simulated stretch as the recording layer would hand it over.

    """

    accel_stamp_ns: npt.NDArray[np.int64]
    accel: Array
    board_stamp_ns: npt.NDArray[np.int64]
    board: Array
    board_after: npt.NDArray[np.int64]
    case_stamp_ns: npt.NDArray[np.int64]
    case: Array
    case_after: npt.NDArray[np.int64]
    truth: Array


def blocks(
    unit: UnitModel, program: str, up: Array, seed: int, rate_hz: float
) -> Iterator[SimulatedBlock]:
    """
    Stream one simulated bag.

    """
    for run in simulate_blocks(unit, cyclogram_preset(program), up, rate_hz=rate_hz, seed=seed):
        yield SimulatedBlock(
            run.accel_stamp_ns,
            run.counts.astype(np.float64),
            run.board_stamp_ns,
            run.board,
            np.searchsorted(run.accel_stamp_ns, run.board_stamp_ns),
            run.case_stamp_ns,
            run.case,
            np.searchsorted(run.accel_stamp_ns, run.case_stamp_ns),
            run.truth.specific_force,
        )


def fitted(
    unit: UnitModel, n_positions: int, seed: int, rate_hz: float, model: str = 'auto'
) -> FitResult:
    """
    Fit a unit on its simulated thermal test.

    """
    sources = [
        FitSource(
            f'position-{number}',
            lambda up=up, number=number: blocks(
                unit, 'chamber', up, 1000 * seed + number, rate_hz
            ),
            serial=unit.serial,
        )
        for number, up in enumerate(positions(n_positions, seed))
    ]
    return fit(sources, FitOptions(gravity=STANDARD_GRAVITY, model=model))


@dataclass(frozen=True)
class HeldOut:
    """
    Errors of 60 s means on programs that the fit never saw, in micro-g.

    """

    norm_rms: float
    norm_peak: float
    vector_rms: float
    coverage: float


def held_out(calibration: Calibration, unit: UnitModel, seed: int, rate_hz: float) -> HeldOut:
    """
    Apply a calibration with the compensator and compare with the truth.

    """
    norms, vectors, inside = [], [], []
    for number, up in enumerate(positions(TEST_POSITIONS, seed + 500)):
        compensator = Compensator(calibration)
        sums: dict[int, Array] = {}
        start_ns = None
        for block in blocks(unit, 'held-out', up, 1000 * seed + 500 + number, rate_hz):
            found = compensator.process_block(block)
            if not len(found.stamp_ns):
                continue
            start_ns = int(found.stamp_ns[0]) if start_ns is None else start_ns
            slots = (found.stamp_ns - start_ns) // round(WINDOW_S * 1e9)
            first = np.flatnonzero(np.concatenate(([True], np.diff(slots) != 0)))
            columns = np.column_stack(
                (
                    np.ones(len(slots)),
                    found.specific_force,
                    block.truth[found.index],
                    found.covariance[:, [0, 4, 8]],
                )
            )
            for slot, total in zip(
                slots[first], np.add.reduceat(columns, first, axis=0), strict=True
            ):
                sums[int(slot)] = sums.get(int(slot), 0.0) + total
        rows = np.array(list(sums.values()))
        full = rows[rows[:, 0] > 0.9 * np.median(rows[:, 0])]
        mean = full / full[:, :1]
        vectors.append(mean[:, 1:4] - mean[:, 4:7])
        norms.append(norm_residual(mean[:, 1:4], STANDARD_GRAVITY))
        # White noise averages down, the rest of the published variance does not.
        density = np.array(calibration.noise_density_m_s2_sqrt_hz)
        white = density**2 / calibration.unit.cycle_time_s
        slow = np.maximum(mean[:, 7:10] - white, 0.0)
        sd = np.sqrt(slow + density**2 / WINDOW_S)
        inside.append(np.abs(vectors[-1]) < 1.96 * sd)
    norm = residual_statistics(np.concatenate(norms)).micro_g
    vector = residual_statistics(np.concatenate(vectors)).micro_g
    return HeldOut(norm.rms, norm.peak, vector.rms, float(np.mean(np.concatenate(inside))))


def part_held_out(options: argparse.Namespace) -> None:
    """
    Units with thermal memory, on a program that the fit never saw.

    """
    print(
        '| unit | thermometers | seed | model | lags s | norm RMS | norm peak | vector RMS '
        '| inside 95 % | fit s |'
    )
    print('|---|---|---|---|---|---|---|---|---|---|')
    for preset, limits in LIMITS.items():
        for quantum in (0.0, 0.0625):
            for seed in range(1, options.seeds + 1):
                unit = unit_preset(preset, seed)
                unit = unit.with_thermometers(quantum=quantum) if quantum else unit
                began = time.perf_counter()
                result = fitted(unit, options.positions, seed, options.rate_hz)
                took = time.perf_counter() - began
                found = held_out(result.calibration, unit, seed, options.rate_hz)
                factor = 2.0 if quantum else 1.0
                measured = (found.norm_rms, found.vector_rms, found.norm_peak)
                marks = [
                    f'{value:.2f}' + ('' if value <= factor * limit else ' (!)')
                    for value, limit in zip(measured, limits, strict=True)
                ]
                lags = ', '.join(f'{tau:.0f}' for tau in result.solution.time_constants_s)
                sensor = f'{quantum * 1e3:g} mK steps' if quantum else '5 mK noise'
                print(
                    f'| {preset} | {sensor} | {seed} | {result.calibration.provenance.model} '
                    f'| {lags} | {marks[0]} | {marks[2]} | {marks[1]} '
                    f'| {100.0 * found.coverage:.0f} % | {took:.0f} |',
                    flush=True,
                )


def main() -> int:
    """
    Run the parts asked for.

    """
    parts = {'held-out': part_held_out}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('parts', nargs='*', choices=[[], *parts], help='parts; all by default')
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--positions', type=int, default=18)
    parser.add_argument('--rate-hz', type=float, default=100.0)
    options = parser.parse_args()
    for name, part in parts.items():
        if not options.parts or name in options.parts:
            print(f'\n### {name}\n')
            part(options)
    return 0


if __name__ == '__main__':
    sys.exit(main())
