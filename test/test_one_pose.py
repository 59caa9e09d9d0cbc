# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
One attitude: what it can tell comes out, with an honest uncertainty; the rest is refused.

"""

from __future__ import annotations

import numpy as np
import pytest
from pose_helpers import GRAVITY, MG, Rest
from thermo_comp.fitting.held_out import held_out
from thermo_comp.fitting.one_pose import (
    PoseOptions,
    fit_branches,
    fit_series,
    fit_whole,
    order_for,
    read_pose,
)

from thermo_comp.errors import FitError
from thermo_comp.fitting.sources import ArrayBlock, FitSource

OPTIONS = PoseOptions(gravity=GRAVITY)
UP = np.array([0.48, -0.6, 0.64])


def drifting(rng, bias_slope=(0.0, 0.0, 0.0), scale_slope=(0.0, 0.0, 0.0), up=UP, **keys):
    """Make a rest whose bias [mg/K] and scale [1e-3/K] drift with the board's temperature."""
    rest = Rest(rng, level=tuple(GRAVITY * up), **keys)
    t = rest.temperature(rest.time)[:, None] - 20.0
    rest.accel += t * MG * (np.array(bias_slope) + np.array(scale_slope) * up)
    return rest


def test_finds_the_combination_along_gravity(rng):
    bias, scale = np.array([1.0, -0.5, 2.0]), np.array([0.3, 0.0, -0.4])
    pose = read_pose(drifting(rng, bias, scale).source(), OPTIONS)
    model = fit_whole(pose)
    # By hand: u . b + g u' S u, per kelvin.
    slope = UP @ bias + UP @ (scale * UP)
    at = np.array([16.0, 20.0, 30.0])
    error = model.thermal_error(at) / MG
    sd = model.thermal_error_sd(at) / MG
    assert model.order == 2
    np.testing.assert_array_less(np.abs(error - slope * (at - 20.0)), 4.0 * sd + 1e-9)
    assert sd[1] == 0.0
    # 15000 samples of 3 mg over 20 K: hundredths of a mg; the doubt about a wander triples it.
    assert sd[2] < 0.3
    np.testing.assert_allclose(model.direction, UP, atol=2e-3)
    # The board ends at 35 - 20 (1 - exp(-3)) = 16.0 degC, its noise is 0.02 K.
    assert model.temperature_range[0] == pytest.approx(16.0, abs=0.1)
    assert model.temperature_range[1] > 34.0


def test_what_happens_across_gravity_is_not_seen(rng):
    # A tilting mount or a bias across u: the norm stays, to second order.
    across = np.cross(UP, (0.0, 0.0, 1.0))
    pose = read_pose(drifting(rng, across).source(), OPTIONS)
    model = fit_whole(pose)
    assert abs(model.thermal_error(np.array([30.0]))[0]) / MG < 0.3


def test_bias_and_scale_look_the_same(rng):
    # WHY it is never a full model: two different sensors give one and the same result.
    one = drifting(np.random.default_rng(5), (0.0, 0.0, 1.0), up=np.array([0.0, 0.0, 1.0]))
    two = drifting(
        np.random.default_rng(5), scale_slope=(0.0, 0.0, 1.0), up=np.array([0.0, 0.0, 1.0])
    )
    models = [fit_whole(read_pose(rest.source(), OPTIONS)) for rest in (one, two)]
    np.testing.assert_allclose(models[0].coefficients, models[1].coefficients, rtol=1e-12)


def test_jumps_refuse_the_whole_and_not_the_branches(rng):
    rest = drifting(rng, (0.0, 0.0, 1.5), up=np.array([0.0, 0.0, 1.0]), fall=30.0)
    rest.add((0.0, 0.0, 20.0 * MG), from_s=250.0)
    pose = read_pose(rest.source(), OPTIONS)
    with pytest.raises(
        FitError, match=r'at 250.0 s the sensor jumped by \+\d\d\.\d mg along'
    ) as no:
        fit_whole(pose)
    assert 'without motion' in str(no.value)
    assert 'not a function of temperature' in str(no.value)
    first, second = fit_branches(pose)
    for fit in (first, second):
        assert fit.refusal == ''
        at = np.mean(fit.model.temperature_range) + np.array([0.0, 1.0])
        assert np.diff(fit.model.reading(at))[0] / MG == pytest.approx(1.5, abs=0.3)
    # The levels differ by the jump, whichever branch is asked.
    at = np.array([14.5])
    step = (second.model.reading(at, extend=True) - first.model.reading(at, extend=True)) / MG
    # Two branches, each known to about 1 mg where they meet.
    assert step[0] == pytest.approx(20.0, abs=4.0)


def test_small_span_is_refused_and_said(rng):
    pose = read_pose(Rest(rng, fall=2.0).source(), OPTIONS)
    with pytest.raises(FitError, match=r'temperature span 1\.\d degC is too small, need 3'):
        fit_whole(pose)
    (only,) = fit_branches(pose)
    assert only.model is None
    assert 'too small' in only.refusal


@pytest.mark.parametrize(('span', 'order'), [(3.0, 1), (9.9, 1), (10.0, 2), (24.9, 2), (60.0, 3)])
def test_order_goes_with_the_span(span, order):
    assert order_for(span) == order


def test_order_needs_a_span():
    with pytest.raises(FitError, match=r'span 2\.9 degC is too small'):
        order_for(2.9)


def test_held_out_part_is_covered_by_its_predicted_sd(rng):
    rest = drifting(rng, (0.0, 0.0, 1.5), up=np.array([0.0, 0.0, 1.0]))
    # A level that wanders by 1 mg over some minutes, as real sensors do.
    steps = rng.standard_normal(len(rest.time)) * MG * np.sqrt(1.0 / (120.0 * rest.rate_hz))
    rest.accel[:, 2] += np.cumsum(steps)
    pose = read_pose(rest.source(), OPTIONS)
    series = pose.series
    parts = (series.time // 20.0).astype(int) % 2
    total = None
    for fold in (0, 1):
        model = fit_series(series.select(parts == fold), OPTIONS)
        found = held_out(model, series, parts != fold, extend=True)
        total = found if total is None else total + found
    # 25 samples of 3 mg leave 0.6 mg; 600 windows with a slow part: coverage within 3 %.
    assert 0.5 < total.rms / MG < 1.5
    assert total.coverage > 0.92
    assert total.normalised_rms == pytest.approx(1.0, abs=0.25)


def test_held_at_the_edge_of_what_was_seen(rng):
    pose = read_pose(drifting(rng, (0.0, 0.0, 1.5)).source(), OPTIONS)
    model = fit_whole(pose)
    low, high = model.temperature_range
    beyond = np.array([low - 5.0, high + 5.0])
    np.testing.assert_array_equal(
        model.reading(beyond), model.reading(np.array(model.temperature_range))
    )
    assert model.reading(beyond, extend=True)[1] != model.reading(beyond)[1]


def test_counts_are_said_in_parts_of_their_own_level(rng):
    rest = drifting(rng, (0.0, 0.0, 1.0), up=np.array([0.0, 0.0, 1.0]))
    rest.accel = np.rint(rest.accel * 1000.0)
    pose = read_pose(rest.source(), PoseOptions(input='counts'))
    assert pose.milli_g == pytest.approx(9.8, rel=0.01)
    slope = fit_whole(pose).thermal_error(np.array([21.0]))[0]
    # 1 mg/K is 9.8 counts/K; the line through 20 K is known to some per cent.
    assert slope == pytest.approx(9.8, rel=0.1)


def test_cut_into_blocks_it_is_the_same(rng):
    rest = drifting(rng, (0.0, 0.0, 1.5))
    one = fit_whole(read_pose(rest.source(), OPTIONS))
    many = fit_whole(read_pose(rest.source(n_blocks=41), OPTIONS))
    np.testing.assert_allclose(one.coefficients, many.coefficients, rtol=1e-12)


def test_part_of_a_recording(rng):
    rest = drifting(rng, (0.0, 0.0, 1.5), up=np.array([0.0, 0.0, 1.0]))
    rest.add((0.0, 0.0, 30.0 * MG), from_s=400.0)
    with pytest.raises(FitError, match='jumped'):
        fit_whole(read_pose(rest.source(), OPTIONS))
    part = PoseOptions(gravity=GRAVITY, end_s=380.0)
    assert fit_whole(read_pose(rest.source(), part)).solution.time[-1] <= 380.0


def test_long_handling_leaves_the_attitude_in_doubt(rng):
    rest = drifting(rng, (0.0, 0.0, 1.5))
    rows = (rest.time > 200.0) & (rest.time < 260.0)
    rest.accel[rows] += GRAVITY * rng.standard_normal((rows.sum(), 3))
    pose = read_pose(rest.source(), OPTIONS)
    with pytest.raises(FitError, match=r'moved for long after .* the same attitude'):
        fit_whole(pose)
    assert len(fit_branches(pose)) == 2


def test_several_attitudes_are_for_the_full_fit(rng):
    rest = Rest(rng)
    rest.add((GRAVITY, 0.0, -GRAVITY), from_s=300.0)
    with pytest.raises(FitError, match='several attitudes, 90 deg apart'):
        read_pose(rest.source(), OPTIONS)


def test_recordings_that_cannot_be_used(rng):
    rest = Rest(rng)
    nothing_ns, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    stamp_ns = np.rint(rest.time * 1e9).astype(np.int64) + 1
    cold = ArrayBlock(stamp_ns, rest.accel, nothing_ns, nothing, nothing_ns, nothing)
    with pytest.raises(FitError, match='no board temperature'):
        read_pose(FitSource('cold', lambda: [cold]), OPTIONS)
    with pytest.raises(FitError, match='no accelerometer samples'):
        read_pose(FitSource('empty', list), OPTIONS)
    # A window without noise beside ever stronger shaking: no two still cells in a row.
    rest.accel += np.exp(rest.time / 20.0)[:, None] * rng.standard_normal(rest.accel.shape)
    with pytest.raises(FitError, match='no still interval of 300 s'):
        read_pose(rest.source(), PoseOptions(min_still_s=300.0))


def test_too_few_windows(rng):
    pose = read_pose(drifting(rng, (0.0, 0.0, 1.5)).source(), OPTIONS)
    with pytest.raises(FitError, match='no still window'):
        fit_series(pose.series.select(pose.series.time < 0.0), OPTIONS)


@pytest.mark.parametrize(
    ('keys', 'message'),
    [
        ({'samples': 1}, '`samples` must be at least 2, got 1'),
        ({'order': 4}, '`order` must be within 0..3, got 4'),
        ({'begin_s': 5.0, 'end_s': 5.0}, '`begin_s` must be before `end_s`'),
        ({'min_still_s': 0.0}, '`min_still_s` must be positive'),
    ],
)
def test_options_are_checked(keys, message):
    with pytest.raises(ValueError, match=message):
        PoseOptions(**keys)
