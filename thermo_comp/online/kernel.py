# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of samples: corrected by the line of bias, scale and variance of their segment.

The same lines of code take one sample, as floats, and the samples of many segments, as arrays.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, TypeVar

import numpy as np

from ..typing import Floats, Ints, Stamps

#: One sample's, or those of many.
Number = TypeVar('Number', float, Floats)
#: Samples corrected at a time: their columns stay in the cache.
PIECE: Final = 4096


def corrected(
    line: Iterable[Number],
    misalignment: tuple[float, ...],
    dt: Number,
    x: Number,
    y: Number,
    z: Number,
) -> tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]:
    """Give specific force x, y, z and covariance xx, xy, xz, yy, yz, zz, `dt` s into a segment."""
    (bx, bx1, sx, sx1, by, by1, sy, sy1, bz, bz1, sz, sz1,
     ax, lx, qx, ay, ly, qy, az, lz, qz) = line  # fmt: skip
    yx, zx, zy, var_yx, var_zx, var_zy = misalignment
    # Eq. (7), solved for the input of each axis.
    x = (x - (bx + bx1 * dt)) / (sx + sx1 * dt)
    y = (y - (by + by1 * dt)) / (sy + sy1 * dt)
    z = (z - (bz + bz1 * dt)) / (sz + sz1 * dt)
    vx = ax + x * (lx + x * qx)
    vy = ay + y * (ly + y * qy)
    vz = az + z * (lz + z * qz)
    xx = x * x
    cxy = yx * vx
    cxz = zx * vx
    return (
        x,
        yx * x + y,
        zx * x + zy * y + z,
        vx,
        cxy,
        cxz,
        yx * cxy + vy + xx * var_yx,
        yx * cxz + zy * vy,
        zx * cxz + zy * zy * vy + vz + xx * var_zx + y * y * var_zy,
    )


def corrected_rate(
    line: Iterable[Number], dt: Number, x: Number, y: Number, z: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Give the angular rate x, y, z and the variance of each axis, `dt` s into a segment."""
    bx, bx1, _, _, by, by1, _, _, bz, bz1, _, _, xx, _, _, yy, _, _, zz, _, _ = line
    return x - (bx + bx1 * dt), y - (by + by1 * dt), z - (bz + bz1 * dt), xx, yy, zz


#: Values of `corrected` in the order of a block's columns: the covariance as a whole matrix.
_COLUMNS: Final = (0, 1, 2, 3, 4, 5, 4, 6, 7, 5, 7, 8)


class Lines:
    """Segments one after the other: starts, lines as columns, and samples that each has."""

    def __init__(self, start_ns: Ints, table: Floats, counts: Ints) -> None:
        self._start_ns = start_ns
        self._table = table
        self._ends = np.cumsum(counts)

    def correct(
        self, stamps: Stamps, samples: Floats, misalignment: tuple[float, ...] | None
    ) -> Floats:
        """
        Correct the samples (n, 3) of the segments: specific force and row-major covariance, shape
        (12, n); or, as there is no misalignment, angular rates: these and variances, shape (6, n).
        """
        n = len(stamps)
        order = _COLUMNS if misalignment else range(6)
        result = np.empty((len(order), n))
        # What is not finite is corrected like the rest; whoever asked leaves it out.
        with np.errstate(invalid='ignore', over='ignore'):
            for begin in range(0, n, PIECE):
                end = min(begin + PIECE, n)
                low = int(np.searchsorted(self._ends, begin, 'right'))
                high = int(np.searchsorted(self._ends, end, 'left')) + 1
                counts = np.diff(np.minimum(self._ends[low:high], end), prepend=begin)
                dt = (stamps[begin:end] - np.repeat(self._start_ns[low:high], counts)) * 1e-9
                line = np.repeat(self._table[:, low:high], counts, axis=1)
                x, y, z = samples[begin:end].T
                values = (
                    corrected(line, misalignment, dt, x, y, z)
                    if misalignment
                    else corrected_rate(line, dt, x, y, z)
                )
                for column, place in zip(result, order, strict=True):
                    column[begin:end] = values[place]
        return result
