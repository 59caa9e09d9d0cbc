# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the judgement of a calibration on recordings: one verdict, with its numbers and exit code.

At rest ``|f|`` is local gravity in any attitude, so no fixture is needed. Like is compared with
like: the RMS of the residual with the RMS of what is claimed for the very same windows. What lies
outside the calibrated ranges is told apart and decides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..text import counted
from ..typing import Floats
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G, spoken
from .rates import RateJudgement, judge_rates
from .shifts import AxisShift, axis_shifts, distinct_positions, rms_by_axis, what_moved
from .verdicts import LARGEST_RATIO, WIDE_PART, Section, Sections, Verdict, sections_of
from .windows import Windows

# Nor is it one above 1 mg.
_WIDE_CLAIM = 1e3 * MICRO_G


@dataclass(frozen=True)
class Judgement:
    """
    What recordings tell of a calibration: the verdict, and one sentence of its numbers.

    `left_out_rms` is, of windows that the fit has seen, what it left on positions left out, else
    NaN; `tolerance` the user's limit [m/s^2]. Shifts are per axis, none with fewer than six
    distinct positions; `moved` says those that are sure. For `axis_rms` see `rms_by_axis`. The
    gyroscope is judged apart, where there is one.
    """

    kind: Verdict
    reason: str
    sections: Sections
    left_out_rms: float
    tolerance: float | None
    shifts: tuple[AxisShift, ...]
    moved: tuple[str, ...]
    axis_rms: Floats
    n_positions: int
    windows: Windows
    rate: RateJudgement | None

    @property
    def is_valid(self) -> bool:
        """Whether the calibration was shown to hold."""
        return self.kind.is_valid

    @property
    def exit_code(self) -> int:
        """0 for a calibration that was shown to hold, unless its gyroscope does not; else 1."""
        is_rate_wrong = self.rate is not None and self.rate.is_wrong
        return 0 if self.is_valid and not is_rate_wrong else 1

    @property
    def headline_rms(self) -> float:
        """RMS of what a new attitude will see: left out of the fit, or of bags it has not seen."""
        return _headline(self.left_out_rms, self.sections['all'])

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.kind is Verdict.WIDE:
            return f'{self.kind.value} {spoken(self.sections["all"].claimed_rms)}'
        return str(self.kind.value)

    def __str__(self) -> str:
        """Give the verdict with its numbers, as every command prints it."""
        return f'{self.verdict}: {self.reason}'

    def facts(self) -> dict[str, Any]:
        """Give everything but the windows, as every command's JSON holds it."""
        return {
            'verdict': self.verdict,
            'reason': self.reason,
            'is_valid': self.is_valid,
            'gravity_m_s2': self.windows.gravity,
            'window_s': self.windows.window_s,
            'tolerance_m_s2': self.tolerance,
            'left_out_rms_m_s2': self.left_out_rms,
            'sections_m_s2': self.sections.facts(),
            'n_positions': self.n_positions,
            'moved': self.moved,
            'shifts': self.shifts,
            'axis_rms_m_s2': self.axis_rms,
            'angular_rate': None if self.rate is None else self.rate.facts(),
        }


def judge(
    windows: Windows,
    calibration: Calibration,
    tolerance: float | None = None,
    *,
    is_seen: bool = False,
) -> Judgement:
    """
    Judge a calibration by its windows; a `tolerance` on the RMS [m/s^2] decides where given.

    Of windows that the fit has seen, what it left on positions left out stands for them.
    """
    if not len(windows):
        raise ValueError('`windows` must hold at least one')
    if tolerance is not None and not 0.0 < tolerance < np.inf:
        raise ValueError(f'`tolerance` must be positive, got {tolerance:g}')
    claims = calibration.has_uncertainty
    claimed = windows.claimed_sd if claims else np.full(len(windows), np.nan)
    sections = sections_of(windows, windows.raw_residual, windows.residual, claimed)
    left_out = calibration.provenance.left_out_rms if is_seen else np.nan
    shifts = axis_shifts(windows.select(windows.is_inside), calibration.misalignment_sd)
    moved = what_moved(shifts) if claims else ()
    is_thermal = calibration.needs_temperature
    kind, reason = _verdict(windows, sections, left_out, tolerance, moved, claims, is_thermal)
    return Judgement(
        kind=kind,
        reason=reason,
        sections=sections,
        left_out_rms=left_out,
        tolerance=tolerance,
        shifts=shifts,
        moved=moved,
        axis_rms=rms_by_axis(windows),
        n_positions=distinct_positions(windows),
        windows=windows,
        rate=judge_rates(windows, calibration),
    )


def _verdict(
    windows: Windows,
    sections: Sections,
    left_out: float,
    tolerance: float | None,
    moved: tuple[str, ...],
    claims: bool,
    is_thermal: bool,
) -> tuple[Verdict, str]:
    one, outside = sections['all'], sections['outside']
    if not one.n:
        reason = (
            f'all {_windows(outside.n, windows)} lie there, {_span(windows)}; {_numbers(outside)}'
        )
        return Verdict.OUTSIDE, reason
    worst = max([s.rms for s in sections.regimes or [one]] + [_headline(left_out, one)])
    ratio = sections.worst_ratio
    # A NaN of no claim compares false.
    is_wide = one.claimed_rms > (tolerance or min(WIDE_PART * one.raw_rms, _WIDE_CLAIM))
    if one.rms >= one.raw_rms and is_thermal:
        kind = Verdict.NO_BETTER
    elif tolerance is not None and worst > tolerance:
        kind = Verdict.RECALIBRATE
    elif tolerance is None and not claims:
        kind = Verdict.NO_CLAIM
    elif tolerance is None and (ratio > LARGEST_RATIO or moved):
        kind = Verdict.RECALIBRATE
    else:
        kind = Verdict.WIDE if is_wide else Verdict.VALID
    said = [f'{_numbers(one)} over {_windows(one.n, windows)}']
    if np.isfinite(left_out):
        said = [f'{spoken(left_out)} RMS of |f| - g on positions left out; in sample {said[0]}']
    if tolerance is not None:
        where = 'on positions left out' if worst == left_out else 'in the worse regime'
        said.append(f'{spoken(worst)} {where}, {spoken(tolerance)} tolerated')
    elif claims:
        said.append(f'largest ratio of a regime {ratio:.2g}, limit {LARGEST_RATIO:g}')
    else:
        said.append('the calibration says nothing of its uncertainty: give a tolerance')
    if moved:
        said.append('moved: ' + ', '.join(moved))
    if outside.n:
        said.append(
            f'{_windows(outside.n, windows)} outside the calibrated ranges not judged: '
            f'{spoken(outside.rms)}'
        )
    return kind, '; '.join(said)


def _headline(left_out: float, section: Section) -> float:
    return left_out if np.isfinite(left_out) else section.rms


def _numbers(section: Section) -> str:
    said = f'{spoken(section.rms)} RMS of |f| - g, {spoken(section.raw_rms)} raw'
    if np.isfinite(section.claimed_rms):
        said += f', {spoken(section.claimed_rms)} claimed'
    return said


def _windows(n: int, windows: Windows) -> str:
    return f'{counted(n, "window")} of {windows.window_s:g} s'


def _span(windows: Windows) -> str:
    return f'at {np.min(windows.board):.1f} to {np.max(windows.board):.1f} degC'
