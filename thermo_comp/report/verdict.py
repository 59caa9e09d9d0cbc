# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the verdict: what the evidence says of the unit, in words, with what speaks against it.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G
from .evidence import CHOSEN, RAW, Evidence
from .text import number

# A ramp slower than this says nothing of its direction.
_SLOWEST_RAMP_K_MIN = 0.05
# The dynamic regime is a concern when it is this many times the static one, and matters at all.
_UNEVEN_RATIO, _UNEVEN_LEAST = 3.0, 10.0 * MICRO_G
# A residual this many times that of the fit's own data is no longer the same unit's.
_SUSPICIOUS_RATIO = 5.0

Level = Literal['good', 'reserved', 'poor', 'open']


@dataclass(frozen=True)
class Verdict:
    """
    The verdict.

    Parameters
    ----------
    level : {'good', 'reserved', 'poor', 'open'}
        It holds; with reservations; it does not; nothing was judged.
    headline : str
        One sentence.
    sentences : tuple of str
        What it rests on.
    reservations : tuple of str
        What speaks against it, each with its reason.
    checks : tuple of str
        What was looked at and found good.

    """

    level: Level
    headline: str
    sentences: tuple[str, ...]
    reservations: tuple[str, ...]
    checks: tuple[str, ...] = ()


def judge(evidence: Evidence) -> Verdict:
    """
    Say what the evidence says.

    Parameters
    ----------
    evidence : Evidence
        The evidence.

    Returns
    -------
    Verdict
        In words.

    """
    calibration = evidence.calibration
    if calibration is None:
        return Verdict(
            'open', 'A thermal record; no calibration was judged.', _record(evidence), ()
        )
    reservations = [*_of_calibration(calibration), *evidence.findings]
    statistics = evidence.statistics
    if CHOSEN not in statistics or not statistics[CHOSEN]['all'].n:
        return Verdict(
            'open',
            'The calibration as it stands; no recording was judged with it.',
            _fitted_sentences(calibration),
            tuple(dict.fromkeys(reservations)),
        )
    suspicions: list[str] = []
    if evidence.is_fit:
        reservations += _of_fit(evidence)
    else:
        suspicions = _suspicions(evidence, calibration)
        reservations += suspicions + _outside(evidence, calibration)
    before, after = statistics[RAW]['all'], statistics[CHOSEN]['all']
    left = ', '.join(
        f'{number(statistics[CHOSEN][section].micro_g.rms)} µg {section}'
        for section in ('static', 'dynamic')
        if statistics[CHOSEN][section].n
    )
    sentences = (
        f'|g| at rest missed local gravity by {number(before.micro_g.rms)} µg RMS without thermal '
        f'correction and by {number(after.micro_g.rms)} µg with it '
        f'(largest {number(after.micro_g.peak)} µg), over {after.n} windows in '
        f'{_count(len(evidence.positions), "position")} and {_span(evidence)}.',
        *_record(evidence),
    )
    against = tuple(dict.fromkeys(reservations))
    if after.rms > before.rms:
        headline = 'The calibration does not hold: |g| is worse with it than without.'
        return Verdict('poor', headline, sentences, against, evidence.checks)
    if suspicions:
        headline = f'The calibration does not hold here: |g| misses gravity by {left} RMS.'
        return Verdict('poor', headline, sentences, against, evidence.checks)
    if against:
        headline = f'The calibration holds, with reservations: |g| within {left} RMS.'
        return Verdict('reserved', headline, sentences, against, evidence.checks)
    headline = f'The calibration holds: |g| within {left} RMS.'
    return Verdict('good', headline, sentences, (), evidence.checks)


def _of_calibration(calibration: Calibration) -> list[str]:
    found = []
    lower, upper = calibration.dynamic.rate_range_k_min
    for name, rate in (('heating', upper), ('cooling', -lower)):
        if rate < _SLOWEST_RAMP_K_MIN:
            found.append(f'the dynamic set never saw {name}: its ramps are a guess there')
    if not any(axis.covariance for part in calibration.regime_sets() for axis in part.axes()):
        found.append('the calibration carries no parameter covariance: it claims no uncertainty')
    return found


def _of_fit(evidence: Evidence) -> list[str]:
    found = []
    static, dynamic = (evidence.statistics[CHOSEN][name] for name in ('static', 'dynamic'))
    for name, part in (('static', static), ('dynamic', dynamic)):
        if not part.n:
            found.append(f'the bags hold nothing {name}: that set was not put to the test')
    if static.n and dynamic.n and dynamic.rms > max(_UNEVEN_RATIO * static.rms, _UNEVEN_LEAST):
        found.append(
            f'the dynamic regime is {number(dynamic.rms / static.rms, 2)} times worse than the '
            'static one: a model with memory or gradient terms may do better'
        )
    return found


def _suspicions(evidence: Evidence, calibration: Calibration) -> list[str]:
    """
    Tell where a recording looks like that of another unit.

    """
    found = []
    for row in calibration.provenance.residuals:
        now = evidence.statistics[CHOSEN].get(row.section)
        if now is None or row.section == 'all' or not now.n:
            continue
        if now.rms > _SUSPICIOUS_RATIO * row.rms_m_s2 > 0.0:
            found.append(
                f'{row.section}: {number(now.micro_g.rms)} µg RMS, where the fit left '
                f'{number(row.rms_m_s2 / MICRO_G)}; another unit, or it has drifted: fit anew'
            )
    return found


def _outside(evidence: Evidence, calibration: Calibration) -> list[str]:
    """
    Tell how much of a recording lies beyond the calibrated temperatures.

    """
    windows = evidence.windows
    if windows is not None and len(windows):
        lower = min(part.temperature_range_c[0] for part in calibration.regime_sets())
        upper = max(part.temperature_range_c[1] for part in calibration.regime_sets())
        outside = float(np.mean((windows.board < lower) | (windows.board > upper)))
        if outside > 0.001:
            return [
                f'{number(100.0 * outside, 2)} % of the windows lie outside the calibrated '
                f'{lower:.1f} to {upper:.1f} °C, where the functions are held'
            ]
    return []


def _record(evidence: Evidence) -> tuple[str, ...]:
    shown = evidence.shown
    if shown is None:
        return ()
    stretches = [s for s in shown.trace.stretches if s.regime >= 0]
    dynamic = [s for s in stretches if s.regime == 1]
    total = sum(s.stop - s.start for s in stretches)
    if not total:
        return ('The regime was never known: the bag is too short for the detector.',)
    part = sum(s.stop - s.start for s in dynamic) / total
    name = evidence.bags[shown.index].name
    return (
        f'In bag {name} the flag marked {_count(len(dynamic), "dynamic stretch", "es")}, '
        f'{100.0 * part:.0f} % of the time in which the regime was known.',
    )


def _fitted_sentences(calibration: Calibration) -> tuple[str, ...]:
    rows = [
        f'{number(row.rms_m_s2 / MICRO_G)} µg RMS {row.section} '
        f'({number(row.raw_rms_m_s2 / MICRO_G)} without correction)'
        for row in calibration.provenance.residuals
        if row.section != 'all'
    ]
    return (f'Its fit left, on its own bags: {"; ".join(rows)}.',) if rows else ()


def _span(evidence: Evidence) -> str:
    windows = evidence.windows
    if windows is None or not len(windows):
        return 'no temperature'
    return f'{float(np.min(windows.board)):.1f} to {float(np.max(windows.board)):.1f} °C'


def _count(n: int, name: str, plural: str = 's') -> str:
    return f'{n} {name}' + ('' if n == 1 else plural)
