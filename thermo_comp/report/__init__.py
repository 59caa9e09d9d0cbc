# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the report: a unit's certificate and its figures; uses matplotlib and Jinja2."""
