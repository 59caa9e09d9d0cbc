# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The calibration value and its file: round trip to the bit, and every refusal with its key.

"""

import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from builders import axis_set, calibration, regime_set, rich_calibration
from hypothesis import given, settings
from hypothesis import strategies as st

from thermo_comp.errors import CalibrationError, OutputError
from thermo_comp.unit.calibration import LinearTerm, MemoryTerm
from thermo_comp.unit.calibration_file import (
    SIZE_LIMIT,
    calibration_schema,
    dump_calibration,
    load_calibration,
    parse_calibration,
    save_calibration,
)
from thermo_comp.unit.functions import CubicSpline, Exponential

REPOSITORY = Path(__file__).parents[1]
number = st.floats(-1e6, 1e6)
# The fourth power of 15 K times this stays far from turning a scale function to 0.
small = st.floats(-1e-6, 1e-6)


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
    return (
        axis_set((at_reference, *coefficients)).bias_function
        if not at_reference
        else (axis_set(scale=(at_reference, *coefficients)).scale_function)
    )


@st.composite
def calibrations(draw):
    def one():
        return replace(
            axis_set(),
            bias_function=draw(functions(0.0)),
            scale_function=draw(functions(1.0)),
            delta=draw(number),
            gradient=LinearTerm(draw(number), draw(small)),
            memory=MemoryTerm((draw(number),), (draw(small),)),
        )

    return replace(
        calibration(memory_time_constants_s=(draw(st.floats(1.0, 1e5)),)),
        static=regime_set(one(), one(), one()),
        dynamic=regime_set(one(), one(), one()),
        unit=replace(
            calibration().unit,
            serial=draw(st.text(min_size=1, max_size=20).filter(lambda s: s.isprintable())),
        ),
    )


@given(calibrations())
@settings(max_examples=100, deadline=None)
def test_round_trip_is_exact(value):
    assert parse_calibration(dump_calibration(value).encode()) == value


@pytest.mark.parametrize('serial', ['no', '1e5', '0x1F', '12', 'null', '~', 'a: b', '- x', '1:30'])
def test_serials_that_look_like_something_else_stay_texts(serial):
    value = calibration(unit=replace(calibration().unit, serial=serial))
    assert parse_calibration(dump_calibration(value).encode()).unit.serial == serial


def test_numbers_as_people_write_them():
    text = dump_calibration(calibration())
    text = text.replace('full_scale: 32767.0', 'full_scale: 32767')
    text = text.replace('cycle_time_s: 0.01', 'cycle_time_s: 1e-02')
    unit = parse_calibration(text.encode()).unit
    assert (unit.full_scale, unit.cycle_time_s) == (32767.0, 0.01)


TEXT = dump_calibration(rich_calibration())


@pytest.mark.parametrize(
    ('old', 'new', 'key', 'message'),
    [
        ('format_version: 1', 'format_version: 2', 'format_version', 'newer'),
        ('format_version: 1', 'format_version: 0', 'format_version', 'must be 1, got 0'),
        ('full_scale: 32767.0', 'full_scale: .nan', 'unit.full_scale', 'finite number, got nan'),
        ('full_scale: 32767.0', 'full_scale: .inf', 'unit.full_scale', 'finite'),
        ('full_scale: 32767.0', 'full_scale: true', 'unit.full_scale', 'valid number, got True'),
        ('full_scale: 32767.0', "full_scale: '9'", 'unit.full_scale', "valid number, got '9'"),
        ('full_scale: 32767.0', 'full_scale: -1.0', 'unit.full_scale', 'greater than 0, got -1'),
        ('full_scale: 32767.0', 'fullscale: 1.0', 'unit.fullscale', 'unknown key'),
        ('full_scale: 32767.0', '"full\\nscale": 1.0', r"unit.'full\nscale'", 'unknown key'),
        ('full_scale: 32767.0', f'{"x" * 999}: 1.0', "unit.'" + 'x' * 59, 'unknown key'),
        ('full_scale: 32767.0, ', '', 'unit.full_scale', 'missing'),
        ('input: counts', 'input: volts', 'unit.input', "got 'volts'"),
        ('serial: T-1', "serial: ''", 'unit.serial', 'at least 1 character'),
        ('gravity_m_s2: 9.80665', 'gravity_m_s2: 1.0', 'gravity_m_s2', 'greater than 9'),
        ('  y: {scale_factor: -295.0', '  w: {scale_factor: -295.0', 'axes.w', 'unknown key'),
        (
            'x: {scale_factor: 300.0',
            'x: {scale_factor: 0.0',
            'axes.x.scale_factor',
            'must not be 0',
        ),
        (
            'coefficients: [0.0, 0.3]',
            'coefficients: [0.1, 0.3]',
            'static.x.bias_function',
            'must be 0 at',
        ),
        (
            'coefficients: [1.0, 7.0e-05]',
            'coefficients: [1.1]',
            'static.x.scale_function',
            'must be 1 at',
        ),
        ('kind: polynomial', 'kind: fourier', 'static.x.bias_function', "'fourier'"),
        ('[1.0, 7.0e-05]', '[1.0, -0.2]', 'static.x.scale_function', 'must stay above 0.1'),
        ('[5.0, 35.0]', '[35.0, 5.0]', 'static.temperature_range_c', 'must be'),
        ('- [1.0, 0.0, 0.0]', '- [1.0, 0.1, 0.0]', 'misalignment[0][1]', 'must be 0'),
        ('- [1.0, 0.0, 0.0]', '- [1.1, 0.0, 0.0]', 'misalignment[0][0]', 'must be 1'),
        ('- [0.001, 1.0, 0.0]', '- [0.7, 1.0, 0.0]', 'misalignment[1][0]', 'below 0.5'),
        (
            '[600.0, 2400.0]',
            '[600.0]',
            'static.x.memory',
            'one coefficient per memory_time_constants_s',
        ),
        ('[600.0, 2400.0]', '[600.0, -1.0]', 'memory_time_constants_s[1]', 'greater than 0'),
        (
            '      bias: [0.1, -0.05]',
            '      bias: [0.1]',
            'static.x.memory',
            'as many bias as scale',
        ),
        ('    - [1.0e-08]', '    - [-1.0e-08]', 'static.x.covariance', 'negative variance'),
        ('    - [1.0e-08]', '    - [1.0e-30]', 'static.x.covariance', 'positive semidefinite'),
        ('    - [1.0e-08]', '    - [1.0e-320]', 'static.x.covariance', 'positive semidefinite'),
        ('    - [1.0e-08]\n', '', 'static.x.covariance', 'rows of a lower triangle'),
        (
            'smallest_ramp_k_min: ',
            'smallest_ramp_k_min: -',
            'detector.smallest_ramp_k_min',
            'must be',
        ),
    ],
)
def test_refusals_name_key_value_and_rule(old, new, key, message):
    assert old in TEXT
    with pytest.raises(CalibrationError, match=message) as caught:
        parse_calibration(TEXT.replace(old, new, 1).encode(), 'unit.yaml')
    assert caught.value.key == key
    assert str(caught.value).startswith('unit.yaml: ')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'', 'mapping of keys'),
        (b'[1, 2]', 'mapping of keys'),
        (b'a: &x 1\nb: *x', r'aliases are not accepted \(line 2\)'),
        (b'[' * 100_000, 'nested deeper'),
        (b'{a: ' * 100_000, 'nested deeper'),
        (b'a: 1\na: 2', "'a' stands twice"),
        (b'? [1]\n: 2', 'a key must be a text'),
        (b'1: 2', 'a key must be a text'),
        (b'x: !!python/object:os.system ls', 'could not determine a constructor'),
        (b'x: !!binary aGk=\n', 'not valid YAML|mapping|Object|unknown|could not'),
        (b'\xff\xfe', 'not UTF-8|not valid YAML'),
        (b'a: \x00', 'not valid YAML'),
        (b'a: [1', 'not valid YAML'),
        (b'a: 1\n---\nb: 2', 'one YAML document'),
        (b'format_version: ' + b'9' * 5000, 'integer of 5000 digits'),
        (b'"\\ud800": 1', 'not valid YAML|invalid'),
    ],
)
def test_bytes_that_are_no_calibration(content, message):
    with pytest.raises(CalibrationError, match=message):
        parse_calibration(content)


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_bytes_give_a_calibration_or_a_calibration_error(content):
    with pytest.raises(CalibrationError):
        parse_calibration(content)


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_any_damage_gives_a_calibration_or_a_calibration_error(data):
    content = bytearray(TEXT.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    with contextlib.suppress(CalibrationError):
        value = parse_calibration(bytes(content))
        assert parse_calibration(dump_calibration(value).encode()) == value


def test_files_that_are_no_files(tmp_path):
    fifo = tmp_path / 'fifo'
    os.mkfifo(fifo)
    large = tmp_path / 'large'
    with large.open('wb') as file:
        file.truncate(SIZE_LIMIT + 1)
    for path, message in (
        (tmp_path, 'not a regular file|Is a directory'),
        (fifo, 'not a regular file'),
        (large, 'at most'),
        (tmp_path / 'absent', 'No such file'),
    ):
        with pytest.raises(CalibrationError, match=message) as caught:
            load_calibration(path)
        assert caught.value.path == str(path)


def test_write_replaces_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / 'unit.yaml'
    save_calibration(calibration(), path)
    assert load_calibration(path) == calibration()
    save_calibration(rich_calibration(), path)
    assert load_calibration(path) == rich_calibration()
    assert [p.name for p in tmp_path.iterdir()] == ['unit.yaml']
    with pytest.raises(OutputError, match=r'cannot be written: .* is no directory'):
        save_calibration(calibration(), path / 'unit.yaml')


def test_value_that_the_reader_would_refuse_is_not_written():
    with pytest.raises(CalibrationError, match='noise_density_m_s2_sqrt_hz'):
        dump_calibration(calibration(noise_density_m_s2_sqrt_hz=(0.0, 1.0, 1.0)))


def test_shipped_schema_is_the_schema():
    path = REPOSITORY / 'config' / 'calibration.schema.json'
    assert json.loads(path.read_text()) == calibration_schema()


def test_shipped_example_loads():
    value = load_calibration(REPOSITORY / 'config' / 'calibration.example.yaml')
    assert value.unit.serial == 'EXAMPLE-1'
