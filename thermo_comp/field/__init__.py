# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the use of a calibration in the field: rests, update from rests, drift watch."""
