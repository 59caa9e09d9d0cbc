# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what a run leaves behind: the recorded columns, and the truth on the grid and at each cycle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..typing import Floats, Ints
from .network import AIR
from .unit import UnitModel


@dataclass(frozen=True, eq=False)
class Truth:
    """
    What really happened, on the thermal grid and at the accelerometer's cycles.

    unit: the unit, with K, M, bias at the reference
    gravity: local gravity, m/s^2
    nodes: parts, the columns of the temperatures
    grid_s, air: instants of the thermal grid from the start of the run, s, and air temperature,
        degC, shape (m,)
    temperatures: of the parts, degC, shape (m, n_parts)
    bias_grid, scale_grid: bias [counts/cycle] and relative scale on the grid, shape (m, 3)
    cycle_s: middles of the accelerometer's cycles from the start of the run, s, shape (n,)
    specific_force: in the orthogonal frame, m/s^2, shape (3,)
    """

    unit: UnitModel
    gravity: float
    nodes: tuple[str, ...]
    grid_s: Floats
    air: Floats
    temperatures: Floats
    bias_grid: Floats
    scale_grid: Floats
    cycle_s: Floats
    specific_force: Floats

    @property
    def bias(self) -> Floats:
        """Bias of each cycle, shape (n, 3), counts/cycle."""
        return on_cycles(self.bias_grid, self.grid_s, self.cycle_s)

    @property
    def scale(self) -> Floats:
        """Scale of each cycle relative to the one at the reference temperature, shape (n, 3)."""
        return on_cycles(self.scale_grid, self.grid_s, self.cycle_s)

    def temperature(self, node: str) -> Floats:
        """
        Return the temperature [degC] of one part, or the air, on the thermal grid, shape (m,).
        """
        return self.air if node == AIR else self.temperatures[:, self.nodes.index(node)]


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """
    What a recorder would have stored, and the truth.

    Ends of the conversion cycles [ns], shape (n,), and their counts, shape (n, 3); instants and
    values [degC] of the thermometers' readings, shape (m,). Of a unit with a gyroscope also the
    mean angular rate of each cycle [rad/s], shape (n, 3).
    """

    accel_stamp_ns: Ints
    counts: NDArray[np.int32]
    board_stamp_ns: Ints
    board: Floats
    case_stamp_ns: Ints
    case: Floats
    truth: Truth
    angular_rate: Floats | None = None


def on_cycles(grid: Floats, grid_s: Floats, cycle_s: Floats) -> Floats:
    """Give what is straight between the points of the grid, at each cycle."""
    # One arithmetic per cycle, whatever the block: not np.interp, which prepares slopes or not.
    place = cycle_s / grid_s[1]
    left = np.minimum(place.astype(np.int64), len(grid_s) - 2)
    share = (place - left)[:, None]
    result: Floats = (1.0 - share) * grid[left] + share * grid[left + 1]
    return result
