# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the known truth: a unit in a thermal chamber, simulated from the physics up.

- `Cyclogram` is the chamber's program, `unit_preset` a specimen, `positions` its attitudes.
- `arrays` runs a whole test (`plan`) in memory, in seconds.
- `simulate` runs one bag and returns what a recorder would have stored plus the truth;
  `simulate_blocks` gives the same bits in bounded memory.
- The model: chamber air -> case -> board -> parts through heat capacities and conductances,
  solved exactly; errors arise in the parts (tempcos, leakage), between them (gradients, heat
  flows), slowly (creep), by the way that was gone (joints that slip) and by what is switched on;
  white noise, a bias that walks; a charge-balancing converter that carries its remainder.

Nothing here is built from a compensator's regressors, reads a file or a clock.
"""

from ..unit.gravity import MICRO_G, STANDARD_GRAVITY
from .campaign import (
    CYCLOGRAM_NAMES,
    PLAN_NAMES,
    Cyclogram,
    Position,
    parse_cyclogram,
    plan,
    positions,
)
from .presets import TRIAD_NAMES, UNIT_NAMES, unit_preset
from .run import START_NS, SimulatedRun, arrays, simulate, simulate_blocks
from .unit import UnitModel

__all__ = [
    'CYCLOGRAM_NAMES',
    'MICRO_G',
    'PLAN_NAMES',
    'STANDARD_GRAVITY',
    'START_NS',
    'TRIAD_NAMES',
    'UNIT_NAMES',
    'Cyclogram',
    'Position',
    'SimulatedRun',
    'UnitModel',
    'arrays',
    'parse_cyclogram',
    'plan',
    'positions',
    'simulate',
    'simulate_blocks',
    'unit_preset',
]
