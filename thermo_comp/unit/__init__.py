# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns one unit's calibration: the value, its file, and the correction computed from it."""
