# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the parts of a certificate according to ISO/IEC 17025: results, bias and scale over
temperature, uncertainty budget, statement of conformity.
"""

import math
from typing import NamedTuple

import numpy as np

from ..judging.verdicts import Verdict
from ..typing import Floats
from ..unit.calibration import AXES, Calibration, RegimeSet
from ..unit.gravity import MICRO_G
from ..unit.prediction import (
    bias_and_scale,
    bias_scale_and_sd,
    in_a_soak,
    nonlinear_coefficients,
    ramp_states,
)
from .evidence import Evidence
from .statements import CertificateInfo
from .style import minus, number, rounded

#: Coverage factor of an expanded uncertainty: 95 % of a normal distribution.
COVERAGE = 2.0
# Numbers of temperatures at which a slope and a curve are evaluated.
_N_SLOPE, _N_CURVE = 33, 61
#: Steps of a table over temperature [K], and the largest number of temperatures in a table.
_STEPS_K = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_MOST_TEMPERATURES = 8


class Program(NamedTuple):
    """A soak, or a ramp from a soak at one end of a regime's temperatures to the other end."""

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

    `value` is the bias or scale less its value in a soak at the reference temperature; `sd` is the
    sd of bias and scale, not of this difference.
    """

    program: Program
    temperature: Floats
    value: Floats
    sd: Floats


class Contribution(NamedTuple):
    """One line of the uncertainty budget: a standard uncertainty of |f| [m/s^2]."""

    name: str
    evaluation: str  # type A (statistical) or B (other), see the GUM, JCGM 100
    standard: float | None  # None if the uncertainty is not stated
    basis: str


class Result(NamedTuple):
    """One line of the results, with its expanded uncertainty (k = 2), as rounded texts."""

    quantity: str
    value: str
    expanded: str
    unit: str


class AxisOverTemperature(NamedTuple):
    """
    Bias and scale of one axis over the temperature of the board, and the slopes of lines fitted to
    bias and scale in a soak [micro-g/K, ppm/K].

    Cells of a row, as rounded texts: soak or ramp; temperature [degC]; bias, its expanded
    uncertainty and its deviation [micro-g]; scale relative to the scale at the reference
    temperature, its expanded uncertainty and its deviation [ppm]. A deviation is the bias or scale
    less a line of the fitted slope through its value in a soak at the reference temperature.
    """

    axis: str
    bias_slope: float
    scale_slope: float
    rows: list[tuple[str, ...]]


def budget(evidence: Evidence, info: CertificateInfo) -> tuple[Contribution, ...]:
    """Return the contributions to the uncertainty of ``|f|`` at rest; empty without bags."""
    judgement, calibration = evidence.judgement, evidence.calibration
    if judgement is None or calibration is None or not judgement.sections['all'].n:
        return ()
    windows = judgement.windows.select(judgement.windows.is_inside)
    noise = _rms(windows.noise_sd)
    attitude = lack = model = None
    claimed = noise
    if calibration.has_uncertainty:
        x, y, z = (windows.force / np.linalg.norm(windows.force, axis=1, keepdims=True)).T
        # Derivatives of |f| with respect to M[1][0], M[2][0] and M[2][1] at |f| = g.
        by_element = np.stack((x * y, x * z, y * z)) * windows.gravity
        attitude = _rms(np.linalg.norm(by_element.T * calibration.misalignment_sd, axis=1))
        claimed = _rms(windows.claimed_sd)
        lack = _rms(windows.lack_sd)
        # The claimed variance is the sum of `itemised` and the variance due to other parameters.
        itemised = noise**2 + attitude**2 + lack**2 + evidence.gravity_sd**2
        model = float(np.sqrt(max(claimed**2 - itemised, 0.0)))
    excess = float(np.sqrt(max(judgement.headline_rms**2 - claimed**2, 0.0)))
    drift_k, drift, slope = info.thermometers.standard_uncertainty_k, None, ''
    if drift_k is not None:
        drift = drift_k * _slope(calibration)
        slope = f'{drift_k:g} K times the RMS slope of the bias'
    gravity = unclaimed_gravity_sd(evidence, info)
    if gravity is not None and calibration.has_uncertainty:
        gravity = float(np.hypot(gravity, evidence.gravity_sd))
    source = info.gravity.source or ('given to the fit' if evidence.gravity_sd else '')
    parts = (
        ('noise', 'A', noise, f'white noise of a mean over {windows.window_s:g} s'),
        ('gravity', 'B', gravity, source),
        ('attitude', 'A', attitude, 'uncertainty of the misalignment of the axes'),
        ('thermometers', 'B', drift, slope),
        ('lack of fit', 'A', lack, 'left-out errors beyond noise and sd of parameters'),
        ('model', 'A', model, 'remainder of the claimed sd of |f|'),
        ('repeatability', 'A', excess, 'RMS of |f| − g beyond the claimed sd'),
    )
    return tuple(Contribution(*part) for part in parts)


def unclaimed_gravity_sd(evidence: Evidence, info: CertificateInfo) -> float | None:
    """Return the sd of gravity that the covariance lacks [m/s^2]; None without a stated sd."""
    stated = info.gravity.standard_uncertainty_m_s2
    if stated is None:
        return 0.0 if evidence.gravity_sd else None
    return float(np.sqrt(max(stated**2 - evidence.gravity_sd**2, 0.0)))


def combined(contributions: tuple[Contribution, ...]) -> float:
    """Return the combined standard uncertainty of the stated contributions [m/s^2]."""
    return float(np.sqrt(sum((part.standard or 0.0) ** 2 for part in contributions)))


def results(
    evidence: Evidence, info: CertificateInfo, contributions: tuple[Contribution, ...]
) -> list[Result]:
    """List constants and nonlinear terms at the reference temperature, and the mean |f| - g."""
    calibration = evidence.calibration
    if calibration is None:
        return []
    unit = 'counts' if calibration.unit.input == 'counts' else 'm/s²'
    bias, bias_sd, scale, scale_sd = in_a_soak(calibration)
    coverage = COVERAGE if calibration.has_uncertainty else np.nan
    scale_sd = np.hypot(scale_sd, _gravity_part(evidence, info)) * np.abs(scale)
    below = ((1, 0), (2, 0), (2, 1))
    constants = {
        'scale factor {}': (AXES, scale, scale_sd, f'{unit} per m/s²'),
        'bias {}': (AXES, bias / MICRO_G, bias_sd / MICRO_G, 'µg'),
        'misalignment {}': (
            [AXES[i] + AXES[j] for i, j in below],
            1e6 * np.array([calibration.misalignment[i][j] for i, j in below]),
            1e6 * np.array(calibration.misalignment_sd),
            'µrad',
        ),
    }
    rows = [
        Result(name.format(part), *rounded(float(value), float(coverage * sd)), in_unit)
        for name, (parts, values, sds, in_unit) in constants.items()
        for part, value, sd in zip(parts, values, sds, strict=True)
    ]
    for term in nonlinear_coefficients(calibration):
        rows += [
            Result(f'{term.name} {axis}', *rounded(value, coverage * sd), term.unit)
            for axis, value, sd in zip(AXES, term.value.tolist(), term.sd.tolist(), strict=True)
        ]
    if contributions and evidence.judgement is not None:
        expanded_ug = COVERAGE * combined(contributions) / MICRO_G
        for name in ('static', 'dynamic'):
            section = evidence.judgement.sections[name]
            if section.n:
                is_known = coverage > 0.0 and unclaimed_gravity_sd(evidence, info) is not None
                mean_ug = section.mean / MICRO_G
                texts = rounded(mean_ug, expanded_ug) if is_known else (number(mean_ug), '–')
                rows.append(Result(f'mean of |f| − g, {name}', *texts, 'µg'))
    return rows


def over_temperature(evidence: Evidence, info: CertificateInfo) -> list[AxisOverTemperature]:
    """Tabulate bias and scale of each axis in a soak and in ramps at temperatures of the board."""
    calibration = evidence.calibration
    if calibration is None or not calibration.needs_temperature:
        return []
    coverage = COVERAGE if calibration.has_uncertainty else np.nan
    slope = slopes(curves(calibration)[0])
    bias_0, *_ = in_a_soak(calibration)
    tables = [
        AxisOverTemperature(axis, float(slope[k]), float(slope[k + 3]), [])
        for k, axis in enumerate(AXES)
    ]
    for program in programs(calibration):
        at = table_temperatures(*program.regime.temperature_range_c)
        value, sd = evaluate(calibration, program, at)[2:]
        off = value - np.outer(at - calibration.reference_temperature_c, slope)
        value[:, :3] += bias_0 / MICRO_G
        # If gravity has no stated sd, the digits of bias, scale and deviations follow from the
        # other uncertainties; without any uncertainty, the largest value of a column has 4 digits.
        largest = np.maximum(np.abs(value).max(axis=0), 1e-3)
        four_digits = 10.0 ** (np.floor(np.log10(largest)) - 2.0)
        digits = np.where(coverage * sd > 0.0, coverage * sd, four_digits)
        sd[:, 3:] = np.hypot(sd[:, 3:], 1e6 * _gravity_part(evidence, info))
        for k, table in enumerate(tables):
            for row in range(len(at)):
                cells = [program.name, minus(f'{at[row]:.1f}')]
                for column in (k, k + 3):
                    expanded = float(coverage * sd[row, column])
                    place = expanded if math.isfinite(expanded) else float(digits[row, column])
                    text, deviation = (
                        rounded(float(part[row, column]), place)[0] for part in (value, off)
                    )
                    cells += text, rounded(0.0, expanded)[1], deviation
                table.rows.append(tuple(cells))
    return tables


def _gravity_part(evidence: Evidence, info: CertificateInfo) -> float:
    """Return the scale's relative sd due to gravity's sd; NaN if gravity has no stated sd."""
    sd = unclaimed_gravity_sd(evidence, info)
    if sd is None or evidence.calibration is None:
        return np.nan
    return sd / evidence.calibration.gravity_m_s2


def conformity(evidence: Evidence) -> tuple[str, str]:
    """Return the statement of conformity and its rule; without a statement, '' and the reason."""
    judgement = evidence.judgement
    if judgement is None:
        return '', 'No recording was judged: no statement of conformity is made.'
    if judgement.tolerance is None:
        return '', 'No limit was specified (--tolerance): no statement of conformity is made.'
    limit = number(judgement.tolerance / MICRO_G)
    if judgement.kind in (Verdict.OUTSIDE, Verdict.SWAPPED):
        return '', f'No statement of conformity is made: {judgement.kind.value}.'
    does = 'conforms' if judgement.is_valid else 'does not conform'
    return (
        f'The unit {does} to the limit of {limit} µg.',
        'Rule: simple acceptance. Within the calibrated ranges the RMS of |f| − g of each regime '
        'and, if known, on positions left out of the fit is at most the limit. If the correction '
        'depends on temperature, the overall RMS of |f| − g is below the raw RMS. '
        'The uncertainty is not subtracted from the limit (guard band 0).',
    )


def _slope(calibration: Calibration) -> float:
    """Return the RMS of the bias's slope over the static range and the axes [m/s^2/K]."""
    temperature = np.linspace(*calibration.static.temperature_range_c, _N_SLOPE)
    bias, _ = bias_and_scale(calibration, ramp_states(calibration, temperature))
    return _rms(np.diff(bias, axis=0) / np.diff(temperature)[:, None])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def programs(calibration: Calibration) -> list[Program]:
    """List a soak and, if the correction differs in ramps, ramps at half the largest rates."""
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
    bias, sd_bias, scale, sd_scale = bias_scale_and_sd(calibration, states)
    bias_0, _, scale_0, _ = in_a_soak(calibration)
    value = np.hstack(((bias - bias_0) / MICRO_G, (scale / scale_0 - 1.0) * 1e6))
    return Curve(program, temperature, value, np.hstack((sd_bias / MICRO_G, sd_scale * 1e6)))


def curves(calibration: Calibration) -> list[Curve]:
    """Evaluate soak and ramps, each over the calibrated temperatures of its regime."""
    return [
        evaluate(calibration, program, np.linspace(*program.regime.temperature_range_c, _N_CURVE))
        for program in programs(calibration)
    ]


def slopes(soak: Curve) -> Floats:
    """Fit a straight line to each column of a soak; return the slopes per kelvin, shape (6,)."""
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
