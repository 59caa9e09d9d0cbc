# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what is known of one unit: its calibration, the file of it, and the correction it gives."""
