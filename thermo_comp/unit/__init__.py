# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the calibration of one unit: its values, its file, and the correction computed from it."""
