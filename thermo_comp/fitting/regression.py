# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the regression: bias, scale, misalignment, attitudes and lags in one weighted least squares.

The forward model has white noise in the counts and is bilinear: linear in the axis parameters
for known attitudes, and the reverse. Gauss-Newton with an exact Jacobian on all of them at once;
an attitude moves in the tangent plane of the unit sphere, so ``|u| = 1`` holds by construction.
The frame is fixed by A = M^-1 being lower triangular. Windows far off (5 sd) lose weight, after
Huber. Levenberg damping accepts only steps that lower the cost.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..errors import FitError
from ..typing import Floats, Ints
from .lags import Memory
from .solution import Regressors, Solution, predict, regressors
from .table import WindowTable

# Huber's bend: at 3 sd the efficiency in pure noise is 99.6 %, and a wild window pulls no more
# than one of 3 sd.
_HUBER_SDS = 3.0
# A step is the last when the quadratic model promises less than this part of one unit of
# chi-square: a hundredth of the smallest shift that the data could tell.
_CONVERGED_DECREASE = 1e-4
# What is known beforehand of the memory at a bag's start [K]: it has seen some of the day.
START_MEMORY_SD = 3.0
_SKEW_ROWS = ((1, 0), (2, 0), (2, 1))


@dataclass(frozen=True)
class Freedom:
    """
    What the regression may move besides bias and scale.

    Parameters
    ----------
    misalignment, lags, start_memory, attitudes, axes, transient : bool, optional
        Which parts are estimated; the rest stays as it starts. A transient is estimated only
        where the start has one.
    time_constant_range_s : (float, float), optional
        Bounds of the time constants [s].
    skew_sd : float, optional
        What is known of the misalignment beforehand [rad], about zero. Where the positions cannot
        tell it, it is estimated within this all the same: held at zero, it would be taken for
        drift.

    """

    misalignment: bool = True
    lags: bool = True
    start_memory: bool = True
    attitudes: bool = True
    axes: bool = True
    transient: bool = True
    time_constant_range_s: tuple[float, float] = (20.0, 1e5)
    skew_sd: float = np.inf


@dataclass(frozen=True)
class Outcome:
    """
    A regression that has ended.

    Parameters
    ----------
    solution : Solution
        The estimates.
    cost : float
        Half the robust chi-square.
    n_steps : int
        Gauss-Newton steps taken.
    is_converged : bool
        Whether the last step was below what the data can tell.
    residual : ndarray, shape (n, 3)
        Measured minus predicted, in input units.
    robust_weight : ndarray, shape (n, 3)
        Huber weights, 1 where nothing is odd.
    information : ndarray, shape (m, m)
        Normal matrix of all free parameters.
    layout : Layout
        Where each parameter stands in it.

    """

    solution: Solution
    cost: float
    n_steps: int
    is_converged: bool
    residual: Floats
    robust_weight: Floats
    information: Floats
    layout: Layout


@dataclass(frozen=True)
class Layout:
    """
    Places of the parameters in the normal matrix; -1 for those that are held.

    Parameters
    ----------
    axis : ndarray of int, shape (3, n_bias + n_scale)
        Bias then scale parameters of each axis.
    skew : ndarray of int, shape (3,)
        Misalignment.
    lags : ndarray of int, shape (n_lags,)
        ``ln tau``.
    up : ndarray of int, shape (n_positions, 2)
        Attitudes, in the tangent basis.
    start : ndarray of int, shape (n_bags, n_lags)
        Start memories.
    transient : ndarray of int, shape (n_bags, 3) or (0, 3)
        Warming-up of each bag.
    transient_lag : ndarray of int, shape (1,) or (0,)
        ``ln`` of its time constant.
    n : int
        How many are free.

    """

    axis: Ints
    skew: Ints
    lags: Ints
    up: Ints
    start: Ints
    transient: Ints
    transient_lag: Ints
    n: int


def layout_of(solution: Solution, freedom: Freedom, table: WindowTable) -> Layout:
    """
    Give each free parameter its place.

    Parameters
    ----------
    solution : Solution
        Gives the sizes.
    freedom : Freedom
        What is free.
    table : WindowTable
        Which positions have windows; the others' attitudes are held.

    Returns
    -------
    Layout
        Places.

    """
    n = 0

    def take(shape: tuple[int, ...], is_free: bool) -> Ints:
        nonlocal n
        size = int(np.prod(shape))
        if not is_free:
            return np.full(shape, -1, dtype=np.int64)
        n += size
        return np.arange(n - size, n, dtype=np.int64).reshape(shape)

    axis = take((3, solution.bias.shape[1] + solution.scale.shape[1]), freedom.axes)
    skew = take((3,), freedom.misalignment)
    lags = take(solution.time_constants_s.shape, freedom.lags)
    start = take(solution.start_memory.shape, freedom.start_memory)
    transient = take(solution.transient.shape, freedom.transient)
    transient_lag = take((min(1, len(solution.transient)),), freedom.transient)
    up = take((len(solution.up), 2), freedom.attitudes)
    present = np.zeros(len(solution.up), dtype=bool)
    present[np.unique(table.position)] = True
    if freedom.attitudes and not present.all():
        up[~present] = -1
        first = n - 2 * len(solution.up)
        up[present] = first + np.arange(2 * int(present.sum())).reshape(-1, 2)
        n = first + 2 * int(present.sum())
    return Layout(axis, skew, lags, up, start, transient, transient_lag, n)


def regress(
    table: WindowTable,
    start: Solution,
    freedom: Freedom | None = None,
    *,
    is_robust: bool = True,
    max_rounds: int = 4,
    max_steps: int = 60,
) -> Outcome:
    """
    Minimise the weighted squares from a start.

    Parameters
    ----------
    table : WindowTable
        The windows.
    start : Solution
        Where to begin; its `noise_sd` gives the first weights.
    freedom : Freedom or None, optional
        What may move.
    is_robust : bool, optional
        Whether odd windows lose weight.
    max_rounds : int, optional
        How often the noise may be re-estimated from the residuals and the fit repeated; with one
        round the weights stay as they start.
    max_steps : int, optional
        Bound of the Gauss-Newton steps of one round.

    Returns
    -------
    Outcome
        The minimum.

    Raises
    ------
    FitError
        If there are no windows or the equations are singular.

    """
    freedom = freedom or Freedom()
    if not len(table.time):
        raise FitError('no still window with a temperature is left to fit')
    state = start
    typical = float(np.median(table.count))
    base = np.sqrt(table.count / typical)
    slices = table.position_slices()
    n_steps = 0
    for _ in range(max_rounds):
        inner = _minimise(table, state, freedom, base, slices, is_robust, max_steps)
        n_steps += inner.n_steps
        before, state = state.noise_sd, inner.solution
        if max_rounds == 1:
            break
        noise = noise_of(table, inner.residual, base)
        state = replace(state, noise_sd=noise)
        inner = replace(inner, solution=state)
        if np.all(np.abs(np.log(noise / before)) < 0.03):
            break
    return replace(inner, n_steps=n_steps)


def noise_of(table: WindowTable, residual: Floats, base: Floats) -> Floats:
    """
    Estimate the residual sd of a typical window, per regime and axis, robustly.

    Parameters
    ----------
    table : WindowTable
        The windows.
    residual : ndarray, shape (n, 3)
        Residuals.
    base : ndarray, shape (n,)
        Root of the relative sample count.

    Returns
    -------
    ndarray, shape (2, 3)
        Static, dynamic. A regime with few windows takes the other's.

    """
    scaled = residual * base[:, None]
    result = np.empty((2, 3))
    dynamic = table.is_dynamic
    for axis in range(3):
        whole = _robust_sd(scaled[:, axis])
        for regime, rows in enumerate((~dynamic, dynamic)):
            result[regime, axis] = _robust_sd(scaled[rows, axis]) if rows.sum() >= 30 else whole
    # A perfect fit (noise-free data) must not divide by zero; equal weights serve then.
    floor = 1e-3 * np.max(result) if np.max(result) > 0.0 else 1.0
    return np.maximum(result, floor)


def _robust_sd(values: Floats) -> float:
    """
    Winsorised standard deviation: near the plain one in noise, blind to a few outliers.

    """
    middle = 1.4826 * float(np.median(np.abs(values)))
    if not middle:
        return float(np.sqrt(np.mean(values**2)))
    clipped = np.clip(values, -_HUBER_SDS * middle, _HUBER_SDS * middle)
    # The clip at 3 sd takes 0.2 % of a normal variance, far below what weights need.
    return float(np.sqrt(np.mean(clipped**2)))


def _minimise(
    table: WindowTable,
    start: Solution,
    freedom: Freedom,
    base: Floats,
    slices: list[slice],
    is_robust: bool,
    max_steps: int,
) -> Outcome:
    layout = layout_of(start, freedom, table)
    sd = np.where(table.is_dynamic[:, None], start.noise_sd[1], start.noise_sd[0])
    root_weight = base[:, None] / sd
    state = start
    memory = table.memory(state.time_constants_s)
    damping = 0.0
    skew_sd = freedom.skew_sd
    cost, columns, residual, huber = _evaluate(
        table, state, root_weight, is_robust, memory, skew_sd
    )
    is_converged = is_stuck = False
    n_steps = 0
    while n_steps < max_steps and not is_converged:
        normal, gradient = _normal_equations(
            table, state, columns, residual, root_weight * np.sqrt(huber), layout, slices, skew_sd
        )
        n_steps += 1
        while True:
            step, promised = _solve(normal, gradient, damping)
            trial = _moved(state, step, layout, freedom)
            moves_lags = not np.array_equal(trial.time_constants_s, state.time_constants_s)
            trial_memory = table.memory(trial.time_constants_s) if moves_lags else memory
            found = _evaluate(table, trial, root_weight, is_robust, trial_memory, skew_sd)
            if found[0] <= cost * (1.0 + 1e-12):
                is_converged = promised < _CONVERGED_DECREASE or promised < 1e-12 * cost
                state, memory = trial, trial_memory
                cost, columns, residual, huber = found
                damping = damping / 10.0 if damping > 1e-9 else 0.0
                break
            if promised < _CONVERGED_DECREASE or damping > 1e8:
                is_converged = promised < _CONVERGED_DECREASE
                is_stuck = True
                break
            damping = max(damping * 10.0, 1e-6)
        if is_stuck:
            break
    normal, _ = _normal_equations(
        table, state, columns, residual, root_weight * np.sqrt(huber), layout, slices, skew_sd
    )
    return Outcome(state, cost, n_steps, is_converged, residual, huber, normal, layout)


def _evaluate(
    table: WindowTable,
    state: Solution,
    root_weight: Floats,
    is_robust: bool,
    memory: Memory,
    skew_sd: float,
) -> tuple[float, Regressors, Floats, Floats]:
    columns = regressors(table, state.spec, state.time_constants_s, state.start_memory, memory)
    residual = table.mean - predict(table, state, columns)
    size = np.abs(residual * root_weight)
    huber = np.ones_like(size)
    loss = 0.5 * size**2
    if is_robust:
        odd = size > _HUBER_SDS
        huber[odd] = _HUBER_SDS / size[odd]
        loss[odd] = _HUBER_SDS * (size[odd] - 0.5 * _HUBER_SDS)
    prior = 0.5 * float(np.sum((state.start_memory / START_MEMORY_SD) ** 2))
    prior += 0.5 * float(np.sum((state.skew / skew_sd) ** 2))
    return float(loss.sum()) + prior, columns, residual, huber


def tangent_basis(up: Floats) -> Floats:
    """
    Two unit vectors across each given one.

    Parameters
    ----------
    up : ndarray, shape (n, 3)
        Unit vectors.

    Returns
    -------
    ndarray, shape (n, 3, 2)
        Orthonormal columns.

    """
    helper = np.zeros_like(up)
    helper[np.arange(len(up)), np.argmin(np.abs(up), axis=1)] = 1.0
    first = np.cross(up, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(up, first)), axis=2)


def _normal_equations(
    table: WindowTable,
    state: Solution,
    columns: Regressors,
    residual: Floats,
    root_weight: Floats,
    layout: Layout,
    slices: list[slice],
    skew_sd: float,
) -> tuple[Floats, Floats]:
    spec, g = state.spec, state.gravity
    inverse = state.inverse_misalignment
    tangents = tangent_basis(state.up)
    memory_bias = state.bias[:, list(spec.memory_columns('bias'))]
    memory_scale = state.scale[:, list(spec.memory_columns('scale'))]
    n_lags = spec.n_lags
    # One spare row and column takes what belongs to held parameters.
    n = layout.n
    normal = np.zeros((n + 1, n + 1))
    gradient = np.zeros(n + 1)
    for p, rows in enumerate(slices):
        if rows.start == rows.stop:
            continue
        bag = int(table.bag[rows.start])
        u, tangent = state.up[p], tangents[p]
        for axis in range(3):
            scale = columns.scale[rows] @ state.scale[axis]
            force = g * float(inverse[axis] @ u)
            parts = [columns.bias[rows], force * columns.scale[rows]]
            places = [layout.axis[axis]]
            parts.append(np.outer(g * scale, inverse[axis] @ tangent))
            places.append(layout.up[p])
            for k, (row, column) in enumerate(_SKEW_ROWS):
                if row == axis:
                    parts.append((g * u[column] * scale)[:, None])
                    places.append(layout.skew[k : k + 1])
            if n_lags:
                effect = columns.live[rows, None] * (
                    memory_bias[axis] + force * memory_scale[axis]
                )
                parts += [effect * columns.slope[rows], effect * columns.decay[rows]]
                places += [layout.lags, layout.start[bag]]
            if len(layout.transient):
                since = table.time[rows, None] / state.transient_s
                decay = np.exp(-since)
                parts += [decay, float(state.transient[bag, axis]) * decay * since]
                places += [layout.transient[bag, axis : axis + 1], layout.transient_lag]
            jacobian = np.concatenate(parts, axis=1) * root_weight[rows, axis, None]
            where = np.concatenate(places)
            normal[np.ix_(where, where)] += jacobian.T @ jacobian
            gradient[where] += jacobian.T @ (residual[rows, axis] * root_weight[rows, axis])
    free = layout.start[layout.start >= 0]
    normal[free, free] += 1.0 / START_MEMORY_SD**2
    held = layout.start >= 0
    gradient[layout.start[held]] -= state.start_memory[held] / START_MEMORY_SD**2
    # What is held stands in the spare place, where this does no harm.
    normal[layout.skew, layout.skew] += 1.0 / skew_sd**2
    gradient[layout.skew] -= state.skew / skew_sd**2
    return normal[:n, :n], gradient[:n]


def _solve(normal: Floats, gradient: Floats, damping: float) -> tuple[Floats, float]:
    """
    Solve the damped, column-scaled equations; also return the decrease they promise.

    """
    diagonal = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(diagonal, diagonal)
    scaled[np.diag_indices_from(scaled)] += damping + 1e-14
    right = gradient / diagonal
    try:
        solved = cho_solve(cho_factor(scaled, lower=True), right)
    except np.linalg.LinAlgError:
        # Two regressors that no data tells apart: the least-norm step moves neither far.
        solved = np.linalg.lstsq(scaled, right, rcond=1e-13)[0]
    return np.asarray(solved / diagonal), 0.5 * float(right @ solved)


def _moved(state: Solution, step: Floats, layout: Layout, freedom: Freedom) -> Solution:
    padded = np.append(step, 0.0)
    axis = padded[layout.axis]
    n_bias = state.bias.shape[1]
    up = state.up + np.einsum('pij,pj->pi', tangent_basis(state.up), padded[layout.up])
    lower, upper = freedom.time_constant_range_s
    # A factor of 2 per step is as far as the derivative can be trusted.
    change = np.clip(padded[layout.lags], -0.7, 0.7)
    slower = float(np.sum(padded[layout.transient_lag]))
    return replace(
        state,
        bias=state.bias + axis[:, :n_bias],
        scale=state.scale + axis[:, n_bias:],
        skew=state.skew + padded[layout.skew],
        up=up / np.linalg.norm(up, axis=1, keepdims=True),
        time_constants_s=np.clip(state.time_constants_s * np.exp(change), lower, upper),
        start_memory=state.start_memory + padded[layout.start],
        transient=state.transient + padded[layout.transient],
        transient_s=float(
            np.clip(state.transient_s * np.exp(np.clip(slower, -0.7, 0.7)), lower, upper)
        ),
    )
