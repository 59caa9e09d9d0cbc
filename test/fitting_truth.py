# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns window tables, drawn from true parameters, for tests of the regression."""

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from thermo_comp.fitting.equations import as_vector
from thermo_comp.fitting.hyperparameters import Candidates
from thermo_comp.fitting.initialisation import STEEPEST
from thermo_comp.fitting.regression import Regression
from thermo_comp.fitting.unknowns import Noise, Prior, Windows, tangent_basis
from thermo_comp.fitting.windows import N_SECTIONS
from thermo_comp.simulation.campaign import positions
from thermo_comp.typing import Floats

GRAVITY = 9.81
NOMINAL = np.array([1000.0, 1010.0, 990.0])  # counts per m/s^2
#: Group of each column: curve (t, t^2), board (two lags), idle (two columns without effect).
GROUPS = ('curve', 'curve', 'board', 'board', 'idle', 'idle')
TAUS = np.array([400.0, 2500.0])  # time constants of the two board lags [s]
START = np.array([[0.25, 0.1], [0.1, 1.0]])  # covariance of the two initial lag states [K^2]
MICRO = 1e-6 * GRAVITY  # 1 ug [m/s^2]


@dataclass(frozen=True)
class Truth:
    """True parameters of a unit; biases are in counts / nominal scale factor [m/s^2]."""

    kappa: Floats = field(default_factory=lambda: np.array([1.0003, 0.9996, 1.0005]))
    bias: Floats = field(default_factory=lambda: np.array([5e-3, -8e-3, 2e-3]))
    on_bias: Floats = field(
        default_factory=lambda: np.outer([1.0, -2.0, 1.5], [2e-5, 1e-7, 2e-5, 1e-5, 0.0, 0.0])
    )
    on_scale: Floats = field(
        default_factory=lambda: np.outer([1.0, 0.7, 1.3], [5e-6, 3e-8, 1e-6, 4e-7, 0.0, 0.0])
    )
    misalignment: Floats = field(default_factory=lambda: np.array([1e-3, -2e-3, 5e-4]))
    start_sd: float = 0.0
    sigma: Floats = field(default_factory=lambda: np.full(3, 2.0 * MICRO))
    #: Correlated noise of the bias, which adds to the white noise of sd `sigma`.
    noise: Noise = field(default_factory=Noise)
    offset_sd: float = 0.0
    #: Sd [rad] of the support tilt by a temperature column whose RMS is 1.
    tilt_sd: float = 0.0

    @property
    def weights(self):
        return np.stack((self.on_bias, self.on_scale))

    def errors(self, regression, found):
        errors, sd = {}, np.sqrt(found.variance)
        for name in ('kappa', 'bias', 'misalignment', 'weights'):
            true = getattr(self, name) * (regression.rms if name == 'weights' else 1.0)
            places = getattr(found.layout, name)
            used = places >= 0
            errors[name] = (getattr(found.state, name) - true)[used] / sd[places[used]]
        return errors


def table_of(truth, n_positions, rng, *, n_windows=40, step_s=120.0, up=None):
    """Draw a table of windows, with a bag per position; return the table and true directions."""
    up = positions(n_positions, 3) if up is None else up
    time = step_s * (np.arange(n_windows) + 0.5)
    # The temperature in the bag of position p is a sine with 0.7 + 0.05 p periods.
    shapes = [_columns(n_windows, step_s, 0.7 + 0.05 * p) for p in range(n_positions)]
    share = np.zeros((n_windows, len(GROUPS)))
    share[:, 2:4] = np.exp(-time[:, None] / TAUS)
    A = np.eye(3)
    A[1, 0], A[2, 0], A[2, 1] = truth.misalignment
    means = []
    tilt = np.concatenate(shapes)[:, [0, 2]]
    tilt /= np.sqrt(np.mean(tilt**2, axis=0))
    tilts = truth.tilt_sd * rng.standard_normal((n_positions, 2, 2)) if truth.tilt_sd else None
    decay = np.exp(-step_s / np.array(truth.noise.times_s))[:, None]
    for p, (columns, direction) in enumerate(zip(shapes, up, strict=True)):
        moved = columns.copy()
        moved[:, 2:4] += share[:, 2:4] * (truth.start_sd * rng.standard_normal(2))
        force = GRAVITY * A @ direction
        clean = truth.kappa * force * (1.0 + moved @ truth.on_scale.T)
        clean = clean + truth.bias + moved @ truth.on_bias.T
        clean += truth.offset_sd * rng.standard_normal(3)
        if tilts is not None:
            across = tangent_basis(up)[p] @ tilts[p].T
            part = tilt[p * n_windows : (p + 1) * n_windows]
            clean += truth.kappa * GRAVITY * (part @ (A @ across).T)
        slow = rng.standard_normal((n_windows, len(decay), 3)) * np.sqrt(truth.noise.ratio)
        for k in range(1, n_windows):
            slow[k] = decay * slow[k - 1] + np.sqrt(1.0 - decay**2) * slow[k]
        white = rng.standard_normal((n_windows, 3))
        means.append(NOMINAL * (clean + (slow.sum(axis=1) + white) * truth.sigma))
    number = np.repeat(np.arange(n_positions), n_windows)
    columns = np.concatenate(shapes)
    steepest = np.array([1.0, 2.0 * np.abs(columns[:, 0]).max(), 1.0, 1.0, 1.0, 1.0])
    windows = Windows(
        position=number, bag=number,
        section=np.tile(np.arange(n_windows) * N_SECTIONS // n_windows, n_positions),
        time=np.tile(time, n_positions), weight=np.ones(len(number)), mean=np.concatenate(means),
        columns=columns, groups=GROUPS, kelvins=np.sqrt(np.mean(columns**2, axis=0)) / steepest,
        lag=np.array([-1, -1, 0, 1, -1, -1]), start=np.tile(share, (n_positions, 1)),
        start_covariance=START, in_scale=np.ones(len(GROUPS), dtype=bool), tilt=tilt,
    )  # fmt: skip
    return windows, up


@cache
def _columns(n_windows, step_s, turns):
    time = step_s * (np.arange(n_windows) + 0.5)
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


def rows_of(windows, rows):
    """Select rows of a table; number the remaining positions and bags from 0 on."""
    names = ('section', 'time', 'weight', 'mean', 'columns', 'start', 'tilt')
    taken = {name: getattr(windows, name)[rows] for name in names}
    for name in ('position', 'bag'):
        _, first, number = np.unique(
            getattr(windows, name)[rows], return_index=True, return_inverse=True
        )
        taken[name] = np.argsort(np.argsort(first))[number]
    return replace(windows, **taken)


def without_starts(windows):
    """Remove initial lag states, so that the model contains no products of unknowns."""
    return replace(
        windows, lag=np.full_like(windows.lag, -1), start=np.zeros_like(windows.start),
        start_covariance=np.zeros((0, 0)),
    )  # fmt: skip


def column_sd(names, bias_sd, scale_sd):
    """Return the prior sd of each column in bias and scale, shape (2, 6); 0 excludes a column."""
    return np.outer((bias_sd, scale_sd), np.isin(GROUPS, names))


def prior_of(truth, names=('curve', 'board'), **changes):
    values = {
        'bias_sd': np.full(3, 1.0), 'scale_sd': 0.05,
        'misalignment_sd': 1e-2, 'column_sd': column_sd(names, 1e-2, 1e-3),
        'offset_sd': max(truth.offset_sd, 1e-9), 'tilt_sd': max(truth.tilt_sd, 1e-9),
        'sigma': truth.sigma, 'noise': truth.noise,
    }  # fmt: skip
    return Prior(**(values | changes))


def candidates_of(windows, forced=()):
    """Allow all columns and keep the groups `forced`; typical sd of slopes: 5 ug/K, 5 ppm/K."""
    none = np.zeros((2, len(windows.groups)), dtype=bool)
    typical, largest = (
        np.outer(slope, windows.kelvins) * windows.parts
        for slope in (np.array([5e-5, 5e-6]), STEEPEST)
    )
    return Candidates(typical, largest, np.isin(windows.groups, forced), none)


def begin(windows, up):
    regression = Regression(windows, GRAVITY, NOMINAL)
    turned = up + np.array([2e-3, -1e-3, 3e-3])
    turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return regression, regression.initial_state(np.zeros(3), np.zeros(3), turned)


def mode_of(regression, state, prior):
    """Find the mode to full precision by Newton steps, from the state `state`."""
    point = regression.at(regression.solve(state, prior, n_steps=12).state, prior)
    for _ in range(6):
        step, _ = point.solution
        point = point.with_step(step)
    return regression.solve(point.state, prior, n_steps=0)


def unit_of(state, layout):
    """Return the parameters of the unit as a vector, without those of positions and bags."""
    return as_vector(state, layout)[: layout.n_unit]
