# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the plausibility checks of temperature readings before an estimator uses the readings.

A board has a heat capacity, so its temperature cannot step. A thermometer has noise, so constant
readings are implausible, above all while the temperature of the other thermometer (case or board)
changes. The case is nearer to the surroundings than the board, so in a ramp the case temperature
changes first. Implausible readings are not used, or their variance is increased by the square of
their possible error.
"""

from enum import Enum
from math import erf, exp, isfinite, log, nan, sqrt
from typing import Final

from .settings import ThermometerSettings
from .thermometer import Thermometer

# Largest possible change between two readings, in addition to quanta and noise: `LARGEST_STEP` [K]
# plus `LARGEST_RATE` [K/s] times the interval between the readings.
LARGEST_STEP: Final = 3.0
LARGEST_RATE: Final = 0.2
#: Number of used readings of a sensor after which readings are checked for steps.
SETTLED_READINGS: Final = 5
#: A sensor's first reading is wrong if the step to the second reading is impossible, and the step
#: from the second to the third reading is less than this share of the first, in K and in K/s.
CONTINUED_SHARE: Final = 0.25
#: A sensor stands still after `STILL_S` [s] with this number of equal readings or, if larger, the
#: number of equal readings that noise gives with the probability `STILL_PROBABILITY`.
STILL_READINGS: Final = 20
STILL_S: Final = 5.0
STILL_PROBABILITY: Final = 1e-9
#: Least number of equal readings in a row that are doubtful, if the quantum is near the noise.
DOUBTFUL_READINGS: Final = 4
# Constant readings of a sensor are frozen if the other sensor's temperature changes by more than
# noise, quanta and this margin [K].
OTHER_MOVED: Final = 0.3
OTHER_MOVED_BEYOND_CELL: Final = 0.7  # replaces `OTHER_MOVED` [K] if the quantum exceeds the noise
LARGEST_ERROR: Final = 60.0  # largest assumed error of a sensor with constant readings [K]

# In a ramp the sensor with the larger temperature change leads if the changes of the two sensors
# differ by more than `LEAD_K` and `LEAD_SHARE`, at `LEAD_READINGS` readings in a row.
LEAD_K: Final = 0.5  # difference of the changes [K]
LEAD_SHARE: Final = 0.15  # difference of the changes / larger change
LEAD_READINGS: Final = 5
LEAD_RATE_SHARE: Final = 0.3  # slower / faster rate of the two sensors, least value for a lead
#: Slower / faster rate of case and board above which a leading board gets a larger variance.
DOUBTFUL_RATE_SHARE: Final = 0.03
#: A sensor copies the board if this number of its changed readings in a row equal the board's.
COPIED_READINGS: Final = 10
_TOGETHER_NS: Final = 10_000_000  # largest time between two readings that are compared [ns]
_NOISE_SDS: Final = 6.0  # largest deviation of a temperature due to noise, in sd
#: Time [ns] for which the rates of case and board must be low before their temperatures are taken
#: as constant: estimates of rates start at 0, even in a unit that heats itself after switch-on.
_CALM_NS: Final = 120 * 10**9


class Fault(Enum):
    """The faults of a temperature sensor; the values are the words of the diagnostics."""

    NONE = 'none'
    #: Readings that have been equal for longer than noise explains: used with a growing variance.
    STILL = 'stands still'
    #: Readings that stay equal while the temperature of board or case changes: they are not used.
    FROZEN = 'frozen'
    #: A reading that has changed faster than the temperature of any part can: it is not used.
    STEP = 'jumped'
    #: A board temperature that differs from the case's by more than ramp and self-heating explain,
    #: as with a loose thermometer: its readings are used with a larger variance.
    LOOSE = 'apart'
    #: Readings after an impossible jump that was not followed by a jump back: they are used with
    #: a variance that includes the square of the jump.
    SHIFTED = 'shifted'
    #: Readings that equal the board's, as if both inputs had one topic: they are used, and the
    #: variance of the gradient includes the square of a gradient estimated without the sensor.
    COPY = 'copy of the board'


class SensorCheck:
    """
    Judges readings of `sensor` by its earlier readings and by the readings of `other`.

    lag_s: lag of the board behind `other` [s], 0 if `other` is the board
    is_revived: whether the estimator of `sensor` must restart
    """

    def __init__(self, sensor: Thermometer, other: Thermometer, lag_s: float) -> None:
        self.sensor, self._other, self.lag_s = sensor, other, lag_s
        #: Signed sum [K] of the impossible jumps after which the readings were used.
        self.shift = 0.0
        settings = sensor.settings
        self._quantum = settings.quantum_c
        self._has_cells = settings.has_cells
        self._n_still = still_readings(settings)
        self._decay = 1e-9 / max(settings.lag_s, other.settings.lag_s)
        self._largest_noise = self._quantum + _NOISE_SDS * settings.noise_sd_c
        self._n_doubtful = min(DOUBTFUL_READINGS, self._n_still)
        self.reset()

    def reset(self) -> None:
        """Forget the sensor's past readings."""
        self.fault = Fault.NONE
        self.step = 0.0
        self.is_revived = False
        self._n_same = 0
        self._n_used = 0
        self._jumped = 0.0
        self._jumped_ns = 0
        # Temperature of `other` [degC] when the reading of `sensor` last changed.
        self._other_then = nan
        # Since `sensor` last changed: its expected change, and the largest change of `other` [K].
        self._expected = self._moved = 0.0
        self._seen_ns: int | None = None
        #: Stamps and values [degC] of the first two readings; None from the third reading on.
        self._first: list[tuple[int, float]] | None = []

    @property
    def finding(self) -> tuple[Fault, float]:
        """The present fault, and the size of the last jump [K], or the sum of jumps if shifted."""
        is_shifted = self.fault is Fault.NONE and abs(self.shift) > LARGEST_STEP
        return (Fault.SHIFTED, self.shift) if is_shifted else (self.fault, self.step)

    def forget_other(self) -> None:
        """Measure the change of `other` anew, from the next reading of `other` on."""
        self._other_then = nan

    def has_wrong_start(self, stamp_ns: int, celsius: float) -> bool:
        """Return whether the first reading of `sensor` is wrong, by its next two readings."""
        first = self._first
        if first is None or not isfinite(celsius) or (first and stamp_ns <= first[-1][0]):
            return False
        if len(first) < 2:
            first.append((stamp_ns, celsius))
            return False
        self._first = None
        (first_ns, wrong), (second_ns, second) = first
        step, after = second - wrong, celsius - second
        possible = LARGEST_RATE * (second_ns - first_ns) * 1e-9 + 2.0 * self._quantum
        # Change from the second to the third reading in a ramp that caused the first change [K].
        continued = abs(step) * (stamp_ns - second_ns) / (second_ns - first_ns)
        is_step = abs(step) > possible + _NOISE_SDS * self.sensor.settings.noise_sd_c
        return is_step and abs(after) < CONTINUED_SHARE * min(abs(step), continued)

    def admits(self, stamp_ns: int, celsius: float) -> bool:
        """Return whether the estimator may use a new reading [degC]."""
        sensor = self.sensor
        last_ns, fault = sensor.stamp_ns, self.fault
        self.is_revived = False
        if last_ns is None or stamp_ns <= last_ns or not isfinite(celsius):
            return True  # a first reading, or a reading that the estimator itself rejects
        if celsius == sensor.reading:
            self._n_same += 1
            self.fault = self._judge_still(stamp_ns)
            return self.fault != Fault.FROZEN
        change = celsius - sensor.reading
        is_doubtful = self._n_same >= self._n_doubtful and not self._has_cells
        if is_doubtful and abs(change) > self._largest_noise:
            # A large change after equal readings shows that they and the estimate were wrong.
            self.note_jump(stamp_ns, change)
        self._n_same = 0
        self._other_then = nan
        age = (stamp_ns - last_ns) * 1e-9
        # To save time, accept a reading near the estimate without the tests below.
        is_near = abs(celsius - sensor.temperature) + abs(sensor.rate) * age < LARGEST_STEP
        if fault is Fault.NONE and is_near:
            self._n_used += 1
            return True
        self.is_revived = fault in (Fault.STILL, Fault.FROZEN)
        if self._n_used >= SETTLED_READINGS and not self.is_revived:
            expected, _, variance = sensor.at(stamp_ns)
            step = celsius - expected
            possible = LARGEST_STEP + 2.0 * self._quantum + LARGEST_RATE * age
            if abs(step) > possible + _NOISE_SDS * sqrt(variance):
                self.fault = Fault.STEP
                self.step = step
                return False
            if fault is Fault.STEP:
                # After a rejected step the estimate starts again if an accepted reading differs
                # from the expected temperature by more than noise.
                self.is_revived = abs(step) > self._largest_noise + _NOISE_SDS * sqrt(variance)
        self.fault = Fault.NONE
        self._n_used += 1
        return True

    def watch_other(self) -> None:
        """Note the change of `other` [K] since the last change of the reading of `sensor`."""
        other = self._other
        now_ns = other.stamp_ns
        moved = other.temperature - self._other_then
        if now_ns is None or not isfinite(moved):
            self._other_then = other.temperature
            self._expected = self._moved = 0.0
            self._seen_ns = now_ns
            return
        if self.lag_s > 0.0:
            dt = (now_ns - (self._seen_ns or now_ns)) * 1e-9
            if dt > 0.0:
                # `sensor`, the board's, should follow `other` with a first-order lag.
                self._expected += dt / (dt + self.lag_s) * (moved - self._expected)
        else:
            # The board may approach, but not pass, the constant temperature of `sensor`.
            ahead = self.sensor.temperature - self._other_then
            self._expected = moved - min(max(moved, min(ahead, 0.0)), max(ahead, 0.0))
        self._seen_ns = now_ns
        self._moved = max(self._moved, abs(moved))

    def _judge_still(self, stamp_ns: int) -> Fault:
        sensor, other = self.sensor, self._other
        if sensor.changed_ns is None:
            return Fault.NONE
        margin = _NOISE_SDS * sqrt(other.var_temperature) + 2.0 * other.settings.quantum_c
        if self._has_cells:
            hidden = 2.0 * self._quantum + OTHER_MOVED_BEYOND_CELL + margin
            is_frozen = self.fault == Fault.FROZEN or abs(self._expected) > hidden
            return Fault.FROZEN if is_frozen else Fault.NONE
        still_s = (stamp_ns - sensor.changed_ns) * 1e-9
        if self._n_same < self._n_still or still_s < STILL_S:
            return Fault.NONE
        return Fault.FROZEN if self._moved > OTHER_MOVED + margin else Fault.STILL

    def note_jump(self, stamp_ns: int, change: float) -> None:
        """Increase the variance by a jump `change` [K]: readings before or after it are wrong."""
        self._jumped = self._jump_at(stamp_ns) + change * change
        self._jumped_ns = stamp_ns

    def _jump_at(self, stamp_ns: int) -> float:
        if not self._jumped:
            return 0.0
        return self._jumped * exp(-max(stamp_ns - self._jumped_ns, 0) * self._decay)

    def extra_variance(self, stamp_ns: int) -> float:
        """Return the variance of the temperature due to doubtful readings and jumps [K^2]."""
        return max(self._jump_at(stamp_ns), self.shift**2) + self.still(stamp_ns)[0] ** 2

    def still(self, stamp_ns: int) -> tuple[float, float]:
        """
        Return the possible error of constant readings [K], and the time since they last changed
        [s]. Both are 0 if noise or a large quantum explains why the readings are equal.
        """
        changed_ns = self.sensor.changed_ns
        is_explained = self._has_cells and self.fault is not Fault.FROZEN
        if changed_ns is None or is_explained or self._n_same < self._n_doubtful:
            return 0.0, 0.0
        still_s = max(stamp_ns - changed_ns, 0) * 1e-9
        fastest_rate = self.sensor.settings.fastest_ramp_k_min / 60.0
        return min(fastest_rate * still_s, LARGEST_ERROR), still_s


def still_readings(settings: ThermometerSettings) -> int:
    """Return the number of consecutive equal readings that noise does not explain."""
    same = erf(settings.quantum_c / (2.0 * sqrt(2.0) * settings.noise_sd_c))
    if not 0.0 < same < 1.0:
        return STILL_READINGS
    return max(STILL_READINGS, round(log(STILL_PROBABILITY) / log(same)))


class CopyCheck:
    """
    Finds out whether a sensor repeats the board's readings, as when one topic is given for both.
    The sensor's gradient (its temperature less the board's) is then wrong: 0 even in a ramp.
    """

    def __init__(self) -> None:
        self.is_copy = False
        self._n_equal = 0
        self._compared = nan
        #: The reading that waits for a comparison: whether of the board, stamp [ns], value [degC].
        self._waiting: tuple[bool, int, float] | None = None

    def update(self, is_board: bool, stamp_ns: int, celsius: float) -> None:
        """Take a reading of the board or of the sensor."""
        before, self._waiting = self._waiting, (is_board, stamp_ns, celsius)
        if before is None or before[0] is is_board or abs(stamp_ns - before[1]) > _TOGETHER_NS:
            return
        self._waiting = None
        if celsius != before[2]:
            self._n_equal, self.is_copy = 0, False
        elif celsius != self._compared:
            self._n_equal += 1
            self.is_copy = self._n_equal >= COPIED_READINGS
        self._compared = celsius


class LeadCheck:
    """
    Finds out whether the case or the board temperature changes first (leads) in a ramp.

    While case and board temperature change in the same direction, their changes since the rates of
    both were last low are compared. Heat from outside changes the case temperature first. A board
    leads if the topics of case and board are swapped, or if the heat comes from inside; the
    gradient terms are then wrong. `extra_variance`: if the board may lead, the square of the
    difference between the changes of board and case temperature, else 0 [K^2].
    """

    def __init__(self, case: Thermometer, board: Thermometer, calm_k_min: float) -> None:
        self._calm_rate = calm_k_min / 60.0
        self._case, self._board = case, board
        self._quanta = case.settings.quantum_c + board.settings.quantum_c
        self._margin = LEAD_K + 2.0 * self._quanta
        self.is_reversed = False
        self.extra_variance = 0.0
        self._calm: tuple[float, float] | None = None
        self._calm_ns: int | None = None
        self._n_alike = 0
        self._is_against = False

    def update(self, is_static: bool) -> None:
        """Compare the temperatures of case and board, after a reading of the case."""
        case, board = self._case, self._board
        calm = self._calm_rate
        if is_static or (-calm < case.rate < calm and -calm < board.rate < calm):
            self._n_alike, self.extra_variance = 0, 0.0
            stamp_ns = case.stamp_ns or 0
            self._calm_ns = stamp_ns if self._calm_ns is None else self._calm_ns
            is_calm = is_static or stamp_ns - self._calm_ns >= _CALM_NS
            if is_calm and board.stamp_ns is not None:
                self._calm = (case.temperature, board.temperature)
            return
        self._calm_ns = None
        if self._calm is None or not (case.is_ready and board.is_ready):
            return
        by_case, by_board = case.temperature - self._calm[0], board.temperature - self._calm[1]
        direction = 1.0 if by_case + by_board > 0.0 else -1.0
        slow, fast = sorted((direction * case.rate, direction * board.rate))
        noise = _NOISE_SDS * sqrt(case.var_temperature + board.var_temperature)
        lead = direction * (by_case - by_board)
        if lead > -noise - self._quanta:
            self.extra_variance = 0.0
        elif slow > DOUBTFUL_RATE_SHARE * fast:
            self.extra_variance = lead * lead
        smallest_lead = max(self._margin + noise, LEAD_SHARE * max(abs(by_case), abs(by_board)))
        if slow <= LEAD_RATE_SHARE * fast or abs(lead) <= smallest_lead:
            return
        is_against = lead < 0.0
        self._n_alike = self._n_alike + 1 if is_against == self._is_against else 1
        self._is_against = is_against
        if self._n_alike >= LEAD_READINGS:
            self.is_reversed = is_against
