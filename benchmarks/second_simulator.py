# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Simulates units whose physics the fit does not model exactly, without code of the simulator of
thermo_comp.

Run ``python benchmarks/second_simulator.py`` for the table of docs/accuracy.md, or a part of it:
``python benchmarks/second_simulator.py --kinds own,even --plans wide --seeds 1``.

Air, case, board, three heads and their pendulums are nodes of a thermal network, integrated in
steps of 2 s; self-heating makes the board warmer than the case. Bias and scale are functions
of the pendulums' temperatures. Samples at 1 Hz have noise of 5 ug (1 sd), thermometer readings at
0.5 Hz noise of 5 mK. Three runs are held out; attitudes, ramps, order of ramps and temperature of
the first soak differ from those in the runs of the fit.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from accuracy import errors, fit_and_correct

from thermo_comp.typing import Floats
from thermo_comp.unit.gravity import MICRO_G, STANDARD_GRAVITY

STEP_S, SAMPLE_S, READING_S = 2.0, 1.0, 2.0
NOISE_UG, READING_SD, READING_STEP = 5.0, 0.005, 0.001
REFERENCE_C, AIR_S, FULL_SCALE = 20.0, 90.0, 8388607.0
Program = tuple[float, float, list[tuple[float, float, float]]]
#: For each plan: seed, program and duration [s] of the test; seed and programs of held-out runs.
#: A program: start [degC], soak [min], then target [degC], rate [K/min] and soak [min] per ramp.
PLANS: dict[str, tuple[str, Program, float, str, list[Program]]] = {
    'wide': (
        'P18',
        (20, 25, [(60, 1, 50), (-40, 2, 60), (20, 0.5, 30), (45, 2, 30), (0, 1, 30),
                  (20, 0.5, 20), (35, 1, 10)]),
        34200.0,
        'H95',
        [
            (-20, 20, [(30, 0.7, 45), (-35, 1.4, 50), (55, 1, 40), (10, 1.7, 45)]),
            (50, 20, [(5, 1.5, 40), (40, 0.6, 50), (-30, 0.9, 45), (15, 1.2, 30)]),
            (5, 15, [(-15, 0.6, 30), (52, 0.8, 60), (25, 1.8, 30), (-36, 1.3, 60),
                     (-5, 0.55, 20)]),
        ],
    ),
    'mild': (
        'M18',
        (20, 25, [(35, 1, 60), (5, 2, 60), (25, 0.5, 40), (10, 1, 45), (33, 2, 60),
                  (15, 0.5, 60), (20, 1, 30)]),
        34200.0,
        'HM',
        [
            (12, 20, [(31, 0.7, 45), (17, 1.5, 50), (26, 0.6, 40), (7, 1, 45), (22, 1.7, 30)]),
            (30, 20, [(8, 1.2, 60), (24, 0.6, 50), (14, 1.8, 45)]),
            (18, 15, [(33, 1.4, 60), (9, 0.55, 40), (28, 1.9, 60)]),
        ],
    ),
}  # fmt: skip
# The bags of the fit are from 5 to 35 degC; the held-out runs exceed this range by 5 to 20 K.
PLANS['beyond'] = (
    *PLANS['mild'][:3],
    'HB',
    [
        (20, 30, [(high, 0.5, 60), (low, 0.5, 60), (20, 0.5, 30)])
        for low, high in ((0, 40), (-5, 45), (-15, 55))
    ],
)
#: Kinds of physics, in the order of the rows of the table in docs/accuracy.md.
KINDS = ('own', 'products', 'hyst', 'hystm', 'even', 'convection', 'slow', 'plain')


def seed_of(text: str) -> int:
    """Return a hash of a text as a seed for random numbers."""
    return int(hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()[:12], 16)


def unit_of(kind: str, seed: int) -> SimpleNamespace:
    """Draw a unit: coefficients of bias [ug/K^n] and scale [ppm/K^n], time constants [s]."""
    draw = np.random.default_rng(seed_of(f'{kind}-{seed}'))

    def normal(sd: float) -> Floats:
        return sd * draw.standard_normal(3)

    def signed(low: float, high: float) -> Floats:
        return np.asarray(draw.uniform(low, high, 3) * draw.choice([-1, 1], 3))

    # Keep the order of the random draws: another order gives other units for the same seeds.
    unit = SimpleNamespace(
        scale_factor=4e5 * (1.0 + 0.01 * draw.standard_normal(3)),
        constant=normal(1500.0),
        misalignment=normal(1e-3),
        case_s=draw.uniform(100, 300),
        board_s=draw.uniform(350, 900),
        own_heat_k=draw.uniform(0.5, 2.0),
        head_s=draw.uniform(500, 1500, 3),
        pendulum_s=draw.uniform(60, 200, 3),
        bias=[signed(4, 20), normal(0.08), normal(5e-4)],
        scale=[60.0 * (1.0 + 0.4 * draw.standard_normal(3)), normal(0.2)],
        stress=np.zeros((2, 3)),
        scale_stress=np.zeros((2, 3)),
        play=np.zeros((0, 3)),
        play_k=np.zeros(0),
        load=np.zeros((2, 3)),
        knee_k=0.5,
        walk=3.0 * (kind == 'slow'),
        gas=kind == 'convection',
    )
    normal(0.0)
    if kind not in ('own', 'slow'):
        unit.head_s, unit.pendulum_s = (
            np.full(3, lags[0]) for lags in (unit.head_s, unit.pendulum_s)
        )
    if kind == 'products':
        unit.stress = np.array([signed(3, 12), signed(0.05, 0.25)])
        unit.scale_stress = np.array([signed(10, 40), signed(0.2, 0.8)])
    parts = {'hyst': ((3, 2, 1, 0.7), (0.25, 0.8, 2, 5)), 'hystm': ((3, 2, 1.5), (0.3, 0.8, 2))}
    if kind in parts:
        sizes, widths = map(np.array, parts[kind])
        unit.play = draw.standard_normal((len(sizes), 3)) * sizes[:, None]
        unit.play_k = widths * draw.uniform(0.7, 1.4, len(sizes))
    if kind == 'even':
        slope, knee = signed(4, 15), draw.uniform(0.3, 1.0)
        unit.load, unit.knee_k = np.array([slope, normal(10.0)]), knee
    if kind == 'plain':
        unit.bias, unit.scale = [np.zeros(3)], [np.zeros(3)]
    return unit


def directions(n: int, seed: int) -> Floats:
    """Return n attitudes spread over the sphere, in a frame that depends on the seed."""
    k = np.arange(n) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / n), np.pi * (1.0 + 5.0**0.5) * k
    spiral = np.c_[np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)]
    turn, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return np.asarray(spiral @ turn)


def program_of(program: Program) -> tuple[Floats, Floats]:
    """Return the times [s] and temperatures [degC] at which ramps begin and end."""
    start, first_min, ramps = program
    corners = [(0.0, start), (60.0 * first_min, start)]
    for target, rate, soak_min in ramps:
        at, before = corners[-1]
        corners.append((at + 60.0 * abs(target - before) / rate, target))
        if soak_min:
            corners.append((corners[-1][0] + 60.0 * soak_min, target))
    seconds, celsius = np.array(corners).T
    return seconds, celsius


def states_of(unit: SimpleNamespace, air_c: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return the temperatures of case and board, shape (n, bags), those of the pendulums, and the
    bias by the play operators (hysteresis), both of shape (n, bags, 3).
    """
    n, n_bags = air_c.shape
    air, heat = air_c[0].copy(), unit.own_heat_k
    case = air + 0.3 * heat
    board = case + heat
    head = np.repeat(board[:, None], 3, axis=1)
    pendulum = head.copy()
    held = np.repeat(pendulum[:, None, :], len(unit.play), axis=1)
    cases, boards = np.empty((2, n, n_bags))
    pendulums, played = np.empty((n, n_bags, 3)), np.zeros((n, n_bags, 3))
    half = unit.play_k[:, None]
    for k in range(n):
        air = air + (air_c[k] - air) * STEP_S / AIR_S
        flow = case - board
        carries = 1.0
        if unit.gas:
            # The conductance of gas rises with temperature and with the temperature difference.
            warm = 0.5 + 0.5 * (1.0 + 0.006 * (board - REFERENCE_C))
            carries = warm * (0.7 + 0.3 * (np.abs(flow) / 3.0) ** 0.25)
        case = case + STEP_S * (air - case + 0.3 * heat - 0.1 * flow) / unit.case_s
        board = board + STEP_S * (flow * carries + heat) / unit.board_s
        head = head + (board[:, None] - head) * STEP_S / unit.head_s
        pendulum = pendulum + (head - pendulum) * STEP_S / unit.pendulum_s
        if len(half):
            around = pendulum[:, None, :]
            held = np.clip(held, around - half, around + half)
            played[k] = (unit.play * held).sum(axis=1) - REFERENCE_C * unit.play.sum(axis=0)
        cases[k], boards[k], pendulums[k] = case, board, pendulum
    return cases, boards, pendulums, played


def runs_of(
    unit: SimpleNamespace,
    program: Program,
    up: Floats,
    seed: int,
    *,
    lasts_s: float | None = None,
    soaked_s: float = 5400.0,
    soaked_c: float | None = None,
) -> list[Any]:
    """Return a run like `SimulatedRun` for each attitude of `up`, shape (n, 3)."""
    draw, n_bags = np.random.default_rng(seed), len(up)
    seconds, celsius = program_of(program)
    lasts_s = lasts_s or float(seconds[-1])
    t = np.arange(round((soaked_s + lasts_s) / STEP_S) + 1) * STEP_S - soaked_s
    first = celsius[0]
    # Before the recording the air changes from `before` to the first temperature at 2 K/min.
    before = first + draw.uniform(-5, 5, n_bags) if soaked_c is None else np.full(n_bags, soaked_c)
    coming = np.minimum(np.abs(first - before), (t + soaked_s)[:, None] / 30.0)
    coming = before + np.sign(first - before) * coming
    air = np.where((t < 0.0)[:, None], coming, np.interp(t, seconds, celsius)[:, None])
    air = air + 0.2 * draw.standard_normal(n_bags)
    air = air + 0.03 * np.sin(2.0 * np.pi * t[:, None] / 240.0 + draw.uniform(0, 6.28, n_bags))
    case, board, pendulum, played = states_of(unit, air)
    x, behind = pendulum - REFERENCE_C, board[:, :, None] - pendulum
    change = np.sqrt((case - board + unit.own_heat_k) ** 2 + unit.knee_k**2) - unit.knee_k
    bias = sum(c * x ** (k + 1) for k, c in enumerate(unit.bias)) + played
    bias = bias + (unit.stress[0] + unit.stress[1] * x) * behind
    bias = bias + unit.load[0] * change[:, :, None]
    scale = sum(c * x ** (k + 1) for k, c in enumerate(unit.scale))
    scale = scale + (unit.scale_stress[0] + unit.scale_stress[1] * x) * behind
    scale = scale + unit.load[1] * change[:, :, None]
    a, b, c = unit.misalignment
    aligned = np.linalg.inv(np.array([[1.0, 0.0, 0.0], [a, 1.0, 0.0], [b, c, 1.0]]))
    middle = np.arange(0.0, lasts_s, SAMPLE_S) + 0.5 * SAMPLE_S
    read = np.arange(0.0, lasts_s, READING_S) + 0.1
    result = []
    for bag, direction in enumerate(up):

        def seen(values: Floats, bag: int = bag) -> Floats:
            of_bag = values[:, bag].T
            return np.array([np.interp(middle, t, axis) for axis in of_bag]).T

        force = STANDARD_GRAVITY * direction
        noise = NOISE_UG * draw.standard_normal((len(middle), 3))
        if unit.walk:
            steps = draw.standard_normal((len(middle), 3)) * np.sqrt(SAMPLE_S / 3600.0)
            noise = noise + np.cumsum(unit.walk * steps, axis=0)
        ideal = aligned @ force * (1.0 + 1e-6 * seen(scale))
        ideal = ideal + (unit.constant + seen(bias) + noise) * MICRO_G
        readings = [
            np.round((np.interp(read, t, celsius[:, bag]) + sd) / READING_STEP) * READING_STEP
            for celsius in (board, case)
            for sd in [READING_SD * draw.standard_normal(len(read))]
        ]
        # The stamp of a sample is the end of its sample interval.
        stamps, read_ns = (np.rint(1e9 * (time + 0.5 * SAMPLE_S)).astype(np.int64)
                           for time in (middle, read))  # fmt: skip
        result.append(
            SimpleNamespace(
                name=f'p{bag:02d}', accel_stamp_ns=stamps,
                counts=np.rint(unit.scale_factor * ideal),
                board_stamp_ns=read_ns, board=readings[0],
                case_stamp_ns=read_ns, case=readings[1],
                truth=SimpleNamespace(specific_force=force), noise=noise,
            )
        )  # fmt: skip
    return result


def plan_of(kind: str, seed: int, plan: str) -> tuple[list[Any], list[Any]]:
    """Simulate the runs of a test of a unit, and the held-out runs."""
    test, program, lasts_s, held, programs = PLANS[plan]
    unit, first = unit_of(kind, seed), seed_of(f'{kind}{seed}{test}') % 2**31
    records = runs_of(unit, program, directions(18, seed), first, lasts_s=lasts_s)
    up = np.random.default_rng(seed + 9999).standard_normal((3, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    first = seed_of(f'{kind}{seed}{held}') % 2**31
    tests = [
        runs_of(unit, program, up[[k]], first + k, soaked_s=21600.0, soaked_c=20.0)[0]
        for k, program in enumerate(programs)
    ]
    return records, tests


def floor_of(tests: Sequence[Any]) -> tuple[float, float]:
    """Return the RMS noise of means over 60 s: of |f|, and of the force vector [ug]."""
    means = [test.noise[: len(test.noise) // 60 * 60].reshape(-1, 60, 3).mean(1) for test in tests]
    norms = [
        mean @ test.truth.specific_force / STANDARD_GRAVITY
        for mean, test in zip(means, tests, strict=True)
    ]
    sizes = np.linalg.norm(np.concatenate(means), axis=1)
    both = (np.concatenate(norms), sizes)
    norm, vector = (float(np.sqrt(np.mean(values**2))) for values in both)
    return norm, vector


def main() -> int:
    """Print a row for each selected plan, kind and seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = {'type': lambda text: text.split(',')}
    parser.add_argument('--kinds', **names, default=KINDS, help='kinds (default: all)')
    parser.add_argument('--plans', **names, default=('wide', 'mild'), help='wide, mild, beyond')
    parser.add_argument('--seeds', type=int, default=1, help='units per kind')
    parser.add_argument('--model', default='response', help='response or golovach')
    options = parser.parse_args()
    print('| plan | kind | seed | floor: norm / vector | fit | error / claimed sd | fit s |')
    print('|---|---|---|---|---|---|---|')
    for plan in options.plans:
        for kind in options.kinds:
            for seed in range(1, options.seeds + 1):
                records, tests = plan_of(kind, seed, plan)
                least = floor_of(tests)
                ours = fit_and_correct(records, tests, full_scale=FULL_SCALE, model=options.model)
                result = errors(ours.specific_force, ours.sd, tests)
                print(
                    f'| {plan} | {kind} | {seed} | {least[0]:.2f} / {least[1]:.2f} '
                    f'| {result.norm:.2f} / {result.vector:.2f} | {result.claimed:.2f} '
                    f'| {ours.fit_s:.1f} |',
                    flush=True,
                )
    return 0


if __name__ == '__main__':
    sys.exit(main())
