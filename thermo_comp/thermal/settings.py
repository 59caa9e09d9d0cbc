# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the settings of thermometers, detector and tracker: what is known of a unit beforehand.

They travel in calibrations and to a fleet's workers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Final, Literal, get_args

from ..quantities import QUANTITIES, refuse_impossible

CELL_SIGMAS: Final = 2.5  # a quantum above this many noise sds has cells ...
WIDE_CELL_SIGMAS: Final = 8.5  # ... that noise never crosses: six sds of a difference
OBVIOUS_SHARE: Final = 1.5  # the hysteresis: opens above this many relaxed rates, closes below one
#: What a thermal test of a unit should span, all bags together, as the board says [K].
ADVISED_SPAN_K: Final = 25.0
#: A slower change of the board is a soak's slow drift and no ramp [K/min].
RAMP_K_MIN: Final = 0.1


def refuse_outside(
    settings: object, *, positive: tuple[str, ...], not_negative: tuple[str, ...]
) -> None:
    """Raise ValueError for attributes that are not above, or not at least, zero, and finite."""
    for name in (*positive, *not_negative):
        value = getattr(settings, name)
        if not 0.0 <= value < inf or (value == 0.0 and name in positive):
            least = 'positive' if name in positive else 'zero or positive'
            raise ValueError(f'`{name}` must be {least} and finite, got {value}')


@dataclass(frozen=True, slots=True)
class ThermometerSettings:
    """What is known of a temperature sensor, physically; its keys are the file's keys."""

    noise_sd_c: Annotated[
        float,
        QUANTITIES['reading noise'],
        'Standard deviation of the white noise of one reading, before quantization, K.',
    ] = 0.005
    quantum_c: Annotated[
        float, QUANTITIES['quantum'], 'Step of the readings, K; 0 for a continuous sensor.'
    ] = 0.0
    fastest_ramp_k_min: Annotated[
        float, QUANTITIES['ramp'], 'Rate of the fastest ramps it will see, K/min.'
    ] = 3.0
    lag_s: Annotated[
        float,
        QUANTITIES['time constant'],
        'Thermal lag between the surroundings and the sensor, s. Together with the ramp it says '
        'how sharply the temperature bends: an onset is an acceleration of ``ramp / lag``.',
    ] = 600.0

    def __post_init__(self) -> None:
        """Refuse values that no sensor has."""
        refuse_outside(
            self,
            positive=('noise_sd_c', 'fastest_ramp_k_min', 'lag_s'),
            not_negative=('quantum_c',),
        )
        refuse_impossible(self)

    @property
    def has_cells(self) -> bool:
        """Whether the quantum exceeds the noise so far that a reading is a cell, not a value."""
        return self.quantum_c > CELL_SIGMAS * self.noise_sd_c

    @property
    def has_wide_cells(self) -> bool:
        """Whether a cell is so wide that noise alone never carries a reading across it."""
        return self.quantum_c > WIDE_CELL_SIGMAS * self.noise_sd_c


Closes = Literal['board', 'case']


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """
    What must be seen and what must not; its keys are the calibration file's `detector` section.
    """

    smallest_ramp_k_min: Annotated[
        float, QUANTITIES['ramp'], 'The slowest ramp that must never be missed, K/min.'
    ] = 0.2
    false_alarms_per_hour: Annotated[
        float,
        QUANTITIES['false alarms'],
        "How often the sensor's noise alone may open the dynamic state, per hour of soak.",
    ] = 0.02
    ripple_c: Annotated[
        float,
        QUANTITIES['ripple'],
        "Amplitude of the surroundings' temperature in a soak (a chamber's control ripple), K. "
        'Through the lag it makes a rate of at most ``ripple_c / lag_s``, which is no onset.',
    ] = 0.1
    relaxed_rate_k_min: Annotated[
        float,
        QUANTITIES['ramp'],
        "The lag has died when every sensor's rate is surely below this, K/min.",
    ] = 0.05
    dwell_s: Annotated[
        float,
        QUANTITIES['dwell'],
        'How long it must have been below, and the shortest dynamic state, s.',
    ] = 60.0
    closes: Annotated[
        Closes,
        'What must be calm for the dynamic state to end: the leading sensor alone (`case`, the '
        'end of the change as in the paper), or the board, too (`board`).',
    ] = 'board'
    case: Annotated[ThermometerSettings, 'The two sensors.'] = field(
        default_factory=ThermometerSettings
    )
    board: Annotated[ThermometerSettings, 'The two sensors.'] = field(
        default_factory=ThermometerSettings
    )

    def __post_init__(self) -> None:
        """Refuse values that contradict each other."""
        refuse_outside(
            self,
            positive=('smallest_ramp_k_min', 'false_alarms_per_hour', 'relaxed_rate_k_min'),
            not_negative=('ripple_c', 'dwell_s'),
        )
        refuse_impossible(self)
        if self.closes not in get_args(Closes):
            raise ValueError(f"`closes` must be 'board' or 'case', got {self.closes!r}")
        if self.relaxed_rate_k_min * OBVIOUS_SHARE >= self.smallest_ramp_k_min:
            raise ValueError(
                f'`relaxed_rate_k_min` must be below `smallest_ramp_k_min` / {OBVIOUS_SHARE}, '
                f'got {self.relaxed_rate_k_min} and {self.smallest_ramp_k_min}'
            )


@dataclass(frozen=True)
class ThermalConfig:
    """What the user sets of thermometers and sets; ValueError if a value is out of its range."""

    #: Time over which the sets cross over after a switch [s], stretched where they differ much
    #: (`Correction.gentle_transition`); 0 = the paper's hard switch.
    transition_time_s: float = 30.0
    #: Age of the board temperature at which nothing is published any more [s], and only after
    #: which a sensor that has taken an impossible step starts anew.
    temperature_timeout_s: float = 60.0
    #: Age of the case temperature at which the board decides the regime [s].
    case_timeout_s: float = 30.0

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        refuse_outside(
            self,
            positive=('case_timeout_s', 'temperature_timeout_s'),
            not_negative=('transition_time_s',),
        )
