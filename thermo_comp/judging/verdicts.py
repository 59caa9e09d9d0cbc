# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the words of a judgement: the verdicts, the sections, and where the limits lie."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

#: A calibration holds while its error is within this many times what it claims.
LARGEST_RATIO = 2.0
#: A claim promises little if it is not below this part of the raw error.
WIDE_PART = 0.5
#: Fewer windows of a regime are judged with the others only.
FEWEST = 6

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
    ``|f| - g`` of the `n` windows of one section [m/s^2].

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
