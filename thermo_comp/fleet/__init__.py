# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns fleets: many units, fitted in parallel; the only package that uses Dask and fsspec."""
