# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns fleets: fits many units in parallel, by Dask and fsspec (imported only here)."""
