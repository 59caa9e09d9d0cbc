# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Simulates the units and recordings of the benchmark `strangers.py` by numpy and scipy.

Case, board, the sensing part of each axis and a hidden node are the nodes of a linear thermal
network. The input of the network is the chamber's air temperature, which is linear in time within
each step, so the integration is exact. Bias and scale of an axis are functions of the temperature
of the axis's sensing part. This module shares no code with the package, so that an error of the
package is not an error of the simulated truth.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import lfilter

Floats = npt.NDArray[np.float64]

GRAVITY = 9.80665  # standard gravity [m/s^2]
UG = 1e-6 * GRAVITY  # a micro-g [m/s^2]
REFERENCE_C = 20.0  # temperature at which the curves of bias and scale are zero [degC]
STEP_S = 5.0  # step of the thermal network; the air temperature is linear within a step [s]
SOAK_S = 5400.0  # time that the unit spends in the chamber before a recording [s]
CASE, BOARD, PARTS, HIDDEN = 0, 1, slice(2, 5), 5


@dataclass(frozen=True)
class Environment:
    """
    Thermal conductances relative to those in a chamber with a fan: air to case (`film`), case to
    hidden node (`path`), air to board (`vent`).
    """

    film: float = 1.0
    path: float = 1.0
    vent: float = 1.0


CHAMBER = Environment()
STILL_AIR = Environment(film=0.3, path=0.25, vent=0.0)


def _zeros() -> Floats:
    return np.zeros(3)


@dataclass(frozen=True)
class Unit:
    """
    A simulated unit: constants, curves, thermal network, converter, thermometers.

    Parameters
    ----------
    bias, gain, misalignment : ndarray, shape (3,)
        Bias [ug] and relative error of the scale at `REFERENCE_C`; elements of M below its
        diagonal.
    bias_curve, scale_curve : ndarray, shape (order, 3)
        Coefficients of powers 1, 2, ... of the sensing part's temperature less `REFERENCE_C`
        [ug/K^n], [ppm/K^n].
    kink, kink_c : ndarray, shape (3,), float
        Change of the slope of the bias [ug/K] above a temperature [degC].
    bump, bump_c, bump_k : ndarray, shape (3,), float, float
        Height [ug] of a bell in the bias, its middle [degC] and its full width at half height [K].
    hidden_bias : ndarray, shape (3,)
        Bias per kelvin by which the hidden node is warmer than the board [ug/K].
    gradient_bias : ndarray, shape (3,)
        Bias per kelvin by which the case is warmer than the board [ug/K].
    case_s, board_s, part_s, hidden_s : float or ndarray, shape (3,)
        Time constants [s]; a part with a time constant of 0 s has the board's temperature.
    case_share : ndarray, shape (3,)
        Share of a part's thermal coupling that is to the case; the other share is to the board.
    vent_share : float
        Share of the board's thermal coupling that is to the air of a chamber with a fan; the other
        share is to the case.
    heat_k : float
        Temperature of the board above that of the case at rest, by self-heating [K].
    counts : float
        Counts per m/s^2; 0 for samples in m/s^2.
    carries : bool
        Whether the converter adds its rounding remainder to the next sample.
    density : float
        White noise [ug/sqrt(Hz)].
    flicker : float
        Floor of the Allan deviation due to flicker noise [ug].
    reading_sd, reading_step, reading_s : float
        Noise [K], rounding [K] and interval [s] of the thermometers.
    thermometer_s : float
        Time constant by which the thermometers lag case and board [s].
    sensors : tuple of str
        Thermometers that are recorded.

    """

    bias: Floats
    gain: Floats
    misalignment: Floats
    bias_curve: Floats
    scale_curve: Floats
    kink: Floats = field(default_factory=_zeros)
    kink_c: float = REFERENCE_C
    bump: Floats = field(default_factory=_zeros)
    bump_c: float = REFERENCE_C
    bump_k: float = 2.0
    hidden_bias: Floats = field(default_factory=_zeros)
    gradient_bias: Floats = field(default_factory=_zeros)
    case_s: float = 200.0
    board_s: float = 600.0
    part_s: Floats = field(default_factory=_zeros)
    case_share: Floats = field(default_factory=_zeros)
    hidden_s: float = 1500.0
    vent_share: float = 0.0
    heat_k: float = 1.0
    counts: float = 4e5
    carries: bool = True
    density: float = 5.0
    flicker: float = 0.0
    reading_sd: float = 0.005
    reading_step: float = 0.001
    reading_s: float = 5.0
    thermometer_s: float = 0.0
    sensors: tuple[str, ...] = ('board', 'case')

    def bias_at(self, part_c: Floats, hidden_k: Floats | float = 0.0) -> Floats:
        """
        Evaluate the bias [ug] at the parts' temperatures [degC], shape (n, 3); `hidden_k`:
        temperature of the hidden node less that of the board [K].
        """
        x = part_c - REFERENCE_C
        bias = self.bias + sum(c * x ** (k + 1) for k, c in enumerate(self.bias_curve))
        bias = bias + self.kink * np.maximum(part_c - self.kink_c, 0.0)
        bell = np.exp(-4.0 * np.log(2.0) * ((part_c - self.bump_c) / self.bump_k) ** 2)
        return np.asarray(bias + self.bump * bell + self.hidden_bias * hidden_k)

    def scale_at(self, part_c: Floats) -> Floats:
        """Evaluate the relative scale at the parts' temperatures [degC], shape (n, 3)."""
        x = part_c - REFERENCE_C
        curve = sum(c * x ** (k + 1) for k, c in enumerate(self.scale_curve))
        return np.asarray((1.0 + self.gain) * (1.0 + 1e-6 * curve))

    def sensed(self, force: Floats) -> Floats:
        """Project forces, shape (n, 3), on the sensitivity axes, by the inverse of M."""
        a, b, c = self.misalignment
        M = np.array([[1.0, 0.0, 0.0], [a, 1.0, 0.0], [b, c, 1.0]])
        return np.asarray(force @ np.linalg.inv(M).T)


@dataclass(frozen=True)
class Bag:
    """
    A recording in one attitude.

    Parameters
    ----------
    name : str
        Name of the bag in messages.
    time_s, samples : ndarray, shapes (n,), (n, 3)
        Times of the samples [s], and counts or m/s^2.
    temperatures : dict of str to (ndarray, ndarray)
        Times [s] and readings [degC] of each thermometer.
    force : ndarray, shape (3,) or (n, 3), or None
        The true specific force [m/s^2]; None if unknown.

    """

    name: str
    time_s: Floats
    samples: Floats
    temperatures: Mapping[str, tuple[Floats, Floats]]
    force: Floats | None = None


def rng_of(*words: object) -> np.random.Generator:
    """Return a random generator whose seed is a hash of words and numbers."""
    return np.random.default_rng([zlib.crc32(str(word).encode()) for word in words])


def signed(rng: np.random.Generator, low: float, high: float) -> Floats:
    """Draw three magnitudes within limits, each with a random sign."""
    return np.asarray(rng.uniform(low, high, 3) * rng.choice([-1.0, 1.0], 3))


def spread(n: int, rng: np.random.Generator) -> Floats:
    """Choose n unit vectors, each far from the vectors before it, in a random frame."""
    many = rng.standard_normal((2000, 3))
    many /= np.linalg.norm(many, axis=1)[:, None]
    chosen = [many[0], -many[0]][:n]
    while len(chosen) < n:
        chosen.append(many[np.argmin((many @ np.array(chosen).T).max(axis=1))])
    return np.array(chosen)


def navigation(rng: np.random.Generator, **given: Any) -> Unit:
    """Draw a unit of navigation grade whose parts lag the board with different time constants."""
    drawn = {
        'bias': 1500.0 * rng.standard_normal(3),
        'gain': 0.01 * rng.standard_normal(3),
        'misalignment': 1e-3 * rng.standard_normal(3),
        'bias_curve': np.array([signed(rng, 5, 20), 0.08 * rng.standard_normal(3)]),
        'scale_curve': np.array([rng.uniform(30, 90, 3), 0.2 * rng.standard_normal(3)]),
        'case_s': rng.uniform(120, 300),
        'board_s': rng.uniform(400, 900),
        'part_s': rng.uniform(500, 1500, 3),
        'heat_k': rng.uniform(0.5, 2.0),
    }
    return Unit(**{**drawn, **given})


def consumer_grade(rng: np.random.Generator) -> Unit:
    """Draw a MEMS unit with a single thermometer, on the die."""
    return Unit(
        bias=2e4 * rng.standard_normal(3),
        gain=0.01 * rng.standard_normal(3),
        misalignment=5e-3 * rng.standard_normal(3),
        bias_curve=np.array([signed(rng, 50, 400), 2.0 * rng.standard_normal(3)]),
        scale_curve=np.array([signed(rng, 30, 120)]),
        case_s=rng.uniform(100, 200),
        board_s=rng.uniform(100, 250),
        part_s=rng.uniform(20, 60, 3),
        heat_k=rng.uniform(1, 3),
        counts=2048.0 / GRAVITY,
        carries=False,
        density=150.0,
        reading_sd=0.1,
        reading_step=1.0 / 16.0,
        sensors=('board',),
    )


def network(unit: Unit, environment: Environment = CHAMBER) -> tuple[Floats, Floats, Floats]:
    """Return A, b, h of ``x' = A x + b air + h``; x: case, board, parts, hidden node [degC]."""
    A, b, h = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    # Relative conductances of the case: 0.1 to the board, `film` to the air (1 in a chamber).
    A[CASE, CASE] = -environment.film - 0.1
    A[CASE, BOARD] = 0.1
    b[CASE] = environment.film
    A[CASE] /= unit.case_s
    b[CASE] /= unit.case_s
    to_case, to_air = 1.0 - unit.vent_share, unit.vent_share * environment.vent
    A[BOARD, [CASE, BOARD]] = np.array([to_case, -to_case - to_air]) / unit.board_s
    b[BOARD] = to_air / unit.board_s
    h[BOARD] = unit.heat_k / unit.board_s
    for node, lag_s, share in zip(range(2, 5), unit.part_s, unit.case_share, strict=True):
        A[node, [BOARD, CASE, node]] = np.array([1.0 - share, share, -1.0]) / max(lag_s, 1.0)
    A[HIDDEN, BOARD] = 1.0 / unit.hidden_s
    A[HIDDEN, CASE] = environment.path / unit.hidden_s
    A[HIDDEN, HIDDEN] = -(1.0 + environment.path) / unit.hidden_s
    return A, b, h


def integrate(A: Floats, b: Floats, h: Floats, air: Floats, step_s: float, x: Floats) -> Floats:
    """Integrate the network from state `x`, exactly for an air temperature linear in a step."""
    n = len(b)
    # Extended state: temperatures of nodes and air, slope of the air temperature, 1 (for `h`).
    whole = np.zeros((n + 3, n + 3))
    whole[:n, :n], whole[:n, n], whole[:n, n + 2] = A, b, h
    whole[n, n + 1] = 1.0
    step = expm(whole * step_s)[:n]
    slope = np.diff(air) / step_s
    drive = np.outer(air[:-1], step[:, n]) + np.outer(slope, step[:, n + 1]) + step[:, n + 2]
    states = np.empty((len(air), n))
    states[0] = x
    turn = step[:, :n]
    for k, push in enumerate(drive):
        x = turn @ x + push
        states[k + 1] = x
    return states


def program(start_c: float, soak_min: float, *ramps: tuple[float, float, float]) -> Floats:
    """
    Return the corners of a chamber program, shape (n, 2) [s, degC]; `ramps`: target [degC], rate
    [K/min], soak [min].
    """
    corners = [(0.0, start_c), (60.0 * soak_min, start_c)]
    for target_c, rate, rest_min in ramps:
        at, before = corners[-1]
        corners.append((at + 60.0 * abs(target_c - before) / rate, target_c))
        if rest_min:
            corners.append((corners[-1][0] + 60.0 * rest_min, target_c))
    return np.array(corners)


def record(
    unit: Unit,
    corners: Floats,
    up: Floats,
    rng: np.random.Generator,
    *,
    name: str = 'bag',
    rate_hz: float = 0.5,
    environment: Environment = CHAMBER,
    shift: Floats | float = 0.0,
    tilt: Floats | None = None,
    is_cold: bool = False,
) -> Bag:
    """
    Record a program of the chamber in one attitude.

    Parameters
    ----------
    unit : Unit
        The unit.
    corners : ndarray, shape (n, 2)
        The chamber's program [s, degC].
    up : ndarray, shape (3,) or (n, 3)
        Direction of the specific force in the unit's frame, of the recording or of each sample.
    rng : Generator
        Random numbers of the chamber and of the noise.
    name : str
        Name of the bag.
    rate_hz : float
        Samples per second.
    environment : Environment
        Thermal conductances.
    shift : ndarray, shape (3,)
        Additional bias of this bag [ug].
    tilt : ndarray, shape (3,) or None
        Rotation of the support / (case temperature less `REFERENCE_C`)^2 [rad/K^2].
    is_cold : bool
        Whether the unit is switched on at the start of the recording, at the temperature of the
        air.

    Returns
    -------
    Bag
        The recording, with the true force.

    """
    lasts_s = float(corners[-1, 0])
    grid = np.arange(-SOAK_S, lasts_s + STEP_S, STEP_S)
    A, b, h = network(unit, environment)
    # The air temperature has a constant error and a ripple, and differs 5400 s before the
    # recording by up to 5 K from the program's first temperature.
    first_c = corners[0, 1]
    air = np.interp(grid, *corners.T) + 0.2 * rng.standard_normal()
    air += 0.03 * np.sin(2.0 * np.pi * grid / rng.uniform(200, 300) + rng.uniform(0, 2 * np.pi))
    away_k = rng.uniform(-5.0, 5.0)
    air += np.sign(away_k) * np.maximum(abs(away_k) - (grid + SOAK_S) / 30.0, 0.0)
    if is_cold:
        grid = np.arange(0.0, lasts_s + STEP_S, STEP_S)
        air, x = air[-len(grid) :], np.full(6, first_c)
    else:
        x = np.linalg.solve(A, -b * air[0] - h)
    states = integrate(A, b, h, air, STEP_S, x)
    n = int(lasts_s * rate_hz)
    stamps = (np.arange(n) + 1.0) / rate_hz
    # A sample is the mean over a sample interval; its stamp is the end of this interval.
    middle = stamps - 0.5 / rate_hz
    nodes = np.array([np.interp(middle, grid, node) for node in states.T]).T
    parts = np.where(unit.part_s > 0.0, nodes[:, PARTS], nodes[:, [BOARD]])
    force = GRAVITY * np.asarray(up)
    if tilt is not None:
        angle = np.outer((nodes[:, CASE] - REFERENCE_C) ** 2, tilt)
        force = force + np.cross(angle, force)
        force *= GRAVITY / np.linalg.norm(force, axis=1, keepdims=True)
    ideal = unit.sensed(np.atleast_2d(force)) * unit.scale_at(parts)
    bias = unit.bias_at(parts, (nodes[:, HIDDEN] - nodes[:, BOARD])[:, None])
    bias = bias + unit.gradient_bias * (nodes[:, CASE] - nodes[:, BOARD])[:, None]
    noise = unit.density * np.sqrt(rate_hz) * rng.standard_normal((n, 3))
    if unit.flicker:
        noise += flicker_noise(n, 1.0 / rate_hz, unit.flicker, rng)
    samples = ideal + UG * (bias + shift + noise)
    if unit.counts:
        samples = quantised(unit.counts * samples, unit.carries)
    read = np.arange(0.3, lasts_s, unit.reading_s)
    temperatures = {}
    for sensor in unit.sensors:
        node = lagged(states[:, CASE if sensor == 'case' else BOARD], unit.thermometer_s)
        value = np.interp(read, grid, node) + unit.reading_sd * rng.standard_normal(len(read))
        temperatures[sensor] = read, np.round(value / unit.reading_step) * unit.reading_step
    return Bag(name, stamps, samples, temperatures, force)


def positions(
    unit: Unit,
    corners: Floats | Sequence[Floats],
    up: Floats,
    rng: np.random.Generator,
    shifts: Floats | float = 0.0,
    **given: Any,
) -> tuple[Bag, ...]:
    """Record a bag in each attitude, shape (n, 3); bag k has program k of a tuple, cyclically."""
    shifts = np.broadcast_to(shifts, (len(up), 3))
    programs = corners if isinstance(corners, tuple) else (corners,)
    return tuple(
        record(unit, programs[k % len(programs)], up[k], rng, name=f'p{k + 1:02d}',
               shift=shifts[k], **given)
        for k in range(len(up))
    )  # fmt: skip


def turned(up: Floats, hold_s: float, n: int, rate_hz: float, rng: np.random.Generator) -> Floats:
    """
    Return the direction of the specific force of n samples, shape (n, 3): each attitude of `up`
    in turn for `hold_s`, of which the last 6 s are a turn by hand to the next attitude.
    """
    time_s = (np.arange(n) + 0.5) / rate_hz
    place = (time_s // hold_s).astype(int)
    share = np.clip((time_s - (place + 1) * hold_s) / 6.0 + 1.0, 0.0, 1.0)[:, None]
    share = share**2 * (3.0 - 2.0 * share)
    path = up[place % len(up)] * (1.0 - share) + up[(place + 1) % len(up)] * share
    path = path + 4e-3 * share * (1.0 - share) * rng.standard_normal((n, 3))
    return np.asarray(path / np.linalg.norm(path, axis=1)[:, None])


def rests_of(bag: Bag, hold_s: float) -> tuple[Bag, ...]:
    """Return each rest of a recording as a bag; the unit is turned every `hold_s` [s]."""
    result = []
    for begin_s in np.arange(0.0, bag.time_s.max(initial=0.0) - hold_s, hold_s):
        assert bag.force is not None
        rows = (bag.time_s > begin_s) & (bag.time_s < begin_s + hold_s - 8.0)
        temperatures = {
            name: (time_s[time_s > begin_s - 60.0] - begin_s, celsius[time_s > begin_s - 60.0])
            for name, (time_s, celsius) in bag.temperatures.items()
        }
        rest = bag.time_s[rows] - begin_s, bag.samples[rows], temperatures, bag.force[rows]
        result.append(Bag(f'{bag.name} at {begin_s:g} s', *rest))
    return tuple(result)


def flicker_noise(n: int, interval_s: float, floor: float, rng: np.random.Generator) -> Floats:
    """
    Draw noise, shape (n, 3), of the one-sided spectrum ``h / f`` down to a quarter of the lowest
    frequency of a recording. The noise's Allan deviation is ``floor = sqrt(2 ln(2) h)`` at all
    averaging times.
    """
    whole = 4 * n
    frequency = np.fft.rfftfreq(whole, interval_s)[1:, None]
    density = floor**2 / (2.0 * np.log(2.0)) / frequency
    parts = rng.standard_normal((2, len(frequency), 3))
    spectrum = np.sqrt(density * whole / interval_s) / 2.0 * (parts[0] + 1j * parts[1])
    return np.asarray(np.fft.irfft(np.vstack((np.zeros(3), spectrum)), axis=0)[:n])


def lagged(node: Floats, tau_s: float) -> Floats:
    """Return a node's temperature, which is linear between steps, after a first-order lag."""
    if not tau_s:
        return node
    decay = np.exp(-STEP_S / tau_s)
    # `behind`: node temperature less lagged temperature; in a long ramp, ramp rate times `tau_s`.
    gain = tau_s / STEP_S * (1.0 - decay)
    behind = lfilter([gain], [1.0, -decay], np.diff(node, prepend=node[0]))
    return np.asarray(node - behind)


def quantised(words: Floats, carries: bool) -> Floats:
    """Round to whole counts; with `carries` the rounding remainder is added to the next sample."""
    if not carries:
        return np.asarray(np.rint(words))
    return np.diff(np.rint(np.cumsum(words, axis=0)), axis=0, prepend=0.0)
