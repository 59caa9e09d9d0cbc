# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what tests ask of a simulated run beyond its columns."""

from __future__ import annotations

import numpy as np

from thermo_comp.simulation import SimulatedRun
from thermo_comp.typing import Bools


def ideal_regime(run: SimulatedRun, threshold_k_min: float = 0.02) -> Bools:
    """Tell where, on the thermal grid, the board really takes up or gives off heat."""
    truth = run.truth
    rate = np.gradient(truth.temperature(truth.unit.board.node), truth.grid_s)
    return np.asarray(np.abs(rate) * 60.0 > threshold_k_min)
