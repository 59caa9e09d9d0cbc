# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the charge-balancing converter: integer counts per cycle, the remainder carried on.

The charge left over when a cycle ends stays on the integrator and counts in the next cycle, so the
sum of the counts follows the integral of the input to within one count for ever. The carry is
kept in fixed point: a long run loses nothing and blocks of any size give the same counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..typing import Floats, Ints
from .streams import Stream, generator

_FRACTION_BITS = 40
_ONE = 1 << _FRACTION_BITS
_ROWS = 1 << 20  # rows summed at once: 2^20 fractions below 2^40 stay far below 2^63


@dataclass(frozen=True)
class Converter:
    """
    Signed integer converter, `bits` wide in two's complement, of a current into counts per cycle.

    It balances charge, or rounds every cycle by itself, as a sampling converter does.

    Raises ValueError if `bits` is not in 2..31.
    """

    bits: int = 16
    carries_remainder: bool = True

    def __post_init__(self) -> None:
        if not 2 <= self.bits <= 31:
            raise ValueError(f'`bits` must lie in 2..31, got {self.bits}')

    @property
    def low(self) -> int:
        """Most negative output, counts."""
        return -(1 << (self.bits - 1))

    @property
    def high(self) -> int:
        """Most positive output, counts."""
        return (1 << (self.bits - 1)) - 1

    def start(self, seed: int) -> Ints:
        """Return the charge on the integrators at power-on, shape (3,), in 2^-40 count."""
        return np.array(
            [generator(seed, Stream.CONVERTER_PHASE, axis).integers(_ONE) for axis in range(3)],
            dtype=np.int64,
        )

    def convert(self, charge: Floats, remainder: Ints) -> tuple[NDArray[np.int32], Ints]:
        """
        Convert consecutive cycles.

        Charge beyond the output range is lost, as in an integrator at its rail; the fraction of a
        count is carried on even then.

        `charge`: input of each cycle, counts (real-valued), shape (n, 3). `remainder`: charge left
        by the cycle before, as `start` or this method returned it, shape (3,). Returns output of
        each cycle, shape (n, 3). Returns charge left by the last cycle, shape (3,).
        """
        if not self.carries_remainder:
            return self._clip(np.rint(charge)), remainder
        counts = np.empty(charge.shape, dtype=np.int32)
        for first in range(0, len(charge), _ROWS):
            rows = charge[first : first + _ROWS]
            # Eq. (1): whole counts; the fraction is carried on.
            whole = np.floor(rows)
            fraction = np.rint((rows - whole) * _ONE).astype(np.int64)
            total = np.cumsum(fraction, axis=0) + remainder
            carried = total >> _FRACTION_BITS
            carry = np.diff(carried, axis=0, prepend=0)
            counts[first : first + _ROWS] = self._clip(whole + carry)
            remainder = total[-1] - (carried[-1] << _FRACTION_BITS)
        return counts, remainder

    def _clip(self, counts: Floats) -> NDArray[np.int32]:
        return np.clip(counts, self.low, self.high).astype(np.int32)
