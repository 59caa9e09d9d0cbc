# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns fleets: hundreds of units, each fitted where a worker is free, and what they tell together.

- `fit_fleet` finds the units, does what is missing on Dask, writes table, prior and page.
- The only package that knows `dask`, `distributed` and `fsspec`: the extra ``fleet``.
"""

from .run import FleetResult, fit_fleet
from .table import COLUMNS, Row, read_parquet
from .unit import FleetOptions

__all__ = ['COLUMNS', 'FleetOptions', 'FleetResult', 'Row', 'fit_fleet', 'read_parquet']
