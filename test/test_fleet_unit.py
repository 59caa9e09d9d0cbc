# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The fleet command fits a unit as `thermo_comp fit` does, and reports every bag left out."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fleet_helpers import OPTIONS, damage, write_unit

from thermo_comp.fitting import fit
from thermo_comp.fitting.sources import fit_sources
from thermo_comp.fleet.table import COLUMNS
from thermo_comp.fleet.units import Storage, find_units
from thermo_comp.fleet.work import process_unit
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import parse_calibration

pytest.importorskip('fsspec', reason='fsspec is not installed: the extra `fleet`')


def processed(folder, **keys):
    (unit,) = find_units(Storage(str(folder)))
    outcome = process_unit(unit, str(folder), replace(OPTIONS, **keys))
    assert list(outcome.row) == [column.name for column in COLUMNS]
    return outcome


@pytest.fixture(scope='module')
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fleet')
    write_unit(folder / 'lot-A' / 'unit1', 1, metadata={'truth': '{}'})
    return folder


@pytest.fixture(scope='module')
def brief(fleet):
    return processed(fleet)


def test_a_unit_of_a_fleet_gets_the_fit_of_thermo_comp_fit(fleet, brief):
    sources, _ = fit_sources(sorted((fleet / 'lot-A' / 'unit1').iterdir()))
    ours = parse_calibration(brief.calibration.encode())
    theirs = fit(sources, replace(OPTIONS.fit, serial='mems-0001')).calibration
    assert ours.provenance.sources == theirs.provenance.sources
    assert ours == replace(theirs, provenance=ours.provenance)


def test_fleet_and_evaluate_give_the_same_verdict(fleet, brief, cli, tmp_path):
    row, bags = brief.row, sorted((fleet / 'lot-A' / 'unit1').iterdir())
    calibration = tmp_path / 'unit.yaml'
    calibration.write_text(brief.calibration)
    content = json.loads(cli('evaluate', *bags, '-c', calibration, '--json', code=None).stdout)
    assert row['verdict'] == content['verdict']
    assert row['reason'] == content['reason']
    assert row['window_s'] == content['window_s']
    micro_g = 9.80665e-6
    sections = content['sections_m_s2']
    for section in ('static', 'dynamic', 'all'):
        assert row[f'{section}_ug'] == pytest.approx(sections[section]['rms'] / micro_g)
    for cell, name in (('raw_ug', 'raw_rms'), ('peak_ug', 'peak'), ('claimed_ug', 'claimed_rms')):
        assert row[cell] == pytest.approx(sections['all'][name] / micro_g)


class TestRow:
    @pytest.mark.usefixtures('no_figures')
    def test_the_row_of_a_good_unit_contains_the_figures_of_its_fit(self, fleet, brief):
        outcome = processed(fleet, certificates=True)
        row = outcome.row
        assert (row['name'], row['serial'], row['lot']) == ('lot-A/unit1', 'mems-0001', 'lot-A')
        assert row['verdict'].startswith('valid')
        assert row['reason'].startswith(f'{row["all_ug"]:.0f} ug RMS of |f| - g, ')
        assert (row['problem'], row['left_out'], row['chosen']) == ('', '', '')
        assert (row['n_bags'], row['n_left_out'], row['n_positions']) == (6, 0, 6)
        calibration = parse_calibration(outcome.calibration.encode())
        x = calibration.axes.x
        bias = (x.bias + calibration.static.x.delta) / x.scale_factor
        assert row['bias_x_ug'] == pytest.approx(bias / 9.80665e-6)
        slope = calibration.static.x.scale_function
        assert row['scale_slope_x_ppm_k'] == pytest.approx(
            (slope.value(1e-3) - slope.value(-1e-3)) / 2e-3 * 1e6, rel=1e-6
        )
        # The sd of a slope must equal the sd of 4000 slopes drawn from the posterior.
        block = parameter_layout(calibration).scale[0]
        n_drawn, rows = 4000, slice(block.static + 1, block.static + 1 + slope.n_free)
        covariance = calibration.posterior.covariance()[rows, rows]
        drawn = np.random.default_rng(1).multivariate_normal(
            slope.free_coefficients, covariance, n_drawn
        )
        curves = [slope.with_free(tuple(row), 1.0) for row in drawn.tolist()]
        slopes = [float(curve.value(1e-3) - curve.value(-1e-3)) / 2e-3 * 1e6 for curve in curves]
        assert row['scale_slope_sd_x_ppm_k'] == pytest.approx(np.std(slopes), rel=0.05)
        assert row['board_lag_s'] == calibration.board_lag_s
        assert row['lowest_c'] < 10.0
        assert row['highest_c'] > 40.0
        assert row['start'] == '2026-01-01T00:00:01Z'
        assert 'mems-0001' in outcome.certificate
        assert 'class="simulated"' in outcome.certificate
        assert brief.certificate == ''
        assert (brief.row['verdict'], brief.row['reservations']) == (
            row['verdict'],
            row['reservations'],
        )
        json.dumps(row, allow_nan=False)

    @pytest.mark.slow
    def test_a_damaged_bag_is_left_out_and_a_cut_off_bag_is_read_up_to_its_end(self, tmp_path):
        paths = write_unit(tmp_path / 'u', 2, 6)
        paths[2].write_bytes(paths[2].read_bytes()[:-300])
        damage(paths[3])
        row = processed(tmp_path).row
        assert row['verdict'].startswith('valid')
        assert (row['n_bags'], row['n_left_out'], row['n_torn']) == (6, 1, 1)
        assert row['left_out'].startswith('u/04.mcap: damaged: ')
        assert '1 of 6 bags are left out: u/04.mcap' in row['reservations']
        assert '03.mcap: the file is cut off at byte' in row['reservations']
        assert row['n_positions'] == 5

    def test_bags_of_two_units_in_one_folder_are_refused(self, tmp_path):
        write_unit(tmp_path / 'u', 1, 1)
        write_unit(tmp_path / 'u', 2, 1, names=['x.mcap'])
        row = processed(tmp_path).row
        assert row['verdict'] == 'refused'
        assert row['problem'] == 'the bags are of different units: mems-0001, mems-0002'

    def test_the_row_states_the_production_lot_and_the_chosen_topic(self, tmp_path):
        lot = {'lot': 'L7'}
        write_unit(tmp_path / 'shelf' / 'u', 1, 2, serial='', metadata=lot, counts='/imu/raw')
        row = processed(tmp_path).row
        assert (row['lot'], row['serial']) == ('L7', 'u')
        assert row['chosen'] == '/imu/raw, its only Vector3Stamped, is taken for counts'

    def test_the_row_has_no_sd_of_a_slope_that_the_positions_do_not_determine(self, tmp_path):
        # WHY: a fit of one position stated the sum of the slopes of bias and scale as the slope of
        # the bias, with an sd of 0.06 ug/K.
        write_unit(tmp_path / 'u', 1, 1)
        row = processed(tmp_path).row
        assert [row[f'bias_slope_sd_{axis}_ug_k'] for axis in 'xyz'] == [None] * 3
        assert [row[f'scale_slope_sd_{axis}_ppm_k'] for axis in 'xyz'] == [None] * 3

    def test_the_lag_of_a_board_that_changes_before_the_case_is_negative(self, tmp_path):
        # WHY: a calibration without a measured board lag contains 900 s, which is not measured.
        write_unit(tmp_path / 'u', 1, 4, is_exchanged=True)
        allowed = replace(OPTIONS.fit, allow=('swapped',))
        outcome = processed(tmp_path, fit=allowed)
        assert outcome.row['board_lag_s'] < -100.0
        assert parse_calibration(outcome.calibration.encode()).board_lag_s == 900.0
