# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits to recordings that other people made have the figures of docs/real_data.md."""

import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from conftest import ran
from recorded.data import GRAVITY, faces_bag, freezer_bag, handheld_bag
from scipy.optimize import least_squares

from thermo_comp.errors import FitError, RecordingError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.fitting.sources import fit_sources
from thermo_comp.judging.evaluation import evaluate
from thermo_comp.recording.topics import BagPart, Topics

MG = GRAVITY * 1e-3
OPTIONS = FitOptions(gravity=GRAVITY, input='m/s^2')


@pytest.fixture(scope='module')
def work(tmp_path_factory):
    return tmp_path_factory.mktemp('recorded')


@pytest.fixture(scope='module', params=[0, 1, 2])
def unit(request, real_data, work):
    sources, _ = fit_sources([handheld_bag(real_data, work, request.param)])
    return fit(sources, OPTIONS)


def means_of(result):
    data = result.fit.windows.data
    return np.array([data.mean[data.position == p].mean(axis=0) for p in range(data.n_positions)])


def test_the_residual_of_handheld_units_is_the_noise_of_their_samples(unit):
    assert 21 <= len(unit.positions) <= 23
    # Means over 1 s have 0.48 to 0.57 mg of noise; the fit uses means over 0.5 s.
    assert 0.5 < unit.residuals[-1].fitted.rms / MG < 0.9
    assert unit.residuals[-1].left_out.rms < 1.15 * unit.residuals[-1].fitted.rms


def test_fits_of_handheld_units_agree_with_a_least_squares_solution_by_scipy(unit):
    # scipy minimises |M (N - b) / K| - g over nine parameters, for the means of all positions.
    means = means_of(unit)

    def residual(parameters):
        matrix = np.eye(3)
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = parameters[6:]
        force = (means - parameters[:3]) / parameters[3:6] @ matrix.T
        return np.linalg.norm(force, axis=1) - GRAVITY

    direct = least_squares(residual, [0, 0, 0, 1, 1, 1, 0, 0, 0], x_scale='jac').x
    calibration = unit.calibration
    axes = calibration.axes
    # The fit weights positions by their duration, the solution by scipy does not.
    np.testing.assert_allclose([axis.bias for axis in axes], direct[:3], atol=1.0 * MG)
    np.testing.assert_allclose([axis.scale_factor for axis in axes], direct[3:6], atol=1e-3)
    M = np.array(calibration.misalignment)
    np.testing.assert_allclose([M[1, 0], M[2, 0], M[2, 1]], direct[6:], atol=1.5e-3)


def test_six_faces_leave_the_misalignment_at_its_prior(real_data, work):
    sources, kind = fit_sources([faces_bag(real_data, work)])
    result = fit(sources, replace(OPTIONS, input=kind))
    calibration = result.calibration
    assert len(result.positions) == 6
    # Six faces hardly determine misalignments, whose sd remains that of the prior, 0.01 rad.
    np.testing.assert_allclose(calibration.misalignment, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(calibration.misalignment_sd, 1e-2, rtol=0.01)
    # The bias is half the sum of opposite faces, the scale factor half of their difference.
    means = means_of(result)
    high, low = means.max(axis=0), means.min(axis=0)
    axes = calibration.axes
    np.testing.assert_allclose([axis.bias for axis in axes], 0.5 * (high + low), atol=1.0)
    by_hand = 0.5 * (high - low) / GRAVITY
    np.testing.assert_allclose([axis.scale_factor for axis in axes], by_hand, rtol=1e-3)
    assert 'misalignment' in {finding.name for finding in result.findings}


def test_the_freezer_run_is_refused_for_its_jumps(real_data, work):
    # |a| jumps by some 20 mg at 367 s and at 467 s; a third jump is mostly across gravity.
    sources, _ = fit_sources([freezer_bag(real_data, work)])
    with pytest.raises(FitError, match='not a function of temperature') as refused:
        fit(sources, OPTIONS)
    pattern = r'at ([\d.]+) s the sensor jumped by \+([\d.]+) mg along gravity'
    jumps = re.findall(pattern, str(refused.value))
    # The message counts from the first sample, which is 1.5 s after time 0 of the log.
    assert [float(at) for at, _ in jumps] == pytest.approx([365.4, 465.4, 511.6], abs=0.2)
    assert [float(size) for _, size in jumps] == pytest.approx([20.0, 17.0, 2.0], abs=4.0)


@pytest.mark.slow
def test_the_bias_slope_of_the_freezer_run_before_its_jumps_is_that_of_the_norm(real_data, work):
    topics = Topics(part=BagPart(47.5, 358.5))
    result = fit(fit_sources([freezer_bag(real_data, work)], topics)[0], OPTIONS)
    z = result.calibration.static.z
    # The slope of |a| over temperature is 1.61 mg/K from 36 to 15 degC.
    slope = np.diff(z.bias_function.value(np.array([-4.0, 14.0])))[0] / 18.0 / MG
    assert slope == pytest.approx(1.61, abs=0.2)
    assert result.residuals[-1].fitted.rms / MG < 0.75


@pytest.mark.slow
@pytest.mark.parametrize(
    ('length', 'n_sets', 'sets', 'drift', 'mg'),
    [(71.0, 2, (0, 1), 2.1, 0.19), (284.0, 5, (0, 3), 2.5, 0.8)],
)
def test_the_error_of_the_freezer_run_on_held_out_minutes(
    real_data, work, length, n_sets, sets, drift, mg
):
    # Parts of the 1420 s after the last jump are corrected by a fit to the other parts.
    bag = freezer_bag(real_data, work)
    starts = np.arange(518.5, 1938.5, length).tolist()
    parts = [BagPart(start, start + length) for start in starts]
    raw, left = [], []
    for first in sets:
        held_out = parts[first::n_sets]
        others = [Topics(part=part) for part in parts if part not in held_out]
        seen = [fit_sources([bag], topics)[0][0] for topics in others]
        calibration = fit(seen, OPTIONS).calibration
        for part in held_out:
            # The freezer was knocked, so some parts have no minute at rest.
            with suppress(RecordingError):
                judged = evaluate([bag], [('unit', calibration)], topics=Topics(part=part))
                windows = judged.judgements['unit'].windows
                raw += np.linalg.norm(windows.mean, axis=1).tolist()
                left += windows.residual.tolist()
    assert len(raw) >= 17 * len(sets) // n_sets
    # The constants are undetermined in one attitude, so compare the sd of |a|.
    assert np.std(raw) / MG == pytest.approx(drift, abs=0.2)
    # Means over 60 s have 0.19 mg of noise; the first of 5 parts is outside the temperature range.
    assert np.sqrt(np.mean(np.square(left))) / MG == pytest.approx(mg, rel=0.35)


@pytest.mark.slow
def test_the_gyroscope_error_of_the_freezer_run_in_215_s_held_out(real_data, work):
    bag = freezer_bag(real_data, work)
    # The parts exclude knocks of the freezer (860 and 1134 s) and the time up to the last jump.
    parts = [BagPart(518.5, 638.5), BagPart(860.5, 1130.5), BagPart(1134.5, 1938.5)]
    seen = [fit_sources([bag], Topics(part=part))[0][0] for part in parts]
    calibration = fit(seen, OPTIONS).calibration
    held_out = Topics(part=BagPart(638.5, 853.5))
    judged = evaluate([bag], [('unit', calibration)], topics=held_out).judgements['unit'].rate
    section = judged.sections['all']
    density = np.mean(calibration.gyroscope.noise_density_rad_s_sqrt_hz)
    floor = density / np.sqrt(60.0)
    assert section.raw_rms > 1.7 * floor
    assert section.rms < 1.3 * floor
    assert 0.3 < section.ratio < 2.0
    # The data sheet states 5 mdeg/s/sqrt(Hz); sampling without anti-aliasing gives more.
    assert 30.0 < np.degrees(density) * 1e3 < 45.0


def test_no_recording_is_in_the_project():
    tracked = ran('git', 'ls-files').stdout.split()
    names = ('temp-calibration.csv', 'mk_imu', 'annotated_session.csv')
    assert not [path for path in tracked if path.rsplit('/', 1)[-1].startswith(names)]
