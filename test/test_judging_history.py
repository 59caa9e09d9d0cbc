# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The history of a unit and the verdicts and forecasts of the drift watch are right."""

import json
from dataclasses import replace

import field_units
import field_watch
import numpy as np
import pytest
from builders import axis_set, calibration, regime_set
from field_helpers import in_any_attitude, jump_of, no_error, precise, rests, upright
from report_helpers import evidence, fitted, write_bag
from scipy.stats import norm

from thermo_comp.field.series import series_of
from thermo_comp.field.watch import LIMIT, passage, watch
from thermo_comp.judging.evaluation import drifts_of, history_of
from thermo_comp.report.page import render_report
from thermo_comp.report.style import number
from thermo_comp.unit.calibration import AxisReference
from thermo_comp.unit.calibration_file import save_calibration
from thermo_comp.unit.gravity import MICRO_G
from thermo_comp.unit.provenance import Source

pytestmark = pytest.mark.usefixtures('equal_fits_once')

K = 300.0


def dated(created, bias_ug=0.0, ppm=0.0, sd_ug=3.0):
    scale = K * (1.0 + 1e-6 * ppm)
    axes = replace(calibration().axes, z=AxisReference(scale, bias_ug * MICRO_G * scale))
    part = regime_set(*[axis_set(residual_sd_m_s2=sd_ug * MICRO_G)] * 3)
    unit = calibration(axes=axes, static=part, dynamic=part)
    provenance = replace(unit.provenance, created=created, sources=(Source(created, created),))
    return replace(unit, provenance=provenance)


def test_changes_between_calibrations_equal_those_found_by_hand_if_they_form_a_history():
    # Dates order the calibrations; the change of the z bias has an sd of hypot(3, 4) = 5 ug.
    drifts = drifts_of(history_of([dated('2026-02-01', 20.0, 50.0, 4.0), dated('2026-01-01')]))
    names = [f'{kind} {axis}' for kind in ('bias', 'scale') for axis in 'xyz']
    assert [drift.constant for drift in drifts] == names
    *still, z = drifts[:3]
    assert (z.earlier, z.later, z.unit) == ('2026-01-01', '2026-02-01', 'ug')
    assert (z.change, z.sd) == (pytest.approx(20.0), pytest.approx(5.0))
    assert z.is_sure
    assert drifts[5].change == pytest.approx(50.0)
    for change in still:
        assert change.change == pytest.approx(0.0, abs=1e-9)
        assert not change.is_sure
    unit = dated('2026-01-01')
    other = replace(unit, unit=replace(unit.unit, serial='other'))
    for calibrations in ([unit], [unit, unit], [unit, other]):
        assert drifts_of(history_of(calibrations)) == []
    silent = drifts_of(history_of([unit, dated('2026-03-01', 500.0, sd_ug=0.0)]))
    assert np.isnan([drift.sd for drift in silent]).all()
    assert not any(drift.is_sure for drift in silent)


def test_evaluate_and_report_print_the_history(cli, tmp_path, monkeypatch):
    undrawn = 'thermo_comp.report.page.drawn_figures'
    monkeypatch.setattr(undrawn, lambda figures: [(figure, '') for figure in figures])
    now = fitted().calibration
    axes = replace(now.axes, x=replace(now.axes.x, bias=now.axes.x.bias + 10.0))
    provenance = replace(now.provenance, tested='2020-01-01T00:00:00Z', sources=())
    save_calibration(replace(now, axes=axes, provenance=provenance), tmp_path / 'a.yaml')
    save_calibration(now, tmp_path / 'b.yaml')
    bag = write_bag(tmp_path / 'held_out.mcap')
    given = ('-c', tmp_path / 'b.yaml', '-c', tmp_path / 'a.yaml', '--json')
    content = json.loads(cli('evaluate', bag, *given, code=None).stdout)
    x = content['history'][0]
    assert (x['constant'], x['earlier']) == ('bias x', '2020-01-01T00:00:00Z')
    assert x['change'] == pytest.approx(-10.0 / now.axes.x.scale_factor / MICRO_G, rel=1e-3)
    page = tmp_path / 'page.html'
    assert json.loads(cli('report', *given, '-o', page).stdout)['history'] == content['history']
    assert '2020-01-01' in page.read_text(encoding='utf-8')
    assert '<h2>History</h2>' not in render_report(evidence())
    # WHY: the calibration of another unit was left out of the history without a message.
    save_calibration(replace(now, unit=replace(now.unit, serial='other')), tmp_path / 'other.yaml')
    refused = cli('report', *given, '-c', tmp_path / 'other.yaml', '-o', tmp_path / 'p', code=1)
    assert 'other.yaml: unit.serial: must be ' in refused.stderr


FACTS = (
    *('verdict', 'reason', 'is_valid', 'gravity_m_s2', 'window_s', 'tolerance_m_s2'),
    *('sections_m_s2', 'n_positions', 'moved', 'shifts', 'axis_rms_m_s2'),
)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('judge')
    save_calibration(fitted().calibration, folder / 'unit.yaml')
    write_bag(folder / 'held_out.mcap')
    return folder


@pytest.mark.usefixtures('no_figures')
@pytest.mark.parametrize('options', [(), ('--tolerance', '1ug', '--window', '120')])
def test_evaluate_and_report_give_equal_verdicts(cli, folder, options):
    page = folder / f'page{len(options)}.html'
    given = (folder / 'held_out.mcap', '-c', folder / 'unit.yaml', *options, '--json')
    printed = cli('evaluate', *given, code=None)
    other = cli('report', *given, '-o', page, code=None)
    ours, theirs = json.loads(printed.stdout), json.loads(other.stdout)
    for name in FACTS:
        assert ours[name] == theirs[name], name
    assert printed.returncode == other.returncode == (0 if ours['is_valid'] else 1)
    assert ours['window_s'] == float(options[3] if options else 60)
    text = page.read_text(encoding='utf-8')
    assert f'means over {ours["window_s"]:g} s' in text
    assert ours['verdict'].replace(' ug', ' µg') in text
    for section in ours['sections_m_s2'].values():
        if section['n']:
            for name in ('raw_rms', 'rms', 'peak', 'claimed_rms'):
                assert f'>{number(section[name] / 9.80665e-6)}<' in text


SLOW = pytest.mark.slow


def walked(rate, bound, axes=1, mean=0.0):
    """Forecast a random walk from `mean`; on each axis its variance grows by `rate` per day."""
    start = np.full(axes, mean)
    return passage(start, np.zeros((axes, axes)), np.sqrt(rate) * np.eye(axes), bound)


def test_the_probability_of_a_first_passage_agrees_with_closed_forms():
    # In one dimension a random walk of rate r stays within (-c, c) up to t with the probability
    # sum over k of (-1)^k [N((2 k + 1) c / s) - N((2 k - 1) c / s)], s^2 = r t, N: normal
    # distribution. In three dimensions it stays in a ball of radius c with the probability 2 sum
    # over k > 0 of (-1)^(k + 1) exp(-(k pi)^2 r t / 2 c^2).
    rate, bound = 4.0, 50.0
    k, n = np.arange(-40, 41), np.arange(1, 200)
    both = walked(rate, bound), walked(rate, bound, 3)
    for probability, days, of_ball in zip((0.1, 0.5, 0.9), *both, strict=True):
        s = np.sqrt(rate * days)
        inside = norm.cdf((2 * k + 1) * bound / s) - norm.cdf((2 * k - 1) * bound / s)
        # A share of about 0.5 among 2000 simulated walks has a standard error of 0.011.
        assert float((-1.0) ** k @ inside) == pytest.approx(1.0 - probability, abs=0.025)
        stays = 2.0 * (-1.0) ** (n + 1) @ np.exp(-((n * np.pi) ** 2) * rate * of_ball / 5000.0)
        assert stays == pytest.approx(1.0 - probability, abs=0.025)
    # A random walk reaches a nearer bound earlier; a unit without ageing never reaches a bound.
    assert walked(rate, bound, mean=30.0)[1] < walked(rate, bound)[1]
    assert walked(1e-12, bound) == (np.inf,) * 3
    assert walked(rate, bound, mean=51.0) == (0.0,) * 3


@pytest.mark.slow
def test_forecasts_agree_with_the_simulated_future_of_units():
    # WHY: errors of opposite attitudes cancelled, so forecasts were 3 to 5 times too long.
    shares, ratios = [], []
    for kind in ('fixed', 'up and down', 'faces', 'carried'):
        for rows in field_watch.forecasts(kind, 3, 20).values():
            shares += rows[:, 0].tolist()
            ratios.append(float(np.median(rows[:, 3] / rows[:, 1])))
    # The interval must contain 80 % of the simulated days; a mean of 24 shares errs by 6 %.
    assert np.mean(shares) == pytest.approx(0.8, abs=0.12)
    # A forecast's median is uncertain by a factor of 1.5, the mean of eight medians by 1.3.
    assert 1.0 / 1.6 < np.exp(np.mean(np.log(ratios))) < 1.6
    assert 0.45 < min(ratios) < max(ratios) < 2.2


@pytest.mark.parametrize('attitudes', [upright, pytest.param(in_any_attitude, marks=SLOW)])
def test_the_verdict_follows_the_true_error_on_each_day(attitudes):
    # RMS error / limit is 1.5 on days 20 to 34, 20 on day 12, and 0.6 on all other days.
    unit = precise()
    limit = LIMIT * np.sqrt(np.mean(series_of(rests(unit, attitudes, no_error), unit).claim ** 2))

    def error(day):
        size = 1.5 if 20.0 <= day < 34.0 else 0.6
        # A bias error of s on each axis has an RMS of s along random directions.
        return np.full(3, limit * (20.0 if 12.0 <= day < 13.0 else size))

    series = series_of(rests(unit, attitudes, error, 40, turn_on=5.0 * MICRO_G), unit)
    first = int(series.day[0])
    for n_days in (11, 13, 14, 16, 18, 20, 24, 26, 28, 33, 34, 40):
        result = watch(series.at(series.day < first + n_days), unit)
        since = {13: 12}.get(n_days, 20 if 20 < n_days <= 34 else None)
        outside = None if since is None else str(np.datetime64(first + since, 'D'))
        assert (result.exit_code, result.outside_since) == (int(outside is not None), outside)
        assert ('outside its claim since' in str(result)) == (since is not None)
        # If gravity is along (1, 1, 1), biases of 0.6 times the limit change |f| by 1.04 times the
        # limit: the unit may return to its claim a day late.
        back = [str(np.datetime64(first + day, 'D')) for day in (34, 35)]
        assert (result.inside_since in back) == (n_days > 34)
        assert ('again within its claim since' in str(result)) == (result.inside_since is not None)
        assert since is not None or f'about {result.last}' not in str(result)


def test_the_drift_watch_states_the_day_and_the_temperature_range():
    of_field = field_units.calibration()
    unit = precise(static=of_field.static, dynamic=of_field.dynamic)
    healthy = watch(series_of(rests(unit, upright, no_error), unit), unit)
    assert (healthy.exit_code, healthy.outside_since) == (0, None)
    assert 'within its claim up to 2030-01-20' in str(healthy)
    n_rests = [row.n_rests for row in healthy.temperatures]
    assert sum(row.n_rests for row in healthy.days) == sum(n_rests)
    assert [row.name for row in healthy.temperatures] == ['10 .. 20 degC', '20 .. 30 degC']
    assert [row.name for row in healthy.periods] == [row.name for row in healthy.days]
    year = watch(series_of(rests(unit, upright, no_error, days=61), unit), unit)
    assert [row.n_rests for row in year.periods] == [9] * 20 + [3]
    assert healthy.forecast[0] < healthy.forecast[1] <= healthy.forecast[2]
    assert watch(series_of(rests(unit, upright, no_error), unit), unit, 1.0).forecast[0] == np.inf
    aged = watch(series_of(rests(unit, upright, jump_of(400.0, 10.0)), unit), unit)
    assert (aged.exit_code, aged.outside_since, aged.forecast) == (1, '2030-01-11', ())
