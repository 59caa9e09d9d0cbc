# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The judgement of a calibration: residuals known by hand, sections, windows at rest only.

"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from builders import GRAVITY, axis_set, calibration, regime_set

from thermo_comp.errors import CalibrationError, RecordingError
from thermo_comp.judging.evaluation import RAW, evaluate, joined
from thermo_comp.recording import BagWriter, Topics
from thermo_comp.unit.calibration import Calibration, Provenance, ResidualSummary
from thermo_comp.unit.gravity import MICRO_G

TOPICS = Topics()
START_NS = 1_767_225_600_000_000_000
K = 300.0
SLOPE = 2.0  # counts per K on the z axis


def resting(
    path: Path,
    temperature: float,
    *,
    minutes: float = 10.0,
    noise: float = 0.0,
    shaken_s: tuple[float, float] | None = None,
    error: float = 0.0,
    serial: str = '',
) -> Path:
    """
    Write a unit at rest, z up, at one temperature, whose z axis drifts with it.

    """
    rng = np.random.default_rng(3)
    n = round(minutes * 600.0)
    stamps = START_NS + (np.arange(n) + 1) * 100_000_000
    counts = np.zeros((n, 3))
    counts[:, 2] = K * GRAVITY + SLOPE * (temperature - 20.0) + error
    counts += noise * rng.standard_normal((n, 3))
    # What lives is never the same to the bit for long, and what is the same is not believed.
    counts[::2, 0] += 1e-9
    if shaken_s:
        seconds = (np.arange(n) + 1) * 0.1
        shaken = (seconds >= shaken_s[0]) & (seconds < shaken_s[1])
        counts[shaken] += 300.0 * rng.standard_normal((int(shaken.sum()), 3))
    with BagWriter(path, metadata={'serial': serial} if serial else None) as writer:
        readings = START_NS + np.arange(round(minutes * 60.0)) * 10**9
        celsius = temperature + 1e-7 * (np.arange(len(readings)) % 2)
        for topic in (TOPICS.board, TOPICS.case):
            writer.write_temperature(topic, readings, celsius)
        writer.write_counts(TOPICS.counts, stamps, counts)
    return path


def corrected_by(slope: float, **changes: object) -> Calibration:
    z = axis_set((0.0, slope))
    return dataclasses.replace(
        calibration(static=regime_set(z=z), dynamic=regime_set(z=z)), **changes
    )


def test_residuals_are_those_of_the_hand(tmp_path: Path) -> None:
    # 10 K above the reference the z axis reads 20 counts too much: 20 / 300 m/s^2.
    bag = resting(tmp_path / 'bag', 30.0)
    result = evaluate(
        bag,
        [
            ('right', corrected_by(SLOPE)),
            ('half', corrected_by(SLOPE / 2)),
            ('none', calibration()),
        ],
    )
    drift = SLOPE * 10.0 / K
    assert list(result.residuals) == [RAW, 'right', 'half', 'none']
    # The thermometer's estimate of a steady reading is exact to 1e-7 K, 1e-9 m/s^2.
    for name, expected in ((RAW, drift), ('right', 0.0), ('half', drift / 2), ('none', drift)):
        np.testing.assert_allclose(result.residuals[name], expected, atol=1e-9)
        assert result.statistics[name]['all'].rms == pytest.approx(expected, abs=1e-9)
    assert result.counters['right'].n_out == 6000
    assert result.findings == ()
    np.testing.assert_allclose(result.board, 30.0, rtol=0.0, atol=1e-6)


def test_gravity_is_that_of_the_place(tmp_path: Path) -> None:
    bag = resting(tmp_path / 'bag', 20.0)
    elsewhere = evaluate(bag, [('a', calibration())], gravity=GRAVITY + 1e-3)
    np.testing.assert_allclose(elsewhere.residuals['a'], -1e-3, atol=1e-9)


def test_only_windows_at_rest_are_judged(tmp_path: Path) -> None:
    bag = resting(tmp_path / 'bag', 20.0, noise=0.3, shaken_s=(201.0, 222.0))
    result = evaluate(bag, [('a', calibration())])
    # Windows of 10 s; those that touch 201..222 s are out, as are the cells next to the shaking.
    inside = (result.time > 200.0) & (result.time < 230.0)
    assert not inside.any()
    assert len(result.time) >= 55
    # 0.3 counts of noise over 100 samples: 0.1 mm/s^2 per window.
    assert result.statistics['a']['all'].rms < 3.0 * 0.3 / K / 10.0


def test_noise_is_claimed_as_it_is(tmp_path: Path) -> None:
    # White noise of sd 0.3 counts at 10 Hz, and a calibration that knows it.
    density = 0.3 / K * np.sqrt(0.1)
    unit = dataclasses.replace(calibration().unit, cycle_time_s=0.1)
    knows = calibration(unit=unit, noise_density_m_s2_sqrt_hz=(density,) * 3)
    result = evaluate(resting(tmp_path / 'bag', 20.0, minutes=40.0, noise=0.3), [('a', knows)])
    ratio = result.residuals['a'] / result.claimed_sd
    # 240 windows: the RMS of a standard normal is 1 within 3 / sqrt(2 * 240).
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.14)


def test_a_longer_window_averages(tmp_path: Path) -> None:
    bag = resting(tmp_path / 'bag', 20.0, noise=0.3)
    ten = evaluate(bag, [('a', calibration())]).statistics['a']['all']
    sixty = evaluate(bag, [('a', calibration())], window_s=60.0).statistics['a']['all']
    assert sixty.rms < ten.rms


def test_a_calibration_that_makes_it_worse_is_found(tmp_path: Path) -> None:
    bag = resting(tmp_path / 'bag', 30.0)
    (finding,) = evaluate(bag, [('wrong', corrected_by(-SLOPE))]).findings
    assert 'it makes |g| worse' in finding


def test_a_unit_that_has_drifted_is_found(tmp_path: Path) -> None:
    fitted = Provenance(
        residuals=(ResidualSummary('static', 100, 1e-2, 10 * MICRO_G, 30 * MICRO_G),)
    )
    knows = corrected_by(SLOPE, provenance=fitted)
    # 0.3 counts on 1 g: 102 ug, ten times what the fit left.
    drifted = resting(tmp_path / 'drifted', 30.0, error=0.3)
    (finding,) = evaluate(drifted, [('old', knows)]).findings
    assert finding.startswith('static: 102 ug RMS, the fit left 10; ')
    assert evaluate(resting(tmp_path / 'as-new', 30.0), [('old', knows)]).findings == ()


def test_refusals(tmp_path: Path) -> None:
    bag = resting(tmp_path / 'bag', 20.0, minutes=1.0, serial='T-9')
    with pytest.raises(ValueError, match='`calibrations` must hold at least one'):
        evaluate(bag, [])
    with pytest.raises(ValueError, match='`window_s` must be positive, got 0'):
        evaluate(bag, [('a', calibration())], window_s=0.0)
    with pytest.raises(CalibrationError, match='is of unit T-1'):
        evaluate(bag, [('a', calibration())])
    with pytest.raises(RecordingError, match='no window of 600 s at rest'):
        evaluate(bag, [('a', calibration())], window_s=600.0, serial='')


def test_several_recordings_are_judged_as_one(tmp_path: Path) -> None:
    models = [('a', corrected_by(SLOPE))]
    parts = [
        evaluate(resting(tmp_path / name, at, error=error), models)
        for name, at, error in (('one', 20.0, 0.3), ('two', 30.0, -0.3))
    ]
    whole = joined(parts, models[0][1])
    # +102 ug in the one, -102 ug in the other: nothing on average, 102 ug RMS.
    row = whole.statistics['a']['all'].micro_g
    assert row.n == sum(part.statistics['a']['all'].n for part in parts)
    assert row.mean == pytest.approx(0.0, abs=0.5)
    assert row.rms == pytest.approx(0.3 / K / MICRO_G, rel=1e-3)
    assert whole.counters['a'].n_out == sum(part.counters['a'].n_out for part in parts)


def test_what_the_judgement_does_not_reach_is_said(tmp_path: Path) -> None:
    knows = corrected_by(SLOPE)
    lower, upper = knows.static.temperature_range_c
    (unsaid,) = evaluate(resting(tmp_path / 'in', 20.0), [('a', knows)]).notes
    assert 'does not say what its fit left' in unsaid
    outside, _ = evaluate(resting(tmp_path / 'out', upper + 2.0), [('a', knows)]).notes
    assert outside.startswith(f'100% of the windows lie outside the calibrated {lower:.1f}..')
