# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns standard gravity, which defines the unit g and with it the micro-g.

"""

from __future__ import annotations

#: [m/s^2], exact by definition: 3rd General Conference on Weights and Measures, 1901.
STANDARD_GRAVITY = 9.80665
#: One micro-g, a unit of accelerometer errors [m/s^2].
MICRO_G = 1e-6 * STANDARD_GRAVITY
