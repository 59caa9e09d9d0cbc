# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the fit: bags of a thermal test -> still positions -> regression -> calibration, with proof.

"""

from .fit import FitResult, PositionReport, ResidualRow, fit
from .gravity import normal_gravity, resolve_gravity
from .options import FitOptions
from .sources import ArrayBlock, FitSource, SourceBlock

__all__ = [
    'ArrayBlock',
    'FitOptions',
    'FitResult',
    'FitSource',
    'PositionReport',
    'ResidualRow',
    'SourceBlock',
    'fit',
    'normal_gravity',
    'resolve_gravity',
]
