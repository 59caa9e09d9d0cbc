# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the calibration of one unit: immutable dataclasses with the keys of the calibration file.

The measurement model of axis i (equations 6 to 9 of Golovach 2016, plus the columns phi_j) has the
raw sample N_i, ``t = T_board - T_ref``, the weight w of the dynamic set (0..1), columns phi_j of
the thermal response (`columns`), the misalignment matrix M and the specific force f. delta and Fs
are the offset and the curve of the bias, Fc is the curve of the scale; the index s marks the
static set, d the dynamic set::

    bias  = bias_i + (1 - w) (delta_s + Fs_s(t)) + w (delta_d + Fs_d(t)) + sum_j bias_ji phi_j
    scale = K_i ((1 - w) Fc_s(t) + w Fc_d(t) + sum_j scale_ji phi_j)
    x_i   = (N_i - bias) / scale, less the nonlinearity over specific force (`nonlinearity`)
    f     = M x
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from ..quantities import QUANTITIES, Bounds
from ..text import LONGEST_SERIAL, valid_serial
from ..thermal.settings import DetectorSettings, ThermometerSettings
from .columns import Column
from .functions import Polynomial, TemperatureFunction, check_reference
from .limits import check_limits
from .nonlinearity import Nonlinearity
from .posterior import ParameterLayout, Posterior, lay_out
from .provenance import GroupEvidence, Provenance
from .rate_bias import LARGEST_RATE, NIL, Gyroscope, RateCurve, RateSet, RateTerm
from .schema import Vector, broken, check_ranges

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from .. import Corrected, Temperature

#: Version of the calibration file's layout that this release reads and writes.
FORMAT_VERSION = 2
AXES = ('x', 'y', 'z')
#: `provenance.model` of a calibration that describes a type of unit and serves as a prior.
POPULATION = 'population'

Celsius = Annotated[float, QUANTITIES['temperature']]
_Kelvin = Annotated[float, QUANTITIES['temperature difference']]
_RateEdge = Annotated[float, QUANTITIES['temperature rate']]
_Density = Annotated[float, QUANTITIES['noise density']]
_Slow = Annotated[float, QUANTITIES['slow noise']]
_Tilt = Annotated[float, QUANTITIES['misalignment deviation']]
_Error = Annotated[float, QUANTITIES['error']]
Serial = Annotated[str, Bounds(shortest=1, longest=LONGEST_SERIAL)]
Input = Literal['counts', 'm/s^2']


@dataclass(frozen=True)
class Unit:
    """Serial number of a unit; unit of measure, full scale and interval of its raw samples."""

    serial: Annotated[Serial, 'Serial number of the unit, one printable line.']
    input: Annotated[Input, 'Unit of the raw samples: counts per conversion cycle, or m/s^2.']
    full_scale: Annotated[
        float, QUANTITIES['full scale'], 'Magnitude of a saturated sample, in input units.'
    ]
    cycle_time_s: Annotated[
        float, QUANTITIES['cycle time'], 'Length of a conversion cycle = sample interval [s].'
    ]

    def __post_init__(self) -> None:
        valid_serial(self.serial)


@dataclass(frozen=True)
class AxisReference:
    """Scale factor and bias of one axis at the reference temperature."""

    scale_factor: Annotated[float, 'K: input units per m/s^2 at the reference temperature.']
    bias: Annotated[float, 'dNs(0): zero offset at the reference temperature, in input units.']

    def __post_init__(self) -> None:
        bounds = QUANTITIES['scale factor']
        if bounds.fault(abs(self.scale_factor)):
            rule = f'be {bounds.at_least:g} to {bounds.at_most:g} in magnitude'
            raise broken('scale_factor', rule, self.scale_factor)


@dataclass(frozen=True)
class Axes:
    """Scale factor and bias of the three axes at the reference temperature."""

    x: AxisReference
    y: AxisReference
    z: AxisReference

    def __iter__(self) -> Iterator[AxisReference]:
        return iter((self.x, self.y, self.z))


@dataclass(frozen=True)
class AxisSet:
    """The curves of bias and scale of one axis in one regime."""

    bias_function: Annotated[TemperatureFunction, 'Fs(t): bias curve [input units]; Fs(0) = 0.']
    scale_function: Annotated[TemperatureFunction, 'Fc(t): curve of relative scale; Fc(0) = 1.']
    delta: Annotated[float, 'Bias of this regime less `axes.bias`, at T_ref, input units.'] = 0.0
    residual_sd_m_s2: Annotated[
        float,
        QUANTITIES['deviation'],
        'Standard deviation of the slowly varying error that the correction leaves.',
    ] = 0.0

    def __post_init__(self) -> None:
        check_reference('bias_function', self.bias_function, 0.0)
        check_reference('scale_function', self.scale_function, 1.0)


@dataclass(frozen=True)
class LackOfFit:
    """Sd of a regime's error at a board temperature, beyond the error that `posterior` states."""

    temperature_c: Annotated[Celsius, 'Board temperature of the entry [degC].']
    sd_m_s2: Annotated[
        tuple[_Error, _Error, _Error], 'Standard deviation of the slow error of each axis.'
    ]


@dataclass(frozen=True)
class RegimeSet:
    """
    The curves of one regime. Outside `temperature_range_c` the covariance of the force grows, and
    each curve runs parallel to the curve of the other regime. Outside the ranges of both regimes
    each curve continues along a tangent for a quarter of the range, and then is constant.
    """

    temperature_range_c: Annotated[tuple[Celsius, Celsius], 'Calibrated range of T_board [degC].']
    rate_range_k_min: Annotated[tuple[_RateEdge, _RateEdge], 'Calibrated range of dT_board/dt.']
    x: AxisSet
    y: AxisSet
    z: AxisSet
    lack_of_fit: Annotated[
        tuple[LackOfFit, ...],
        'Error on data left out of the fit, beyond the sd of the posterior; includes the error of '
        'scale factors at temperatures at which no position had the axis along gravity. The error '
        'variance is linear between the temperatures of entries, and constant outside them.',
    ] = ()

    def __post_init__(self) -> None:
        check_ranges(
            self,
            temperature_range_c=QUANTITIES['temperature span'],
            rate_range_k_min=QUANTITIES['rate span'],
        )
        at = [point.temperature_c for point in self.lack_of_fit]
        for k, (before, after) in enumerate(pairwise(at)):
            if not before < after:
                rule = f'be above the previous entry ({before:g})'
                raise broken(f'lack_of_fit[{k + 1}].temperature_c', rule, after)

    def axes(self) -> tuple[AxisSet, AxisSet, AxisSet]:
        """Return the curves of the axes x, y, z."""
        return self.x, self.y, self.z


@dataclass(frozen=True)
class ResponseTerm(Column):
    """A column (regressor) of the thermal response, with its weights on the three axes."""

    bias: Annotated[Vector, 'Weights on the bias, input units per unit of the column.'] = field(
        kw_only=True
    )
    scale: Annotated[Vector, 'Weights on the relative scale, per unit of the column.'] = field(
        kw_only=True
    )


@dataclass(frozen=True)
class Calibration:
    """Calibration of one unit; ValueError if a value is impossible or contradicts another."""

    format_version: Annotated[int, f'Version of the layout of this file: {FORMAT_VERSION}.']
    unit: Unit
    reference_temperature_c: Annotated[Celsius, 'Reference temperature T_ref; paper: 20 degC.']
    gravity_m_s2: Annotated[float, QUANTITIES['gravity'], 'Local gravity used by the fit.']
    gravity_sd_m_s2: Annotated[
        float, QUANTITIES['deviation'], 'Sd of local gravity; `posterior` includes its effect.'
    ] = field(default=0.0, kw_only=True)
    axes: Axes
    static: Annotated[RegimeSet, 'Curves of the static regime (S = 0 in the paper).']
    dynamic: Annotated[RegimeSet, 'Curves of the dynamic regime (S = 1 in the paper).']
    noise_density_m_s2_sqrt_hz: Annotated[
        tuple[_Density, _Density, _Density],
        'White noise of each axis; variance of a sample: density^2 / cycle_time_s + rounding.',
    ]
    slow_noise_m_s2_sqrt_h: Annotated[
        tuple[_Slow, _Slow, _Slow],
        'Slow noise of each axis: growth of the sd of the bias per root hour, over times shorter '
        'than the correlation time of the slow noise.',
    ] = (0.0, 0.0, 0.0)
    misalignment: Annotated[
        tuple[Vector, Vector, Vector],
        'Matrix M, from sensitivity axes to output frame: lower triangular, unit diagonal.',
    ] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    misalignment_sd: Annotated[
        tuple[_Tilt, _Tilt, _Tilt],
        'Standard deviations of M[1][0], M[2][0], M[2][1], used if `posterior` is null.',
    ] = (0.0, 0.0, 0.0)
    sensors: Annotated[
        tuple[str, ...],
        "Thermometers except the board's; in a ramp the board lags the first of them.",
    ] = ('case',)
    response: Annotated[
        tuple[ResponseTerm, ...], QUANTITIES['columns'], 'Columns of the thermal response.'
    ] = ()
    board_lag_s: Annotated[
        float,
        QUANTITIES['time constant'],
        'Lag of T_board behind T_case. Without readings of the case, T_case - T_board is '
        'estimated as its value in the last soak, or in the fit, plus board_lag_s * dT_board/dt.',
    ] = 900.0
    rest_gradient_range_k: Annotated[
        tuple[_Kelvin, _Kelvin] | None,
        'Range of T_s - T_board - board_lag_s * dT_board/dt of the first sensor s in the bags; '
        'null: unknown. Far outside the range (loose sensor) the sd of T_board is increased.',
    ] = None
    soak_gradient_k: Annotated[
        tuple[_Kelvin, _Kelvin] | None,
        'T_s - T_board of the first sensor s in a soak, due to self-heating, and the sd of this '
        'difference; certificates and exported files include it; null: unknown, taken as 0.',
    ] = None
    detector: Annotated[
        DetectorSettings, 'Settings of the thermometers and of the regime detector.'
    ] = field(default_factory=DetectorSettings)
    provenance: Provenance = field(default_factory=Provenance)
    evidence: Annotated[tuple[GroupEvidence, ...], 'RMS correction by each group of columns.'] = ()
    posterior: Annotated[Posterior | None, 'Covariance of all parameters; null: unknown.'] = None
    nonlinearity: Annotated[
        Nonlinearity | None,
        'Nonlinearity of the axes over specific force; null: the bags were at 1 g only.',
    ] = None
    gyroscope: Annotated[
        Gyroscope | None, "Bias of the unit's gyroscope; null: the angular rate is not corrected."
    ] = None

    def __post_init__(self) -> None:
        if (version := self.format_version) != FORMAT_VERSION:
            raise broken('format_version', f'be {FORMAT_VERSION}', version)
        self._check_misalignment()
        self._check_sensors()
        if self.rest_gradient_range_k is not None:
            check_ranges(self, rest_gradient_range_k=QUANTITIES['temperature span'])
        check_limits(self, parameter_layout(self))
        if self.gyroscope is not None:
            try:
                rate_triad(self)  # the rules of an accelerometer triad apply
            except ValueError as error:
                raise ValueError(str(error).replace('`', '`gyroscope.', 1)) from error

    def _check_misalignment(self) -> None:
        for (row, column), value in np.ndenumerate(np.array(self.misalignment)):
            is_good, rule = value == 1.0, '1'
            if column > row:
                is_good, rule = not value, '0 (M is lower triangular)'
            elif column < row:
                is_good, rule = abs(value) < 0.5, 'below 0.5 in magnitude'
            if not is_good:
                raise broken(f'misalignment[{row}][{column}]', f'be {rule}', value)

    def _check_sensors(self) -> None:
        names = self.sensors
        if not names or len(set(names)) != len(names) or not all(names) or 'board' in names:
            rule = 'be one or more different names, none of them board'
            raise broken('sensors', rule, list(names))
        for k, term in enumerate(self.response):
            if term.is_of_sensor and term.sensor not in names:
                rule = f'be one of sensors {list(names)}'
                raise broken(f'response[{k}].sensor', rule, repr(term.sensor))

    def correct(
        self, time_s: ArrayLike, counts: ArrayLike, *, board: Temperature = ([], []), **others: Any
    ) -> Corrected:
        """Correct arrays of samples; arguments and result are those of `thermo_comp.correct`."""
        from .. import correct

        return correct(self, time_s, counts, board=board, **others)

    def regime_sets(self) -> tuple[RegimeSet, RegimeSet]:
        """Return the static and the dynamic set of curves."""
        return self.static, self.dynamic

    @property
    def needs_temperature(self) -> bool:
        """Whether any parameter of the correction depends on the temperature or on the regime."""
        gyroscope = self.gyroscope
        sets = (*self.regime_sets(), *((gyroscope.static, gyroscope.dynamic) if gyroscope else ()))
        weights: list[float] = []
        for axis in (axis for part in sets for axis in part.axes()):
            weights += (axis.delta, *axis.bias_function.free_coefficients)
            if isinstance(axis, AxisSet):
                weights += axis.scale_function.free_coefficients
        for term in self.nonlinearity.terms if self.nonlinearity else ():
            weights += term.per_kelvin
        return any(weights) or bool(self.columns)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of the specific force, then those of the angular rate."""
        return (*self.response, *(self.gyroscope.response if self.gyroscope else ()))

    @property
    def needs_case(self) -> bool:
        """Whether readings of a sensor are needed, by `detector.case` or a column of a sensor."""
        is_default = self.detector.case == ThermometerSettings()
        return not is_default or any(column.is_of_sensor for column in self.columns)

    @property
    def has_uncertainty(self) -> bool:
        """Whether a posterior, misalignment sd, residual sd or lack of fit is given."""
        sets = self.regime_sets()
        sds = (axis.residual_sd_m_s2 for part in sets for axis in part.axes())
        has_lacks = any(part.lack_of_fit for part in sets)
        return self.posterior is not None or has_lacks or any((*self.misalignment_sd, *sds))


def parameter_layout(calibration: Calibration) -> ParameterLayout:
    """Return the indices of a calibration's parameters in its posterior."""
    pairs: list[tuple[TemperatureFunction, TemperatureFunction]] = []
    for static, dynamic in zip(*(part.axes() for part in calibration.regime_sets()), strict=True):
        pairs.append((static.bias_function, dynamic.bias_function))
        pairs.append((static.scale_function, dynamic.scale_function))
    blocks = lay_out(pairs, len(calibration.response))
    end, nonlinearity = blocks[-1].end, calibration.nonlinearity
    after = end + (6 * len(nonlinearity.terms) if nonlinearity else 0)
    return ParameterLayout(blocks[0::2], blocks[1::2], end, after, after + 3)


def rate_triad(calibration: Calibration) -> Calibration:
    """Return the gyroscope's bias as a `Calibration` of scale 1; ValueError without gyroscope."""
    gyroscope = calibration.gyroscope
    if gyroscope is None:
        raise ValueError('`calibration` must have a gyroscope')

    def regime(shared: RegimeSet, curves: RateSet) -> RegimeSet:
        one = Polynomial((1.0,))
        pairs = zip(curves.axes(), gyroscope.residual_sd_rad_s, strict=True)
        x, y, z = (AxisSet(curve.bias_function, one, curve.delta, sd) for curve, sd in pairs)
        # The lack of fit of the unit is an error of the specific force, not of the angular rate.
        return replace(shared, x=x, y=y, z=z, lack_of_fit=())

    triad = replace(
        calibration,
        # The full scale of the accelerometer does not limit an angular rate.
        unit=replace(calibration.unit, input='m/s^2', full_scale=LARGEST_RATE),
        axes=Axes(*(AxisReference(1.0, bias) for bias in gyroscope.bias_rad_s)),
        static=regime(calibration.static, gyroscope.static),
        dynamic=regime(calibration.dynamic, gyroscope.dynamic),
        noise_density_m_s2_sqrt_hz=gyroscope.noise_density_rad_s_sqrt_hz,
        slow_noise_m_s2_sqrt_h=gyroscope.slow_noise_rad_s_sqrt_h,
        misalignment=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        misalignment_sd=NIL,
        response=tuple(ResponseTerm(**vars(term), scale=NIL) for term in gyroscope.response),
        provenance=Provenance(),
        evidence=(),
        posterior=None,
        nonlinearity=None,
        gyroscope=None,
    )
    if gyroscope.posterior is None:
        return triad
    rows, n = _bias_rows(triad), parameter_layout(triad).n_parameters
    matrix, variances = np.zeros((n, gyroscope.posterior.rank)), np.zeros(n)
    matrix[rows], variances[rows] = gyroscope.posterior.matrix, gyroscope.posterior.variances
    return replace(triad, posterior=Posterior.of(matrix, variances))


def gyroscope_of(triad: Calibration) -> Gyroscope:
    """Convert a calibration in the form that `rate_triad` returns to a `Gyroscope`."""
    x, y, z = (axis.bias for axis in triad.axes)
    static, dynamic = (
        RateSet(*(RateCurve(axis.bias_function, axis.delta) for axis in regime_set.axes()))
        for regime_set in triad.regime_sets()
    )
    sx, sy, sz = (axis.residual_sd_m_s2 for axis in triad.static.axes())
    terms = [{k: v for k, v in vars(term).items() if k != 'scale'} for term in triad.response]
    posterior = triad.posterior
    if posterior is not None:
        rows = _bias_rows(triad)
        posterior = Posterior.of(posterior.matrix[rows], posterior.variances[rows])
    return Gyroscope(
        bias_rad_s=(x, y, z),
        static=static,
        dynamic=dynamic,
        noise_density_rad_s_sqrt_hz=triad.noise_density_m_s2_sqrt_hz,
        slow_noise_rad_s_sqrt_h=triad.slow_noise_m_s2_sqrt_h,
        residual_sd_rad_s=(sx, sy, sz),
        response=tuple(RateTerm(**keys) for keys in terms),
        posterior=posterior,
    )


def _bias_rows(triad: Calibration) -> list[int]:
    blocks = parameter_layout(triad).bias
    return [row for block in blocks for row in range(block.static, block.end)]
