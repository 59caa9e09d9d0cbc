# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Simulates the ageing units of the benchmark `field.py`: physics, rests, reference filter.

A unit leaves the laboratory with a calibration whose error is drawn from the covariance that the
calibration states. In the field bias and scale follow random walks, each turn-on has a random bias
offset, and a shock changes the biases once. The forward model and the Kalman filter are written
here in numpy and share no code with `thermo_comp update`; the filter is given the true variances
and the time of the shock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from thermo_comp.field.rest import Rest, Start
from thermo_comp.thermal.lags import MemorySpec
from thermo_comp.unit.calibration import (
    Axes,
    AxisReference,
    AxisSet,
    Calibration,
    RegimeSet,
    Unit,
    parameter_layout,
)
from thermo_comp.unit.functions import Polynomial
from thermo_comp.unit.posterior import posterior_of
from thermo_comp.unit.provenance import Provenance

Floats = npt.NDArray[np.float64]

G = 9.80665
UG = 1e-6 * G
K = 300.0  # counts per m/s^2
REFERENCE_C = 20.0
CREATED = '2026-01-01T00:00:00Z'
DAY_ZERO = 20454  # 2026-01-01 in days since 1970
#: Slopes over temperature, of the bias [m/s^2 per K] and the scale [1/K], in the calibration.
SLOPE, SCALE_SLOPE = 30 * UG, 1e-5
#: Sd of the calibration's error: bias and its slope per K [m/s^2], relative scale and its slope
#: per K, misalignment [rad].
PRIOR = np.repeat([10 * UG, 0.3 * UG, 10e-6, 0.3e-6, 5e-6], 3)
#: Length of a window [s], and density of the samples' white noise [m/s^2/sqrt(Hz)].
WINDOW_S, NOISE = 10.0, 60 * UG
KINDS = ('level', 'carried', 'fixed', 'up and down', 'faces')


@dataclass(frozen=True)
class Process:
    """Sd of the random walks of bias and scale per root day, of turn-on offsets, of the shock."""

    bias: float = 15 * UG
    scale: float = 10e-6
    turn_on: float = 20 * UG
    shock: float = 300 * UG
    shock_day: float = np.inf


@dataclass
class History:
    """Rests of a unit; `states`: deviations of the unit from its calibration after each day."""

    rests: list[tuple[Start, Rest]] = field(default_factory=list)
    #: For each window of `rests`: number of its day, and number of its turn-on.
    day: list[int] = field(default_factory=list)
    start: list[int] = field(default_factory=list)
    states: list[Floats] = field(default_factory=list)


def calibration() -> Calibration:
    """Build a calibration whose parameters have the sd `PRIOR`, as from a laboratory."""
    axis = AxisSet(
        Polynomial((0.0, K * SLOPE)), Polynomial((1.0, SCALE_SLOPE)), residual_sd_m_s2=20 * UG
    )
    part = RegimeSet((-10.0, 50.0), (-1.0, 1.0), axis, axis, axis)
    blank = Calibration(
        format_version=2,
        unit=Unit('FIELD-1', 'counts', 32767.0, 0.01),
        reference_temperature_c=REFERENCE_C,
        gravity_m_s2=G,
        axes=Axes(*[AxisReference(K, 0.0)] * 3),
        static=part,
        dynamic=part,
        noise_density_m_s2_sqrt_hz=(NOISE,) * 3,
        provenance=Provenance(created=CREATED),
    )
    layout = parameter_layout(blank)
    to_file = np.zeros((layout.n_parameters, 15))
    for axis_number, (bias, scale) in enumerate(zip(layout.bias, layout.scale, strict=True)):
        for place, number, size in (
            (bias, 0, K), (scale, 2, 1.0),
        ):  # fmt: skip
            to_file[[place.static, place.dynamic], 3 * number + axis_number] = size
            to_file[[place.static + 1, place.dynamic + 1], 3 * number + 3 + axis_number] = size
        to_file[layout.misalignment + axis_number, 12 + axis_number] = 1.0
    return replace(blank, posterior=posterior_of((to_file * PRIOR**2) @ to_file.T))


def _parts(state: Floats, warmth: Floats) -> tuple[Floats, Floats, Floats]:
    """Return bias [m/s^2], relative scale and M for deviations `state`, shape (15,) or (24,)."""
    bias, slope, scale, scale_slope, tilt = state[:15].reshape(5, 3)
    if len(state) > 15:
        walk_bias, walk_scale, turn_on = state[15:].reshape(3, 3)
        bias, scale = bias + walk_bias + turn_on, scale + walk_scale
    warm = np.atleast_1d(warmth)[:, None]
    M = np.eye(3)
    M[[1, 2, 2], [0, 0, 1]] = tilt
    return (
        bias + (SLOPE + slope) * warm,
        (1.0 + scale) * (1.0 + (SCALE_SLOPE + scale_slope) * warm),
        M,
    )


def measured(force: Floats, warmth: Floats, state: Floats) -> Floats:
    """Return the samples / `K` [m/s^2] of a unit with deviations `state` under forces (n, 3)."""
    bias, scale, M = _parts(state, warmth)
    return np.asarray(np.linalg.solve(M, force.T).T * scale + bias)


def corrected(counts: Floats, warmth: Floats, state: Floats) -> Floats:
    """Correct samples / `K` [m/s^2] of a unit with deviations `state`; return forces [m/s^2]."""
    bias, scale, M = _parts(state, warmth)
    return np.asarray((counts - bias) / scale @ M.T)


def attitude(kind: str, rng: np.random.Generator) -> Floats:
    """Draw a direction of f in a kind of `KINDS`; 'level': within 10 deg of the z axis."""
    if kind == 'carried':
        u = rng.standard_normal(3)
        return np.asarray(u / np.linalg.norm(u))
    faces = np.vstack((np.eye(3), -np.eye(3)))
    if n_faces := {'fixed': 1, 'up and down': 2, 'faces': 6}.get(kind):
        return np.asarray(faces[[2, 5, 0, 1, 3, 4][rng.integers(n_faces)]])
    tilt, azimuth = np.radians(rng.uniform(0.0, 10.0)), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])


def temperature(day: float, rng: np.random.Generator) -> float:
    """Draw the board's temperature on a day [degC]: a sine of 60 days plus noise of 2 K (1 sd)."""
    return float(REFERENCE_C + 10.0 * np.sin(2.0 * np.pi * day / 60.0) + rng.normal(0.0, 2.0))


def lasting(kind: str, seconds: float, rng: np.random.Generator) -> Iterator[float]:
    """
    Yield the durations [s] of the attitudes in a rest of `seconds`: one attitude in the kinds
    'level' and 'fixed'; in the other kinds each attitude lasts 20 to 90 s.
    """
    while seconds >= WINDOW_S:
        rest = seconds if kind in ('level', 'fixed') else min(seconds, rng.uniform(20.0, 90.0))
        yield rest
        seconds -= rest


def live(kind: str, seed: int, days: int, process: Process) -> History:
    """Simulate the ageing of a unit: three turn-ons a day, a rest of 2 to 10 min in each."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    state = np.concatenate((PRIOR * rng.standard_normal(15), np.zeros(9)))
    history, before, is_shocked, n_starts = History(), 0.0, False, 0
    for day in range(days):
        for number in range(3):
            now = day + (8.0 + 5.0 * number + rng.uniform(0.0, 2.0)) / 24.0
            root = np.sqrt(now - before)
            before = now
            state = state.copy()
            state[15:18] += process.bias * root * rng.standard_normal(3)
            state[18:21] += process.scale * root * rng.standard_normal(3)
            if now >= process.shock_day and not is_shocked:
                is_shocked = True
                state[15:18] += process.shock * rng.standard_normal(3)
            state[21:] = process.turn_on * rng.standard_normal(3)
            stamp = int((DAY_ZERO + now) * 86400e9)
            start = Start(stamp, 'FIELD-1', 'counts', G, 'laboratory', MemorySpec())
            for seconds in lasting(kind, rng.uniform(120.0, 600.0), rng):
                force, celsius = G * attitude(kind, rng), temperature(day, rng)
                clean = measured(force[None], np.array([celsius - REFERENCE_C]), state)[0]
                for _ in range(int(seconds // WINDOW_S)):
                    noise = NOISE / np.sqrt(WINDOW_S) * rng.standard_normal(3)
                    mean = tuple((K * (clean + noise)).tolist())
                    thermal = (celsius, 1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6)
                    rest = Rest(stamp, 1000, mean, (K * NOISE * 10.0,) * 3, thermal)
                    history.rests.append((start, rest))
                    history.day.append(day)
                    history.start.append(n_starts)
                    stamp += int(WINDOW_S * 1e9)
            n_starts += 1
        history.states.append(np.concatenate((state[:21], np.zeros(3))))
    return history


class BestFilter:
    """A Kalman filter that is given the variances of the ageing and the time of the shock."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.state = np.zeros(24)
        self.P = np.diag(np.concatenate((PRIOR**2, np.zeros(9))))
        self._now, self._is_shocked, self._start = 0.0, False, -1

    def take(self, now: float, start: int, counts: Floats, warmth: float, variance: float) -> None:
        """
        Update the filter with a rest.

        now: time [days]; start: number of the turn-on; counts: mean sample of the rest in counts,
        divided by `K` [m/s^2]; variance: variance of the norm of `counts` [m^2/s^4]; warmth: board
        temperature less the reference temperature [K]
        """
        process = self.process
        if start != self._start:
            elapsed, self._now, self._start = now - self._now, now, start
            walk = np.repeat([process.bias**2, process.scale**2], 3) * elapsed
            self.P[range(15, 21), range(15, 21)] += walk
            if now >= process.shock_day and not self._is_shocked:
                self._is_shocked = True
                self.P[range(15, 18), range(15, 18)] += process.shock**2
            self.state[21:], self.P[21:], self.P[:, 21:] = 0.0, 0.0, 0.0
            self.P[range(21, 24), range(21, 24)] = process.turn_on**2
        warm = np.array([warmth])

        def norm(state: Floats) -> float:
            return float(np.linalg.norm(corrected(counts[None], warm, state)))

        step = 1e-6
        here = norm(self.state)
        H = np.array([(norm(self.state + step * e) - here) / step for e in np.eye(24)])
        S = H @ self.P @ H + variance
        gain = self.P @ H / S
        self.state = self.state + gain * (G - here)
        self.P = self.P - np.outer(gain, gain) * S
