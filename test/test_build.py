# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The package installs with and without a compiler, and says which core it has and why.

"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from build_helpers import ROOT, missing, run


@pytest.mark.parametrize('command', ['develop', 'editable_wheel'])
def test_an_editable_install_is_refused(command: str) -> None:
    finished = run('setup.py', command, cwd=str(ROOT), THERMO_COMP_COMPILE='1')
    assert finished.returncode == 1
    assert 'does not go with an editable install' in finished.stderr
    assert 'Traceback' not in finished.stderr


#: setup.py without the compiler that may be installed.
HIDDEN = """
import runpy, sys
sys.modules['mypyc'] = None
runpy.run_path('setup.py', run_name='__main__')
"""


def build(
    tmp_path: Path, *before: object, stub: str = '', **env: str
) -> subprocess.CompletedProcess[str]:
    """Build the package as pip and colcon do, with this in place of mypyc."""
    if stub:
        (tmp_path / 'mypyc').mkdir()
        (tmp_path / 'mypyc' / '__init__.py').touch()
        (tmp_path / 'mypyc' / 'build.py').write_text(f'def mypycify(*_, **__):\n    {stub}\n')
        env['PYTHONPATH'] = str(tmp_path)
    command = [*(before or ['setup.py']), 'build', '-b', tmp_path / 'build']
    return run(*command, cwd=str(ROOT), **env)


def built(tmp_path: Path) -> list[str]:
    """Name the modules that were built; whatever was compiled is among them."""
    files = [*(tmp_path / 'build').glob('lib*/thermo_comp/*')]
    assert any(file.name == 'kernel.py' for file in files)
    return [file.name for file in files if file.suffix in {'.so', '.pyd'}]


NO_MYPYC = r"^thermo_comp: the core stays interpreted: it needs mypyc .*'mypy>=1.18'$"


def test_without_mypyc_the_core_stays_interpreted(tmp_path: Path) -> None:
    """WHY: a vehicle's computer has no compiler, and has to get the package all the same."""
    finished = build(tmp_path, '-c', HIDDEN, THERMO_COMP_COMPILE='')
    assert finished.returncode == 0, finished.stderr
    assert re.search(NO_MYPYC, finished.stderr, re.MULTILINE)
    assert built(tmp_path) == []


@pytest.mark.parametrize('wish', ['', '1'])
@pytest.mark.parametrize(
    ('stub', 'env', 'said'),
    [
        ('return []', {'CC': 'no-such-cc'}, 'it needs a C compiler, no-such-cc'),
        # One that is there and fails: what was built before it failed must not stay.
        ('return []', {'CC': 'false'}, 'the C compiler failed: '),
        ('raise RuntimeError("crashed")', {}, 'mypyc failed: crashed'),
        ('import sys; sys.exit("a type error")', {}, 'mypyc failed: a type error'),
    ],
)
def test_what_cannot_be_compiled_is_an_error_only_where_it_was_asked_for(
    tmp_path: Path, stub: str, env: dict[str, str], said: str, wish: str
) -> None:
    if missing():
        pytest.skip(missing())
    finished = build(tmp_path, stub=stub, THERMO_COMP_COMPILE=wish, **env)
    assert 'Traceback' not in finished.stderr
    if wish:
        assert finished.returncode == 1
        assert f'thermo_comp: THERMO_COMP_COMPILE: {said}' in finished.stderr
    else:
        assert finished.returncode == 0, finished.stderr
        assert f'thermo_comp: the core stays interpreted: {said}' in finished.stderr
        assert built(tmp_path) == []


def test_a_missing_compiler_is_named(tmp_path: Path) -> None:
    finished = build(tmp_path, '-c', HIDDEN, THERMO_COMP_COMPILE='1')
    assert finished.returncode == 1
    assert re.search(r"^thermo_comp: .* pip install 'mypy>=", finished.stderr, re.MULTILINE)
    assert 'Traceback' not in finished.stderr


@pytest.mark.parametrize('name', ['build', 'editable'])
@pytest.mark.parametrize(
    ('wish', 'brought'),
    [('', ['mypy>=1.18']), ('1', ['mypy>=1.18']), ('0', [])],
)
def test_pip_is_asked_for_the_compiler(
    tmp_path: Path, name: str, wish: str, brought: list[str]
) -> None:
    """WHY: what a build in pip's isolation needs is what this hook tells."""
    # The hook writes beside setup.py what it finds.
    (tmp_path / 'thermo_comp').mkdir()
    for file in ('setup.py', 'README.md', 'thermo_comp/__init__.py'):
        shutil.copy(ROOT / file, tmp_path / file)
    kind = 'wheel' if name == 'build' else 'editable'
    code = f'import setuptools.build_meta as b; print(b.get_requires_for_build_{kind}())'
    finished = run('-c', code, cwd=str(tmp_path), THERMO_COMP_COMPILE=wish)
    assert finished.returncode == 0, finished.stderr
    said = ast.literal_eval(finished.stdout.splitlines()[-1])
    # Older ones of setuptools add what they need themselves.
    assert [r.split(';')[0] for r in said if not r.startswith('wheel')] == brought
