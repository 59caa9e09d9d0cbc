# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Switches between sets cause no step of the output; a swap of calibrations loses no sample."""

import numpy as np
import pytest
from builders import (
    SECOND_NS,
    UNCHECKED,
    axis_set,
    calibration,
    equal_axes,
    regime_set,
    rich_calibration,
    warm,
)

from thermo_comp.online.compensator import Compensator, CompensatorConfig


def test_a_switch_of_sets_causes_no_step():
    # The output changes by 5 counts = 1.7 mg within 300 s, at most 0.28 ug per sample at 20 Hz.
    unit = calibration(dynamic=regime_set(axis_set(delta=5.0)))
    compensator = Compensator(unit, UNCHECKED)
    outputs = []
    for k in range(40_000):
        stamp = k * 50_000_000
        if k % 20 == 0:
            ramp = max(k / 20.0 - 1200.0, 0.0) / 60.0
            compensator.push('board', stamp, 20.0 + 0.3 * ramp)
            compensator.push('case', stamp, 20.0 + ramp)
        outputs.append(compensator.process(stamp, 0.0, 0.0, 1.0)[0])
    steps = np.abs(np.diff(outputs))
    assert outputs[0] == 0.0
    assert outputs[-1] == pytest.approx(-5.0 / 300.0)
    assert steps.max() <= 5.0 / 300.0 / 6000.0 * 1.001


@pytest.mark.parametrize(
    ('delta', 'given_s', 'expected_s'),
    # The blend is limited to 1 ug/s: 102 s for sets that differ by 0.3 counts = 102 ug.
    [(0.01, 30.0, 30.0), (0.3, 30.0, 1e-3 / 9.80665e-6), (0.3, 5.0, 50.0), (0.3, 0.0, 0.0)],
)
def test_a_transition_time_above_0_limits_the_change_to_1_ug_per_s(delta, given_s, expected_s):
    unit = calibration(dynamic=regime_set(axis_set(delta=delta)))
    compensator = Compensator(unit, CompensatorConfig(transition_time_s=given_s))
    assert compensator.thermal.tracker.config.transition_time_s == pytest.approx(expected_s)


def test_a_swap_of_calibrations_takes_effect_between_two_samples():
    compensator = Compensator(calibration())
    warm(compensator, until_s=5)
    before = compensator.process(5 * SECOND_NS, 300.0, 0.0, 1.0)
    compensator.swap(calibration(axes=equal_axes(150.0)))
    after = compensator.process(5 * SECOND_NS + 1, 300.0, 0.0, 1.0)
    assert (before[0], after[0]) == (1.0, 2.0)


def test_a_swap_to_another_detector_loses_no_sample():
    compensator = Compensator(calibration())
    warm(compensator, until_s=5)
    assert compensator.process(5 * SECOND_NS, 300.0, 0.0, 1.0) is not None
    compensator.swap(rich_calibration())
    row = compensator.process(5 * SECOND_NS + 1, 300.0, 0.0, 1.0)
    assert row is not None
    assert not compensator.status().is_settled
