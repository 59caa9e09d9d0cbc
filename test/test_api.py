# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Corrections and fits of arrays in Python equal those of the commands."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from builders import GRAVITY, calibration, rich_calibration, thermal_calibration
from conftest import ROOT
from readme_helpers import FENCE, README
from test_layers import loaded_after

import thermo_comp as tc
from thermo_comp.convert.readers import read_log
from thermo_comp.judging.evaluation import open_bags
from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.recording.writer import BagWriter
from thermo_comp.replay import replay


@pytest.fixture(scope='module')
def fitted():
    bags = sorted((ROOT / 'bags' / 'fit').glob('*.mcap'))[:3]
    return tc.fit(bags, gravity=9.80665, model='golovach')


@pytest.fixture
def arrays(rng):
    """Make samples of 2 min at 10 Hz, with a reading of each thermometer every tenth sample."""
    time_s = np.arange(1200) * 0.1
    given = np.arange(1200) % 10 == 0
    board = np.where(given, 20.0 + 0.01 * time_s + rng.normal(0.0, 0.01, 1200), np.nan)
    case = np.where(given, 20.5 + 0.02 * time_s + rng.normal(0.0, 0.01, 1200), np.nan)
    counts = rng.normal([5.0, -3.0, 2940.0], 2.0, (1200, 3)).round()
    return {'time_s': time_s, 'counts': counts, 'board': board, 'case': case}


def test_importing_the_package_loads_no_large_library():
    heavy = ('numpy', 'scipy', 'yaml', 'rosbags', 'mcap', 'matplotlib')
    assert loaded_after('import thermo_comp', *heavy) == []
    assert all(getattr(tc, name) is not None for name in tc.__all__)
    with pytest.raises(AttributeError, match="'thermo_comp' has no attribute 'lode'"):
        _ = tc.lode


def test_arrays_have_the_bits_of_a_replayed_bag(tmp_path, fitted):
    bag = ROOT / 'bags' / 'held_out.mcap'
    recording = tc.read(bag)
    out = fitted.correct(recording.time_s, recording.counts, **recording.temperatures)
    result = replay(bag, fitted, tmp_path / 'out.mcap')
    topics = Topics(imu='imu/data_raw', input='imu')
    written = read_recording(tmp_path / 'out.mcap', topics, require=['accel']).columns
    np.testing.assert_array_equal(out.specific_force, written.accel)
    covariance = written.imu.linear_acceleration_covariance
    np.testing.assert_array_equal(out.covariance.reshape(-1, 9), covariance)
    assert out.counters == result.counters
    stamps = recording.start_ns + np.rint(recording.time_s * 1e9).astype(np.int64)
    np.testing.assert_array_equal(stamps, written.accel_stamp_ns)
    changes = np.flatnonzero(np.diff(out.dynamic)) + 1
    switches = [stamp for stamp, _ in result.switches[1:]]
    np.testing.assert_array_equal(changes, np.searchsorted(stamps, switches))


def test_readings_of_5000_times_or_of_a_further_thermometer_are_used(rng, arrays):
    # WHY: `correct` queued all readings ahead of the samples; the full queue lost some readings.
    time_s = np.arange(5000) * 0.1
    readings = {name: 20.0 + rng.normal(0.0, 0.01, 5000) for name in ('board', 'case')}
    counts = rng.normal([5.0, -3.0, 2940.0], 2.0, (5000, 3)).round()
    counters = rich_calibration().correct(time_s, counts, **readings).counters
    assert (counters.n_board, counters.n_case) == (5000, 5000)
    assert (counters.n_board_rejected, counters.n_case_rejected) == (0, 0)
    unit = replace(calibration(), sensors=('case', 'lid'))
    out = unit.correct(**arrays, lid=arrays['case'] + 1.0)
    assert np.isfinite(out.specific_force).all()
    assert np.linalg.norm(out.specific_force.mean(axis=0)) == pytest.approx(GRAVITY, rel=1e-3)


def test_equal_readings_in_any_form_give_equal_output(arrays):
    unit = rich_calibration()
    out = unit.correct(**arrays)
    pairs, filled = dict(arrays), dict(arrays)
    for name in ('board', 'case'):
        here = ~np.isnan(arrays[name])
        pairs[name] = (arrays['time_s'][here], arrays[name][here])
        filled[name] = np.repeat(arrays[name][here], 10)
    lists = {name: value.tolist() for name, value in arrays.items()}
    since = (arrays['time_s'] * 1e9).round().astype('timedelta64[ns]')
    dates = np.datetime64('2026-03-01T12:00', 'ns') + since

    class Column:
        def __init__(self, value):
            self.value = value

        def __array__(self, dtype=None, copy=None):
            return np.array(self.value, dtype=dtype)

    columns = {name: Column(value) for name, value in arrays.items()}
    for given in (pairs, filled, lists, {**arrays, 'time_s': dates}, columns):
        same = unit.correct(**given)
        np.testing.assert_array_equal(same.specific_force, out.specific_force)
        np.testing.assert_array_equal(same.covariance, out.covariance)


def test_unusable_samples_give_rows_of_nan_and_empty_arrays_give_empty_arrays(arrays):
    counts = arrays['counts'].copy()
    counts[7, 1], counts[9, 2] = np.nan, 32767.0
    board = np.where(arrays['time_s'] < 0.55, np.nan, arrays['board'])
    out = thermal_calibration().correct(arrays['time_s'], counts, board=board, case=arrays['case'])
    assert np.isnan(out.specific_force[:10]).all()
    assert np.isnan(out.covariance[:10]).all()
    assert np.isfinite(out.specific_force[10:]).all()
    assert (out.counters.n_no_temperature, out.counters.n_out) == (10, 1190)
    late = thermal_calibration().correct(arrays['time_s'], counts, board=arrays['board'])
    assert np.flatnonzero(np.isnan(late.specific_force[:, 0])).tolist() == [7, 9]
    assert (late.counters.n_not_finite, late.counters.n_saturated) == (1, 1)
    # Without case readings the dynamic regime begins at the same sample as with them, or later.
    assert late.dynamic.any()
    assert np.argmax(late.dynamic) >= np.argmax(out.dynamic)
    out = thermal_calibration().correct([], np.empty((0, 3)), board=[])
    assert (out.specific_force.shape, out.covariance.shape) == ((0, 3), (0, 3, 3))
    assert out.dynamic.shape == (0,)
    dates = np.array(['2026-01-01T00:00:00', '2026-01-01T00:00:10'], 'M8[ns]')
    unread = thermal_calibration().correct(dates, np.ones((2, 3)), board=([], []))
    assert np.isnan(unread.specific_force).all()
    assert unread.counters.n_no_temperature == 2


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        ({'time_s': [[0.0, 1.0]]}, r'`time_s` must have one dimension, got the shape \(1, 2\)'),
        ({'time_s': [0.0, 1.0, 1.0]}, r'`time_s` must rise, got 1.0 at index 1 and then 1.0'),
        ({'time_s': [0.0, np.nan, 2.0]}, 'be finite seconds, or datetime64, got nan at index 1'),
        ({'time_s': [0, 10**18, 2 * 10**18]}, r'must be finite seconds, .* got 1e\+18 at index 1'),
        ({'time_s': ['a', 'b', 'c']}, r'`time_s` must be numbers: could not convert'),
        ({'time_s': np.array(['2026-01-01', 'NaT', '2026-01-03'], 'M8')}, 'got NaT at index 1'),
        ({'counts': np.zeros((2, 3))}, r'`counts` must have the shape \(3, 3\), .* got \(2, 3\)'),
        ({'counts': np.zeros((3, 2))}, r'`counts` must have the shape \(3, 3\), .* got \(3, 2\)'),
        ({'board': [20.0, 20.0]}, r'`board` must have a value for each of the 3 times'),
        ({'board': ([0.0, 1.0], [20.0])}, r'`board` must have as many values as times, 2'),
        ({'board': ([1.0, 0.0], [20.0, 20.0])}, r'`board time_s` must rise, got 1.0 at index 0'),
        ({'board': (np.array(['2026-01-01'], 'M8[ns]'), [20.0])}, 'be seconds or datetime64, as'),
        ({'lid': [20.0] * 3}, r'`lid` is not a thermometer of the calibration, which has board'),
    ],
)
def test_wrong_arguments_are_named(change, text):
    given = {'time_s': [0.0, 1.0, 2.0], 'counts': np.ones((3, 3)), 'board': [20.0] * 3, **change}
    with pytest.raises(ValueError, match=text):
        calibration().correct(**given)


def test_a_fit_of_arrays_equals_the_fit_of_their_bags(tmp_path, fitted):
    recordings = [tc.read(bag) for bag in sorted((ROOT / 'bags' / 'fit').glob('*.mcap'))[:3]]
    again = tc.fit(recordings, gravity=9.80665, model='golovach')
    assert again.unit.serial == 'demo-0007'
    assert replace(again, provenance=fitted.provenance) == fitted
    tc.save(again, tmp_path / 'unit.yaml')
    assert tc.load(tmp_path / 'unit.yaml') == again
    recordings[0].time_s[2] = recordings[0].time_s[1]
    with pytest.raises(ValueError, match=r'`time_s` must rise, got 3.0 at index 1 and then 3.0'):
        tc.fit(recordings, gravity=9.80665)


def test_the_python_code_of_the_readme_runs(tmp_path, fitted, monkeypatch):
    (snippet,) = (body for kind, body in FENCE.findall(README) if kind == 'python')
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    tc.save(fitted, tmp_path / 'unit.yaml')
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(snippet, names)  # noqa: S102 - our own page
    assert names['out'].specific_force.shape == (15407, 3)


def test_tc_read_reads_a_table_by_its_headings(tmp_path):
    table = tmp_path / 'log.csv'
    rows = [f'{k / 50},{k % 3 / 100},0.02,{9.8 + 0.01 * (k % 2)},{20 + k // 100}'
            for k in range(300)]  # fmt: skip
    table.write_text('\n'.join(['time_s,ax,ay,az,temperature_c', *rows]))
    content = tc.read(table)
    np.testing.assert_allclose(np.diff(content.time_s), 0.02, atol=1e-9)
    np.testing.assert_allclose(content.counts[1], [0.01, 0.02, 9.81], rtol=1e-12)
    assert content.temperatures['board'][1].tolist() == [20.0, 21.0, 22.0]
    with pytest.raises(ValueError, match='`imu` does not apply to a table, which takes `columns`'):
        read_log(table, imu=1)


def test_arrays_that_cannot_be_fitted_and_doubled_bags_are_refused(tmp_path):
    columns = tc.Columns(np.arange(5.0), np.zeros((4, 3)), {})
    with pytest.raises(ValueError, match=r'must have the shape \(5, 3\), .* got \(4, 3\)'):
        tc.fit(columns, gravity=9.8)
    with pytest.raises(tc.ThermoCompError, match=r'gravity 0 m/s\^2 is not found on Earth'):
        tc.fit([], gravity=0.0)
    with pytest.raises(tc.ThermoCompError, match='no bag was given'):
        tc.fit([], gravity=9.8)
    for name in ('groups', 'forced', 'allow'):
        with pytest.raises(ValueError, match=f"`{name}` must be a list of names, got 'curve'"):
            tc.fit([], gravity=9.8, **{name: 'curve'})
    with pytest.raises(ValueError, match=r"`prior` must be a Calibration, .* got 'a\.yaml'"):
        tc.fit([], gravity=9.8, prior='a.yaml')
    bag = ROOT / 'bags' / 'fit' / '01.mcap'
    copy = shutil.copy(bag, tmp_path / 'copy.mcap')
    for take in (lambda bags: tc.fit(bags, gravity=9.80665), open_bags):
        with pytest.raises(tc.ThermoCompError, match=r'copy\.mcap: has the same content'):
            take([bag, copy])


def test_tc_read_keeps_the_known_force_of_a_bag_and_refuses_to_fit_a_rotation(tmp_path):
    source = read_recording(ROOT / 'bags' / 'held_out.mcap').columns
    for number, facts in enumerate(
        (
            {'specific_force_magnitude_m_s2': '29.4'},
            {'rotation_topic': '/table', 'radius_m': '0.5'},
        )
    ):
        with BagWriter(tmp_path / f'{number}.mcap', metadata=facts) as writer:
            writer.write_counts('/accel/counts', source.accel_stamp_ns, source.accel, 'imu_link')
    assert tc.read(tmp_path / '0.mcap').specific_force == '29.4'
    with pytest.raises(ValueError, match='rotation_topic /table'):
        tc.fit(tc.read(tmp_path / '1.mcap'), gravity=GRAVITY)
