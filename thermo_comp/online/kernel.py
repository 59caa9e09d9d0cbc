# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the arithmetic of many samples: that of `Compensator.process`, in its order, column by column.

What a sample costs here is memory traffic, so the samples go through in pieces whose columns stay
in the cache, and a segment's coefficients are spread over its samples just before they are used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..typing import Floats, Ints, Stamps

#: Samples corrected at a time.
PIECE = 12288


class Lines:
    """The coefficients of a block's segments (`segments.lay_lines`), spread on demand."""

    def __init__(self, start_ns: Ints, columns: list[Floats], counts: Ints) -> None:
        self._start_ns = start_ns
        self.columns = columns
        self._ends = np.cumsum(counts)
        self._begins = self._ends - counts
        self._rows = slice(0, 0)
        self._counts: Ints = counts

    def select(self, begin: int, end: int) -> None:
        """Say of which samples the coefficients are wanted."""
        low = int(np.searchsorted(self._ends, begin, 'right'))
        high = int(np.searchsorted(self._ends, end, 'left')) + 1
        self._rows = slice(low, high)
        ends = np.minimum(self._ends[self._rows], end)
        self._counts = ends - np.maximum(self._begins[self._rows], begin)

    def spread(self, column: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Repeat the value of each selected segment for its samples, in a new array."""
        return np.repeat(column[self._rows], self._counts)

    def age(self, stamps: Stamps) -> Floats:
        """Time since the beginning of each sample's segment [s]."""
        start_ns = self.spread(self._start_ns)
        age: Floats = np.subtract(stamps, start_ns, out=start_ns) * 1e-9
        return age

    def corrected(self, axis: int, raw: Floats, dt: Floats, out: Floats | None = None) -> Floats:
        """Take bias and scale from the samples of one axis."""
        bias, bias_slope, scale, scale_slope = self.columns[4 * axis : 4 * axis + 4]
        value: Floats = self.spread(bias_slope)
        value *= dt
        value += self.spread(bias)
        # Eq. (7), solved for the input.
        np.subtract(raw, value, out=value)
        divisor = self.spread(scale_slope)
        divisor *= dt
        divisor += self.spread(scale)
        result: Floats = np.divide(value, divisor, out=value if out is None else out)
        return result

    def variance(self, axis: int, x: Floats, out: Floats | None = None) -> Floats:
        """Error variance of one axis."""
        a, b, c = self.columns[12 + 3 * axis : 15 + 3 * axis]
        value: Floats = self.spread(c)
        value *= x
        value += self.spread(b)
        value *= x
        result: Floats = np.add(value, self.spread(a), out=value if out is None else out)
        return result


def correct(
    lines: Lines, misalignment: tuple[float, ...], stamps: Stamps, samples: Floats
) -> tuple[Floats, Floats]:
    """
    Correct the samples (n, 3) of segments: force (n, 3) [m/s^2] and covariance (n, 9) [m^2/s^4].
    """
    n = len(stamps)
    raw = np.empty((3, min(n, PIECE)))
    # The columns stand one after the other in memory: each is written in one run.
    force, covariance = np.empty((3, n)), np.empty((9, n))
    # What is not finite is corrected like the rest; whoever asked leaves it out.
    with np.errstate(invalid='ignore', over='ignore'):
        for begin in range(0, n, PIECE):
            piece = slice(begin, min(begin + PIECE, n))
            lines.select(piece.start, piece.stop)
            columns = raw[:, : piece.stop - begin]
            np.copyto(columns, samples[piece].T)
            _correct(
                lines, misalignment, stamps[piece], columns, force[:, piece], covariance[:, piece]
            )
    return force.T, covariance.T


def correct_rates(lines: Lines, stamps: Stamps, rates: Floats) -> tuple[Floats, Floats]:
    """Correct angular rates (n, 3), as `Compensator.correct_rate` does; and variances."""
    lines.select(0, len(stamps))
    dt = lines.age(stamps)
    corrected, variance = np.empty((2, len(stamps), 3))
    for axis in range(3):
        bias = lines.spread(lines.columns[4 * axis + 1]) * dt
        bias += lines.spread(lines.columns[4 * axis])
        with np.errstate(invalid='ignore', over='ignore'):
            np.subtract(rates[:, axis], bias, out=corrected[:, axis])
        variance[:, axis] = lines.spread(lines.columns[12 + 3 * axis])
    return corrected, variance


def _correct(
    lines: Lines,
    misalignment: tuple[float, ...],
    stamps: Stamps,
    raw: Floats,
    force: Floats,
    covariance: Floats,
) -> None:
    yx, zx, zy, var_yx, var_zx, var_zy = misalignment
    dt = lines.age(stamps)
    x = lines.corrected(0, raw[0], dt, out=force[0])
    y, z = (lines.corrected(axis, raw[axis], dt) for axis in (1, 2))
    vx = lines.variance(0, x, out=covariance[0])
    vy, vz = lines.variance(1, y), lines.variance(2, z)
    np.add(np.multiply(x, yx, out=dt), y, out=force[1])
    third = zx * x
    third += np.multiply(y, zy, out=dt)
    np.add(third, z, out=force[2])
    cxy = np.multiply(vx, yx, out=covariance[1])
    cxz = np.multiply(vx, zx, out=covariance[2])
    covariance[3] = cxy
    covariance[6] = cxz
    xx = np.multiply(x, x, out=z)
    value = np.multiply(cxy, yx, out=third)
    value += vy
    np.add(value, np.multiply(xx, var_yx, out=dt), out=covariance[4])
    value = np.multiply(cxz, yx, out=value)
    value += np.multiply(vy, zy, out=dt)
    covariance[5] = value
    covariance[7] = value
    value = np.multiply(cxz, zx, out=value)
    value += np.multiply(vy, zy * zy, out=dt)
    value += vz
    value += np.multiply(xx, var_zx, out=dt)
    yy = np.multiply(y, y, out=y)
    np.add(value, np.multiply(yy, var_zy, out=dt), out=covariance[8])
