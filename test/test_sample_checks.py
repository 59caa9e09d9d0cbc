# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Invalid samples are dropped; the gravity check refuses aged calibrations and ignores motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import (
    GRAVITY,
    SECOND_NS,
    UNCHECKED,
    assert_equal_bits,
    calibration,
    equal_axes,
    stream,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from thermo_comp.online.checks import SAME_DIRECTION, STUCK_SAMPLES, GravityCheck, StuckCheck
from thermo_comp.online.compensator import Compensator, CompensatorConfig
from thermo_comp.unit.calibration import Unit

K = 300.0
UP = (0.36, -0.48, 0.8)
LEVEL = K * GRAVITY * np.array(UP)


def at_rest(rng, bias=0.0):
    return tuple(float(round(K * GRAVITY * u + bias + rng.normal(0.0, 0.3))) for u in UP)


def readings(second):
    at, flicker = second * SECOND_NS, 0.004 * (-1) ** second
    return [('board', at, 20.0 + flicker), ('case', at, 20.0 - flicker)]


def recording(n, rate_hz, sample, start_ns=0):
    """Make events: samples sample(0) to sample(n - 1), and both temperatures at 1 Hz."""
    events = []
    second = start_ns // SECOND_NS
    for k in range(n):
        stamp_ns = start_ns + round(k * 1e9 / rate_hz)
        while second * SECOND_NS <= stamp_ns:
            events += readings(second)
            second += 1
        events.append(('accel', stamp_ns, sample(k)))
    return events


def test_few_equal_samples_and_samples_in_bursts_are_accepted_and_checks_can_be_off(rng):
    compensator = Compensator(calibration())
    stuck = at_rest(rng)
    stream(compensator, recording(STUCK_SAMPLES, 1.0, lambda _: stuck))
    assert compensator.counters.n_stuck == 0
    compensator = Compensator(calibration(), UNCHECKED)
    stream(compensator, recording(1000, 100.0, lambda _: (0.0, 0.0, 0.0)))
    assert compensator.counters.n_out == 1000
    compensator = Compensator(calibration())
    events = []
    for burst in range(60):
        events += readings(burst) if burst % 2 == 0 else []
        stamp_ns = burst * SECOND_NS // 2
        events += [('accel', stamp_ns + 1000 * k, at_rest(rng)) for k in range(1, 51)]
    stream(compensator, events)
    assert compensator.counters.n_too_fast == 0


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('value', [0.0, 123.0])
def test_a_constant_axis_is_stuck_if_the_other_axes_change(axis, value):
    compensator = Compensator(calibration())

    def sample(k):
        counts = [float(round(K * GRAVITY * u * (1.0 + 0.3 * math.sin(0.1 * k)))) for u in UP]
        counts[axis] = value
        return tuple(counts)

    stream(compensator, recording(1000, 100.0, sample))
    assert compensator.counters.n_out == 201  # samples of two seconds
    assert compensator.counters.n_stuck == 799


def noisy_unit(noise_counts, n_in_counts=K):
    """Make a calibration whose samples at 100 Hz have white noise of sd `noise_counts`."""
    density = noise_counts / n_in_counts / 10.0
    return calibration(
        axes=equal_axes(n_in_counts),
        unit=replace(calibration().unit, cycle_time_s=0.01),
        noise_density_m_s2_sqrt_hz=(density,) * 3,
    )


@pytest.mark.parametrize('dead', [(0,), (1,), (2,), (0, 1), (1, 2)])
def test_a_constant_axis_at_rest_is_stuck_if_its_noise_would_show(dead, rng):
    compensator = Compensator(noisy_unit(3.0))

    def sample(_):
        counts = [float(round(K * GRAVITY * u + rng.normal(0.0, 3.0))) for u in UP]
        for axis in dead:
            counts[axis] = float(round(K * GRAVITY * UP[axis]))
        return tuple(counts)

    stream(compensator, recording(1000, 100.0, sample))
    # An axis counts as stuck after the time-out of 2 s, and not before the other axes show noise.
    assert 201 <= compensator.counters.n_out <= 260
    assert compensator.counters.n_stuck == 1000 - compensator.counters.n_out


def low_passed(rng, correlation):
    white = 3.0 * math.sqrt(1.0 - correlation**2) * rng.normal(size=(30_000, 3))
    return np.round(LEVEL + lfilter([1.0], [1.0, -correlation], white, axis=0))


def quiet(rng, step):
    """Draw noise of 0.1 rounding steps at rest; the calibration was made in a shaken chamber."""
    centre = step * np.round(LEVEL / step) + step * np.array([0.5, 0.0, 0.5])
    return step * np.round((centre + rng.normal(0.0, 0.1 * step, (5000, 3))) / step)


def below_a_step(rng, _):
    """Draw noise below a rounding step: x repeats one value, y and z alternate between two."""
    return np.round(np.floor(LEVEL) + [0.0, 0.5, 0.5] + [0, 0.1, 0.1] * rng.normal(size=(5000, 3)))


@pytest.mark.parametrize(
    ('draw', 'size', 'noise'),
    [
        *((low_passed, correlation, 3.0) for correlation in (0.0, 0.9, 0.999)),
        *((quiet, step, 3.0) for step in (1.0, 2.0, 5.0)),
        (below_a_step, 0.0, 0.3),
    ],
)
def test_no_sample_of_a_working_sensor_at_rest_is_stuck(draw, size, noise, rng):
    compensator, table = Compensator(noisy_unit(noise)), draw(rng, size)
    stream(compensator, recording(len(table), 100.0, lambda k: tuple(table[k].tolist())))
    assert (compensator.counters.n_stuck, compensator.counters.n_out) == (0, len(table))


def test_the_variance_of_samples_in_m_s2_is_proportional_to_their_rate(rng):
    unit = calibration(unit=Unit('T-1', 'm/s^2', 100.0, 0.01), axes=equal_axes(1.0))
    compensator = Compensator(unit)
    samples = GRAVITY * np.array(UP) + 1e-3 * rng.standard_normal((8000, 3))
    rows, _ = stream(compensator, recording(8000, 400.0, lambda k: tuple(samples[k])))
    assert len(rows) == 8000
    # At four times the rate a sample lasts 1/4 of the time, and has 4 times the variance.
    assert rows[-1][3] / rows[0][3] == pytest.approx(4.0, rel=1e-6)


def test_the_gravity_check_uses_local_gravity_or_that_of_the_calibration(rng):
    for local, expected in ((0.0, 0.0), (GRAVITY + 2e-3, -2e-3)):
        compensator = Compensator(calibration(), CompensatorConfig(local_gravity_m_s2=local))
        stream(compensator, recording(6000, 100.0, lambda _: at_rest(rng)))
        gravity = compensator.status().gravity
        # The tolerance is 5 sd of a mean over 110 samples with 1.4 mm/s^2 of noise, plus rounding.
        assert gravity.residual == pytest.approx(expected, abs=5 * 1.4e-3 / math.sqrt(110) + 2e-4)


@st.composite
def stretches(draw):
    """Draw sequences of samples, each with at most one kind of fault, and temperatures."""
    events = []
    stamp_ns = 0
    k = 0
    for _ in range(draw(st.integers(1, 6))):
        kinds = 'rest', 'stuck', 'zero', 'nan', 'full', 'reversed'
        kind = draw(st.sampled_from(kinds))
        n = draw(st.sampled_from([1, 2, 48, 49, 50, 51, 52, 120]))
        step_ns = draw(st.sampled_from([1_000_000, 10_000_000, 40_000_000]))
        every = draw(st.sampled_from([7, 30, 200]))
        for _ in range(n):
            if k % every == 0:
                events.append(('board', stamp_ns, 20.0 + 0.001 * (k % 5)))
                events.append(('case', stamp_ns, 20.0 - 0.001 * (k % 3)))
            k += 1
            stamp_ns += step_ns
            sign = -1.0 if kind == 'reversed' else 1.0
            value = {
                'stuck': (1060.0, -1410.0, 2354.0),
                'zero': (0.0, 0.0, 0.0),
                'nan': (math.nan, 1.0, 2.0),
                'full': (1.0, 40000.0, 2.0),
            }.get(kind, (1060.0 + k % 2, -1410.0, sign * (2354.0 + 60.0 + k % 3)))
            events.append(('accel', stamp_ns, value))
        if draw(st.integers(0, 9)) == 0:
            stamp_ns = max(0, stamp_ns - 5 * SECOND_NS)
    return events


#: Numbers of samples in a part of the series; some are near the limit for a stuck axis.
LENGTHS = [1, 1, 1, 2, 3, 24, 48, 49, 50, 51, 52, 120]


@given(
    st.lists(st.tuples(st.sampled_from(LENGTHS), st.integers(0, 7)), max_size=40),
    st.lists(st.integers(1, 300), min_size=1, max_size=10),
    st.sampled_from([0, 1, 49, 60]),
)
@settings(max_examples=300, deadline=None)
def test_constant_samples_are_found_in_batches_of_any_size(parts, cuts, period):
    # In each part of the series an axis is constant or always changes; some y are NaN.
    stands = np.repeat([which >> np.arange(3) & 1 for _, which in parts], [n for n, _ in parts], 0)
    sizes = 1.0 + np.arange(len(stands)) % 4
    samples = 1.0 + np.cumsum((1.0 - stands.reshape(-1, 3)) * sizes[:, np.newaxis], axis=0)
    samples[7::97, 1] = np.nan
    stamps = np.arange(len(samples), dtype=np.int64) * 20_000_000
    single, batched = (StuckCheck(period / 50.0, 60.0, (2.0, 1.5, 2.5)) for _ in range(2))
    expected = []
    for stamp_ns, (x, y, z) in zip(stamps.tolist(), samples.tolist(), strict=True):
        last = single.last
        if x == last[0] or y == last[1] or z == last[2]:
            expected.append(single.again(stamp_ns, x, y, z))
        else:
            single.last, single.runs = (x, y, z, stamp_ns), ()
            expected.append(False)
    collected = []
    begin = 0
    for cut in [*cuts, len(stamps)]:
        end = min(begin + cut, len(stamps))
        if end > begin:
            collected += batched.find(stamps[begin:end], samples[begin:end]).tolist()
        begin = end
    assert collected == expected
    # Before the first sample `last`, a sample and its stamp, has NaN as x, y and z.
    np.testing.assert_array_equal(batched.last, single.last)
    for run, other in zip(single.runs, batched.runs, strict=bool(single.runs)):
        np.testing.assert_array_equal(np.hstack(run), np.hstack(other))


@given(stretches(), st.sampled_from([7, 64, 500]), st.sampled_from([0.0, 0.05, 1.0]))
@settings(max_examples=60, deadline=None)
def test_the_batch_drops_the_samples_that_the_stream_drops(events, chunk, stuck_s):
    config = CompensatorConfig(stuck_timeout_s=stuck_s, gravity_tolerance_m_s2=0.1)
    unit = calibration(axes=equal_axes(K, 60.0))
    _, _, compensators = assert_equal_bits(unit, config, events, chunk)
    first, *others = (compensator.status() for compensator in compensators)
    assert others == [first, first]


@pytest.mark.parametrize('is_mended', [False, True])
def test_a_jump_back_in_time_does_not_restore_a_refuted_calibration(rng, is_mended):
    compensator = Compensator(calibration(), CompensatorConfig(gravity_tolerance_m_s2=0.1))

    def events(bias, start_ns=0):
        return recording(6000, 100.0, lambda _: at_rest(rng, bias), start_ns)

    stream(compensator, events(100.0, 100 * SECOND_NS))
    assert compensator.is_refusing
    n_out, n_refuted = compensator.counters.n_out, compensator.counters.n_refuted
    stream(compensator, events(0.0 if is_mended else 100.0))
    assert compensator.counters.n_time_jumps == 1
    if is_mended:
        # Output returns after three windows of 5 s, as the first window has no window before it.
        assert compensator.counters.n_out - n_out == pytest.approx(4500, abs=200)
    else:
        assert compensator.counters.n_out == n_out
        assert compensator.counters.n_refuted == n_refuted + 6000


NOISE_SD = 2e-3
BIAS_SD = 1e-4
VARIANCE = NOISE_SD**2 + BIAS_SD**2
COVARIANCE = (VARIANCE, 0.0, 0.0, VARIANCE, 0.0, VARIANCE)


def watch(rng, *, bias=0.0, seconds=60, motion=0.0, rate_hz=100, monitor=None):
    monitor = monitor or GravityCheck(GRAVITY)
    up = np.array([0.3, -0.5, math.sqrt(1 - 0.34)])
    n = seconds * rate_hz
    t = np.arange(n) / rate_hz
    force = GRAVITY * up + bias * up + NOISE_SD * rng.standard_normal((n, 3))
    force += motion * np.sin(2 * np.pi * 1.3 * t)[:, None] * [0.7, 0.6, 0.1]
    for stamp, row in zip(np.rint(t * 1e9).astype(int).tolist(), force.tolist(), strict=True):
        monitor.add(stamp, tuple(row), COVARIANCE, 3 * NOISE_SD**2)
    return monitor.result


def test_the_residual_is_that_of_the_latest_windows_and_motion_gives_no_verdict(rng):
    result = watch(rng)
    # The residual averages more than 1500 samples; the limit is 5 sd of a mean over 1500.
    assert abs(result.residual) < 5 * NOISE_SD / math.sqrt(100 * 15)
    assert result.residual_sd == pytest.approx(math.hypot(BIAS_SD, NOISE_SD / math.sqrt(99)))
    assert result.n_windows == 59  # the first of 60 windows has no earlier window to compare with
    assert result.is_still
    assert watch(rng, motion=0.05) is None
    monitor = GravityCheck(GRAVITY)
    watch(rng, seconds=10, monitor=monitor)
    assert watch(rng, seconds=10, monitor=monitor).n_windows == 19
    monitor = GravityCheck(GRAVITY, tolerance=0.1)
    watch(rng, seconds=40, bias=0.001, monitor=monitor)
    assert not monitor.is_refuted
    # Stamps start again at 0, so the change of |f| counts as a restart, not as a step.
    result = watch(rng, seconds=8, bias=0.5, monitor=monitor)
    assert monitor.is_refuted
    assert result.residual == pytest.approx(0.5, abs=1e-3)


def steps(rng, *, offset, at_s=20.0, ramp_s=0.0, rate_hz=2.5, scatter=0.0):
    """Change |f| at `at_s`; return the time until the refusal [s], and the check's result."""
    monitor = GravityCheck(GRAVITY, tolerance=0.1)
    up = np.array([0.3, -0.5, math.sqrt(1 - 0.34)])
    for k in range(round((at_s + 10.0) * rate_hz)):
        seconds = k / rate_hz
        grown = min(max((seconds - at_s) / ramp_s, 0.0), 1.0) if ramp_s else seconds >= at_s
        sd = math.hypot(NOISE_SD, scatter * (seconds >= at_s))
        force = (GRAVITY + offset * grown) * up + sd * rng.standard_normal(3)
        monitor.add(round(seconds * 1e9), tuple(force), COVARIANCE, 3 * NOISE_SD**2)
        if monitor.is_refuted:
            return seconds - at_s, monitor.result
    return math.inf, monitor.result


@pytest.mark.parametrize('rate_hz', [2.5, 5.0, 10.0])
@pytest.mark.parametrize('offset', [0.3, -3.0, 15.0])
def test_a_step_at_rest_refutes_the_calibration_within_a_second(rng, rate_hz, offset):
    # WHY: a step of |f| was reported after 5 s, with a mean that included samples before it.
    after_s, result = steps(rng, offset=offset, rate_hz=rate_hz)
    assert after_s < 1.0
    assert result.residual == pytest.approx(offset, abs=5 * NOISE_SD)


def test_a_change_by_motion_does_not_refute_the_calibration_at_once(rng):
    # |f| changes by 1 m/s^2: within 0.8 s as in a lift, or with added noise as in a shaking car.
    assert steps(rng, offset=1.0, ramp_s=0.8, rate_hz=5.0)[0] > 2.0
    assert steps(rng, offset=1.0, scatter=0.05, rate_hz=5.0)[0] > 2.0


@pytest.mark.parametrize(('bank_deg', 'tilt_deg'), [(20.0, 0.0), (60.0, 2.0), (30.0, 5.0)])
def test_a_smooth_coordinated_turn_is_an_acceleration_and_not_a_wrong_calibration(
    bank_deg, tilt_deg, rng
):
    # WHY: |f| = g / cos(bank) without vibration stopped the output for the whole turn.
    monitor = GravityCheck(GRAVITY, tolerance=0.5)
    for k in range(12_000):
        seconds = 0.01 * k
        banked = float(np.interp(seconds, [20.0, 26.0, 90.0, 96.0], [0.0, 1.0, 1.0, 0.0]))
        size = GRAVITY / math.cos(math.radians(bank_deg * banked))
        attack = math.radians(tilt_deg * banked)
        force = size * np.array([math.sin(attack), 0.0, math.cos(attack)])
        force += NOISE_SD * rng.standard_normal(3)
        monitor.add(round(seconds * 1e9), tuple(force), COVARIANCE, 3 * NOISE_SD**2)
        if monitor.is_refuted:
            break
    # A turn by 5 deg may end in a rest in a new attitude, in which |f| shows a wrong axis.
    assert monitor.is_refuted == (tilt_deg > math.degrees(SAME_DIRECTION))


def test_a_vibration_of_whole_periods_between_readings_is_no_rest(rng):
    # WHY: at the stamps of readings, 1 s apart, a vibration of 20 Hz looked like a rest.
    sway = np.sin(2.0 * np.pi * 0.2 * np.arange(5) + 1.0)

    def shaken(k):
        return at_rest(rng, K * 5.0 * sway[k % 5] if k > 1000 else 0.0)

    compensator = Compensator(calibration())
    stream(compensator, recording(3000, 100.0, shaken))
    assert (compensator.counters.n_refuted, compensator.counters.n_out) == (0, 3000)
