# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prints the figures of docs/beyond_1g.md: errors of nonlinear terms K2, K3 from centrifuge runs.

Run ``python benchmarks/nonlinearity.py``, or with fewer units: ``--units 4``. The runs come from
a generator in this file, not from `thermo_comp.simulation`. A test has 12 mountings, each in three
soaks at 1 g and at 2, 4, 7 and 10 g. The stated |f| has an error of 1 ppm (1 sd), the samples in
m/s^2 have a noise of 5 ug/sqrt(Hz), and bias and scale are quadratic in the board's temperature.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from thermo_comp.fitting import FitOptions, FitSource, fit
from thermo_comp.fitting.nonlinear import without_terms
from thermo_comp.fitting.sources import KnownForce, Section
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.online.status import CompensatorConfig
from thermo_comp.recording.blocks import Block, Readings
from thermo_comp.typing import Floats
from thermo_comp.unit.calibration import Calibration, parameter_layout

G = 9.80665
MICRO = 1e-6 * G
LEVELS_G = (2.0, 4.0, 7.0, 10.0)
#: Temperatures of the soaks [degC], duration of a soak and of a ramp between soaks [s].
SOAKS_C, SOAK_S, RAMP_S = (20.0, 35.0, 5.0), 2700.0, 900.0
#: Times in a soak [s]: settling before the centrifuge runs, each level of |f|, each spin-up.
SETTLE_S, LEVEL_S, SPIN_UP_S = 1500.0, 240.0, 30.0
FORCE_SD = 1e-6
NOISE = 5.0 * MICRO
BOARD_LAG_S = 200.0
UNCHECKED = CompensatorConfig(stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0)


@dataclass(frozen=True)
class Unit:
    """True constants of a unit; K2 [g/g^2] and K3 [g/g^3] grow by 100 * `share` % per K."""

    scale: Floats
    scale_slope: Floats
    bias: Floats
    bias_slope: Floats
    M: Floats
    k2: Floats
    k3: Floats
    share: float = 0.01

    @classmethod
    def drawn(cls, rng: np.random.Generator, k2: float, k3: float) -> Unit:
        """Draw a unit with K2 and K3 of the given sizes and random signs."""
        M = np.eye(3)
        M[[1, 2, 2], [0, 0, 1]] = 1e-3 * rng.standard_normal(3)
        return cls(
            1.0 + 5e-3 * rng.standard_normal(3),
            np.outer([1e-6, 1e-8], [1.0, 1.0, 1.0]) * (50.0 + 30.0 * rng.standard_normal((2, 3))),
            1500.0 * MICRO * rng.standard_normal(3),
            np.array([[10.0], [0.1]]) * MICRO * rng.standard_normal((2, 3)),
            M,
            k2 * rng.choice((-1.0, 1.0), 3),
            k3 * rng.choice((-1.0, 1.0), 3),
        )

    def read(self, force: Floats, board: Floats) -> Floats:
        """Return the readings of the axes without noise, shape (n, 3) [m/s^2]."""
        t = (board - 20.0)[:, None]
        f = force @ np.linalg.inv(self.M).T / G
        bent = f + (1.0 + self.share * t) * (self.k2 * f**2 + self.k3 * f**3)
        scale = self.scale * (1.0 + t * self.scale_slope[0] + t * t * self.scale_slope[1])
        return scale * G * bent + self.bias + t * self.bias_slope[0] + t * t * self.bias_slope[1]


@dataclass(frozen=True)
class Run:
    """A centrifuge run: samples and readings, true force, and stated |f|."""

    block: Block
    force: Floats
    stated: KnownForce
    levels: Floats  # |f| of each sample in g, rounded


def run(
    unit: Unit, inward: Floats, rng: np.random.Generator, levels: tuple[float, ...] = LEVELS_G
) -> Run:
    """Simulate a centrifuge run of a mounting: in each soak 1 g, then the levels of |f|."""
    knots, air = [0.0], [SOAKS_C[0]]
    for last, target in zip((SOAKS_C[0], *SOAKS_C), (*SOAKS_C, SOAKS_C[-1]), strict=False):
        if target != last:
            knots.append(knots[-1] + RAMP_S)
            air.append(target)
        if len(air) < 2 * len(SOAKS_C):
            knots.append(knots[-1] + SOAK_S)
            air.append(target)
    time = np.arange(0.5, knots[-1])
    case = np.interp(time, knots, air)
    board, now = np.empty_like(case), case[0]
    for k, outside in enumerate(case.tolist()):
        now += (outside - now) / BOARD_LAG_S
        board[k] = now
    marks, sizes = [0.0], [0.0]
    for soak in range(len(SOAKS_C)):
        begin = soak * (SOAK_S + RAMP_S) + SETTLE_S
        for level in (*levels, 1.0):
            marks += [begin, begin + SPIN_UP_S]
            sizes += [sizes[-1], np.sqrt(level**2 - 1.0)]
            begin += SPIN_UP_S + LEVEL_S
    marks.append(knots[-1])
    sizes.append(0.0)
    upward = np.cross(inward, np.roll(inward, 1) + np.array([0.1, 0.0, 0.0]))
    upward /= np.linalg.norm(upward)
    force = G * (upward + np.interp(time, marks, sizes)[:, None] * inward)
    sections = []
    for (begin, size), (end, after) in pairwise(zip(marks, sizes, strict=True)):
        if size == after:
            true = G * float(np.hypot(1.0, size))
            sd = FORCE_SD * true * (size > 0.0)
            sections.append(Section(begin, end, true + sd * rng.standard_normal(), sd))
    samples = unit.read(force, board) + NOISE * rng.standard_normal(force.shape)
    stamps = np.rint(time * 1e9).astype(np.int64)
    every = slice(0, None, 5)
    temperatures = {
        name: Readings(
            stamps[every],
            values[every] + 0.003 * rng.standard_normal(len(stamps[every])),
            np.arange(len(stamps))[every],
        )
        for name, values in (('board', board), ('case', case))
    }
    levels_of = np.round(np.linalg.norm(force, axis=1) / G, 3)
    block = Block(stamps, samples, '', None, temperatures, {})
    return Run(block, force, KnownForce('run', tuple(sections)), levels_of)


def mountings(rng: np.random.Generator) -> Floats:
    """Return the 12 corners of a randomly turned icosahedron as directions of the force."""
    golden = (1.0 + 5.0**0.5) / 2.0
    quad = np.array([(0.0, a, b * golden) for a in (1.0, -1.0) for b in (1.0, -1.0)])
    corners = np.concatenate([np.roll(quad, turn, axis=1) for turn in range(3)])
    turned, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return corners / np.linalg.norm(corners[0]) @ turned


def fitted(runs: list[Run], **options: float) -> Calibration:
    """Fit the runs of one unit."""
    sources = [
        FitSource(f'run{k}', lambda record=record: [record.block], force=record.stated)
        for k, record in enumerate(runs)
    ]
    wanted = FitOptions(gravity=G, input='m/s^2', full_scale=12.0 * G, **options)
    return fit(sources, wanted).calibration


def residual_ug(calibration: Calibration, record: Run, level: float) -> float:
    """Return the RMS vector error [ug] of means over 60 s at `level`, a value of |f| [g]."""
    compensator = Compensator(calibration, UNCHECKED)
    corrected = process_block(compensator, record.block)
    error = corrected.specific_force - record.force[corrected.index]
    at = record.levels[corrected.index] == level
    edges = np.flatnonzero(np.diff(np.r_[0, at, 0]))
    means = [
        error[a + k : a + k + 60].mean(axis=0)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        for k in range(0, b - a - 59, 60)
    ]
    return float(np.sqrt(np.mean(np.square(means).sum(axis=1))) / MICRO)


def figures(seed: int, k2: float, k3: float) -> dict[str, Floats]:
    """Fit a unit; return errors and error / claimed sd of K2 and K3, and the RMS error at 5 g."""
    rng = np.random.default_rng(seed)
    unit = Unit.drawn(rng, k2, k3)
    runs = [run(unit, inward, rng) for inward in mountings(rng)]
    calibration = fitted(runs)
    layout = parameter_layout(calibration)
    sd = np.sqrt(np.diag(calibration.posterior.covariance()))
    nonlinearity = calibration.nonlinearity
    of_terms = sd[layout.nonlinear : layout.misalignment].reshape(3, 2, -1)
    result = {'kinds': np.array([term.kind for term in nonlinearity.terms])}
    if not k2:
        # Repeat the fit with K2 and K3 fixed at 0; return (change / claimed sd) of bias and scale.
        without = fitted(runs, k2_sd=1e-12, k3_sd=1e-13)
        values = [
            np.array([[a.bias / a.scale_factor, np.log(a.scale_factor)] for a in used.axes])
            for used in (calibration, without)
        ]
        bias = sd[[curve.static for curve in layout.bias]] / [
            a.scale_factor for a in calibration.axes
        ]
        scale = sd[[block.static for block in layout.scale]]
        result['moved'] = (values[0] - values[1]) / np.column_stack((bias, scale))
        return result
    for k, term in enumerate(nonlinearity.terms):
        true = {'square': unit.k2, 'cube': unit.k3}.get(term.kind, np.zeros(3))
        result[term.kind] = (np.array(term.coefficient) - true) / np.abs(true)
        result[f'{term.kind} ratio'] = (np.array(term.coefficient) - true) / of_terms[:, 0, k]
        slope = np.array(term.per_kelvin) - unit.share * true
        result[f'{term.kind} slope ratio'] = slope / of_terms[:, 1, k]
    # The held-out force is nearly along an axis, where the nonlinear terms are largest.
    direction = np.eye(3)[seed % 3] * rng.choice((-1.0, 1.0)) + 0.1 * rng.standard_normal(3)
    new = run(unit, direction / np.linalg.norm(direction), rng, (5.0,))
    result['after'] = np.array([residual_ug(calibration, new, 5.0)])
    result['before'] = np.array([residual_ug(without_terms(calibration), new, 5.0)])
    return result


def main() -> int:
    """Print the figures; return 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--units', type=int, default=20, help='units with nonlinear terms')
    parser.add_argument('--without', type=int, default=5, help='units without nonlinear terms')
    parser.add_argument('--processes', type=int, default=2, help='units fitted at once')
    options = parser.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        results = list(pool.map(partial(figures, k2=1e-5, k3=1e-6), range(options.units)))
        plain = list(pool.map(partial(figures, k2=0.0, k3=0.0), range(100, 100 + options.without)))
    wrong = 0

    def say(name: str, value: float, low: float, high: float) -> None:
        nonlocal wrong
        is_met = low <= value <= high
        wrong += not is_met
        print(
            f'{name:58} {value:9.3g}   goal {low:g} .. {high:g}   {"met" if is_met else "MISSED"}'
        )

    for seed, result in enumerate(results):
        print(
            seed,
            *result['kinds'],
            f'without terms {result["before"][0]:.0f} ug, with terms {result["after"][0]:.2f} ug',
        )
    for kind in ('square', 'cube'):
        has = [unit for unit in results if kind in unit]
        say(f'{kind}: share of files with the term', len(has) / len(results), 1.0, 1.0)
        each = np.array([unit[kind] for unit in has])
        say(f'{kind}: RMS relative error', float(np.sqrt(np.mean(each**2))), 0.0, 0.02)
        say(f'{kind}: largest relative error', float(np.abs(each).max()), 0.0, 0.02)
        for name in (f'{kind} ratio', f'{kind} slope ratio'):
            ratio = np.array([unit[name] for unit in has])
            say(f'{name}: RMS error / claim', float(np.sqrt(np.mean(ratio**2))), 0.7, 1.4)
    say(
        'every file has exactly two terms (1: yes)',
        float(all(len(result['kinds']) == 2 for result in results)),
        1,
        1,
    )
    rms = {
        k: float(np.sqrt(np.mean([result[k] ** 2 for result in results])))
        for k in ('before', 'after')
    }
    say('RMS error at 5 g in a new mounting, without K2, K3 [ug]', rms['before'], 200.0, 700.0)
    say('RMS error at 5 g in a new mounting, with K2, K3 [ug]', rms['after'], 0.0, 3.0)
    if plain:
        say(
            'units without nonlinearity: number of terms in all files',
            sum(len(unit['kinds']) for unit in plain),
            0,
            0,
        )
        moved = float(np.abs([unit['moved'] for unit in plain]).max())
        say('units without nonlinearity: change of bias, scale / sd', moved, 0.0, 1.0)
    return int(wrong > 0)


if __name__ == '__main__':
    sys.exit(main())
