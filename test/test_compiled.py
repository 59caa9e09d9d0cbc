# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The compiled core is the interpreted one: built as a user builds it, run, compared to the bit.

"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from thermo_comp.status import DROPPED

ROOT = Path(__file__).resolve().parent.parent
HERE = Path(__file__).resolve().parent


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


@pytest.fixture(scope='module')
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the compiled core beside a copy of the package."""
    if missing():
        pytest.skip(missing())
    path = tmp_path_factory.mktemp('compiled')
    shutil.copytree(
        ROOT / 'thermo_comp',
        path / 'thermo_comp',
        ignore=shutil.ignore_patterns('__pycache__', '*.so'),
    )
    for name in ('setup.py', 'README.md'):
        shutil.copy(ROOT / name, path / name)
    finished = run('setup.py', '-q', 'build_ext', '-i', cwd=str(path), THERMO_COMP_COMPILE='1')
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return path


def saved(path: Path, core: Path) -> dict[str, np.ndarray]:
    finished = run(
        HERE / 'compiled_run.py', path, PYTHONPATH=os.pathsep.join([str(core), str(HERE)])
    )
    assert finished.returncode == 0, finished.stderr
    with np.load(path) as arrays:
        return dict(arrays)


def test_both_cores_give_the_same_bits(tree: Path, tmp_path: Path) -> None:
    """
    WHY: a flight replayed on another machine must give the bits that the vehicle published.

    WHAT: a simulated day with lost, frozen, jumping and quantized thermometers, bad samples, a
    loop of time, a reload, in the stream and in blocks: every number, status and flag.

    """
    interpreted = saved(tmp_path / 'interpreted.npz', ROOT)
    compiled = saved(tmp_path / 'compiled.npz', tree)
    assert not interpreted.pop('is_compiled').any()
    assert compiled.pop('is_compiled').all()
    assert interpreted.keys() == compiled.keys()
    for name, values in interpreted.items():
        np.testing.assert_array_equal(compiled[name], values, err_msg=name)
    # The comparison means something only if everything happened.
    for kind in ('smooth', 'cells', 'degrees'):
        last, flags = interpreted[f'{kind}_batch_texts'][-2:]
        assert 'True' in flags
        assert 'False' in flags
        for counter in (*DROPPED, 'n_board_rejected', 'n_case_rejected', 'n_time_jumps'):
            assert int(re.search(rf'{counter}=(\d+)', last)[1]), (kind, counter)


def test_a_compiled_core_says_so(tree: Path) -> None:
    finished = run('-m', 'thermo_comp', '--version', cwd=str(tree))
    assert re.fullmatch(r'thermo_comp \S+ \(compiled core\)\n', finished.stdout)


@pytest.mark.parametrize(
    ('command', 'said'),
    [
        ('develop', 'does not go with an editable install'),
        ('editable_wheel', 'does not go with an editable install'),
    ],
)
def test_an_editable_install_is_refused(command: str, said: str) -> None:
    finished = run('setup.py', command, cwd=str(ROOT), THERMO_COMP_COMPILE='1')
    assert finished.returncode == 1
    assert said in finished.stderr
    assert 'Traceback' not in finished.stderr


def test_a_missing_compiler_is_named(tmp_path: Path) -> None:
    # A `mypyc` that cannot be imported hides the one that may be installed.
    (tmp_path / 'mypyc.py').write_text('raise ImportError\n')
    finished = run(
        *('setup.py', 'build', '-b', tmp_path),
        cwd=str(ROOT),
        PYTHONPATH=str(tmp_path),
        THERMO_COMP_COMPILE='1',
    )
    assert finished.returncode == 1
    assert re.search(r"^thermo_comp: .* pip install 'mypy>=", finished.stderr, re.MULTILINE)
    assert 'Traceback' not in finished.stderr
