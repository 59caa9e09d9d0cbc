# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate prints the laboratory's statements, correct budgets and rounded values."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import strangers_cases as cases
from builders import source_of
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from report_helpers import evidence, fitted, write_bag

from thermo_comp.cli.output import micro_g
from thermo_comp.errors import ThermoCompError
from thermo_comp.fitting import FitOptions, fit
from thermo_comp.judging.verdicts import Verdict
from thermo_comp.report.certificate import (
    budget,
    combined,
    conformity,
    over_temperature,
    results,
    table_temperatures,
)
from thermo_comp.report.evidence import evidence_of_bags, evidence_of_fit
from thermo_comp.report.page import render_report
from thermo_comp.report.statements import CertificateInfo, load_certificate_info
from thermo_comp.report.style import rounded
from thermo_comp.unit.calibration import LackOfFit
from thermo_comp.unit.calibration_file import (
    dump_calibration,
    load_calibration,
    parse_calibration,
    save_calibration,
)
from thermo_comp.unit.gravity import MICRO_G
from thermo_comp.unit.prediction import in_a_soak

pytestmark = pytest.mark.usefixtures('equal_fits_once', 'no_figures')

#: Name of the budget's row for the error on data left out of the fit.
LACK = 'lack of fit'
LAB = """
number: 2026-017
laboratory: {name: Inertial Lab, address: 1 Street, accreditation: L-1}
customer: {name: A Customer}
place: Room 2, Exampleton
operator: A. Person
unit: {maker: ACME, model: TRI-3, serial: thermostatted-0001, condition: undamaged}
instruments:
  - {name: chamber, model: CX, serial: '4711', traceability: certificate 3 of 2025}
gravity: {standard_uncertainty_m_s2: 2.0e-5, source: absolute gravimeter}
thermometers: {standard_uncertainty_k: 0.05}
dates: {receipt: 2026-02-20, test: 2026-03-01, issue: 2026-03-31, due: 2027-03-31}
conditions: (23 ± 1) °C
signatory: B. Person
"""


def lab(folder, text=LAB):
    path = folder / 'lab.yaml'
    path.write_text(text, encoding='utf-8')
    return path


@pytest.mark.parametrize(
    ('value', 'expanded', 'text'),
    [
        (302.95873, 0.01319, ('302.959', '0.013')), (1954.9, 21.7, ('1955', '22')),
        (-356.26, 199.6, ('−360', '200')), (0.0123, 0.0996, ('0.01', '0.10')),
        (-0.3, 15.0, ('0', '15')), (12345.6, 9960.0, ('12000', '10000')),
        (1.23456789, math.nan, ('1.23457', '–')), (1.5, 0.0, ('1.50000', '–')),
    ],
)  # fmt: skip
def test_uncertainties_have_two_digits_and_values_end_at_the_same_digit(value, expanded, text):
    assert rounded(value, expanded) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e5))
def test_rounding_changes_a_value_by_at_most_half_a_digit(value, expanded):
    text, of_it = rounded(value, expanded)
    assert float(of_it) == pytest.approx(expanded, rel=0.0501)
    assert len(of_it.replace('.', '').strip('0')) <= 2
    # Rounding to two digits changes an uncertainty by at most 5 %.
    assert abs(float_of(text) - value) <= 0.0501 * expanded + 1e-9 * abs(value)


def test_statements_of_a_laboratory_are_printed_and_missing_statements_are_blank(tmp_path):
    page = render_report(evidence(), load_certificate_info(lab(tmp_path), 'thermostatted-0001'))
    for text in (
        *('2026-017', 'Inertial Lab', '1 Street', 'L-1', 'A Customer', 'A. Person', 'ACME'),
        *('TRI-3', 'certificate 3 of 2025', '2e-05 m/s²', 'absolute gravimeter', '2026-03-01'),
        *('2026-03-31', '2027-03-31', '(23 ± 1) °C', 'B. Person', 'thermostatted-0001'),
        *('Room 2, Exampleton', 'undamaged', '2026-02-20'),
    ):
        assert text in page, text
    # Two fields are blank: the customer's address, and the place of the signature.
    assert page.count('class="blank"') == 2
    # The margin of each printed page shows certificate number and serial, in CSS escapes.
    number, unit = '2026\\00002d017', 'thermostatted\\00002d0001'
    assert f'certificate\\000020{number}\\00002c\\000020unit\\000020{unit}' in page
    order = [
        *('Certificate number', 'Laboratory', 'Customer', 'Unit, maker', 'Date of test'),
        'Conditions',
        *('>Instruments', 'Local gravity', '>Method', '>Results', '>Results over temperature'),
        *('>Uncertainty budget', '>Statement of conformity', '>Range of validity'),
        *('reproduced in full only', 'Authorised by', '>End of the certificate'),
    ]
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert render_report(evidence()).count('class="blank"') == 21


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('numbr: 1', 'numbr: unknown key'),
        ('number: 17', 'number: must be a valid text, got 17'),
        ('laboratory: Inertial Lab', 'laboratory: must be a mapping of keys'),
        ('gravity: {standard_uncertainty_m_s2: small}', 'gravity.standard_uncertainty_m_s2: must'),
        ('gravity: {standard_uncertainty_m_s2: -1.0}', 'must be at least 0'),
        ('instruments: [{model: CX}]', 'instruments[0].name: this key is missing'),
        ('dates: {due: tomorrow}', 'dates.due: must be a date like 2026-03-31'),
        ('unit: {serial: other}', 'serial: must be unit-1, as in the calibration, got other'),
        ('- number', 'must be a mapping of keys'),
        ('a: *b', 'YAML aliases are not accepted'),
        ('operator: ' + 'x' * 70_000, 'bytes, at most'),
    ],
)
def test_a_wrong_entry_in_the_statements_gives_a_message_of_one_line(tmp_path, text, said):
    path = lab(tmp_path, text)
    with pytest.raises(ThermoCompError) as caught:
        load_certificate_info(path, 'unit-1')
    message = str(caught.value)
    assert message.startswith(f'{path}: ')
    assert said in message
    assert '\n' not in message


def test_the_example_of_statements_equals_the_documentation_and_other_files_are_refused(tmp_path):
    example = ROOT / 'config' / 'lab.example.yaml'
    info = load_certificate_info(example)
    assert info.gravity.source == 'national gravity network'
    assert [instrument.name for instrument in info.instruments] == ['chamber', 'thermometers']
    page = (ROOT / 'docs' / 'recording.md').read_text(encoding='utf-8')
    assert example.read_text(encoding='utf-8') in page
    with pytest.raises(ThermoCompError, match='cannot be read: No such file'):
        load_certificate_info(tmp_path / 'none.yaml')
    (tmp_path / 'binary.yaml').write_bytes(b'number: \xff')
    with pytest.raises(ThermoCompError, match='not UTF-8 text'):
        load_certificate_info(tmp_path / 'binary.yaml')
    (tmp_path / 'empty.yaml').write_text('')
    assert load_certificate_info(tmp_path / 'empty.yaml') == CertificateInfo()


def test_the_uncertainty_budget_adds_up_to_the_claimed_sd_or_a_larger_residual(tmp_path):
    standards = {source.name: source.standard for source in budget(evidence(), CertificateInfo())}
    assert standards['gravity'] is None
    assert standards['thermometers'] is None
    # The claimed sd squared is the sum of the squares of these four rows of the budget.
    windows = evidence().judgement.windows
    claim = float(np.sqrt(np.mean(windows.claimed_sd[windows.is_inside] ** 2)))
    parts = [standards[name] for name in ('noise', 'attitude', LACK, 'model')]
    assert float(np.linalg.norm(parts)) == pytest.approx(claim)
    assert standards['repeatability'] == 0.0
    stated = budget(evidence(), load_certificate_info(lab(tmp_path)))
    by_name = {contribution.name: contribution.standard for contribution in stated}
    assert by_name['gravity'] == 2e-5
    assert combined(stated) == pytest.approx(math.hypot(claim, 2e-5, by_name['thermometers']))
    judgement, claim = evidence().judgement, combined(budget(evidence(), CertificateInfo()))
    doubtful = replace(evidence(), judgement=replace(judgement, left_out_rms=3.0 * claim))
    standards = {source.name: source.standard for source in budget(doubtful, CertificateInfo())}
    whole = combined(budget(doubtful, CertificateInfo()))
    assert standards['repeatability'] == pytest.approx(8.0**0.5 * claim)
    assert whole == pytest.approx(3.0 * claim)


@pytest.mark.slow
def test_the_lack_of_fit_is_a_row_of_the_budget_and_not_part_of_the_model():
    def with_lack(*sds):
        points = [LackOfFit(c, (sd,) * 3) for c, sd in zip((15.0, 30.0), sds, strict=True)]
        sets = [
            replace(part, lack_of_fit=tuple(points)) for part in fitted().calibration.regime_sets()
        ]
        unit = replace(fitted().calibration, static=sets[0], dynamic=sets[1])
        judged = evidence_of_bags(fitted().bags, unit, serial='')
        lines = budget(judged, CertificateInfo())
        return judged.judgement.windows, {line.name: line.standard for line in lines}, lines

    _, without, _ = with_lack(0.0, 0.0)
    assert without[LACK] == 0.0
    windows, standards, lines = with_lack(1e-3, 2e-3)
    # The variance of the lack of fit is linear between 15 and 30 degC, and equal on all axes.
    variance = 1e-6 + 3e-6 * np.clip((windows.board - 15.0) / 15.0, 0.0, 1.0)
    # The regime may be unknown for five minutes: then the variances of both sets add.
    known = windows.time > 300.0
    np.testing.assert_allclose(windows.lack_sd[known] ** 2, variance[known], rtol=0.01)
    assert (windows.lack_sd**2 / variance).max() == pytest.approx(2.0, rel=0.01)
    lack = float(np.sqrt(np.mean(windows.lack_sd[windows.is_inside] ** 2)))
    assert standards[LACK] == pytest.approx(lack)
    assert standards['model'] == pytest.approx(without['model'], rel=0.005)
    claim = float(np.sqrt(np.mean(windows.claimed_sd[windows.is_inside] ** 2)))
    assert combined(lines) == pytest.approx(claim)


@pytest.mark.slow
def test_the_budget_of_a_unit_with_a_kink_names_the_lack_of_fit():
    # The slope of the bias changes by 8 to 20 ug/K at one temperature, which no cubic describes.
    (study,) = cases.kink(2)
    sources = []
    for bag in study.bags:
        series = (bag.time_s, bag.samples), bag.temperatures['board'], bag.temperatures['case']
        arrays = [
            part for time_s, of in series for part in (np.rint(1e9 * time_s).astype(int), of)
        ]
        sources.append(source_of(*arrays, name=bag.name))
    options = FitOptions(gravity=study.gravity, groups=('curve',), **study.options)
    judged = evidence_of_fit(fit(sources, options))
    lines = budget(judged, CertificateInfo())
    standards = {line.name: line.standard for line in lines}
    # The drift on left-out data consists of the lack of fit and of the noise of the fit.
    left_out = judged.calibration.provenance.left_out_drift
    assert 0.3 * left_out < standards[LACK] < left_out
    windows = judged.judgement.windows
    claim = float(np.sqrt(np.mean(windows.claimed_sd[windows.is_inside] ** 2)))
    assert combined(lines) == pytest.approx(claim)


def test_the_uncertainty_of_scale_factors_contains_that_of_gravity_or_is_withheld(tmp_path):
    # WHY: U = 0.00037 was printed for the scale factor, as if gravity had no error.
    rows = {result.quantity: result for result in results(evidence(), CertificateInfo(), ())}
    assert rows['scale factor x'].expanded == '–'
    assert rows['bias x'].expanded != '–'
    page = render_report(evidence())
    assert 'U of the scale factors and of |f| − g is withheld' in page
    assert 'combined, without gravity' in page
    info = load_certificate_info(lab(tmp_path))
    assert 'withheld' not in render_report(evidence(), info)
    # WHY: calibration files did not store gravity's sd, so U was withheld after a fit.
    unit = replace(evidence().calibration, gravity_sd_m_s2=2e-5)
    stated = replace(evidence(), calibration=parse_calibration(dump_calibration(unit).encode()))
    page = render_report(stated)
    assert 'withheld' not in page
    # WHY: all expanded uncertainties contained gravity's sd, but its line on the page was blank.
    assert re.search(r'Standard uncertainty of gravity<[^0-9]*2e-05 m/s²', page)
    assert {source.name: source.standard for source in budget(stated, info)}['gravity'] == 2e-5
    info = load_certificate_info(lab(tmp_path, 'gravity: {standard_uncertainty_m_s2: 9.80665e-3}'))
    rows = {result.quantity: result for result in results(evidence(), info, ())}
    scale = fitted().calibration.axes.x.scale_factor
    # The relative uncertainty of gravity, 1e-3, dominates U = 2e-3 of the scale factor.
    assert float(rows['scale factor x'].expanded) == pytest.approx(2e-3 * scale, rel=0.05)
    assert rows['bias x'] in results(evidence(), CertificateInfo(), ())


def float_of(cell):
    return float(cell.replace('−', '-'))


def test_the_table_over_temperature_agrees_with_the_calibration(tmp_path):
    tables = over_temperature(evidence(), load_certificate_info(lab(tmp_path)))
    assert [table.axis for table in tables] == ['x', 'y', 'z']
    calibration = fitted().calibration
    for k, table in enumerate(tables):
        assert len({program for program, *_ in table.rows}) == 3
        for cells in (cells for program, *cells in table.rows if program == 'soak'):
            at, *numbers = map(float_of, cells)
            bias, sd, scale, scale_sd = in_a_soak(calibration, at)
            # Values and temperatures are rounded, so the tolerance is half of the last digit.
            slack = 0.06 * abs(table.bias_slope) + 0.06 * numbers[1]
            assert numbers[0] == pytest.approx(bias[k] / MICRO_G, abs=slack)
            assert numbers[1] == pytest.approx(2.0 * sd[k] / MICRO_G, rel=0.06)
            *_, scale_0, _ = in_a_soak(calibration)
            slack = 0.06 * abs(table.scale_slope) + 0.06 * numbers[4]
            assert numbers[3] == pytest.approx(1e6 * (scale[k] / scale_0[k] - 1.0), abs=slack)
            gravity = 2e-5 / calibration.gravity_m_s2
            assert numbers[4] == pytest.approx(2e6 * math.hypot(scale_sd[k], gravity), rel=0.06)


def without_uncertainty(calibration):
    def plain(part):
        axes = {name: replace(getattr(part, name), residual_sd_m_s2=0.0) for name in 'xyz'}
        return replace(part, lack_of_fit=(), **axes)

    static, dynamic = map(plain, calibration.regime_sets())
    sds = {'posterior': None, 'misalignment_sd': (0.0, 0.0, 0.0)}
    return replace(calibration, static=static, dynamic=dynamic, **sds)


@pytest.mark.parametrize('is_known', [True, False])
def test_values_and_deviations_have_equal_decimals_if_u_is_withheld(is_known, tmp_path):
    # WHY: the scale was printed without decimals, -1777 ppm, its deviation with two, 23.12 ppm.
    calibration = fitted().calibration
    if not is_known:
        calibration = without_uncertainty(calibration)
        assert not calibration.has_uncertainty
    withheld = over_temperature(replace(evidence(), calibration=calibration), CertificateInfo())
    stated = over_temperature(evidence(), load_certificate_info(lab(tmp_path)))
    n_withheld = 0
    for table, whole in zip(withheld, stated, strict=True):
        for row, other in zip(table.rows, whole.rows, strict=True):
            cells, others = row[2:], other[2:]
            for k in (0, 3):
                text, expanded, deviation = cells[k : k + 3]
                n_withheld += expanded == '–'
                assert len(text.partition('.')[2]) == len(deviation.partition('.')[2])
                for value, place in ((text, k), (deviation, k + 2)):
                    half = 0.5 * 10.0 ** -len(value.partition('.')[2])
                    number, expected = map(float_of, (value, others[place]))
                    tolerance = half + 0.06 * float(others[k + 1])
                    assert number == pytest.approx(expected, abs=tolerance)
    assert n_withheld == sum(len(table.rows) for table in withheld) * (1 if is_known else 2)


@pytest.mark.parametrize(
    ('ends', 'expected'),
    [
        ((-20.2, 61.3), [-20.2, 0.0, 20.0, 40.0, 61.3]),
        *(((14.9, 30.1), [14.9, 20.0, 25.0, 30.1]), ((20.0, 20.5), [20.0, 20.5])),
    ],
)
def test_temperatures_of_the_table_are_round_numbers(ends, expected):
    assert table_temperatures(*ends).tolist() == expected


def test_conformity_is_stated_only_with_a_tolerance():
    judgement = replace(evidence().judgement, tolerance=100.0 * MICRO_G)
    statement, rule = conformity(replace(evidence(), judgement=judgement))
    assert statement == 'The unit conforms to the limit of 100 µg.'
    assert 'guard band 0' in rule
    beyond = replace(judgement, kind=Verdict.RECALIBRATE)
    assert 'does not conform' in conformity(replace(evidence(), judgement=beyond))[0]
    for judged in (replace(judgement, kind=Verdict.OUTSIDE), evidence().judgement, None):
        statement, rule = conformity(replace(evidence(), judgement=judged))
        assert statement == ''
        assert 'o statement of conformity is made' in rule


def test_a_fit_in_one_pose_states_that_the_error_on_data_left_out_is_a_drift(cli, tmp_path):
    # WHY: after a fit to one pose the drift of left-out data was printed as the error |f| - g.
    bag, page, unit = write_bag(tmp_path / '01.mcap'), tmp_path / 'fit.html', tmp_path / 'fit.yaml'
    given = ('--gravity', '9.80665', '--groups', 'curve,set', '--report', page, '--json')
    facts = json.loads(cli('fit', bag, '-o', unit, *given).stdout)
    text = page.read_text(encoding='utf-8')
    assert text.count('Left out: RMS drift of an axis (force less its mean in the position)') == 2
    assert 'by a fit to the other positions' not in text
    (row,) = (row for row in facts['residuals_m_s2'] if row['section'] == 'all')
    known = load_calibration(unit).provenance
    assert math.isnan(known.left_out_rms)
    assert known.left_out_drift == row['left_out_drift']['rms'] == row['left_out']['rms'] > 0.0
    shown = cli('info', unit).stdout
    drift = micro_g(known.left_out_drift)
    assert re.search(rf'^all +\d+ .* - +{re.escape(drift)}$', shown, re.MULTILINE)
    # The file of an earlier version has no left-out drift.
    older = re.sub(r',\s+left_out_drift_m_s2: \S+}', '}', unit.read_text(encoding='utf-8'))
    assert math.isnan(parse_calibration(older.encode()).provenance.left_out_drift)
    chosen = [model for model in facts['models'] if model['is_chosen']]
    assert len(chosen) == 1
    assert {model['is_near'] for model in chosen} == {False}


def test_fit_and_report_print_the_statements_of_a_laboratory(cli, tmp_path):
    save_calibration(fitted().calibration, tmp_path / 'unit.yaml')
    given = ('-c', tmp_path / 'unit.yaml', '-o', tmp_path / 'page.html', '--certificate-info')
    cli('report', *given, lab(tmp_path))
    assert 'Inertial Lab' in (tmp_path / 'page.html').read_text(encoding='utf-8')
    bag = write_bag(tmp_path / '01.mcap')
    known = ('--gravity', '9.80665', '--groups', 'curve', '--certificate-info')
    arguments = ('fit', bag, '-o', tmp_path / 'fit.yaml', *known)
    cli(*arguments, lab(tmp_path), '--report', tmp_path / 'fit.html')
    page = (tmp_path / 'fit.html').read_text(encoding='utf-8')
    assert 'Inertial Lab' in page
    assert 'class="simulated"' in page
    assert '1 position in bags of the fit' in page
    assert '--report' in cli(*arguments, lab(tmp_path), '--force', code=2).stderr
    refused = cli('report', *given, lab(tmp_path, 'number: 17'), '--force', code=1)
    assert 'lab.yaml: number: must be a valid text, got 17' in refused.stderr
