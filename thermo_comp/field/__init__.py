# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns a calibration in use: rests of the unit, the update from them, the watch over its claim."""
