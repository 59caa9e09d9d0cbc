# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thermal state of a unit: stamped readings in, temperature, rate and regime out."""
