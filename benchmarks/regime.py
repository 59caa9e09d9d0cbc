# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prints the figures of docs/regime.md: the regime detector in simulated ramps and soaks.

A ramp of a chamber, with control ripple and a drift by self-heating, changes the temperatures of a
case (first-order lag of the chamber) and of a board (first-order lag of the case). Sensors of
several noises, quanta and rates read both temperatures. The detector's settings are the defaults
except for noise, quantum, lags and ripple, which the scene determines. All runs are seeded, so
the command always prints the same figures, except for CPU times.

    python benchmarks/regime.py --quick            # seconds
    python benchmarks/regime.py --workers 2        # some minutes
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.pool import Pool
from pathlib import Path

import numpy as np
from regime_figures import plot_ramp
from regime_runs import Job, Outcome, cost, regime_flags, rng_of, run_ramps, run_soak, settings
from regime_scenes import SENSORS, Scene, known_signature_delays, read, temperatures

from thermo_comp.thermal.regime import Regime

SOAK_H = 5.0
# Number of ramps per scene by the rate of the readings [Hz]; run time is proportional to the rate.
RAMPS = {10.0: 1, 1.0: 6, 0.1: 10}

Rows = list[list[str]]
Matrix = list[tuple[Scene, Outcome]]


def quantiles(delays: list[float]) -> tuple[float, float]:
    """Return median and 95 % quantile of the delays [s]; infinite if the list is empty."""
    if not delays:
        return np.inf, np.inf
    return float(np.median(delays)), float(np.percentile(delays, 95))


def cost_table() -> Rows:
    """Return rows of CPU times per reading, in us and relative to a numpy call on a scalar."""
    measured = cost()
    unit = measured['numpy scalar call']
    rows = [['per reading', 'CPU us', 'numpy scalar calls']]
    rows += [[name, f'{each:.2f}', f'{each / unit:.0f}'] for name, each in measured.items()]
    return rows


def table(title: str, rows: Rows) -> None:
    """Print rows as a Markdown table; the first row is the head."""
    print(f'## {title}\n')
    for k, row in enumerate(rows):
        print('| ' + ' | '.join(each.replace('|', '\\|') for each in row) + ' |')
        if k == 0:
            print('|' + '---|' * len(row))
    print(flush=True)


def onset_table(pool: Pool, is_quick: bool, seed: int) -> Rows:
    """Return rows of onset delays [s] of the detector and of a CUSUM test with the true ramp."""
    n, hours = (6, 20.0) if is_quick else (200, 400.0)
    scenes = [Scene(0.5, 900.0, noise, quantum, 1.0) for noise, quantum in SENSORS]
    jobs = [(scene, n, seed, rippled) for scene in scenes for rippled in (False, True)]
    plain = [scene for scene in scenes if not scene.quantum]
    bounds = pool.starmap_async(
        known_signature_delays,
        [(each, settings(each).false_alarms_per_hour, hours, n, seed) for each in plain],
    )
    results = pool.map(run_ramps, jobs, chunksize=1)
    bound_of = dict(zip(plain, bounds.get(), strict=True))
    rows = [
        [
            'sensor',
            'ripple and drift',
            'median, s',
            '95 %, s',
            'CUSUM median',
            'CUSUM 95 %',
            'missed',
            'static before the end',
            'ramps',
        ]
    ]
    for (scene, result), job in zip(results, jobs, strict=True):
        is_rippled = job[3]
        bound = ('', '') if is_rippled else bound_of.get(scene, ('', ''))
        rows.append(
            [
                scene.sensor,
                'yes' if is_rippled else 'no',
                *(f'{each:.0f}' for each in quantiles(result.delays)),
                *(f'{each:.0f}' if each else '' for each in bound),
                f'{result.missed}',
                f'{result.flips}',
                f'{result.n}',
            ]
        )
    return rows


def soak_table(pool: Pool, hours: float, seed: int) -> Rows:
    """Return a row per sensor with the number of false switches per hour of soak."""
    runs = max(1, round(hours / len(SENSORS) / SOAK_H))
    scenes = [Scene(0.5, 900.0, noise, quantum, 1.0) for noise, quantum in SENSORS]
    jobs = [(scene, SOAK_H, seed + k) for scene in scenes for k in range(runs)]
    soaks = pool.map(run_soak, jobs, chunksize=1)
    rows = [['sensor', 'hours', 'to dynamic', 'switches', 'switches per hour']]
    for sensor in [*dict.fromkeys(each[0] for each in soaks), 'all']:
        mine = [each for each in soaks if sensor in {each[0], 'all'}]
        span = SOAK_H * sum(each[3] for each in mine)
        switches = sum(each[2] for each in mine)
        openings = sum(each[1] for each in mine)
        rows.append(
            [sensor, f'{span:.0f}', f'{openings}', f'{switches}', f'{switches / span:.4f}']
        )
    return rows


def run_matrix(
    pool: Pool, is_quick: bool, seed: int, rates: Sequence[float], n_ramps: int | None
) -> Matrix:
    """Run the detector over the ramps of all scenes; return the results by scene."""
    ramps = (0.1, 0.5, 3.0) if is_quick else (0.1, 0.2, 0.5, 1.0, 3.0)
    lags = (180.0, 900.0) if is_quick else (180.0, 900.0, 1200.0)
    jobs: list[Job] = [
        (
            Scene(ramp, lag, noise, quantum, rate),
            1 if is_quick else n_ramps or RAMPS[rate],
            seed,
            True,
        )
        for rate in rates
        for lag in lags
        for noise, quantum in SENSORS
        for ramp in ramps
    ]
    return pool.map(run_ramps, jobs, chunksize=1)


def rate_table(matrix: Matrix) -> Rows:
    """Count for each reading rate the ramps, missed ramps, and ramps flagged static too early."""
    rows = [['readings', 'ramps', 'missed', 'missed, >= 0.2 K/min', 'static before the end']]
    for rate in dict.fromkeys(scene.rate_hz for scene, _ in matrix):
        mine = [(scene, result) for scene, result in matrix if scene.rate_hz == rate]
        rows.append(
            [
                f'{rate:g} Hz',
                f'{sum(row.n for _, row in mine)}',
                f'{sum(row.missed for _, row in mine)}',
                f'{sum(row.missed for scene, row in mine if scene.ramp_k_min >= 0.2)}',
                f'{sum(row.flips for _, row in mine)}',
            ]
        )
    return rows


def scene_table(matrix: Matrix, lag: float) -> Rows:
    """Return median delay and flagged share of ramps, for scenes with a given case lag [s]."""
    rows = [['sensor', 'Hz', 'K/min', 'median, s', 'share flagged']]
    for scene, result in matrix:
        if scene.lag_s == lag:
            delay, share = f'{quantiles(result.delays)[0]:.0f}', f'{result.flagged:.2f}'
            row = [scene.sensor, f'{scene.rate_hz:g}', f'{scene.ramp_k_min:g}', delay, share]
            rows.append(row)
    return rows


def draw_ramp(seed: int, folder: Path) -> None:
    """Draw the temperatures of a ramp, and the regime flag."""
    scene = Scene(0.5, 900.0, 0.01, 0.0, 1.0)
    rng = rng_of(seed, 11, scene)
    t = np.arange(-2700.0, 10800.0)
    case, board = temperatures(scene, t, 3600.0, rng)
    flag = regime_flags(scene, read(case, scene, rng), read(board, scene, rng))
    plot_ramp(t, case, board, flag == Regime.DYNAMIC, folder)


Tables = Iterator[tuple[str, Rows]]


def part_onset(pool: Pool, arguments: argparse.Namespace) -> Tables:
    """Measure onset delays for ramps of 0.5 K/min and a case that lags by 15 min."""
    rows = onset_table(pool, arguments.quick, arguments.seed)
    yield 'Onset of a ramp of 0.5 K/min behind a lag of 15 min, 1 Hz', rows


def part_soak(pool: Pool, arguments: argparse.Namespace) -> Tables:
    """Count switches of the regime in soaks."""
    hours = 25.0 if arguments.quick else arguments.soak_hours
    yield 'False switches in soaks with ripple and drift', soak_table(pool, hours, arguments.seed)


def part_matrix(pool: Pool, arguments: argparse.Namespace) -> Tables:
    """Yield tables: missed ramps; onset delay and fraction of a ramp flagged dynamic by scene."""
    rates = arguments.rates or ((1.0, 0.1) if arguments.quick else tuple(RAMPS))
    matrix = run_matrix(pool, arguments.quick, arguments.seed, rates, arguments.ramps)
    yield 'Ramps by rate of the readings', rate_table(matrix)
    for lag in sorted({scene.lag_s for scene, _ in matrix}):
        title = 'Median onset delay, share of the ramp flagged: lag {:g} min'
        yield title.format(lag / 60.0), scene_table(matrix, lag)
    if arguments.figures:
        draw_ramp(arguments.seed, arguments.figures)


def part_cost(_pool: Pool, _arguments: argparse.Namespace) -> Tables:
    """Measure the time that the detector takes for a reading."""
    yield 'Cost', cost_table()


PARTS: dict[str, Callable[[Pool, argparse.Namespace], Tables]] = {
    'onset': part_onset,
    'soak': part_soak,
    'matrix': part_matrix,
    'cost': part_cost,
}


def main() -> None:
    """Run the parts and print their tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('parts', nargs='*', help=f'all by default: {", ".join(PARTS)}')
    parser.add_argument('--quick', action='store_true', help='fewer runs, done in seconds')
    parser.add_argument('--seed', type=int, default=1, help='seed of the random numbers')
    parser.add_argument('--workers', type=int, default=1, help='number of processes')
    parser.add_argument('--soak-hours', type=float, default=1100.0, help='soak: total length')
    parser.add_argument(
        '--rates', type=float, nargs='+', choices=RAMPS, help='matrix: rates of the readings, Hz'
    )
    parser.add_argument('--ramps', type=int, help='matrix: number of ramps per scene')
    parser.add_argument('--figures', metavar='FOLDER', type=Path, help='folder for figures')
    parser.add_argument('--json', metavar='FILE', help='file for every table, as JSON')
    arguments = parser.parse_args()
    parts = arguments.parts or [*PARTS]
    if not set(parts) <= set(PARTS):
        parser.error(f'parts are {", ".join(PARTS)}')
    figures: dict[str, Rows] = {}
    with multiprocessing.Pool(arguments.workers) as pool:
        for part in parts:
            for title, rows in PARTS[part](pool, arguments):
                figures[title] = rows
                table(title, rows)
    if arguments.json:
        text = json.dumps({'seed': arguments.seed, 'tables': figures}, indent=1)
        Path(arguments.json).write_text(text + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
