# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal memory: the states of lags and play operators, updated with each reading, or
computed on a uniform grid of times.

The state m of a lag (see `lags`) with the input u obeys ``dm/dt = du/dt - m / tau``. If the
input u is linear between two readings (first-order hold), the state m becomes, after dt, exactly
``m' = m e + (u' - u) (tau / dt) (1 - e)``, ``e = exp(-dt / tau)``.
"""

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import accumulate
from typing import Final

import numpy as np

from ..typing import Floats
from .lags import BOARD_INPUT, Lag, MemorySpec, first_order_lags

#: If interval between readings / time constant of a lag is above this value, the unknown time of a
#: change between the readings adds variance to the lag.
SPARSE_SHARE: Final = 0.1
#: `_recursion` neglects old inputs whose weight is smaller: they have no effect in float64.
_LEAST_WEIGHT: Final = 1e-18


class LagBank:
    """
    First-order lags of one input with the time constants `taus` [s]; `stamp_ns`, `start_ns`: last
    and first stamp of the input since the last call of `forget`.
    """

    def __init__(self, taus: tuple[float, ...]) -> None:
        self.taus = taus
        self._sparse_s = SPARSE_SHARE * min(self.taus, default=math.inf)
        self.forget()

    def forget(self) -> None:
        """Forget the input; all lags begin at 0 with the next input value."""
        self.stamp_ns: int | None = None
        self.start_ns: int | None = None
        self.input = 0.0
        #: Input less lagged input of each lag [K]; its variance for a known initial state [K^2].
        self.lagging = self.extra = [0.0] * len(self.taus)

    def step(self, stamp_ns: int, value: float, sd: float = 0.0) -> None:
        """Use the next input value (error sd: `sd` [K]); the input is linear between values."""
        if self.stamp_ns is None:
            self.stamp_ns = self.start_ns = stamp_ns
            self.input = value
            return
        if not self.taus:
            return
        change, dt_ns = value - self.input, stamp_ns - self.stamp_ns
        if dt_ns <= 0:
            self.lagging = [m + change for m in self.lagging]
        else:
            self.lagging, self.extra = self.at(stamp_ns, value)
            self.stamp_ns = stamp_ns
            if sd or dt_ns * 1e-9 > self._sparse_s:
                self._add_variances(_coefficients(self.taus, dt_ns)[0], dt_ns * 1e-9, change, sd)
        self.input = value

    def _add_variances(self, decays: list[float], dt: float, change: float, sd: float) -> None:
        result = []
        for variance, e, tau in zip(self.extra, decays, self.taus, strict=True):
            grown = variance
            if dt > SPARSE_SHARE * tau:
                grown += (change * (1.0 - e)) ** 2
            if sd:
                # An error of the input is the same in all steps, so the steps' standard deviations
                # add, not their variances.
                grown = (math.sqrt(grown) + sd * (1.0 - e)) ** 2
            result.append(grown)
        self.extra = result

    def note_jump(self, change: float) -> None:
        """Add `change`^2 to the variance of each lag; `change`: a wrong step of the input [K]."""
        self.extra = [variance + change * change for variance in self.extra]

    def at(self, stamp_ns: int, value: float) -> tuple[list[float], list[float]]:
        """Return each lag [K] and its variance [K^2] at a stamp, for the input `value` [K]."""
        seen_ns = self.stamp_ns
        if seen_ns is None or stamp_ns <= seen_ns or not self.taus:
            return self.lagging, self.extra
        decays, gains = _coefficients(self.taus, stamp_ns - seen_ns)
        change = value - self.input
        lagging = [
            m * e + change * gain for m, e, gain in zip(self.lagging, decays, gains, strict=True)
        ]
        return lagging, [v * e * e for v, e in zip(self.extra, decays, strict=True)]


@lru_cache(maxsize=1024)
def _coefficients(taus: tuple[float, ...], dt_ns: int) -> tuple[list[float], list[float]]:
    """Return ``e`` and ``(1 - e) tau / dt`` of each lag, ``e = exp(-dt / tau)``, dt in ns."""
    dt = dt_ns * 1e-9
    lost = [-math.expm1(-dt / tau) for tau in taus]
    gains = [part * (tau / dt) for part, tau in zip(lost, taus, strict=True)]
    return [1.0 - part for part in lost], gains


class ThermalMemory:
    """
    The memory of a tracker: lags of the board temperature and of each gradient, and plays.

    A play (Prandtl-Ishlinskii operator of rate-independent hysteresis) of half-width r [K] follows
    an input v only when v is farther than r from the output ``P = min(max(P, v - r), v + r)``.
    """

    def __init__(self, spec: MemorySpec) -> None:
        self.spec = spec
        terms = sorted(first_order_lags(spec.lags), key=lambda term: spec.inputs.index(term[0]))

        def weights(lag: Lag) -> list[tuple[int, float]]:
            """Return index in `terms` and weight of each first-order lag that `lag` contains."""
            return [(terms.index(term), w) for term, w in lag.first_order_weights.items()]

        #: The first-order lags of each input, by the input's name.
        self.banks = {
            name: LagBank(tuple(tau for of, tau in terms if of == name)) for name in spec.inputs
        }
        self.board = self.banks[BOARD_INPUT]
        self.is_empty = not spec.lags and not spec.plays
        #: Index and weight of the first-order lags in each lag; [] if all lags are first-order.
        self._sums = [weights(lag) for lag in spec.lags]
        if self._sums == [[(k, 1.0)] for k in range(len(terms))]:
            self._sums = []
        #: Index of the lag of each play's input, or -1 if the input is the board temperature.
        self._inputs = [spec.lags.index(play.lag) if play.lag else -1 for play in spec.plays]
        #: Index and weight of each first-order lag in each play's input; [] if it has no lag.
        self._followed = [weights(play.lag) if play.lag else [] for play in spec.plays]
        self._needs_sensors = any(play.inputs != (BOARD_INPUT,) for play in spec.plays)
        self._widths = [play.width_k for play in spec.plays]
        self.forget()

    def forget(self) -> None:
        """Forget all inputs; the next board temperature sets each play equal to its input."""
        for bank in self.banks.values():
            bank.forget()
        self._held: list[float] = []  # output of each play; empty before the first temperature
        #: Estimated board rate in a ramp in which the unit may have been switched on [K/s];
        #: `sure_rate`: lower bound of this rate, the largest estimate of the board rate less 2 sd.
        self.start_rate = self.sure_rate = 0.0

    def forget_input(self, name: str) -> None:
        """Forget the gradient of a sensor or, for the board, all inputs."""
        if name == BOARD_INPUT:
            self.forget()
        else:
            self.banks[name].forget()
            self._held = [] if self._needs_sensors else self._held

    def board_step(self, stamp_ns: int, board: float, sd: float = 0.0) -> None:
        """Use the next board temperature [degC], with an error of the sd `sd` [K]."""
        self.board.step(stamp_ns, board, sd)
        values = self.board.lagging
        if self._needs_sensors:
            # Only the board has a reading at this stamp: use the last gradients of the sensors.
            gradients = [self.banks[name].input for name in self.spec.sensors]
            values, _ = self._first_order(stamp_ns, board, gradients)
        inputs = [
            board - sum([share * values[k] for k, share in lag]) if lag else board
            for lag in self._followed
        ]
        self._held = list(map(_follow, self._held or inputs, inputs, self._widths))

    def note_jump(self, change: float) -> None:
        """Add `change`^2 to the variance of each lag; `change`: wrong step of the board [K]."""
        for bank in self.banks.values():
            bank.note_jump(change)

    def at(
        self,
        stamp_ns: int,
        board: float,
        gradients: list[float],
        still: Sequence[tuple[float, float]] = (),
    ) -> list[float]:
        """
        Return each lag [K] and its variance for a known initial state [K^2], then each play less
        its input [K]. `still`: possible error of each input's constant readings [K], and their
        duration [s]; empty if no input has constant readings.
        """
        behind, extra = self._first_order(stamp_ns, board, gradients)
        if still:
            # An error of the board temperature is also an error of each gradient.
            causes = [still[:1], *((still[0], cause) for cause in still[1:])]
            grown = [
                sum((sd * math.expm1(-still_s / tau)) ** 2 for sd, still_s in of_bank)
                for bank, of_bank in zip(self.banks.values(), causes, strict=True)
                for tau in bank.taus
            ]
            extra = [variance + more for variance, more in zip(extra, grown, strict=True)]
        if self._sums:
            values, variances = behind, extra
            behind = [sum([share * values[k] for k, share in lag]) for lag in self._sums]
            # The errors of first-order lags have common causes, so their standard deviations add.
            extra = [
                sum([abs(share) * math.sqrt(variances[k]) for k, share in lag]) ** 2
                for lag in self._sums
            ]
        result = [number for pair in zip(behind, extra, strict=True) for number in pair]
        if not self._held:
            return result + [0.0] * len(self._widths)
        for place, p, r in zip(self._inputs, self._held, self._widths, strict=True):
            apart = p - (board if place < 0 else board - behind[place])
            result.append(-r if apart < -r else r if apart > r else apart)
        return result

    def _first_order(
        self, stamp_ns: int, board: float, gradients: Sequence[float]
    ) -> tuple[list[float], list[float]]:
        """Return each first-order lag [K], and its variance for a known initial state [K^2]."""
        values, extra = self.board.at(stamp_ns, board)
        for name, gradient in zip(self.spec.sensors, gradients, strict=True):
            if (bank := self.banks[name]).taus:
                lagging, bank_extra = bank.at(stamp_ns, gradient)
                values = values + [gradient - m for m in lagging]
                extra = extra + bank_extra
        return values, extra

    def remaining_shares(self, stamp_ns: int) -> list[float]:
        """Return `Lag.remaining_share` of each lag at a stamp, a number from 1 (start) to 0."""
        ages = {
            name: 0.0 if bank.start_ns is None else max(stamp_ns - bank.start_ns, 0) * 1e-9
            for name, bank in self.banks.items()
        }
        return [lag.remaining_share(min(ages[of] for of in lag.inputs)) for lag in self.spec.lags]


def memory_on_grid(
    spec: MemorySpec, step_s: float, board: Floats, gradients: Sequence[Floats]
) -> Floats:
    """
    Return the results of `ThermalMemory.at` on a uniform grid of times, equal up to rounding:
    each lag [K] and the variance 0, then each play less its input [K], (n, 2 n_lags + n_plays).
    """
    inputs = dict(zip(spec.inputs, (board, *gradients), strict=True))
    first_order: dict[tuple[str, float], Floats] = {}
    for name, tau in first_order_lags(spec.lags):
        u = inputs[name]
        lost = -math.expm1(-step_s / tau)
        driven = np.diff(u, prepend=u[:1]) * (lost * tau / step_s)
        m = _recursion(1.0 - lost, driven)
        first_order[name, tau] = m if name == BOARD_INPUT else u - m
    behind = {
        lag: np.asarray(sum(w * first_order[of] for of, w in lag.first_order_weights.items()))
        for lag in spec.lags
    }
    columns = [part for lag in behind.values() for part in (lag, np.zeros_like(lag))]
    for play in spec.plays:
        v = board - behind[play.lag] if play.lag else board
        held = accumulate(v.tolist(), partial(_follow, width=play.width_k))
        columns.append(np.array(list(held)) - v)
    return np.column_stack(columns) if columns else np.zeros((len(board), 0), dtype=np.float64)


def _recursion(decay: float, driven: Floats) -> Floats:
    """Compute ``m[k] = decay m[k - 1] + driven[k]`` in log2(n) passes: pass j spans 2^j steps."""
    result: Floats = driven.copy()
    shift, factor = 1, decay
    while shift < len(result) and factor > _LEAST_WEIGHT:
        result[shift:] += factor * result[:-shift]
        shift, factor = 2 * shift, factor * factor
    return result


def _follow(p: float, v: float, width: float) -> float:
    """Return the output of a play of half-width `width` at the input `v`; `p`: last output."""
    return v - width if p < v - width else v + width if p > v + width else p
