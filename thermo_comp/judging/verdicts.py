# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the words of a judgement: the verdicts, the sections, and where the limits lie."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

from ..typing import Floats
from ..unit.metrics import residual_statistics
from .windows import Windows

#: A calibration holds while its error is within this many times what it claims.
LARGEST_RATIO = 2.0
#: A claim promises little if it is not below this part of the raw error.
WIDE_PART = 0.5
# Fewer windows of a regime are judged with the others only.
_FEWEST = 6

SECTIONS = ('static', 'dynamic', 'all', 'outside')


class Verdict(Enum):
    """The verdicts; the value is the verdict's wording."""

    VALID = 'valid'
    WIDE = 'valid, but it only claims'
    RECALIBRATE = 'recalibrate'
    NO_BETTER = 'no better than raw'
    OUTSIDE = 'outside the calibrated range: not judged'
    NO_CLAIM = 'no claim'

    @property
    def is_valid(self) -> bool:
        """Whether the calibration was shown to hold."""
        return self in (Verdict.VALID, Verdict.WIDE)


@dataclass(frozen=True)
class Section:
    """
    What `n` windows of one section leave: ``|f| - g`` [m/s^2], or changes of the rate [rad/s].

    Raw is by the constants at the reference temperature, the others by the calibration;
    `claimed_rms` is the RMS of what is claimed for the same windows, NaN where nothing is.
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
        """RMS over claimed RMS."""
        return self.rms / self.claimed_rms


class Sections(dict[str, Section]):
    """``static``, ``dynamic`` and ``all`` within the calibrated ranges, and ``outside`` them."""

    @property
    def regimes(self) -> list[Section]:
        """The regimes with enough windows to be judged by themselves."""
        return [one for one in (self['static'], self['dynamic']) if one.n >= _FEWEST]

    @property
    def worst_ratio(self) -> float:
        """Largest ratio of a regime, or of all."""
        return max(one.ratio for one in (*self.regimes, self['all']))

    def facts(self) -> dict[str, Any]:
        """Give everything, as JSON holds it."""
        return {name: {**asdict(one), 'ratio': one.ratio} for name, one in self.items()}


def sections_of(windows: Windows, raw: Floats, residual: Floats, claimed: Floats) -> Sections:
    """Summarise values of windows, shape (n,) or (n, axes), by section."""
    inside, dynamic = windows.is_inside, windows.is_dynamic
    found = Sections()
    rows_of = (inside & ~dynamic, inside & dynamic, inside, ~inside)
    for name, rows in zip(SECTIONS, rows_of, strict=True):
        before, after, claim = (
            residual_statistics(one[rows].ravel()) for one in (raw, residual, claimed)
        )
        n = after.n // max(1, residual[:1].size)
        found[name] = Section(
            n, before.rms, before.peak, after.rms, after.mean, after.peak, claim.rms
        )
    return found
