# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns fleets: many units, each fitted where a worker is free; knows Dask and fsspec alone."""
