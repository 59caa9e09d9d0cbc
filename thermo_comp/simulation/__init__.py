# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the known truth: a unit in a thermal chamber, simulated from the physics up.

- `Cyclogram` is the chamber's program, `unit_preset` a specimen, `positions` its attitudes.
- `simulate` runs them and returns what a recorder would have stored plus the truth;
  `simulate_blocks` gives the same bits in bounded memory.
- The model: chamber air -> case -> board -> parts through heat capacities and conductances,
  solved exactly; errors arise in the parts (tempcos), between them (gradients) and slowly
  (creep); white noise; a charge-balancing converter that carries its remainder.

Nothing here is built from a compensator's regressors, reads a file or a clock.

"""

from .attitude import Handling, positions
from .converter import Converter
from .cyclogram import (
    CYCLOGRAM_NAMES,
    Cyclogram,
    cyclogram_preset,
    parse_cyclogram,
    ramps_and_soaks,
    random_cyclogram,
)
from .drift import CreepEffect, DifferenceEffect, DriftModel, PartEffect
from .network import AIR, Link, ThermalNetwork, Thermostat
from .presets import UNIT_NAMES, unit_preset
from .response import ThermalResponse
from .run import START_NS, ChamberRipple, simulate, simulate_blocks
from .thermometers import ThermometerModel
from .truth import SimulatedRun, Truth, ideal_regime
from .unit import MICRO_G, STANDARD_GRAVITY, UnitModel

__all__ = [
    'AIR',
    'CYCLOGRAM_NAMES',
    'MICRO_G',
    'STANDARD_GRAVITY',
    'START_NS',
    'UNIT_NAMES',
    'ChamberRipple',
    'Converter',
    'CreepEffect',
    'Cyclogram',
    'DifferenceEffect',
    'DriftModel',
    'Handling',
    'Link',
    'PartEffect',
    'SimulatedRun',
    'ThermalNetwork',
    'ThermalResponse',
    'ThermometerModel',
    'Thermostat',
    'Truth',
    'UnitModel',
    'cyclogram_preset',
    'ideal_regime',
    'parse_cyclogram',
    'positions',
    'ramps_and_soaks',
    'random_cyclogram',
    'simulate',
    'simulate_blocks',
    'unit_preset',
]
