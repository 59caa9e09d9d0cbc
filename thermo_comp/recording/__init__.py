# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags: reads them into columns and writes them from columns, as streams in bounded memory.

No other package of thermo_comp imports `rosbags` or `mcap`.
"""
