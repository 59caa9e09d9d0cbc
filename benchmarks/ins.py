# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Computes position errors of an inertial navigator by accelerometer drift, raw and compensated.

The unit of the held-out bag stands still in the chamber, so any computed motion is an error. The
navigator levels for five minutes, then navigates without aiding for half an hour; or it gets a
zero-velocity update (ZUPT) every minute for 25 minutes, and no aiding in the next five minutes. In
each minute of the bag both flights begin, with raw samples, with samples corrected by a cubic for
both regimes ('one set'), and with samples compensated as in the node.

The simulated gyroscopes are ideal and the Earth does not rotate, so that the accelerometer causes
all errors; the height is kept constant, as with a barometer. The filter estimates for each of the
two level axes the errors of position p, velocity v, tilt a and accelerometer b, [1]_ chapter 12::

    p' = v      v' = b - g a      a' = v / R      b' = -b / tau + noise

Run ``python benchmarks/ins.py --figure docs/images/ins.png``.

References
----------
.. [1] D. Titterton, J. Weston, "Strapdown Inertial Navigation Technology", 2nd edition, 2004.

"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np

import thermo_comp as tc
from thermo_comp.recording.reader import inspect_recording
from thermo_comp.typing import Floats
from thermo_comp.unit.correction import Correction

BAGS = Path(__file__).resolve().parent.parent / 'bags'
#: Mean radius of the Earth [m]: IUGG, R_1.
EARTH_RADIUS = 6.371009e6
ALIGN_S, FREE_S, COAST_S, STANDING_S = 300.0, 1800.0, 300.0, 1500.0
#: Interval of zero-velocity updates [s], sd of an update [m/s], interval of flight starts [s].
ZUPT_S, ZUPT_SD, EVERY_S = 60.0, 1e-3, 60.0
#: Correlation time of the accelerometer's error in the filter [s]: a few board time constants.
BIAS_S = 1800.0
COLOURS = {'raw': '#b2182b', 'one set': '#e08214', 'compensated': '#2166ac'}


def turned(angles: Floats) -> Floats:
    """Return rotation matrices, shape (..., 3, 3), for small angles, shape (..., 3) [rad]."""
    x, y, z = np.moveaxis(angles, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    return np.eye(3) + cross + 0.5 * cross @ cross


def levelled(force: Floats) -> Floats:
    """Return the attitude, body to east-north-up, that makes a mean force (..., 3) vertical."""
    up = force / np.linalg.norm(force, axis=-1, keepdims=True)
    east = np.array([1.0, 0.0, 0.0]) - up[..., :1] * up
    east /= np.linalg.norm(east, axis=-1, keepdims=True)
    return np.stack([east, np.cross(up, east), up], axis=-2)


@dataclass
class Navigator:
    """Attitude, velocity and position of a strapdown navigator, or of many navigators at once."""

    attitude: Floats
    gravity: float
    velocity: Floats = field(init=False)
    position: Floats = field(init=False)
    bias: Floats = field(init=False)

    def __post_init__(self) -> None:
        zeros = np.zeros(self.attitude.shape[:-1])
        self.velocity, self.position, self.bias = zeros, zeros.copy(), zeros.copy()

    def step(self, dt: float, force: Floats, rate: Floats | float = 0.0) -> None:
        """Integrate specific force [m/s^2] and angular rate [rad/s] over a step of `dt` [s]."""
        v = self.velocity
        transport = np.stack([-v[..., 1], v[..., 0], 0.0 * v[..., 0]], -1) / EARTH_RADIUS
        self.attitude = turned(-transport * dt) @ self.attitude @ turned(rate * dt + 0.0 * v)
        acceleration = (self.attitude @ force[..., None])[..., 0] - self.bias
        acceleration[..., 2] -= self.gravity
        self.velocity = v + acceleration * dt
        self.velocity[..., 2] = 0.0
        self.position = self.position + self.velocity * dt

    def correct(self, gain: Floats, innovation: Floats) -> None:
        """Correct position, velocity, attitude and bias by `gain` times the ZUPT's innovation."""
        level = innovation[..., :2, None] * gain
        up = np.zeros((*level.shape[:-2], 1))
        position, velocity, tilt, bias = (
            np.concatenate([level[..., k], up], axis=-1) for k in range(4)
        )
        self.position = self.position - position
        self.velocity = self.velocity - velocity
        self.bias = self.bias + bias
        about = np.stack([-tilt[..., 1], tilt[..., 0], up[..., 0]], -1)
        self.attitude = turned(about) @ self.attitude


@dataclass(frozen=True)
class Model:
    """Samples (n, 3) [m/s^2]; for the filter: noise density [m/s^2/sqrt(Hz)], bias sd [m/s^2]."""

    force: Floats
    noise_density: float
    bias_sd: float


@dataclass(frozen=True)
class Flights:
    """Errors of all flights, shape (steps, flights); `sigma`: the filter's position sd."""

    time_s: Floats
    position: Floats
    velocity: Floats
    tilt: Floats
    sigma: Floats


def fly(model: Model, dt: float, up: Floats, gravity: float, zupts_s: float) -> Flights:
    """Compute flights: levelling, zero-velocity updates for `zupts_s`, then no aiding."""
    n_align = round(ALIGN_S / dt)
    n = round((zupts_s + (COAST_S if zupts_s else FREE_S)) / dt)
    starts = np.arange(0, len(model.force) - n_align - n, round(EVERY_S / dt))
    means = np.stack([model.force[s : s + n_align].mean(axis=0) for s in starts])
    navigator = Navigator(levelled(means), gravity)
    A = np.zeros((4, 4))
    A[0, 1], A[1, 2], A[1, 3], A[2, 1], A[3, 3] = (
        1.0, -gravity, 1.0, 1.0 / EARTH_RADIUS, -1.0 / BIAS_S,
    )  # fmt: skip
    F = np.eye(4) + A * dt + 0.5 * A @ A * dt * dt
    Q = np.diag([0.0, model.noise_density**2, 0.0, 2.0 * model.bias_sd**2 / BIAS_S]) * dt
    # Levelling turns an accelerometer error b into a tilt b / g, which cancels the error at first.
    tilt = np.array([0.0, 0.0, 1.0 / gravity, 1.0])
    P = np.outer(tilt, tilt) * model.bias_sd**2
    P[2, 2] += model.noise_density**2 / ALIGN_S / gravity**2
    rows = []
    for k in range(n):
        navigator.step(dt, model.force[starts + n_align + k])
        navigator.bias *= 1.0 - dt / BIAS_S
        P = F @ P @ F.T + Q
        if (k + 1) % round(ZUPT_S / dt) == 0 and (k + 1) * dt <= zupts_s:
            gain = P[:, 1] / (P[1, 1] + ZUPT_SD**2)
            P = P - np.outer(gain, P[1])
            navigator.correct(gain, navigator.velocity)
        true_up = navigator.attitude @ up
        level = [np.hypot(*v.T[:2]) for v in (navigator.position, navigator.velocity, true_up)]
        rows.append([*level, np.full(len(starts), np.sqrt(2.0 * P[0, 0]))])
    table = np.array(rows)
    return Flights(np.arange(1, n + 1) * dt, *table.transpose(1, 0, 2))


def models() -> tuple[dict[str, Model], float, Floats, float]:
    """
    Fit the sample bags and correct the held-out bag; return the raw and corrected samples, the
    sample interval [s], the true direction of up and gravity [m/s^2].
    """
    bags, held_out = sorted((BAGS / 'fit').glob('*.mcap')), BAGS / 'held_out.mcap'
    full = tc.fit(bags, gravity=9.80665)
    cubic = tc.fit(bags, gravity=9.80665, groups=('curve',), static_curve='cubic',
                   dynamic_curve='cubic')  # fmt: skip
    recording = tc.read(held_out)
    collected = {}
    for name, unit in (('one set', cubic), ('compensated', full)):
        out = unit.correct(recording.time_s, recording.counts, **recording.temperatures)
        noise = np.array(Correction(unit).noise)
        claimed = np.nanmean(np.diagonal(out.covariance, axis1=1, axis2=2), axis=0) - noise
        density = float(np.mean(unit.noise_density_m_s2_sqrt_hz))
        collected[name] = Model(out.specific_force, density, float(np.sqrt(claimed[:2].mean())))
    axes = [getattr(full.axes, axis) for axis in 'xyz']
    bias = np.array([axis.bias for axis in axes])
    scale = np.array([axis.scale_factor for axis in axes])
    raw = (recording.counts - bias) / scale @ np.array(full.misalignment).T
    # Raw samples have no stated sd: for them the filter uses the sd of the compensated samples.
    ours = collected['compensated']
    truth = json.loads(inspect_recording(held_out).metadata['truth'])
    return (
        {'raw': Model(raw, ours.noise_density, ours.bias_sd), **collected},
        float(np.median(np.diff(recording.time_s))),
        np.array(truth['up']),
        full.gravity_m_s2,
    )


def draw(path: Path, results: dict[str, dict[str, Flights]]) -> None:
    """Draw the RMS position error over time, without and with zero-velocity updates."""
    mpl.use('Agg')
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9.6, 3.8), layout='constrained')
    for panel, (program, flights) in zip(panels, results.items(), strict=True):
        for name, flight in flights.items():
            minutes, colour = flight.time_s / 60.0, COLOURS[name]
            low, high = np.quantile(flight.position, (0.05, 0.95), axis=1)
            if name != 'one set':
                panel.fill_between(minutes, low, high, color=colour, alpha=0.15, linewidth=0)
            rms = np.sqrt(np.mean(flight.position**2, 1))
            panel.plot(minutes, rms, color=colour, label=f'{name}: {rms[-1]:.3g} m at the end')
        panel.set(xlabel='minutes after levelling', title=program, ylim=(0.0, None))
        panel.legend(loc='upper left')
        panel.grid(alpha=0.3)
    panels[0].set_ylabel('horizontal position error, m')
    figure.savefig(path, dpi=110)


def main() -> int:
    """Print the table, and draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--figure', type=Path, help='PNG to draw')
    options = parser.parse_args()
    of_model, dt, up, gravity = models()
    results = {
        program: {name: fly(model, dt, up, gravity, zupts_s) for name, model in of_model.items()}
        for program, zupts_s in (
            ('free for 30 min', 0.0), ('25 min of ZUPT, 5 min coast', STANDING_S),
        )
    }  # fmt: skip
    print('| program | accelerometer | position, m RMS | max | velocity, m/s RMS | tilt, urad RMS '
          '| sigma of position, m | error / sigma |')  # fmt: skip
    print('|---|---|---|---|---|---|---|---|')
    for program, flights in results.items():
        for name, flight in flights.items():
            position, velocity, tilt = (
                float(np.sqrt(np.mean(error[-1] ** 2)))
                for error in (flight.position, flight.velocity, flight.tilt)
            )
            sigma = float(flight.sigma[-1, 0])
            print(f'| {program} | {name} | {position:.3g} | {flight.position[-1].max():.3g} '
                  f'| {velocity:.2g} | {1e6 * tilt:.3g} | {sigma:.3g} '
                  f'| {position / sigma:.2f} |')  # fmt: skip
    if options.figure:
        draw(options.figure, results)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
