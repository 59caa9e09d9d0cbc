# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prints the figures of docs/accuracy.md: errors of fits, relative to the simulator's truth.

Run ``python benchmarks/accuracy.py`` for everything, or a part with fewer units:
``python benchmarks/accuracy.py kinds --kinds own-lags,paper --seeds 1``.

Every fit uses all bags of a thermal test; the fit is not given the attitudes. With the fitted
calibration the compensator corrects the bags of the plan 'held-out', whose ramps, soaks and
attitudes differ from those of the test. Errors are means over 60 s of the corrected force less the
simulated force [ug]. The floor is the error of a correction by the true thermal model: noise only.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from triads import sibling, unit_of

from thermo_comp.fitting import FitOptions, FitSource, fit
from thermo_comp.fitting.population import population
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.recording.blocks import Block, Readings
from thermo_comp.simulation.campaign import plan
from thermo_comp.simulation.run import SimulatedRun, arrays
from thermo_comp.typing import Floats
from thermo_comp.unit.calibration import Calibration, parameter_layout
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

WINDOW_S = 60.0  # length of the means whose errors are evaluated [s]
N_SIBLINGS = 10  # number of units of the same type whose calibrations give the prior


@dataclass(frozen=True)
class Goal:
    """
    Limits of a unit's RMS of |f| - g (`norm`) and of the error vector (`vector`), in ug, or as
    multiples of the floor if `is_relative`.
    """

    norm: float
    vector: float
    is_relative: bool = False
    plan: str = 'chamber-18'


_RESPONSE = Goal(1.3, 2.0)
_REGIME = Goal(2.0, 3.0)
GOALS = {
    'own-lags': _RESPONSE,
    'between': _RESPONSE,
    'products': _RESPONSE,
    'convection': _RESPONSE,
    'switched-load': _RESPONSE,
    'hysteresis': _RESPONSE,
    'even': _REGIME,
    'paper': _REGIME,
    'slow-noise': Goal(1.15, 1.15, is_relative=True),
    'plain': Goal(1.05, 1.05, is_relative=True, plan='chamber-9'),
}
# Limits of the errors for three plans of a thermal test, without and with a prior from siblings;
# None: no limit.
PLAN_GOALS = {
    'chamber-9': (None, None),
    'tumble-3': (Goal(1.5, 2.5), Goal(1.2, 2.1)),
    'tumble-1': (None, Goal(20.0, 35.0)),
}


def block(record: SimulatedRun) -> Block:
    """Return samples and temperatures of a simulated run as a block for the compensator."""
    stamps, counts = record.accel_stamp_ns, record.counts.astype(np.float64)
    readings = {
        'board': (record.board_stamp_ns, record.board),
        'case': (record.case_stamp_ns, record.case),
    }
    temperatures = {
        name: Readings(at, celsius, np.searchsorted(stamps, at))
        for name, (at, celsius) in readings.items()
    }
    return Block(stamps, counts, '', None, temperatures, {})


@dataclass(frozen=True)
class Corrected:
    """
    Held-out runs corrected with a calibration, and constants of the calibration.

    Parameters
    ----------
    specific_force, sd : list of ndarray, shape (w, 3)
        Means over 60 s of each held-out run, and their claimed standard deviations, m/s^2.
    constants, constants_sd : ndarray, shape (2, 3)
        Bias [counts/cycle] and ln K at the reference temperature, and their claimed sd.
    fit_s : float
        Wall time of the fit, s.
    calibration : Calibration
        The result of the fit.

    """

    specific_force: list[Floats]
    sd: list[Floats]
    constants: Floats
    constants_sd: Floats
    fit_s: float
    calibration: Calibration


def fitted(records: Sequence[SimulatedRun], **options: Any) -> Calibration:
    """Fit the runs of a test."""
    sources = [FitSource('bag', lambda record=record: [block(record)]) for record in records]
    return fit(sources, FitOptions(gravity=STANDARD_GRAVITY, **options)).calibration


def fit_and_correct(
    records: Sequence[SimulatedRun], test_records: Sequence[SimulatedRun], **options: Any
) -> Corrected:
    """Fit the runs of a test, and correct held-out runs with the result."""
    began = time.perf_counter()
    calibration = fitted(records, **options)
    took = time.perf_counter() - began
    forces, sds = [], []
    density = np.array(calibration.noise_density_m_s2_sqrt_hz)
    for record in test_records:
        compensator = Compensator(calibration)
        corrected = process_block(compensator, block(record))
        slots = corrected.index // round(WINDOW_S * 1e9 / record.accel_stamp_ns[0])
        first = np.flatnonzero(np.diff(slots, prepend=-1))
        columns = np.column_stack((corrected.specific_force, corrected.covariance[:, [0, 4, 8]]))
        size = np.diff(first, append=len(slots))
        mean = np.add.reduceat(columns, first, axis=0)[size == size.max()] / size.max()
        # A mean over 60 s reduces only white noise and rounding, not errors that last for minutes.
        white = np.array(compensator.thermal.correction.noise)
        forces.append(mean[:, :3])
        sds.append(np.sqrt(np.maximum(mean[:, 3:] - white, 0.0) + density**2 / WINDOW_S))
    axes = (calibration.axes.x, calibration.axes.y, calibration.axes.z)
    layout = parameter_layout(calibration)
    parameter_sd = np.sqrt(np.diag(calibration.posterior.covariance()))
    return Corrected(
        forces,
        sds,
        np.array([[a.bias for a in axes], np.log([a.scale_factor for a in axes])]),
        parameter_sd[[[block.static for block in part] for part in (layout.bias, layout.scale)]],
        took,
        calibration,
    )


@dataclass(frozen=True)
class Errors:
    """RMS and peak of |f| - g, RMS of the error vector [ug] and of error / claimed sd."""

    norm: float
    peak: float
    vector: float
    claimed: float


def errors(means: Sequence[Floats], sd: Sequence[Floats], tests: Sequence[SimulatedRun]) -> Errors:
    """Compare corrected means of the specific force with the simulated truth."""
    vector = [
        mean - record.truth.specific_force for mean, record in zip(means, tests, strict=True)
    ]
    norm = np.concatenate([np.linalg.norm(force, axis=1) for force in means]) - STANDARD_GRAVITY
    ratio = np.concatenate([e / s for e, s in zip(vector, sd, strict=True)])
    return Errors(
        _rms(norm) / MICRO_G,
        float(np.abs(norm).max()) / MICRO_G,
        _rms(np.linalg.norm(np.concatenate(vector), axis=1)) / MICRO_G,
        _rms(ratio),
    )


def corrected_by_truth(run: SimulatedRun) -> Floats:
    """Correct the mean counts of windows with the true thermal model, (w, 3), m/s^2."""
    unit = run.truth.unit
    per = round(WINDOW_S / (2.0 * run.truth.cycle_s[0]))
    n = len(run.counts) // per
    counts, bias, scale = (
        column[: n * size].reshape(n, size, 3).mean(axis=1)
        for column, size in (
            (run.counts, per),
            (run.truth.thermal_bias, round(WINDOW_S)),
            (run.truth.scale_grid, round(WINDOW_S)),
        )
    )
    result: Floats = ((counts - bias) / scale / unit.scale_factor) @ unit.M.T
    return result


def floor(tests: Sequence[SimulatedRun]) -> Errors:
    """Return the errors of a correction by the true thermal model: noise alone."""
    forces = [corrected_by_truth(record) for record in tests]
    return errors(forces, [np.ones_like(force) for force in forces], tests)


def judged(result: Errors, goal: Goal | None, least: Errors) -> str:
    """Format the RMS of |f| - g and of the error vector [ug] as a table cell; (!): too large."""
    cell = f'{result.norm:.2f} / {result.vector:.2f}'
    if goal is None:
        return cell
    norm, vector = (least.norm, least.vector) if goal.is_relative else (1.0, 1.0)
    is_reached = result.norm <= goal.norm * norm and result.vector <= goal.vector * vector
    return cell if is_reached else f'{cell} (!)'


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def part_kinds(options: argparse.Namespace) -> None:
    """Print a table of errors on held-out runs, with a row for each kind and seed of a unit."""
    print(
        '| unit | seed | floor: norm / vector | golovach | fit | peak | error / claimed sd '
        '| fit s |'
    )
    print('|---|---|---|---|---|---|---|---|')
    for kind in options.kinds or GOALS:
        goal = GOALS[kind]
        for seed in range(1, options.seeds + 1):
            unit = unit_of(kind, seed)
            records = arrays(unit, plan(goal.plan, seed), seed, rate_hz=options.rate_hz)
            tests = arrays(unit, plan('held-out', seed), seed + 500, rate_hz=options.rate_hz)
            least = floor(tests)
            paper, ours = (
                fit_and_correct(records, tests, model=m) for m in ('golovach', 'response')
            )
            sets = errors(paper.specific_force, paper.sd, tests)
            errors_ = errors(ours.specific_force, ours.sd, tests)
            worse = '' if errors_.vector <= 1.05 * sets.vector else ' (worse than golovach)'
            print(
                f'| {kind} | {seed} | {least.norm:.2f} / {least.vector:.2f} '
                f'| {sets.norm:.2f} / {sets.vector:.2f} | {judged(errors_, goal, least)}{worse} '
                f'| {errors_.peak:.1f} | {errors_.claimed:.2f} | {ours.fit_s:.1f} |',
                flush=True,
            )


def part_plans(options: argparse.Namespace) -> None:
    """Print the errors of short chamber tests, without and with the prior of ten siblings."""
    print('| test | unit | seed | floor | no prior | with siblings | error / claimed sd of each |')
    print('|---|---|---|---|---|---|---|')
    for kind in options.kinds or ('own-lags', 'between', 'products'):
        for seed in range(1, options.seeds + 1):
            unit = unit_of(kind, seed)
            tests = arrays(unit, plan('held-out', seed), seed + 500, rate_hz=options.rate_hz)
            least = floor(tests)
            siblings = population([
                fitted(
                    arrays(
                        sibling(unit, number), plan('chamber-18', number), 100 * seed + number,
                        rate_hz=options.rate_hz,
                    ),
                    serial=f'sibling-{number}',
                )
                for number in range(1, N_SIBLINGS + 1)
            ])  # fmt: skip
            for name, goals in PLAN_GOALS.items():
                records = arrays(unit, plan(name, seed), seed, rate_hz=options.rate_hz)
                cells, claimed = [], []
                for goal, prior in zip(goals, (None, siblings), strict=True):
                    ours = fit_and_correct(records, tests, prior=prior)
                    result = errors(ours.specific_force, ours.sd, tests)
                    cells.append(judged(result, goal, least))
                    claimed.append(f'{result.claimed:.2f}')
                print(
                    f'| {name} | {kind} | {seed} | {least.norm:.2f} / {least.vector:.2f} '
                    f'| {cells[0]} | {cells[1]} | {" / ".join(claimed)} |',
                    flush=True,
                )


def main() -> int:
    """Run the selected parts."""
    parts = {'kinds': part_kinds, 'plans': part_plans}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        'parts', nargs='*', choices=[*parts, []], help='parts to run (default: all)'
    )
    parser.add_argument('--seeds', type=int, default=3, help='units per kind')
    parser.add_argument('--rate-hz', type=float, default=4.0, help='cycles per second')
    parser.add_argument(
        '--kinds', type=lambda text: text.split(','), help='kinds of units, separated by commas'
    )
    options = parser.parse_args()
    for name in options.parts or parts:
        print(f'\n### {name}\n', flush=True)
        parts[name](options)
    return 0


if __name__ == '__main__':
    sys.exit(main())
