# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Updates by rests agree with true parameters, with a Kalman filter and with closed formulas."""

from dataclasses import replace

import field_units
import numpy as np
import pytest
from builders import rich_calibration
from conftest import ROOT, parsed
from field_helpers import in_any_attitude, jump_of, no_error, precise, rests, upright, write_log

from thermo_comp.errors import FitError
from thermo_comp.field.ageing import Ageing, Model, learn, rows_of, solve
from thermo_comp.field.series import read_rests, series_of
from thermo_comp.field.update import change_texts, refuse_another_unit, update
from thermo_comp.fitting.assembly import parameters_of, with_parameters
from thermo_comp.thermal.lags import Lag, start_root
from thermo_comp.thermal.state import StateLayout
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import load_calibration, save_calibration
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.gravity import MICRO_G
from thermo_comp.unit.provenance import Provenance


def test_derivatives_of_a_rest_by_all_parameters_agree_with_finite_differences():
    # The rests are in a ramp, so that every column and both coefficient sets have an effect.
    unit = rich_calibration()
    logged = rests(unit, in_any_attitude, no_error, days=1, rate=0.5 / 60.0)
    series = series_of(logged, unit)
    values, scale = parameters_of(unit), np.array([axis.scale_factor for axis in unit.axes])
    covariance = unit.posterior.covariance()
    layout = parameter_layout(unit)
    levels = {level for block in layout.scale for level in (block.static, block.dynamic)}
    levels |= {block.static for block in layout.bias}
    # Test every second parameter: as blocks have odd lengths, bias or scale covers each kind.
    for k in range(0, layout.n_parameters, 2):
        step = 1e-7
        moved = values.copy()
        if k in levels:  # the derivatives by an axis's scale factor K are tested below
            continue
        moved[k] += step
        residual = series_of(logged, with_parameters(unit, scale, moved, covariance)).residual
        slope = (series.residual - residual) / step
        assert np.allclose(slope, series.by_parameter[:, k], atol=2e-4 * abs(slope).max() + 1e-9)
    for axis, block in enumerate(layout.scale):
        factor = np.where(np.arange(3) == axis, 1.0 + 1e-6, 1.0)
        changed = with_parameters(unit, scale * factor, values, covariance)
        slope = (series.residual - series_of(logged, changed).residual) / 1e-6
        assert np.allclose(slope, series.by_level[:, axis + 3] * unit.gravity_m_s2, atol=1e-4)
        both = series.by_parameter[:, [block.static, block.dynamic]].sum(axis=1)
        # A relative change of K changes |f| like an equal change of both regimes' scale levels.
        assert np.allclose(slope, both, atol=0.02 * abs(slope).max())


def test_an_update_with_the_true_variances_equals_a_kalman_filter():
    process = field_units.Process()
    history = field_units.live('carried', 3, 6, process)
    unit = field_units.calibration()
    series = series_of(history.rests, unit)
    best = field_units.BestFilter(process)
    for k in range(len(series)):
        # The mean of the rests in row k of `series` is one measurement of the Kalman filter.
        first = int(series.n_windows[:k].sum())
        windows = [r for _, r in history.rests[first : first + int(series.n_windows[k])]]
        mean = np.mean([window.mean for window in windows], axis=0) / field_units.K
        warmth = series.temperature[k] - field_units.REFERENCE_C
        variance = field_units.NOISE**2 / (10.0 * len(windows))
        now = history.rests[first][0].start_ns / 86400e9 - field_units.DAY_ZERO
        best.take(now, int(series.start[k]), mean, warmth, variance)
    ageing = Ageing(process.bias, process.scale * field_units.G, process.turn_on, 1e-9)
    rows = rows_of(series, 1e-9)
    to_file = np.zeros((parameter_layout(unit).n_parameters, 6))
    layout = parameter_layout(unit)
    for axis, (bias, scale) in enumerate(zip(layout.bias, layout.scale, strict=True)):
        to_file[[bias.static, bias.dynamic], axis] = field_units.K
        to_file[[scale.static, scale.dynamic], axis + 3] = 1.0 / field_units.G
    model = Model(rows, unit, float(field_units.DAY_ZERO))
    solved = solve(model, ageing, to_file, np.zeros((len(to_file), 3)), 0.0)
    for axis in range(3):
        bias, scale = layout.bias[axis].static, layout.scale[axis].static
        sd = np.sqrt(solved.posterior[bias, bias]) / field_units.K
        expected = best.state[axis] + best.state[15 + axis]
        # The update averages the rests of a turn-on to a few rows: results change by < 0.2 sd.
        assert abs(solved.shift[bias] / field_units.K - expected) < 0.2 * sd
        P = best.P[np.ix_([axis, 15 + axis], [axis, 15 + axis])].sum()
        assert sd == pytest.approx(np.sqrt(P), rel=0.1)
        expected = best.state[6 + axis] + best.state[18 + axis]
        assert abs(solved.shift[scale] - expected) < 0.2 * np.sqrt(solved.posterior[scale, scale])


def test_updates_of_ageing_units_have_small_errors_of_at_most_1_4_claimed_sd_rms():
    # Units on level and on carried platforms age by random walks, turn-on offsets and one shock.
    squares, ratios = [], []
    for kind, seed in (('level', 1), ('level', 2), ('level', 4), ('carried', 1)):
        history = field_units.live(kind, seed, 30, field_units.Process(shock_day=11.5))
        unit = field_units.calibration()
        updated = update(series_of(history.rests, unit), unit)
        assert updated.judged.is_better
        before, truth = history.states[10], history.states[-1]
        jumps = [change.time for change in updated.changes if change.time is not None]
        shock = history.states[11][15:18] - before[15:18]
        if np.abs(shock[2:] if kind == 'level' else shock).max() > 200 * MICRO_G:
            (jump,) = jumps
            assert jump - field_units.DAY_ZERO == pytest.approx(11.5, abs=0.7)
        force = field_units.G * np.array([[0.0, 0.0, 1.0]])
        counts = field_units.measured(force, np.zeros(1), truth)[0] * field_units.K
        start, rest = history.rests[-1]
        thermal = (field_units.REFERENCE_C, *rest.state[1:])
        last = [(start, replace(rest, mean=tuple(counts), state=thermal))]
        after, new = series_of(last, unit), series_of(last, updated.calibration)
        squares.append((float(after.residual[0]), float(new.residual[0])))
        ratios.append(float(new.residual[0] / new.claim[0]))
        if kind == 'level':
            assert abs(updated.ageing.turn_on / (20 * MICRO_G) - 1.0) < 0.5
    before, left = np.sqrt(np.mean(np.square(squares), axis=0)) / MICRO_G
    # A Kalman filter with the true variances has errors of 12 to 14 ug RMS (benchmarks/field.py).
    assert before > 100.0
    assert left < 30.0
    assert np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_an_update_does_not_change_the_constants_of_axes_that_no_rest_observes():
    unit = precise()
    updated = update(series_of(rests(unit, upright, jump_of(300.0, 10.0)), unit), unit)
    new = updated.calibration
    assert [axis.is_determined for axis in updated.axis_changes] == [False, False, True]
    assert (new.axes.x, new.axes.y) == (unit.axes.x, unit.axes.y)
    assert new.axes.z != unit.axes.z
    # In one attitude a shock of the bias and a change of gravity change |f| - g alike.
    assert [change.may_be_gravity for change in updated.changes] == [True]
    assert 'or gravity changed' in ' '.join(change_texts(updated))
    assert updated.axis_changes[2].reading == pytest.approx(300.0 * MICRO_G, abs=15.0 * MICRO_G)
    layout = parameter_layout(unit)
    old, aged = (np.diag(each.posterior.covariance()) for each in (unit, new))
    assert aged[layout.bias[0].static] > old[layout.bias[0].static]


def test_a_jump_is_distinguished_from_ageing(rng):
    unit = precise()
    jumped = update(series_of(rests(unit, upright, jump_of(300.0, 10.0)), unit), unit)
    (change,) = jumped.changes
    first = series_of(rests(unit, upright, no_error), unit).time[0]
    assert change.time == pytest.approx(first + 10.0, abs=0.4)
    assert jumped.ageing.bias < 10.0 * MICRO_G
    steps = 60.0 / np.sqrt(3.0) * MICRO_G * rng.standard_normal((90, 3))
    walked = np.cumsum(steps, axis=0)
    aged = update(series_of(rests(unit, upright, lambda d: walked[round(3 * d)], 30), unit), unit)
    assert aged.changes == ()
    assert np.hypot(aged.ageing.bias, aged.ageing.scale) == pytest.approx(60.0 * MICRO_G, rel=0.4)


def test_the_sd_of_an_old_calibration_aged_to_the_last_rest_includes_the_random_walk(rng):
    # After 30 days a random walk of 60 ug per root day has an sd of 329 ug.
    unit = precise()
    walk = np.cumsum(60.0 / np.sqrt(3.0) * MICRO_G * rng.standard_normal((90, 3)), axis=0)
    logged = rests(unit, upright, lambda day: walk[round(3 * day)], 30)
    x, y, z = update(series_of(logged, unit), unit).axis_changes
    # The bias sd of x is 10 ug; at 1 g the bias and the scale of z each contribute 10 ug.
    residual = unit.static.x.residual_sd_m_s2
    assert x.claimed_sd == pytest.approx(np.hypot(10.0 * MICRO_G, residual), rel=0.01)
    assert z.claimed_sd == pytest.approx(np.hypot(np.sqrt(200.0) * MICRO_G, residual), rel=0.01)
    # The ageing model gives half to all of the random walk's variance to the biases of x and y.
    for axis in (x, y):
        assert 0.5 < axis.present_sd / (329.0 * MICRO_G) < 1.5
    # At the last rest the force sd of z is |random walk of z|, within two sd of turn-ons.
    assert z.present_sd == pytest.approx(abs(walk[-1, 2]), abs=40.0 * MICRO_G)


def stepped(history, size, day):
    """Change the means of rests as if gravity grew by `size` [m/s^2] on `day`."""
    return [
        (s, replace(r, mean=tuple(np.array(r.mean) * (1.0 + size / field_units.G * (d >= day)))))
        for (s, r), d in zip(history.rests, history.day, strict=True)
    ]


@pytest.mark.parametrize('day', [15, pytest.param(0, marks=pytest.mark.slow)])
def test_a_change_of_gravity_is_not_taken_for_a_change_of_three_scales(day):
    # Bias and scale walk by 15 ug and 10 ppm per root day; from `day` on gravity is 300 ug larger.
    unit, size = field_units.calibration(), 300.0 * MICRO_G
    history = field_units.live('carried', 2, 30, field_units.Process())
    aged = update(series_of(history.rests, unit), unit)
    result = update(series_of(stepped(history, size, day), unit), unit)
    ((change, found, sd),) = result.solution.gravity
    assert change.time - field_units.DAY_ZERO == pytest.approx(day + 0.4, abs=0.5)
    # The gravity step is found only as well as the random walks of the scales permit.
    assert abs(found - size) < 4.0 * sd < 60.0 * MICRO_G
    for before, after in zip(aged.axis_changes, result.axis_changes, strict=True):
        assert after.scale == pytest.approx(before.scale, abs=30e-6)
    assert result.judged.after < 40.0 * MICRO_G
    (text,) = (line for line in change_texts(result) if 'as if gravity' in line)
    assert text.startswith('from 2026-')
    assert 'as if gravity differed from the stated 9.80665 m/s^2: no scale was changed' in text
    certain = update(series_of(stepped(history, size, day), unit), unit, is_gravity_certain=True)
    assert certain.solution.gravity == ()
    assert all(axis.scale > 150e-6 for axis in certain.axis_changes)


@pytest.mark.parametrize('kind', ['level', 'carried'])
def test_ageing_is_not_taken_for_a_change_of_gravity_or_of_the_unit(kind):
    unit = field_units.calibration()
    for seed in range(5):
        shock_day = np.inf if seed % 2 else 10.0
        history = field_units.live(kind, seed, 20, field_units.Process(shock_day=shock_day))
        result = update(series_of(history.rests, unit), unit)
        assert result.solution.gravity == ()
        assert all(change.kind == 'levels' for change in result.changes)
        assert seed % 2 == 0 or result.changes == ()
        refuse_another_unit(result)


@pytest.mark.parametrize('first', [0, 10])
def test_samples_of_another_unit_are_refused(first):
    # The second unit's scales differ by 1 to 2 %, and its biases by 0.3 to 1.4 mg.
    unit = field_units.calibration()
    history = field_units.live('carried', 3, 20, field_units.Process())
    mixed = [
        (s, replace(r, mean=tuple(np.array(r.mean) * (1.02, 0.985, 1.01) + (2.0, -4.0, 1.0))))
        if day >= first else (s, r)
        for (s, r), day in zip(history.rests, history.day, strict=True)
    ]  # fmt: skip
    result = update(series_of(mixed, unit), unit)
    with pytest.raises(FitError, match=r'at most 1 mg for this unit with ageing: samples'):
        refuse_another_unit(result)


def on_z(rest, counts):
    return replace(rest, mean=(*rest.mean[:2], rest.mean[2] + counts))


def test_a_changed_curve_is_corrected_and_the_sd_of_an_unobserved_slope_grows():
    # The slope of the z bias changes by 5 ug/K; the rests are at 15 to 25 degC.
    curved = field_units.calibration()
    unit = precise(static=curved.static, dynamic=curved.dynamic)
    logged = rests(unit, upright, no_error, days=30)
    bent = [(s, on_z(r, 300.0 * 5 * MICRO_G * (r.state[0] - 20.0))) for s, r in logged]
    result = update(series_of(bent, unit), unit)
    assert [change.time for change in result.changes] == [None]
    both = (unit, result.calibration)
    before, after = (each.static.z.bias_function.coefficients[1] / 300.0 for each in both)
    assert after - before == pytest.approx(5.0 * MICRO_G, abs=1.5 * MICRO_G)
    # Upright rests do not observe x: the sd of its bias slope grows by 1 ug/K per root year.
    series = series_of(rests(unit, upright, no_error), unit)
    result, n = update(series, unit), len(series) // 10
    span = np.sort(series.temperature)[[n, -1 - n]]
    expected = 1.0 * MICRO_G * np.sqrt(np.ptp(series.time) / 365.25) * np.ptp(span)
    assert result.axis_changes[0].curve_sd == pytest.approx(expected, rel=0.02)
    assert 0.0 < result.axis_changes[2].curve_sd < expected


def test_a_contradicting_turn_on_is_left_out_and_stamps_may_be_in_wrong_order(rng):
    unit = precise()
    logged = rests(unit, upright, jump_of(100.0, 8.0), days=15)
    bad = [(s, on_z(r, 300.0 * 0.02) if s == logged[80][0] else r) for s, r in logged]
    result = update(series_of(bad, unit), unit)
    assert result.n_outliers == 1
    assert result.axis_changes[2].reading == pytest.approx(100.0 * MICRO_G, abs=20.0 * MICRO_G)
    logged = rests(unit, upright, no_error)
    wrong = {s.start_ns: int(rng.choice((0, 0, 864e12 * rng.uniform(-1, 1)))) for s, _ in logged}
    moved = [(s, replace(r, stamp_ns=r.stamp_ns + wrong[s.start_ns])) for s, r in logged]
    solution = update(series_of(moved, unit), unit).solution
    for covariance in (solution.prior, solution.posterior):
        assert np.linalg.eigvalsh(covariance).min() > -1e-9 * np.trace(covariance)


def test_a_wrong_clock_at_the_start_of_the_node_does_not_change_the_update(tmp_path, rng):
    # The stamps of samples are right; the time of no start, all starts or the last start is wrong.
    unit = precise()
    logged = rests(unit, upright, jump_of(300.0, 10.0))
    image = {start.start_ns: int(1.6e18 + 5e8 * rng.standard_normal()) for start, _ in logged}
    last = logged[-1][0].start_ns
    expected = None
    for number, wrong in enumerate(({}, image, {last: 30 * 10**9})):
        begins = [wrong.get(s.start_ns, s.start_ns) for s, _ in logged]
        of_image = [(replace(s, start_ns=t), r) for t, (s, r) in zip(begins, logged, strict=True)]
        read, source, _ = read_rests([write_log(tmp_path / str(number), of_image)], unit)
        assert source.name.startswith('rests until 2030-01-20T23:12:40')
        updated = update(series_of(read, unit), unit)
        expected = expected or updated
        assert (updated.calibration, updated.judged) == (expected.calibration, expected.judged)


@pytest.fixture
def unit_file(tmp_path):
    path = tmp_path / 'unit.yaml'
    save_calibration(precise(provenance=Provenance(created='2029-12-31T00:00:00Z')), path)
    return path


@pytest.mark.usefixtures('no_figures')
def test_the_command_update_writes_a_better_calibration(tmp_path, unit_file, cli):
    logged = rests(load_calibration(unit_file), upright, jump_of(300.0, 10.0))
    log, new = write_log(tmp_path / 'rests', logged), tmp_path / 'new.yaml'
    finished = cli('update', unit_file, log, '-o', new)
    assert 'the rests do not determine x, y' in finished.stdout
    assert 'a shock, not ageing' in finished.stdout
    written = load_calibration(new)
    assert written.provenance.sources[-1].name == 'rests until 2030-01-20T23:12:40, claim aged 1 d'
    assert 'before: 2029-12-31' in written.provenance.notes[-1]
    assert written.provenance.date == '2030-01-20T23:12:40Z'
    assert 'from 0 bags and 1 rest log, ' in cli('info', new).stdout
    assert parsed(cli('evaluate', log, '-c', unit_file, '--json', code=1).stdout)['left']
    history = cli('report', '-c', unit_file, '-c', new, '-o', tmp_path / 'page.html', '--json')
    assert [change['constant'] for change in parsed(history.stdout)['history']][2] == 'bias z'
    assert '240 windows were used by the last update' in cli('evaluate', log, '-c', new).stdout
    again = cli('update', new, log, '-o', tmp_path / 'newer.yaml', code=1)
    assert 'has been updated with all of these rests' in again.stderr


def test_an_update_without_gain_writes_no_file(tmp_path, unit_file, cli):
    log = write_log(tmp_path / 'rests', rests(load_calibration(unit_file), upright, no_error))
    finished = cli('update', unit_file, log, '-o', tmp_path / 'new.yaml', '--json', code=3)
    data = parsed(finished.stdout)
    assert data['output'] is None
    assert data['is_better'] is False
    assert all(axis['present_sd'] >= axis['claimed_sd'] > 0.0 for axis in data['moved'][:2])
    printed = cli('update', unit_file, log, '-o', tmp_path / 'new.yaml', code=3).stdout
    assert 'sd of the correction at the last rest, with ageing: x ' in printed
    assert not (tmp_path / 'new.yaml').exists()
    assert 'recalibration interval' in cli('evaluate', log, '-c', unit_file).stdout


def test_wrong_arguments_and_logs_of_update_give_a_message(tmp_path, unit_file, cli):
    unit = load_calibration(unit_file)
    other = replace(unit, unit=replace(unit.unit, serial='T-2'))
    log = write_log(tmp_path / 'rests', rests(other, upright, no_error, days=2))
    new = ('-o', tmp_path / 'new.yaml')
    (tmp_path / 'empty').mkdir()
    for path, text in (
        (log, 'rests: no rest of unit T-1 (counts): the rests are of T-2 (counts)'),
        (tmp_path / 'empty', 'empty: no rest log: expected a folder'),
        (tmp_path / 'none', 'none: no rest log: expected a folder'),
    ):
        assert text in cli('update', unit_file, path, *new, code=1).stderr
    bag = ROOT / 'bags' / 'held_out.mcap'
    assert 'cannot be mixed with bags' in cli('evaluate', log, bag, '-c', unit_file, code=2).stderr
    # WHY: these options were ignored without a message.
    for given in (('--window', 5), ('--serial', 'u7'), ('--from', 10), ('--specific-force', '2g')):
        error = cli('evaluate', log, '-c', unit_file, *given, code=2).stderr
        assert 'rest logs take no options except --tolerance and --gravity' in error
    broken = write_log(tmp_path / 'broken', rests(unit, upright, jump_of(3000.0, 2.0), days=4))
    printed = cli('update', unit_file, broken, *new, code=1).stderr
    assert 'on 2030-01-03 |f| differs from the gravity 9.80665 m/s^2 by 3 mg RMS' in printed
    assert '(override with --allow unit)' in printed
    printed = cli('update', unit_file, broken, *new, '--allow', 'units', code=2).stderr
    assert "--allow: expected one of gravity, unit, got 'units'" in printed
    cli('update', unit_file, broken, *new, '--allow', 'unit')
    (tmp_path / 'new.yaml').unlink()
    rich = tmp_path / 'rich.yaml'
    save_calibration(rich_calibration(), rich)
    log = write_log(tmp_path / 'own', rests(unit, upright, no_error, days=2))
    printed = cli('update', rich, log, *new, code=1).stderr
    assert 'the rests were logged with another calibration' in printed


def with_shares(logged, share):
    return [(s, replace(r, shares=(share,) * len(r.shares))) for s, r in logged]


def test_derivatives_of_a_rest_by_initial_lag_states_agree_with_finite_differences():
    # The derivatives of |f| by lag states, unknown after a turn-on, equal finite differences.
    unit, share, step = rich_calibration(), 0.6, 1e-4
    logged = with_shares(rests(unit, in_any_attitude, no_error, days=4, rate=0.5 / 60.0), share)
    series, layout = series_of(logged, unit), StateLayout(Correction(unit).memory)
    lags = [lag for lag in layout.places if isinstance(lag, Lag)]
    for k, column in enumerate(start_root(tuple(lags)).T):
        states = np.array([r.state for _, r in logged])
        for lag, size in zip(lags, column, strict=True):
            states[:, layout.places[lag]] += step * share * size
        moved = [(s, replace(r, state=tuple(x))) for (s, r), x in zip(logged, states, strict=True)]
        slope = (series.residual - series_of(moved, unit).residual) / step
        assert np.allclose(slope, series.by_start[:, k], atol=0.03 * np.abs(series.by_start).max())
    settled = series_of(with_shares(logged, 0.0), unit)
    assert not settled.by_start.any()
    assert np.array_equal(settled.noise, series.noise)


def test_an_unknown_regime_after_a_turn_on_does_not_increase_the_noise_of_a_rest():
    # The ageing model estimates the scatter of turn-ons: the noise of a rest must not contain it.
    unit = field_units.calibration()
    logged = field_units.live('level', 1, 3, field_units.Process()).rests
    unknown = [(s, replace(r, state=(*r.state[:4], 1.0, *r.state[5:]))) for s, r in logged]
    series, early = series_of(logged, unit), series_of(unknown, unit)
    assert np.allclose(early.noise, series.noise, rtol=1e-9)
    assert np.sqrt(series.noise.max()) < 8.0 * MICRO_G < early.claim.min()


@pytest.mark.parametrize('lags', [pytest.param(0.0, marks=pytest.mark.slow), 1.0])
def test_unknown_initial_lag_states_are_not_taken_for_scatter_of_rests(rng, lags):
    # A turn-on has three rests, in which 100, 70 and 40 % of the initial lag states remain. Random
    # walks grow by 15 ug (bias) and 10 ug (scale, at 1 g) per root day. The sd of turn-ons is 20
    # ug, of rests 3 ug, of initial lag states `lags` times the assumed 40 to 100 ug.
    unit = rich_calibration()
    each = series_of(with_shares(rests(unit, in_any_attitude, no_error, days=60), 1.0), unit)
    n, names = len(each), [k for k, v in vars(each).items() if isinstance(v, np.ndarray)]
    series = replace(each, **{name: np.repeat(getattr(each, name), 3, axis=0) for name in names})
    series.by_start[:] *= np.tile([1.0, 0.7, 0.4], n)[:, np.newaxis]
    steps = np.sqrt(np.diff(each.time, prepend=each.time[0]))[:, np.newaxis]
    sd = np.repeat([15.0, 10.0], 3) * MICRO_G
    levels = np.cumsum(steps * sd * rng.standard_normal((n, 6)), axis=0)
    levels[:, :3] += 20.0 * MICRO_G * rng.standard_normal((n, 3))
    start = lags * rng.standard_normal((n, each.by_start.shape[1]))
    residual = (series.by_level * np.repeat(levels, 3, axis=0)).sum(axis=1)
    residual += (series.by_start * np.repeat(start, 3, axis=0)).sum(axis=1)
    residual += np.sqrt(series.noise + (3.0 * MICRO_G) ** 2) * rng.standard_normal(3 * n)
    ageing, _, used = learn(replace(series, residual=residual), unit, float(series.time[0]))
    assert len(used) == 3 * n
    # The estimates of six simulations scattered by 20 % (bias), 30 % (scale) and 15 % (turn-on).
    assert ageing.bias == pytest.approx(15.0 * MICRO_G, rel=0.5)
    assert ageing.scale == pytest.approx(10.0 * MICRO_G, rel=0.7)
    assert ageing.turn_on == pytest.approx(20.0 * MICRO_G, rel=0.35)
    assert ageing.rest == pytest.approx(3.0 * MICRO_G, rel=0.4)
    assert ageing.lags == pytest.approx(lags, abs=0.25)


def test_the_newest_of_too_many_turn_ons_are_used_and_fewer_than_three_are_refused(monkeypatch):
    unit = precise()
    series = series_of(rests(unit, upright, no_error), unit)
    everything = rows_of(series, MICRO_G)
    monkeypatch.setattr('thermo_comp.field.ageing._MOST_ROWS', 25)
    assert set(rows_of(series, MICRO_G).start) == set(everything.start[-24:])
    logged = rests(unit, upright, no_error, days=1)[:8]
    with pytest.raises(FitError, match='rests of 2 starts of the node, at least 3 are needed'):
        update(series_of(logged, unit), unit)
