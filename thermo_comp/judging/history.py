# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the history of a unit: what has drifted between its calibrations, with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..typing import Floats
from ..unit.calibration import AXES, Calibration, Source
from ..unit.gravity import MICRO_G
from ..unit.prediction import in_a_soak

# A change must be this sure to be called one.
_SURE_SDS = 3.0


@dataclass(frozen=True)
class Epoch:
    """
    One calibration of a history, in a soak at the reference temperature of the first.

    Bias [ug], scale [ppm of the first one], shapes (3,); an sd that nobody claims is NaN.
    """

    created: str
    bias: Floats
    bias_sd: Floats
    scale: Floats
    scale_sd: Floats


@dataclass(frozen=True)
class Drift:
    """What one constant changed by between two calibrations; sure beyond three sd."""

    earlier: str
    later: str
    constant: str
    unit: str
    change: float
    sd: float

    @property
    def is_sure(self) -> bool:
        """Whether it is more than what both calibrations leave open."""
        return abs(self.change) > _SURE_SDS * self.sd


def history_of(calibrations: Sequence[Calibration]) -> tuple[Epoch, ...]:
    """
    Put calibrations of the first one's unit in the order of their dates.

    Of those that were fitted on the same bags the first counts: two models are no history.
    """
    known: set[tuple[Source, ...]] = set()
    ordered: list[Calibration] = []
    for one in calibrations:
        sources = one.provenance.sources
        if one.unit.serial == calibrations[0].unit.serial and not (sources and sources in known):
            ordered.append(one)
        known.add(sources)
    ordered.sort(key=lambda one: one.provenance.created)
    found: list[Epoch] = []
    first = np.ones(3)
    for number, one in enumerate(ordered):
        bias, bias_sd, scale, scale_sd = in_a_soak(one, ordered[0].reference_temperature_c)
        first = first if number else scale
        claim = 1.0 if one.has_uncertainty else np.nan
        found.append(
            Epoch(
                created=one.provenance.created or f'no. {number + 1}',
                bias=bias / MICRO_G,
                bias_sd=claim * bias_sd / MICRO_G,
                scale=1e6 * (scale / first - 1.0),
                scale_sd=claim * 1e6 * scale_sd,
            )
        )
    return tuple(found)


def drifts_of(history: Sequence[Epoch]) -> list[Drift]:
    """List what changed from each calibration to the next, as if both knew nothing in common."""
    return [
        Drift(
            earlier=before.created,
            later=after.created,
            constant=f'{name} {axis}',
            unit=unit,
            change=float(getattr(after, name)[i] - getattr(before, name)[i]),
            sd=float(np.hypot(getattr(before, f'{name}_sd')[i], getattr(after, f'{name}_sd')[i])),
        )
        for before, after in pairwise(history)
        for name, unit in (('bias', 'ug'), ('scale', 'ppm'))
        for i, axis in enumerate(AXES)
    ]
