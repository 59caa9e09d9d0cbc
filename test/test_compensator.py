# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The compensator agrees with hand calculations; a change of regime or calibration is smooth."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from builders import (
    GRAVITY,
    SECOND_NS,
    UNCHECKED,
    UNIQUE,
    assert_equal_bits,
    axis_set,
    batch,
    calibration,
    equal_axes,
    regime_set,
    rich_calibration,
    stream,
    term,
    thermal_calibration,
    warm,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

from thermo_comp.online.compensator import Compensator, CompensatorConfig
from thermo_comp.unit.calibration import Axes, AxisReference
from thermo_comp.unit.correction import Correction

#: Variance of a sample [m^2/s^4]: density^2 / cycle, plus the variance of rounding with carry.
NOISE = 1e-4**2 / 0.01 + (1.0 / 6.0) / 300.0**2


def test_corrected_samples_agree_with_the_formulas_of_two_faces_and_of_the_static_set():
    # Counts at +-g: offset = sum / 2, scale = difference / 2; the paper's Eq. (3), (4) swap them.
    plus, minus = 300.0 * GRAVITY + 12.0, -300.0 * GRAVITY + 12.0
    axis = AxisReference((plus - minus) / 2.0 / GRAVITY, (plus + minus) / 2.0)
    compensator = Compensator(calibration(axes=Axes(*[axis] * 3)))
    warm(compensator)
    corrected = compensator.process(1, plus, minus, 12.0)[:3]
    assert corrected == pytest.approx((GRAVITY, -GRAVITY, 0.0), abs=1e-12)
    axis = axis_set((0.0, 0.5, 0.01), (1.0, 1e-4), delta=2.0)
    unit = calibration(
        axes=equal_axes(300.0, 7.0),
        static=regime_set(axis, axis, axis),
        response=(term('gradient', (9.0,) * 3, (9.0,) * 3, range=(-0.05, 0.05)),),
        misalignment=((1.0, 0.0, 0.0), (1e-3, 1.0, 0.0), (2e-3, -3e-3, 1.0)),
    )
    compensator = Compensator(unit)
    warm(compensator, 30.0, until_s=200)
    x, y, z = compensator.process(200 * SECOND_NS, 1000.0, -500.0, 3000.0)[:3]
    bias = 7.0 + 2.0 + 0.5 * 10.0 + 0.01 * 100.0
    scale = 300.0 * (1.0 + 1e-4 * 10.0)
    a, b, c = ((n - bias) / scale for n in (1000.0, -500.0, 3000.0))
    # At constant temperature the temperature estimate is exact, so the tolerance is rounding.
    assert (x, y, z) == pytest.approx((a, 1e-3 * a + b, 2e-3 * a - 3e-3 * b + c), abs=1e-12)


RICH = rich_calibration()

#: Values of a few samples: not finite, limits of 16 bits, zeros, the least positive number.
STRANGE = (math.nan, math.inf, -math.inf, 32767.0, -32768.0, 0.0, -0.0, 5e-324)


def event_list(seed):
    """Make random messages; some are late, repeated, not finite or saturated, or stamps fall."""
    rng = random.Random(seed)
    events = []
    stamp = rng.choice([0, rng.randrange(2**60)])
    for _ in range(rng.randint(1, 60)):
        kind = rng.choice(['accel', 'accel', 'accel', 'board', 'case'])
        stamp += rng.choice([0, 1, 2_500_000, 400_000_000, 3 * SECOND_NS, 50 * SECOND_NS])
        stamp -= rng.choice([0, 0, 0, 0, 0, 5_000_000, 400 * SECOND_NS])
        stamp = max(stamp, 0)
        if kind == 'accel':
            value = tuple(
                rng.choice([rng.uniform(-33000.0, 33000.0), rng.choice(STRANGE)]) for _ in range(3)
            )
            if rng.random() < 0.5:
                value = (100.0, -200.0, 2900.0)
            events.append((kind, stamp, value))
        else:
            late = rng.choice([0, 0, 0, -SECOND_NS, 2 * SECOND_NS, 86_400 * SECOND_NS])
            celsius = rng.choice([rng.uniform(-60.0, 90.0), math.nan, 20.0])
            events.append((kind, max(stamp + late, 0), celsius))
    return events


#: Hypothesis draws one seed per list, as drawing each message would double the tests' time.
event_lists = st.integers(0, 2**64 - 1).map(event_list)


def at_seconds(*events):
    """Make events from letters and seconds: samples (A), board (B) and case (C) readings."""
    kinds = {'A': ('accel', (0.0, 0.0, 1.0)), 'B': ('board', 0.0), 'C': ('case', 0.0)}
    return [
        (kinds[kind][0], int(seconds * SECOND_NS), kinds[kind][1])
        for kind, seconds in zip(events[::2], events[1::2], strict=True)
    ]


# Earlier readings count as readings of another clock only if stamps fall by more than 5 s.
@given(event_lists, st.integers(3, 30), st.sampled_from([0.0, 5.0]))
@example(at_seconds('A', 3, 'A', 0, 'B', 2, 'B', 86_400, 'C', 0, 'A', 0), 5, 0.0)
@example(at_seconds('B', 26, 'B', 21, 'A', 23, 'B', 16.5), 1, 0.0)
@example(at_seconds('B', 12, 'B', 7.1, 'A', 7.1, 'B', 6.1), 1, 0.0)
@settings(max_examples=40, deadline=None)
def test_blocks_of_any_size_give_the_bits_of_single_samples(events, chunk, transition_s):
    config = CompensatorConfig(transition_time_s=transition_s, case_timeout_s=2.0)
    _, block, (compensator, *_) = assert_equal_bits(RICH, config, events, chunk)
    counters = compensator.counters
    for name in ('specific_force', 'angular_rate', 'angular_rate_variance', 'covariance'):
        assert np.isfinite(getattr(block, name)).all()
    assert (block.angular_rate_variance > 0.0).all()
    matrices = block.covariance.reshape(-1, 3, 3)
    if len(matrices):
        assert np.linalg.eigvalsh(matrices).min() > 0.0
    assert counters.n_in == sum(kind == 'accel' for kind, _, _ in events)
    assert counters.n_out == len(block.index)
    assert np.count_nonzero(np.diff(block.stamp_ns) <= 0) <= counters.n_time_jumps


def test_the_covariance_in_an_unknown_regime_contains_the_difference_of_the_sets():
    compensator = Compensator(calibration(dynamic=regime_set(axis_set(delta=3.0))))
    warm(compensator, until_s=1)
    early = compensator.process(SECOND_NS // 2, 0.0, 0.0, 1.0)
    warm(compensator, until_s=1500, start_s=1)
    late = compensator.process(1500 * SECOND_NS, 0.0, 0.0, 1.0)
    # The dynamic bias is 3 counts (0.01 m/s^2) above the static bias on x, and equal on y.
    assert early[3] == pytest.approx(NOISE + 0.01**2, rel=1e-6)
    assert early[6] == pytest.approx(NOISE, rel=1e-6)
    assert late[3] == pytest.approx(NOISE, rel=1e-6)


def test_samples_before_the_first_temperature_or_20_s_after_the_last_are_not_published():
    compensator = Compensator(thermal_calibration(), CompensatorConfig(temperature_timeout_s=20.0))
    assert compensator.process(1, 0.0, 0.0, 1.0) is None
    compensator.push('board', 2, 20.0)
    assert compensator.process(3, 0.0, 0.0, 1.0) is not None
    assert compensator.process(10 * SECOND_NS, 0.0, 0.0, 1.0) is not None
    assert compensator.process(2 + 20 * SECOND_NS, 0.0, 0.0, 1.0) is not None
    assert compensator.status().is_board_stale
    assert compensator.process(3 + 20 * SECOND_NS, 0.0, 0.0, 1.0) is None
    assert compensator.status().is_board_lost
    compensator.push('board', 30 * SECOND_NS, 20.0)
    assert compensator.process(30 * SECOND_NS, 0.0, 0.0, 1.0) is not None
    counters = compensator.counters
    assert (counters.n_out, counters.n_no_temperature, counters.n_stale) == (4, 1, 1)


@pytest.mark.parametrize('run', [lambda *given: stream(*given)[1], lambda *a: [*batch(*a).index]])
def test_a_sample_with_a_stamp_20_s_ahead_is_dropped_unless_the_next_stamp_agrees(run):
    # WHY: after one stamp 20 s ahead all later samples counted as late, and lags were reset.
    leap, step = 20 * SECOND_NS, SECOND_NS // 100
    usual = np.arange(1, 6) * step
    for stamps, kept in (
        (np.insert(usual, 2, usual[2] + leap), [0, 1, 3, 4, 5]),
        # After a gap of 20 s the first sample is dropped, and the samples after it are used.
        (np.where(np.arange(5) < 2, usual, usual + leap), [0, 1, 3, 4]),
        # Two stamps 20 s ahead are dropped if they are not adjacent, or if the second is lower.
        (np.insert(usual, [1, 3], usual[[1, 3]] + leap), [0, 2, 3, 5, 6]),
        (np.array([1, 2 + leap, 1 + leap, 3, 4]), [0, 3, 4]),
    ):
        compensator = Compensator(thermal_calibration())
        samples = [('accel', int(at), (1.0, 2.0, 3.0 + k)) for k, at in enumerate(stamps)]
        assert run(compensator, [('board', 0, 20.0), *samples]) == kept
        assert compensator.counters.n_out_of_order == len(stamps) - len(kept)
        assert compensator.counters.n_time_jumps == 0


@pytest.mark.parametrize('run', [lambda *given: stream(*given)[1], lambda *a: [*batch(*a).index]])
def test_a_stamp_ahead_before_a_jump_back_does_not_confirm_a_stamp_ahead_after_the_jump(run):
    # WHY: the second of two damaged stamps, with a jump back between them, reset the lags.
    seconds = (100.0, 100.01, 3700.0, 90.0, 7300.0, 90.01)
    samples = [('accel', round(at * 1e9), (k, 2.0, 3.0)) for k, at in enumerate(seconds)]
    compensator = Compensator(calibration())
    assert run(compensator, samples) == [0, 1, 3, 5]
    assert compensator.counters.n_time_jumps == 1


@pytest.mark.parametrize('is_read', [False, True])
def test_a_reading_with_a_near_stamp_confirms_a_sample_20_s_ahead(is_read):
    compensator = Compensator(thermal_calibration())
    compensator.push('board', 0, 20.0)
    assert compensator.process(1, 1.0, 2.0, 3.0) is not None
    if is_read:
        compensator.push('board', 19 * SECOND_NS, 20.0)
    assert (compensator.process(20 * SECOND_NS, 2.0, 3.0, 4.0) is not None) == is_read


@pytest.mark.parametrize('ahead_s', [0, 10**6])
def test_a_full_queue_has_4096_readings_and_keeps_the_newest(ahead_s):
    # WHY: case readings with a clock ahead filled the queue, and new board readings were dropped.
    compensator = Compensator(thermal_calibration(), CompensatorConfig(gravity_tolerance_m_s2=0.0))
    for k in range(10_000):
        compensator.push('case', (k + ahead_s) * SECOND_NS, 20.0)
        compensator.push('board', k * SECOND_NS, 20.0)
        if ahead_s and k % 100 == 0:
            compensator.process(k * SECOND_NS + 1, 1.0 + k % 2, 2.0, 3.0)
    counters = compensator.counters
    assert compensator.process(9_999 * SECOND_NS + 2, 7.0, 8.0, 9.0) is not None
    assert bool(counters.n_board_rejected) == (not ahead_s)
    assert counters.n_case_rejected > 3_000
    compensator = Compensator(calibration())
    for k in range(10_000):
        compensator.push('board', 10**18 + k, 20.0)
    assert len(compensator.thermal.queue) <= 4096
    assert compensator.counters.n_board_rejected == 10_000 - len(compensator.thermal.queue)


@pytest.mark.parametrize('n_before', [0, 3])
@pytest.mark.parametrize('ahead_s', [0, 2])
def test_all_readings_of_two_minutes_without_samples_are_applied(n_before, ahead_s):
    first = [('accel', k * SECOND_NS // 100, (1.0, 2.0, 2930.0)) for k in range(1, 1 + n_before)]
    readings = [
        (name, k * SECOND_NS // 20, 20.0 + 1e-4 * k + 1e-3 * (k % 7))
        for k in range(4, 20 * 120)
        for name in ('board', 'case')
    ]
    # For `ahead_s` = 2 the readings of the last 2 s have later stamps than the next sample.
    after_ns = (120 - ahead_s) * SECOND_NS
    last = [('accel', after_ns + k * SECOND_NS // 100, (1.0, 2.0 + k, 2930.0)) for k in range(5)]
    block, live = (Compensator(replace(rich_calibration(), gyroscope=None)) for _ in range(2))
    whole = batch(block, [*first, *readings, *last])
    rows, _ = stream(live, first)
    for reading in readings:
        live.push(*reading)
        if reading[1] <= after_ns:
            live.flush(reading[1])
    more, _ = stream(live, last)
    columns = np.column_stack([whole.specific_force, whole.covariance[:, UNIQUE]])
    np.testing.assert_array_equal(columns, np.concatenate([rows, more]))
    assert block.counters == live.counters
    assert block.counters.n_board_rejected == block.counters.n_case_rejected == 0


def test_flush_updates_the_regime_without_samples():
    compensator = Compensator(calibration())
    warm(compensator, until_s=1500)
    compensator.flush(1500 * SECOND_NS)
    assert compensator.take_flags()[-1] == (1499 * SECOND_NS, False)


def test_another_transition_time_during_a_transition_causes_no_step_of_the_output():
    # The curves of the two regimes differ by 0.025 counts (8.5 ug) at any temperature.
    unit = calibration(dynamic=regime_set(axis_set(delta=0.025)))
    compensator = Compensator(unit, replace(UNCHECKED, transition_time_s=100.0))
    warm(compensator, 20.0, until_s=1200)
    for k in range(1200, 1400):
        compensator.push('board', k * SECOND_NS, 20.0)
        compensator.push('case', k * SECOND_NS, 20.0 + (k - 1200) / 30.0)
    stamp = 1200 * SECOND_NS
    while compensator.process(stamp, 0.0, 0.0, 1.0)[0] > -0.01 / 300.0:
        stamp += SECOND_NS // 10
    before = compensator.process(stamp + 1, 0.0, 0.0, 1.0)[0]
    other = replace(compensator.config, transition_time_s=50.0)
    compensator.take_over(compensator.thermal.model, other)
    assert compensator.process(stamp + 2, 0.0, 0.0, 1.0)[0] == pytest.approx(before, abs=1e-9)


def test_a_new_transition_time_does_not_restart_the_checks_of_gravity_and_sample_rate(rng):
    compensator = Compensator(calibration(), CompensatorConfig())

    def published(seconds, size):
        count = 0
        for second in seconds:
            warm(compensator, start_s=second, until_s=second + 1)
            for k in range(10):
                x, y, z = rng.normal((0.0, 0.0, size), 0.1)
                stamp = second * SECOND_NS + (k + 1) * SECOND_NS // 10
                count += compensator.process(stamp, x, y, z) is not None
        return count

    count_per_g = GRAVITY * compensator.calibration.axes.z.scale_factor
    assert published(range(60), 1.1 * count_per_g) < 600
    assert compensator.gravity.is_refuted
    assert published(range(60, 65), 1.1 * count_per_g) == 0
    other = replace(compensator.config, transition_time_s=50.0)
    compensator.take_over(compensator.thermal.model, other)
    assert published(range(65, 70), 1.3 * count_per_g) == 0
    compensator.take_over(compensator.thermal.model, replace(other, gravity_tolerance_m_s2=5.0))
    assert published(range(70, 75), 1.1 * count_per_g) > 0
    compensator = Compensator(calibration(), CompensatorConfig(gravity_tolerance_m_s2=0.0))
    warm(compensator, until_s=10)
    step_ns = round(0.25e9 * compensator.calibration.unit.cycle_time_s)

    def published(begin_s):
        stamps = range(begin_s * SECOND_NS, (begin_s + 1) * SECOND_NS, step_ns)
        force = rng.normal(0.0, 1.0, (len(stamps), 3))
        samples = zip(stamps, *force.T, strict=True)
        return sum(compensator.process(*sample) is not None for sample in samples)

    assert published(3) > 0
    assert published(4) == 0
    other = replace(compensator.config, transition_time_s=50.0)
    compensator.take_over(compensator.thermal.model, other)
    assert published(5) == 0


@pytest.mark.parametrize('bad', [math.nan, math.inf, 1e200])
def test_output_that_is_not_finite_is_never_published(monkeypatch, bad):
    line = Correction.line

    def broken(self, start, end, slow, excess):
        corrected = line(self, start, end, slow, excess)
        at = np.asarray(start)[0]
        corrected[0] = np.where((at > 21.0) & (at < 23.0), bad, corrected[0])
        return corrected

    monkeypatch.setattr(Correction, 'line', broken)
    events = []
    for k in range(40):
        stamp_ns = k * SECOND_NS // 8
        if k % 4 == 0:
            events += [(name, stamp_ns, 20.0 + 0.125 * k) for name in ('board', 'case')]
        events.append(('accel', stamp_ns, (30.0 + k % 3, -20.0, 2941.0 + k % 5)))
    unit = thermal_calibration()
    rows, _, (compensator, *_) = assert_equal_bits(unit, CompensatorConfig(), events, 7)
    n_sent = sum(name == 'accel' for name, *_ in events)
    assert 0 < compensator.counters.n_unsound == n_sent - len(rows)
    assert np.isfinite(rows).all()


def test_a_switch_of_sets_causes_no_step():
    # The output changes by 5 counts = 1.7 mg within 300 s, at most 0.57 ug per sample at 10 Hz.
    compensator = Compensator(calibration(dynamic=regime_set(axis_set(delta=5.0))), UNCHECKED)
    outputs = []
    for k in range(20_000):
        stamp = k * 100_000_000
        if k % 10 == 0:
            ramp = max(k / 10.0 - 1200.0, 0.0) / 60.0
            compensator.push('board', stamp, 20.0 + 0.3 * ramp)
            compensator.push('case', stamp, 20.0 + ramp)
        outputs.append(compensator.process(stamp, 0.0, 0.0, 1.0)[0])
    steps = np.abs(np.diff(outputs))
    assert (outputs[0], outputs[-1]) == (0.0, pytest.approx(-5.0 / 300.0))
    assert steps.max() <= 5.0 / 300.0 / 3000.0 * 1.001


@pytest.mark.parametrize(
    ('delta', 'given_s', 'expected_s'),
    # The regimes differ by 0.3 counts = 102 ug: at 1 ug/s a change by this difference takes 102 s.
    [(0.01, 30.0, 30.0), (0.3, 30.0, 1e-3 / 9.80665e-6), (0.3, 5.0, 50.0), (0.3, 0.0, 0.0)],
)
def test_a_transition_time_above_0_limits_the_change_to_1_ug_per_s(delta, given_s, expected_s):
    unit = calibration(dynamic=regime_set(axis_set(delta=delta)))
    compensator = Compensator(unit, CompensatorConfig(transition_time_s=given_s))
    assert compensator.thermal.tracker.config.transition_time_s == pytest.approx(expected_s)


def test_a_swap_of_calibrations_takes_effect_between_two_samples_and_loses_no_sample():
    compensator = Compensator(calibration())
    warm(compensator, until_s=5)
    before = compensator.process(5 * SECOND_NS, 300.0, 0.0, 1.0)
    compensator.swap(calibration(axes=equal_axes(150.0)))
    after = compensator.process(5 * SECOND_NS + 1, 300.0, 0.0, 1.0)
    assert (before[0], after[0]) == (1.0, 2.0)
    # `rich_calibration` has other detector settings: its detector is new and has not settled.
    compensator.swap(rich_calibration())
    assert compensator.process(5 * SECOND_NS + 2, 300.0, 0.0, 1.0) is not None
    assert not compensator.status().is_settled
