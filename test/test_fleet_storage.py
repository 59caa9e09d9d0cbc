# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags of a fleet are found on disk or in a storage; its fits equal those of `thermo_comp fit`."""

import errno
import json
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from fleet_helpers import OPTIONS, damage, write_unit
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from thermo_comp.errors import ThermoCompError
from thermo_comp.fitting import fit
from thermo_comp.fitting.sources import digest, fit_sources
from thermo_comp.fleet.table import COLUMNS
from thermo_comp.fleet.units import (
    FoundUnit,
    Storage,
    StoredFile,
    find_units,
    folders_of_tables,
    group_files,
)
from thermo_comp.fleet.work import process_unit
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.calibration_file import parse_calibration

fsspec = pytest.importorskip('fsspec', reason='fsspec of the extra `fleet` is not installed')


@pytest.fixture(scope='module')
def unit(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fleet') / 'unit'
    write_unit(folder, 1, 2)
    return folder


@pytest.fixture
def memory():
    """Return an empty folder of fsspec's memory file system, and its URL."""
    fs = fsspec.filesystem('memory')
    name = f'/{uuid4().hex}'
    yield fs, f'memory:/{name}'
    if fs.exists(name):
        fs.rm(name, recursive=True)


def to_sqlite(path, target):
    with (
        Reader(path) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer,
    ):
        store = get_typestore(Stores.ROS2_JAZZY)
        connections = {
            link.topic: writer.add_connection(link.topic, link.msgtype, typestore=store)
            for link in reader.connections
        }
        for connection, stamp_ns, data in reader.messages():
            writer.write(connections[connection.topic], stamp_ns, data)


class TestElsewhere:
    def test_a_fleet_in_memory_and_a_fleet_on_disk_give_equal_calibrations(self, unit, memory):
        fs, url = memory
        fs.put(f'{unit}/', f'{url}/unit/', recursive=True)
        (here,), (there,) = find_units(Storage(str(unit.parent))), find_units(Storage(url))
        assert list(here.bags) == list(there.bags)
        alone = process_unit(here, str(unit.parent), OPTIONS)
        other = process_unit(there, url, OPTIONS)
        first, second = (parse_calibration(text.calibration.encode()) for text in (alone, other))
        assert replace(first, provenance=second.provenance) == second
        assert first.provenance.sources == second.provenance.sources
        assert other.hashes == {name: digest(unit.parent / name) for name in here.bags}

    @pytest.mark.parametrize('name', ['pos1', 'pos1.db3'])
    def test_bags_are_read_from_a_url_without_a_copy(self, name, tmp_path, memory, monkeypatch):
        fs, url = memory
        (path,) = write_unit(tmp_path / 'bags' / 'unit', 1, 1, names=['pos1'])
        if name == 'pos1.db3':
            to_sqlite(path, tmp_path / 'other')
            (tmp_path / 'other' / 'other.db3').rename(path.with_name(name))
            shutil.rmtree(path)
        fs.put(f'{tmp_path}/bags/', f'{url}/', recursive=True)
        (units,) = find_units(Storage(url))
        assert list(units.bags) == [f'unit/{name}']
        (tmp_path / 'scratch').mkdir()
        monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'scratch'))
        outcome = process_unit(units, url, OPTIONS)
        assert outcome.row['left_out'] == ''
        assert outcome.hashes == {f'unit/{name}': digest(path.with_name(name))}
        assert list((tmp_path / 'scratch').iterdir()) == []

    def test_the_result_of_a_unit_with_a_missing_bag_is_not_final(self, memory):
        _, url = memory
        gone = {'unit/a.mcap': [StoredFile('unit/a.mcap', 5, '')]}
        outcome = process_unit(FoundUnit('unit', '', gone), url, OPTIONS)
        assert not outcome.is_final
        assert outcome.row['verdict'] == 'failed'
        assert str(outcome.row['left_out']).startswith('unit/a.mcap: ')


class TestDiscovery:
    @pytest.mark.parametrize(
        ('files', 'bags'),
        [
            (['u/1.mcap', 'u/2.mcap', 'u/notes.txt'], ['u/1.mcap', 'u/2.mcap']),
            (['u/p1/metadata.yaml', 'u/p1/p1_0.mcap', 'u/p1/p1_1.mcap'], ['u/p1']),
            # These bags have no metadata.yaml, as after a recorder was killed.
            (['u/p1/p1_0.mcap', 'u/p2/p2_0.db3'], ['u/p1', 'u/p2']),
            (['u/u_a.mcap'], ['u/u_a.mcap']),
            (['top.bag', 'u/x.db3'], ['top.bag', 'u/x.db3']),
        ],
    )
    def test_files_of_a_folder_are_grouped_into_bags(self, files, bags):
        assert list(group_files([StoredFile(name, 1, '') for name in files])) == bags

    def test_folders_give_unit_and_lot(self, tmp_path):
        for name in (
            *('lot-A/u1/1.mcap', 'lot-A/u1/2.mcap', 'lot-B/u2/1.mcap', 'u3/1.mcap', 'u4/log.csv'),
            *('u3/truth.csv', 'out/fleet.csv', 'out/fleet.parquet', '.hidden/x.mcap'),
            *('u5/log.ulg', 'u6/notes.txt'),
        ):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
        found = [(u.name, u.lot, [*u.bags]) for u in find_units(Storage(str(tmp_path)))]
        assert found == [
            ('lot-A/u1', 'lot-A', ['lot-A/u1/1.mcap', 'lot-A/u1/2.mcap']),
            *(('lot-B/u2', 'lot-B', ['lot-B/u2/1.mcap']), ('u3', '', ['u3/1.mcap'])),
        ]
        # WHY: a unit with tables and no bags was left out without a message.
        assert folders_of_tables(Storage(str(tmp_path))) == ('u4', 'u5')

    def test_bags_without_folders_are_sorted_by_serial(self, tmp_path):
        for seed, names in ((1, ['a.mcap', 'd.mcap']), (2, ['b.mcap', 'c.mcap'])):
            write_unit(tmp_path, seed, 2, names=names)
        write_unit(tmp_path, 3, 1, serial='', names=['e.mcap'])
        (tmp_path / 'f.mcap').write_bytes(b'no bag')
        units = find_units(Storage(str(tmp_path)))
        # A bag without a serial belongs to a unit named as the folder; f.mcap is unreadable.
        assert {unit.name: list(unit.bags) for unit in units} == {
            'mems-0001': ['a.mcap', 'd.mcap'], 'mems-0002': ['b.mcap', 'c.mcap'],
            tmp_path.name: ['e.mcap'], 'f.mcap': ['f.mcap'],
        }  # fmt: skip

    def test_names_from_files_are_printed_on_one_line(self, tmp_path):
        write_unit(tmp_path / 'lot\x1b[31m' / 'a\nb', 1, 1)
        write_unit(tmp_path, 1, 1, serial='S1\nCAL_ACC0_ID 7', names=['loose.mcap'])
        units = find_units(Storage(str(tmp_path)))
        assert [unit.name for unit in units] == ['S1\\nCAL_ACC0_ID 7', 'lot\\x1b[31m/a\\nb']
        rows = [process_unit(unit, str(tmp_path), OPTIONS).row for unit in units]
        assert rows[0]['verdict'] == 'refused'
        assert str(rows[0]['problem']).startswith('`serial` must be one printable line')
        for row in rows:
            assert all(cell.isprintable() for cell in row.values() if isinstance(cell, str))

    def test_links_are_followed_except_in_circles(self, tmp_path):
        (tmp_path / 'store' / 'u1').mkdir(parents=True)
        (tmp_path / 'store' / 'u1' / '1.mcap').touch()
        fleet = tmp_path / 'fleet'
        fleet.mkdir()
        (fleet / 'unit').symlink_to(tmp_path / 'store' / 'u1')
        (fleet / 'again').symlink_to(fleet)
        (fleet / 'nowhere.mcap').symlink_to(tmp_path / 'gone')
        units = find_units(Storage(str(fleet)))
        assert [name for unit in units for name in unit.bags] == ['unit/1.mcap']

    def test_a_folder_that_cannot_be_read_is_named(self, tmp_path, monkeypatch):
        unread = '.hidden', 'lost+found'
        write_unit(tmp_path / 'u1', 1, 1)
        for name in ('u2', *unread):
            (tmp_path / name).mkdir()
        scan = os.scandir

        def refusing(path):
            if Path(path).name in ('u2', *unread):
                raise PermissionError(errno.EACCES, 'Permission denied', str(path))
            return scan(path)

        monkeypatch.setattr(os, 'scandir', refusing)
        reason = r'cannot be listed: Permission denied in .*/u2$'
        with pytest.raises(ThermoCompError, match=reason):
            find_units(Storage(str(tmp_path)))
        (tmp_path / 'u2').rmdir()
        assert [unit.name for unit in find_units(Storage(str(tmp_path)))] == ['u1']

    def test_folders_without_bags_and_unknown_protocols_are_refused_and_paths_are_absolute(
        self, tmp_path, monkeypatch
    ):
        with pytest.raises(ThermoCompError, match='no bag in it; expected DIR/UNIT/BAG'):
            find_units(Storage(str(tmp_path)))
        for url in (str(tmp_path / 'gone'), 'memory://never-made'):
            with pytest.raises(ThermoCompError, match='cannot be listed: no such directory'):
                find_units(Storage(url))
        with pytest.raises(ThermoCompError, match='nowhere://x: Protocol not known'):
            Storage('nowhere://x')
        monkeypatch.chdir(tmp_path)
        assert Storage('bags').address == str(tmp_path / 'bags')
        assert Storage('memory://bags').address == 'memory://bags'


def test_a_damaged_bag_is_not_reported_as_a_failure_of_the_file_system(tmp_path):
    (path,) = write_unit(tmp_path / 'u', 1, 1)
    damage(path)
    (units,) = find_units(Storage(str(tmp_path)))
    outcome = process_unit(units, str(tmp_path), OPTIONS)
    assert outcome.is_final
    assert str(outcome.row['left_out']).startswith('u/01.mcap: damaged: ')
    assert outcome.hashes == {'u/01.mcap': digest(path)}


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
    for name in ('verdict', 'reason', 'window_s'):
        assert row[name] == content[name]
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

        def ppm_k(curve):
            return float(curve.value(1e-3) - curve.value(-1e-3)) / 2e-3 * 1e6

        assert row['scale_slope_x_ppm_k'] == pytest.approx(ppm_k(slope), rel=1e-6)
        # The sd of the slope is that of 4000 slopes drawn from the posterior.
        block = parameter_layout(calibration).scale[0]
        rows = slice(block.static + 1, block.static + 1 + slope.n_free)
        covariance, rng = calibration.posterior.covariance()[rows, rows], np.random.default_rng(1)
        drawn = rng.multivariate_normal(slope.free_coefficients, covariance, 4000).tolist()
        slopes = [ppm_k(slope.with_free(tuple(row), 1.0)) for row in drawn]
        assert row['scale_slope_sd_x_ppm_k'] == pytest.approx(np.std(slopes), rel=0.05)
        assert row['board_lag_s'] == calibration.board_lag_s
        assert row['lowest_c'] < 10.0
        assert row['highest_c'] > 40.0
        assert row['start'] == '2026-01-01T00:00:01Z'
        assert 'mems-0001' in outcome.certificate
        assert 'class="simulated"' in outcome.certificate
        assert brief.certificate == ''
        for name in ('verdict', 'reservations'):
            assert brief.row[name] == row[name]
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
        assert row['chosen'] == '/imu/raw, the only Vector3Stamped of the bag, is taken for counts'

    def test_the_row_has_no_sd_of_a_slope_that_the_positions_do_not_determine(self, tmp_path):
        # WHY: the bias slope was the sum of the slopes of bias and scale, with an sd of 0.06 ug/K.
        write_unit(tmp_path / 'u', 1, 1)
        row = processed(tmp_path).row
        assert [row[f'bias_slope_sd_{axis}_ug_k'] for axis in 'xyz'] == [None] * 3
        assert [row[f'scale_slope_sd_{axis}_ppm_k'] for axis in 'xyz'] == [None] * 3

    def test_the_lag_of_a_board_that_changes_before_the_case_is_negative(self, tmp_path):
        # WHY: if the measured lag is negative, the calibration contains the default lag of 900 s.
        write_unit(tmp_path / 'u', 1, 4, is_exchanged=True)
        outcome = processed(tmp_path, fit=replace(OPTIONS.fit, allow=('swapped',)))
        assert outcome.row['board_lag_s'] < -100.0
        assert parse_calibration(outcome.calibration.encode()).board_lag_s == 900.0
