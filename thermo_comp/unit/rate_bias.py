# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the bias of a unit's gyroscope: a curve over temperature plus weighted columns."""

import math
from dataclasses import dataclass, field
from typing import Annotated

from ..quantities import QUANTITIES
from .columns import Column
from .functions import TemperatureFunction, check_reference
from .posterior import Posterior, lay_out
from .schema import Vector

#: One millidegree per second, a unit of gyroscope errors [rad/s].
MILLIDEGREE = math.radians(1e-3)
NIL = (0.0, 0.0, 0.0)
#: Largest angular rate of a gyroscope, and its largest bias [rad/s].
LARGEST_RATE = QUANTITIES['angular rate'].at_most or 0.0

_Rate = Annotated[float, QUANTITIES['angular rate']]
_Density = Annotated[float, QUANTITIES['rate noise density']]
_Slow = Annotated[float, QUANTITIES['rate slow noise']]
_Deviation = Annotated[float, QUANTITIES['rate deviation']]


@dataclass(frozen=True)
class RateCurve:
    """The bias of one axis of the gyroscope over temperature in one regime."""

    bias_function: Annotated[TemperatureFunction, 'Fs(t): bias curve [rad/s]; Fs(0) = 0.']
    delta: Annotated[float, 'Bias of this regime less `bias_rad_s`, at T_ref [rad/s].'] = 0.0

    def __post_init__(self) -> None:
        check_reference('bias_function', self.bias_function, 0.0)


@dataclass(frozen=True)
class RateSet:
    """The bias curves of the gyroscope's three axes in one regime."""

    x: RateCurve
    y: RateCurve
    z: RateCurve

    def axes(self) -> tuple[RateCurve, RateCurve, RateCurve]:
        """Return the curves of the axes x, y, z."""
        return self.x, self.y, self.z


@dataclass(frozen=True)
class RateTerm(Column):
    """A column (regressor) of the thermal response, with its weights on the gyroscope's bias."""

    bias: Annotated[Vector, 'Weights on the bias, rad/s per unit of the column.'] = field(
        kw_only=True
    )


@dataclass(frozen=True)
class Gyroscope:
    """
    Bias of the angular rate over temperature: ``w = measured - bias``. The scale factor is 1. For
    each axis `posterior` has the coefficients of both regimes, then the weights of the columns.
    """

    bias_rad_s: Annotated[
        tuple[_Rate, _Rate, _Rate], 'Bias at the reference temperature, averaged over positions.'
    ]
    static: RateSet
    dynamic: RateSet
    noise_density_rad_s_sqrt_hz: Annotated[
        tuple[_Density, _Density, _Density], 'White noise density of each axis.'
    ]
    slow_noise_rad_s_sqrt_h: Annotated[
        tuple[_Slow, _Slow, _Slow],
        'Slow noise: growth of the sd of the bias per root hour, over times shorter than the '
        'correlation time of the slow noise.',
    ] = NIL
    residual_sd_rad_s: Annotated[
        tuple[_Deviation, _Deviation, _Deviation],
        'Sd of the slowly varying error that the correction leaves, such as turn-on offsets.',
    ] = NIL
    response: Annotated[
        tuple[RateTerm, ...], QUANTITIES['columns'], 'Columns of the thermal response.'
    ] = ()
    posterior: Annotated[Posterior | None, 'Covariance of all parameters; null if unknown.'] = None

    def __post_init__(self) -> None:
        if self.posterior is not None:
            axes = zip(self.static.axes(), self.dynamic.axes(), strict=True)
            pairs = ((static.bias_function, dynamic.bias_function) for static, dynamic in axes)
            self.posterior.check_size(lay_out(pairs, len(self.response))[-1].end)
