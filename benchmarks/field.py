# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compares updates in the field with an optimal filter, for units that age (`field_units.py`).

    python benchmarks/field.py [--units 10] [--days 60] [--recordings ../shared/data]

Half of the units are in vehicles, level within 10 deg, half are carried in any attitude. Units age
for 60 days: random walks of the bias (15 ug per root day) and scale (10 ppm per root day), bias
offsets at turn-on (sd 20 ug) and one shock (sd 300 ug). On six days the calibration is updated
with all earlier rests, as by `thermo_comp update`, and judged on the next day's rests. After the
last day the errors of the updated calibration are compared with those of a Kalman filter that is
given the true variances and the time of the shock. With --recordings FOLDER, the real recordings
in FOLDER are cut into parts, and an update with all earlier parts is judged on the next part.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from field_recorded import judge_recordings
from field_units import (
    DAY_ZERO,
    KINDS,
    NOISE,
    REFERENCE_C,
    UG,
    WINDOW_S,
    BestFilter,
    Floats,
    G,
    History,
    K,
    Process,
    attitude,
    calibration,
    corrected,
    live,
    measured,
)

from thermo_comp.field.rest import Rest, encode
from thermo_comp.field.series import RestSeries, series_of
from thermo_comp.field.update import update
from thermo_comp.unit.calibration import Calibration

#: Number of pairs of attitude and temperature at which the errors are evaluated.
N_PROBES = 200
LABORATORY = calibration()


def probes(kind: str, state: Floats, seed: int) -> tuple[list, Floats, Floats, Floats]:
    """
    Build noise-free rests in random attitudes of a platform `kind`; return the rests, their
    samples / `K` [m/s^2], board temperatures less the reference [K], and true forces [m/s^2].
    """
    rng = np.random.default_rng(seed)
    force = G * np.array([attitude(kind, rng) for _ in range(N_PROBES)])
    warmth = rng.normal(0.0, 5.0, N_PROBES)
    counts = measured(force, warmth, state)
    start = live(kind, 0, 1, Process()).rests[0][0]
    rests = []
    for number, (count, warm) in enumerate(zip(counts, warmth, strict=True)):
        thermal = (REFERENCE_C + warm, 1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6)
        stamp = start.start_ns + number * 10**13
        rests.append((start, Rest(stamp, 1000, tuple(K * count), (K * NOISE * 10,) * 3, thermal)))
    return rests, counts, warmth, force


def errors_of(series: RestSeries, calibrated: Calibration, force: Floats) -> Floats:
    """Return the errors of |f| and of the axes x, y, z after correction [m/s^2], shape (n, 4)."""
    f = series.force @ np.array(calibrated.misalignment).T
    return np.column_stack((series.residual, f - force))


def rms_of(values: Floats) -> float:
    """Return the RMS of all values of an array."""
    return float(np.sqrt(np.mean(np.square(values))))


def worse(after: list, new: Calibration, kalman: Floats) -> tuple[bool, bool]:
    """
    Return whether the RMS of |f| - g on the rests of a day is larger than with the laboratory's
    calibration, for the updated calibration and for the Kalman filter.

    An RMS counts as larger if it exceeds the RMS with the laboratory's calibration by more than
    claimed sd / sqrt(2 n), the standard error of an RMS over n turn-ons.
    """
    old, updated = (series_of(after, given) for given in (LABORATORY, new))
    counts = np.array([rest.mean for _, rest in after]) / K
    warmth = np.array([rest.state[0] for _, rest in after]) - REFERENCE_C
    of_best = np.linalg.norm(corrected(counts, warmth, kalman), axis=1) - G
    # Average |f| - g over the windows of each rest and attitude, as in the rows of `series_of`.
    group = np.repeat(np.arange(len(old)), old.n_windows)
    of_best = np.bincount(group, of_best) / old.n_windows

    weights = old.n_windows / np.bincount(old.start, old.n_windows)[old.start]
    n_starts = int(old.start[-1]) + 1
    before, *later = (
        np.sqrt(weights @ x**2 / n_starts) for x in (old.residual, updated.residual, of_best)
    )
    error = rms_of(updated.claim) / np.sqrt(2.0 * n_starts)
    found = [bool(rms > before + error) for rms in later]
    return found[0], found[1]


def filtered(history: History, process: Process, days: int) -> Floats:
    """Return the Kalman filter's state after `days` days, with the turn-on offset set to zero."""
    state = best(history, process, days).state.copy()
    state[21:] = 0.0
    return state


def best(history: History, process: Process, days: int) -> BestFilter:
    """Run the Kalman filter over the rests of the first `days` days; a rest is one measurement."""
    found = BestFilter(process)
    rests: dict[tuple, list[Rest]] = defaultdict(list)
    for (_, rest), day, start in zip(history.rests, history.day, history.start, strict=True):
        if day < days:
            rests[start, rest.state[0]].append(rest)
    for (start, celsius), windows in rests.items():
        mean = np.mean([window.mean for window in windows], axis=0) / K
        variance = NOISE**2 / (WINDOW_S * len(windows))
        now = windows[0].stamp_ns / 86400e9 - DAY_ZERO
        found.take(now, start, mean, celsius - REFERENCE_C, variance)
    return found


def unit(kind: str, seed: int, days: int) -> tuple[dict[str, Floats], list, float]:
    """
    Simulate an ageing unit and its updates; return the errors after the last day, the result of
    `worse` for each update, and the computing time of the last update [s].
    """
    shock_day = np.random.default_rng([seed, 7]).uniform(0.2, 0.8) * days
    process = Process(shock_day=float(shock_day))
    history = live(kind, seed, days, process)
    day = np.array(history.day)
    compared = []
    for until in np.linspace(days / 6.0, days, 6).round().astype(int):
        chosen = [history.rests[k] for k in np.flatnonzero(day < until)]
        begin = time.perf_counter()
        updated = update(series_of(chosen, LABORATORY), LABORATORY)
        took = time.perf_counter() - begin
        new = updated.calibration if updated.judged.is_better else LABORATORY
        after = [history.rests[k] for k in np.flatnonzero(day == until)]
        if after:
            kalman = filtered(history, process, until)
            compared.append(worse(after, new, kalman))
    state = history.states[-1]
    rests, counts, warmth, force = probes(kind, state, seed)
    series, before = series_of(rests, new), series_of(rests, LABORATORY)
    kalman = filtered(history, process, days)
    f = corrected(counts, warmth, kalman)
    of_best = np.column_stack((np.linalg.norm(f, axis=1) - G, f - force))
    # The claimed sd holds for |f| in a window one day after the update, after a further turn-on:
    # add a turn-on offset, noise and a random walk over a day to the error.
    rng = np.random.default_rng([seed, 9])
    of_bias = np.hypot(process.turn_on, process.bias)
    more = (series.direction * rng.normal(0.0, of_bias, (N_PROBES, 3))).sum(axis=1)
    of_scale = rng.normal(0.0, process.scale, (N_PROBES, 3))
    more += (series.direction * series.force * of_scale).sum(axis=1)
    more += rng.normal(0.0, NOISE / np.sqrt(WINDOW_S), N_PROBES)
    return (
        {
            'before': errors_of(before, LABORATORY, force),
            'after': errors_of(series, new, force),
            'best': of_best,
            'claimed': series.claim[:, None],
            'missed': (series.residual + more)[:, None],
        },
        compared,
        took,
    )


def simulated(kind: str, n_units: int, days: int) -> None:
    """Print errors on a kind of platform before and after updates, and of the Kalman filter."""
    results = [unit(kind, seed, days) for seed in range(n_units)]
    joined = {name: np.array([result[0][name] for result in results]) for name in results[0][0]}
    print(f'\n{kind}: {n_units} units, {days} days, one shock each')
    for column, name in enumerate(('|f|', 'x', 'y', 'z')):
        a, b, c = (rms_of(joined[key][..., column]) / UG for key in ('before', 'after', 'best'))
        n_worse, n_best = (
            sum(
                rms_of(result[0][key][:, column]) > rms_of(result[0]['before'][:, column])
                for result in results
            )
            for key in ('after', 'best')
        )
        print(
            f'  {name:4} before {a:6.1f} ug  after {b:6.1f}  filter {c:6.1f}  ratio {b / c:.2f}  '
            f'units with a larger error after {n_worse} (filter: {n_best})'
        )
    ratio = rms_of(joined['missed']) / rms_of(joined['claimed'])
    print(f'  error / claimed sd of |f| {ratio:.2f} (goal 0.7 .. 1.4)')
    days_after = np.array([pair for result in results for pair in result[1]])
    print(
        f'  RMS larger with the update than without, by more than its standard error, on '
        f'{days_after[:, 0].sum()} (filter: {days_after[:, 1].sum()}) of {len(days_after)} days'
    )
    print(f'  time of an update: {max(result[2] for result in results):.1f} s at most')


def log_size() -> None:
    """Print the size of the rest log of an ageing unit over 30 days."""
    history = live('carried', 0, 30, Process())
    size = sum(len(encode(rest)) for _, rest in history.rests)
    size += sum(len(encode(start)) for start in {start for start, _ in history.rests})
    print(f'rest log of 30 days: {size / 1e6:.2f} MB, {len(history.rests)} windows')


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--units', type=int, default=10, help='units on each kind of platform')
    parser.add_argument('--days', type=int, default=60, help='days for which a unit ages')
    parser.add_argument('--recordings', type=Path, help='folder with the real recordings')
    arguments = parser.parse_args()
    for kind in KINDS[:2]:
        simulated(kind, arguments.units, arguments.days)
    log_size()
    if arguments.recordings is not None:
        judge_recordings(arguments.recordings)


if __name__ == '__main__':
    main()
