# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the tracker of a unit's thermal state: thermometers, regime, memory, dynamic weight.

The compensator, the fit and the report all run `ThermalTracker`, so a regressor has the same value
in the fit and in the correction (within the noise of a reading if the fit averages readings).
`ThermalTracker` is causal and reads no clock: each reading has a stamp, and the thermal state is
requested for a stamp.
"""

from copy import copy
from math import inf, sqrt
from typing import Final

from .lags import BOARD_INPUT, MemorySpec, start_covariance
from .memory import ThermalMemory
from .plausibility import CopyCheck, Fault, LeadCheck, SensorCheck
from .regime import Regime, RegimeDetector
from .settings import DetectorSettings, ThermalConfig
from .state import BOARD, GRADIENT, MEMORY_SETTLED_SD, USUAL_BOARD_LAG_S
from .thermometer import RESTART_READINGS, Thermometer

#: Relative sd of a gradient that is estimated while its sensor is lost (gives no readings).
LOST_GRADIENT_RELATIVE_SD: Final = 0.5
#: The regime is unknown after this time without a decision / lag of the case thermometer.
UNWATCHED_SHARE: Final = 0.25
# Another air flow changes the self-heating gradient after the fit. Changes up to the larger one of
# these two limits are not taken as errors of the board temperature.
SELF_HEATING_CHANGE_K: Final = 1.0  # in K
SELF_HEATING_CHANGE: Final = 0.5  # times the largest self-heating gradient in the fit
ANY_RANGE: Final = (-inf, inf)


class ThermalTracker:
    """Thermal state from stamped readings of the board and of other thermometers."""

    def __init__(
        self,
        detector: DetectorSettings,
        memory: MemorySpec | None = None,
        config: ThermalConfig | None = None,
        board_lag_s: float = USUAL_BOARD_LAG_S,
        rest_gradient_range_k: tuple[float, float] = ANY_RANGE,
    ) -> None:
        self.settings = detector
        self.spec = memory or MemorySpec()
        self.board = Thermometer(detector.board)
        others = {name: Thermometer(detector.case) for name in self.spec.sensors}
        self.thermometers = {BOARD_INPUT: self.board, **others}
        self.case = others[self.spec.sensors[0]]  # the leading sensor
        self.checks = {
            BOARD_INPUT: SensorCheck(self.board, self.case, board_lag_s),
            **{name: SensorCheck(sensor, self.board, 0.0) for name, sensor in others.items()},
        }
        self.copies = {name: CopyCheck() for name in others}
        self.memory = ThermalMemory(self.spec)
        self.updated_ns: int | None = None  # newest stamp of a used reading
        self._decided_ns: int | None = None
        self._weight = 0.0
        self._weight_ns = 0
        self._target = 0.0
        #: Gradient of each sensor in the last static regime less `_board_lag_s` * board rate [K].
        self._rest_gradients: dict[str, float] = {}
        self._begin_watch()
        self.reconfigure(config or ThermalConfig(), board_lag_s, rest_gradient_range_k, None)

    def _begin_watch(self) -> None:
        self.detector = RegimeDetector(self.settings)
        self.lead = LeadCheck(self.case, self.board, self.settings.relaxed_rate_k_min)

    def reconfigure(
        self,
        config: ThermalConfig,
        board_lag_s: float,
        rest_gradient_range_k: tuple[float, float],
        stamp_ns: int | None,
    ) -> None:
        """Use new settings from a stamp on, without a step in the weight of the dynamic set."""
        if stamp_ns is not None:
            self._weight = self.weight_at(stamp_ns)
            self._weight_ns = stamp_ns
        self.config = config
        self._rest_gradient_range = rest_gradient_range_k
        #: Lag of the board behind the case [s], to estimate the gradient of a lost sensor.
        self._board_lag_s = board_lag_s
        lag_s = self.settings.case.lag_s
        usual_s = max(UNWATCHED_SHARE * lag_s, config.case_timeout_s)
        #: Time without a decision after which the regime is unknown [s].
        self._unwatched_s = min(usual_s, max(lag_s, self.settings.board.lag_s))
        # Other trackers may share the board's plausibility check: set the lag in a copy of it.
        self.checks = {**self.checks, BOARD_INPUT: copy(self.checks[BOARD_INPUT])}
        self.checks[BOARD_INPUT].lag_s = board_lag_s

    def is_live(self, stamp_ns: int, sensor: Thermometer) -> bool:
        """Whether a sensor's last reading is at most `case_timeout_s` older than a stamp."""
        seen_ns = sensor.stamp_ns
        return seen_ns is not None and (stamp_ns - seen_ns) * 1e-9 <= self.config.case_timeout_s

    def read(self, name: str, stamp_ns: int, celsius: float) -> bool:
        """Take a reading [degC]; return False if it is old, an outlier or implausible."""
        sensor, check = self.thermometers[name], self.checks[name]
        # Test whether sensors repeat readings of the board.
        for other in self.copies if sensor is self.board else (name,):
            self.copies[other].update(sensor is self.board, stamp_ns, celsius)
        if not self._use(name, sensor, check, stamp_ns, celsius):
            return False
        if sensor is self.board:
            self._follow_board(stamp_ns)
            return True
        bank = self.memory.banks[name]
        if self.board.stamp_ns is not None:
            board, rate, _ = self.board.at(stamp_ns)
            gradient = sensor.temperature - board
            if bank.taus:
                leading, _ = self._gradient(self.spec.sensors[0], stamp_ns, board, rate)
                bank.step(stamp_ns, gradient, sqrt(self._board_error(leading)))
            if self.detector.regime is Regime.STATIC:
                self._rest_gradients[name] = gradient - self._board_lag_s * rate
        if sensor is self.case:
            self.checks[BOARD_INPUT].watch_other()
            if check.fault is not Fault.STILL or self.detector.regime is not Regime.DYNAMIC:
                # In the dynamic regime a sensor that stands still must not end the regime.
                self._decide(stamp_ns, sensor)
            self.lead.update(self.detector.regime is Regime.STATIC)
        return True

    def _follow_board(self, stamp_ns: int) -> None:
        board, memory = self.board, self.memory
        if not memory.is_empty:
            name = self.spec.sensors[0]
            leading, _ = self._gradient(name, stamp_ns, board.temperature, board.rate)
            error = sqrt(self._board_error(leading))
            memory.board_step(stamp_ns, board.temperature, error)
            age_s = (stamp_ns - (memory.board.start_ns or 0)) * 1e-9
            if age_s <= max(self._board_lag_s, board.settings.lag_s):
                # Within the longer of the two lags, a rate may be due to a ramp before the start.
                rate = abs(board.rate)
                memory.sure_rate = max(memory.sure_rate, rate - 2.0 * sqrt(board.var_rate))
                memory.start_rate = max(memory.sure_rate, rate)
            # A sensor that has given no reading is lost once the time-out has passed.
            is_young = age_s <= self.config.case_timeout_s
            for name, bank in memory.banks.items():
                sensor = self.thermometers[name]
                if sensor is board or not bank.taus:
                    continue
                is_first = bank.stamp_ns is None and is_young
                if not (is_first or self.is_live(stamp_ns, sensor)):
                    # The sensor is lost: update its gradient's lags with an estimated gradient.
                    gradient, variance = self._lost_gradient(name, stamp_ns, board.rate)
                    bank.step(stamp_ns, gradient, sqrt(variance))
        for name in self.spec.sensors:
            self.checks[name].watch_other()
        if not self.is_live(stamp_ns, self.case):
            self._decide(stamp_ns, None)

    def _use(
        self, name: str, sensor: Thermometer, check: SensorCheck, stamp_ns: int, celsius: float
    ) -> bool:
        """Use a plausible reading, adjust lags after a jump or gap; return whether it was used."""
        if check.has_wrong_start(stamp_ns, celsius):
            self._begin_again(name, sensor)
        before_ns, before, n_restarts = sensor.stamp_ns, sensor.temperature, sensor.n_restarts
        n_before, has_jumped = sensor.n_in_row, check.fault is Fault.STEP
        is_rejected = not check.admits(stamp_ns, celsius)
        if is_rejected:
            # If all readings for the length of the time-out were rejected as steps, restart.
            age_s = 0.0 if before_ns is None else (stamp_ns - before_ns) * 1e-9
            config, is_board = self.config, sensor is self.board
            timeout_s = config.temperature_timeout_s if is_board else config.case_timeout_s
            if check.fault != Fault.STEP or age_s <= timeout_s:
                return False
            check.reset()
        is_new = is_rejected or check.is_revived
        if is_new:
            sensor.reset()
        if not sensor.update(stamp_ns, celsius):
            return False
        seen_ns = self.updated_ns
        self.updated_ns = stamp_ns if seen_ns is None else max(seen_ns, stamp_ns)
        has_restarted = sensor.n_restarts != n_restarts
        if before_ns is not None and (is_new or has_restarted):
            is_gap = has_restarted and (stamp_ns - before_ns) * 1e-9 > sensor.settings.lag_s
            if has_restarted and not is_gap and n_before < 2 * RESTART_READINGS:
                # The few readings before the restart were wrong: forget what followed from them.
                self._begin_again(name, sensor)
                sensor.update(stamp_ns, celsius)
                return True
            memory = self.memory if sensor is self.board else self.memory.banks[name]
            if memory is self.memory and (is_rejected or is_gap):
                memory.forget()
            if is_new or not is_gap:
                change = sensor.temperature - before
                check.shift += change if is_rejected or has_jumped else 0.0
                check.note_jump(stamp_ns, change)
                memory.note_jump(change)
        return True

    def _begin_again(self, name: str, sensor: Thermometer) -> None:
        """Forget a sensor's readings, and the lags, gradients and regime that depend on them."""
        sensor.reset()
        self.memory.forget_input(name)
        self._rest_gradients.clear()
        self._begin_watch()
        for check in self.checks.values():
            check.forget_other()

    def _decide(self, stamp_ns: int, case: Thermometer | None) -> None:
        board = self.board if self.board.stamp_ns is not None else None
        decided_ns, self._decided_ns = self._decided_ns, stamp_ns
        if decided_ns is not None and (stamp_ns - decided_ns) * 1e-9 > self._unwatched_s:
            # A ramp may have begun or ended in the long time without a decision.
            self._begin_watch()
        regime = self.detector.update(stamp_ns, case, board)
        target = 1.0 if regime is Regime.DYNAMIC else 0.0
        if target != self._target:
            self._weight = self.weight_at(stamp_ns)
            self._weight_ns = stamp_ns
            self._target = target

    def weight_at(self, stamp_ns: int) -> float:
        """Return the weight of the dynamic set at a stamp, linear in time in a transition."""
        duration_s = self.config.transition_time_s
        if self._weight == self._target or not duration_s:
            return self._target
        moved = max((stamp_ns - self._weight_ns) * 1e-9, 0.0) / duration_s
        return max(min(self._weight + moved, self._target), self._weight - moved)

    def sample(self, stamp_ns: int) -> tuple[float, ...]:
        """
        Return the thermal state at a stamp, in the order of `StateLayout`; the board must have a
        reading. The variance of a gradient is the variance of the sensor's temperature, without
        that of the board; the variance of a lag is its variance for a known initial state.
        """
        board, rate, var_board = self.board.at(stamp_ns)
        decided_ns = self._decided_ns
        is_known = (
            decided_ns is not None
            and self.detector.regime is not Regime.UNKNOWN
            and (stamp_ns - decided_ns) * 1e-9 <= self._unwatched_s
        )
        gradients, pairs = [], []
        for name in self.spec.sensors:
            gradient, variance = self._gradient(name, stamp_ns, board, rate)
            gradients.append(gradient)
            variance += self.checks[name].extra_variance(stamp_ns)
            if self.copies[name].is_copy:
                true, unknown = self._lost_gradient(name, stamp_ns, rate)
                variance += true * true + unknown
            pairs += [gradient, variance]
        for name in self.spec.rates:
            sensor = self.thermometers[name]
            is_live = self.is_live(stamp_ns, sensor)
            # A lost sensor is given the board's rate, with an sd of 100 %.
            pairs += [sensor.rate, sensor.var_rate] if is_live else [rate, rate * rate]
        var_board += self.checks[BOARD_INPUT].extra_variance(stamp_ns)
        var_board += self._board_error(gradients[0])
        if not self.memory.is_empty:
            still = [self.checks[name].still(stamp_ns) for name in self.spec.inputs]
            if not any(sd for sd, _ in still):
                still = []
            pairs += self.memory.at(stamp_ns, board, gradients, still)
        return board, var_board, rate, self.weight_at(stamp_ns), float(not is_known), *pairs

    def _board_error(self, gradient: float) -> float:
        """
        Return the variance of the board temperature [K^2] due to an impossible gradient of the
        leading sensor, as with a loose thermometer or swapped topics.
        """
        loose, lead = self.loose_k(gradient), self.lead
        # If the board leads the case in a ramp, the topics of case and board may be swapped.
        return loose * loose + (gradient * gradient if lead.is_reversed else lead.extra_variance)

    def loose_k(self, gradient: float) -> float:
        """Return the part of the leading sensor's gradient beyond ramp and self-heating [K]."""
        of_ramp = self._board_lag_s * self.board.rate
        lower, upper = self._rest_gradient_range
        excess = max(gradient - of_ramp - upper, lower - gradient + of_ramp)
        if excess > SELF_HEATING_CHANGE_K:
            usual = max(SELF_HEATING_CHANGE_K, SELF_HEATING_CHANGE * max(-lower, upper))
            # In other surroundings the board's lag may be twice the lag in the fit.
            return max(excess - usual - abs(of_ramp), 0.0)
        return 0.0

    def _gradient(
        self, name: str, stamp_ns: int, board: float, rate: float
    ) -> tuple[float, float]:
        """Return sensor less board temperature, and the variance of the sensor's temperature."""
        sensor = self.thermometers[name]
        if self.is_live(stamp_ns, sensor):
            celsius, _, variance = sensor.at(stamp_ns)
            return celsius - board, variance
        return self._lost_gradient(name, stamp_ns, rate)

    def _lost_gradient(self, name: str, stamp_ns: int, rate: float) -> tuple[float, float]:
        """
        Estimate a gradient while its sensor is lost: lag times rate of the board, plus the
        gradient by self-heating in the last static regime (else of the fit, else 0).
        """
        lag = self._board_lag_s
        lower, upper = self._rest_gradient_range
        is_known = name == self.spec.sensors[0] and upper < inf
        usual = 0.5 * (lower + upper) if is_known else 0.0
        gradient = self._rest_gradients.get(name, usual) + lag * rate
        # Largest change of the case temperature after the end of the board's extrapolation [K].
        unseen = self.settings.case.fastest_ramp_k_min / 60.0 * self.board.beyond(stamp_ns)
        of_rate = (LOST_GRADIENT_RELATIVE_SD * gradient) ** 2 + lag * lag * self.board.var_rate
        return gradient, of_rate + unseen * unseen

    def is_settled(self, stamp_ns: int) -> bool:
        """Whether the sd of each lag, initial state included, is below `MEMORY_SETTLED_SD`."""
        state = self.sample(stamp_ns)
        gradients = list(state[GRADIENT : GRADIENT + 2 * len(self.spec.sensors) : 2])
        lags = self.memory.at(stamp_ns, state[BOARD], gradients)[: 2 * len(self.spec.lags)]
        start = start_covariance(self.spec.lags).diagonal().tolist()
        shares = self.memory.remaining_shares(stamp_ns)
        return all(
            variance * share * share + more < MEMORY_SETTLED_SD**2
            for variance, share, more in zip(start, shares, lags[1::2], strict=True)
        )
