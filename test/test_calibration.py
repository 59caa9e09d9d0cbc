# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files are read back to the bit, and messages on wrong entries name the key."""

import contextlib
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from builders import axis_set, calibration, regime_set, rich_calibration, term
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.errors import CalibrationError
from thermo_comp.thermal.settings import DetectorSettings
from thermo_comp.unit.calibration import AxisSet, parameter_layout
from thermo_comp.unit.calibration_file import (
    _FORMER,
    SIZE_LIMIT,
    dump_calibration,
    load_calibration,
    parse_calibration,
)
from thermo_comp.unit.functions import CubicSpline, Exponential
from thermo_comp.unit.provenance import GroupEvidence

# The largest accepted bias is twice the full scale of 32767 counts.
number = st.floats(-6.5e4, 6.5e4)
# With coefficients up to 1e-6 a scale function is near 1 over 15 K.
small = st.floats(-1e-6, 1e-6)
RICH = rich_calibration()


@st.composite
def functions(draw, at_reference):
    kind = draw(st.sampled_from(['polynomial', 'spline', 'exponential']))
    if kind == 'spline':
        values = [at_reference + draw(small), at_reference, at_reference + draw(small)]
        return CubicSpline((-9.5, 0.0, 7.25), tuple(values))
    if kind == 'exponential':
        amplitude = draw(small)
        return Exponential(at_reference - amplitude, (amplitude,), (draw(st.floats(5.0, 90.0)),))
    coefficients = tuple(draw(st.lists(small, max_size=4)))
    if at_reference:
        return axis_set(scale=(at_reference, *coefficients)).scale_function
    return axis_set((at_reference, *coefficients)).bias_function


@st.composite
def calibrations(draw):
    def drawn_set():
        bias_function, scale_function = draw(functions(0.0)), draw(functions(1.0))
        return AxisSet(bias_function, scale_function, delta=draw(number))

    def weights(numbers):
        return tuple(draw(numbers) for _ in range(3))

    terms = draw(st.lists(st.sampled_from(RICH.response), max_size=4))
    serials = st.text(min_size=1, max_size=20).filter(lambda s: s.isprintable())
    noted = GroupEvidence('gradient', 'bias', 1e-5, 2.5, draw(number), (draw(st.floats(0, 9)),))
    return replace(
        calibration(sensors=('case', 'frame')),
        response=tuple(replace(t, bias=weights(number), scale=weights(small)) for t in terms),
        evidence=(noted,),
        static=regime_set(drawn_set(), drawn_set(), drawn_set()),
        dynamic=regime_set(drawn_set(), drawn_set(), drawn_set()),
        unit=replace(calibration().unit, serial=draw(serials)),
    )


@given(calibrations())
@settings(max_examples=40, deadline=None)
def test_a_calibration_is_read_back_from_its_text_bit_for_bit(value):
    assert parse_calibration(dump_calibration(value).encode()) == value


@pytest.mark.parametrize('end_condition', ['board', 'case'])
def test_the_end_condition_of_the_dynamic_regime_is_in_the_file(end_condition):
    value = calibration(detector=DetectorSettings(end_condition=end_condition))
    text = dump_calibration(value)
    assert parse_calibration(text.encode()) == value
    without = text.replace(f'  end_condition: {end_condition}\n', '')
    assert without != text
    assert parse_calibration(without.encode()).detector.end_condition == 'board'


@pytest.mark.parametrize('serial', ['no', '1e5', '0x1F', '12', 'null', '~', 'a: b', '- x', '1:30'])
def test_serials_like_numbers_are_texts_and_numbers_may_have_any_yaml_notation(serial):
    text = dump_calibration(calibration(unit=replace(calibration().unit, serial=serial)))
    text = text.replace('full_scale: 32767.0', 'full_scale: 32767')
    unit = parse_calibration(text.replace('time_s: 0.01', 'time_s: 1e-02').encode()).unit
    assert (unit.serial, unit.full_scale, unit.cycle_time_s) == (serial, 32767.0, 0.01)


TEXT = dump_calibration(RICH)


@pytest.mark.parametrize(
    ('old', 'new', 'key', 'message'),
    [
        ('format_version: 2', 'format_version: 3', 'format_version', 'newer'),
        ('format_version: 2', 'format_version: 0', 'format_version', 'must be 2, got 0'),
        ('format_version: 2', 'format_version: 1\nmemory: 3', 'format_version', 'again'),
        ('format_version: 2', 'format_version: true', 'format_version', 'integer, got True'),
        ('format_version: 2', '', 'format_version', 'missing'),
        ('full_scale: 32767.0', 'full_scale: .nan', 'unit.full_scale', 'finite number, got nan'),
        ('full_scale: 32767.0', 'full_scale: true', 'unit.full_scale', 'valid number, got True'),
        ('full_scale: 32767.0', "full_scale: '9'", 'unit.full_scale', "valid number, got '9'"),
        ('full_scale: 32767.0', 'full_scale: -1.0', 'unit.full_scale', 'greater than 0, got -1'),
        ('full_scale: 32767.0', 'fullscale: 1.0', 'unit.fullscale', 'unknown key'),
        ('full_scale: 32767.0', '"full\\nscale": 1.0', r"unit.'full\nscale'", 'unknown key'),
        ('full_scale: 32767.0', f'{"x" * 999}: 1.0', "unit.'" + 'x' * 59, 'unknown key'),
        ('full_scale: 32767.0, ', '', 'unit.full_scale', 'missing'),
        ('serial: T-1', "serial: ''", 'unit.serial', 'at least 1 character'),
        ('gravity_m_s2: 9.80665', 'gravity_m_s2: 1.0', 'gravity_m_s2', 'greater than 9'),
        ('  y: {scale_factor: -295.0', '  w: {scale_factor: -295.0', 'axes.w', 'unknown key'),
        ('x: {scale_factor: 300.0', 'x: {scale_factor: 0.0', 'axes.x.scale_factor',
         r'must be 1e-09 to 1e\+09'),
        ('{scale_factor: 300.0', '{scale_factor: 1.0e-300', 'axes.x.scale_factor', 'got 1e-300'),
        ('0, bias: 5.0}', '0, bias: 1.0e+12}', 'axes.x.bias', 'within twice .*, 65534'),
        ('coefficients: [0.0, 0.3]', 'coefficients: [0.1, 0.3]', 'static.x.bias_function',
         'must be 0 at'),
        ('coefficients: [1.0, 7.0e-05]', 'coefficients: [1.1]', 'static.x.scale_function',
         'must be 1 at'),
        ('kind: polynomial', 'kind: fourier', 'static.x.bias_function.kind',
         "'exponential'.*, got 'fo"),
        ('      kind: polynomial\n', '', 'static.x.bias_function.kind', 'missing'),
        ('[5.0, 35.0]', '[5.0]', 'static.temperature_range_c', 'must have 2 entries, got 1'),
        ('[5.0, 35.0]', '5.0', 'static.temperature_range_c', 'must be a list, got 5.0'),
        ('[1.0, 7.0e-05]', '[1.0, -0.2]', 'static.x.scale_function', 'must stay above 0.1'),
        ('[5.0, 35.0]', '[35.0, 5.0]', 'static.temperature_range_c', 'must be'),
        ('- [1.0, 0.0, 0.0]', '- [1.0, 0.1, 0.0]', 'misalignment[0][1]', 'must be 0'),
        ('- [1.0, 0.0, 0.0]', '- [1.1, 0.0, 0.0]', 'misalignment[0][0]', 'must be 1'),
        ('- [0.001, 1.0, 0.0]', '- [0.7, 1.0, 0.0]', 'misalignment[1][0]', 'below 0.5'),
        ('sensors: [case, frame]', 'sensors: [case]', 'response[1].sensor', "got 'frame'"),
        ('sensors: [case, frame]', 'sensors: [case, case]', 'sensors', 'different names'),
        ('sensors: [case, frame]', 'sensors: []', 'sensors', 'must be one or more'),
        ('sensors: [case, frame]', 'sensors: [board]', 'sensors', 'none of them board'),
        ('- kind: gradient\n', '- kind: then\n', 'response[0].kind', "'gradient', .* got 'then'"),
        ('tau_s: 600.0', 'tau_s: 0.0', 'response[3].tau_s', 'greater than 0 for board, got 0'),
        ('tau_s: 600.0', 'tau_s: -1.0', 'response[3].tau_s', 'must be at least 0, got -1.0'),
        ('width_k: 1.5', 'width_k: 0.0', 'response[7].width_k',
         'greater than 0 for gradient_even'),
        ('power: 1', 'power: 1.5', 'response[6].power', 'valid integer, got 1.5'),
        ('range: [-0.1, 0.1]', 'range: [1, 1]', 'response[2].range', r'lower < upper, got \[1'),
        ('[2.0e-05, 2.0e-05, 2.0e-05]', '[2.0e-05]', 'response[0].scale', 'must have 3 entries'),
        ('scale: [2.0e-05', 'scale: [0.1', 'static.x.scale_function', 'above 0.1 .* reaches -4'),
        ('rank: ', 'rank: 9', 'posterior.factor', 'must hold 105 x 9105 numbers'),
        ('rank: ', 'rank: -', 'posterior.rank', 'must be at least 0'),
        ('smallest_ramp_k_min: ', 'smallest_ramp_k_min: -', 'detector.smallest_ramp_k_min',
         'must be'),
        ('end_condition: board', 'end_condition: both', 'detector.end_condition',
         "'board' or 'case', got 'both'"),
    ],
)  # fmt: skip
def test_the_message_on_a_wrong_entry_names_key_value_and_rule(old, new, key, message):
    assert old in TEXT
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(TEXT.replace(old, new, 1).encode(), 'unit.yaml')
    assert caught.value.key == key
    assert str(caught.value).startswith('unit.yaml: ')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'', 'mapping of keys'), (b'[1, 2]', 'mapping of keys'),
        (b'[' + b'1,' * 20_000 + b']', 'more than 20000 keys and values'),
        (b'a: &x 1\nb: *x', r'aliases are not accepted \(line 2\)'),
        (b'[' * 100_000, 'nested deeper|nesting depth'), (b'{a: ' * 100_000, 'nested deeper'),
        (b'a: 1\na: 2', "'a' occurs twice"), (b'? [1]\n: 2', 'a key must be a text'),
        (b'1: 2', 'a key must be a text'),
        (b'x: !!python/object:os.system ls', r'YAML tags are not accepted \(line 1\)'),
        (b'x: !!binary aGk=\n', 'YAML tags are not accepted'),
        (b'\xff\xfe', 'not UTF-8|not valid YAML'), (b'a: \x00', 'not valid YAML'),
        (b'a: [1', 'not valid YAML'), (b'a: 1\n---\nb: 2', 'one YAML document'),
        (b'format_version: ' + b'9' * 5000, 'integer of 5000 digits'),
        (b'"\\ud800": 1', 'not valid YAML|invalid'),
    ],
)  # fmt: skip
def test_files_without_a_calibration_are_refused(content, message):
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(content)
    # `rule`: message that a node sends to peers on the network; it must not quote the file.
    rule, whole = caught.value.rule or str(caught.value), str(caught.value)
    quotes = whole.startswith('not valid YAML: ')
    assert re.fullmatch(r'not valid YAML( \(line \d+\))?', rule) if quotes else rule == whole


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_file_gives_a_calibration_or_a_calibration_error(data):
    content = bytearray(TEXT.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    with contextlib.suppress(CalibrationError):
        value = parse_calibration(bytes(content))
        assert parse_calibration(dump_calibration(value).encode()) == value


def test_files_that_are_cut_at_any_line_or_no_regular_files_are_refused(tmp_path):
    # WHY: a file that was still being copied was loaded, without its last columns and covariance.
    lines = dump_calibration(rich_calibration()).splitlines(keepends=True)
    for n in range(1, len(lines)):
        with pytest.raises(CalibrationError, match='the file is cut'):
            parse_calibration(''.join(lines[:n]).encode())
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    large = tmp_path / 'large'
    with large.open('wb') as file:
        file.truncate(SIZE_LIMIT + 1)
    for path, message in (
        *((tmp_path, 'not a regular file|Is a directory'), (fifo, 'not a regular file')),
        *((large, 'at most'), (tmp_path / 'absent', 'No such file')),
    ):
        with pytest.raises(CalibrationError, match=message) as caught:
            load_calibration(path)
        assert caught.value.path == str(path)


@pytest.mark.parametrize(
    ('old', 'new', 'key', 'message'),
    [
        ('[4.0, 37.0]', '[4.0, 999.0]', 'static.y.bias_function', 'must be finite over its range'),
        ('[4.0, 37.0]', '[4.0, 1e5]', 'static.temperature_range_c[1]', 'less than 1000'),
        ('[4.0, 37.0]', '[-300, 37.0]', 'static.temperature_range_c[0]', 'at least -273.15'),
        ('c: 20.0', 'c: 1e308', 'reference_temperature_c', 'less than 1000'),
        ('[-15.0, 0.0', '[-1e-320, 0.0', 'static.z.scale_function.knots_k', 'rise strictly, by 0'),
        ('0.0, 15.0]', '0.0, 1e308]', 'static.z.scale_function.knots_k', 'within 2000 K'),
        ('[0.99893, 1.0', '[1e308, 1.0', 'static.z.scale_function', 'must stay above 0.1'),
        ('[0.0, 0.0031]', '[0.0, 1e308]', 'static.x.bias_function', 'must be finite over its'),
        # The scale 1 - 0.05 t is 0.15 at 37 degC; its continuation above 37 degC is negative.
        ('[1.0, 7.7e-05]', '[1.0, -0.05]', 'static.x.scale_function', 'must stay above 0.1'),
    ],
)
def test_impossible_curves_and_temperatures_are_refused(old, new, key, message):
    text = (Path(__file__).parents[1] / 'config' / 'calibration.example.yaml').read_text()
    text = text.replace('e_fold_k: [18.0]', 'e_fold_k: [1.0]')
    assert old in text
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(text.replace(old, new, 1).encode())
    assert caught.value.key == key


@pytest.mark.parametrize(
    ('key', 'value', 'message'),
    [
        ('factor', '?', 'base64 of float32'), ('factor', 'AAAA', 'base64 of float32'),
        ('factor', 'AADAfw==', 'finite'),
        ('factor', '', r'must hold \d+ x \d+ numbers \(`diagonal` x `rank`\), got 0'),
        ('diagonal', 'AACAvw==', 'must hold'), ('diagonal', '', 'must hold 0 x'),
    ],
)  # fmt: skip
def test_wrong_numbers_are_neither_read_nor_written(key, value, message):
    old = getattr(RICH.posterior, key)
    assert old in TEXT
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(TEXT.replace(old, f"'{value}'").encode())
    assert caught.value.key.startswith('posterior.')
    n = parameter_layout(RICH).n_parameters
    with pytest.raises(ValueError, match=rf'`posterior.diagonal` .*eter \({n + 6}\), got {n}'):
        replace(RICH, response=(term('gradient'), *RICH.response))
    with pytest.raises(CalibrationError, match='noise_density_m_s2_sqrt_hz'):
        dump_calibration(calibration(noise_density_m_s2_sqrt_hz=(0.0, 1.0, 1.0)))


def test_files_with_former_names_of_columns_and_keys_are_read():
    text = TEXT
    for former, name in _FORMER.items():
        text = re.sub(rf'(group|kind): {name}(?=[,}}\n])', rf'\1: {former}', text)
    assert text != TEXT
    keys = re.sub(r'\bend_condition:', 'closes:', re.sub(r'\bdiagonal:', 'rest:', text))
    assert (keys.count('closes:'), 'rest:' in keys) == (1, True)
    assert parse_calibration(keys.encode()) == RICH
