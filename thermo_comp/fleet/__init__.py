# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns fleets: hundreds of units, each fitted where a worker is free, and what they tell together.

- `fit_fleet` finds the units, does what is missing on Dask, writes table and page.
- The only package that knows `dask`, `distributed` and `fsspec`: the extra ``fleet``.
"""

from __future__ import annotations

from .row import COLUMNS, Column, Row, is_fitted
from .run import FleetResult, fit_fleet
from .summary import Summary, summarise
from .table import read_parquet
from .unit import FleetOptions

__all__ = [
    'COLUMNS',
    'Column',
    'FleetOptions',
    'FleetResult',
    'Row',
    'Summary',
    'fit_fleet',
    'is_fitted',
    'read_parquet',
    'summarise',
]
