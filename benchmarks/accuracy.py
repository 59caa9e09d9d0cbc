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
from dataclasses import dataclass, replace

import numpy as np

from thermo_comp.fitting import FitOptions, FitResult, FitSource, fit
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.simulation import (
    STANDARD_GRAVITY,
    DriftModel,
    PartEffect,
    UnitModel,
    cyclogram_preset,
    positions,
    simulate,
    simulate_blocks,
    unit_preset,
)
from thermo_comp.typing import Floats, Ints
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.metrics import norm_residual, residual_statistics

WINDOW_S = 60.0
TEST_POSITIONS = 4
LIMITS = {'thermostatted': (1.0, 1.8, 5.0), 'bare-quartz': (2.0, 3.0, 5.0)}


@dataclass(frozen=True)
class SimulatedBlock:
    """
    A simulated stretch as the recording layer would hand it over.

    """

    accel_stamp_ns: Ints
    accel: Floats
    board_stamp_ns: Ints
    board: Floats
    board_after: Ints
    case_stamp_ns: Ints
    case: Floats
    case_after: Ints
    truth: Floats


def blocks(
    unit: UnitModel,
    program: str,
    up: Floats,
    seed: int,
    rate_hz: float,
    temperature_rate_hz: float | None = None,
) -> Iterator[SimulatedBlock]:
    """
    Stream one simulated bag.

    """
    for run in simulate_blocks(
        unit,
        cyclogram_preset(program),
        up,
        rate_hz=rate_hz,
        temperature_rate_hz=temperature_rate_hz,
        seed=seed,
    ):
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
        sums: dict[int, Floats] = {}
        start_ns = None
        for block in blocks(unit, 'held-out', up, 1000 * seed + 500 + number, rate_hz):
            found = process_block(compensator, block)
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


def part_ladder(options: argparse.Namespace) -> None:
    """
    Every rung of the ladder on the same bags, judged on the program that none has seen.

    """
    print('| unit | model | norm RMS | norm peak | vector RMS |')
    print('|---|---|---|---|---|')
    rungs = (
        'constant', 'quadratic', 'golovach', 'quadratic+gradient', 'quadratic+memory1',
        'quadratic+memory2',
    )  # fmt: skip
    for preset in LIMITS:
        unit = unit_preset(preset, 1)
        sources = []
        for number, up in enumerate(positions(options.positions, 1)):
            kept = list(blocks(unit, 'chamber', up, 1000 + number, 25.0))
            sources.append(FitSource(f'position-{number}', lambda kept=kept: kept))
        for model in rungs:
            settings = FitOptions(gravity=STANDARD_GRAVITY, model=model)
            found = held_out(fit(sources, settings).calibration, unit, 1, options.rate_hz)
            print(
                f'| {preset} | {model} | {found.norm_rms:.2f} | {found.norm_peak:.1f} '
                f'| {found.vector_rms:.2f} |',
                flush=True,
            )


def exact_unit(seed: int) -> UnitModel:
    """
    Make a unit whose drift is a quadratic of the board's temperature, and nothing else.

    """
    rng = np.random.default_rng(seed)

    def axes(sd: float) -> tuple[float, float, float]:
        x, y, z = rng.normal(0.0, sd, 3)
        return float(x), float(y), float(z)

    drift = PartEffect(
        'board', bias=axes(5.0), bias_curvature=axes(0.05), scale=axes(40.0),
        scale_curvature=axes(0.2),
    )  # fmt: skip
    return replace(unit_preset('thermostatted', seed), drift=DriftModel((drift,)))


def bound(unit: UnitModel, program: str, directions: Floats, window_s: float) -> Floats:
    """
    Cramer-Rao bound of bias [counts] and ln K at the reference, shape (2, 3), as sd.

    Written on its own: window means of counts with white noise, unknown attitudes (two angles
    each), M, and a quadratic of the true board temperature per axis; differentiated numerically.

    """
    run = simulate(unit, cyclogram_preset(program), directions[0], rate_hz=1.0)
    truth = run.truth
    time_s = np.arange(window_s / 2.0, truth.grid_s[-1], window_s)
    t = np.interp(time_s, truth.grid_s, truth.temperature('board')) - 20.0
    powers = np.column_stack((np.ones_like(t), t, t * t))
    K = np.array(unit.scale_factor)
    sd = np.array(unit.noise_density) * 1e-6 * STANDARD_GRAVITY * K / np.sqrt(window_s)
    n = len(directions)
    effect = unit.drift.effects[0]
    micro = 1e-6 * STANDARD_GRAVITY * K
    start = np.concatenate(
        (
            np.column_stack((unit.bias_at_reference, effect.bias * micro,
                             effect.bias_curvature * micro)).ravel(),
            np.column_stack((np.ones(3), np.array(effect.scale) * 1e-6,
                             np.array(effect.scale_curvature) * 1e-6)).ravel(),
            np.linalg.inv(unit.M)[[1, 2, 2], [0, 0, 1]],
            np.zeros(2 * n),
        )
    )  # fmt: skip
    across = [np.linalg.svd(u[None])[2][1:] for u in directions]

    def predicted(p: Floats) -> Floats:
        A = np.eye(3)
        A[1, 0], A[2, 0], A[2, 1] = p[18:21]
        angles = p[21:].reshape(n, 2)
        up = np.array([u + a @ e for u, a, e in zip(directions, angles, across, strict=True)])
        force = STANDARD_GRAVITY * (up / np.linalg.norm(up, axis=1, keepdims=True)) @ A.T
        bias = powers @ p[:9].reshape(3, 3).T
        scale = K * (powers @ p[9:18].reshape(3, 3).T)
        return ((bias + force[:, None, :] * scale) / sd).ravel()

    columns = []
    for j in range(len(start)):
        # Steps of the size that the data could just tell, from the signal itself.
        step = np.zeros(len(start))
        step[j] = 1e-6 if j >= 9 else 1e-3
        step[j] *= 1e-3 if j < 18 and j % 3 == 2 else 1e-1 if j < 18 and j % 3 == 1 else 1.0
        columns.append((predicted(start + step) - predicted(start - step)) / (2.0 * step[j]))
    jacobian = np.column_stack(columns)
    norm = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian / norm).T @ (jacobian / norm)) / np.outer(norm, norm)
    sds = np.sqrt(np.diag(covariance))
    return np.array([sds[0:9:3], sds[9:18:3]])


def part_efficiency(options: argparse.Namespace) -> None:
    """
    Bias and scale at the reference against the Cramer-Rao bound.

    """
    print(
        '| positions | units | bias: RMS error / bound | scale | bias: error / claimed sd | scale '
        '| 95 % intervals, bias | scale |'
    )
    print('|---|---|---|---|---|---|---|---|')
    for n_positions in (18, 24):
        ratios: list[Floats] = []
        claimed: list[Floats] = []
        for seed in range(1, options.units + 1):
            unit = exact_unit(seed)
            up = positions(n_positions, seed)
            sources = [
                FitSource(
                    f'position-{number}',
                    lambda unit=unit, one=one, number=number, seed=seed: blocks(
                        unit, 'demo', one, 1000 * seed + number, 25.0, 0.5
                    ),
                )
                for number, one in enumerate(up)
            ]
            settings = FitOptions(gravity=STANDARD_GRAVITY, model='quadratic')
            calibration = fit(sources, settings).calibration
            axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
            bias = np.array([axis.bias for axis in axes]) - unit.bias_at_reference
            scale = np.log(np.array([axis.scale_factor for axis in axes]) / unit.scale_factor)
            errors = np.array([bias, scale])
            ratios.append(errors / bound(unit, 'demo', up, 60.0))
            sets = calibration.static.axes()
            at = sets[0].n_bias_parameters
            sd = [[one.covariance[k][k] ** 0.5 for one in sets] for k in (0, at)]
            claimed.append(errors / np.array(sd))
        ratio = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
        own = np.sqrt(np.mean(np.square(claimed), axis=(0, 2)))
        inside = np.mean(np.abs(claimed) < 1.96, axis=(0, 2))
        print(
            f'| {n_positions} | {options.units} | {ratio[0]:.3f} | {ratio[1]:.3f} '
            f'| {own[0]:.3f} | {own[1]:.3f} '
            f'| {100 * inside[0]:.1f} % | {100 * inside[1]:.1f} % |',
            flush=True,
        )


def part_restraint(options: argparse.Namespace) -> None:
    """
    Units without thermal memory: the chosen model against the true one.

    """
    print('| unit | seed | chosen | vector RMS, chosen | true model | ratio |')
    print('|---|---|---|---|---|---|')
    for seed in range(1, options.seeds + 1):
        for name, unit, model in (
            ('no drift', unit_preset('thermostatted', seed).without_drift(), 'constant'),
            ('quadratic of the board', exact_unit(seed), 'quadratic'),
        ):
            found = []
            for wanted in ('auto', model):
                calibration = fitted(
                    unit, options.positions, seed, options.rate_hz, wanted
                ).calibration
                if wanted == 'auto':
                    chosen = calibration.provenance.model
                found.append(held_out(calibration, unit, seed, options.rate_hz).vector_rms)
            print(
                f'| {name} | {seed} | {chosen} | {found[0]:.3f} | {found[1]:.3f} '
                f'| {found[0] / found[1]:.3f} |',
                flush=True,
            )


def main() -> int:
    """
    Run the parts asked for.

    """
    parts = {
        'ladder': part_ladder,
        'held-out': part_held_out,
        'restraint': part_restraint,
        'efficiency': part_efficiency,
    }
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('parts', nargs='*', help=f'all by default: {", ".join(parts)}')
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--units', type=int, default=100, help='Monte-Carlo units')
    parser.add_argument('--positions', type=int, default=18)
    parser.add_argument('--rate-hz', type=float, default=100.0)
    options = parser.parse_args()
    for name in options.parts or parts:
        print(f'\n### {name}\n')
        parts[name](options)
    return 0


if __name__ == '__main__':
    sys.exit(main())
