# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the Calibration value: everything that is known about one unit, validated as a whole.

The dataclasses mirror the calibration file key by key. One object is one unit; it is immutable,
so a running node swaps it by one reference.

Measurement model, per axis i and regime r (eqs 6-9, and beyond the paper the gradient, rate and
memory terms), with ``t = T_board - T_ref``, ``g = T_case - T_board``, ``q = dT_board/dt`` and
``m_k = T_board - L_k`` where ``dL_k/dt = (T_board - L_k) / tau_k``::

    bias  = bias_i + delta + Fs(t) + gradient.bias g + rate.bias q + sum_k memory.bias[k] m_k
    scale = K_i (Fc(t) + gradient.scale g + rate.scale q + sum_k memory.scale[k] m_k)
    x_i   = (N_i - bias) / scale
    f     = M x

"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..text import LONGEST_SERIAL, valid_serial
from ..thermal.settings import DetectorSettings
from ..typing import Floats
from .functions import CubicSpline, Exponential, Polynomial

#: The version of the file's layout that this code writes and reads.
FORMAT_VERSION = 1
AXES = ('x', 'y', 'z')
#: A scale function, with every term at its worst, must stay above this fraction of the reference.
SMALLEST_RELATIVE_SCALE = 0.1
#: How exactly a function must meet its value at the reference.
NORMALISATION_TOLERANCE = 1e-9

_STRICT = {'extra': 'forbid', 'strict': True, 'allow_inf_nan': False}

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Range = tuple[float, float]
Function = Annotated[Polynomial | CubicSpline | Exponential, Field(discriminator='kind')]


@dataclass(frozen=True)
class Unit:
    """
    What is calibrated, and in which unit it speaks.

    """

    __pydantic_config__ = _STRICT

    serial: Annotated[
        str,
        Field(
            min_length=1,
            max_length=LONGEST_SERIAL,
            description='Serial number of the unit, one printable line.',
        ),
    ]
    input: Annotated[
        Literal['counts', 'm/s^2'],
        Field(description='Unit of the raw samples: counts per conversion cycle, or m/s^2.'),
    ]
    full_scale: Annotated[
        Positive,
        Field(description='A sample at or beyond this magnitude is saturated, in input units.'),
    ]
    cycle_time_s: Annotated[
        Positive, Field(description='Length of a conversion cycle = sample interval [s].')
    ]

    def __post_init__(self) -> None:
        valid_serial(self.serial)


@dataclass(frozen=True)
class AxisReference:
    """
    One axis at the reference temperature.

    """

    __pydantic_config__ = _STRICT

    scale_factor: Annotated[
        float, Field(description='K: input units per m/s^2 at the reference temperature.')
    ]
    bias: Annotated[
        float, Field(description='dNs(0): zero offset at the reference, in input units.')
    ]

    def __post_init__(self) -> None:
        if not self.scale_factor:
            raise ValueError('`scale_factor` must not be 0')


@dataclass(frozen=True)
class Axes:
    """
    The three axes at the reference temperature.

    """

    __pydantic_config__ = _STRICT

    x: AxisReference
    y: AxisReference
    z: AxisReference


@dataclass(frozen=True)
class LinearTerm:
    """
    Coefficients of one thermal regressor, on the bias and on the scale.

    """

    __pydantic_config__ = _STRICT

    bias: Annotated[float, Field(description='Input units per unit of the regressor.')] = 0.0
    scale: Annotated[float, Field(description='Relative, per unit of the regressor.')] = 0.0


@dataclass(frozen=True)
class MemoryTerm:
    """
    Coefficients of the thermal memory, one per time constant.

    """

    __pydantic_config__ = _STRICT

    bias: Annotated[tuple[float, ...], Field(description='Input units per K.')] = ()
    scale: Annotated[tuple[float, ...], Field(description='Relative, per K.')] = ()


@dataclass(frozen=True)
class AxisSet:
    """
    The correction of one axis in one regime (method section 3: items 2 to 4, and more).

    """

    __pydantic_config__ = _STRICT

    bias_function: Annotated[Function, Field(description='Fs(t), input units; Fs(0) = 0.')]
    scale_function: Annotated[Function, Field(description='Fc(t), dimensionless; Fc(0) = 1.')]
    delta: Annotated[
        float, Field(description='Bias of this regime relative to axes.bias, input units.')
    ] = 0.0
    gradient: Annotated[LinearTerm, Field(description='Terms in T_case - T_board [K].')] = (
        LinearTerm()
    )
    rate: Annotated[LinearTerm, Field(description='Terms in dT_board/dt [K/s].')] = LinearTerm()
    memory: Annotated[MemoryTerm, Field(description='Terms in T_board minus its lags [K].')] = (
        MemoryTerm()
    )
    residual_sd_m_s2: Annotated[
        NotNegative, Field(description='What this set leaves unexplained, as a slow error.')
    ] = 0.0
    covariance: Annotated[
        tuple[tuple[float, ...], ...],
        Field(
            description='Lower triangle of the covariance of [bias level, Fs free coefficients, '
            'gradient.bias, rate.bias, memory.bias.., relative scale level, Fc free '
            'coefficients, gradient.scale, rate.scale, memory.scale..]; empty when unknown.'
        ),
    ] = ()

    def __post_init__(self) -> None:
        for name, function, expected in (
            ('bias_function', self.bias_function, 0.0),
            ('scale_function', self.scale_function, 1.0),
        ):
            value = function.value(0.0)
            if not abs(value - expected) <= NORMALISATION_TOLERANCE:
                raise ValueError(f'`{name}` must be {expected:g} at the reference, got {value:g}')
        if len(self.memory.bias) != len(self.memory.scale):
            raise ValueError(
                '`memory` must have as many bias as scale coefficients, '
                f'got {len(self.memory.bias)} and {len(self.memory.scale)}'
            )
        if self.covariance:
            _check_covariance(self.covariance, self.n_bias_parameters + self.n_scale_parameters)

    @property
    def n_bias_parameters(self) -> int:
        """
        Number of bias entries in `covariance`.

        """
        return 3 + self.bias_function.n_free + len(self.memory.bias)

    @property
    def n_scale_parameters(self) -> int:
        """
        Number of scale entries in `covariance`.

        """
        return 3 + self.scale_function.n_free + len(self.memory.scale)


@dataclass(frozen=True)
class RegimeSet:
    """
    The coefficient set of one regime, with the ranges over which it was fitted.

    Outside a range the regressor is held at the range's edge and the covariance grows.

    """

    __pydantic_config__ = _STRICT

    temperature_range_c: Annotated[Range, Field(description='Board temperature [degC].')]
    rate_range_k_min: Annotated[Range, Field(description='dT_board/dt [K/min].')]
    x: AxisSet
    y: AxisSet
    z: AxisSet
    gradient_range_k: Annotated[Range, Field(description='T_case - T_board [K].')] = (-50.0, 50.0)
    memory_range_k: Annotated[Range, Field(description='T_board minus its lags [K].')] = (
        -50.0,
        50.0,
    )

    def __post_init__(self) -> None:
        for name in (
            'temperature_range_c',
            'rate_range_k_min',
            'gradient_range_k',
            'memory_range_k',
        ):
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise ValueError(f'`{name}` must be [lower, upper] with lower < upper')

    def axes(self) -> tuple[AxisSet, AxisSet, AxisSet]:
        """
        Return the three axes in order.

        """
        return self.x, self.y, self.z


@dataclass(frozen=True)
class Source:
    """
    One bag that the calibration was fitted on.

    """

    __pydantic_config__ = _STRICT

    name: str
    sha256: str = ''
    n_samples: int = 0


@dataclass(frozen=True)
class ResidualSummary:
    """
    |g| error of one section of the fitted data, before and after.

    """

    __pydantic_config__ = _STRICT

    section: str
    n_windows: int
    raw_rms_m_s2: NotNegative
    rms_m_s2: NotNegative
    max_m_s2: NotNegative


@dataclass(frozen=True)
class Provenance:
    """
    Where the numbers come from.

    """

    __pydantic_config__ = _STRICT

    created: str = ''
    tool_version: str = ''
    model: str = ''
    sources: tuple[Source, ...] = ()
    residuals: tuple[ResidualSummary, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """
    One unit's calibration.

    Raises
    ------
    ValueError
        If parts contradict each other: naming the key, the rule and the value.

    """

    __pydantic_config__ = _STRICT

    format_version: Annotated[int, Field(description='Version of this layout: 1.')]
    unit: Unit
    reference_temperature_c: Annotated[float, Field(description='T_ref; the paper uses 20.')]
    gravity_m_s2: Annotated[
        float, Field(gt=9.0, lt=10.5, description='Local gravity used by the fit.')
    ]
    axes: Axes
    static: Annotated[RegimeSet, Field(description='The set of the static regime, S = 0.')]
    dynamic: Annotated[RegimeSet, Field(description='The set of the dynamic regime, S = 1.')]
    noise_density_m_s2_sqrt_hz: Annotated[
        tuple[Positive, Positive, Positive],
        Field(description='White noise of each axis; variance of a sample = density^2 / cycle.'),
    ]
    misalignment: Annotated[
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]],
        Field(description='M: lower triangular, unit diagonal; sensitivity axes to frame.'),
    ] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    misalignment_sd: Annotated[
        tuple[NotNegative, NotNegative, NotNegative],
        Field(description='Standard deviations of M[1][0], M[2][0], M[2][1].'),
    ] = (0.0, 0.0, 0.0)
    memory_time_constants_s: Annotated[
        tuple[Positive, ...], Field(description='tau_k of the lags of T_board.')
    ] = ()
    board_lag_s: Annotated[
        Positive,
        Field(
            description='Time constant of T_board behind T_case: stands in for the gradient '
            '(lag times rate) while the case sensor is lost.'
        ),
    ] = 900.0
    detector: Annotated[
        DetectorSettings, Field(description='The thermometers and the regime detector.')
    ] = field(default_factory=DetectorSettings)
    provenance: Provenance = Provenance()

    def __post_init__(self) -> None:
        if self.format_version != FORMAT_VERSION:
            raise ValueError(
                f'`format_version` must be {FORMAT_VERSION}, got {self.format_version}'
            )
        self._check_misalignment()
        for regime, regime_set in (('static', self.static), ('dynamic', self.dynamic)):
            for axis, axis_set in zip(AXES, regime_set.axes(), strict=True):
                n_memory = len(axis_set.memory.bias)
                if n_memory not in (0, len(self.memory_time_constants_s)):
                    raise ValueError(
                        f'`{regime}.{axis}.memory` must have one coefficient per '
                        f'memory_time_constants_s ({len(self.memory_time_constants_s)}), '
                        f'got {n_memory}'
                    )
                smallest = _smallest_scale(axis_set, regime_set, self.reference_temperature_c)
                if not smallest > SMALLEST_RELATIVE_SCALE:
                    raise ValueError(
                        f'`{regime}.{axis}.scale_function` must stay above '
                        f'{SMALLEST_RELATIVE_SCALE:g} over its ranges, reaches {smallest:.4g}'
                    )

    def _check_misalignment(self) -> None:
        for row in range(3):
            for column in range(3):
                value = self.misalignment[row][column]
                key = f'`misalignment[{row}][{column}]`'
                if column == row and value != 1.0:
                    raise ValueError(f'{key} must be 1, got {value:g}')
                if column > row and value:
                    raise ValueError(f'{key} must be 0 (M is lower triangular), got {value:g}')
                if column < row and not abs(value) < 0.5:
                    raise ValueError(f'{key} must be below 0.5 in magnitude, got {value:g}')

    def regime_sets(self) -> tuple[RegimeSet, RegimeSet]:
        """
        Return the static and the dynamic set.

        """
        return self.static, self.dynamic

    @property
    def has_uncertainty(self) -> bool:
        """
        Whether the calibration says anything of how well it is known; else it claims nothing.

        """
        return any(self.misalignment_sd) or any(
            axis.covariance or axis.residual_sd_m_s2
            for part in self.regime_sets()
            for axis in part.axes()
        )


def _check_covariance(rows: tuple[tuple[float, ...], ...], expected: int) -> None:
    if len(rows) != expected or any(len(row) != i + 1 for i, row in enumerate(rows)):
        raise ValueError(
            f'`covariance` must be the {expected} rows of a lower triangle, '
            f'got rows of {[len(row) for row in rows]}'
        )
    matrix = np.zeros((expected, expected))
    for i, row in enumerate(rows):
        matrix[i, : i + 1] = row
    diagonal = np.diag(matrix).copy()
    if not np.all(diagonal >= 0.0):
        raise ValueError('`covariance` must not have a negative variance')
    # Scaled to correlations first: entries in counts^2 and in relative^2 differ by 10 decades.
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    with np.errstate(over='ignore'):
        correlation = (matrix + np.tril(matrix, -1).T) / scale / scale[:, np.newaxis]
    # Eigenvalues exist of what is finite; beyond 1 there is no correlation anyway.
    is_bounded = np.abs(correlation).max(initial=0.0) < 2.0
    if not (is_bounded and np.linalg.eigvalsh(correlation)[0] > -1e-6):
        raise ValueError('`covariance` must be positive semidefinite')


def _smallest_scale(axis_set: AxisSet, regime_set: RegimeSet, reference: float) -> float:
    """
    Lower bound of the relative scale over a set's ranges, every term at its worst.

    """
    lower, upper = (edge - reference for edge in regime_set.temperature_range_c)
    function = axis_set.scale_function
    temperatures = np.linspace(lower, upper, 513)
    if isinstance(function, Polynomial):
        temperatures = np.append(temperatures, _extremes(function, lower, upper))
    with np.errstate(all='ignore'):
        smallest = float(np.min(function.value(temperatures)))
    worst = _largest(regime_set.gradient_range_k) * abs(axis_set.gradient.scale)
    worst += _largest(regime_set.rate_range_k_min) / 60.0 * abs(axis_set.rate.scale)
    for coefficient in axis_set.memory.scale:
        worst += _largest(regime_set.memory_range_k) * abs(coefficient)
    result = smallest - worst
    return result if math.isfinite(result) else -math.inf


def _extremes(function: Polynomial, lower: float, upper: float) -> Floats:
    """
    Find where a polynomial can have its extremes inside a range.

    """
    reach = max(abs(lower), abs(upper), 1.0)
    slope = [power * c for power, c in enumerate(function.coefficients)][1:]
    # A term that cannot move the function by 1e-12 anywhere in the range moves no extreme either,
    # and as a leading coefficient it would overflow the companion matrix.
    while slope and not abs(slope[-1]) * reach ** len(slope) > 1e-12:
        slope.pop()
    if len(slope) < 2 or not np.all(np.isfinite(slope)):
        return np.empty(0)
    return np.clip(np.roots(slope[::-1]).real, lower, upper)


def _largest(edges: Range) -> float:
    return max(abs(edges[0]), abs(edges[1]))
