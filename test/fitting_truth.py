# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns window tables with known truth for the tests of the fit, without samples or simulation.

"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np

from thermo_comp.fitting.history import ThermalHistory
from thermo_comp.fitting.table import WindowTable
from thermo_comp.simulation import positions
from thermo_comp.typing import Floats

GRAVITY = 9.81
#: Chamber program: up, down and back, an hour's soak at each end.
PROGRAM_S = np.array([0.0, 1200.0, 3000.0, 5400.0, 9000.0, 11400.0, 12600.0])
PROGRAM_C = np.array([20.0, 20.0, 35.0, 35.0, 5.0, 5.0, 20.0])


@dataclass(frozen=True)
class Truth:
    """
    One unit: ``counts = bias + g K scale (A u) + noise`` with functions of t and of the memory.

    """

    bias: Floats = field(default_factory=lambda: np.array([5.0, -8.0, 2.0]))
    scale: Floats = field(default_factory=lambda: np.array([1000.0, 1010.0, 990.0]))
    #: Per axis: t, t^2.
    bias_curve: Floats = field(default_factory=lambda: np.outer([1.0, -0.5, 2.0], [2e-2, 1e-4]))
    scale_curve: Floats = field(default_factory=lambda: np.outer([1.0, 1.2, 0.8], [5e-5, 3e-7]))
    #: A[1, 0], A[2, 0], A[2, 1].
    skew: Floats = field(default_factory=lambda: np.array([1e-3, -2e-3, 5e-4]))
    time_constants_s: Floats = field(default_factory=lambda: np.array([400.0, 2500.0]))
    bias_memory: Floats = field(default_factory=lambda: np.outer([1.0, -2.0, 1.5], [2e-2, 1e-2]))
    scale_memory: Floats = field(default_factory=lambda: np.outer([1.0, 0.7, 1.3], [1e-5, 4e-6]))
    noise_sd: float = 0.01


@cache
def history(step_s: float = 2.0, board_lag_s: float = 600.0) -> ThermalHistory:
    """
    One bag's thermal state: the board follows the program's air with one lag.

    """
    time = np.arange(0.0, PROGRAM_S[-1] + step_s, step_s)
    case = np.interp(time, PROGRAM_S, PROGRAM_C)
    board = lagged(case, step_s, board_lag_s)
    rate = (case - board) / board_lag_s
    return ThermalHistory(
        start_s=0.0,
        step_s=step_s,
        board=board,
        var_board=np.full(len(time), 1e-6),
        rate=rate,
        gradient=case - board,
        weight=(np.abs(rate) * 60.0 > 0.05).astype(float),
        is_unknown=np.zeros(len(time), dtype=bool),
    )


def lagged(temperature: Floats, step_s: float, tau_s: float) -> Floats:
    """
    First-order lag by fine Euler steps: the slow road, on purpose not the fit's formula.

    """
    return np.array(_lagged(tuple(temperature.tolist()), step_s, tau_s))


@cache
def _lagged(temperature: tuple[float, ...], step_s: float, tau_s: float) -> list[float]:
    n = 20
    result = []
    state = temperature[0]
    result.append(state)
    for i in range(1, len(temperature)):
        for k in range(n):
            drive = temperature[i - 1] + (temperature[i] - temperature[i - 1]) * (k + 0.5) / n
            state += (drive - state) * step_s / n / tau_s
        result.append(state)
    return result


def table_of(
    truth: Truth,
    n_positions: int,
    rng: np.random.Generator,
    *,
    window_s: float = 60.0,
    thermal: ThermalHistory | None = None,
    up: Floats | None = None,
) -> tuple[WindowTable, Floats]:
    """
    Draw a table of windows, one bag per position; also return the true directions.

    """
    thermal = thermal or history()
    up = positions(n_positions, 3) if up is None else up
    time = np.arange(window_s / 2.0, thermal.time[-1], window_s)
    n = len(time)
    t = np.interp(time, thermal.time, thermal.board) - 20.0
    powers = np.column_stack((t, t * t))
    memory = np.column_stack(
        [
            np.interp(
                time, thermal.time, thermal.board - lagged(thermal.board, thermal.step_s, tau)
            )
            for tau in truth.time_constants_s
        ]
        or [np.zeros((n, 0))]
    )
    A = np.eye(3)
    A[1, 0], A[2, 0], A[2, 1] = truth.skew
    bias = truth.bias + powers @ truth.bias_curve.T + memory @ truth.bias_memory.T
    scale = truth.scale * (1.0 + powers @ truth.scale_curve.T + memory @ truth.scale_memory.T)
    means = [
        bias + scale * (GRAVITY * A @ u) + truth.noise_sd * rng.standard_normal((n, 3)) for u in up
    ]
    number = np.repeat(np.arange(n_positions), n)
    sections = thermal.sections()[np.searchsorted(thermal.time, time)]
    return (
        WindowTable(
            position=number,
            bag=number,
            section=np.tile(sections, n_positions),
            time=np.tile(time, n_positions),
            count=np.full(n * n_positions, 100.0 * window_s),
            mean=np.concatenate(means),
            t=np.tile(t, n_positions),
            gradient=np.tile(np.interp(time, thermal.time, thermal.gradient), n_positions),
            rate=np.tile(np.interp(time, thermal.time, thermal.rate), n_positions),
            weight=np.tile(np.interp(time, thermal.time, thermal.weight), n_positions),
            histories=(thermal,) * n_positions,
        ),
        up,
    )


def without_memory(truth: Truth) -> Truth:
    """
    Return the same unit without thermal memory.

    """
    return Truth(
        truth.bias, truth.scale, truth.bias_curve, truth.scale_curve, truth.skew,
        np.zeros(0), np.zeros((3, 0)), np.zeros((3, 0)), truth.noise_sd,
    )  # fmt: skip
