# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the thermal history of a bag: the causal thermal state, on a uniform grid.

The thermal tracker that the compensator runs is run here over the bag's readings, so that every
regressor means in the fit what it means online.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..thermal.settings import DetectorSettings, ThermalConfig
from ..thermal.state import BOARD, GRADIENT, RATE, UNKNOWN, VAR_BOARD, WEIGHT
from ..thermal.tracker import ThermalTracker
from ..typing import Bools, Floats, Ints
from .reduction import ReducedBag

# Rates are seen over two minutes; below this the chamber rests [K/s].
_SECTION_HALF_WIDTH_S = 60.0
_SECTION_RATE = 0.05 / 60.0


@dataclass(frozen=True)
class ThermalHistory:
    """
    Thermal state of one bag.

    Parameters
    ----------
    start_s : float
        Time of the first grid point since the bag's first sample [s].
    step_s : float
        Grid step [s].
    board, var_board, rate, gradient, weight : ndarray, shape (n,)
        Board temperature, its variance and rate, ``T_case - T_board``, weight of the dynamic set.
    is_unknown : ndarray of bool, shape (n,)
        Whether the regime was still unknown.

    """

    start_s: float
    step_s: float
    board: Floats
    var_board: Floats
    rate: Floats
    gradient: Floats
    weight: Floats
    is_unknown: Bools

    @property
    def time(self) -> Floats:
        """
        Times of the grid points since the bag's first sample, shape (n,).

        """
        return np.asarray(self.start_s + self.step_s * np.arange(len(self.board)))

    def coarsened(self, factor: int) -> ThermalHistory:
        """
        Keep every so manieth grid point: the state moves little between them.

        """
        kept = {
            name: getattr(self, name)[::factor]
            for name in ('board', 'var_board', 'rate', 'gradient', 'weight', 'is_unknown')
        }
        return replace(self, step_s=self.step_s * factor, **kept)

    def sections(self) -> Ints:
        """
        Give each grid point the number of its stretch of the program: ramp up, soak, ramp down.

        Stretches longer than a sixth of the bag are cut, so that a bag of one long soak still
        has several.

        Returns
        -------
        ndarray of int64, shape (n,)
            Number of the stretch at each grid point, from 0.

        """
        case = self.board + self.gradient
        half = max(1, round(_SECTION_HALF_WIDTH_S / self.step_s))
        if len(case) <= 4 * half:
            return np.zeros(len(case), dtype=np.int64)
        padded = np.pad(case, half, mode='edge')
        rate = (padded[2 * half :] - padded[: -2 * half]) / (2 * half * self.step_s)
        least = max(_SECTION_RATE, 0.2 * float(np.quantile(np.abs(rate), 0.95)))
        direction = np.where(np.abs(rate) < least, 0, np.sign(rate)).astype(np.int64)
        longest = max(len(case) // 6, 2 * half)
        result = np.zeros(len(case), dtype=np.int64)
        number = 0
        begin = 0
        for i in range(1, len(case)):
            # A change that the window itself would blur away is no new stretch.
            lasts = (direction[i : i + 2 * half] == direction[i]).all()
            if (direction[i] != direction[begin] and lasts) or i - begin >= longest:
                number += 1
                begin = i
            result[i] = number
        return result


def thermal_history(
    bag: ReducedBag, detector: DetectorSettings, step_s: float, config: ThermalConfig
) -> ThermalHistory:
    """
    Run the thermal tracker over a bag's readings.

    Parameters
    ----------
    bag : ReducedBag
        The bag, with board readings.
    detector : DetectorSettings
        Settings of thermometers and detector.
    step_s : float
        Grid step [s].
    config : ThermalConfig
        Cross-over and time-outs.

    Returns
    -------
    ThermalHistory
        From the first board reading to the last sample.

    """
    tracker = ThermalTracker(detector, None, config)
    start_s, states = thermal_states(bag, tracker, step_s)
    return ThermalHistory(
        start_s=start_s,
        step_s=step_s,
        board=states[:, BOARD],
        var_board=states[:, VAR_BOARD],
        rate=states[:, RATE],
        gradient=states[:, GRADIENT],
        weight=states[:, WEIGHT],
        is_unknown=states[:, UNKNOWN] > 0.5,
    )


def thermal_states(
    bag: ReducedBag, tracker: ThermalTracker, step_s: float
) -> tuple[float, Floats]:
    """
    Drive a tracker with a bag's readings and sample it on a grid.

    Parameters
    ----------
    bag : ReducedBag
        The bag, with board readings.
    tracker : ThermalTracker
        A fresh one.
    step_s : float
        Grid step [s].

    Returns
    -------
    start_s : float
        Time of the first grid point since the bag's first sample [s].
    states : ndarray, shape (n, width)
        `ThermalTracker.sample` at each grid point.

    """
    stamps = np.concatenate((bag.board.stamp_ns, bag.case.stamp_ns))
    values = np.concatenate((bag.board.value, bag.case.value))
    is_case = np.concatenate(
        (np.zeros(len(bag.board.value), bool), np.ones(len(bag.case.value), bool))
    )
    order = np.argsort(stamps, kind='stable')
    stamps, values, is_case = stamps[order], values[order], is_case[order]
    step_ns = round(step_s * 1e9)
    begin = max(int(bag.board.stamp_ns[0]), bag.start_ns)
    grid = np.arange(begin, max(bag.end_ns, begin) + step_ns, step_ns)
    # Readings up to and including a grid stamp come first, as they do online.
    due = np.searchsorted(stamps, grid, side='right')
    rows = []
    reading = 0
    stamp_list, value_list, case_list = stamps.tolist(), values.tolist(), is_case.tolist()
    for stamp, stop in zip(grid.tolist(), due.tolist(), strict=True):
        while reading < stop:
            name = 'case' if case_list[reading] else 'board'
            tracker.read(name, stamp_list[reading], value_list[reading])
            reading += 1
        rows.append(tracker.sample(stamp))
    return (begin - bag.start_ns) * 1e-9, np.array(rows)
