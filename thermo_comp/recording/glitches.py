# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the detection of glitches: single samples with wrong bits, as after a transfer error."""

from __future__ import annotations

import numpy as np

from ..typing import Bools, Floats

# Smallest distance of a glitch from the mean of its neighbours, in sd of the noise.
_SDS = 25.0
# Smallest distance of a glitch from the mean of its neighbours, divided by the samples' norm: the
# carried remainder of a converter changes single samples by a count, which is no glitch.
_LEAST = 0.02
# Smallest number of samples from which the noise is estimated; with fewer no glitch is searched.
_FEWEST = 30


def is_glitch(samples: Floats, quantum: Floats) -> Bools:
    """
    Return which samples, shape (n, 3), are glitches: a glitch is far from its two neighbours, the
    neighbours agree, and no motion is near. A glitch left in the data would end a rest.
    """
    result = np.zeros(len(samples), dtype=bool)
    if len(samples) < _FEWEST:
        return result
    is_far = np.zeros(samples.shape, dtype=bool)
    is_moving = np.zeros(len(samples), dtype=bool)
    # Noise and norm are estimated from at most 4000 samples, to save time.
    every = slice(None, None, max(len(samples) // 2000, 1))
    least = _LEAST * float(np.median(np.linalg.norm(samples[every], axis=1)))
    for x, step, far in zip(samples.T, quantum.tolist(), is_far.T, strict=True):
        bend = np.abs(x[1:-1] - 0.5 * (x[2:] + x[:-2]))
        noise = max(float(np.median(bend[every])) / 0.6745, step)
        limit = max(_SDS * noise, least)
        is_moving[1:-1] |= bend > limit / 3.0
        far[1:-1] = bend > limit
        if far.any():
            far[1:-1] &= np.abs(x[2:] - x[:-2]) < 0.5 * bend
    # The second to fourth sample on each side of a glitch must show no motion.
    at = np.flatnonzero(is_far.any(axis=1))
    beside = np.array([-4, -3, -2, 2, 3, 4])
    around = np.clip(at[:, np.newaxis] + beside, 0, len(samples) - 1)
    result[at[~is_moving[around].any(axis=1)]] = True
    return result
