# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""One judge: commands that look at the same bags with the same calibration say the same."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fleet_helpers import OPTIONS, write_unit
from report_helpers import fitted, write_bag

from thermo_comp.report.html import number
from thermo_comp.unit.calibration_file import save_calibration

FACTS = (
    *('verdict', 'reason', 'is_valid', 'gravity_m_s2', 'window_s', 'tolerance_m_s2'),
    *('sections_m_s2', 'n_positions', 'moved', 'shifts', 'axis_rms_m_s2'),
)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('judge')
    save_calibration(fitted().calibration, folder / 'unit.yaml')
    write_bag(folder / 'held_out.mcap')
    return folder


@pytest.mark.parametrize('options', [(), ('--tolerance', '1ug', '--window', '120')])
def test_evaluate_and_report_agree(cli, folder: Path, options: tuple[str, ...]) -> None:
    # WHY: of one bag and one calibration one said "re-calibrate", the other "holds".
    page = folder / f'page{len(options)}.html'
    given = (folder / 'held_out.mcap', '-c', folder / 'unit.yaml', *options, '--json')
    one = cli('evaluate', *given, code=None)
    other = cli('report', *given, '-o', page, code=None)
    ours, theirs = json.loads(one.stdout), json.loads(other.stdout)
    for name in FACTS:
        assert ours[name] == theirs[name], name
    assert one.returncode == other.returncode == (0 if ours['is_valid'] else 1)
    assert ours['window_s'] == float(options[3] if options else 60)
    # The page shows these very figures, and no other length of a window.
    text = page.read_text(encoding='utf-8')
    assert f'means over {ours["window_s"]:g} s' in text
    assert ours['verdict'].replace(' ug', ' µg') in text
    for section in ours['sections_m_s2'].values():
        if section['n']:
            for name in ('raw_rms', 'rms', 'peak', 'claimed_rms'):
                assert f'>{number(section[name] / 9.80665e-6)}<' in text


def test_fleet_and_evaluate_agree(cli, tmp_path: Path) -> None:
    pytest.importorskip('fsspec', reason='fsspec is not installed: the extra `fleet`')
    from thermo_comp.fleet.units import Storage, find_units
    from thermo_comp.fleet.work import process_unit

    bags = write_unit(tmp_path / 'fleet' / 'unit1', 1)
    (unit,) = find_units(Storage(str(tmp_path / 'fleet')))
    outcome = process_unit(unit, str(tmp_path / 'fleet'), OPTIONS)
    assert outcome is not None
    row = outcome.row
    calibration = tmp_path / 'unit.yaml'
    calibration.write_text(outcome.calibration)
    found = json.loads(cli('evaluate', *bags, '-c', calibration, '--json', code=None).stdout)
    assert row['verdict'] == found['verdict']
    assert row['reason'] == found['reason']
    assert row['window_s'] == found['window_s']
    micro_g = 9.80665e-6
    sections = found['sections_m_s2']
    for section in ('static', 'dynamic', 'all'):
        assert row[f'{section}_ug'] == pytest.approx(sections[section]['rms'] / micro_g)
    for cell, name in (('raw_ug', 'raw_rms'), ('peak_ug', 'peak'), ('claimed_ug', 'claimed_rms')):
        assert row[cell] == pytest.approx(sections['all'][name] / micro_g)
