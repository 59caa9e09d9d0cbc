# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A fleet's bags are found wherever they lie, read by ranges, and each byte of them only once."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from fleet_helpers import OPTIONS, damage, write_unit
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.errors import FleetError
from thermo_comp.fitting.fit_sources import digest
from thermo_comp.fleet.bag import FoundBag, group_files, reduce_found
from thermo_comp.fleet.discovery import find_units
from thermo_comp.fleet.storage import HashingFile, Storage, StoredFile

fsspec = pytest.importorskip('fsspec', reason='fsspec is not installed: the extra `fleet`')


@pytest.fixture(scope='module')
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('fleet') / 'unit'
    write_unit(folder, 1, 2)
    return folder


@pytest.fixture
def memory() -> Iterator[tuple[object, str]]:
    """Give an empty folder of fsspec's memory file system, and its URL."""
    fs = fsspec.filesystem('memory')
    name = f'/{uuid4().hex}'
    yield fs, f'memory:/{name}'
    if fs.exists(name):
        fs.rm(name, recursive=True)


class _Bytes:
    """A file that counts how often each of its bytes was read."""

    def __init__(self, content: bytes) -> None:
        self.content, self.size = content, len(content)
        self.times = np.zeros(self.size, dtype=np.int64)

    def read_at(self, at: int, n_bytes: int) -> bytes:
        self.times[at : at + n_bytes] += 1
        return self.content[at : at + n_bytes]

    def close(self) -> None:
        pass


@settings(max_examples=60, deadline=None)
@given(
    content=st.binary(max_size=3000),
    reads=st.lists(st.tuples(st.integers(0, 3200), st.integers(0, 1500)), max_size=12),
)
def test_a_file_is_hashed_in_whatever_order_it_is_read(
    content: bytes, reads: list[tuple[int, int]]
) -> None:
    file = HashingFile(_Bytes(content))
    for at, n_bytes in reads:
        assert file.read_at(at, n_bytes) == content[at : at + n_bytes]
    assert file.digest() == hashlib.sha256(content).hexdigest()


def test_the_hash_needs_no_second_reading(rng: np.random.Generator) -> None:
    content = rng.bytes(10_000)
    inner = _Bytes(content)
    file = HashingFile(inner)
    for piece in rng.permutation(10):
        file.read_at(1000 * int(piece), 1000)
    assert file.digest() == hashlib.sha256(content).hexdigest()
    assert inner.times.tolist() == [1] * 10_000


class TestElsewhere:
    def test_a_bag_in_memory_gives_the_bits_of_one_on_disk(
        self, unit: Path, memory: tuple[object, str]
    ) -> None:
        fs, url = memory
        fs.put(f'{unit}/', f'{url}/unit/', recursive=True)
        here = find_units(Storage(str(unit.parent)))
        there = find_units(Storage(url))
        assert [one.name for one in there] == [one.name for one in here] == ['unit']
        for local, remote in zip(here[0].bags, there[0].bags, strict=True):
            assert local.name == remote.name
            one, other = (
                reduce_found(where, bag, OPTIONS.fit, None, 'auto')
                for where, bag in ((str(unit.parent), local), (url, remote))
            )
            assert one.sha256 == other.sha256 == digest(unit.parent / local.name)
            assert one.reduced is not None
            assert other.reduced is not None
            for a, b in zip(one.reduced.intervals, other.reduced.intervals, strict=True):
                assert a.mean.tobytes() == b.mean.tobytes()
            assert one.reduced.board.value.tobytes() == other.reduced.board.value.tobytes()

    @pytest.mark.parametrize('block', [1 << 18, 1 << 10])
    def test_each_byte_comes_once(
        self, block: int, unit: Path, memory: tuple[object, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr('thermo_comp.fleet.storage._BLOCK_BYTES', block)
        fs, url = memory
        path = f'{url}/unit/01.mcap'
        content = (unit / '01.mcap').read_bytes()
        fs.pipe_file(path, content)
        fetched = Counter()
        plain = type(fs).cat_file

        def counting(self: object, name: str, start: int, end: int, **keys: object) -> bytes:
            fetched.update({'bytes': end - start})
            return plain(self, name, start=start, end=end, **keys)

        monkeypatch.setattr(type(fs), 'cat_file', counting)
        (found,) = find_units(Storage(url))
        result = reduce_found(url, found.bags[0], OPTIONS.fit, None, 'auto')
        assert result.sha256 == hashlib.sha256(content).hexdigest()
        # Small blocks stand for a large file: those that hold heads of records overlap a chunk.
        assert (
            len(content) <= fetched['bytes'] <= len(content) + (block < len(content)) * 8 * block
        )

    def test_a_rosbag2_folder_in_memory(self, tmp_path: Path, memory: tuple[object, str]) -> None:
        fs, url = memory
        write_unit(tmp_path / 'unit', 1, 1, names=['pos1'])
        fs.put(f'{tmp_path}/', f'{url}/', recursive=True)
        (found,) = find_units(Storage(url))
        assert [bag.name for bag in found.bags] == ['unit/pos1']
        result = reduce_found(url, found.bags[0], OPTIONS.fit, None, 'auto')
        assert result.problem == ''
        assert result.sha256 == digest(tmp_path / 'unit' / 'pos1')

    def test_what_needs_a_file_of_this_machine_is_said(self, memory: tuple[object, str]) -> None:
        fs, url = memory
        fs.pipe_file(f'{url}/unit/old.bag', b'#ROSBAG V2.0')
        (found,) = find_units(Storage(url))
        result = reduce_found(url, found.bags[0], OPTIONS.fit, None, 'auto')
        assert 'unit/old.bag: only MCAP is read from a distance' in result.problem

    def test_a_file_that_vanishes_may_come_back(self, memory: tuple[object, str]) -> None:
        _, url = memory
        gone = FoundBag('unit/a.mcap', (StoredFile('unit/a.mcap', 5, ''),))
        result = reduce_found(url, gone, OPTIONS.fit, None, 'auto')
        assert result.is_passing
        assert result.problem.startswith('unit/a.mcap: ')

    def test_a_protocol_that_nobody_knows(self) -> None:
        with pytest.raises(FleetError, match='nowhere://x: Protocol not known'):
            Storage('nowhere://x')


class TestDiscovery:
    @pytest.mark.parametrize(
        ('files', 'bags'),
        [
            (['u/1.mcap', 'u/2.mcap', 'u/notes.txt'], ['u/1.mcap', 'u/2.mcap']),
            (['u/p1/metadata.yaml', 'u/p1/p1_0.mcap', 'u/p1/p1_1.mcap'], ['u/p1']),
            # The recorder was killed before it wrote metadata.yaml.
            (['u/p1/p1_0.mcap', 'u/p2/p2_0.db3'], ['u/p1', 'u/p2']),
            (['u/u_a.mcap'], ['u/u_a.mcap']),
            (['top.bag', 'u/x.db3'], ['top.bag', 'u/x.db3']),
        ],
    )
    def test_files_to_bags(self, files: list[str], bags: list[str]) -> None:
        stored = [StoredFile(name, 1, '') for name in files]
        assert [bag.name for bag in group_files(stored)] == bags

    def test_a_folder_per_unit_and_lot(self, tmp_path: Path) -> None:
        for name in ('lot-A/u1/1.mcap', 'lot-A/u1/2.mcap', 'lot-B/u2/1.mcap', 'u3/1.mcap'):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
        (tmp_path / '.hidden').mkdir()
        (tmp_path / '.hidden' / 'x.mcap').touch()
        found = find_units(Storage(str(tmp_path)))
        assert [(one.name, one.lot, len(one.bags)) for one in found] == [
            ('lot-A/u1', 'lot-A', 2),
            ('lot-B/u2', 'lot-B', 1),
            ('u3', '', 1),
        ]

    def test_bags_without_folders_are_sorted_by_serial(self, tmp_path: Path) -> None:
        for seed, names in ((1, ['a.mcap', 'd.mcap']), (2, ['b.mcap', 'c.mcap'])):
            write_unit(tmp_path, seed, 2, names=names)
        write_unit(tmp_path, 3, 1, serial='', names=['e.mcap'])
        (tmp_path / 'f.mcap').write_bytes(b'no bag')
        found = find_units(Storage(str(tmp_path)))
        assert {one.name: [bag.name for bag in one.bags] for one in found} == {
            'mems-0001': ['a.mcap', 'd.mcap'],
            'mems-0002': ['b.mcap', 'c.mcap'],
            # Nothing says whose it is but the folder; and one that cannot even be asked.
            tmp_path.name: ['e.mcap'],
            'f.mcap': ['f.mcap'],
        }

    def test_links_are_followed_but_not_in_circles(self, tmp_path: Path) -> None:
        (tmp_path / 'store' / 'u1').mkdir(parents=True)
        (tmp_path / 'store' / 'u1' / '1.mcap').touch()
        fleet = tmp_path / 'fleet'
        fleet.mkdir()
        (fleet / 'unit').symlink_to(tmp_path / 'store' / 'u1')
        (fleet / 'again').symlink_to(fleet)
        (fleet / 'nowhere.mcap').symlink_to(tmp_path / 'gone')
        found = find_units(Storage(str(fleet)))
        assert [bag.name for one in found for bag in one.bags] == ['unit/1.mcap']

    def test_a_relative_path_is_the_same_for_every_process(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert Storage('bags').address == str(tmp_path / 'bags')
        assert Storage('memory://bags').address == 'memory://bags'

    def test_nothing_there(self, tmp_path: Path) -> None:
        with pytest.raises(FleetError, match='no bag in it; expected DIR/UNIT/BAG'):
            find_units(Storage(str(tmp_path)))
        with pytest.raises(FleetError, match='cannot be listed: no such directory'):
            find_units(Storage(str(tmp_path / 'gone')))
        with pytest.raises(FleetError, match='cannot be listed: no such directory'):
            find_units(Storage('memory://never-made'))


def test_damage_is_the_bag_s_not_the_file_system_s(tmp_path: Path) -> None:
    (path,) = write_unit(tmp_path / 'u', 1, 1)
    damage(path)
    (found,) = find_units(Storage(str(tmp_path)))
    result = reduce_found(str(tmp_path), found.bags[0], OPTIONS.fit, None, 'auto')
    assert result.reduced is None
    assert result.problem.startswith('u/01.mcap: damaged: ')
    assert not result.is_passing
    assert result.sha256 == digest(path)
    assert replace(result, cpu_s=0.0) == replace(
        reduce_found(str(tmp_path), found.bags[0], OPTIONS.fit, None, 'auto'), cpu_s=0.0
    )
