# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns fleets: many units, each fitted where a worker is free; knows Dask and fsspec alone."""

from .run import FleetResult, fit_fleet
from .table import COLUMNS, Row, read_parquet
from .work import FleetOptions

__all__ = ['COLUMNS', 'FleetOptions', 'FleetResult', 'Row', 'fit_fleet', 'read_parquet']
