# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the verdicts of a judgement, its sections and limits, and the judgement of a gyroscope."""

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np

from ..text import counted
from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration, rate_triad
from ..unit.correction import Correction
from ..unit.metrics import means_by, residual_statistics
from ..unit.prediction import SlowUncertainty
from ..unit.rate_bias import MILLIDEGREE
from .windows import JudgedWindows

#: Largest ratio of RMS error to claimed RMS of a valid calibration, if no tolerance is given.
LARGEST_RATIO = 2.0
#: Without a tolerance, a valid calibration is WIDE if claimed RMS / raw RMS exceeds this ratio.
WIDE_PART = 0.5
# Smallest number of windows of a regime that is judged separately.
_FEWEST_WINDOWS = 6
# Windows sorted by known |f| are split where successive |f| differ by more than this ratio.
_LEVEL_RATIO = 1.02

SECTIONS = ('static', 'dynamic', 'all', 'outside')


class Verdict(Enum):
    """The verdicts on a calibration; the value of a member is the wording."""

    VALID = 'valid'
    WIDE = 'valid, but it only claims'
    RECALIBRATE = 'recalibrate'
    NO_BETTER = 'no better than raw'
    OUTSIDE = 'outside the calibrated range: not judged'
    SWAPPED = 'thermometers exchanged or loose: not judged'
    NO_CLAIM = 'no claim'

    @property
    def is_valid(self) -> bool:
        """Whether the verdict is that the calibration is valid."""
        return self in (Verdict.VALID, Verdict.WIDE)


@dataclass(frozen=True)
class Section:
    """
    Residuals of the `n` windows of a section: ``|f| - g`` [m/s^2], or angular rate less its mean
    in the rest [rad/s].

    Fields named `raw` hold residuals with the constants at the reference temperature only, others
    with the whole calibration; `claimed_rms`: RMS of the claimed sd of the windows, or NaN.
    """

    n: int
    raw_rms: float
    raw_peak: float
    rms: float
    mean: float
    peak: float
    claimed_rms: float

    @property
    def ratio(self) -> float:
        """Ratio of RMS error to claimed RMS."""
        return self.rms / self.claimed_rms


class Sections(dict[str, Section]):
    """The sections ``static``, ``dynamic``, ``all`` in the calibrated ranges, and ``outside``."""

    @property
    def regimes(self) -> list[Section]:
        """Sections of the regimes that have at least `_FEWEST_WINDOWS` windows."""
        return [part for part in (self['static'], self['dynamic']) if part.n >= _FEWEST_WINDOWS]

    @property
    def worst_ratio(self) -> float:
        """Largest ratio of RMS error to claimed RMS in static, dynamic or all windows."""
        return max(part.ratio for part in (*self.regimes, self['all']))

    def facts(self) -> dict[str, Any]:
        """Return all sections, as in a command's JSON."""
        return {name: {**asdict(part), 'ratio': part.ratio} for name, part in self.items()}


def sections_of(
    windows: JudgedWindows, raw: Floats, residual: Floats, claimed: Floats
) -> Sections:
    """Summarise the residuals of windows, shape (n,) or (n, axes), by section."""
    inside, dynamic = windows.is_inside, windows.is_dynamic
    rows_of = (inside & ~dynamic, inside & dynamic, inside, ~inside)
    pairs = zip(SECTIONS, rows_of, strict=True)
    return Sections({name: _section(raw, residual, claimed, rows) for name, rows in pairs})


def by_force(windows: JudgedWindows, claimed: Floats) -> dict[float, Section]:
    """Summarise the residuals per known |f| [m/s^2]; empty if |f| is gravity in all windows."""
    if windows.is_usual.all():
        return {}
    order = np.argsort(windows.size, kind='stable')
    steps = np.flatnonzero(windows.size[order][1:] > _LEVEL_RATIO * windows.size[order][:-1]) + 1
    values = windows.raw_residual, windows.residual, claimed
    levels = np.split(order, steps)
    return {float(windows.size[rows].mean()): _section(*values, rows) for rows in levels}


def _section(raw: Floats, residual: Floats, claimed: Floats, rows: Bools | Ints) -> Section:
    before, after, claim = (
        residual_statistics(column[rows].ravel()) for column in (raw, residual, claimed)
    )
    n = after.n // max(1, residual[:1].size)
    return Section(n, before.rms, before.peak, after.rms, after.mean, after.peak, claim.rms)


@dataclass(frozen=True)
class RateJudgement:
    """The judgement of a gyroscope by its rates less their mean in each rest [rad/s]."""

    kind: Verdict
    reason: str
    sections: Sections

    def __str__(self) -> str:
        """Return the verdict with its numbers, as printed by every command."""
        return f'angular rate: {self.kind.value}: {self.reason}'

    def facts(self) -> dict[str, Any]:
        """Return the gyroscope's judgement, as in every command's JSON."""
        return {
            'verdict': self.kind.value,
            'reason': self.reason,
            'is_valid': self.kind.is_valid,
            'sections_rad_s': self.sections.facts(),
        }


def judge_rates(windows: JudgedWindows, calibration: Calibration) -> RateJudgement | None:
    """
    Judge a gyroscope by windows at rest; return None without a gyroscope or angular rates.

    At rest a gyroscope reads the unknown sum of Earth's rate and turn-on bias. The judged error is
    therefore the angular rate less its mean in each rest; the RMS of this error may be at most
    `LARGEST_RATIO` times the RMS of its claimed sd.
    """
    windows = windows.select(np.asarray(np.isfinite(windows.gyro[:, :6]).all(axis=1)))
    if not windows.gyro.size:
        return None
    raw, corrected, variance = (windows.gyro[:, k : k + 3] for k in (0, 3, 6))
    # The rate of a window is compared with the mean rate in the same rest: over the windows inside
    # the calibrated ranges or, if none is inside, over all windows.
    _, place = np.unique(windows.position, return_inverse=True)
    has_inside = np.bincount(place, windows.is_inside) > 0.0
    weight = np.where(has_inside[place], windows.is_inside, 1.0)
    counts = np.bincount(place, weight).astype(np.float64)[place]

    def mean_of(rows: Floats) -> Floats:
        return means_by(place, rows, weight)[place]

    triad = rate_triad(calibration)
    claims, claimed = triad.has_uncertainty, np.full_like(corrected, np.nan)
    if claims:
        # Derive the claimed variance of a rate less its mean in the rest from the claimed variance
        # of one message's rate.
        correction = Correction(triad, Correction(calibration).memory)
        bias, change = SlowUncertainty(triad, correction).of_bias(windows.gyro[:, 9:], mean_of)
        slow = np.square([axis.residual_sd_m_s2 for axis in triad.static.axes()])
        # Errors due to thermometer noise and unknown initial lag states hardly change the mean of
        # a rest, so a rate less this mean has the whole variance of these errors.
        of_thermometers = np.maximum(variance - np.array(correction.noise) - slow - bias, 0.0)
        white = np.square(triad.noise_density_m_s2_sqrt_hz) / windows.window_s
        noise = white * (1.0 - 1.0 / np.maximum(counts, 1.0))[:, None]
        hours = counts[:, None] * windows.window_s / 3600.0
        # The variance of a random walk about its mean is 1/6 of the variance at its end.
        walk = np.square(triad.slow_noise_m_s2_sqrt_h) * hours / 6.0
        claimed = np.sqrt(of_thermometers + change + noise + walk)
    changes = np.stack((raw - mean_of(raw), corrected - mean_of(corrected), claimed))
    is_judged = counts > 1
    sections = sections_of(windows.select(is_judged), *changes[:, is_judged])
    kind, reason = _verdict(sections, windows.window_s, claims)
    return RateJudgement(kind, reason, sections)


def _verdict(sections: Sections, window_s: float, claims: bool) -> tuple[Verdict, str]:
    total, outside = sections['all'], sections['outside']
    if not total.n:
        windows = f'{counted(outside.n, "window")} of {window_s:g} s'
        return Verdict.OUTSIDE, f'{windows}, all outside the calibrated ranges'
    text = f'{_mdeg(total.rms)} RMS about the mean of each rest, {_mdeg(total.raw_rms)} raw'
    over = f'over {counted(total.n, "window")} of {window_s:g} s'
    if not claims:
        kind = Verdict.NO_BETTER if total.rms > total.raw_rms else Verdict.NO_CLAIM
        return kind, f'{text} {over}; the calibration states no uncertainty'
    ratio = sections.worst_ratio
    text = (
        f'{text}, {_mdeg(total.claimed_rms)} claimed {over}; '
        f'largest ratio of RMS to claimed RMS {ratio:.2g}, limit {LARGEST_RATIO:g}'
    )
    # At constant temperature the correction is constant, so a residual as large as the raw
    # residual is not a fault.
    if ratio > LARGEST_RATIO:
        return Verdict.NO_BETTER if total.rms >= total.raw_rms else Verdict.RECALIBRATE, text
    return Verdict.WIDE if total.claimed_rms > WIDE_PART * total.raw_rms else Verdict.VALID, text


def _mdeg(rate: float) -> str:
    return f'{rate / MILLIDEGREE:.3g} mdeg/s'
