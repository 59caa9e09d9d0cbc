# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Computes errors of bias and scale divided by the Cramer-Rao bound, for docs/accuracy.md.

Run ``python benchmarks/efficiency.py``, or with fewer units: ``--units 10``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np
from accuracy import WINDOW_S, fit_and_correct

from thermo_comp.simulation.campaign import Position, parse_cyclogram, positions
from thermo_comp.simulation.drift import PartEffect
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import arrays, simulate
from thermo_comp.simulation.unit import UnitModel
from thermo_comp.typing import Floats
from thermo_comp.unit.gravity import STANDARD_GRAVITY


def exact_unit(seed: int) -> UnitModel:
    """
    Make a unit whose bias and scale are quadratics of the board's temperature alone.

    A calibration states its constants for zero heat flow. The unit has no self-heating, so there
    is no heat flow in soaks, and the bound needs no extrapolation to zero heat flow.
    """
    rng = np.random.default_rng(seed)

    def axes(sd: float) -> tuple[float, float, float]:
        x, y, z = rng.normal(0.0, sd, 3)
        return float(x), float(y), float(z)

    drift = PartEffect(
        'board', bias=axes(5.0), bias_curvature=axes(0.05), scale=axes(40.0),
        scale_curvature=axes(0.2),
    )  # fmt: skip
    unit = unit_preset('thermostatted', seed)
    return replace(unit, drift=(drift,), network=replace(unit.network, power={}))


def bound(unit: UnitModel, program: str, directions: Floats, window_s: float) -> Floats:
    """
    Return the Cramer-Rao bounds of bias [counts] and ln K at the reference temperature, as sd,
    shape (2, 3).

    The bounds are computed without the fit, by numerical derivatives of window means of counts
    with white noise. The unknowns are two angles of each attitude, M, and for each axis bias and
    scale as quadratics of the true board temperature.
    """
    run = simulate(unit, parse_cyclogram(program), directions[0], rate_hz=1.0)
    truth = run.truth
    time_s = np.arange(window_s / 2.0, truth.grid_s[-1], window_s)
    board = truth.temperatures[:, unit.network.nodes.index('board')]
    t = np.interp(time_s, truth.grid_s, board) - 20.0
    powers = np.column_stack((np.ones_like(t), t, t * t))
    K = np.array(unit.scale_factor)
    sd = np.array(unit.noise_density) * 1e-6 * STANDARD_GRAVITY * K / np.sqrt(window_s)
    n = len(directions)
    effect = unit.drift[0]
    micro = 1e-6 * STANDARD_GRAVITY * K
    start = np.concatenate(
        (
            np.column_stack((unit.bias_at_reference, effect.bias * micro,
                             effect.bias_curvature * micro)).ravel(),
            np.column_stack((np.ones(3), np.array(effect.scale) * 1e-6,
                             np.array(effect.scale_curvature) * 1e-6)).ravel(),
            np.linalg.inv(unit.M)[[1, 2, 2], [0, 0, 1]],
            np.zeros(2 * n),
        )
    )  # fmt: skip
    across = [np.linalg.svd(u[None])[2][1:] for u in directions]

    def predicted(p: Floats) -> Floats:
        A = np.eye(3)
        A[1, 0], A[2, 0], A[2, 1] = p[18:21]
        angles = p[21:].reshape(n, 2)
        up = np.array([u + a @ e for u, a, e in zip(directions, angles, across, strict=True)])
        force = STANDARD_GRAVITY * (up / np.linalg.norm(up, axis=1, keepdims=True)) @ A.T
        bias = powers @ p[:9].reshape(3, 3).T
        scale = K * (powers @ p[9:18].reshape(3, 3).T)
        return ((bias + force[:, None, :] * scale) / sd).ravel()

    columns = []
    for j in range(len(start)):
        # Steps of the numerical derivatives: 1e-3 for the bias, 1e-6 for scale, M and directions;
        # coefficients of t and t^2 have steps smaller by factors of 10 and 1000.
        step = np.zeros(len(start))
        step[j] = 1e-6 if j >= 9 else 1e-3
        step[j] *= 1e-3 if j < 18 and j % 3 == 2 else 1e-1 if j < 18 and j % 3 == 1 else 1.0
        columns.append((predicted(start + step) - predicted(start - step)) / (2.0 * step[j]))
    jacobian = np.column_stack(columns)
    norm = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian / norm).T @ (jacobian / norm)) / np.outer(norm, norm)
    sds = np.sqrt(np.diag(covariance))
    return np.array([sds[0:9:3], sds[9:18:3]])


def efficiency(n_units: int) -> None:
    """Compare bias and scale at the reference temperature with the Cramer-Rao bound."""
    print(
        '| positions | units | bias: RMS error / bound | scale | bias: RMS error / claimed sd '
        '| scale | errors within 1.96 claimed sd: bias | scale |'
    )
    print('|---|---|---|---|---|---|---|---|')
    for n_positions in (18, 24):
        ratios: list[Floats] = []
        claimed: list[Floats] = []
        for seed in range(1, n_units + 1):
            unit, ups = exact_unit(seed), positions(n_positions, seed)
            stations = [Position(parse_cyclogram('demo'), up) for up in ups]
            ours = fit_and_correct(arrays(unit, stations, seed, rate_hz=4.0), [])
            truth = np.array([unit.bias_at_reference, np.log(unit.scale_factor)])
            ratios.append((ours.constants - truth) / bound(unit, 'demo', ups, WINDOW_S))
            claimed.append((ours.constants - truth) / ours.constants_sd)
        ratio = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
        claim = np.sqrt(np.mean(np.square(claimed), axis=(0, 2)))
        inside = np.mean(np.abs(claimed) < 1.96, axis=(0, 2))
        print(
            f'| {n_positions} | {n_units} | {ratio[0]:.3f} | {ratio[1]:.3f} '
            f'| {claim[0]:.3f} | {claim[1]:.3f} '
            f'| {100 * inside[0]:.1f} % | {100 * inside[1]:.1f} % |',
            flush=True,
        )


def main() -> int:
    """Print errors of bias and scale relative to the Cramer-Rao bound and to the claimed sd."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--units', type=int, default=100, help='number of random units')
    efficiency(parser.parse_args().units)
    return 0


if __name__ == '__main__':
    sys.exit(main())
