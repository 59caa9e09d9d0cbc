# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a fleet: simulated outliers and drifts are reported, noise is not."""

import re
from datetime import datetime, timedelta

import numpy as np
import pytest
from conftest import ROOT

from thermo_comp.errors import ThermoCompError
from thermo_comp.fleet.run import Results, render_fleet
from thermo_comp.fleet.summary import QUANTITIES, outlier_limit, summarise
from thermo_comp.fleet.table import COLUMNS, read_parquet, row_of, write_tables

pa = pytest.importorskip('pyarrow', reason='pyarrow of the extra `fleet` is not installed')

MONDAY = datetime(2026, 1, 5)


def fleet_of(n, rng, *, lots=('',), day=0.0, like=()):
    """Draw table rows of n units or, with the rows `like`, of a second test of these units."""
    rows = []
    for i in range(n):
        cells = {}
        for quantity in QUANTITIES:
            noise = float(rng.standard_normal())
            if like:
                before = float(like[i][quantity.name])
                sd = float(like[i][quantity.sd]) if quantity.sd else 0.0
                per_unit = abs(before) * 1e-6 if quantity.by == 'ppm' else 1.0
                cells[quantity.name] = before + noise * sd * per_unit
            elif quantity.by == 'ppm':
                cells[quantity.name] = 300.0 * (1.0 + 1e-3 * noise)
            elif quantity.by == 'logarithm':
                cells[quantity.name] = 4.0 * np.exp(0.1 * noise)
            else:
                cells[quantity.name] = 50.0 * noise
        sds = {quantity.sd: 2.0 for quantity in QUANTITIES if quantity.sd}
        rows.append(
            row_of(
                name=f'{lots[i % len(lots)]}/u{i:03d}@{day:g}', serial=f'S{i:03d}',
                lot=lots[i % len(lots)], verdict='valid', model='response',
                start=f'{MONDAY + timedelta(days=day):%Y-%m-%dT%H:%M:%SZ}', raw_ug=300.0,
                peak_ug=9.0, n_bags=12, n_left_out=0, n_positions=12, lowest_c=5.0, highest_c=35.0,
                calibration_sha256=f'{day}-{i}', **sds, **cells,
            ),
        )  # fmt: skip
    return rows


class TestOutliers:
    def test_one_outlier_or_5_bad_units_of_60_are_reported(self, rng):
        rows = fleet_of(100, rng)
        rows[17] = {**rows[17], 'bias_y_ug': 50.0 * 12.0}
        (outliers,) = summarise(rows).outliers
        assert (outliers.serial, outliers.label, outliers.unit) == ('S017', 'bias y', 'µg')
        assert (outliers.value, outliers.z) == (600.0, pytest.approx(12.0, rel=0.3))
        rows = fleet_of(60, rng)
        for i in range(5):
            rows[i] = {**rows[i], 'dynamic_ug': 40.0}
        serials = {outlier.serial for outlier in summarise(rows).outliers}
        assert serials == {f'S{i:03d}' for i in range(5)}
        # A loose case thermometer does not follow the case, so the board seems to lead the case.
        rows = fleet_of(20, rng)
        rows[4] = {**rows[4], 'board_lag_s': -800.0}
        (outlier,) = summarise(rows).outliers
        assert (outlier.serial, outlier.label, outlier.unit) == ('S004', 'lag of the board', 's')

    @pytest.mark.parametrize('n', [10, pytest.param(40, marks=pytest.mark.slow)])
    def test_fewer_than_a_fifth_of_fleets_without_outliers_give_a_false_alarm(self, n, rng):
        n_alarms = sum(bool(summarise(fleet_of(n, rng)).outliers) for _ in range(60))
        # At a rate of 5 % 60 fleets give 3 false alarms on average; 12 or more have p < 1e-4.
        assert n_alarms < 12

    def test_equal_units_and_a_fleet_of_six_give_no_outliers(self, rng):
        rows = fleet_of(6, rng)
        rows[0] = {**rows[0], 'bias_y_ug': 1e6}
        assert summarise(rows).outliers == ()
        assert outlier_limit(6, 20) == float('inf')
        spread = spread_of('noise_x', [{**row, NOISE_X: 4.0} for row in fleet_of(20, rng)])
        assert (spread.sd, set(spread.z.tolist())) == (0.0, {0.0})


NOISE_X = 'noise_x_ug_sqrt_hz'


def spread_of(name, rows):
    return next(each for each in summarise(rows).spreads if each.quantity.name.startswith(name))


class TestUndetermined:
    # WHY: a misalignment of -3950 +- 9100 urad was an outlier of -32 sd of the fleet.
    @staticmethod
    def with_few_positions(n, rng):
        rows = fleet_of(n + 12, rng)
        few = {'m_sd_10_urad': 9100.0, 'bias_sd_x_ug': 23000.0, 'bias_slope_sd_z_ug_k': None}
        for i in range(n):
            drawn = {'m_10_urad': 4000.0 * rng.normal(), 'bias_x_ug': 20000.0 * rng.normal()}
            rows[i] = {**rows[i], **few, **drawn, 'bias_slope_z_ug_k': 1e4}
        return rows

    @pytest.mark.parametrize('n', [1, 4, 16])
    def test_undetermined_values_change_neither_outliers_median_spread_nor_limit(self, n, rng):
        rows = self.with_few_positions(n, rng)
        summary = summarise(rows)
        assert summary.outliers == ()
        for name in ('m_10', 'bias_x', 'bias_slope_z'):
            all_units, whole = spread_of(name, rows), spread_of(name, rows[n:])
            assert (all_units.middle, all_units.sd) == (whole.middle, whole.sd)
            assert all_units.counted.tolist() == whole.values.tolist()
            n_comparisons = sum(len(spread.names) for spread in summary.spreads)
            assert all_units.limit == outlier_limit(12, n_comparisons)
        assert len(spread_of('bias_slope_z', rows).names) == 12

    def test_undetermined_values_are_judged_by_the_sd_of_fleet_and_unit(self, rng):
        rows = self.with_few_positions(1, rng)
        rows[0] = {**rows[0], 'm_10_urad': -3950.0}
        spread = spread_of('m_10', rows)
        expected = (-3950.0 - spread.middle) / np.sqrt(spread.sd**2 + 9100.0**2)
        assert spread.z[0] == pytest.approx(expected)
        rows = self.with_few_positions(16, rng)
        rows[-1] = {**rows[-1], 'm_10_urad': 2000.0}
        (outlier,) = summarise(rows).outliers
        assert (outlier.serial, outlier.label) == ('S027', 'M[1][0]')

    def test_a_parameter_that_fewer_than_eight_units_determine_is_not_compared(self, rng):
        rows = [{**row, 'm_10_urad': 0.0, 'm_sd_10_urad': 9e3} for row in fleet_of(20, rng)]
        names = [spread.quantity.name for spread in summarise(rows).spreads]
        assert 'm_10_urad' not in names
        assert 'm_20_urad' in names
        rows = self.with_few_positions(30, rng)[:37]
        rows[-1] = {**rows[-1], 'bias_slope_z_ug_k': 1e6}
        assert spread_of('bias_slope_z', rows).limit == float('inf')
        assert summarise(rows).outliers == ()


class TestDrift:
    def test_a_change_between_two_tests_is_reported(self, rng):
        first = fleet_of(10, rng)
        second = fleet_of(10, rng, day=30.0, like=first)
        second[3] = {**second[3], 'bias_x_ug': float(first[3]['bias_x_ug']) + 40.0}
        second[5] = {**second[5], 'scale_z': float(first[5]['scale_z']) * (1.0 + 90e-6)}
        drifts = {drift.serial: drift for drift in summarise([*second, *first]).drifts}
        assert len(drifts) == 10
        changed = {serial for serial, drift in drifts.items() if drift.is_significant}
        assert changed == {'S003', 'S005'}
        worst = drifts['S003']
        assert (worst.worst.constant, worst.worst.unit, worst.days) == ('bias x', 'µg', 30.0)
        assert worst.worst.change == pytest.approx(40.0)
        assert worst.worst.sd == pytest.approx(2.0 * np.sqrt(2.0))
        assert (worst.earlier, worst.later) == ('/u003@0', '/u003@30')
        worst = drifts['S005'].worst
        assert (worst.constant, worst.unit) == ('scale factor z', 'ppm')
        assert worst.change == pytest.approx(90.0)

    def test_the_table_of_an_earlier_fleet_gives_drifts(self, rng, tmp_path):
        first = fleet_of(3, rng)
        table, _ = write_tables(first, tmp_path)
        before = read_parquet(table)
        assert before == first
        drifts = summarise(fleet_of(3, rng, day=90.0, like=first), before).drifts
        names = sorted(drift.earlier for drift in drifts)
        assert names == [f'earlier /u00{i}@0' for i in range(3)]
        assert summarise(first, before).drifts == ()


class TestPage:
    def test_text_from_bags_is_no_markup_and_the_page_needs_no_network(self, rng):
        evil = '<script>alert(1)</script>"&$x_1$'
        first = fleet_of(12, rng, lots=('A', evil))
        rows = [*first, *fleet_of(12, rng, lots=('A', evil), day=400.0, like=first)]
        for row in rows:
            row |= {name: f'{evil}{row[name]}' for name in ('serial', 'name')}
        rows[0] = {**rows[0], 'bias_x_ug': 1e5}
        rows[1] = row_of(name=evil, serial=evil, verdict='refused', problem=f'3.5 {evil}')
        page = render_fleet(rows, summarise(rows), lambda row: f'units/{row["name"]}/c.html')
        assert '<script' not in page
        assert '&lt;script&gt;alert(1)' in page
        for heading in ('Not calibrated', 'Units that stand out', 'Tested again', 'All tests'):
            assert f'<h2>{heading}</h2>' in page
        links = re.findall(r'<a href="([^"]*)"', page)
        assert len(links) == 23
        assert all(re.fullmatch(r"[\w./%'()~-]+", link) for link in links)
        assert re.findall(r'\ssrc="', page) == []
        assert "default-src 'none'" in page
        assert page.count('<figure') == 2

    def test_the_page_of_a_fleet_without_a_calibration_has_no_figure(self):
        rows = [row_of(name='u', serial='u', verdict='failed', problem='x: damaged')]
        page = render_fleet(rows, summarise(rows), lambda _: '')
        assert '0 of 1 test gave a calibration.' in page
        assert '<figure' not in page


class TestTable:
    def test_cells_of_the_csv_table_are_not_read_as_formulas(self, tmp_path):
        row = row_of(name='=cmd()', serial='-1', n_bags=3, raw_ug=-1.5)
        _, path = write_tables([row], tmp_path)
        heading, line = path.read_text().splitlines()
        assert heading.split(',') == [column.name for column in COLUMNS]
        cells = dict(zip(heading.split(','), line.split(','), strict=True))
        assert (cells['name'], cells['serial']) == ("'=cmd()", "'-1")
        assert (cells['n_bags'], cells['raw_ug'], cells['board_lag_s']) == ('3', '-1.5', '')

    def test_files_and_columns_that_are_not_of_a_fleet_are_refused(self, tmp_path):
        (tmp_path / 'x.parquet').write_bytes(b'PAR1 not')
        with pytest.raises(ThermoCompError, match=r'x\.parquet: not a fleet table'):
            read_parquet(tmp_path / 'x.parquet')
        from pyarrow import parquet

        parquet.write_table(pa.table({'a': [1]}), tmp_path / 'y.parquet')
        with pytest.raises(ThermoCompError, match='lacks the columns serial and verdict'):
            read_parquet(tmp_path / 'y.parquet')
        with pytest.raises(ValueError, match="no column 'colour'"):
            row_of(colour='red')

    def test_the_page_on_fleets_lists_every_column(self):
        rows = (ROOT / 'docs' / 'fleet.md').read_text().replace('\\|', '|').splitlines()
        listed = [row for row in rows if re.match(r'\| `\w+` \| \w+ \| .* \|$', row)]
        assert listed == [f'| `{each.name}` | {each.kind} | {each.meaning} |' for each in COLUMNS]


@pytest.mark.parametrize(
    'name', ['../../etc', '.', '..', 'a/../b', '/abs', 'a\0b', 'x' * 300, 'ü/ß', 'a b', '']
)
def test_the_result_folder_of_any_name_is_inside_the_results(name, tmp_path):
    folder = Results(tmp_path / 'out').folder_of(name)
    folder.mkdir(parents=True)
    assert (tmp_path / 'out' / 'units').resolve() in folder.resolve().parents


def test_results_are_not_written_into_a_file(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(ThermoCompError, match='file: cannot be created'):
        Results(tmp_path / 'file')
