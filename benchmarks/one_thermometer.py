# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prints the errors of fits with and without the case thermometer, on held-out bags.

python benchmarks/one_thermometer.py
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.writer import BagWriter

ROOT = Path(__file__).resolve().parent.parent
#: Options of each unit's fit, by its name in `simulate --unit`, or 'sample' for the sample bags.
UNITS: dict[str, tuple[str, ...]] = {
    'thermostatted': (), 'bare-quartz': (), 'mems': ('--mounting-sd', '30ug'), 'sample': (),
}  # fmt: skip
RATE_HZ = '2'
MICRO_G = 9.80665e-6


def command(*arguments: object) -> dict[str, Any]:
    """Run thermo_comp; return its JSON output. Exit codes 0 and 1 (bad verdict) are accepted."""
    line = [sys.executable, '-m', 'thermo_comp', *map(str, arguments), '--json']
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode not in {0, 1} or not done.stdout:
        raise RuntimeError(done.stderr)
    content: dict[str, Any] = json.loads(done.stdout)
    return content


def without_case(bag: Path, target: Path) -> Path:
    """Copy a bag without the case temperature."""
    recording = read_recording(bag, require=('accel', 'board'))
    columns, board = recording.columns, recording.columns.temperatures['board']
    with BagWriter(target, metadata=dict(recording.info.metadata)) as writer:
        log_ns = columns.log_ns
        stamps = columns.accel_stamp_ns
        writer.write_counts('accel/counts', stamps, columns.accel, log_ns=log_ns['accel'])
        names = 'temperature/board', board.stamp_ns, board.celsius
        writer.write_temperature(*names, log_ns['board'])
    return target


def bags_of(unit: str, folder: Path) -> tuple[list[Path], list[Path]]:
    """Return bags of a fit and held-out bags; simulate them, except the bags of 'sample'."""
    if unit == 'sample':
        return sorted((ROOT / 'bags' / 'fit').glob('*.mcap')), [ROOT / 'bags' / 'held_out.mcap']
    common = ('simulate', '--unit', unit, '--rate-hz', RATE_HZ)
    command(*common, '--plan', 'chamber-9', '-o', folder / 'fit')
    command(*common, '--plan', 'held-out', '-o', folder / 'held')
    return sorted((folder / 'fit').iterdir()), sorted((folder / 'held').iterdir())


def left(bags: list[Path], held: list[Path], calibration: Path, *options: str) -> dict[str, float]:
    """Fit bags; return RMS of |f| - g on the held-out bags, raw and corrected [m/s^2]."""
    command('fit', *bags, '-o', calibration, '--gravity', '9.80665', *options)
    found: dict[str, float] = command('evaluate', *held, '-c', calibration)['sections_m_s2']['all']
    return found


def main() -> None:
    """Print RMS of |f| - g for each unit: raw, and fits with two and with one thermometer."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('units', nargs='*', default=list(UNITS), help='kinds (default: all)')
    print('RMS of |f| - g [ug]: raw, and after fits with two thermometers and with one')
    print(f'{"unit":16}{"raw":>8}{"two":>8}{"one":>8}')
    for unit in parser.parse_args().units:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            bags, held = bags_of(unit, folder)
            board_only = folder / 'one'
            board_only.mkdir()
            alone = [without_case(bag, board_only / f'{bag.stem}.mcap') for bag in bags]
            held_alone = [without_case(bag, board_only / f'held_{bag.stem}.mcap') for bag in held]
            two = left(bags, held, folder / 'two.yaml', *UNITS[unit])
            board = left(alone, held_alone, folder / 'one.yaml', *UNITS[unit])
            values = (two['raw_rms'], two['rms'], board['rms'])
            print(f'{unit:16}' + ''.join(f'{rms / MICRO_G:8.3g}' for rms in values), flush=True)


if __name__ == '__main__':
    main()
