# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what the fit reads: blocks of accelerometer samples and temperature readings, by source.

Bags, tables and simulated runs provide the same blocks as to the compensator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..online.blocks import AccelBlock, Readings
from ..typing import Floats, Ints


@dataclass(frozen=True)
class ArrayBlock:
    """
    A block made of arrays at hand: a simulated run, or a whole recording in memory.

    accel_stamp_ns: stamps of the samples, shape (n,)
    accel: counts, or m/s^2, shape (n, 3)
    board_stamp_ns, case_stamp_ns: stamps of the temperature readings, shape (m,)
    board, case: temperatures, shape (m,)
    others: stamps and temperatures of further thermometers
    """

    accel_stamp_ns: Ints
    accel: Floats
    board_stamp_ns: Ints
    board: Floats
    case_stamp_ns: Ints
    case: Floats
    others: Mapping[str, tuple[Ints, Floats]] = field(default_factory=dict)

    @property
    def temperatures(self) -> Mapping[str, Readings]:
        """Stamps, readings and how many samples came before, by the name of the thermometer."""
        own = {
            'board': (self.board_stamp_ns, self.board),
            'case': (self.case_stamp_ns, self.case),
            **self.others,
        }
        return {
            name: (stamp_ns, celsius, np.searchsorted(self.accel_stamp_ns, stamp_ns))
            for name, (stamp_ns, celsius) in own.items()
        }


def angular_velocity(block: object) -> Floats | None:
    """Angular rate of a block that has one: a recording's, when its input is an Imu."""
    imu = getattr(block, 'imu', None)
    if imu is None or (imu.angular_velocity_covariance[:, 0] == -1.0).any():
        return None
    rate: Floats = imu.angular_velocity
    return rate if rate.any() else None


def _nothing() -> str | None:
    return None


def _at_once() -> float:
    return 0.0


@dataclass(frozen=True)
class FitSource:
    """
    One bag (or what stands for one), to be streamed in file order.

    name: what messages and provenance call it
    blocks: gives a fresh iterable of blocks; called once per pass
    sha256: hash of the content, for the provenance
    serial: unit serial found in the source's metadata
    chosen: which of its topics were taken by their type
    missing: tells what of the bag is missing, as far as it has been read; None where nothing is
    since_s: tells, once it is read, where the part that is read begins [s]
    metadata: what the recording says of itself
    """

    name: str
    blocks: Callable[[], Iterable[AccelBlock]]
    sha256: str | None = None
    serial: str | None = None
    chosen: str | None = None
    missing: Callable[[], str | None] = _nothing
    since_s: Callable[[], float] = _at_once
    metadata: Mapping[str, str] = field(default_factory=dict)
