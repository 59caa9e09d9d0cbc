# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what every test shares: an own DDS domain per test process, seeds, the command line's door.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

# Every worker of every test run on this machine talks in a DDS domain of its own, and none of them
# beyond this machine. The run id keeps two runs apart, the worker's number two workers.
_RUN = os.environ.get('PYTEST_XDIST_TESTRUNUID', str(os.getpid()))
_WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
os.environ['ROS_DOMAIN_ID'] = str((zlib.crc32(_RUN.encode()) % 25) * 4 + _WORKER % 4)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.pop('ROS_STATIC_PEERS', None)

# A shell starts what runs in the background deaf to SIGINT, and children inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# How long an example takes is the machine's business, not a test's.
settings.register_profile('usual', deadline=None)
settings.load_profile('usual')
# For `make nightly`; tests that say how often they run are not touched.
settings.register_profile('nightly', max_examples=10_000, deadline=None)


class Cli(Protocol):
    """Run ``thermo_comp`` as a user does, in a process of its own."""

    def __call__(
        self, *args: str | Path, code: int | None = 0, cwd: Path | None = None, **env: str
    ) -> subprocess.CompletedProcess[str]: ...


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20161)


@pytest.fixture(scope='session')
def root() -> Path:
    return ROOT


@pytest.fixture(scope='session')
def real_data() -> Path:
    """Return the folder of real recordings made by others, which the project may not ship."""
    folder = Path(os.environ.get('THERMO_COMP_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip(f'the real recordings are not in {folder} (set THERMO_COMP_DATA)')
    return folder


@pytest.fixture(scope='session')
def cli() -> Cli:
    def run(
        *args: str | Path, code: int | None = 0, cwd: Path | None = None, **env: str
    ) -> subprocess.CompletedProcess[str]:
        finished = subprocess.run(
            [sys.executable, '-m', 'thermo_comp', *map(str, args)],
            cwd=cwd,
            env={**os.environ, 'PYTHONPATH': str(ROOT), 'COLUMNS': '80', **env},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert 'Traceback' not in finished.stderr, finished.stderr
        if code is not None:
            assert finished.returncode == code, finished.stderr + finished.stdout
        return finished

    return run
