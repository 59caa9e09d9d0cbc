# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns what tests need to build the package: whether a compiler is there, a clean Python process.

"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def missing() -> str:
    """Say what a build lacks here; empty where nothing."""
    if importlib.util.find_spec('mypyc') is None:
        return 'mypyc is not installed: the extra `test`'
    compiler = (sysconfig.get_config_var('CC') or 'cc').split()[0]
    if shutil.which(compiler) is None:
        return f'no C compiler: {compiler}'
    header = Path(sysconfig.get_path('include'), 'Python.h')
    return '' if header.exists() else f'no headers of Python: {header}'


def run(*command: object, **env: str) -> subprocess.CompletedProcess[str]:
    clean = {key: value for key, value in os.environ.items() if key != 'PYTHONPATH'}
    return subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=env.pop('cwd', None),
        env={**clean, **env},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
