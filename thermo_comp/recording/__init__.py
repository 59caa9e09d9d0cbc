# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags: reading into columns and writing from columns, streaming, in bounded memory.

The only package that imports `rosbags` and `mcap`.
"""
