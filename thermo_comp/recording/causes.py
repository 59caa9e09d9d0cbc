# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the messages for recordings that are not of an accelerometer at rest."""

import numpy as np

from ..unit.gravity import STANDARD_GRAVITY
from .blocks import Block, unstamped
from .stillness import Cells

# Largest share of samples of exactly 0 that is taken for glitches, and share of messages marked as
# without acceleration above which the whole recording counts as without acceleration.
_GLITCH_SHARE, _FAULT_SHARE = 0.01, 0.5
# Ratio of |a| at rest to gravity: range for samples with gravity, and upper limit for samples
# from which gravity is subtracted.
_WITH_GRAVITY, _WITHOUT_GRAVITY = (0.8, 1.25), 0.3


class CauseCounter:
    """Counts samples that a working accelerometer at rest does not send, block by block."""

    def __init__(self) -> None:
        self._n = self._n_zero = self._n_absent = 0
        self._is_imu = False
        self._stamps_ns: set[int] = set()

    def add(self, block: Block) -> None:
        """Count zero samples, messages marked as without acceleration, and stamps of a block."""
        self._n += len(block.accel_stamp_ns)
        self._n_zero += int(np.count_nonzero(~block.accel.any(axis=1)))
        if block.imu is not None:
            self._is_imu = True
            is_absent = block.imu.linear_acceleration_covariance[:, 0] == -1.0
            self._n_absent += int(np.count_nonzero(is_absent))
        if len(self._stamps_ns) < 2:  # two different stamps show that the clock runs
            self._stamps_ns |= set(np.unique(block.accel_stamp_ns)[:2].tolist())

    def cause(self, cells: Cells, still_sd: float) -> str:
        """Describe why the samples cannot be those of an accelerometer at rest; '' if they can."""
        if self._n_absent > _FAULT_SHARE * self._n:
            return (
                'the messages are marked as without acceleration '
                '(linear_acceleration_covariance[0] = -1): use another topic of the driver'
            )
        if self._n > 1 and len(self._stamps_ns) == 1:
            return unstamped(next(iter(self._stamps_ns)))
        if self._n_zero == self._n and self._n:
            return 'all samples are exactly zero: the sensor does not answer'
        if self._n_zero > _GLITCH_SHARE * self._n:
            return (
                f'{100.0 * self._n_zero / self._n:.0f} % of the samples are exactly zero, between '
                'other samples: the topic has two sources, or messages without an acceleration'
            )
        return self._unit_of(cells, still_sd) if self._is_imu else ''

    def _unit_of(self, cells: Cells, still_sd: float) -> str:
        """Name the fault if |a| at rest is near 1 (g), 1000 (mg) or 0 (no gravity); '' if not."""
        scatter = cells.variance.max(axis=1, initial=0.0)
        quiet = (cells.count > 1) & (scatter <= np.quantile(scatter, 0.5) if len(scatter) else 0)
        if not quiet.any():
            return ''
        norm = float(np.median(np.linalg.norm(cells.mean[quiet], axis=1)))
        sd = float(np.sqrt(np.median(scatter[quiet])))
        for unit, one_g in (('g', 1.0), ('mg', 1000.0)):
            if _WITH_GRAVITY[0] < norm / one_g < _WITH_GRAVITY[1] and sd < still_sd * one_g:
                return (
                    f'samples at rest have the norm {norm:.4g}, not {STANDARD_GRAVITY:.2f} m/s^2: '
                    f'the samples are in {unit}, convert them to m/s^2 with thermo_comp convert'
                )
        if norm < _WITHOUT_GRAVITY * STANDARD_GRAVITY and sd < still_sd * STANDARD_GRAVITY:
            return (
                f'samples at rest have the norm {norm:.2g} m/s^2: gravity is subtracted (linear '
                'or free acceleration), but the fit needs gravity: use another topic of the driver'
            )
        return ''
