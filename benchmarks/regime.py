# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the figures of docs/regime.md: the detector against four rules, in one run.

Closed-form responses of a case (first-order lag) and a board (a second lag behind it) to a
chamber's ramp, with the chamber's ripple and a self-heating drift, are read by sensors of several
noises, quanta and rates. Ours runs as shipped; each rival's threshold is the largest value that
its statistic takes in 20 h of soak of the same sensor, so all rivals have the same rate of false
alarms, about one in 20 h, which is more than ours has. Seeded: one command, one set of figures.

    python benchmarks/regime.py --quick            # seconds
    python benchmarks/regime.py --workers 2        # some minutes

"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections.abc import Iterable
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path

import numpy as np
import numpy.typing as npt
from regime_rules import (
    BOARD_LAG_S,
    RIPPLE_C,
    RIVALS,
    SENSORS,
    Array,
    Scene,
    known_signature_delays,
    read,
    temperatures,
)

from thermo_comp.regime import DetectorSettings, Regime, RegimeDetector
from thermo_comp.thermometer import Thermometer, ThermometerSettings

SEGMENT_H = 2.5
SOAK_H = 5.0
OURS = 'ours'
# ramps per scene, by the rate of the readings [Hz]: ten times the readings, ten times the work
RAMPS = {10.0: 2, 1.0: 10, 0.1: 20}
TUNING_H = 20.0
SETTLE_S = 1800.0


@dataclass
class Outcome:
    """
    What a rule made of the ramps of one scene.

    """

    delays: list[float]
    missed: int
    flips: int
    early: int
    flagged: float
    n: int


Rows = list[list[str]]
Job = tuple[tuple[Scene, ...], int, float, int, bool]
Matrix = list[tuple[Scene, dict[str, Outcome]]]


def settings(scene: Scene) -> DetectorSettings:
    """
    Shipped defaults, with the sensor and the unit's lags filled in.

    """
    case = ThermometerSettings(scene.noise_sd, scene.quantum, lag_s=scene.lag_s)
    board = ThermometerSettings(scene.noise_sd, scene.quantum, lag_s=scene.lag_s + BOARD_LAG_S)
    return DetectorSettings(ripple_c=RIPPLE_C, case=case, board=board)


def rng_of(seed: int, purpose: int, scene: Scene) -> np.random.Generator:
    """
    Make the generator of one scene, the same in whichever order scenes run.

    """
    return np.random.default_rng([seed, purpose, *(round(1e6 * v) for v in vars(scene).values())])


def ours(scene: Scene, case: Array, board: Array) -> npt.NDArray[np.int8]:
    """
    Flag of the shipped detector at each reading: 1 dynamic, 0 static, -1 unknown.

    """
    detector_settings = settings(scene)
    case_thermometer = Thermometer(detector_settings.case)
    board_thermometer = Thermometer(detector_settings.board)
    detector = RegimeDetector(detector_settings)
    step_ns = round(1e9 / scene.rate_hz)
    flags = np.empty(len(case), np.int8)
    regime = Regime.UNKNOWN
    for k, (c, b) in enumerate(zip(case.tolist(), board.tolist(), strict=True)):
        board_thermometer.update(k * step_ns, b)
        if case_thermometer.update(k * step_ns, c):
            regime = detector.update(k * step_ns, case_thermometer, board_thermometer)
        flags[k] = regime
    return flags


def judge(flags: Iterable[tuple[Array, npt.NDArray[np.bool_]]], duration: float) -> Outcome:
    """
    Delay, flips and flagged share of ramps from 0 to `duration`.

    """
    outcome = Outcome([], 0, 0, 0, 0.0, 0)
    for t, flag in flags:
        outcome.n += 1
        inside = flag[(t >= 0.0) & (t < duration)]
        times = t[(t >= 0.0) & (t < duration)]
        outcome.flagged += float(inside.mean())
        if flag[np.searchsorted(t, 0.0) - 1]:
            outcome.early += 1
            continue
        if not inside.any():
            outcome.missed += 1
            continue
        onset = int(np.argmax(inside))
        outcome.delays.append(float(times[onset]))
        outcome.flips += bool((~inside[onset:]).any())
    outcome.flagged /= max(outcome.n, 1)
    return outcome


def run_scenes(job: Job) -> list[tuple[Scene, dict[str, Outcome]]]:
    """
    All rules over `n` ramps of each scene of one sensor, the rivals tuned on its soak first.

    """
    scenes, n, hours, seed, is_rippled = job
    rng = rng_of(seed, 3, scenes[0])
    thresholds = dict.fromkeys(RIVALS if hours else (), 0.0)
    for _ in range(round(hours / SEGMENT_H)):
        t = np.arange(0.0, 3600.0 * SEGMENT_H, 1.0 / scenes[0].rate_hz)
        soak = read(temperatures(scenes[0], t, 0.0, rng)[0], scenes[0], rng)
        for name in thresholds:
            peak = RIVALS[name](scenes[0], soak)[t > SETTLE_S].max()
            thresholds[name] = max(thresholds[name], float(peak))
    return [(scene, run_ramps(scene, n, thresholds, seed, is_rippled)) for scene in scenes]


def run_ramps(
    scene: Scene, n: int, thresholds: dict[str, float], seed: int, is_rippled: bool
) -> dict[str, Outcome]:
    """
    Ours, and the rivals at their thresholds, over `n` ramps of one scene.

    """
    rng = rng_of(seed, 5, scene)
    # long enough for three edges of the coarsest sensor
    edges_s = 60.0 * 4.0 * scene.quantum / scene.ramp_k_min + 2.0 * scene.lag_s
    duration = min(max(edges_s, 2400.0), 7200.0)
    t = np.arange(-2700.0, duration, 1.0 / scene.rate_hz)
    flags: dict[str, list[tuple[Array, npt.NDArray[np.bool_]]]] = {OURS: []}
    for _ in range(n):
        case, board = temperatures(scene, t, duration, rng, RIPPLE_C if is_rippled else 0.0)
        readings = read(case, scene, rng)
        flags[OURS].append((t, ours(scene, readings, read(board, scene, rng)) == Regime.DYNAMIC))
        for name, threshold in thresholds.items():
            flags.setdefault(name, []).append((t, RIVALS[name](scene, readings) > threshold))
    return {name: judge(each, duration) for name, each in flags.items()}


def run_soak(job: tuple[Scene, float, int]) -> tuple[str, int, int, float]:
    """
    Count openings, switches and the decided share of one soak, shipped detector.

    """
    scene, hours, seed = job
    rng = rng_of(seed, 7, scene)
    t = np.arange(0.0, 3600.0 * hours, 1.0 / scene.rate_hz)
    case, board = temperatures(scene, t, 0.0, rng)
    flag = ours(scene, read(case, scene, rng), read(board, scene, rng))
    known = flag[flag >= 0]
    switches = int(np.count_nonzero(np.diff(known)))
    return scene.sensor, int(np.count_nonzero(np.diff(known) == 1)), switches, len(known) / len(t)


def quantiles(delays: list[float]) -> tuple[float, float]:
    """
    Median and 95 %; infinite when there is none.

    """
    if not delays:
        return np.inf, np.inf
    return float(np.median(delays)), float(np.percentile(delays, 95))


def cost() -> dict[str, float]:
    """
    CPU microseconds per reading, best of three, and those of one numpy scalar call.

    """
    scene = Scene(0.5, 900.0, 0.001, 0.0, 1.0)
    rng = np.random.default_rng(0)
    t = np.arange(-7200.0, 7200.0)
    case, board = (read(x, scene, rng).tolist() for x in temperatures(scene, t, 3600.0, rng))
    best = dict.fromkeys(('thermometer', 'thermometer + detector', 'numpy scalar call'), np.inf)

    def keep(name: str, begin: float, n: int) -> None:
        best[name] = min(best[name], (time.process_time() - begin) / n * 1e6)

    value = np.float64(2.0)
    for _ in range(3):
        own = settings(scene)
        one, other, detector = Thermometer(own.case), Thermometer(own.board), RegimeDetector(own)
        begin = time.process_time()
        for k, reading in enumerate(board):
            other.update(k * 10**9, reading)
        keep('thermometer', begin, len(board))
        begin = time.process_time()
        for k, reading in enumerate(case):
            one.update(k * 10**9, reading)
            detector.update(k * 10**9, one, other)
        keep('thermometer + detector', begin, len(case))
        begin = time.process_time()
        for _ in range(100_000):
            np.sqrt(value)
        keep('numpy scalar call', begin, 100_000)
    return best


def cost_table() -> Rows:
    """
    Cost of a reading beside that of the smallest numpy call.

    """
    measured = cost()
    unit = measured['numpy scalar call']
    rows = [['per reading', 'CPU us', 'numpy scalar calls']]
    rows += [[name, f'{each:.2f}', f'{each / unit:.0f}'] for name, each in measured.items()]
    return rows


def table(title: str, rows: Rows) -> None:
    """
    Print a Markdown table, the first row its head.

    """
    print(f'## {title}\n')
    for k, row in enumerate(rows):
        print('| ' + ' | '.join(each.replace('|', '\\|') for each in row) + ' |')
        if k == 0:
            print('|' + '---|' * len(row))
    print(flush=True)


def onset_table(pool: Pool, is_quick: bool, seed: int) -> Rows:
    """
    Delays of the named ramp by sensor, and of the CUSUM that knows it.

    """
    n, hours = (6, 20.0) if is_quick else (200, 400.0)
    scenes = [Scene(0.5, 900.0, noise, quantum, 1.0) for noise, quantum in SENSORS]
    jobs = [((scene,), n, 0.0, seed, rippled) for scene in scenes for rippled in (False, True)]
    plain = [scene for scene in scenes if not scene.quantum]
    bounds = pool.starmap_async(
        known_signature_delays,
        [(each, settings(each).false_alarms_per_hour, hours, n, seed) for each in plain],
    )
    found = [each[0] for each in pool.map(run_scenes, jobs, chunksize=1)]
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
            'flips',
            'ramps',
        ]
    ]
    for (scene, outcomes), job in zip(found, jobs, strict=True):
        one, is_rippled = outcomes[OURS], job[4]
        bound = ('', '') if is_rippled else bound_of.get(scene, ('', ''))
        rows.append(
            [
                scene.sensor,
                'yes' if is_rippled else 'no',
                *(f'{each:.0f}' for each in quantiles(one.delays)),
                *(f'{each:.0f}' if each else '' for each in bound),
                f'{one.missed}',
                f'{one.flips}',
                f'{one.n}',
            ]
        )
    return rows


def soak_table(pool: Pool, hours: float, seed: int) -> Rows:
    """
    Switches per hour of soak by sensor.

    """
    runs = max(1, round(hours / len(SENSORS) / SOAK_H))
    scenes = [Scene(0.5, 900.0, noise, quantum, 1.0) for noise, quantum in SENSORS]
    jobs = [(scene, SOAK_H, seed + k) for scene in scenes for k in range(runs)]
    soaks = pool.map(run_soak, jobs, chunksize=1)
    rows = [['sensor', 'hours', 'openings', 'switches', 'switches per hour']]
    for sensor in [*dict.fromkeys(each[0] for each in soaks), 'all']:
        mine = [each for each in soaks if sensor in {each[0], 'all'}]
        span = SOAK_H * sum(each[3] for each in mine)
        switches = sum(each[2] for each in mine)
        openings = sum(each[1] for each in mine)
        rows.append(
            [sensor, f'{span:.0f}', f'{openings}', f'{switches}', f'{switches / span:.4f}']
        )
    return rows


def run_matrix(pool: Pool, is_quick: bool, seed: int, n_ramps: int | None, hours: float) -> Matrix:
    """
    All rules over all scenes; `hours` of soak tune the rivals, 0 leaves them out.

    """
    ramps = (0.1, 0.5, 3.0) if is_quick else (0.1, 0.2, 0.5, 1.0, 3.0)
    lags = (180.0, 900.0) if is_quick else (180.0, 900.0, 1200.0)
    jobs: list[Job] = [
        (
            tuple(Scene(ramp, lag, noise, quantum, rate) for ramp in ramps),
            1 if is_quick else n_ramps or RAMPS[rate],
            2.5 if is_quick else hours,
            seed,
            True,
        )
        for rate in ((1.0, 0.1) if is_quick else RAMPS)
        for lag in lags
        for noise, quantum in SENSORS
    ]
    return [one for each in pool.map(run_scenes, jobs, chunksize=1) for one in each]


def rate_table(matrix: Matrix) -> Rows:
    """
    Count what ours made of the ramps, by the rate of the readings.

    """
    rows = [['readings', 'ramps', 'missed', 'missed of >= 0.2 K/min', 'with a flip']]
    for rate in dict.fromkeys(scene.rate_hz for scene, _ in matrix):
        mine = [(scene, each[OURS]) for scene, each in matrix if scene.rate_hz == rate]
        rows.append(
            [
                f'{rate:g} Hz',
                f'{sum(one.n for _, one in mine)}',
                f'{sum(one.missed for _, one in mine)}',
                f'{sum(one.missed for scene, one in mine if scene.ramp_k_min >= 0.2)}',
                f'{sum(one.flips for _, one in mine)}',
            ]
        )
    return rows


def rule_table(matrix: Matrix) -> Rows:
    """
    Missed ramps, flips and the flagged share, by rule.

    """
    rows = [
        [
            'rule',
            'ramps',
            'missed of >= 0.2 K/min',
            'with a flip',
            'already dynamic',
            'share flagged',
        ]
    ]
    for name in matrix[0][1]:
        every = [each[name] for _, each in matrix]
        due = [each[name] for scene, each in matrix if scene.ramp_k_min >= 0.2]
        count = sum(one.n for one in every)
        flagged = sum(one.flagged * one.n for one in due) / sum(one.n for one in due)
        rows.append(
            [
                f'`{name}`',
                f'{count}',
                f'{sum(one.missed for one in due)}',
                f'{sum(one.flips for one in every)}',
                f'{sum(one.early for one in every)}',
                f'{flagged:.3f}',
            ]
        )
    return rows


def scene_table(matrix: Matrix, lag: float) -> Rows:
    """
    Median delay and flagged share of each rule in each scene of one lag.

    """
    names = list(matrix[0][1])
    rows = [['sensor', 'Hz', 'K/min', *(f'`{name}`' for name in names)]]
    for scene, each in matrix:
        if scene.lag_s == lag:
            cells = [
                f'{quantiles(each[name].delays)[0]:.0f} ({each[name].flagged:.2f})'
                for name in names
            ]
            rows.append([scene.sensor, f'{scene.rate_hz:g}', f'{scene.ramp_k_min:g}', *cells])
    return rows


def main() -> None:
    """
    Run the parts and print their tables.

    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='a small version, some seconds')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--workers', type=int, default=1, help='processes')
    parser.add_argument('--soak-hours', type=float, default=1000.0)
    parser.add_argument('--ramps', type=int, help='per scene, of ours alone, and no other table')
    parser.add_argument('--json', metavar='FILE', help='every table, machine-readable')
    arguments = parser.parse_args()
    is_quick, seed = arguments.quick, arguments.seed
    figures: dict[str, Rows] = {}

    def show(title: str, rows: Rows) -> None:
        figures[title] = rows
        table(title, rows)

    with multiprocessing.Pool(arguments.workers) as pool:
        if arguments.ramps:
            matrix = run_matrix(pool, is_quick, seed, arguments.ramps, 0.0)
            show('Ramps by rate of the readings', rate_table(matrix))
        else:
            show('Onset of 0.5 K/min behind 15 min at 1 Hz', onset_table(pool, is_quick, seed))
            hours = 25.0 if is_quick else arguments.soak_hours
            show('Switches in soak with ripple and drift, 1 Hz', soak_table(pool, hours, seed))
            matrix = run_matrix(pool, is_quick, seed, None, TUNING_H)
            show('Ramps by rate of the readings', rate_table(matrix))
            show('The matrix by rule', rule_table(matrix))
            for lag in sorted({scene.lag_s for scene, _ in matrix}):
                title = 'Median onset delay in s (share of the ramp flagged), lag {:g} min'
                show(title.format(lag / 60.0), scene_table(matrix, lag))
            show('Cost', cost_table())
    if arguments.json:
        text = json.dumps({'seed': seed, 'quick': is_quick, 'tables': figures}, indent=1)
        Path(arguments.json).write_text(text + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
