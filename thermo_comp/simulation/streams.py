# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the random numbers: one independent stream per error source and axis, from one seed.

Switching a source on or off, or asking for other block sizes, leaves every other stream as it was.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Error sources; the numbers are part of what a seed means: never changed, nor used again."""

    ACCEL_NOISE = 0
    CONVERTER_PHASE = 1
    BOARD_NOISE = 2
    CASE_NOISE = 3
    UNIT = 8
    POSITIONS = 9
    CYCLOGRAM = 10
    BIAS_WALK = 11
    LOAD = 13
    SIBLING = 14
    GYRO_NOISE = 15
    GYRO_OFFSET = 16


def generator(seed: int, stream: Stream, axis: int = 0) -> np.random.Generator:
    """Return the generator of one source, for an axis or other number, at its stream's start."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(stream), axis)))
