# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the verdict: whether the bags can carry a calibration, with numbers and advice.

A refusal stops the fit unless the user allows it by name; advice goes into the result.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import FitError
from ..typing import Floats
from ..unit.gravity import MICRO_G
from .evidence import ResidualRow
from .options import FitOptions
from .reduction import ReducedBag
from .solution import Solution
from .table import WindowTable

SPAN_NEEDED, SPAN_ADVISED = 10.0, 25.0
POSITIONS_NEEDED, POSITIONS_FOR_MISALIGNMENT, POSITIONS_ADVISED = 6, 9, 18
# Directions closer than this are one position measured twice.
_SAME_DIRECTION_DEG = 5.0
# Largest standard deviation, in units of the noise of one position, that a parameter may have: 18
# spread positions give 1, nine 3, the six faces each done three times by hand 4.5 to 8.
_WORST_GEOMETRY = 6.0
_SATURATED_NEEDED, _SATURATED_ADVISED = 0.05, 0.001
_RAMP_K_MIN = 0.1


@dataclass(frozen=True)
class Finding:
    """
    One thing that the fit noticed of the data.

    Parameters
    ----------
    name : str
        Short name; a refusal is overridden by it.
    level : {'refusal', 'advice', 'good'}
        What it means.
    message : str
        One line with the number found, the number needed and what to do.

    """

    name: str
    level: Literal['refusal', 'advice', 'good']
    message: str


def enforce(findings: Sequence[Finding], options: FitOptions) -> tuple[Finding, ...]:
    """
    Stop at the first refusal that the user does not allow.

    Parameters
    ----------
    findings : sequence of Finding
        What was found.
    options : FitOptions
        Gives what the user allows.

    Returns
    -------
    tuple of Finding
        The findings, allowed refusals turned into advice.

    Raises
    ------
    FitError
        If there is a refusal; its text says how to mend it and how to override it.

    """
    result = []
    for finding in findings:
        if finding.level == 'refusal':
            if finding.name not in options.allow:
                raise FitError(f'{finding.message} (override with --allow {finding.name})')
            result.append(Finding(finding.name, 'advice', f'allowed: {finding.message}'))
        else:
            result.append(finding)
    return tuple(result)


def judge_bags(bags: Sequence[ReducedBag], options: FitOptions) -> list[Finding]:
    """
    Judge the raw data: saturation, units, numbers that are no counts.

    Parameters
    ----------
    bags : sequence of ReducedBag
        The bags.
    options : FitOptions
        What the user said of them.

    Returns
    -------
    list of Finding
        Findings.

    """
    findings = []
    n_samples = sum(bag.n_samples for bag in bags)
    n_saturated = sum(bag.n_saturated for bag in bags)
    if n_saturated > _SATURATED_ADVISED * n_samples:
        part = n_saturated / n_samples
        findings.append(
            Finding(
                'saturation',
                'refusal' if part > _SATURATED_NEEDED else 'advice',
                f'{100.0 * part:.2f} % of the samples are at the full scale: an axis sees more '
                'than it can measure, or --full-scale is wrong',
            )
        )
    still = sum(bag.n_still_cells for bag in bags) / max(sum(bag.n_cells for bag in bags), 1)
    if still < 0.5:
        findings.append(
            Finding(
                'motion',
                'advice',
                f'only {100.0 * still:.0f} % of the time is still; vibration or handling is in '
                'the rest and was cut out',
            )
        )
    if options.input == 'counts':
        findings += _judge_counts(bags)
    return findings


def _judge_counts(bags: Sequence[ReducedBag]) -> list[Finding]:
    means = np.concatenate([interval.mean for bag in bags for interval in bag.intervals])
    size = float(np.median(np.linalg.norm(means, axis=1)))
    whole = all(bag.is_integer for bag in bags)
    for unit, one_g in (('m/s^2', 9.81), ('g', 1.0)):
        if not whole and abs(size / one_g - 1.0) < 0.1:
            return [
                Finding(
                    'units',
                    'refusal',
                    f'the samples have norm {size:.3g} and are no whole numbers: they look like '
                    f'{unit}, not counts; record them as sensor_msgs/Imu in m/s^2 (--input imu)',
                )
            ]
    if not whole:
        return [
            Finding(
                'compensated',
                'advice',
                'the samples are no whole numbers: scaled or compensated before they were '
                'recorded? A calibration made on them fits that output only',
            )
        ]
    return []


def judge_table(
    table: WindowTable, up: Floats, with_misalignment: bool, has_case: bool
) -> list[Finding]:
    """
    Judge what the still windows cover: temperatures, ramps, positions.

    Parameters
    ----------
    table : WindowTable
        The windows.
    up : ndarray, shape (n_positions, 3)
        Directions, to first order.
    with_misalignment : bool
        Whether M is to be estimated.
    has_case : bool
        Whether there are case temperatures.

    Returns
    -------
    list of Finding
        Findings.

    """
    findings = _judge_span(table) + _judge_ramps(table)
    findings += _judge_positions(up, with_misalignment)
    if has_case:
        findings += _judge_order(table)
    else:
        findings.append(
            Finding(
                'case',
                'advice',
                'no case temperature: the regime is told from the board alone, later and less '
                'surely',
            )
        )
    return findings


def _judge_span(table: WindowTable) -> list[Finding]:
    lower, upper = float(np.min(table.t)), float(np.max(table.t))
    span = upper - lower
    if span >= SPAN_ADVISED:
        return [Finding('span', 'good', f'temperature span {span:.1f} degC')]
    level: Literal['refusal', 'advice'] = 'refusal' if span < SPAN_NEEDED else 'advice'
    return [
        Finding(
            'span',
            level,
            f'temperature span {span:.1f} degC, need {SPAN_NEEDED:g} ({SPAN_ADVISED:g} advised): '
            'run the chamber over the whole range of use',
        )
    ]


def _judge_ramps(table: WindowTable) -> list[Finding]:
    rate = table.rate * 60.0
    heating, cooling = float(np.mean(rate > _RAMP_K_MIN)), float(np.mean(rate < -_RAMP_K_MIN))
    findings = []
    if heating + cooling < 0.02:
        findings.append(
            Finding(
                'ramps',
                'refusal',
                f'no ramp: the board never changes by {_RAMP_K_MIN:g} K/min for long, so there '
                'is no dynamic set; record ramps between the soaks',
            )
        )
    elif min(heating, cooling) < 0.1 * max(heating, cooling):
        seen, missing = ('heating', 'cooling') if heating > cooling else ('cooling', 'heating')
        findings.append(
            Finding(
                'directions',
                'advice',
                f'only {seen} was seen; errors in a ramp change sign with its direction, so '
                f'record {missing}, too',
            )
        )
    calm = float(np.mean(~table.is_dynamic))
    if calm < 0.05:
        findings.append(
            Finding(
                'soak',
                'advice',
                f'only {100.0 * calm:.0f} % of the windows are static: the soaks end before the '
                'unit has settled; let some last several hours',
            )
        )
    return findings


def _judge_order(table: WindowTable) -> list[Finding]:
    """
    Check that the case leads: the gradient has the sign of the board's rate.

    """
    moving = np.abs(table.rate) * 60.0 > _RAMP_K_MIN
    if moving.sum() < 30:
        return []
    gradient = table.gradient - np.median(table.gradient)
    correlation = float(np.corrcoef(gradient[moving], table.rate[moving])[0, 1])
    if correlation > -0.3:
        return []
    return [
        Finding(
            'swapped',
            'refusal',
            f'the board temperature leads the case (correlation {correlation:.2f} of gradient '
            'and rate): are the two sensors exchanged?',
        )
    ]


def _judge_positions(up: Floats, with_misalignment: bool) -> list[Finding]:
    distinct = distinct_directions(up)
    n = len(distinct)
    if n < POSITIONS_NEEDED:
        return [
            Finding(
                'positions',
                'refusal',
                f'{n} distinct positions, need {POSITIONS_NEEDED} for bias and scale and '
                f'{POSITIONS_FOR_MISALIGNMENT} for the misalignment '
                f'({POSITIONS_ADVISED} advised)',
            )
        ]
    findings = []
    if with_misalignment and n < POSITIONS_FOR_MISALIGNMENT:
        findings.append(
            Finding(
                'misalignment',
                'refusal',
                f'{n} distinct positions cannot tell the misalignment, need '
                f'{POSITIONS_FOR_MISALIGNMENT}: add positions between the faces',
            )
        )
    worst = geometry(distinct, with_misalignment)
    if not worst <= _WORST_GEOMETRY:
        findings.append(
            Finding(
                'geometry',
                'refusal',
                f'the positions are badly spread: the worst parameter is known to {worst:.1f} '
                f'times the noise, need {_WORST_GEOMETRY:g}; point each axis up, down and '
                'between, or leave the misalignment out',
            )
        )
    elif n < POSITIONS_ADVISED:
        findings.append(
            Finding('positions', 'advice', f'{n} positions; {POSITIONS_ADVISED} give more')
        )
    else:
        findings.append(
            Finding('positions', 'good', f'{n} positions, worst parameter {worst:.1f} x noise')
        )
    return findings


def can_tell_misalignment(up: Floats) -> bool:
    """
    Whether positions are enough, and spread enough, to estimate M.

    """
    distinct = distinct_directions(up)
    if len(distinct) < POSITIONS_FOR_MISALIGNMENT:
        return False
    return geometry(distinct, with_misalignment=True) <= _WORST_GEOMETRY


def distinct_directions(up: Floats) -> Floats:
    """
    Drop directions that repeat another.

    Parameters
    ----------
    up : ndarray, shape (n, 3)
        Unit vectors.

    Returns
    -------
    ndarray, shape (m, 3)
        Those further than 5 degrees from all before.

    """
    kept: list[Floats] = []
    limit = np.cos(np.radians(_SAME_DIRECTION_DEG))
    for direction in up:
        if all(float(direction @ other) < limit for other in kept):
            kept.append(direction)
    return np.array(kept).reshape(-1, 3)


def geometry(up: Floats, with_misalignment: bool) -> float:
    """
    Worst standard deviation of bias, scale and misalignment per unit of norm noise.

    Parameters
    ----------
    up : ndarray, shape (n, 3)
        Directions.
    with_misalignment : bool
        Whether M is among the parameters.

    Returns
    -------
    float
        In units of the noise of ``|f|``, g = 1; infinite when a parameter is free.

    """
    x, y, z = up.T
    # d|f| by the biases, relative scales and the three elements of M.
    columns = [x, y, z, x * x, y * y, z * z]
    if with_misalignment:
        columns += [x * y, x * z, y * z]
    jacobian = np.column_stack(columns)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    if values[0] < 1e-9 * values[-1]:
        return float('inf')
    return float(np.sqrt(np.max((vectors**2) @ (1.0 / values))))


def judge_result(
    solution: Solution, rows: Sequence[ResidualRow], slow: Floats, options: FitOptions
) -> list[Finding]:
    """
    Judge what the fit left.

    Parameters
    ----------
    solution : Solution
        The estimates.
    rows : sequence of ResidualRow
        Residuals before and after.
    slow : ndarray, shape (2, 3)
        Slow error per regime and axis.
    options : FitOptions
        The unit of the samples.

    Returns
    -------
    list of Finding
        Findings.

    """
    findings = []
    overall = rows[-1]
    raw, fitted = overall.raw.micro_g.rms, overall.fitted.micro_g.rms
    left = float(np.sqrt(np.mean(slow**2))) / MICRO_G
    text = f'|g| error {raw:.1f} ug RMS raw, {fitted:.1f} ug fitted, {left:.1f} ug of it slow'
    if left > 0.3 * raw and left > 0.5 * fitted:
        findings.append(
            Finding(
                'misfit',
                'advice',
                f'{text}: temperature does not explain the drift (jumps, mounting, a loose '
                'thermometer?)',
            )
        )
    elif raw < 1.2 * fitted:
        findings.append(
            Finding(
                'compensated',
                'advice',
                f'{text}: no temperature drift above the noise; already compensated?',
            )
        )
    else:
        findings.append(Finding('residual', 'good', text))
    relative = np.abs(solution.scale[:, 0])
    if options.input == 'm/s^2' and np.abs(relative - 1.0).max() > 0.1:
        findings.append(
            Finding(
                'units',
                'advice',
                f'the scale factors are {relative.min():.3g}..{relative.max():.3g}, expected near '
                '1 for m/s^2: is the unit, or --gravity, right?',
            )
        )
    longest = float(np.max(solution.time_constants_s, initial=0.0))
    if longest:
        findings.append(
            Finding(
                'memory',
                'good',
                'thermal memory of '
                + ' and '.join(f'{tau:.0f} s' for tau in solution.time_constants_s)
                + f'; soaks should last {5.0 * longest / 3600.0:.1f} h to see it die',
            )
        )
    return findings
