# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits to simulated units that were heated in only one or two attitudes are right."""

from types import SimpleNamespace

import numpy as np
import pytest
import strangers
from strangers_cases import (
    FULL_SCALE,
    RETURNED,
    Study,
    consumer_grade,
    navigation,
    one_test,
    returned,
)
from strangers_helpers import slow
from strangers_units import GRAVITY, program, record, rng_of, spread

from thermo_comp.fitting.rests import poses_of


@pytest.mark.parametrize('poses', [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize('unit', [1, pytest.param(2, marks=pytest.mark.slow)])
def test_rests_in_one_pose_at_four_temperatures_determine_the_drift_of_level_axes(unit, poses):
    # WHY: if the attitude of each rest is free, only the warm-up of the board determines the bias
    # curve. The sensor lags the board, which caused bias errors of 1 to 4 mg between the rests.
    study = list(returned(unit))[poses - 1]
    calibration = strangers.fitted(study)
    (held,) = map(slow, study.tests[''])
    force = strangers.corrected(calibration, held).force
    drift = force - strangers.minutes(held).force
    drift -= np.nanmean(drift, axis=0)
    # Attitude errors of 0.2 mrad RMS in the rests cause errors of about 0.2 mg in the bias curve
    # of a level axis. Tolerance: 0.4 mg, two sd.
    assert np.sqrt(np.nanmean(drift**2)) < 2.0 * 2e-4 * GRAVITY


def test_only_an_attitude_to_which_the_unit_was_returned_is_a_pose():
    # WHY: parts of one long rest counted as returns to a pose, so that a random walk of the bias
    # was fitted as a curve over temperature.
    x, y = np.eye(3)[:2]

    def poses(*up, start_ns=range(4)):
        rests = [(SimpleNamespace(start_ns=start), None) for start in start_ns]
        found = poses_of(SimpleNamespace(rests=rests), np.array(up))
        return None if found is None else found.tolist()

    assert poses(x, x, y, y) is None
    assert poses(x, y, x, y) == [0, 1, 0, 1]
    assert poses(x, y, y, x) == [0, -1, -1, 0]
    assert poses(x, x, y, y, start_ns=(0, 2, 1, 3)) == [0, 0, 1, 1]
    assert poses(x, x, x, x) == [0, 0, 0, 0]


def test_rests_in_one_pose_use_the_mounting_sd_that_the_user_stated():
    # WHY: a fit of rests in one pose used a smaller sd of mountings than the user had stated.
    study = next(returned(1))
    calibration = strangers.fitted(study, mounting_sd=0.01)
    for axis in calibration.static.axes():
        assert axis.residual_sd_m_s2 == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('draw', 'unit', 'is_cold'),
    [
        (consumer_grade, 3, False),
        (consumer_grade, 4, False),
        (navigation, 2, True),
        (navigation, 2, False),
    ],
)
def test_the_claimed_sd_is_right_if_one_ramp_cannot_separate_bias_and_scale(draw, unit, is_cold):
    # WHY: noise of the thermometer in rests at constant temperature was taken for temperature
    # changes that do not change the bias, so the drift in the only ramp was attributed to scale
    # factors: 470 ppm/K instead of -36. In warm-ups of a cold unit the effect of a lag was
    # attributed to the scale factor alone.
    rng = rng_of('bench beside a ramp', unit)
    imu = draw(rng)
    bench = program(22.0, 5.0)
    ups = [*spread(14, rng), *spread(3, rng)]
    programs = [bench] * 14 + [RETURNED] * 3
    bags = [
        record(
            *(imu, program, up, rng),
            name=f'{k}', rate_hz=0.5 if draw is navigation else 10.0, is_cold=is_cold and k < 15,
        )
        for k, (program, up) in enumerate(zip(programs, ups, strict=True))
    ]  # fmt: skip
    held = tuple(bags[15:] if draw is navigation else map(slow, bags[15:]))
    options = FULL_SCALE if draw is navigation else {}
    study = Study('', tuple(bags[:15]), one_test(held), options)
    tests = {'': [strangers.minutes(bag) for bag in held]}
    score = strangers.scored(study, strangers.fitted(study), tests)['']
    # A ramp in one attitude does not determine the slopes of the three scale factors. If their
    # claimed sd is right, the RMS of error / claimed sd exceeds 1.9 for 1 % of all units.
    assert score.ratio < 1.9
