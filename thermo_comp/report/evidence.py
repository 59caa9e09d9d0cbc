# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a report is made of: facts, series and statistics, gathered before anything is drawn.

Figures and page read one value, `Evidence`, whether it came from a fit, from bags with or without
a calibration, or from a calibration alone; what is missing is None or empty, and its part of the
page is left out.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..fitting.reduction import Readings
from ..simulation import Cyclogram
from ..typing import Bools, Floats, Ints
from ..unit.calibration import Calibration
from ..unit.metrics import ResidualStatistics, norm_residual, statistics_by_regime
from .trace import ThermalTrace

#: Names of the ladder's rungs, as figures and tables call them.
RAW = 'raw'
ONE_SET = 'one set'
TWO_REGIMES = 'two regimes'
CHOSEN = 'calibration'
STATIC_ALONE = 'static set alone'

SECTIONS = ('static', 'dynamic', 'all')


@dataclass(frozen=True)
class BagFacts:
    """
    One bag in the certificate's table.

    Parameters
    ----------
    name, sha256 : str
        Name and hash; an unknown hash is empty.
    start_ns : int
        Stamp of the first sample.
    duration_s : float
        Length [s].
    n_samples : int
        Samples read.
    rate_hz : float
        Samples per second; NaN when unknown.
    board_span : (float, float) or None
        Lowest and highest board reading [degC].
    remarks : tuple of str
        What a reader should know: cut off, saturated, moved.

    """

    name: str
    sha256: str
    start_ns: int
    duration_s: float
    n_samples: int
    rate_hz: float
    board_span: tuple[float, float] | None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class ShownBag:
    """
    The bag that the time figures show.

    Parameters
    ----------
    index : int
        Its place in `Evidence.bags`.
    start_ns : int
        Stamp that times count from.
    board, case : Readings
        Its readings.
    trace : ThermalTrace
        Derivatives and regime.
    cyclogram : Cyclogram or None
        The chamber's program, when somebody knows it; its start is the bag's.

    """

    index: int
    start_ns: int
    board: Readings
    case: Readings
    trace: ThermalTrace
    cyclogram: Cyclogram | None


@dataclass(frozen=True)
class Windows:
    """
    Means over some ten seconds at rest, of all bags, sorted by position.

    Parameters
    ----------
    bag, position : ndarray of int64, shape (n,)
        Which bag, which still position.
    time : ndarray, shape (n,)
        Time since the bag's start [s].
    mean : ndarray, shape (n, 3)
        Raw samples.
    board : ndarray, shape (n,)
        Board temperature [degC].
    is_dynamic : ndarray of bool, shape (n,)
        Whether the dynamic set prevails.
    forces : dict of {str: ndarray, shape (n, 3)}
        Specific force that each rung of the ladder makes of it; the last is the one judged.

    """

    bag: Ints
    position: Ints
    time: Floats
    mean: Floats
    board: Floats
    is_dynamic: Bools
    forces: dict[str, Floats]

    def __len__(self) -> int:
        """
        Count the windows.

        """
        return len(self.time)

    @property
    def judged(self) -> str | None:
        """
        Name of the best rung, None when there is no specific force at all.

        """
        return next(reversed(self.forces), None)

    def breaks(self, rows: Bools | slice = slice(None)) -> Ints:
        """
        Rows, of those selected, at which another position begins.

        """
        return np.flatnonzero(np.diff(self.position[rows])) + 1


@dataclass(frozen=True)
class Position:
    """
    One still position.

    Parameters
    ----------
    number : int
        Counted from 1.
    bag : int
        Its bag.
    duration_s : float
        How long it rested.
    up : tuple of float
        Direction of the specific force in the output frame.
    residual_rms : dict of {str: float}
        Per rung, RMS of ``|f| - g`` [m/s^2].

    """

    number: int
    bag: int
    duration_s: float
    up: tuple[float, float, float]
    residual_rms: dict[str, float]


@dataclass(frozen=True)
class CandidateRow:
    """
    One candidate model of the fit.

    Parameters
    ----------
    name : str
        The model.
    n_parameters : int
        Its size.
    fitted_rms, held_out_rms : float
        RMS per axis on its own windows and on held-out sections [m/s^2].
    is_chosen : bool
        Whether it was taken.

    """

    name: str
    n_parameters: int
    fitted_rms: float
    held_out_rms: float
    is_chosen: bool


@dataclass(frozen=True)
class Evidence:
    """
    All that a report says.

    Parameters
    ----------
    serial : str
        Unit serial, or what is known instead.
    unit : {'counts', 'm/s^2'}
        Unit of the raw samples.
    gravity : float or None
        Local gravity.
    calibration : Calibration or None
        What is certified.
    bags : tuple of BagFacts
        The bags.
    shown : ShownBag or None
        The bag of the time figures.
    windows : Windows or None
        At rest, of all bags.
    candidates : tuple of CandidateRow
        What the fit chose from.
    findings : tuple of str
        What the fit itself warns of.
    checks : tuple of str
        What the fit looked at and found good.
    is_fit : bool
        Whether the calibration was fitted on these very bags.

    """

    serial: str
    unit: str
    gravity: float | None = None
    calibration: Calibration | None = None
    bags: tuple[BagFacts, ...] = ()
    shown: ShownBag | None = None
    windows: Windows | None = None
    candidates: tuple[CandidateRow, ...] = ()
    findings: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    is_fit: bool = False

    @cached_property
    def residuals(self) -> dict[str, Floats]:
        """
        ``|f| - g`` of each rung over the windows [m/s^2]; empty without gravity.

        """
        if self.windows is None or self.gravity is None:
            return {}
        return {
            name: norm_residual(force, self.gravity) for name, force in self.windows.forces.items()
        }

    @cached_property
    def statistics(self) -> dict[str, dict[str, ResidualStatistics]]:
        """
        Statistics of `residuals` by rung and section.

        """
        if self.windows is None:
            return {}
        return {
            name: statistics_by_regime(residual, self.windows.is_dynamic)
            for name, residual in self.residuals.items()
        }

    @cached_property
    def positions(self) -> tuple[Position, ...]:
        """
        The still positions, with the attitude that the judged rung sees.

        """
        windows = self.windows
        if windows is None or windows.judged is None:
            return ()
        force = windows.forces[windows.judged]
        found = []
        for number, p in enumerate(np.unique(windows.position), 1):
            rows = windows.position == p
            mean = force[rows].mean(axis=0)
            x, y, z = (mean / np.linalg.norm(mean)).tolist()
            time = windows.time[rows]
            step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
            found.append(
                Position(
                    number=number,
                    bag=int(windows.bag[rows][0]),
                    duration_s=float(time[-1] - time[0]) + step,
                    up=(x, y, z),
                    residual_rms={
                        name: float(np.sqrt(np.mean(residual[rows] ** 2)))
                        for name, residual in self.residuals.items()
                    },
                )
            )
        return tuple(found)

    def axis_residuals(self) -> dict[str, Floats]:
        """
        Residual of each axis over the windows, per rung [m/s^2].

        The attitude of a position is not known, so the mean direction that the judged rung sees
        there stands for it, with the length of gravity.

        Returns
        -------
        dict of {str: ndarray, shape (n, 3)}
            Empty without gravity.

        """
        windows = self.windows
        if windows is None or self.gravity is None or not self.positions:
            return {}
        ups = np.array([position.up for position in self.positions]) * self.gravity
        _, place = np.unique(windows.position, return_inverse=True)
        true = ups[place]
        return {name: force - true for name, force in windows.forces.items()}
