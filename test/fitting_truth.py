# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns window tables with known truth for the tests of the regression, without samples or sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thermo_comp.fitting.posterior import Regression
from thermo_comp.fitting.unknowns import Prior, State, Windows, initial_state, tangent_basis
from thermo_comp.simulation.campaign import positions
from thermo_comp.typing import Floats

GRAVITY = 9.81
NOMINAL = np.array([1000.0, 1010.0, 990.0])
#: Groups of the table's columns: a curve t, t^2; two lags; two columns that nothing needs.
GROUPS = ('curve', 'curve', 'board', 'board', 'idle', 'idle')
TAUS = np.array([400.0, 2500.0])
START = np.array([[0.25, 0.1], [0.1, 1.0]])
MICRO = 1e-6 * GRAVITY


@dataclass(frozen=True)
class Truth:
    """One unit, in m/s^2 of the nominal scale factor; weights per physical unit of the columns."""

    kappa: Floats = field(default_factory=lambda: np.array([1.0003, 0.9996, 1.0005]))
    bias: Floats = field(default_factory=lambda: np.array([5e-3, -8e-3, 2e-3]))
    on_bias: Floats = field(
        default_factory=lambda: np.outer([1.0, -2.0, 1.5], [2e-5, 1e-7, 2e-5, 1e-5, 0.0, 0.0])
    )
    on_scale: Floats = field(
        default_factory=lambda: np.outer([1.0, 0.7, 1.3], [5e-6, 3e-8, 1e-6, 4e-7, 0.0, 0.0])
    )
    skew: Floats = field(default_factory=lambda: np.array([1e-3, -2e-3, 5e-4]))
    start_sd: float = 0.0
    sigma: Floats = field(default_factory=lambda: np.full(3, 2.0 * MICRO))
    #: Random walk of the bias, m/s^2 per root second.
    walk: float = 0.0
    offset_sd: float = 0.0
    #: What supports lean by, rad per RMS of what they lean with.
    lean_sd: float = 0.0

    @property
    def weights(self) -> Floats:
        """Weights in bias and scale, shape (2, 3, m)."""
        return np.stack((self.on_bias, self.on_scale))


def table_of(
    truth: Truth,
    n_positions: int,
    rng: np.random.Generator,
    *,
    n_windows: int = 40,
    step_s: float = 120.0,
    up: Floats | None = None,
) -> tuple[Windows, Floats]:
    """Draw a table of windows, one bag per position; also return the true directions."""
    up = positions(n_positions, 3) if up is None else up
    time = step_s * (np.arange(n_windows) + 0.5)
    # Once up and down in each bag, each time a little otherwise.
    shapes = [_columns(time, step_s, 0.7 + 0.05 * p) for p in range(n_positions)]
    share = np.zeros((n_windows, len(GROUPS)))
    share[:, 2:4] = np.exp(-time[:, None] / TAUS)
    A = np.eye(3)
    A[1, 0], A[2, 0], A[2, 1] = truth.skew
    means = []
    lean = np.concatenate(shapes)[:, [0, 2]]
    lean /= np.sqrt(np.mean(lean**2, axis=0))
    leaning = truth.lean_sd * rng.standard_normal((n_positions, 2, 2)) if truth.lean_sd else None
    for p, (columns, direction) in enumerate(zip(shapes, up, strict=True)):
        moved = columns.copy()
        moved[:, 2:4] += share[:, 2:4] * (truth.start_sd * rng.standard_normal(2))
        force = GRAVITY * A @ direction
        clean = truth.kappa * force * (1.0 + moved @ truth.on_scale.T)
        clean = clean + truth.bias + moved @ truth.on_bias.T
        clean += truth.offset_sd * rng.standard_normal(3)
        if leaning is not None:
            across = tangent_basis(up)[p] @ leaning[p].T
            own = lean[p * n_windows : (p + 1) * n_windows]
            clean += truth.kappa * GRAVITY * (own @ (A @ across).T)
        steps = rng.standard_normal((n_windows, 3)) * truth.walk * np.sqrt(step_s)
        steps[0] = 0.0
        white = rng.standard_normal((n_windows, 3)) * truth.sigma
        means.append(NOMINAL * (clean + np.cumsum(steps, axis=0) + white))
    number = np.repeat(np.arange(n_positions), n_windows)
    windows = Windows(
        position=number,
        bag=number,
        time=np.tile(time, n_positions),
        weight=np.ones(len(number)),
        mean=np.concatenate(means),
        columns=np.concatenate(shapes),
        groups=GROUPS,
        lag=np.array([-1, -1, 0, 1, -1, -1]),
        reach=np.array([0.0, 0.0, *TAUS, 0.0, 0.0]),
        start=np.tile(share, (n_positions, 1)),
        start_covariance=START,
        in_scale=np.ones(len(GROUPS), dtype=bool),
        lean=lean,
    )
    return windows, up


def _columns(time: Floats, step_s: float, turns: float) -> Floats:
    end = time[-1] + 0.5 * step_s
    fine = np.linspace(0.0, end, 2000)
    t = 15.0 * np.sin(2.0 * np.pi * turns * fine / end)
    behind = []
    for tau in TAUS:
        state, lagged = t[0], []
        for value in t.tolist():
            state += (value - state) * (fine[1] / tau)
            lagged.append(state)
        behind.append(t - np.array(lagged))
    idle = [np.cos(17.0 * turns * fine / end), np.sin(29.0 * turns * fine / end)]
    table = np.column_stack((t, t * t, *behind, *idle))
    return np.column_stack([np.interp(time, fine, column) for column in table.T])


def widths(names: tuple[str, ...], bias_sd: float, scale_sd: float) -> Floats:
    """Width of each column in bias and scale: 0 where it takes no part."""
    return np.outer((bias_sd, scale_sd), np.isin(GROUPS, names))


def prior_of(
    truth: Truth, names: tuple[str, ...] = ('curve', 'board'), **changes: object
) -> Prior:
    """Return a wide prior with the true noises."""
    known: dict[str, object] = {
        'bias_mean': np.zeros(3),
        'bias_sd': np.full(3, 1.0),
        'scale_sd': 0.05,
        'skew_sd': 1e-2,
        'widths': widths(names, 1e-2, 1e-3),
        'offset_sd': max(truth.offset_sd, 1e-9),
        'lean_sd': max(truth.lean_sd, 1e-9),
        'sigma': truth.sigma,
        'rho': (truth.walk / truth.sigma) ** 2,
    }
    return Prior(**(known | changes))  # type: ignore[arg-type]


def begin(windows: Windows, up: Floats) -> tuple[Regression, State]:
    """Return a regression and a state a little beside the truth."""
    regression = Regression(windows, GRAVITY, NOMINAL)
    turned = up + np.array([2e-3, -1e-3, 3e-3])
    turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    state = initial_state(windows, regression.n_bags, np.zeros(3), np.ones(3), np.zeros(3), turned)
    return regression, state
