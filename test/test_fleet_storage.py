# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The bags of a fleet are found and read on a disk and in a storage of fsspec."""

import shutil
import tempfile
from dataclasses import replace
from uuid import uuid4

import pytest
from fleet_helpers import OPTIONS, damage, write_unit
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from thermo_comp.errors import ThermoCompError
from thermo_comp.fitting.sources import digest
from thermo_comp.fleet.units import (
    FoundUnit,
    Storage,
    StoredFile,
    find_units,
    folders_of_tables,
    group_files,
)
from thermo_comp.fleet.work import process_unit
from thermo_comp.unit.calibration_file import parse_calibration

fsspec = pytest.importorskip('fsspec', reason='fsspec is not installed: the extra `fleet`')


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
        alone, other = (
            process_unit(here, str(unit.parent), OPTIONS),
            process_unit(there, url, OPTIONS),
        )
        first, second = (parse_calibration(text.calibration.encode()) for text in (alone, other))
        assert replace(first, provenance=second.provenance) == second
        assert first.provenance.sources == second.provenance.sources
        assert other.hashes == {name: digest(unit.parent / name) for name in here.bags}

    @pytest.mark.parametrize('name', ['pos1', 'pos1.db3'])
    def test_bags_of_any_storage_are_read_from_a_url_and_leave_no_copy(
        self, name, tmp_path, memory, monkeypatch
    ):
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

    def test_an_unknown_protocol_is_refused(self):
        with pytest.raises(ThermoCompError, match='nowhere://x: Protocol not known'):
            Storage('nowhere://x')


class TestDiscovery:
    @pytest.mark.parametrize(
        ('files', 'bags'),
        [
            (['u/1.mcap', 'u/2.mcap', 'u/notes.txt'], ['u/1.mcap', 'u/2.mcap']),
            (['u/p1/metadata.yaml', 'u/p1/p1_0.mcap', 'u/p1/p1_1.mcap'], ['u/p1']),
            # Bags without metadata.yaml, as after a recorder was killed.
            (['u/p1/p1_0.mcap', 'u/p2/p2_0.db3'], ['u/p1', 'u/p2']),
            (['u/u_a.mcap'], ['u/u_a.mcap']),
            (['top.bag', 'u/x.db3'], ['top.bag', 'u/x.db3']),
        ],
    )
    def test_files_of_a_folder_are_grouped_into_bags(self, files, bags):
        stored = [StoredFile(name, 1, '') for name in files]
        assert list(group_files(stored)) == bags

    def test_folders_give_unit_and_lot(self, tmp_path):
        for name in ('lot-A/u1/1.mcap', 'lot-A/u1/2.mcap', 'lot-B/u2/1.mcap', 'u3/1.mcap'):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
        (tmp_path / 'u4').mkdir()
        (tmp_path / 'u4' / 'log.csv').touch()
        (tmp_path / 'u3' / 'truth.csv').touch()
        (tmp_path / 'out').mkdir()
        (tmp_path / 'out' / 'fleet.csv').touch()
        (tmp_path / '.hidden').mkdir()
        (tmp_path / '.hidden' / 'x.mcap').touch()
        units = find_units(Storage(str(tmp_path)))
        assert [(unit.name, unit.lot, len(unit.bags)) for unit in units] == [
            ('lot-A/u1', 'lot-A', 2),
            ('lot-B/u2', 'lot-B', 1),
            ('u3', '', 1),
        ]
        # WHY: a unit with tables and no bags was left out without a message.
        assert folders_of_tables(Storage(str(tmp_path))) == ('u4',)

    def test_bags_without_folders_are_sorted_by_serial(self, tmp_path):
        for seed, names in ((1, ['a.mcap', 'd.mcap']), (2, ['b.mcap', 'c.mcap'])):
            write_unit(tmp_path, seed, 2, names=names)
        write_unit(tmp_path, 3, 1, serial='', names=['e.mcap'])
        (tmp_path / 'f.mcap').write_bytes(b'no bag')
        units = find_units(Storage(str(tmp_path)))
        assert {unit.name: list(unit.bags) for unit in units} == {
            'mems-0001': ['a.mcap', 'd.mcap'],
            'mems-0002': ['b.mcap', 'c.mcap'],
            # A bag without a serial belongs to a unit named like the folder; f.mcap is unreadable.
            tmp_path.name: ['e.mcap'],
            'f.mcap': ['f.mcap'],
        }

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

    def test_a_relative_path_of_a_fleet_becomes_absolute(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert Storage('bags').address == str(tmp_path / 'bags')
        assert Storage('memory://bags').address == 'memory://bags'

    def test_a_folder_without_bags_is_refused(self, tmp_path):
        with pytest.raises(ThermoCompError, match='no bag in it; expected DIR/UNIT/BAG'):
            find_units(Storage(str(tmp_path)))
        for url in (str(tmp_path / 'gone'), 'memory://never-made'):
            with pytest.raises(ThermoCompError, match='cannot be listed: no such directory'):
                find_units(Storage(url))


def test_a_damaged_bag_is_not_reported_as_a_failure_of_the_file_system(tmp_path):
    (path,) = write_unit(tmp_path / 'u', 1, 1)
    damage(path)
    (units,) = find_units(Storage(str(tmp_path)))
    outcome = process_unit(units, str(tmp_path), OPTIONS)
    assert outcome.is_final
    assert str(outcome.row['left_out']).startswith('u/01.mcap: damaged: ')
    assert outcome.hashes == {'u/01.mcap': digest(path)}
