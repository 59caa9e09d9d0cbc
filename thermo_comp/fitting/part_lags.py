# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the search for the thermal lag of each axis.

The bias and the scale factor of an axis are modelled as functions of ``x = t - m``, the
temperature of one part of the unit: t is the board temperature less the reference temperature, and
m = T - L(T) the difference between the board temperature T and its lag. The lag has one stage or,
where a part hangs on another part, two stages in series. The time constants minimise the RMS
residual of a spline of the bias and a cubic of the scale factor, both over x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, CubicSpline
from scipy.optimize import minimize, minimize_scalar

from ..thermal.memory import Lag
from ..typing import Floats
from ..unit.columns import Stages
from .hyperparameters import undisturbed
from .start import ConstantCalibration, position_means, white_noise_of
from .windows import ThermalWindows

# Ratio of a time constant of the columns to the next smaller one: half an octave.
_STEP = 2.0**0.5


@dataclass(frozen=True)
class Parts:
    """
    The thermal lags of the axes of a unit.

    stages: the time constants of each axis; 0 if the axis follows the board without a lag
    undisturbed: factors, up to 1, that reduce the weights of outlying windows, shape (n,)
    noise: mean over the axes of the windows' white noise [m/s^2]
    """

    stages: tuple[Stages, Stages, Stages]
    undisturbed: Floats
    noise: float


def find_parts(windows: ThermalWindows, start: ConstantCalibration) -> Parts | None:
    """
    Find the lag of each axis, and reduce the weights of windows that do not fit it.

    Returns None if the model with one lag per axis does not explain the drift of all axes, or if
    the data do not determine a time constant.
    """
    data, columns = windows.data, windows.model.columns
    of_board = [k for k, column in enumerate(columns) if column.group == 'board']
    if not of_board or not windows.has_temperature:
        return None
    noise = white_noise_of(data, start.scale)
    accepted = None
    for has_stress in (False, True):
        curves = _PartCurves(windows, start, of_board, has_stress=has_stress)
        lags = [curves.stages(axis, noise[axis]) for axis in range(3)]
        if not all(curves.is_determined(lag, axis) for axis, lag in enumerate(lags)):
            continue
        residual = np.column_stack([curves.residual(lag, axis) for axis, lag in enumerate(lags)])
        factors = undisturbed(residual, data.weight, data.position)
        square = np.average(residual**2, axis=0, weights=data.weight * factors)
        x, y, z = ((round(tau, 1), round(second, 1)) for tau, second in lags)
        parts = Parts((x, y, z), factors, float(noise.mean()))
        # An RMS residual of up to 1.5 times the white noise is attributed to noise.
        if (square <= (1.5 * noise) ** 2).all():
            return parts
        # A larger residual has another cause, e.g. slow noise: the lags are then accepted only if
        # they reduce the RMS residual of each axis to an eighth or less of that without a lag.
        if accepted is None and min(map(curves.reduction, lags, range(3))) >= 8.0:
            accepted = parts
    return accepted


class _PartCurves:
    """
    Bias and scale factor of each axis as functions of x (see the module), for any time constants.

    `columns`: indices of the columns of group `board`, the lags of the board temperature
    `has_stress`: whether both also depend on m, by a coefficient that is linear in x: the stress
        between a part and the board
    """

    def __init__(
        self,
        windows: ThermalWindows,
        start: ConstantCalibration,
        columns: list[int],
        *,
        has_stress: bool,
    ) -> None:
        data = windows.data
        self._position, self._bag = data.position, data.bag
        self._weight = data.weight[:, None]
        self._first = data.edges[:-1]
        self._t = windows.temperature - windows.model.reference_temperature
        self._taus = np.array([windows.model.columns[k].tau_s for k in columns])
        #: Time constants tried [s]: those of the columns, and shorter ones.
        self._tried = np.array([15.0, 21.0, 30.0, 42.0, *self._taus])
        # The lag m at a time constant tau between those of the columns is interpolated: m / tau
        # is a smooth function of tau, whose limit at tau = 0 is the rate of the temperature.
        ratios = np.column_stack((windows.rate, windows.raw[:, columns] / self._taus))
        self._ratio = CubicSpline(_even(np.append(0.0, self._taus)), ratios, axis=1)
        self._age, self._has_stress = data.age, has_stress
        force = (position_means(data) - start.bias) / start.scale
        self._force = force[data.position]
        self._measured = self._centred(data.mean / start.scale)
        # Every k-th window: 3000 to 6000 of them are sufficient to find a time constant.
        self._some = slice(None, None, max(len(data.time) // 3000, 1))

    def stages(self, axis: int, noise: float) -> Stages:
        """
        Return the time constants with the smallest RMS residual; 0 if none reduces it.

        A second stage must reduce a residual above the white noise (`noise`) by 5 %.
        """
        tau = self._time_constant(axis)
        single = self._square((tau, 0.0), axis)
        if single <= 1.1**2 * noise**2 * len(self._t[self._some]):
            return tau, 0.0

        def log_square(logs: Floats) -> float:
            return float(np.log(self._square(_in_order(*np.exp(logs)), axis)))

        # The residual has a valley along a constant sum of both time constants.
        first = np.log([0.8 * tau + 1.0, 0.2 * tau + 1.0])
        options: Any = {'xatol': 2e-3, 'fatol': 1e-4, 'maxfev': 150}
        both = _in_order(
            *np.exp(minimize(log_square, first, method='Nelder-Mead', options=options).x)
        )
        return both if self._square(both, axis) < single / 1.05**2 else (tau, 0.0)

    def _time_constant(self, axis: int) -> float:
        """Return the single time constant with the smallest RMS residual [s]; 0 for none."""
        squares = [self._square((tau, 0.0), axis) for tau in self._tried]
        best = float(self._tried[int(np.argmin(squares))])
        minimum = minimize_scalar(
            lambda log_tau: float(np.log(self._square((float(np.exp(log_tau)), 0.0), axis))),
            bounds=(float(np.log(best / _STEP)), float(np.log(best * _STEP))),
            method='bounded',
            options={'xatol': 1e-3},
        )
        tau = float(np.exp(minimum.x))
        return tau if self._square((tau, 0.0), axis) < self._square((0.0, 0.0), axis) else 0.0

    def is_determined(self, lag: Stages, axis: int) -> bool:
        """Whether time constants larger, or smaller, by `_STEP` add 5 % to the RMS residual."""
        tau, second = lag
        others = [(ratio * tau, ratio * second) for ratio in (1.0 / _STEP, _STEP)]
        if not tau:
            others = [(float(self._tried[0]) * _STEP, 0.0)]
        limit = 1.05**2 * self._square(lag, axis)
        return all(self._square(other, axis) > limit for other in others)

    def reduction(self, lag: Stages, axis: int) -> float:
        """Return the ratio of the RMS residual of an axis without a lag to that with `lag`."""
        return float(np.sqrt(self._square((0.0, 0.0), axis) / self._square(lag, axis)))

    def residual(self, lag: Stages, axis: int) -> Floats:
        """Return the residuals of one axis in all windows, shape (n,) [m/s^2]."""
        series = self._series(lag, axis)
        left = self._measured[:, axis] - series @ _solved(series, self._measured[:, axis])
        return np.asarray(left / np.sqrt(self._weight[:, 0]))

    def _square(self, lag: Stages, axis: int) -> float:
        """Return the weighted sum of squared residuals of an axis over every k-th window."""
        series = self._series(lag, axis)[self._some]
        measured = self._measured[self._some, axis]
        left = measured - series @ _solved(series, measured)
        return max(float(left @ left), 1e-30)

    def _series(self, lag: Stages, axis: int) -> Floats:
        """Return the weighted regressors of bias, scale factor and initial lags, shape (n, k)."""
        x: Floats = self._t.copy()
        if lag[0]:
            for tau_s, share in zip(lag, Lag('board', *lag).shares, strict=True):
                x -= share * tau_s * self._ratio(_even(np.asarray(tau_s)))
        low, high = float(x.min()), float(x.max())
        span = (high - low) or 1.0
        # The spline of the bias has a node every 0.6 K, but at least 4 and at most 60 nodes.
        n_nodes = int(np.clip(span / 0.6, 4, 60))
        inner = np.linspace(low, low + span, n_nodes)
        knots = np.pad(inner, 3, mode='edge')
        bias = BSpline.design_matrix(np.clip(x, low, low + span), knots, 3).toarray()
        rows = np.arange(len(x))
        u = (x / span)[:, None]
        stress = (self._t - x)[:, None] * u ** np.arange(2.0 * self._has_stress)
        scale = self._force[:, [axis]] * np.hstack((u ** np.arange(1, 4), stress))
        # The lag of the part at the start of each bag is unknown and decays.
        begin = np.zeros((len(x), int(self._bag[-1]) + 1))
        begin[rows, self._bag] = np.exp(-self._age / max(lag[0], 1.0))
        return self._centred(np.hstack((bias, stress, scale, begin)))

    def _centred(self, values: Floats) -> Floats:
        """Subtract the weighted mean over each position; multiply by the root of the weight."""
        every = np.hstack((values, np.ones_like(self._weight))) * self._weight
        sums = np.add.reduceat(every, self._first, axis=0)
        level = sums[:, :-1] / sums[:, -1:]
        return np.asarray((values - level[self._position]) * np.sqrt(self._weight))


def _in_order(tau_s: float, second_tau_s: float) -> Stages:
    """Return two time constants, the longer first, the shorter at most 0.89 of the longer."""
    # Columns accept ratios up to 0.9; both time constants are rounded to 0.1 s before.
    longer, shorter = max(tau_s, second_tau_s), min(tau_s, second_tau_s)
    return float(longer), float(min(shorter, 0.89 * longer))


def _even(tau_s: Floats) -> Floats:
    """Map time constants [s] to 0 .. 1, for the interpolation; 200 s become 0.5."""
    return np.asarray(tau_s / (tau_s + 200.0))


def _solved(series: Floats, measured: Floats) -> Floats:
    """Return the least-squares coefficients of regressors of any magnitude."""
    normal, right = series.T @ series, series.T @ measured
    size = np.sqrt(np.diag(normal)) + 1e-12
    normal = normal / np.outer(size, size)
    normal[np.diag_indices_from(normal)] += 1e-7  # ridge, for nearly collinear regressors
    return np.asarray(np.linalg.solve(normal, right / size) / size)
