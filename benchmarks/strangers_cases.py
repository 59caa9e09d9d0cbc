# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Simulates the cases of the benchmark `strangers.py`: units, bags of the fit, held-out bags.

Each case draws a random unit, seeded by its number, and yields studies: bags for a fit, and
held-out bags.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from strangers_units import (
    CHAMBER,
    GRAVITY,
    REFERENCE_C,
    STILL_AIR,
    UG,
    Bag,
    Environment,
    Floats,
    Unit,
    consumer_grade,
    navigation,
    positions,
    program,
    record,
    rests_of,
    rng_of,
    signed,
    spread,
    turned,
)

#: Programs of the chamber: start [degC], soak [min], then target [degC], rate [K/min], soak [min].
LONG = program(
    20, 25, (35, 1, 60), (5, 2, 60), (25, 0.5, 40), (10, 1, 45), (33, 2, 60), (20, 0.5, 60)
)
HALF = program(20, 20, (35, 1, 45), (5, 1, 45), (20, 1, 5))
FAST = program(20, 2, (5, 1.9, 5), (35, 2.3, 5), (20, 2, 2))
WHOLE = program(20, 25, (35, 1, 60), (5, 1.5, 60), (20, 0.7, 20), (28, 1, 20))
POSE = program(20, 40, (35, 1, 90), (5, 1, 100), (28, 0.5, 60), (12, 1.5, 70), (20, 1, 75))
RETURNED = program(22, 20, (-12, 0.8, 40), (44, 0.8, 40), (22, 0.8, 20))
OTHER = program(12, 25, (31, 0.7, 45), (17, 1.5, 50), (26, 0.6, 40), (7, 1, 45))
HELD = (
    program(12, 20, (31, 0.7, 45), (17, 1.5, 40)),
    program(30, 20, (8, 1.2, 50), (24, 0.6, 40)),
)
FROST = program(5, 10, (12, 0.5, 60), (28, 0.8, 30))
ROOM = program(21, 20)
#: Program SHORT spans 7 to 33 degC, the programs USE of the held-out bags span 5 to 35 degC.
SHORT = program(20, 20, (33, 1, 50), (7, 1, 60), (20, 1, 12))
USE = (program(20, 20, (35, 0.7, 45), (15, 1.5, 40)), program(20, 20, (5, 1.2, 50), (24, 0.6, 40)))
#: Programs for MEMS units: of the fit, and of the held-out bags.
WARM = program(22, 15, (45, 1, 30), (12, 1, 40), (22, 1, 20))
WARM_HELD = (program(15, 15, (40, 0.8, 40)), program(40, 15, (18, 1.2, 40)))


@dataclass(frozen=True)
class Study:
    """
    Bags for a fit, and held-out bags.

    Parameters
    ----------
    label : str
        Name within the case; empty if the case has a single study.
    bags : tuple of Bag
        Bags of the fit.
    tests : dict of str to tuple of Bag
        Held-out bags by name.
    options : dict
        Options of the fit.
    gravity : float
        The fit's option `gravity` [m/s^2].
    prior_of : str
        Label of an earlier study whose calibration is the prior; empty without a prior.
    is_drift : bool
        Whether the mean error over a bag is subtracted from the errors of each axis, because a
        single pose does not determine the constants.
    baseline_bags : tuple of Bag
        Bags at rest for the curves by scipy; if empty, the bags of the fit are used.
    bound : Bound or None
        Cramer-Rao bound of the bias, for studies that evaluate the bias instead of the force.

    """

    label: str
    bags: tuple[Bag, ...]
    tests: Mapping[str, tuple[Bag, ...]]
    options: Mapping[str, Any] = field(default_factory=dict)
    gravity: float = GRAVITY
    prior_of: str = ''
    is_drift: bool = False
    baseline_bags: tuple[Bag, ...] = ()
    bound: Bound | None = None


@dataclass(frozen=True)
class Bound:
    """
    True bias at the reference temperature, and the smallest sd of the bias that an unbiased fit
    can have [m/s^2].
    """

    unit: Unit
    bias: Floats
    sd: Floats


FULL_SCALE = {'full_scale': 8388607.0}


def one_test(bags: tuple[Bag, ...]) -> dict[str, tuple[Bag, ...]]:
    """Return bags as the only set of held-out bags, without a name."""
    return {'': bags}


def plain(number: int) -> Iterator[Study]:
    """Record 18 positions over the program LONG with a case and a board thermometer."""
    rng = rng_of('plain', number)
    unit = navigation(rng)
    fit = positions(unit, LONG, spread(18, rng), rng)
    yield Study('', fit, one_test(positions(unit, HELD, spread(2, rng), rng)), FULL_SCALE)


def one_pose(number: int) -> Iterator[Study]:
    """Record a single pose for 9.1 h; the parts lag the board by 500 to 1500 s."""
    rng = rng_of('one-pose', number)
    unit = navigation(rng)
    up = spread(1, rng)
    fit = positions(unit, POSE, up, rng)
    tests = {'own bag': fit, 'other program': positions(unit, OTHER, up, rng)}
    yield Study('', fit, tests, FULL_SCALE, is_drift=True)


def returned(number: int) -> Iterator[Study]:
    """
    Record rests of a MEMS unit at four temperatures, in one or two poses that repeat to 0.2 mrad.
    """
    for label, poses in (('one pose', 1), ('two poses', 2)):
        rng = rng_of('returned', number)
        unit = consumer_grade(rng)
        ups = [spread(1, rng)[0] for _ in range(poses)]
        fit: tuple[Bag, ...] = ()
        for celsius in (-15.0, 22.0, 45.0, 5.0):
            for number_of_pose, up in enumerate(ups, 1):
                turned = up + np.cross(2e-4 * rng.standard_normal(3), up)
                # At 10 Hz the noise of a sample is about a count, so rounding averages out.
                fit += (record(unit, program(celsius, 30), turned / np.linalg.norm(turned), rng,
                               name=f'{celsius:g} degC, pose {number_of_pose}', rate_hz=10.0,
                               is_cold=True),)  # fmt: skip
        held = record(unit, RETURNED, ups[0], rng, rate_hz=10.0)
        yield Study(label, fit, one_test((held,)), is_drift=True)


def soaks(number: int) -> Iterator[Study]:
    """Record rests of 20 min on six faces at each of three temperatures, without ramps."""
    rng = rng_of('soaks', number)
    unit = navigation(rng)
    faces = np.concatenate((np.eye(3), -np.eye(3)))
    bags: tuple[Bag, ...] = ()
    for celsius in (20.0, 35.0, 5.0):
        # The faces are level to 2 degrees RMS: exact faces would not determine the misalignment.
        up = faces + 0.035 * rng.standard_normal((6, 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        bags += positions(unit, program(celsius, 20), up, rng)
    bags = tuple(replace(bag, name=f'rest{k + 1:02d}') for k, bag in enumerate(bags))
    yield Study('', bags, one_test(positions(unit, HELD, spread(2, rng), rng)), FULL_SCALE)


def turn_on(number: int) -> Iterator[Study]:
    """Record 9 to 18 positions; each bag has a random bias offset (sd 0, 30 or 300 ug)."""
    for n in (9, 10, 12, 18):
        for sd in (0, 30, 300):
            rng = rng_of('turn-on', n, sd, number)
            unit = navigation(rng)
            fit = positions(unit, HALF, spread(n, rng), rng, sd * rng.standard_normal((n, 3)))
            held = positions(unit, HELD, spread(4, rng), rng, sd * rng.standard_normal((4, 3)))
            yield Study(f'{n} at {sd} ug', fit, one_test(held), FULL_SCALE)


def mems(number: int) -> Iterator[Study]:
    """Record a MEMS unit with random bias offsets at turn-on (sd 0.1, 0.3 or 1 mg)."""
    for n in (9, 12, 18):
        for sd in (100, 300, 1000):
            rng = rng_of('mems', n, sd, number)
            unit = consumer_grade(rng)
            fit, held = (
                positions(
                    unit,
                    corners,
                    spread(k, rng),
                    rng,
                    sd * rng.standard_normal((k, 3)),
                    rate_hz=10.0,
                )
                for corners, k in ((WARM, n), (WARM_HELD, 4))
            )
            yield Study(f'{n} at {sd / 1000:g} mg', fit, one_test(held), {'full_scale': 32767.0})


def sessions(number: int) -> Iterator[Study]:
    """
    Turn a MEMS unit by hand every 8 min in two recordings, each with a random bias offset of
    0.3 mg. Fit the first recording, both recordings, and the second with the first fit as prior.
    """
    rng, hold_s, rate_hz = rng_of('sessions', number), 480.0, 10.0
    unit, up = consumer_grade(rng), spread(12, rng)
    n = int(WARM[-1, 0] * rate_hz)
    bags = tuple(
        record(unit, WARM, turned(rng.permutation(up), hold_s, n, rate_hz, rng), rng, name=name,
               rate_hz=rate_hz, shift=300.0 * rng.standard_normal(3))
        for name in ('one', 'two')
    )  # fmt: skip
    shifts = 300.0 * rng.standard_normal((4, 3))
    held = one_test(positions(unit, WARM_HELD, spread(4, rng), rng, shifts, rate_hz=rate_hz))
    first, second = (rests_of(bag, hold_s) for bag in bags)
    options = {'full_scale': 32767.0}
    yield Study('one', bags[:1], held, options, baseline_bags=first)
    yield Study('two', bags, held, options, baseline_bags=first + second)
    yield Study('update', bags[1:], held, options, prior_of='one')


def ageing(number: int) -> Iterator[Study]:
    """Add a random walk of the bias (12 ug per bag) and random turn-on offsets (15 ug)."""
    rng = rng_of('ageing', number)
    unit = navigation(rng)
    shifts = 15.0 * rng.standard_normal((16, 3))
    shifts += np.cumsum(12.0 * rng.standard_normal((16, 3)), axis=0)
    fit = positions(unit, HALF, spread(12, rng), rng, shifts[:12])
    held = positions(unit, HELD, spread(4, rng), rng, shifts[12:])
    yield Study('', fit, one_test(held), FULL_SCALE)


def kink(number: int) -> Iterator[Study]:
    """Change the slope of the bias by 8 to 20 ug/K at a random temperature of 12 to 30 degC."""
    rng = rng_of('kink', number)
    unit = navigation(rng, kink=signed(rng, 8, 20), kink_c=rng.uniform(12, 30))
    fit = positions(unit, HALF, spread(12, rng), rng)
    yield Study('', fit, one_test(positions(unit, HELD, spread(3, rng), rng)), FULL_SCALE)


def gradient(number: int) -> Iterator[Study]:
    """Add a bias proportional to case less board temperature; record fast ramps of 40 min."""
    rng = rng_of('gradient', number)
    unit = navigation(
        rng,
        gradient_bias=signed(rng, 8, 25),
        part_s=rng.uniform(50, 200, 3),
        case_s=rng.uniform(20, 50),
        board_s=rng.uniform(70, 150),
    )
    fit = positions(unit, FAST, spread(9, rng), rng)
    yield Study('', fit, one_test(positions(unit, HELD, spread(3, rng), rng)), FULL_SCALE)


def bump(number: int) -> Iterator[Study]:
    """Add a bell curve over temperature, 300 to 600 ug high and 2 K wide, to the bias."""
    rng = rng_of('bump', number)
    unit = navigation(rng, bump=signed(rng, 300, 600), bump_c=rng.uniform(12, 28))
    fit = positions(unit, HALF, spread(12, rng), rng)
    yield Study('', fit, one_test(positions(unit, HELD, spread(3, rng), rng)), FULL_SCALE)


def carry(number: int) -> Iterator[Study]:
    """Change the bias by 50 to 150 ug after half of the fit's bags, as a shock may do."""
    rng = rng_of('carry', number)
    unit = navigation(rng)
    step = signed(rng, 50, 150)
    fit = positions(unit, HALF, spread(12, rng), rng, np.repeat([0 * step, step], 6, axis=0))
    held = positions(unit, HELD, spread(3, rng), rng, step)
    yield Study('', fit, one_test(held), FULL_SCALE)


def support(number: int) -> Iterator[Study]:
    """Tilt the support by 1 urad/K^2 times (T_case - T_ref)^2, but not in held-out bags."""
    rng = rng_of('support', number)
    unit = navigation(rng)
    up = spread(12, rng)
    # The axis of the tilt is level; its direction in the unit is random in each position.
    level = np.cross(up, rng.standard_normal((12, 3)))
    level *= 1.0e-6 / np.linalg.norm(level, axis=1)[:, None]
    fit = tuple(
        record(unit, HALF, attitude, rng, name=f'p{k + 1:02d}', tilt=axis)
        for k, (attitude, axis) in enumerate(zip(up, level, strict=True))
    )
    yield Study('', fit, one_test(positions(unit, HELD, spread(3, rng), rng)), FULL_SCALE)


def gravity(number: int) -> Iterator[Study]:
    """Give the fit a gravity that is 50 ug too large, and 50 ug as the sd of gravity."""
    rng = rng_of('gravity', number)
    unit = navigation(rng)
    fit = positions(unit, HALF, spread(12, rng), rng)
    held = positions(unit, HELD, spread(3, rng), rng)
    wrong = 50.0 * UG
    options = {**FULL_SCALE, 'gravity_sd': wrong}
    yield Study('', fit, one_test(held), options, gravity=GRAVITY + wrong)


def cold_start(number: int) -> Iterator[Study]:
    """Hold out bags with a cold switch-on; in the bags of the fit the unit is already warm."""
    rng = rng_of('cold-start', number)
    unit = navigation(rng)
    fit = positions(unit, HALF, spread(12, rng), rng)
    held = positions(unit, FROST, spread(3, rng), rng, is_cold=True)
    yield Study('', fit, one_test(held), FULL_SCALE)


def slow_thermometer(number: int) -> Iterator[Study]:
    """Record with a board thermometer that lags by 30 to 90 s, and no case thermometer."""
    rng = rng_of('slow-thermometer', number)
    unit = navigation(rng, thermometer_s=rng.uniform(30, 90), sensors=('board',))
    fit = positions(unit, FROST, spread(12, rng), rng)
    yield Study('', fit, one_test(positions(unit, HELD, spread(3, rng), rng)), FULL_SCALE)


def coarse_thermometer(number: int) -> Iterator[Study]:
    """Record a MEMS unit whose thermometer has steps of 0.1 to 1 K or a noise of 1 K."""
    for label, step_k, interval_s, sd_k in (
        ('1 K each second', 1.0, 1.0, 0.02),
        ('0.5 K each minute', 0.5, 60.0, 0.02),
        ('0.1 K each minute', 0.1, 60.0, 0.02),
        ('noise of 1 K', 0.01, 1.0, 1.0),
    ):
        rng = rng_of('coarse-thermometer', label, number)
        given = {'reading_sd': sd_k, 'reading_step': step_k, 'reading_s': interval_s}
        unit = replace(consumer_grade(rng), **given)
        fit, held = (
            positions(unit, corners, spread(n, rng), rng, rate_hz=10.0)
            for corners, n in ((WARM, 12), (WARM_HELD, 4))
        )
        yield Study(label, fit, one_test(held), {'full_scale': 32767.0})


def slow_drift(number: int) -> Iterator[Study]:
    """Add a random walk of the bias, slow tilts of the support, or a decaying bias (sd 1 mg)."""
    for kind, grade, full_scale, rate_hz, ways in (
        ('bias', navigation, 8388607.0, 0.5, (HALF, HELD)),
        ('support', navigation, 8388607.0, 0.5, (HALF, HELD)),
        ('power-on', consumer_grade, 32767.0, 10.0, (WARM, WARM_HELD)),
    ):
        rng = rng_of('slow-drift', kind, number)
        unit = grade(rng)
        parts = []
        for way, n in zip(ways, (12, 3), strict=True):
            bags = positions(unit, way, spread(n, rng), rng, rate_hz=rate_hz)
            parts.append(tuple(_drifting(bag, unit, kind, rng) for bag in bags))
        yield Study(kind, parts[0], one_test(parts[1]), {'full_scale': full_scale})


def _drifting(bag: Bag, unit: Unit, kind: str, rng: np.random.Generator) -> Bag:
    """Add a drift by `kind`: bias walk ('bias'), tilt ('support'), decaying bias ('power-on')."""
    force = np.ones((len(bag.samples), 1)) * bag.force
    if kind == 'power-on':
        decay = 1e3 * UG * rng_of('decay', unit.bias.tolist()).standard_normal(3)
        change = np.exp(-bag.time_s[:, None] / 600.0) * decay
        return replace(bag, samples=np.rint(bag.samples + unit.counts * change))
    step = 20.0 * UG * np.sqrt(2.0 / 3600.0)  # sd of the walk in 2 s, the sample interval
    change = np.cumsum(step * rng.standard_normal(force.shape), axis=0)
    if kind == 'support':
        phase = 2.0 * np.pi * (bag.time_s[:, None] / 14400.0 + rng.uniform())
        change = np.cross(6e-5 * np.sin(phase) * rng.standard_normal(3), force)
        force = force + change
    return replace(bag, samples=np.rint(bag.samples + unit.counts * change), force=force)


def flicker(number: int) -> Iterator[Study]:
    """Add flicker noise (bias instability): 3 ug in a navigation unit, 60 ug in a MEMS unit."""
    for label, floor, grade, full_scale, rate_hz in (
        ('navigation', 3.0, navigation, 8388607.0, 0.5),
        ('MEMS', 60.0, consumer_grade, 32767.0, 10.0),
    ):
        rng = rng_of('flicker', label, number)
        unit = replace(grade(rng), flicker=floor)
        fit = positions(unit, HALF, spread(12, rng), rng, rate_hz=rate_hz)
        held = positions(unit, HELD, spread(3, rng), rng, rate_hz=rate_hz)
        yield Study(label, fit, one_test(held), {'full_scale': full_scale})


def third_node(number: int) -> Iterator[Study]:
    """Let the bias depend on a thermal node without thermometer, in a chamber and in still air."""
    rng = rng_of('third-node', number)
    unit = navigation(rng, hidden_bias=signed(rng, 20, 60), hidden_s=rng.uniform(900, 2500))
    fit = positions(unit, HALF, spread(12, rng), rng)
    up = spread(3, rng)

    def bags_in(environment: Environment, attitudes: Floats, corners: Any) -> tuple[Bag, ...]:
        return positions(unit, corners, attitudes, rng, environment=environment)

    still = tuple(replace(bag, name='still') for bag in bags_in(STILL_AIR, up[:1], WHOLE))
    tests = {
        'chamber': bags_in(CHAMBER, up[1:], HELD),
        'still air': bags_in(STILL_AIR, up[1:], HELD),
        'its attitude': bags_in(STILL_AIR, up[:1], HELD[0]),
    }
    yield Study('alone', fit, tests, FULL_SCALE)
    yield Study('joint', (*fit, *still), tests, FULL_SCALE)
    yield Study('prior', still, tests, FULL_SCALE, prior_of='alone')


def bench3(number: int) -> Iterator[Study]:
    """Record 18 positions at room temperature, and 3 in a chamber over 7 to 33 degC."""
    rng = rng_of('bench3', number)
    unit = navigation(rng)
    bench = positions(unit, ROOM, spread(18, rng), rng)
    chamber = positions(unit, SHORT, spread(3, rng), rng)
    bags = (*bench, *(replace(bag, name=f'c{k + 1}') for k, bag in enumerate(chamber)))
    yield Study('', bags, one_test(positions(unit, USE, spread(2, rng), rng)), FULL_SCALE)


def quadratic(number: int) -> Iterator[Study]:
    """Record units with bias and scale quadratic in board temperature; evaluate the bias."""
    for n in (18, 24):
        rng = rng_of('quadratic', n, number)
        unit = navigation(rng, part_s=np.zeros(3))
        up = spread(n, rng)
        bags = positions(unit, HALF, up, rng)
        bound = Bound(unit, UG * unit.bias, bias_bound(unit, up, bags))
        yield Study(str(n), bags, {}, FULL_SCALE, bound=bound)


def bias_bound(unit: Unit, up: Floats, bags: Sequence[Bag], window_s: float = 60.0) -> Floats:
    """
    Return the Cramer-Rao bound of the bias at the reference temperature, shape (3,), for a unit
    whose bias and scale factor are parabolas. The unknowns are the constants, the parabolas of
    bias and scale, and the direction of each position; the data are means of the three axes over
    windows of `window_s`, in which the temperature is taken as constant.
    """
    n = len(up)
    tangents = np.array([np.linalg.svd(attitude[None])[2][1:] for attitude in up])
    temperatures = []
    for bag in bags:
        time_s, board = bag.temperatures['board']
        rows = (time_s // window_s).astype(int)
        temperatures.append(np.bincount(rows, board) / np.bincount(rows) - REFERENCE_C)
    x = np.concatenate(temperatures)[:, None]
    position = np.repeat(np.arange(n), [len(celsius) for celsius in temperatures])
    p = np.concatenate((
        1e-6 * unit.bias, unit.gain, unit.misalignment, 1e-6 * unit.bias_curve.ravel(),
        1e-6 * unit.scale_curve.ravel(), np.zeros(2 * n),
    ))  # fmt: skip

    def modelled(p: Any) -> Any:
        """Return samples [g] for complex parameters `p`, for derivatives by imaginary steps."""
        a, b, c = p[6:9]
        u = up + np.einsum('pk,pki->pi', p[21:].reshape(n, 2), tangents)
        u = u / np.sqrt((u**2).sum(axis=1, keepdims=True))
        y = u[:, 1] - a * u[:, 0]
        z = u[:, 2] - b * u[:, 0] - c * y
        sensed = np.stack((u[:, 0], y, z), axis=1)[position]
        scale = (1.0 + p[3:6]) * (1.0 + p[15:18] * x + p[18:21] * x**2)
        return sensed * scale + p[:3] + p[9:12] * x + p[12:15] * x**2

    columns = []
    for k in range(len(p)):
        step = p.astype(complex)
        step[k] += 1e-30j
        columns.append(modelled(step).imag.ravel() / 1e-30)
    noise = 1e-6 * unit.density / np.sqrt(window_s)
    J = np.array(columns).T / noise
    size = np.linalg.norm(J, axis=0)
    J /= size
    sd = np.sqrt(np.diag(np.linalg.inv(J.T @ J))) / size
    return np.asarray(GRAVITY * sd[:3])


#: For each case: the function that yields the studies of a unit, and the default number of units.
CASES: dict[str, tuple[Callable[[int], Iterator[Study]], int]] = {
    'plain': (plain, 3),
    'one-pose': (one_pose, 3),
    'returned': (returned, 4),
    'soaks': (soaks, 6),
    'turn-on': (turn_on, 8),
    'mems': (mems, 8),
    'sessions': (sessions, 6),
    'ageing': (ageing, 3),
    'kink': (kink, 3),
    'gradient': (gradient, 3),
    'bump': (bump, 3),
    'carry': (carry, 3),
    'support': (support, 3),
    'gravity': (gravity, 3),
    'cold-start': (cold_start, 3),
    'slow-thermometer': (slow_thermometer, 3),
    'coarse-thermometer': (coarse_thermometer, 3),
    'slow-drift': (slow_drift, 4),
    'flicker': (flicker, 3),
    'third-node': (third_node, 3),
    'bench3': (bench3, 3),
    'quadratic': (quadratic, 100),
}
