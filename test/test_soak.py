# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A short soak test: at 2 kHz, with reloads and an onset, every sample is published."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')

import soak


def test_slope_and_its_error(rng):
    time = np.arange(3600.0)
    values = 100.0 + 7.0 * time / 3600.0 + rng.standard_normal(3600)
    # The start is not counted.
    values[:300] += 50.0
    slope, sd = soak.slope(list(zip(time.tolist(), values.tolist(), strict=True)), 60.0)
    # Sd of a mean of 60, divided by sqrt(sum of squared hours) of 54 windows over 0.9 h.
    assert sd == pytest.approx(1.0 / 60**0.5 / (54 * 0.9**2 / 12) ** 0.5, rel=0.3)
    assert abs(slope - 7.0) < 4.0 * sd
    assert soak.slope([(0.0, 1.0), (1.0, 1.0)], 60.0) is None
