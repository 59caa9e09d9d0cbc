# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands give the same verdict for the same bags and the same calibration."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from report_helpers import fitted, write_bag

from thermo_comp.report.html import number
from thermo_comp.unit.calibration_file import save_calibration

pytestmark = pytest.mark.usefixtures('equal_fits_once')

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


@pytest.mark.usefixtures('no_figures')
@pytest.mark.parametrize('options', [(), ('--tolerance', '1ug', '--window', '120')])
def test_evaluate_and_report_agree(cli, folder: Path, options: tuple[str, ...]) -> None:
    # WHY: for one bag and calibration one command said "re-calibrate", another "holds".
    page = folder / f'page{len(options)}.html'
    given = (folder / 'held_out.mcap', '-c', folder / 'unit.yaml', *options, '--json')
    one = cli('evaluate', *given, code=None)
    other = cli('report', *given, '-o', page, code=None)
    ours, theirs = json.loads(one.stdout), json.loads(other.stdout)
    for name in FACTS:
        assert ours[name] == theirs[name], name
    assert one.returncode == other.returncode == (0 if ours['is_valid'] else 1)
    assert ours['window_s'] == float(options[3] if options else 60)
    # The page shows the same figures, with the same length of windows.
    text = page.read_text(encoding='utf-8')
    assert f'means over {ours["window_s"]:g} s' in text
    assert ours['verdict'].replace(' ug', ' µg') in text
    for section in ours['sections_m_s2'].values():
        if section['n']:
            for name in ('raw_rms', 'rms', 'peak', 'claimed_rms'):
                assert f'>{number(section[name] / 9.80665e-6)}<' in text
