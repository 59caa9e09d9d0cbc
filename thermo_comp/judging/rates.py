# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the judgement of a gyroscope: the angular rate at rest, raw and corrected, against its claim.

A gyroscope at rest reads the Earth's rate and what its turn-on has left, and nobody knows them: so
what is judged are the changes within each rest, from the mean of that rest. The claim is for the
very same changes: what is uncertain of the bias there, less what it has in common with the mean.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.correction import Correction
from ..unit.gyroscope import MILLIDEGREE
from ..unit.metrics import residual_statistics
from ..unit.rate_triad import rate_triad
from ..unit.uncertainty import SlowUncertainty
from .verdicts import FEWEST, LARGEST_RATIO, SECTIONS, WIDE_PART, Section, Verdict
from .windows import Windows


@dataclass(frozen=True)
class RateJudgement:
    """
    What recordings tell of a gyroscope: sections as of `Judgement`, of all axes, in rad/s.

    `level_rms` is the RMS over rests and axes of their corrected means, which hold the Earth's
    rate (4.2e-5 on an axis) and the turn-on, `raw_level_rms` that of the raw ones: they decide
    nothing.
    """

    kind: Verdict
    reason: str
    sections: dict[str, Section]
    raw_level_rms: float
    level_rms: float

    @property
    def is_wrong(self) -> bool:
        """Whether the gyroscope was shown not to hold."""
        return self.kind in (Verdict.RECALIBRATE, Verdict.NO_BETTER)

    def __str__(self) -> str:
        """Give the verdict with its numbers, as every command prints it."""
        return f'angular rate: {self.kind.value}: {self.reason}'

    def facts(self) -> dict[str, Any]:
        """Give everything, as every command's JSON holds it."""
        return {
            'verdict': self.kind.value,
            'reason': self.reason,
            'is_valid': self.kind.is_valid,
            'sections_rad_s': {
                name: {**asdict(one), 'ratio': one.ratio} for name, one in self.sections.items()
            },
            'raw_level_rms_rad_s': self.raw_level_rms,
            'level_rms_rad_s': self.level_rms,
        }


def judge_rates(windows: Windows, calibration: Calibration) -> RateJudgement | None:
    """Judge a gyroscope by the windows of bags; None without one, or without its rate."""
    windows = windows.select(np.asarray(np.isfinite(windows.gyro[:, :6]).all(axis=1)))
    if not windows.gyro.size:
        return None
    raw, corrected, variance = (windows.gyro[:, k : k + 3] for k in (0, 3, 6))
    # What lies outside the ranges is held against the rest's mean inside them.
    reference = _Means(windows.position, windows.is_inside)
    counts = reference.counts
    is_judged = counts > 1
    claims = rate_triad(calibration).has_uncertainty
    claimed = np.full_like(corrected, np.nan)
    if claims:
        claimed = np.sqrt(_variance(windows, calibration, variance, reference))
    inside, dynamic = windows.is_inside & is_judged, windows.is_dynamic
    rows_of = (inside & ~dynamic, inside & dynamic, inside, ~windows.is_inside & is_judged)
    changes = raw - reference.of(raw), corrected - reference.of(corrected)
    sections = {
        name: _section(*(change[rows].ravel() for change in (*changes, claimed)))
        for name, rows in zip(SECTIONS, rows_of, strict=True)
    }
    kind, reason = _verdict(sections, windows.window_s, claims)
    _, first = np.unique(windows.position, return_index=True)
    levels = [reference.of(rate)[first] for rate in (raw, corrected)]
    raw_level, level = (float(np.sqrt(np.mean(one**2))) for one in levels)
    return RateJudgement(kind, reason, sections, raw_level, level)


class _Means:
    """Means over the rests: of their windows inside the ranges, where there are any."""

    def __init__(self, position: Ints, is_inside: Bools) -> None:
        _, self._where = np.unique(position, return_inverse=True)
        n = int(self._where.max()) + 1
        has_inside = np.bincount(self._where, is_inside, n) > 0.0
        self._weight = np.where(has_inside[self._where], is_inside, 1.0)
        self._counts = np.bincount(self._where, self._weight, n)
        #: Windows that went into the mean of each window's rest.
        self.counts = self._counts[self._where]

    def of(self, rows: Floats) -> Floats:
        """Give each window the mean of its rest."""
        total = np.zeros((len(self._counts), rows.shape[1]))
        np.add.at(total, self._where, rows * self._weight[:, None])
        return np.asarray((total / self._counts[:, None])[self._where])


def _variance(
    windows: Windows, calibration: Calibration, variance: Floats, reference: _Means
) -> Floats:
    """Say what is claimed for the changes, from what is for the rate of one message."""
    triad = rate_triad(calibration)
    correction = Correction(triad, Correction(calibration).memory)
    whole, away = SlowUncertainty(triad, correction).of_bias(windows.gyro[:, 9:], reference.of)
    slow = np.square([axis.residual_sd_m_s2 for axis in triad.static.axes()])
    # Of the thermometers' noise, and of lags that started unseen, a rest's mean has little.
    rest = np.maximum(variance - np.array(correction.noise) - slow - whole, 0.0)
    white = np.square(triad.noise_density_m_s2_sqrt_hz) / windows.window_s
    noise = white * (1.0 - 1.0 / np.maximum(reference.counts, 1.0))[:, None]
    hours = reference.counts[:, None] * windows.window_s / 3600.0
    # A walk strays from its mean over a time by a sixth of what it gains in that time.
    walk = np.square(triad.slow_noise_m_s2_sqrt_h) * hours / 6.0
    return np.asarray(rest + away + noise + walk)


def _section(raw: Floats, corrected: Floats, claimed: Floats) -> Section:
    before, after = residual_statistics(raw), residual_statistics(corrected)
    rms = residual_statistics(claimed).rms
    return Section(after.n // 3, before.rms, before.peak, after.rms, after.mean, after.peak, rms)


def _verdict(sections: dict[str, Section], window_s: float, claims: bool) -> tuple[Verdict, str]:
    one, outside = sections['all'], sections['outside']
    if not one.n:
        return Verdict.OUTSIDE, f'{outside.n} windows of {window_s:g} s lie there'
    judged = [s for s in (sections['static'], sections['dynamic']) if s.n >= FEWEST]
    ratio = max(s.ratio for s in (*judged, one))
    said = f'{_mdeg(one.rms)} RMS of its changes at rest, {_mdeg(one.raw_rms)} raw'
    over = f'over {one.n} windows of {window_s:g} s'
    if not claims:
        kind = Verdict.NO_BETTER if one.rms > one.raw_rms else Verdict.NO_CLAIM
        return kind, f'{said} {over}; the calibration says nothing of its uncertainty'
    said = (
        f'{said}, {_mdeg(one.claimed_rms)} claimed {over}; '
        f'largest ratio of a regime {ratio:.2g}, limit {LARGEST_RATIO:g}'
    )
    # Where no temperature changes, nothing is corrected: that is no fault.
    if ratio > LARGEST_RATIO:
        return Verdict.NO_BETTER if one.rms >= one.raw_rms else Verdict.RECALIBRATE, said
    return Verdict.WIDE if one.claimed_rms > WIDE_PART * one.raw_rms else Verdict.VALID, said


def _mdeg(rate: float) -> str:
    return f'{rate / MILLIDEGREE:.3g} mdeg/s'
