# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Changes between calibrations of a unit are right; `evaluate` and `report` agree."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builders import axis_set, calibration, regime_set
from report_helpers import evidence, fitted, write_bag

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
    sources = (Source(created, created),)
    provenance = replace(unit.provenance, created=created, sources=sources)
    return replace(unit, provenance=provenance)


def test_changes_between_calibrations_equal_those_found_by_hand_if_they_form_a_history():
    # Dates give the order of calibrations. The change of z bias has the sd hypot(3, 4) = 5 ug.
    drifts = drifts_of(history_of([dated('2026-02-01', 20.0, 50.0, 4.0), dated('2026-01-01')]))
    names = [f'{kind} {axis}' for kind in ('bias', 'scale') for axis in 'xyz']
    assert [drift.constant for drift in drifts] == names
    *still, z = drifts[:3]
    assert (z.earlier, z.later, z.unit) == ('2026-01-01', '2026-02-01', 'ug')
    assert z.change == pytest.approx(20.0)
    assert z.sd == pytest.approx(5.0)
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
    drawn = json.loads(cli('report', *given, '-o', page).stdout)
    assert drawn['history'] == content['history']
    assert '2020-01-01' in page.read_text(encoding='utf-8')
    assert '<h2>History</h2>' not in render_report(evidence())
    # WHY: the calibration of another unit was left out of the history without a message.
    unit = replace(now.unit, serial='other')
    save_calibration(replace(now, unit=unit), tmp_path / 'other.yaml')
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
    # WHY: two commands printed contradictory verdicts on one bag and calibration.
    page = folder / f'page{len(options)}.html'
    given = (folder / 'held_out.mcap', '-c', folder / 'unit.yaml', *options, '--json')
    printed = cli('evaluate', *given, code=None)
    other = cli('report', *given, '-o', page, code=None)
    ours, theirs = json.loads(printed.stdout), json.loads(other.stdout)
    for name in FACTS:
        assert ours[name] == theirs[name], name
    assert printed.returncode == other.returncode == (0 if ours['is_valid'] else 1)
    assert ours['window_s'] == float(options[3] if options else 60)
    # The page of the report shows the figures of `evaluate`, from windows of the same length.
    text = page.read_text(encoding='utf-8')
    assert f'means over {ours["window_s"]:g} s' in text
    assert ours['verdict'].replace(' ug', ' µg') in text
    for section in ours['sections_m_s2'].values():
        if section['n']:
            for name in ('raw_rms', 'rms', 'peak', 'claimed_rms'):
                assert f'>{number(section[name] / 9.80665e-6)}<' in text
