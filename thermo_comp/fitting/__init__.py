# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the fit of a calibration to the positions at rest in the bags of a thermal test."""

from .evidence import ResidualRow
from .fit import FitResult, fit, fit_bags, reduce_bag
from .options import FitOptions, normal_gravity
from .reduction import ReducedBag
from .sources import FitSource

__all__ = [
    'FitOptions',
    'FitResult',
    'FitSource',
    'ReducedBag',
    'ResidualRow',
    'fit',
    'fit_bags',
    'normal_gravity',
    'reduce_bag',
]
