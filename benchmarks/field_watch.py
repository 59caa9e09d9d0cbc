# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Measures verdicts and forecasts of the drift watch on simulated units (`field_units.py`).

    python benchmarks/field_watch.py [--units 20] [--days 30]

Units with attitudes of five kinds age by random walks of known sd and log rests. For each unit 200
continuations of the random walk are drawn, until the RMS of |f| - g over random attitudes of its
kind, with the scatter of turn-ons, exceeds a tolerance of 200 ug. The figures of a forecast are
the percentage of the drawn times in the forecast's 10 to 90 % interval, and the forecast's median
divided by the median drawn time. A second part of the benchmark gives a verdict every five days on
level and on carried units, half of which do not age. The figures are the numbers of verdicts
"outside" in each class of (true RMS of |f| - g) / (twice the claimed sd).
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import numpy as np
from field import probes, rms_of
from field_units import DAY_ZERO, KINDS, UG, Floats, G, Process, calibration, live

from thermo_comp.field.series import RestSeries, series_of
from thermo_comp.field.update import update
from thermo_comp.field.watch import LIMIT, watch

#: Edges of the classes of (true RMS of |f| - g) / (limit of the verdict); verdicts are counted.
CLASSES = (0.0, 0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5, 9.0)
LABORATORY, TOLERANCE, N_FUTURES = calibration(), 200.0 * UG, 200


def exits(probe: RestSeries, process: Process, bound: float, rng: np.random.Generator) -> Floats:
    """Draw 200 random walks of bias and scale; return times [days] when RMS |f| - g > `bound`."""
    size = np.repeat([process.bias, process.scale * G], 3) / np.sqrt(3.0)
    error, levels = np.full(N_FUTURES, np.inf), np.zeros((N_FUTURES, 6))
    # The norm of `root` @ (1, changes `levels` of bias and scale) is the RMS of |f| - g.
    joined = np.column_stack((probe.residual, probe.by_level)) / np.sqrt(len(probe))
    root = np.asarray(np.linalg.qr(joined, mode='r'))
    for step in range(3 * 3650):
        residual = root[:, 0] + levels @ root[:, 1:].T
        is_out = (residual**2).sum(axis=1) + process.turn_on**2 > bound**2
        error[is_out] = np.minimum(error[is_out], step / 3.0)
        if np.isfinite(error).all():
            break
        levels += size * rng.standard_normal(levels.shape)
    return error


def forecasts(kind: str, n_units: int, days: int) -> dict[str, Floats]:
    """
    Compare forecasts and recalibration intervals with simulated times [days] after which the error
    exceeds the tolerance.

    Each row has the share of simulated times in the forecast's 10 to 90 % interval, the median of
    the simulated times [days], and the forecast's quantiles 10, 50 and 90 % [days].
    """
    rng, process = np.random.default_rng(3), Process()
    found: dict[str, list[tuple[float, ...]]] = {'forecast': [], 'interval': []}
    for seed in range(n_units):
        history = live(kind, seed, days, process)
        series = series_of(history.rests, LABORATORY)
        result = watch(series, LABORATORY, TOLERANCE)
        updated = update(series, LABORATORY, ahead=0.0).calibration
        rests = probes(kind, history.states[-1], seed)[0]
        before, after = (series_of(rests, known) for known in (LABORATORY, updated))
        for name, probe, printed in (
            ('forecast', before, result.forecast),
            ('interval', after, result.interval),
        ):
            if printed:
                drawn = exits(probe, process, TOLERANCE, rng)
                inside = ((drawn >= printed[0]) & (drawn <= printed[2])).mean()
                found[name].append((float(inside), float(np.median(drawn)), *printed))
    return {name: np.array(rows) for name, rows in found.items()}


def verdicts(kind: str, n_units: int, days: int) -> None:
    """Print the number of verdicts "outside" by the class of the true RMS of |f| - g / limit."""
    found = []
    for seed in range(2 * n_units):
        ageing = {'bias': 0.0, 'scale': 0.0} if seed % 2 else {}
        process = Process(**ageing)
        history = live(kind, 100 + seed, days, process)
        series = series_of(history.rests, LABORATORY)
        for day in range(5, days + 1, 5):
            chosen = series.at(series.day < DAY_ZERO + day)
            probe = series_of(probes(kind, history.states[day - 1], seed)[0], LABORATORY)
            limit = LIMIT * rms_of(chosen.claim)
            ratio = float(np.hypot(rms_of(probe.residual), process.turn_on)) / limit
            found.append((ratio, 1 - seed % 2, watch(chosen, LABORATORY).exit_code))
    ratio, is_ageing, is_out = np.array(found).T
    for name, chosen in (('of constant error', is_ageing == 0), ('that age', is_ageing == 1)):
        print(f'{kind}: {n_units} units {name}, verdict every 5 days for {days} days')
        for low, high in pairwise(CLASSES):
            at = chosen & (ratio >= low) & (ratio < high)
            print(
                f'  true RMS / limit {low}..{high}: {int(is_out[at].sum())} of {at.sum()} outside'
            )


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--units', type=int, default=20, help='units of each kind')
    parser.add_argument('--days', type=int, default=30, help='days for which a unit logs rests')
    arguments = parser.parse_args()
    for kind in KINDS:
        for name, rows in forecasts(kind, arguments.units, arguments.days).items():
            shares, true, _, printed, _ = rows.T
            factor = np.log(np.maximum(printed, 0.3) / np.maximum(true, 0.3))
            print(
                f'{kind:12} {name}: {len(rows)} units, {100 * shares.mean():.0f} % of drawn times '
                f'in the 10 .. 90 % range; median {np.median(printed):.0f} days, drawn '
                f'{np.median(true):.0f} days, ratio {np.exp(np.median(factor)):.2f} (scatter over '
                f'the units: factor {np.exp(np.std(factor)):.1f})'
            )
    for kind in KINDS[:2]:
        verdicts(kind, arguments.units, arguments.days)


if __name__ == '__main__':
    main()
