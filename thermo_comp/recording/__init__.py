# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags: reading into columns and writing from columns, streaming, in bounded memory.

No other package of thermo_comp imports `rosbags` or `mcap`.
"""
