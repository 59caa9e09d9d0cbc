# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the covariance of the slowly varying errors at thermal states, due to the parameters and the
unknown initial lag states, and the thermal states of a soak and of a ramp.

After s seconds of a ramp of rate q each gradient is ``board_lag_s q``, a part of time constant tau
lags the board by ``tau q (1 - exp(-s / tau))``, and the output of a play lags its input by the
play's half-width. In a soak (q = 0) gradients, lags and plays are 0. The gradient of the first
sensor by self-heating, `soak_gradient_k`, is added in soaks and ramps. The static curves apply in
soaks, the dynamic curves in ramps. Variances include neither noise nor thermometer errors.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from ..thermal.lags import BOARD_INPUT, Lag, Play, start_root
from ..thermal.state import BOARD, RATE, WEIGHT, Gradient, Rate, StateLayout
from ..typing import Floats
from .calibration import Calibration, parameter_layout
from .correction import Correction, memory_of_unit
from .covariance import rows_between
from .functions import hold, in_order

#: Largest number of thermal states evaluated at once, so that the arrays stay in the cache.
_CHUNK: Final = 64


class SlowUncertainty:
    """Error covariance at thermal states due to the posterior and unknown initial lag states."""

    def __init__(self, calibration: Calibration, correction: Correction) -> None:
        self._correction = correction
        self._K = correction.K[:, 0].tolist()
        lags = correction.memory.lags
        self._root = start_root(lags)
        edges = [edge for part in calibration.regime_sets() for edge in part.temperature_range_c]
        self._span = max(edges) - min(edges)
        #: Value of each lag [K] / rate of the board temperature in a ramp [K/s], (2, n_lags). Row
        #: 0: lags of the board in a long ramp; row 1: lags of gradients at the onset of a ramp.
        self._behind_s = np.zeros((2, len(lags)))
        for k, lag in enumerate(lags):
            for (name, tau), weight in lag.first_order_weights.items():
                row, behind_s = (0, tau) if name == BOARD_INPUT else (1, calibration.board_lag_s)
                self._behind_s[row, k] += weight * behind_s
        layout, posterior = parameter_layout(calibration), calibration.posterior
        matrix, diagonal = np.zeros((layout.n_parameters, 0)), np.zeros(layout.n_parameters)
        diagonal[layout.misalignment :] = np.square(calibration.misalignment_sd)
        if posterior is not None:
            matrix, diagonal = posterior.matrix, posterior.variances
        #: For each axis: factor and diagonal of the covariances of the parameters of the bias, of
        #: the scale, and of the nonlinear terms.
        self._blocks = [
            [(matrix[part], diagonal[part]) for part in (bias.rows, scale.rows, force)]
            for bias, scale, force in zip(layout.bias, layout.scale, layout.force, strict=True)
        ]
        self._misalignment = matrix[layout.misalignment :], diagonal[layout.misalignment :]

    def at(
        self, states: Floats, start_shares: Floats, start_rates: Floats | None = None
    ) -> Floats:
        """
        Return rows of the error covariance (see `unit.covariance`) at thermal states, (width, n).

        `start_shares`, (n_lags, n): share of each lag's initial state that remains; `start_rates`,
        (n,): board rate of a ramp at the start [K/s]; None: the present rate. The rows, of number
        `Correction.n_slow`, are a, b, c of each axis' error variance ``v(x) = a + b x + c x^2``
        [m^2/s^4], the covariances of the pairs of errors in `BETWEEN`, and the contributions of
        a nonlinearity to the coefficients of x^2 to x^6 of v(x).
        """
        cuts = range(_CHUNK, states.shape[1], _CHUNK)
        rates = np.abs(states[RATE]) if start_rates is None else start_rates
        arrays = states, start_shares, rates
        parts = zip(*(np.split(array, cuts, -1) for array in arrays), strict=True)
        return np.hstack([self._at(*part) for part in parts])

    def of_start(self, states: Floats, start_shares: Floats, rates: Floats) -> Floats:
        """
        Return derivatives of bias [input units] and relative scale w.r.t. the unknown initial lag
        states, each scaled to unit variance, shape (n_unknown, 6, n). `rates`: board rate in a
        ramp that is assumed at the start, (n,) [K/s].
        """
        table = self._correction.table
        factors, _ = table.factors(states[BOARD], states[WEIGHT])
        by_pair = self._correction.by_pairs(table.slopes(states)[0] * factors)
        by_lag = by_pair[self._correction.layout.lag_pairs] * start_shares[:, np.newaxis]
        # For a unit that was switched on in a ramp, the sd of a lag at the start is the lag in
        # a ramp of rate `rates`, limited to the calibrated span of temperatures.
        behind = hold(self._behind_s[:, :, np.newaxis] * rates, -self._span, self._span)
        in_ramp = in_order(by_lag * behind[:, :, np.newaxis], 1)
        by_root = in_order(self._root[:, :, np.newaxis, np.newaxis] * by_lag[:, np.newaxis], 0)
        return np.concatenate((by_root, in_ramp))

    def _at(self, states: Floats, start_shares: Floats, rates: Floats) -> Floats:
        of_start = self.of_start(states, start_shares, rates)
        curves, phi = self._correction.curves, self._correction.table.values(states)
        regressors = curves.regressors(states, phi)
        of_misalignment, var_misalignment = self._misalignment
        n_start, (n, rank) = len(of_start), (states.shape[1], of_misalignment.shape[1])
        errors = np.zeros((9, n_start + rank, n))
        # For positive forces, a larger element of the misalignment matrix increases the corrected
        # force, and a larger bias or scale factor decreases it.
        errors[6:, n_start:] = -of_misalignment[:, :, np.newaxis]
        variance = np.zeros((3, 3, n))
        of_nonlinearity: list[Floats] = []
        nonlinear = self._correction.of_force
        for axis, K in enumerate(self._K):
            *of_curves, of_force = self._blocks[axis]
            on_bias, on_scale = both = errors[2 * axis : 2 * axis + 2]
            # k = 0: the bias [input units] is divided by K; k = 1: the scale is relative.
            for k, ((factor, diagonal), unit) in enumerate(zip(of_curves, (K, 1.0), strict=True)):
                by = regressors[axis + 3 * k] / unit
                both[k, :n_start] = of_start[:, axis + 3 * k] / unit
                both[k, n_start:] = in_order(factor[:, :, np.newaxis] * by[:, np.newaxis], 0)
                variance[axis, 2 * k] = in_order(diagonal[:, np.newaxis] * by**2, 0)
            if nonlinear is not None:
                t = nonlinear.held(states[BOARD])
                of_nonlinearity.append(nonlinear.variance(t, *of_force, *both[:, n_start:]))
            products = on_bias * on_bias, 2.0 * (on_bias * on_scale), on_scale * on_scale
            variance[axis] += in_order(np.array(products), 1)
        between = rows_between(errors, var_misalignment)
        return np.concatenate((variance.reshape(9, n), between, *of_nonlinearity))

    def of_bias(
        self, states: Floats, mean_of: Callable[[Floats], Floats]
    ) -> tuple[Floats, Floats]:
        """
        Return two variances due to the parameters at thermal states (n, width), shapes (n, 3)
        [m^2/s^4]: of the bias, and of the bias less the mean that `mean_of` computes.
        """
        columns = states.T
        phi = self._correction.table.values(columns)
        regressors = self._correction.curves.regressors(columns, phi)
        of_state, of_difference = np.zeros((2, len(states), 3))
        for axis, ((rows, variances), _, _) in enumerate(self._blocks):
            terms = regressors[axis].T / self._K[axis]
            for result, design in ((of_state, terms), (of_difference, terms - mean_of(terms))):
                result[:, axis] = ((design @ rows) ** 2).sum(axis=1) + design**2 @ variances
        return of_state, of_difference


def in_a_soak(
    calibration: Calibration, temperature: float | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return bias [m/s^2], its sd, scale [input units per m/s^2] and its relative sd, shapes (3,), in
    a soak at a board temperature [degC], by default the reference temperature.
    """
    at = np.array([calibration.reference_temperature_c if temperature is None else temperature])
    bias, sd_bias, scale, sd_scale = bias_scale_and_sd(calibration, ramp_states(calibration, at))
    return bias[0], sd_bias[0], scale[0], sd_scale[0]


class Coefficients(NamedTuple):
    """A coefficient of the nonlinearity of the three axes, and its sd, shapes (3,)."""

    name: str
    unit: str
    value: Floats
    sd: Floats


def nonlinear_coefficients(calibration: Calibration) -> list[Coefficients]:
    """List the coefficients of the nonlinearity, and their changes per kelvin."""
    nonlinearity, posterior = calibration.nonlinearity, calibration.posterior
    terms = nonlinearity.terms if nonlinearity else ()
    layout = parameter_layout(calibration)
    sd = np.full((3, 2, len(terms)), np.nan)
    if posterior is not None:
        rows = slice(layout.nonlinear, layout.misalignment)
        variance = (posterior.matrix[rows] ** 2).sum(axis=1) + posterior.variances[rows]
        sd = np.sqrt(variance).reshape(sd.shape)
    names = {'square': ('K2', 'µg/g²'), 'odd_square': ('Kq', 'µg/g²'), 'cube': ('K3', 'µg/g³')}
    result = []
    for k, term in enumerate(terms):
        name, unit = names[term.kind]
        at, slope = 1e6 * np.array((term.coefficient, term.per_kelvin))
        at_sd, slope_sd = 1e6 * sd[:, :, k].T
        result.append(Coefficients(name, unit, at, at_sd))
        result.append(Coefficients(f'{name} per kelvin', f'{unit}/K', slope, slope_sd))
    return result


def bias_and_scale(calibration: Calibration, states: Floats) -> tuple[Floats, Floats]:
    """Return bias [m/s^2] and scale [input units per m/s^2] at thermal states, shapes (n, 3)."""
    correction = Correction(calibration)
    bias, scale = correction.bias_scale(states.T)
    return (bias / correction.K).T, scale.T


def bias_scale_and_sd(
    calibration: Calibration, states: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return bias [m/s^2], its sd, scale [input units per m/s^2] and its relative sd at thermal
    states, shapes (n, 3). The sds include the error of the self-heating gradient, and the lack of
    fit, which at 1 g may be due to the bias or to the scale.
    """
    correction = Correction(calibration)
    slow = SlowUncertainty(calibration, correction)
    start_shares = np.zeros((len(correction.memory.lags), len(states)))
    variance = slow.at(states.T, start_shares)[:9].T.reshape(-1, 3, 3)
    board, each = states[:, BOARD], np.arange(len(states))
    regime = np.rint(states[:, WEIGHT]).astype(np.int64)
    unexplained = correction.curves.unexplained(board)[regime, :, each]
    lack = correction.curves.lack_of_fit(board)[regime, :, each]
    warmer = states.copy()
    _add_gradient(warmer, calibration, (calibration.soak_gradient_k or (0.0, 0.0))[1])
    here = correction.bias_scale(states.T)
    of_bias, of_scale = ((correction.bias_scale(warmer.T) - here) / correction.K).swapaxes(1, 2)
    a, c = variance[:, :, 0] + unexplained, np.maximum(variance[:, :, 2], 0.0)
    c += lack / calibration.gravity_m_s2**2
    bias, scale = (here[0] / correction.K).T, here[1].T
    return bias, np.sqrt(a + of_bias**2), scale, np.sqrt(c + of_scale**2)


def ramp_states(
    calibration: Calibration,
    temperature: Floats,
    rate: float = 0.0,
    lasted_s: Floats | float = 0.0,
) -> Floats:
    """Build thermal states (n, width) of a ramp at `rate` [K/s] that has lasted `lasted_s` [s]."""
    layout = StateLayout(memory_of_unit(calibration))
    states = np.zeros((len(temperature), layout.width))
    states[:, BOARD], states[:, WEIGHT] = temperature, float(rate != 0.0)
    gradient = calibration.board_lag_s * rate
    for quantity, place in layout.places.items():
        if isinstance(quantity, Rate | Gradient):
            states[:, place] = rate if isinstance(quantity, Rate) else gradient
        elif isinstance(quantity, Lag):
            for (name, tau), share in quantity.first_order_weights.items():
                end = tau * rate if name == BOARD_INPUT else gradient
                states[:, place] += share * end * (1.0 - np.exp(-np.asarray(lasted_s) / tau))
        elif isinstance(quantity, Play):
            states[:, place] = -np.sign(rate) * quantity.width_k
    _add_gradient(states, calibration, (calibration.soak_gradient_k or (0.0, 0.0))[0])
    return states


def _add_gradient(states: Floats, calibration: Calibration, change_k: float) -> None:
    """Add `change_k` [K] to the first sensor's gradient, and to its lags, in `states`."""
    layout = StateLayout(memory_of_unit(calibration))
    for quantity, place in layout.places.items():
        if isinstance(quantity, Gradient) and quantity.input == calibration.sensors[0]:
            states[:, place] += change_k
        elif isinstance(quantity, Lag):
            weights = quantity.first_order_weights.items()
            of_first = (share for (name, _), share in weights if name == calibration.sensors[0])
            states[:, place] += change_k * sum(of_first)
