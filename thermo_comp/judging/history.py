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
    One calibration of a history, in a soak at the reference temperature of the first: bias of x y
    z [ug], scale [ppm of the first one], shape (6,); an sd that nobody claims is NaN.
    """

    created: str
    value: Floats
    sd: Floats


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
    Put calibrations of the first one's unit in the order of their dates; of those that were fitted
    on the same bags the first counts: two models are no history.
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
        value = np.concatenate((bias / MICRO_G, 1e6 * (scale / first - 1.0)))
        sd = np.concatenate((bias_sd / MICRO_G, 1e6 * scale_sd))
        created = one.provenance.created or f'no. {number + 1}'
        found.append(Epoch(created, value, sd if one.has_uncertainty else np.full(6, np.nan)))
    return tuple(found)


def drifts_of(history: Sequence[Epoch]) -> list[Drift]:
    """List what changed from each calibration to the next, as if both knew nothing in common."""
    return [
        Drift(
            earlier=before.created,
            later=after.created,
            constant=f'{"scale" if k // 3 else "bias"} {AXES[k % 3]}',
            unit='ppm' if k // 3 else 'ug',
            change=float(after.value[k] - before.value[k]),
            sd=float(np.hypot(before.sd[k], after.sd[k])),
        )
        for before, after in pairwise(history)
        for k in range(6)
    ]
