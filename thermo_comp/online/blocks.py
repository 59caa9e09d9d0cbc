# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the shape of a batch: columns in file order in, columns of published samples out.

"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ..typing import Floats, Ints, Stamps


class AccelBlock(Protocol):
    """
    Columns of a run of messages in file order.

    `board_after[k]` and `case_after[k]` say how many of the block's samples come before reading k.

    """

    @property
    def accel_stamp_ns(self) -> Stamps:
        """
        Stamps of the samples, shape (n,).

        """

    @property
    def accel(self) -> Floats:
        """
        Samples in the calibration's input unit, shape (n, 3).

        """

    @property
    def board_stamp_ns(self) -> Stamps:
        """
        Stamps of the board readings, shape (m,).

        """

    @property
    def board(self) -> Floats:
        """
        Board readings [degC], shape (m,).

        """

    @property
    def board_after(self) -> Stamps:
        """
        Samples before each board reading, shape (m,).

        """

    @property
    def case_stamp_ns(self) -> Stamps:
        """
        Stamps of the case readings, shape (k,).

        """

    @property
    def case(self) -> Floats:
        """
        Case readings [degC], shape (k,).

        """

    @property
    def case_after(self) -> Stamps:
        """
        Samples before each case reading, shape (k,).

        """


@dataclass(frozen=True)
class CompensatedBlock:
    """
    The published samples of a block.

    """

    #: Which samples of the block these are, shape (n,).
    index: Ints
    stamp_ns: Stamps
    #: [m/s^2], shape (n, 3).
    specific_force: Floats
    #: Row-major 3x3 [m^2/s^4], shape (n, 9).
    covariance: Floats
