# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings that other people made: what docs/real_data.md claims, held by the numbers behind it.

Skipped with a reason where the recordings are absent; the limits are those that were asked for
before anything was fitted.

"""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / 'benchmarks'))

from recorded.data import freezer_bag
from recorded.faces import read_faces
from recorded.freezer import coarser, forecast, interleaved, ours, peers, read_freezer, track
from recorded.handheld import read_handheld
from recorded.null import freezer_under_another_unit, small_spans, wrong_units

from thermo_comp.cli.app import run


@pytest.fixture(scope='module')
def work(tmp_path_factory):
    return tmp_path_factory.mktemp('recorded')


@pytest.fixture(scope='module')
def bag(real_data, work):
    return freezer_bag(real_data, work)


@pytest.fixture(scope='module')
def freezer(real_data, bag):
    return read_freezer(real_data, bag)


@pytest.fixture(scope='module')
def units(real_data, work):
    return {unit: read_handheld(real_data, work, unit, jackknife=False) for unit in range(3)}


def test_jumps_are_found_with_time_and_size(freezer):
    # Read off the plain plot of |a|: some +20 mg at 366 s and +17 mg at 468 s, means of 2 s.
    first, second, third = freezer.pose.events
    assert all(event.kind == 'jump' for event in freezer.pose.events)
    assert first.time + freezer.origin_s == pytest.approx(366.5, abs=1.0)
    assert second.time + freezer.origin_s == pytest.approx(467.0, abs=1.0)
    assert first.along / freezer.per_mg == pytest.approx(20.0, abs=4.0)
    assert second.along / freezer.per_mg == pytest.approx(17.0, abs=4.0)
    # A third one, across gravity, that |a| hardly shows.
    assert third.time + freezer.origin_s == pytest.approx(513.2, abs=0.5)
    assert np.hypot(*third.step[:2]) / freezer.per_mg == pytest.approx(19.0, abs=3.0)


@pytest.mark.parametrize('which', ['refusal', 'full_refusal'])
def test_whole_run_is_refused_with_that_reason(freezer, which):
    said = getattr(freezer, which)
    jumps = re.findall(r'at ([\d.]+) s the sensor jumped by \+([\d.]+) mg along gravity', said)
    # Times from the first sample, 1.5 s after the log's zero.
    assert [float(at) for at, _ in jumps] == pytest.approx([365.4, 465.4, 511.6], abs=0.2)
    assert [float(size) for _, size in jumps] == pytest.approx([20.0, 17.0, 2.0], abs=4.0)
    assert 'without motion' in said
    assert 'not a function of temperature' in said


def test_branches_have_their_own_slopes(freezer):
    first, second, third, last = freezer.fits
    middle = np.array([20.0, 30.0])
    slope = np.diff(first.model.reading(middle))[0] / 10.0 / freezer.per_mg
    assert slope == pytest.approx(1.61, abs=0.15)
    assert last.model.coefficients[1] / freezer.per_mg == pytest.approx(-1.04, abs=0.15)
    for short in (second, third):
        assert 'too small' in short.refusal


@pytest.mark.parametrize('shift_s', [0.0, 5.0, 10.0, 15.0])
def test_interleaved_blocks(freezer, shift_s):
    found, models = ours(freezer, interleaved(freezer, shift_s), extend=True)
    assert found.rms / freezer.per_mg <= 0.75
    # Some 150 means: a coverage of 95 % has an sd of 1.8 %.
    assert found.coverage > 0.90
    assert found.normalised_rms < 1.1
    assert all(model.order == 2 for model in models)


def test_later_part(freezer):
    found, (model,) = ours(freezer, forecast(freezer), extend=True)
    assert found.rms / freezer.per_mg <= 0.85
    assert found.coverage > 0.93
    assert found.normalised_rms < 1.1
    assert model.order == 1


def test_peers_do_not_do_better_on_the_blocks(freezer):
    split = interleaved(freezer)
    mine = ours(freezer, split, extend=True)[0].rms / freezer.per_mg
    theirs = peers(freezer, split, extend=True)
    assert theirs['no correction'] > 8.0
    assert mine < min(theirs.values())


def test_thermometer_beats_the_raw_reading(freezer):
    tracked = track(freezer)
    for low, high in ((49.0, 120.0), (120.0, 364.0), (520.0, 1200.0), (1200.0, 1940.0)):
        raw, estimate, sd, largest = tracked.errors(low, high)
        # One reading is off by 90 mK; the reference itself by some 10 mK, more in the onset.
        assert estimate < 0.5 * raw
        assert largest < 0.1
        assert estimate < 2.0 * sd
    assert tracked.switches()[0][0] < 49.0


def test_regime_sees_plateau_and_reversal(freezer):
    switches = track(freezer, coarser(freezer.pose.detector, 0.3)).switches()
    assert [name for _, name in switches] == ['dynamic', 'static', 'dynamic']
    # It cools by less than 0.3 K/min from about 1000 s on, and is taken out at 1942..1945 s.
    assert 1000.0 < switches[1][0] < 1800.0
    assert 1942.0 < switches[2][0] < 1955.0


@pytest.mark.parametrize('unit', [0, 1, 2])
def test_handheld_units(units, unit):
    found = units[unit]
    assert 20 <= len(found.intervals) <= 22
    assert found.ours.has_misalignment
    assert 0.45 < found.in_sample[0] < 0.60
    assert found.ratio <= 1.05
    assert np.abs(found.pulls).max() < 1.0


def test_six_faces(real_data, work):
    faces = read_faces(real_data, work)
    assert faces.n_positions == 6
    assert not faces.fit.has_misalignment
    # Faces are level within a degree or two: 0.05 % of the scale, under a count of the bias.
    np.testing.assert_allclose(faces.fit.scale, faces.by_hand_scale, rtol=1e-3)
    np.testing.assert_allclose(faces.fit.bias, faces.by_hand_bias, atol=1.0)
    assert faces.fit.advice == (faces.refusal,)
    assert 'add positions between the faces' in faces.refusal


def test_small_spans_change_nothing(bag, capsys):
    for _, said in small_spans(bag):
        assert 'is too small, need 3' in said
    before = sorted(bag.parent.iterdir())
    assert run(['partial', str(bag), '--from', '1200', '--to', '1900']) == 1
    assert re.search(r'temperature span 1\.\d degC is too small', capsys.readouterr().err)
    output = bag.parent / 'none.yaml'
    assert run(['fit', str(bag), '-o', str(output), '--gravity', '9.80665']) == 1
    assert sorted(bag.parent.iterdir()) == before


def test_wrong_unit_is_noticed(bag, units, work):
    two = {unit: units[unit] for unit in (0, 1)}
    for found in wrong_units({unit: work / f'handheld{unit}.mcap' for unit in two}, two, work):
        assert found.is_valid == (found.data == found.calibration)
    assert not freezer_under_another_unit(bag, units[0]).is_valid


def test_page_is_skipped_with_a_reason_where_the_data_are_absent(tmp_path):
    finished = subprocess.run(
        [sys.executable, ROOT / 'benchmarks' / 'real_data.py', '--docs', tmp_path],
        env={'THERMO_COMP_DATA': str(tmp_path / 'nowhere'), 'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert 'skipped: the recordings are not in' in finished.stdout
    assert list(tmp_path.iterdir()) == []


def test_no_recording_is_in_the_project():
    # Only plots and numbers: no file of the project holds a row of the freezer run.
    tracked = subprocess.run(
        ['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
    ).stdout.split()
    names = ('temp-calibration.csv', 'mk_imu', 'annotated_session.csv')
    assert not [path for path in tracked if path.rsplit('/', 1)[-1].startswith(names)]
