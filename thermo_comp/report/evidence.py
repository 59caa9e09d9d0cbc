# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a report is made of, gathered before anything is drawn: from a fit, from bags, or from a
calibration alone; what is missing is None or empty, and its part of the page is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np

from ..fitting import ResidualRow
from ..fitting.coverage import LeastKnown, least_known
from ..fitting.reduction import Readings
from ..judging import Judgement, Verdict, Windows
from ..judging.history import Epoch
from ..thermal.regime import Regime
from ..typing import Floats
from ..unit.calibration import Calibration, Source
from ..unit.metrics import norm_residual

_T = TypeVar('_T')

#: What is set side by side: the constants at the reference temperature, and the calibration.
RAW = 'raw'
CHOSEN = 'calibration'
#: Beside them, of each position of a fit: the calibration that the other positions alone give.
LEFT_OUT = 'left out'


@dataclass(frozen=True)
class BagFacts:
    """One bag in the certificate's table; `remarks` say what of it was lost or is odd."""

    name: str
    sha256: str  # empty where nobody took it
    start_ns: int
    duration_s: float
    n_samples: int
    rate_hz: float  # NaN when unknown
    board_span: tuple[float, float] | None  # lowest and highest reading [degC]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stretch:
    """A run of one regime and direction (-1 cooling, +1 heating, 0 neither) [s since start]."""

    start: float
    stop: float
    regime: Regime
    direction: int


@dataclass(frozen=True)
class ShownBag:
    """
    The bag that the time figures show, and what the node's own tracker makes of its readings.

    `index` of `Evidence.bags`; `time` since `start_ns`; rates [K/s], and the acceleration of the
    sensor that leads [K/s^2], after a reading each, NaN where not known yet.
    """

    index: int
    start_ns: int
    board: Readings
    case: Readings
    time: Floats
    board_rate: Floats
    case_rate: Floats
    acceleration: Floats
    stretches: tuple[Stretch, ...]

    @property
    def leader(self) -> str:
        """The sensor that leads: the case's, where there is one."""
        return 'case' if len(self.case.value) else 'board'


@dataclass(frozen=True)
class Position:
    """
    One still position.

    `up` is the direction of the specific force in the output frame, `residual_rms` by rung the
    RMS of ``|f| - g`` [m/s^2], `LEFT_OUT` where the fit could do without the position.
    """

    number: int
    bag: int
    duration_s: float
    up: tuple[float, float, float]
    residual_rms: dict[str, float]


@dataclass(frozen=True)
class Evidence:
    """
    All that a report says; what is missing is None or empty.

    `serial` is the unit's, or what is known instead; `unit` that of the raw samples; `windows` are
    at rest, of all bags, and `judgement` what they tell of the calibration; `steps` what each
    step of the model leaves on the windows of the fit; `left_out`, by `Windows.position`, the RMS
    of ``|f| - g`` with what the other positions alone say of the unit [m/s^2]; `findings` what
    speaks against calibration or bags, `checks` what the fit looked at and found good; `history`
    the unit's calibrations by date, where there are several. A fit is shown on its own bags.
    """

    serial: str
    unit: str
    gravity: float | None = None
    calibration: Calibration | None = None
    bags: tuple[BagFacts, ...] = ()
    shown: ShownBag | None = None
    windows: Windows | None = None
    judgement: Judgement | None = None
    steps: tuple[ResidualRow, ...] = ()
    left_out: Mapping[int, float] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    history: tuple[Epoch, ...] = ()
    is_fit: bool = False
    is_simulated: bool = False

    @property
    def sources(self) -> tuple[Source, ...]:
        """The bags that the calibration was fitted on."""
        return () if self.calibration is None else self.calibration.provenance.sources

    @property
    def is_seen(self) -> bool:
        """Whether the calibration was fitted on one of these bags."""
        known = {source.sha256 for source in self.sources if source.sha256}
        return self.is_fit or any(bag.sha256 in known for bag in self.bags)

    @property
    def headline(self) -> str:
        """The verdict with its numbers, or why there is none."""
        if self.judgement is not None:
            return str(self.judgement)
        if self.calibration is not None:
            return 'the calibration as it stands: no recording was judged with it'
        if not self.bags:
            return 'nothing to show yet: no file could be read'
        return 'a thermal record: no calibration was judged'

    @property
    def level(self) -> Literal['good', 'reserved', 'poor', 'open']:
        """How the verdict is to be coloured: valid; with reservations; not; nothing was judged."""
        if self.judgement is None or self.judgement.kind in (Verdict.OUTSIDE, Verdict.NO_CLAIM):
            return 'open'
        if not self.judgement.is_valid:
            return 'poor'
        is_good = self.judgement.kind is Verdict.VALID and not self.findings
        return 'good' if is_good else 'reserved'

    @property
    def forces(self) -> dict[str, Floats]:
        """Specific force over the windows by what corrected it; empty where nothing gave one."""
        windows = self.windows
        if windows is None or not len(windows):
            return {}
        if self.calibration is not None:
            return {RAW: windows.raw, CHOSEN: windows.force}
        return {RAW: windows.force} if self.unit == 'm/s^2' else {}

    @cached_property
    def residuals(self) -> dict[str, Floats]:
        """``|f| - g`` of each of `forces` [m/s^2]; empty without gravity."""
        if self.gravity is None:
            return {}
        return {name: norm_residual(force, self.gravity) for name, force in self.forces.items()}

    @cached_property
    def least_known(self) -> LeastKnown | None:
        """The attitude of which the calibration knows least; None where it claims nothing."""
        if self.calibration is None:
            return None
        return least_known(self.calibration, np.array([one.up for one in self.positions]))

    @cached_property
    def positions(self) -> tuple[Position, ...]:
        """The still positions, with the attitude that the judged rung sees."""
        windows = self.windows
        if windows is None or not self.forces:
            return ()
        force = next(reversed(self.forces.values()))
        found = []
        for number, p in enumerate(np.unique(windows.position), 1):
            rows = windows.position == p
            mean = force[rows].mean(axis=0)
            x, y, z = (mean / np.linalg.norm(mean)).tolist()
            rms = {
                name: float(np.sqrt(np.mean(residual[rows] ** 2)))
                for name, residual in self.residuals.items()
            }
            if np.isfinite(self.left_out.get(int(p), np.nan)):
                rms[LEFT_OUT] = self.left_out[int(p)]
            found.append(
                Position(
                    number=number,
                    bag=int(windows.bag[rows][0]),
                    duration_s=windows.window_s * int(rows.sum()),
                    up=(x, y, z),
                    residual_rms=rms,
                )
            )
        return tuple(found)

    def axis_residuals(self) -> dict[str, Floats]:
        """
        Give the residual of each axis over the windows, by rung, shape (n, 3) [m/s^2].

        The mean direction that the judged rung sees in a position stands for its attitude.
        """
        windows = self.windows
        if windows is None or self.gravity is None or not self.positions:
            return {}
        ups = np.array([position.up for position in self.positions]) * self.gravity
        _, place = np.unique(windows.position, return_inverse=True)
        true = ups[place]
        return {name: force - true for name, force in self.forces.items()}


def given(value: _T | None) -> _T:
    """Return what a figure draws, which is drawn only where it is there."""
    if value is None:
        raise ValueError('`evidence` lacks what is to be drawn')
    return value
