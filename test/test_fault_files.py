# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A full disk or a kill leaves no partial output file, except for the bag of `record`."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders import calibration
from conftest import ROOT
from fleet_helpers import write_unit

from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.writer import BagWriter
from thermo_comp.unit.calibration_file import save_calibration

#: The fit of these two bags takes 0.5 s.
FIT = ('bags/01.mcap', 'bags/02.mcap')
HELD_OUT = ROOT / 'bags' / 'held_out.mcap'
GRAVITY = ('--gravity', '9.80665', '--model', 'golovach')
#: Arguments of the command that writes each output, up to the path of the output.
COMMANDS = {
    'unit.yaml': ('fit', *FIT, *GRAVITY, '-f', '-o'),
    'page.html': ('report', '-c', 'unit.yaml', '-f', '-o'),
    'bag.mcap': ('replay', HELD_OUT, '-c', 'unit.yaml', '--serial', 'T-1', '-f', '-o'),
    'bag': ('replay', HELD_OUT, '-c', 'unit.yaml', '--serial', 'T-1', '-f', '-o'),
}


@pytest.fixture
def folder(tmp_path):
    save_calibration(calibration(), tmp_path / 'unit.yaml')
    write_unit(tmp_path / 'bags', 1, 2)
    return tmp_path


@pytest.mark.parametrize('name', COMMANDS)
def test_a_command_on_a_full_disk_fails_in_one_line(small_disk, folder, cli, name):
    output = small_disk / name
    (line,) = cli(*COMMANDS[name], output, code=1, cwd=folder).stderr.strip().splitlines()[-1:]
    assert line.startswith('thermo_comp: error: ')
    assert str(output) in line
    assert line.endswith('No space left on device')
    assert list(small_disk.iterdir()) == []


@pytest.mark.parametrize('small_disk', [300], indirect=True)
def test_a_conversion_on_a_full_disk_leaves_no_file(small_disk, tmp_path, cli):
    table = tmp_path / 'log.csv'
    samples = np.random.default_rng(3).normal((0.0, 0.0, 9.8), 0.1, (9000, 3))
    rows = [f'{k / 100},{x},{y},{z},20.0' for k, (x, y, z) in enumerate(samples)]
    table.write_text('\n'.join(['time_s,x,y,z,board', *rows]))
    finished = cli('convert', table, '-o', small_disk / 'log', code=1)
    assert 'No space left on device' in finished.stderr
    assert not list(small_disk.rglob('*.partial*'))


@pytest.mark.parametrize('small_disk', [300], indirect=True)
def test_a_recording_on_a_full_disk_keeps_what_was_written(small_disk, cli):
    # The recording is 700 KB of noise, which does not fit on a disk of 300 KB when compressed.
    n = 20000
    stamps = np.arange(n) * 10**8
    samples = np.random.default_rng(1).normal((0.0, 0.0, 2942.0), 3.0, (n, 3))
    bag = small_disk.parent / 'session.mcap'
    with BagWriter(bag) as writer:
        writer.write_counts('accel/counts', stamps, samples)
    options = ('--positions', '1', '--soak', '30min', '-o', small_disk)
    (line,) = cli('record', bag, *options, '-q', code=1).stderr.strip().splitlines()
    reason = 'cannot be written: No space left on device; the part written is in'
    match = re.fullmatch(rf'thermo_comp: error: {small_disk}/01.mcap: {reason} (\S+)', line)
    assert match, line
    (kept,) = small_disk.iterdir()
    assert kept.name == match[1]
    torn = read_recording(kept, require=['accel'])
    assert torn.info.truncated
    assert 1000 < len(torn.columns) < n
    assert torn.columns.accel[:1000] == pytest.approx(samples[:1000])


@pytest.mark.parametrize('name', COMMANDS)
def test_output_into_a_read_only_folder_fails_in_one_line(folder, cli, name):
    locked = folder / 'locked' if os.geteuid() else Path('/proc')
    locked.mkdir(mode=0o500, exist_ok=True)
    finished = cli(*COMMANDS[name], locked / name, code=1, cwd=folder)
    (line,) = finished.stderr.strip().splitlines()[-1:]
    assert line.startswith(f'thermo_comp: error: {locked / name}: ')


#: This script runs a command, and kills itself during a write or before the final rename.
KILLED = """
import os, signal, sys
point, target = sys.argv[1:3]
seen = []
def hook(event, arguments):
    if event == 'os.rename' and str(arguments[1]).endswith(target) and point == 'before':
        os.kill(os.getpid(), signal.SIGKILL)
    if seen and point == 'writing' and event != 'os.kill':
        seen.clear()
        os.kill(os.getpid(), signal.SIGKILL)
    if event == 'open' and isinstance(arguments[0], str):
        name = os.path.basename(arguments[0])
        is_written = arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if is_written and name.startswith('.' + target.split('.')[0]):
            seen.append(name)
from thermo_comp.cli.app import main
sys.addaudithook(hook)
sys.argv[:] = ['thermo_comp', *sys.argv[3:]]
sys.exit(main())
"""


def killed_replay(script, point, name, folder):
    arguments = [str(word) for word in COMMANDS['bag.mcap']]
    command = [sys.executable, '-c', script, point, name, *arguments, name]
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False)


@pytest.mark.parametrize('point', ['before', 'writing'])
def test_a_killed_command_leaves_the_old_file(folder, point):
    output = folder / 'bag.mcap'
    output.write_bytes(b'\x89MCAP old')
    listed = set(folder.iterdir())
    killed = killed_replay(KILLED, point, output.name, folder)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert output.read_bytes() == b'\x89MCAP old'
    (rest,) = set(folder.iterdir()) - listed
    assert rest.name.startswith('.')
    if point == 'before':
        assert len(read_recording(rest, require=()).columns) == 0
        assert read_recording(rest, require=()).info.truncated is None


@pytest.mark.parametrize('name', ['bag.mcap', 'rows.csv'])
def test_a_command_ended_by_sigterm_leaves_no_file(folder, name):
    listed = set(folder.iterdir())
    ended = killed_replay(KILLED.replace('SIGKILL', 'SIGTERM'), 'writing', name, folder)
    assert (ended.returncode, ended.stderr) == (143, b'')
    assert set(folder.iterdir()) == listed
