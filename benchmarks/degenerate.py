# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs every command on every degenerate input; prints exit code, seconds and peak memory.

For any recording or table a command must end within 60 s, use at most 300 MB, and print no
traceback. Exit code 0 is allowed only if all data of the input can be read. A run that breaks a
rule is marked ``!``, and the exit code of the benchmark is then 1.

    python benchmarks/degenerate.py --only jump --json degenerate.json
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from degenerate_inputs import INPUTS

ROOT = Path(__file__).resolve().parent.parent
CALIBRATION = ROOT / 'config' / 'calibration.example.yaml'
LIMIT_S, LIMIT_MB, KILL_MB = 60.0, 300.0, 2048
MAP = """\
stamp: {column: 0, unit: ns}
accel: {columns: [1, 2, 3], unit: counts, output: counts}
board: {column: 4}
case: {column: 5}
"""

Line = Callable[[Path, Path], list[str | Path]]
COMMANDS: dict[str, Line] = {
    'info': lambda bag, _: ['info', bag],
    'evaluate': lambda bag, _: ['evaluate', bag, '-c', CALIBRATION, '--serial', ''],
    'replay': lambda bag, out: [
        'replay', bag, '-c', CALIBRATION, '--serial', '', '-o', out / 'out.mcap',
    ],
    'report': lambda bag, out: [
        'report', bag, '-c', CALIBRATION, '--serial', '', '-o', out / 'out.html',
    ],
    'fit': lambda bag, out: ['fit', bag, '--gravity', '9.81', '-o', out / 'out.yaml'],
    'fleet': lambda bag, out: [
        'fleet', 'fit', bag.parent, '-o', out / 'fleet', '--gravity', '9.81', '--workers', '1',
    ],
    'play': lambda bag, _: ['play', bag, '--rate', '0', '--wait', '0'],
    'convert': lambda log, out: [
        'convert', log, '-o', out / 'out.mcap',
        *(['--columns', out / 'map.yaml'] if log.suffix in {'.csv', '.parquet'} else []),
    ],
}  # fmt: skip
TABLES = {'convert'}


@dataclass(frozen=True)
class Run:
    """Exit code, time, peak memory and last two lines of stderr of a command with an input."""

    input: str
    command: str
    code: int | None
    seconds: float
    megabytes: float
    said: str
    is_bad: bool


def _peak_megabytes(pid: int) -> float:
    """Return the largest resident size of a process so far [MB]; 0 after the process has ended."""
    try:
        status = Path(f'/proc/{pid}/status').read_text()
    except OSError:
        return 0.0
    match = re.search(r'VmHWM:\s+(\d+) kB', status)
    return int(match[1]) / 1024 if match else 0.0


def run(name: str, command: str, path: Path, out: Path) -> Run:
    """Run a command to its end, or until the time limit; judge its time, memory and output."""
    program = Path(sys.executable).with_name('thermo_comp')
    log = out / 'said.txt'
    began = time.monotonic()
    with log.open('wb') as sink:
        process = subprocess.Popen(
            [program, *COMMANDS[command](path, out)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=sink,
            cwd=out, env={**os.environ, 'TMPDIR': str(out)},
        )  # fmt: skip
    resource.prlimit(process.pid, resource.RLIMIT_DATA, (KILL_MB << 20, KILL_MB << 20))
    code: int | None = None
    pid = 0
    megabytes = 0.0
    while not pid and time.monotonic() - began < LIMIT_S:
        # Use /proc, because the peak memory from wait4 includes the parent's memory at the fork.
        megabytes = max(megabytes, _peak_megabytes(process.pid))
        pid, status, _ = os.wait4(process.pid, os.WNOHANG)
        time.sleep(0.01)
    if pid:
        code = os.waitstatus_to_exitcode(status)
    else:
        process.kill()
        os.wait4(process.pid, 0)
    process.returncode = -9 if code is None else code
    lines = log.read_text('utf-8', 'replace').strip().splitlines()
    text = ' | '.join(lines[-2:])
    is_bad = (
        code not in {0, 1}
        or megabytes > LIMIT_MB
        or any(line.startswith('Traceback') for line in lines)
        or (code == 0 and INPUTS[name].is_lost)
    )
    return Run(name, command, code, time.monotonic() - began, megabytes, text, is_bad)


def main() -> int:
    """Make the inputs, run the commands, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--only', default='', help='inputs whose name contains this text')
    parser.add_argument(
        '--commands', nargs='*', choices=COMMANDS, default=list(COMMANDS), help='default: all'
    )
    parser.add_argument('--json', type=Path, help='file for the results')
    arguments = parser.parse_args()
    runs: list[Run] = []
    print(f'{"input":34}' + ''.join(f'{name:>17}' for name in arguments.commands))
    for name, given in INPUTS.items():
        if arguments.only not in name:
            continue
        folder = Path(tempfile.mkdtemp(prefix='degenerate-'))
        unit = folder / 'in' / 'unit'
        unit.mkdir(parents=True)
        path = given.make(unit)
        row = f'{name:34}'
        for command in arguments.commands:
            is_table = path.suffix in {'.csv', '.parquet'}
            if is_table and command not in TABLES:
                row += f'{"":17}'
                continue
            out = folder / command
            out.mkdir()
            (out / 'map.yaml').write_text(MAP, encoding='ascii')
            runs.append(done := run(name, command, path, out))
            code = 'hangs' if done.code is None else str(done.code)
            mark = '!' if done.is_bad else ' '
            row += f'{code:>6}{done.seconds:5.1f}{done.megabytes:5.0f}{mark}'
            shutil.rmtree(out)
        print(row, flush=True)
        shutil.rmtree(folder)
    bad = [result for result in runs if result.is_bad]
    for result in bad:
        print(f'{result.command} on {result.input}: {result.code}: {result.said[:300]}')
    print(f'{len(runs)} runs, {len(bad)} break a rule')
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(result) for result in runs], indent=1))
    return 1 if bad else 0


if __name__ == '__main__':
    sys.exit(main())
