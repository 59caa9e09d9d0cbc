# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs the fuzz targets, guided by coverage, for a time or a number of inputs.

    python fuzz/run.py [calibration|mcap|cdr|parameters|db3|zstd|csv|parquet|all] [--seconds 60]

The targets need the extra `fuzz` (atheris). A target fails on an exception, on an input that takes
10 s, and beyond 1 GiB of memory; the input is then left as `crash-*` in the working folder. Inputs
that reach new code are kept in `fuzz/corpus/`, which is not under version control.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CORPUS = Path(__file__).resolve().parent / 'corpus'
NAMES = ('calibration', 'mcap', 'cdr', 'parameters', 'db3', 'zstd', 'csv', 'parquet')


def main() -> int:
    """Run one target in this process, or all targets one after the other."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('target', choices=(*NAMES, 'all'), nargs='?', default='all')
    parser.add_argument('--seconds', type=int, default=60, help='time per target [s] (default 60)')
    parser.add_argument('--inputs', type=int, default=-1, help='inputs per target (-1: no limit)')
    arguments = parser.parse_args()
    if arguments.target == 'all':
        options = [f'--seconds={arguments.seconds}', f'--inputs={arguments.inputs}']
        command = [sys.executable, __file__]
        codes = [subprocess.run([*command, name, *options], check=False) for name in NAMES]
        return max(abs(finished.returncode) for finished in codes)
    _fuzz(arguments.target, arguments.seconds, arguments.inputs)
    return 0


def _fuzz(name: str, seconds: int, n_inputs: int) -> None:
    try:
        import atheris
    except ImportError:
        sys.exit("fuzzing needs atheris: pip install 'thermo_comp[fuzz]'")
    sys.path[:0] = [str(ROOT), str(ROOT / 'fuzz')]
    with atheris.instrument_imports(include=['thermo_comp']):
        import targets

        if name in {'cdr', 'parameters'}:
            import thermo_comp.ros.parameters  # noqa: F401 - instrumented by this import
    target = targets.targets()[name]
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds):
        (folder / f'seed{number}').write_bytes(seed)
    options = [
        f'-max_total_time={seconds}',
        f'-runs={n_inputs}',
        f'-max_len={target.max_length}',
        '-timeout=10',
        '-rss_limit_mb=1024',
        '-print_final_stats=1',
        '-verbosity=0' if seconds < 30 else '-verbosity=1',
    ]
    atheris.Setup([sys.argv[0], *options, str(folder)], target.check)
    atheris.Fuzz()


if __name__ == '__main__':
    sys.exit(main())
