# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the Calibration value of one unit, validated as a whole.

The dataclasses mirror the calibration file key by key. The object is immutable, so a running node
replaces it by one assignment.

Measurement model, per axis i, with ``t = T_board - T_ref``, w the weight of the dynamic regime
(0..1), and phi_j the columns of the thermal response (`columns`), common to both sets (Eq. (6) to
(9) of the paper; the response is an addition to it)::

    bias  = bias_i + (1 - w) (delta_s + Fs_s(t)) + w (delta_d + Fs_d(t)) + sum_j bias_ji phi_j
    scale = K_i ((1 - w) Fc_s(t) + w Fc_d(t) + sum_j scale_ji phi_j)
    x_i   = (N_i - bias) / scale, less the nonlinearity over specific force (`nonlinearity`)
    f     = M x
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from ..quantities import QUANTITIES, Bounds
from ..text import LONGEST_SERIAL, valid_serial
from ..thermal.settings import DetectorSettings, ThermometerSettings
from .columns import Column
from .functions import TemperatureFunction, check_reference
from .nonlinearity import Nonlinearity
from .posterior import ParameterLayout, Posterior, lay_out
from .provenance import GroupEvidence, Provenance
from .rate_bias import LARGEST_RATE, Gyroscope
from .reach import FULL_SCALES, LARGEST_RELATIVE_SCALE, Reach, Term, check_posterior
from .schema import Vector, check_ranges

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from .. import Corrected, Temperature

#: Version of the file's layout that this code reads and writes.
FORMAT_VERSION = 2
AXES = ('x', 'y', 'z')
#: `provenance.model` of a calibration that describes a type of unit and serves as a prior.
POPULATION = 'population'

Celsius = Annotated[float, QUANTITIES['temperature']]
_RateEdge = Annotated[float, QUANTITIES['temperature rate']]
_Density = Annotated[float, QUANTITIES['noise density']]
_Slow = Annotated[float, QUANTITIES['slow noise']]
_Tilt = Annotated[float, QUANTITIES['misalignment deviation']]
_Error = Annotated[float, QUANTITIES['error']]
Serial = Annotated[str, Bounds(shortest=1, longest=LONGEST_SERIAL)]
Input = Literal['counts', 'm/s^2']


@dataclass(frozen=True)
class Unit:
    """The calibrated unit and its raw samples."""

    serial: Annotated[Serial, 'Serial number of the unit, one printable line.']
    input: Annotated[Input, 'Unit of the raw samples: counts per conversion cycle, or m/s^2.']
    full_scale: Annotated[
        float, QUANTITIES['full scale'], 'A sample at or beyond this is saturated, in input units.'
    ]
    cycle_time_s: Annotated[
        float, QUANTITIES['cycle time'], 'Length of a conversion cycle = sample interval [s].'
    ]

    def __post_init__(self) -> None:
        valid_serial(self.serial)


@dataclass(frozen=True)
class AxisReference:
    """One axis at the reference temperature."""

    scale_factor: Annotated[float, 'K: input units per m/s^2 at the reference temperature.']
    bias: Annotated[float, 'dNs(0): zero offset at the reference, in input units.']

    def __post_init__(self) -> None:
        bounds = QUANTITIES['scale factor']
        if bounds.fault(abs(self.scale_factor)):
            raise ValueError(
                f'`scale_factor` must be {bounds.at_least:g} to {bounds.at_most:g} in magnitude, '
                f'got {self.scale_factor:g}'
            )


@dataclass(frozen=True)
class Axes:
    """The three axes at the reference temperature."""

    x: AxisReference
    y: AxisReference
    z: AxisReference

    def __iter__(self) -> Iterator[AxisReference]:
        """Give the three axes in order."""
        return iter((self.x, self.y, self.z))


@dataclass(frozen=True)
class AxisSet:
    """The curves of one axis in one regime."""

    bias_function: Annotated[TemperatureFunction, 'Fs(t), input units; Fs(0) = 0.']
    scale_function: Annotated[TemperatureFunction, 'Fc(t), dimensionless; Fc(0) = 1.']
    delta: Annotated[float, 'Bias of this regime relative to axes.bias, input units.'] = 0.0
    residual_sd_m_s2: Annotated[
        float, QUANTITIES['deviation'], 'Standard deviation of the residual, a slow error.'
    ] = 0.0

    def __post_init__(self) -> None:
        check_reference('bias_function', self.bias_function, 0.0)
        check_reference('scale_function', self.scale_function, 1.0)


@dataclass(frozen=True)
class LackOfFit:
    """Lack of fit of a set at a board temperature, a slow error in addition to the posterior's."""

    temperature_c: Annotated[Celsius, 'Board temperature [degC].']
    sd_m_s2: Annotated[tuple[_Error, _Error, _Error], 'Standard deviation of each axis.']


@dataclass(frozen=True)
class RegimeSet:
    """
    The set of one regime. Outside `temperature_range_c` its curves go on along their tangents for
    a quarter of the span and are held from there on; the covariance grows.
    """

    temperature_range_c: Annotated[tuple[Celsius, Celsius], 'Board temperature [degC].']
    rate_range_k_min: Annotated[tuple[_RateEdge, _RateEdge], 'dT_board/dt [K/min].']
    x: AxisSet
    y: AxisSet
    z: AxisSet
    lack_of_fit: Annotated[
        tuple[LackOfFit, ...],
        'Error of left-out data in excess of the posterior: variance linear between the '
        'temperatures, held outside.',
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
                raise ValueError(
                    f'`lack_of_fit[{k + 1}].temperature_c` must be above the previous entry '
                    f'({before:g}), got {after:g}'
                )

    def axes(self) -> tuple[AxisSet, AxisSet, AxisSet]:
        """Return the three axes in order."""
        return self.x, self.y, self.z


@dataclass(frozen=True)
class ResponseTerm(Column):
    """A column of the thermal response with its weights on the three axes."""

    bias: Annotated[Vector, 'Input units per unit of the column.'] = field(kw_only=True)
    scale: Annotated[Vector, 'Relative, per unit of the column.'] = field(kw_only=True)


@dataclass(frozen=True)
class Calibration:
    """One unit's calibration; ValueError if parts contradict each other."""

    format_version: Annotated[int, f'Version of this layout: {FORMAT_VERSION}.']
    unit: Unit
    reference_temperature_c: Annotated[Celsius, 'T_ref; the paper uses 20.']
    gravity_m_s2: Annotated[float, QUANTITIES['gravity'], 'Local gravity used by the fit.']
    axes: Axes
    static: Annotated[RegimeSet, 'The set of the static regime, S = 0.']
    dynamic: Annotated[RegimeSet, 'The set of the dynamic regime, S = 1.']
    noise_density_m_s2_sqrt_hz: Annotated[
        tuple[_Density, _Density, _Density],
        'White noise of each axis; variance of a sample = density^2 / cycle, plus rounding.',
    ]
    slow_noise_m_s2_sqrt_h: Annotated[
        tuple[_Slow, _Slow, _Slow], 'Random walk of the bias of each axis, per root hour.'
    ] = (0.0, 0.0, 0.0)
    misalignment: Annotated[
        tuple[Vector, Vector, Vector],
        'M, from sensitivity axes to the frame: lower triangular, unit diagonal.',
    ] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    misalignment_sd: Annotated[
        tuple[_Tilt, _Tilt, _Tilt],
        'Standard deviations of M[1][0], M[2][0], M[2][1], used if `posterior` is null.',
    ] = (0.0, 0.0, 0.0)
    sensors: Annotated[
        tuple[str, ...], 'Thermometers beside the board; the first one leads in a ramp.'
    ] = ('case',)
    response: Annotated[
        tuple[ResponseTerm, ...], QUANTITIES['columns'], 'The response, common to both sets.'
    ] = ()
    board_lag_s: Annotated[
        float,
        QUANTITIES['time constant'],
        'Lag of T_board behind T_case; while the case is lost, gradient = lag * dT_board/dt.',
    ] = 900.0
    detector: Annotated[DetectorSettings, 'The thermometers and the regime detector.'] = field(
        default_factory=DetectorSettings
    )
    provenance: Provenance = field(default_factory=Provenance)
    evidence: Annotated[tuple[GroupEvidence, ...], 'Contribution of each group of columns.'] = ()
    posterior: Annotated[
        Posterior | None, 'Covariance of all parameters; null where it is unknown.'
    ] = None
    nonlinearity: Annotated[
        Nonlinearity | None,
        'Nonlinearity of the axes over specific force; null: only 1 g was seen.',
    ] = None
    gyroscope: Annotated[
        Gyroscope | None, "Bias of the unit's gyroscope; null: the angular rate is not corrected."
    ] = None

    def __post_init__(self) -> None:
        if (version := self.format_version) != FORMAT_VERSION:
            raise ValueError(f'`format_version` must be {FORMAT_VERSION}, got {version}')
        self._check_axes()
        self._check_misalignment()
        self._check_sensors()
        self._check_reach()

    def _check_axes(self) -> None:
        # Samples in an offset code have a bias of half their range.
        farthest = FULL_SCALES * self.unit.full_scale
        force = QUANTITIES['full-scale force']
        for name, axis in zip(AXES, self.axes, strict=True):
            if abs(axis.bias) > farthest:
                raise ValueError(
                    f'`axes.{name}.bias` must be within twice unit.full_scale, {farthest:g}, '
                    f'got {axis.bias:g}'
                )
            reached = self.unit.full_scale / abs(axis.scale_factor)
            if fault := force.fault(reached):
                raise ValueError(
                    f'`axes.{name}.scale_factor` makes unit.full_scale a force that {fault}, '
                    f'got {reached:g}'
                )

    def _check_misalignment(self) -> None:
        for (row, column), value in np.ndenumerate(np.array(self.misalignment)):
            is_good, rule = value == 1.0, '1'
            if column > row:
                is_good, rule = not value, '0 (M is lower triangular)'
            elif column < row:
                is_good, rule = abs(value) < 0.5, 'below 0.5 in magnitude'
            if not is_good:
                raise ValueError(f'`misalignment[{row}][{column}]` must be {rule}, got {value:g}')

    def _check_sensors(self) -> None:
        names = self.sensors
        if not names or len(set(names)) != len(names) or not all(names) or 'board' in names:
            raise ValueError(
                '`sensors` must be different names, at least one, none of them board, '
                f'got {list(names)}'
            )
        of_rate = self.gyroscope.response if self.gyroscope else ()
        for key, response in (('response', self.response), ('gyroscope.response', of_rate)):
            for k, term in enumerate(response):
                if term.is_of_sensor and term.sensor not in names:
                    raise ValueError(
                        f'`{key}[{k}].sensor` must be one of sensors {list(names)}, '
                        f'got {term.sensor!r}'
                    )

    def _check_reach(self) -> None:
        """Check curves, columns and posterior against full scale and temperature ranges."""
        gyroscope, full_scale = self.gyroscope, self.unit.full_scale
        terms = [Term(term, term.bias, term.scale) for term in self.response]
        of_rate = (
            [Term(term, term.bias, (0.0,) * 3) for term in gyroscope.response] if gyroscope else []
        )
        reference = self.reference_temperature_c
        all_edges = [edge for part in self.regime_sets() for edge in part.temperature_range_c]
        if self.nonlinearity is not None:
            largest = full_scale / min(abs(axis.scale_factor) for axis in self.axes)
            edges_t = min(all_edges) - reference, max(all_edges) - reference
            self.nonlinearity.check_slope(largest, edges_t)
        for regime, part in zip(('static', 'dynamic'), self.regime_sets(), strict=True):
            edges = part.temperature_range_c
            reach = Reach(edges, all_edges, reference, FULL_SCALES * full_scale)
            lost = reach.losses(terms, regime)
            for name, axis, loss in zip(AXES, part.axes(), lost, strict=True):
                reach.check_scale(f'{regime}.{name}', axis.scale_function, loss)
            for name, at, axis in zip(AXES, self.axes, part.axes(), strict=True):
                level = at.bias + axis.delta
                reach.check_bias(f'{regime}.{name}', level, axis.bias_function)
            reach.check_terms('response', terms)
            if gyroscope:
                reach = Reach(edges, all_edges, reference, FULL_SCALES * LARGEST_RATE)
                curves = gyroscope.static if regime == 'static' else gyroscope.dynamic
                for name, at_rest, curve in zip(
                    AXES, gyroscope.bias_rad_s, curves.axes(), strict=True
                ):
                    key = f'gyroscope.{regime}.{name}'
                    reach.check_bias(key, at_rest + curve.delta, curve.bias_function)
                reach.check_terms('gyroscope.response', of_rate)
        self._check_posteriors(terms, of_rate)

    def _check_posteriors(self, terms: list[Term], of_rate: list[Term]) -> None:
        reference = self.reference_temperature_c
        static, dynamic = (
            [edge - reference for edge in part.temperature_range_c] for part in self.regime_sets()
        )
        if self.posterior is not None:
            layout = parameter_layout(self)
            self.posterior.check_size(layout.n_parameters)
            axes = zip(self.static.axes(), self.dynamic.axes(), strict=True)
            blocks = []
            for bias, scale, (a, b) in zip(layout.bias, layout.scale, axes, strict=True):
                most = FULL_SCALES * self.unit.full_scale
                blocks.append((bias, (a.bias_function, b.bias_function), most))
                most = LARGEST_RELATIVE_SCALE
                blocks.append((scale, (a.scale_function, b.scale_function), most))
            check_posterior('posterior.factor', self.posterior, blocks, (static, dynamic), terms)
        gyroscope = self.gyroscope
        if gyroscope is not None and gyroscope.posterior is not None:
            axes_of_rate = zip(gyroscope.static.axes(), gyroscope.dynamic.axes(), strict=True)
            pairs = [(a.bias_function, b.bias_function) for a, b in axes_of_rate]
            laid_out = zip(lay_out(pairs, len(gyroscope.response)), pairs, strict=True)
            of_bias = [(block, pair, FULL_SCALES * LARGEST_RATE) for block, pair in laid_out]
            key = 'gyroscope.posterior.factor'
            check_posterior(key, gyroscope.posterior, of_bias, (static, dynamic), of_rate)

    def correct(
        self, time_s: ArrayLike, counts: ArrayLike, *, board: Temperature = ([], []), **others: Any
    ) -> Corrected:
        """Correct arrays of samples; arguments and result are those of `thermo_comp.correct`."""
        from .. import correct

        return correct(self, time_s, counts, board=board, **others)

    def regime_sets(self) -> tuple[RegimeSet, RegimeSet]:
        """Return the static and the dynamic set."""
        return self.static, self.dynamic

    @property
    def needs_temperature(self) -> bool:
        """Whether the correction depends on temperature; if not, it is constant."""
        weights: list[float] = []
        for axis in (axis for part in self.regime_sets() for axis in part.axes()):
            weights += (axis.delta, *axis.bias_function.free_coefficients)
            weights += axis.scale_function.free_coefficients
        gyroscope = self.gyroscope
        for rate in (*gyroscope.static.axes(), *gyroscope.dynamic.axes()) if gyroscope else ():
            weights += (rate.delta, *rate.bias_function.free_coefficients)
        return any(weights) or bool(self.response or (gyroscope and gyroscope.response))

    @property
    def needs_case(self) -> bool:
        """Whether the unit was fitted with a case thermometer, or has columns computed from it."""
        columns = (*self.response, *(self.gyroscope.response if self.gyroscope else ()))
        return self.detector.case != ThermometerSettings() or any(
            column.is_of_sensor for column in columns
        )

    @property
    def has_uncertainty(self) -> bool:
        """Whether it holds any uncertainty; without it no uncertainty can be stated."""
        return (
            self.posterior is not None
            or any(self.misalignment_sd)
            or any(axis.residual_sd_m_s2 for part in self.regime_sets() for axis in part.axes())
            or any(part.lack_of_fit for part in self.regime_sets())
        )


def parameter_layout(calibration: Calibration) -> ParameterLayout:
    """Return the index of each parameter of a calibration in its posterior."""
    axes = zip(calibration.static.axes(), calibration.dynamic.axes(), strict=True)
    pairs: list[tuple[TemperatureFunction, TemperatureFunction]] = []
    for static, dynamic in axes:
        pairs.append((static.bias_function, dynamic.bias_function))
        pairs.append((static.scale_function, dynamic.scale_function))
    blocks = lay_out(pairs, len(calibration.response))
    end, nonlinearity = blocks[-1].end, calibration.nonlinearity
    after = end + (6 * len(nonlinearity.terms) if nonlinearity else 0)
    return ParameterLayout(blocks[0::2], blocks[1::2], end, after, after + 3)
