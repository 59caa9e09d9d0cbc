# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Text from outside (serials, topics, metadata) is printed without escape sequences."""

import io
import json
import os
import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import rich_calibration
from hypothesis import given
from hypothesis import strategies as st

from thermo_comp import errors
from thermo_comp.cli.app import run
from thermo_comp.fitting import FitOptions, FitSource
from thermo_comp.fitting.fit import check_serial
from thermo_comp.recording.writer import BagWriter
from thermo_comp.text import LONGEST_SERIAL, one_line, valid_serial
from thermo_comp.unit.calibration import Unit
from thermo_comp.unit.calibration_file import save_calibration

FORGED = '42\x1b]0;owned\x07\x1b[2J\nthermo_comp: error: forged\r\x9b31m\u202e\u2028'
BAD_SERIALS = ('', 'a\nb', 'a\x1b[2J', 'x' * (LONGEST_SERIAL + 1), '\u202e', 'a\udcff')


@given(st.text())
def test_text_from_outside_is_printed_as_one_line_without_escape_sequences(text):
    shown = one_line(text)
    assert len(shown.splitlines()) <= 1
    assert not {unicodedata.category(c) for c in shown} & {'Cc', 'Cf', 'Cs', 'Zl', 'Zp'}
    assert one_line(shown) == shown
    shown.encode()
    if not re.search(r'[^ -~]', text):
        assert shown == text


def test_an_error_is_printed_as_one_line_without_escape_sequences():
    # WHY: paths, keys and topics in messages come from outside, and may contain escape sequences.
    for error in (
        errors.ThermoCompError(FORGED),
        errors.CalibrationError('cannot be read', FORGED, FORGED),
        errors.RecordingError('no such', Path('bag'), FORGED),
        errors.OutputError(FORGED, FORGED),
    ):
        assert str(error) == one_line(str(error))
        assert one_line(FORGED) in str(error)


@pytest.mark.parametrize('serial', BAD_SERIALS)
def test_impossible_serials_are_refused(serial):
    for take in (valid_serial, lambda text: Unit(text, 'counts', 1.0, 0.01)):
        with pytest.raises(ValueError, match='`serial` must be one printable line of 1 to 64'):
            take(serial)
    if serial:
        source = FitSource('bag', list, serial=serial)
        with pytest.raises(errors.FitError, match='must be one printable line'):
            check_serial([source], FitOptions(gravity=9.8))
    for good in ('42', 'Блок 7', 'x' * LONGEST_SERIAL):
        assert valid_serial(good) == good


@pytest.mark.parametrize(
    'command',
    [
        *(('fit', 'x', '-o', 'y', '--gravity', '9.8'), ('report', '-c', 'x', '-o', 'y')),
        *(('replay', 'x', '-c', 'y', '-o', 'z'), ('import', 'x', '-o', 'y')),
    ],
    ids=lambda command: command[0],
)
def test_an_option_with_an_impossible_serial_is_refused(command, capsys):
    assert run([*command, '--serial', FORGED]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('thermo_comp: error: ')
    assert 'the serial must be one printable line' in line


@pytest.fixture
def forged(tmp_path):
    path = tmp_path / 'forged.mcap'
    stamps = np.arange(60) * 10**9
    with BagWriter(path, metadata={'serial': FORGED, 'converted_from': FORGED}) as bag:
        bag.write_counts('accel/counts', stamps, np.full((60, 3), 100.0))
        bag.write_temperature('temperature/board', stamps, np.full(60, 20.0))
        bag.write_raw(FORGED, 'std_msgs/msg/Bool', stamps, [b''] * 60)
    return path


def test_a_recording_forges_no_line(forged, tmp_path, capfd):
    save_calibration(rich_calibration(), tmp_path / 'unit.yaml')
    unit = ('-c', str(tmp_path / 'unit.yaml'))
    out = ('-o', str(tmp_path / 'out.yaml'))
    for command, *words in (
        *(('info',), ('info', '--json'), ('evaluate', *unit), ('replay', *unit, *out)),
        ('fit', *out, '--gravity', '9.8'),
    ):
        run([command, str(forged), *words])
        printed, said = capfd.readouterr()
        for line in (printed + said).splitlines():
            assert line.isprintable()
            assert not line.startswith('thermo_comp: error: forged')
        assert command != 'info' or r'\x1b' in printed or r'\u001b' in printed
        if '--json' in words:
            assert json.loads(printed)['metadata']['serial'] == FORGED


@pytest.mark.parametrize('encoding', ['latin-1', 'ascii', 'utf-8'])
def test_any_terminal_can_show_names_and_serials(tmp_path, cli, monkeypatch, encoding):
    calibration = rich_calibration()
    unit = replace(calibration.unit, serial='Блок')
    save_calibration(replace(calibration, unit=unit), tmp_path / 'unit.yaml')
    name = tmp_path / os.fsdecode(b'not \xff utf-8.yaml')
    (tmp_path / 'unit.yaml').rename(name)
    for more in ((), ('--json',)):
        terminal = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        with monkeypatch.context() as patch:
            patch.setattr('sys.stdout', terminal)
            assert run(['info', str(name), *more]) == 0
        terminal.seek(0)
        content = terminal.read()
        assert ('Блок' if encoding == 'utf-8' and not more else r'\u0411') in content
        assert r'not \udcff utf-8.yaml' in content
    if encoding == 'latin-1':  # this encoding is also tested in a new process
        assert r'\u0411' in cli('info', name, PYTHONIOENCODING=encoding).stdout
    assert r'no\udcff.mcap: ' in cli('info', tmp_path / os.fsdecode(b'no\xff.mcap'), code=1).stderr


def test_an_unexpected_exception_is_one_line_and_a_log(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError('boom\nand more')

    monkeypatch.setattr('thermo_comp.recording.overview.survey_recording', fail)
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    assert run(['info', 'x.mcap']) == 70
    (line,) = capsys.readouterr().err.splitlines()
    (log,) = tmp_path.iterdir()
    assert line.startswith('thermo_comp: error: unexpected RuntimeError: boom and more; ')
    assert line.endswith(str(log))
    assert 'Traceback' in log.read_text()
    assert "raise RuntimeError('boom" in log.read_text()
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'absent'))
    assert run(['info', 'x.mcap']) == 70
    assert 'not written (No such file or directory)' in capsys.readouterr().err
