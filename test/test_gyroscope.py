# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The calibration of a gyroscope agrees with simulated truth and closed formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest
from builders import START_NS, calibration, rich_calibration, rms, warm
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.errors import CalibrationError
from thermo_comp.fitting import FitOptions, FitSource, fit
from thermo_comp.fitting.initial_triad import within_positions
from thermo_comp.fitting.reduction import reduce_source
from thermo_comp.fitting.sources import KnownForce, Section
from thermo_comp.judging.evaluation import judge_bags
from thermo_comp.judging.verdicts import Verdict
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import Compensator
from thermo_comp.recording.blocks import Block, ImuColumns, Readings
from thermo_comp.simulation.campaign import parse_cyclogram, plan
from thermo_comp.simulation.presets import unit_preset
from thermo_comp.simulation.run import arrays
from thermo_comp.unit.calibration import gyroscope_of, rate_triad
from thermo_comp.unit.calibration_file import dump_calibration, parse_calibration
from thermo_comp.unit.functions import Polynomial
from thermo_comp.unit.gravity import EARTH_RATE, STANDARD_GRAVITY
from thermo_comp.unit.prediction import bias_and_scale, bias_scale_and_sd, ramp_states
from thermo_comp.unit.rate_bias import MILLIDEGREE, RateCurve

OPTIONS = FitOptions(gravity=STANDARD_GRAVITY, input='m/s^2')
RATE_HZ, MINUTE = 1.0, 60
#: Sd of a mean over 60 s of the simulated gyroscope's white noise [rad/s].
FLOOR = 5.0 * MILLIDEGREE / np.sqrt(60.0)


def block_of(record, K, rate=None):
    stamps = START_NS + record.accel_stamp_ns
    n, nothing, temperatures = len(stamps), np.zeros((len(stamps), 9)), {}
    rate = record.angular_rate if rate is None else rate
    imu = ImuColumns(np.zeros((n, 4)), nothing, rate, nothing, nothing)
    for name in ('board', 'case'):
        at = START_NS + getattr(record, f'{name}_stamp_ns')
        temperatures[name] = Readings(at, getattr(record, name), np.searchsorted(stamps, at))
    return Block(stamps, record.counts / K, 'imu', imu, temperatures, {})


def source_of(record, K, rate=None, name='bag'):
    return FitSource(name, lambda: [block_of(record, K, rate)])


@pytest.fixture(scope='module')
def unit():
    # Lags are minutes, so a reading every 4 s suffices, and saves 3/4 of the time of a fit.
    return unit_preset('mems', 2).with_thermometers(rate_hz=0.25)


@pytest.fixture(scope='module')
def fitted(unit):
    """Fit a MEMS unit in nine positions; its gyroscope's drift is the sum of several effects."""
    records = arrays(unit, plan('chamber-9', 2), 2, rate_hz=RATE_HZ)
    options = replace(OPTIONS, groups=('curve', 'gradient', 'board', 'gradient_lag', 'product'))
    return fit([source_of(record, unit.scale_factor) for record in records], options)


@pytest.fixture(scope='module')
def held_out(unit):
    (station, *_) = plan('held-out', 2)
    # The shortened program has two ramps up and two ramps down, each followed by a soak.
    whole = station.program
    program = replace(whole, time_s=whole.time_s[:10], temperature_c=whole.temperature_c[:10])
    return arrays(unit, [replace(station, program=program)], 99, rate_hz=RATE_HZ)[0]


@pytest.mark.slow
def test_the_corrected_rate_of_a_mems_gyroscope_has_only_noise_also_in_data_left_out(
    unit, fitted, held_out
):
    calibration = fitted.calibration
    gyroscope = calibration.gyroscope
    block = block_of(held_out, unit.scale_factor)
    out = process_block(Compensator(calibration), block, block.imu.angular_velocity)
    n = len(out.index) // MINUTE
    means, raw = (
        rate[: MINUTE * n].reshape(n, MINUTE, 3).mean(axis=1)
        for rate in (out.angular_rate, block.imu.angular_velocity[out.index])
    )
    changes = means - means.mean(axis=0)
    assert rms(raw - raw.mean(axis=0)) > 100.0 * FLOOR
    assert rms(changes) < 1.15 * FLOOR
    assert (np.sqrt(np.mean(changes**2, axis=0)) < 1.3 * FLOOR).all()
    # Expected square of a mean rate: claimed variance less sample noise + (Earth's rate)^2 / 3.
    message = gyroscope.noise_density_rad_s_sqrt_hz[0] ** 2 / calibration.unit.cycle_time_s
    claimed = np.sqrt(out.angular_rate_variance.mean(axis=0) - message + EARTH_RATE**2 / 3.0)
    assert (np.abs(means.mean(axis=0)) < 3.0 * claimed).all()
    np.testing.assert_allclose(gyroscope.noise_density_rad_s_sqrt_hz, 5.0 * MILLIDEGREE, rtol=0.05)
    # The residual sd of nine positions estimates the sd of turn-on offsets, 2 mdeg/s.
    assert np.mean(gyroscope.residual_sd_rad_s) == pytest.approx(2.0 * MILLIDEGREE, rel=0.4)
    row = fitted.rates[-1]
    assert row.section == 'all'
    assert row.raw.rms > 100.0 * FLOOR
    assert row.fitted.rms <= row.left_out.rms < 1.05 * FLOOR


@pytest.mark.slow
def test_a_gyroscope_does_not_change_the_accelerometer_s_fit(unit):
    program = parse_cyclogram('20 10min, 35@1.5 10min, 10@1.5 15min')
    stations = [replace(station, program=program) for station in plan('chamber-9', 2)[:2]]
    records = arrays(unit, stations, 2, rate_hz=RATE_HZ)
    options = replace(OPTIONS, groups=('curve', 'gradient'))
    plain = [source_of(record, unit.scale_factor) for record in records]
    with_rate = fit(plain, options)
    silent = [source_of(o, unit.scale_factor, np.zeros((len(o.counts), 3))) for o in records]
    without = fit(silent, options)
    assert with_rate.calibration.gyroscope is not None
    assert without.calibration.gyroscope is None
    provenance = without.calibration.provenance
    same = replace(with_rate.calibration, gyroscope=None, provenance=provenance)
    assert same == without.calibration
    broken = np.array(records[0].angular_rate)
    broken[len(broken) // 2 :] = np.nan
    sources = [source_of(records[0], unit.scale_factor, broken, 'first'), plain[1]]
    result = fit(sources, replace(options, groups=('curve',)))
    assert result.calibration.gyroscope is None
    (messages,) = (finding.message for finding in result.findings if finding.name == 'rate')
    assert messages == 'first: not every sample has an angular rate, so no gyroscope was fitted'
    assert 'rate' not in {finding.name for finding in (*with_rate.findings, *without.findings)}
    known = KnownForce('stated', (Section(0.0, math.inf, 1.002 * STANDARD_GRAVITY, 0.0),))
    result = fit([replace(plain[0], force=known), plain[1]], options)
    notes = result.calibration.provenance.notes
    assert result.calibration.gyroscope is None
    assert any(note.startswith('rate: the stated |f| differs') for note in notes)
    assert notes == tuple(str(each) for each in result.findings if each.level != 'good')


@given(st.lists(st.integers(0, 4), min_size=1, max_size=30), st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_residuals_about_position_means_do_not_depend_on_the_means(places, seed):
    position = np.sort(np.array(places))
    rng = np.random.default_rng(seed)
    rate, level = rng.standard_normal((len(places), 3)), rng.standard_normal((5, 3))
    within = within_positions(rate, position)
    moved = within_positions(rate + level[position], position)
    np.testing.assert_allclose(moved, within, atol=1e-12)
    for p in np.unique(position):
        np.testing.assert_allclose(within[position == p].sum(axis=0), 0.0, atol=1e-12)


def test_a_gyroscope_is_read_back_from_a_file_and_messages_name_wrong_keys():
    whole = rich_calibration()
    assert parse_calibration(dump_calibration(whole).encode()) == whole
    triad = rate_triad(whole)
    assert gyroscope_of(triad) == whole.gyroscope
    assert triad.gyroscope is None
    # The scale factor of a gyroscope is taken as 1, without uncertainty.
    states = ramp_states(triad, np.array([10.0, 20.0, 30.0]))
    bias, scale = bias_and_scale(triad, states)
    np.testing.assert_array_equal(scale, 1.0)
    _, sd_bias, _, sd_scale = bias_scale_and_sd(triad, states[1:2])
    np.testing.assert_array_equal(sd_scale, 0.0)
    # The bias at 20 degC is its level, with the variances of the level and of a turn-on.
    np.testing.assert_allclose(bias[1], (0.02 + 1e-5, -0.03, 0.01 + 1e-5))
    expected = np.hypot((1e-5, 2e-5, 1e-5), np.sqrt(1.01e-10))
    np.testing.assert_allclose(sd_bias[0], expected, rtol=1e-5)
    with pytest.raises(ValueError, match='`calibration` must have a gyroscope'):
        rate_triad(calibration())
    text = dump_calibration(whole)
    for old, new, said in (
        ('bias_rad_s: [0.02', 'bias_rad_s: [.nan', r'gyroscope\.bias_rad_s\[0\]'),
        ('noise_density_rad_s_sqrt_hz: [0.0001', 'noise_density_rad_s_sqrt_hz: [0.0',
         r'gyroscope\.noise_density_rad_s_sqrt_hz\[0\]: .*greater than 0'),
        ('residual_sd_rad_s', 'residual_sd', r'gyroscope'),
    ):  # fmt: skip
        assert old in text
        with pytest.raises(CalibrationError, match=said):
            parse_calibration(text.replace(old, new).encode())
    gyro = whole.gyroscope
    with pytest.raises(ValueError, match=r'`posterior\.diagonal` must have one number per param'):
        replace(gyro, response=gyro.response[1:])
    with pytest.raises(ValueError, match=r'`bias_function` must be 0 at t = 0 .*, got 1'):
        RateCurve(Polynomial((1.0, 2.0)))
    foreign = replace(gyro, response=(replace(gyro.response[0], sensor='magnet'),), posterior=None)
    with pytest.raises(ValueError, match=r'`gyroscope.response\[0\].sensor` must be one of'):
        replace(whole, gyroscope=foreign)


def test_the_rate_at_the_reference_temperature_is_corrected_by_its_bias():
    triad = replace(rich_calibration().gyroscope, response=(), posterior=None)
    for gyroscope in (triad, None):
        compensator = Compensator(replace(calibration(), gyroscope=gyroscope))
        warm(compensator, until_s=2000)
        row = compensator.process(2000 * 10**9, 300.0, 600.0, 2900.0)
        assert row[:2] == pytest.approx((1.0, 2.0))
        assert compensator.corrects_rate is (gyroscope is not None)
    compensator = Compensator(replace(calibration(), gyroscope=triad))
    warm(compensator)
    assert compensator.process(0, 300.0, 600.0, 2900.0) is not None
    x, y, z, *variances = compensator.correct_rate(0, 1.0, 1.0, 1.0)
    assert (x, y, z) == pytest.approx((0.98 - 1e-5, 1.03, 0.99 - 1e-5), abs=1e-12)
    # In an unknown regime the variance contains noise, residual and the regimes' bias difference.
    least = np.square((1e-4, 2e-4, 1e-4)) / 0.01 + np.square((1e-5, 2e-5, 1e-5))
    assert (np.array(variances) >= least).all()
    assert variances == pytest.approx(least, rel=0.05)
    # The bias sd for an INS does not contain the noise of a single sample.
    sd = compensator.status().rate_bias_sd
    noise = np.square((1e-4, 2e-4, 1e-4)) / 0.01
    np.testing.assert_allclose(np.square(sd), variances - noise, rtol=1e-6)


@pytest.mark.slow
def test_after_a_tumble_the_gyroscope_of_the_prior_is_kept_and_gives_no_alarm(unit, fitted):
    record = arrays(unit, plan('tumble', 2)[:1], 5, rate_hz=RATE_HZ)[0]
    again = fit([source_of(record, unit.scale_factor)], replace(OPTIONS, prior=fitted.calibration))
    assert (again.calibration.gyroscope, again.rates) == (fitted.calibration.gyroscope, ())
    bags = reduced(unit, arrays(unit, plan('tumble', 2)[:2], 3, rate_hz=RATE_HZ))
    rate = judge_bags(bags, fitted.calibration).rate
    section = rate.sections['all']
    assert section.rms < section.raw_rms < 1.3 * section.rms
    assert rate.kind is Verdict.WIDE


def reduced(unit, records):
    sources = [source_of(record, unit.scale_factor) for record in records]
    return [reduce_source(source, full_scale=None) for source in sources]


@pytest.mark.slow
def test_the_changes_of_the_rate_are_compared_with_their_claimed_sd(unit, fitted, held_out):
    calibration, bags = fitted.calibration, reduced(unit, [held_out])
    thirds = [replace(interval, n_whole=interval.n_whole // 3) for interval in bags[0].intervals]
    short = [replace(bags[0], intervals=tuple(thirds))]
    judged = judge_bags(bags, calibration)
    rate = judged.rate
    assert rate.kind is Verdict.VALID
    assert judged.exit_code == 0
    for name in ('static', 'dynamic', 'all'):
        section = rate.sections[name]
        # Unknown initial lag states add to the claimed sd, so it exceeds the noise.
        assert 0.7 < section.ratio < 1.2
        assert section.rms < 1.3 * FLOOR
        assert section.raw_rms > 50.0 * FLOOR
    assert judged.facts()['angular_rate']['reason'] == rate.reason
    assert 'angular rate: valid: 0.' in str(rate)
    gyro = calibration.gyroscope
    other = replace(gyro, response=(), static=gyro.dynamic, dynamic=gyro.dynamic, posterior=None)
    wrong = judge_bags(short, replace(calibration, gyroscope=other))
    assert wrong.is_valid
    assert wrong.rate.kind is Verdict.RECALIBRATE
    assert wrong.exit_code == 1
    assert judge_bags(short, replace(calibration, gyroscope=None)).rate is None
    silent = replace(other, residual_sd_rad_s=(0.0, 0.0, 0.0))
    unknown = judge_bags(short, replace(calibration, gyroscope=silent))
    assert unknown.rate.kind is Verdict.NO_CLAIM
    assert np.isnan(unknown.rate.sections['all'].claimed_rms)
    assert unknown.exit_code == 0
