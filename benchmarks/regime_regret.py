# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a wrong flag costs: the paper's two sets under our flag against the perfect one.

A simulated unit is fitted with the model 'golovach' on the program 'chamber', in unknown attitudes
and under the detector that the fit learns. The compensator is then fed the charge that the unit
would have converted without noise, with its noisy thermometers: what is left of |f| - g is the
error in truth. It runs three times: under our flag, always static, always dynamic. The perfect
flag takes at each sample the set that is nearer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from accuracy import SimulatedBlock

from thermo_comp.fitting import FitOptions, FitSource, fit
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator, CompensatorConfig
from thermo_comp.simulation import (
    STANDARD_GRAVITY,
    SimulatedRun,
    parse_cyclogram,
    positions,
    simulate,
    unit_preset,
)
from thermo_comp.typing import Floats, Ints
from thermo_comp.unit.calibration import Calibration

MICRO_G = 1e-6 * STANDARD_GRAVITY
N_POSITIONS = 12
N_JUDGED = 2
RATE_HZ = 2
# the fit's own program, and one that it has not seen
PROGRAMS = ('chamber', 'held-out')


@dataclass(frozen=True)
class Judged:
    """
    One bag under three flags, and its switches.

    Parameters
    ----------
    program : str
        The program.
    time : ndarray, shape (n,)
        Seconds of the run.
    ours, static, dynamic : ndarray, shape (n,)
        |f| - g without noise [ug].
    flag : ndarray of int8, shape (n,)
        -1 unknown, 0 static, 1 dynamic.
    noise : ndarray, shape (n,)
        What the noise and the rounding of the counts add [ug].
    jumps : ndarray, shape (m,)
        Per switch the largest change of the output within a second that crossing over made [ug].

    """

    program: str
    time: Floats
    ours: Floats
    static: Floats
    dynamic: Floats
    flag: npt.NDArray[np.int8]
    noise: Floats
    jumps: Floats

    @property
    def perfect(self) -> Floats:
        """|f| - g under the perfect flag [ug]."""
        return np.where(np.abs(self.static) < np.abs(self.dynamic), self.static, self.dynamic)


@dataclass(frozen=True)
class Unit:
    """A unit under the flags."""

    name: str
    bags: tuple[Judged, ...]
    density: float


def rms(values: Floats) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def seconds(values: Floats) -> Floats:
    """Means over a second."""
    n = len(values) // RATE_HZ * RATE_HZ
    return np.asarray(values[:n].reshape(n // RATE_HZ, RATE_HZ, *values.shape[1:]).mean(axis=1))


def judge_unit(job: tuple[str, int]) -> Unit:
    """Simulate and fit one unit, and judge its flag."""
    name, seed = job
    unit = unit_preset(name, seed)

    def run(program: str, up: Floats, number: int) -> SimulatedRun:
        return simulate(
            unit, parse_cyclogram(program), up, rate_hz=RATE_HZ, seed=1000 * seed + number
        )

    fitted = [run('chamber', up, k) for k, up in enumerate(positions(N_POSITIONS, seed))]
    sources = [
        FitSource(f'position-{k}', lambda one=one: [block_of(one)], serial=unit.serial)
        for k, one in enumerate(fitted)
    ]
    options = FitOptions(gravity=STANDARD_GRAVITY, model='golovach')
    calibration = fit(sources, options).calibration
    others = [run('held-out', up, 500 + k) for k, up in enumerate(positions(N_JUDGED, seed + 500))]
    bags = [(PROGRAMS[0], one) for one in fitted[:N_JUDGED]]
    bags += [(PROGRAMS[1], one) for one in others]
    return Unit(
        name,
        tuple(judge_bag(program, calibration, one) for program, one in bags),
        float(np.mean(unit.noise_density)),
    )


def block_of(run: SimulatedRun, accel: Floats | None = None) -> SimulatedBlock:
    """Give a run the form of a recording's block, with its counts or other samples."""
    return SimulatedBlock(
        run.accel_stamp_ns,
        run.counts.astype(np.float64) if accel is None else accel,
        run.board_stamp_ns,
        run.board,
        np.searchsorted(run.accel_stamp_ns, run.board_stamp_ns),
        run.case_stamp_ns,
        run.case,
        np.searchsorted(run.accel_stamp_ns, run.case_stamp_ns),
        run.truth.specific_force,
    )


def judge_bag(program: str, calibration: Calibration, run: SimulatedRun) -> Judged:
    """Compensate one bag under each flag."""
    truth = run.truth
    unit = truth.unit
    on_axes = truth.specific_force @ np.linalg.inv(unit.M).T
    charge = truth.bias + np.array(unit.scale_factor) * truth.scale * on_axes
    clean, noisy = block_of(run, charge), block_of(run)
    both, stamps, flags = compensated(calibration, clean)
    static, _, _ = compensated(calibration, clean, 0.0)
    dynamic, _, _ = compensated(calibration, clean, 1.0)
    measured, _, _ = compensated(calibration, noisy)
    flag = np.full(len(stamps), -1, np.int8)
    edges = [0, *np.flatnonzero(np.diff([value for _, value in flags]) != 0) + 1]
    for k in edges:
        at_ns, value = flags[k]
        flag[stamps >= at_ns] = value
    return Judged(
        program,
        (stamps - stamps[0]) * 1e-9,
        norm_error(both),
        norm_error(static),
        norm_error(dynamic),
        flag,
        norm_error(measured) - norm_error(both),
        jumps_of(seconds(both), seconds(static), seconds(dynamic)),
    )


def compensated(
    calibration: Calibration, block: SimulatedBlock, weight: float | None = None
) -> tuple[Floats, Ints, list[tuple[int, bool]]]:
    """
    Specific force, stamps and flags of one bag; with a weight of the dynamic set, under that.
    """
    # a charge without noise may stand still
    compensator = Compensator(calibration, CompensatorConfig(stuck_timeout_s=0.0))
    if weight is not None:
        compensator.thermal.tracker.weight_at = lambda _stamp_ns: weight
    found = process_block(compensator, block)
    return found.specific_force, found.stamp_ns, compensator.take_flags()


def norm_error(force: Floats) -> Floats:
    """|f| - g in ug."""
    return np.asarray((np.linalg.norm(force, axis=1) - STANDARD_GRAVITY) / MICRO_G)


def jumps_of(both: Floats, static: Floats, dynamic: Floats) -> Floats:
    """
    Change of the output from one second to the next that each crossing over made, at most [ug].

    The output is a mean of the sets; of its change the part is taken that the change of the
    weight makes.
    """
    gap = dynamic - static
    size = np.sum(gap**2, axis=1)
    weight = np.sum((both - static) * gap, axis=1) / np.maximum(size, 1e-300)
    step = np.abs(np.diff(np.round(weight, 6))) * np.sqrt(size[1:]) / MICRO_G
    crossing = (step > 0.0) & (size[1:] > (0.01 * MICRO_G) ** 2)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], crossing, [False]))))
    return np.array([step[a:b].max() for a, b in zip(edges[::2], edges[1::2], strict=True)])


def regret_table(units: list[Unit]) -> list[list[str]]:
    """|g| RMS under our flag over that under the perfect one."""
    rows = [
        [
            'unit',
            'program',
            'ours, ug',
            'perfect flag, ug',
            'ratio',
            'ratio, means of 1 s with noise',
            'always static',
            'always dynamic',
        ]
    ]
    for unit in units:
        for program in PROGRAMS:
            bags = [bag for bag in unit.bags if bag.program == program]
            ours, perfect, static, dynamic = (
                np.concatenate([getattr(bag, name) for bag in bags])
                for name in ('ours', 'perfect', 'static', 'dynamic')
            )
            measured = [
                np.concatenate([seconds(getattr(bag, name) + bag.noise) for bag in bags])
                for name in ('ours', 'perfect')
            ]
            rows.append(
                [
                    unit.name,
                    program,
                    f'{rms(ours):.1f}',
                    f'{rms(perfect):.1f}',
                    f'{rms(ours) / rms(perfect):.3f}',
                    f'{rms(measured[0]) / rms(measured[1]):.3f}',
                    f'{rms(static) / rms(perfect):.3f}',
                    f'{rms(dynamic) / rms(perfect):.3f}',
                ]
            )
    return rows


def switch_table(units: list[Unit]) -> list[list[str]]:
    """Show what crossing over does to the output."""
    rows = [
        [
            'unit',
            'switches',
            'largest jump in 1 s, ug',
            'in sd of the 1 s mean',
            'velocity kick, 1e-5 m/s',
        ]
    ]
    for unit in units:
        jumps = np.concatenate([bag.jumps for bag in unit.bags])
        rows.append(
            [
                unit.name,
                f'{len(jumps)}',
                f'{jumps.max():.2f}',
                f'{jumps.max() / unit.density:.2f}',
                f'{jumps.max() * MICRO_G / 1e-5:.2f}',
            ]
        )
    return rows
