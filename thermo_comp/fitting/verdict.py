# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the verdict: whether the bags can carry a calibration, with numbers and advice.

Only contradictions are refused. A refusal stops the fit unless the user allows it by name; advice
goes into the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..errors import FitError
from ..thermal.settings import ADVISED_SPAN_K, RAMP_K_MIN
from ..typing import Floats
from ..unit.gravity import MICRO_G, STANDARD_GRAVITY, spoken
from .attitudes import distinct_directions, geometry
from .coverage import LeastKnown, spoken_direction
from .options import FitOptions
from .reduction import ReducedBag
from .windows import ThermalWindows

if TYPE_CHECKING:
    from .evidence import ResidualRow

POSITIONS_NEEDED, POSITIONS_FOR_MISALIGNMENT, POSITIONS_ADVISED = 6, 9, 18
# Largest standard deviation, in units of the noise of one position, that a parameter may have: 18
# spread positions give 1, nine 3, the six faces each done three times by hand 4.5 to 8.
_WORST_GEOMETRY = 6.0
_SATURATED_NEEDED, _SATURATED_ADVISED = 0.05, 0.001
# A direction is unseen whose |f| is known so many times less than in the positions.
_UNSEEN = 3.0


@dataclass(frozen=True)
class Finding:
    """
    One thing that the fit noticed of the data.

    name: short name; a refusal is overridden by it
    level: what it means
    message: one line with the number found, the number needed and what to do
    """

    name: str
    level: Literal['refusal', 'advice', 'good']
    message: str


def enforce(findings: Sequence[Finding], options: FitOptions) -> tuple[Finding, ...]:
    """
    Stop at the first refusal that the user does not allow.

    Raises FitError if there is a refusal; its text says how to mend it and how to override it.
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
    """Judge the raw data: saturation, units, numbers that are no counts."""
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
    for unit, one_g in (('m/s^2', STANDARD_GRAVITY), ('g', 1.0)):
        if not whole and abs(size / one_g - 1.0) < 0.1:
            return [
                Finding(
                    'units',
                    'refusal',
                    f'the samples have norm {size:.3g} and are no whole numbers: they look like '
                    f'{unit}, not counts; record them as sensor_msgs/Imu in m/s^2',
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


def judge_windows(windows: ThermalWindows, up: Floats, has_case: bool) -> list[Finding]:
    """
    Judge what the still windows cover: temperatures, ramps, positions.

    Nothing that is missing is refused: the posterior says what it costs. Refused is what
    contradicts itself.

    `up`: directions, to first order, shape (n_positions, 3).
    """
    findings = _judge_positions(up)
    if not windows.has_temperature:
        text = 'no temperature was recorded: the calibration holds at the temperature of the test'
        return [*findings, Finding('temperature', 'advice', text)]
    findings += _judge_span(windows) + _judge_ramps(windows)
    if has_case:
        return findings + _judge_order(windows)
    text = 'no case temperature: the regime is told from the board alone, later and less surely'
    return [*findings, Finding('case', 'advice', text)]


def _judge_span(windows: ThermalWindows) -> list[Finding]:
    lower, upper = float(np.min(windows.temperature)), float(np.max(windows.temperature))
    span = upper - lower
    if span >= ADVISED_SPAN_K:
        return [Finding('span', 'good', f'temperature span {span:.1f} degC')]
    return [
        Finding(
            'span',
            'advice',
            f'temperature span {span:.1f} degC ({ADVISED_SPAN_K:g} advised): run the chamber over '
            'the whole range of use',
        )
    ]


def _judge_ramps(windows: ThermalWindows) -> list[Finding]:
    rate = windows.rate * 60.0
    heating, cooling = float(np.mean(rate > RAMP_K_MIN)), float(np.mean(rate < -RAMP_K_MIN))
    findings = []
    if heating + cooling < 0.02:
        text = (
            f'no ramp: the board never changes by {RAMP_K_MIN:g} K/min for long, so what a ramp '
            'does is not known; record ramps between the soaks'
        )
        findings.append(Finding('ramps', 'advice', text))
    elif min(heating, cooling) < 0.1 * max(heating, cooling):
        seen, missing = ('heating', 'cooling') if heating > cooling else ('cooling', 'heating')
        text = (
            f'only {seen} was seen; errors in a ramp change sign with its direction, so '
            f'record {missing}, too'
        )
        findings.append(Finding('directions', 'advice', text))
    calm = float(np.mean(windows.weight <= 0.5))
    if calm < 0.05:
        text = (
            f'only {100.0 * calm:.0f} % of the windows are static: the soaks end before the '
            'unit has settled; let some last several hours'
        )
        findings.append(Finding('soak', 'advice', text))
    return findings


def _judge_order(windows: ThermalWindows) -> list[Finding]:
    """Check that the case leads: the gradient has the sign of the board's rate."""
    moving = np.abs(windows.rate) * 60.0 > RAMP_K_MIN
    if windows.data.weight[moving].sum() < 30.0 * windows.data.weight.max():
        return []
    gradient = windows.gradient - np.median(windows.gradient)
    correlation = float(np.corrcoef(gradient[moving], windows.rate[moving])[0, 1])
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


def _judge_positions(up: Floats) -> list[Finding]:
    n = len(distinct_directions(up))
    if n < POSITIONS_NEEDED:
        text = (
            f'{n} distinct position{"s" * (n != 1)}: what tells bias from scale stays at its '
            f'prior (that takes {POSITIONS_NEEDED}, the misalignment {POSITIONS_FOR_MISALIGNMENT})'
        )
        return [Finding('positions', 'advice', text)]
    if not can_tell_misalignment(up):
        text = (
            f'{n} distinct positions tell bias and scale, the misalignment stays at its prior: '
            f'it takes {POSITIONS_FOR_MISALIGNMENT} well spread ones'
        )
        return [Finding('misalignment', 'advice', text)]
    if n < POSITIONS_ADVISED:
        text = f'{n} positions; {POSITIONS_ADVISED} give more'
        return [Finding('positions', 'advice', text)]
    return [Finding('positions', 'good', f'{n} positions')]


def judge_coverage(least: LeastKnown | None) -> list[Finding]:
    """Judge whether the positions left a direction unseen, and say what that costs."""
    if least is None or least.sd_m_s2 < _UNSEEN * least.seen_sd_m_s2:
        return []
    text = (
        f'{least.away_deg:.0f} deg away from every position |f| is known to '
        f'{spoken(least.sd_m_s2)} (1 sd), in them to {spoken(least.seen_sd_m_s2)}: record one '
        f'with {spoken_direction(np.array(least.up))}'
    )
    return [Finding('unseen', 'advice', text)]


def can_tell_misalignment(up: Floats) -> bool:
    """Whether positions are enough, and spread enough, to estimate M."""
    distinct = distinct_directions(up)
    if len(distinct) < POSITIONS_FOR_MISALIGNMENT:
        return False
    return geometry(distinct, with_misalignment=True) <= _WORST_GEOMETRY


def judge_result(
    K: Floats,
    rows: Sequence[ResidualRow],
    slow: float,
    options: FitOptions,
    has_temperature: bool = True,
) -> list[Finding]:
    """
    Judge what the fit left.

    `K`: scale factors, shape (3,). `slow`: RMS over the axes of what no temperature explains
    [m/s^2].
    """
    findings = []
    overall = rows[-1]
    raw, fitted = overall.raw.micro_g.rms, overall.fitted.micro_g.rms
    others = ''
    if overall.left_out.n:
        others = f'{overall.left_out.micro_g.rms:.1f} ug on positions left out, '
    text = f'|g| error {raw:.1f} ug RMS raw, {others}{fitted:.1f} ug in sample'
    if has_temperature and slow / MICRO_G > max(0.3 * raw, 0.5 * fitted):
        why = ': temperature does not explain the drift (jumps, mounting, a loose thermometer?)'
        findings.append(Finding('misfit', 'advice', text + why))
    elif raw < 1.2 * fitted and has_temperature:
        why = ': no temperature drift above the noise; already compensated?'
        findings.append(Finding('compensated', 'advice', text + why))
    else:
        findings.append(Finding('residual', 'good', text))
    if options.input == 'm/s^2' and np.abs(K - 1.0).max() > 0.1:
        text = (
            f'the scale factors are {K.min():.3g}..{K.max():.3g}, expected near 1 for m/s^2: is '
            'the unit, or --gravity, right?'
        )
        findings.append(Finding('units', 'advice', text))
    return findings
