# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the settings of thermometers, detector and tracker.

A calibration file has the settings of thermometers and detector; the user sets the tracker's.
"""

from dataclasses import dataclass, field
from typing import Annotated, Final, Literal, get_args

from ..quantities import QUANTITIES, NotNegative, Positive, refuse_impossible

CELL_SIGMAS: Final = 2.5  # quantum / noise sd above which a reading is treated as an interval
# Quantum / noise sd above which noise does not change a reading: the quantum is 6 sd of the
# difference of two readings.
WIDE_CELL_SIGMAS: Final = 8.5
# Hysteresis of the dynamic state: rate that begins the state / rate below which the state ends.
OBVIOUS_SHARE: Final = 1.5
#: Advised span of the board temperature over all bags of a unit's thermal test [K].
ADVISED_SPAN_K: Final = 25.0
#: Smallest rate of the board temperature in a ramp [K/min]; a slower change is a drift in a soak.
RAMP_K_MIN: Final = 0.1


@dataclass(frozen=True, slots=True)
class ThermometerSettings:
    """Physical properties of a temperature sensor; the keys are those of the calibration file."""

    noise_sd_c: Annotated[
        float,
        QUANTITIES['reading noise'],
        'Standard deviation of the white noise of one reading, before quantization, K.',
    ] = 0.005
    quantum_c: Annotated[
        float, QUANTITIES['quantum'], 'Step of the readings, K; 0 for a continuous sensor.'
    ] = 0.0
    fastest_ramp_k_min: Annotated[
        float, QUANTITIES['ramp'], "Rate of the fastest ramps of the sensor's temperature, K/min."
    ] = 3.0
    lag_s: Annotated[
        float,
        QUANTITIES['time constant'],
        'Thermal lag between the surroundings and the sensor, s. At the onset of a ramp the '
        'second derivative of the temperature is ``ramp / lag``.',
    ] = 600.0

    def __post_init__(self) -> None:
        refuse_impossible(self)

    @property
    def has_cells(self) -> bool:
        """Whether the quantum far exceeds the noise, so that a reading is an interval (cell)."""
        return self.quantum_c > CELL_SIGMAS * self.noise_sd_c

    @property
    def has_wide_cells(self) -> bool:
        """Whether the quantum is so large that noise alone never changes a reading."""
        return self.quantum_c > WIDE_CELL_SIGMAS * self.noise_sd_c


EndCondition = Literal['board', 'case']


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Settings of the regime detector: the section `detector` of a calibration file."""

    smallest_ramp_k_min: Annotated[
        float, QUANTITIES['ramp'], 'Rate of the slowest ramp that must be detected, K/min.'
    ] = 0.2
    false_alarms_per_hour: Annotated[
        float,
        QUANTITIES['false alarms'],
        'Number of times per hour of soak at which noise alone may begin the dynamic state.',
    ] = 0.02
    ripple_c: Annotated[
        float,
        QUANTITIES['ripple'],
        'Amplitude of temperature oscillations of the surroundings in a soak, such as the control '
        'ripple of a chamber, K. The ripple causes rates of a sensor up to ``ripple_c / lag_s``.',
    ] = 0.1
    relaxed_rate_k_min: Annotated[
        float,
        QUANTITIES['ramp'],
        'Rate below which a sensor has relaxed, so that the dynamic state may end, K/min.',
    ] = 0.05
    dwell_s: Annotated[
        float,
        QUANTITIES['dwell'],
        'Shortest time for which the rates must be below `relaxed_rate_k_min` before the dynamic '
        'state ends, s.',
    ] = 60.0
    end_condition: Annotated[
        EndCondition,
        'Sensors whose rates must be low before the dynamic state ends: `case` for the leading '
        'sensor alone, as in the paper; `board` for the leading sensor and the board.',
    ] = 'board'
    case: Annotated[ThermometerSettings, 'Settings of the case thermometer.'] = field(
        default_factory=ThermometerSettings
    )
    board: Annotated[ThermometerSettings, 'Settings of the board thermometer.'] = field(
        default_factory=ThermometerSettings
    )

    def __post_init__(self) -> None:
        refuse_impossible(self)
        if self.end_condition not in get_args(EndCondition):
            raise ValueError(
                f"`end_condition` must be 'board' or 'case', got {self.end_condition!r}"
            )
        if self.relaxed_rate_k_min * OBVIOUS_SHARE >= self.smallest_ramp_k_min:
            raise ValueError(
                f'`relaxed_rate_k_min` must be below `smallest_ramp_k_min` / {OBVIOUS_SHARE}, '
                f'got {self.relaxed_rate_k_min} and {self.smallest_ramp_k_min}'
            )


@dataclass(frozen=True)
class ThermalConfig:
    """Times of the tracker that the user sets; ValueError if a value is out of its range."""

    #: Time over which the two sets of coefficients are blended after a change of regime [s], up to
    #: ten times longer if the force would change faster than 1 ug/s; 0: a step, as in the paper.
    transition_time_s: NotNegative = 30.0
    #: Age of the board temperature after which no sample is published [s], unless the correction
    #: is constant; also the time for which board readings after an impossible step are refused.
    temperature_timeout_s: Positive = 60.0
    #: Age of the case temperature after which the board temperature decides the regime [s]; also
    #: the time for which the readings of other sensors after an impossible step are refused.
    case_timeout_s: Positive = 30.0

    def __post_init__(self) -> None:
        refuse_impossible(self)
