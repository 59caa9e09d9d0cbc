# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Windows, residuals and verdicts of a judgement agree with hand calculations."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from builders import GRAVITY, START_NS, axis_set, calibration, equal_axes, regime_set
from conftest import ROOT

from thermo_comp.cli.output import micro_g
from thermo_comp.errors import RecordingError
from thermo_comp.fitting.sources import digest
from thermo_comp.judging.evaluation import evaluate
from thermo_comp.judging.judgement import AxisShift, change_texts, judge
from thermo_comp.judging.verdicts import Verdict
from thermo_comp.judging.windows import JudgedWindows, columns_of
from thermo_comp.online.batch import process_block
from thermo_comp.online.compensator import CONTINUED, SWAPPED, Compensator
from thermo_comp.recording.reader import open_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter, table_writer
from thermo_comp.replay import replay
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration
from thermo_comp.unit.gravity import MICRO_G, parse_acceleration, ug_text
from thermo_comp.unit.provenance import Provenance, ResidualSummary, Source

TOPICS = Topics()
K = 300.0
SLOPE = 2.0  # drift of the z axis [counts/K]


def resting(
    path, temperature, *, minutes=10, rate_hz=10, noise=0, shaken=(), error=0, reading_s=1, dead=''
):
    """Write a bag of a unit at rest, z up, whose z axis drifts with its temperature."""
    rng = np.random.default_rng(3)
    begin, end = temperature if isinstance(temperature, tuple) else (temperature, temperature)
    n = round(minutes * 60.0 * rate_hz)
    seconds = (np.arange(n) + 1) / rate_hz
    stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    celsius = begin + (end - begin) * seconds / (minutes * 60.0)
    counts = np.zeros((n, 3))
    counts[:, 2] = K * GRAVITY + SLOPE * (celsius - 20.0) + error
    counts += noise * rng.standard_normal((n, 3))
    counts[:, ['xyz'.index(axis) for axis in dead]] = 0.0
    # x alternates by 1e-9 counts, because an axis that repeats one value counts as broken.
    counts[::2, 0] += 1e-9
    if shaken:
        rows = (seconds >= shaken[0]) & (seconds < shaken[1])
        counts[rows] += 300.0 * rng.standard_normal((int(rows.sum()), 3))
    with BagWriter(path) as writer:
        since = np.arange(0, round(minutes * 60.0), reading_s)
        readings = begin + (end - begin) * since / (minutes * 60.0)
        readings += 1e-7 * (since // reading_s % 2)
        for topic in (TOPICS.board, TOPICS.case):
            writer.write_temperature(topic, START_NS + since * 10**9, readings)
        writer.write_counts(TOPICS.counts, stamps, counts)
    return path


def corrected_by(slope, claim=0.0, **changes):
    """Make a calibration with a temperature slope of z [counts/K] and a claimed sd [m/s^2]."""
    parts = {name: axis_set(residual_sd_m_s2=claim) for name in 'xy'}
    part = regime_set(**parts, z=axis_set((0.0, slope), residual_sd_m_s2=claim))
    return dataclasses.replace(calibration(static=part, dynamic=part), **changes)


def of_noise(sd):
    unit = dataclasses.replace(calibration().unit, cycle_time_s=0.1)
    return calibration(unit=unit, noise_density_m_s2_sqrt_hz=(sd * np.sqrt(0.1),) * 3)


def judged(bag, calibration, **keys):
    return evaluate([bag], [('it', calibration)], **keys).judgements['it']


def made(residual, raw, claimed, n=40, dynamic=10, outside=0):
    """Make windows of one position, z up, with residual, raw residual and claimed sd [ug]."""
    force, constant = np.zeros((n, 3)), np.zeros((n, 3))
    force[:, 2] = GRAVITY + residual * MICRO_G
    constant[:, 2] = GRAVITY + raw * MICRO_G
    rows = np.arange(n)
    return JudgedWindows(
        window_s=60.0, gravity=GRAVITY, bag=np.zeros(n, np.int64), position=np.zeros(n, np.int64),
        start_ns=START_NS + rows * 60 * 10**9, time=rows * 60.0 + 30.0, count=np.full(n, 600),
        mean=constant * K, board=np.full(n, 20.0), rate=np.zeros(n), is_dynamic=rows < dynamic,
        is_inside=rows >= outside, is_swapped=np.zeros(n, bool), raw=constant, force=force,
        size=np.full(n, GRAVITY), claimed_sd=np.full(n, claimed * MICRO_G), noise_sd=np.zeros(n),
        lack_sd=np.zeros(n), gyro=np.zeros((n, 0)),
    )  # fmt: skip


CLAIMING = corrected_by(SLOPE, 1e-5)


class TestWindows:
    @pytest.mark.parametrize('reading_s', [30, 50])
    def test_readings_every_30_or_50_s_remove_no_window(self, tmp_path, reading_s):
        # WHY: the time between readings counted as a jump, so at 2 Hz windows were lost.
        bag = resting(tmp_path / 'bag', 30.0, minutes=30.0, rate_hz=2.0, reading_s=reading_s)
        windows = judged(bag, corrected_by(SLOPE)).windows
        assert len(windows) >= 28
        np.testing.assert_allclose(windows.residual, 0.0, atol=1e-9)

    def test_residuals_equal_those_computed_by_hand_with_the_gravity_that_the_user_states(
        self, tmp_path
    ):
        bag = resting(tmp_path / 'bag', 30.0)
        models = [('right', corrected_by(SLOPE)), ('half', corrected_by(SLOPE / 2))]
        judgements = evaluate([bag], models).judgements
        drift = SLOPE * 10.0 / K
        # The estimated board temperature errs by 1e-7 K, which changes |f| by 1e-9 m/s^2.
        for name, expected in (('right', 0.0), ('half', drift / 2)):
            windows = judgements[name].windows
            np.testing.assert_allclose(windows.raw_residual, drift, atol=1e-9)
            np.testing.assert_allclose(windows.residual, expected, atol=1e-9)
            np.testing.assert_allclose(windows.board, 30.0, rtol=0.0, atol=1e-6)
        judgement = judged(resting(tmp_path / 'cold', 20.0), calibration(), gravity=GRAVITY + 1e-3)
        np.testing.assert_allclose(judgement.windows.residual, -1e-3, atol=1e-9)

    def test_a_window_is_the_mean_of_the_samples_that_the_node_publishes(self, tmp_path):
        # The temperature rises by 1 K/min, so a wrong time or reading changes the correction.
        bag = resting(tmp_path / 'bag', (15.0, 33.0), minutes=18.0, noise=0.2)
        unit = corrected_by(SLOPE)
        windows = judged(bag, unit).windows
        compensator = Compensator(unit)
        with open_recording(bag) as reader:
            blocks = [process_block(compensator, block) for block in reader.blocks()]
        stamps = np.concatenate([block.stamp_ns for block in blocks])
        force = np.concatenate([block.specific_force for block in blocks])
        for start_ns, mean in zip(windows.start_ns, windows.force, strict=True):
            inside = (stamps >= start_ns) & (stamps < start_ns + 60 * 10**9)
            assert inside.sum() == 600
            # The judgement takes the correction as linear over 10 s: the error is below 0.001 ug.
            np.testing.assert_allclose(mean, force[inside].mean(axis=0), atol=1e-8)

    @pytest.mark.parametrize('rate_hz', [0.5, 1.0, 3.0, 4.0, 50.0])
    @pytest.mark.parametrize('window_s', [60.0, 120.0])
    def test_windows_at_rest_have_the_stated_length(self, tmp_path, rate_hz, window_s):
        # WHY: at 4 Hz windows were made of 8 s means (32 samples), so 10 s windows lasted 16 s.
        bag = resting(tmp_path / 'bag', 20.0, minutes=20.5, rate_hz=rate_hz, noise=0.3)
        windows = judged(bag, calibration(), window_s=window_s).windows
        assert windows.window_s == window_s
        np.testing.assert_array_equal(windows.count, rate_hz * window_s)
        np.testing.assert_allclose(np.diff(windows.start_ns) * 1e-9, window_s, atol=1e-6)
        assert len(windows) >= int(20.5 * 60.0 / window_s) - 1

    def test_only_windows_at_rest_are_judged(self, tmp_path):
        bag = resting(tmp_path / 'bag', 20.0, noise=0.3, shaken=(201.0, 222.0))
        windows = judged(bag, calibration(), window_s=10.0).windows
        inside = (windows.time > 196.0) & (windows.time < 227.0)
        assert not inside.any()
        assert len(windows) >= 55
        assert np.unique(windows.position).tolist() == [0, 1]
        # A mean over 100 samples with a noise of 0.3 counts has a noise of 0.1 mm/s^2.
        assert np.sqrt(np.mean(windows.residual**2)) < 3.0 * 0.3 / K / 10.0

    @pytest.mark.parametrize('rate_hz', [10, 40])
    def test_residuals_of_white_noise_agree_with_their_claimed_sd(self, tmp_path, rate_hz):
        # At both rates the noise has the calibrated density: 0.3 counts per sample at 10 Hz.
        knows, noise = of_noise(0.3 / K), 0.3 * np.sqrt(rate_hz / 10.0)
        bag = resting(tmp_path / 'bag', 20.0, minutes=40.0, rate_hz=rate_hz, noise=noise)
        windows = judged(bag, knows, window_s=10.0).windows
        ratio = windows.residual / windows.claimed_sd
        # The RMS of 240 standard normal numbers is 1 within 3 / sqrt(2 * 240) = 0.14.
        assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.14)

    def test_the_limit_of_noise_at_rest_follows_from_the_calibration_and_slow_samples_are_refused(
        self, tmp_path
    ):
        # WHY: a unit with 100 mg of noise had no window at rest, because the limit was 50 mg.
        bag = resting(tmp_path / 'bag', 20.0, noise=0.1 * K * GRAVITY)
        assert len(judged(bag, of_noise(0.1 * GRAVITY)).windows) >= 8
        with pytest.raises(RecordingError, match='no window of 60 s at rest'):
            judged(bag, calibration())
        bag = resting(tmp_path / 'slow', 20.0, rate_hz=1.0)
        reason = 'low for windows of 10 s: give --window as 30 s '
        with pytest.raises(RecordingError, match=reason):
            judged(bag, calibration(), window_s=10.0)

    def test_the_figures_of_several_recordings_are_those_of_all_their_windows(self, tmp_path):
        one = resting(tmp_path / 'one', 19.0, error=0.3)
        bags = [one, resting(tmp_path / 'two', 30.0, error=-0.3)]
        evaluation = evaluate(bags, [('it', CLAIMING)])
        whole = evaluation.judgements['it'].sections['all']
        assert whole.n == sum(judged(bag, CLAIMING).sections['all'].n for bag in bags)
        assert whole.mean / MICRO_G == pytest.approx(0.0, abs=0.5)
        assert whole.rms == pytest.approx(0.3 / K, rel=1e-3)
        assert evaluation.notes == ()

    def test_a_bag_that_never_rests_is_named_and_a_report_on_it_has_exit_code_1(
        self, tmp_path, cli
    ):
        good = resting(tmp_path / 'good', 25.0)
        short = resting(tmp_path / 'short', 25.0, minutes=0.5)
        (note,) = evaluate([good, short], [('it', CLAIMING)]).notes
        assert note.startswith(f'{short}: no window of 60 s at rest')
        save_calibration(CLAIMING, tmp_path / 'unit.yaml')
        options = '-c', tmp_path / 'unit.yaml', '-o', tmp_path / 'report.html'
        finished = cli('report', short, *options, code=1)
        assert 'not judged: no recording has a rest' in finished.stdout


class TestVerdict:
    @pytest.mark.parametrize(
        ('residual', 'raw', 'claimed', 'tolerance', 'verdict'),
        [
            (50.0, 1000.0, 60.0, None, 'valid'),
            (119.0, 1000.0, 60.0, None, 'valid'),
            (121.0, 1000.0, 60.0, None, 'recalibrate'),
            (1100.0, 9000.0, 1500.0, None, 'valid, but it only claims 1.5 mg'),
            (50.0, 100.0, 60.0, None, 'valid, but it only claims 60 ug'),
            # A verdict is never 'valid' if the residual is not below the raw residual.
            (1100.0, 1000.0, 1500.0, None, 'no better than raw'),
            (1000.0, 1000.0, 1500.0, None, 'no better than raw'),
            (90.0, 1000.0, 10.0, 100.0, 'valid'),  # residual > claimed sd, < tolerance
            (110.0, 1000.0, 200.0, 100.0, 'recalibrate'),  # residual < claimed sd, > tolerance
            (90.0, 1000.0, 200.0, 100.0, 'valid, but it only claims 200 ug'),
            (90.0, 80.0, 60.0, 100.0, 'no better than raw'),
        ],
    )
    def test_the_verdict_compares_residual_and_claimed_sd_or_the_users_tolerance(
        self, residual, raw, claimed, tolerance, verdict
    ):
        limit = None if tolerance is None else tolerance * MICRO_G
        judgement = judge(made(residual, raw, claimed), CLAIMING, limit)
        assert (judgement.verdict, judgement.is_valid) == (verdict, verdict.startswith('valid'))
        assert judgement.exit_code == (0 if judgement.is_valid else 1)
        assert judgement.sections['all'].ratio == pytest.approx(residual / claimed)
        for value in (residual, raw, tolerance or claimed):
            assert ug_text(value * MICRO_G) in judgement.reason
        limited = 'in the worse regime, limit 100 ug' in judgement.reason
        assert limited == (tolerance is not None)
        # WHY: the reason named a worse regime also if only one regime had been judged.
        one = judge(made(residual, raw, claimed, dynamic=0), CLAIMING, limit).reason
        assert ('over these windows, limit' in one) == limited

    def test_the_verdict_on_bags_of_the_fit_states_the_left_out_error_first(self):
        # WHY: the stated error was that of fitted attitudes, 61 ug, not of new attitudes, 1091 ug.
        fitted = ResidualSummary('all', 40, 1e-3, 5e-4, 1e-3, left_out_rms_m_s2=300.0 * MICRO_G)
        unit = dataclasses.replace(CLAIMING, provenance=Provenance(residuals=(fitted,)))
        windows = made(50.0, 1000.0, 60.0)
        unseen, seen = (judge(windows, unit, is_seen=is_seen) for is_seen in (False, True))
        assert unseen.headline_rms / MICRO_G == pytest.approx(50.0)
        assert unseen.reason.startswith('50 ug RMS of |f| - g, 1 mg raw')
        assert seen.headline_rms / MICRO_G == pytest.approx(300.0)
        left_out = '300 ug RMS of |f| - g on positions left out; in sample '
        assert seen.reason.startswith(f'{left_out}50 ug RMS of |f| - g, 1 mg raw')
        # The claimed sd judges the in-sample error, a tolerance judges the left-out error.
        assert seen.verdict == unseen.verdict == 'valid'
        limited = judge(windows, unit, 100.0 * MICRO_G, is_seen=True)
        assert limited.verdict == 'recalibrate'
        assert '300 ug RMS on positions left out, limit 100 ug' in limited.reason
        assert judge(windows, unit, 100.0 * MICRO_G).verdict == 'valid'

    def test_the_error_is_printed_beside_that_on_data_left_out_of_the_fit(self, cli, tmp_path):
        # 2 counts on z are an error of 2 / 300 m/s^2 = 680 ug; there is no noise, so no drift.
        bag = resting(tmp_path / 'bag.mcap', 25.0, error=2.0)
        path = tmp_path / 'it.yaml'
        for norm, drift, rows in (
            (500.0, 40.0, ['|f| - g 680 500 {}', 'drift of an axis 0.0 40.0 -']),
            (None, 40.0, ['|f| - g 680 - {}', 'drift of an axis 0.0 40.0 -']),
            (None, None, []),
        ):
            known = [value and value * MICRO_G for value in (norm, drift)]
            fitted = ResidualSummary('all', 40, 1e-3, 5e-4, 1e-3, *known)
            provenance = Provenance(residuals=(fitted,))
            unit = dataclasses.replace(corrected_by(SLOPE, 0.01), provenance=provenance)
            save_calibration(unit, path, overwrite=True)
            claimed = judged(bag, unit).sections['all'].claimed_rms
            printed = cli('evaluate', bag, '-c', path).stdout
            lines = [' '.join(line.split()) for line in printed.splitlines()]
            first = lines.index('RMS in ug found expected claimed sd') + 1 if rows else 0
            right = [row.format(micro_g(claimed)) for row in rows]
            assert lines[first : first + len(rows)] == right
            facts = json.loads(cli('evaluate', bag, '-c', path, '--json').stdout)
            expected = facts['expectations_m_s2']
            assert [expected[key]['expected_rms'] for key in ('norm', 'drift')] == known
            assert expected['norm']['claimed_rms'] == claimed

    def test_a_drift_far_above_the_drift_of_left_out_data_is_named(self):
        # WHY: with board stamps 300 s late the drift was 35 ug instead of 1 ug, "valid".
        windows = made(1.0, 1000.0, 2.0)
        fitted = ResidualSummary('all', 40, 1e-3, 5e-4, 1e-3, None, 10.0 * MICRO_G)
        unit = dataclasses.replace(CLAIMING, provenance=Provenance(residuals=(fitted,)))
        ramp = np.linspace(-1.0, 1.0, len(windows))[:, None] * (MICRO_G, 0.0, 0.0)
        for peak, is_named in ((80.0, False), (400.0, True)):
            # A ramp on a level axis hardly changes |f|; the RMS over three axes is peak / 3.
            drifting = dataclasses.replace(windows, force=windows.force + peak * ramp)
            reason = judge(drifting, unit).reason
            assert ('an axis drifts by' in reason) == is_named

    def test_a_bag_of_the_fit_is_recognised_by_its_hash(self, tmp_path):
        bag = resting(tmp_path / 'bag', 25.0)
        fitted = ResidualSummary('all', 40, 1e-3, 5e-4, 1e-3, left_out_rms_m_s2=3e-4)
        for sha256, expected in ((digest(bag), 3e-4), ('0' * 64, np.nan)):
            provenance = Provenance(sources=(Source('bag', sha256, 6000),), residuals=(fitted,))
            judgement = judged(bag, dataclasses.replace(CLAIMING, provenance=provenance))
            assert judgement.left_out_rms == pytest.approx(expected, nan_ok=True)

    def test_a_calibration_without_covariance_gets_the_verdict_no_claim(self):
        # WHY: without a covariance only noise is claimed, so the verdict was 'recalibrate'.
        imported = corrected_by(SLOPE)
        windows = made(50.0, 1000.0, 2.0)
        judgement = judge(windows, imported)
        assert judgement.verdict == 'no claim'
        assert not judgement.is_valid
        assert 'give the largest accepted RMS with --tolerance' in judgement.reason
        assert np.isnan(judgement.sections['all'].claimed_rms)
        assert judge(windows, imported, 60.0 * MICRO_G).verdict == 'valid'
        assert judge(windows, imported, 40.0 * MICRO_G).verdict == 'recalibrate'
        assert judge(made(50.0, 40.0, 2.0), imported).verdict == 'no better than raw'

    def test_the_worse_regime_decides_the_verdict(self):
        windows = made(50.0, 1000.0, 60.0)
        windows.force[:10, 2] = GRAVITY + 150.0 * MICRO_G
        # The residual is 150 ug in the dynamic regime and 84 ug RMS in all; 60 ug are claimed.
        judgement = judge(windows, CLAIMING)
        assert judgement.sections['all'].ratio < 2.0
        assert judgement.verdict == 'recalibrate'
        assert judge(windows, CLAIMING, 100.0 * MICRO_G).verdict == 'recalibrate'

    def test_windows_outside_the_ranges_do_not_change_the_verdict_and_are_named(self, tmp_path):
        windows = made(50.0, 1000.0, 60.0, outside=10)
        bad = windows.force.copy()
        windows.force[:10, 2] = GRAVITY + 5000.0 * MICRO_G
        found = judge(windows, CLAIMING)
        assert (found.verdict, found.sections['all'].n) == ('valid', 30)
        assert found.sections['outside'].n == 10
        assert '10 windows of 60 s outside the calibrated ranges not judged: 5 mg' in found.reason
        bad[10:, 2] = GRAVITY + 500.0 * MICRO_G
        assert judge(dataclasses.replace(windows, force=bad), CLAIMING).verdict == 'recalibrate'
        for tolerance in (None, 1.0):
            found = judge(made(1.0, 1000.0, 60.0, outside=40), CLAIMING, tolerance)
            assert found.verdict == 'outside the calibrated range: not judged'
            assert not found.is_valid
        _, upper = CLAIMING.static.temperature_range_c
        judgement = judged(resting(tmp_path / 'out', upper + 2.0), CLAIMING)
        assert judgement.kind is Verdict.OUTSIDE
        # WHY: for windows outside the range of rates the message named only temperatures.
        assert '+0.00 K/min; calibrated at 5.0 to 35.0 degC and -1.00 to +1.00' in judgement.reason
        assert f'at {upper + 2.0:.1f} to {upper + 2.0:.1f} degC' in judgement.reason
        # Thermometer noise may be 0.01 K, so a soak 0.01 K above the range counts as inside.
        edge = judged(resting(tmp_path / 'edge', upper + 0.01), CLAIMING)
        assert edge.sections['outside'].n == 0


def around(n, bias, scale, noise=0.0):
    rng = np.random.default_rng(5)
    faces = np.vstack((np.eye(3), -np.eye(3)))
    others = rng.standard_normal((max(n - 6, 0), 3))
    up = np.vstack((faces, others / np.linalg.norm(others, axis=1, keepdims=True)))[:n]
    position = np.repeat(np.arange(n), 12)
    force = up[position] * GRAVITY * (1.0 + np.array(scale)) + np.array(bias)
    force += noise * rng.standard_normal(force.shape)
    return dataclasses.replace(made(0.0, 1000.0, 2.0, n=12 * n), position=position, force=force)


class TestShifts:
    @pytest.mark.parametrize('n', [6, 18])
    def test_changed_parameters_are_named(self, n):
        moved = around(n, (20.0 * MICRO_G, 0.0, 0.0), (0.0, 30e-6, 0.0), noise=0.5 * MICRO_G)
        # 12 windows per position, with 0.5 ug of noise, determine bias to 1 ug, scale to 1.5 ppm.
        judgement = judge(moved, corrected_by(SLOPE, 1e-5), None)
        assert judgement.n_positions >= min(n, 12)
        assert judgement.shifts[0].bias / MICRO_G == pytest.approx(20.0, abs=1.0)
        assert judgement.shifts[1].scale == pytest.approx(30e-6, abs=1.5e-6)
        assert abs(judgement.shifts[2].bias) < 3.0 * judgement.shifts[2].bias_sd
        assert [text.split(' +')[0] for text in judgement.moved] == ['x bias', 'y scale']
        assert judgement.verdict == 'recalibrate'
        assert '; shifted: x bias +' in judgement.reason

    def test_a_large_shift_is_written_without_an_exponent(self):
        # WHY: the message was `x bias +829 +- 1.3e+02 ug`, with the sd as a power of ten.
        big = AxisShift(829.4 * MICRO_G, 129.2 * MICRO_G, 0.0, 1.0)
        small = AxisShift(-1.234 * MICRO_G, 0.0567 * MICRO_G, 0.0, 1.0)
        assert change_texts((big, small)) == ('x bias +829 +- 129 ug', 'y bias -1.234 +- 0.057 ug')

    def test_an_unchanged_unit_shows_no_shift(self):
        judgement = judge(around(12, (0.0,) * 3, (0.0,) * 3, noise=MICRO_G), CLAIMING)
        assert (len(judgement.shifts), judgement.moved, judgement.verdict) == (3, (), 'valid')
        judgement = judge(around(5, (0.0,) * 3, (0.0,) * 3), CLAIMING)
        assert (judgement.shifts, judgement.n_positions) == ((), 5)

    def test_the_drift_of_an_axis_is_the_deviation_from_its_mean_in_a_position(self):
        windows = made(0.0, 1000.0, 60.0, n=40, dynamic=20)
        windows.force[:20, 0] += 3e-5 * np.where(np.arange(20) % 2, 1.0, -1.0)
        judgement = judge(windows, CLAIMING)
        np.testing.assert_allclose(judgement.axis_rms, [[0, 0, 0], [3e-5, 0, 0]], atol=1e-12)


def test_evaluate_reports_exchanged_thermometers_and_temperatures_out_of_range(tmp_path):
    exchanged = Topics(board='temperature/case', case='temperature/board')
    for topics, text in ((Topics(), []), (exchanged, [SWAPPED])):
        bag = ROOT / 'bags' / 'held_out.mcap'
        result = replay(bag, CLAIMING, tmp_path / f'{len(text)}.mcap', topics=topics, serial='')
        assert result.notes == text
        verdict = judged(bag, CLAIMING, topics=topics, serial='', tolerance=1.0 + 9.0 * len(text))
        assert (verdict.kind is Verdict.SWAPPED) == bool(text)
        assert not (text and verdict.is_valid)
        assert verdict.reason.startswith(SWAPPED) == bool(text)
    _, upper = CLAIMING.static.temperature_range_c
    (note,) = replay(resting(tmp_path / 'hot', upper + 2.0), CLAIMING, tmp_path / 'hot.mcap').notes
    assert note == f'board temperature +2.00 K {CONTINUED}'


def test_a_bag_in_kelvins_or_with_an_axis_that_repeats_one_value_is_refused(tmp_path):
    # WHY: a bag whose level y axis repeated one number was valid, as y hardly changes |f|.
    bag = resting(tmp_path / 'dead.mcap', 20.0, noise=5.0, dead='y')
    noisy = of_noise(5.0 / K)
    with pytest.raises(RecordingError, match=r'dead\.mcap: dead axis: y reads exactly 0 for 0\.'):
        judged(bag, noisy)
    # An axis whose noise is below a step of the converter may repeat values, and is not reported.
    assert judged(bag, dataclasses.replace(noisy, noise_density_m_s2_sqrt_hz=(1e-5,) * 3))
    # WHY: the verdict on a bag in kelvins only named temperatures outside the calibrated range.
    bag = resting(tmp_path / 'hot.mcap', 293.15)
    reason = r'hot\.mcap: temperature/board reads 293\S* degC .* kelv'
    with pytest.raises(RecordingError, match=reason):
        judged(bag, CLAIMING)


@pytest.mark.parametrize(('step', 'noise'), [(0.0, 0.02), (0.005, 0.02), (0.01, 0.001)])
def test_a_constant_axis_of_an_imu_is_named_if_its_noise_exceeds_a_step(
    tmp_path, rng, step, noise
):
    n = 6000
    force = noise * rng.standard_normal((n, 3)) + (1.5 * step, 0.0, GRAVITY)
    force = step * np.round(force / step) if step else force
    force[:, 1] = 0.0
    path = tmp_path / 'imu.mcap'
    with BagWriter(path) as writer:
        readings = 20.0 + 1e-7 * (np.arange(600) % 2)
        for topic in (TOPICS.board, TOPICS.case):
            writer.write_temperature(topic, START_NS + np.arange(600) * 10**9, readings)
        writer.write_imu(TOPICS.imu, START_NS + np.arange(n) * 10**8, force, np.zeros(9))
    unit = Unit('T-1', 'm/s^2', 80.0, 0.1)
    density = (noise * np.sqrt(0.1),) * 3
    known = calibration(unit=unit, axes=equal_axes(1.0), noise_density_m_s2_sqrt_hz=density)
    if noise > step:
        with pytest.raises(RecordingError, match=r'\.mcap: dead axis: y reads exactly 0 for 0\.'):
            judged(path, known)
    else:
        assert judged(path, known)


def test_windows_are_written_as_a_table(tmp_path):
    windows = made(50.0, 1000.0, 60.0, outside=3)
    with table_writer(tmp_path / 'rows', {}) as write:
        write(columns_of(windows, ['a,"b".mcap']))
    first, *rows = csv.reader((tmp_path / 'rows').read_text().splitlines())
    assert first == [
        *('bag', 'position', 'start_ns', 'time_s', 'window_s', 'samples'),
        *('board_c', 'board_rate_k_min', 'regime', 'is_inside'),
        *('force_x_m_s2', 'force_y_m_s2', 'force_z_m_s2', 'known_force_m_s2'),
        *('raw_residual_ug', 'residual_ug', 'claimed_sd_ug'),
    ]
    assert len(rows) == len(windows)
    row = dict(zip(first, rows[0], strict=True))
    assert (row['bag'], row['position'], row['start_ns']) == ('a,"b".mcap', '1', str(START_NS))
    assert (row['regime'], row['is_inside'], rows[-1][8]) == ('dynamic', '0', 'static')
    assert float(row['residual_ug']) == pytest.approx(50.0)
    assert float(row['claimed_sd_ug']) == pytest.approx(60.0)


def test_accelerations_of_an_option_are_read_with_their_unit_or_refused():
    for text in ('100ug', '100 µg', '0.1mg', '9.80665e-4m/s^2'):
        assert parse_acceleration(text) / MICRO_G == pytest.approx(100.0)
    for text in ('', '100', 'ug', '-1ug', '1 parsec', '1e999ug', '0mg', '1.2.3mg'):
        with pytest.raises(ValueError, match='expected a positive number with its unit, like 100'):
            parse_acceleration(text)
