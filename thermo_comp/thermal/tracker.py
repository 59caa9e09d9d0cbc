# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal state of a unit at any stamp: two thermometers, regime, memory, cross-over.

The compensator, the fit and the report all run this one class, so a regressor means the same
when it is fitted as when it is applied. It is causal and has no clock: readings go in by stamp,
a state comes out for a stamp.

Thermal memory: the lag of the board temperature obeys ``dL/dt = (T - L) / tau``. Kept here is
``m = T - L`` itself; with T linear between two readings (first-order hold) its exact step over
dt is ``m' = m e + (T' - T) (tau / dt) (1 - e)``, ``e = exp(-dt / tau)``.

"""

from __future__ import annotations

import math
from typing import Final

from .plausibility import Fault, LeadWatch, SensorGuard
from .regime import Regime, RegimeDetector
from .settings import DetectorSettings, ThermalConfig
from .state import ThermalState
from .thermometer import Thermometer

#: A unit that starts in the middle of a ramp has a memory that nobody saw: its sd then [K].
MEMORY_START_SD: Final = 3.0
#: While the case sensor is lost the gradient is guessed from the board's rate, this well.
LOST_GRADIENT_RELATIVE_SD: Final = 0.5
#: A regime that no sensor has watched for this part of a thermal lag is not known any more.
UNWATCHED_SHARE: Final = 0.25

#: Layout of `ThermalTracker.sample`; the memory values follow as pairs (value, variance).
(
    BOARD,
    VAR_BOARD,
    RATE,
    GRADIENT,
    VAR_GRADIENT,
    WEIGHT,
    UNKNOWN,
    MEMORY,
) = range(8)


class ThermalTracker:
    """
    Thermal state from stamped readings of the board and the case thermometer.

    Parameters
    ----------
    detector : DetectorSettings
        Thermometers and detector, as the coefficient sets were fitted under.
    memory_time_constants_s : tuple of float, optional
        Time constants of the lags of the board temperature [s].
    config : ThermalConfig, optional
        Cross-over, time-out and stand-in.

    """

    def __init__(
        self,
        detector: DetectorSettings,
        memory_time_constants_s: tuple[float, ...] = (),
        config: ThermalConfig | None = None,
    ) -> None:
        self.settings = detector
        self.memory_time_constants_s = memory_time_constants_s
        self._configure(config or ThermalConfig())
        self.board = Thermometer(detector.board)
        self.case = Thermometer(detector.case)
        self.detector = RegimeDetector(detector)
        self.board_guard = SensorGuard(self.board, self.case, self.config.board_lag_s)
        self.case_guard = SensorGuard(self.case, self.board, 0.0)
        self.lead = LeadWatch(self.case, self.board, detector.relaxed_rate_k_min)
        self._clear()

    def _configure(self, config: ThermalConfig) -> None:
        self.config = config
        self._case_timeout_s = config.case_timeout_s
        #: How long nobody may have watched before the regime is not known any more [s].
        self._unwatched_s = max(UNWATCHED_SHARE * self.settings.case.lag_s, config.case_timeout_s)

    def _clear(self) -> None:
        #: Stamp of the newest reading that was used, None before the first.
        self.updated_ns: int | None = None
        self._decided_ns: int | None = None
        self._is_doubted = False
        self._memory: list[float] = []
        self._var_memory: list[float] = []
        self._forget_memory()
        self._weight = 0.0
        self._weight_ns = 0
        self._target = 0.0

    def reset(self) -> None:
        """
        Forget everything: time has jumped, or a new recording begins.

        """
        self.board.reset()
        self.case.reset()
        self.detector.reset()
        self.board_guard.reset()
        self.case_guard.reset()
        self.lead.reset()
        self._clear()

    def reconfigure(self, config: ThermalConfig, stamp_ns: int | None) -> None:
        """
        Take over another configuration from a stamp on, without a step in the weight.

        """
        if stamp_ns is not None:
            self._weight = self.weight_at(stamp_ns)
            self._weight_ns = stamp_ns
        self._configure(config)
        self.board_guard.lag_s = config.board_lag_s

    def is_case_live(self, stamp_ns: int) -> bool:
        """
        Whether the case temperature is there and fresh enough at a stamp.

        """
        seen = self.case.stamp_ns
        return seen is not None and (stamp_ns - seen) * 1e-9 <= self._case_timeout_s

    def board_reading(self, stamp_ns: int, celsius: float) -> bool:
        """
        Take one reading of the board thermometer.

        Parameters
        ----------
        stamp_ns : int
            Its stamp.
        celsius : float
            The reading [degC].

        Returns
        -------
        bool
            Whether the reading was used; False for one that is not finite, not newer than the
            last, an outlier, or not plausible.

        """
        board, guard = self.board, self.board_guard
        before_ns, before, n_restarts = board.stamp_ns, board.temperature, board.n_restarts
        is_anew = False
        if not guard.admits(stamp_ns, celsius):
            self._is_doubted = True
            if not self._may_begin_anew(guard, stamp_ns, self.config.temperature_timeout_s):
                return False
            is_anew = True
        if is_anew or guard.is_revived:
            board.reset()
        if not board.update(stamp_ns, celsius):
            return False
        if before_ns is not None:
            dt = (stamp_ns - before_ns) * 1e-9
            change = board.temperature - before
            has_restarted = board.n_restarts != n_restarts
            is_gap = has_restarted and dt > self.settings.board.lag_s
            if is_anew or is_gap:
                self._forget_memory()
            elif self._memory:
                self._step_memory(dt, change)
            if is_anew or guard.is_revived or (has_restarted and not is_gap):
                guard.note_jump(stamp_ns, change)
                self._var_memory = [value + change * change for value in self._var_memory]
        self.case_guard.watch_other()
        self._note(stamp_ns)
        if not self.is_case_live(stamp_ns):
            self._decide(stamp_ns, None)
        return True

    def case_reading(self, stamp_ns: int, celsius: float) -> bool:
        """
        Take one reading of the case thermometer and decide the regime.

        Parameters
        ----------
        stamp_ns : int
            Its stamp.
        celsius : float
            The reading [degC].

        Returns
        -------
        bool
            Whether the reading was used.

        """
        case, guard = self.case, self.case_guard
        before_ns, before, n_restarts = case.stamp_ns, case.temperature, case.n_restarts
        is_anew = False
        if not guard.admits(stamp_ns, celsius):
            self._is_doubted = True
            if not self._may_begin_anew(guard, stamp_ns, self.config.case_timeout_s):
                return False
            is_anew = True
        is_anew = is_anew or guard.is_revived
        if is_anew:
            case.reset()
        if not case.update(stamp_ns, celsius):
            return False
        if before_ns is not None and (is_anew or case.n_restarts != n_restarts):
            is_gap = (stamp_ns - before_ns) * 1e-9 > self.settings.case.lag_s
            if is_anew or not is_gap:
                guard.note_jump(stamp_ns, case.temperature - before)
        self.board_guard.watch_other()
        self._note(stamp_ns)
        detector = self.detector
        if guard.fault is not Fault.STILL or detector.regime is not Regime.DYNAMIC:
            # One that stands still does not tell that a ramp has ended.
            self._decide(stamp_ns, case)
        self.lead.update(detector.regime is Regime.STATIC)
        return True

    @staticmethod
    def _may_begin_anew(guard: SensorGuard, stamp_ns: int, patience_s: float) -> bool:
        """
        Let a sensor begin again that has stayed where it cannot have come to for long enough.

        """
        seen_ns = guard.own.stamp_ns
        if guard.fault != Fault.STEP or seen_ns is None:
            return False
        if (stamp_ns - seen_ns) * 1e-9 <= patience_s:
            return False
        guard.reset()
        return True

    def _note(self, stamp_ns: int) -> None:
        if self.updated_ns is None or stamp_ns > self.updated_ns:
            self.updated_ns = stamp_ns
        self._is_doubted = (
            self.board_guard.is_doubtful
            or self.case_guard.is_doubtful
            or self.lead.is_reversed
            or self.lead.doubt > 0.0
        )

    def _decide(self, stamp_ns: int, case: Thermometer | None) -> None:
        board = self.board if self.board.stamp_ns is not None else None
        decided_ns, self._decided_ns = self._decided_ns, stamp_ns
        if decided_ns is not None and self._is_unwatched(decided_ns, stamp_ns):
            # Nobody has seen whether a ramp began or ended meanwhile.
            self.detector.reset()
            self.lead.reset()
        regime = self.detector.update(stamp_ns, case, board)
        target = 1.0 if regime is Regime.DYNAMIC else 0.0
        if target != self._target:
            self._weight = self.weight_at(stamp_ns)
            self._weight_ns = stamp_ns
            self._target = target

    def _is_unwatched(self, decided_ns: int, stamp_ns: int) -> bool:
        return (stamp_ns - decided_ns) * 1e-9 > self._unwatched_s

    def _forget_memory(self) -> None:
        n_lags = len(self.memory_time_constants_s)
        self._memory = [0.0] * n_lags
        self._var_memory = [MEMORY_START_SD**2] * n_lags

    def _step_memory(self, dt: float, change: float) -> None:
        for k, tau in enumerate(self.memory_time_constants_s):
            e = math.exp(-dt / tau)
            self._memory[k] = self._memory[k] * e + change * (tau / dt) * (1.0 - e)
            variance = self._var_memory[k] * e * e
            if dt > 0.1 * tau:
                # Nobody saw the way between two readings this far apart.
                variance += (change * (1.0 - e)) ** 2
            self._var_memory[k] = variance

    def weight_at(self, stamp_ns: int) -> float:
        """
        Weight of the dynamic set at a stamp, moving linearly over the transition time.

        """
        if self._weight == self._target:
            return self._target
        duration = self.config.transition_time_s
        if duration == 0.0:
            return self._target
        moved = max((stamp_ns - self._weight_ns) * 1e-9, 0.0) / duration
        if self._target > self._weight:
            return min(self._weight + moved, self._target)
        return max(self._weight - moved, self._target)

    def sample(self, stamp_ns: int) -> tuple[float, ...]:
        """
        Thermal state at a stamp as a flat tuple, in the layout of `BOARD` .. `MEMORY`.

        Parameters
        ----------
        stamp_ns : int
            The stamp; the board must have been read at least once.

        Returns
        -------
        tuple of float
            Board temperature [degC], its variance [K^2], its rate [K/s], gradient [K], variance
            of the gradient from the case side [K^2], weight, 1.0 while the regime is unknown,
            then (memory [K], variance [K^2]) per time constant.

        """
        board, rate, var_board = self.board.at(stamp_ns)
        if self.is_case_live(stamp_ns):
            case, _, var_gradient = self.case.at(stamp_ns)
            gradient = case - board
        else:
            gradient, var_gradient = self._lost_gradient(stamp_ns, rate)
        if self._is_doubted:
            var_board += self.board_guard.doubt(stamp_ns)
            var_gradient += self.case_guard.doubt(stamp_ns)
            if self.lead.is_reversed:
                # What is called the case may be the board.
                var_board += gradient * gradient
            else:
                var_board += self.lead.doubt
        decided_ns = self._decided_ns
        is_known = (
            decided_ns is not None
            and self.detector.regime is not Regime.UNKNOWN
            and (stamp_ns - decided_ns) * 1e-9 <= self._unwatched_s
        )
        unknown = 0.0 if is_known else 1.0
        state = (board, var_board, rate, gradient, var_gradient, self.weight_at(stamp_ns), unknown)
        if not self._memory:
            return state
        return state + self._memory_at(stamp_ns, board)

    def _lost_gradient(self, stamp_ns: int, rate: float) -> tuple[float, float]:
        """
        Guess the gradient from the board's rate, while the case sensor is lost.

        """
        lag = self.config.board_lag_s
        gradient = lag * rate
        # Nor has anybody seen what the case did since the board was last read.
        unseen = self.settings.case.fastest_ramp_k_min / 60.0 * self.board.beyond(stamp_ns)
        variance = (
            (LOST_GRADIENT_RELATIVE_SD * gradient) ** 2
            + lag * lag * self.board.var_rate
            + unseen * unseen
        )
        return gradient, variance

    def _memory_at(self, stamp_ns: int, board: float) -> tuple[float, ...]:
        dt = (stamp_ns - (self.board.stamp_ns or 0)) * 1e-9
        change = board - self.board.temperature
        result: tuple[float, ...] = ()
        for k, tau in enumerate(self.memory_time_constants_s):
            value, variance = self._memory[k], self._var_memory[k]
            if dt > 0.0:
                e = math.exp(-dt / tau)
                value = value * e + change * (tau / dt) * (1.0 - e)
                variance = variance * e * e
            result += (value, variance)
        return result

    def state_at(self, stamp_ns: int) -> ThermalState:
        """
        Thermal state at a stamp, with names.

        Parameters
        ----------
        stamp_ns : int
            The stamp.

        Returns
        -------
        ThermalState
            The state.

        Raises
        ------
        ValueError
            If the board thermometer has not been read yet.

        """
        if self.board.stamp_ns is None:
            raise ValueError('`state_at` needs a board temperature first')
        flat = self.sample(stamp_ns)
        return ThermalState(
            board=flat[BOARD],
            var_board=flat[VAR_BOARD],
            rate=flat[RATE],
            gradient=flat[GRADIENT],
            var_gradient=flat[VAR_GRADIENT],
            weight=flat[WEIGHT],
            regime=self.detector.regime,
            direction=self.detector.direction,
            memory=flat[MEMORY::2],
            var_memory=flat[MEMORY + 1 :: 2],
        )
