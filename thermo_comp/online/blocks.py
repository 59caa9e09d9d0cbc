# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the shape of a batch: columns in file order in, columns of published samples out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from ..typing import Floats, Ints, Stamps

#: Of one thermometer: stamps, readings [degC], and how many of the block's samples came before.
Readings: TypeAlias = tuple[Stamps, Floats, Stamps]


#: A thermometer that stands still is heard again after this, so that nobody takes it for lost.
_REPEAT_NS = 10_000_000_000


def said_anew(stamp_ns: Stamps, celsius: Floats) -> Ints:
    """
    Find which rows of a temperature column are readings: finite, and a change or ten seconds old.

    What is filled up to the rate of other columns would look like a thermometer that stands still.
    """
    kept: list[int] = []
    last_ns, last = 0, math.nan
    for row, (now_ns, value) in enumerate(zip(stamp_ns.tolist(), celsius.tolist(), strict=True)):
        # A stamp before the last one is a restart of the clock, and worth a reading.
        is_new = value != last or now_ns - last_ns >= _REPEAT_NS or now_ns < last_ns
        if is_new and math.isfinite(value):
            kept.append(row)
            last_ns, last = now_ns, value
    return np.array(kept, dtype=np.int64)


class AccelBlock(Protocol):
    """Columns of a run of messages in file order."""

    @property
    def accel_stamp_ns(self) -> Stamps:
        """Stamps of the samples, shape (n,)."""

    @property
    def accel(self) -> Floats:
        """Samples in the calibration's input unit, shape (n, 3)."""

    @property
    def temperatures(self) -> Mapping[str, Readings]:
        """Readings by the name of their thermometer, ``'board'`` and the others."""


@dataclass(frozen=True)
class CompensatedBlock:
    """The published samples of a block."""

    #: Which samples of the block these are, shape (n,).
    index: Ints
    stamp_ns: Stamps
    #: [m/s^2], shape (n, 3).
    specific_force: Floats
    #: Row-major 3x3 [m^2/s^4], shape (n, 9).
    covariance: Floats
    #: [rad/s], and variances [rad^2/s^2], shape (n, 3), where a rate is given and corrected.
    angular_rate: Floats | None = None
    angular_rate_variance: Floats | None = None
