# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the judgement of a calibration on recordings: a verdict with its numbers and exit code."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ..fitting.coverage import distinct_directions, norm_columns
from ..fitting.data_checks import POSITIONS_NEEDED
from ..fitting.initial_triad import within_positions
from ..online.compensator import SWAPPED
from ..text import counted
from ..typing import Floats
from ..unit.calibration import Calibration
from ..unit.gravity import MICRO_G, ug_text
from ..unit.metrics import means_by
from ..unit.provenance import Provenance
from . import verdicts
from .verdicts import Section, Sections, Verdict
from .windows import JudgedWindows

# Without a tolerance, a valid calibration is WIDE above this RMS of the claimed sd [m/s^2].
_WIDE_CLAIM = 1e3 * MICRO_G
# A drift of an axis is reported above this ratio to the drift on data left out of the fit.
_LARGE_DRIFT = 5.0
#: Smallest significant shift or change of a constant, in standard deviations.
SIGNIFICANT_SDS = 3.0
# Smallest sds, to avoid a division by 0: sd of a misalignment [rad]; sd of the mean |f| / g of a
# position, also used for the |f| of a window [m/s^2].
_SMALLEST_MISALIGNMENT_SD, _SMALLEST_NORM_SD = 1e-5, 1e-8
# Number of consecutive windows that count as one observation: thermal residuals are correlated.
_CORRELATED_WINDOWS = 6.0


@dataclass(frozen=True)
class AxisShift:
    """Shift of an axis since the calibration: bias [m/s^2], relative scale, each with its sd."""

    bias: float
    bias_sd: float
    scale: float
    scale_sd: float


@dataclass(frozen=True)
class Expectation:
    """RMS error of windows and of left-out data, RMS claimed sd [m/s^2]; NaN if unknown."""

    found_rms: float
    expected_rms: float
    claimed_rms: float = np.nan


@dataclass(frozen=True)
class Judgement:
    """
    The judgement of a calibration on recordings: the verdict, and a sentence with its numbers.

    `left_out_rms`: RMS of |f| - g on positions left out of the fit, NaN unless the bags are those
    of the fit; `tolerance`: the user's limit on RMS values [m/s^2]. `shifts`: shift of bias and
    scale of each axis, empty with fewer than six distinct positions; `moved`: text of each
    significant shift; `axis_rms`: RMS drift of each regime and axis; `rate`: judgement of the
    gyroscope; `expectations`: errors of |f| - g (`norm`) and of an axis's drift (`drift`).
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
    windows: JudgedWindows
    rate: verdicts.RateJudgement | None
    expectations: dict[str, Expectation]
    by_force: dict[float, Section] = field(default_factory=dict)

    @property
    def is_valid(self) -> bool:
        """Whether the verdict is that the calibration is valid."""
        return self.kind.is_valid

    @property
    def exit_code(self) -> int:
        """0 if valid, and the gyroscope's verdict is not `RECALIBRATE` or `NO_BETTER`, else 1."""
        is_wrong = self.rate and self.rate.kind in (Verdict.RECALIBRATE, Verdict.NO_BETTER)
        return 0 if self.is_valid and not is_wrong else 1

    @property
    def headline_rms(self) -> float:
        """RMS error of left-out positions or, if unknown, of windows in the calibrated ranges."""
        in_sample = self.sections['all'].rms
        return self.left_out_rms if np.isfinite(self.left_out_rms) else in_sample

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.kind is Verdict.WIDE:
            return f'{self.kind.value} {ug_text(self.sections["all"].claimed_rms)}'
        return str(self.kind.value)

    def __str__(self) -> str:
        """Return the verdict with its numbers, as printed by every command."""
        return f'{self.verdict}: {self.reason}'

    def facts(self) -> dict[str, Any]:
        """Return the judgement without the windows, as in every command's JSON."""
        return {
            'verdict': self.verdict,
            'reason': self.reason,
            'is_valid': self.is_valid,
            'gravity_m_s2': self.windows.gravity,
            'window_s': self.windows.window_s,
            'tolerance_m_s2': self.tolerance,
            'left_out_rms_m_s2': self.left_out_rms,
            'expectations_m_s2': self.expectations,
            'sections_m_s2': self.sections.facts(),
            'n_positions': self.n_positions,
            'moved': self.moved,
            'shifts': self.shifts,
            'by_force_m_s2': [
                {'size': size, **asdict(section)} for size, section in self.by_force.items()
            ],
            'axis_rms_m_s2': self.axis_rms,
            'angular_rate': None if self.rate is None else self.rate.facts(),
        }


def judge(
    windows: JudgedWindows,
    calibration: Calibration,
    tolerance: float | None = None,
    *,
    is_seen: bool = False,
) -> Judgement:
    """
    Judge a calibration by corrected windows; for windows of the fit's bags (`is_seen`) also by the
    RMS on positions left out of the fit. If a `tolerance` on the RMS [m/s^2] is given, the
    tolerance decides instead of the claimed sd.
    """
    claims = calibration.has_uncertainty
    claimed = windows.claimed_sd if claims else np.full(len(windows), np.nan)
    sections = verdicts.sections_of(windows, windows.raw_residual, windows.residual, claimed)
    at_1_g = windows.select(windows.is_inside & windows.is_usual)
    shifts = axis_shifts(at_1_g, calibration.misalignment_sd)
    judgement = Judgement(
        kind=Verdict.OUTSIDE,
        reason='',
        sections=sections,
        left_out_rms=calibration.provenance.left_out_rms if is_seen else np.nan,
        tolerance=tolerance,
        shifts=shifts,
        moved=change_texts(shifts) if claims else (),
        axis_rms=rms_by_axis(windows),
        n_positions=distinct_positions(windows),
        windows=windows,
        rate=verdicts.judge_rates(windows.select(windows.is_usual), calibration),
        expectations=_expectations(windows, sections['all'], calibration.provenance),
        by_force=verdicts.by_force(windows, claimed),
    )
    kind, reason = _verdict(judgement, claims, calibration)
    return replace(judgement, kind=kind, reason=reason)


def _expectations(
    windows: JudgedWindows, full: Section, provenance: Provenance
) -> dict[str, Expectation]:
    """Compare |f| - g and the axes' drift with their errors on data left out of the fit."""
    inside = windows.select(windows.is_inside)
    drift = within_positions(inside.force, inside.position)
    found = float(np.sqrt(np.mean(drift**2))) if len(inside) else np.nan
    return {
        'norm': Expectation(full.rms, provenance.left_out_rms, full.claimed_rms),
        'drift': Expectation(found, provenance.left_out_drift),
    }


def _ranges(celsius: Floats, k_min: Floats) -> str:
    """Return the ranges of temperatures and of their rates [K/min] as text."""
    return (
        f'{np.min(celsius):.1f} to {np.max(celsius):.1f} degC and '
        f'{np.min(k_min):+.2f} to {np.max(k_min):+.2f} K/min'
    )


def _verdict(judgement: Judgement, claims: bool, calibration: Calibration) -> tuple[Verdict, str]:
    sections, windows, tolerance = judgement.sections, judgement.windows, judgement.tolerance
    full, outside, left_out = sections['all'], sections['outside'], judgement.left_out_rms
    if not full.n:
        judged = _ranges(windows.board, windows.rate * 60.0)
        edges = [(s.temperature_range_c, s.rate_range_k_min) for s in calibration.regime_sets()]
        calibrated = _ranges(*map(np.array, zip(*edges, strict=True)))
        text = f'{_windows(outside.n, windows)}, all at {judged}; calibrated at {calibrated}'
        return Verdict.OUTSIDE, f'{text}; {_numbers(outside)}'
    worst = max([s.rms for s in sections.regimes or [full]] + [judgement.headline_rms])
    ratio = sections.worst_ratio
    # Without a claimed sd `claimed_rms` is NaN, and `is_wide` is false.
    is_wide = full.claimed_rms > (tolerance or min(verdicts.WIDE_PART * full.raw_rms, _WIDE_CLAIM))
    if windows.is_swapped.any():
        kind = Verdict.SWAPPED
    elif full.rms >= full.raw_rms and calibration.needs_temperature:
        kind = Verdict.NO_BETTER
    elif tolerance is not None and worst > tolerance:
        kind = Verdict.RECALIBRATE
    elif tolerance is None and not claims:
        kind = Verdict.NO_CLAIM
    elif tolerance is None and (ratio > verdicts.LARGEST_RATIO or judgement.moved):
        kind = Verdict.RECALIBRATE
    else:
        kind = Verdict.WIDE if is_wide else Verdict.VALID
    parts = [f'{_numbers(full)} over {_windows(full.n, windows)}']
    if np.isfinite(left_out):
        parts = [f'{ug_text(left_out)} RMS of |f| - g on positions left out; in sample {parts[0]}']
    if tolerance is not None:
        where = 'in the worse regime' if len(sections.regimes) > 1 else 'over these windows'
        where = 'on positions left out' if worst == left_out else where
        parts.append(f'{ug_text(worst)} RMS {where}, limit {ug_text(tolerance)}')
    elif claims:
        parts.append(
            f'largest ratio of RMS to claimed RMS {ratio:.2g}, limit {verdicts.LARGEST_RATIO:g}'
        )
    else:
        parts.append(
            'the calibration states no uncertainty: give the largest accepted RMS with --tolerance'
        )
    if kind is Verdict.SWAPPED:
        parts.insert(0, SWAPPED)
    if judgement.moved:
        parts.append('shifted: ' + ', '.join(judgement.moved))
    drift = judgement.expectations['drift']
    if drift.found_rms > _LARGE_DRIFT * drift.expected_rms and drift.found_rms > MICRO_G:
        parts.append(
            f'an axis drifts by {ug_text(drift.found_rms)}, expected '
            f'{ug_text(drift.expected_rms)}: a support that tilts, late or wrong temperatures, or '
            'another environment'
        )
    if outside.n:
        parts.append(
            f'{_windows(outside.n, windows)} outside the calibrated ranges not judged: '
            f'{ug_text(outside.rms)} RMS'
        )
    return kind, '; '.join(parts)


def _numbers(section: Section) -> str:
    text = f'{ug_text(section.rms)} RMS of |f| - g, {ug_text(section.raw_rms)} raw'
    if np.isfinite(section.claimed_rms):
        text += f', {ug_text(section.claimed_rms)} claimed'
    return text


def _windows(n: int, windows: JudgedWindows) -> str:
    return f'{counted(n, "window")} of {windows.window_s:g} s'


def distinct_positions(windows: JudgedWindows) -> int:
    """Count the directions of the force that are more than five degrees apart."""
    means = means_by(windows.position, windows.force)
    return len(distinct_directions(means / np.linalg.norm(means, axis=1, keepdims=True)))


def axis_shifts(
    windows: JudgedWindows, misalignment_sd: tuple[float, ...]
) -> tuple[AxisShift, ...]:
    """Fit shifts of bias, scale, misalignment to ``|f| = g``; none for fewer than 6 positions."""
    if distinct_positions(windows) < POSITIONS_NEEDED:
        return ()
    gravity = windows.gravity
    # Windows with a large claimed sd, such as the first windows of a bag, have a small weight.
    weight = 1.0 / np.maximum(windows.claimed_sd, _SMALLEST_NORM_SD) ** 2
    precision = means_by(windows.position, weight)
    force = (
        means_by(windows.position, windows.force * weight[:, None]) / precision[:, None] / gravity
    )
    residual = windows.residual
    scatter = means_by(windows.position, residual**2) - means_by(windows.position, residual) ** 2
    count = np.unique(windows.position, return_counts=True)[1]
    variance = 1.0 / precision + scatter / np.maximum(count / _CORRELATED_WINDOWS, 1.0)
    sd = np.maximum(np.sqrt(np.maximum(variance, 0.0)) / gravity, _SMALLEST_NORM_SD)
    # Linear equations for the small shifts: |f| = g in each position, and a prior of misalignment.
    sizes = np.linalg.norm(force, axis=1)
    rows = norm_columns(force / sizes[:, None]) / sd[:, None]
    rows = np.vstack(
        (rows, np.eye(9)[6:] / np.maximum(misalignment_sd, _SMALLEST_MISALIGNMENT_SD)[:, None])
    )
    residuals = np.concatenate(((sizes - 1.0) / sd, np.zeros(3)))
    shift = np.linalg.lstsq(rows, residuals, rcond=None)[0]
    # If residuals exceed the claimed errors, increase the sds of the bias and scale shifts.
    n_free, chi_square = len(sd) - 6, float(np.sum((residuals - rows @ shift) ** 2))
    excess = max(1.0, chi_square / n_free) if n_free > 0 else 1.0
    spread = np.sqrt(np.diag(np.linalg.pinv(rows.T @ rows)) * excess)
    bias, scale = (np.stack((shift[k], spread[k]), axis=1) for k in (slice(3), slice(3, 6)))
    return tuple(AxisShift(*row) for row in np.hstack((bias * gravity, scale)).tolist())


def change_texts(shifts: tuple[AxisShift, ...]) -> tuple[str, ...]:
    """Name the significant shifts, as in ``z bias +12 +- 3 ug``."""
    collected = []
    for axis, shift in zip('xyz', shifts, strict=False):
        for name, value, sd, unit in (
            ('bias', shift.bias / MICRO_G, shift.bias_sd / MICRO_G, 'ug'),
            ('scale', 1e6 * shift.scale, 1e6 * shift.scale_sd, 'ppm'),
        ):
            if abs(value) > SIGNIFICANT_SDS * sd:
                # The sd is printed with two digits and without an exponent.
                digits = max(0, 1 - int(np.floor(np.log10(sd)))) if sd > 0.0 else 3
                collected.append(f'{axis} {name} {value:+.{digits}f} +- {sd:.{digits}f} {unit}')
    return tuple(collected)


def rms_by_axis(windows: JudgedWindows) -> Floats:
    """Return the RMS of the force less its mean in the position, per regime and axis, (2, 3)."""
    about = within_positions(windows.force, windows.position)
    return np.array(
        [
            np.sqrt(np.mean(about[rows] ** 2, axis=0)) if rows.any() else np.full(3, np.nan)
            for rows in (~windows.is_dynamic, windows.is_dynamic)
        ]
    )
