# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bias and scale of both regimes over the board temperature, within and beyond their ranges.

n thermal states are the columns of an array; results have the rows bias x, y, z, scale x, y, z.
"""

import numpy as np

from ..thermal.state import BOARD, RATE, WEIGHT
from ..typing import Floats
from .calibration import Calibration
from .functions import TANGENT_SPANS, basis_slopes, hold


class Curves:
    """
    Bias and scale of the static set (row 0) and the dynamic set (row 1) over board temperature.

    At a temperature in the range of one set only, the curves of the other set run parallel to the
    curves of that set. Beyond both ranges the set whose range extends farther follows tangents for
    `TANGENT_SPANS` times the width of its range, then is constant; the other set runs parallel.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._reference = calibration.reference_temperature_c
        sets = calibration.regime_sets()
        edges = np.array([(part.temperature_range_c, part.rate_range_k_min) for part in sets])
        # Edges of the fitted ranges, (2, 2, 1): lower edges of both regimes, then upper edges.
        self._t_range = (edges[:, 0].T - self._reference)[:, :, np.newaxis]
        self._rate_range = (edges[:, 1].T / 60.0)[:, :, np.newaxis]
        self._functions = [
            [axis.bias_function for axis in axes] + [axis.scale_function for axis in axes]
            for axes in (part.axes() for part in sets)
        ]
        # Index of the set whose tangent each set follows: below both ranges, then above them.
        regimes, (lower, upper) = np.arange(2), self._t_range[:, :, 0]
        self._leads = np.where([lower > lower.min(), upper < upper.max()], 1 - regimes, regimes)
        self._ends = lower.min(), upper.max()
        self._tangents_k = TANGENT_SPANS * (upper - lower)[self._leads][:, :, np.newaxis]
        biases = [axis.bias for axis in calibration.axes]
        deltas = [[axis.delta for axis in part.axes()] for part in sets]
        self._levels = np.add(biases, deltas)[:, :, np.newaxis]
        residuals = [[axis.residual_sd_m_s2**2 for axis in part.axes()] for part in sets]
        self._residuals = np.array(residuals)[:, :, np.newaxis]
        # Lack of fit of each regime that has one: temperatures, then variances of three axes.
        lacks = (
            [(p.temperature_c, *np.square(p.sd_m_s2)) for p in part.lack_of_fit] for part in sets
        )
        self._lacks = {regime: np.array(rows).T for regime, rows in enumerate(lacks) if rows}

    def excess(self, states: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return excess of T_board [K] and rate [K/s] by set, and both / half ranges, (2, n)."""
        t, rate = states[BOARD] - self._reference, states[RATE]
        over, too_fast = t - hold(t, *self._t_range), rate - hold(rate, *self._rate_range)
        span, rate_span = (edges[1] - edges[0] for edges in (self._t_range, self._rate_range))
        return over, too_fast, np.abs(over) / (span / 2.0), np.abs(too_fast) / (rate_span / 2.0)

    def values(self, board: Floats) -> Floats:
        """Evaluate bias [input units] and relative scale of each regime and axis, (2, 6, n)."""
        t = board - self._reference
        held = hold(t, *self._t_range)
        result = self._evaluate(held)
        result[:, :3] += self._levels
        if (held != t).any():
            here, edge = (hold(at, *self._t_range[:, ::-1]) for at in (t, held))
            result += (self._evaluate(here[::-1]) - self._evaluate(edge[::-1]))[::-1]
            ends = zip(self._t_range, self._leads, self._beyond(t), strict=True)
            for end, leads, beyond in ends:
                result += self._evaluate(end, 'slope')[leads] * beyond[:, np.newaxis]
        return result

    def _evaluate(self, t: Floats, what: str = 'value') -> Floats:
        """Evaluate curves or slopes of regime k at row k of `t`, (2, n), T_board - T_ref [K]."""
        pairs = zip(self._functions, t, strict=True)
        return np.array([[getattr(function, what)(at) for function in row] for row, at in pairs])

    def _beyond(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the parts of t [K] below and above both ranges, up to the tangents' ends."""
        (lower, upper), (below, above) = self._ends, self._tangents_k
        return hold(t - lower, -below, 0.0), hold(t - upper, 0.0, above)

    def unexplained(self, board: Floats) -> Floats:
        """Return variance of residual plus lack of fit by regime and axis [m^2/s^4], (2, 3, n)."""
        return self._residuals + self.lack_of_fit(board)

    def lack_of_fit(self, board: Floats) -> Floats:
        """Return the variance of the lack of fit by regime and axis [m^2/s^4], (2, 3, n)."""
        result = np.zeros((2, 3, len(board)))
        for regime, (at, *variances) in self._lacks.items():
            result[regime] = [np.interp(board, at, variance) for variance in variances]
        return result

    def slopes(self, board: Floats) -> Floats:
        """Return slopes of bias and scale over T_board [per K] by regime, shape (2, 6, n)."""
        held = hold(board - self._reference, *self._t_range)
        return self._evaluate(held, 'slope')

    def regressors(self, states: Floats, phi: Floats) -> list[Floats]:
        """Return derivatives of bias and scale of each axis w.r.t. the parameters of a `Block`."""
        t, weight = states[BOARD] - self._reference, states[WEIGHT]
        held, shares = hold(t, *self._t_range), np.array([1.0 - weight, weight])
        is_outside = bool((held != t).any())
        result = []
        for place in range(6):
            derivatives = []
            for regime, row in enumerate(self._functions):
                basis = row[place].basis(held[regime])
                basis = shares[regime] * np.reshape(basis, (-1, len(t)))
                if is_outside:
                    basis += self._followed(regime, place, t, shares)
                derivatives += [shares[regime], *basis]
            result.append(np.array([*derivatives, *phi]))
        return result

    def _followed(self, regime: int, place: int, t: Floats, shares: Floats) -> Floats:
        """Return derivatives of extrapolated curves w.r.t. free coefficients, (n_free, n)."""
        # Outside its range a curve is a constant plus a tangent, or plus the other set's curve.
        function = self._functions[regime][place]
        own_range, other_range = self._t_range[:, regime], self._t_range[:, 1 - regime]
        bases = (function.basis(hold(at, *own_range)) for at in (t, hold(t, *other_range)))
        here, edge = (np.reshape(basis, (-1, len(t))) for basis in bases)
        result = shares[1 - regime] * (here - edge)
        ends = zip(own_range[:, 0].tolist(), self._leads, self._beyond(t), strict=True)
        for end, leads, beyond in ends:
            slopes = np.reshape(basis_slopes(function, end), (-1, 1))
            result += slopes * (shares * beyond)[leads == regime].sum(axis=0)
        return np.asarray(result)
