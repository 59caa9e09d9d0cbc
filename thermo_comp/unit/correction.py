# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of the correction: bias, scale and error variances from thermal states.

n thermal states are the columns of an array of shape (width, n), whose rows are in the order of
`thermal.state`. Sums run in a fixed order, and the result of a state does not depend on the other
states, so a stream and a batch get the same bits. Results for three axes stand in rows: the bias
of x, y, z, then the scale of x, y, z. An axis with the specific force x, before the misalignment
is corrected, has the error variance ``v(x) = a + b x + c x^2`` [m^2/s^4]. The module `covariance`
adds misalignment errors and covariances between axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..thermal.lags import BOARD_INPUT, Lag, MemorySpec
from ..thermal.state import BOARD, UNKNOWN, VAR_BOARD, WEIGHT, StateLayout
from ..typing import Floats
from .calibration import Calibration
from .columns import ColumnTable, memory_of
from .covariance import CONSTANTS, N_ROWS, OF_MISALIGNMENT, CovarianceMap, grown
from .curves import Curves
from .functions import hold, in_order
from .gravity import MICRO_G
from .nonlinearity import ForceCorrection, beyond_force

#: Largest rate of change of the force in a transition between regimes [m/s^3]: 1 ug per second. A
#: faster transition is made longer, at most `LONGEST_TRANSITION` times.
GENTLE_RATE = MICRO_G
LONGEST_TRANSITION = 10.0
#: Number of board temperatures for which slopes, and the difference of the sets, are evaluated.
_GAP_TEMPERATURES = 33
#: Rounding variance [counts^2]: 2/12, as the converter adds the remainder to the next cycle.
ROUNDING_VARIANCE = 1.0 / 6.0
#: Smallest noise variance of a sample / largest variance of any axis. This minimum keeps the
#: covariance positive definite in spite of rounding, and is far below the noise of any instrument.
_LEAST_SHARE = 1e-13
#: Largest number in a usable result of `Correction.line`: corrected samples then do not overflow.
_LARGEST = 1e140
#: Indices of the variances of the axes at zero force in a result of `Correction.line`.
VARIANCES = tuple(12 + place for place in CONSTANTS)
#: Indices of the variances of the relative scale of the axes in a result of `Correction.line`: the
#: coefficients of x^2 in xx, y^2 in yy, z^2 in zz.
SCALE_VARIANCES = tuple(place + last for place, last in zip(VARIANCES, (2, 5, 9), strict=True))
#: Number of thermal states above which a loop over the columns is faster than a sum over an array
#: of all products.
_FEW = 64
#: Largest number of thermal states evaluated at once, to bound the memory.
_CHUNK = 2048


class Excess(NamedTuple):
    """How far a thermal state lies outside the calibrated ranges; 0 inside."""

    temperature: float  # board temperature less the nearest edge of the regime's range [K]
    rate: float  # rate of the board temperature less the nearest edge of the regime's range [K/s]
    gradient: float  # gradient less the nearest edge of its range, of the worst gradient [K]
    relative: float  # sum of three excesses, each / half range: temperature, rate, worst column


class Correction:
    """
    Evaluates bias, scale and error variances of a calibration at thermal states.

    memory: lags, plays and rates in the thermal states; default: those of the unit's columns
    noise: noise variance of one sample per axis, including rounding of counts [m^2/s^4]
    noise_trace: the sum of `noise`
    misalignment: elements yx, zx, zy of the misalignment matrix M
    beyond: additional variance at forces above the largest |f| of the fit
    """

    def __init__(self, calibration: Calibration, memory: MemorySpec | None = None) -> None:
        self.curves = Curves(calibration)
        edges = [edge for part in calibration.regime_sets() for edge in part.temperature_range_c]
        self._span = min(edges), max(edges)
        K = [axis.scale_factor for axis in calibration.axes]
        self.K = np.array(K)[:, np.newaxis]
        self._full_scale = calibration.unit.full_scale
        self._gravity = calibration.gravity_m_s2
        response, reference = calibration.response, calibration.reference_temperature_c
        self.memory = memory or memory_of_unit(calibration)
        self.table = ColumnTable(response, self.memory, reference, self._span)
        weights = np.array([(*term.bias, *term.scale) for term in response])
        self._W = weights.reshape(-1, 6).T[:, :, np.newaxis]
        self._is_present = (self._W[:3] != 0.0) | (self._W[3:] != 0.0)
        self._find_columns_of_pairs()
        settled = np.zeros((self.layout.width, _GAP_TEMPERATURES))
        settled[BOARD] = np.linspace(*self._span, _GAP_TEMPERATURES)
        slopes, (_, of_bends) = self.curves.slopes(settled[BOARD]), self.table.slopes(settled)
        if of_bends is not None:
            slopes += self._weigh(of_bends, np.zeros(slopes.shape[1:]))
        # Sd, over the calibrated temperatures, of the slopes of both sets: of bias, then of scale.
        of_bias = np.arange(6)[:, np.newaxis] < 3
        sds = slopes.std(axis=2, keepdims=True)
        self._slope_sds = np.concatenate((sds * of_bias, sds * ~of_bias))
        rounding = ROUNDING_VARIANCE if calibration.unit.input == 'counts' else 0.0
        cycle_s, densities = calibration.unit.cycle_time_s, calibration.noise_density_m_s2_sqrt_hz
        pairs = zip(densities, K, strict=True)
        self.noise = tuple(d * d / cycle_s + rounding / (k * k) for d, k in pairs)
        self.noise_trace = sum(self.noise, 0.0)
        self._noise = np.array(self.noise)[:, np.newaxis]
        M = calibration.misalignment
        self.misalignment: tuple[float, ...] = (M[1][0], M[2][0], M[2][1])
        self._covariance = CovarianceMap(self.misalignment)
        self.beyond = beyond_force(calibration)
        #: The nonlinearity over specific force, or None if the calibration has none.
        self.of_force: ForceCorrection | None = None
        if calibration.nonlinearity is not None:
            self.of_force = ForceCorrection(calibration, calibration.nonlinearity, self._span)
        #: Number of rows that `SlowUncertainty.at` returns, a covariance of slowly varying errors.
        self.n_slow = N_ROWS if self.of_force is None else N_ROWS + 15

    def _find_columns_of_pairs(self) -> None:
        """Find the columns that depend on each quantity with a variance in the thermal state."""
        self.layout = layout = StateLayout(self.memory)
        pair = np.array([layout.pairs.get(c.source, -1) for c in self.table.columns], np.int64)
        columns = np.argsort(pair, kind='stable')
        self._pair_columns = columns[pair[columns] >= 0]
        self._pairs, self._pair_starts = np.unique(pair[self._pair_columns], return_index=True)
        by_board = np.array([quantity.by_board for quantity in layout.pairs])
        self._signs = by_board[:, np.newaxis, np.newaxis]
        self._has_lags = any(isinstance(column.source, Lag) for column in self.table.columns)
        self._lagged = [layout.places[lag] for lag in layout.lags if lag.input == BOARD_INPUT]

    def bias_scale(self, states: Floats) -> Floats:
        """Evaluate bias and scale of the three axes, shape (2, 3, n)."""
        sets, phi = self.curves.values(states[BOARD]), self.table.values(states)
        return self._blended(sets, states[WEIGHT], phi).reshape(2, 3, -1)

    def _blended(self, sets: Floats, weight: Floats, phi: Floats) -> Floats:
        result = self._weigh(phi, (1.0 - weight) * sets[0] + weight * sets[1])
        # Scale factor = K times relative scale, Eq. (8) of docs/theory.md.
        result[3:] *= self.K
        return result

    def _weigh(self, columns: Floats, start: Floats) -> Floats:
        """Add ``W @ columns`` (W: weights) to `start`, shape (6, n), column by column."""
        if columns.shape[1] > _FEW:
            total: Floats = start.copy()
            for weights, column in zip(self._W.swapaxes(0, 1), columns, strict=True):
                total += weights * column
            return total
        return in_order(np.concatenate((start[:, np.newaxis], self._W * columns), axis=1), 1)

    def gentle_transition(self, given_s: float) -> float:
        """Return the time of a transition [s], up to 10 times `given_s`, to keep `GENTLE_RATE`."""
        board = np.linspace(*self._span, _GAP_TEMPERATURES)
        gap = np.diff(self.curves.values(board), axis=0)[0]
        scale = np.abs(gap[3:]).max(axis=0)
        bias = np.sqrt(((gap[:3] / self.K) ** 2).sum(axis=0))
        largest = float((bias + self._gravity * scale).max())
        return min(max(given_s, largest / GENTLE_RATE), LONGEST_TRANSITION * given_s)

    def excess(self, state: Sequence[float], *, is_dynamic: bool) -> Excess:
        """Return how far a thermal state is outside the calibrated ranges."""
        states = np.array(state)[:, np.newaxis]
        rows = self.curves.excess(states)
        over, too_fast, relative, by_rate = (row[:, 0].tolist() for row in rows)
        shares = 1.0 - state[WEIGHT], state[WEIGHT]
        curves = sum(w * (a + b) for w, a, b in zip(shares, relative, by_rate, strict=True))
        raw = self.table.raw(states)
        beyond = self.table.beyond(raw)[:, 0].tolist()
        columns = zip(beyond, self.table.columns, strict=True)
        gradients = [0.0, *(excess for excess, column in columns if column.is_gradient)]
        of_columns = float(self.table.excess(raw).max(initial=0.0))
        gradient = max(gradients, key=abs)
        return Excess(over[is_dynamic], too_fast[is_dynamic], gradient, curves + of_columns)

    def by_pairs(self, slopes: Floats) -> Floats:
        """
        Return derivatives of bias and relative scale w.r.t. the quantities of `StateLayout.pairs`,
        (p, 6, n); `slopes`: derivative of each column w.r.t. its quantity, (n_columns, n).
        """
        columns = self._pair_columns
        result = np.zeros((len(self._signs), 6, slopes.shape[1]))
        if len(columns):
            each = self._W[:, columns] * slopes[columns]
            result[self._pairs] = np.add.reduceat(each, self._pair_starts, axis=1).swapaxes(0, 1)
        return result

    def line(
        self,
        start: npt.ArrayLike,
        end: npt.ArrayLike,
        slow: npt.ArrayLike,
        noise_excess: npt.ArrayLike,
    ) -> Floats:
        """
        Evaluate the correction in segments, linear in time between the states `start` and `end`.

        `slow`: slowly varying error covariance, (n_slow, n), see `SlowUncertainty.at`;
        `noise_excess`: relative increase of a sample's noise variance. The result, (52,) or
        (52, n), has for each axis the bias, the change of the bias over the segment, the scale and
        its change; then the coefficients for `covariance.covariance_at`, with a sample's noise. If
        the unit has a nonlinearity, `slow` has 15 more rows, and the result ends with K2, Kq, K3
        of each axis and the coefficients of x^3 to x^6 in the variance of each axis.
        """
        ends = np.array((start, end), dtype=np.float64)
        n = ends[0, 0].size
        if n > _CHUNK:
            columns = (*ends, np.asarray(slow), np.broadcast_to(noise_excess, n))
            cuts = range(_CHUNK, n, _CHUNK)
            parts = zip(*(np.split(column, cuts, axis=-1) for column in columns), strict=True)
            return np.hstack([self.line(*part) for part in parts])
        states = np.concatenate(ends.reshape(2, -1, n), axis=1)
        board = states[BOARD]
        sets = self.curves.values(board)
        raw = self.table.raw(states)
        factors = self.table.factors(board, states[WEIGHT])
        held = self.table.held(raw)
        phi = held * factors[0]
        both = self._blended(sets, states[WEIGHT], phi).reshape(2, 3, 2, n)
        both[:, :, 1] -= both[:, :, 0]
        factors_at_end = factors[0][:, n:], factors[1][:, n:]
        gap = (sets[1] - sets[0])[:, n:]
        slow = np.reshape(slow, (self.n_slow, n))
        v, growth = self._variance(
            states[:, n:], raw[:, n:], held[:, n:], factors_at_end, gap, slow[:9].reshape(3, 3, n)
        )
        between = grown(slow[9:N_ROWS], growth)
        # The error variance at the largest force that each axis can measure [m/s^2].
        largest_force = (self._full_scale + np.abs(both[0, :, 0])) / np.abs(both[1, :, 0])
        tilts = between[OF_MISALIGNMENT].max(axis=0)
        variance = v[:, 0] + largest_force * (np.abs(v[:, 1]) + largest_force * (v[:, 2] + tilts))
        smallest = _LEAST_SHARE * variance.max(axis=0)
        v[:, 0] += np.maximum(self._noise * (1.0 + np.asarray(noise_excess)), smallest)
        beyond = np.empty((0, n))
        if self.of_force is not None:
            v[:, 2] += slow[N_ROWS::5]
            middle = 0.5 * (board[:n] + board[n:])
            beyond = self.of_force.rows(middle, slow[N_ROWS:])
        covariance = self._covariance.coefficients(np.concatenate((v.reshape(9, n), between)))
        line = np.concatenate((both.swapaxes(0, 1).reshape(12, n), covariance, beyond))
        return line.reshape(-1, *ends.shape[2:])

    def _variance(
        self,
        states: Floats,
        raw: Floats,
        held: Floats,
        factors: tuple[Floats, Floats],
        gap: Floats,
        slow: Floats,
    ) -> tuple[Floats, Floats]:
        """
        Evaluate a, b, c of each axis' error variance ``a + b x + c x^2``, (3, 3, n), without
        sample noise, and the growth factor (3, n) of the variance outside the calibrated ranges.

        `gap`, the dynamic less the static set, is added as an error while the sets are blended,
        outside the calibrated ranges, and while the regime is unknown. In an unknown regime the
        variances due to T_board, residual and lack of fit are sums over both sets.
        """
        board, weight, unknown = states[BOARD], states[WEIGHT], states[UNKNOWN]
        static_weight, beyond_range = 1.0 - weight, self.table.beyond(raw)
        excess, _, relative, by_rate = self.curves.excess(states)
        if not self._has_lags:
            # Lags describe the effect of the rate: add the excess rate of a unit without lags.
            relative = relative + by_rate
        outside = static_weight * relative[0] + weight * relative[1]
        shares = np.array([static_weight + unknown * weight, weight + unknown * static_weight])
        variances = (shares * states[VAR_BOARD], states[self.layout.variances])
        by_source, direct = self.table.slopes(states)
        by_pair = self.by_pairs(by_source * factors[0])
        # Columns depend on T_board through t^power, gradients (T_s - T_board) and lags.
        on_board = raw * factors[1]
        if direct is not None:
            on_board = on_board + direct * factors[0]
        on_board = self._weigh(on_board, in_order(self._signs * by_pair, 0))
        slopes = self.curves.slopes(board)
        v = self._spread(np.concatenate(variances), np.concatenate((slopes + on_board, by_pair)))
        v[:, 0] += (shares[:, np.newaxis] * self.curves.unexplained(board)).sum(axis=0)
        v += slow
        growth = np.ones((3, len(board)))
        is_beyond = bool(beyond_range.any())
        # A part that lags the board may return into the calibrated range later than the board.
        parts = np.concatenate((board[np.newaxis], board - states[self._lagged]))
        parts_out = np.abs(parts - hold(parts, *self._span)).max(axis=0)
        if is_beyond or outside.any() or parts_out.any():
            columns_out = np.where(self._is_present, self.table.excess(raw), 0.0)
            columns_out = columns_out.max(axis=1, initial=0.0)
            # Outside the calibrated range the curves are extrapolated with two errors. The first
            # is the slope of the curves at the edge of the range times the board's distance from
            # the edge, the second is the sd of the slopes in the range times the largest distance
            # of board or part from the range.
            v += self._spread(shares * excess * excess, slopes)
            squares = shares * np.maximum(excess * excess, parts_out * parts_out)
            slope_sds = np.broadcast_to(self._slope_sds, (4, *slopes.shape[1:]))
            v += self._spread(np.concatenate((squares, squares)), slope_sds)
            # The posterior is valid within the calibrated ranges: increase the variance outside.
            growth = 1.0 + (outside + columns_out) ** 2
            v *= growth[:, np.newaxis]
        of_gap = unknown + weight * static_weight + outside * outside
        if not (is_beyond or of_gap.any()):
            return v, growth
        if self.table.differs:
            both = (np.full_like(weight, w) for w in (0.0, 1.0))
            of_static, of_dynamic = (self.table.factors(board, w)[0] for w in both)
            gap = self._weigh(held * (of_dynamic - of_static), gap)
        # The limits of a column's range cut off a part of its effect, which is taken as an error.
        cut_off = self._weigh(beyond_range * factors[0], np.zeros_like(gap))
        variances_of_both = np.array([of_gap, np.ones_like(of_gap)])
        return v + self._spread(variances_of_both, np.array([gap, cut_off])), growth

    def _spread(self, variances: Floats, effects: Floats) -> Floats:
        """
        Return a, b, c of each axis' variance ``a + b x + c x^2``, (3, 3, n), due to p independent
        errors of `variances`, (p, n); `effects`, (p, 6, n): bias, relative scale per unit error.
        """
        variance, bias, scale = variances[:, np.newaxis], effects[:, :3] / self.K, effects[:, 3:]
        parts = np.empty((*bias.shape[:2], 3, bias.shape[2]))
        parts[:, :, 0] = variance * bias * bias
        parts[:, :, 1] = 2.0 * variance * bias * scale
        parts[:, :, 2] = variance * scale * scale
        return in_order(parts, 0)


def memory_of_unit(calibration: Calibration) -> MemorySpec:
    """Return the lags, plays and rates in the columns of specific force and angular rate."""
    return memory_of(calibration.columns, calibration.sensors)


def is_sound(line: Floats) -> npt.NDArray[np.bool_]:
    """Whether results of `Correction.line` give finite forces: scale not 0, numbers < 1e140."""
    scale = line[2:12:4]
    is_finite = (np.abs(line) < _LARGEST).all(axis=0)
    return np.asarray(is_finite & (scale * (scale + line[3:12:4]) > 0.0).all(axis=0))
