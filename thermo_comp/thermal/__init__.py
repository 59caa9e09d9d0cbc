# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the thermal state of a unit: temperature, rate and regime, from stamped readings."""
