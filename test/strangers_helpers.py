# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns units and attitudes for the tests of the strangers benchmark."""

import numpy as np
from strangers_units import Unit

ZEROS = np.zeros((1, 3))
LEVEL = np.array([0.0, 0.0, 1.0])
#: Six faces and the twelve edges of a cube.
ATTITUDES = np.array([
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)
    if 0 < abs(x) + abs(y) + abs(z) < 3
])  # fmt: skip
ATTITUDES = ATTITUDES / np.linalg.norm(ATTITUDES, axis=1)[:, None]


def unit(**given):
    """Make a unit without errors, noise and rounding."""
    perfect = {
        'bias': np.zeros(3), 'gain': np.zeros(3), 'skew': np.zeros(3), 'bias_curve': ZEROS,
        'scale_curve': ZEROS, 'counts': 0.0, 'density': 0.0, 'reading_sd': 0.0,
        'reading_step': 1e-9, 'heat_k': 0.0,
    }  # fmt: skip
    return Unit(**{**perfect, **given})
