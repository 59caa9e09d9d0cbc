# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the causal decision [1]_ between static and dynamic regime, from stamped readings alone.

The dynamic state *begins* when the rate of the leading sensor departs from its rate in the soak
(`change_detector`), or when the rate of case or board is clearly as large as in a ramp. The
dynamic state is *held* while the rate of the case or of the board, at present or extrapolated by
half a lag, may exceed `relaxed_rate_k_min`; so a ramp of constant rate stays dynamic. With the
`end_condition` 'case' (the paper's rule) only the rate of the case is tested or, while the case
gives no readings, the rate of the board (docs/regime.md).

References
----------
.. [1] M. Basseville, I. V. Nikiforov, "Detection of Abrupt Changes", Prentice-Hall, 1993.

"""

from enum import IntEnum
from math import sqrt
from typing import Final

from .change_detector import ChangeDetector
from .settings import OBVIOUS_SHARE, DetectorSettings, ThermometerSettings
from .thermometer import Thermometer

HOLD_LAGS: Final = 0.75  # shortest duration of the dynamic state / lag of the leading sensor
# A rate must be below a limit by this number of its sds: only 0.5, because in a soak most of the
# variance of the rate is an allowance for a ramp that may begin at any time.
SURE_SIGMAS: Final = 0.5
OBVIOUS_SIGMAS: Final = 5.0  # a rate must exceed a limit by this number of its sds
FIRST_READINGS: Final = 20  # number of readings after which the noise estimate is reliable


class Regime(IntEnum):
    """Thermal regime of the unit; STATIC and DYNAMIC have the values of the paper's S."""

    UNKNOWN = -1
    STATIC = 0
    DYNAMIC = 1


class RegimeDetector:
    """
    State machine over the temperature estimates of the case and the board.

    `direction`: in the dynamic regime -1 while cooling, +1 while heating; 0 in other regimes.
    """

    def __init__(self, settings: DetectorSettings) -> None:
        self.settings = settings
        self._relaxed_rate = settings.relaxed_rate_k_min / 60.0
        self._dwell_ns = round(settings.dwell_s * 1e9)
        self._case = _Watch(settings, settings.case)
        self._board = _Watch(settings, settings.board)
        self.regime = Regime.UNKNOWN
        self.direction = 0
        self._calm_ns: int | None = None
        self._held_until_ns: int | None = None
        self._turning_ns: int | None = None
        self._is_grown = False

    def update(self, stamp_ns: int, case: Thermometer | None, board: Thermometer | None) -> Regime:
        """Decide the regime after a reading of the case or, if `case` is None, of the board."""
        if case is not None:
            lead, change = case, self._case.change
            if self.settings.end_condition == 'case':
                board = None
        elif board is not None:
            lead, change = board, self._board.change
        else:
            return self.regime
        is_static, is_dynamic = self.regime is Regime.STATIC, self.regime is Regime.DYNAMIC
        pace = 1.0 if not is_dynamic else (0.0 if self._is_grown else 0.25)
        departure = change.update(stamp_ns, lead, pace)
        if not lead.is_ready:
            return self.regime

        is_calm = self._case.is_calm(stamp_ns, case, change.swing)
        is_calm = self._board.is_calm(stamp_ns, board, change.swing) and is_calm
        if is_dynamic and not self._is_grown:
            # The onset of a ramp is detected while the rate is still low. Before the rate has
            # exceeded 1.5 times the relaxed rate, only a rate near the baseline is taken as low.
            self._is_grown = abs(lead.rate) > OBVIOUS_SHARE * self._relaxed_rate
            is_calm = is_calm and change.is_back()
        if not is_calm:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = stamp_ns

        if not is_dynamic:
            speed = OBVIOUS_SHARE * self._relaxed_rate
            # If noise never changes a reading, two successive changes in one direction prove
            # a ramp, even in an unknown regime.
            is_sure = lead.settings.has_wide_cells and departure * lead.rate > speed
            if departure and (is_static or is_sure):
                self._open(stamp_ns, departure, lead)
            elif not is_calm and (is_static or lead.n_in_row > FIRST_READINGS):
                direction = _obvious(lead, speed)
                if not direction and board is not None and board.is_ready:
                    direction = _obvious(board, speed)
                if direction:
                    self._open(stamp_ns, direction, lead)
        else:
            self._turn(stamp_ns, _obvious(lead, change.swing))
        dwell_ns = self._dwell_ns * (1.0 + 2.0 * change.swing / self._relaxed_rate)
        if (
            self._calm_ns is not None
            and self.regime is not Regime.STATIC
            and stamp_ns - self._calm_ns >= dwell_ns
            and (self._held_until_ns is None or stamp_ns >= self._held_until_ns)
        ):
            # Before the first soak the rate's swing is unknown: allow a larger baseline error.
            is_first = self.regime == Regime.UNKNOWN
            change.settle(lead, 0.5 * self._relaxed_rate if is_first else 0.0)
            self.regime = Regime.STATIC
            self.direction = 0
        return self.regime

    def _turn(self, stamp_ns: int, direction: int) -> None:
        """Reverse the direction if the rate's new sign lasts; coarse quanta may flip the sign."""
        if direction == self.direction or not direction:
            self._turning_ns = None
        elif self._turning_ns is None:
            self._turning_ns = stamp_ns
        if self._turning_ns is not None and (
            self.direction == 0 or stamp_ns - self._turning_ns >= self._dwell_ns // 2
        ):
            self.direction = direction
            self._turning_ns = None

    def _open(self, stamp_ns: int, direction: int, lead: Thermometer) -> None:
        self.regime = Regime.DYNAMIC
        self.direction = direction
        self._turning_ns = None
        self._is_grown = False
        # A ramp is detected before its rate is large, so the dynamic state has a minimum length.
        hold_ns = round(HOLD_LAGS * 1e9 * lead.settings.lag_s)
        self._held_until_ns = stamp_ns + max(self._dwell_ns, hold_ns)


class _Watch:
    """The change detector of a sensor, and the test that its rate is low and will stay low."""

    def __init__(self, settings: DetectorSettings, sensor: ThermometerSettings) -> None:
        self.change = ChangeDetector(
            sensor,
            settings.smallest_ramp_k_min / 60.0,
            settings.ripple_c,
            settings.false_alarms_per_hour / 3600.0,
        )
        self._relaxed = settings.relaxed_rate_k_min / 60.0
        self._memory_s = 0.25 * sensor.lag_s
        self._stale_ns = round(0.5e9 * sensor.lag_s)
        # At the relaxed rate, or at a second derivative `bend` [K/s^2], a reading changes within
        # `still_s`: a reading that is unchanged for longer proves a low rate.
        quantum, bend = sensor.quantum_c, settings.smallest_ramp_k_min / 60.0 / sensor.lag_s
        still_s = max(quantum / self._relaxed, 2.0 * sqrt(2.0 * quantum / bend))
        self._still_ns = round(1e9 * still_s)
        self._stamp_ns: int | None = None
        self._mean = 0.0

    def is_calm(self, stamp_ns: int, sensor: Thermometer | None, lead_swing: float) -> bool:
        """Update a sensor's mean rate; return whether the rate is low or no reading is recent."""
        seen_ns = None if sensor is None else sensor.stamp_ns
        if sensor is None or seen_ns is None or stamp_ns - seen_ns > self._stale_ns:
            return True
        if not sensor.is_ready:
            self._stamp_ns = None
            return False
        change = self.change
        # The rate of `Thermometer`, a third-order filter, overshoots if the temperature
        # oscillates; the rate of the detector's filters does not.
        rate = change.rate if change.is_following(stamp_ns) else sensor.rate
        sd, relaxed = sqrt(sensor.var_rate), self._relaxed
        stamp, self._stamp_ns = self._stamp_ns, stamp_ns
        if stamp is None or sd > relaxed:
            self._mean = rate  # the rate is too uncertain for a mean
        else:
            dt = (stamp_ns - stamp) * 1e-9
            self._mean += dt / (dt + self._memory_s) * (rate - self._mean)
        changed = sensor.changed_ns
        if self._still_ns and changed is not None and stamp_ns - changed > self._still_ns:
            return True
        bound = relaxed + min(change.swing, 0.25 * relaxed) - SURE_SIGMAS * sd
        if not -bound < rate < bound:
            return False
        # Extrapolate the rate half a lag ahead, from its mean over the last quarter lag.
        ahead = 3.0 * rate - 2.0 * self._mean
        limit = max(relaxed, 3.0 * lead_swing)
        return -limit < ahead < limit


def _obvious(sensor: Thermometer, limit: float) -> int:
    """Return the sign of a rate that exceeds a limit by `OBVIOUS_SIGMAS` sd; 0 if it does not."""
    margin = abs(sensor.rate) - limit
    if margin > 0.0 and margin * margin > OBVIOUS_SIGMAS**2 * sensor.var_rate:
        return 1 if sensor.rate > 0.0 else -1
    return 0
