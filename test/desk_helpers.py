# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns folders with the files that the examples of help texts and pages use."""

import itertools
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from readme_helpers import shown

#: Files that are made when an example needs them.
MADE = (
    *('unit.yaml', 'unit42.yaml', 'unit01.yaml', 'unit02.yaml', 'unit03.yaml', 'map.yaml'),
    *('autopilot.params', 'xsens_acc.calib', 'accel_calib.yaml', 'chamber.mcap', 'unit42_p01'),
    *('freezer.mcap', 'log.csv', 'tumble.txt', 'flight.ulg', 'flight.bin', 'bags/fleet'),
    *('bags/unit42', 'rests'),
)
_EXPORTS = {'autopilot.params': 'px4', 'xsens_acc.calib': 'imu_tk',
            'accel_calib.yaml': 'imu_calib'}  # fmt: skip


def write_fit_of_the_readme(path, cli):
    """Write the calibration of the sample bags by the `fit` command on docs/cli.md."""
    words, _ = shown()['fit']
    bags = ROOT / 'bags' / 'fit'
    assert words[1] == 'bags/fit/*.mcap'
    assert words[2:4] == ['-o', 'unit.yaml']
    cli('fit', *sorted(bags.iterdir()), *words[2:], cwd=path.parent)
    (path.parent / 'unit.yaml').rename(path)


class Desk:
    """Makes files once, and runs examples in folders that contain these files."""

    def __init__(self, folder, cli, once):
        self._cli = cli
        self._once = once
        self._ready = folder / 'ready'
        self._folder = folder
        self._n = 0
        bags = self._ready / 'bags'
        bags.mkdir(parents=True)
        (bags / 'fit').symlink_to(ROOT / 'bags' / 'fit')
        for name in ('bags/held_out.mcap', 'held_out.mcap', 'flight.mcap', 'new.mcap'):
            (self._ready / name).symlink_to(ROOT / 'bags' / 'held_out.mcap')
        (self._ready / 'config').symlink_to(ROOT / 'config')

    def _make(self, name):
        made = self._ready / name
        if not made.exists():
            file = Path(name).name
            made.symlink_to(self._once(file, lambda folder: self._write(folder / file)) / file)
        return made

    def _write(self, path):
        name = path.name
        if name == 'unit42.yaml':
            write_fit_of_the_readme(path, self._cli)
        elif name == 'unit.yaml':
            shutil.copy(self._make('unit42.yaml'), path)
        elif name == 'unit01.yaml':
            # Three fits with the default model take 10 s; the model `golovach` is faster.
            bags = sorted(self._make('bags/unit42').iterdir())
            given = ('--gravity', '9.8154', '--model', 'golovach', '--serial', path.stem)
            self._cli('fit', *bags, *given, '-o', path, '-q')
        elif name in ('unit02.yaml', 'unit03.yaml'):
            path.write_text(self._make('unit01.yaml').read_text().replace('unit01', path.stem))
        elif name in _EXPORTS:
            to = ('--to', _EXPORTS[name])
            self._cli('export', self._make('unit42.yaml'), *to, '-o', path, '-q')
        elif name in ('chamber.mcap', 'unit42_p01'):
            # Some examples play the bag in real time, so the bag is short.
            self._cli('simulate', '--profile', '20 1s', '-o', path, '-q')
        elif name == 'freezer.mcap':
            program = ('--unit', 'mems', '--profile', '20 2min, 0@2 5min', '--rate-hz', '20')
            self._cli('simulate', *program, '-o', path, '-q')
        elif name == 'unit42':
            from fleet_helpers import write_unit

            write_unit(path, 42, 2)
        elif name == 'fleet':
            pytest.importorskip('distributed', reason='distributed is not installed (`fleet`)')
            from fleet_helpers import write_unit

            write_unit(path / 'unit42', 42, 1)
        elif name == 'rests':
            from field_helpers import rests, upright, write_log

            from thermo_comp.unit.calibration_file import load_calibration
            from thermo_comp.unit.gravity import MICRO_G

            off = np.array([0.0, 0.0, 4.0 * MICRO_G])
            unit = load_calibration(self._make('unit42.yaml'))
            write_log(path, rests(unit, upright, lambda _: off, turn_on=1.0 * MICRO_G))
        elif name == 'log.csv':
            rng = np.random.default_rng(3)
            accel = np.array([0.2, -0.1, 9.8]) + 0.01 * rng.standard_normal((1000, 3))
            rows = [
                f'{1.0 + 0.01 * k:.2f},{x:.4f},{y:.4f},{z:.4f},{25.0 + 1e-4 * k:.3f}'
                for k, (x, y, z) in enumerate(accel)
            ]
            path.write_text('\n'.join(['t,ax,ay,az,temp', *rows]) + '\n')
        elif name == 'tumble.txt':
            from thermo_comp.simulation.campaign import positions

            rng = np.random.default_rng(5)
            rests = np.repeat(9.8154 * positions(12, 2) + (0.1, -0.2, 0.3), 500, axis=0)
            rests += 0.02 * rng.standard_normal(rests.shape)
            moves = np.arange(len(rests)) % 500 < 100
            rests[moves] += 5.0 * rng.standard_normal((int(moves.sum()), 3))
            np.savetxt(path, np.column_stack([0.01 * np.arange(len(rests)), rests]), fmt='%.6f')
        elif name == 'map.yaml':
            path.write_text(
                'stamp: {column: t, unit: s}\n'
                'accel: {columns: [ax, ay, az], unit: m/s^2, output: imu}\n'
                'board: {column: temp, unit: degC}\n'
            )
        elif name == 'flight.ulg':
            pytest.importorskip('pyulog', reason='pyulog of the extra `px4` is not installed')
            from test_convert_ulog import write_two_imus

            write_two_imus(path, np.random.default_rng(4))
        elif name == 'flight.bin':
            pytest.importorskip('pymavlink', reason='pymavlink is not installed')
            from test_convert_dataflash import write_new

            write_new(path, np.random.default_rng(5))

    def run(self, command, cli=None):
        """Run an example in a new folder; examples of `fleet` share a folder."""
        words = shlex.split(command, comments=True)
        assert words.pop(0) == 'thermo_comp'
        outputs = {after for word, after in itertools.pairwise(words) if word == '-o'}
        self._n += 1
        # The examples of `fleet` share a folder, so a second `fleet fit` finds existing results.
        here = self._folder / ('fleet' if words[0] == 'fleet' else f'run{self._n}')
        (here / 'bags').mkdir(parents=True, exist_ok=True)
        for word in words:
            made = word.partition('/*')[0]
            if made in MADE and made not in outputs:
                self._make(made)
        for path in [*self._ready.iterdir(), *(self._ready / 'bags').iterdir()]:
            name = path.relative_to(self._ready)
            is_there = (here / name).is_symlink()
            if path.name != 'bags' and str(name) not in outputs and not is_there:
                (here / name).symlink_to(path)
        arguments = []
        for word in words:
            paths = here.glob(word) if '*' in word else []
            arguments += sorted(str(path.relative_to(here)) for path in paths) or [word]
        if arguments[0] == 'play':
            pytest.importorskip('rclpy', reason='rclpy of the extra `ros` is not installed')
            # No subscriber exists in these tests, so `play` waits only 0.5 s for subscribers.
            arguments[1:1] = ['--wait', '0.5']
        if arguments[:2] == ['record', '--positions']:
            return self._interrupted(arguments, here)
        return (cli or self._cli)(*arguments, cwd=here)

    def _interrupted(self, arguments, here):
        """Run a command that does not end by itself; send SIGINT after its first printed line."""
        process = subprocess.Popen(
            [sys.executable, '-m', 'thermo_comp', *arguments], cwd=here,
            env={**os.environ, 'PYTHONPATH': str(ROOT)}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        assert 'Traceback' not in errors
        return subprocess.CompletedProcess(arguments, 0, first + rest, errors)
