# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Few positions: two of them determine the effect of temperature, but not the constants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import thermo_comp as tc
from thermo_comp.typing import Floats

BAGS = Path(__file__).parent.parent / 'bags'
MICRO_G = 9.80665e-6


def minutes(values: Floats) -> Floats:
    """Means of a minute at 2 Hz [ug], without the first minutes, which have no temperature."""
    values = values[~np.isnan(values).any(axis=1)]
    n = len(values) // 120
    return values[: 120 * n].reshape(n, 120, 3).mean(axis=1) / MICRO_G


def left_by(pair: tuple[int, int], **options: str) -> Floats:
    """Fit two positions; return the drift of each axis in a third position at rest [ug]."""
    bags = [BAGS / f'fit/0{number}.mcap' for number in pair]
    calibration = tc.fit(bags, gravity=9.80665, **options)
    held_out = tc.read(BAGS / 'held_out.mcap')
    corrected = calibration.correct(held_out.time_s, held_out.counts, **held_out.temperatures)
    # In a new attitude the constants are uncertain, and the covariance includes that.
    sd = np.sqrt(np.nanmedian(np.einsum('nii->ni', corrected.covariance), axis=0))
    assert (sd > 1000.0 * MICRO_G).any()
    return np.asarray(minutes(corrected.specific_force).std(axis=0))


@pytest.mark.parametrize('pair', [(1, 2), (3, 9)])
def test_two_positions_tell_the_thermal_response(pair: tuple[int, int]) -> None:
    # 9 ug/sqrt(Hz) are 1.2 ug in a minute; 128 minutes determine their sd to 6 %, and a few
    # superfluous columns may add a tenth. Half of all 36 pairs are as good (docs/accuracy.md).
    assert left_by(pair) == pytest.approx([1.2] * 3, rel=0.3)


def test_two_sets_leave_a_lag() -> None:
    assert (left_by((1, 2), model='golovach') > 10.0).all()
