# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the way from other people's logs to bags: tables with a column map, PX4, ArduPilot, bags.
"""

from .autopilot import read_dataflash, read_ulog
from .bag import bag_log
from .columns import ColumnMap, guess_columns, load_column_map, spoken_columns, table_log
from .log import ConversionReport, ForeignLog, write_log

__all__ = [
    'ColumnMap',
    'ConversionReport',
    'ForeignLog',
    'bag_log',
    'guess_columns',
    'load_column_map',
    'read_dataflash',
    'read_ulog',
    'spoken_columns',
    'table_log',
    'write_log',
]
