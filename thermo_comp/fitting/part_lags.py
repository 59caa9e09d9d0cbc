# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the search for the thermal lag of each axis.

The bias and the scale factor of an axis are functions of ``x = t - m``, the temperature of one
part of the unit less the reference temperature. t is the board temperature T less the reference
temperature, and the lag m = T - L(T + v G) is T less the temperature of the part. L is a low-pass
filter and G = T_case - T_board the gradient. The part follows a temperature T + v G between board
and case with a lag of one first-order stage or, if it is heated through another part, of two
stages in series. Without a case thermometer, the part may follow a temperature that leads T by
a time, the lead. The time constants, the share v of the gradient and the lead minimise the RMS
residual of a fit of a spline of the bias and a cubic of the scale factor over x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BSpline, CubicSpline
from scipy.linalg.lapack import dposv
from scipy.optimize import minimize, minimize_scalar

from ..thermal.lags import Lag
from ..typing import Floats
from ..unit.columns import Part
from .hyperparameters import undisturbed
from .initial_triad import (
    ConstantCalibration,
    position_means,
    thermometer_error_of,
    white_noise_of,
)
from .windows import ThermalWindows

# Ratio of each time constant of the columns to the next smaller time constant.
_TAU_RATIO = 2.0**0.5


class _Shape(NamedTuple):
    """
    The shape of the curves of bias and scale factor over x, the temperature of a part.

    n_nodes: largest number of nodes of the spline of the bias
    most_noise: largest ratio of the RMS residual to the noise at which noise explains the residual
    has_stress: whether bias and scale have terms in the lag m and in m x, due to thermal stress
    has_gradient: whether the bias also has a term in the gradient T_case - T_board
    """

    n_nodes: int
    most_noise: float
    has_stress: bool = False
    has_gradient: bool = False


# The search for shapes and lags ends at this ratio of the RMS residual to the noise, or below.
_EXPLAINED_RATIO = 1.1
# Shapes of curves over part temperature, in the order of trials. A spline of 4 nodes determines a
# lag best, but cannot describe a kink of the bias, so it must fit down to a low `most_noise`.
_SHAPES = (
    _Shape(4, _EXPLAINED_RATIO),
    _Shape(4, _EXPLAINED_RATIO, has_gradient=True),
    _Shape(60, 1.5),
    _Shape(60, 1.5, has_gradient=True, has_stress=True),
)


@dataclass(frozen=True)
class Parts:
    """
    The thermal lags of the axes of a unit.

    lags: the lag of each axis; 0 s if the axis follows the board without a lag
    undisturbed: factors (0 to 1) that reduce the weights of outlying windows, shape (n,)
    most_drift: left-out drift above which models without these lags are tried, too [m/s^2]
    """

    lags: tuple[Part, Part, Part]
    undisturbed: Floats
    most_drift: float


def find_parts(windows: ThermalWindows, start: ConstantCalibration) -> list[Parts]:
    """
    Find the lag of each axis, and reduce the weights of windows that deviate from the model.

    Returns [] if the model with one lag per axis does not explain the drift of all axes, or if the
    data determine no axis's time constant. If no shape of the curves reduces the residual to the
    noise, the second stage of a lag may only describe slow noise or a tilt of the support: lags of
    one stage that more than halve the RMS residual of each axis then come first in the result.
    """
    data, columns = windows.data, windows.model.columns
    if not windows.has_temperature or not any(column.group == 'board' for column in columns):
        return []
    noise = np.hypot(white_noise_of(data, start.scale), thermometer_error_of(data, start.scale))
    best, least_ratio = None, np.inf
    for shape in _SHAPES:
        if shape.has_gradient and not windows.gradient.any():
            continue
        # 500 windows are sufficient for the search of the lags, 3000 for their refinement.
        searched = _PartCurves(windows, start, shape, 500).lags(noise)
        if searched is None:
            continue
        subset = _PartCurves(windows, start, shape, 3000)
        lags = [subset.refined(lag, axis) for axis, lag in enumerate(searched)]
        parts, ratio = _PartCurves(windows, start, shape, len(data.time)).parts(lags, noise)
        # A residual above `most_noise` times the noise has a further cause, such as slow noise:
        # the lags are then accepted only if they reduce each axis's RMS residual to a quarter.
        is_explained = ratio <= shape.most_noise
        if not is_explained and min(map(subset.reduction, lags, range(3))) < 4.0:
            continue
        if ratio < least_ratio:
            best, least_ratio = parts, ratio
        if ratio <= _EXPLAINED_RATIO:
            break
    accepted = [] if best is None else [best]
    if least_ratio > _SHAPES[-1].most_noise:
        curves = _PartCurves(windows, start, _SHAPES[0], 500)
        lags = [curves.one_stage(axis) for axis in range(3)]
        if min(map(curves.reduction, lags, range(3))) > 2.0:
            full = _PartCurves(windows, start, _SHAPES[0], len(data.time))
            return [full.parts(lags, noise)[0], *accepted]
    return accepted


class _PartCurves:
    """
    Fits of bias and scale factor of an axis as functions of x, the temperature of its part, for
    a given lag. To save time, every k-th window is fitted: about `n_windows` windows.
    """

    def __init__(
        self, windows: ThermalWindows, start: ConstantCalibration, shape: _Shape, n_windows: int
    ) -> None:
        data, columns = windows.data, windows.model.columns
        rows = slice(None, None, max(len(data.time) // n_windows, 1))
        of_board = [k for k, column in enumerate(columns) if column.group == 'board']
        taus = np.array([columns[k].tau_s for k in of_board])
        _, self._first, self._position = np.unique(
            data.position[rows], return_index=True, return_inverse=True
        )
        self._age = data.age[rows, None]
        self._is_of_bag = data.bag[rows, None] == np.arange(data.bag[-1] + 1.0)
        self._weight = data.weight[rows]
        weight = self._weight[:, None]
        self._root_weight = np.sqrt(weight)
        self._share = weight / np.add.reduceat(weight, self._first)[self._position]
        self._case = windows.gradient[rows]
        self._t = windows.temperature[rows] - windows.model.reference_temperature
        #: Time constants to try [s]: four short times, then the time constants of group `board`.
        self._tried = np.array([15.0, 21.0, 30.0, 42.0, *taus])
        # The lag m is interpolated between the time constants tau of the columns: m / tau is a
        # smooth function of tau, whose limit at tau = 0 is the rate of the temperature.
        ratios = np.column_stack((windows.rate, windows.raw[:, of_board] / taus))[rows]
        knots = _interpolation_place(np.append(0.0, taus))
        self._ratio = CubicSpline(knots, ratios, axis=1)
        # The lag L_tau(G) of the gradient G is interpolated over tau; its limit at tau = 0 is G.
        of_case = [
            [c.group == 'gradient_lag' and c.tau_s == tau and c.sensor == 'case' for c in columns]
            for tau in taus
        ]
        self._has_case = bool(np.any(of_case, axis=1).all())
        if self._has_case:
            gradients = np.column_stack((windows.gradient, windows.raw @ np.transpose(of_case)))
            self._gradient = CubicSpline(knots, gradients[rows], axis=1)
        self._shape = shape
        force = (position_means(data) - start.bias) / start.scale
        self._force = force[data.position[rows]]
        self._measured = self._centred(data.mean[rows] / start.scale)

    def lags(self, noise: Floats) -> list[Part] | None:
        """
        Return the lag of each axis; None if a lag is useless or longer than the bags show, or if
        the data determine the lag of no axis. The lag of a single axis may be undetermined if its
        bias hardly depends on temperature, or if the lag is shorter than a window.
        """
        lags, is_determined = [], False
        longest_s = float(self._age.max()) / np.log(10.0)
        for axis in range(3):
            lag = self._lag(axis, noise[axis])
            if not self._is_useful(lag, axis, noise[axis]) or lag.tau_s > longest_s:
                return None
            is_determined = is_determined or self._is_determined(lag, axis)
            lags.append(lag)
        return lags if is_determined else None

    def _is_useful(
        self, lag: Part, axis: int, noise: float, most_noise: float = 3.0, reduction: float = 4.0
    ) -> bool:
        """Whether the residual with `lag` is near the noise, or far smaller than without a lag."""
        typical = 1.4826 * np.median(np.abs(self._weighted(lag, axis) / self._root_weight[:, 0]))
        return bool(typical <= most_noise * noise or self.reduction(lag, axis) >= reduction)

    def _lag(self, axis: int, noise: float) -> Part:
        """
        Return the lag with the smallest RMS residual; 0 s if no lag reduces the residual. If the
        residual exceeds the noise, a second stage of the lag, another share of the gradient and
        the combination of the two are tried; they must reduce the RMS residual by over 5 %.
        """
        one_stage = self.one_stage(axis)
        best = self._with_lead(one_stage, axis)
        enough = _EXPLAINED_RATIO**2 * noise**2 * len(self._t)
        if self._square(best, axis) > enough:
            starts = [one_stage]
            if self._has_case:
                # The residual has several minima: a larger share v of the gradient advances
                # T + v G in time, which a larger time constant nearly compensates.
                along = [self.one_stage(axis, share) for share in (0.3, 0.6, 0.9)]
                starts.append(min(along, key=lambda lag: self._square(lag, axis)))
            if not any(self._is_useful(near, axis, noise, 8.0, 1.5) for near in (best, *starts)):
                # The residual has another cause than a second stage or a share of the gradient.
                return best
            lags = [self._searched(axis, _in_two_stages(one_stage), (0.2, 0.4, 0.0, 0.0))]
            if best.lead_s:
                lags.append(self._searched(axis, _in_two_stages(best), (0.2, 0.4, 0.0, 0.1)))
            if self._has_case:
                for near in starts:
                    first = near._replace(tau_s=max(near.tau_s, 15.0))
                    lags.append(self._searched(axis, first, (0.2, 0.0, 0.1, 0.0)))
            best = self._better(axis, best, min(lags, key=lambda lag: self._square(lag, axis)))
        is_incomplete = self._is_useful(best, axis, noise) and self._square(best, axis) > enough
        if self._has_case and is_incomplete:
            first = best if best.second_tau_s else _in_two_stages(best)
            searched = self._searched(axis, first, (0.2, 0.4, 0.3, 0.0))
            best = self._better(axis, best, searched)
        return best

    def _with_lead(self, lag: Part, axis: int) -> Part:
        """
        Return `lag` plus a share of the gradient or, without a case thermometer, a positive lead
        time; or `lag` itself if the residual does not become significantly smaller.

        The residual is linearised w.r.t. the time constant and the share (or the lead). The sum of
        squares of the linearised residual must decrease by more than white noise explains with
        a probability of 1e-5.
        """
        tau = lag.tau_s
        if not tau:
            return lag
        key, unit = ('sensor_share', 1.0) if self._has_case else ('lead_s', tau)
        near = lag._replace(tau_s=1.03 * tau), lag._replace(**{key: 0.03 * unit})
        residual = self._weighted(lag, axis)
        slopes = np.column_stack([self._weighted(other, axis) - residual for other in near])
        steps = -np.linalg.lstsq(slopes, residual, rcond=None)[0]
        left = residual + slopes @ steps
        enough = float(np.exp(-20.0 / len(left)) * (residual @ residual))
        if left @ left > enough or (steps[1] <= 0.0 and not self._has_case):
            return lag
        longer, lead = 0.03 * np.clip(steps, -10.0, 20.0)
        first = lag._replace(tau_s=float(tau * (1.0 + longer)), **{key: float(lead * unit)})
        share_and_lead = (0.1, 0.0) if self._has_case else (0.0, 0.1)
        searched = self._searched(axis, first, (0.1, 0.0, *share_and_lead))
        return searched if self._square(searched, axis) <= enough else lag

    def refined(self, lag: Part, axis: int) -> Part:
        """Return the lag with the smallest RMS residual, by a search from `lag` in small steps."""
        if not lag.tau_s:
            return lag
        steps = np.where(lag, (0.03, 0.06, 0.02, 0.02), 0.0)
        return self._searched(axis, lag, steps, accuracy=1e-3)

    def _better(self, axis: int, simple: Part, other: Part) -> Part:
        """Return `simple`, unless the RMS residual of `other` is more than 5 % smaller."""
        is_better = self._square(other, axis) < self._square(simple, axis) / 1.05**2
        return other if is_better else simple

    def _searched(
        self, axis: int, first: Part, steps: Sequence[float] | Floats, accuracy: float = 0.01
    ) -> Part:
        """
        Search the lag with the smallest RMS residual by the simplex method, from the lag `first`.

        The variables are the logarithms of both time constants, the share of the gradient, and
        lead / first time constant. `steps`: first step in each variable, 0 to keep the variable
        constant; `accuracy`: half of the simplex's size in a variable at which the search ends
        """
        tau, second, share, lead = first
        start = np.array([np.log(tau), np.log(second or 1.0), share, lead / tau])
        free = np.flatnonzero(steps)

        def lag_at(values: Floats) -> Part:
            point = start.copy()
            point[free] = values
            taus = np.exp(point[:2]) * (1.0, bool(second))
            return _in_order(*taus.tolist(), *np.clip(point[2:], (-2.0, 0.0), 2.0).tolist())

        simplex = start[free] + np.vstack((np.zeros(len(free)), np.diag(np.array(steps)[free])))
        options: Any = {
            'xatol': 2.0 * accuracy, 'fatol': 0.1 * accuracy, 'maxfev': 150,
            'initial_simplex': simplex,
        }  # fmt: skip

        def log_square(values: Floats) -> float:
            return float(np.log(self._square(lag_at(values), axis)))

        return lag_at(minimize(log_square, simplex[0], method='Nelder-Mead', options=options).x)

    def one_stage(self, axis: int, sensor_share: float = 0.0) -> Part:
        """Return the lag of one stage with the smallest RMS residual, which may be 0 s."""

        def square(tau_s: float) -> float:
            return self._square(Part(tau_s, 0.0, sensor_share if tau_s else 0.0), axis)

        best = min(self._tried.tolist(), key=square)
        minimum = minimize_scalar(
            lambda log_tau: float(np.log(square(float(np.exp(log_tau))))),
            bounds=(float(np.log(best / _TAU_RATIO)), float(np.log(best * _TAU_RATIO))),
            method='bounded',
            options={'xatol': 1e-3},
        )
        tau = float(np.exp(minimum.x))
        return Part(tau, 0.0, sensor_share) if square(tau) < square(0.0) else Part(0.0)

    def _is_determined(self, lag: Part, axis: int) -> bool:
        """
        Whether other time constants increase the RMS residual by over 5 %: `_TAU_RATIO` times
        longer and shorter time constants; for a lag of 0 s, a lag of 21 s.
        """
        tau, second, share, lead = lag
        others = [
            Part(ratio * tau, ratio * second, share, ratio * lead)
            for ratio in (1.0 / _TAU_RATIO, _TAU_RATIO)
        ]
        if not tau:
            others = [Part(float(self._tried[0]) * _TAU_RATIO)]
        limit = 1.05**2 * self._square(lag, axis)
        return all(self._square(other, axis) > limit for other in others)

    def reduction(self, lag: Part, axis: int) -> float:
        """Return RMS residual of an axis without a lag / RMS residual of the axis with `lag`."""
        return float(np.sqrt(self._square(Part(0.0), axis) / self._square(lag, axis)))

    def parts(self, lags: Sequence[Part], noise: Floats) -> tuple[Parts, float]:
        """Return `Parts` with the given lags, and the largest ratio of RMS residual to noise."""
        weighted = np.column_stack([self._weighted(lag, axis) for axis, lag in enumerate(lags)])
        residual = weighted / self._root_weight
        factors = undisturbed(residual, self._weight, self._position)
        square = np.average(residual**2, axis=0, weights=self._weight * factors)
        # Unknowns of an axis: the coefficient of each regressor, and one constant per position.
        n_unknowns = self._series(lags[0], 0).shape[1] + len(self._first)
        square /= max(1.0 - n_unknowns / len(residual), 0.05)
        ratio = float(np.sqrt((square / noise**2).max()))
        x, y, z = (Part(*map(round, lag, (1, 1, 4, 1))) for lag in lags)
        # Curves that fit all data well may extrapolate badly to left-out data. If the left-out
        # drift exceeds `most_drift`, other models are tried: at 2 sd of the noise, or at 10 sd if
        # noise explains the residual of a shape without stress.
        is_complete = ratio <= self._shape.most_noise and not self._shape.has_stress
        most_drift = (10.0 if is_complete else 2.0) * float(noise.mean())
        return Parts((x, y, z), factors, most_drift), ratio

    def _square(self, lag: Part, axis: int) -> float:
        left = self._weighted(lag, axis)
        return max(float(left @ left), 1e-30)

    def _weighted(self, lag: Part, axis: int) -> Floats:
        """Return an axis's residuals times the square roots of the windows' weights, (n,)."""
        series, measured = self._series(lag, axis), self._measured[:, axis]
        normal, right = series.T @ series, series.T @ measured
        # Regressors are divided by their norms, because their magnitudes differ.
        size = np.sqrt(np.diag(normal)) + 1e-12
        normal = normal / np.outer(size, size)
        normal[np.diag_indices_from(normal)] += 1e-7  # a ridge, for nearly collinear regressors
        return np.asarray(measured - series @ (dposv(normal, right / size)[1] / size))

    def _series(self, lag: Part, axis: int) -> Floats:
        """Return the weighted regressors of bias, scale and initial lag states, shape (n, k)."""
        x: Floats = self._t.copy()
        if lag.tau_s:
            tau, second, of_case, lead = lag
            shares = Lag('board', tau, second, lead_s=lead).shares
            for tau_s, share in zip((tau, second), shares, strict=True):
                at = _interpolation_place(np.asarray(tau_s))
                x -= share * tau_s * self._ratio(at)
                if of_case:
                    x += of_case * share * self._gradient(at)
        low, high = float(x.min()), float(x.max())
        span = (high - low) or 1.0
        # A spline of the bias with more than 4 nodes has nodes at least 0.6 K apart.
        n_nodes = min(max(int(span / 0.6), 4), self._shape.n_nodes)
        nodes = np.linspace(low, low + span, n_nodes)
        knots = np.concatenate((nodes[[0] * 3], nodes, nodes[[-1] * 3]))
        spline = BSpline.construct_fast(knots, np.eye(n_nodes + 2), 3)
        bias = [spline(np.minimum(x, nodes[-1]))]
        u = (x / span)[:, None]
        scale = [u, u * u, u * u * u]
        if self._shape.has_stress:
            m = (self._t - x)[:, None]
            bias, scale = [*bias, m, m * u], [*scale, m, m * u]
        if self._shape.has_gradient:
            bias.append(self._case[:, None])
        of_scale = self._force[:, [axis]] * np.hstack(scale)
        # The effect of the unknown lag of the part at the start of a bag decays with tau.
        begin = self._is_of_bag * np.exp(-self._age / max(lag.tau_s, 1.0))
        return self._centred(np.hstack((*bias, of_scale, begin)))

    def _centred(self, values: Floats) -> Floats:
        """Subtract each position's weighted mean from series; multiply by root weights, (n, k)."""
        level = np.add.reduceat(values * self._share, self._first)
        return np.asarray((values - level[self._position]) * self._root_weight)


def _in_two_stages(lag: Part) -> Part:
    """Split a lag of one stage into two stages, as the start of a search."""
    # Two stages fit almost as well as one stage with the sum of their time constants.
    tau, _, share, lead = lag
    return Part(0.8 * tau + 1.0, 0.2 * tau + 1.0, share, lead)


def _in_order(tau_s: float, second_tau_s: float, sensor_share: float, lead_share: float) -> Part:
    """Return a lag with the longer time constant first; `lead_share`: ratio of lead to `tau_s`."""
    # `Part` accepts ratios of its two time constants up to 0.9, after rounding to 0.1 s.
    longer, shorter = max(tau_s, second_tau_s), min(tau_s, second_tau_s)
    return Part(longer, min(shorter, 0.89 * longer), sensor_share, lead_share * tau_s)


def _interpolation_place(tau_s: Floats) -> Floats:
    """Map time constants [s] to an interpolation's abscissa in [0, 1): 200 s are mapped to 0.5."""
    return np.asarray(tau_s / (tau_s + 200.0))
