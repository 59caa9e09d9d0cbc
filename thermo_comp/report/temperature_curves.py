# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns bias and scale of a calibration over temperature, in a soak and in ramps, with their sd."""

import math
from typing import NamedTuple

import numpy as np

from ..typing import Floats
from ..unit.calibration import Calibration, RegimeSet
from ..unit.gravity import MICRO_G
from ..unit.prediction import bias_and_scale, in_a_soak, ramp_states, sd_of_states

_N_CURVE = 61
#: Steps of a table over temperature [K], and the largest number of temperatures in a table.
_STEPS_K = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_MOST_TEMPERATURES = 8


class Program(NamedTuple):
    """A soak, or a ramp from a soak at one end of a set's temperatures to the other end."""

    name: str  # soak, heating or cooling
    regime: RegimeSet
    rate_k_min: float

    @property
    def label(self) -> str:
        """The name of the soak or ramp and, for a ramp, the rate."""
        return f'{self.name} at {abs(self.rate_k_min):g} K/min' if self.rate_k_min else self.name


class Curve(NamedTuple):
    """
    Bias [micro-g] and scale [ppm] of x, y, z in a soak or ramp, shape (n, 6), and their sd.

    `value` is the difference from a soak at the reference temperature; `sd` is the sd of bias and
    scale, not of the difference.
    """

    program: Program
    temperature: Floats
    value: Floats
    sd: Floats


def programs(calibration: Calibration) -> list[Program]:
    """Return a soak and, if bias or scale depend on the rate, ramps at half the valid rates."""
    static, dynamic = calibration.regime_sets()
    result = [Program('soak', static, 0.0)]
    if calibration.response or static != dynamic:
        cooling, heating = (round(edge / 2.0, 1) for edge in dynamic.rate_range_k_min)
        ramps = (Program('heating', dynamic, heating), Program('cooling', dynamic, cooling))
        result += [ramp for ramp in ramps if ramp.rate_k_min]
    return result


def evaluate(calibration: Calibration, program: Program, temperature: Floats) -> Curve:
    """Evaluate bias and scale in a soak or ramp at board temperatures, shape (n,)."""
    rate = program.rate_k_min / 60.0
    lower, upper = program.regime.temperature_range_c
    begun = lower if rate > 0.0 else upper
    lasted_s = (temperature - begun) / rate if rate else 0.0
    states = ramp_states(calibration, temperature, rate, lasted_s)
    bias, scale = bias_and_scale(calibration, states)
    sd_bias, sd_scale = sd_of_states(calibration, states)
    bias_0, _, scale_0, _ = in_a_soak(calibration)
    value = np.hstack(((bias - bias_0) / MICRO_G, (scale / scale_0 - 1.0) * 1e6))
    return Curve(program, temperature, value, np.hstack((sd_bias / MICRO_G, sd_scale * 1e6)))


def curves(calibration: Calibration) -> list[Curve]:
    """Evaluate soak and ramps over the temperature range of their sets."""
    return [
        evaluate(calibration, program, np.linspace(*program.regime.temperature_range_c, _N_CURVE))
        for program in programs(calibration)
    ]


def slopes(soak: Curve) -> Floats:
    """Fit a straight line to each column of a soak and give its slope per kelvin, shape (6,)."""
    return np.asarray(np.polyfit(soak.temperature, soak.value, 1)[0])


def table_temperatures(lowest: float, highest: float) -> Floats:
    """Return the temperatures of a table: both ends of a range, and round numbers in between."""
    span = highest - lowest
    step = next((k for k in _STEPS_K if span <= k * (_MOST_TEMPERATURES - 2)), _STEPS_K[-1])
    within = step * np.arange(math.ceil(lowest / step), math.floor(highest / step) + 1)
    # Skip round temperatures within a quarter of a step from an end of the range: these rows would
    # repeat the row of the end.
    kept = within[(within - lowest > 0.25 * step) & (highest - within > 0.25 * step)]
    return np.array([lowest, *kept, highest])
