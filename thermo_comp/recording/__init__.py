# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns bags: recordings to columns and columns to recordings, streaming, in bounded memory.

The only package that knows `rosbags` and `mcap`.
"""
