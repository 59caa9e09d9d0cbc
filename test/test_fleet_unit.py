# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A unit's fit is the same whoever reduced its bags, and says what became of each of them."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from fleet_helpers import OPTIONS, damage, write_unit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermo_comp.fitting import fit
from thermo_comp.fitting.fit_sources import fit_sources
from thermo_comp.fleet.discovery import FoundUnit, find_units
from thermo_comp.fleet.row import COLUMNS
from thermo_comp.fleet.storage import Storage
from thermo_comp.fleet.unit import (
    Statistics,
    UnitOutcome,
    conclude,
    merged,
    process_unit,
    reduce_unit,
)
from thermo_comp.unit.calibration import Calibration
from thermo_comp.unit.calibration_file import parse_calibration

pytest.importorskip('fsspec', reason='fsspec is not installed: the extra `fleet`')


def only_unit(folder: Path) -> FoundUnit:
    (unit,) = find_units(Storage(str(folder)))
    return unit


def numbers_of(outcome: UnitOutcome | None) -> dict[str, float]:
    """Return every number of a row that is not about the run itself."""
    assert outcome is not None
    return {
        name: cell
        for name, cell in outcome.row.items()
        if isinstance(cell, float) and name != 'cpu_s'
    }


def processed(folder: Path, **keys: object) -> UnitOutcome:
    outcome = process_unit(str(folder), only_unit(folder), replace(OPTIONS, **keys))
    assert outcome is not None
    assert list(outcome.row) == [column.name for column in COLUMNS]
    return outcome


@pytest.fixture(scope='module')
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('fleet')
    write_unit(folder / 'lot-A' / 'unit1', 1)
    return folder


@pytest.fixture(scope='module')
def statistics(fleet: Path) -> Statistics:
    return reduce_unit(str(fleet), only_unit(fleet), OPTIONS)


@pytest.fixture(scope='module')
def theirs(fleet: Path) -> Calibration:
    """Fit the unit as `thermo_comp fit` does."""
    sources, _ = fit_sources(sorted((fleet / 'lot-A' / 'unit1').iterdir()))
    return fit(sources, OPTIONS.fit).calibration


class TestTree:
    @settings(
        max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    @given(data=st.data())
    def test_any_tree_over_any_order_merges_to_the_same(
        self, statistics: Statistics, data: st.DataObject
    ) -> None:
        # A bag may come twice: its first worker died after it had sent its statistics.
        again = data.draw(st.lists(st.sampled_from(statistics), max_size=3))
        parts = [(one,) for one in data.draw(st.permutations([*statistics, *again]))]
        while len(parts) > 1:
            i = data.draw(st.integers(0, len(parts) - 2))
            parts[i : i + 2] = [merged(parts[i : i + 2])]
        assert all(a is b for a, b in zip(parts[0], statistics, strict=True))

    @settings(
        max_examples=3, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    @given(data=st.data())
    def test_the_fit_is_that_of_one_process(
        self, fleet: Path, statistics: Statistics, theirs: Calibration, data: st.DataObject
    ) -> None:
        order = data.draw(st.permutations(statistics))
        cut = data.draw(st.integers(1, len(order) - 1))
        parts = [tuple(order[:cut]), reduce(lambda a, b: merged([a, (b,)]), order[cut:], ())]
        outcome = conclude(only_unit(fleet), OPTIONS, parts)
        assert outcome is not None
        ours = parse_calibration(outcome.calibration)
        assert ours.provenance.sources == theirs.provenance.sources
        for part, other in zip(ours.regime_sets(), theirs.regime_sets(), strict=True):
            for axis, same in zip(part.axes(), other.axes(), strict=True):
                for name in ('bias_function', 'scale_function'):
                    np.testing.assert_allclose(
                        getattr(axis, name).coefficients,
                        getattr(same, name).coefficients,
                        rtol=1e-12,
                    )
        np.testing.assert_allclose(ours.misalignment, theirs.misalignment, rtol=1e-12)
        for name in 'xyz':
            one, same = getattr(ours.axes, name), getattr(theirs.axes, name)
            assert one.scale_factor == pytest.approx(same.scale_factor, rel=1e-12)
            assert one.bias == pytest.approx(same.bias, rel=1e-12)

    def test_statistics_are_far_smaller_than_their_bags(self, statistics: Statistics) -> None:
        import pickle

        size = len(pickle.dumps(statistics))
        assert size < 1_000_000
        assert pickle.loads(pickle.dumps(statistics))[0].name == statistics[0].name  # noqa: S301


class TestRow:
    def test_a_good_unit(self, fleet: Path) -> None:
        outcome = processed(fleet, certificates=True)
        row = outcome.row
        assert (row['name'], row['serial'], row['lot']) == ('lot-A/unit1', 'mems-0001', 'lot-A')
        assert row['verdict'].startswith('valid')
        assert row['reason'].startswith(f'{row["all_ug"]:.0f} ug RMS of |f| - g, ')
        assert (row['problem'], row['left_out']) == ('', '')
        assert (row['n_bags'], row['n_left_out'], row['n_positions']) == (6, 0, 6)
        calibration = parse_calibration(outcome.calibration)
        # A reading of x at the reference, from the row and from the file.
        x = calibration.axes.x
        bias = (x.bias + calibration.static.x.delta) / x.scale_factor
        assert row['bias_x_ug'] == pytest.approx(bias / 9.80665e-6)
        slope = calibration.static.x.scale_function
        assert row['scale_slope_x_ppm_k'] == pytest.approx(
            (slope.value(1e-3) - slope.value(-1e-3)) / 2e-3 * 1e6, rel=1e-6
        )
        assert row['lowest_c'] < 10.0
        assert row['highest_c'] > 40.0
        assert row['start'] == '2026-01-01T00:00:01Z'
        page = zlib.decompress(outcome.certificate).decode()
        assert 'mems-0001' in page
        brief = processed(fleet)
        assert brief.certificate == b''
        assert (brief.row['verdict'], brief.row['reservations']) == (
            row['verdict'],
            row['reservations'],
        )
        json.dumps(row, allow_nan=False)

    def test_a_corrupt_bag_costs_itself(self, tmp_path: Path) -> None:
        paths = write_unit(tmp_path / 'u', 2, 8)
        damage(paths[3])
        row = processed(tmp_path).row
        assert row['verdict'].startswith('valid')
        assert (row['n_bags'], row['n_left_out']) == (8, 1)
        assert row['left_out'].startswith('u/04.mcap: damaged: ')
        assert '1 of 8 bags are left out: u/04.mcap' in row['reservations']
        assert row['n_positions'] == 7

    def test_a_bag_that_was_cut_off_is_read_up_to_there(self, tmp_path: Path) -> None:
        paths = write_unit(tmp_path / 'u', 2, 7)
        content = paths[2].read_bytes()
        paths[2].write_bytes(content[:-300])
        row = processed(tmp_path).row
        assert row['verdict'].startswith('valid')
        assert (row['n_left_out'], row['n_torn']) == (0, 1)
        assert '03.mcap: the file is cut off at byte' in row['reservations']
        assert row['n_positions'] == 7

    def test_what_the_fit_refuses(self, tmp_path: Path) -> None:
        write_unit(tmp_path / 'u', 1, 4, is_exchanged=True)
        outcome = processed(tmp_path)
        assert outcome.row['verdict'] == 'refused'
        assert 'the board temperature leads the case' in outcome.row['problem']
        assert outcome.is_final
        assert outcome.calibration == b''

    def test_nothing_but_damage(self, tmp_path: Path) -> None:
        (path,) = write_unit(tmp_path / 'u', 1, 1)
        damage(path)
        row = processed(tmp_path).row
        assert (row['verdict'], row['problem']) == ('failed', 'none of its bags can be used')

    def test_bags_of_two_units_in_one_folder(self, tmp_path: Path) -> None:
        write_unit(tmp_path / 'u', 1, 1)
        write_unit(tmp_path / 'u', 2, 1, names=['x.mcap'])
        row = processed(tmp_path).row
        assert row['verdict'] == 'refused'
        assert row['problem'] == 'the bags are of different units: mems-0001, mems-0002'

    def test_the_lot_of_the_metadata_wins(self, tmp_path: Path) -> None:
        write_unit(tmp_path / 'shelf' / 'u', 1, 1, serial='', metadata={'lot': 'L7'})
        row = processed(tmp_path).row
        assert (row['lot'], row['serial']) == ('L7', 'u')


def test_a_result_that_is_there_is_not_made_again(fleet: Path, statistics: Statistics) -> None:
    unit = only_unit(fleet)
    first = conclude(unit, OPTIONS, [statistics])
    assert first is not None
    assert conclude(unit, OPTIONS, [statistics], first.key) is None
    other = replace(OPTIONS, fit=replace(OPTIONS.fit, gravity=9.81))
    again = conclude(unit, other, [statistics], first.key)
    assert again is not None
    assert again.key != first.key
