# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Windows of a fit have the compensator's columns; a calibration file corrects as the fit does."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from builders import arrays_of, source_of
from triads import triad

from thermo_comp.fitting import FitOptions, fit_bags, reduce_bag
from thermo_comp.fitting.claim import claim_of
from thermo_comp.fitting.initialisation import Problem, _candidates
from thermo_comp.fitting.options import sets_of
from thermo_comp.fitting.raw_checks import judge_missing
from thermo_comp.fitting.reduction import Readings
from thermo_comp.fitting.windows import N_SECTIONS, Model, thermal_windows
from thermo_comp.simulation.campaign import Position, parse_cyclogram, positions
from thermo_comp.simulation.run import arrays
from thermo_comp.thermal.lags import Lag, Play
from thermo_comp.thermal.settings import DetectorSettings, ThermalConfig
from thermo_comp.thermal.state import BOARD, Gradient, StateLayout
from thermo_comp.thermal.tracker import ThermalTracker
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.columns import ColumnTable, bank, memory_of
from thermo_comp.unit.correction import Correction
from thermo_comp.unit.functions import CubicSpline, Exponential, Polynomial
from thermo_comp.unit.gravity import STANDARD_GRAVITY

PROGRAM = parse_cyclogram('20 10min, 35@1 10min, 15@1 10min')
OPTIONS = FitOptions(gravity=STANDARD_GRAVITY)
SECOND = 1_000_000_000


@pytest.fixture(scope='module')
def all_bags():
    plan = [Position(PROGRAM, up) for up in positions(6, 1)]
    records = arrays(triad('own-lags', 1).with_thermometers(rate_hz=0.25), plan, 1)
    return [reduce_bag(source_of(*arrays_of(record)), OPTIONS) for record in records]


@pytest.fixture(scope='module')
def bags(all_bags):
    return all_bags[:2]


def windows_of(bags):
    model = Model('response', sets_of(OPTIONS, bags), bank(), ('case',), DetectorSettings(), 20.0)
    return thermal_windows(bags, model)


def test_a_rest_partly_in_the_range_of_the_model_is_used_there_only(bags):
    # WHY: positions 3 K outside the range of the prior doubled the error of an update.
    everything = windows_of(bags)
    lower, upper = np.quantile(everything.temperature, (0.3, 0.7))
    for range_c, is_used in (((lower, upper), True), ((90.0, 95.0), False)):
        model = replace(everything.model, range_c=range_c)
        windows = thermal_windows(bags, model, everything.tracks)
        board = windows.temperature
        assert (len(board) < len(everything.temperature)) == is_used
        assert (board.min() >= lower and board.max() <= upper) == is_used
        # WHY: samples outside the range were reported as samples without temperatures.
        assert not list(judge_missing(bags, windows))


def test_the_sets_differ_only_with_soaks_at_several_temperatures(bags):
    # WHY: static curves fitted to 4 of 1035 windows erred by 341 ug, common curves by 21 ug.
    ramps = windows_of(bags)
    soaks = replace(ramps, weight=1.0 * (np.abs(ramps.rate) > 1e-3))
    of_sets = np.array(ramps.data.groups) == 'set'
    forced = replace(OPTIONS, forced=('set',))
    for windows, options, is_tried in (
        (ramps, OPTIONS, False),
        (soaks, OPTIONS, True),
        (ramps, forced, True),
        (ramps, replace(OPTIONS, model='golovach'), True),
    ):
        problem = Problem(bags, options, None, np.eye(3)[:2], lambda _part: None)
        candidates = _candidates(windows, problem, 1e-5, is_bench=False)
        assert candidates.typical[0, of_sets].any() == is_tried


def test_columns_of_the_fit_equal_those_of_the_tracker(bags):
    windows = windows_of(bags)
    spec = memory_of(bank())
    table = ColumnTable(bank(), spec, 20.0)
    tracker = ThermalTracker(DetectorSettings(), spec, ThermalConfig())
    bag = bags[0]
    events = sorted(
        (int(s), name, float(v))
        for name, readings in (('board', bag.board), ('case', bag.case))
        for s, v in zip(readings.stamp_ns, readings.value, strict=True)
    )
    of_bag = windows.data.bag == 0
    time, rows = windows.data.time[of_bag], windows.data.columns[of_bag]
    grid = np.arange(int(bag.board.stamp_ns[0]), bag.end_ns, SECOND)
    states, reading = [], 0
    for stamp in grid.tolist():
        while reading < len(events) and events[reading][0] <= stamp:
            at, name, value = events[reading]
            tracker.read(name, at, value)
            reading += 1
        states.append(tracker.sample(stamp))
    phi = table.values(np.array(states).T).T
    seconds = (grid - bag.start_ns) * 1e-9
    n_sets = rows.shape[1] - phi.shape[1]
    mean = np.array([phi[np.abs(seconds - t) <= 30.0].mean(axis=0) for t in time])
    scale = np.sqrt(np.mean(phi**2, axis=0)) + 1e-9
    late = time > 300.0
    # The tracker lags estimated temperatures, the fit lags readings: plays reverse at other times.
    np.testing.assert_allclose(rows[late, n_sets:] / scale, mean[late] / scale, atol=0.05)


def test_lags_after_a_pause_depend_on_the_temperatures_in_it(bags):
    # WHY: lags took the temperature as constant in a pause, which tripled the drift error.
    whole, first_s, last_s = bags[0], 780.0, 1200.0
    temperatures = {}
    for name, readings in whole.temperatures.items():
        seconds = (readings.stamp_ns - whole.start_ns) * 1e-9
        kept = (seconds < first_s) | (seconds > last_s)
        temperatures[name] = Readings(readings.stamp_ns[kept], readings.value[kept])
    paused = replace(whole, temperatures=temperatures)
    before, after = windows_of([whole]), windows_of([paused])
    is_lag = [column.group in ('board', 'gradient_lag') for column in before.model.columns]
    places = np.searchsorted(before.data.time, after.data.time - 1e-6)
    at = np.minimum(places, len(before.data.time) - 1)
    same = (np.abs(before.data.time[at] - after.data.time) < 1.0) & (
        after.data.time > last_s + 60.0
    )
    assert same.sum() >= 25
    expected, actual = before.raw[at][:, is_lag], after.raw[:, is_lag]
    # The ramp continues in the pause, so the interpolated temperature is nearly the true one.
    error = np.sqrt(np.mean((actual - expected)[same] ** 2, axis=0))
    assert (error < 0.05 * np.sqrt(np.mean(expected**2, axis=0))).all()


def test_columns_sections_and_initial_lag_states_agree_with_formulas(bags):
    windows = windows_of(bags)
    data = windows.data
    t, w = windows.temperature - 20.0, windows.weight
    assert data.groups[:6] == ('curve',) * 3 + ('set',) * 3
    np.testing.assert_allclose(data.columns[:, [0, 3]], np.column_stack((t, w)), atol=1e-9)
    assert data.in_scale[:6].tolist() == [True, True, True, False, True, True]
    # An initial lag state decays as exp(-time / tau), in a column lag * t as t * exp(-time / tau).
    taus = [lag.tau_s for lag in memory_of(bank()).lags]
    for k, column in enumerate(bank(), start=6):
        lag = data.lag[k]
        if lag < 0:
            assert not data.start[:, k].any()
            continue
        fades = np.exp(-data.time / taus[lag])
        if column.kind in ('board', 'gradient_lag') and column.power == 0:
            np.testing.assert_allclose(data.start[:, k], fades, atol=0.15)
        assert np.abs(data.start[-1, k]) <= np.abs(data.start[:, k]).max()
    for p in range(data.n_positions):
        section = data.section[data.position == p]
        assert (np.diff(section) >= 0).all()
        assert np.ptp(np.bincount(section, minlength=N_SECTIONS)) <= 2
    rms = np.sqrt(np.mean(data.columns**2, axis=0))
    # `kelvins` is the RMS of a column / its largest slope over t, which is 2 max |t| for t^2.
    lines = [0, *(k for k, column in enumerate(bank(), start=6) if column.group == 'board')]
    np.testing.assert_allclose(data.kelvins[lines], rms[lines], rtol=1e-6)
    assert data.kelvins[1] == pytest.approx(rms[1] / (2.0 * np.abs(t).max()), rel=0.02)


def test_the_board_temperature_is_measured_while_the_case_thermometer_is_silent(bags):
    # The case readings of the bag end at 900 s; the lags need board temperatures after this time.
    bag = bags[0]
    is_early = (bag.case.stamp_ns - bag.start_ns) * 1e-9 < 900.0
    case = Readings(bag.case.stamp_ns[is_early], bag.case.value[is_early])
    silent = replace(bag, temperatures={**bag.temperatures, 'case': case})
    whole, track = (windows_of([each]).tracks[0] for each in (bag, silent))
    np.testing.assert_allclose(track.states[:, BOARD], whole.states[:, BOARD], atol=0.01)


@pytest.mark.parametrize('name', ['board', 'case'])
@pytest.mark.parametrize('is_stuck', [False, True])
def test_windows_with_a_silent_or_stuck_thermometer_are_left_out(bags, name, is_stuck):
    # From 900 s to 2200 s, in both ramps, the thermometer is silent or repeats one value.
    bag, start, stop = bags[0], 900.0, 2200.0
    readings = bag.temperatures[name]
    age = (readings.stamp_ns - bag.start_ns) * 1e-9
    lost = (age > start) & (age < stop)
    if is_stuck:
        value = np.where(lost, readings.value[np.argmax(lost)], readings.value)
        readings = Readings(readings.stamp_ns, value)
    else:
        readings = Readings(readings.stamp_ns[~lost], readings.value[~lost])
    windows = windows_of([replace(bag, temperatures={**bag.temperatures, name: readings})])
    # Windows are left out from 120 s after the last reading of a silent thermometer (time-out of
    # 60 s, 5 reading intervals, a window) or 600 s after the last change of a stuck thermometer.
    seen_s = 600.0 if is_stuck else 120.0
    assert not ((windows.data.time > start + seen_s) & (windows.data.time < stop)).any()
    whole = windows_of([bag])
    assert len(windows.data.time) > 0.4 * len(whole.data.time)
    kept = np.isin(whole.data.time, windows.data.time) & (whole.data.time < start)
    both = np.isin(windows.data.time, whole.data.time[kept])
    np.testing.assert_array_equal(windows.data.columns[both], whole.data.columns[kept])


def test_the_derivative_of_a_column_by_its_lag_agrees_with_differences():
    columns = bank(span_k=(-4.0, 12.0))
    spec = memory_of(columns)
    layout, table = StateLayout(spec), ColumnTable(columns, spec, 20.0)
    state = np.zeros((layout.width, 1))
    state[0], state[layout.places[Gradient('case')]] = 27.0, 0.4
    for lag in layout.lags:
        state[layout.places[lag]] = 0.3 + 1e-4 * lag.tau_s
    expected = (table.slopes(state)[0] * table.factors(state[0], state[3])[0])[:, 0]
    for k, column in enumerate(columns):
        if isinstance(column.source, Lag):
            step = np.zeros_like(state)
            step[layout.places[column.source]] = 1e-6
            slope = (table.values(state + step) - table.values(state - step))[k, 0] / 2e-6
            assert slope == pytest.approx(expected[k], rel=1e-6)


@pytest.mark.parametrize(
    ('options', 'static', 'dynamic', 'is_shared'),
    [
        ({}, Polynomial, 2, True), ({'static_curve': 'quadratic'}, Polynomial, 2, True),
        ({'model': 'golovach'}, Polynomial, 2, False),
        ({'static_curve': 'spline'}, CubicSpline, None, False),
        ({'static_curve': 'exponential'}, Exponential, 2, False),
        ({'static_curve': 'linear', 'dynamic_curve': 'linear'}, Polynomial, 1, False),
    ],
)  # fmt: skip
def test_curve_columns_of_a_fit_are_powers_of_temperature(
    bags, options, static, dynamic, is_shared
):
    sets = sets_of(replace(OPTIONS, **options), bags)
    assert isinstance(sets.static, static)
    assert sets.is_shared == is_shared
    assert dynamic is None or sets.dynamic.n_free == dynamic
    columns = sets.columns(np.linspace(-5.0, 15.0, 9), np.linspace(0.0, 1.0, 9))
    assert len(columns) == len(sets.groups) == sets.static.n_free + 1 + sets.dynamic.n_free
    for k, column in enumerate(sets.columns(np.zeros(3), np.array([0.0, 0.5, 1.0]))):
        expected = [0.0, 0.5, 1.0] if k == sets.level else 0.0
        np.testing.assert_allclose(column, expected, atol=1e-12)
    assert all(column[0] == 0.0 for column in columns[sets.static.n_free :])


#: Models that are fitted; the curves of both `golovach` and `linear` are polynomials.
MODELS = 'golovach', pytest.param('linear', marks=pytest.mark.slow), 'exponential', 'spline'


@pytest.fixture(scope='module', params=MODELS)
def fitted(request, all_bags):
    groups = ('curve', 'set', *(['board'] if request.param == 'exponential' else []))
    is_paper = request.param == 'golovach'
    chosen = {'static_curve': request.param, 'groups': groups}
    options = replace(OPTIONS, gravity_sd=1e-4, **({'model': 'golovach'} if is_paper else chosen))
    claims = []

    def keep(*given, **options):
        claims.append(claim_of(*given, **options))
        return claims[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module('thermo_comp.fitting.fit'), 'claim_of', keep)
        result = fit_bags(all_bags, options)
    (claim,) = claims
    assert result.calibration.gravity_sd_m_s2 == options.gravity_sd
    return result, claim


def states_of(windows, calibration):
    layout = StateLayout(memory_of(calibration.response))
    states = np.zeros((len(windows.temperature), layout.width))
    states[:, 0], states[:, 3] = windows.temperature, windows.weight
    raw = dict(zip(windows.model.columns, windows.raw.T, strict=True))
    plain = {(c.kind, c.sensor, c.tau_s, c.width_k): value for c, value in raw.items()}
    for column, place in layout.places.items():
        if isinstance(column, Play):
            states[:, place] = plain['play', 'case', column.tau_s, column.width_k]
        elif isinstance(column, Lag):
            kind = 'board' if column.input == 'board' else 'gradient_lag'
            states[:, place] = plain.get((kind, 'case', column.tau_s, 0.0), 0.0)
        elif isinstance(column, Gradient):
            states[:, place] = windows.gradient
    return states.T


def test_a_calibration_file_corrects_windows_with_the_sd_of_the_regression(fitted):
    # In ramps of 1 K/min powers of means over 60 s differ from means of powers by some ppm.
    result, claim = fitted
    windows, calibration = result.fit.windows, result.calibration
    state, prior = result.fit.posterior.state, result.fit.posterior.prior
    correction = Correction(calibration)
    pairs = correction.bias_scale(states_of(windows, calibration)).swapaxes(0, 1)
    bias, scale = np.transpose(pairs, (1, 2, 0))
    force = (windows.data.mean - bias) / scale @ np.array(calibration.misalignment).T
    up = state.up[windows.data.position]
    left = force - STANDARD_GRAVITY * up
    along = np.sum(left * up, axis=1)
    report = next(row for row in result.residuals if row.section == 'all')
    assert np.sqrt(np.mean(along**2)) < 1.3 * report.fitted.rms + 5e-6
    assert prior.sigma.min() > 0.0
    layout = parameter_layout(calibration)
    covariance = calibration.posterior.covariance()
    assert covariance.shape == (layout.n_parameters, layout.n_parameters)
    K = np.array([axis.scale_factor for axis in calibration.axes])
    sd = np.sqrt(np.diag(claim.covariance))
    by_file = np.sqrt(np.diag(covariance))
    for axis in range(3):
        bias, scale = layout.bias[axis].static, layout.scale[axis].static
        expected = sd[claim.layout.bias[axis]] * K[axis] / state.kappa[axis]
        assert by_file[bias] == pytest.approx(expected, rel=1e-4)
        expected = sd[claim.layout.kappa[axis]] / state.kappa[axis]
        assert by_file[scale] == pytest.approx(expected, rel=1e-4)
        assert by_file[scale] > 1e-4 / STANDARD_GRAVITY
    places = claim.layout.misalignment[[0, 2]]
    np.testing.assert_allclose(by_file[-3:][[0, 2]], sd[places], rtol=1e-4)
