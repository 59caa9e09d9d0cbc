# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the Calibration value: everything that is known about one unit, validated as a whole.

The dataclasses mirror the calibration file key by key. One object is one unit; it is immutable,
so a running node swaps it by one reference.

Measurement model, per axis i, with ``t = T_board - T_ref``, w the weight of the dynamic regime
(0..1), and phi_j the columns of the response (`columns`), common to both sets (Eq. (6) to
(9), and beyond the paper the response)::

    bias  = bias_i + (1 - w) (delta_s + Fs_s(t)) + w (delta_d + Fs_d(t)) + sum_j bias_ji phi_j
    scale = K_i ((1 - w) Fc_s(t) + w Fc_d(t) + sum_j scale_ji phi_j)
    x_i   = (N_i - bias) / scale
    f     = M x
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from ..text import LONGEST_SERIAL, valid_serial
from ..thermal.settings import DetectorSettings, ThermometerSettings
from ..typing import Floats
from .columns import Column
from .functions import TemperatureFunction, check_reference
from .gyroscope import Gyroscope
from .posterior import ParameterLayout, Posterior, lay_out
from .schema import Bounds, NotNegative, NotNegatives, Positive, Positives, Vector, check_ranges

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from .. import Corrected, Temperature

#: The version of the file's layout that this code writes.
FORMAT_VERSION = 2
AXES = ('x', 'y', 'z')
#: A scale function, with every term at its worst, must stay above this fraction of the reference.
SMALLEST_RELATIVE_SCALE = 0.1
#: At so many temperatures of its range a function is looked at.
_GRID = 513
#: The model of a calibration that stands for a type of unit: a prior.
POPULATION = 'population'
# No converter has fewer input units per m/s^2, nor more than one over it.
_SMALLEST_K = 1e-9

Celsius = Annotated[float, Bounds(at_least=-273.15, below=1000.0)]
Serial = Annotated[str, Bounds(shortest=1, longest=LONGEST_SERIAL)]
Input = Literal['counts', 'm/s^2']


@dataclass(frozen=True)
class Unit:
    """What is calibrated, and in which unit it speaks."""

    serial: Annotated[Serial, 'Serial number of the unit, one printable line.']
    input: Annotated[Input, 'Unit of the raw samples: counts per conversion cycle, or m/s^2.']
    full_scale: Annotated[Positive, 'A sample at or beyond this is saturated, in input units.']
    cycle_time_s: Annotated[Positive, 'Length of a conversion cycle = sample interval [s].']

    def __post_init__(self) -> None:
        valid_serial(self.serial)


@dataclass(frozen=True)
class AxisReference:
    """One axis at the reference temperature."""

    scale_factor: Annotated[float, 'K: input units per m/s^2 at the reference temperature.']
    bias: Annotated[float, 'dNs(0): zero offset at the reference, in input units.']

    def __post_init__(self) -> None:
        if not _SMALLEST_K <= abs(self.scale_factor) <= 1.0 / _SMALLEST_K:
            raise ValueError(
                f'`scale_factor` must be {_SMALLEST_K:g} to {1.0 / _SMALLEST_K:g} in magnitude, '
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
    """The curves of one axis in one regime (method section 3: items 2 to 4)."""

    bias_function: Annotated[TemperatureFunction, 'Fs(t), input units; Fs(0) = 0.']
    scale_function: Annotated[TemperatureFunction, 'Fc(t), dimensionless; Fc(0) = 1.']
    delta: Annotated[float, 'Bias of this regime relative to axes.bias, input units.'] = 0.0
    residual_sd_m_s2: Annotated[NotNegative, 'What it leaves unexplained, as a slow error.'] = 0.0

    def __post_init__(self) -> None:
        check_reference('bias_function', self.bias_function, 0.0)
        check_reference('scale_function', self.scale_function, 1.0)


@dataclass(frozen=True)
class RegimeSet:
    """The set of one regime; outside its ranges it is held, and the covariance grows."""

    temperature_range_c: Annotated[tuple[Celsius, Celsius], 'Board temperature [degC].']
    rate_range_k_min: Annotated[tuple[float, float], 'dT_board/dt [K/min].']
    x: AxisSet
    y: AxisSet
    z: AxisSet

    def __post_init__(self) -> None:
        check_ranges(self, 'temperature_range_c', 'rate_range_k_min')

    def axes(self) -> tuple[AxisSet, AxisSet, AxisSet]:
        """Return the three axes in order."""
        return self.x, self.y, self.z


@dataclass(frozen=True)
class ResponseTerm(Column):
    """A column of the thermal response with its weights on the three axes."""

    bias: Annotated[Vector, 'Input units per unit of the column.'] = field(kw_only=True)
    scale: Annotated[Vector, 'Relative, per unit of the column.'] = field(kw_only=True)


@dataclass(frozen=True)
class GroupEvidence:
    """What one group of columns is worth to the data it was fitted on."""

    group: Annotated[str, 'The group, as in `response`.']
    part: Annotated[Literal['bias', 'scale'], 'Which of the two it corrects.']
    explains_m_s2: Annotated[NotNegative, 'RMS of what it explains.']
    effective_parameters: Annotated[NotNegative, 'How many of its weights the data determine.']
    log_evidence_change: Annotated[float, 'By how much the log evidence falls without it.']
    prior_sd: Annotated[tuple[NotNegative, ...], 'Sd of its weights before the data were seen.']


@dataclass(frozen=True)
class Source:
    """One bag that the calibration was fitted on."""

    name: str
    sha256: str = ''
    n_samples: int = 0


@dataclass(frozen=True)
class ResidualSummary:
    """|g| error of one section of the fitted data, before and after."""

    section: str
    n_windows: int
    raw_rms_m_s2: NotNegative
    rms_m_s2: NotNegative
    max_m_s2: NotNegative
    left_out_rms_m_s2: Annotated[
        NotNegative | None, 'On each position by what the others say of the unit; null if unknown.'
    ] = None


@dataclass(frozen=True)
class Provenance:
    """Where the numbers come from."""

    created: str = ''
    tool_version: str = ''
    model: str = ''
    sources: tuple[Source, ...] = ()
    residuals: tuple[ResidualSummary, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def left_out_rms(self) -> float:
        """RMS of ``|f| - g`` on positions left out of the fit [m/s^2]; NaN where unknown."""
        found = [one.left_out_rms_m_s2 for one in self.residuals if one.section == 'all']
        return math.nan if not found or found[0] is None else found[0]


@dataclass(frozen=True)
class Calibration:
    """One unit's calibration; parts that contradict each other are a ValueError."""

    format_version: Annotated[int, f'Version of this layout: {FORMAT_VERSION}.']
    unit: Unit
    reference_temperature_c: Annotated[Celsius, 'T_ref; the paper uses 20.']
    gravity_m_s2: Annotated[float, Bounds(above=9.0, below=10.5), 'Local gravity used by the fit.']
    axes: Axes
    static: Annotated[RegimeSet, 'The set of the static regime, S = 0.']
    dynamic: Annotated[RegimeSet, 'The set of the dynamic regime, S = 1.']
    noise_density_m_s2_sqrt_hz: Annotated[
        Positives, 'White noise of each axis; of a sample density^2 / cycle, and rounding.'
    ]
    slow_noise_m_s2_sqrt_h: Annotated[
        NotNegatives, 'Random walk of the bias of each axis, per root hour.'
    ] = (0.0, 0.0, 0.0)
    misalignment: Annotated[
        tuple[Vector, Vector, Vector],
        'M: lower triangular, unit diagonal; sensitivity axes to frame.',
    ] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    misalignment_sd: Annotated[
        NotNegatives, 'Deviations of M[1][0], M[2][0], M[2][1], where there is no `posterior`.'
    ] = (0.0, 0.0, 0.0)
    sensors: Annotated[
        tuple[str, ...], 'Thermometers beside the board; the first one leads in a ramp.'
    ] = ('case',)
    response: Annotated[tuple[ResponseTerm, ...], 'The response, common to both sets.'] = ()
    board_lag_s: Annotated[
        Positive, 'Lag of T_board behind T_case; times the rate it is the gradient of a lost case.'
    ] = 900.0
    detector: Annotated[DetectorSettings, 'The thermometers and the regime detector.'] = field(
        default_factory=DetectorSettings
    )
    provenance: Provenance = Provenance()
    evidence: Annotated[tuple[GroupEvidence, ...], 'What each group of columns is worth.'] = ()
    posterior: Annotated[
        Posterior | None, 'Covariance of all parameters; null where it is unknown.'
    ] = None
    gyroscope: Annotated[
        Gyroscope | None, 'Bias of the angular rate that comes with the samples; null: unknown.'
    ] = None

    def __post_init__(self) -> None:
        if (version := self.format_version) != FORMAT_VERSION:
            raise ValueError(f'`format_version` must be {FORMAT_VERSION}, got {version}')
        self._check_axes()
        self._check_misalignment()
        self._check_sensors()
        for regime in ('static', 'dynamic'):
            self._check_curves(regime)
        if self.posterior is not None:
            self.posterior.check_size(parameter_layout(self).n_parameters)

    def _check_axes(self) -> None:
        # Words with an offset have it in the bias, at half their range.
        farthest = 2.0 * self.unit.full_scale
        for name, axis in zip(AXES, self.axes, strict=True):
            if abs(axis.bias) > farthest:
                raise ValueError(
                    f'`axes.{name}.bias` must be within twice unit.full_scale, {farthest:g}, '
                    f'got {axis.bias:g}'
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
        own = self.gyroscope.response if self.gyroscope else ()
        for key, response in (('response', self.response), ('gyroscope.response', own)):
            for k, term in enumerate(response):
                if term.is_of_sensor and term.sensor not in names:
                    raise ValueError(
                        f'`{key}[{k}].sensor` must be one of sensors {list(names)}, '
                        f'got {term.sensor!r}'
                    )

    def _check_curves(self, regime: str) -> None:
        """Check that a set's functions are finite over its ranges, with a scale far from 0."""
        reference = self.reference_temperature_c
        own = self.static if regime == 'static' else self.dynamic
        t = np.linspace(*own.temperature_range_c, _GRID) - reference
        edges = [edge for one in self.regime_sets() for edge in one.temperature_range_c]
        farthest = np.max(np.abs(np.subtract(edges, reference)))
        lost = np.zeros(3)
        with np.errstate(all='ignore'):
            # Every term of the response at its worst.
            for term in self.response:
                if term.during in ('always', regime):
                    largest = max(map(abs, term.range)) * farthest**term.power
                    lost += np.abs(np.multiply(term.scale, largest))
        for name, axis, loss in zip(AXES, own.axes(), lost.tolist(), strict=True):
            least = _smallest(axis.scale_function, t) - loss
            if not least > SMALLEST_RELATIVE_SCALE:
                raise ValueError(
                    f'`{regime}.{name}.scale_function` must stay above '
                    f'{SMALLEST_RELATIVE_SCALE:g} over its ranges, reaches {least:.4g}'
                )
        both = (('', own), ('gyroscope.', self.gyroscope and getattr(self.gyroscope, regime)))
        for of, curves in both:
            for name, curve in zip(AXES, curves.axes() if curves else (), strict=False):
                if not math.isfinite(_smallest(curve.bias_function, t)):
                    key = f'{of}{regime}.{name}.bias_function'
                    raise ValueError(f'`{key}` must be finite over its range')

    def correct(
        self, time_s: ArrayLike, counts: ArrayLike, *, board: Temperature = ([], []), **others: Any
    ) -> Corrected:
        """Correct arrays of samples: `thermo_comp.correct` says what it takes, and gives."""
        from .. import correct

        return correct(self, time_s, counts, board=board, **others)

    def regime_sets(self) -> tuple[RegimeSet, RegimeSet]:
        """Return the static and the dynamic set."""
        return self.static, self.dynamic

    @property
    def needs_temperature(self) -> bool:
        """Whether temperature changes what it says; else it is constants, of the reference."""
        weights: list[float] = []
        for axis in (one for part in self.regime_sets() for one in part.axes()):
            weights += (axis.delta, *axis.bias_function.free_coefficients)
            weights += axis.scale_function.free_coefficients
        own = self.gyroscope
        for rate in (*own.static.axes(), *own.dynamic.axes()) if own else ():
            weights += (rate.delta, *rate.bias_function.free_coefficients)
        return any(weights) or bool(self.response or (own and own.response))

    @property
    def needs_case(self) -> bool:
        """Whether it was fitted with a case thermometer, or has columns made of its readings."""
        own = (*self.response, *(self.gyroscope.response if self.gyroscope else ()))
        return self.detector.case != ThermometerSettings() or any(
            one.kind in {'now', 'neighbour', 'size', 'even'}
            or (one.kind == 'square' and not one.tau_s)
            for one in own
        )

    @property
    def has_uncertainty(self) -> bool:
        """Whether it says anything of how well it is known; else it claims nothing."""
        return (
            self.posterior is not None
            or any(self.misalignment_sd)
            or any(axis.residual_sd_m_s2 for part in self.regime_sets() for axis in part.axes())
        )


def parameter_layout(calibration: Calibration) -> ParameterLayout:
    """Say where each parameter of a calibration stands in its posterior."""
    axes = zip(calibration.static.axes(), calibration.dynamic.axes(), strict=True)
    pairs: list[tuple[TemperatureFunction, TemperatureFunction]] = []
    for static, dynamic in axes:
        pairs.append((static.bias_function, dynamic.bias_function))
        pairs.append((static.scale_function, dynamic.scale_function))
    blocks = lay_out(pairs, len(calibration.response))
    end = blocks[-1].end
    return ParameterLayout(blocks[0::2], blocks[1::2], end, end + 3)


def _smallest(function: TemperatureFunction, t: Floats) -> float:
    """Find the smallest value over a range; -inf if any is not finite."""
    try:
        with np.errstate(all='ignore'):
            values = function.value(t)
    except OverflowError:
        return -math.inf
    return float(np.min(values)) if np.isfinite(values).all() else -math.inf
